"""Means of traces over the steady window, over bins of displacement and over the repeats of a run."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import pairwise

import numpy as np
import pandas as pd

from sealfit.config import Bins

# ---------------------------------------------------------------- average

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
    spectrum = np.fft.rfft(centred, 1 << (2 * n - 1).bit_length())  # padded so that no lag wraps around
    lagged = np.fft.irfft(spectrum * spectrum.conj())[:n]
    sums = 0.5 + np.concatenate(([0.0], np.cumsum(lagged[1:] / square)))
    inside = np.flatnonzero(np.arange(n) >= 5.0 * sums)
    tau = float(sums[inside[0]] if len(inside) else sums.max())  # the largest if the window never ends
    return math.sqrt(square / (n - 1) * max(2.0 * tau, 1.0) / n)


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


def _strokes_by_run(row: np.ndarray, run_id: Sequence[str]) -> list[list[tuple[int, slice]]]:
    """Return the strokes of each run and where their samples lie; `row` is each sample's stroke, rising."""
    edges = [*np.flatnonzero(np.diff(row, prepend=-1)).tolist(), len(row)]
    runs: dict[str, list[tuple[int, slice]]] = {}
    for start, stop in pairwise(edges):
        stroke = int(row[start])
        runs.setdefault(run_id[stroke], []).append((stroke, slice(start, stop)))
    return list(runs.values())


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

    Returns
    -------
    dict of str to ndarray
        `row`, `bin` (from 0 in the direction of motion), `n`, `force_sd_N`, and the mean of every column of
        `samples`.
    """
    row, x = samples["row"], np.asarray(samples["displacement_mm"])
    bins = np.zeros(len(row), int)
    for run in _strokes_by_run(row, strokes["run_id"]):
        low, high = min(x[own].min() for _, own in run), max(x[own].max() for _, own in run)
        typical = np.median([own.stop - own.start for _, own in run])
        # Half as many again as needed on average, since samples do not fall into bins evenly.
        count = int(np.clip(typical // np.ceil(1.5 * settings.min_samples), 1, settings.per_stroke))
        width = (high - low) / count if high > low else np.inf  # all in the first bin
        for stroke, own in run:
            place = np.minimum(((x[own] - low) / width).astype(int), count - 1)
            place = count - 1 - place if strokes["direction"][stroke] < 0 else place
            bins[own] = _joined(place, settings.min_samples)
    bin_of_stroke, group = np.unique(row * settings.per_stroke + bins, return_inverse=True)
    n = np.bincount(group)
    made = {"row": bin_of_stroke // settings.per_stroke, "bin": bin_of_stroke % settings.per_stroke, "n": n}
    for name in samples:
        values = np.asarray(samples[name])
        if name == "row":
            continue
        if values.dtype.kind in "fiub":
            made[name] = np.bincount(group, values) / n
        else:
            made[name] = common_by_group(values, group, len(n))
    square = np.bincount(group, (samples["force_N"] - made["force_N"][group]) ** 2)
    made["force_sd_N"] = np.sqrt(np.divide(square, n - 1.0, out=np.full(len(n), np.nan), where=n > 1))
    return made


def _joined(bins: np.ndarray, least: int) -> np.ndarray:
    """Return the bin of every sample of a stroke after thin bins joined their nearest neighbour."""
    count = np.bincount(bins)
    full = np.flatnonzero(count >= least)
    if not len(full):  # a stroke as short as that is one bin
        full = np.array([count.argmax()])
    target = np.arange(len(count))
    for thin in np.flatnonzero((count > 0) & (count < least)):
        target[thin] = full[np.abs(full - thin).argmin()]
    return target[bins]


# ---------------------------------------------------------------- mean traces

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
    names = ("displacement_mm", "force_N", "steady")
    x, force, steady = (np.asarray(samples[name]) for name in names)
    made = []
    for run in _strokes_by_run(samples["row"], strokes["run_id"]):
        low, step, cells = _grid([x[own] for _, own in run])
        each = [
            _of_cells(((x[own] - low) / step).astype(int), force[own], steady[own], cells) for _, own in run
        ]
        back = np.array([strokes["direction"][stroke] < 0 for stroke, _ in run])
        of_strokes, steady_cell = (np.array(values) for values in zip(*each, strict=True))
        keep = _comparable(np.isfinite(of_strokes), steady_cell, back)
        mean, error = _over_files(np.where(keep, of_strokes, 0.0), keep, [strokes["file"][i] for i, _ in run])
        shown = np.flatnonzero(keep.any(axis=0))
        made.append(
            {
                "row": np.full(len(shown), run[0][0]),
                "displacement_mm": low + (shown + 0.5) * step,
                "force_N": mean[shown],
                "force_se_N": error[shown],
                "n": keep.sum(axis=0)[shown],
                "steady": (keep & steady_cell).any(axis=0)[shown],
            }
        )
    return {name: np.concatenate([run[name] for run in made]) for name in made[0]}


def _grid(places: Sequence[np.ndarray]) -> tuple[float, float, int]:
    """Return start, step and number of the cells of a run, from the displacements of its strokes."""
    low, high = min(x.min() for x in places), max(x.max() for x in places)
    span = high - low if high > low else 1.0
    widest = max((x.max() - x.min()) / max(len(x) - 1.0, 1.0) for x in places)
    step = max(widest if widest > 0.0 else span, span / MAX_CELLS)
    cells = max(math.ceil(span / step * (1.0 - 1e-9)), 1)
    return low, span / cells, cells


def _of_cells(
    cell: np.ndarray, force: np.ndarray, steady: np.ndarray, cells: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return a stroke's mean force in each cell, NaN if empty, and whether all samples there are steady.

    Short runs of empty cells are filled along a straight line.
    """
    cell = np.minimum(cell, cells - 1)
    count = np.bincount(cell, minlength=cells)
    with np.errstate(invalid="ignore"):
        mean = np.bincount(cell, force, cells) / count
    all_steady = np.bincount(cell[~steady], minlength=cells) == 0
    full = np.flatnonzero(count)
    missing = np.diff(full) - 1
    short = np.flatnonzero((missing > 0) & (missing <= BRIDGED))
    for left, right in zip(full[short], full[short + 1], strict=True):
        empty = np.arange(left + 1, right)
        share = (empty - left) / (right - left)
        mean[empty] = (1.0 - share) * mean[left] + share * mean[right]
        all_steady[empty] = all_steady[left] & all_steady[right]
    return mean, all_steady


