from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from bins_helpers import make_bins

from sealfit.closure.predict import _of_unknown_phase
from sealfit.closure.ripples import agreement, common_wavelength, pass_shifts
from sealfit.closure.spectrum import _on_grid
from sealfit.effects import EFFECTS
from sealfit.fit.joint.model import Term, passes
from sealfit.fit.joint.rows import make_rows


def made(seed=0, files=10, wavelength=3.0, amplitude=0.1, trend=4.0, noise_N=0.1, periods=9.0):
    """Samples of one stroke per file, each with a phase of its own on a steep trend."""
    rng = np.random.default_rng(seed)
    tables, phases = [], rng.uniform(0, 2 * np.pi, files)
    for k in range(files):
        x = np.linspace(2.0, 2.0 + periods * wavelength, 300)
        wave = amplitude * np.sin(2 * np.pi * x / wavelength + phases[k])
        force = trend * (x / x[-1]) ** 2 + wave + rng.normal(0, noise_N, x.size)
        own = {"stroke_id": k, "unit": k, "direction": 1.0, "displacement_mm": x, "residual_N": force}
        tables.append(pd.DataFrame(own))
    return pd.concat(tables, ignore_index=True), phases


@pytest.mark.parametrize("periods", [3.5, 9.0, 25.0])
def test_wavelength_is_found_under_a_steep_trend_and_its_error_covers(periods):
    missed = []
    for seed in range(20):
        samples, _ = made(seed, periods=periods)
        length, error = common_wavelength(samples, 3.0 * (1 + 0.1 / periods), "displacement_mm")
        missed.append(abs(length - 3.0) / error)
    assert np.mean(np.array(missed) < 2.26) >= 0.8  # t, 9 degrees of freedom: 95 %; 20 draws


def test_phase_of_each_pass_is_found_about_its_middle():
    samples, phases = made(noise_N=0.02)
    bins = make_bins(temperatures=(60.0,), days=(4.0,), speeds=(1.0, 2.0, 4.0, 8.0, 16.0), repeats=1, bins=3)
    rows = make_rows(bins.assign(stroke_id=np.arange(len(bins)) // 3), has_aging=False)
    shifts = pass_shifts(samples, rows, 3.0, "displacement_mm")
    middle = 2.0 + 4.5 * 3.0
    for shift, phase in zip(shifts.values(), phases, strict=True):
        assert abs(middle + shift) <= 1.5 + 1e-9
        assert np.cos(2 * np.pi * shift / 3.0 - phase) > 0.99


def test_strokes_split_into_files_keep_the_passes_of_their_record():
    """Whatever files are left: the first of a record may be among those held out."""
    bins = make_bins(
        temperatures=(60.0,), days=(4.0,), speeds=(1.0, 2.0), directions=(1, -1), repeats=2, bins=3
    )
    way = np.where(bins["direction"] > 0, "+", "-")
    bins["stroke"] = 2 * bins["repeat"] - (bins["direction"] > 0)
    run = bins["run_id"].str.replace("-", "")
    bins = bins.assign(run_id=run + way, repeat=1, stroke_id=np.arange(len(bins)) // 3)
    rows = make_rows(bins, has_aging=False)
    assert rows.groups.starts["file"].size == rows.groups.starts["run"].size == 2 * len(rows.conditions)
    names = passes(rows.table)
    assert names.nunique() == 2 * rows.groups.starts["file"].size
    later = rows.subset(rows.table["stroke"].to_numpy() > 2)
    assert set(passes(later.table)) == set(names)
    assert set(later.table["file"]).isdisjoint(rows.table["record"])


def test_halves_agree_on_a_wave_and_on_nothing_else():
    samples, _ = made()
    first = samples["displacement_mm"].to_numpy() < 2.0 + 4.5 * 3.0
    assert (agreement(samples, first, 3.0, "displacement_mm") > 0).all()
    noise, _ = made(amplitude=0.0, files=40)
    first = noise["displacement_mm"].to_numpy() < 2.0 + 4.5 * 3.0
    assert 8 <= (agreement(noise, first, 3.0, "displacement_mm") > 0).sum() <= 32


def test_parabola_is_no_wave():
    x = np.linspace(-3.0, 8.0, 50)
    value = 3 - 2 * x + 0.5 * x**2
    trend, _ = _on_grid(x.size)
    np.testing.assert_allclose(value - trend @ (trend.T @ value), 0.0, atol=1e-10)


def test_the_unknown_phase_of_a_pass_counts_as_much_as_the_wave_is_strong_there():
    bins = make_bins(temperatures=(60.0,), days=(4.0,), speeds=(1.0, 2.0), directions=(1, -1), bins=3)
    rows = make_rows(bins, has_aging=False)
    fixed = {"shift": {}, "z_ref": 0.0}
    names = ("displacement_mm", "direction")
    term = Term(EFFECTS["sinusoid_changing"], names, "force", "add", fixed)
    values = {"A": 0.5, "B": 0.5, "lambda_": 3.0, "phi": 0.0}
    after = SimpleNamespace(terms=(term,), values=(values,))
    variance = _of_unknown_phase(after, rows, rows.force)
    np.testing.assert_allclose(variance, np.where(rows.speed > 0, 0.5, 0.0))
