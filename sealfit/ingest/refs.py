"""What is known of a trace file before it is read."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from sealfit.ingest.coded import Coded, Columns


@dataclass(frozen=True, slots=True)
class TraceRef:
    """One trace file and everything that runs.csv, its name, its header or its constant columns say of the whole file.

    `file` is relative to the campaign folder, with forward slashes. `channels` always holds `run_id`, `repeat`,
    `specimen_id` and the condition columns (day 0 may lack those other than the days), and where they are known
    `speed_set_mm_s` (magnitude), `load_N`, `started_at` (ISO 8601), `run_order`, `elapsed_h` and the campaign's own
    channels. What is not known is not there.
    """

    file: str
    channels: Mapping[str, float | str]


@dataclass(frozen=True, slots=True, eq=False)
class Listing(Sequence[TraceRef]):
    """The trace files of a campaign, or some of them, in order; column by column, as they are many.

    `columns` hold the channels; `conditions` the condition of each file in words.
    """

    files: list[str]
    columns: Columns
    conditions: Coded

    def __len__(self) -> int:
        return len(self.files)

    def __getitem__(self, i: int) -> TraceRef:
        known = ((name, column[i]) for name, column in self.columns.items())
        return TraceRef(self.files[i], {name: value for name, value in known if value is not None})

    def __iter__(self) -> Iterator[TraceRef]:
        cells = (column.cells() for column in self.columns.values())
        for file, *values in zip(self.files, *cells, strict=True):
            known = zip(self.columns, values, strict=True)
            yield TraceRef(file, {name: value for name, value in known if value is not None})

    def words(self) -> dict[str, np.ndarray]:
        """Return every column in words, shape (files,)."""
        return {name: column.words() for name, column in self.columns.items()}

    def take(self, files: np.ndarray) -> Listing:
        """Return some of the files, by their numbers, with the columns in which any of them has a value."""
        taken = {name: column.take(files) for name, column in self.columns.items()}
        filled = {name: column for name, column in taken.items() if column.values}
        return Listing([self.files[i] for i in files.tolist()], filled, self.conditions.take(files))
