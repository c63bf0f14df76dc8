"""Score tests of columns of the force, judged by sign flips of whole units, and adjusted for the whole search."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.special import betainc, chdtrc, fdtrc

from sealfit.closure import small_sample_test
from sealfit.closure.channels import FINER
from sealfit.closure.criteria import (
    CONSTANT_IN_RUNS,
    IDENTIFIABLE,
    JACKKNIFE_UNITS,
    MANY_RUNS,
    PROMISING,
    SEARCHES,
    WORTH_THE_RUNS,
)
from sealfit.closure.small_sample_test import (
    ClusterTests,
    ContrastTest,
    SmallSampleTest,
    along_strokes,
    contrast_test,
    few_specimens,
    slope_log_p,
    specimens_agree,
)
from sealfit.fit.joint.estimate import Fitted
from sealfit.fit.joint.rows import LEVELS
from sealfit.fit.joint.tangent import OwnColumns, Tangent

# ---------------------------------------------------------------- score test
# Score tests of columns of the force, judged by sign flips of whole units and by their jackknife.
#
# A candidate is a free shape of one channel acting on one quantity: columns c of the force. After whitening and after
# projection on the tangent space of the current model, the score of unit u is :math:`s_u = c_u^T r_u`, and
#
# .. math:: T = S^T V^{-1} S, \quad S = \sum_u s_u, \quad V = \sum_u s_u s_u^T .
#
# The r_u in V are widened for what the fit has taken out of each unit (CR2, Bell & McCaffrey 2002), as residuals are
# smaller than errors and few units would otherwise look too quiet. V is unchanged when a unit's sign is flipped,
# so that flips hold T against chance (`adjusted`).
#
# Sign flips hold whatever the units' scatter is, but a strong effect stands in V itself: T never exceeds the number of
# units over the kurtosis of c, and a few runs in extreme places hide what all others show. So from thirty units on the
# estimate is also held against its jackknife over whole units (CV3; MacKinnon, Nielsen & Webb 2023,
# doi:10.1016/j.jeconom.2022.04.001). A few runs may hold nearly all that columns say and agree by chance, so what the
# columns explain must count as well: by chi-squared, or by F against the runs' own scatter where they are one number a
# run. With fewer specimens than thirty, what is constant in them is held against their own scatter (`few`), and what
# varies within them against the scatter of their slopes (`slopes`); with fewer runs than twenty to tell slopes apart,
# what is constant in runs against the scatter of these (`few`).

OWN = 1e-6  # eigenvalue of what is left without a unit, below which the unit alone determines it
RANK = 1e-9  # singular value of what specimens do not hold of the tangent space, below which that is nothing


class ScoreTestResult(NamedTuple):
    """What the residual says of some columns."""

    chi2: float  # whitened sum of squares they explain
    df: int
    units: int
    log_p: float  # of T by its F distribution, not adjusted
    log_p_jackknife: float = 0.0  # of the estimate against its jackknife over units; 0 where that was not tried
    scores: np.ndarray | None = None  # (units, k)
    few: SmallSampleTest | None = None  # against the scatter of few specimens; None where that was not tried
    slopes: tuple[ContrastTest, ...] = ()  # against the slopes of few units, in every variant; empty where not tried
    agree: bool = True  # whether two to four specimens show the same along strokes, where many runs are the units


@dataclass(frozen=True)
class Candidate:
    """A free shape of one channel, or of a pair, acting on one quantity, with its test."""

    channels: tuple[str, ...]
    acts_on: str
    operation: str
    unit: str  # level of the groups moved by sign flips
    columns: np.ndarray  # (n, k) shape values, before the slope of the quantity
    test_result: ScoreTestResult
    p_value: float = 1.0  # adjusted over the search
    pair: bool = False  # whether it acts by two channels together

    @property
    def key(self) -> tuple:
        """What it acts with and on."""
        return (self.channels, self.acts_on, self.operation)

    @property
    def agrees(self) -> bool:
        """Whether two to four specimens show the same of it."""
        few = (test.agree[np.argmax(np.abs(test.slope))] for test in self.test_result.slopes)
        return self.test_result.agree and all(few)

    @property
    def sure(self) -> bool:
        """Whether it may be claimed: too few specimens do not show their own scatter, or show that they differ."""
        return self.agrees and (self.test_result.few is None or self.test_result.few.sure)

    @property
    def chi2(self) -> float:
        """Whitened sum of squares it explains."""
        return self.test_result.chi2

    @property
    def evidence(self) -> float:
        """Explained sum of squares less what as many idle columns would be given (Schwarz)."""
        return self.chi2 - self.test_result.df * np.log(max(self.test_result.units, 2))


def project(fitted: Fitted, columns: np.ndarray) -> np.ndarray:
    """Return columns of the force, whitened and freed of the current model's tangent space, shape (n, k)."""
    white = fitted.whitening(columns)
    return _distinct(fitted.basis.project_out(white), white)


