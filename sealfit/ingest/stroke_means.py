"""Trace files to what is known of their strokes: which are of use, their means, and their samples."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd

from sealfit.config import Config
from sealfit.errors import BadFile, Fault
from sealfit.ingest.averages import standard_errors
from sealfit.ingest.file_names import TraceRef
from sealfit.ingest.files import Folder
from sealfit.ingest.quality import (
    equal_neighbours,
    load_faults,
    rising_faults,
    speed_column_faults,
    stroke_faults,
)
from sealfit.ingest.reader import Trace, read_traces
from sealfit.ingest.segments import Pieces
from sealfit.ingest.strokes import Found, displacement_noises_mm, find_all
from sealfit.ingest.trace_checks import (
    displacement_spikes,
    force_spikes,
    speed_factor,
)
from sealfit.store.manifest import Fingerprint

# ---------------------------------------------------------------- stroke means
# Traces to what is known of their strokes: which are of use, their means, and the samples with their place in them.

OWN_SPEED = "speed_file_mm_s"  # what the reader calls a speed column of the trace itself
ALONG = "speed_bin_mm_s"  # the speed at a sample, of which bins have the mean
BUNDLE_ROWS = 65_536  # traces computed at once: enough that numpy's calls cost little, few enough for the cache
SLOTS = ("time_s", "displacement_mm", "force_N")


class Made(NamedTuple):
    """What one trace gives: findings, a row per stroke, and its samples as columns of equal length."""

    faults: tuple[Fault, ...]
    strokes: tuple[Mapping[str, object], ...] = ()
    samples: Mapping[str, np.ndarray] | None = None


@dataclass(frozen=True, slots=True, eq=False)
class _Bundle:
    """Traces with the same columns, end to end: columns and `line` of shape (n,), and what was found in each trace."""

    refs: Sequence[TraceRef]
    columns: Mapping[str, np.ndarray]
    line: np.ndarray
    traces: Pieces
    faults: Sequence[list[Fault]]

    @classmethod
    def of(cls, traces: Sequence[Trace]) -> _Bundle:
        columns = {name: np.concatenate([trace.columns[name] for trace in traces]) for name in traces[0].columns}
        line = np.concatenate([trace.line for trace in traces])
        pieces = Pieces([len(trace.line) for trace in traces])
        return cls([trace.ref for trace in traces], columns, line, pieces, [list(trace.faults) for trace in traces])

    def slots(self) -> tuple[np.ndarray, ...]:
        return tuple(self.columns[name] for name in SLOTS)

    def where(self, keep: np.ndarray) -> _Bundle:
        """Return the bundle with some of its rows, at least one of every trace."""
        columns = {name: values[keep] for name, values in self.columns.items()}
        return _Bundle(self.refs, columns, self.line[keep], Pieces(self.traces.sum(keep)), self.faults)

    def only(self, chosen: Sequence[int]) -> _Bundle:
        """Return the bundle with some of its traces."""
        rows = np.concatenate([np.arange(own.start, own.stop) for own in (self.traces.slices[i] for i in chosen)])
        columns = {name: values[rows] for name, values in self.columns.items()}
        refs, faults = [self.refs[i] for i in chosen], [self.faults[i] for i in chosen]
        return _Bundle(refs, columns, self.line[rows], Pieces(self.traces.size[list(chosen)]), faults)


def strokes_of(traces: Sequence[Trace], config: Config) -> list[Made]:
    """Return the strokes of traces that were read, in their order; those that have the same columns in one go."""
    bundles: list[list[int]] = []
    open_: dict[tuple, tuple[list[int], int]] = {}  # the last bundle of each kind, and its rows
    for i, trace in enumerate(traces):
        kind = tuple((name, values.dtype.kind) for name, values in trace.columns.items())
        members, rows = open_.get(kind, ([], 0))
        if not members or rows + len(trace.line) > BUNDLE_ROWS:
            members, rows = [], 0
            bundles.append(members)
        members.append(i)
        open_[kind] = members, rows + len(trace.line)
    made: dict[int, Made] = {}
    for members in bundles:
        made.update(zip(members, _bundled(_Bundle.of([traces[i] for i in members]), config), strict=True))
    return [made[i] for i in range(len(traces))]


def _bundled(bundle: _Bundle, config: Config) -> list[Made]:
    bundle, noise = _without_displacement_spikes(bundle, config)
    found = find_all(*bundle.slots(), bundle.traces, config.strokes, noise)
    made: dict[int, Made] = {}
    force = bundle.columns["force_N"]
    for i, rows in enumerate(bundle.traces.slices):
        own = found.of_trace(i, rows.start)
        keep, faults = force_spikes(bundle.refs[i].file, force[rows], own, bundle.line[rows], config.quality)
        bundle.faults[i].extend(faults)
        if not keep.all():
            # Rows do not decide where a stroke begins: found again without the spikes, it is found at the same place.
            one = bundle.only([i]).where(keep)
            again = find_all(*one.slots(), one.traces, config.strokes)
            (made[i],) = _finished(one, again, config) if len(again.trace) else [_unmoved(one, 0, config)]
    moved = set(found.trace.tolist())
    made |= {i: _unmoved(bundle, i, config) for i in range(len(bundle.refs)) if i not in moved and i not in made}
    left = [i for i in range(len(bundle.refs)) if i not in made]
    if left and len(moved) < len(bundle.refs):
        bundle = bundle.only(left)
        found = find_all(*bundle.slots(), bundle.traces, config.strokes)
        made |= dict(zip(left, _finished(bundle, found, config), strict=True))
    elif left:
        made = dict(enumerate(_finished(bundle, found, config, set(made)))) | made
    return [made[i] for i in range(len(made))]


def _without_displacement_spikes(bundle: _Bundle, config: Config) -> tuple[_Bundle, np.ndarray]:
    """Return the bundle without rows whose displacement jumps away and back, and the displacement's noise."""
    displacement, traces = bundle.columns["displacement_mm"], bundle.traces
    noise = displacement_noises_mm(displacement, traces)
    keep = np.ones(traces.rows, bool)
    for i, rows in enumerate(traces.slices):
        file = bundle.refs[i].file
        keep[rows], faults = displacement_spikes(file, displacement[rows], bundle.line[rows], config.quality)
        bundle.faults[i].extend(faults)
    if keep.all():
        return bundle, noise
    bundle = bundle.where(keep)
    return bundle, displacement_noises_mm(bundle.columns["displacement_mm"], bundle.traces)


