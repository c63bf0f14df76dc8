"""The solver of many steady and aging fits against others: no worse sum of squares, whatever the problem."""

import numpy as np
import numpy.testing as npt
import pytest
from scipy.optimize import curve_fit, least_squares, nnls

from sealfit.fit.aging.law import solve_law
from sealfit.fit.steady.stribeck import solve_stribeck

PROBLEMS = 150
KINDS = ("plain", "shared", "loads", "limits", "falling", "noisy", "padded", "few")


def draw(kind, rng):
    """Speeds, loads, forces and weights of many problems of one kind, shape (problems, n), and the truth."""
    n = int(rng.choice([6, 8, 12, 24]))
    levels = int(rng.integers(4, 6)) if kind == "few" else n // 2 + 1
    slowest = 10 ** rng.uniform(-2, 1)
    fastest = slowest * 10 ** rng.uniform(0.7, 3)
    size = (1 if kind == "shared" else PROBLEMS, levels)
    speed = np.exp(rng.uniform(np.log(slowest), np.log(fastest), size))[:, np.arange(n) % levels]
    speed = np.broadcast_to(speed, (PROBLEMS, n))
    load = rng.uniform(20, 80, (PROBLEMS, n)) if kind == "loads" else np.full((PROBLEMS, n), 49.0)
    beyond = np.array([0.2, 20.0]) if kind == "limits" else 1.0
    truth = np.stack(
        [
            rng.uniform(0.05, 1, PROBLEMS),
            rng.uniform(0.05, 1, PROBLEMS),
            np.exp(rng.uniform(*np.log(np.array([slowest, fastest]) * beyond), PROBLEMS)),
            rng.uniform(-1 if kind == "falling" else 0, 0 if kind == "falling" else 1, PROBLEMS)
            * 2
            / fastest,
        ],
        axis=1,
    )
    force = model((speed, load), *truth.T[..., None])
    force = force + 10 ** rng.uniform(-3, 1 if kind == "noisy" else 0) * rng.normal(size=force.shape)
    weight = rng.uniform(0.2, 5, (PROBLEMS, n))
    if kind == "padded":
        weight[:, 5:] *= rng.random((PROBLEMS, n - 5)) < 0.7
    return speed, load, force, weight, truth


def model(x, mu_s, mu_c, v_s, sigma_2):
    speed, load = x
    return load * (mu_c + (mu_s - mu_c) * np.exp(-((speed / v_s) ** 2))) + sigma_2 * speed


@pytest.mark.parametrize("kind", KINDS)
def test_no_v_s_of_a_fine_search_does_better(kind):
    """A second way: Lawson and Hanson's non-negative least squares at 1,500 v_s over all that is searched."""
    speed, load, force, weight, _ = draw(kind, np.random.default_rng(KINDS.index(kind)))
    fit = solve_stribeck(speed, load, force, weight)
    root = np.sqrt(weight)
    assert np.all(fit.values[:, [0, 1, 3]] >= 0)
    rest = root * (force - model((speed, load), *fit.values.T[..., None]))
    npt.assert_allclose(fit.rss, np.sum(rest**2, axis=1), rtol=1e-9)
    for k in range(0, PROBLEMS, 50):
        scan = []
        for v_s in np.exp(np.linspace(*fit.grid[k, [0, -1]], 1500)):
            decay = np.exp(-((speed[k] / v_s) ** 2))
            columns = np.stack([load[k] * decay, load[k] * (1 - decay), speed[k]], axis=1) * root[k][:, None]
            size = np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
            scan.append(nnls(columns / size, force[k] * root[k])[1] ** 2)
        assert fit.rss[k] <= min(scan) * (1 + 1e-9)


@pytest.mark.filterwarnings("ignore:Covariance of the parameters")
@pytest.mark.parametrize("kind", KINDS)
def test_no_other_solver_does_better_from_the_truth(kind):
    """curve_fit knows no signs, so it is compared where it ends with none that is wrong."""
    speed, load, force, weight, truth = draw(kind, np.random.default_rng(100 + KINDS.index(kind)))
    fit = solve_stribeck(speed, load, force, weight)
    for k in range(0, PROBLEMS, 15):
        x, y, root = (speed[k], load[k]), force[k], np.sqrt(weight[k])

        def residual(p, x=x, y=y, root=root):
            return root * (model(x, *p) - y)

        low, high = np.exp(fit.grid[k, [0, -1]])
        start = np.clip(truth[k], [0, 0, low * 1.001, 0], [5, 5, high * 0.999, np.inf])
        with np.errstate(all="ignore"):
            other = least_squares(residual, start, bounds=([0, 0, low, 0], [np.inf, np.inf, high, np.inf]))
            try:
                found, _ = curve_fit(model, x, y, p0=truth[k], sigma=1 / np.maximum(root, 1e-9))
            except RuntimeError:
                found = np.full(4, -1.0)
        floor = 1e-20 * np.sum((root * y) ** 2)  # below, both are rounding
        assert fit.rss[k] <= 2 * other.cost * (1 + 1e-9) + floor
        if np.all(found[[0, 1, 3]] >= 0) and low <= abs(found[2]) <= high:
            assert fit.rss[k] <= np.sum(residual(found) ** 2) * (1 + 1e-9) + floor


@pytest.mark.parametrize("shared", [True, False])
def test_no_b_of_a_fine_search_does_better(shared):
    """A second way: ordinary least squares at 3,000 b over all that is searched."""
    rng = np.random.default_rng(8)
    days = np.broadcast_to([0.0, 1, 2, 4, 8, 12, 16], (60, 7))
    days = days if shared else days * np.exp(rng.normal(0, 0.1, days.shape))
    value = rng.uniform(0.5, 1, (60, 1)) - 0.05 * np.log1p(days / np.exp(rng.uniform(-5, 3, (60, 1))))
    value = value + 10 ** rng.uniform(-4, -1, (60, 1)) * rng.normal(size=value.shape)
    weight = rng.uniform(0.5, 2, value.shape)
    fit = solve_law(days, value, weight)
    for k in range(60):
        root = np.sqrt(weight[k])[:, None]
        first, last = days[k][days[k] > 0].min(), days[k].max()
        b = np.exp(np.linspace(np.log(first * 1e-9), np.log(last * 1e3), 3000))[:, None]
        column = np.log1p(days[k] / b) * root[:, 0]
        unit = root[:, 0] / np.linalg.norm(root)
        column -= (column @ unit)[:, None] * unit
        rest = root[:, 0] * value[k] - unit * (unit @ (root[:, 0] * value[k]))
        left = rest @ rest - (column @ rest) ** 2 / np.einsum("gn,gn->g", column, column)
        assert fit.rss[k] <= left.min() * (1 + 1e-9)
        mu_0, a = fit.coefficients[k]
        model_rss = np.sum(weight[k] * (value[k] - mu_0 + a * np.log1p(days[k] / np.exp(fit.u[k]))) ** 2)
        npt.assert_allclose(fit.rss[k], model_rss, rtol=1e-8)
