import numpy as np
import numpy.testing as npt
import pytest
from bristle_helpers import integrated
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import quad

from sealfit.errors import ParameterError
from sealfit.physics import PRESSURES, Contact, LuGre, bristle_limit, lugre_force, stribeck_force

LOAD = 49.03
STATIC = {"mu_s": 0.35, "mu_c": 0.3, "v_s": 5.0}
MODEL = {**STATIC, "sigma_0": 60.0, "sigma_1": 0.3, "sigma_2": 0.2}
DAHL = {"mu_s": 0.3, "mu_c": 0.3, "v_s": 5.0, "sigma_0": 60.0}


def slide(distance_mm, speed=2.0, **more):
    """Force after sliding from rest over distances, at one speed."""
    time = np.r_[0.0, np.asarray(distance_mm) / abs(speed)]
    return lugre_force(time, np.full(time.size, speed), LOAD, LuGre(**{**DAHL, **more})).force_N[1:]


@pytest.mark.parametrize("speed", [-40.0, -0.5, 0.5, 5.0, 40.0])
def test_long_sliding_ends_in_the_steady_state(speed):
    found = lugre_force([0.0, 60.0 / abs(speed)], [speed, speed], LOAD, LuGre(**MODEL))
    npt.assert_allclose(found.force_N[-1], stribeck_force(speed, LOAD, **STATIC, sigma_2=0.2), rtol=1e-12)
    npt.assert_allclose(
        found.deflection_mm[-1], np.sign(speed) * bristle_limit(speed, LOAD, **STATIC, sigma_0=60.0)
    )


def test_dahl_limit():
    """mu_s = mu_c, no damping: the force depends on the distance alone, along one exponential; Dahl 1968."""
    coulomb = 0.3 * LOAD
    x = np.array([0.01, 0.1, 0.4, 2.0])
    npt.assert_allclose(slide(x), coulomb * (1 - np.exp(-60.0 * x / coulomb)), rtol=1e-13)
    npt.assert_allclose(slide(x, speed=900.0), slide(x, speed=0.001), rtol=1e-9)
    # Turned round at the steady state, it falls by two Coulomb forces over the same length.
    time = np.r_[0.0, 10.0, 10.0 + x / 2.0]
    speed = np.r_[2.0, 2.0, np.full(x.size, -2.0)]
    back = lugre_force(time, speed, LOAD, LuGre(**DAHL)).force_N[2:]
    npt.assert_allclose(back, coulomb * (2 * np.exp(-60.0 * x / coulomb) - 1), rtol=1e-12)


def test_presliding_stiffness_is_sigma_0():
    npt.assert_allclose(slide([1e-7], **STATIC) / 1e-7, 60.0, rtol=1e-6)


def test_damping_adds_at_the_start_and_a_rest_holds_the_force():
    found = lugre_force([0.0, 1e-9, 0.05, 5.0], [3.0, 3.0, 3.0, 0.0], LOAD, LuGre(**MODEL))
    npt.assert_allclose(
        found.force_N[1], (0.3 + 0.2) * 3.0, rtol=1e-6
    )  # z = 0: all of v goes into the bristles
    npt.assert_allclose(found.force_N[3], 60.0 * found.deflection_mm[2], rtol=1e-13)


@pytest.mark.parametrize("exponent", [1.0, 0.8])
def test_exact_steps_and_a_stiff_solver_agree(exponent):
    def speed(t):
        return 8.0 * np.sin(3.0 * t) + 2.0

    contact = Contact(PRESSURES["parabolic"], width_mm=3.0, exponent=exponent)
    asked = np.linspace(0.0, 4.0, 41)
    fine = np.linspace(0.0, 4.0, 80001)
    middle = np.r_[fine[0], (fine[1:] + fine[:-1]) / 2]
    by_steps = lugre_force(fine, speed(middle), LOAD, LuGre(**MODEL, contact=contact))
    force, deflection = integrated(asked, speed, LOAD, LuGre(**MODEL, contact=contact))
    npt.assert_allclose(deflection, by_steps.deflection_mm[::2000], atol=2e-8)
    npt.assert_allclose(force, by_steps.force_N[::2000], atol=2e-3)  # the speeds differ by half a step


