"""The start's least squares of two numbers per condition and one shared, against the whole as one matrix."""

import bins_helpers
import numpy as np
import numpy.testing as npt
import pytest

from sealfit.fit.joint import search
from sealfit.fit.joint.rows import make_rows
from sealfit.fit.joint.search import pairs_and_shared, start_model


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
    columns = load * np.stack([decay, 1 - decay])
    values = rng.normal(30.0, 1.0, code.size)
    pairs, shared, _ = pairs_and_shared(columns, code, speed, values)
    expected, expected_shared = _dense(columns, code, speed, values)
    npt.assert_allclose(pairs, expected, rtol=1e-9, atol=1e-12)
    npt.assert_allclose(shared, expected_shared, rtol=1e-9)


def test_series_that_start_together_are_solved_once(monkeypatch):
    rows = make_rows(bins_helpers.make_bins(temperatures=(40.0, 60.0, 80.0), bins=4), has_aging=True)
    one_by_one = start_model(rows)
    solved = []
    whole = search._per_condition
    monkeypatch.setattr(search, "_per_condition", lambda *given: solved.append(given[3]) or whole(*given))
    together = start_model(rows, together=True)
    assert [np.unique(conditions).size for conditions in solved] == [
        13
    ]  # unaged, and three series of four days
    own, shared = (
        {p: m.theta[k] for k, p in enumerate(m.declared.parameters) if p.quantity == "v_s"}
        for m in (one_by_one, together)
    )
    assert len(own) == 4  # of the unaged rubber, too
    assert len(set(shared.values())) == 1
    assert max(shared.values()) == pytest.approx(np.mean(list(own.values())), abs=0.2)  # logarithms
