"""A moving mass: its force is subtracted, and friction is recovered."""

import numpy as np
import numpy.testing as npt
import pandas as pd
import pytest
from trace_helpers import config

from sealfit.errors import ConfigError
from sealfit.ingest.campaign import ingest_campaign
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


def ingested(folder, traces, text=ONE):
    folder.mkdir(exist_ok=True)
    for number, (time, x, force) in enumerate(traces):
        table = pd.DataFrame({"time_s": time, "displacement_mm": x, "force_N": force, "load_N": LOAD_N})
        table.to_csv(folder / f"{number}.csv", index=False)
    return ingest_campaign(folder, config(text))


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
