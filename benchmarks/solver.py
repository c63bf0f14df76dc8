"""How many steady and aging fits a second, beside scipy's curve_fit from a good start, least_squares and lmfit.

    make bench-solver                                          (about a minute; lmfit is in .venv/bench)
    python benchmarks/solver.py [--problems N] [--seed N]

Every solver gets the same simulated problems (24 points and 4 numbers of Eq. 14; 7 points and 3 numbers of Eq. 15), on
one core. The others start at the truth, which nobody has; ours searches all v_s, or all b. Both with one design shared
by all problems, as bootstraps and simulations have it, and with measured speeds or days of their own. Ours and the
others take turns, `ROUNDS` times, and of each the fastest round counts: other work on the machine slows all. Prints
fits a second, the ratio to ours, and the worst excess of our sum of squares over the best of the others.
"""

from __future__ import annotations

import argparse
import platform
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import scipy
from scipy.optimize import curve_fit, least_squares

from sealfit.fit.law import solve_law
from sealfit.fit.stribeck import solve_stribeck
from sealfit.physics import aging_law, stribeck_force
from sealfit.threads import one_thread

SPEEDS = np.tile(np.geomspace(0.5, 64.0, 8), 3)
DAYS = np.array([0.0, 1, 2, 4, 8, 12, 16])
LOAD = 49.03
SHARED = 100  # problems that the slow solvers get: their rate does not depend on how many
ROUNDS = 5


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--problems", type=int, default=20_000)
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    one_thread()
    print(f"{cpu()}, Python {platform.python_version()}, numpy {np.__version__}, scipy {scipy.__version__}, "
          f"{given.problems} problems, seed {given.seed}, one core")  # fmt: skip
    rng = np.random.default_rng(given.seed)
    for own in (False, True):
        design = "each its own" if own else "all the same"
        compare(f"steady, speeds {design}", *steady(given.problems, rng, own))
        compare(f"aging, days {design}", *aging(given.problems, rng, own))


def cpu() -> str:
    """Return the processor's name."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    return next((line.split(":")[1].strip() for line in lines if line.startswith("model name")), platform.machine())


def steady(count: int, rng: np.random.Generator, own: bool) -> tuple:
    """Return ours, the model and its problems: x (problems or 1, n), y and the truth as a start, and bounds."""
    truth = np.column_stack([rng.uniform(0.6, 1, count), rng.uniform(0.3, 0.6, count), rng.uniform(2, 10, count),
                             rng.uniform(0.01, 0.1, count)])  # fmt: skip

    def model(speed, mu_s, mu_c, v_s, sigma_2):
        return LOAD * (mu_c + (mu_s - mu_c) * np.exp(-((speed / v_s) ** 2))) + sigma_2 * speed

    speed = SPEEDS * np.exp(0.01 * rng.standard_normal((count, SPEEDS.size))) if own else SPEEDS[None, :]
    names = ("mu_s", "mu_c", "v_s", "sigma_2")
    force = stribeck_force(speed, LOAD, **dict(zip(names, truth.T[..., None], strict=True)))
    force = force * (1 + 0.01 * rng.standard_normal(force.shape))

    def ours() -> np.ndarray:
        return solve_stribeck(speed, np.full((1, 1), LOAD), force, np.ones((1, 1))).rss

    return ours, model, speed, force, truth, (np.zeros(4), np.array([5.0, 5.0, 1000.0, 10.0]))


def aging(count: int, rng: np.random.Generator, own: bool) -> tuple:
    """Return the same for the aging law; b as its logarithm, so that the others stay where it is positive."""
    truth = np.column_stack(
        [rng.uniform(0.6, 1, count), rng.uniform(0.02, 0.06, count), np.log(rng.uniform(0.05, 1, count))]
    )

    def model(days, mu_0, a, log_b):
        return mu_0 - a * np.log1p(days / np.exp(log_b))

    days = DAYS * np.exp(0.05 * rng.standard_normal((count, DAYS.size))) if own else DAYS[None, :]
    value = aging_law(days, mu_0=truth[:, :1], a=truth[:, 1:2], b=np.exp(truth[:, 2:]))
    value = value * (1 + 0.002 * rng.standard_normal(value.shape))

    def ours() -> np.ndarray:
        return solve_law(days, value, np.ones((1, 1))).rss

    return ours, model, days, value, truth, (np.array([0.0, -1.0, -20.0]), np.array([5.0, 1.0, 10.0]))


def compare(title: str, ours: Callable, model: Callable, x, y, truth, bounds) -> None:
    """Print a line per solver."""
    few = range(min(SHARED, len(y)))
    x = np.broadcast_to(x, y.shape)
    solvers = others(model, bounds)
    quickest = dict.fromkeys(["ours", *solvers], np.inf)
    best = np.full(len(few), np.inf)
    for _ in range(ROUNDS):
        begun = time.perf_counter()
        found = ours()
        quickest["ours"] = min(quickest["ours"], (time.perf_counter() - begun) / len(y))
        for name, solver in solvers.items():
            begun = time.perf_counter()
            rss = np.array([solver(x[k], y[k], truth[k]) for k in few])
            quickest[name] = min(quickest[name], (time.perf_counter() - begun) / len(few))
            best = np.fmin(best, rss)
    mine = quickest.pop("ours")
    print(f"\n{title}, {x.shape[1]} points: sealfit {1 / mine:,.0f} fits a second, {1e6 * mine:.1f} us each")
    for name, each in quickest.items():
        print(f"  {name:42s} {1 / each:8,.0f} a second: sealfit does {each / mine:,.0f} times as many")
    excess = float(np.max(found[: len(best)] / best - 1))
    print(f"  worst excess of sealfit's sum of squares over the best of these: {excess:.1e}")


def others(model: Callable, bounds: tuple) -> dict[str, Callable[..., float]]:
    """Return solvers (x, y, start) -> sum of squares."""

    def by_curve_fit(x, y, start):
        try:
            found, _ = curve_fit(model, x, y, p0=start)
        except RuntimeError:
            return np.inf
        return float(((model(x, *found) - y) ** 2).sum())

    def by_least_squares(x, y, start):
        return 2 * least_squares(lambda p: model(x, *p) - y, start, bounds=bounds, x_scale="jac").cost

    solvers = {"scipy curve_fit from the truth": by_curve_fit, "scipy least_squares with bounds": by_least_squares}
    try:
        import lmfit
    except ImportError:
        return solvers
    fitter = lmfit.Model(model)

    def by_lmfit(x, y, start):
        return float(fitter.fit(y, fitter.make_params(**dict(zip(fitter.param_names, start, strict=True))),
                                **{fitter.independent_vars[0]: x}).chisqr)  # fmt: skip

    return {**solvers, f"lmfit {lmfit.__version__} from the truth": by_lmfit}


if __name__ == "__main__":
    main()
