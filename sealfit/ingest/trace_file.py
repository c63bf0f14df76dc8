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


@dataclass(frozen=True, slots=True, eq=False)
class FileStrokes:
    """What one file gives: its fingerprint, findings, a row per stroke, and its samples as columns of equal length."""

    file: str
    mark: Fingerprint
    rows: int
    faults: tuple[Fault, ...]
    strokes: tuple[Mapping[str, object], ...] = ()
    samples: Mapping[str, np.ndarray] | None = None


def read_files(refs: Sequence[TraceRef], campaign: Path, config: Config) -> list[FileStrokes]:
    """Return the strokes of several trace files, in order; without strokes where a file must be left out, and why.

    Parameters
    ----------
    refs : sequence of TraceRef
        The files, and what is known of each as a whole; all are held at once, so no more than memory has room for.
    campaign : Path
        Campaign folder.
    config : Config
        The rig.
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
    strokes = iter(strokes_of([trace for trace in found if isinstance(trace, Trace)], config))
    return [
        FileStrokes(ref.file, marks[i], 0, made.faults)
        if isinstance(made, BadFile)
        else FileStrokes(ref.file, marks[i], made.rows_read, *next(strokes))
        for i, (ref, made) in enumerate(zip(refs, found, strict=True))
    ]
