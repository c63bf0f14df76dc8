"""Channels that may explain a residual, and the level at which each varies.

A channel varies at the coarsest level within whose groups it is nearly constant. A category with each of its
levels in one group only (a serial number) is a grouping and never an effect.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import BSpline

from sealfit.closure import criteria
from sealfit.config import Config
from sealfit.effects.free import WIDE
from sealfit.fit.joint.rows import ALONG, LEVELS, POWER, Rows, one_load, open_columns
from sealfit.ingest.columns import condition_columns, force_inputs
from sealfit.ingest.quality import STILL_RISING, forms_of_force, shared_variance
from sealfit.ingest.strokes import SPEEDS_APART
from sealfit.tables import CALENDAR

FINER = {level: k for k, level in enumerate(("sample", *LEVELS))}
ROUNDING = 1e-9  # Relative rounding error of the mean of equal numbers.


@dataclass(frozen=True)
class Channel:
    """A channel on the rows: numbers, or categories as strings."""

    name: str
    values: np.ndarray  # (n,) float or str
    unit: str  # "sample" or a nesting level
    grouping: bool = False  # each category in one unit only: an identifier
    added_only: bool = False  # whether only an added force is tested

    @property
    def numeric(self) -> bool:
        """Whether the channel holds numbers."""
        return self.values.dtype.kind == "f"

    @property
    def scatters(self) -> bool:
        """Whether specimens differ in their slope along the channel without any effect."""
        return self.unit == "sample" or self.name in ("speed_mm_s", "direction", "load_N", POWER)


def channels_of(rows: Rows, config: Config) -> list[Channel]:
    """Return the channels that the loop searches by a campaign's config: see `find_channels`."""
    ignored = {*config.loop.ignore_channels, *force_inputs(config)}
    if config.position_origin != "rig":  # displacement is not the same place in every file
        ignored.add("displacement_mm")
    return find_channels(rows, ignored, conditions=condition_columns(config))


def searched(channels: Iterable[Channel], rows: Rows) -> list[Channel]:
    """Return the channels that are searched: all, or those that do not increase along strokes.

    Where strokes end before the friction is steady, a residual along them is an error of the bristle model,
    and opposes the motion. A force that time adds, such as a drift of the sensor, does not, so it is searched
    where strokes go both ways.
    """
    if not too_short(rows):
        return list(channels)
    both_ways = rows.speed.min() < 0 < rows.speed.max()
    drifts = [replace(c, added_only=True) for c in channels if both_ways and c.name == "time_s"]
    return [*(c for c in channels if c.name not in ALONG), *drifts]


def too_short(rows: Rows) -> bool:
    """Return whether at least half of the strokes end before the friction is steady (`never_steady`)."""
    if "presliding_N" not in rows.table:
        return False
    last = np.r_[rows.groups.starts["stroke"][1:], rows.force.size] - 1
    left = np.abs(rows.table["presliding_N"].to_numpy(dtype=float)[last])
    return bool(np.mean(left > STILL_RISING * np.abs(rows.force[last])) >= criteria.SHORT_STROKES)


def find_channels(
    rows: Rows, ignore: Collection[str] = (), *, conditions: Collection[str] = ()
) -> list[Channel]:
    """Return every channel of the rows that varies and is not a grouping or a text with hundreds of values.

    Groupings are kept among `conditions`: an offset between directions may differ between these. One of them
    may be called `rubber`, as the column of table `bins` that has the names of rubbers.
    """
    found, measured = [], open_columns(rows.table)
    own = [name for name in conditions if name == "rubber" and name in rows.table]
    for name in (name for name in [*rows.channels, *own] if name not in ignore):
        values = np.abs(rows.speed) if name == "speed_mm_s" else rows.values(name)
        if values.dtype.kind == "f":
            if not (np.isfinite(values).all() and varies(values)) or _one_setting(name, values):
                continue
            if name in measured and _repeats_force(values, rows):
                continue
            values = settings(level_values(values, rows))
        elif not 2 <= np.unique(values).size <= criteria.MOST_LEVELS:
            continue
        if name == "stroke" and "direction" not in ignore and out_and_back(rows):
            continue
        channel = Channel(name, values, unit_of(values, rows))
        channel = replace(channel, grouping=not channel.numeric and _is_grouping(channel, rows))
        if not channel.grouping or name in conditions:
            found.append(channel)
    return found


def _repeats_force(values: np.ndarray, rows: Rows) -> bool:
    """Whether numbers, shape (n,), are the force: in other units, over the load, or filtered.

    They follow it, and within strokes its noise, which no cause of friction does.
    """
    inside = np.diff(rows.codes("stroke")) == 0
    return inside.any() and any(
        shared_variance(values, form) > criteria.SAME_AS_FORCE
        and shared_variance(np.diff(values)[inside], np.diff(form)[inside]) > criteria.SAME_NOISE
        for form in forms_of_force(rows.force, rows.load)
    )


