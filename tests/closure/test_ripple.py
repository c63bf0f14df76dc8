from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from bins_helpers import make_bins

from sealfit.closure import ripple_selection
from sealfit.closure.confirm import Context
from sealfit.closure.ripple_selection import turns_joined
from sealfit.closure.ripples import (
    Peak,
    _coherent,
    _incoherent,
    _with_shared_phase,
    find_ripple,
    unresolved_wave,
)
from sealfit.closure.spectrum import Spectrum
from sealfit.config import Config
from sealfit.effects import EFFECTS
from sealfit.fit.joint.model import Term
from sealfit.fit.joint.rows import make_rows
from sealfit.fit.joint.search import start_model


def make_samples(
    seed=0,
    files=12,
    amplitude=0.0,
    wavelength=3.0,
    phase="common",
    directions=(1, -1),
    noise_N=0.2,
    along="x",
):
    rng = np.random.default_rng(seed)
    tables = []
    for k in range(files):
        own = rng.uniform(0, 2 * np.pi) if phase == "free" else 0.4
        for stroke, direction in enumerate(directions, start=1):
            speed = 10.0 + 0.7 * k
            n = 400
            t = np.arange(n) * 0.01
            x = 5.0 + direction * speed * t + (0 if direction > 0 else 40)
            place = x if along == "x" else t * 10
            force = (
                5.0 * direction
                + amplitude * np.sin(2 * np.pi * place / wavelength + own)
                + rng.normal(0, noise_N, n)
            )
            tables.append(
                pd.DataFrame(
                    {
                        "stroke_id": 2 * k + stroke,
                        "direction": direction,
                        "unit": k,
                        "displacement_mm": x,
                        "time_s": t,
                        "residual_N": force,
                    }
                )
            )
    return pd.concat(tables, ignore_index=True)


def test_common_phase_ripple_is_found_at_its_wavelength_below_the_noise():
    peak = find_ripple(make_samples(amplitude=0.05), common_phase=True)
    assert (peak.axis, peak.common_phase, peak.sign_symmetric) == ("displacement_mm", True, True)
    assert peak.wavelength == pytest.approx(3.0, rel=0.01)
    assert peak.p_value < 1e-4


def test_free_phase_ripple_is_found_by_its_power():
    peak = find_ripple(make_samples(amplitude=0.12, phase="free"), common_phase=False)
    assert (peak.axis, peak.common_phase) == ("displacement_mm", False)
    assert peak.wavelength == pytest.approx(3.0, rel=0.01)
    assert peak.p_value < 1e-4


@pytest.mark.parametrize("phase", ["common", "free"])
def test_a_ripple_of_some_files_has_one_phase_if_theirs_agree(phase):
    samples = make_samples(amplitude=0.4, phase=phase, files=24, noise_N=0.7)
    quiet = make_samples(seed=1, files=24, noise_N=0.7)
    samples["residual_N"] = samples["residual_N"].where(samples["unit"] % 4 == 0, quiet["residual_N"])
    peak = find_ripple(samples, common_phase=True)
    assert peak.wavelength == pytest.approx(3.0, rel=0.02)
    assert peak.p_value < 1e-3
    assert peak.common_phase == (phase == "common")


def test_a_backlash_between_the_directions_leaves_no_common_phase():
    samples = make_samples(amplitude=0.4, files=24, noise_N=0.7)
    place, back = samples["displacement_mm"], samples["direction"] < 0
    moved = np.sin(2 * np.pi * (place - 0.75) / 3.0 + 0.4) - np.sin(2 * np.pi * place / 3.0 + 0.4)
    shifted = samples.assign(residual_N=samples["residual_N"] + 0.4 * moved.where(back, 0.0))
    peak = Peak("displacement_mm", 3.0, True, False, 9.0, 1e-9, 1.0)  # of the mean power
    assert _with_shared_phase(peak, samples).common_phase
    assert not _with_shared_phase(peak, shifted).common_phase


def test_hum_in_time_is_not_taken_for_position():
    peak = find_ripple(make_samples(amplitude=0.15, along="t"), common_phase=True)
    assert peak.axis == "time_s"
    assert peak.wavelength == pytest.approx(0.3, rel=0.02)


