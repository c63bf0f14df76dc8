"""The solvers on measurements by others; the folder is named by the environment variable SEALFIT_MEASURED."""

import os
from pathlib import Path

import numpy as np
import numpy.testing as npt
import pandas as pd
import pytest
from scipy import stats

from sealfit.fit.aging.law import solve_law
from sealfit.fit.least_squares import Separable, global_optimum
from sealfit.fit.steady.stribeck import solve_stribeck

MEASURED = os.environ.get("SEALFIT_MEASURED")
pytestmark = pytest.mark.skipif(MEASURED is None, reason="SEALFIT_MEASURED names no folder of measured data")


# ------------------------------------------------------ screw drives: Eq. 14 with 16 and 23 speeds each way
def drive(number):
    """Mean speed (rpm) and torque (mN m) of each file less its first 50 samples; the authors' conversion."""
    folder = Path(MEASURED) / "screwdrive" / "raw" / f"driveNo{number}" / "steady_state" / "0.096kg"
    means = []
    for path in sorted(folder.glob("*.csv")):
        lines = path.read_text("latin-1").splitlines()
        start = next(i for i, line in enumerate(lines) if line.startswith("ms;")) + 51
        rows = [line.split(",")[0].split(";")[1:3] for line in lines[start:] if line.strip(" ,")]
        rpm, percent = np.array(rows, float).mean(axis=0)
        means.append((-rpm, -percent * 9.84 / 100))
    speed, torque = np.array(means).T
    return np.sign(speed), np.abs(speed), torque


# drive, files, RMS of the symmetric fit, RMS with offset, (F_c, F_s, v_s, sigma_2, offset): README of the
# data
DRIVES = [
    (1, 32, 0.357, 0.047, (2.60, 3.11, 33.0, 0.0046, -0.354)),
    (3, 46, 0.482, 0.079, (1.36, 1.51, 3.07, 0.0015, -0.475)),
]


@pytest.mark.parametrize(("number", "files", "symmetric", "with_offset", "expected"), DRIVES)
def test_screw_drive(number, files, symmetric, with_offset, expected):
    way, speed, torque = drive(number)
    assert speed.size == files
    one = np.ones((1, files))
    plain = solve_stribeck(speed[None], one, (torque * way)[None], one)
    npt.assert_allclose(np.sqrt(plain.rss[0] / files), symmetric, atol=6e-4)

    def basis(u, rows):
        decay = np.exp(-((speed * np.exp(-u)[..., None]) ** 2))
        steady = [np.broadcast_to(x, decay.shape) for x in (way * speed, np.ones(files))]
        return np.stack([way * (1 - decay), way * decay, *steady], axis=-1)

    grid = np.log(np.geomspace(speed.min() / 5, speed.max() * 20, 500))[None]
    fit = global_optimum(Separable(basis, torque[None], one, [True, True, True, False]), grid)
    npt.assert_allclose(np.sqrt(fit.rss[0] / files), with_offset, atol=6e-4)
    found = [*fit.coefficients[0, :2], np.exp(fit.u[0]), *fit.coefficients[0, 2:]]
    printed = [0.005, 0.005, {1: 0.05, 3: 0.005}[number], 5e-5, 5e-4]  # half of the last digit there
    assert np.all(np.abs(np.array(found) - expected) <= np.array(printed) * 1.01), found


# ---------------------------------------------------------------- ageing tables: Eq. 15, read in place
# table, temperature, a, b in days, RMS, pure error of the repeats, p of the lack of fit: README of the data
AGEING = [
    ("AdhesiveFormulationK", 40, 9.7, 0.53, 4.1, 4.3, 0.50),
    ("AdhesiveFormulationK", 50, 7.0, 0.015, 3.6, 3.9, 1.0),
    ("AdhesiveFormulationK", 60, 3.3, 6e-7, 3.4, 3.6, 0.76),
    ("PolymerY", 50, 8.8, 15.6, 1.6, 1.8, 0.55),
    ("PolymerY", 65, 7.6, 3.8, 2.4, 2.4, 0.15),
    ("PolymerY", 80, 8.6, 1.3, 1.8, 2.0, 0.90),
]


@pytest.mark.parametrize(("name", "temperature", "a", "b", "rms", "pure", "p"), AGEING)
def test_ageing_strength(name, temperature, a, b, rms, pure, p):
    table = pd.read_csv(Path(MEASURED) / "aging-strength" / "csv" / f"{name}.csv")
    own = table[
        (table.TempC == temperature) | (table.TimeH == 0)
    ]  # fresh specimens are shared by all temperatures
    days, value = own.TimeH.to_numpy(float) / 24, own.Response.to_numpy(float)
    fit = solve_law(days[None], value[None], np.ones((1, len(own))))
    npt.assert_allclose(fit.coefficients[0, 1], a, atol=0.06)
    npt.assert_allclose(np.exp(fit.u[0]), b, rtol=0.1)
    npt.assert_allclose(np.sqrt(fit.rss[0] / len(own)), rms, atol=0.06)
    cells = own.groupby("TimeH").Response
    within, df = ((cells.count() - 1) * cells.var().fillna(0)).sum(), len(own) - cells.ngroups
    npt.assert_allclose(np.sqrt(within / df), pure, atol=0.06)
    lack = (fit.rss[0] - within) / (cells.ngroups - 3)
    npt.assert_allclose(stats.f.sf(lack / (within / df), cells.ngroups - 3, df), p, atol=0.01)
