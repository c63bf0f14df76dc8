"""Campaigns made of the measured data that the environment variable SEALFIT_MEASURED names.

EMPS (Janot, Gautier and Brunot 2019) is one record of trapezoidal moves; its parts at constant speed are cut
out here, one file each, where the mass does not accelerate and the force of the drive is friction.
"""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import numpy as np
import pandas as pd

ROOT = Path(__file__).resolve().parents[1]
# Published gain of the drive in N/V.
FORCE_PER_VOLT = 35.15065
# Speeds of the plateaus in mm/s.
SPEEDS = (42.0, 83.0, 125.0)
# A plateau has less acceleration (mm/s^2) and more speed (mm/s) than these.
STILL, MOVING = 60.0, 15.0
# Smallest number of samples of a plateau, and number of samples excluded at each end.
SHORTEST, MARGIN = 120, 30
EMPS_CONFIG = """
name = "emps"
condition = ["axis"]
position_origin = "rig"
[strokes]
whole_file = true
"""
KIDNEY_CONFIG = """
name = "kidney"
condition = ["set_pressure_bar"]
position_origin = "rig"
[bins]
per_stroke = 100
min_samples = 2
"""


def measured() -> Path | None:
    """Return the folder of measured data, None where the environment names none."""
    named = os.environ.get("SEALFIT_MEASURED")
    return Path(named) if named else None


def kidney(source: Path, folder: Path) -> Path:
    """Copy the traces of pneuseal-kidney to the campaign `folder` and return its config."""
    shutil.copytree(source / "pneuseal-kidney" / "raw", folder / "raw")
    return ROOT / "configs" / "kidney.toml"


def kidney_plain(source: Path, folder: Path) -> Path:
    """Write pneuseal-kidney as a campaign with default columns, force on the piston less the pressure's part.

    The author's piston area, and without the first 15 rows of each file, as `configs/kidney.toml` has it.
    """
    folder.mkdir(parents=True)
    rows = []
    for path in sorted((source / "pneuseal-kidney" / "raw").glob("*.csv")):
        raw = np.loadtxt(path)[15:]
        force = raw[:, 6] - raw[:, 5] * 1e5 * np.pi * (0.0257 / 2) ** 2
        trace = {
            "time_s": raw[:, 0] / 1000,
            "displacement_mm": raw[:, 4],
            "force_N": force,
            "pressure_bar": raw[:, 5],
        }
        pd.DataFrame(trace).to_csv(folder / path.name, index=False)
        rows.append({"file": path.name, "set_pressure_bar": int(path.stem[-4])})
    pd.DataFrame(rows).to_csv(folder / "runs.csv", index=False)
    config = folder.with_suffix(".toml")
    config.write_text(KIDNEY_CONFIG)
    return config


def emps_plateaus(source: Path, folder: Path, most: int = 16) -> Path:
    """Write the first `most` plateaus of EMPS to the campaign `folder`, a file each.

    Return its config, which is written beside it.
    """
    table = pd.read_csv(source / "emps" / "csv" / "DATA_EMPS.csv")
    time, place = table["time_s"].to_numpy(), 1e3 * table["position_m"].to_numpy()
    speed = _smooth(np.gradient(place, time), 51)
    flat = (np.abs(np.gradient(speed, time)) < STILL) & (np.abs(speed) > MOVING)
    ends = np.flatnonzero(np.diff(np.r_[0, flat.astype(int), 0])).reshape(-1, 2)
    folder.mkdir(parents=True)
    rows = []
    long = ends[np.diff(ends, axis=1)[:, 0] >= SHORTEST]
    for first, end in long[:most] + np.array([MARGIN, -MARGIN]):
        own = slice(first, end)
        trace = pd.DataFrame(
            {
                "time_s": time[own] - time[first],
                "displacement_mm": place[own],
                "force_N": FORCE_PER_VOLT * table["motor_V"].to_numpy()[own],
            }
        )
        file = f"plateau{len(rows):02d}.csv"
        trace.to_csv(folder / file, index=False)
        commanded = min(SPEEDS, key=lambda s, own=own: abs(abs(speed[own].mean()) - s))
        rows.append({"file": file, "axis": "EMPS", "speed_mm_s": commanded})
    pd.DataFrame(rows).to_csv(folder / "runs.csv", index=False)
    config = folder.with_suffix(".toml")
    config.write_text(EMPS_CONFIG)
    return config


def _smooth(values: np.ndarray, width: int) -> np.ndarray:
    return np.convolve(values, np.full(width, 1 / width), "same")
