"""Strokes of 3 to 300 bristle lengths: the rest of the rise in the steady window is known, and taken out."""

import numpy as np
import pandas as pd
import pytest
from scipy.ndimage import uniform_filter1d

from sealfit.config import Config, Strokes
from sealfit.ingest.campaign import ingest_campaign
from sealfit.ingest.presliding import MotionStart, _before, rise_of
from sealfit.ingest.strokes import find_strokes
from sealfit.ingest.window import transient_rows
from sealfit.simulation import Spec, simulate

LENGTH, LEVEL, SPEED, NOISE = 0.45, 45.0, 0.5, 0.1  # mm, N, mm/s, N


def bristle_trace(
    ratio,
    *,
    hertz=100.0,
    ramp=0.2,
    blur=0.002,
    begin=0.0,
    damping=0.0,
    seed=1,
    shape="straight",
    drift=0.0,
    ripple=0.0,
    wave=0.2,
):
    """Return time, displacement and force of a stroke `ratio` bristle lengths long, after a rest of a second.

    At constant G the force is an exponential of the distance whatever the speed does: Eq. 2 divided by v.
    """
    random = np.random.default_rng(seed)
    time = np.arange(0.0, 1.0 + ratio * LENGTH / SPEED, 1.0 / hertz)
    since = np.maximum(time - 1.0, 0.0)
    if shape == "straight":
        slid = SPEED * np.where(since < ramp, 0.5 * since**2 / ramp, since - 0.5 * ramp)
    else:
        slid = SPEED * (since - ramp * -np.expm1(-since / ramp))
    bent = np.exp(-slid / LENGTH)  # damping: sigma_1 dz/dt, in N at the stroke's speed
    force = LEVEL + (begin - LEVEL) * bent + damping * np.gradient(slid, time) / SPEED * bent
    noise = random.normal(0.0, NOISE, time.size) + ripple * np.cos(2 * np.pi * slid / (wave * LENGTH))
    if drift:
        noise += uniform_filter1d(random.normal(0.0, drift, time.size), 8) * 8**0.5
    return time, slid + random.normal(0.0, blur, time.size), force + noise


def steady_forces(ratio, many=12, **more):
    """Return the mean force of several strokes' steady windows, as measured and with the rise taken out."""
    made = []
    for seed in range(many):
        time, place, force = bristle_trace(ratio, seed=seed, **more)
        (found,) = find_strokes(time, place, force, Strokes())
        assert found.short is None
        made.append((force[found.steady].mean(), (force - found.presliding_N)[found.steady].mean()))
    return np.array(made).T


@pytest.mark.parametrize("ratio", [3.0, 6.0, 11.0, 30.0, 100.0, 300.0])
@pytest.mark.parametrize(
    "more",
    [
        {},
        {"hertz": 500.0},
        {"begin": -LEVEL},
        {"begin": 0.3 * LEVEL},
        {"ramp": 0.4},
        {"ramp": 0.1, "shape": "lag"},
    ],
    ids=str,
)
def test_the_steady_force_does_not_depend_on_where_the_window_begins(ratio, more):
    measured, steady = steady_forces(ratio, **more)
    error = steady.std(ddof=1) / np.sqrt(steady.size)
    assert abs(steady.mean() - LEVEL) < 4 * error + 1e-4 * LEVEL
    assert steady.std() < 0.002 * LEVEL
    if ratio <= 6:
        assert measured.mean() < LEVEL - 0.2


@pytest.mark.parametrize("ratio", [4.0, 6.0, 11.0])
def test_a_ripple_does_not_hide_the_rise_of_a_reversed_stroke(ratio):
    _, steady = steady_forces(ratio, begin=-LEVEL, ripple=0.15 * LEVEL, hertz=50.0)
    assert steady == pytest.approx(LEVEL, rel=0.04)  # the rise begins 90 N below


@pytest.mark.parametrize("ratio", [5.0, 8.0, 11.0])
@pytest.mark.parametrize("wave", [0.4, 0.9])
def test_a_ripple_does_not_bend_the_rise_that_is_taken_out(ratio, wave):
    """What is left of the rise is that of the stroke without a ripple."""
    ends = []
    for ripple in (0.0, 0.2 * LEVEL):
        time, place, force = bristle_trace(ratio, ripple=ripple, wave=wave)
        (found,) = find_strokes(time, place, force, Strokes())
        late = place > 0.55 * ratio * LENGTH
        ends.append(found.presliding_N[found.steady & late].mean())
    assert ends[0] < 0.0
    assert ends[1] == pytest.approx(ends[0], rel=0.1, abs=1e-4 * LEVEL)


@pytest.mark.parametrize("ratio", [6.0, 11.0, 30.0])
def test_noise_of_the_displacement_does_not_hide_the_rise(ratio):
    _, steady = steady_forces(ratio, blur=0.3, hertz=500.0)
    assert abs(steady.mean() - LEVEL) < 4 * steady.std(ddof=1) / np.sqrt(steady.size) + 1e-4 * LEVEL


