"""What a SPEC says: rubber, rig, design, effects and scatter; checked on load, unknown keys refused."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

from pydantic import Field, ValidationError, model_validator

from sealfit.effects.free import LEVELS
from sealfit.errors import ConfigError
from sealfit.simulation.channels import Channel
from sealfit.simulation.design import Design
from sealfit.simulation.effects import EffectEntry, resolve_effects
from sealfit.simulation.formula import parse_formula
from sealfit.simulation.noise import Noise
from sealfit.simulation.physics import Physics
from sealfit.simulation.strict import Strict

NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*")
TRACE_NAMES = ("time_s", "displacement_mm", "force_N")
RUN_NAMES = (
    "file",
    "run_id",
    "repeat",
    "specimen_id",
    "temperature_C",
    "compression_ratio_pct",
    "aging_days",
    "load_N",
)
DERIVED_NAMES = (
    "distance_mm",
    "stroke",
    "direction",
    "run_order",
    "elapsed_h",
    "speed_set_mm_s",
    "condition",
    "series",
)
TAKEN = {*TRACE_NAMES, *RUN_NAMES, *DERIVED_NAMES, "speed_mm_s", "started_at", "rubber", "pi"}


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
        own = [name for name, there in self.design.columns.items() if there]
        dated = ["run_order", "elapsed_h"] if self.design.dated else []
        along = ["time_s", "displacement_mm", "distance_mm", "speed_mm_s", "direction", "stroke"]
        return (*along, "repeat", "specimen_id", *own, *dated, *(c.name for c in self.channels))

    def risen(self) -> Spec:
        """Return the SPEC whose `design.stiffness_mm` is the longest rise that `physics.sigma_0` makes, if it is given.

        Raises
        ------
        ConfigError
            If the stroke is too short for it.
        """
        if self.physics.sigma_0 is None:
            return self
        most = max(self.physics.mu_s.mu_0, self.physics.mu_c.mu_0) * max(self.design.loads_N, default=1.0)
        design = {**self.design.model_dump(), "stiffness_mm": most / self.physics.sigma_0}
        try:
            return self.model_copy(update={"design": Design.model_validate(design)})
        except ValidationError as error:
            raise ConfigError(
                explain(error), fix="Raise physics.sigma_0: the rise is load * mu / sigma_0 long."
            ) from error

    @model_validator(mode="after")
    def _names_are_free(self) -> Spec:
        seen: set[str] = set()
        for channel in self.channels:
            if channel.name in TAKEN or channel.name in seen or not NAME.fullmatch(channel.name):
                raise ValueError(f"channel name '{channel.name}' is taken, given twice, or not letters, digits and _")
            seen.add(channel.name)
            if channel.kind == "slow" and not self.design.dated:
                raise ValueError(f"channel '{channel.name}' drifts with the calendar: design.order must not be undated")
        labels = {c.name: c.labels for c in self.channels if c.kind == "category" and c.labels}
        for number, effect in enumerate(self.effects):
            for category in effect.parameters if effect.id == LEVELS and effect.channels[0] in labels else ():
                if category not in labels[effect.channels[0]]:
                    raise ValueError(f"effects.{number} (levels): '{category}' is no label of {effect.channels[0]}")
            read = parse_formula(effect.formula).channels if effect.formula is not None else ()
            for name in (*effect.channels, *(n for n in read if n not in effect.parameters)):
                if name not in self.channel_names:
                    raise ValueError(
                        f"effects.{number} ({effect.id}): there is no channel '{name}'; known are "
                        + ", ".join(self.channel_names)
                    )
        return self


def load_spec(path: Path) -> Spec:
    """Return the SPEC at `path`, its effects resolved against the catalogue.

    Raises
    ------
    ConfigError
        If the file is missing, is not TOML, has a key or value that is not allowed, or names an effect, parameter or
        channel that does not exist; one sentence per fault.
    """
    try:
        text = Path(path).read_text("utf-8-sig")  # Windows editors begin with a byte-order mark
    except OSError as error:
        raise ConfigError(f"cannot be read ({error.strerror}).", file=path, fix="Check the path of SPEC.") from error
    except UnicodeDecodeError as error:
        raise ConfigError("is not UTF-8.", file=path, fix="Save it as UTF-8.") from error
    try:
        spec = Spec.model_validate(tomllib.loads(text))
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(
            f"is not TOML: {error}.", file=path, fix="See sample_data/simulated.spec.toml for an example."
        ) from error
    except ValidationError as error:
        raise ConfigError(explain(error), file=path, fix="sample_data/README.md lists every key.") from error
    try:
        resolve_effects(spec.effects)
    except ConfigError as error:
        raise ConfigError(error.message, file=path, fix=error.fix) from error
    return spec


def explain(error: ValidationError) -> str:
    """Return one sentence per fault of a SPEC."""
    lines = []
    for fault in error.errors():
        key = ".".join(str(part) for part in fault["loc"]) or "the file"
        if fault["type"] == "extra_forbidden":
            lines.append(f"unknown key '{key}'.")
        else:
            lines.append(f"key '{key}': {fault['msg'].removeprefix('Value error, ')}.")
    return " ".join(lines)
