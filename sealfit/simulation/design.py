"""The design of a SPEC and the table of files that it plans, in the order in which they are measured."""

from __future__ import annotations

from datetime import datetime, timedelta
from itertools import product
from typing import Annotated, Literal

import numpy as np
import pandas as pd
from pydantic import Field, model_validator

from sealfit.simulation.strict import Strict

STEADY_LENGTHS = 9.0  # stiffness lengths after which 1 - exp(-9) = 0.9999 of the force has come up


class Design(Strict):
    """Which runs are made, on what rig, in what order."""

    temperatures_C: tuple[float, ...] = Field((60.0,), description="empty: no such column")
    compressions_pct: tuple[Annotated[float, Field(gt=0)], ...] = Field((80.0,), description="empty: no such column")
    days: tuple[Annotated[float, Field(gt=0)], ...] = Field((1.0, 2.0, 4.0, 8.0), description="days of the aged rubber")
    unaged: bool = Field(True, description="unaged rubber too, as day 0; false and no days: no such column")
    unaged_temperature_C: float = 23.0
    unaged_compression_pct: float = Field(100.0, gt=0)
    loads_N: tuple[Annotated[float, Field(gt=0)], ...] = Field((49.03,), description="empty: no such column")
    speeds_mm_s: tuple[Annotated[float, Field(gt=0)], ...] = Field(
        (0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 50.0), min_length=1
    )
    directions: tuple[Literal[1, -1], ...] = Field((1,), min_length=1, max_length=2)
    strokes_per_file: int = Field(1, ge=1, description="more than one: strokes both ways in every file")
    repeats: int = Field(3, ge=1)
    specimens: int = Field(1, ge=1, description="pieces of rubber per condition, each with all runs")
    stroke_mm: float = Field(40.0, gt=0)
    start_mm: float = Field(0.0, description="where the stroke begins in the rig's coordinate")
    start_scatter_mm: float = Field(0.0, ge=0, description="SD per file of where the stroke begins")
    sampling_Hz: float = Field(1000.0, gt=0, description="slower where a file would have more than max_rows")
    max_rows: int = Field(1000, ge=40)
    stiffness_mm: float = Field(0.3, gt=0, description="length of the pre-sliding rise")
    ramp_s: float = Field(0.2, ge=0, description="speed ramp at start and stop; at most a tenth of the sliding time")
    dwell_s: float = Field(0.5, ge=0, description="rest before every stroke; at most a tenth of the sliding time")
    order: Literal["calendar", "randomised", "listed", "undated"] = Field(
        "calendar",
        description="calendar: day by day as the rubber ages, runs of a day at random; randomised: all runs at random; "
        "listed: as written here; undated: no started_at",
    )
    first_start: datetime = datetime(2024, 1, 8, 8, 0, 0)
    minutes_per_file: float = Field(4.0, gt=0)

    @property
    def dated(self) -> bool:
        """Whether runs.csv has started_at."""
        return self.order != "undated"

    @property
    def aging(self) -> bool:
        """Whether runs.csv has aging_days."""
        return self.unaged or bool(self.days)

    @property
    def columns(self) -> dict[str, bool]:
        """Which condition columns and load runs.csv has."""
        return {
            "temperature_C": bool(self.temperatures_C),
            "compression_ratio_pct": bool(self.compressions_pct),
            "aging_days": self.aging,
            "load_N": bool(self.loads_N),
        }

    @model_validator(mode="after")
    def _holds_together(self) -> Design:
        for name in ("temperatures_C", "compressions_pct", "days", "loads_N", "speeds_mm_s", "directions"):
            values = getattr(self, name)
            if len(set(values)) != len(values):
                raise ValueError(f"{name} names a value twice")
        if self.strokes_per_file > 1 and len(self.directions) < 2:
            raise ValueError("strokes_per_file above 1 needs directions = [1, -1]: strokes go both ways")
        if self.stroke_mm < 2.5 * STEADY_LENGTHS * self.stiffness_mm:
            raise ValueError(
                f"stroke_mm {self.stroke_mm:g} is too short for stiffness_mm {self.stiffness_mm:g}: "
                f"make it at least {2.5 * STEADY_LENGTHS * self.stiffness_mm:g}"
            )
        if self.max_rows < 40 * self.strokes_per_file:
            raise ValueError(f"max_rows must be at least {40 * self.strokes_per_file}: 40 per stroke")
        fastest = self.stroke_mm / max(self.speeds_mm_s) * self.sampling_Hz
        if fastest < 40:
            raise ValueError(f"only {fastest:.0f} samples in the fastest stroke: raise sampling_Hz or stroke_mm")
        return self


