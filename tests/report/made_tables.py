"""Single tables of a made campaign: fits, residuals, levels, shapes, quality; the laws are Eq. 14 and 15."""

import numpy as np
import pandas as pd

from sealfit.tables import SCHEMAS

DROP, TAU = 0.061, 4.0  # warming: mu falls by 6.1 % with a time constant of 4 s


def empty(name):
    """Return a table without rows, typed as tables.py says."""
    return pd.DataFrame({c.name: pd.Series(dtype=c.dtype.to_pandas_dtype()) for c in SCHEMAS[name].columns})


def table(name, rows):
    """Return rows as the table `name`, its columns in order, whatever is not given null."""
    frame = pd.DataFrame(rows)
    fixed = SCHEMAS[name].names()
    frame = frame.assign(**{c: None for c in fixed if c not in frame})
    frame = frame[[*fixed, *(c for c in frame.columns if c not in fixed)]]
    numbers = {
        c.name: float
        for c in SCHEMAS[name].columns
        if str(c.dtype) in ("double", "int64") and frame[c.name].isna().any()
    }
    return frame.astype(numbers)


def law(temperature, compression, day):
    """Return mu_s, mu_c, v_s, sigma_2 of a condition by Eq. 15 with the paper's a and b, faster when hot."""
    rate = (1 + 0.012 * (temperature - 60)) * (1 + 0.004 * (100 - compression))
    mu_s = 0.935 - 0.0445 * rate * np.log1p(day / 0.0804)
    mu_c = 0.609 - 0.0331 * rate * np.log1p(day / 0.1324)
    return mu_s, mu_c, 4.6, 0.105


def steady_rows(temperature, compression, day, values, rng):
    rows = []
    for (name, unit, se), true in zip(
        (("mu_s", "", 0.006), ("mu_c", "", 0.004), ("v_s", "mm/s", 0.14), ("sigma_2", "N s/mm", 0.009)),
        values,
        strict=True,
    ):
        value = true + rng.normal(0, se)
        known = not (name == "v_s" and day == 16)
        rows.append(
            {
                "temperature_C": temperature,
                "compression_ratio_pct": compression,
                "aging_days": day,
                "quantity": "steady",
                "parameter": name,
                "value": value,
                "se": se,
                "lo95": value - 2.1 * se,
                "hi95": value + 2.1 * se,
                "u_sys": 0.0024 if name.startswith("mu") else 0.0,
                "unit": unit,
                "identified": known,
                "reason": None if known else "fewer than two speeds lie below 2 v_s",
            }
        )
    shared = {
        "temperature_C": temperature,
        "compression_ratio_pct": compression,
        "aging_days": day,
        "identified": True,
    }
    rows.append({**shared, "quantity": "statistics", "parameter": "rmse_N", "value": 0.31, "unit": "N"})
    return rows


def aging_fit(fits):
    rows = []
    series = [s for s in dict.fromkeys(fits["series"]) if s != "unaged"]
    for k, name in enumerate(series):
        for quantity, mu_0, a, b in (("mu_s", 0.93513, 0.04448, 0.0804), ("mu_c", 0.609, 0.03307, 0.1324)):
            c = -a * np.log(b)
            for parameter, value, se, unit in (
                ("mu_0", mu_0, 0.004, ""),
                ("a", a, 0.0011, ""),
                ("b", b, 0.021, "d"),
                ("c", c, 0.011, ""),
            ):
                value = value * (1 + 0.01 * k)
                known = not (k == 1 and parameter == "b" and quantity == "mu_c")
                rows.append(
                    {
                        "series": name,
                        "rubber": "rubber",
                        "quantity": quantity,
                        "parameter": parameter,
                        "value": value,
                        "se": se,
                        "lo95": value - 2.3 * se,
                        "hi95": value + 2.3 * se,
                        "u_sys": 0.0024 if parameter == "mu_0" else 0.0002,
                        "unit": unit,
                        "identified": known,
                        "reason": None
                        if known
                        else "no tested day is near b: only a and mu_0 - c are determined",
                    }
                )
    return table("aging_fit", rows)


def aging_curves(fits, last):
    rows = []
    for name, group in fits[fits["aging_days"] > 0].groupby("series", sort=False):
        t, c = group[["temperature_C", "compression_ratio_pct"]].iloc[0]
        for k, quantity in enumerate(("mu_s", "mu_c")):
            for day in np.linspace(0, last, 60):
                value = law(t, c, day)[k]
                rows.append(
                    {
                        "series": name,
                        "quantity": quantity,
                        "aging_days": day,
                        "value": value,
                        "lo95": value - 0.008,
                        "hi95": value + 0.008,
                    }
                )
    return table("aging_curves", rows)


def trace(run, condition, mean, speed, drop, points, rng):
    x = np.linspace(0, 40, points)
    rise = 1 - np.exp(-x / 0.4)
    force = mean * rise * (1 - drop * (1 - np.exp(-x / speed / TAU))) + rng.normal(0, 0.15, points)
    return pd.DataFrame(
        {
            "run_id": run,
            "direction": 1,
            "temperature_C": condition[0],
            "compression_ratio_pct": condition[1],
            "aging_days": condition[2],
            "displacement_mm": x,
            "force_N": force,
            "force_se_N": 0.2,
            "n": 3,
            "steady": (x > 2) & (x < 38),
        }
    )


