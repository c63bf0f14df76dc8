"""Motions with several steady speeds, without one, and rotations."""

import numpy as np
import numpy.testing as npt
import pytest

from sealfit.config import Strokes
from sealfit.ingest.strokes import find_strokes


def moved(speeds, hertz=500, *, hold=2.0, ramp=0.1, rest=0.0, blur=0.0, noise=0.05, seed=0):
    """A motion from rest through steady speeds with straight ramps: time, displacement, force and true speed.

    It comes to rest for `rest` s between two speeds if that is not 0.
    """
    rng = np.random.default_rng(seed)
    knots, values, now = [0.0, 0.3], [0.0, 0.0], 0.3
    for i, speed in enumerate(speeds):
        if rest and i:
            knots += [now + ramp, now + ramp + rest]
            values += [0.0, 0.0]
            now = knots[-1]
        knots += [now + ramp, now + ramp + hold]
        values += [speed, speed]
        now = knots[-1]
    fine = np.linspace(0.0, now + ramp + 0.3, 400_001)
    pace = np.interp(fine, [*knots, now + ramp], [*values, 0.0])
    place = np.concatenate([[0.0], np.cumsum(0.5 * (pace[1:] + pace[:-1]) * np.diff(fine))])
    time = np.arange(0.0, fine[-1], 1.0 / hertz)
    speed, x = np.interp(time, fine, pace), np.interp(time, fine, place)
    force = (10.0 + 0.1 * speed) * -np.expm1(-x / 0.05) * (speed > 0) + rng.normal(0.0, noise, time.size)
    return time, x + rng.normal(0.0, blur, time.size), force, speed


def found_in(time, x, force, **settings):
    return find_strokes(time, x, force, Strokes(**settings))


def assert_parts(found, time, speed, speeds):
    """Assert that there is a stroke for each speed, whose window is long and slides at that speed only."""
    npt.assert_allclose([stroke.speed_mm_s for stroke in found], speeds, rtol=0.02)
    assert [stroke.start for stroke in found[1:]] == [stroke.stop for stroke in found[:-1]]
    for stroke, wanted in zip(found, speeds, strict=True):
        assert stroke.short is None
        assert stroke.settles
        assert stroke.several_speeds
        there = np.abs(speed / wanted - 1.0) < 0.02
        assert np.mean(there[stroke.rows]) > 0.98
        assert len(stroke.rows) > 0.6 * there.sum() / speeds.count(wanted)


def test_friction_follows_a_step_between_speeds_before_its_window_begins():
    """Bristles of 0.5 mm, whose force relaxes as exp(-x / 0.5 mm) to the level of each speed."""
    levels = {2.0: 40.0, 4.0: 36.0, 8.0: 30.0}
    time, x, _, speed = moved([2.0, 4.0, 8.0, 4.0, 2.0], 500, hold=6.0)
    level = np.interp(speed, [0.0, *levels], [40.0, *levels.values()])
    force = np.zeros(time.size)
    for row in range(1, time.size):
        left = np.exp(-(x[row] - x[row - 1]) / 0.5)
        force[row] = level[row] + (force[row - 1] - level[row]) * left
    force += np.random.default_rng(1).normal(0.0, 0.05, time.size)
    found = found_in(time, x, force)
    assert len(found) == 5
    for stroke in found:
        rows, wanted = stroke.rows, levels[round(stroke.speed_mm_s)]
        settled = force[rows] + stroke.presliding_N[rows - stroke.start]
        npt.assert_allclose(settled[:100].mean(), wanted, rtol=0.002)
        assert rows.size > 0.4 * 6.0 * 500


SPEEDS = [[5.0, 10.0, 20.0, 40.0], [40.0, 20.0, 10.0, 5.0], [42.0, 83.0, 125.0, 42.0], [1.0, 3.0, 10.0, 30.0]]


@pytest.mark.parametrize("speeds", SPEEDS, ids=str)
@pytest.mark.parametrize(("hertz", "hold"), [(20, 6.0), (100, 2.0), (1000, 2.0), (10_000, 1.0)])
@pytest.mark.parametrize("rest", [0.0, 0.2])
def test_each_steady_speed_of_a_motion_is_a_stroke(speeds, hertz, hold, rest):
    time, x, force, speed = moved(speeds, hertz, hold=hold, rest=rest)
    assert_parts(found_in(time, x, force), time, speed, speeds)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("blur", [0.001, 0.01, 0.03])
def test_noise_of_the_displacement_hides_no_steady_speed(blur, seed):
    time, x, force, speed = moved([5.0, 10.0, 20.0, 40.0], 1000, blur=blur, seed=seed)
    assert_parts(found_in(time, x, force), time, speed, [5.0, 10.0, 20.0, 40.0])


@pytest.mark.parametrize("step", [0.005, 0.05])
def test_coarse_steps_of_the_displacement_hide_no_steady_speed(step):
    time, x, force, speed = moved([5.0, 10.0, 20.0, 40.0], 1000)
    x = np.round(x / step) * step
    assert_parts(found_in(time, x, force), time, speed, [5.0, 10.0, 20.0, 40.0])


@pytest.mark.parametrize("ramp", [0.02, 0.5, 1.0])
def test_ramps_between_steady_speeds_are_in_no_window(ramp):
    time, x, force, speed = moved([10.0, 30.0, 20.0], ramp=ramp, hold=3.0)
    assert_parts(found_in(time, x, force), time, speed, [10.0, 30.0, 20.0])


