"""Profile-likelihood intervals of the aging law's a, b and c, those of all curves at once."""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass

import numpy as np

from sealfit.fit.law import PROFILED, LawFit
from sealfit.fit.lawseries import EachSeries

STEPS = 40
CLOSE = 1e-3  # ends are found to 0.1 % of b, or of the rise: far below what an interval means


@dataclass(frozen=True)
class CurveInterval:
    """95 % limits of one curve; an open end is 0 or inf for b, -inf or inf for a and c."""

    a: tuple[float, float]
    b: tuple[float, float]
    c: tuple[float, float]


End = tuple[float, bool]  # of an interval of ln b, and whether it is open
Asked = tuple[int, float]  # chi-square of which curve, with its ln b held where


def curve_intervals(fit: LawFit, rise_of_origin: np.ndarray) -> list[CurveInterval]:
    """Return the profile-likelihood intervals of every curve.

    For b: where the best chi-square with ln b held exceeds the optimum's by no more than the rise. For a and
    c = -a ln b, both linear in a once b is held: the union of their intervals along those b.

    Parameters
    ----------
    fit : LawFit
        Joint fit.
    rise_of_origin : ndarray, shape (origins,)
        t^2 of each quantity.
    """
    values, each, log_b = fit.values, EachSeries(fit), fit.x[-fit.values.curves :]
    curves = np.arange(values.curves)
    best = each.chi2_at_optimum()
    limit = best + rise_of_origin[[values.origin[values.curve == c][0] for c in curves]]
    searches = [
        _end(c, sign, fit.limits[side][c], log_b[c], best[c], limit[c])
        for c in curves
        for side, sign in enumerate((-1, 1))
    ]
    ends = _together(searches, lambda asked: each.held(*map(np.array, zip(*asked, strict=True)))[0])
    points = [
        np.unique([*np.linspace(low, high, PROFILED), at])
        for (low, _), (high, _), at in zip(ends[::2], ends[1::2], log_b, strict=True)
    ]
    of = np.repeat(curves, [at.size for at in points])
    chi2, a, variance = each.held(of, np.concatenate(points))
    room = limit[of] - chi2
    half = np.sqrt(np.where(room > 0, room * variance, 0.0))
    return [
        _interval(at, a[of == c], half[of == c], ends[2 * c], ends[2 * c + 1])
        for c, at in zip(curves, points, strict=True)
    ]


def _interval(log_b: np.ndarray, a: np.ndarray, half: np.ndarray, low: End, high: End) -> CurveInterval:
    """Return the interval of a curve: a with its half-width where ln b is held at points from one end to the other."""
    around = {
        name: [float((factor * a - np.abs(factor) * half).min()), float((factor * a + np.abs(factor) * half).max())]
        for name, factor in (("a", 1.0), ("c", -log_b))
    }
    signs = [end for end, reached in ((1, around["a"][1] > 0), (0, around["a"][0] < 0)) if reached]
    for outer in signs:
        endless = np.inf if outer else -np.inf
        if high[1]:  # a grows with b without end
            around["a"][outer], around["c"][1 - outer] = endless, -endless
        if low[1]:  # and c grows as b goes to zero
            around["c"][outer] = endless
    b = (0.0 if low[1] else float(np.exp(low[0])), np.inf if high[1] else float(np.exp(high[0])))
    return CurveInterval(tuple(around["a"]), b, tuple(around["c"]))


def _end(
    c: int, sign: int, edge: float, near: float, best: float, limit: float
) -> Generator[Asked, float, tuple[float, bool]]:
    """Find where the profile along ln b reaches the limit, from the optimum outwards; return whether it never does."""
    if sign * (edge - near) <= 0:
        return near, True
    step, far, at_near, at_far = 0.25, None, best, best
    while far is None:
        trial = near + sign * step
        trial = edge if sign * (trial - edge) >= 0 else trial
        chi2 = yield c, trial
        if chi2 > limit:
            far, at_far = trial, chi2
        elif trial == edge:
            return edge, True
        else:
            near, at_near, step = trial, chi2, 2 * step
    # the root of the rise is nearly straight in ln b: a secant lands close, a halving at times is safe
    for turn in range(STEPS):
        if abs(far - near) < CLOSE:
            break
        low, high = (np.sqrt(max(value - best, 0.0)) for value in (at_near, at_far))
        share = (np.sqrt(limit - best) - low) / (high - low) if high > low and turn % 3 < 2 else 0.5
        middle = near + np.clip(share, 0.02, 0.98) * (far - near)
        chi2 = yield c, middle
        if chi2 > limit:
            far, at_far = middle, chi2
        else:
            near, at_near = middle, chi2
        if abs(chi2 - limit) < CLOSE * (limit - best):
            return middle, False
    return near, False


def _together(
    searches: Sequence[Generator[Asked, float, End]], answer: Callable[[list[Asked]], np.ndarray]
) -> list[End]:
    """Return what searches find that ask for one number after the other, the next ones of all answered at once."""
    found: dict[int, End] = {}
    answers: dict[int, float | None] = dict.fromkeys(range(len(searches)))
    while answers:
        asked = {}
        for k, given in answers.items():
            try:
                asked[k] = searches[k].send(given)
            except StopIteration as end:
                found[k] = end.value
        answers = dict(zip(asked, answer(list(asked.values())), strict=True)) if asked else {}
    return [found[k] for k in range(len(searches))]
