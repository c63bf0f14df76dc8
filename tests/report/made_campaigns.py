"""Tables of campaigns of known truth, as reports get them; laws are Eq. 14 and 15, scatter is drawn."""

import copy
from dataclasses import dataclass
from functools import cache, wraps

import numpy as np
import pandas as pd
from report.made_starts import starts
from report.made_tables import (
    DROP,
    TAU,
    aging_curves,
    aging_fit,
    channels,
    closure_document,
    curves,
    effects,
    empty,
    inputs,
    law,
    levels,
    quality,
    residuals,
    shape_points,
    shapes,
    steady_rows,
    table,
    trace,
)

from sealfit.config import Config
from sealfit.fit.aging.all_series import joint_laws
from sealfit.ingest.columns import add_keys
from sealfit.tables import FITTED

NAMES = (
    "inputs",
    "runs",
    "quality",
    "traces",
    "traces_mean",
    "steady",
    "bins",
    "steady_fit",
    "aging_fit",
    "aging_curves",
    "aging_laws",
    "master_curve",
    "dynamic_fit",
    "dynamic_curves",
    "effects",
    "residuals_before",
    "residuals_after",
    "levels",
    "channels",
    "shapes",
    "shape_points",
    "curves",
)
PROVENANCE = {
    "program": "sealfit",
    "version": "0.1.0",
    "python": "3.11.9",
    "system": "Linux x86_64",
    "packages": {"numpy": "2.4.0", "pandas": "3.1.0", "scipy": "1.17.0", "matplotlib": "3.10.0"},
    "campaign": "/data/hydrothermal-2024",
    "table": None,
    "config": {"name": "default", "path": None, "text": 'name = "default"\n'},
    "inputs": [],
    "own_effects": [],
    "steps": [
        {"step": "ingest", "version": "0.1.0", "finished_at": "2024-05-02T09:31:10+00:00", "seconds": 12.4},
        {
            "step": "close-loop",
            "version": "0.1.0",
            "finished_at": "2024-05-02T09:33:40+00:00",
            "seconds": 131.02,
        },
    ],
}
NOISE, RUN_SD = 0.25, 0.12


@dataclass
class Made:
    """What build_report takes."""

    tables: dict
    closure: dict
    provenance: dict
    config: Config

    @property
    def arguments(self):
        return self.tables, self.closure, self.provenance, self.config


def made_once(make):
    """Make each campaign once in a process, and return a copy, for tests that change it."""
    kept = cache(make)

    @wraps(make)
    def made(**options):
        return copy.deepcopy(kept(**options))

    return made


