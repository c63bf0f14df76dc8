"""Trace files to what is known of their strokes: which are of use, their means, and their samples."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pandas as pd

from sealfit.config import Config
from sealfit.errors import BadFile, Fault
from sealfit.ingest.averages import standard_error
from sealfit.ingest.file_names import TraceRef
from sealfit.ingest.files import bad_file, read_marked
from sealfit.ingest.quality import (
    equal_neighbours,
    load_faults,
    rising_faults,
    speed_column_faults,
    stroke_faults,
    swapped_faults,
)
from sealfit.ingest.reader import Trace, parse_trace
from sealfit.ingest.strokes import Stroke, displacement_noise_mm, find_strokes
from sealfit.ingest.trace_checks import displacement_spikes, force_spikes, speed_factor
from sealfit.ingest.window import acceleration
from sealfit.store.manifest import Fingerprint, fingerprint

OWN_SPEED = "speed_file_mm_s"  # what the reader calls a speed column of the trace itself
ALONG = "speed_bin_mm_s"  # the speed at a sample, of which bins have the mean
SLOTS = ("time_s", "displacement_mm", "force_N")


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
    return _file_strokes(trace, mark, config)


def _file_strokes(trace: Trace, mark: Fingerprint, config: Config) -> FileStrokes:
    file, rows_read = trace.ref.file, trace.rows_read
    trace, strokes = _with_strokes(trace, config)
    if not strokes:
        return FileStrokes(file, mark, rows_read, (*trace.faults, _unmoved(trace, config)))
    samples = _samples(trace, strokes, config)
    rows, faults = _stroke_rows(trace, strokes, samples, config)
    samples["stroke"] += _strokes_before(trace.ref)
    return FileStrokes(file, mark, rows_read, (*trace.faults, *faults), rows, samples)


def _with_strokes(trace: Trace, config: Config) -> tuple[Trace, list[Stroke]]:
    """Return the trace without rows that are spikes, and its strokes."""
    keep, faults = displacement_spikes(
        trace.ref.file, trace.columns["displacement_mm"], trace.line, config.quality
    )
    trace = _without_inertia(trace.where(keep, faults), config.mass)
    strokes = find_strokes(*(trace.columns[name] for name in SLOTS), config.strokes)
    keep, faults = force_spikes(trace.ref.file, trace.columns["force_N"], strokes, trace.line, config.quality)
    if keep.all():
        return replace(trace, faults=(*trace.faults, *faults)), strokes
    trace = trace.where(keep, faults)
    return trace, find_strokes(*(trace.columns[name] for name in SLOTS), config.strokes)


def _without_inertia(trace: Trace, mass: float) -> Trace:
    """Return the trace with the force less mass times acceleration of the measured displacement.

    Both count in the direction of rising displacement, as the force of friction does.
    """
    if not mass or len(trace.line) < 3:
        return trace
    time_s, displacement, force = (trace.columns[name] for name in SLOTS)
    noise, wanted = (displacement_noise_mm(values, order=4) for values in (displacement, force))
    inertia = mass * acceleration(time_s, displacement, noise, wanted / mass)
    return replace(trace, columns={**trace.columns, "force_N": force - inertia})


def _unmoved(trace: Trace, config: Config) -> Fault:
    """Return what is to be said of a trace without strokes."""
    span, unit = np.ptp(trace.columns["displacement_mm"]), config.units.unit("displacement")
    reason = f"nothing moves: displacement stays within {span:.3g} {unit}."
    fix = "Check the displacement column and its unit, or set strokes.min_travel_mm in the config."
    return bad_file(trace.ref.file, "no_motion", reason, fix, column="displacement_mm").fault


def _strokes_before(ref: TraceRef) -> int:
    """Return how many strokes of the record other files hold."""
    return int(ref.channels.get("stroke", 1)) - 1


def _samples(trace: Trace, strokes: Sequence[Stroke], config: Config) -> dict[str, np.ndarray]:
    """Return the samples of a trace with stroke, distance and flags.

    Time is counted from the start of the motion if there are several strokes.
    """
    time_s, displacement, force = (trace.columns[name] for name in SLOTS)
    size = [stroke.stop - stroke.start for stroke in strokes]
    origin = np.array([stroke.origin for stroke in strokes])
    since = time_s[origin] if len(strokes) > 1 else np.zeros(1)
    turn, turns = config.strokes.turn, np.zeros(len(strokes))  # where the turn of each stroke begins
    if turn is not None:
        middle = [np.median(displacement[stroke.start : stroke.stop]) for stroke in strokes]
        turns = turn * np.floor(np.array(middle) / turn)
    return {
        "stroke": np.repeat([stroke.number for stroke in strokes], size),
        "time_s": time_s - np.repeat(since, size),
        "displacement_mm": displacement - np.repeat(turns, size),
        "force_N": force,
        "steady": np.concatenate([stroke.steady for stroke in strokes]),
        "sliding": np.concatenate([stroke.sliding for stroke in strokes]),
        "presliding_N": np.concatenate([stroke.presliding_N for stroke in strokes]),
        ALONG: speed_factor(config.units) * np.concatenate([stroke.speed_along_mm_s for stroke in strokes]),
        "distance_mm": np.abs(displacement - np.repeat(displacement[origin], size)),
        **{name: values for name, values in trace.columns.items() if name not in SLOTS},
    }


def _stroke_rows(
    trace: Trace, strokes: Sequence[Stroke], samples: Mapping[str, np.ndarray], config: Config
) -> tuple[tuple[Mapping[str, object], ...], list[Fault]]:
    """Return a row for every stroke, and what was found in them."""
    ref, several, unit = trace.ref, len(strokes) > 1, config.units.unit("force")
    rows, faults = [], []
    for stroke in strokes:
        means = _means(stroke, samples)
        row = {**ref.channels, **means, "file": ref.file, "direction": stroke.direction}
        row["speed_mm_s"] = speed_factor(config.units) * stroke.speed_mm_s
        found = stroke_faults(
            stroke, trace.columns["time_s"], trace.columns["force_N"], trace.line, config.quality
        )
        used = not any(fault.action == "stroke left out" for fault in found)
        if used:
            found += rising_faults(row["left"], row["force_N"], unit)
        if used and OWN_SPEED in row:
            found += speed_column_faults(row["speed_mm_s"], row[OWN_SPEED], config)
        row |= {"several": several, "used": used, "stroke": stroke.number + _strokes_before(ref)}
        row["several_speeds"] = stroke.several_speeds
        rows.append(row)
        faults += [
            replace(fault, file=ref.file, stroke=stroke.number if several else None) for fault in found
        ]
    return tuple(rows), faults + _load_faults(trace, rows, config)


def _load_faults(trace: Trace, rows: Sequence[Mapping[str, object]], config: Config) -> list[Fault]:
    """Return where the load measured in the strokes of use differs from the declared one, or is no load."""
    declared = trace.ref.channels.get("load_N")
    loads = [row["load_N"] for row in rows if row["used"]] if "load_N" in trace.columns else []
    if not loads:
        return []
    found = swapped_faults(trace.columns["force_N"], trace.columns["load_N"], config)
    if isinstance(declared, int | float):
        found += load_faults(float(np.mean(loads)), declared, config.units.unit("load"))
    return [replace(fault, file=trace.ref.file) for fault in found]


def _means(stroke: Stroke, samples: Mapping[str, np.ndarray]) -> dict[str, object]:
    """Return the means of the samples of a stroke over its steady window, and what else is found there."""
    rows = stroke.rows
    window = {
        name: values[rows] for name, values in samples.items() if name not in ("steady", "sliding", ALONG)
    }
    window["force_N"] = force = window["force_N"] - window["presliding_N"]
    place, n = window["displacement_mm"], len(rows)
    size = np.abs(samples["force_N"][stroke.start : stroke.stop])
    return {name: _mean_or_label(values) for name, values in window.items()} | {
        "force_sd_N": float(force.std(ddof=1)) if n > 1 else np.nan,
        "force_se_N": standard_error(force),
        "n": n,
        "displacement_from_mm": float(place[0]) if n else np.nan,
        "displacement_to_mm": float(place[-1]) if n else np.nan,
        "left": float(window["presliding_N"][-1]) if n else np.nan,
        "equal": equal_neighbours(force),
        "extreme": bool(n and size[stroke.steady].max() >= size.max()),
    }


def _mean_or_label(values: np.ndarray) -> float | str | None:
    """Return the mean of numbers, or the most frequent of labels; null of nothing."""
    if values.dtype.kind in "fiub":
        return float(values.mean()) if len(values) else np.nan
    found = pd.Series(values).mode()
    return found.iloc[0] if len(found) else None
