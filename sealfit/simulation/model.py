"""The declared model of a SPEC, Eq. 14 with Eq. 15, and its undeclared effects, bound to the catalogue."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from pydantic import Field, model_validator

from sealfit.config import Expression, Strict
from sealfit.effects import EFFECTS
from sealfit.effects.contract import CHANNEL, Effect, Operation, Target
from sealfit.effects.free import LEVELS, SMOOTH, smooth_effect
from sealfit.errors import ConfigError, ParameterError, nearest
from sealfit.ingest.expression import evaluate, parse

CONDITIONS = ("temperature_C", "compression_ratio_pct", "aging_days")


class Law(Strict):
    """Eq. 15 in its identifiable form, mu_0 - a ln(1 + t/b); forces in N where the design has no load."""

    mu_0: float = Field(gt=0, description="unaged rubber")
    a: float = Field(0.0, description="loss per e-fold of time")
    b: float = Field(1.0, gt=0, description="days after which the loss sets in")


class Growth(Strict):
    """The dependence of `a` on temperature and compression, for series that are not listed."""

    reference_temperature_C: float = Field(60.0, description="temperature at which `a` is as declared")
    doubling_C: float = Field(40.0, gt=0, description="degrees that double `a`")
    reference_compression_pct: float = Field(80.0, description="compression at which `a` is as declared")
    per_pct: float = Field(0.005, description="relative growth of `a` per percent of height taken away")

    def factor(self, temperature_C, compression_pct):
        """Return the factor on `a`, broadcast over both arguments."""
        thermal = 2.0 ** ((temperature_C - self.reference_temperature_C) / self.doubling_C)
        return thermal * (1.0 + self.per_pct * (self.reference_compression_pct - compression_pct))


class SeriesLaw(Strict):
    """Parameters of one series; others are those of `physics`. mu_0 belongs to the unaged rubber."""

    temperature_C: float | None = None
    compression_ratio_pct: float | None = None
    a_s: float | None = None
    b_s: float | None = Field(None, gt=0)
    a_c: float | None = None
    b_c: float | None = Field(None, gt=0)
    v_s: float | None = Field(None, gt=0)
    sigma_2: float | None = None


class Physics(Strict):
    """The declared model: Eq. 14 with Eq. 15. The defaults are the paper's numbers for 60 degC and 80 %."""

    mu_s: Law = Law(mu_0=0.93513, a=0.04448, b=0.0804)
    mu_c: Law = Law(mu_0=0.609, a=0.03307, b=0.1324)
    v_s: float = Field(5.0, gt=0, description="mm/s")
    sigma_2: float = Field(0.05, description="N s/mm")
    sigma_0: float = Field(150.0, gt=0, description="N/mm; the rise from rest is load * mu / sigma_0 long")
    sigma_1: float = Field(0.0, ge=0, description="N s/mm")
    growth: Growth | None = Field(None, description="none: one law for all series")
    series: tuple[SeriesLaw, ...] = ()


