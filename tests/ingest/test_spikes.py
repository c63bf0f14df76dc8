"""Single samples that cannot be right are found, and the steep start of a stroke is none."""

import numpy as np
import numpy.testing as npt
import pytest

from sealfit.config import Quality, Strokes
from sealfit.ingest.strokes import find_strokes
from sealfit.ingest.trace_checks import displacement_spikes, force_spikes


def stroke(seed):
    rng = np.random.default_rng(seed)
    time = 0.05 * np.arange(80)
    x = 5.0 * (time - 0.2 * (1.0 - np.exp(-time / 0.2)))
    return time, x, 20.0 * (1.0 - np.exp(-x / 0.05)) + 0.05 * rng.normal(size=80)


def rows_left_out(time, x, force):
    line = np.arange(len(x)) + 2
    strokes = find_strokes(time, x, force, Strokes())
    kept = (
        displacement_spikes(x, line, Quality())[0],
        force_spikes(force, strokes, line, Quality())[0],
    )
    return [np.flatnonzero(~keep).tolist() for keep in kept]


def test_the_steep_start_of_a_short_stroke_is_no_spike():
    for seed in range(20):
        assert rows_left_out(*stroke(seed)) == [[], []]


def test_a_sample_far_off_its_neighbours_is_found_with_its_line():
    time, x, force = stroke(0)
    force[40] += 5.0
    x[60] -= 3.0
    assert rows_left_out(time, x, force) == [[60], [40]]
    _, (fault,) = displacement_spikes(x, np.arange(80) + 2, Quality())
    assert (fault.line, fault.column) == (62, "displacement_mm")
    npt.assert_allclose(float(fault.value), x[60])


@pytest.mark.parametrize("way", [1, -1])
def test_the_ends_of_a_motion_that_does_not_rest_are_no_spikes(way):
    """Speed steps: the usual step is that of the slow part, and the file ends in the fast one."""
    steps = np.r_[np.full(900, 0.01), np.full(100, 0.6)]
    displacement = np.cumsum(steps)[::way] * way
    line = np.arange(displacement.size) + 2
    keep, faults = displacement_spikes(displacement, line, Quality())
    assert keep.all()
    assert faults == []
    displacement[-1] += 40.0
    keep, (fault,) = displacement_spikes(displacement, line, Quality())
    assert (np.flatnonzero(~keep).tolist(), fault.line) == ([999], 1001)
