"""Scatter, noise and defects of a SPEC, and irrelevant channels: other columns that a laboratory records."""

from collections import Counter
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Annotated, Literal
from zlib import crc32

import numpy as np
import pandas as pd
from pydantic import Field, model_validator
from scipy.signal import lfilter

from sealfit.config import Expression, Strict
from sealfit.errors import ConfigError
from sealfit.ingest.expression import evaluate, parse

if TYPE_CHECKING:
    from sealfit.simulation.motion import Motion


def stream(seed: int, *purpose: str | int) -> np.random.Generator:
    """Return a generator for one purpose, e.g. `stream(seed, "white", 0, 12)` for the thirteenth file.

    A kind of noise or a channel that is added to a SPEC changes no other draw.
    """
    key = [crc32(part.encode("utf-8")) if isinstance(part, str) else part for part in purpose]
    return np.random.default_rng([seed, *key])


def remembering(kicks: np.ndarray, memory: float) -> np.ndarray:
    """Return unit noise with correlation `memory` of neighbours, from independent unit `kicks`, shape (n,).

    It is the exact discretisation of a stationary Ornstein-Uhlenbeck process at equal steps.
    """
    scaled = np.sqrt(1.0 - memory**2) * kicks
    scaled[0] = kicks[0]
    return lfilter([1.0], [1.0, -memory], scaled)


class White(Strict):
    """Independent noise on every sample."""

    kind: Literal["white"]
    sd_N: float = Field(ge=0)


class Autocorrelated(Strict):
    """Autocorrelated noise (Ornstein-Uhlenbeck; AR(1) for a length in samples)."""

    kind: Literal["autocorrelated"]
    sd_N: float = Field(ge=0)
    length: float = Field(gt=0, description="after which 1/e of the correlation is left")
    unit: Literal["samples", "s", "mm"] = "samples"


class Quantised(Strict):
    """The resolution of the force, which is rounded to multiples of it."""

    kind: Literal["quantised"]
    resolution_N: float = Field(gt=0)


class RandomGain(Strict):
    """A random factor on the friction of every file, or of every specimen."""

    kind: Literal["repeat_gain", "specimen"]
    sd_rel: float = Field(ge=0)


class RunSetup(Strict):
    """A random factor on friction and a random offset of the force of every run, common to its repeats."""

    kind: Literal["run_setup"]
    sd_rel: float = Field(0.0, ge=0)
    sd_N: float = Field(0.0, ge=0)


class Proportional(Strict):
    """Independent noise with a standard deviation proportional to the force."""

    kind: Literal["proportional"]
    sd_rel: float = Field(ge=0)


class DisplacementNoise(Strict):
    """Independent noise of the logged displacement."""

    kind: Literal["displacement"]
    sd_mm: float = Field(ge=0)


class SpeedScatter(Strict):
    """A random factor per file between the real and the commanded speed."""

    kind: Literal["speed"]
    sd_rel: float = Field(ge=0, lt=0.2)


class OutlierRepeats(Strict):
    """A random share of all files, with friction multiplied by 1 + size_rel."""

    kind: Literal["outlier_repeats"]
    share: float = Field(ge=0, le=1)
    size_rel: float = 0.3


class BadData(Strict):
    """Defects of files: a number of files of each kind, no file twice."""

    kind: Literal["bad_data"]
    missing_cells: int = Field(0, ge=0, description="2 % of the force cells are empty")
    spikes: int = Field(0, ge=0, description="three samples are ten times the largest force")
    gaps: int = Field(0, ge=0, description="a tenth of the rows is missing in one piece")
    saturated: int = Field(0, ge=0, description="the force is cut at 97 % of its median")
    reversed: int = Field(0, ge=0, description="the rows are in reverse order")


Noise = Annotated[
    White | Autocorrelated | Quantised | RandomGain | RunSetup | Proportional | DisplacementNoise
    | SpeedScatter | OutlierRepeats | BadData,
    Field(discriminator="kind"),
]  # fmt: skip


def draw_scatter(noise: Sequence[Noise], files: pd.DataFrame, seed: int) -> pd.DataFrame:
    """Return the scatter of `files`, their runs and specimens, a row per file.

    Columns: the `gain` of the friction, `offset_N` of the force, the real over the commanded `speed`, and
    whether the file is an `outlier`. Gains multiply each other.
    """
    n = len(files)
    gain, offset, speed, outlier = np.ones(n), np.zeros(n), np.ones(n), np.zeros(n, bool)
    for kind, random in _streams(noise, seed):
        match kind:
            case RandomGain():
                codes, groups = pd.factorize(files["file" if kind.kind == "repeat_gain" else "specimen_id"])
                gain *= 1.0 + kind.sd_rel * random.standard_normal(len(groups))[codes]
            case RunSetup():
                codes, runs = pd.factorize(files["run_id"])
                factor, shift = random.standard_normal((2, len(runs)))
                gain *= 1.0 + kind.sd_rel * factor[codes]
                offset += kind.sd_N * shift[codes]
            case SpeedScatter():
                speed *= 1.0 + kind.sd_rel * np.clip(random.standard_normal(n), -4.0, 4.0)
            case OutlierRepeats():
                chosen = random.random(n) < kind.share
                gain[chosen] *= 1.0 + kind.size_rel
                outlier |= chosen
    return pd.DataFrame({"gain": gain, "offset_N": offset, "speed": speed, "outlier": outlier})


