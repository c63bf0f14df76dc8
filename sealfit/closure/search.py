r"""Does any channel order the residual? Score tests of free shapes, judged by sign flips of whole units.

A candidate is a free shape of one channel acting on one quantity: columns c of the force. After whitening and after
projection on the tangent space of the current model, the score of unit u is :math:`s_u = c_u^T r_u`, and

.. math:: T = S^T V^{-1} S, \quad S = \sum_u s_u, \quad V = \sum_u s_u s_u^T .

The r_u in V are widened for what the fit has taken out of each unit (CR2, Bell & McCaffrey 2002), as residuals are
smaller than errors and few units would otherwise look too quiet. V is unchanged when a unit's sign is flipped, so
flipping all units at random many times costs one matrix product, and the largest standardised T over all candidates
gives the p-value adjusted for the whole search (Westfall & Young 1993; sign flips of score contributions: Hemerik,
Goeman & Finos 2020, doi:10.1111/rssb.12369).

Sign flips hold whatever the units' scatter is, but a strong effect stands in V itself: T never exceeds the number of
units over the kurtosis of c, and a few runs in extreme places hide what all others show. So from thirty units on the
estimate is also held against its jackknife over whole units (CV3; MacKinnon, Nielsen & Webb 2023,
doi:10.1016/j.jeconom.2022.04.001), adjusted by the number of candidates (Bonferroni). Each way has half of the error.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import stats
from scipy.special import betainc

from sealfit.closure.channels import CALENDAR, FINE_DF, FINE_UNITS, FINER, Channel, flip_level, free_columns, unit_of
from sealfit.fit.estimate import Fitted
from sealfit.fit.joint import term_slope
from sealfit.fit.mixed import orthonormal
from sealfit.fit.rows import Rows

TARGETS = (
    ("mu", "multiply"),
    ("force", "add"),
    ("force", "multiply"),
    ("mu_s", "multiply"),
    ("mu_c", "multiply"),
    ("v_s", "multiply"),
    ("sigma_2", "add"),
    ("a", "multiply"),
)
MAIN_TARGETS = (("mu", "multiply"), ("force", "add"))
FLIPS = 1999  # resolves p = 0.0005, a tenth of the family-wise level
MANY = 30  # units from which the jackknife is tried
PROMISING = 0.01  # p-value by sign flips, not adjusted, below which it is
SEARCHES = 2  # single channels and pairs of them: each search has half of the error
LEAST_LEFT = 0.01  # share of a column's variance that must survive projection to be identifiable here


@dataclass(frozen=True)
class Candidate:
    """A free shape of one channel acting on one quantity, with its test."""

    channels: tuple[str, ...]
    acts_on: str
    operation: str
    unit: str  # level of the groups moved by sign flips
    columns: np.ndarray  # (n, k) shape values, before the slope of the quantity
    chi2: float  # whitened sum of squares it explains
    df: int
    units: int
    log_p: float  # of T by its F distribution, not adjusted
    log_p_jackknife: float = 0.0  # of the estimate against its jackknife over units; 0 where that was not tried
    p_value: float = 1.0  # adjusted over the search
    scores: np.ndarray | None = None  # (units, k)
    pair: bool = False  # whether it acts by two channels together

    @property
    def key(self) -> tuple:
        """What it acts with and on."""
        return (self.channels, self.acts_on, self.operation)

    @property
    def evidence(self) -> float:
        """Explained sum of squares less what as many idle columns would be given (Schwarz)."""
        return self.chi2 - self.df * np.log(max(self.units, 2))


def project(fitted: Fitted, columns: np.ndarray) -> np.ndarray:
    """Return columns of the force, whitened and freed of the current model's tangent space, shape (n, k)."""
    white, _ = fitted.scatter.whitened(columns, fitted.force, fitted.rows.groups)
    size = np.linalg.norm(white, axis=0)
    left = white - fitted.basis @ (fitted.basis.T @ white)
    left[:, np.linalg.norm(left, axis=0) ** 2 < LEAST_LEFT * size**2] = 0.0
    return left


def search(fitted: Fitted, channels: Sequence[Channel], rng: np.random.Generator) -> list[Candidate]:
    """Return every candidate with its adjusted p-value, strongest evidence first.

    Parameters
    ----------
    fitted : Fitted
        The current model at its optimum.
    channels : sequence of Channel
        Where to look.
    rng : Generator
        For the sign flips.
    """
    candidates = [c for channel in channels for c in _of_channel(fitted, channel)]
    if not candidates:
        return []
    return judged(candidates, rng)


