"""The motion of the platform, and the noise-free force."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import exprel

from sealfit.effects.contract import QUANTITIES_OF
from sealfit.physics import aging_law, stribeck_decay
from sealfit.simulation.model import CONDITIONS, BoundEffect, Physics, declared_parameters, resolve_effects
from sealfit.simulation.spec import STEADY_LENGTHS, Design, Spec

RAMP_STEPS = 256  # of constant speed in the simulation of a ramp
TICK_S = 1e-5  # resolution of the logged time in s; sampling intervals are multiples of it


@dataclass(frozen=True, slots=True)
class Motion:
    """The sampled motion of one file: rest, ramp, constant speed, ramp, and the reverse; shape (n,) each."""

    time_s: np.ndarray  # from the start of the file
    stroke_time_s: np.ndarray  # `time_s` of the tables: from the start of the stroke if there are several
    displacement_mm: np.ndarray
    distance_mm: np.ndarray
    speed_mm_s: np.ndarray  # signed; zero at rest
    direction: np.ndarray
    stroke: np.ndarray
    cruising: np.ndarray  # bool: between the ramps
    steady: np.ndarray  # bool


def move(spec: Spec, speed_mm_s: float, direction: int, start_mm: float) -> Motion:
    """Return the motion of one file.

    `speed_mm_s` is the magnitude of the platform's real speed. `direction`, +1 or -1, is that of the first
    stroke; the others alternate. `start_mm` is the lower end of the stroke in the rig's coordinate.
    """
    design = spec.design
    _, rest, _, period = _phases(design, speed_mm_s)
    total = design.strokes_per_file * period + 0.5 * rest
    step = max(1.0 / design.sampling_Hz, total / (design.max_rows - 1))
    step = np.ceil(np.round(step / TICK_S, 6)) * TICK_S
    time = np.round(np.arange(int(total / step) + 1) * step, 5)
    return move_at(spec, speed_mm_s, direction, start_mm, time)


def move_at(spec: Spec, speed_mm_s: float, direction: int, start_mm: float, time: np.ndarray) -> Motion:
    """Return the motion of one file at given times since its start, shape (n,); other arguments as `move`."""
    design, length = spec.design, spec.design.stroke_mm
    ramp, rest, cruise, period = _phases(design, speed_mm_s)
    number = np.minimum((time / period).astype(int), design.strokes_per_file - 1)
    since = time - number * period - rest  # since the start of motion of the stroke
    along, speed = _trapezoid(since, ramp, cruise, speed_mm_s, length)
    cruising = (since > ramp) & (since < ramp + cruise)
    steady_from = 0.5 * speed_mm_s * ramp + STEADY_LENGTHS * spec.rise_mm
    sign = direction * np.where(number % 2, -1, 1)
    return Motion(
        time_s=time,
        stroke_time_s=np.maximum(since, 0.0) if design.both_ways else time,
        displacement_mm=start_mm + np.where(sign > 0, along, length - along),
        distance_mm=along,
        speed_mm_s=sign * speed,
        direction=sign,
        stroke=number + 1,
        cruising=cruising,
        steady=cruising & (along > steady_from),
    )


def _phases(design: Design, speed_mm_s: float) -> tuple[float, float, float, float]:
    """Return the durations in s of a ramp, the rest before a stroke, constant speed, and their sum."""
    ramp = min(design.ramp_s, 0.1 * design.stroke_mm / speed_mm_s)
    rest = min(design.dwell_s, 0.1 * design.stroke_mm / speed_mm_s)
    cruise = design.stroke_mm / speed_mm_s - ramp
    return ramp, rest, cruise, rest + 2.0 * ramp + cruise


def finer(motion: Motion, design: Design, speed_mm_s: float) -> np.ndarray:
    """Return the sorted times of the file, with RAMP_STEPS times in each ramp added."""
    time = motion.time_s
    ramp, *_ = _phases(design, speed_mm_s)
    changing = np.flatnonzero(~(motion.cruising[1:] & motion.cruising[:-1]))
    step = time[1] - time[0]
    count = int(np.ceil(step * RAMP_STEPS / ramp)) if ramp > 0.0 else 1
    between = time[changing, None] + step * np.arange(1, count) / count
    return np.union1d(time, between)


def _trapezoid(
    since: np.ndarray, ramp: float, cruise: float, speed: float, length: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return distance and speed of one stroke, `since` seconds after the start of its motion."""
    remaining = 2.0 * ramp + cruise - since
    up, down = since < ramp, remaining < ramp
    rate = speed / ramp if ramp > 0.0 else 0.0
    before, after = since <= 0.0, remaining <= 0.0
    phases = [before, after, up, down]
    distances = [0.0, length, 0.5 * rate * since**2, length - 0.5 * rate * remaining**2]
    distance = np.select(phases, distances, speed * (since - 0.5 * ramp))
    return distance, np.select(phases, [0.0, 0.0, rate * since, rate * remaining], speed)


