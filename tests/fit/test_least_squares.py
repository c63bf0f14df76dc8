"""Many least squares at once: each ends where scipy's ends, within bounds, and a lost one hurts no other."""

import numpy as np
import numpy.testing as npt
from scipy.optimize import least_squares

from sealfit.fit.least_squares import levenberg_marquardt

T = np.linspace(0.1, 4.0, 15)
LOW, HIGH = np.array([-np.inf, 0.0]), np.array([np.inf, 0.8])


def problems(values):
    """Residual and tangent of a decay a exp(-k t)."""

    def evaluate(x, rows):
        decay = np.exp(-x[:, 1:] * T)
        return x[:, :1] * decay - values[rows], np.stack([decay, -x[:, :1] * T * decay], axis=1)

    return evaluate


def drawn():
    """Decays of noisy values: slow, fast, beyond the bound of k, and growing, beyond the other."""
    truth = np.array([[1.0, 0.2], [2.0, 0.6], [1.5, 1.4], [0.5, -0.3]])
    noise = 0.05 * np.random.default_rng(4).standard_normal((4, T.size))
    return truth[:, :1] * np.exp(-truth[:, 1:] * T) + noise


def test_each_ends_where_one_alone_ends():
    values = drawn()
    x, rss = levenberg_marquardt(problems(values), np.ones((4, 2)), LOW, HIGH)
    for k, own in enumerate(values):
        alone = least_squares(
            lambda p, own=own: p[0] * np.exp(-p[1] * T) - own,
            [1.0, 0.5],
            bounds=(LOW, HIGH),
            xtol=1e-15,
            ftol=1e-15,
        )
        npt.assert_allclose(x[k], alone.x, rtol=1e-6, atol=1e-9)
        npt.assert_allclose(rss[k], 2 * alone.cost, rtol=1e-9)
    assert x[2, 1] == HIGH[1]
    assert x[3, 1] == LOW[1]


def test_a_number_between_equal_bounds_is_held():
    held = np.array([0.1, 0.2, 0.3, 0.4])
    low, high = np.tile(LOW, (4, 1)), np.tile(HIGH, (4, 1))
    low[:, 1] = high[:, 1] = held
    x, _ = levenberg_marquardt(problems(drawn()), np.ones((4, 2)), low, high)
    npt.assert_array_equal(x[:, 1], held)
    decay = np.exp(-held[:, None] * T)
    npt.assert_allclose(x[:, 0], (decay * drawn()).sum(axis=1) / (decay**2).sum(axis=1), rtol=1e-10)


def test_a_problem_without_a_finite_residual_is_infinite_and_alone_in_it():
    values = drawn()
    values[1, 3] = np.inf
    _, rss = levenberg_marquardt(problems(values), np.ones((4, 2)), LOW, HIGH)
    npt.assert_array_equal(np.isfinite(rss), [True, False, True, True])


def test_steps_of_rounding_do_not_repeat_without_end():
    """Of 3,000 small problems some went round in steps of one unit in the last place."""
    rng = np.random.default_rng(1)
    days = np.array([2.0, 8.0, 32.0])
    value = 0.04 * np.log1p(days / 0.1) + 0.003 * rng.standard_normal((3000, 3))
    calls = []

    def evaluate(x, of):
        calls.append(of.size)
        a, ratio = x[:, :1], days * np.exp(-x[:, 1:])
        slope = np.stack([np.log1p(ratio), -a * ratio / (1 + ratio)], axis=1)
        return 1e3 * (a * np.log1p(ratio) - value[of]), 1e3 * slope

    start = np.tile([0.04, np.log(0.1)], (3000, 1))
    levenberg_marquardt(evaluate, start, np.array([-np.inf, -20.0]), np.array([np.inf, 10.0]))
    assert len(calls) < 100  # were 2,001