def judged(candidates: Sequence[Candidate], rng: np.random.Generator) -> list[Candidate]:
    """Return candidates with p-values adjusted over all of them, strongest evidence first."""
    flipped = adjust(candidates, rng)
    jackknife = len(candidates) * np.exp([c.log_p_jackknife for c in candidates])
    both = np.array([c.units >= MANY for c in candidates])  # two ways, each with half of the error
    p_values = SEARCHES * np.where(both, 2 * np.minimum(flipped, jackknife), flipped)
    p_values = np.minimum(1.0, p_values)
    found = [replace(c, p_value=float(p)) for c, p in zip(candidates, p_values, strict=True)]
    return sorted(found, key=lambda c: -c.evidence)


def _of_channel(fitted: Fitted, channel: Channel) -> Iterator[Candidate]:
    rows = fitted.rows
    if channel.name == "direction":
        yield from _of_shapes(fitted, channel, np.ones((rows.force.size, 1)), TARGETS)
        return
    shapes = free_columns(channel)
    widths = (1, shapes.shape[1]) if channel.numeric else (shapes.shape[1],)
    yield from _of_shapes(fitted, channel, shapes, TARGETS, widths)
    units = rows.groups.starts[flip_level(channel.unit, rows)].size
    if (
        channel.numeric
        and channel.name not in CALENDAR
        and units >= FINE_UNITS
        and np.unique(channel.values).size > 2 * FINE_DF
    ):
        yield from _of_shapes(fitted, channel, free_columns(channel, FINE_DF), MAIN_TARGETS)


def _of_shapes(
    fitted: Fitted, channel: Channel, shapes: np.ndarray, targets: Sequence[tuple[str, str]], widths: Sequence[int] = ()
) -> Iterator[Candidate]:
    """Yield the candidates of a channel's columns, by the first so many of them, on every target that may take them."""
    rows = fitted.rows
    both_ways = rows.speed.min() < 0 < rows.speed.max()
    slopes, places = [], []
    for acts_on, operation in targets:
        if not (_allowed(channel, acts_on, operation, both_ways) and _declared(fitted, acts_on)):
            continue
        slope = term_slope(fitted.model, rows, acts_on, operation)
        if np.abs(slope).max() <= 0:
            continue
        own = shapes
        if channel.name == "direction" and acts_on != "force":
            own = channel.values[:, None] / 2
        slopes.append(own * slope[:, None])
        places.append((acts_on, operation, own))
    if not slopes:
        return
    left = project(fitted, np.column_stack(slopes))
    inside = inside_specimens(fitted, left, channel.unit)
    for number, (acts_on, operation, own) in enumerate(places):
        place = slice(number * own.shape[1], (number + 1) * own.shape[1])
        unit = channel.unit
        names = (channel.name,)
        unsigned = both_ways and (acts_on, operation) == ("force", "add") and channel.name != "direction"
        if unsigned and FINER[channel.unit] > FINER["stroke"]:  # it shows only between directions
            names = ("direction", channel.name)
            unit = min(unit, _direction_unit(rows), key=FINER.get)
        for width in dict.fromkeys(widths or (own.shape[1],)):
            level = flip_level(unit, rows)
            found = weaker(fitted, left[:, place][:, :width], inside[:, place][:, :width], level)
            if found is not None:
                chi2, df, units, log_p, jackknife, scores = found
                shape = own[:, :width]
                yield Candidate(
                    names, acts_on, operation, level, shape, chi2, df, units, log_p, jackknife, scores=scores
                )


def inside_specimens(fitted: Fitted, left: np.ndarray, unit: str) -> np.ndarray:
    """Return projected columns, shape (n, k), freed of what tells specimens apart where their scatter is not known.

    With about as many specimens as conditions their scatter cannot be told from the conditions' own values. A channel
    that varies from run to run, such as the time since the start, would then be given what specimens do.
    """
    rows = fitted.rows
    scatter = {c.level for c in fitted.scatter.components}
    starts = rows.groups.starts["specimen"]
    if (
        "specimen" in scatter
        or FINER[unit] >= FINER["specimen"]
        or not 1 < starts.size < rows.groups.starts["run"].size
    ):
        return left
    own = rows.codes("specimen")[:, None] == np.arange(starts.size)[None, :]
    basis = orthonormal(project(fitted, own * fitted.force[:, None]))
    size = np.linalg.norm(left, axis=0)
    freed = left - basis @ (basis.T @ left)
    freed[:, np.linalg.norm(freed, axis=0) ** 2 < LEAST_LEFT * size**2] = 0.0
    return freed


def weaker(fitted: Fitted, left: np.ndarray, inside: np.ndarray, level: str) -> tuple | None:
    """Return the judgement of columns as they are or inside specimens, whichever says less; both must hold."""
    found = judge(fitted, left, level)
    if inside is left or np.shares_memory(inside, left) or found is None:
        return found
    other = judge(fitted, inside, level)
    return None if other is None else max(found, other, key=lambda f: max(f[3], f[4]))


def _direction_unit(rows: Rows) -> str:
    return unit_of(np.sign(rows.speed), rows)


