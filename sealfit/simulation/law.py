"""The noise-free truth: the declared model with its undeclared effects, in steady sliding."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from sealfit.physics.aging import aging_law
from sealfit.physics.stribeck import stribeck_decay
from sealfit.simulation.effects import BoundEffect, resolve_effects
from sealfit.simulation.physics import QUANTITIES, Physics, declared_parameters
from sealfit.simulation.spec import Spec

BY_TARGET = {
    "mu_0": ("mu_0s", "mu_0c"),
    "a": ("a_s", "a_c"),
    "b": ("b_s", "b_c"),
    "v_s": ("v_s",),
    "sigma_2": ("sigma_2",),
}
CONDITIONS = ("temperature_C", "compression_ratio_pct", "aging_days")


@dataclass(frozen=True, slots=True)
class SteadyLaw:
    """The force of steady sliding as a function of the channels.

    Order of application: changes of mu_0, a, b, v_s and sigma_2; then of mu_s and mu_c; the factor on mu and what is
    added to mu; the viscous term; the factor on the whole friction force; last the added forces, signed as in the file.
    """

    physics: Physics
    effects: tuple[BoundEffect, ...]

    def without(self, number: int) -> SteadyLaw:
        """Return the law without its effect `number`."""
        return replace(self, effects=tuple(e for k, e in enumerate(self.effects) if k != number))

    def parts(self, channels: Mapping[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the bristles' limit, the viscous part and the added forces, in N, broadcast over the channels.

        Parameters
        ----------
        channels : mapping of str to ndarray
            `speed_mm_s` (signed), the condition columns and `load_N` where the design has them, and whatever the
            effects read; each of shape (n,) or (1,).

        Raises
        ------
        ParameterError
            If an effect carries v_s or b to zero or below.
        """
        given = {name: np.atleast_1d(channels[name]) for name in CONDITIONS if name in channels}
        now = declared_parameters(self.physics, given)
        for target, quantities in BY_TARGET.items():
            for quantity in quantities:
                now[quantity] = self._changed(target, now[quantity], channels)
        days = given.get("aging_days", np.zeros(1))
        for end in "sc":
            law = aging_law(days, mu_0=now[f"mu_0{end}"], a=now[f"a_{end}"], b=now[f"b_{end}"])
            now[f"mu_{end}"] = self._changed(f"mu_{end}", law, channels)
        speed = np.atleast_1d(channels["speed_mm_s"]).astype(float)
        mu = now["mu_c"] + (now["mu_s"] - now["mu_c"]) * stribeck_decay(speed, now["v_s"])
        mu = self._changed("mu", mu, channels, factors_first=True)
        load = np.asarray(channels.get("load_N", 1.0), dtype=float)
        limit, viscous = load * mu * np.sign(speed), now["sigma_2"] * speed
        for effect in self._acting("force", "multiply"):
            factor = 1.0 + effect.shape(channels)
            limit, viscous = limit * factor, viscous * factor
        added = np.zeros(1)
        for effect in self._acting("force", "add"):
            added = added + effect.shape(channels)
        return limit, viscous, added

    def force_N(self, channels: Mapping[str, np.ndarray]) -> np.ndarray:
        """Return the force of steady sliding, in N, signed as in the file."""
        limit, viscous, added = self.parts(channels)
        return limit + viscous + added

    def _acting(self, target: str, operation: str) -> list[BoundEffect]:
        return [e for e in self.effects if (e.acts_on, e.operation) == (target, operation)]

    def _changed(
        self, target: str, value: np.ndarray, channels: Mapping[str, np.ndarray], *, factors_first: bool = False
    ) -> np.ndarray:
        own = [e for e in self.effects if e.acts_on == target]
        if factors_first:
            own.sort(key=lambda effect: effect.operation == "add")
        for effect in own:
            shape = effect.shape(channels)
            value = value * (1.0 + shape) if effect.operation == "multiply" else value + shape
        return value


def steady_law(spec: Spec) -> SteadyLaw:
    """Return the truth of a SPEC.

    Raises
    ------
    ConfigError
        If an effect is not the catalogue's.
    """
    return SteadyLaw(spec.physics, resolve_effects(spec.effects))


def law_of_condition(physics: Physics, condition: Mapping[str, float]) -> dict[str, float]:
    """Return the declared model's numbers at one condition, mu_s and mu_c included, before any effect."""
    given = {name: np.array([condition[name]], dtype=float) for name in CONDITIONS if name in condition}
    values = {name: float(value[0]) for name, value in declared_parameters(physics, given).items()}
    days = float(condition.get("aging_days", 0.0))
    for end in "sc":
        values[f"mu_{end}"] = float(
            aging_law(days, mu_0=values[f"mu_0{end}"], a=values[f"a_{end}"], b=values[f"b_{end}"])
        )
    return {name: values[name] for name in ("mu_s", "mu_c", *QUANTITIES)}
