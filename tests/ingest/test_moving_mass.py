"""Campaigns of motions with several steady speeds, of turns, and with a moving mass."""

import numpy as np
import numpy.testing as npt
import pandas as pd
import pytest
from trace_helpers import config

from sealfit.errors import CampaignError, ConfigError
from sealfit.fit.dynamic.starts import strokes_along
from sealfit.fit.joint.rows import nesting_run, records
from sealfit.fit.steady.uncertainty import merge_directions, run_means
from sealfit.ingest.campaign import ingest_campaign
from sealfit.ingest.strokes import displacement_noise_mm, resolution_mm
from sealfit.ingest.window import acceleration

ONE = 'condition = ["lot"]\nfiles.glob = "*.csv"\nruns.constants = {lot = "A", run_id = "A"}\n'
LOAD_N, MU, SIGMA_2, MASS_KG, STIFFNESS = 100.0, 0.3, 0.05, 40.0, 400.0


def moved(legs, hertz=1000, *, jitter=0.0, blur=1e-4, noise=0.2, seed=0, mass_kg=MASS_KG):
    """Time, displacement and driving force of a mass that a drive moves against a LuGre bristle of mu.

    A leg is (seconds, mm/s at its end), the speed straight in between. The driving force is that of the
    bristle, integrated here, plus viscous friction and mass times acceleration. `jitter` varies time steps.
    """
    rng = np.random.default_rng(seed)
    ends = np.cumsum([0.0, *(seconds for seconds, _ in legs)])
    fine = np.arange(0.0, ends[-1], 1e-4)
    speed = np.interp(fine, ends, [0.0, *(at for _, at in legs)])
    place = np.concatenate([[0.0], np.cumsum(0.5e-4 * (speed[1:] + speed[:-1]))])
    level, z, bristle = MU * LOAD_N, 0.0, np.empty(fine.size)
    for i, step in enumerate(np.diff(place, prepend=0.0)):
        z = step / abs(step) + (z - step / abs(step)) * np.exp(-abs(step) * STIFFNESS / level) if step else z
        bristle[i] = level * z
    force = bristle + SIGMA_2 * speed + 1e-3 * mass_kg * np.gradient(speed, fine)
    time = np.arange(0.0, ends[-1] - 2e-3, 1.0 / hertz)
    time[1:-1] += jitter / hertz * rng.uniform(-0.5, 0.5, time.size - 2)
    columns = [np.interp(time, fine, values) for values in (place, force)]
    sd = (blur, noise)
    return time, *(values + rng.normal(0.0, s, time.size) for values, s in zip(columns, sd, strict=True))


def steps(speeds, hold=1.0, ramp=0.1):
    """Legs of a motion through steady speeds, and back through the same."""
    there = [leg for speed in speeds for leg in ((ramp, speed), (hold, speed))] + [(ramp, 0.0), (0.3, 0.0)]
    return [(0.3, 0.0), *there, *((seconds, -speed) for seconds, speed in there)]


def ingested(folder, traces, text=ONE):
    folder.mkdir(exist_ok=True)
    for number, (time, x, force) in enumerate(traces):
        table = pd.DataFrame({"time_s": time, "displacement_mm": x, "force_N": force, "load_N": LOAD_N})
        table.to_csv(folder / f"{number}.csv", index=False)
    return ingest_campaign(folder, config(text))


def test_a_run_with_several_speeds_is_a_run_for_each(tmp_path):
    traces = [moved(steps([20.0, 40.0, 80.0, 20.0]), seed=seed, mass_kg=0.0) for seed in range(3)]
    found = ingested(tmp_path / "c", traces)
    assert found.faults == []
    tables = found.tables
    steady = tables["steady"]
    assert sorted(steady["run_id"].unique()) == [f"A at {v}{d}" for v in (20, 40, 80) for d in "+-"]
    assert steady.groupby("run_id").size().tolist() == [6, 6, 3, 3, 3, 3]
    npt.assert_allclose(steady["speed_set_mm_s"], steady["speed_mm_s"].abs(), rtol=0.01)
    expected = steady["direction"] * (MU * LOAD_N + SIGMA_2 * steady["speed_mm_s"].abs())
    npt.assert_allclose(steady["force_N"], expected, atol=0.05)
    assert set(tables["bins"]["run_id"]) == set(tables["traces_mean"]["run_id"]) == set(steady["run_id"])
    # All speeds and both directions of a file share its set-up: one run, in which the directions are merged.
    assert set(nesting_run(steady, records(steady))) == {"A"}
    means = run_means(merge_directions(steady).assign(direction=1))
    npt.assert_allclose(means["speed"], [20.0, 40.0, 80.0], rtol=0.01)
    assert means["files"].tolist() == [3, 3, 3]
    # Only the first speed of a motion begins at rest.
    begun = [stroke.row for stroke in strokes_along(tables["traces"], steady)]
    assert set(steady["stroke"].iloc[begun]) == {1, 5}