def with_presliding(
    limit_N: np.ndarray, motion: Motion, rise_mm: np.ndarray, damping_s: float = 0.0
) -> np.ndarray:
    r"""Return the bristle force sigma_0 z + sigma_1 dz/dt in N, shape (n,).

    .. math:: dF/dx = (F_{limit} - F) / x_0

    This is Eq. 2 over the distance x for F = sigma_0 z, with x_0 = g, the length of the rise, `rise_mm`.
    `limit_N` is the force of the bristles in steady sliding at every row's speed, a straight line between
    rows of one direction; it and `rise_mm` have the shape (n,). `damping_s` is sigma_1 / sigma_0.
    """
    slid = np.abs(np.diff(motion.displacement_mm, prepend=motion.displacement_mm[0])) / rise_mm
    turned = np.diff(motion.direction, prepend=0) != 0
    change = np.where(turned, 0.0, np.diff(limit_N, prepend=limit_N[0]))
    begin, end = limit_N - change, limit_N - change * exprel(-slid)
    result, force = np.empty(limit_N.size), 0.0
    for row, decay in enumerate(np.exp(-slid)):
        result[row] = force = end[row] + (force - begin[row]) * decay
    return result + damping_s * np.abs(motion.speed_mm_s) / rise_mm * (limit_N - result)


# ---------------------------------------------------------------- law
# The noise-free truth: the declared model with its undeclared effects, in steady sliding.


@dataclass(frozen=True, slots=True)
class SteadyLaw:
    """The force of steady sliding as a function of the channels.

    Effects are applied in this order: on mu_0, a, b, v_s and sigma_2; on mu_s and mu_c; factors on mu, then
    terms added to mu; factors on the friction force, viscous term included; added forces, signed as in the
    file.
    """

    physics: Physics
    effects: tuple[BoundEffect, ...]

    def without(self, number: int) -> "SteadyLaw":
        """Return the law without its effect `number`."""
        return replace(self, effects=self.effects[:number] + self.effects[number + 1 :])

    def parts(self, channels: Mapping[str, np.ndarray]) -> tuple[np.ndarray, ...]:
        """Return the steady bristle force, the viscous part, the factor on both, and added forces.

        Forces are in N, all broadcast over the channels. `channels` has `speed_mm_s` (signed), the condition
        columns and `load_N` of the design, and all that the effects read; shape (n,) or (1,) each.
        ParameterError if an effect makes v_s or b zero or negative.
        """
        given = {name: np.atleast_1d(channels[name]) for name in CONDITIONS if name in channels}
        now = declared_parameters(self.physics, given)
        for target, quantities in QUANTITIES_OF.items():
            for quantity in quantities:
                now[quantity] = self._changed(target, now[quantity], channels)
        days = given.get("aging_days", np.zeros(1))
        for end in "sc":
            now[f"mu_{end}"] = self._changed(f"mu_{end}", _aged(now, end, days), channels)
        speed = np.atleast_1d(channels["speed_mm_s"]).astype(float)
        mu = now["mu_c"] + (now["mu_s"] - now["mu_c"]) * stribeck_decay(speed, now["v_s"])
        for operation in ("multiply", "add"):
            mu = self._changed("mu", mu, channels, operation)
        load = np.asarray(channels.get("load_N", 1.0), dtype=float)
        factor = self._changed("force", np.ones(1), channels, "multiply")
        added = self._changed("force", np.zeros(1), channels, "add")
        return load * mu * np.sign(speed), now["sigma_2"] * speed, factor, added

    def force_N(self, channels: Mapping[str, np.ndarray]) -> np.ndarray:
        """Return the force of steady sliding, in N, signed as in the file."""
        limit, viscous, factor, added = self.parts(channels)
        return (limit + viscous) * factor + added

    def _changed(
        self, target: str, value: np.ndarray, channels: Mapping[str, np.ndarray], operation: str | None = None
    ) -> np.ndarray:
        """Return a value with the effects on `target` applied, all of them or those of one operation."""
        for effect in self.effects:
            if effect.acts_on == target and operation in (None, effect.operation):
                shape = effect.shape(channels)
                value = value * (1.0 + shape) if effect.operation == "multiply" else value + shape
        return value


def steady_law(spec: Spec) -> SteadyLaw:
    """Return the truth of a SPEC; ConfigError if an effect is not in the catalogue."""
    return SteadyLaw(spec.physics, resolve_effects(spec.effects))


def law_of_condition(physics: Physics, condition: Mapping[str, float]) -> dict[str, float]:
    """Return the declared model's parameters at one condition without effects, mu_s and mu_c included."""
    given = {name: np.array([value], dtype=float) for name, value in condition.items()}
    values = {name: float(value[0]) for name, value in declared_parameters(physics, given).items()}
    days = condition.get("aging_days", 0.0)
    return {f"mu_{end}": float(_aged(values, end, days)) for end in "sc"} | values


def _aged(values: Mapping, end: str, days):
    """Return mu_s or mu_c (`end` "s" or "c") after so many days by Eq. 15."""
    return aging_law(days, mu_0=values[f"mu_0{end}"], a=values[f"a_{end}"], b=values[f"b_{end}"])