@pytest.mark.parametrize("axis", ["time_s", "displacement_mm"])
def test_a_wave_that_is_strong_at_one_speed_has_the_axis_along_which_all_speeds_show_it(axis):
    """A long slow stroke makes the spectrum in time fine, in which the hum of short strokes is broad."""
    rng, tables = np.random.default_rng(3), []
    for unit, speed in enumerate(np.repeat([2.0, 10.0, 40.0, 150.0], 6)):
        speed *= 1 + 1e-4 * rng.standard_normal()  # no two strokes have the same
        time = np.arange(0, 60.0 / speed, 1 / min(2000.0, 50.037 + 12.5 * speed))
        place = 20.0 + speed * time
        wave = time / 0.02 if axis == "time_s" else place / 3.0
        force = 0.5 * np.sin(2 * np.pi * (wave + rng.random())) + rng.normal(0, 0.2, time.size)
        own = {"stroke_id": unit, "unit": unit, "direction": 1.0, "residual_N": force}
        tables.append(pd.DataFrame({"displacement_mm": place, "time_s": time, **own}))
    peak = find_ripple(pd.concat(tables, ignore_index=True), common_phase=True)
    assert peak.axis == axis
    assert peak.wavelength == pytest.approx(0.02 if axis == "time_s" else 3.0, rel=0.01)


def test_at_one_speed_a_known_wave_of_the_position_is_not_found_again_in_time():
    samples = make_samples(amplitude=0.15)
    at_10_mm_s = 5.0 + 10.0 * samples["time_s"] * samples["direction"] + 40.0 * (samples["direction"] < 0)
    rest = 0.15 * np.sin(2 * np.pi * at_10_mm_s / 3.1)  # a wave of another length is what is left of it
    samples = samples.assign(displacement_mm=at_10_mm_s, residual_N=samples["residual_N"] + rest)
    assert find_ripple(samples, common_phase=True).p_value < 1e-4
    found = find_ripple(samples, common_phase=True, known=[("displacement_mm", 3.1)])
    assert found.p_value > 0.01 or abs(found.wavelength - (0.31 if found.axis == "time_s" else 3.1)) > 0.05


def test_axes_that_the_config_ignores_are_not_searched():
    samples = make_samples(amplitude=0.15, along="t")
    assert find_ripple(samples, common_phase=True, ignored=["time_s", "displacement_mm"]) is None
    assert find_ripple(samples, common_phase=True, ignored=["time_s"]).axis == "displacement_mm"


@pytest.mark.long
def test_noise_alone_seldom_looks_like_a_ripple():
    white = [find_ripple(make_samples(seed=s, files=10), common_phase=True).p_value for s in range(60)]
    assert np.mean(np.array(white) < 0.05) <= 0.1  # nominal 5 %; 60 draws: at most 6


@pytest.mark.long
def test_correlated_noise_is_not_a_ripple():
    found = []
    for seed in range(25):
        samples = make_samples(seed=seed, files=10, noise_N=0.0)
        rng = np.random.default_rng(seed)
        wave = rng.normal(0, 0.2, len(samples))
        for k in range(1, wave.size):
            wave[k] += 0.9 * wave[k - 1]
        found.append(find_ripple(samples.assign(residual_N=wave), common_phase=True).p_value)
    assert np.mean(np.array(found) < 0.005) <= 0.04


def short_strokes(seed=0, files=20, shape=None, each=0.0, back=False):
    """Strokes of 10 mm that start at about 50 mm; `shape(place, travelled)` is in all, `each` is random."""
    rng = np.random.default_rng(seed)
    tables = []
    for k in range(files):
        direction = -1 if back and k % 2 else 1
        travelled = np.linspace(0.0, 10.0, 200)
        x = 50.0 + rng.normal(0, 0.2) + (travelled if direction > 0 else 10.0 - travelled)
        force = rng.normal(0, 0.1, x.size)
        for number in range(1, 6):  # a smooth shape of the file's own
            force += each * rng.normal() * np.cos(np.pi * number * travelled / 10.0) / number**2
        if shape is not None:
            force += shape(x, travelled)
        own = {"stroke_id": k, "unit": k, "direction": direction}
        tables.append(
            pd.DataFrame({**own, "displacement_mm": x, "time_s": travelled / 5.0, "residual_N": force})
        )
    return pd.concat(tables, ignore_index=True)


@pytest.mark.parametrize("back", [False, True])
@pytest.mark.parametrize("wavelength", [2.4, 3.1, 4.5])
def test_a_wave_of_few_periods_per_stroke_is_found(wavelength, back):
    samples = short_strokes(shape=lambda x, _: 0.2 * np.sin(2 * np.pi * x / wavelength), each=0.3, back=back)
    peak = find_ripple(samples, common_phase=True)
    assert (peak.axis, peak.common_phase, peak.sign_symmetric) == ("displacement_mm", True, True)
    assert peak.wavelength == pytest.approx(wavelength, rel=0.03)
    assert peak.p_value < 1e-6


def backward_only(shape, each):
    """Strokes both ways, with a shape in backward ones."""
    samples, without = (short_strokes(shape=own, each=each, back=True) for own in (shape, None))
    return samples.where(samples["direction"] < 0, without)