def _one_setting(name: str, values: np.ndarray) -> bool:
    """Whether the speeds or loads of a campaign, shape (n,), are one setting."""
    if name == "speed_mm_s":
        return bool(values.max() <= SPEEDS_APART * values.min())
    return name == "load_N" and one_load(values)


def varies(values: np.ndarray) -> bool:
    """Whether numbers differ by more than rounding."""
    return bool(np.ptp(values) > ROUNDING * max(float(np.abs(values).max()), 1e-300))


def incomplete_channels(rows: Rows) -> list[dict]:
    """Return the campaign's own channels that some files lack, their numbers and whether each is searched."""
    found = []
    for name in open_columns(rows.table):
        known = rows.table[name].notna().groupby(rows.codes("file")).any()
        if not known.all() and known.any():
            whole = rows.values(name).dtype.kind != "f" or bool(np.isfinite(rows.values(name)).all())
            counts = {"files_without": int((~known).sum()), "files": len(known)}
            found.append({"channel": name, **counts, "searched": whole})
    return found


def unit_of(values: np.ndarray, rows: Rows) -> str:
    """Return the coarsest level in whose groups `values` are nearly constant; "sample" if there is none."""
    numeric = values.dtype.kind == "f"
    if numeric:
        rounding = ROUNDING * float(np.abs(values).max())
        most = max(criteria.CONSTANT_SHARE * float(np.var(values)), rounding**2)
    for level in reversed(LEVELS):
        start, code = rows.groups.starts[level], rows.codes(level)
        if numeric:
            constant = np.mean((values - rows.groups.means(values, level)[code]) ** 2) <= most
        else:
            constant = (values == values[start][code]).all()
        if constant:
            return level
    return "sample"


def level_values(values: np.ndarray, rows: Rows) -> np.ndarray:
    """Return numbers as their means in the groups of the level at which they vary."""
    level = unit_of(values, rows)
    return values if level == "sample" else rows.groups.means(values, level)[rows.codes(level)]


def run_means(channel: Channel, rows: Rows) -> Channel | None:
    """Return a channel as its means over runs if it differs little within them; None otherwise.

    A channel that varies within runs is tested mostly within them, where a step between runs is not seen.
    """
    if not channel.numeric or channel.unit not in ("stroke", "file"):
        return None
    means = rows.groups.means(channel.values, "run")[rows.codes("run")]
    if np.mean((channel.values - means) ** 2) > criteria.MOST_WITHIN_RUNS * np.var(channel.values):
        return None
    return replace(channel, values=means, unit="run")


def follows_strokes(name: str, rows: Rows) -> bool:
    """Whether a channel is the same along all strokes to a part, as the profiles of specimens may be.

    Time, distance and position are, and a column of the traces if a common parabola of distance and position
    explains `COMMON_PROFILE` of its variance within strokes.
    """
    values = rows.values(name)
    if name in ALONG or unit_of(values, rows) != "sample":
        return name in ALONG
    places = [rows.values(own) for own in ("distance_mm", "displacement_mm") if own in rows.table]
    columns = np.column_stack([*(own**k for own in places for k in (1, 2)), values])
    columns = columns - rows.groups.means(columns, "stroke")[rows.codes("stroke")]
    shared, own = columns[:, :-1], columns[:, -1]
    left = own - shared @ np.linalg.lstsq(shared, own)[0]
    return bool(left @ left < (1 - criteria.COMMON_PROFILE) * (own @ own))


def without_trends(channel: Channel, rows: Rows) -> Channel | None:
    """Return a column of the traces that does not follow the strokes, less a parabola along each of them.

    Specimens differ in their profiles, which would hide what the column does. None for other channels.
    """
    if not channel.numeric or channel.unit != "sample" or follows_strokes(channel.name, rows):
        return None
    place, code = rows.values("distance_mm"), rows.codes("stroke")
    left = np.column_stack([place, place**2, channel.values])
    left -= rows.groups.means(left, "stroke")[code]
    for k in (0, 1):  # each power is removed from the columns after it, in every stroke
        power, rest = left[:, [k]], left[:, k + 1 :]
        size = np.maximum(rows.groups.sums(power**2, "stroke"), 1e-300)
        left[:, k + 1 :] = rest - (rows.groups.sums(power * rest, "stroke") / size)[code] * power
    return replace(channel, values=left[:, -1])