def test_twenty_samples_a_second_are_enough_where_the_window_holds_twenty():
    _, steady = steady_forces(11.0, hertz=20.0)
    assert abs(steady.mean() - LEVEL) < 4 * steady.std(ddof=1) / np.sqrt(steady.size) + 1e-4 * LEVEL


def test_the_end_of_a_rise_follows_its_length_without_jumps():
    lengths, x = np.geomspace(0.4, 0.6, 200), np.linspace(0.0, 40.0, 2001)
    noise = np.random.default_rng(0).normal(0.0, NOISE, x.size)
    starts = [MotionStart(x, LEVEL * (1.0 - np.exp(-x / length)) + noise, 0) for length in lengths]
    end = np.array([rise_of(start).end_mm for start in starts])
    assert np.abs(np.diff(np.log(end / lengths))).max() < 0.002


def test_a_rise_along_a_straight_line_is_no_bristle_and_is_not_corrected():
    time, place, _ = bristle_trace(40.0)
    force = np.minimum(place / 3.0, 1.0) * LEVEL  # elastic over 3 of 18 mm
    (found,) = find_strokes(time, place, force, Strokes())
    assert not found.presliding_N.any()
    assert place[found.steady].min() > 2.9


def test_a_stroke_that_ends_before_it_is_steady_says_so_and_is_used(tmp_path):
    for name, ratio in (("short.csv", 3.0), ("long.csv", 40.0)):
        columns = dict(zip(("time_s", "displacement_mm", "force_N"), bristle_trace(ratio), strict=True))
        pd.DataFrame(columns).to_csv(tmp_path / name, index=False)
    runs = pd.DataFrame(
        {"file": ["short.csv", "long.csv"], "aging_days": 0.0, "load_N": 49.0, "speed_mm_s": SPEED}
    )
    runs.to_csv(tmp_path / "runs.csv", index=False)
    tables = ingest_campaign(tmp_path, Config(condition=["aging_days"])).tables
    said = tables["quality"].set_index("file")["check"]
    assert said.to_dict() == {"short.csv": "never_steady", "long.csv": "ok"}
    steady = tables["steady"].set_index("file")
    assert steady["used"].all()
    assert steady["force_N"].to_numpy() == pytest.approx([LEVEL, LEVEL], rel=2e-3)
    assert steady.loc["short.csv", "presliding_N"] < -1.0
    bins = tables["bins"]
    short = bins[bins["file"] == "short.csv"]
    assert short["force_N"].to_numpy() == pytest.approx(LEVEL, abs=1.0)
    assert short["presliding_N"].iloc[0] < 1.5 * short["presliding_N"].iloc[-1] < 0


@pytest.mark.parametrize("ratio", [22.0, 25.0, 30.0])
def test_a_small_overshoot_after_a_reversal_is_over_too(ratio):
    _, corrected = steady_forces(ratio, begin=-LEVEL, damping=2.3 * LEVEL)
    assert corrected.mean() == pytest.approx(LEVEL, rel=3e-4)


@pytest.mark.parametrize("ratio", [40.0, 100.0, 300.0])
@pytest.mark.parametrize("damping", [1.5, 3.0, 6.0])
def test_damped_bristles_that_overshoot_are_over_too(ratio, damping):
    _, corrected = steady_forces(ratio, damping=damping * LEVEL)
    assert abs(corrected.mean() - LEVEL) < 4 * corrected.std(ddof=1) / np.sqrt(corrected.size) + 1e-4 * LEVEL
    assert corrected.std() < 0.002 * LEVEL


@pytest.mark.parametrize("ratio", [6.0, 11.0, 30.0])
@pytest.mark.parametrize("damping", [50.0, 56.0, 135.0, 150.0])
def test_damping_that_jumps_at_a_reversal_hides_no_rise(ratio, damping):
    """The force jumps from -45 N to 5, 11, 90 or 105 N, and follows the bristles from there."""
    _, steady = steady_forces(ratio, begin=-LEVEL, damping=damping, ramp=0.02, hertz=400.0)
    assert steady.mean() == pytest.approx(LEVEL, abs=0.05)


@pytest.mark.parametrize("share", [0.15, 0.2])
def test_a_rise_of_which_damping_brings_up_most_within_a_sample_is_that_of_the_bristles(share):
    """At a reversal the first row still has the force of the motion before."""
    x = np.linspace(0.0, 2.14, 435)
    force = 12.5 - share * 25.0 * np.exp(-x / 0.0857)
    force[0] = -12.5
    noisy = force + np.random.default_rng(1).normal(0.0, 0.02, x.size)
    rise = rise_of(MotionStart(x, noisy, 0))
    assert rise.length_mm == pytest.approx(0.0857, rel=0.05)
    assert rise.end_mm > 5 * 0.0857
    assert np.abs(force - 12.5 - rise.at(x))[x > rise.end_mm].max() < 0.02