def residuals(bins, *, after_is_before):
    found = {}
    for stage in ("before", "after"):
        model = bins["before" if after_is_before else stage]
        found[stage] = table(
            "residuals_" + stage,
            bins.drop(columns=["before", "after"]).assign(
                model_N=model,
                residual_N=bins["force_N"] - model,
                heldout_model_N=model * 1.001,
                heldout_residual_N=bins["force_N"] - model * 1.001,
                weight=1.0 / bins.groupby("file")["bin"].transform("size"),
            ),
        )
    return found


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


def closure_document(found, verdict):
    numbers = {}
    for stage, rows in found.items():
        runs = rows.groupby("run_id")["residual_N"].mean()
        numbers[stage] = {
            "rmse_N": rms(rows["residual_N"]),
            "rmse_runs_N": rms(runs),
            "heldout_rmse_N": rms(rows["heldout_residual_N"]),
            "heldout_extrapolated_rmse_N": None,
            "max_abs_N": float(rows["residual_N"].abs().max()),
            "mean_abs_pct": float((rows["residual_N"].abs() / rows["force_N"].abs()).mean() * 100),
            "lack_of_fit_p": 0.0001 if stage == "before" and verdict != "nothing_missing" else 0.42,
        }
    if verdict != "closed":
        numbers["after"] = numbers["before"]
    warming = {
        "id": "warming_time",
        "label": "warming by sliding (time), factor on mu",
        "level": "trace",
        "channels": ["time_s"],
        "acts_on": "mu",
        "operation": "multiply",
        "reference": "time 0",
        "form": "-A (1 - exp(-t / tau))",
        "named": True,
        "candidate": False,
        "parameters": [
            {"name": "A", "value": DROP, "ci95": [0.055, 0.067], "unit": ""},
            {"name": "tau", "value": 4.02, "ci95": [3.61, 4.48], "unit": "s"},
        ],
        "p_value": 0.0005,
        "heldout_gain_N": 0.93,
        "heldout_rmse_N": 0.41,
        "alternatives": [
            {"id": "warming_distance", "channels": ["distance_mm"], "acts_on": "mu", "heldout_rmse_N": 0.61}
        ],
    }
    candidate = {
        "id": "aging_induction",
        "label": "aging with an induction time",
        "level": "condition",
        "channels": ["aging_days"],
        "acts_on": "a",
        "operation": "multiply",
        "reference": "day 0",
        "form": "max(0, t - t_i)",
        "named": True,
        "candidate": True,
        "parameters": [{"name": "t_i", "value": 0.8, "ci95": [0.1, 1.6], "unit": "d"}],
        "p_value": 0.03,
        "heldout_gain_N": None,
        "heldout_rmse_N": None,
        "alternatives": [],
    }
    left = {"rmse_N": numbers["after"]["rmse_N"], "level": None, "channel": None, "p_value": None}
    left["significant"] = verdict == "unexplained"
    if left["significant"]:
        left |= {"level": "trace", "channel": "displacement_mm", "p_value": 0.0005}
    runs = [
        {
            "why": "Replicate specimens would show whether the law of aging has an induction time.",
            "conditions": {"temperature_C": 60, "compression_ratio_pct": 80, "aging_days": 1},
        }
    ]
    return {
        "schema": 1,
        "verdict": verdict,
        "fit_quality": {"state": "within_scatter", "ratio": 1.1, "p_value": 0.42},
        "sensitivity": [],
        "refused": [],
        "units": {
            "force_N": "N",
            "displacement_mm": "mm",
            "speed_mm_s": "mm/s",
            "load_N": "N",
            "time_s": "s",
        },
        "noise_floor_N": 0.262,
        **numbers,
        "heldout_unit": "run",
        "effects": {"closed": [warming, candidate]}.get(verdict, []),
        "scatter": [
            {"level": "run", "sd_rel": None, "sd_N": 0.12, "df": 41.0},
            {"level": "file", "sd_rel": 0.004, "sd_N": 0.05, "df": 80.0},
        ],
        "left": left,
        "outlier_files": [],
        "next_runs": runs if verdict == "closed" else [],
        "incomplete_channels": [],
    }


def effects(closure):
    rows = []
    for k, effect in enumerate(closure["effects"]):
        for p in effect["parameters"]:
            lo, hi = p["ci95"]
            rows.append(
                {
                    **effect,
                    "round": k + 1,
                    "channels": " ".join(effect["channels"]),
                    "parameter": p["name"],
                    "value": p["value"],
                    "lo95": lo,
                    "hi95": hi,
                    "unit": p["unit"],
                }
            )
    return table("effects", rows)


