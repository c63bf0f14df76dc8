"""What a SPEC says: rubber, rig, design, effects and scatter, checked on load; and the files it plans."""

import re
from datetime import datetime, timedelta
from itertools import product
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import pandas as pd
from pydantic import Field, model_validator

from sealfit.config import Strict, parse_toml, read_toml
from sealfit.effects.free import LEVELS
from sealfit.errors import ConfigError
from sealfit.ingest.columns import RESERVED, SLOTS
from sealfit.ingest.expression import parse
from sealfit.simulation.model import CONDITIONS, EffectEntry, Physics, resolve_effects
from sealfit.simulation.noise import Channel, Noise

STEADY_LENGTHS = 9.0  # of the rise, after which the force has reached 1 - exp(-9) = 0.9999 of its limit

Positive = Annotated[float, Field(gt=0)]


class Design(Strict):
    """The runs of a campaign, the rig, and the order of tests."""

    temperatures_C: tuple[float, ...] = Field((60.0,), description="empty: no such column")
    compressions_pct: tuple[Positive, ...] = Field((80.0,), description="empty: no such column")
    days: tuple[Positive, ...] = Field((1.0, 2.0, 4.0, 8.0), description="days of the aged rubber")
    unaged: bool = Field(True, description="unaged rubber too, as day 0; false and no days: no such column")
    unaged_temperature_C: float = 23.0
    unaged_compression_pct: float = Field(100.0, gt=0)
    loads_N: tuple[Positive, ...] = Field((49.03,), description="empty: no such column")
    speeds_mm_s: tuple[Positive, ...] = Field((0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 50.0), min_length=1)
    directions: tuple[Literal[1, -1], ...] = Field((1,), min_length=1, max_length=2)
    strokes_per_file: int = Field(1, ge=1, description="more than one: strokes both ways in every file")
    repeats: int = Field(3, ge=1)
    specimens: int = Field(1, ge=1, description="pieces of rubber per condition, each with all runs")
    stroke_mm: float = Field(40.0, gt=0)
    start_mm: float = Field(0.0, description="where the stroke begins in the rig's coordinate")
    start_scatter_mm: float = Field(0.0, ge=0, description="SD per file of where the stroke begins")
    sampling_Hz: float = Field(1000.0, gt=0, description="slower where a file would have more than max_rows")
    max_rows: int = Field(1000, ge=40)
    # Ramps and rests last at most a tenth of the sliding time.
    ramp_s: float = Field(0.2, ge=0, description="speed ramp at start and stop")
    dwell_s: float = Field(0.5, ge=0, description="rest before every stroke")
    # calendar: day by day as the rubber ages, runs of a day at random; randomised: all runs at random;
    # listed: as written here; undated: no started_at.
    order: Literal["calendar", "randomised", "listed", "undated"] = "calendar"
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
    def both_ways(self) -> bool:
        """Whether every file has strokes in both directions."""
        return self.strokes_per_file > 1

    @property
    def columns(self) -> list[str]:
        """The condition columns and load that runs.csv has."""
        values = (self.temperatures_C, self.compressions_pct, self.aging, self.loads_N)
        return [name for name, there in zip((*CONDITIONS, "load_N"), values, strict=True) if there]

    @model_validator(mode="after")
    def _holds_together(self) -> "Design":
        for name in ("temperatures_C", "compressions_pct", "days", "loads_N", "speeds_mm_s", "directions"):
            values = getattr(self, name)
            if len(set(values)) != len(values):
                raise ValueError(f"{name} names a value twice")
        if self.both_ways and len(self.directions) < 2:
            raise ValueError("strokes_per_file above 1 needs directions = [1, -1]: strokes go both ways")
        if self.max_rows < 40 * self.strokes_per_file:
            raise ValueError(f"max_rows must be at least {40 * self.strokes_per_file}: 40 per stroke")
        fastest = self.stroke_mm / max(self.speeds_mm_s) * self.sampling_Hz
        if fastest < 40:
            few = f"only {fastest:.0f} samples in the fastest stroke"
            raise ValueError(f"{few}: raise sampling_Hz or stroke_mm")
        return self