def test_a_wave_of_few_periods_in_one_direction_is_found():
    samples = backward_only(lambda x, _: 0.2 * np.sin(2 * np.pi * x / 3.1), each=0.1)
    peak = find_ripple(samples, common_phase=True)
    assert (peak.axis, peak.common_phase, peak.sign_symmetric) == ("displacement_mm", True, True)
    assert peak.wavelength == pytest.approx(3.1, rel=0.03)
    assert peak.p_value < 1e-6


SMOOTH = {
    "warming": lambda _, travelled: 2.0 * np.exp(-travelled / 2.0),
    "the rest of a rise": lambda _, travelled: -np.exp(-travelled / 0.7),
    "a step": lambda x, _: 0.5 * (x > 54.0),
    "a bump": lambda x, _: 0.5 * np.exp(-0.5 * ((x - 56.0) / 0.8) ** 2),
    "a slope that changes": lambda x, _: 0.3 * np.maximum(x - 54.0, 0.0),
}


@pytest.mark.parametrize("back", [False, True])
@pytest.mark.parametrize("shape", SMOOTH)
def test_a_smooth_shape_of_all_strokes_is_no_wave(shape, back):
    samples = short_strokes(shape=SMOOTH[shape], each=0.1, back=back)
    for own in (samples, backward_only(SMOOTH[shape], each=0.1)) if back else (samples,):
        assert find_ripple(own, common_phase=True).p_value > 1e-3


@pytest.mark.long
def test_smooth_shapes_of_files_seldom_look_like_a_wave():
    found = [find_ripple(short_strokes(s, files=8, each=0.5), common_phase=True).p_value for s in range(60)]
    assert np.mean(np.array(found) < 0.05) <= 0.1  # nominal 5 %


def one_file(seed=0, amplitude=0.0):
    """Sixteen strokes of one file, forward and back in turn, at three speeds."""
    samples = make_samples(seed, 16, amplitude, directions=(1,))
    back = samples["unit"] % 2 == 1
    samples = samples.assign(direction=np.where(back, -1, 1))
    return samples.assign(unit=0, time_s=samples["time_s"] * (1.0 + samples["stroke_id"] % 3))


def test_a_ripple_of_one_file_is_the_same_in_all_of_its_strokes():
    peak = find_ripple(one_file(amplitude=0.1), common_phase=True)
    assert (peak.axis, peak.common_phase) == ("displacement_mm", True)
    assert peak.wavelength == pytest.approx(3.0, rel=0.01)
    assert peak.p_value < 1e-4


@pytest.mark.long
def test_noise_of_one_file_seldom_looks_like_a_ripple():
    white = [find_ripple(one_file(seed), common_phase=True).p_value for seed in range(60)]
    assert np.mean(np.array(white) < 0.05) <= 0.1  # nominal 5 %


def test_too_few_samples_say_nothing():
    samples = make_samples(files=2)
    assert find_ripple(samples[samples.groupby("stroke_id").cumcount() < 10], common_phase=True) is None


def test_a_slow_wave_in_time_is_not_taken_for_one_wavelength_at_the_slowest_speed():
    tables = []
    for k, speed in enumerate((0.5, 1.0, 2.0, 4.0, 8.0) * 4):
        t = np.linspace(0, 40 / speed, 300)
        force = np.sin(2 * np.pi * t / 1.7 + k) + np.random.default_rng(k).normal(0, 0.1, t.size)
        tables.append(
            pd.DataFrame(
                {
                    "stroke_id": k,
                    "direction": 1,
                    "unit": k,
                    "displacement_mm": 3.0 * np.sin(k) + speed * t,
                    "time_s": t,
                    "residual_N": force,
                }
            )
        )
    peak = find_ripple(pd.concat(tables, ignore_index=True), common_phase=True)
    assert peak.axis == "time_s"
    assert peak.wavelength == pytest.approx(1.7, rel=0.02)
    assert peak.p_value < 1e-3


def test_noise_of_the_strokes_that_are_sampled_most_finely_is_no_ripple_where_only_they_reach():
    rng = np.random.default_rng(0)
    steps = (0.2638, 0.2641, 0.2647, 0.266, 0.268, 0.2725, 0.281, 0.292)  # each speed has its own
    tables = []
    for k in range(800):
        x = rng.uniform(0.0, 4.0) + steps[k % 8] * np.arange(60) + rng.normal(0.0, 0.002, 60)
        own = {"stroke_id": k, "unit": k, "direction": 1.0, "displacement_mm": x, "time_s": x / (1 + k % 8)}
        tables.append(pd.DataFrame({**own, "residual_N": rng.normal(0.0, 0.1, 60)}))
    peak = find_ripple(pd.concat(tables, ignore_index=True), common_phase=True)
    assert peak.p_value > 0.05