def shapes():
    x = np.linspace(0, 76, 60)
    value = -DROP * (1 - np.exp(-x / TAU))
    free = value + 0.002 * np.sin(x / 6) * (1 - np.exp(-x / TAU))
    return table(
        "shapes",
        [
            {
                "effect": 0,
                "id": "warming_time",
                "channel": "time_s",
                "x": a,
                "value": b,
                "lo95": b * 1.1,
                "hi95": b * 0.9,
                "free": c,
                "unit": "",
            }
            for a, b, c in zip(x, value, free, strict=True)
        ],
    )


def shape_points():
    """The data of `shapes`, in twelve groups."""
    x = np.linspace(3, 73, 12)
    value = -DROP * (1 - np.exp(-x / TAU)) + 0.001 * np.cos(9 * x)
    found = {"effect": 0, "channel": "time_s", "x": x, "value": value, "se": 0.0005, "unit": ""}
    return table("shape_points", found)


def levels(found):
    rows = []
    for stage, frame in found.items():
        r = frame["residual_N"]
        run = r.groupby(frame["run_id"]).transform("mean")
        file = r.groupby(frame["file"]).transform("mean") - run
        parts = {"specimen": 0.02, "run": run.std(), "file": file.std(), "sample": (r - run - file).std()}
        total = sum(sd**2 for sd in parts.values())
        rows += [
            {"stage": stage, "level": name, "sd_N": sd, "share": sd**2 / total, "df": 40.0}
            for name, sd in parts.items()
        ]
        p = 0.0005 if stage == "before" else 0.6
        rows += [
            {
                "stage": stage,
                "level": "sample",
                "channel": "time_s",
                "sd_N": 0.7,
                "share": 0.6,
                "df": 4.0,
                "p_value": p,
            },
            {
                "stage": stage,
                "level": "file",
                "channel": "operator",
                "sd_N": 0.01,
                "share": 0.001,
                "df": 1.0,
                "p_value": 0.8,
            },
        ]
    return table("levels", rows)


def channels(found):
    rows = []
    for name in (
        "displacement_mm",
        "time_s",
        "distance_mm",
        "speed_mm_s",
        "run_order",
        "aging_days",
        "repeat",
        "operator",
        "specimen_id",
    ):
        values = found["before"][name]
        numeric = pd.api.types.is_numeric_dtype(values)
        group = (
            pd.qcut(values.rank(method="dense"), 8, labels=False)
            if values.nunique() > 12 and numeric
            else values
        )
        means = {
            stage: frame.groupby([group.rename("group"), "run_id"])["residual_N"].mean()
            for stage, frame in found.items()
        }
        for key, index in values.groupby(group).groups.items():
            row = {
                "channel": name,
                "x": values[index].mean() if numeric else None,
                "label": None if numeric else values[index].iloc[0],
                "n": len(index),
                "along_motion": False,
            }
            for stage in found:
                units = means[stage][key]
                row |= {
                    f"{stage}_N": units.mean(),
                    f"{stage}_half_N": 2 * units.std() / np.sqrt(len(units)) if len(units) > 1 else None,
                    f"{stage}_run": units.abs().idxmax(),
                }
            rows.append(row)
    return table("channels", rows)


def curves(fits, speeds, drop):
    rows = []
    for condition, group in fits.groupby("condition", sort=False):
        t, c, d = group[["temperature_C", "compression_ratio_pct", "aging_days"]].iloc[0]
        mu_s, mu_c, v_s, sigma_2 = law(t, c, d)
        for speed in np.geomspace(min(speeds) / 1.2, max(speeds) * 1.05, 60):
            force = 49.03 * (mu_c + (mu_s - mu_c) * np.exp(-((speed / v_s) ** 2))) + sigma_2 * speed
            warm = np.mean(1 - drop * (1 - np.exp(-np.linspace(2, 38, 40) / speed / TAU)))
            after = force * warm
            rows.append(
                {
                    "condition": condition,
                    "series": group["series"].iloc[0],
                    "speed_mm_s": speed,
                    "load_N": 49.03,
                    "force_before_N": force * (1 - 0.6 * drop),
                    "force_after_N": after,
                    "force_after_lo95_N": after - 0.3,
                    "force_after_hi95_N": after + 0.3,
                }
            )
    return table("curves", rows)


def quality(steady):
    rows = [
        {
            "file": f,
            "check": "read",
            "severity": "info",
            "action": "kept",
            "reason": "no fault found",
            "fix": "",
            "value": "",
        }
        for f in steady["file"]
    ]
    rows += [
        {
            "file": 'traces/a "quoted" <b>.csv',
            "line": 17,
            "column": "force_N",
            "check": "bad_number",
            "value": "1,84",
            "severity": "error",
            "action": "row left out",
            "reason": "not a number.",
            "fix": "Use a decimal point.",
        },
        {
            "file": steady["file"].iloc[3],
            "stroke": 1,
            "check": "spike",
            "column": "force_N",
            "value": "91.2",
            "severity": "warning",
            "action": "kept",
            "reason": "force_N jumps by 40 between two samples.",
            "fix": "Look at the cable.",
        },
    ]
    return table("quality", rows)


def inputs(files):
    return [{"file": f, "size": 51234, "sha256": "ab" * 32} for f in files]
