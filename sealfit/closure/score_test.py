"""Score tests of columns of the force by sign flips of whole units, with p-values adjusted for the whole search."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Sequence
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
    TESTED_AGAINST_RUNS,
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
# Score tests of columns of the force by sign flips of whole units and by the jackknife over them.
#
# A candidate is a free shape of one channel acting on one quantity: columns c of the force. After whitening and after
# projection on the tangent space of the current model, the score of unit u is :math:`s_u = c_u^T r_u`, and
#
# .. math:: T = S^T V^{-1} S, \quad S = \sum_u s_u, \quad V = \sum_u s_u s_u^T .
#
# The r_u in V are enlarged for what the fit has removed from each unit (CR2, Bell & McCaffrey 2002), because residuals
# are smaller than errors and V would be too small with few units. V does not change when the sign of a unit is flipped,
# so random flips give the null distribution of T.
#
# Sign flips are valid for any scatter of the units, but a strong effect is part of V itself: T never exceeds the number
# of units over the kurtosis of c, and a few runs in extreme places may mask the others. From thirty units on the
# estimate is therefore also tested against its jackknife over whole units (CV3; MacKinnon, Nielsen & Webb 2023,
# doi:10.1016/j.jeconom.2022.04.001). A few runs may have nearly all of the leverage and agree by chance, so what the
# columns explain must be significant too: by chi-squared, or by F against the scatter of runs if they are one number
# per run. With fewer than thirty specimens, what is constant in them is tested against their own scatter
# (`small_sample`), and what varies within them against the scatter of their slopes (`slopes`). With fewer than twenty
# runs, what is constant in runs is tested against their scatter (`small_sample`).

# A unit alone determines a direction if the eigenvalue of what is left without the unit is smaller.
OWN = 1e-6
# A direction of the tangent space with a smaller singular value lies in the specimens' own columns.
RANK = 1e-9


class ScoreTestResult(NamedTuple):
    """Score test of some columns."""

    chi2: float  # whitened sum of squares they explain
    df: int
    units: int
    log_p: float  # of T by its F distribution, not adjusted
    log_p_jackknife: float = 0.0  # of the estimate by the jackknife over units; 0 if not computed
    scores: np.ndarray | None = None  # (units, k)
    small_sample: SmallSampleTest | None = None  # against the scatter of few units; None if not tested
    slopes: tuple[ContrastTest, ...] = ()  # against the slopes of few units, one per variant
    consistent: bool = True  # whether two to four specimens have the same slopes along strokes


@dataclass(frozen=True)
class Candidate:
    """A free shape of one channel, or of a pair, acting on one quantity, with its test."""

    channels: tuple[str, ...]
    acts_on: str
    operation: str
    unit: str  # level of the groups whose signs are flipped
    columns: np.ndarray  # (n, k) shape values, before the slope of the quantity
    test_result: ScoreTestResult
    p_value: float = 1.0  # adjusted over the search
    pair: bool = False  # whether it is an interaction of two channels

    @property
    def key(self) -> tuple:
        """Its channels and target."""
        return (self.channels, self.acts_on, self.operation)

    @property
    def consistent(self) -> bool:
        """Whether two to four specimens have the same slopes."""
        strongest = (test.consistent[np.argmax(np.abs(test.slope))] for test in self.test_result.slopes)
        return self.test_result.consistent and all(strongest)

    @property
    def claimable(self) -> bool:
        """Whether it may be claimed: there are enough units, and two to four specimens are consistent."""
        return self.consistent and (self.test_result.small_sample is None or self.test_result.small_sample.enough_df)

    @property
    def chi2(self) -> float:
        """Whitened sum of squares it explains."""
        return self.test_result.chi2

    @property
    def evidence(self) -> float:
        """Explained sum of squares less the BIC penalty of the columns."""
        return self.chi2 - self.test_result.df * np.log(max(self.test_result.units, 2))


def project(fitted: Fitted, columns: np.ndarray) -> np.ndarray:
    """Return columns of the force, whitened and projected off the tangent space of the model, shape (n, k)."""
    white = fitted.whitening(columns)
    return _distinct(fitted.basis.project_out(white), white)


def _distinct(left: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Return projected columns, shape (n, k), with zeros for those that are not identifiable."""
    left[:, _squares(left) < IDENTIFIABLE * _squares(columns)] = 0.0
    return left