def test_noise_does_not_hide_the_rise_after_a_jump():
    """The force jumps to 25 N, and follows the bristles from there under correlated noise of 2 N."""
    _, steady = steady_forces(4.0, damping=25.0, ramp=0.02, hertz=400.0, drift=2.0)
    assert steady.mean() == pytest.approx(LEVEL, abs=3 * steady.std() / np.sqrt(steady.size) + 0.1)


@pytest.mark.parametrize("ramp_end", [4, 6, 9])
def test_a_fast_stroke_of_few_samples_whose_force_jumps_at_its_reversal_shows_its_rise(ramp_end):
    """Sixty samples, four of them in the ramp, where damping brings the force up faster than the bristles."""
    distance = np.r_[0.0, 0.007, 0.022, 0.049, 0.082 + 0.0345 * np.arange(56)]
    force = 76.5 - 62.0 * np.exp(-distance / 0.163)
    force[:4] = -50.0, -26.0, 0.6, 28.0
    rise = rise_of(MotionStart(distance, np.round(force, 2), ramp_end))
    later = distance > rise.end_mm
    assert later.sum() > 30
    assert (force - rise.at(distance))[later] == pytest.approx(76.5, abs=0.15)


def test_a_rise_that_only_the_plateau_of_the_speed_shows_is_found():
    """A stroke of three rise lengths; damping brings the force up from -1.5 to -0.2 N in its ramp."""
    distance = np.r_[0.0, 0.01, 0.03, 0.056, 0.084 + 0.0288 * np.arange(131)]
    force = 1.45 - 1.72 * np.exp(-distance / 1.29)
    force[:4] = -1.48, -1.1, -0.75, -0.4
    rise = rise_of(MotionStart(distance, force, 4))
    later = distance > rise.end_mm
    assert later.sum() > 30
    assert (force - rise.at(distance))[later] == pytest.approx(1.45, abs=0.01)


def test_a_rise_far_shorter_than_the_ramp_of_the_speed_leaves_nothing():
    assert _before(-1e-3, 1e4) == 0.0
    assert _before(-1.0, np.log(2.0)) == pytest.approx(-2.0)


@pytest.mark.parametrize("seed", range(40))
def test_times_with_long_gaps_are_no_fault_of_the_program(seed):
    rng = np.random.default_rng(seed)
    time = np.cumsum(rng.lognormal(0.0, rng.uniform(1.0, 5.0), int(rng.integers(30, 300))))
    displacement = rng.uniform(0.1, 10.0) * time
    force = 10.0 * (1.0 - np.exp(-(displacement - displacement[0]) / rng.uniform(0.1, 5.0)))
    for stroke in find_strokes(time, displacement, force + rng.normal(0.0, 0.1, len(time)), Strokes()):
        assert np.isfinite(stroke.speed_mm_s)


def window(shape, n=200, seed=0):
    """Return the force of a steady window of n rows along a share from 0 to 1 of its length, with noise."""
    share = np.linspace(0.0, 1.0, n)
    return 30.0 + shape(share) + np.random.default_rng(seed).normal(0.0, NOISE, n)


@pytest.mark.parametrize("size", [10.0, -10.0, 20.0])
@pytest.mark.parametrize(("length", "rows"), [(0.01, 10), (0.04, 20)])
def test_a_transient_at_the_beginning_of_a_window_is_left_out(size, length, rows):
    assert 0 < transient_rows(window(lambda x: size * np.exp(-x / length))) <= rows


@pytest.mark.parametrize(
    "shape",
    [
        lambda x: 2.0 * np.exp(-x / 0.25),  # warming
        lambda x: 2.0 * x - x**2,
        lambda x: np.sin(2 * np.pi * x / 0.3),  # a ripple
        lambda x: np.where(x > 0.5, 2.0, 0.0),
    ],
)
def test_what_changes_along_a_stroke_stays_in_its_window(shape):
    assert transient_rows(window(shape)) == 0


def test_noise_is_seldom_a_transient():
    white = [transient_rows(window(np.zeros_like, seed=seed)) for seed in range(3000)]
    assert not any(white)  # 0.02 are expected
    assert transient_rows(np.full(200, 30.0)) == transient_rows(np.full(12, 30.0)) == 0


def test_warming_of_a_fast_stroke_is_no_rest_of_its_rise(tmp_path):
    """Friction falls by 10 % over 5 mm of sliding; the rise of the bristles is 0.25 mm long."""
    warming = {"id": "warming_distance", "acts_on": "mu", "operation": "multiply"}
    design = {"days": (), "speeds_mm_s": (25.0,), "repeats": 1, "stroke_mm": 25.0, "max_rows": 400}
    spec = Spec(
        physics={"sigma_0": 100.0}, design=design, effects=[{**warming, "parameters": {"A": 0.1, "s_0": 5.0}}]
    )
    simulate(spec, tmp_path / "campaign")
    bins = ingest_campaign(tmp_path / "campaign", Config()).tables["bins"]
    assert bins["presliding_N"].abs().max() < 0.01
    assert bins["rise_mm"].iloc[0] == pytest.approx(0.25, abs=0.05)
