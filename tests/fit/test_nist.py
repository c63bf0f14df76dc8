"""The solvers on the 27 NIST reference sets: certified parameters, standard deviations and residual sums of squares.

`solve_separable` (no starting guess) takes 24 sets; Gauss1 to Gauss3 have five nonlinear numbers, it takes three at
most. `polish` takes all 27 from both starting points, except those named in `ASTRAY`.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from sealfit.fit.polish import central_jacobian, polish
from sealfit.fit.separable import solve_separable

FOLDER = Path(__file__).parent / "nist"
exp, pi = np.exp, np.pi


@dataclass(frozen=True)
class Certified:
    starts: np.ndarray  # (2, p)
    values: np.ndarray
    deviations: np.ndarray
    rss: float
    y: np.ndarray
    x: np.ndarray

    @property
    def df(self):
        # not from the file: Rat43's header prints 9, its certified residual standard deviation is of 15 - 4 = 11
        return self.y.size - self.values.size


def read(name):
    lines = (FOLDER / f"{name}.dat").read_text().splitlines()
    table, rss = [], None
    for line in lines[40:60]:
        words = line.replace("=", " ").split()
        if words and words[0].startswith("b") and words[0][1:].isdigit():
            table.append([float(word) for word in words[1:5]])
        elif line.startswith("Residual Sum of Squares"):
            rss = float(words[-1])
    data = np.array([[float(word) for word in line.split()] for line in lines[60:] if line.strip()])
    table = np.array(table)
    y = np.log(data[:, 0]) if name == "Nelson" else data[:, 0]
    x = data[:, 1:].T if name == "Nelson" else data[:, 1]
    return Certified(table[:, :2].T, table[:, 2], table[:, 3], rss, y, x)


def gauss(b, x):
    return b[0] * exp(-b[1] * x) + b[2] * exp(-(((x - b[3]) / b[4]) ** 2)) + b[5] * exp(-(((x - b[6]) / b[7]) ** 2))


def lanczos(b, x):
    return b[0] * exp(-b[1] * x) + b[2] * exp(-b[3] * x) + b[4] * exp(-b[5] * x)


def cubics(b, x):
    return (b[0] + b[1] * x + b[2] * x**2 + b[3] * x**3) / (1 + b[4] * x + b[5] * x**2 + b[6] * x**3)


def saturation(b, x):
    return b[0] * (1 - exp(-b[1] * x))


def chwirut(b, x):
    return exp(-b[0] * x) / (b[1] + b[2] * x)


def turns(period, x):
    return np.cos(2 * pi * x / period), np.sin(2 * pi * x / period)


def enso(b, x):
    (c0, s0), (c1, s1), (c2, s2) = turns(12, x), turns(b[3], x), turns(b[6], x)
    return b[0] + b[1] * c0 + b[2] * s0 + b[4] * c1 + b[5] * s1 + b[7] * c2 + b[8] * s2


MODELS = {
    "Bennett5": lambda b, x: b[0] * (b[1] + x) ** (-1 / b[2]),
    "BoxBOD": saturation,
    "Chwirut1": chwirut,
    "Chwirut2": chwirut,
    "DanWood": lambda b, x: b[0] * x ** b[1],
    "ENSO": enso,
    "Eckerle4": lambda b, x: b[0] / b[1] * exp(-0.5 * ((x - b[2]) / b[1]) ** 2),
    "Gauss1": gauss,
    "Gauss2": gauss,
    "Gauss3": gauss,
    "Hahn1": cubics,
    "Kirby2": lambda b, x: (b[0] + b[1] * x + b[2] * x**2) / (1 + b[3] * x + b[4] * x**2),
    "Lanczos1": lanczos,
    "Lanczos2": lanczos,
    "Lanczos3": lanczos,
    "MGH09": lambda b, x: b[0] * (x**2 + x * b[1]) / (x**2 + x * b[2] + b[3]),
    "MGH10": lambda b, x: b[0] * exp(b[1] / (x + b[2])),
    "MGH17": lambda b, x: b[0] + b[1] * exp(-x * b[3]) + b[2] * exp(-x * b[4]),
    "Misra1a": saturation,
    "Misra1b": lambda b, x: b[0] * (1 - (1 + b[1] * x / 2) ** -2),
    "Misra1c": lambda b, x: b[0] * (1 - (1 + 2 * b[1] * x) ** -0.5),
    "Misra1d": lambda b, x: b[0] * b[1] * x / (1 + b[1] * x),
    "Nelson": lambda b, x: b[0] - b[1] * x[0] * exp(-b[2] * x[1]),
    "Rat42": lambda b, x: b[0] / (1 + exp(b[1] - b[2] * x)),
    "Rat43": lambda b, x: b[0] / (1 + exp(b[1] - b[2] * x)) ** (1 / b[3]),
    "Roszman1": lambda b, x: b[0] - b[1] * x - np.arctan(b[2] / (x - b[3])) / pi,
    "Thurber": cubics,
}


@dataclass(frozen=True)
class Form:
    """A set as columns of the nonlinear numbers t (m, d): where to search, and the way back to NIST's parameters."""

    columns: object  # (t: d arrays of shape (m, 1), x: (n,)) -> list of (m, n)
    grid: tuple
    back: object  # (c, t) -> b
    offset: object = None


