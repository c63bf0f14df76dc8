import numpy as np
import numpy.testing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sealfit.config import Strokes
from sealfit.ingest.presliding import MotionStart, rise_of
from sealfit.ingest.strokes import displacement_noise_mm, find_strokes, slope, steady_speeds, turning_rows


def stroke(
    v=5.0,
    length=40.0,
    n=1000,
    *,
    rise=0.3,
    force=30.0,
    lag=0.05,
    lead=0.0,
    noise=0.1,
    blur=0.002,
    seed=0,
    **more,
):
    """A stroke whose speed lags by `lag` s: time, displacement, force; and force without rise and noise."""
    rng = np.random.default_rng(seed)
    time = np.linspace(0.0, length / v + lead, n)
    since = np.maximum(time - lead, 0.0)
    x = v * (since - lag * (1.0 - np.exp(-since / lag))) if lag else v * since
    level = force * (1.0 + more.get("warm", 0.0) * np.exp(-since / more.get("tau", 3.0)))
    level += more.get("ripple", 0.0) * np.sin(
        2.0 * np.pi * x / more.get("wavelength", 7.0) + more.get("phase", 0.0)
    )
    level += more.get("drift", 0.0) * since
    measured = level * (1.0 - np.exp(-x / rise)) + rng.normal(0.0, noise, n)
    return time, x + rng.normal(0.0, blur, n), measured, level


def only(time, x, force, **settings):
    found = find_strokes(time, x, force, Strokes(**settings))
    assert len(found) == 1
    assert found[0].short is None
    return found[0]


def there_and_back(turns=4, v=5.0, length=40.0, rest=0.0, dt=0.01, noise=0.05, blur=0.002, seed=1):
    """Strokes to and fro at +-v with a rest of `rest` s at each turn; the force swings over in about 1 mm."""
    rng = np.random.default_rng(seed)
    x, force, onsets = [0.0], [0.0], []
    for i in range(turns):
        sign = 1 if i % 2 == 0 else -1
        onsets.append(len(x) - 1)
        way = np.arange(1, round(length / v / dt) + 1) * v * dt
        begin = force[-1]
        x.extend(x[-1] + sign * way)
        force.extend(sign * 20.0 + (begin - sign * 20.0) * np.exp(-way / 0.25))
        x.extend([x[-1]] * round(rest / dt))
        force.extend([force[-1]] * round(rest / dt))
    x, force = np.array(x), np.array(force)
    time = np.arange(len(x)) * dt
    return time, x + rng.normal(0, blur, len(x)), force + rng.normal(0, noise, len(x)), onsets


def speeds_along(time, x, force):
    (found,) = find_strokes(time, x, force, Strokes())
    return found.speed_along_mm_s[found.steady], found.steady


@pytest.mark.parametrize("blur", [0.002, 0.02])
def test_a_speed_that_sags_along_the_stroke_is_that_of_its_bins(blur):
    rng = np.random.default_rng(2)
    time = np.linspace(0.0, 8.0, 1600)
    x = 5.0 * time + 0.08 * 5.0 * 1.5 * (1.0 - np.exp(-time / 1.5))
    speed, steady = speeds_along(
        time, x + rng.normal(0.0, blur, 1600), np.full(1600, 30.0) + rng.normal(0, 0.1, 1600)
    )
    true = (5.0 * (1.0 + 0.08 * np.exp(-time / 1.5)))[steady]
    assert np.abs(speed / true - 1.0).max() < 0.02
    assert np.abs(speed / true - 1.0).mean() < 0.003


@pytest.mark.parametrize(("blur", "step"), [(0.0, 0.0), (0.002, 0.0), (0.3, 0.0), (0.0, 0.05), (0.002, 0.5)])
def test_noise_and_resolution_of_the_displacement_are_no_change_of_speed(blur, step):
    for seed in range(60):
        time, x, force, _ = stroke(blur=blur, seed=seed)
        speed, _ = speeds_along(time, np.round(x / step) * step if step else x, force)
        assert np.ptp(speed) == 0.0


def test_beats_between_the_steps_of_the_sensor_and_the_sampling_are_no_change_of_speed():
    rng = np.random.default_rng(3)
    for hertz, v in ((172.68, 3.92), (1013.2, 23.0)):
        for _ in range(30):
            time = np.arange(0.0, 14.4 / v, 1.0 / hertz)
            x = np.round(v * (1 + 7e-4 * rng.normal()) * time / 0.0018974) * 0.0018974
            x *= 1.0 + rng.choice([0.0, 1e-6]) * rng.normal(size=time.size)
            speed, _steady = speeds_along(time, x, 10.0 + rng.normal(0, 0.005, time.size))
            assert np.ptp(speed) == 0.0


