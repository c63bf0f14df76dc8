"""Hidden effects: shapes, families of the catalogue, local ones, and smooth random functions.

An effect is `amplitude x shape(variables)`, zero outside `where`; it is added to, or one plus it multiplies,
the quantity it acts on. `names` are the ids under which a claim names it rightly; a closed form of the right
variable (linear, log, bump, ...) describes it and is right, too.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from worlds.world import World

SERIES = ("temperature_C", "compression_ratio_pct")  # columns that tell series apart
FEATURES = 24  # cosines of a random smooth function
WIDE = 20.0  # a positive variable that spans this factor varies by its logarithm


@dataclass(frozen=True)
class Effect:
    """One hidden effect."""

    family: str
    names: tuple[str, ...]
    variables: tuple[str, ...]
    acts_on: str
    operation: str
    shape: str
    parameters: dict = field(default_factory=dict)
    where: dict | None = None  # {"channel", "low", "high"}: zero outside
    amplitude: float = 1.0
    strength_pct: float = 0.0  # RMS of what it adds to the force, share of the RMS force

    @property
    def place(self) -> tuple[str, ...]:
        """Channels that say where the effect sits, beside its variables."""
        if self.where is None:
            return ()
        name = self.where["channel"]
        return SERIES if name == "series" else (name,)


def change(effect: Effect, channels: Mapping[str, np.ndarray]) -> np.ndarray:
    """Return what an effect adds to its quantity, or its factor minus one, at given channel values."""
    values = [channels[name] for name in effect.variables]
    shaped = effect.amplitude * SHAPES[effect.shape](*values, **effect.parameters)
    if effect.where is None:
        return shaped
    place = channels[effect.where["channel"]]
    return np.where((place >= effect.where["low"]) & (place <= effect.where["high"]), shaped, 0.0)


def _fourier(*values, scales, frequencies, phases, weights):
    """Random Fourier features on variables mapped to [0, 1]."""
    mapped = []
    for value, (low, high, logarithmic) in zip(values, scales, strict=True):
        x = np.clip(value, low, high)
        mapped.append((np.log(x / low) / np.log(high / low)) if logarithmic else (x - low) / (high - low))
    return sum(
        w * np.cos(sum(f * x for f, x in zip(own, mapped, strict=True)) + phase)
        for w, own, phase in zip(weights, frequencies, phases, strict=True)
    )


def _levels(value, *, sizes):
    value = np.asarray(value)
    return sum((np.where(value == name, size, 0.0) for name, size in sizes.items()), np.zeros(value.shape))


SHAPES: dict[str, Callable] = {
    "constant": lambda *_: 1.0,
    "half_direction": lambda d, **_: d / 2,
    "linear": lambda x, *, ref, span: (x - ref) / span,
    "approach": lambda x, *, start, scale: 1 - np.exp(-(x - start) / scale),
    "log_ratio": lambda x, *, ref: np.log(x / ref),
    "log_growth": lambda x, *, scale: np.log1p(x / scale),
    "sine": lambda x, *, period, phase: np.sin(2 * np.pi * x / period + phase),
    "log_bump": lambda x, *, place, width: np.exp(-((np.log10(x / place) / width) ** 2)),
    "stribeck": lambda v, *, v_s, n: np.exp(-((v / v_s) ** n)) - np.exp(-((v / v_s) ** 2)),
    "power": lambda v, d, *, ref, n: d * (v / ref) ** n,
    "conduction": lambda s, v, *, ref: np.sqrt(np.maximum(s, 0) * v / ref),
    "floor": lambda t, *, day: np.log(np.maximum(1.0, t / day)),
    "induction": lambda t, *, day: (t / day) * np.exp(1 - t / day),
    "step": lambda x, *, place: np.where(x >= place, 1.0, 0.0),
    "levels": _levels,
    "fourier": _fourier,
}


# ---------------------------------------------------------- families: each returns an effect of amplitude +-1
def _warming_distance(w: World, rng) -> Effect:
    scale = w.rig["stroke_mm"] * 10 ** rng.uniform(-1, 0.3)
    return Effect("warming_distance", ("warming_distance",), ("distance_mm",), "mu", "multiply", "approach",
                  {"start": 0.0, "scale": scale}, amplitude=-1.0)  # fmt: skip


def _warming_time(w: World, rng) -> Effect:
    _low, high = w.ranges["time_s"][:2]
    return Effect("warming_time", ("warming_time",), ("time_s",), "mu", "multiply", "approach",
                  {"start": 0.0, "scale": high * 10 ** rng.uniform(-2, 0)}, amplitude=-1.0)  # fmt: skip


def _warming_conduction(w: World, rng) -> Effect:
    names = ("warming_conduction", "warming_conduction_load", "warming_power")
    return Effect("warming_conduction", names, ("distance_mm", "speed_mm_s"), "mu", "multiply", "conduction",
                  {"ref": w.rig["stroke_mm"] * w.speeds_mm_s[-1]}, amplitude=-1.0)  # fmt: skip


def _ripple(w: World, rng) -> Effect:
    period = w.rig["stroke_mm"] / np.exp(rng.uniform(np.log(3), np.log(30)))
    return Effect("ripple", ("ripple",), ("displacement_mm",), "force", "add", "sine",
                  {"period": period, "phase": rng.uniform(0, 2 * np.pi)})  # fmt: skip


def _sensor_drift(w: World, rng) -> Effect:
    return Effect("sensor_drift", ("drift",), ("time_s",), "force", "add", "linear",
                  {"ref": 0.0, "span": w.ranges["time_s"][1]}, amplitude=_sign(rng))  # fmt: skip


def _zero_offset(w: World, rng) -> Effect:
    return Effect(
        "zero_offset", ("zero_offset",), ("direction",), "force", "add", "constant", amplitude=_sign(rng)
    )


def _asymmetry(w: World, rng) -> Effect:
    target = ("mu", "mu", "mu_s", "mu_c", "sigma_2", "v_s")[rng.integers(6)]
    return Effect("asymmetry", ("asymmetry",), ("direction",), target, "multiply", "half_direction",
                  amplitude=_sign(rng))  # fmt: skip


def _conditioning(w: World, rng) -> Effect:
    return Effect("conditioning", ("conditioning",), ("repeat",), "mu", "multiply", "approach",
                  {"start": 1.0, "scale": rng.uniform(0.4, 3.0)}, amplitude=-1.0)  # fmt: skip


def _run_in(w: World, rng) -> Effect:
    return Effect("run_in", ("run_in",), ("stroke",), "mu", "multiply", "approach",
                  {"start": 1.0, "scale": rng.uniform(0.4, 3.0)}, amplitude=_sign(rng))  # fmt: skip


def _campaign_drift(w: World, rng) -> Effect:
    target = (("mu", "multiply"), ("force", "add"))[rng.integers(2)]
    low, high = w.ranges["elapsed_h"][:2]
    return Effect("campaign_drift", ("campaign_drift",), ("elapsed_h",), *target, "linear",
                  {"ref": (low + high) / 2, "span": high - low}, amplitude=_sign(rng))  # fmt: skip


def _load_exponent(w: World, rng) -> Effect:
    return Effect("load_exponent", ("load_exponent",), ("load_N",), "mu", "multiply", "log_ratio",
                  {"ref": float(np.mean(w.loads_N))}, amplitude=-1.0)  # fmt: skip


def _stribeck_exponent(w: World, rng) -> Effect:
    n = (0.5, 0.8, 1.0, 1.4, 3.0, 4.0)[rng.integers(6)]
    return Effect("stribeck_exponent", ("stribeck_exponent",), ("speed_mm_s",), "mu", "add", "stribeck",
                  {"v_s": w.series[0]["v_s"], "n": n})  # fmt: skip


def _grosch_peak(w: World, rng) -> Effect:
    low, high = np.log(w.speeds_mm_s[[0, -1]])
    place = float(np.exp(rng.uniform(low + 0.2 * (high - low), high - 0.2 * (high - low))))
    return Effect("grosch_peak", ("grosch_peak",), ("speed_mm_s",), "mu", "multiply", "log_bump",
                  {"place": place, "width": rng.uniform(0.2, 1.0)})  # fmt: skip


def _power_viscous(w: World, rng) -> Effect:
    n = (0.3, 0.5, 1.5, 2.0)[rng.integers(4)]
    return Effect("power_viscous", ("power_viscous",), ("speed_mm_s", "direction"), "force", "add", "power",
                  {"ref": float(w.speeds_mm_s[-1]), "n": n})  # fmt: skip


def _log_rate(w: World, rng) -> Effect:
    ref = float(np.exp(np.log(w.speeds_mm_s).mean()))
    return Effect("log_rate", ("log_rate",), ("speed_mm_s",), "mu", "multiply", "log_ratio", {"ref": ref},
                  amplitude=_sign(rng))  # fmt: skip


def _aging_floor(w: World, rng) -> Effect:
    aged = w.days[w.days > 0]
    day = float(np.exp(rng.uniform(np.log(aged[1]), np.log(aged[-2] * 1.0001))))
    return Effect("aging_floor", ("aging_floor",), ("aging_days",), "mu", "multiply", "floor", {"day": day})


def _aging_induction(w: World, rng) -> Effect:
    aged = w.days[w.days > 0]
    day = float(np.exp(rng.uniform(np.log(aged[0]), np.log(aged[-2]))))
    return Effect(
        "aging_induction", ("aging_induction",), ("aging_days",), "mu", "multiply", "induction", {"day": day}
    )


def _stribeck_aging(w: World, rng) -> Effect:
    return Effect("stribeck_speed_aging", ("stribeck_speed_aging",), ("aging_days",), "v_s", "multiply",
                  "log_growth", {"scale": rng.uniform(0.3, 3.0)}, amplitude=_sign(rng))  # fmt: skip


def _viscosity_aging(w: World, rng) -> Effect:
    return Effect("viscosity_aging", ("viscosity_aging",), ("aging_days",), "sigma_2", "multiply",
                  "log_growth", {"scale": rng.uniform(0.3, 3.0)})  # fmt: skip


def _of_column(family: str, name: str, target: tuple[str, str]) -> Callable:
    def made(w: World, rng) -> Effect:
        low, high = w.ranges[name][:2]
        return Effect(family, (family,), (name,), *target, "linear",
                      {"ref": (low + high) / 2, "span": high - low}, amplitude=_sign(rng))  # fmt: skip

    return made


def _batch(w: World, rng) -> Effect:
    labels = sorted(set(w.files["batch"].dropna()))
    target = (("mu", "multiply"), ("force", "add"))[rng.integers(2)]
    sizes = {label: float(rng.normal()) for label in labels}
    return Effect("batch", ("levels",), ("batch",), *target, "levels", {"sizes": sizes})


def _step_in_time(w: World, rng) -> Effect:
    target = (("force", "multiply"), ("force", "add"))[rng.integers(2)]
    place = float(np.quantile(w.files["elapsed_h"], rng.uniform(0.25, 0.75)))
    return Effect(
        "step_in_time", ("step",), ("elapsed_h",), *target, "step", {"place": place}, amplitude=_sign(rng)
    )


def _day_and_night(w: World, rng) -> Effect:
    target = (("mu", "multiply"), ("force", "add"))[rng.integers(2)]
    return Effect("day_and_night", ("sinusoid",), ("elapsed_h",), *target, "sine",
                  {"period": 24.0, "phase": rng.uniform(0, 2 * np.pi)})  # fmt: skip


def _local(w: World, rng) -> Effect:
    """An effect in one series, one direction, one speed range or one week."""
    base = (_warming_distance, _ripple, _gain, _offset)[rng.integers(4)](w, rng)
    places = []
    if len({s["temperature_C"] * 1e3 + s["compression_ratio_pct"] for s in w.series}) > 1:
        places.append("series")
    if w.rig["directions"] != "one":
        places.append("direction")
    if w.speeds_mm_s.size >= 5:
        places.append("speed_mm_s")
    if w.rig["calendar"]:
        places.append("elapsed_h")
    if not places:
        return base
    name = places[rng.integers(len(places))]
    if name == "series":
        k = int(rng.integers(w.files["series"].nunique()))
        k = sorted(w.files["series"].unique())[k]
        low, high = k - 0.5, k + 0.5
    elif name == "direction":
        low, high = ((-1.5, -0.5), (0.5, 1.5))[rng.integers(2)]
    elif name == "speed_mm_s":
        k = int(rng.integers(2, w.speeds_mm_s.size - 1))
        edge = float(np.sqrt(w.speeds_mm_s[k - 1] * w.speeds_mm_s[k]))
        low, high = ((0.0, edge), (edge, np.inf))[rng.integers(2)]
    else:
        low, high = np.quantile(w.files["elapsed_h"], np.sort(rng.uniform(0, 1, 2)))
        high = max(high, low + 0.2 * np.ptp(w.files["elapsed_h"]))
    where = {"channel": name, "low": float(low), "high": float(min(high, 1e9))}
    return Effect(f"local_{base.family}_in_{name}", base.names, base.variables, base.acts_on, base.operation,
                  base.shape, base.parameters, where, base.amplitude)  # fmt: skip


def _gain(w: World, rng) -> Effect:
    return Effect(
        "gain", ("levels", "step", "temporary_change"), (), "mu", "multiply", "constant", amplitude=_sign(rng)
    )


def _offset(w: World, rng) -> Effect:
    return Effect(
        "offset", ("levels", "step", "temporary_change"), (), "force", "add", "constant", amplitude=_sign(rng)
    )


def smooth_random(w: World, rng) -> Effect:
    """A random Fourier draw of one or two variables on a random quantity."""
    names = list(w.ranges)
    count = min(len(names), 1 + int(rng.random() < 0.35))
    chosen = tuple(names[k] for k in rng.permutation(len(names))[:count])
    targets = [("force", "add"), ("force", "multiply"), ("mu", "multiply"), ("mu", "multiply"),
               ("mu_s", "multiply"), ("mu_c", "multiply"), ("v_s", "multiply"),
               ("sigma_2", "multiply")]  # fmt: skip
    length = rng.uniform(0.2, 0.8)  # correlation length, share of the range
    return Effect(
        f"smooth_{count}", (), chosen, *targets[rng.integers(len(targets))], "fourier",
        {
            "scales": [list(w.ranges[name]) for name in chosen],
            "frequencies": (rng.normal(size=(FEATURES, count)) / length).tolist(),
            "phases": rng.uniform(0, 2 * np.pi, FEATURES).tolist(),
            "weights": (rng.normal(size=FEATURES) * np.sqrt(2 / FEATURES)).tolist(),
        },
    )  # fmt: skip


def _sign(rng) -> float:
    return float(rng.choice([-1.0, 1.0]))


# What each family needs of the world; columns named here are put into the world when the family is drawn.
FAMILIES: dict[str, tuple[Callable, Callable]] = {
    "warming_distance": (_warming_distance, lambda w: True),
    "warming_time": (_warming_time, lambda w: True),
    "warming_conduction": (_warming_conduction, lambda w: True),
    "ripple": (_ripple, lambda w: True),
    "sensor_drift": (_sensor_drift, lambda w: True),
    "zero_offset": (_zero_offset, lambda w: w.rig["directions"] != "one"),
    "asymmetry": (_asymmetry, lambda w: w.rig["directions"] != "one"),
    "conditioning": (_conditioning, lambda w: w.files["repeat"].max() > 1),
    "run_in": (_run_in, lambda w: w.rig["strokes"] > 2),
    "campaign_drift": (_campaign_drift, lambda w: w.rig["calendar"]),
    "load_exponent": (_load_exponent, lambda w: w.loads_N.size > 1),
    "stribeck_exponent": (_stribeck_exponent, lambda w: w.speeds_mm_s.size > 4),
    "grosch_peak": (_grosch_peak, lambda w: w.speeds_mm_s.size > 4),
    "power_viscous": (_power_viscous, lambda w: w.speeds_mm_s.size > 4),
    "log_rate": (_log_rate, lambda w: w.speeds_mm_s.size > 4),
    "aging_floor": (_aging_floor, lambda w: (w.days > 0).sum() >= 4),
    "aging_induction": (_aging_induction, lambda w: (w.days > 0).sum() >= 4),
    "stribeck_speed_aging": (_stribeck_aging, lambda w: (w.days > 0).sum() >= 3),
    "viscosity_aging": (_viscosity_aging, lambda w: (w.days > 0).sum() >= 3),
    "lab_temperature": (
        _of_column("lab_temperature", "lab_temperature_C", ("mu", "multiply")),
        lambda w: "lab_temperature_C" in w.ranges,
    ),
    "humidity": (
        _of_column("humidity", "humidity_pct", ("mu", "multiply")),
        lambda w: "humidity_pct" in w.ranges,
    ),
    "batch": (_batch, lambda w: "batch" in w.files),
    "channel_offset": (
        _of_column("channel_offset", "pressure_bar", ("force", "add")),
        lambda w: "pressure_bar" in w.ranges,
    ),
    "trace_column": (
        _of_column("trace_column", "motor_current_A", ("force", "add")),
        lambda w: "motor_current_A" in w.ranges,
    ),
    "step_in_time": (_step_in_time, lambda w: w.rig["calendar"]),
    "day_and_night": (
        _day_and_night,
        lambda w: w.rig["calendar"] and np.ptp(w.files["elapsed_h"]) > 48,
    ),
    "local": (_local, lambda w: True),
}