def settings(values: np.ndarray) -> np.ndarray:
    """Return numbers with measured values replaced by the mean of their setting; unchanged without settings.

    Settings are groups of values with gaps between them; a continuous channel has none.
    """
    distinct, place = np.unique(values, return_inverse=True)
    if distinct.size == 1:
        return values
    at = scaled(distinct)
    first = np.flatnonzero(np.r_[True, np.diff(at) > criteria.SAME_VALUE])
    widest = float((at[np.r_[first[1:] - 1, at.size - 1]] - at[first]).max())
    if first.size == at.size or first.size > criteria.MOST_SET_VALUES or widest > 10 * criteria.SAME_VALUE:
        return values
    group = (np.searchsorted(first, np.arange(at.size), side="right") - 1)[place]
    return (np.bincount(group, values) / np.bincount(group))[group]


def scatter_level(channels: Iterable[Channel], rows: Rows) -> str:
    """Return the level of the units between which a contrast of some channels is tested.

    It is the coarsest level at which the slope may scatter without any effect: specimens for the place in a
    stroke, speed, load and direction, and runs for what else varies between runs. A product has the units of
    its coarser channel, each of which may have a slope of its own along the finer one. With few units the
    next finer level is used.
    """
    channels = list(channels)
    unit = max((c.unit for c in channels), key=FINER.get)
    coarsest = "specimen" if unit == "specimen" or any(c.scatters for c in channels) else "run"
    levels = LEVELS[max(FINER[unit], 1) - 1 : FINER[coarsest]]
    least = criteria.LEAST_UNITS_OF_SLOPES
    return next((level for level in reversed(levels) if rows.groups.starts[level].size >= least), levels[0])


def flip_level(unit: str, rows: Rows) -> str:
    """Return the level whose whole groups are held out and are the sample size of the BIC.

    With one or a few files it is the stroke; the result then holds for these files only.
    """
    if FINER[unit] >= FINER["run"]:
        return unit
    if rows.groups.starts["run"].size >= criteria.MANY_RUNS:
        return "run"
    if unit == "file" or rows.groups.starts["file"].size >= criteria.LEAST_GROUPS_HELD_OUT:
        return "file"
    return "stroke"


def out_and_back(rows: Rows) -> bool:
    """Whether the stroke number only distinguishes the two directions."""
    pairs = np.unique(np.column_stack([rows.values("stroke"), np.sign(rows.speed)]), axis=0)
    return len(pairs) == 2 and bool((np.ptp(pairs, axis=0) > 0).all())


def _is_grouping(channel: Channel, rows: Rows) -> bool:
    level = channel.unit if channel.unit != "sample" else "stroke"
    first = channel.values[rows.groups.starts[level]]
    return np.unique(first).size == first.size


def free_columns(channel: Channel, most: int = criteria.FREE_DF) -> np.ndarray:
    """Return the columns of a free shape, first a straight line: shape (n, k), each centred and scaled.

    A cubic B-spline with knots at quantiles of the scaled channel (the zero of the calendar is arbitrary), a
    quadratic for few units; for categories, one column per level except the first.
    """
    if not channel.numeric:
        levels = np.unique(channel.values)
        return (channel.values[:, None] == levels[None, 1:]).astype(float)
    x = scaled(channel.values, even=channel.name in CALENDAR)
    distinct = np.unique(x)
    df = min(most, distinct.size - 1)
    if distinct.size <= most + 1 or df == 2:  # a cubic spline has three columns at least
        columns = [x**k for k in range(1, max(df, 1) + 1)]
    else:
        inner = np.quantile(distinct, np.linspace(0, 1, df)[1:-1])
        knots = np.r_[[distinct[0]] * 4, inner, [distinct[-1]] * 4]
        columns = [x, *BSpline.design_matrix(x, knots, 3).toarray()[:, 1:-1].T]
    stacked = np.column_stack(columns)
    stacked = stacked - stacked.mean(axis=0)
    size = np.sqrt((stacked**2).mean(axis=0))
    return stacked[:, size > 1e-12] / size[size > 1e-12]


def kinks(channel: Channel) -> np.ndarray:
    """Return centred columns that are linear up to an inner channel value and constant beyond it, (n, k)."""
    x = scaled(channel.values, even=channel.name in CALENDAR)
    columns = np.minimum(x[:, None], np.unique(x)[1:-1])
    return columns - columns.mean(axis=0)


def steps(channel: Channel, rows: Rows) -> np.ndarray:
    """Return centred columns that jump once between the units of a channel, shape (n, k).

    A free shape of four columns does not follow a step, and what it leaves hides it in a few files.
    """
    columns = (channel.values[:, None] > _jumps(channel, rows, criteria.MOST_STEPS)).astype(float)
    return columns - columns.mean(axis=0)