def test_strokes_of_a_file_at_several_speeds_are_a_run_for_each_unless_a_speed_is_given(tmp_path):
    legs = [leg for speed in (20.0, 80.0, 20.0, 80.0) for leg in steps([speed])[1:]]
    traces = [moved([(0.3, 0.0), *legs], seed=seed, mass_kg=0.0) for seed in range(2)]
    own = ONE.replace(', run_id = "A"', "")
    steady = ingested(tmp_path / "c", traces, own).tables["steady"]
    runs = [f"lot=A at {v}{d}" for v in (20, 80) for d in "+-"]
    assert steady.groupby("run_id").size().to_dict() == dict.fromkeys(runs, 4)
    npt.assert_allclose(steady["speed_set_mm_s"], steady["speed_mm_s"].abs(), rtol=0.01)
    given = own.replace("lot =", "speed_mm_s = 30, lot =") + "quality.speed_disagreement = 0.9\n"
    assert set(ingested(tmp_path / "c", traces, given).tables["steady"]["speed_set_mm_s"]) == {30.0}


def test_a_speed_that_never_settles_is_in_quality_and_kept(tmp_path):
    time = np.arange(0.0, 12.0, 0.005)
    x = 30.0 * (1.0 - np.cos(2.0 * np.pi * time / 4.0))
    force = 30.0 * np.tanh(10.0 * np.sin(2.0 * np.pi * time / 4.0))
    found = ingested(tmp_path / "c", [(time, x, force)])
    assert {fault.check for fault in found.faults} == {"no_plateau"}
    assert {(fault.action, fault.severity) for fault in found.faults} == {("kept", "warning")}
    assert len(found.faults) == len(found.tables["steady"]) == 6


def test_turns_of_a_rotation_share_their_positions_and_have_ripples_in_place(tmp_path):
    rng = np.random.default_rng(3)
    time = np.arange(0.0, 40.0, 0.01)
    angle = 1000.0 + 90.0 * time  # ten turns
    force = 20.0 + np.cos(np.radians(3.0 * angle)) + rng.normal(0.0, 0.1, time.size)
    units = '[quantities]\ndisplacement = {quantity = "angle", unit = "deg"}\n'
    units += 'speed = {quantity = "speed", unit = "deg/s"}\n[strokes]\nturn = 360\n'
    tables = ingested(tmp_path / "c", [(time, angle, force)], ONE + units).tables
    whole = tables["steady"].iloc[1:-1]
    assert len(whole) == 9
    assert set(tables["steady"]["run_id"]) == {"A"}
    npt.assert_allclose(whole["displacement_from_mm"], 0.0, atol=1.0)
    npt.assert_allclose(whole["displacement_to_mm"], 360.0, atol=1.0)
    npt.assert_allclose(np.diff(whole["distance_mm"]), 360.0, atol=2.0)  # it counts on
    place, residual = tables["bins"]["displacement_mm"], tables["bins"]["force_N"] - 20.0
    assert np.corrcoef(residual, np.cos(np.radians(3.0 * place)))[0, 1] > 0.98


@pytest.mark.parametrize("way", [1, -1])
def test_an_angle_that_begins_anew_at_each_turn_is_told_and_unwrapped(tmp_path, way):
    time = np.arange(0.0, 20.0, 0.01)
    angle = (1000.0 + way * 90.0 * time) % 360.0  # five turns
    force = way * (20.0 + np.random.default_rng(3).normal(0.0, 0.1, time.size))
    units = ONE + '[quantities]\ndisplacement = {quantity = "angle", unit = "deg"}\n'
    units += 'speed = {quantity = "speed", unit = "deg/s"}\n'
    with pytest.raises(CampaignError, match=r"it wraps\. Set turn = 360 under \[strokes\]"):
        ingested(tmp_path / "wrapped", [(time, angle, force)], units)
    units += "[strokes]\nturn = 360\n"
    steady = ingested(tmp_path / "turns", [(time, angle, force)], units).tables["steady"]
    assert len(steady) == 6
    npt.assert_allclose(steady["speed_mm_s"], way * 90.0, rtol=1e-3)
    npt.assert_allclose(steady["force_N"], way * 20.0, atol=0.1)


