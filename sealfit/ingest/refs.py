"""What is known of a trace file before it is read."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass


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