@pytest.mark.parametrize("ramp", [0.02, 0.1])
@pytest.mark.parametrize("last", [0.15, 0.18])
def test_a_last_speed_that_is_too_short_takes_no_other_along(last, ramp):
    time, x, force, speed = moved([10.0, 30.0], 100, ramp=ramp)
    kept = time <= 0.3 + ramp + 2.0 + ramp + last
    first, short = found_in(time[kept], x[kept], force[kept])
    assert np.all(speed[first.rows] == 10.0)
    assert len(first.rows) > 150
    assert first.short is None
    assert "samples; at least 20 are needed" in short.short


def test_distance_and_time_of_a_later_speed_count_from_the_start_of_the_motion():
    time, x, force, _ = moved([10.0, 30.0])
    assert {stroke.origin for stroke in found_in(time, x, force)} == {found_in(time, x, force)[0].origin}
    back = np.r_[x, x[-1] + x[-1] - x[1:]]
    found = found_in(np.arange(back.size) / 500, back, np.r_[force, -force[1:]])
    assert [stroke.direction for stroke in found] == [1, 1, -1, -1]
    assert found[2].origin == found[3].origin == found[2].start


@pytest.mark.parametrize("more", [{}, {"blur": 0.01}, {"hertz": 20, "hold": 8.0}, {"ramp": 1.0}], ids=str)
def test_one_speed_is_one_stroke_with_rests_ramps_and_a_change_within_the_tolerance(more):
    for speeds in ([10.0], [10.0, 10.0], [10.0, 11.0]):
        time, x, force, _ = moved(speeds, **{"rest": 0.0 if speeds[-1] == 11.0 else 0.4, **more})
        (stroke,) = found_in(time, x, force)
        assert not stroke.several_speeds
        assert stroke.settles


def driven(speed_of, blur, seed=0, cycles=3, n=3000):
    """Displacement and force of a rig whose speed over the phase of a cycle, 0 to 1, is `speed_of`."""
    rng = np.random.default_rng(seed)
    time = np.linspace(0.0, 10.0, n)
    speed = speed_of(cycles * time / 10.0 % 1.0)
    x = np.concatenate([[0.0], np.cumsum(0.5 * (speed[1:] + speed[:-1]) * np.diff(time))])
    force = 10.0 * np.tanh(speed / 0.2) + 0.1 * speed + rng.normal(0.0, 0.05, n)
    return time, x + rng.normal(0.0, blur, n), force


SINE = (lambda phase: 20.0 * np.sin(2.0 * np.pi * phase), "sine")
TRIANGLE = (lambda phase: 20.0 * (4.0 * np.abs((phase - 0.25) % 1.0 - 0.5) - 1.0), "triangle")


@pytest.mark.parametrize("speed_of", [SINE[0], TRIANGLE[0]], ids=[SINE[1], TRIANGLE[1]])
@pytest.mark.parametrize("blur", [0.0, 0.002, 0.02])
@pytest.mark.parametrize("n", [300, 3000, 30_000])
def test_a_speed_that_never_settles_has_no_plateau(speed_of, blur, n):
    for seed in range(3):
        found = found_in(*driven(speed_of, blur, seed, n=n))
        assert 6 <= len(found) <= 7
        assert not any(stroke.settles for stroke in found if stroke.short is None)
        assert not any(stroke.several_speeds for stroke in found)


def test_a_ripple_of_the_speed_and_a_sag_are_still_a_plateau():
    time = np.linspace(0.0, 10.0, 3000)
    for speed in (10.0 * (1.0 + 0.15 * np.sin(2.0 * np.pi * 3.0 * time)), 10.0 * (1.08 - 0.016 * time)):
        x = np.concatenate([[0.0], np.cumsum(0.5 * (speed[1:] + speed[:-1]) * np.diff(time))])
        (stroke,) = found_in(time, x, np.full(3000, 10.0))
        assert stroke.settles
        assert not stroke.several_speeds


@pytest.mark.parametrize("way", [1, -1])
@pytest.mark.parametrize("blur", [0.0, 0.5])
def test_a_rotation_is_cut_into_turns(way, blur):
    rng = np.random.default_rng(1)
    time = np.arange(0.0, 20.0, 0.005)
    angle = 100.0 + way * 180.0 * time + rng.normal(0.0, blur, time.size)  # ten turns of 360 degrees
    force = way * (5.0 + np.sin(np.radians(angle)) + rng.normal(0.0, 0.05, time.size))
    found = found_in(time, angle, force, turn=360.0)
    assert len(found) == 11
    assert found[0].origin == found[-1].origin
    npt.assert_allclose([stroke.speed_mm_s for stroke in found], way * 180.0, rtol=0.01)
    for stroke in found[1:-1]:
        ends = angle[[stroke.start, stroke.stop - 1]] / 360.0
        npt.assert_allclose(ends, np.round(ends), atol=0.01)
        assert abs(ends[1] - ends[0]) == pytest.approx(1.0, abs=0.01)
        assert stroke.short is None
    assert sum(len(stroke.rows) for stroke in found) > 0.95 * time.size


def test_a_rotation_with_several_speeds_is_cut_at_both():
    time = np.arange(0.0, 24.0, 0.005)
    angle = np.where(time < 12.0, 180.0 * time, 180.0 * 12.0 + 720.0 * (time - 12.0))  # 6 turns, 24 turns
    found = found_in(time, angle, np.full(time.size, 5.0), turn=360.0)
    speeds = np.array([stroke.speed_mm_s for stroke in found])
    assert (np.abs(speeds - 180.0) < 1.0).sum() == 6
    assert (np.abs(speeds - 720.0) < 1.0).sum() == 24
    assert len(found) == 30


def test_a_part_of_a_turn_at_an_end_is_a_stroke_only_if_it_is_long():
    time = np.arange(0.0, 10.0, 0.01)
    for first, parts in ((355.0, 2), (300.0, 3)):
        assert len(found_in(time, first + 60.0 * time, np.full(1000, 5.0), turn=360.0)) == parts