def _unmoved(bundle: _Bundle, i: int, config: Config) -> Made:
    """Return what is to be said of a trace without strokes."""
    span = np.ptp(bundle.columns["displacement_mm"][bundle.traces.slices[i]])
    fault = Fault(
        "no_motion",
        f"nothing moves: displacement stays within {span:.3g} {config.units.unit('displacement')}.",
        file=bundle.refs[i].file,
        column="displacement_mm",
        action="file left out",
        fix="Check the displacement column and its unit, or set strokes.min_travel_mm in the config.",
    )
    return Made((*bundle.faults[i], fault))


def _finished(bundle: _Bundle, found: Found, config: Config, skip: Sequence[int] | set[int] = ()) -> list[Made]:
    """Return the strokes of a bundle whose every trace has some; nothing is made of those in `skip`."""
    strokes, count = Pieces(found.stop - found.start), np.bincount(found.trace, minlength=len(bundle.refs))
    several = count > 1
    factor = speed_factor(config.units)
    samples = _samples(bundle.columns, found, strokes, several, factor)
    files = [bundle.refs[i].file for i in found.trace.tolist()]
    rows = _stroke_rows(samples, files, found, strokes, factor)
    time_s, _, force = bundle.slots()
    unit = config.units.unit("force")
    made, first = [], 0
    for i, own in enumerate(bundle.traces.slices):
        mine = range(first, first + int(count[i]))
        first = mine.stop
        if i in skip:
            made.append(Made(()))
            continue
        ref, faults, several_here = bundle.refs[i], bundle.faults[i], bool(several[i])
        before = int(ref.channels.get("stroke", 1)) - 1  # strokes of the record that other files hold
        for k in mine:
            number = int(found.number[k]) if several_here else None
            stroke = found.stroke(k, own.start)
            wrong = stroke_faults(ref.file, number, stroke, time_s[own], force[own], bundle.line[own], config)
            used = not any(fault.action == "stroke left out" for fault in wrong)
            row = rows[k] = {**ref.channels, **rows[k], "several": several_here, "used": used}
            row["stroke"] += before
            if used:
                wrong = wrong + rising_faults(ref.file, number, row["left"], row["force_N"], unit)
            if used and OWN_SPEED in row:
                wrong = wrong + speed_column_faults(ref.file, number, row["speed_mm_s"], row[OWN_SPEED], config)
            faults.extend(wrong)
        faults.extend(_load_faults(ref, bundle.columns, [rows[k] for k in mine], config))
        columns = {name: values[own] + before if name == "stroke" else values[own] for name, values in samples.items()}
        made.append(Made(tuple(faults), tuple(rows[k] for k in mine), columns))
    return made


def _load_faults(
    ref: TraceRef, columns: Mapping[str, np.ndarray], rows: Sequence[Mapping[str, object]], config: Config
) -> list[Fault]:
    """Return where the load measured in the strokes of use differs from the declared one."""
    declared = ref.channels.get("load_N")
    loads = [row["load_N"] for row in rows if row["used"]] if "load_N" in columns else []
    if not loads or not isinstance(declared, int | float):
        return []
    return load_faults(ref.file, float(np.mean(loads)), declared, config.units.unit("load"))


