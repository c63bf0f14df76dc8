"""Strokes of trace files and means: over steady windows, over bins of displacement and over repeats."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pandas as pd

from sealfit.config import MEASURED, Bins, Config
from sealfit.errors import BadFile, Fault
from sealfit.ingest.cells import Trace
from sealfit.ingest.columns import TraceRef
from sealfit.ingest.files import placed, read_marked
from sealfit.ingest.quality import beginnings, load_checks, rising_faults, speed_column_faults, stroke_faults
from sealfit.ingest.reader import parse_trace
from sealfit.ingest.strokes import Stroke, displacement_noise_mm, find_strokes, resolution_mm
from sealfit.ingest.trace_checks import displacement_spikes, force_spikes, motion_fault, speed_fault
from sealfit.ingest.window import acceleration
from sealfit.store.manifest import Fingerprint, fingerprint

Samples = Mapping[str, np.ndarray]  # columns of equal length
Strokes = Mapping[str, Sequence]

OWN_SPEED = "speed_file_mm_s"  # what the reader calls a speed column of the trace itself
ALONG = "speed_bin_mm_s"  # the speed at a sample, of which bins have the mean


def standard_error(values: np.ndarray) -> float:
    """Return the standard error of the mean of a series, counting in the correlation of neighbouring samples.

    SE = s sqrt(2 tau / n), with the autocorrelation time tau = 1/2 + sum of rho(k) over lags up to the first
    M that is at least 5 tau (Sokal's window). A trend or a ripple makes it larger; correlation that would
    make it smaller is not believed. Sokal 1997, Monte Carlo Methods in Statistical Mechanics, section 3,
    doi:10.1007/978-1-4899-0319-8_6; GUM 4.2.7.

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
    """Return the most frequent label in each group, shape (groups,); None for a group without one.

    Of equally frequent labels it is the first in alphabetical order.
    """
    codes, labels = pd.factorize(values, sort=True)
    known = codes >= 0
    pairs, count = np.unique(group[known] * max(len(labels), 1) + codes[known], return_counts=True)
    made = np.full(groups, None, object)
    order = np.lexsort((-pairs, count))  # the most frequent is written last
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

    All strokes of a run share the edges of their bins, which span the windows of all of them. A run has
    `per_stroke` bins, or fewer where its strokes have too few samples; bins that still hold less than
    `min_samples` are joined to their neighbours.

    `samples` are those of the steady windows, stroke after stroke, at least one: `row` (place in `strokes`),
    displacement_mm, force_N and further columns, numbers or labels; `strokes` have `run_id` and `direction`.
    Columns are `row`, `bin` (from 0 in the direction of motion), `n`, `force_sd_N`, and the mean, or the most
    frequent label, of every column of `samples`.
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
    for name in (name for name in samples if name != "row"):
        values = np.asarray(samples[name])
        numbers = values.dtype.kind in "fiub"
        made[name] = np.bincount(group, values) / n if numbers else common_by_group(values, group, len(n))
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
    of one file are averaged first; mean and standard error are those of the files, each weighing the same.

    `samples` are those of sliding, stroke after stroke, at least one: `row` (place in `strokes`),
    displacement_mm, force_N, steady; `strokes` have file, run_id and direction. Columns are those of table
    `traces_mean` with numbers, and `row`, the first stroke of the run.
    """
    x, force, steady = (np.asarray(samples[name]) for name in ("displacement_mm", "force_N", "steady"))
    made = []
    for run in _strokes_by_run(samples["row"], strokes["run_id"]):
        low, step, cells = _grid([x[own] for _, own in run])
        each = [_of_cells((x[own] - low) / step, force[own], steady[own], cells) for _, own in run]
        back = np.array([strokes["direction"][stroke] < 0 for stroke, _ in run])
        of_strokes, steady_cell = (np.array(values) for values in zip(*each, strict=True))
        keep = _comparable(np.isfinite(of_strokes), steady_cell, back)
        mean, error = _over_files(np.where(keep, of_strokes, 0.0), keep, [strokes["file"][i] for i, _ in run])
        shown = np.flatnonzero(keep.any(axis=0))
        row, place = np.full(len(shown), run[0][0]), low + (shown + 0.5) * step
        n, slides = keep.sum(axis=0), (keep & steady_cell).any(axis=0)
        made.append((row, place, mean[shown], error[shown], n[shown], slides[shown]))
    names = ("row", "displacement_mm", "force_N", "force_se_N", "n", "steady")
    return {name: np.concatenate(parts) for name, parts in zip(names, zip(*made, strict=True), strict=True)}


def _grid(places: Sequence[np.ndarray]) -> tuple[float, float, int]:
    """Return start, step and number of the cells of a run, from the displacements of its strokes."""
    low, high = min(x.min() for x in places), max(x.max() for x in places)
    span = high - low if high > low else 1.0
    widest = max((x.max() - x.min()) / max(len(x) - 1.0, 1.0) for x in places)
    step = max(widest if widest > 0.0 else span, span / MAX_CELLS)
    cells = max(math.ceil(span / step * (1.0 - 1e-9)), 1)
    return low, span / cells, cells


def _of_cells(
    place: np.ndarray, force: np.ndarray, steady: np.ndarray, cells: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return a stroke's mean force in each cell, NaN if empty, and whether all samples there are steady."""
    cell = np.minimum(place.astype(int), cells - 1)
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

    Where one slides steadily, another may just be starting. So steady strokes are averaged where there are
    any, and elsewhere those that have come equally far from their own start.
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


# ---------------------------------------------------------------- strokes of a file


@dataclass(frozen=True, slots=True, eq=False)
class FileStrokes:
    """What a file gives: fingerprint, findings, a row per stroke, and samples as columns of equal length."""

    file: str
    mark: Fingerprint
    rows: int
    faults: tuple[Fault, ...]
    strokes: tuple[Mapping[str, object], ...] = ()
    samples: Mapping[str, np.ndarray] | None = None


def read_strokes(ref: TraceRef, campaign: Path, config: Config) -> FileStrokes:
    """Return the strokes of a trace file; none where it must be left out, and why."""
    mark = None
    try:
        raw, mark = read_marked(campaign, ref.file)
        trace = parse_trace(raw, ref, config)
    except BadFile as error:
        return FileStrokes(ref.file, mark or fingerprint(campaign / ref.file), 0, error.faults)
    trace, strokes = with_strokes(trace, config)
    fault = motion_fault(trace, strokes, config)
    count, rows, samples = trace.rows_read, (), None
    if fault is None:
        fault = speed_fault(trace, strokes, config)
        count = 0 if fault is not None and fault.action == "file left out" else count
    faults = [*trace.faults, *([fault] if fault else [])]
    if fault is None or fault.action == "kept":
        samples = _samples(trace, strokes, config)
        rows, found = _stroke_rows(ref.file, trace, strokes, samples, config)
        faults += found
    return FileStrokes(ref.file, mark, count, placed(faults, ref.file), rows, samples)


def with_strokes(trace: Trace, config: Config) -> tuple[Trace, list[Stroke]]:
    """Return the trace without rows that are spikes, its displacement unwrapped, and its strokes."""
    displacement, turn = trace.columns["displacement_mm"], config.strokes.turn
    if turn is not None and np.ptp(displacement) <= turn:
        displacement = np.unwrap(displacement, period=turn)
        trace = trace.having({"displacement_mm": displacement})
    keep, faults = displacement_spikes(displacement, trace.line, config.quality)
    trace = _without_inertia(trace.where(keep).with_faults(faults), config.mass)
    strokes = find_strokes(*(trace.columns[name] for name in MEASURED), config.strokes)
    keep, faults = force_spikes(trace.columns["force_N"], strokes, trace.line, config.quality)
    trace = trace.where(keep).with_faults(faults)
    if not keep.all():
        strokes = find_strokes(*(trace.columns[name] for name in MEASURED), config.strokes)
    return trace, strokes


def _without_inertia(trace: Trace, mass: float) -> Trace:
    """Return the trace with the force less mass times acceleration of the measured displacement.

    Both count in the direction of rising displacement, as the force of friction does.
    """
    if not mass or len(trace.line) < 3:
        return trace
    time_s, displacement, force = (trace.columns[name] for name in MEASURED)
    noise, wanted = (displacement_noise_mm(values, order=4) for values in (displacement, force))
    noise = max(noise, resolution_mm(displacement) / math.sqrt(12.0))
    inertia = mass * acceleration(time_s, displacement, noise, wanted / mass)
    return trace.having({"force_N": force - inertia})


def _samples(trace: Trace, strokes: Sequence[Stroke], config: Config) -> dict[str, np.ndarray]:
    """Return the samples of a trace with stroke, distance and flags, time from the start of the motion."""
    time_s, displacement, force = (trace.columns[name] for name in MEASURED)
    first = int(trace.channels.get("stroke", 1))  # other files hold the strokes of the record before it
    size = [stroke.stop - stroke.start for stroke in strokes]
    origin = np.array([stroke.origin for stroke in strokes])
    since = time_s[origin] if len(strokes) > 1 else np.zeros(1)
    turn, turns = config.strokes.turn, np.zeros(len(strokes))  # where the turn of each stroke begins
    if turn is not None:
        middle = [np.median(displacement[stroke.start : stroke.stop]) for stroke in strokes]
        turns = turn * np.floor(np.array(middle) / turn)
    return {
        "stroke": np.repeat(np.arange(len(strokes)), size) + first,
        "time_s": time_s - np.repeat(since, size),
        "displacement_mm": displacement - np.repeat(turns, size),
        "force_N": force,
        "steady": np.concatenate([stroke.steady for stroke in strokes]),
        "sliding": np.concatenate([stroke.sliding for stroke in strokes]),
        "presliding_N": np.concatenate([stroke.presliding_N for stroke in strokes]),
        ALONG: config.units.speed_factor * np.concatenate([stroke.speed_along_mm_s for stroke in strokes]),
        "distance_mm": np.abs(displacement - np.repeat(displacement[origin], size)),
        **{name: values for name, values in trace.columns.items() if name not in MEASURED},
    }


def _stroke_rows(
    file: str, trace: Trace, strokes: Sequence[Stroke], samples: Mapping[str, np.ndarray], config: Config
) -> tuple[tuple[Mapping[str, object], ...], list[Fault]]:
    """Return a row for every stroke, and what was found in them."""
    several, unit = len(strokes) > 1, config.units.unit("force")
    rows, faults = [], []
    for number, stroke in enumerate(strokes, start=1):
        row = {**trace.channels, **_means(stroke, samples), "file": file}
        row |= {"stroke": int(samples["stroke"][stroke.start]), "direction": stroke.direction}
        row |= {"speed_mm_s": config.units.speed_factor * stroke.speed_mm_s}
        row |= {"rise_mm": stroke.rise_mm, "several": several, "several_speeds": stroke.several_speeds}
        found = stroke_faults(stroke, trace, config.quality)
        used = not any(fault.action == "stroke left out" for fault in found)
        if used:
            found += rising_faults(row["left"], row["force_N"], unit)
        if used and OWN_SPEED in row:
            found += speed_column_faults(row["speed_mm_s"], row[OWN_SPEED], config)
        rows.append({**row, "used": used})
        faults += [replace(fault, stroke=number if several else None) for fault in found]
    return tuple(rows), faults + load_checks(trace, rows, config)


def _means(stroke: Stroke, samples: Mapping[str, np.ndarray]) -> dict[str, object]:
    """Return the means of the samples of a stroke over its steady window, and what else is found there."""
    rows = stroke.rows
    names = [name for name in samples if name not in ("steady", "sliding", ALONG)]
    window = {name: samples[name][rows] for name in names}
    window["force_N"] = force = window["force_N"] - window["presliding_N"]
    place, n = window["displacement_mm"], len(rows)
    whole = slice(stroke.start, stroke.stop)
    size = np.abs(samples["force_N"][whole])
    return {name: _mean_or_label(values) for name, values in window.items()} | {
        "force_sd_N": float(force.std(ddof=1)) if n > 1 else np.nan,
        "force_se_N": standard_error(force),
        "n": n,
        "displacement_from_mm": float(place[0]) if n else np.nan,
        "displacement_to_mm": float(place[-1]) if n else np.nan,
        "left": float(window["presliding_N"][-1]) if n else np.nan,
        "equal": float(np.mean(np.diff(force) == 0.0)) if n > 1 else 0.0,  # to the one before
        "extreme": bool(n and size[stroke.steady].max() >= size.max()),
        **beginnings(samples["force_N"][whole], samples["displacement_mm"][whole]),
    }


def _mean_or_label(values: np.ndarray) -> float | str | None:
    """Return the mean of numbers, or the most frequent of labels; null of nothing."""
    if values.dtype.kind in "fiub":
        return float(values.mean()) if len(values) else np.nan
    return common_by_group(values, np.zeros(len(values), int), 1)[0]
