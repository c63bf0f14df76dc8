"""Tables of the dynamic fit as reports get them: exponential rises over G / sigma_0, a peak at top speed."""

import numpy as np
import pandas as pd
from report.made_tables import law, table

from sealfit.ingest.columns import add_keys

SIGMA_0, SIGMA_1 = 100.0, 0.5
PEAK = 0.08


def starts(conditions, speeds, config, peak=True):
    """Return `dynamic_fit` and `dynamic_curves` of an aging campaign's conditions."""
    rows, curves = [], []
    for temperature, compression, day in conditions:
        own = {"temperature_C": temperature, "compression_ratio_pct": compression, "aging_days": day}
        mu_s, mu_c, v_s, _ = law(temperature, compression, day)
        for name, value, unit, known in (
            ("sigma_0", SIGMA_0, "N/mm", True),
            ("sigma_1", SIGMA_1, "N s/mm", day > 0),
        ):
            rows.append(
                {
                    **own, "quantity": "dynamic", "parameter": name, "value": value, "se": 0.01 * value,
                    "lo95": 0.98 * value, "hi95": 1.02 * value, "u_sys": 0.004 * value, "unit": unit,
                    "identified": known,
                    "reason": "" if known else "no damping of the bristles is seen: at most 0.6",
                }
            )  # fmt: skip
        for speed in speeds:
            limit = 49.03 * (mu_c + (mu_s - mu_c) * np.exp(-((speed / v_s) ** 2)))
            x = np.linspace(0.02, 2.5, 40)
            force = limit * (1 - np.exp(-x * SIGMA_0 / limit))
            curves.append(
                pd.DataFrame(
                    {**own, "speed_set_mm_s": speed, "direction": 1, "distance_mm": x, "n": 3}
                ).assign(force_N=force, force_se_N=0.05, model_N=force)
            )
            high = 1 + PEAK if peak and speed == max(speeds) else 1.0
            for name, value, unit in (("F_ba", limit * high, "N"), ("F_ba/F", high, "")):
                rows.append(
                    {
                        **own, "quantity": "break_away", "parameter": name, "value": value,
                        "se": 0.003 * value, "lo95": 0.99 * value, "hi95": 1.01 * value, "unit": unit,
                        "identified": True,
                        "reason": "" if high > 1 else "no peak", "speed_set_mm_s": speed, "direction": 1,
                    }
                )  # fmt: skip
    fit = add_keys(pd.DataFrame(rows), config)
    curves = add_keys(pd.concat(curves, ignore_index=True), config)
    return {"dynamic_fit": table("dynamic_fit", fit), "dynamic_curves": table("dynamic_curves", curves)}