def _declared(fitted: Fitted, acts_on: str) -> bool:
    """Whether the declared model holds the quantity here; mu_c alone is mu where no Stribeck curve is fitted."""
    needs = {"mu_s": "v_s", "mu_c": "v_s", "v_s": "v_s", "sigma_2": "sigma_2", "a": "a_c", "b": "b_c"}.get(acts_on)
    return needs is None or bool((fitted.model.declared.index[needs] >= 0).any())


def _allowed(channel: Channel, acts_on: str, operation: str, both_ways: bool) -> bool:
    if channel.name == "direction":
        return both_ways
    if channel.grouping:
        return both_ways and (acts_on, operation) == ("force", "add")
    if channel.name == "speed_mm_s":
        return acts_on in ("mu", "a")  # mu_s, mu_c, v_s and sigma_2 are themselves the dependence on speed
    return not (channel.name == "load_N" and acts_on == "force")


def judge(fitted: Fitted, left: np.ndarray, level: str) -> tuple[float, int, int, float, float, np.ndarray] | None:
    """Return (chi2, df, units, log p, log p by jackknife, scores) of whitened, projected columns, or None."""
    size = np.linalg.norm(left, axis=0)
    left = left[:, size > 0] / size[size > 0]
    start = fitted.rows.groups.starts[level]
    most = max(1, start.size // 5)
    if left.shape[1] == 0 or start.size < 4:
        return None
    u, s, _ = np.linalg.svd(left.T @ left)
    keep = s > 1e-6 * s[0]
    left = (left @ u[:, keep] / np.sqrt(s[keep]))[:, :most]
    scores = np.add.reduceat(left * fitted.unit_residual(level)[:, None], start, axis=0)
    total = left.T @ fitted.white_residual
    chi2 = float(total @ total)
    log_p = float(log_p_of(_wald(total[None, :], scores)[0], left.shape[1], start.size))
    jackknife = 0.0
    if start.size >= MANY and log_p < np.log(PROMISING):
        jackknife = _jackknife(fitted, left, level)
    return chi2, left.shape[1], start.size, log_p, jackknife, scores


def _jackknife(fitted: Fitted, left: np.ndarray, level: str) -> float:
    """Return the log p-value of orthonormal columns' coefficients against their jackknife over whole units.

    Everything is estimated anew without each unit, the current model's numbers too, in the tangent space.
    """
    start = fitted.rows.groups.starts[level]
    units, k = start.size, left.shape[1]
    every = np.column_stack([fitted.basis, left])
    own = np.stack([part.T @ part for part in np.split(every, start[1:])])
    product = np.add.reduceat(every * fitted.white_residual[:, None], start, axis=0)
    total = left.T @ fitted.white_residual
    size, axes = np.linalg.eigh(np.eye(every.shape[1]) - own)
    inverse = np.where(
        size > 1e-6, 1 / np.maximum(size, 1e-6), 0.0
    )  # what one unit alone determines is left where it is
    right = np.r_[np.zeros(every.shape[1] - k), total] - product
    without = np.einsum("uij,uj,ukj,uk->ui", axes, inverse, axes, right)[:, -k:]
    spread = (without - total).T @ (without - total) * (units - 1) / units
    t = float(total @ np.linalg.pinv(spread, hermitian=True) @ total)
    return float(stats.f.logsf(t * (units - k) / (k * (units - 1)), k, units - k))


def _wald(totals: np.ndarray, scores: np.ndarray) -> np.ndarray:
    """Return T for each row of `totals`, shape (m, k) -> (m,)."""
    inverse = np.linalg.pinv(scores.T @ scores, rcond=1e-10, hermitian=True)
    return np.einsum("ij,jk,ik->i", totals, inverse, totals)


def log_p_of(t: np.ndarray, df: int, units: int) -> np.ndarray:
    """Return the log p-value of T, from Hotelling's F with as many units; T never exceeds their number."""
    share = np.clip(np.asarray(t) / units, 0.0, 1 - 1e-15)
    return np.log(np.maximum(betainc((units - df) / 2, df / 2, 1 - share), 1e-300))


def adjust(candidates: Sequence[Candidate], rng: np.random.Generator, flips: int = FLIPS) -> np.ndarray:
    """Return each candidate's p-value adjusted over all of them, by the maximum over sign flips, shape (m,).

    Candidates of one unit are flipped with the same signs, so that what they share counts once.
    """
    least = np.zeros(flips)
    signs = {}
    for candidate in candidates:
        place = (candidate.unit, candidate.units)
        if place not in signs:
            signs[place] = rng.choice([-1.0, 1.0], size=(flips, candidate.units))
        totals = signs[place] @ candidate.scores
        least = np.minimum(least, log_p_of(_wald(totals, candidate.scores), candidate.df, candidate.units))
    least = np.sort(least)
    own = np.array([c.log_p for c in candidates])
    return (1 + np.searchsorted(least, own, side="right")) / (flips + 1)
