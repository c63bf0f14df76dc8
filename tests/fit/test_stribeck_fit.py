import numpy as np
import numpy.testing as npt
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize, nnls

from sealfit.errors import FitError
from sealfit.fit.least_squares import least_squares_of
from sealfit.fit.steady.stribeck import constrained_ends, flat_p_value, solve_stribeck, stribeck_intervals
from sealfit.physics import stribeck_force

SPEEDS = np.array([0.5, 1.0, 2.0, 4.0, 7.0, 12.0, 25.0, 50.0, 100.0])
LOAD = 49.03


def curve(speed, **model):
    return stribeck_force(speed, LOAD, **model)


# ---------------------------------------------------------------- the linear part
@settings(max_examples=60)
@given(seed=st.integers(0, 10**6), n=st.integers(4, 12), p=st.integers(1, 4))
def test_non_negative_coefficients_agree_with_lawson_and_hanson(seed, n, p):
    rng = np.random.default_rng(seed)
    columns, y = rng.normal(size=(5, n, p)), rng.normal(size=(5, n))
    columns /= np.linalg.norm(columns, axis=1)[:, None, :]
    gram, moment = np.swapaxes(columns, 1, 2) @ columns, np.einsum("knp,kn->kp", columns, y)
    found, support = least_squares_of(gram, moment, [True] * p)
    expected = np.array([nnls(b, t)[0] for b, t in zip(columns, y, strict=True)])
    npt.assert_allclose(found, expected, atol=1e-7)
    assert np.all(found[~support] == 0)


def test_a_column_that_repeats_another_is_left_out():
    column = np.array([1.0, 2.0, 3.0]) / np.sqrt(14)
    columns = np.stack([column, column], axis=1)
    found, _ = least_squares_of(columns.T @ columns, columns.T @ (5 * column), [True, True])
    npt.assert_allclose(columns @ found, 5 * column, rtol=1e-12)


# ---------------------------------------------------------------- the batch
@settings(max_examples=40, deadline=None)
@given(
    mu_s=st.floats(0.05, 2),
    mu_c=st.floats(0.05, 2),
    v_s=st.floats(1.2, 40),
    sigma_2=st.floats(0, 0.2),
    load=st.floats(1, 200),
)
def test_exact_data_give_back_all_four_parameters(mu_s, mu_c, v_s, sigma_2, load):
    assume(abs(mu_s - mu_c) > 0.01)
    force = stribeck_force(SPEEDS, load, mu_s=mu_s, mu_c=mu_c, v_s=v_s, sigma_2=sigma_2)
    fit = solve_stribeck(SPEEDS[None], np.full((1, 9), load), force[None], np.ones((1, 9)))
    npt.assert_allclose(fit.values[0], [mu_s, mu_c, v_s, sigma_2], rtol=1e-8, atol=1e-8)


def many(problems, seed=3, noise=0.15):
    rng = np.random.default_rng(seed)
    true = np.stack(
        [
            rng.uniform(0.5, 1.0, problems),
            rng.uniform(0.3, 0.6, problems),
            rng.uniform(1, 30, problems),
            rng.uniform(0, 0.05, problems),
        ],
        axis=1,
    )
    mu_s, mu_c, v_s, sigma_2 = (column[:, None] for column in true.T)
    force = stribeck_force(SPEEDS, LOAD, mu_s=mu_s, mu_c=mu_c, v_s=v_s, sigma_2=sigma_2)
    return true, force + rng.normal(0, noise, force.shape)


def test_a_thousand_conditions_at_once_are_each_at_their_global_minimum():
    _, force = many(1000)
    weight = np.full_like(force, 1 / 0.15**2)
    fit = solve_stribeck(SPEEDS, LOAD, force, weight)
    # an independent search of the same sum of squares, by Nelder and Mead from the fit and from elsewhere
    for k in range(0, 1000, 100):

        def cost(x, k=k):
            model = curve(SPEEDS, mu_s=abs(x[0]), mu_c=abs(x[1]), v_s=np.exp(x[2]), sigma_2=abs(x[3]))
            return np.sum((force[k] - model) ** 2) / 0.15**2

        mu_s, mu_c, v_s, sigma_2 = fit.values[k]
        near = [mu_s, mu_c, np.log(v_s), sigma_2]
        npt.assert_allclose(cost(near), fit.rss[k], rtol=1e-9)
        tries = [near, [0.7, 0.4, 1.0, 0.01], [0.7, 0.4, 3.0, 0.01]]
        with np.errstate(all="ignore"):
            others = [
                minimize(cost, t, method="Nelder-Mead", options={"maxiter": 3000, "xatol": 1e-9})
                for t in tries
            ]
        assert fit.rss[k] <= min(o.fun for o in others) + 1e-6


def test_the_stribeck_speed_does_not_depend_on_the_unit_of_force():
    _, force = many(200)
    weight = np.ones_like(force)
    fit = solve_stribeck(SPEEDS, LOAD, force, weight)
    inner = (fit.grid[:, 0] < np.log(fit.values[:, 2])) & (np.log(fit.values[:, 2]) < fit.grid[:, -1])
    assert inner.mean() > 0.9
    fine = solve_stribeck(SPEEDS, LOAD, 10 * force, weight / 100)  # the same problems, other rounding
    # Half of the digits of a sum of squares, and fewer where its minimum is flat.
    npt.assert_allclose(fine.values[inner, 2], fit.values[inner, 2], rtol=1e-5)