@pytest.mark.parametrize("sag", [0.02, 0.04])
@pytest.mark.parametrize("blur", [0.0, 1e-9, 1e-6, 1e-4])
def test_a_small_sag_is_found_whatever_the_last_digits_say(sag, blur):
    rng = np.random.default_rng(2)
    time = np.linspace(0.0, 8.0, 600)
    x = 5.0 * time + sag * 5.0 * 1.5 * (1.0 - np.exp(-time / 1.5)) + rng.normal(0.0, blur, 600)
    speed, _steady = speeds_along(time, x, 30.0 + rng.normal(0.0, 0.1, 600))
    assert np.ptp(speed) == pytest.approx(sag * 5.0, rel=0.05)


def test_the_window_begins_where_the_rise_and_the_ramp_are_over_and_no_later_than_needed():
    time, x, force, level = stroke()
    found = only(time, x, force)
    first, last = found.rows[[0, -1]]
    # 1/50000 of the rise is left 0.3 mm * ln(50000) = 3.25 mm from the start.
    assert 2.7 < x[first] < 4.2
    assert last == len(x) - 2
    assert found.speed_mm_s == pytest.approx(5.0, rel=1e-3)
    kept = force[found.rows] - level[found.rows]
    assert abs(kept[:50].mean()) < 4 * 0.1 / np.sqrt(50)


def test_the_last_sample_is_not_steady_as_the_platform_may_have_stopped_since_the_one_before():
    time = np.arange(0.0, 40.1, 0.5)
    since = np.maximum(time - 2.0, 0.0)
    stops = since[-1] - 0.05  # a ramp far shorter than the step from sample to sample
    x = 0.5 * np.minimum(since, stops) + np.where(since > stops, 0.0125, 0.0)
    last = (x[-1] - x[-2]) / (0.5 * 0.5)
    assert 0.9 < last < 1.0  # of the plateau: slower by less than the tolerance of speed
    force = 20.0 * -np.expm1(-x / 0.3)
    assert only(time, x, force).rows[-1] == len(x) - 2


@pytest.mark.parametrize("rise", [0.01, 0.05, 0.2, 0.5, 1.0])
def test_what_is_left_of_the_rise_in_the_window_is_below_a_thousandth(rise):
    time, x, force, level = stroke(rise=rise, noise=0.0, blur=0.0, lag=0.01)
    rows = only(time, x, force).rows
    assert np.abs(force[rows] / level[rows] - 1.0).max() < 1e-3
    assert x[rows[0]] < 0.5 + 14 * rise


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize(
    "more",
    [
        {"warm": 0.2, "tau": 1.0},
        {"warm": 0.2, "tau": 4.0},
        {"warm": -0.15, "tau": 2.0},
        {"drift": 0.5},
        {"drift": -0.5},
        {"ripple": 2.0, "wavelength": 7.0, "phase": 0.0},
        {"ripple": 2.0, "wavelength": 12.0, "phase": -np.pi / 2},
        {"ripple": 0.5, "wavelength": 1.0, "phase": 1.0},
    ],
)
def test_slow_effects_stay_inside_the_window(more, seed):
    time, x, force, _ = stroke(seed=seed, **more)
    found = only(time, x, force)
    assert x[found.rows[0]] < 4.5
    assert found.rows[-1] == len(x) - 2
    npt.assert_array_equal(np.diff(found.rows), 1)


@pytest.mark.parametrize("phase", np.linspace(0, 2 * np.pi, 9))
def test_a_file_that_begins_in_steady_sliding_is_steady_from_its_first_row_wherever_its_ripple_begins(phase):
    time = np.linspace(0.0, 8.0, 800)
    x = 5.0 * time
    rng = np.random.default_rng(3)
    force = 30.0 + 2.0 * np.sin(2 * np.pi * x / 7.0 + phase) + rng.normal(0.0, 0.1, 800)
    assert only(time, x, force).steady[:-1].all()


