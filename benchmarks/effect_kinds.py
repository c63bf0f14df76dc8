"""The kinds of effect in benchmark campaigns: of the catalogue and outside of it, one to three at once.

`EFFECT_CAMPAIGNS[name](k)` gives (effects, channels) of a SPEC at strength k; `DESIGNS[name]` what the kind's
design needs beyond the common one, by size. At k = 1 each effect has an RMS of 0.25 to 2 times one file's
scatter.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

Size = Literal["small", "large"]
Ingredients = tuple[tuple[dict, ...], tuple[dict, ...]]

COLUMN = {"kind": "numeric", "name": "oil_ppm", "level": "run", "mean": 50.0, "sd": 10.0}
OTHER = {"kind": "numeric", "name": "dust_mg", "level": "run", "mean": 5.0, "sd": 1.0}
GRADES = {
    "kind": "category",
    "name": "cleaner",
    "level": "run",
    "labels": ("K", "L", "M"),
    "assignment": "balanced",
}
LABORATORY = {"kind": "slow", "name": "lab_temperature_C", "mean": 22.0, "sd": 1.0, "correlation_h": 12.0}
# No two files alike, and neither repeats nor the calendar order it: 5 to 740 s.
REST = {
    "kind": "formula",
    "name": "rest_s",
    "formula": "5 * exp(2.5 + 2.5 * sin(12.9898 * run_order))",
    "decimals": 1,
}

CURRENT = {"kind": "trace", "name": "motor_current_A", "mean": 2.0, "sd": 0.2, "correlation_s": 1.0}

SIGMOID = "A * tanh((oil_ppm - 50) / 3)"
TWO_HUMPS = "A * (exp(-((oil_ppm - 40) / 4) ** 2) + exp(-((oil_ppm - 60) / 4) ** 2))"
PRODUCT = "A * (oil_ppm - 50) / 10 * (dust_mg - 5)"
FORMULA_OF = {PRODUCT: "product"}  # formulas that the catalogue holds: to be named so
SPEED_TIMES_DAYS = "A * log(abs(speed_mm_s) / 5) * (log(1 + aging_days) - 1.4)"


def _one(id: str, parameters: dict, acts_on: str, operation: str, **more) -> dict:
    return {"id": id, "parameters": parameters, "acts_on": acts_on, "operation": operation, **more}


def _factor(id: str, **parameters: float) -> dict:
    return _one(id, parameters, "mu", "multiply")


def _ripple(k: float) -> dict:
    return _one("ripple", {"A": 0.1 * k, "lambda_": 5.0, "phi": 0.7}, "force", "add")


def _warming_distance(k: float) -> dict:
    return _factor("warming_distance", A=0.01 * k, s_0=10.0)


def _warming_conduction(k: float) -> dict:
    return _factor("warming_conduction", A=0.006 * k) | {
        "reference": {"speed_mm_s_ref": 10.0, "distance_mm_ref": 20.0}
    }


def _drift(k: float) -> dict:
    return _one("drift", {"A": 0.004 * k}, "force", "add")


def _conditioning(k: float) -> dict:
    return _factor("conditioning", A=-0.01 * k, n_0=1.0)


def _zero_offset(k: float) -> dict:
    return _one("zero_offset", {"A": 0.15 * k}, "force", "add")


def _asymmetry(k: float) -> dict:
    return _factor("asymmetry", A=0.014 * k)


def _laboratory(k: float) -> dict:
    return _factor("lab_temperature", A=-0.007 * k) | {"reference": {"lab_temperature_C_ref": 22.0}}


def _column(k: float) -> dict:
    return _factor("linear", A=0.0007 * k) | {
        "channels": ("oil_ppm",),
        "reference": {"x_ref": COLUMN["mean"]},
    }


def _column_mu_c(k: float) -> dict:
    return _one(
        "linear", {"A": 0.0015 * k}, "mu_c", "multiply", channels=("oil_ppm",), reference={"x_ref": 50.0}
    )


def _current(k: float) -> dict:
    return _one(
        "linear", {"A": 0.4 * k}, "force", "add", channels=("motor_current_A",), reference={"x_ref": 2.0}
    )


def _hum(k: float) -> dict:
    return _one("sinusoid", {"A": 0.1 * k, "lambda_": 1.7, "phi": 0.7}, "force", "add", channels=("time_s",))


def _warming_power(k: float) -> dict:
    return _factor("warming_power", A=0.0065 * k, tau=4.0) | {
        "reference": {"speed_mm_s_ref": 10.0, "load_N_ref": 49.03}
    }


def _column_log(k: float) -> dict:
    reference = {"x_ref": COLUMN["mean"]}
    return _one("log", {"A": 0.7 * k}, "force", "add", channels=("oil_ppm",), reference=reference)


def _column_step(k: float) -> dict:
    return _one("step", {"A": 0.25 * k, "x_0": 55.0}, "force", "add", channels=("oil_ppm",))


def _grades(k: float, acts_on: str, operation: str, size: float) -> dict:
    values = {"K": -size * k, "L": 0.0, "M": size * k}
    return _one("levels", values, acts_on, operation, channels=("cleaner",))


def _bump(k: float) -> dict:
    return _one("bump", {"A": 0.25 * k, "x_0": 22.0, "w": 2.0}, "force", "add", channels=("displacement_mm",))


def _expression(formula: str, size: float, acts_on: str = "mu", operation: str = "multiply") -> dict:
    return _one("expression", {"A": size}, acts_on, operation, formula=formula)


def _log_rate(k: float) -> dict:
    return _factor("log_rate", A=0.008 * k) | {"reference": {"speed_mm_s_ref": 5.0}}


def _load_exponent(k: float) -> dict:
    return _factor("load_exponent", A=-0.015 * k) | {"reference": {"load_N_ref": 50.0}}


EFFECT_CAMPAIGNS: dict[str, Callable[[float], Ingredients]] = {
    # of the catalogue, one at a time: inside files, between files, between conditions
    "ripple": lambda k: ((_ripple(k),), ()),
    "warming_time": lambda k: ((_factor("warming_time", A=0.01 * k, tau=4.0),), ()),
    "warming_distance": lambda k: ((_warming_distance(k),), ()),
    "warming_power": lambda k: ((_warming_power(k),), ()),
    "warming_conduction": lambda k: ((_warming_conduction(k),), ()),
    "drift": lambda k: ((_drift(k),), ()),
    "periodic_in_time": lambda k: ((_hum(k),), ()),
    "bump": lambda k: ((_bump(k),), ()),
    "run_in": lambda k: ((_factor("run_in", A=-0.01 * k, n_0=1.5),), ()),
    "conditioning": lambda k: ((_conditioning(k),), ()),
    "zero_offset": lambda k: ((_zero_offset(k),), ()),
    "asymmetry": lambda k: ((_asymmetry(k),), ()),
    "campaign_drift": lambda k: ((_factor("campaign_drift", A=0.001 * k),), ()),
    "rest_strengthening": lambda k: (
        (_one("rest_strengthening", {"A": 0.006 * k, "t_0": 2.0}, "mu_s", "multiply"),),
        (REST,),
    ),
    "load_exponent": lambda k: ((_load_exponent(k),), ()),
    "log_rate": lambda k: ((_log_rate(k),), ()),
    "grosch_peak": lambda k: ((_factor("grosch_peak", A=0.02 * k, v_p=8.0, w=0.5),), ()),
    "stribeck_speed_aging": lambda k: (
        (_one("stribeck_speed_aging", {"A": 0.015 * k, "t_0": 1.0}, "v_s", "multiply"),),
        (),
    ),
    "viscosity_aging": lambda k: (
        (_one("viscosity_aging", {"A": 0.003 * k, "t_0": 1.0}, "sigma_2", "add"),),
        (),
    ),
    "aging_floor": lambda k: ((_factor("aging_floor", A=0.012 * k, t_f=4.0),), ()),
    "aging_induction": lambda k: ((_factor("aging_induction", A=0.015 * k, t_i=3.0),), ()),
    "lab_temperature": lambda k: ((_laboratory(k),), (LABORATORY,)),
    # columns that nobody declared
    "column_linear_mu": lambda k: ((_column(k),), (COLUMN,)),
    "column_linear_mu_c": lambda k: ((_column_mu_c(k),), (COLUMN,)),
    "column_of_the_trace": lambda k: ((_current(k),), (CURRENT,)),
    "column_log_force": lambda k: ((_column_log(k),), (COLUMN,)),
    "column_step": lambda k: ((_column_step(k),), (COLUMN,)),
    "column_category_mu": lambda k: ((_grades(k, "mu", "multiply", 0.008),), (GRADES,)),
    "column_category_force": lambda k: ((_grades(k, "force", "add", 0.2),), (GRADES,)),
    # outside the catalogue
    "two_humps": lambda k: ((_expression(TWO_HUMPS, 0.013 * k),), (COLUMN,)),
    "sigmoid": lambda k: ((_expression(SIGMOID, 0.006 * k),), (COLUMN,)),
    "product": lambda k: ((_expression(PRODUCT, 0.007 * k),), (COLUMN, OTHER)),
    "speed_times_days": lambda k: ((_expression(SPEED_TIMES_DAYS, 0.006 * k),), ()),
    # pairs and triples
    "two_at_once": lambda k: ((_ripple(k), _conditioning(k)), ()),
    "two_warming_and_category": lambda k: (
        (_warming_distance(k), _grades(k, "force", "add", 0.2)),
        (GRADES,),
    ),
    "two_offset_and_asymmetry": lambda k: ((_zero_offset(k), _asymmetry(k)), ()),
    "two_laboratory_and_step": lambda k: ((_laboratory(k), _column_step(k)), (LABORATORY, COLUMN)),
    "three_at_once": lambda k: ((_warming_distance(k), _column(k), _ripple(k)), (COLUMN,)),
    "three_inside_and_between": lambda k: (
        (_drift(k), _conditioning(k), _grades(k, "mu", "multiply", 0.008)),
        (GRADES,),
    ),
}
NEEDS_BOTH_WAYS = ("zero_offset", "asymmetry", "two_offset_and_asymmetry")

_LOADS = {
    "temperatures_C": (60.0,),
    "loads_N": (25.0, 50.0, 75.0),
    "speeds_mm_s": (0.5, 2.0, 4.0, 8.0, 16.0, 50.0),
}
_LONG_AGED = {"days": (1.0, 2.0, 4.0, 8.0, 16.0, 32.0), "temperatures_C": (60.0, 80.0)}
DESIGNS: dict[str, dict[Size, dict]] = {
    # The calendar follows the days where a day's tests wait for the rubber: here they do not.
    "campaign_drift": {size: {"order": "randomised"} for size in ("small", "large")},
    "run_in": {size: {"strokes_per_file": 5, "directions": (1, -1)} for size in ("small", "large")},
    "load_exponent": {  # 216 and 594 files
        "small": {**_LOADS, "days": (1.0, 4.0, 16.0)},
        "large": {
            **_LOADS,
            "temperatures_C": (60.0, 80.0),
            "compressions_pct": (80.0,),
            "days": (1.0, 2.0, 4.0, 8.0, 16.0),
        },
    },
    "aging_floor": {  # 195 and 600 files, seven days a series
        "small": {**_LONG_AGED, "speeds_mm_s": (0.5, 2.0, 8.0, 16.0, 50.0)},
        "large": {**_LONG_AGED, "compressions_pct": (80.0, 90.0)},
    },
}
DESIGNS["aging_induction"] = DESIGNS["aging_floor"]
