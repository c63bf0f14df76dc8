"""Rows left out of a fit: files that went wrong as a whole, and those held out to measure predictions."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.special import stdtr

from sealfit.closure import criteria
from sealfit.closure.channels import level_values, settings
from sealfit.fit.joint import Fitted, fit, fit_declared, fitted_at
from sealfit.fit.joint.declared import has_law
from sealfit.fit.joint.rows import LEVELS, POWER, Rows, sliding_power
from sealfit.fit.joint.search import search_nonlinear
from sealfit.ingest.strokes import SPEEDS_APART

# A file is tried if its residual in the fit to all files has a p-value below this, times the number of files.
SCREEN_P = 0.05
MOST_SUSPECTS = 3  # Files that are tried, those with the largest residuals.
# Files of a campaign up to which all of them are tried: the fit to so few follows the one that went wrong.
FEW_FILES = 20
# Largest p-value of an outlier, times the number of files. With 0.01, 5 of 73 worlds drawn at random lost a
# sound file: their scatter was not normal.
OUTLIER_P = 1e-3
AGREES_P = 0.5  # P-value, times the number of files, above which a file agrees with the rest.
# Largest p-value beside the files of the same speed. Where these scatter more than others, or differ from the
# model like the file, it is no outlier.
SAME_SPEED_P = 0.01
LEAST_OF_SPEED = 3  # Fewest files of the same speed from which their scatter is estimated.
OUTLIER_SHARE = 0.05  # Least share of the force by which an outlier is off.
# Largest share of the files that may be outliers. If there are more, they are not exceptions.
MOST_OUTLIERS = 0.1
# Least degrees of freedom of the files. With fewer, all files together do not predict another one.
LEAST_DF = 4
ROWS = 8  # Rows of each stroke in the fits. The mean of a file needs no more.


class OutlierFile(NamedTuple):
    """A file that went wrong as a whole."""

    file: str
    deviation: float  # its mean force over that predicted, less 1
    p_value: float  # times the number of files
    conditions: dict  # the columns of its first row
    instead: tuple[str, ...] = ()  # files that may be the wrong ones instead; it is not left out then


def outlier_files(rows: Rows) -> tuple[list[OutlierFile], Fitted]:
    """Return the files whose mean force is far off what all other files predict, and the fit without them.

    The farthest is the first.

    Model and scatter are fitted without the file. It is an outlier if the gain that would explain it is
    significant beside the scatter of the others, which are then judged without it. In linear regression the
    test is that of the deletion residual (Cook & Weisberg 1982, *Residuals and Influence in Regression*,
    section 2.2.2). If another file may be the wrong one instead, none is left out, and the search ends.
    """
    rows = rows.sparse(ROWS)
    fitted, found = fit_declared(rows), []
    for _ in range(int(MOST_OUTLIERS * rows.groups.starts["file"].size)):
        tried = [_without(fitted, number) for number in _suspects(fitted)]
        one, kept = min(tried, key=lambda pair: pair[0].p_value, default=(None, fitted))
        if one is None or one.p_value > OUTLIER_P or abs(one.deviation) < OUTLIER_SHARE:
            break
        found.append(one._replace(instead=_wrong_instead(one, tried)))
        if found[-1].instead:
            break
        fitted = kept
    return sorted(found, key=lambda one: -abs(one.deviation)), fitted


def _wrong_instead(one: OutlierFile, tried: Sequence[tuple[OutlierFile, Fitted]]) -> tuple[str, ...]:
    """Return the files without which `one` agrees with the rest: each may be the wrong one instead."""
    found = []
    for other, kept in tried:
        if other.file == one.file:
            continue
        names = kept.rows.table["record"].to_numpy()[kept.rows.groups.starts["file"]].tolist()
        again, _ = _without(kept, names.index(one.file))
        if abs(again.deviation) < OUTLIER_SHARE or again.p_value > AGREES_P:
            found.append(other.file)
    return tuple(found)


def _df(fitted: Fitted) -> int:
    """Return the degrees of freedom of the files, one of them left out."""
    return fitted.rows.groups.starts["file"].size - 1 - fitted.basis.shape[1]


def _suspects(fitted: Fitted) -> list[int]:
    """Return the numbers of the files with the largest mean residuals, where these may be outliers.

    A residual over a standard deviation estimated without it has Student's distribution.
    """
    groups, df = fitted.rows.groups, _df(fitted)
    if df < LEAST_DF:
        return []
    if groups.starts["file"].size <= FEW_FILES:
        return list(range(groups.starts["file"].size))
    along = fitted.unit_residual("file") * np.sign(fitted.rows.speed)
    square = groups.sums(along, "file") ** 2 / np.bincount(groups.codes["file"])
    alone = square * df / np.maximum(df + 1 - square, 1e-9)
    suspect = 2 * stdtr(df, -np.sqrt(alone)) * square.size < SCREEN_P
    return [int(k) for k in np.argsort(-square)[:MOST_SUSPECTS] if suspect[k]]


def _without(fitted: Fitted, number: int) -> tuple[OutlierFile, Fitted]:
    """Return the test of one file, and the fit to the others, for which v_s and b are searched anew.

    The file's gain is a further parameter of the model, with the estimates and the scatter of the others.
    """
    rows, own = fitted.rows, fitted.rows.codes("file") == number
    others = rows.subset(~own)
    kept = fit(search_nonlinear(fitted.model, others, fitted.scatter), others, fitted.scatter, turns=2)
    at = fitted_at(kept.model, rows, kept.scatter)
    column = at.basis.project_out(at.whitening(np.where(own, at.friction, 0.0)[:, None])[:, 0])
    size = float(np.linalg.norm(column))  # 0, but for rounding, if only this file determines a parameter
    deviation = float(column @ at.white_residual) / size**2 if size > 1e-9 else 0.0
    p_value = 2 * stdtr(_df(at), -abs(deviation) * size) * rows.groups.starts["file"].size
    if _like_others_of_its_speed(at, number):
        p_value = 1.0
    first = rows.table.iloc[rows.groups.starts["file"][number]]
    return OutlierFile(str(first["record"]), deviation, float(min(p_value, 1.0)), dict(first)), kept


def _like_others_of_its_speed(fitted: Fitted, number: int) -> bool:
    """Whether a file's relative residual is within those of the other files of its speed (t test)."""
    groups = fitted.rows.groups
    size = groups.sums(fitted.friction**2, "file")
    relative = groups.sums(fitted.friction * fitted.residual, "file") / size
    speed = groups.means(np.abs(fitted.rows.speed), "file")
    ratio = speed / speed[number]
    same = np.maximum(ratio, 1 / ratio) < SPEEDS_APART
    same[number] = False
    others = relative[same]
    if others.size < LEAST_OF_SPEED:
        return False
    sd = float(np.std(others, ddof=1)) * np.sqrt(1 + 1 / others.size)
    t = abs(relative[number] - others.mean()) / max(sd, 1e-300)
    return 2 * stdtr(others.size - 1, -t) > SAME_SPEED_P


