"""Forms fitted to the residual in the tangent space: amplitudes exactly, other parameters on a grid."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from sealfit.closure.criteria import IDENTIFIABLE, PAIR_PENALTY, WEAK_P
from sealfit.closure.score_test import Candidate, project
from sealfit.effects.contract import SECOND
from sealfit.effects.free import SMOOTH, SURFACE, WITHIN
from sealfit.fit.joint import Fitted, effective_df
from sealfit.fit.joint.model import Term, mean_derivatives
from sealfit.fit.joint.prior import penalised, reml_smoothness, roughness_of
from sealfit.fit.joint.rows import Rows

PART = 32  # Grid points that are whitened at once.
UNNAMED = (SMOOTH, SURFACE, WITHIN)
ZERO_OFFSET = (("direction",), "force", "add")
PREFERRED = ("mu", "mu_c", "mu_s", "force", "v_s", "sigma_2", "a", "b", "mu_0")


@dataclass(frozen=True, eq=False)  # compared by identity: it holds arrays
class Proposal:
    """A term with start values, what it explains, and the joint fit once it is refitted."""

    term: Term
    values: Mapping[str, float]
    unit: str  # level of its units of evidence
    units: int
    chi2: float
    p_value: float
    column: np.ndarray  # (n,) what it adds to the force, whitened and projected
    source: tuple  # key of its candidate
    linear_size: float | None = None  # effective degrees of freedom of a penalised shape, not refitted
    fitted: Fitted | None = None

    @cached_property
    def size(self) -> float:
        """Effective degrees of freedom: its number of parameters, or fewer for a penalised free shape."""
        if self.linear_size is None:
            return float(len(self.term.effect.parameters))
        if self.fitted is None:
            return self.linear_size
        return effective_df(self.fitted, len(self.fitted.model.terms) - 1)

    @property
    def bic_penalty(self) -> float:
        """BIC penalty of its parameters; pairs of channels have an additional one, as there are many."""
        pair = PAIR_PENALTY if SECOND in self.term.effect.reads else 0.0
        return self.size * np.log(max(self.units, 2)) + pair

    @property
    def bic(self) -> float:
        """Deviance plus the BIC penalty; smaller is better."""
        return (self.fitted.deviance if self.fitted is not None else -self.chi2) + self.bic_penalty

    @property
    def named(self) -> bool:
        """Whether the form has a name."""
        return self.term.effect.id not in UNNAMED

    @property
    def weak(self) -> bool:
        """Whether its evidence is weak: too weak for the verdict `unexplained`."""
        return self.p_value > WEAK_P

    @property
    def rank(self) -> tuple:
        """Sort key of equals: physical effect, closed form, free shape; fewer parameters; then target."""
        effect = self.term.effect
        kind = 0 if effect.physical else 2 if effect.id in UNNAMED else 1
        is_offset = self.source == ZERO_OFFSET  # amplifier offsets are commoner than one-sided friction
        position = -1 if is_offset else PREFERRED.index(self.term.acts_on)
        usual = effect.acts_on.index(self.term.target) if effect.physical else 0  # its usual target is first
        return (kind, self.size, position, usual)


def linearised(
    fitted: Fitted, term: Term, search: Mapping[str, tuple], candidate: Candidate
) -> list[Proposal]:
    """Return a term fitted in the tangent space of a model at the best point of its grid, if identifiable."""
    effect, rows = term.effect, fitted.rows
    points = [dict(zip(search, point, strict=True)) for point in itertools.product(*search.values())]
    point, most, shape = _best(fitted, term, points)
    for jump in (p.name for p in effect.nonlinear if p.search == "between"):
        if finer := _between(term, point, jump, search[jump], rows):
            point, most, shape = _best(fitted, term, finer)
    if not most > 0:
        return []
    left = project(fitted, fitted.slope(*term.target)[:, None] * shape)
    size = None
    if term.smoothness is None:
        amplitude, *_ = np.linalg.lstsq(left, fitted.white_residual, rcond=1e-10)
    else:  # a free shape
        normal, gradient, rough = left.T @ left, left.T @ fitted.white_residual, roughness_of(term)
        smoothness = reml_smoothness(normal, gradient, rough)
        amplitude, size = penalised(normal, gradient, smoothness * rough)
        term = replace(term, smoothness=smoothness)
    column = left @ amplitude
    chosen = {**effect.start(), **point, **dict(zip(effect.linear, amplitude.tolist(), strict=True))}
    values = {p.name: chosen[p.name] for p in effect.parameters}
    found = float(2 * column @ fitted.white_residual - column @ column)
    units, p_value = candidate.test_result.units, candidate.p_value
    return [Proposal(term, values, candidate.unit, units, found, p_value, column, candidate.key, size)]


def _best(
    fitted: Fitted, term: Term, points: list[dict[str, float]]
) -> tuple[dict[str, float], float, np.ndarray]:
    """Return the best point of a grid, the sum of squares it explains and its shapes, (n, amplitudes)."""
    slope, count, start = fitted.slope(*term.target)[:, None], len(term.effect.linear), term.effect.start()
    with np.errstate(all="ignore"):
        made = [mean_derivatives(term, {**start, **point}, fitted.rows, only_linear=True) for point in points]
    shapes = np.column_stack(list(itertools.chain.from_iterable(made)))
    wide = PART * count
    parts = [slope * shapes[:, k : k + wide] for k in range(0, shapes.shape[1], wide)]
    chi2 = np.concatenate([_explained(fitted, part, count) for part in parts])
    best = int(np.argmax(chi2))
    return points[best], float(chi2[best]), shapes[:, best * count : (best + 1) * count]


def _between(
    term: Term, point: Mapping[str, float], jump: str, searched: tuple[float, ...], rows: Rows
) -> list[dict[str, float]]:
    """Return the places of a jump between the best grid point's neighbours that the grid left out."""
    grid = np.array(searched)
    at = int(np.searchsorted(grid, point[jump]))
    places = middles(term.inputs(rows)[term.effect.reads[0]])
    near = places[(places >= grid[max(at - 1, 0)]) & (places <= grid[min(at + 1, grid.size - 1)])]
    return [{**point, jump: float(place)} for place in near] if places.size > grid.size else []


def middles(values: np.ndarray) -> np.ndarray:
    """Return the midpoints between neighbouring values of a channel, where a jump may lie."""
    distinct = np.unique(values)
    return (distinct[1:] + distinct[:-1]) / 2


def _explained(fitted: Fitted, columns: np.ndarray, count: int) -> np.ndarray:
    """Return the sum of squares that each group of `count` columns of the force explains, shape (points,)."""
    good = np.isfinite(columns).all(axis=0)
    white = fitted.whitening(np.where(good, columns, 0.0))
    taken = fitted.basis.against(white)
    white, taken = (a.reshape(a.shape[0], -1, count) for a in (white, taken))
    whole = np.einsum("npi,npj->pij", white, white)
    gram = whole - np.einsum("npi,npj->pij", taken, taken)
    score = np.einsum("npi,n->pi", white, fitted.white_residual)
    size, least = (np.einsum("pii->pi", a) for a in (gram, whole))
    kept = (size > IDENTIFIABLE * least) & good.reshape(-1, count)
    root = np.sqrt(np.where(kept, size, 1.0))
    score, unit = np.where(kept, score / root, 0.0), np.where(kept, 1 / root, 0.0)
    inverse = np.linalg.pinv(gram * unit[:, :, None] * unit[:, None, :], rcond=1e-10, hermitian=True)
    return np.einsum("pi,pij,pj->p", score, inverse, score)