def log_grid(low, high, n):
    return np.geomspace(low, high, n)


def rational(top, bottom):
    """Numerator of `top` linear coefficients over 1 + t0 x + t1 x^2 ..."""
    return lambda t, x: [x**k / (1 + sum(t[j] * x ** (j + 1) for j in range(bottom))) for k in range(top)]


def one(value):
    return lambda t, x: [value(t, x)]


def exponentials(n):
    return lambda t, x: [exp(-t[k] * x) for k in range(n)]


def same(c, t):
    return [*c, *t]


CHWIRUT = Form(
    one(lambda t, x: exp(-t[0] * x) / (1 + t[1] * x)),
    (log_grid(1e-2, 10, 15), log_grid(1e-2, 100, 15)),
    lambda c, t: [t[0], 1 / c[0], t[1] / c[0]],
)
LANCZOS = Form(
    exponentials(3),
    (log_grid(0.3, 3, 8), log_grid(1, 6, 8), log_grid(3, 12, 8)),
    lambda c, t: [c[0], t[0], c[1], t[1], c[2], t[2]],
)
FORMS = {
    "Bennett5": Form(
        one(lambda t, x: ((t[0] + x) / 100) ** (-1 / t[1])),
        (log_grid(1, 300, 25), log_grid(0.2, 5, 25)),
        lambda c, t: [c[0] * 100 ** (1 / t[1]), *t],
    ),
    "BoxBOD": Form(one(lambda t, x: 1 - exp(-t[0] * x)), (log_grid(1e-3, 10, 40),), same),
    "Chwirut1": CHWIRUT,
    "Chwirut2": CHWIRUT,
    "DanWood": Form(one(lambda t, x: x ** t[0]), (np.linspace(-6, 6, 40),), same),
    "ENSO": Form(
        lambda t, x: [np.ones_like(x + t[0]), *(q + 0 * t[0] for q in turns(12, x)), *turns(t[0], x), *turns(t[1], x)],
        (np.linspace(30, 60, 40), np.linspace(20, 30, 30)),
        lambda c, t: [c[0], c[1], c[2], t[0], c[3], c[4], t[1], c[5], c[6]],
    ),
    "Eckerle4": Form(
        one(lambda t, x: exp(-0.5 * ((x - t[1]) / t[0]) ** 2)),
        (log_grid(0.5, 50, 20), np.linspace(400, 500, 40)),
        lambda c, t: [c[0] * abs(t[0]), abs(t[0]), t[1]],
    ),
    "Hahn1": Form(
        rational(4, 3),
        (np.linspace(-1e-2, 1e-2, 21), np.linspace(-5e-4, 5e-4, 21), np.linspace(-5e-7, 5e-7, 20)),
        same,
    ),
    "Kirby2": Form(rational(3, 2), (np.linspace(-1e-2, 1e-2, 41), log_grid(1e-6, 1e-3, 31)), same),
    "Lanczos1": LANCZOS,
    "Lanczos2": LANCZOS,
    "Lanczos3": LANCZOS,
    "MGH09": Form(
        lambda t, x: [x**2 / (x**2 + x * t[0] + t[1]), x / (x**2 + x * t[0] + t[1])],
        (log_grid(1e-2, 10, 25), log_grid(1e-2, 10, 25)),
        lambda c, t: [c[0], c[1] / c[0], *t],
    ),
    # exp of b2/(x + b3), taken relative to x = 85 so that it neither over- nor underflows
    "MGH10": Form(
        one(lambda t, x: exp(t[0] / (x + t[1]) - t[0] / (85 + t[1]))),
        (log_grid(1e2, 1e5, 30), log_grid(10, 1e4, 30)),
        lambda c, t: [c[0] * exp(-t[0] / (85 + t[1])), *t],
    ),
    "MGH17": Form(
        lambda t, x: [np.ones_like(x + t[0]), *exponentials(2)(t, x)],
        (log_grid(1e-3, 0.02, 15), log_grid(0.015, 0.3, 15)),
        same,
    ),
    "Misra1a": Form(one(lambda t, x: 1 - exp(-t[0] * x)), (log_grid(1e-5, 1, 60),), same),
    "Misra1b": Form(one(lambda t, x: 1 - (1 + t[0] * x / 2) ** -2), (log_grid(1e-5, 1, 60),), same),
    "Misra1c": Form(one(lambda t, x: 1 - (1 + 2 * t[0] * x) ** -0.5), (log_grid(1e-5, 1, 60),), same),
    "Misra1d": Form(one(lambda t, x: t[0] * x / (1 + t[0] * x)), (log_grid(1e-5, 1, 60),), same),
    "Nelson": Form(
        lambda t, x: [np.ones_like(x[0] + t[0]), -x[0] * exp(-t[0] * x[1])], (np.linspace(-0.2, 0.2, 81),), same
    ),
    "Rat42": Form(
        one(lambda t, x: 1 / (1 + exp(t[0] - t[1] * x))), (np.linspace(-5, 10, 31), log_grid(1e-3, 1, 25)), same
    ),
    "Rat43": Form(
        one(lambda t, x: 1 / (1 + exp(t[0] - t[1] * x)) ** (1 / t[2])),
        (np.linspace(-5, 15, 21), log_grid(0.05, 5, 15), log_grid(0.1, 10, 15)),
        same,
    ),
    "Roszman1": Form(
        lambda t, x: [np.ones_like(x + t[0]), -x + 0 * t[0]],
        (log_grid(10, 1e4, 25), np.linspace(-1000, -10, 25)),
        same,
        lambda t, x: -np.arctan(t[0] / (x - t[1])) / pi,
    ),
    "Thurber": Form(
        rational(4, 3), (np.linspace(0, 2, 15), np.linspace(-0.5, 1, 16), np.linspace(-0.2, 0.2, 15)), same
    ),
}