# ---------------------------------------------------------------- held-out rows


def heldout_level(rows: Rows) -> str:
    """Return the level whose groups are held out: run, or file or stroke if there are fewer than six."""
    for level in ("run", "file"):
        if rows.groups.starts[level].size >= criteria.LEAST_GROUPS_HELD_OUT:
            return foldable(rows, level)
    return "stroke"


def foldable(rows: Rows, level: str) -> str:
    """Return a level, or the next finer one at which conditions keep some groups while others are held out.

    A condition with one file and no aging law cannot be predicted without that file.
    """
    for finer in reversed(LEVELS[: LEVELS.index(level) + 1]):
        start = rows.groups.starts[finer]
        groups = np.bincount(rows.condition[start], minlength=len(rows.conditions))
        lost = [c for c in np.flatnonzero(groups == 1) if _edge(rows, int(c))]
        if len(lost) <= np.count_nonzero(groups) / 2:
            return finer
    return LEVELS[0]


def folds(rows: Rows, level: str, count: int, seed: int) -> Iterator[np.ndarray]:
    """Yield masks of the rows held out, shape (n,), in whole groups spread over the conditions."""
    start = rows.groups.starts[level]
    count = min(count, start.size)
    condition = rows.condition[start]
    shuffled = np.random.default_rng(seed).permutation(start.size)
    order = shuffled[np.argsort(condition[shuffled], kind="stable")]
    number = np.empty(start.size, dtype=int)
    number[order] = np.arange(start.size) % count
    yield from _masks(rows, level, number)