def plan_files(design: Design, random: np.random.Generator) -> pd.DataFrame:
    """Return one row per trace file, sorted as runs.csv lists them; `random` gives the order of the runs.

    The columns are those of runs.csv without channels, and `condition`, `direction`, `run_order` (from 1) and
    `elapsed_h`. A run's repeats follow each other. Columns that the design does not have are missing.
    """
    ways = design.directions[:1] if design.both_ways else design.directions
    rows = []
    for state, specimen in product(_conditions(design), range(1, design.specimens + 1)):
        temperature, compression, days = state
        parts = [f"{days:g}d" if days else "unaged"] if days is not None else []
        if days != 0:
            parts += [f"{temperature:g}C"] if temperature is not None else []
            parts += [f"{compression:g}pct"] if compression is not None else []
        condition = "_".join(parts) or "rubber"
        specimen_id = f"{condition}_s{specimen}"
        for load, speed, direction in product(design.loads_N or (None,), design.speeds_mm_s, ways):
            words = [specimen_id if design.specimens > 1 else condition]
            words += [f"{load:g}N"] if len(design.loads_N) > 1 else []
            words += [f"{speed:g}mms"]
            words += [{1: "fwd", -1: "back"}[direction]] if len(ways) > 1 else []
            run_id = "_".join(words)
            for repeat in range(1, design.repeats + 1):
                file = f"traces/{run_id}_r{repeat}.csv"
                rows.append((file, run_id, repeat, specimen_id, *state, load, speed, condition, direction))
    of_run = ("file", "run_id", "repeat", "specimen_id", *CONDITIONS, "load_N", "speed_mm_s")
    files = pd.DataFrame(rows, columns=[*of_run, "condition", "direction"])
    files = files.drop(columns=[name for name in (*CONDITIONS, "load_N") if name not in design.columns])
    return _dated(files, design, random) if design.dated else files


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
    if design.order != "listed":
        runs = random.permutation(runs)
    place = {run: number for number, run in enumerate(runs)}
    by_days = design.order == "calendar" and "aging_days" in files
    block = files["aging_days"].to_numpy() if by_days else np.zeros(len(files))
    order = np.lexsort([files["repeat"], files["run_id"].map(place), block])
    minutes, elapsed = 0.0, np.zeros(len(files))
    for index in order:
        # a day's tests wait for the rubber, and for the rig
        minutes = max(minutes, 24 * 60 * float(block[index]))
        elapsed[index] = minutes / 60
        minutes += design.minutes_per_file
    elapsed -= elapsed.min()
    run_order = np.empty(len(files))
    run_order[order] = np.arange(1, len(files) + 1)
    seconds = np.round(elapsed * 3600).astype(int)  # started_at is written to the second
    times = (design.first_start + timedelta(seconds=s) for s in seconds.tolist())
    started = [time.isoformat(timespec="seconds") for time in times]
    return files.assign(started_at=started, run_order=run_order, elapsed_h=seconds / 3600)


NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*")
TAKEN = {*SLOTS, *RESERVED, *CONDITIONS, "pi"}  # of traces, of tables, and of formulas


class Spec(Strict):
    """One simulated campaign."""

    name: str = ""
    seed: int = Field(1, ge=0)
    physics: Physics = Physics()
    design: Design = Design()
    effects: tuple[EffectEntry, ...] = ()
    channels: tuple[Channel, ...] = ()
    noise: tuple[Noise, ...] = ()
    force_decimals: int = Field(4, ge=0, le=12, description="digits with which the force is written")

    @property
    def channel_names(self) -> tuple[str, ...]:
        """Every channel that an effect may read, in the names of sealfit's tables."""
        dated = ["run_order", "elapsed_h"] if self.design.dated else []
        along = ["time_s", "displacement_mm", "distance_mm", "speed_mm_s", "direction", "stroke"]
        own = [channel.name for channel in self.channels]
        return (*along, "repeat", "specimen_id", *self.design.columns, *dated, *own)

    @property
    def rise_mm(self) -> float:
        """Length of the longest rise from rest: load * mu / sigma_0 of the unaged rubber."""
        most = max(self.physics.mu_s.mu_0, self.physics.mu_c.mu_0) * max(self.design.loads_N, default=1.0)
        return most / self.physics.sigma_0

    @model_validator(mode="after")
    def _strokes_are_long_enough(self) -> "Spec":
        if self.design.stroke_mm < (least := 2.5 * STEADY_LENGTHS * self.rise_mm):
            short = f"stroke_mm {self.design.stroke_mm:g} is too short for a rise (load * mu / sigma_0)"
            fix = f"make it {np.ceil(least):g}, or raise physics.sigma_0"
            raise ValueError(f"{short} of {self.rise_mm:.3g} mm: {fix}")
        return self

    @model_validator(mode="after")
    def _names_are_free(self) -> "Spec":
        seen: set[str] = set()
        for channel in self.channels:
            name = channel.name
            if name in TAKEN or name in seen or not NAME.fullmatch(name):
                raise ValueError(f"channel name '{name}' is taken, given twice, or not letters, digits and _")
            seen.add(name)
            if channel.kind == "slow" and not self.design.dated:
                undated = "drifts with the calendar: design.order must not be undated"
                raise ValueError(f"channel '{name}' {undated}")
        labels = {c.name: c.labels for c in self.channels if c.kind == "category" and c.labels}
        for number, effect in enumerate(self.effects):
            place = f"effects.{number} ({effect.id})"
            if effect.id == LEVELS and (known := labels.get(effect.channels[0])):
                for category in effect.parameters:
                    if category not in known:
                        raise ValueError(f"{place}: '{category}' is no label of {effect.channels[0]}")
            read = parse(effect.formula).names - set(effect.parameters) if effect.formula is not None else ()
            for name in (*effect.channels, *sorted(read)):
                if name not in self.channel_names:
                    known = ", ".join(self.channel_names)
                    raise ValueError(f"{place}: there is no channel '{name}'; known are {known}")
        return self


def load_spec(path: Path) -> Spec:
    """Return the SPEC at `path`.

    ConfigError if the file is missing, is not TOML, has a key or value that is not allowed, or names an
    effect, parameter or channel that does not exist; one sentence per fault.
    """
    text = read_toml(path, "Check the path of SPEC.")
    spec = parse_toml(Spec, text, path, "sample_data/README.md lists every key.")
    try:
        resolve_effects(spec.effects)
    except ConfigError as error:
        raise ConfigError(error.message, file=path, fix=error.fix) from error
    return spec