@made_once
def aging_campaign(
    *,
    temperatures=(60,),
    compressions=(80, 100),
    days=(1, 4, 16),
    speeds=(0.5, 1, 2, 5, 10, 20),
    verdict="closed",
    bins_per_file=20,
    trace_points=200,
    seed=1,
):
    """Return a campaign of the paper's kind.

    With `verdict` "closed" it has warming by sliding, with "nothing_missing" nothing, and with "unexplained"
    a hump along displacement.
    """
    rng = np.random.default_rng(seed)
    config = Config()
    drop = DROP if verdict == "closed" else 0.0
    hump = 0.6 if verdict == "unexplained" else 0.0
    conditions = [(60.0, 100.0, 0.0)]
    conditions += [(float(t), float(c), float(d)) for t in temperatures for c in compressions for d in days]
    files, bins, traces, fits = [], [], [], []
    order = 0
    for number, (temperature, compression, day) in enumerate(conditions):
        mu_s, mu_c, v_s, sigma_2 = law(temperature, compression, day)
        fits += steady_rows(temperature, compression, day, (mu_s, mu_c, v_s, sigma_2), rng)
        for speed in speeds:
            run = f"T{temperature:g}C{compression:g}D{day:g}V{speed:g}"
            offset = rng.normal(0, RUN_SD)
            for repeat in (1, 2, 3):
                order += 1
                file = f"traces/{run}_{repeat}.csv"
                displacement = np.linspace(2.0, 38.0, bins_per_file)
                time = displacement / speed
                mean = 49.03 * (mu_c + (mu_s - mu_c) * np.exp(-((speed / v_s) ** 2))) + sigma_2 * speed
                warm = 1 - drop * (1 - np.exp(-time / TAU))
                odd = hump * np.exp(-(((displacement - 25) / 3) ** 2))
                force = mean * warm + odd + offset + rng.normal(0, 0.05) + rng.normal(0, NOISE, bins_per_file)
                key = {
                    "file": file,
                    "run_id": run,
                    "repeat": repeat,
                    "stroke": 1,
                    "direction": 1,
                    "specimen_id": f"S{number}",
                    "temperature_C": temperature,
                    "compression_ratio_pct": compression,
                    "aging_days": day,
                    "speed_mm_s": speed * 1.002,
                    "speed_set_mm_s": speed,
                    "load_N": 49.03,
                    "run_order": float(order),
                    "elapsed_h": order * 0.11,
                    "operator": "AB"[order % 2],
                }
                own = {
                    **key,
                    "bin": np.arange(bins_per_file),
                    "force_N": force,
                    "n": 50,
                    "displacement_mm": displacement,
                    "distance_mm": displacement - 2.0,
                    "time_s": time,
                    "force_sd_N": 0.3,
                    # the same mean with part of the warming everywhere, between slow and fast runs
                    "before": mean * (1 - 0.6 * drop),
                    "after": mean * warm,
                }
                bins.append(own)
                files.append(
                    {
                        **key,
                        "force_N": force.mean(),
                        "force_sd_N": force.std(),
                        "force_se_N": 0.04,
                        "n": 1000,
                        "displacement_mm": 20.0,
                        "displacement_from_mm": 2.0,
                        "displacement_to_mm": 38.0,
                        "time_s": 20 / speed,
                        "distance_mm": 18.0,
                        "outlier": False,
                        "used": True,
                    }
                )
            traces.append(trace(run, (temperature, compression, day), mean, speed, drop, trace_points, rng))
    columns = {name: [np.broadcast_to(own[name], bins_per_file) for own in bins] for name in bins[0]}
    bins = add_keys(pd.DataFrame({name: np.concatenate(own) for name, own in columns.items()}), config)
    steady = add_keys(pd.DataFrame(files), config)
    fits = add_keys(pd.DataFrame(fits), config)
    traces = add_keys(pd.concat(traces, ignore_index=True), config)
    found = residuals(bins, after_is_before=verdict != "closed")
    closure = closure_document(found, verdict)
    tables = {name: empty(name) for name in NAMES}
    tables |= {
        "inputs": table(
            "inputs",
            [
                {"file": f, "size": 51234, "sha256": "ab" * 32, "rows": 1000, "strokes": 1, "status": "used"}
                for f in steady["file"]
            ],
        ),
        "runs": table("runs", steady.assign(started_at="2024-04-02T08:00:00")),
        "quality": quality(steady),
        "traces": bins[["file", "stroke", "run_id", "direction", "displacement_mm", "force_N"]],
        "traces_mean": table("traces_mean", traces),
        "steady": table("steady", steady),
        "bins": table("bins", bins.drop(columns=["before", "after"])),
        "steady_fit": table("steady_fit", fits),
        "aging_fit": aging_fit(fits),
        "aging_curves": aging_curves(fits, max(days)),
        **starts(conditions, speeds, config),
        **(_laws(table("steady", steady), fits, config) if len(conditions) < 20 else {}),
        "residuals_before": found["before"],
        "residuals_after": found["after"],
        "levels": levels(found),
        "channels": channels(found),
        "curves": curves(fits, speeds, drop),
    }
    if verdict == "closed":
        tables["shapes"], tables["shape_points"] = shapes(), shape_points()
        tables["effects"] = effects(closure)
    return Made(tables, closure, {**PROVENANCE, "inputs": inputs(steady["file"])}, config)


def _laws(steady, fits, config):
    """Return the tables of the laws for all series; those of 73 conditions would take half a minute."""
    beside = {name: table(name, []) for name in ("steady_covariance", "steady_shift")}
    laws, curve = joint_laws(steady, {"steady_fit": table("steady_fit", fits), **beside}, config)
    return {"aging_laws": table("aging_laws", laws), "master_curve": table("master_curve", curve)}


def paper_sized():
    """Return 73 conditions at 8 speeds, 1752 files."""
    return aging_campaign(
        temperatures=(20, 40, 60, 80),
        compressions=(80, 90, 100),
        days=(1, 2, 4, 8, 12, 16),
        speeds=(0.2, 0.5, 1, 2, 5, 10, 20, 50),
        bins_per_file=40,
        trace_points=400,
    )