@given(
    speeds=st.lists(st.floats(-50, 50), min_size=2, max_size=30),
    sigma_1=st.floats(0, 5),
    start=st.floats(-1, 1),
    seed=st.integers(0, 2**31),
)
def test_no_energy_comes_out_of_the_contact(speeds, sigma_1, start, seed):
    time = np.cumsum(np.random.default_rng(seed).uniform(1e-4, 2.0, len(speeds)))
    model = {**MODEL, "sigma_1": sigma_1, "sigma_2": sigma_1 * (0.35 - 0.3) / 0.3 + 1e-9}
    limit = 0.3 * LOAD / 60.0
    found = lugre_force(time, speeds, LOAD, LuGre(**model), deflection_mm=start * limit)
    assert (found.heat_mW >= -1e-6 * np.abs(found.force_N * speeds) - 1e-9).all()


def test_work_is_what_is_stored_and_what_becomes_heat():
    time = np.linspace(0.0, 2.0, 40001)
    speed = np.r_[0.0, 6.0 * np.cos(4.0 * (time[1:] + time[:-1]) / 2)]
    found = lugre_force(time, speed, LOAD, LuGre(**MODEL))
    step = np.diff(time)
    work = (found.force_N[1:] * speed[1:] * step).sum()
    heat = (found.heat_mW[1:] * step).sum()
    npt.assert_allclose(work, heat + 0.5 * 60.0 * found.deflection_mm[-1] ** 2, rtol=2e-3)


@pytest.mark.parametrize("pressure", PRESSURES.values(), ids=PRESSURES)
def test_the_distribution_cancels_unless_friction_depends_on_the_pressure(pressure):
    time = np.linspace(0.0, 0.5, 200)
    speed = 4.0 * np.sin(20.0 * time)
    plain = lugre_force(time, speed, LOAD, LuGre(**MODEL)).force_N
    shared = lugre_force(time, speed, LOAD, LuGre(**MODEL, contact=Contact(pressure, width_mm=3.0))).force_N
    npt.assert_allclose(shared, plain, rtol=1e-12)
    local = lugre_force(
        time, speed, LOAD, LuGre(**MODEL, contact=Contact(pressure, width_mm=3.0, exponent=0.7))
    ).force_N
    assert (
        np.abs(local - plain).max()
        > (0.005 if pressure is not PRESSURES["uniform"] else -1) * np.abs(plain).max()
    )


@pytest.mark.parametrize("pressure", PRESSURES.values(), ids=PRESSURES)
def test_local_pressure_ends_in_the_steady_force_summed_over_the_contact(pressure):
    reference, exponent = 20.0, 0.75
    contact = Contact(pressure, width_mm=3.0, exponent=exponent, reference_N_mm=reference)
    found = lugre_force([0.0, 100.0], [3.0, 3.0], LOAD, LuGre(**MODEL, contact=contact))
    # mu p integrated over the contact by another quadrature, for mu in proportion to (p / reference)^(n - 1)
    scaled, _ = quad(
        lambda zeta: (LOAD / 3.0 * float(pressure(zeta / 3.0))) ** exponent * reference ** (1 - exponent),
        0,
        3.0,
    )
    steady = stribeck_force(3.0, scaled, **STATIC, sigma_2=0.2)
    npt.assert_allclose(found.force_N[-1], steady, rtol=1e-5)


def test_friction_that_falls_with_pressure_grows_less_than_the_load():
    contact = Contact(exponent=0.8, reference_N_mm=50.0)
    one, two = (
        lugre_force([0.0, 90.0], [2.0, 2.0], load, LuGre(**DAHL, contact=contact)).force_N[-1]
        for load in (50, 100)
    )
    npt.assert_allclose(two / one, 2**0.8, rtol=1e-12)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"time_s": [0.0, 0.0]}, "increasing"),
        ({"time_s": []}, "increasing"),
        ({"speed_mm_s": [1.0]}, "one speed a time"),
        ({"sigma_0": 0.0}, "stiffness must be positive"),
        ({"sigma_1": -1.0}, "neither can be negative"),
        ({"load_N": 0.0}, "load above 0"),
        ({"load_N": -50.0}, "load above 0"),
        ({"v_s": 0.0}, "v_s"),
        ({"contact": Contact(width_mm=1.0, reference_N_mm=-1.0)}, "both must be positive"),
    ],
)
def test_refuses_what_has_no_meaning(change, words):
    call = {"time_s": [0.0, 1.0], "speed_mm_s": [1.0, 1.0], "load_N": LOAD, **MODEL} | change
    with pytest.raises(ParameterError, match=words):
        lugre_force(call.pop("time_s"), call.pop("speed_mm_s"), call.pop("load_N"), LuGre(**call))
