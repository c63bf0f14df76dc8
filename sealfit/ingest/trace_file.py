"""Trace files from the reader to their strokes, the means of these and their samples: what is done per file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sealfit.config import Config
from sealfit.errors import BadFile, Fault
from sealfit.fingerprint import Fingerprint
from sealfit.ingest.folder import Folder
from sealfit.ingest.read import Trace, read_traces
from sealfit.ingest.refs import TraceRef
from sealfit.ingest.stroke_means import strokes_of

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
