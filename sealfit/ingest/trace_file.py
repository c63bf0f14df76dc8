"""One trace file from the reader to its strokes, their means and its samples: the work that is done per file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from sealfit.config import Config
from sealfit.errors import BadFile, Fault
from sealfit.fingerprint import Fingerprint
from sealfit.ingest.average import standard_error
from sealfit.ingest.folder import Folder
from sealfit.ingest.quality import equal_neighbours, load_faults, speed_column_faults, stroke_faults
from sealfit.ingest.read import Trace, read_traces
from sealfit.ingest.refs import TraceRef
from sealfit.ingest.speed_unit import speed_factor
from sealfit.ingest.spikes import displacement_spikes, force_spikes
from sealfit.ingest.strokes import Stroke, find_strokes

OWN_SPEED = "speed_file_mm_s"  # what the reader calls a speed column of the trace itself


@dataclass(frozen=True, slots=True, eq=False)
class FileStrokes:
    """What one file gives: its fingerprint, findings, a row per stroke, and its samples as columns of equal length."""

    file: str
    mark: Fingerprint
    rows: int
    faults: tuple[Fault, ...]
    strokes: tuple[Mapping[str, object], ...] = ()
    samples: Mapping[str, np.ndarray] | None = None


def read_strokes(ref: TraceRef, campaign: Path, config: Config) -> FileStrokes:
    """Return the strokes of one trace file; without strokes where the file must be left out, and why.

    Parameters
    ----------
    ref : TraceRef
        The file, and what is known of it as a whole.
    campaign : Path
        Campaign folder.
    config : Config
        The rig.
    """
    (made,) = read_files([ref], campaign, config)
    return made


def read_files(refs: Sequence[TraceRef], campaign: Path, config: Config) -> list[FileStrokes]:
    """Return the strokes of several trace files in their order; what reading them in one go saves is its point.

    Parameters
    ----------
    refs : sequence of TraceRef
        Some dozens of files, as all are held at once; see `read_strokes` for the others.
    """
    folder = Folder(campaign)
    marks: dict[int, Fingerprint] = {}
    left: dict[int, BadFile] = {}
    contents: list[tuple[TraceRef, bytes]] = []
    for i, ref in enumerate(refs):
        try:
            raw, marks[i] = folder.read(ref.file)
            contents.append((ref, raw))
        except BadFile as error:
            marks[i], left[i] = folder.fingerprint(ref.file), error
    traces = iter(read_traces(contents, config))
    found = [left[i] if i in left else next(traces) for i in range(len(refs))]
    return [
        FileStrokes(ref.file, marks[i], 0, made.faults)
        if isinstance(made, BadFile)
        else strokes_of(made, marks[i], config)
        for i, (ref, made) in enumerate(zip(refs, found, strict=True))
    ]


def strokes_of(trace: Trace, mark: Fingerprint, config: Config) -> FileStrokes:
    """Return the strokes of one trace that was read."""
    file, quality = trace.ref.file, config.quality
    keep, found = displacement_spikes(file, trace.columns["displacement_mm"], trace.line, quality)
    faults = [*trace.faults, *found]
    columns, line = _where(trace.columns, trace.line, keep)
    slots = [columns[name] for name in ("time_s", "displacement_mm", "force_N")]
    strokes = find_strokes(*slots, config.strokes)
    keep, found = force_spikes(file, columns["force_N"], strokes, line, quality)
    faults += found
    if not keep.all():
        # Rows do not decide where a stroke begins: found again without the spikes, it is found at the same place.
        columns, line = _where(columns, line, keep)
        slots = [columns[name] for name in ("time_s", "displacement_mm", "force_N")]
        strokes = find_strokes(*slots, config.strokes)
    if not strokes:
        return FileStrokes(file, mark, trace.rows_read, (*faults, _no_motion(file, columns["displacement_mm"], config)))
    several = len(strokes) > 1
    rows, samples = [], _samples(columns, strokes)
    factor = speed_factor(config.units)
    for stroke in strokes:
        number = stroke.number if several else None
        found = stroke_faults(file, number, stroke, slots[0], slots[2], line, config)
        row = _stroke_row(trace.ref, stroke, samples, factor)
        row |= {"several": several, "used": not any(fault.action == "stroke left out" for fault in found)}
        if row["used"] and OWN_SPEED in columns:
            found += speed_column_faults(file, number, row["speed_mm_s"], row[OWN_SPEED], config)
        rows.append(row)
        faults += found
    declared = trace.ref.channels.get("load_N")
    if "load_N" in columns and isinstance(declared, int | float) and any(row["used"] for row in rows):
        measured = float(np.mean([row["load_N"] for row in rows if row["used"]]))
        faults += load_faults(file, measured, declared, config.units.unit("load"))
    return FileStrokes(file, mark, trace.rows_read, tuple(faults), tuple(rows), samples)


def _where(
    columns: Mapping[str, np.ndarray], line: np.ndarray, keep: np.ndarray
) -> tuple[Mapping[str, np.ndarray], np.ndarray]:
    if keep.all():
        return columns, line
    return {name: values[keep] for name, values in columns.items()}, line[keep]


def _no_motion(file: str, displacement: np.ndarray, config: Config) -> Fault:
    return Fault(
        "no_motion",
        f"nothing moves: displacement stays within {np.ptp(displacement):.3g} {config.units.unit('displacement')}.",
        file=file,
        column="displacement_mm",
        action="file left out",
        mend="Check the displacement column and its unit, or set strokes.min_travel_mm in the config.",
    )


def _samples(columns: Mapping[str, np.ndarray], strokes: list[Stroke]) -> dict[str, np.ndarray]:
    """Return the samples of a file with stroke, distance, and flags; time from the stroke's start if there are
    several."""
    time_s, displacement = columns["time_s"], columns["displacement_mm"]
    length = [stroke.stop - stroke.start for stroke in strokes]
    origin = np.repeat([stroke.origin for stroke in strokes], length)
    return {
        "stroke": np.repeat([stroke.number for stroke in strokes], length),
        "time_s": time_s - time_s[origin] if len(strokes) > 1 else time_s,
        "displacement_mm": displacement,
        "force_N": columns["force_N"],
        "steady": np.concatenate([stroke.steady for stroke in strokes]),
        "sliding": np.concatenate([stroke.sliding for stroke in strokes]),
        "distance_mm": np.abs(displacement - displacement[origin]),
        **{name: values for name, values in columns.items() if name not in ("time_s", "displacement_mm", "force_N")},
    }


def _stroke_row(ref: TraceRef, stroke: Stroke, samples: Mapping[str, np.ndarray], factor: float) -> dict[str, object]:
    """Return one stroke: what is known of its file, and the means over its steady window."""
    rows = stroke.rows
    means = {name: _middle(values[rows]) for name, values in samples.items() if name not in ("steady", "sliding")}
    force, place = samples["force_N"][rows], samples["displacement_mm"][rows]
    ends = (place[0], place[-1]) if len(rows) else (np.nan, np.nan)
    return {
        **ref.channels,
        **means,
        "file": ref.file,
        "stroke": stroke.number,
        "direction": stroke.direction,
        "speed_mm_s": factor * stroke.speed_mm_s,
        "force_sd_N": float(force.std(ddof=1)) if len(rows) > 1 else np.nan,
        "force_se_N": standard_error(force),
        "n": len(rows),
        "displacement_from_mm": float(ends[0]),
        "displacement_to_mm": float(ends[1]),
        "equal": equal_neighbours(force),
        "extreme": bool(
            len(rows) and np.abs(force).max() >= np.abs(samples["force_N"][stroke.start : stroke.stop]).max()
        ),
    }


def _middle(values: np.ndarray) -> float | str | None:
    """Return the mean of numbers, the most frequent of labels; null of nothing."""
    if values.dtype.kind in "fiub":
        return float(values.mean()) if len(values) else np.nan
    labels = pd.Series(values).mode()
    return labels.iloc[0] if len(labels) else None
