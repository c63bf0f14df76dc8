"""Means of traces: over the steady window, over bins of displacement, and over the repeats of a run."""

from __future__ import annotations

import math

import numpy as np
import pandas as pd

from sealfit.config import Bins
from sealfit.ingest.pieces import Pieces
from sealfit.tables import TRACES_MEAN

LAGS = 20  # the sum of correlations ends within so few, unless the noise is slow: then all lags are computed at once
MAX_CELLS = 2000  # per run, in traces_mean: finer than any screen shows
SAME_TRAVEL = 2  # cells by which strokes that are averaged before they slide steadily may differ in travel
BRIDGED = 3  # empty cells in a row that are filled by a straight line: scarce samples, not a gap


def standard_error(values: np.ndarray) -> float:
    """Return the standard error of the mean of a series, with the correlation of neighbouring samples counted in.

    SE = s sqrt(2 tau / n), with the autocorrelation time tau = 1/2 + sum of rho(k) over lags up to the first M that
    is at least 5 tau (Sokal's window): beyond, the sum adds noise only. A trend or a ripple within the window is
    correlation too, and makes the standard error larger; correlation that would make it smaller is not believed.

    Notes
    -----
    Sokal 1997, Monte Carlo Methods in Statistical Mechanics, section 3, doi:10.1007/978-1-4899-0319-8_6; GUM 4.2.7.

    Examples
    --------
    >>> round(standard_error(np.array([1.0, 2.0, 1.0, 2.0])), 4)  # not correlated: s / sqrt(n) = 0.5774 / 2
    0.2887
    """
    return float(standard_errors(values, Pieces([len(values)]))[0]) if len(values) else float("nan")


def standard_errors(values: np.ndarray, series: Pieces) -> np.ndarray:
    """Return the standard error of the mean of every series, shape (series,): see `standard_error`."""
    means = series.mean(values).tolist()
    return np.array([_standard_error(values[own] - mean) for own, mean in zip(series.slices, means, strict=True)])


def _standard_error(centred: np.ndarray) -> float:
    n, square = len(centred), float(centred @ centred)
    if n < 2:
        return float("nan")
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
    """Return the autocorrelation time of a series, all lags at once; the largest sum where the window never ends."""
    n = len(centred)
    spectrum = np.fft.rfft(centred, 1 << (2 * n - 1).bit_length())  # padded so that no lag wraps around
    lagged = np.fft.irfft(spectrum * spectrum.conj())[:n]
    tau = 0.5 + np.concatenate(([0.0], np.cumsum(lagged[1:] / lagged[0])))
    inside = np.flatnonzero(np.arange(n) >= 5.0 * tau)
    return float(tau[inside[0]] if len(inside) else tau.max())


def mean_by_group(values: np.ndarray, group: np.ndarray, groups: int, count: np.ndarray) -> np.ndarray:
    """Return the mean of `values` in each of `groups` groups, shape (groups,); `count` samples each, NaN for none."""
    total = np.bincount(group, values, minlength=groups)
    return np.divide(total, count, out=np.full(groups, np.nan), where=count > 0)


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