def turns(direction=1, files=6, number=4, turn=360.0, noise=0.3, seed=0):
    """Return samples of rotations cut into turns, with one wave a turn and the drift of each file."""
    rng = np.random.default_rng(seed)
    strokes = [(file, stroke) for file in range(files) for stroke in range(1, number + 1)]
    of_file = rng.normal(size=(files, 3))
    parts = []
    for file, stroke in strokes:
        place = ((np.arange(200) + 0.5) * turn / 200)[::direction]
        along = stroke - 1 + (place if direction > 0 else turn - place) / turn
        wave = np.sin(2 * np.pi * place / turn + 1.0)
        residual = wave + of_file[file] @ np.vander(along / number, 3).T + noise * rng.normal(size=200)
        parts.append(pd.DataFrame({"displacement_mm": place, "residual_N": residual, "time_s": along}))
    own = [samples.assign(unit=f, stroke=s) for (f, s), samples in zip(strokes, parts, strict=True)]
    every = pd.concat(own, ignore_index=True).assign(direction=direction)
    return every.assign(stroke_id=every.groupby(["unit", "stroke"]).ngroup())


@pytest.mark.parametrize("direction", [1, -1])
def test_one_wave_a_turn_is_found_where_turns_are_strokes(direction):
    """A wave of one period a stroke cannot be distinguished from a slow change of each stroke."""
    cut = turns(direction)
    joined = turns_joined(cut, 360.0)
    assert joined["stroke_id"].nunique() == 6
    assert np.all(np.diff(joined["displacement_mm"].to_numpy()[:800]) * direction > -1e-9)
    found = find_ripple(joined, common_phase=True)
    assert found.wavelength == pytest.approx(360.0, rel=0.01)
    assert found.p_value < 1e-3


def test_turns_are_joined_only_where_nothing_lies_between_them():
    cut = turns(files=2)
    gone = cut[(cut["unit"] != 0) | (cut["stroke"] != 2)]  # a turn without steady window
    risen = cut[(cut["unit"] != 1) | (cut["stroke"] != 3) | (cut["displacement_mm"] > 40.0)]
    assert list(turns_joined(gone, 360.0)["stroke_id"].unique()) == [0, 2, 4]
    assert list(turns_joined(risen, 360.0)["stroke_id"].unique()) == [0, 4, 6]


def test_a_round_that_tries_a_ripple_says_so_first(monkeypatch):
    said, peak = [], SimpleNamespace(p_value=1e-9)
    monkeypatch.setattr(ripple_selection, "find_ripple", lambda *samples, **known: peak)
    monkeypatch.setattr(ripple_selection, "propose_ripples", lambda *tried: said.append("tried") or [])
    ripples = ripple_selection.Ripples(pd.DataFrame({"force_N": [1.0]}), Context(Config(), {}, said.append))
    monkeypatch.setattr(ripple_selection, "channels_of", lambda rows, config: [])
    ripples.added_to(SimpleNamespace(rows=None), None)
    assert said == ["round 1: a significant ripple in the samples, before all other effects", "tried"]


def test_a_spectrum_that_only_falls_has_no_peak():
    """Its low end has the smooth shapes of strokes."""
    frequency = np.linspace(0.1, 3.0, 30)
    falling, ones = 1 / frequency**2, np.ones(30)
    spectrum = Spectrum(
        "displacement_mm", frequency, ones > 1, 12 * ones, falling, falling, (12 * falling)[None] + 0j,
        falling[None], falling[None] + 0j, np.array([12]),
    )  # fmt: skip
    assert _coherent(spectrum) == []
    assert _incoherent(spectrum) == []


@pytest.mark.parametrize(
    ("length", "axis", "unresolved"),
    [(4.2, "displacement_mm", True), (5.0, "displacement_mm", False), (4.2, "distance_mm", False)],
)
def test_a_second_wave_needs_another_length_within_a_stroke(length, axis, unresolved):
    """Strokes of 38 mm have 9.5 periods of 4 mm, 9.0 of 4.2 mm and 7.6 of 5 mm."""
    rows = make_rows(make_bins(bins=20, temperatures=(60.0,)), has_aging=True)
    model = start_model(rows)
    for place, wave in (("displacement_mm", 4.0), (axis, length)):
        term = Term(EFFECTS["ripple"], (place,), "mu", "multiply")
        model = model.with_term(term, {"A": 0.02, "lambda_": wave, "phi": 0.0})
    assert unresolved_wave(model, rows) == unresolved
    assert not unresolved_wave(model.without_term(0), rows)