def intervals(channel: Channel, rows: Rows) -> np.ndarray:
    """Return centred columns that are 1 between two places along a channel and 0 elsewhere, shape (n, k)."""
    ends = _jumps(channel, rows, criteria.MOST_ENDS)
    first, last = np.triu_indices(ends.size, 1)
    columns = (channel.values[:, None] > ends[first]) & (channel.values[:, None] < ends[last])
    start = rows.groups.starts[flip_level(channel.unit, rows)]
    columns = columns[:, columns[start].sum(axis=0) >= criteria.LEAST_BESIDE_STEP].astype(float)
    return columns - columns.mean(axis=0)


def _jumps(channel: Channel, rows: Rows, most: int) -> np.ndarray:
    """Return up to `most` places between the units of a channel, with enough of them on either side."""
    values = np.sort(channel.values[rows.groups.starts[flip_level(channel.unit, rows)]])
    inner = slice(criteria.LEAST_BESIDE_STEP - 1, max(values.size - criteria.LEAST_BESIDE_STEP, 0))
    before, after = values[:-1][inner], values[1:][inner]
    places = ((before + after) / 2)[after > before]
    if places.size > most:
        places = places[np.linspace(0, places.size - 1, most).round().astype(int)]
    return places


def evenly(values: np.ndarray) -> np.ndarray:
    """Return values mapped so that five quantiles of the distinct ones lie evenly from -1 to 1.

    Examples
    --------
    >>> [float(u) for u in evenly(np.array([1.0, 10.0, 55.0, 100.0, 1000.0]))]
    [-1.0, -0.5, 0.0, 0.5, 1.0]
    """
    distinct = np.unique(values)
    knots = np.unique(distinct if distinct.size <= 5 else np.quantile(distinct, np.linspace(0, 1, 5)))
    return np.interp(values, knots, np.linspace(-1, 1, knots.size))


def shifted_from_zero(values: np.ndarray) -> np.ndarray:
    """Return values, shifted by the smallest positive one if they start at 0, so that logarithms exist."""
    return values + values[values > 0].min() if values.min() == 0 < values.max() else values


def scaled(values: np.ndarray, *, even: bool = False) -> np.ndarray:
    """Return a channel mapped to [-1, 1], logarithmically if it spans a factor of 20 unless `even`.

    A channel that starts at 0, such as days of aging, is shifted by its smallest positive value first.
    """
    values = shifted_from_zero(values)
    low, high = float(values.min()), float(values.max())
    if low > 0 and high / low >= WIDE and not even:
        values, low, high = np.log(values), np.log(low), np.log(high)
    return np.clip(2 * (values - low) / (high - low) - 1, -1.0, 1.0)


# ---------------------------------------------------------------- columns of a pair

# Powers of the two mapped channels in the nonlinear terms of a pair.
BENDS = ((1, 1), (2, 1), (1, 2), (2, 2))


def main_columns(channel: Channel) -> np.ndarray:
    """Return columns of what depends on one channel alone, shape (n, k): any of few levels, or a parabola."""
    levels = np.unique(channel.values)
    if levels.size <= criteria.MOST_CATEGORIES:
        return (channel.values[:, None] == levels[1:]).astype(float)
    return evenly(channel.values)[:, None] ** (1, 2)


def mixed_columns(one: Channel, other: Channel) -> list[np.ndarray]:
    """Return the interaction terms of two channels, blocks of shape (n, k) that are tested one by one.

    The first are products, also of logarithms for channels with a wide range; the last is a block of
    nonlinear terms. Two categories have none.
    """
    if not (one.numeric or other.numeric):
        return []
    if one.numeric and other.numeric:
        products = [(u * w)[:, None] for u in _scales(one) for w in _scales(other)]
        u, w = (_centred(evenly(channel.values)) for channel in (one, other))
        blocks = [*products, np.column_stack([u**j * w**k for j, k in BENDS])]
    else:
        number, category = (one, other) if one.numeric else (other, one)
        u = _centred(evenly(number.values))
        levels = np.unique(category.values)
        blocks = [(category.values[:, None] == levels[None, 1:]) * u[:, None]]
    found = []
    for columns in blocks:
        size = np.sqrt((columns**2).mean(axis=0))
        if (size > 1e-9).any():
            found.append(columns[:, size > 1e-9] / size[size > 1e-9])
    return found


def _scales(channel: Channel) -> list[np.ndarray]:
    """Return a channel, centred, and its logarithm if the range is wide (values from 0 are shifted first)."""
    x = channel.values
    scales = [x]
    if x.min() >= 0 and x.max() > criteria.LOGARITHMIC_SPAN * x[x > 0].min(initial=np.inf):
        scales.append(np.log(shifted_from_zero(x)))
    return [_centred(x) / max(float(np.ptp(x)), 1e-300) for x in scales]


def _centred(values: np.ndarray) -> np.ndarray:
    return values - values.mean()