def _samples(
    columns: Mapping[str, np.ndarray], found: Found, strokes: Pieces, several: np.ndarray, factor: float
) -> dict[str, np.ndarray]:
    """Return the samples of traces with stroke, distance, and flags; time from the stroke's start if a trace has
    several."""
    time_s, displacement = columns["time_s"], columns["displacement_mm"]
    since = np.where(several[found.trace], time_s[found.origin], 0.0)
    return {
        "stroke": strokes.spread(found.number),
        "time_s": time_s - strokes.spread(since),
        "displacement_mm": displacement,
        "force_N": columns["force_N"],
        "steady": found.steady,
        "sliding": found.sliding,
        "presliding_N": found.presliding_N,
        ALONG: factor * found.speed_along_mm_s,
        "distance_mm": np.abs(displacement - strokes.spread(displacement[found.origin])),
        **{name: values for name, values in columns.items() if name not in SLOTS},
    }


def _stroke_rows(
    samples: Mapping[str, np.ndarray], files: list[str], found: Found, strokes: Pieces, factor: float
) -> list[dict[str, object]]:
    """Return what the samples say of every stroke: its means over its steady window, and what is found there."""
    count = strokes.sum(found.steady)
    some, rows = count > 0, np.flatnonzero(found.steady)
    windows = Pieces(count[some])

    def of_strokes(per_window: np.ndarray, missing: float = np.nan) -> list:
        made = np.full(len(strokes), missing, per_window.dtype)
        made[some] = per_window
        return made.tolist()

    force, place = (samples["force_N"] - samples["presliding_N"])[rows], samples["displacement_mm"][rows]
    columns: dict[str, list] = {"stroke": found.number.tolist()}
    for name, values in samples.items():
        if name in columns or name in ("steady", "sliding", ALONG):
            continue
        if values.dtype.kind in "fiub":
            columns[name] = of_strokes(windows.mean(force if name == "force_N" else values[rows]))
        else:
            own = values[rows]
            labels = [_most_frequent(own[slots]) for slots in windows.slices]
            columns[name] = of_strokes(np.array(labels, object), None)
    deviation = force - windows.spread(windows.mean(force))
    with np.errstate(invalid="ignore", divide="ignore"):
        sd = np.where(windows.size > 1, np.sqrt(windows.sum(deviation * deviation) / (windows.size - 1)), np.nan)
    size = np.abs(samples["force_N"])
    columns |= {
        "file": files,
        "direction": found.direction.tolist(),
        "speed_mm_s": (factor * found.speed_mm_s).tolist(),
        "force_sd_N": of_strokes(sd),
        "force_se_N": of_strokes(standard_errors(force, windows)),
        "n": count.tolist(),
        "displacement_from_mm": of_strokes(place[windows.start]),
        "displacement_to_mm": of_strokes(place[windows.stop - 1]),
        "left": of_strokes(samples["presliding_N"][rows][windows.stop - 1]),
        "equal": of_strokes(equal_neighbours(force, windows), 0.0),
        "extreme": of_strokes(windows.max(size[rows]) >= strokes.max(size)[some], False),
    }
    return [dict(zip(columns, values, strict=True)) for values in zip(*columns.values(), strict=True)]


def _most_frequent(labels: np.ndarray) -> str | None:
    """Return the most frequent of labels; null of nothing."""
    found = pd.Series(labels).mode()
    return found.iloc[0] if len(found) else None


# ---------------------------------------------------------------- trace file
# Trace files from the reader to their strokes, the means of these and their samples: what is done per file.

BATCH_BYTES = 4_000_000  # of files held at once, and hardly more: bounds the memory where files are long


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
    """Return the strokes of several trace files, in their order; those that are written alike are read in one go.

    What is returned does not depend on which files are read together, but for the last digit of sums.

    Parameters
    ----------
    refs : sequence of TraceRef
        Some 32 or 64 files; more gain nothing.
    campaign : Path
        Campaign folder.
    config : Config
        The rig.
    """
    folder = Folder(campaign)
    made: list[FileStrokes] = []
    batch: list[tuple[TraceRef, Fingerprint, bytes | BadFile]] = []
    held = 0
    for ref in refs:
        try:
            raw, mark = folder.read(ref.file)
            batch.append((ref, mark, raw))
            held += len(raw)
        except BadFile as error:
            batch.append((ref, folder.fingerprint(ref.file), error))
        if held > BATCH_BYTES:
            made += _strokes_of_batch(batch, config)
            batch, held = [], 0
    return made + _strokes_of_batch(batch, config)


def _strokes_of_batch(
    batch: Sequence[tuple[TraceRef, Fingerprint, bytes | BadFile]], config: Config
) -> list[FileStrokes]:
    read = iter(read_traces([(ref, raw) for ref, _, raw in batch if isinstance(raw, bytes)], config))
    found = [next(read) if isinstance(raw, bytes) else raw for _, _, raw in batch]
    strokes = iter(strokes_of([trace for trace in found if isinstance(trace, Trace)], config))
    return [
        FileStrokes(ref.file, mark, made.rows_read, *next(strokes))
        if isinstance(made, Trace)
        else FileStrokes(ref.file, mark, 0, made.faults)
        for (ref, mark, _), made in zip(batch, found, strict=True)
    ]
