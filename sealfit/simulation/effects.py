"""The undeclared effects of a SPEC, bound to the catalogue and put to work on the declared model."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from pydantic import Field, model_validator

from sealfit.effects import EFFECTS
from sealfit.effects.contract import CHANNEL, Effect, Operation, Target
from sealfit.effects.free import LEVELS, SMOOTH, smooth_effect
from sealfit.errors import ConfigError, ParameterError
from sealfit.simulation.formula import evaluate_formula, parse_formula
from sealfit.simulation.strict import Strict

EXPRESSION = "expression"


class EffectEntry(Strict):
    """One effect: of the catalogue, `smooth`, `levels` (one value per category), or a formula of channels."""

    id: str
    channels: tuple[str, ...] = Field((), description="in the order in which the effect reads them")
    acts_on: Target | None = Field(None, description="default: the catalogue's likeliest; force for an expression")
    operation: Operation | None = Field(None, description="default: the catalogue's likeliest; add for an expression")
    parameters: dict[str, float] = Field(default_factory=dict)
    reference: dict[str, float] = Field(default_factory=dict, description="where it is zero or one, e.g. load_N_ref")
    knots: tuple[float, ...] = Field((), description="of a smooth shape")
    formula: str | None = Field(None, description="of an expression")

    @model_validator(mode="after")
    def _whole(self) -> EffectEntry:
        if (self.id == EXPRESSION) != (self.formula is not None):
            raise ValueError("id = 'expression' and formula belong together")
        if self.formula is not None:
            try:
                unknown = [
                    n for n in parse_formula(self.formula).channels if n not in (*self.channels, *self.parameters)
                ]
            except ConfigError as error:
                raise ValueError(str(error)) from None
            if self.channels and unknown:
                raise ValueError(f"formula reads {', '.join(unknown)}: list it in channels or parameters")
        if self.id == LEVELS and (len(self.channels) != 1 or not self.parameters):
            raise ValueError("levels needs one channel, and parameters = {category = value, ...}")
        return self


@dataclass(frozen=True, slots=True)
class BoundEffect:
    """An effect of a SPEC with everything decided: what it reads, what it acts on, and its shape."""

    id: str
    channels: tuple[str, ...]
    acts_on: Target
    operation: Operation
    form: str
    parameters: Mapping[str, float]
    shape: Callable[[Mapping[str, np.ndarray]], np.ndarray]  # channels -> added force, factor minus one or change


def resolve_effects(entries: Sequence[EffectEntry]) -> tuple[BoundEffect, ...]:
    """Return the effects of a SPEC bound to the catalogue, in the SPEC's order.

    Raises
    ------
    ConfigError
        If an id, a parameter or the number of channels is not the catalogue's, or an effect cannot act on a target.
    """
    return tuple(_resolve(entry, f"effects.{number} ({entry.id})") for number, entry in enumerate(entries))


def _resolve(entry: EffectEntry, place: str) -> BoundEffect:
    if entry.formula is not None:
        return _expression(entry)
    if entry.id == LEVELS:
        return _levels(entry)
    effect = _catalogued(entry, place)
    channels = _bound_channels(entry, effect, place)
    _check_parameters(entry, effect, place)
    _check_reference(entry, effect, place)
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
            return smooth_effect(entry.knots, entry.reference.get("x_ref"))
        except ParameterError as error:
            raise ConfigError(f"{place}: {error}", fix="Give knots = [...].") from error
    if entry.id not in EFFECTS:
        known = ", ".join(sorted({*EFFECTS, SMOOTH, LEVELS, EXPRESSION}))
        raise ConfigError(f"{place}: there is no such effect.", fix=f"Known: {known}.")
    return EFFECTS[entry.id]


def _check_reference(entry: EffectEntry, effect: Effect, place: str) -> None:
    known = [f"{name}_ref" for name in effect.reads]
    for name in entry.reference:
        if name not in known:
            raise ConfigError(f"{place}: has no reference '{name}'.", fix=f"It may have {', '.join(known)}.")


def _bound_channels(entry: EffectEntry, effect: Effect, place: str) -> tuple[str, ...]:
    if entry.channels:
        if len(entry.channels) != len(effect.reads):
            raise ConfigError(
                f"{place}: reads {len(effect.reads)} channels, {len(entry.channels)} given.",
                fix=f"Give channels for {', '.join(effect.reads)}, in this order.",
            )
        return entry.channels
    if CHANNEL in effect.reads:
        raise ConfigError(f"{place}: reads a channel of your choice.", fix='Add channels = ["<column>"].')
    return effect.reads


def _check_parameters(entry: EffectEntry, effect: Effect, place: str) -> None:
    wanted = {p.name: p for p in effect.parameters}
    for name in entry.parameters:
        if name not in wanted:
            raise ConfigError(f"{place}: has no parameter '{name}'.", fix=f"Its parameters: {', '.join(wanted)}.")
    for name, parameter in wanted.items():
        if name not in entry.parameters:
            raise ConfigError(f"{place}: parameter '{name}' is missing.", fix=f"{name}: {parameter.meaning}.")
        low, high = parameter.bounds
        if not parameter.linear and not low <= entry.parameters[name] <= high:
            raise ConfigError(
                f"{place}: parameter '{name}' is {entry.parameters[name]:g}.", fix=f"Give {low:g} to {high:g}."
            )


def _target(entry: EffectEntry, effect: Effect, place: str) -> tuple[Target, Operation]:
    pairs = [
        (target, operation)
        for target, operation in effect.acts_on
        if entry.acts_on in (None, target) and entry.operation in (None, operation)
    ]
    if pairs:
        return pairs[0]
    known = ", ".join(f"{target} by {operation}" for target, operation in effect.acts_on)
    wanted = " by ".join(part for part in (entry.acts_on, entry.operation) if part)
    raise ConfigError(f"{place}: cannot act on {wanted}.", fix=f"It acts on {known}; write an expression for others.")


def _expression(entry: EffectEntry) -> BoundEffect:
    formula = parse_formula(str(entry.formula))
    constants = {name: np.float64(value) for name, value in entry.parameters.items()}
    channels = tuple(name for name in formula.channels if name not in constants)

    def shape(given: Mapping[str, np.ndarray]) -> np.ndarray:
        return evaluate_formula(formula, {**given, **constants})

    target, operation = entry.acts_on or "force", entry.operation or "add"
    return BoundEffect(entry.id, channels, target, operation, formula.text, dict(entry.parameters), shape)


def _levels(entry: EffectEntry) -> BoundEffect:
    (channel,) = entry.channels
    labels = np.array(list(entry.parameters), dtype=str)
    order = np.argsort(labels)
    values = np.array(list(entry.parameters.values()))[order]
    labels = labels[order]

    def shape(given: Mapping[str, np.ndarray]) -> np.ndarray:
        found = _as_label(np.asarray(given[channel]))
        place = np.minimum(np.searchsorted(labels, found), labels.size - 1)
        return np.where(labels[place] == found, values[place], 0.0)  # a category without a value has none

    target, operation = entry.acts_on or "force", entry.operation or "add"
    return BoundEffect(LEVELS, (channel,), target, operation, "value of the level", dict(entry.parameters), shape)


def _as_label(values: np.ndarray) -> np.ndarray:
    """Return categories as text; numbers as %g, so that repeat 2.0 is level "2"."""
    if values.dtype.kind in "fiu":
        found, codes = np.unique(values, return_inverse=True)
        return np.array([f"{v:g}" for v in found], dtype=str)[codes].reshape(values.shape)
    return values.astype(str)
