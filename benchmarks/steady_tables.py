"""Tables `steady` with known truth, made from the equations without traces: for counts of many campaigns."""

from __future__ import annotations

from itertools import product

import numpy as np
import pandas as pd

from sealfit.physics import aging_law, stribeck_force

# Law of the source at 80 degC and 80 %.
MU_S = {"mu_0": 0.93513, "a": 0.04448, "b": 0.0804}
MU_C = {"mu_0": 0.609, "a": 0.03307, "b": 0.1324}
SPEEDS = (0.5, 1, 2, 4, 8, 16, 32, 64)


def steady_rows(
    *,
    seed=1,
    speeds=SPEEDS,
    days=(0, 1, 2, 4, 8, 16),
    series=((60.0, 80.0),),
    repeats=3,
    noise=0.004,
    setup=0.0,
    specimen=0.0,
    specimens=1,
    constant=0.0,
    load=49.03,
    ways=(1, -1),
    together=False,
    commanded=True,
    model=None,
    laws=None,
):
    """Table `steady` of a campaign with known truth; noise, setup and specimen are relative, constant in N.

    Each condition has `specimens`, tested at all speeds. With `together` both directions are in one file and
    share its set-up and noise.
    """
    rng = np.random.default_rng(seed)
    rows, drawn = [], {}

    def once(*key):
        """A standard normal number, the same in both directions of one file."""
        if key not in drawn:
            drawn[key] = rng.normal()
        return drawn[key]

    for place, (temperature, compression) in enumerate(series):
        law_s, law_c = (laws or {}).get((temperature, compression), (MU_S, MU_C))
        for day in days:
            if day == 0 and place > 0:
                continue
            truth = model or {
                "mu_s": aging_law(day, **law_s),
                "mu_c": aging_law(day, **law_c),
                "v_s": 5.0,
                "sigma_2": 0.02,
            }
            name = f"temperature_C={temperature:g}, compression_ratio_pct={compression:g}"
            condition = "unaged" if day == 0 else f"{name}, aging_days={day:g}"
            for piece, speed, way in product(range(specimens), speeds, ways):
                own = speed if together else way * speed
                sign = ("+" if way > 0 else "-") if together else ""
                specimen_id = condition if specimens == 1 else f"{condition} {piece}"
                run_id = f"{specimen_id} {own:g}"
                force = stribeck_force(way * speed, load if load else 1.0, **truth)
                force *= (1 + specimen * once(specimen_id)) * (1 + setup * once(run_id))
                for repeat in range(1, repeats + 1):
                    error = noise * once(run_id, repeat)
                    rows.append(
                        {
                            "file": f"{run_id} {repeat}.csv",
                            "run_id": f"{run_id}{sign}",
                            "repeat": repeat,
                            "stroke": 1,
                            "direction": way,
                            "specimen_id": specimen_id,
                            "condition": condition,
                            "series": "unaged" if day == 0 else name,
                            "rubber": "rubber",
                            "speed_mm_s": way * speed,
                            "speed_set_mm_s": speed if commanded else np.nan,
                            "load_N": load if load else np.nan,
                            "force_N": float(force) * (1 + error)
                            + (constant * rng.normal() if constant else 0.0),
                            "used": True,
                            "temperature_C": temperature,
                            "compression_ratio_pct": compression,
                            "aging_days": float(day),
                        }
                    )
    return pd.DataFrame(rows)
