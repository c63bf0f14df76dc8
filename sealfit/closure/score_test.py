"""Score tests of columns of the force by sign flips of whole units and by the jackknife over them."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.special import betainc, chdtrc, fdtrc

from sealfit.closure import criteria
from sealfit.closure.channels import FINER
from sealfit.closure.small_sample_test import (
    ClusterTests,
    ContrastTest,
    SmallSampleTest,
    along_strokes,
    contrast_test,
    few_specimens,
    specimens_agree,
)
from sealfit.fit.joint import Fitted
from sealfit.fit.joint.rows import CELL, LEVELS, Cache, cached
from sealfit.fit.joint.tangent import OwnColumns, Tangent
from sealfit.fit.joint.variance_components import orthonormal

# A candidate is a free shape of one channel acting on one quantity: columns c of the force. After whitening
# and after projection on the tangent space of the current model, the score of unit u is
# :math:`s_u = c_u^T r_u`, and
#
# .. math:: T = S^T V^{-1} S, \quad S = \sum_u s_u, \quad V = \sum_u s_u s_u^T .
#
# The r_u in V are enlarged for what the fit has removed from each unit (CR2, Bell & McCaffrey 2002). V does
# not change when the sign of a unit is flipped, so random flips give the null distribution of T.
#
# A strong effect is part of V itself: T never exceeds the number of units over the kurtosis of c. From thirty
# units on the estimate is therefore also tested against its jackknife over whole units (CV3; MacKinnon,
# Nielsen & Webb 2023, doi:10.1016/j.jeconom.2022.04.001). A few runs may have nearly all of the leverage and
# agree by chance, so what the columns explain must be significant too: by chi-squared, or by F against the
# scatter of runs (files) if they are one number per run (file). With fewer than thirty specimens or runs,
# what is constant in them is tested against their own scatter (`small_sample`), and what varies within them
# against the scatter of their slopes (`slopes`).

NOISE_DRAWS = 300  # Number of draws of noise from which the effective number of contrasts follows, to 5 %.
FRICTION = ("mu", "multiply")  # Target along which the forces of cells are compared.
# A unit alone determines a direction if the eigenvalue of what is left without the unit is smaller.
OWN = 1e-6
# A direction of the tangent space with a smaller singular value lies in the specimens' own columns.
RANK = 1e-9
# Scores depend on the others if an eigenvalue of their cross product is a smaller share of the largest one.
DEPENDENT = 1e-10


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
    place: bool = False  # whether it is a step or a kink at one of many places along its channel
    category: str | None = None  # the one category of the first channel in which the last one acts
    temporary: bool = False  # whether it begins at one time and ends at another; searched by themselves

    @property
    def target(self) -> tuple[str, str]:
        """What it acts on, and the operation."""
        return self.acts_on, self.operation

    @property
    def key(self) -> tuple:
        """Its channels and target."""
        return (self.channels, *self.target)

    @property
    def straight(self) -> bool:
        """Whether it is one column that was not chosen among many: a line, a level, or a product."""
        return self.columns.shape[1] == 1 and not self.place

    @property
    def consistent(self) -> bool:
        """Whether two to four specimens have the same slopes."""
        strongest = (test.consistent[np.argmax(np.abs(test.slope))] for test in self.test_result.slopes)
        return self.test_result.consistent and all(strongest)

    @property
    def claimable(self) -> bool:
        """Whether it may be claimed: there are enough units, and two to four specimens are consistent."""
        test = self.test_result.small_sample
        return self.consistent and (test is None or test.enough_df)

    @property
    def chi2(self) -> float:
        """Whitened sum of squares it explains."""
        return self.test_result.chi2

    @property
    def evidence(self) -> float:
        """Explained sum of squares less the BIC penalty of the columns."""
        return self.chi2 - self.test_result.df * np.log(max(self.test_result.units, 2))


def project(fitted: Fitted, columns: np.ndarray) -> np.ndarray:
    """Return columns of the force, whitened and projected off the model's tangent space, shape (n, k)."""
    white = fitted.whitening(columns)
    return _distinct(fitted.basis.project_out(white), white)