def _squares(columns: np.ndarray) -> np.ndarray:
    return np.einsum("ij,ij->j", columns, columns)


class ScoreTests:
    """Score tests of columns of the force on the residual of a fit.

    Parameters
    ----------
    fitted : Fitted
        The current model at its optimum.
    """

    def __init__(self, fitted: Fitted) -> None:
        self.fitted = fitted
        self.cluster_tests = {level: ClusterTests(fitted, level) for level in LEVELS}
        self._kept: dict[str, tuple[np.ndarray, np.ndarray]] = {}

    def variants(self, columns: np.ndarray, unit: str) -> tuple[np.ndarray, ...]:
        """Return the columns of a channel, shape (n, k), in each variant in which they must be significant.

        The first variant is projected. If the scatter of specimens is not known, the second is also projected off the
        specimens' own columns. With about as many specimens as conditions their scatter is confounded with the
        conditions, and a channel that varies between runs, such as the time since the start, would explain it.
        """
        left = project(self.fitted, columns)
        if self._specimens is None or FINER[unit] >= FINER["specimen"]:
            return (left,)
        own, basis = self._specimens
        return left, _distinct(basis.project_out(own.project_out(left)), left)

    @cached_property
    def _specimens(self) -> tuple[OwnColumns, Tangent] | None:
        """The specimens' own columns (their friction), and the tangent space projected off them.

        None if their scatter is known or each specimen is one run.
        """
        rows = self.fitted.rows
        starts = rows.groups.starts
        if self.fitted.scatter.estimates("specimen") or not 1 < starts["specimen"].size < starts["run"].size:
            return None
        white, basis = self.fitted.whitening(self.fitted.friction[:, None])[:, 0], self.fitted.basis
        size = rows.groups.sums(white**2, "specimen")
        taken = (basis.sums(rows.groups, "specimen", white).values ** 2).sum(axis=1)
        identifiable = size - taken >= IDENTIFIABLE * size
        own = OwnColumns(rows.codes("specimen"), white * identifiable[rows.codes("specimen")])
        return own, basis.orthonormal(RANK, project_out=own.project_out)

    def __call__(
        self, variants: Sequence[np.ndarray], between: str, level: str, target: tuple[str, str]
    ) -> ScoreTestResult | None:
        """Return the weakest test of all variants of some columns; None if one of them cannot be tested.

        Parameters
        ----------
        variants : sequence of ndarray, shape (n, k)
            Columns as returned by `variants`.
        between : str
            Level of the units whose slopes along the columns may scatter.
        level : str
            Level of the units of evidence.
        target : tuple of str
            (acts_on, operation) of the columns.
        """
        starts = self.fitted.rows.groups.starts
        few_units = starts[between].size < JACKKNIFE_UNITS
        found = []
        for left in variants:
            test_result = self._score_test(left, level if few_units else between, target)
            if test_result is None:
                return None
            found.append(test_result)
        weakest = max(found, key=lambda j: max(j.log_p, j.log_p_jackknife))
        weakest = weakest._replace(units=starts[level].size)
        if not few_units:
            return weakest._replace(consistent=all(map(self._specimens_agree, variants)))
        if level == "specimen":
            test = self.cluster_tests[level].test(variants[0], target)
            if test is None:
                return weakest
            return weakest._replace(chi2=test.chi2, df=test.basis.shape[1], small_sample=test)
        tests = tuple(contrast_test(self.fitted, left, between) for left in variants)
        if any(test is None for test in tests):
            return None
        return weakest._replace(slopes=tests, small_sample=self._test_of_runs(variants, between, level, target))

    def _specimens_agree(self, left: np.ndarray) -> bool:
        """Return whether two to four specimens are consistent in what columns along strokes explain together."""
        fitted = self.fitted
        if not few_specimens(fitted):
            return True
        explained = left @ (np.linalg.pinv(left.T @ left, hermitian=True) @ (left.T @ fitted.white_residual))
        explained = explained[:, None]
        return not along_strokes(fitted, explained)[0] or bool(specimens_agree(fitted, explained)[0])

    def _test_of_runs(
        self, variants: Sequence[np.ndarray], between: str, level: str, target: tuple[str, str]
    ) -> SmallSampleTest | None:
        """Return the weakest F test of all variants of columns that are constant in each of a few runs.

        It is exact; the variance of a slope from half a dozen runs has two or three degrees of freedom.
        """
        if not between == level == "run" or self.fitted.rows.groups.starts["run"].size >= MANY_RUNS:
            return None
        tests = [self.cluster_tests["run"].test(left, target) for left in variants]
        if any(test is None or test.share <= CONSTANT_IN_RUNS for test in tests):
            return None
        return max(tests, key=lambda test: test.log_p)

    def _score_test(self, left: np.ndarray, level: str, target: tuple[str, str]) -> ScoreTestResult | None:
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
            if level == "run" and explained < np.log(TESTED_AGAINST_RUNS):
                test = self.cluster_tests["run"].test(left, target)
                if test is not None and test.share > CONSTANT_IN_RUNS:
                    explained = min(explained, test.log_p)
            if explained < np.log(PROMISING):
                jackknife = max(self._jackknife(left, level), explained)
        return ScoreTestResult(float(total @ total), left.shape[1], units, log_p, jackknife, scores)

    def _jackknife(self, left: np.ndarray, level: str) -> float:
        """Return the log p-value of the coefficients of orthonormal columns by their jackknife over whole units.

        All parameters, also those of the model, are re-estimated without each unit u in the tangent space, from the
        normal equations less those of u: [[1 - B'B, -B'L], [-L'B, 1 - L'L]] with B, L its rows of basis and columns.
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
    """Return inverses, shape (u, k, k), from eigenvalues and axes; 0 for what one unit alone determines."""
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
# P-values adjusted for the whole search: all channels, quantities and numbers of columns.
#
# The signs of whole units are flipped at random many times. The largest T over all candidates gives the p-value
# adjusted for the search (Westfall & Young 1993; sign flips of score contributions: Hemerik, Goeman & Finos 2020,
# doi:10.1111/rssb.12369). P-values by the jackknife are adjusted for the number of candidates (Bonferroni); each of the
# two tests has half of the error rate. Tests on few specimens are adjusted by random draws (`small_sample`), contrasts
# in few units by their number (`slopes`).
#
# Draws continue until the smallest p-value is known well enough for the decision not to depend on them (sequential
# Monte Carlo p-values: Besag & Clifford 1991, Biometrika 78(2), 301-304, doi:10.1093/biomet/78.2.301).

FLIPS = 1999  # Number of random sign flips, or draws, that are made at a time.
MOST_FLIPS = 25 * FLIPS  # Their largest number: a p-value of 0.00125, four times which is 0.005, has an error of 13 %.
ENOUGH = 50  # Number of draws below the smallest p-value that determine it well enough.
MOST_SIGNS = 1 << 22  # Signs of all units that are drawn at once (34 MB), or beyond `FLIPS`.


def adjust_all(tests: ScoreTests, candidates: Sequence[Candidate], rng: np.random.Generator) -> list[Candidate]:
    """Return candidates with p-values adjusted over all of them, strongest evidence first."""
    results = [c.test_result for c in candidates]
    p_values = np.ones(len(candidates))
    many = [k for k, r in enumerate(results) if r.small_sample is None and not r.slopes]
    if many:
        p_values[many] = adjust([results[k] for k in many], rng)
    for k in many:
        if results[k].scores.shape[0] >= JACKKNIFE_UNITS:  # two tests, each with half of the error rate
            p_values[k] = 2 * min(p_values[k], len(many) * np.exp(results[k].log_p_jackknife))
    small = np.min([adjust_small_sample(units, results, rng) for units in tests.cluster_tests.values()], axis=0)
    p_values = np.minimum(p_values, np.minimum(small, adjust_slopes(results)))
    p_values[[r.small_sample is not None and bool(r.slopes) for r in results]] *= 2  # two tests here as well
    found = [replace(c, p_value=min(1.0, SEARCHES * float(p))) for c, p in zip(candidates, p_values, strict=True)]
    return sorted(found, key=lambda c: -c.evidence)


def adjust(results: Sequence[ScoreTestResult], rng: np.random.Generator, flips: int = FLIPS) -> np.ndarray:
    """Return each p-value adjusted over all results by the maximum over sign flips, shape (m,).

    Results with the same number of units are flipped with the same signs, so that their correlation is used.
    """
    own = [j.log_p for j in results]
    return _adjusted(own, _drawn(lambda: _least(results, rng, flips), min(own), max(j.units for j in results)))


def _drawn(draw: Callable[[], np.ndarray], smallest: float, units: int) -> np.ndarray:
    """Return draws of the smallest log p-value until `ENOUGH` are below the smallest observed one, or no more fit."""
    least = draw()
    most = min(MOST_FLIPS, MOST_SIGNS // units)
    while np.count_nonzero(least <= smallest) < ENOUGH and least.size < most:
        least = np.concatenate([least, draw()])
    return least


def critical_many(results: Sequence[ScoreTestResult], level: float, rng: np.random.Generator) -> float:
    """Return the critical value at a level of the smallest log p-value (not adjusted) of all results."""
    return float(np.quantile(_least(results, rng, FLIPS), level))


def critical_small_sample(fitted: Fitted, tests: Sequence[SmallSampleTest], level: float) -> float:
    """Return the same for the small-sample tests of one level."""
    units = ClusterTests(fitted, tests[0].level)
    for test in tests:
        units.numbers(test.target)
    return float(np.quantile(_least_small_sample(units, tests, np.random.default_rng(0), FLIPS), level))


def _least(results: Sequence[ScoreTestResult], rng: np.random.Generator, flips: int) -> np.ndarray:
    """Return the smallest log p-value of all results under each of many random flips."""
    by_units = defaultdict(lambda: defaultdict(list))
    for test_result in results:
        units, df = test_result.scores.shape
        by_units[units][df].append(test_result.scores)
    least = np.zeros(flips)
    for units, by_df in by_units.items():
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


def adjust_small_sample(
    units: ClusterTests, results: Sequence[ScoreTestResult], rng: np.random.Generator, draws: int = FLIPS
) -> np.ndarray:
    """Return the p-values of the small-sample tests of a level, adjusted over all, shape (m,); 1 if not tested."""
    p_values = np.ones(len(results))
    tried = [k for k, j in enumerate(results) if j.small_sample is not None and j.small_sample.level == units.level]
    if tried:
        tests = [results[k].small_sample for k in tried]
        logs = np.array([test.log_p for test in tests])
        count = max(results[k].units for k in tried)
        least = _drawn(lambda: _least_small_sample(units, tests, rng, draws), logs.min(), count)
        # Bonferroni is for p-values that are smaller than the draws resolve.
        p_values[tried] = np.minimum(_adjusted(logs, least), len(tried) * np.exp(logs))
    return p_values


def _least_small_sample(
    units: ClusterTests, tests: Sequence[SmallSampleTest], rng: np.random.Generator, draws: int
) -> np.ndarray:
    """Return the smallest log p-value of all small-sample tests of one level in each of many draws."""
    drawn = units.draws(draws, rng)
    return np.min([small_sample_test.log_p_of(drawn[test.target], test.basis, test.known) for test in tests], axis=0)


def adjust_slopes(results: Sequence[ScoreTestResult]) -> np.ndarray:
    """Return the p-values of the contrasts in few units, times their number, shape (m,); 1 if not tested.

    A candidate has the p-value of its strongest contrast in its weakest variant.
    """
    p_values = np.ones(len(results))
    tried = [k for k, j in enumerate(results) if j.slopes]
    if tried:
        logs = iter(slope_log_p([test for k in tried for test in results[k].slopes]))
        least = [max(float(next(logs).min()) for _ in results[k].slopes) for k in tried]
        count = sum(results[k].slopes[0].slope.size for k in tried)
        p_values[tried] = np.minimum(count * np.exp(least), 1.0)
    return p_values


def _adjusted(own: Sequence[float], least: np.ndarray) -> np.ndarray:
    """Return adjusted p-values from log p and many draws of the smallest log p under the null hypothesis."""
    return (1 + np.searchsorted(np.sort(least), own, side="right")) / (least.size + 1)