def bin_table(samples: pd.DataFrame, strokes: pd.DataFrame, settings: Bins) -> pd.DataFrame:
    """Return the steady window of every stroke cut along displacement, a row per bin.

    All strokes of a run share the edges of their bins, which span the windows of all of them, so a pattern along
    displacement falls into the same bins in every repeat. A run has `per_stroke` bins, or fewer where its strokes
    have too few samples; the few bins that still hold less than `min_samples` are joined to their neighbours.

    Parameters
    ----------
    samples : DataFrame
        Samples of the steady windows: `row` (place in `strokes`), displacement_mm, force_N and further columns,
        numbers or labels, whose means (or most frequent labels) are wanted.
    strokes : DataFrame
        One row per stroke: `run_id`, `direction`.
    settings : Bins
        The config's `bins`.

    Returns
    -------
    DataFrame
        `row`, `bin` (from 0 in the direction of motion), `n`, `force_sd_N`, and the mean of every column of `samples`.
    """
    row = samples["row"].to_numpy()
    run = pd.factorize(strokes["run_id"])[0]
    place, bins = _bin_of(samples["displacement_mm"].to_numpy(), row, run, strokes["direction"].to_numpy(), settings)
    width = int(bins.max(initial=1))
    group, count = _joined(row * width + place, len(strokes), width, settings.min_samples)
    groups = len(strokes) * width
    made = {"row": np.arange(groups) // width, "bin": np.arange(groups) % width, "n": count}
    for name in samples.columns.drop("row"):
        values = samples[name].to_numpy()
        if values.dtype.kind in "fiub":
            made[name] = mean_by_group(values.astype(float), group, groups, count)
        else:
            made[name] = common_by_group(values, group, groups)
    off = samples["force_N"].to_numpy() - made["force_N"][group]
    square = np.bincount(group, off * off, minlength=groups)
    made["force_sd_N"] = np.sqrt(np.divide(square, count - 1.0, out=np.full(groups, np.nan), where=count > 1))
    return pd.DataFrame(made)[count > 0].reset_index(drop=True)


def _bin_of(
    displacement: np.ndarray, row: np.ndarray, run: np.ndarray, direction: np.ndarray, settings: Bins
) -> tuple[np.ndarray, np.ndarray]:
    """Return the bin of every sample, and the number of bins of every run."""
    runs = int(run.max(initial=-1)) + 1
    low, high = np.full(runs, np.inf), np.full(runs, -np.inf)
    np.minimum.at(low, run[row], displacement)
    np.maximum.at(high, run[row], displacement)
    per_stroke = np.bincount(row, minlength=len(run)).astype(float)
    typical = (
        pd.Series(per_stroke[per_stroke > 0]).groupby(run[per_stroke > 0]).median().reindex(range(runs), fill_value=0)
    )
    # Half as many again as needed on average, since samples do not fall into bins evenly.
    bins = np.clip(typical.to_numpy() // np.ceil(1.5 * settings.min_samples), 1, settings.per_stroke).astype(int)
    of = run[row]
    width = (high[of] - low[of]) / bins[of]
    place = np.floor(np.divide(displacement - low[of], width, out=np.zeros(len(of)), where=width > 0)).astype(int)
    place = np.clip(place, 0, bins[of] - 1)
    return np.where(direction[row] < 0, bins[of] - 1 - place, place), bins


def _joined(group: np.ndarray, strokes: int, width: int, least: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the group of every sample after thin bins have joined their nearest neighbour, and the counts."""
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


def mean_traces(samples: pd.DataFrame, strokes: pd.DataFrame) -> pd.DataFrame:
    """Return table `traces_mean`: the mean over repeats on a displacement grid that the repeats of a run share.

    Cells are as wide as the usual step between samples, so the pre-sliding rise keeps its shape. The strokes of one
    file are averaged first; mean and standard error are then those of the files of the run, each weighing the same.

    Parameters
    ----------
    samples : DataFrame
        Samples of sliding: `row` (place in `strokes`), displacement_mm, force_N, steady.
    strokes : DataFrame
        One row per stroke: file, run_id, direction, condition.
    """
    if not len(samples):
        return pd.DataFrame({column.name: [] for column in TRACES_MEAN.columns})
    row, x = samples["row"].to_numpy(), samples["displacement_mm"].to_numpy()
    run = pd.factorize(strokes["run_id"])[0]
    low, step, cells = _grid(x, row, run)
    offset = np.concatenate(([0], np.cumsum(cells[run])))  # of each stroke in one flat array of cells
    of = run[row]
    place = np.minimum(((x - low[of]) / step[of]).astype(int), cells[of] - 1)
    flat, size = offset[row] + place, int(offset[-1])
    count = np.bincount(flat, minlength=size)
    force = mean_by_group(samples["force_N"].to_numpy(), flat, size, count)
    steady = mean_by_group(samples["steady"].to_numpy(float), flat, size, count)
    owner = np.repeat(np.arange(len(strokes)), cells[run])
    force, steady = _bridged(force, steady, owner)
    cell = np.arange(size) - offset[owner]
    known = np.isfinite(force)
    travel = _travel(cell, known, owner, strokes["direction"].to_numpy())
    owner, cell, force, steady = owner[known], cell[known], force[known], steady[known]
    first_spot = np.concatenate(([0], np.cumsum(cells)))  # of each run in one flat array of the cells of all runs
    spot, spots = first_spot[run[owner]] + cell, int(first_spot[-1])
    keep = _comparable(spot, spots, steady, travel)
    owner, spot, force, steady = owner[keep], spot[keep], force[keep], steady[keep]
    strokes_there = np.bincount(spot, minlength=spots)
    spot, force, steady = _one_per_file(spot, pd.factorize(strokes["file"])[0][owner], force, steady)
    files = np.bincount(spot, minlength=spots)
    mean = mean_by_group(force, spot, spots, files)
    square = np.bincount(spot, (force - mean[spot]) ** 2, minlength=spots)
    error = np.sqrt(np.divide(square, (files - 1.0) * files, out=np.full(spots, np.nan), where=files > 1))
    lowest = _extreme(np.minimum, np.inf, spot, spots, steady)
    shown = np.flatnonzero(files)
    of = np.searchsorted(first_spot, shown, side="right") - 1
    first = strokes.iloc[np.unique(run, return_index=True)[1]]
    return pd.DataFrame(
        {
            "run_id": first["run_id"].to_numpy()[of],
            "direction": first["direction"].to_numpy()[of],
            "condition": first["condition"].to_numpy()[of],
            "displacement_mm": low[of] + (shown - first_spot[of] + 0.5) * step[of],
            "force_N": mean[shown],
            "force_se_N": error[shown],
            "n": strokes_there[shown],
            "steady": lowest[shown] >= 1.0,
        }
    )


def _extreme(ufunc: np.ufunc, start: float, group: np.ndarray, groups: int, values: np.ndarray) -> np.ndarray:
    """Return the least or largest value of each group, shape (groups,); `start` for none."""
    found = np.full(groups, start)
    ufunc.at(found, group, values)
    return found


def _one_per_file(
    spot: np.ndarray, file: np.ndarray, force: np.ndarray, steady: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return place, mean force and whether all is steady, once for every file at every place."""
    pair, own, count = np.unique(spot * (int(file.max(initial=0)) + 1) + file, return_inverse=True, return_counts=True)
    if len(pair) == len(spot):
        return spot, force, steady
    place = np.zeros(len(pair), int)
    place[own] = spot
    return (
        place,
        mean_by_group(force, own, len(pair), count),
        _extreme(np.minimum, np.inf, own, len(pair), steady),
    )


def _travel(cell: np.ndarray, known: np.ndarray, owner: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Return how many cells each known cell lies behind its stroke's start, along the motion."""
    first, last = np.full(len(direction), np.iinfo(int).max), np.full(len(direction), -1)
    np.minimum.at(first, owner[known], cell[known])
    np.maximum.at(last, owner[known], cell[known])
    own = owner[known]
    return np.where(direction[own] > 0, cell[known] - first[own], last[own] - cell[known])


def _comparable(spot: np.ndarray, spots: int, steady: np.ndarray, travel: np.ndarray) -> np.ndarray:
    """Return which cells of which strokes may be averaged with the others at the same place (`spot`) of their run.

    Repeats need not start at the same place: where one slides steadily, another may just be starting, and its
    pre-sliding rise would be a dip in the mean. So steady strokes are averaged where there are any, and elsewhere those
    that have come equally far from their own start.
    """
    somewhere = np.bincount(spot, steady >= 1.0, minlength=spots) > 0
    furthest = _extreme(np.maximum, -np.inf, spot, spots, travel)
    return np.where(somewhere[spot], steady >= 1.0, travel >= furthest[spot] - SAME_TRAVEL)


def _grid(x: np.ndarray, row: np.ndarray, run: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return start, step and number of the cells of every run."""
    runs = int(run.max()) + 1
    low, high = np.full(runs, np.inf), np.full(runs, -np.inf)
    np.minimum.at(low, run[row], x)
    np.maximum.at(high, run[row], x)
    span = np.where(high > low, high - low, 1.0)
    start, stop = np.full(len(run), np.inf), np.full(len(run), -np.inf)
    np.minimum.at(start, row, x)
    np.maximum.at(stop, row, x)
    count = np.bincount(row, minlength=len(run))
    usual = np.divide(stop - start, count - 1.0, out=np.zeros(len(run)), where=count > 1)
    widest = np.zeros(runs)
    np.maximum.at(widest, run[count > 1], usual[count > 1])
    step = np.maximum(np.where(widest > 0.0, widest, span), span / MAX_CELLS)
    cells = np.maximum(np.ceil(span / step * (1.0 - 1e-9)), 1).astype(int)
    return np.where(np.isfinite(low), low, 0.0), span / cells, cells


def _bridged(force: np.ndarray, steady: np.ndarray, owner: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return force and steady flag with short runs of empty cells of a stroke filled along a straight line."""
    places, full = np.arange(len(force)), np.isfinite(force)
    before = np.maximum.accumulate(np.where(full, places, -1))
    after = np.minimum.accumulate(np.where(full, places, len(force))[::-1])[::-1]
    empty = np.flatnonzero(~full & (before >= 0) & (after < len(force)))
    left, right = before[empty], after[empty]
    fill = (owner[left] == owner[right]) & (right - left - 1 <= BRIDGED)
    empty, left, right = empty[fill], left[fill], right[fill]
    share = (empty - left) / (right - left)
    force, steady = force.copy(), steady.copy()
    force[empty] = (1.0 - share) * force[left] + share * force[right]
    steady[empty] = np.minimum(steady[left], steady[right])
    return force, steady