def _comparable(known: np.ndarray, steady: np.ndarray, back: np.ndarray) -> np.ndarray:
    """Return which cells of strokes may be averaged with others at their place, shape (strokes, cells).

    Repeats need not start at the same place: where one slides steadily, another may just be starting, and its
    pre-sliding rise would be a dip in the mean. So steady strokes are averaged where there are any, and
    elsewhere those that have come equally far from their own start.
    """
    cell = np.arange(known.shape[1])
    first, last = known.argmax(axis=1), len(cell) - 1 - known[:, ::-1].argmax(axis=1)
    travel = np.where(back[:, None], last[:, None] - cell, cell - first[:, None])
    sliding = known & steady
    others = known & ~sliding.any(axis=0)
    furthest = np.where(others, travel, 0).max(axis=0)
    return sliding | (others & (travel >= furthest - SAME_TRAVEL))


def _over_files(force: np.ndarray, keep: np.ndarray, file: Sequence[str]) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and standard error of the force in each cell over files, each the mean of its strokes."""
    names, code = np.unique(file, return_inverse=True)
    if len(names) < len(file):
        count = np.array([keep[code == i].sum(axis=0) for i in range(len(names))])
        total = np.array([force[code == i].sum(axis=0) for i in range(len(names))])
        force, keep = total / np.maximum(count, 1), count > 0
    n = keep.sum(axis=0)
    mean = force.sum(axis=0) / np.maximum(n, 1)
    square = np.where(keep, (force - mean) ** 2, 0.0).sum(axis=0)
    error = np.divide(square, (n - 1.0) * n, out=np.full(len(n), np.nan), where=n > 1)
    return mean, np.sqrt(error)
