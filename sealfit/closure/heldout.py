"""Rows held out: whole groups, blocks of the calendar or whole settings, and whether the others cover them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np

from sealfit.closure.criteria import (
    BLOCKS_OF_A_FOLD,
    LEAST_GROUPS_HELD_OUT,
    LEAST_HELD_OUT,
    OUTSIDE_RANGE,
    SAME_SETTING,
)
from sealfit.fit.joint.rows import LEVELS, Rows


def heldout_level(rows: Rows) -> str:
    """Return the level whose groups are held out: run, or file or stroke where there are fewer than six."""
    for level in ("run", "file"):
        if rows.groups.starts[level].size >= LEAST_GROUPS_HELD_OUT:
            return foldable(rows, level)
    return "stroke"


def foldable(rows: Rows, level: str) -> str:
    """Return a level, or the next finer one at which conditions keep some groups while others are held out.

    A condition with one file and no law that reaches it cannot be predicted without that file: its strokes are held
    out then, and say how well these very files are predicted.
    """
    for finer in reversed(LEVELS[: LEVELS.index(level) + 1]):
        start = rows.groups.starts[finer]
        groups = np.bincount(rows.condition[start], minlength=len(rows.conditions))
        lost = [c for c in np.flatnonzero(groups == 1) if _edge(rows, int(c))]
        if len(lost) <= np.count_nonzero(groups) / 2:
            return finer
    return LEVELS[0]


def folds(rows: Rows, level: str, count: int, seed: int) -> Iterator[np.ndarray]:
    """Yield masks of the rows held out, shape (n,): whole groups, dealt so that each condition keeps most of its own.

    Day 0 and the last day are never held out with all their groups, as a law is not asked to extrapolate.
    """
    start = rows.groups.starts[level]
    count = min(count, start.size)
    condition = rows.condition[start]
    rng = np.random.default_rng(seed)
    shuffled = rng.permutation(start.size)
    order = shuffled[np.argsort(condition[shuffled], kind="stable")]
    number = np.empty(start.size, dtype=int)
    number[order] = np.arange(start.size) % count
    yield from _masks(rows, level, number)


def blocks(rows: Rows, level: str, count: int, channel: str) -> list[np.ndarray]:
    """Return masks of the rows held out, shape (n,): groups that follow one another in the campaign's calendar.

    Neighbours in time resemble each other, and so do the conditions that were tested one after the other: with groups
    left out here and there any wavy line through the calendar seems to be confirmed. Where a block would hold all of a
    condition that cannot be predicted without, blocks are made shorter, and a fold holds several that lie apart.
    """
    start = rows.groups.starts[level]
    count = min(count, start.size)
    place = np.empty(start.size, dtype=int)
    place[np.argsort(rows.values(channel)[start], kind="stable")] = np.arange(start.size)
    masks: list[np.ndarray] = []
    for parts in BLOCKS_OF_A_FOLD:
        masks = list(_masks(rows, level, place * min(count * parts, start.size) // start.size % count))
        if np.any(masks, axis=0).mean() > LEAST_HELD_OUT:
            break
    return masks


def _masks(rows: Rows, level: str, number: np.ndarray) -> Iterator[np.ndarray]:
    """Yield masks of the rows held out, shape (n,), from the fold of each group; no edge condition loses all groups."""
    start, code = rows.groups.starts[level], rows.codes(level)
    condition = rows.condition[start]
    for k in range(number.max() + 1):
        out = _without_lost_edges(number == k, condition, rows)
        if out.any():
            yield out[code]


def _without_lost_edges(out: np.ndarray, condition: np.ndarray, rows: Rows) -> np.ndarray:
    """Return what is held out less the edge conditions that would be held out whole, shape of `out`."""
    for c in np.unique(condition[out]):
        if not (~out & (condition == c)).any() and _edge(rows, c):
            out = out & (condition != c)
    return out


def _edge(rows: Rows, condition: int) -> bool:
    if not rows.has_aging:
        return True  # a condition of its own parameters cannot be predicted without its rows
    days = rows.conditions["aging_days"]
    series = rows.conditions["series"]
    own = days[series == series.iloc[condition]]
    return bool(days.iloc[condition] in (0.0, own.max()))


def covered(rows: Rows, out: np.ndarray, channels: Iterable[str] = ()) -> np.ndarray:
    """Return which of the rows held out lie inside what the other rows cover, shape (n,): the rest are extrapolated.

    Parameters
    ----------
    rows : Rows
        All rows.
    out : ndarray of bool, shape (n,)
        Which are held out.
    channels : iterable of str
        What the effects of the model read.
    """
    inside = out.copy()
    series = rows.conditions["series"].to_numpy()[rows.condition]
    speed = np.abs(rows.speed)
    for own in np.unique(series[out]):
        here = series == own
        seen = here & ~out
        tested = np.unique(rows.condition[seen])
        lawful = rows.has_aging and tested.size > 1
        days = rows.days[seen | (~out & (rows.days == 0))]  # unaged rubber starts every series
        new = here & out & ~np.isin(rows.condition, tested)
        if not lawful:
            inside &= ~new
        else:
            inside &= ~(new & ((rows.days < days.min()) | (rows.days > days.max())))
        if seen.any():
            inside &= ~(here & out & _outside(speed, speed[seen]))
    for name in channels:
        values = rows.values(name)
        if values.dtype.kind == "f":
            inside &= ~_outside(values, values[~out])
        else:
            inside &= np.isin(values, np.unique(values[~out]))
    return inside


def _outside(values: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """Return which values lie beyond those seen, by more than measured numbers of one setting differ."""
    low, high = float(seen.min()), float(seen.max())
    slack = OUTSIDE_RANGE * (high - low) + SAME_SETTING * max(abs(low), abs(high))
    return (values < low - slack) | (values > high + slack)


def whole_settings(rows: Rows, values: np.ndarray) -> Iterator[np.ndarray]:
    """Yield masks of the rows held out, shape (n,): everything at one inner setting of a channel, one after the other.

    A free shape through every setting fits those it was given, and says nothing of what lies between them.
    """
    for setting in np.unique(values)[1:-1]:
        out = _without_lost_edges(values == setting, rows.condition, rows)
        if out.any():
            yield out
