"""The start's least squares of two numbers per condition and one shared, against the whole problem as one matrix."""

import numpy as np
import numpy.testing as npt
import pytest

from sealfit.fit.start import pairs_and_shared


def _dense(columns, code, shared, values):
    own = np.zeros((code.size, 2 * (code.max() + 1)))
    rows = np.arange(code.size)
    own[rows, 2 * code], own[rows, 2 * code + 1] = columns
    solved, *_ = np.linalg.lstsq(np.column_stack([own, shared]), values, rcond=1e-10)
    return solved[:-1].reshape(-1, 2), solved[-1]


@pytest.mark.parametrize(
    ("v_s", "speed_of"),
    [
        (5.0, None),
        (0.03, None),  # no speed is slow enough for mu_s
        (5.0, {2: 8.0}),  # a condition at one speed
        (5.0, {0: 1.0, 1: 4.0, 2: 8.0, 3: 20.0, 4: 50.0, 5: 2.0}),  # all of them: the shared number is free
    ],
    ids=["full", "fast", "one_speed", "all_one_speed"],
)
def test_two_numbers_per_condition_and_a_shared_one_are_those_of_the_whole_problem(v_s, speed_of):
    rng = np.random.default_rng(3)
    code = np.repeat(np.arange(6), 10)
    speed = rng.choice([1.0, 4.0, 8.0, 20.0, 50.0], code.size)
    for condition, only in (speed_of or {}).items():
        speed[code == condition] = only
    load, decay = rng.choice([49.0, 98.0], code.size), np.exp(-((speed / v_s) ** 2))
    columns = (load * decay, load * (1 - decay))
    values = rng.normal(30.0, 1.0, code.size)
    pairs, shared = pairs_and_shared(columns, code, speed, values)
    expected, expected_shared = _dense(columns, code, speed, values)
    npt.assert_allclose(pairs, expected, rtol=1e-9, atol=1e-12)
    npt.assert_allclose(shared, expected_shared, rtol=1e-9)