def declared_parameters(physics: Physics, conditions: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return mu_0s, a_s, b_s, mu_0c, a_c, b_c, v_s and sigma_2 without effects, shape (n,) each.

    `conditions` has those of `CONDITIONS` that the design has, shape (n,) each. Unaged rubber (day 0) has v_s
    and sigma_2 of `physics` itself, whatever its temperature cell says.
    """
    n = len(next(iter(conditions.values()))) if conditions else 1
    values = {}
    for end, law in (("s", physics.mu_s), ("c", physics.mu_c)):
        values |= {f"mu_0{end}": law.mu_0, f"a_{end}": law.a, f"b_{end}": law.b}
    values |= {"v_s": physics.v_s, "sigma_2": physics.sigma_2}
    values = {name: np.full(n, value) for name, value in values.items()}
    if (growth := physics.growth) is not None:
        factor = growth.factor(
            conditions.get("temperature_C", growth.reference_temperature_C),
            conditions.get("compression_ratio_pct", growth.reference_compression_pct),
        )
        values["a_s"], values["a_c"] = values["a_s"] * factor, values["a_c"] * factor
    for series in physics.series:
        own, given = conditions.get("aging_days", np.ones(n)) > 0, series.model_dump(exclude_none=True)
        for name in CONDITIONS:
            if name in given:
                own = own & (conditions.get(name, np.nan) == given.pop(name))
        for name, value in given.items():
            values[name] = np.where(own, value, values[name])
    return values


EXPRESSION = "expression"


class EffectEntry(Strict):
    """One effect: of the catalogue, `smooth`, `levels` (one value per category), or a formula of channels."""

    id: str
    channels: tuple[str, ...] = Field((), description="in the order in which the effect reads them")
    acts_on: Target | None = Field(None, description="default: the likeliest; force for an expression")
    operation: Operation | None = Field(None, description="default: the likeliest; add for an expression")
    parameters: dict[str, float] = Field(default_factory=dict)
    reference: dict[str, float] = Field(default_factory=dict, description="of channels: load_N_ref = ...")
    knots: tuple[float, ...] = Field((), description="of a smooth shape")
    formula: Expression | None = Field(None, description="of an expression")

    @model_validator(mode="after")
    def _whole(self) -> "EffectEntry":
        if (self.id == EXPRESSION) != (self.formula is not None):
            raise ValueError("id = 'expression' and formula belong together")
        if self.id == LEVELS and (len(self.channels) != 1 or not self.parameters):
            raise ValueError("levels needs one channel, and parameters = {category = value, ...}")
        return self


Shape = Callable[[Mapping[str, np.ndarray]], np.ndarray]  # channels -> added force, factor less 1 or change


@dataclass(frozen=True, slots=True)
class BoundEffect:
    """An effect of a SPEC, resolved: its channels, its target and its shape."""

    id: str
    channels: tuple[str, ...]
    acts_on: Target
    operation: Operation
    form: str
    parameters: Mapping[str, float]
    shape: Shape


def resolve_effects(entries: Sequence[EffectEntry]) -> tuple[BoundEffect, ...]:
    """Return the effects of a SPEC bound to the catalogue; ConfigError if one does not fit it."""
    return tuple(_resolve(entry, f"effects.{number} ({entry.id})") for number, entry in enumerate(entries))


def _resolve(entry: EffectEntry, place: str) -> BoundEffect:
    if entry.formula is not None or entry.id == LEVELS:
        channels, form, shape = _levels(entry) if entry.formula is None else _expression(entry)
        acts_on, operation = entry.acts_on or "force", entry.operation or "add"
        return BoundEffect(entry.id, channels, acts_on, operation, form, dict(entry.parameters), shape)
    effect = _catalogued(entry, place)
    channels = entry.channels or effect.reads
    _check(entry, effect, channels, place)
    acts_on, operation = _target(entry, effect, place)
    values, reference = dict(entry.parameters), {k: np.float64(v) for k, v in entry.reference.items()}

    def shape(given: Mapping[str, np.ndarray]) -> np.ndarray:
        arrays = np.broadcast_arrays(*(np.asarray(given[channel]) for channel in channels))
        inputs = dict(zip(effect.reads, arrays, strict=True))
        return np.asarray(effect.shape({**inputs, **reference}, **values), dtype=float)

    return BoundEffect(entry.id, channels, acts_on, operation, effect.form, values, shape)


def _catalogued(entry: EffectEntry, place: str) -> Effect:
    if entry.id == SMOOTH:
        try:
            return smooth_effect(entry.knots)
        except ParameterError as error:
            raise ConfigError(f"{place}: {error}", fix="Give knots = [...].") from error
    if entry.id not in EFFECTS:
        known = sorted({*EFFECTS, SMOOTH, LEVELS, EXPRESSION})
        meant = nearest(entry.id, known)
        fix = f"Did you mean '{meant}'?" if meant else f"Known: {', '.join(known)}."
        raise ConfigError(f"{place}: there is no such effect.", fix=fix)
    return EFFECTS[entry.id]


def _check(entry: EffectEntry, effect: Effect, channels: tuple[str, ...], place: str) -> None:
    """Raise ConfigError where channels, parameters or references are not those of the effect."""
    reads = effect.reads
    if CHANNEL in channels or len(channels) != len(reads):
        fix = f"Give channels for {', '.join(reads)}, in this order; x is a channel of your choice."
        raise ConfigError(f"{place}: reads {len(reads)} channels, {len(entry.channels)} given.", fix=fix)
    parameters, references = {p.name: p for p in effect.parameters}, [f"{name}_ref" for name in reads]
    given = (("parameter", entry.parameters, parameters), ("reference", entry.reference, references))
    for what, names, known in given:
        for name in names:
            if name not in known:
                raise ConfigError(f"{place}: has no {what} '{name}'.", fix=f"Known: {', '.join(known)}.")
    for name, parameter in parameters.items():
        if name not in entry.parameters:
            raise ConfigError(f"{place}: parameter '{name}' is missing.", fix=f"{name}: {parameter.meaning}.")
        low, high = parameter.bounds
        if not parameter.linear and not low <= entry.parameters[name] <= high:
            reason = f"{place}: parameter '{name}' is {entry.parameters[name]:g}."
            raise ConfigError(reason, fix=f"Give {low:g} to {high:g}.")


def _target(entry: EffectEntry, effect: Effect, place: str) -> tuple[Target, Operation]:
    for target, operation in effect.acts_on:
        if entry.acts_on in (None, target) and entry.operation in (None, operation):
            return target, operation
    known = ", ".join(f"{target} by {operation}" for target, operation in effect.acts_on)
    wanted = " by ".join(part for part in (entry.acts_on, entry.operation) if part)
    fix = f"It acts on {known}; write an expression for others."
    raise ConfigError(f"{place}: cannot act on {wanted}.", fix=fix)


def _expression(entry: EffectEntry) -> tuple[tuple[str, ...], str, Shape]:
    """Return the channels, the form and the shape of a formula."""
    formula = parse(str(entry.formula))
    constants = {name: np.float64(value) for name, value in entry.parameters.items()}
    channels = tuple(name for name in sorted(formula.names) if name not in constants)

    def shape(given: Mapping[str, np.ndarray]) -> np.ndarray:
        return evaluate(formula, {**given, **constants})

    return channels, formula.text, shape


def _levels(entry: EffectEntry) -> tuple[tuple[str, ...], str, Shape]:
    """Return the channels, the form and the shape of one value per category."""
    (channel,) = entry.channels

    def shape(given: Mapping[str, np.ndarray]) -> np.ndarray:
        values = np.asarray(given[channel])
        label = "{:g}".format if values.dtype.kind in "fiu" else str  # so that repeat 2.0 is level "2"
        found, codes = np.unique(values, return_inverse=True)
        # 0 for a category without a value
        return np.array([entry.parameters.get(label(value), 0.0) for value in found])[codes]

    return (channel,), "value of the level", shape