def plan_files(design: Design, random: np.random.Generator) -> pd.DataFrame:
    """Return one row per trace file, sorted as runs.csv lists them.

    Parameters
    ----------
    design : Design
        The SPEC's.
    random : Generator
        Gives the order of the runs.

    Returns
    -------
    DataFrame
        The columns of runs.csv without channels, and `condition`, `direction`, `run_order` (from 1) and `elapsed_h`.
        A run's repeats follow each other. Columns that the design does not have are missing.
    """
    rows = []
    for (temperature, compression, days), specimen in product(_conditions(design), range(1, design.specimens + 1)):
        parts = [f"{days:g}d" if days else "unaged"] if days is not None else []
        if days != 0:
            parts += [f"{temperature:g}C"] if temperature is not None else []
            parts += [f"{compression:g}pct"] if compression is not None else []
        condition = "_".join(parts) or "rubber"
        specimen_id = f"{condition}_s{specimen}"
        for load, speed, direction in product(design.loads_N or (None,), design.speeds_mm_s, _directions(design)):
            words = [specimen_id if design.specimens > 1 else condition]
            words += [f"{load:g}N"] if len(design.loads_N) > 1 else []
            words += [f"{speed:g}mms"]
            words += [{1: "fwd", -1: "back"}[direction]] if len(design.directions) > 1 and not _both(design) else []
            run_id = "_".join(words)
            for repeat in range(1, design.repeats + 1):
                rows.append(
                    {
                        "file": f"traces/{run_id}_r{repeat}.csv",
                        "run_id": run_id,
                        "repeat": repeat,
                        "specimen_id": specimen_id,
                        "temperature_C": temperature,
                        "compression_ratio_pct": compression,
                        "aging_days": days,
                        "load_N": load,
                        "speed_mm_s": speed,
                        "condition": condition,
                        "direction": direction,
                    }
                )
    files = pd.DataFrame(rows)
    files = files.drop(columns=[name for name, there in design.columns.items() if not there])
    return _dated(files, design, random) if design.dated else files


def _both(design: Design) -> bool:
    return design.strokes_per_file > 1


def _directions(design: Design) -> tuple[int, ...]:
    return design.directions[:1] if _both(design) else design.directions


def _conditions(design: Design) -> list[tuple[float | None, float | None, float | None]]:
    temperatures, compressions = design.temperatures_C or (None,), design.compressions_pct or (None,)
    if not design.aging:
        return [(t, c, None) for t, c in product(temperatures, compressions)]
    cold = design.unaged_temperature_C if design.temperatures_C else None
    free = design.unaged_compression_pct if design.compressions_pct else None
    unaged = [(cold, free, 0.0)] if design.unaged else []
    return unaged + [(t, c, d) for t, c, d in product(temperatures, compressions, design.days)]


def _dated(files: pd.DataFrame, design: Design, random: np.random.Generator) -> pd.DataFrame:
    """Return `files` with started_at, run_order and elapsed_h."""
    runs = files["run_id"].drop_duplicates().to_numpy()
    place = dict(zip(runs, range(len(runs)), strict=True))
    if design.order != "listed":
        place = dict(zip(random.permutation(runs).tolist(), range(len(runs)), strict=True))
    by_days = design.order == "calendar" and "aging_days" in files
    block = files["aging_days"].to_numpy() if by_days else np.zeros(len(files))
    order = np.lexsort([files["repeat"], files["run_id"].map(place), block])
    minutes, elapsed = 0.0, np.zeros(len(files))
    for index in order:
        minutes = max(minutes, 24 * 60 * float(block[index]))  # a day's tests wait for the rubber, and for the rig
        elapsed[index] = minutes / 60
        minutes += design.minutes_per_file
    elapsed -= elapsed.min()
    run_order = np.empty(len(files))
    run_order[order] = np.arange(1, len(files) + 1)
    seconds = np.round(elapsed * 3600).astype(int)  # started_at is written to the second
    started = [(design.first_start + timedelta(seconds=s)).isoformat(timespec="seconds") for s in seconds.tolist()]
    return files.assign(started_at=started, run_order=run_order, elapsed_h=seconds / 3600)