def _distinct(left: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Return what is left of columns, shape (n, k) both, with zeros for those of which next to nothing is."""
    left[:, _squares(left) < IDENTIFIABLE * _squares(columns)] = 0.0
    return left


def _squares(columns: np.ndarray) -> np.ndarray:
    return np.einsum("ij,ij->j", columns, columns)


class ScoreTests:
    """Holds columns of the force against the residual of a fit.

    Parameters
    ----------
    fitted : Fitted
        The current model at its optimum.
    """

    def __init__(self, fitted: Fitted) -> None:
        self.fitted = fitted
        self.few = {level: ClusterTests(fitted, level) for level in LEVELS}
        self._kept: dict[str, tuple[np.ndarray, np.ndarray]] = {}

    def variants(self, columns: np.ndarray, unit: str) -> tuple[np.ndarray, ...]:
        """Return columns of a channel of some unit, shape (n, k), in every way in which they must hold.

        They are projected; and, where the scatter of specimens is not known, freed of what tells specimens apart. With
        about as many specimens as conditions that scatter cannot be told from the conditions' own values, and a channel
        that varies from run to run, such as the time since the start, would be given what specimens do.
        """
        left = project(self.fitted, columns)
        if self._specimens is None or FINER[unit] >= FINER["specimen"]:
            return (left,)
        own, basis = self._specimens
        return left, _distinct(basis.project_out(own.project_out(left)), left)

    @cached_property
    def _specimens(self) -> tuple[OwnColumns, Tangent] | None:
        """What tells specimens apart: their friction, and the tangent space less that; None where that cannot be had.

        It cannot where their scatter is known, or where each specimen is one run."""
        rows = self.fitted.rows
        starts = rows.groups.starts
        if self.fitted.scatter.estimates("specimen") or not 1 < starts["specimen"].size < starts["run"].size:
            return None
        white, basis = self.fitted.whitening(self.fitted.friction[:, None])[:, 0], self.fitted.basis
        size = rows.groups.sums(white**2, "specimen")
        taken = (basis.sums(rows.groups, "specimen", white).values ** 2).sum(axis=1)
        told = size - taken >= IDENTIFIABLE * size
        own = OwnColumns(rows.codes("specimen"), white * told[rows.codes("specimen")])
        return own, basis.orthonormal(RANK, project_out=own.project_out)

    def __call__(
        self, variants: Sequence[np.ndarray], between: str, level: str, target: tuple[str, str]
    ) -> ScoreTestResult | None:
        """Return the judgement that says least of all variants of some columns; None where one cannot be judged.

        Parameters
        ----------
        variants : sequence of ndarray, shape (n, k)
            Columns as `variants` gives them.
        between : str
            Level of the units whose slopes along the columns may scatter.
        level : str
            Level whose whole groups are held out.
        target : tuple of str
            (acts_on, operation) of the columns.
        """
        starts = self.fitted.rows.groups.starts
        few = starts[between].size < JACKKNIFE_UNITS
        found = []
        for left in variants:
            test_result = self._judge(left, level if few else between, target)
            if test_result is None:
                return None
            found.append(test_result)
        weakest = max(found, key=lambda j: max(j.log_p, j.log_p_jackknife))
        weakest = weakest._replace(units=starts[level].size)
        if not few:
            return weakest._replace(agree=all(map(self._specimens_agree, variants)))
        if level == "specimen":
            test = self.few[level].test(variants[0], target)
            return weakest if test is None else weakest._replace(chi2=test.chi2, df=test.basis.shape[1], few=test)
        tests = tuple(contrast_test(self.fitted, left, between) for left in variants)
        if any(test is None for test in tests):
            return None
        return weakest._replace(slopes=tests, few=self._of_few_runs(variants, between, level, target))

    def _specimens_agree(self, left: np.ndarray) -> bool:
        """Return whether a few specimens show the same of what columns along strokes explain together."""
        fitted = self.fitted
        if not few_specimens(fitted):
            return True
        explained = left @ (np.linalg.pinv(left.T @ left, hermitian=True) @ (left.T @ fitted.white_residual))
        explained = explained[:, None]
        return not along_strokes(fitted, explained)[0] or bool(specimens_agree(fitted, explained)[0])

    def _of_few_runs(
        self, variants: Sequence[np.ndarray], between: str, level: str, target: tuple[str, str]
    ) -> SmallSampleTest | None:
        """Return the F test, of all variants that which says least, of columns constant in each of a few runs.

        It is exact there, while the variance of a slope from half a dozen runs has two or three degrees of freedom.
        """
        if not between == level == "run" or self.fitted.rows.groups.starts["run"].size >= MANY_RUNS:
            return None
        tests = [self.few["run"].test(left, target) for left in variants]
        if any(test is None or test.share <= CONSTANT_IN_RUNS for test in tests):
            return None
        return max(tests, key=lambda test: test.log_p)

    def _judge(self, left: np.ndarray, level: str, target: tuple[str, str]) -> ScoreTestResult | None:
        fitted = self.fitted
        units = fitted.rows.groups.starts[level].size
        size = np.sqrt(_squares(left))
        left = left[:, size > 0] / size[size > 0]
        if left.shape[1] == 0 or units < 4:
            return None
        u, s, _ = np.linalg.svd(left.T @ left)
        keep = s > 1e-6 * s[0]
        left = (left @ u[:, keep] / np.sqrt(s[keep]))[:, : max(1, units // 5)]
        scores = fitted.rows.groups.sums(left * fitted.unit_residual(level)[:, None], level)
        total = left.T @ fitted.white_residual
        log_p = float(log_p_of(score_statistic(total[None, :], scores)[0], left.shape[1], units))
        jackknife = 0.0
        if units >= JACKKNIFE_UNITS:
            explained = _log(chdtrc(left.shape[1], total @ total))
            if level == "run" and explained < np.log(WORTH_THE_RUNS):
                test = self.few["run"].test(left, target)
                if test is not None and test.share > CONSTANT_IN_RUNS:
                    explained = min(explained, test.log_p)
            if explained < np.log(PROMISING):
                jackknife = max(self._jackknife(left, level), explained)
        return ScoreTestResult(float(total @ total), left.shape[1], units, log_p, jackknife, scores)

    def _jackknife(self, left: np.ndarray, level: str) -> float:
        """Return the log p-value of orthonormal columns' coefficients against their jackknife over whole units.

        Everything is estimated anew without each unit u, the current model's numbers too, in the tangent space: the
        normal equations less those of u, [[1 - B'B, -B'L], [-L'B, 1 - L'L]] with B, L its rows of basis and columns.
        """
        fitted, start = self.fitted, self.fitted.rows.groups.starts[level]
        units, k = start.size, left.shape[1]
        parts = np.split(left, start[1:])
        inverse, product = self._without(level)
        own = np.add.reduceat(left * fitted.white_residual[:, None], start)
        mixed = np.stack([b.T @ c for b, c in zip(np.split(fitted.basis.values, start[1:]), parts, strict=True)])
        through = mixed.transpose(0, 2, 1) @ inverse
        square = np.eye(k) - np.stack([c.T @ c for c in parts]) - through @ mixed
        total = left.T @ fitted.white_residual
        right = total - own - np.einsum("uij,uj->ui", through, product)
        without = np.einsum("uij,uj->ui", _inverse_of(*np.linalg.eigh(square)), right)
        spread = (without - total).T @ (without - total) * (units - 1) / units
        t = float(total @ np.linalg.pinv(spread, hermitian=True) @ total)
        return _log(fdtrc(k, units - k, t * (units - k) / (k * (units - 1))))

    def _without(self, level: str) -> tuple[np.ndarray, np.ndarray]:
        """Return per unit the inverse of 1 - B'B, shape (units, k, k), and B'r, shape (units, k), in its block."""
        if level not in self._kept:
            fitted = self.fitted
            share, axes = fitted.unit_shares(level)
            inverse = _inverse_of(1 - share, axes)
            product = fitted.basis.sums(fitted.rows.groups, level, fitted.white_residual).values
            self._kept[level] = (inverse, product)
        return self._kept[level]


def _log(p_value: float) -> float:
    return float(np.log(max(p_value, 1e-300)))


def _inverse_of(size: np.ndarray, axes: np.ndarray) -> np.ndarray:
    """Return inverses, shape (u, k, k), from eigenvalues and axes; what one unit alone determines is left as it is."""
    shrink = np.where(size > OWN, 1 / np.maximum(size, OWN), 0.0)
    return (axes * shrink[:, None, :]) @ axes.transpose(0, 2, 1)


def score_statistic(totals: np.ndarray, scores: np.ndarray) -> np.ndarray:
    """Return T for each row of `totals`, shape (m, k) -> (m,)."""
    inverse = np.linalg.pinv(scores.T @ scores, rcond=1e-10, hermitian=True)
    return np.einsum("ij,jk,ik->i", totals, inverse, totals)


def log_p_of(t: np.ndarray, df: int, units: int) -> np.ndarray:
    """Return the log p-value of T, from Hotelling's F with as many units; T never exceeds their number."""
    share = np.clip(np.asarray(t) / units, 0.0, 1 - 1e-15)
    return np.log(np.maximum(betainc((units - df) / 2, df / 2, 1 - share), 1e-300))


# ---------------------------------------------------------------- multiplicity
# P-values adjusted for the whole search: for every channel, quantity and width that was tried.
#
# Flipping the signs of whole units at random many times costs one matrix product a candidate, and the largest
# standardised T over all candidates gives the p-value adjusted for the search (Westfall & Young 1993; sign flips of
# score contributions: Hemerik, Goeman & Finos 2020, doi:10.1111/rssb.12369). P-values by the jackknife are adjusted by
# the number of candidates (Bonferroni); each way has half of the error. Tests on few specimens are adjusted by draws
# (`few`), contrasts in few units by their number (`slopes`).

FLIPS = 1999  # resolves p = 0.0005, a tenth of the family-wise level
MOST_SIGNS = 1 << 22  # drawn at once: 34 MB


def judged(judge: ScoreTests, candidates: Sequence[Candidate], rng: np.random.Generator) -> list[Candidate]:
    """Return candidates with p-values adjusted over all of them, strongest evidence first."""
    judgements = [c.test_result for c in candidates]
    p_values = np.ones(len(candidates))
    many = [k for k, j in enumerate(judgements) if j.few is None and not j.slopes]
    if many:
        p_values[many] = adjust([judgements[k] for k in many], rng)
    for k in many:
        if judgements[k].scores.shape[0] >= JACKKNIFE_UNITS:  # of two ways, each has half of the error
            p_values[k] = 2 * min(p_values[k], len(many) * np.exp(judgements[k].log_p_jackknife))
    few_p = np.min([adjust_few(units, judgements, rng) for units in judge.few.values()], axis=0)
    p_values = np.minimum(p_values, np.minimum(few_p, adjust_slopes(judgements)))
    p_values[[j.few is not None and bool(j.slopes) for j in judgements]] *= 2  # of two ways, each has half of the error
    found = [replace(c, p_value=min(1.0, SEARCHES * float(p))) for c, p in zip(candidates, p_values, strict=True)]
    return sorted(found, key=lambda c: -c.evidence)


def adjust(judgements: Sequence[ScoreTestResult], rng: np.random.Generator, flips: int = FLIPS) -> np.ndarray:
    """Return each p-value adjusted over all judgements, by the maximum over sign flips, shape (m,).

    Those of as many units are flipped with the same signs, so that what they share counts once.
    """
    return _adjusted([j.log_p for j in judgements], _least(judgements, rng, flips))


def critical_many(judgements: Sequence[ScoreTestResult], level: float, rng: np.random.Generator) -> float:
    """Return the log p-value, not adjusted, that the smallest of all judgements falls below by chance at a level."""
    return float(np.quantile(_least(judgements, rng, FLIPS), level))


def critical_few(fitted: Fitted, tests: Sequence[SmallSampleTest], level: float) -> float:
    """Return the same for the tests on few units of one level."""
    units = ClusterTests(fitted, tests[0].level)
    for test in tests:
        units.numbers(test.target)
    return float(np.quantile(_least_few(units, tests, np.random.default_rng(0), FLIPS), level))


def _least(judgements: Sequence[ScoreTestResult], rng: np.random.Generator, flips: int) -> np.ndarray:
    """Return the smallest log p-value of all judgements under each of many random flips."""
    alike = defaultdict(lambda: defaultdict(list))
    for test_result in judgements:
        units, df = test_result.scores.shape
        alike[units][df].append(test_result.scores)
    least = np.zeros(flips)
    for units, by_df in alike.items():
        scores = np.column_stack([own for scores in by_df.values() for own in scores])
        totals = _flipped(scores, flips, rng)
        first = 0
        for df, scores in by_df.items():
            most = np.zeros(flips)  # the largest T has the smallest p-value where units and df are the same
            for own in scores:
                most = np.maximum(most, score_statistic(totals[:, first : first + df], own))
                first += df
            least = np.minimum(least, log_p_of(most, df, units))
    return least


def _flipped(scores: np.ndarray, flips: int, rng: np.random.Generator) -> np.ndarray:
    """Return the sums of scores, shape (units, m), under random signs -> (flips, m); a few flips at a time."""
    part = max(1, MOST_SIGNS // scores.shape[0])
    return np.concatenate(
        [
            rng.choice([-1.0, 1.0], size=(min(part, flips - first), scores.shape[0])) @ scores
            for first in range(0, flips, part)
        ]
    )


def adjust_few(
    units: ClusterTests, judgements: Sequence[ScoreTestResult], rng: np.random.Generator, draws: int = FLIPS
) -> np.ndarray:
    """Return the p-values of the tests on few units of a level, adjusted over all of them, shape (m,); 1 for none."""
    p_values = np.ones(len(judgements))
    tried = [k for k, j in enumerate(judgements) if j.few is not None and j.few.level == units.level]
    if tried:
        tests = [judgements[k].few for k in tried]
        logs = np.array([test.log_p for test in tests])
        least = _least_few(units, tests, rng, draws)
        p_values[tried] = np.minimum(_adjusted(logs, least), len(tried) * np.exp(logs))  # below what draws resolve
    return p_values


def _least_few(
    units: ClusterTests, tests: Sequence[SmallSampleTest], rng: np.random.Generator, draws: int
) -> np.ndarray:
    """Return the smallest log p-value of all tests on few units of one level in each of many draws."""
    drawn = units.draws(draws, rng)
    return np.min([small_sample_test.log_p_of(drawn[test.target], test.basis, test.known) for test in tests], axis=0)


def adjust_slopes(judgements: Sequence[ScoreTestResult]) -> np.ndarray:
    """Return the p-values of the contrasts in few units, times the number of all contrasts, shape (m,); 1 for none.

    A candidate has that of its strongest contrast, by the variant of it that says least.
    """
    p_values = np.ones(len(judgements))
    tried = [k for k, j in enumerate(judgements) if j.slopes]
    if tried:
        logs = iter(slope_log_p([test for k in tried for test in judgements[k].slopes]))
        least = [max(float(next(logs).min()) for _ in judgements[k].slopes) for k in tried]
        count = sum(judgements[k].slopes[0].slope.size for k in tried)
        p_values[tried] = np.minimum(count * np.exp(least), 1.0)
    return p_values


def _adjusted(own: Sequence[float], least: np.ndarray) -> np.ndarray:
    """Return p-values from log p and the least of all candidates under chance, drawn many times."""
    return (1 + np.searchsorted(np.sort(least), own, side="right")) / (least.size + 1)