def test_padding_and_company_change_nothing():
    _, force = many(3)
    alone = solve_stribeck(SPEEDS[None], np.full((1, 9), LOAD), force[1:2], np.ones((1, 9)))
    padded = np.hstack([force, np.full((3, 2), 1e6)])
    weight = np.hstack([np.ones((3, 9)), np.zeros((3, 2))])
    among = solve_stribeck(np.hstack([np.tile(SPEEDS, (3, 1)), np.ones((3, 2))]), LOAD, padded, weight)
    npt.assert_allclose(among.values[1], alone.values[0], rtol=1e-9)


def test_forces_against_the_motion_end_at_zero_and_falling_friction_at_sigma_2_zero():
    falling = curve(SPEEDS, mu_s=0.6, mu_c=0.4, v_s=5.0, sigma_2=0.0) - 0.02 * SPEEDS
    force = np.stack([-np.ones(9), falling])
    fit = solve_stribeck(SPEEDS, LOAD, force, np.ones((2, 9)))
    npt.assert_array_equal(fit.values[0, [0, 1, 3]], 0.0)
    npt.assert_allclose(fit.rss[0], 9.0)
    assert fit.values[1, 3] == 0.0


def test_a_rise_with_speed_is_allowed():
    force = curve(SPEEDS, mu_s=0.3, mu_c=0.5, v_s=5.0, sigma_2=0.01)
    fit = solve_stribeck(SPEEDS[None], LOAD, force[None], np.ones((1, 9)))
    npt.assert_allclose(fit.values[0], [0.3, 0.5, 5.0, 0.01], rtol=1e-9)


def test_refuses_empty_cells():
    with pytest.raises(FitError, match="must be finite"):
        solve_stribeck(SPEEDS[None], LOAD, np.full((1, 9), np.nan), np.ones((1, 9)))


# ---------------------------------------------------------------- intervals
@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10**6))
def test_ends_are_where_a_constrained_solver_says_the_limit_is_reached(seed):
    """Second way: Lawson-Hanson with c_j fixed gives exactly the limit just inside, and more just outside."""
    rng = np.random.default_rng(seed)
    columns, y = np.abs(rng.normal(size=(8, 3))), rng.normal(size=8) + 0.7
    best = nnls(columns, y)[1] ** 2
    limit = best + 1.5
    low, high = constrained_ends(columns[None, None], y[None, None], np.array([limit]), (True, True, True))

    def at(j, value):
        rest = np.delete(columns, j, axis=1)
        return nnls(rest, y - value * columns[:, j])[1] ** 2

    for j in range(3):
        npt.assert_allclose(at(j, high[0, 0, j]), limit, rtol=1e-8)
        if low[0, 0, j] > 0:
            npt.assert_allclose(at(j, low[0, 0, j]), limit, rtol=1e-8)
        else:
            assert at(j, 0.0) <= limit * (1 + 1e-9)


def test_intervals_are_those_of_the_curvature_where_the_data_are_good():
    true = np.array([0.7, 0.45, 8.0, 0.02])
    force = curve(SPEEDS, mu_s=true[0], mu_c=true[1], v_s=true[2], sigma_2=true[3])[None]
    weight = np.full((1, 9), 1 / 0.01**2)
    speed, load = SPEEDS[None], np.full((1, 9), LOAD)
    fit = solve_stribeck(speed, load, force, weight)
    low, high = stribeck_intervals(speed, load, force, weight, fit, np.array([1.96**2]))
    step = 1e-6 * true
    moved = [
        [curve(SPEEDS, **dict(zip(
             ("mu_s", "mu_c", "v_s", "sigma_2"), true + s * np.eye(4)[k] * step, strict=True)))
         for s in (1, -1)]
        for k in range(4)
    ]  # fmt: skip
    tangent = (
        np.stack([(up - down) / (2 * h) for (up, down), h in zip(moved, step, strict=True)], axis=1) / 0.01
    )
    se = np.sqrt(np.diag(np.linalg.inv(tangent.T @ tangent)))
    npt.assert_allclose((high - low)[0] / (2 * 1.96 * se), 1.0, rtol=5e-3)


def test_flat_friction_has_open_intervals():
    force = np.full((1, 9), 20.0) + 0.1 * np.sin(np.arange(9.0))
    speed, load, weight = SPEEDS[None], np.full((1, 9), LOAD), np.full((1, 9), 100.0)
    fit = solve_stribeck(speed, load, force, weight)
    low, high = stribeck_intervals(speed, load, force, weight, fit, np.array([4.0]))
    assert low[0, 2] == 0.0
    assert np.isinf(high[0, 2])
    assert high[0, 0] > 100  # mu_s: a spike below the slowest speed cannot be excluded


@pytest.mark.long
@pytest.mark.parametrize("df", [np.inf, 12])
def test_no_stribeck_is_rejected_as_often_as_its_level_says(df):
    """2000 flat campaigns, nominal 5 %: 3 standard errors of the count are 1.5 %."""
    rng = np.random.default_rng(5)
    runs = 2000
    force = LOAD * 0.4 + 0.01 * SPEEDS + rng.normal(0, 0.2, (runs, 9))
    weight = np.full((runs, 9), 1 / 0.2**2)
    fit = solve_stribeck(SPEEDS, LOAD, force, weight)
    base = np.stack([np.full(9, LOAD), SPEEDS], axis=1)
    flat = np.sum((force.T - base @ np.linalg.lstsq(base, force.T, rcond=None)[0]) ** 2, axis=0) / 0.2**2
    variance = np.ones(runs) if np.isinf(df) else rng.chisquare(df, runs) / df
    grid = fit.grid[0]
    p = [
        flat_p_value(SPEEDS, base, weight[0], grid, gain / s2, df)
        for gain, s2 in zip(flat - fit.rss, variance, strict=True)
    ]
    assert 0.03 < np.mean(np.array(p) < 0.05) < 0.065