def logged(
    noise: Sequence[Noise], force_N: np.ndarray, motion: "Motion", speed_mm_s: float, file: int, seed: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return force in N and displacement in mm as the sensors of one trace give them, shape (n,) each.

    `force_N` is without noise, shape (n,), at equal time steps. The magnitude of the speed turns a length of
    correlation in mm into one in s. Every `file`, by its number, has its own noise.
    """
    n = len(force_N)
    of_force, of_displacement = np.zeros(n), np.zeros(n)
    for kind, random in _streams(noise, seed, file):
        match kind:
            case White():
                of_force += kind.sd_N * random.standard_normal(n)
            case Proportional():
                of_force += kind.sd_rel * np.abs(force_N) * random.standard_normal(n)
            case Autocorrelated():
                second = motion.time_s[1] - motion.time_s[0]
                step = {"samples": 1.0, "s": second, "mm": second * speed_mm_s}[kind.unit]
                of_force += kind.sd_N * remembering(random.standard_normal(n), np.exp(-step / kind.length))
            case DisplacementNoise():
                of_displacement += kind.sd_mm * random.standard_normal(n)
    force = force_N + of_force
    for kind in noise:
        if isinstance(kind, Quantised):
            force = kind.resolution_N * np.round(force / kind.resolution_N)
    return force, motion.displacement_mm + of_displacement


def _streams(noise: Sequence[Noise], seed: int, *file: int) -> Iterator[tuple[Noise, np.random.Generator]]:
    """Yield every kind of noise with its generator, which its number among those of the kind names."""
    seen: Counter[str] = Counter()
    for kind in noise:
        yield kind, stream(seed, kind.kind, seen[kind.kind], *file)
        seen[kind.kind] += 1


DEFECTS = tuple(name for name in BadData.model_fields if name != "kind")
Columns = dict[str, np.ndarray]  # a trace's columns, each of shape (n,); NaN is written as an empty cell


def draw_defects(noise: Sequence[Noise], files: int, seed: int) -> dict[int, str]:
    """Return the defect of each file that has one; fewer than asked if there are not enough files."""
    bad = [kind for kind in noise if isinstance(kind, BadData)]
    wanted = [defect for kind in bad for defect in DEFECTS for _ in range(getattr(kind, defect))]
    order = stream(seed, "bad_data").permutation(files).tolist()
    return dict(zip(order, wanted, strict=False))


def spoil(columns: Columns, defect: str, random: np.random.Generator) -> Columns:
    """Return a trace's columns with one of `DEFECTS`."""
    force = columns["force_N"].copy()
    n = len(force)
    match defect:
        case "missing_cells":
            force[random.choice(n, size=max(1, n // 50), replace=False)] = np.nan
        case "spikes":
            force[random.choice(n, size=3, replace=False)] = 10.0 * force[np.argmax(np.abs(force))]
        case "gaps":
            first = int(n * random.uniform(0.4, 0.5))
            gap = slice(first, first + n // 10)
            return {name: np.delete(values, gap) for name, values in columns.items()}
        case "saturated":
            limit = 0.97 * np.median(np.abs(force))
            force = np.clip(force, -limit, limit)
        case "reversed":
            return {name: values[::-1] for name, values in columns.items()}
    return {**columns, "force_N": force}


Level = Literal["file", "run", "specimen", "condition"]
GROUPS = {"file": "file", "run": "run_id", "specimen": "specimen_id", "condition": "condition"}


class NumericChannel(Strict):
    """A random number for each group of a level."""

    kind: Literal["numeric"]
    name: str
    level: Level = "run"
    mean: float = 0.0
    sd: float = Field(1.0, ge=0)
    decimals: int = Field(4, ge=0, le=12)


class SlowChannel(Strict):
    """A number per file that varies slowly: an Ornstein-Uhlenbeck process with a daily sine added."""

    kind: Literal["slow"]
    name: str
    mean: float = 22.0
    sd: float = Field(1.0, ge=0)
    correlation_h: float = Field(24.0, gt=0)
    daily_amplitude: float = 0.0
    decimals: int = Field(2, ge=0, le=12)


class TraceChannel(Strict):
    """A number logged within the trace, with a correlation time `correlation_s`."""

    kind: Literal["trace"]
    name: str
    mean: float = 0.0
    sd: float = Field(1.0, ge=0)
    correlation_s: float = Field(1.0, gt=0)
    decimals: int = Field(4, ge=0, le=12)


class CategoryChannel(Strict):
    """A category per group of a level: random, in rotation, or unique to the group (a serial number)."""

    kind: Literal["category"]
    name: str
    level: Level = "run"
    labels: tuple[str, ...] = ()
    assignment: Literal["random", "balanced", "unique"] = "random"

    @model_validator(mode="after")
    def _has_labels(self) -> "CategoryChannel":
        if (self.assignment == "unique") == bool(self.labels):
            raise ValueError("give labels, or assignment = 'unique'")
        return self


class ConstantChannel(Strict):
    """A column with the same value everywhere."""

    kind: Literal["constant"]
    name: str
    value: float | str


class FormulaChannel(Strict):
    """A number per file, computed from other columns of runs.csv."""

    kind: Literal["formula"]
    name: str
    formula: Expression
    sd: float = Field(0.0, ge=0, description="white scatter per file")
    decimals: int = Field(4, ge=0, le=12)


Channel = Annotated[
    NumericChannel | SlowChannel | TraceChannel | CategoryChannel | ConstantChannel | FormulaChannel,
    Field(discriminator="kind"),
]


def add_channels(files: pd.DataFrame, channels: tuple[Channel, ...], seed: int) -> pd.DataFrame:
    """Return `files` with every channel that is logged once per file.

    Channels within the trace come from `trace_channel`. ConfigError if a formula does not give a number.
    """
    for channel in channels:
        random = stream(seed, "channel", channel.name)
        match channel:
            case NumericChannel():
                codes, groups = pd.factorize(files[GROUPS[channel.level]])
                drawn = channel.mean + channel.sd * random.standard_normal(len(groups))
                files = files.assign(**{channel.name: np.round(drawn, channel.decimals)[codes]})
            case SlowChannel():
                files = files.assign(**{channel.name: _slow(channel, files["elapsed_h"].to_numpy(), random)})
            case CategoryChannel():
                codes, groups = pd.factorize(files[GROUPS[channel.level]])
                files = files.assign(**{channel.name: _categories(channel, len(groups), random)[codes]})
            case ConstantChannel():
                files = files.assign(**{channel.name: channel.value})
            case FormulaChannel():
                files = files.assign(**{channel.name: _computed(channel, files, random)})
    return files


def trace_channel(channel: TraceChannel, time_s: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """Return a channel logged within one trace, shape (n,), at equal time steps."""
    step = time_s[1] - time_s[0]
    drawn = remembering(random.standard_normal(len(time_s)), np.exp(-step / channel.correlation_s))
    return np.round(channel.mean + channel.sd * drawn, channel.decimals)


def _slow(channel: SlowChannel, elapsed_h: np.ndarray, random: np.random.Generator) -> np.ndarray:
    order = np.argsort(elapsed_h, kind="stable")
    # Nothing is remembered before the first file.
    memory = np.exp(-np.diff(elapsed_h[order], prepend=-np.inf) / channel.correlation_h)
    walk, last = np.empty(len(elapsed_h)), 0.0
    for row, rho, kick in zip(order, memory, random.standard_normal(len(elapsed_h)), strict=True):
        walk[row] = last = rho * last + np.sqrt(1.0 - rho**2) * kick
    swing = channel.daily_amplitude * np.sin(2.0 * np.pi * elapsed_h / 24.0)
    return np.round(channel.mean + channel.sd * walk + swing, channel.decimals)


def _categories(channel: CategoryChannel, groups: int, random: np.random.Generator) -> np.ndarray:
    if channel.assignment == "unique":
        numbers, width = random.permutation(groups) + 1, len(str(groups))
        return np.array([f"{channel.name}-{number:0{width}d}" for number in numbers], dtype=object)
    labels = np.array(channel.labels, dtype=object)
    if channel.assignment == "balanced":
        return labels[random.permutation(groups) % len(labels)]
    return labels[random.integers(len(labels), size=groups)]


def _computed(channel: FormulaChannel, files: pd.DataFrame, random: np.random.Generator) -> np.ndarray:
    formula = parse(channel.formula)
    columns = {name: files[name].to_numpy() for name in sorted(formula.names) if name in files}
    values = np.broadcast_to(evaluate(formula, columns), (len(files),))
    if not np.isfinite(values).all():
        raise ConfigError(f"channel '{channel.name}': {channel.formula!r} is not a number for every file.")
    return np.round(values + channel.sd * random.standard_normal(len(files)), channel.decimals)