@pytest.mark.parametrize(
    ("hertz", "jitter", "blur"), [(1000, 0.0, 1e-4), (1000, 0.8, 1e-5), (100, 0.0, 1e-3)]
)
def test_mass_times_acceleration_is_taken_off_and_mu_is_recovered(tmp_path, hertz, jitter, blur):
    # From 40 to 36 mm/s in 0.4 s: 40 kg take 0.4 N off, or 1.3 %. The friction itself falls by 0.2 N.
    sag = [(0.3, 0.0), (0.1, 40.0), (0.4, 36.0), (0.05, 0.0), (0.3, 0.0)]
    legs = [*sag, *((seconds, -speed) for seconds, speed in sag)]
    traces = [moved(legs, hertz, jitter=jitter, blur=blur, seed=seed) for seed in range(4)]
    found = {}
    for mass in (0.0, MASS_KG):
        folder = tmp_path / f"{mass:g}"
        steady = ingested(folder, traces, ONE + f"rig.moving_mass_kg = {mass}\n").tables["steady"]
        viscous = SIGMA_2 * steady["speed_mm_s"].abs()
        found[mass] = ((steady["force_N"].abs() - viscous) / LOAD_N).groupby(steady["direction"]).mean()
    npt.assert_allclose(found[MASS_KG], MU, atol=0.001)
    assert (MU - found[0.0] > 0.003).all()


def test_the_force_of_a_ramp_is_friction_once_the_mass_is_taken_off(tmp_path):
    time, x, force = moved([(0.3, 0.0), (0.5, 50.0), (1.0, 50.0), (0.5, 0.0), (0.3, 0.0)])  # 100 mm/s2: 4 N
    for mass, expected in ((0.0, 4.0), (MASS_KG, 0.0)):
        tables = ingested(tmp_path / f"{mass:g}", [(time, x, force)], ONE + f"rig.moving_mass_kg = {mass}\n")
        trace = tables.tables["traces"]
        for begin, end, sign in ((0.5, 0.7, 1), (1.9, 2.1, -1)):
            own = trace["time_s"].between(begin, end)
            speed = np.interp(trace["time_s"][own], [0.3, 0.8, 1.8, 2.3], [0.0, 50.0, 50.0, 0.0])
            more = trace["force_N"][own] - MU * LOAD_N - SIGMA_2 * speed
            assert more.mean() == pytest.approx(sign * expected, abs=0.1)


def test_acceleration_is_exact_of_a_parabola_at_uneven_times():
    time = np.cumsum(np.random.default_rng(2).uniform(0.5, 1.5, 200))
    npt.assert_allclose(acceleration(time, 3.0 * time**2 + time, 0.0, 1.0), 6.0, rtol=1e-9)
    wide = acceleration(time, 3.0 * time**2 + time, 1.0, 1e-2)
    npt.assert_allclose(wide, 6.0, rtol=1e-9)


def test_the_mass_is_in_units_of_the_rig():
    mass = "rig.moving_mass_kg = 2\n"
    assert config(mass).mass == pytest.approx(2e-3)  # N s2/mm
    metres = '[quantities]\ndisplacement = {quantity = "displacement", unit = "m"}\n'
    metres += 'speed = {quantity = "speed", unit = "m/s"}\n'
    assert config(mass + metres).mass == pytest.approx(2.0)
    with pytest.raises(ConfigError, match=r"rig\.moving_mass_kg"):
        config(mass + '[quantities]\nforce = {quantity = "torque", unit = "N m"}\n')


@pytest.mark.parametrize("speed", [100.0, 197.0, 300.0])
def test_the_inertia_of_a_motion_in_steps_of_the_encoder_is_smooth(speed):
    time = 1e-3 * np.arange(1000)
    x = np.round(speed * time, 1)
    noise = max(displacement_noise_mm(x, order=4), resolution_mm(x) / np.sqrt(12.0))
    assert np.abs(acceleration(time, x, noise, 500.0)).max() < 5000.0  # a step is 0.1 mm / (1 ms)^2 = 1e5