# Lanczos1 is exact to 11 digits of y: its certified sum of squares, 1.4e-25, lies below what double precision can show
EXACT = "Lanczos1"
ENOUGH = 8  # digits of parameters and standard deviations
FLAT = {"Lanczos3": 6}  # three nearly equal decays: moving along the valley by 1e-6 changes no digit of the rss


def digits(found, certified):
    """Agreeing significant digits, the fewest over all numbers (NIST's log relative error), at most 11."""
    with np.errstate(divide="ignore"):
        return np.min(np.minimum(11, -np.log10(np.abs(np.asarray(found) / certified - 1))))


def fitted_separably(name):
    nist, form = read(name), FORMS[name]

    def parts(theta):
        return [theta[:, k, None] for k in range(theta.shape[1])]

    fit = solve_separable(
        lambda theta: np.stack(form.columns(parts(theta), nist.x), axis=-1),
        nist.y,
        grid=form.grid,
        offset=None if form.offset is None else lambda theta: form.offset(parts(theta), nist.x),
    )
    p = fit.coefficients.size

    def back(both):
        return np.array(form.back(both[:p], both[p:]))

    both = np.concatenate([fit.coefficients, fit.theta])
    b = back(both)
    change = central_jacobian(back, both)
    covariance = change @ fit.covariance @ change.T
    if name.startswith("Lanczos"):  # the three decays are interchangeable: in NIST's order
        order = np.argsort(b[1::2])
        take = np.ravel([[2 * k, 2 * k + 1] for k in order])
        b, covariance = b[take], covariance[np.ix_(take, take)]
    if name == "MGH17" and b[3] > b[4]:
        take = [0, 2, 1, 4, 3]
        b, covariance = b[take], covariance[np.ix_(take, take)]
    return nist, fit, b, covariance


@pytest.mark.parametrize("name", FORMS)
def test_separable_solver_needs_no_starting_point(name):
    nist, fit, b, covariance = fitted_separably(name)
    assert digits(b, nist.values) >= FLAT.get(name, ENOUGH), digits(b, nist.values)
    if name == EXACT:
        assert fit.rss < 1e-19
        return
    assert fit.df == nist.df
    deviations = np.sqrt(np.diag(covariance) * fit.rss / fit.df)
    assert digits(fit.rss, nist.rss) >= 9.5, digits(fit.rss, nist.rss)
    assert digits(deviations, nist.deviations) >= FLAT.get(name, ENOUGH), digits(deviations, nist.deviations)


# From these starting points Levenberg-Marquardt ends elsewhere; nothing in the program starts from a guess like them.
ASTRAY = {
    ("BoxBOD", 0): "both parameters 1: the exponential saturates before the first measurement and the slope is gone"
}


@pytest.mark.parametrize("start", [0, 1], ids=["start 1", "start 2"])
@pytest.mark.parametrize("name", MODELS)
def test_polish_from_the_certified_starting_points(name, start):
    nist = read(name)
    fit = polish(lambda b: MODELS[name](b, nist.x) - nist.y, None, nist.starts[start])
    if (name, start) in ASTRAY:
        assert fit.rss > 1.01 * nist.rss, "it now arrives: take it off the list"
        pytest.xfail(ASTRAY[name, start])
    assert fit.converged
    assert digits(fit.x, nist.values) >= FLAT.get(name, ENOUGH), digits(fit.x, nist.values)
    if name == EXACT:
        return
    deviations = np.sqrt(np.diag(fit.covariance) * fit.rss / nist.df)
    assert digits(fit.rss, nist.rss) >= 9.5, digits(fit.rss, nist.rss)
    assert digits(deviations, nist.deviations) >= FLAT.get(name, ENOUGH), digits(deviations, nist.deviations)


def test_every_set_is_there_and_every_set_is_used():
    assert {path.stem for path in FOLDER.glob("*.dat")} == set(MODELS)
    assert set(MODELS) - set(FORMS) == {"Gauss1", "Gauss2", "Gauss3"}