def _distinct(left: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Return projected columns, shape (n, k), with zeros for those that are not identifiable."""
    left[:, _squares(left) < criteria.IDENTIFIABLE * _squares(columns)] = 0.0
    return left


def _squares(columns: np.ndarray) -> np.ndarray:
    return np.einsum("ij,ij->j", columns, columns)


class ScoreTests:
    """Score tests of columns of the force on the residual of a fit."""

    def __init__(self, fitted: Fitted) -> None:
        self.fitted = fitted
        levels = LEVELS if fitted.rows.cells() is None else (CELL, *LEVELS)
        self.cluster_tests = {level: ClusterTests(fitted, level) for level in levels}
        self.other = np.empty((fitted.force.size, 0))  # columns beside which others are tested
        self.cache = Cache()

    def beside(self, columns: np.ndarray) -> ScoreTests:
        """Return these tests beside other columns of the force, shape (n, m), which are fitted as well.

        Those of up to four specimens are not: without their mean the slopes of so few agree with anything.
        """
        own = copy(self)
        own.other = orthonormal(project(self.fitted, columns), OWN)
        if not few_specimens(self.fitted):
            own.fitted = self.fitted.beside(own.other)
        return own

    def variants(self, columns: np.ndarray, unit: str) -> tuple[np.ndarray, ...]:
        """Return the columns of a channel, shape (n, k), in each variant in which they must be significant.

        The first variant is projected. If the scatter of specimens is not known, another is also projected
        off the specimens' own columns: a channel that varies between runs would explain that scatter. The
        same holds for a few runs, or set-ups, and a channel that varies between files.
        """
        left = project(self.fitted, columns)
        left = _distinct(left - self.other @ (self.other.T @ left), left)
        levels = [name for name in self._of_unknown_scatter() if FINER[unit] < FINER[name]]
        own = map(self._own_columns, levels)
        return left, *(_distinct(basis.project_out(c.project_out(left)), left) for c, basis in own)

    @cached
    def _noise(self) -> np.ndarray:
        """Draws of whitened noise, shape (n, draws)."""
        return np.random.default_rng(0).standard_normal((self.fitted.rows.force.size, NOISE_DRAWS))

    @cached
    def _of_unknown_scatter(self) -> list[str]:
        """The levels whose groups scatter by an unknown amount."""
        starts = self.fitted.rows.groups.starts
        files, runs, specimens = (starts[name].size for name in ("file", "run", "specimen"))
        few_runs = 1 < runs < min(files, criteria.LEAST_UNITS_OF_SLOPES)
        unknown = not self.fitted.scatter.estimates("specimen") and 1 < specimens < runs
        return [*(["run"] if few_runs else []), *(["specimen"] if unknown else [])]

    @cached
    def _own_columns(self, level: str) -> tuple[OwnColumns, Tangent]:
        """Return the own columns of the groups of a level, and the tangent space off them."""
        rows, basis = self.fitted.rows, self.fitted.basis
        white = self.fitted.whitening(self.fitted.friction[:, None])[:, 0]
        size = rows.groups.sums(white**2, level)
        taken = (basis.sums(rows.groups, level, white).values ** 2).sum(axis=1)
        identifiable = size - taken >= criteria.IDENTIFIABLE * size
        own = OwnColumns(rows.codes(level), white * identifiable[rows.codes(level)])
        return own, basis.orthonormal(RANK, project_out=own.project_out)

    def __call__(
        self, variants: Sequence[np.ndarray], between: str, level: str, target: tuple[str, str]
    ) -> ScoreTestResult | None:
        """Return the weakest test of all `variants` of some columns; None if one of them cannot be tested.

        `between` is the level of units whose slopes may scatter, `level` that of the units of evidence.
        """
        starts = self.fitted.rows.groups.starts
        few_units = starts[between].size < criteria.JACKKNIFE_UNITS
        found = [self._score_test(left, level if few_units else between, target) for left in variants]
        if None in found:
            return None
        weakest = max(found, key=lambda j: max(j.log_p, j.log_p_jackknife))
        weakest = weakest._replace(units=starts[level].size)
        if level in ("file", "run") and self._constant_in_cells(variants):
            test = self._test_of_constants(variants, FRICTION, (CELL,))
            found = weakest._replace(small_sample=test)
            return found._replace(chi2=test.chi2, df=test.basis.shape[1]) if test is not None else None
        if not few_units:
            return weakest._replace(consistent=all(map(self._specimens_agree, variants)))
        if level == "specimen":
            test = self.cluster_tests[level].test(variants[0], target)
            if test is None:
                return weakest
            return weakest._replace(chi2=test.chi2, df=test.basis.shape[1], small_sample=test)
        given = between, self._noise(), self.other
        tests = tuple(contrast_test(self.fitted, left, *given) for left in variants)
        if any(test is None for test in tests):
            return None
        own = ("run", "file") if between in ("run", "file") else ()
        constant = self._test_of_constants(variants, target, own)
        return weakest._replace(slopes=tests, small_sample=constant)

    def _specimens_agree(self, left: np.ndarray) -> bool:
        """Return whether two to four specimens agree in what columns along strokes explain together."""
        fitted = self.fitted
        if not few_specimens(fitted):
            return True
        explained = self._explained(left)[:, None]
        return not along_strokes(fitted, explained)[0] or bool(specimens_agree(fitted, explained)[0])

    def _constant_in_cells(self, variants: Sequence[np.ndarray]) -> bool:
        """Whether columns are one number per cell. Their files are no independent evidence then."""
        cells = self.cluster_tests.get(CELL)
        if cells is None:
            return False
        return all(cells.share(left, FRICTION) > criteria.CONSTANT_IN_RUNS for left in variants)

    def _test_of_constants(
        self, variants: Sequence[np.ndarray], target: tuple[str, str], levels: Sequence[str]
    ) -> SmallSampleTest | None:
        """Return the weakest exact F test of columns that are constant in units of the first such level.

        Of cells, runs or files it is not significant if fewer than `LEAST_BEARING` bear the evidence: a wrong
        file is no normal scatter.
        """
        for level in levels:
            tests = [self.cluster_tests[level].test(left, target) for left in variants]
            if all(test is not None and test.share > criteria.CONSTANT_IN_RUNS for test in tests):
                weakest = max(tests, key=lambda test: test.log_p)
                few = level != "specimen" and self._bearing(variants[0], level) < criteria.LEAST_BEARING
                return weakest._replace(log_p=0.0) if few else weakest
        return None

    def _bearing(self, left: np.ndarray, level: str) -> float:
        """Return the effective number of units that bear the evidence for projected columns, shape (n, k).

        It is (sum s)^2 / sum s^2 of the sums of squares s that the columns explain in each unit.
        """
        scores = self.cluster_tests[level].sums(self._explained(left) * self.fitted.white_residual)
        return float(scores.sum() ** 2 / max((scores**2).sum(), 1e-300))

    def _explained(self, left: np.ndarray) -> np.ndarray:
        """Return what projected columns, shape (n, k), explain of the whitened residual, shape (n,)."""
        return left @ (np.linalg.pinv(left.T @ left, hermitian=True) @ (left.T @ self.fitted.white_residual))

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
        statistic = np.sum((total @ to_orthonormal(scores)) ** 2)
        log_p = float(log_p_of_score(statistic, left.shape[1], units))
        jackknife = 0.0
        if units >= criteria.JACKKNIFE_UNITS:
            explained, against_units = _log(chdtrc(left.shape[1], total @ total)), 0.0
            if level != "stroke" and explained < np.log(criteria.TESTED_AGAINST_RUNS):
                own = ("specimen",) if level == "specimen" else ("run", "file")
                test = self._test_of_constants([left], target, own)
                if test is not None:
                    against_units = test.log_p
                    explained = min(explained, against_units)
            if explained < np.log(criteria.PROMISING):
                jackknife = max(self._jackknife(left, level), explained)
                jackknife = min(jackknife, against_units + np.log(criteria.UNEQUAL_RUNS))
        return ScoreTestResult(float(total @ total), left.shape[1], units, log_p, jackknife, scores)

    def _jackknife(self, left: np.ndarray, level: str) -> float:
        """Return the log p-value of orthonormal columns' coefficients by their jackknife over whole units.

        Without each unit u the normal equations of the tangent space and the columns are
        [[1 - B'B, -B'L], [-L'B, 1 - L'L]] with B, L its rows of basis and columns.
        """
        fitted, start = self.fitted, self.fitted.rows.groups.starts[level]
        units, k = start.size, left.shape[1]
        parts = np.split(left, start[1:])
        inverse = self._without(level)
        product = fitted.basis.sums(fitted.rows.groups, level, fitted.white_residual).values
        own = np.add.reduceat(left * fitted.white_residual[:, None], start)
        bases = np.split(fitted.basis.values, start[1:])
        mixed = np.stack([b.T @ c for b, c in zip(bases, parts, strict=True)])
        through = mixed.transpose(0, 2, 1) @ inverse
        square = np.eye(k) - np.stack([c.T @ c for c in parts]) - through @ mixed
        total = left.T @ fitted.white_residual
        right = total - own - np.einsum("uij,uj->ui", through, product)
        without = np.einsum("uij,uj->ui", _inverse_of(*np.linalg.eigh(square)), right)
        spread = (without - total).T @ (without - total) * (units - 1) / units
        t = float(total @ np.linalg.pinv(spread, hermitian=True) @ total)
        return _log(fdtrc(k, units - k, t * (units - k) / (k * (units - 1))))

    @cached
    def _without(self, level: str) -> np.ndarray:
        """Return the inverse of 1 - B'B of each unit in its block of the basis, shape (units, k, k)."""
        share, axes = self.fitted.unit_shares(level)
        return _inverse_of(1 - share, axes)


def _log(p_value: float) -> float:
    return float(np.log(max(p_value, 1e-300)))


def _inverse_of(size: np.ndarray, axes: np.ndarray) -> np.ndarray:
    """Return inverses, shape (u, k, k), from eigenvalues and axes; 0 for what one unit alone determines."""
    shrink = np.where(size > OWN, 1 / np.maximum(size, OWN), 0.0)
    return (axes * shrink[:, None, :]) @ axes.transpose(0, 2, 1)


def to_orthonormal(scores: np.ndarray) -> np.ndarray:
    """Return the transform, shape (k, k), of scores, shape (units, k), to orthonormal ones.

    T is the squared length of the transformed sum. Scores that depend on the others become zero.
    """
    size, axes = np.linalg.eigh(scores.T @ scores)
    kept = size > DEPENDENT * size[-1]
    return axes * np.where(kept, 1 / np.sqrt(np.where(kept, size, 1.0)), 0.0)


def log_p_of_score(t: np.ndarray, df: int, units: int) -> np.ndarray:
    """Return the log p-value of T, from Hotelling's F with as many units; T never exceeds their number."""
    share = np.clip(np.asarray(t) / units, 0.0, 1 - 1e-15)
    return np.log(np.maximum(betainc((units - df) / 2, df / 2, 1 - share), 1e-300))