def torque_campaign(seed=3):
    """Return a rig that measures torque against rpm, without load or aging: two pressures, two directions."""
    rng = np.random.default_rng(seed)
    config = Config.model_validate(
        {
            "name": "screw drive",
            "condition": ["pressure_bar"],
            "column_units": {"oil_temp": "°C"},
            "quantities": {
                "force": {"quantity": "torque", "unit": "mN m"},
                "displacement": {"quantity": "angle", "unit": "turn"},
                "speed": {"quantity": "rotational speed", "unit": "rpm"},
            },
        }
    )
    rows, fits, curve = [], [], []
    for pressure, scale in ((2, 1.0), (8, 1.9)):
        for parameter, value, unit in (
            ("F_s", 82 * scale, "mN m"),
            ("F_c", 51 * scale, "mN m"),
            ("v_s", 35.0, "rpm"),
            ("sigma_2", 0.08, "mN m/rpm"),
        ):
            fits.append(
                {
                    "pressure_bar": pressure,
                    "quantity": "steady",
                    "parameter": parameter,
                    "value": value,
                    "se": 0.02 * value,
                    "lo95": 0.96 * value,
                    "hi95": 1.04 * value,
                    "u_sys": 0.1,
                    "unit": unit,
                    "identified": True,
                }
            )
        for sign in (1, -1):
            for rpm in (10, 25, 50, 100, 150, 200):
                offset = rng.normal(0, 1.0)
                for repeat in (1, 2, 3):
                    torque = (
                        sign * (scale * (51 + 31 * np.exp(-((rpm / 35) ** 2))) + 0.08 * rpm)
                        + offset
                        + rng.normal(0, 0.4)
                    )
                    run = f"p{pressure}n{rpm}{'+' if sign > 0 else '-'}"
                    rows.append(
                        {
                            "file": f"{run}_{repeat}.csv",
                            "run_id": run,
                            "repeat": repeat,
                            "stroke": 1,
                            "direction": sign,
                            "specimen_id": f"p{pressure}",
                            "pressure_bar": pressure,
                            "speed_mm_s": sign * rpm * 1.0,
                            "load_N": None,
                            "force_N": torque,
                            "force_sd_N": 1.0,
                            "force_se_N": 0.1,
                            "n": 500,
                            "displacement_mm": 3.0,
                            "used": True,
                            "outlier": False,
                            "oil_temp": 21.0,
                        }
                    )
        for sign in (1, -1):
            for rpm in np.geomspace(8, 210, 50):
                force = sign * (scale * (51 + 31 * np.exp(-((rpm / 35) ** 2))) + 0.08 * rpm)
                curve.append(
                    {
                        "pressure_bar": pressure,
                        "speed_mm_s": sign * rpm,
                        "force_before_N": force,
                        "force_after_N": force,
                        "force_after_lo95_N": force - 2,
                        "force_after_hi95_N": force + 2,
                    }
                )
    steady = add_keys(pd.DataFrame(rows), config)
    tables = {name: empty(name) for name in NAMES}
    tables |= {
        "steady": table("steady", steady),
        "runs": table("runs", steady),
        "quality": quality(steady),
        "steady_fit": table("steady_fit", add_keys(pd.DataFrame(fits), config)),
        "curves": table("curves", add_keys(pd.DataFrame(curve), config)),
    }
    errors = {
        "rmse_N": 1.31,
        "rmse_runs_N": 0.97,
        "heldout_rmse_N": 1.52,
        "heldout_extrapolated_rmse_N": None,
        "max_abs_N": 4.2,
        "mean_abs_pct": 1.3,
        "lack_of_fit_p": 0.31,
    }
    closure = {
        "schema": 1,
        "verdict": "nothing_missing",
        "fit_quality": {"state": "within_scatter", "ratio": 1.1, "p_value": 0.31},
        "sensitivity": [],
        "refused": [],
        "units": {
            "force_N": "mN m",
            "displacement_mm": "turn",
            "speed_mm_s": "rpm",
            "load_N": "N",
            "time_s": "s",
        },
        "noise_floor_N": 1.2,
        "before": errors,
        "after": dict(errors),
        "heldout_unit": "run",
        "effects": [],
        "scatter": [],
        "left": {
            "rmse_N": 1.31,
            "level": None,
            "channel": None,
            "p_value": None,
            "significant": False,
        },
        "outlier_files": [],
        "next_runs": [],
        "incomplete_channels": [],
    }
    return Made(tables, closure, PROVENANCE, config)


HIGHER = 1.04  # values after the loop, to those before


def after_campaign():
    """The aging campaign with fits after the loop beside those before it."""
    before = aging_campaign()
    tables = dict(before.tables)
    for name in (fit.name for fit in FITTED):
        table = before.tables[name]
        numbers = [c for c in ("value", "lo95", "hi95") if c in table]
        tables[f"{name}_after"] = table.assign(**{c: table[c] * HIGHER for c in numbers})
    effects = [{**effect, "reference": "cold contact (time 0)"} for effect in before.closure["effects"]]
    return Made(tables, {**before.closure, "effects": effects}, before.provenance, before.config)