@pytest.mark.parametrize(("blur", "step"), [(0.0, 0.0), (0.05, 0.0), (0.2, 0.0), (0.0, 0.1), (0.0, 0.5)])
def test_noise_and_resolution_of_the_displacement_neither_split_a_stroke_nor_bias_its_speed(blur, step):
    time, x, force, _ = stroke(blur=blur)
    if step:
        x = np.round(x / step) * step
    found = only(time, x, force)
    assert found.speed_mm_s == pytest.approx(5.0, rel=5e-3)
    assert found.steady.sum() > 800


@pytest.mark.parametrize("step", [0.0, 0.5])
def test_the_noise_of_the_displacement_does_not_rest_on_equal_neighbours(step):
    _, x, *_ = stroke(lead=3.0, blur=0.0)  # a rest whose rows are equal to the last digit
    x = np.round(x / step) * step if step else x
    jittered = x + 1e-6 * np.random.default_rng(0).standard_normal(x.size)
    noise = [displacement_noise_mm(values) for values in (x, jittered)]
    assert noise[0] == pytest.approx(step / np.sqrt(12.0), abs=1e-5)
    assert noise[1] == pytest.approx(noise[0], abs=1e-5)


def test_gaps_do_not_bias_the_speed():
    time, x, force, _ = stroke()
    keep = np.ones(1000, bool)
    keep[300:390] = keep[600:650] = keep[960:970] = False
    found = only(time[keep], x[keep], force[keep])
    assert found.speed_mm_s == pytest.approx(5.0, rel=1e-3)


def test_a_rest_before_the_motion_and_a_stop_after_it_are_outside_the_window():
    time, x, force, _ = stroke(lead=1.0, n=1100)
    x = np.concatenate([x, np.full(200, x[-1])])
    time = np.concatenate([time, time[-1] + 0.008 * np.arange(1, 201)])
    force = np.concatenate([force, np.linspace(force[-1], 0.7 * force[-1], 200)])
    found = only(time, x, force)
    assert time[found.origin] == pytest.approx(1.0, abs=0.05)
    assert x[found.rows[0]] > 2.0
    assert found.rows[-1] <= 1100
    assert found.rows[-1] > 1080


def test_a_rest_within_a_stroke_and_the_rise_after_it_are_left_out():
    one = stroke(length=20.0, n=500)
    two = stroke(length=20.0, n=500, seed=5)
    time = np.concatenate([one[0], one[0][-1] + 2.0 + two[0]])
    x = np.concatenate([one[1], one[1][-1] + two[1]])
    force = np.concatenate([one[2], two[2]])
    time = np.concatenate([time[:500], one[0][-1] + np.arange(1, 200) * 0.01, time[500:]])
    x = np.concatenate([x[:500], np.full(199, x[499]), x[500:]])
    force = np.concatenate([force[:500], np.full(199, 15.0), force[500:]])
    found = only(time, x, force)
    inside = found.steady
    assert not inside[500:700].any()
    assert not inside[699:730].any()
    assert inside[100:480].all()
    assert inside[820:-1].all()
    assert found.speed_mm_s == pytest.approx(5.0, rel=2e-3)


@pytest.mark.parametrize("rest", [0.0, 0.5, 3.0])
@pytest.mark.parametrize("blur", [0.0, 0.002, 0.05])
def test_strokes_to_and_fro_are_split_where_they_turn(rest, blur):
    time, x, force, onsets = there_and_back(rest=rest, blur=blur)
    found = find_strokes(time, x, force, Strokes())
    assert [s.direction for s in found] == [1, -1, 1, -1]
    assert [s.stop for s in found[:-1]] == [s.start for s in found[1:]]
    assert (found[0].start, found[-1].stop) == (0, len(x))
    for one, onset in zip(found, onsets, strict=True):
        assert abs(one.origin - onset) <= 12
        assert one.speed_mm_s == pytest.approx(5.0 * one.direction, rel=5e-3)
        assert abs(force[one.rows].mean() - 20.0 * one.direction) < 0.02
        assert len(one.rows) > 600


def test_a_backlash_at_the_turn_is_not_a_stroke():
    time, x, force, _ = there_and_back(turns=2)
    middle = len(x) // 2
    x = x.copy()
    x[middle - 5 : middle + 15] += 0.3 * np.sin(np.arange(20))
    assert len(find_strokes(time, x, force, Strokes())) == 2


def test_min_travel_says_what_a_stroke_is():
    time, x, force, _ = there_and_back(turns=3)
    assert find_strokes(time, x, force, Strokes(min_travel_mm=50.0)) == []


