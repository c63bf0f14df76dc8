"""Irrelevant channels: other columns that a laboratory records."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
import pandas as pd
from pydantic import Field, model_validator

from sealfit.config import Strict
from sealfit.errors import ConfigError
from sealfit.ingest.expression import evaluate, parse
from sealfit.simulation.noise import remembering, stream

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
    """A number per file that varies slowly, as a laboratory temperature.

    It is an Ornstein-Uhlenbeck process with a daily sine added.
    """

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
    def _has_labels(self) -> CategoryChannel:
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
    formula: str
    sd: float = Field(0.0, ge=0, description="white scatter per file")
    decimals: int = Field(4, ge=0, le=12)

    @model_validator(mode="after")
    def _is_safe(self) -> FormulaChannel:
        try:
            parse(self.formula)
        except ConfigError as error:
            raise ValueError(str(error)) from None
        return self


Channel = Annotated[
    NumericChannel | SlowChannel | TraceChannel | CategoryChannel | ConstantChannel | FormulaChannel,
    Field(discriminator="kind"),
]


def add_channels(files: pd.DataFrame, channels: tuple[Channel, ...], seed: int) -> pd.DataFrame:
    """Return `files` with every channel that is logged once per file.

    Channels within the trace come from `trace_channel`.

    Raises
    ------
    ConfigError
        If a formula does not give a number.
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
    memory = np.exp(-np.diff(elapsed_h[order], prepend=elapsed_h[order[0]]) / channel.correlation_h)
    kicks = random.standard_normal(len(elapsed_h))
    walk = np.empty(len(elapsed_h))
    last = kicks[0]
    for place, (rho, kick) in enumerate(zip(memory, kicks, strict=True)):
        last = rho * last + np.sqrt(1.0 - rho**2) * kick if place else kick
        walk[order[place]] = last
    swing = channel.daily_amplitude * np.sin(2.0 * np.pi * elapsed_h / 24.0)
    return np.round(channel.mean + channel.sd * walk + swing, channel.decimals)


def _categories(channel: CategoryChannel, groups: int, random: np.random.Generator) -> np.ndarray:
    if channel.assignment == "unique":
        width = len(str(groups))
        return np.array(
            [f"{channel.name}-{number:0{width}d}" for number in random.permutation(groups) + 1], dtype=object
        )
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
