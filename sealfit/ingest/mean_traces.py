"""Means of traces over the repeats of a run, on cells of displacement."""

from __future__ import annotations

import numpy as np

from sealfit.ingest.average import Samples, Strokes, mean_by_group, owners, range_of_runs
from sealfit.ingest.pieces import Pieces, numbered

MAX_CELLS = 2000  # per run, in traces_mean: finer than any screen shows
SAME_TRAVEL = 2  # cells by which strokes that are averaged before they slide steadily may differ in travel
BRIDGED = 3  # empty cells in a row that are filled by a straight line: scarce samples, not a gap


def mean_traces(samples: Samples, strokes: Strokes) -> dict[str, np.ndarray]:
    """Return the mean over repeats on a displacement grid that the repeats of a run share.

    Cells are as wide as the usual step between samples, so the pre-sliding rise keeps its shape. The strokes of one
    file are averaged first; mean and standard error are then those of the files of the run, each weighing the same.

    Parameters
    ----------
    samples : mapping of str to ndarray, shape (n,)
        Samples of sliding, stroke after stroke, at least one: `row` (place in `strokes`), displacement_mm, force_N,
        steady.
    strokes : mapping of str to sequence, one value per stroke
        file, run_id, direction.

    Returns
    -------
    dict of str to ndarray
        What table `traces_mean` holds of numbers, and `row`, the first stroke of the run.
    """
    row, own = owners(samples["row"])
    (run, runs), (file, files) = (numbered([strokes[name][i] for i in row.tolist()]) for name in ("run_id", "file"))
    back = np.asarray(strokes["direction"])[row] < 0
    low, step, cells = _grid(np.asarray(samples["displacement_mm"]), own, run, runs)
    grid, places = Pieces(cells[run]), Pieces(cells)  # the cells of every stroke, and of every run, end to end
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
    error = np.sqrt(np.divide(square, (count - 1.0) * count, out=np.full(places.rows, np.nan), where=count > 1))
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


def _grid(x: np.ndarray, own: Pieces, run: np.ndarray, runs: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
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
    """Return the mean force in every cell of every stroke, NaN in empty ones, and whether all samples are steady."""
    x = np.asarray(samples["displacement_mm"])
    cell = ((x - own.spread(low)) / own.spread(step)).astype(int)
    np.minimum(cell, own.spread(grid.size - 1), out=cell)
    cell += own.spread(grid.start)
    force = mean_by_group(np.asarray(samples["force_N"]), cell, grid.rows, np.bincount(cell, minlength=grid.rows))
    unsteady = cell[~np.asarray(samples["steady"], bool)]
    return force, np.bincount(unsteady, minlength=grid.rows) == 0


def _bridged(force: np.ndarray, steady: np.ndarray, grid: Pieces) -> tuple[np.ndarray, np.ndarray]:
    """Return force and steady flag with short runs of empty cells of a stroke filled along a straight line."""
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


def _comparable(spot: np.ndarray, spots: int, steady: np.ndarray, travel: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return which cells of which strokes may be averaged with the others at the same place (`spot`) of their run, and
    the places where these are steady.

    Repeats need not start at the same place: where one slides steadily, another may just be starting, and its
    pre-sliding rise would be a dip in the mean. So steady strokes are averaged where there are any, and elsewhere those
    that have come equally far from their own start.
    """
    somewhere = np.bincount(spot[steady], minlength=spots) > 0
    keep = steady.copy()
    others = np.flatnonzero(~somewhere[spot])
    furthest = np.zeros(spots, int)
    np.maximum.at(furthest, spot[others], travel[others])
    keep[others] = travel[others] >= furthest[spot[others]] - SAME_TRAVEL
    return keep, somewhere


def _one_per_file(spot: np.ndarray, file: np.ndarray, files: int, force: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return place and mean force once for every file at every place."""
    pair, own, count = np.unique(spot * files + file, return_inverse=True, return_counts=True)
    if len(pair) == len(spot):
        return spot, force
    place = np.zeros(len(pair), int)
    place[own] = spot
    return place, mean_by_group(force, own, len(pair), count)
