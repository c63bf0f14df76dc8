"""Means of traces over the steady window, over bins of displacement and over the repeats of a run."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd

from sealfit.config import Bins
from sealfit.ingest.segments import Pieces, median

# ---------------------------------------------------------------- average

# The sum of correlations ends within so few lags, unless the noise is slow: then all are computed at once.
LAGS = 20

Samples = Mapping[str, np.ndarray]  # columns of equal length
Strokes = Mapping[str, Sequence]


def standard_error(values: np.ndarray) -> float:
    """Return the standard error of the mean of a series, counting in the correlation of neighbouring samples.

    SE = s sqrt(2 tau / n), with the autocorrelation time tau = 1/2 + sum of rho(k) over lags up to the first
    M that is at least 5 tau (Sokal's window): beyond, the sum adds noise only. A trend or a ripple within the
    window is correlation too, and makes the standard error larger; correlation that would make it smaller is
    not believed.

    Notes
    -----
    Sokal 1997, Monte Carlo Methods in Statistical Mechanics, section 3, doi:10.1007/978-1-4899-0319-8_6; GUM
    4.2.7.

    Examples
    --------
    >>> round(standard_error(np.array([1.0, 2.0, 1.0, 2.0])), 4)  # not correlated: s / sqrt(n) = 0.5774 / 2
    0.2887
    """
    n = len(values)
    if n < 2:
        return math.nan
    centred = values - values.mean()
    square = float(centred @ centred)
    if square == 0.0:
        return 0.0
    tau = 0.5
    for lag in range(1, min(LAGS, n)):
        tau += float(centred[lag:] @ centred[:-lag]) / square
        if lag >= 5.0 * tau:
            break
    else:
        tau = _slow_tau(centred)
    return math.sqrt(square / (n - 1) * max(2.0 * tau, 1.0) / n)


def _slow_tau(centred: np.ndarray) -> float:
    """Return a series' autocorrelation time, all lags at once; the largest sum if the window never ends."""
    n = len(centred)
    spectrum = np.fft.rfft(centred, 1 << (2 * n - 1).bit_length())  # padded so that no lag wraps around
    lagged = np.fft.irfft(spectrum * spectrum.conj())[:n]
    tau = 0.5 + np.concatenate(([0.0], np.cumsum(lagged[1:] / lagged[0])))
    inside = np.flatnonzero(np.arange(n) >= 5.0 * tau)
    return float(tau[inside[0]] if len(inside) else tau.max())


def mean_by_group(values: np.ndarray, group: np.ndarray, groups: int, count: np.ndarray) -> np.ndarray:
    """Return the mean of `values` in each group, shape (groups,), of `count` samples each; NaN for none."""
    with np.errstate(invalid="ignore"):
        return np.bincount(group, values, minlength=groups) / count


def common_by_group(values: np.ndarray, group: np.ndarray, groups: int) -> np.ndarray:
    """Return the most frequent label in each group, shape (groups,); None for a group without one."""
    codes, labels = pd.factorize(values)
    known = codes >= 0
    pairs, count = np.unique(group[known] * max(len(labels), 1) + codes[known], return_counts=True)
    made = np.full(groups, None, object)
    order = np.argsort(count, kind="stable")  # the most frequent is written last
    owner, label = np.divmod(pairs[order], max(len(labels), 1))
    made[owner] = np.asarray(labels, object)[label] if len(labels) else None
    return made


def bin_table(samples: Samples, strokes: Strokes, settings: Bins) -> dict[str, np.ndarray]:
    """Return the steady window of every stroke cut along displacement, a row per bin.

    All strokes of a run share the edges of their bins, which span the windows of all of them, so a pattern
    along displacement falls into the same bins in every repeat. A run has `per_stroke` bins, or fewer where
    its strokes have too few samples; the few bins that still hold less than `min_samples` are joined to their
    neighbours.

    Parameters
    ----------
    samples : mapping of str to ndarray, shape (n,)
        Samples of the steady windows, stroke after stroke, at least one: `row` (place in `strokes`),
        displacement_mm, force_N and further columns, numbers or labels, whose means (or most frequent labels)
        are wanted.
    strokes : mapping of str to sequence, one value per stroke
        `run_id`, `direction`.
    settings : Bins
        The config's `bins`.

    Returns
    -------
    dict of str to ndarray
        `row`, `bin` (from 0 in the direction of motion), `n`, `force_sd_N`, and the mean of every column of
        `samples`.
    """
    row, own = owners(samples["row"])
    run, runs = _numbered(strokes["run_id"], row)
    back = np.asarray(strokes["direction"])[row] < 0
    group, width = _bin_of(np.asarray(samples["displacement_mm"]), own, run, runs, back, settings)
    group, count = _joined(group, len(own), width, settings.min_samples)
    groups, shown = len(count), np.flatnonzero(count)
    made = {"row": row[shown // width], "bin": shown % width, "n": count[shown]}
    for name in samples:
        values = np.asarray(samples[name])
        if name == "row":
            continue
        if values.dtype.kind in "fiub":
            made[name] = mean_by_group(values.astype(float, copy=False), group, groups, count)[shown]
        else:
            made[name] = common_by_group(values, group, groups)[shown]
    force = np.asarray(samples["force_N"])
    off = force - mean_by_group(force, group, groups, count)[group]
    square, n = np.bincount(group, off * off, minlength=groups)[shown], count[shown]
    made["force_sd_N"] = np.sqrt(np.divide(square, n - 1.0, out=np.full(len(n), np.nan), where=n > 1))
    return made


def owners(row: np.ndarray) -> tuple[np.ndarray, Pieces]:
    """Return the strokes with samples, and where those of each lie; `row` is each sample's stroke, rising."""
    count = np.bincount(row)
    there = np.flatnonzero(count)
    return there, Pieces(count[there])


def _numbered(labels: Sequence[str], rows: np.ndarray) -> tuple[np.ndarray, int]:
    """Return a number for the label of each of these rows, as they appear, and how many labels there are."""
    codes, different = pd.factorize(np.array(labels, object)[rows])
    return codes, len(different)


def _bin_of(
    x: np.ndarray, own: Pieces, run: np.ndarray, runs: int, back: np.ndarray, settings: Bins
) -> tuple[np.ndarray, int]:
    """Return the bin of every sample, counted through all strokes, and how many each stroke has room for."""
    low, high = range_of_runs(own.min(x), own.max(x), run, runs)
    typical = np.array([median(own.size[run == i].astype(float)) for i in range(runs)])
    # Half as many again as needed on average, since samples do not fall into bins evenly.
    bins = np.clip(typical // np.ceil(1.5 * settings.min_samples), 1, settings.per_stroke).astype(int)
    width = (high - low) / bins
    width[width <= 0.0] = np.inf  # all in the first bin
    place = ((x - own.spread(low[run])) / own.spread(width[run])).astype(int)
    np.minimum(place, own.spread(bins[run] - 1), out=place)
    room = int(bins.max())
    first = np.arange(len(own)) * room + np.where(back, bins[run] - 1, 0)
    return own.spread(first) + np.where(own.spread(back), -place, place), room


def range_of_runs(
    low: np.ndarray, high: np.ndarray, run: np.ndarray, runs: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return the least and the largest value of every run, shape (runs,), from those of its strokes."""
    least, largest = np.full(runs, np.inf), np.full(runs, -np.inf)
    np.minimum.at(least, run, low)
    np.maximum.at(largest, run, high)
    return least, largest


def _joined(group: np.ndarray, strokes: int, width: int, least: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the group of every sample after thin bins joined their nearest neighbour, and the counts."""
    count = np.bincount(group, minlength=strokes * width)
    thin = np.flatnonzero((count > 0) & (count < least))
    if not len(thin):
        return group, count
    target = np.arange(strokes * width)
    for stroke in np.unique(thin // width):
        own = np.arange(stroke * width, (stroke + 1) * width)
        full = own[count[own] >= least]
        if not len(full):  # a stroke as short as that is one bin
            full = own[[int(np.argmax(count[own]))]]
        for one in own[(count[own] > 0) & (count[own] < least)]:
            target[one] = full[int(np.argmin(np.abs(full - one)))]
    group = target[group]
    return group, np.bincount(group, minlength=strokes * width)


# ---------------------------------------------------------------- mean traces
# Means of traces over the repeats of a run, on cells of displacement.

MAX_CELLS = 2000  # per run, in traces_mean: finer than any screen shows
SAME_TRAVEL = 2  # cells by which strokes that are averaged before they slide steadily may differ in travel
BRIDGED = 3  # empty cells in a row that are filled by a straight line: scarce samples, not a gap


def mean_traces(samples: Samples, strokes: Strokes) -> dict[str, np.ndarray]:
    """Return the mean over repeats on a displacement grid that the repeats of a run share.

    Cells are as wide as the usual step between samples, so the pre-sliding rise keeps its shape. The strokes
    of one file are averaged first; mean and standard error are then those of the files of the run, each
    weighing the same.

    Parameters
    ----------
    samples : mapping of str to ndarray, shape (n,)
        Samples of sliding, stroke after stroke, at least one: `row` (place in `strokes`), displacement_mm,
        force_N, steady.
    strokes : mapping of str to sequence, one value per stroke
        file, run_id, direction.

    Returns
    -------
    dict of str to ndarray
        What table `traces_mean` holds of numbers, and `row`, the first stroke of the run.
    """
    row, own = owners(samples["row"])
    (run, runs), (file, files) = (_numbered(strokes[name], row) for name in ("run_id", "file"))
    back = np.asarray(strokes["direction"])[row] < 0
    low, step, cells = _grid(np.asarray(samples["displacement_mm"]), own, run, runs)
    # The cells of every stroke, and of every run, end to end.
    grid, places = Pieces(cells[run]), Pieces(cells)
    force, steady = _of_cells(samples, own, grid, low[run], step[run])
    force, steady = _bridged(force, steady, grid)
    known = np.flatnonzero(np.isfinite(force))
    owner, force, steady = grid.of[known], force[known], steady[known]
    cell = known - grid.start[owner]
    spot = places.start[run][owner] + cell
    keep, somewhere = _comparable(spot, places.rows, steady, _travel(cell, owner, back))
    owner, spot, force = owner[keep], spot[keep], force[keep]
    strokes_there = np.bincount(spot, minlength=places.rows)
    if files < len(row):
        spot, force = _one_per_file(spot, file[owner], files, force)
    count = np.bincount(spot, minlength=places.rows)
    mean = mean_by_group(force, spot, places.rows, count)
    square = np.bincount(spot, (force - mean[spot]) ** 2, minlength=places.rows)
    error = np.sqrt(
        np.divide(square, (count - 1.0) * count, out=np.full(places.rows, np.nan), where=count > 1)
    )
    shown = np.flatnonzero(count)
    of = places.of[shown]
    return {
        "row": row[np.unique(run, return_index=True)[1]][of],
        "displacement_mm": low[of] + (shown - places.start[of] + 0.5) * step[of],
        "force_N": mean[shown],
        "force_se_N": error[shown],
        "n": strokes_there[shown],
        "steady": somewhere[shown],
    }


def _grid(
    x: np.ndarray, own: Pieces, run: np.ndarray, runs: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return start, step and number of the cells of every run."""
    start, stop = own.min(x), own.max(x)
    low, high = range_of_runs(start, stop, run, runs)
    span = np.where(high > low, high - low, 1.0)
    usual = (stop - start) / np.maximum(own.size - 1.0, 1.0)
    widest = np.zeros(runs)
    np.maximum.at(widest, run, usual)
    step = np.maximum(np.where(widest > 0.0, widest, span), span / MAX_CELLS)
    cells = np.maximum(np.ceil(span / step * (1.0 - 1e-9)), 1).astype(int)
    return low, span / cells, cells


def _of_cells(
    samples: Samples, own: Pieces, grid: Pieces, low: np.ndarray, step: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean force in each cell of each stroke, NaN if empty, and whether all samples are steady."""
    x = np.asarray(samples["displacement_mm"])
    cell = ((x - own.spread(low)) / own.spread(step)).astype(int)
    np.minimum(cell, own.spread(grid.size - 1), out=cell)
    cell += own.spread(grid.start)
    force = mean_by_group(
        np.asarray(samples["force_N"]), cell, grid.rows, np.bincount(cell, minlength=grid.rows)
    )
    unsteady = cell[~np.asarray(samples["steady"], bool)]
    return force, np.bincount(unsteady, minlength=grid.rows) == 0


def _bridged(force: np.ndarray, steady: np.ndarray, grid: Pieces) -> tuple[np.ndarray, np.ndarray]:
    """Return force and steady flag with short runs of a stroke's empty cells filled along a straight line."""
    full = np.flatnonzero(np.isfinite(force))
    missing = np.diff(full) - 1
    short = np.flatnonzero((missing > 0) & (missing <= BRIDGED))
    short = short[grid.of[full[short]] == grid.of[full[short + 1]]]
    gaps = Pieces(missing[short])
    left, right = gaps.spread(full[short]), gaps.spread(full[short + 1])
    empty = left + 1 + np.arange(gaps.rows) - gaps.spread(gaps.start)
    share = (empty - left) / (right - left)
    force, steady = force.copy(), steady.copy()
    force[empty] = (1.0 - share) * force[left] + share * force[right]
    steady[empty] = steady[left] & steady[right]
    return force, steady


def _travel(cell: np.ndarray, owner: np.ndarray, back: np.ndarray) -> np.ndarray:
    """Return how many cells each known cell lies behind its stroke's start, along the motion."""
    own = Pieces(np.bincount(owner))  # every stroke has a cell
    turn = own.spread(np.where(back, cell[own.stop - 1], cell[own.start]))
    return np.where(own.spread(back), turn - cell, cell - turn)


def _comparable(
    spot: np.ndarray, spots: int, steady: np.ndarray, travel: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return which cells of strokes may be averaged with others at their place, and which places are steady.

    The place in the run is `spot`. Repeats need not start at the same place: where one slides steadily,
    another may just be starting, and its pre-sliding rise would be a dip in the mean. So steady strokes are
    averaged where there are any, and elsewhere those that have come equally far from their own start.
    """
    somewhere = np.bincount(spot[steady], minlength=spots) > 0
    keep = steady.copy()
    others = np.flatnonzero(~somewhere[spot])
    furthest = np.zeros(spots, int)
    np.maximum.at(furthest, spot[others], travel[others])
    keep[others] = travel[others] >= furthest[spot[others]] - SAME_TRAVEL
    return keep, somewhere


def _one_per_file(
    spot: np.ndarray, file: np.ndarray, files: int, force: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return place and mean force once for every file at every place."""
    pair, own, count = np.unique(spot * files + file, return_inverse=True, return_counts=True)
    if len(pair) == len(spot):
        return spot, force
    place = np.zeros(len(pair), int)
    place[own] = spot
    return place, mean_by_group(force, own, len(pair), count)