def blocks(rows: Rows, level: str, count: int, channel: str) -> list[np.ndarray]:
    """Return masks of the rows held out, shape (n,): blocks of groups that are consecutive in the calendar.

    With single groups held out, any smooth curve through the calendar would be confirmed. If a block contains
    a whole condition that cannot be predicted without it, a fold has several shorter ones that are apart.
    """
    start = rows.groups.starts[level]
    count = min(count, start.size)
    place = np.empty(start.size, dtype=int)
    place[np.argsort(rows.values(channel)[start], kind="stable")] = np.arange(start.size)
    masks: list[np.ndarray] = []
    for parts in criteria.BLOCKS_OF_A_FOLD:
        masks = list(_masks(rows, level, place * min(count * parts, start.size) // start.size % count))
        if np.any(masks, axis=0).mean() > criteria.LEAST_HELD_OUT:
            break
    return masks


def _masks(rows: Rows, level: str, number: np.ndarray) -> Iterator[np.ndarray]:
    """Yield masks of the rows held out, shape (n,), from each group's fold; edge conditions keep a group."""
    start, code = rows.groups.starts[level], rows.codes(level)
    condition = rows.condition[start]
    for k in range(number.max() + 1):
        out = _without_lost_edges(number == k, condition, rows)
        if out.any():
            yield out[code]


def _without_lost_edges(out: np.ndarray, condition: np.ndarray, rows: Rows) -> np.ndarray:
    """Return what is held out, without edge conditions that would lose all groups, shape of `out`."""
    for c in np.unique(condition[out]):
        if not (~out & (condition == c)).any() and _edge(rows, c):
            out = out & (condition != c)
    return out


def _edge(rows: Rows, condition: int) -> bool:
    """Whether a condition cannot be predicted without its rows: no aging law, day 0 or the last day."""
    law = rows.cache.once(("aging law",), lambda: has_law(rows.conditions, rows.has_aging))
    if not law[condition]:
        return True
    days, series = rows.conditions["aging_days"], rows.conditions["series"]
    return bool(days.iloc[condition] in (0.0, days[series == series.iloc[condition]].max()))


def covered(rows: Rows, out: np.ndarray, channels: Iterable[str] = ()) -> np.ndarray:
    """Return which held-out rows are covered by the other rows, shape (n,); the rest are extrapolated.

    `out`, shape (n,), is true where rows are held out; `channels` are those of the effects in the model.
    """
    inside = out.copy()
    series = rows.conditions["series"].to_numpy()[rows.condition]
    speed = np.abs(rows.speed)
    for own in np.unique(series[out]):
        here = series == own
        seen = here & ~out
        tested = np.unique(rows.condition[seen])
        lawful = rows.has_aging and tested.size > 1
        days = rows.days[seen | (~out & (rows.days == 0))]  # every series starts from unaged rubber
        new = here & out & ~np.isin(rows.condition, tested)
        if lawful:
            new &= (rows.days < days.min()) | (rows.days > days.max())
        inside &= ~new
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
    """Return which values lie outside the range of those seen, by more than values of one setting differ."""
    low, high = float(seen.min()), float(seen.max())
    slack = criteria.OUTSIDE * (high - low) + criteria.SAME_SETTING * max(abs(low), abs(high))
    return (values < low - slack) | (values > high + slack)


def whole_settings(rows: Rows, values: np.ndarray) -> Iterator[np.ndarray]:
    """Yield masks of the rows held out, shape (n,): all rows at each inner setting of a channel in turn."""
    for setting in np.unique(values)[1:-1]:
        out = _without_lost_edges(values == setting, rows.condition, rows)
        if out.any():
            yield out


def between_speeds(rows: Rows) -> Rows:
    """Return rows moved halfway, on a log scale, to the next higher tested speed of their series."""
    speed = settings(level_values(np.abs(rows.speed), rows))
    series = rows.conditions["series"].to_numpy()[rows.condition]
    halfway = np.full(speed.size, np.nan)
    for own in np.unique(series):
        here = series == own
        tested, place = np.unique(speed[here], return_inverse=True)
        halfway[here] = np.r_[np.sqrt(tested[1:] * tested[:-1]), np.nan][place]
    there = np.isfinite(halfway)
    table = rows.table[there].assign(**{name: values[there] for name, values in rows.filled.items()})
    table["speed_mm_s"] = np.sign(rows.speed[there]) * halfway[there]
    if POWER in table:
        table[POWER] = sliding_power(table["load_N"], table["speed_mm_s"])
    return replace(rows.points(table, rows.condition[there]), force=rows.force[there])