def test_nothing_moving_is_no_stroke_and_a_short_one_says_so():
    rng = np.random.default_rng(0)
    time = np.arange(500) * 0.01
    assert find_strokes(time, rng.normal(0.0, 0.01, 500), np.ones(500), Strokes()) == []
    assert find_strokes(time, np.zeros(500), np.ones(500), Strokes()) == []
    t, x, force, _ = stroke(n=22)
    assert "at least 20 are needed" in find_strokes(t, x, force, Strokes())[0].short


def test_a_whole_file_is_one_steady_stroke_when_the_config_says_so():
    time, x, force, _ = stroke()
    found = find_strokes(time, -x, -force, Strokes(whole_file=True))
    assert len(found) == 1
    assert found[0].steady.all()
    assert found[0].direction == -1


@given(
    v=st.floats(0.01, 100.0),
    length=st.floats(5.0, 200.0),
    n=st.integers(200, 1500),
    origin=st.floats(-1e3, 1e3),
    sign=st.sampled_from([-1, 1]),
)
def test_the_window_does_not_depend_on_the_rig_s_origin_or_direction(v, length, n, origin, sign):
    time, x, force, _ = stroke(
        v, length, n, rise=length / 100, lag=0.005 * length / v, noise=0.1, blur=1e-5 * length
    )
    one = find_strokes(time, x, force, Strokes())
    two = find_strokes(time, np.round(origin) + sign * x, sign * force, Strokes())
    assert len(one) == len(two) == 1
    npt.assert_array_equal(one[0].steady, two[0].steady)
    assert two[0].speed_mm_s == pytest.approx(sign * one[0].speed_mm_s, rel=1e-6)
    assert one[0].speed_mm_s == pytest.approx(v, rel=5e-3)


@given(st.lists(st.floats(-100, 100), min_size=2, max_size=40), st.floats(0.5, 20.0))
def test_neighbouring_turns_alternate_and_are_at_least_the_travel_apart(values, travel):
    x = np.array(values)
    turns = turning_rows(x, travel)
    assert len(turns) != 1
    assert turns == sorted(turns)
    steps = np.diff(x[turns])
    assert (np.abs(steps) >= travel).all()
    assert (steps[1:] * steps[:-1] < 0).all()
    assert len(turns) > 0 or np.ptp(x) < travel + 1e-9


def test_slope_of_two_pieces_ignores_the_rest_between_them():
    time = np.arange(10.0)
    x = np.array([0, 2, 4, 6, 8, 8, 8, 10, 12, 14.0])
    steady = np.array([1, 1, 1, 1, 0, 0, 1, 1, 1, 1], bool)
    assert slope(time, x, steady) == pytest.approx(2.0)


def test_no_rise_is_found_in_a_force_that_falls_or_begins_within_its_later_band():
    x = np.linspace(0.0, 40.0, 1000)
    assert rise_of(MotionStart(x, 30.0 + 5.0 * np.exp(-x / 3.0), 0)).end_mm == 0.0
    assert rise_of(MotionStart(x, np.full(1000, 30.0), 0)).end_mm == 0.0


def test_a_stroke_hardly_longer_than_its_rise_keeps_its_plateau():
    # As a fretting stroke swings over: along a straight line for half of the way, then a plateau that climbs
    # a little.
    time = np.linspace(0.0, 1.0, 200)
    x = 0.23 * time
    force = np.minimum(-2.2 + 4.4 * x / 0.1, 2.2 + 0.5 * (x - 0.1)) + np.random.default_rng(0).normal(
        0.0, 0.005, 200
    )
    found = only(time, x, force)
    # Past the bend at 0.1 mm, and no later than where the late plateau begins: 60 % of the way, 0.138 mm, and
    # a margin.
    assert 0.1 < x[found.rows[0]] < 0.147
    assert found.rows[-1] == 198


def test_a_noisy_speed_of_a_few_samples_gives_no_empty_window():
    rng = np.random.default_rng(906)
    samples = int(rng.integers(12, 60))
    speed = np.repeat(rng.uniform(0.5, 5, 3), 20)[:samples] * (1 + 0.02 * rng.normal(size=samples))
    place = np.cumsum(speed) / 10 + 0.003 * rng.normal(size=samples)
    parts = steady_speeds(np.arange(samples) / 10, place, 0.003, Strokes())
    assert all(rows.stop > rows.start for rows, _ in parts)
    assert [parts[0][0].start, parts[-1][0].stop] == [0, samples]
