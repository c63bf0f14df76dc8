"""The solver on the 27 NIST reference sets: certified parameters, standard deviations and sums of squares."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from sealfit.fit.least_squares import central_jacobian, covariance_of, levenberg_marquardt

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
        # not from the file: Rat43's header prints 9, its certified residual standard deviation is of 15 - 4 =
        # 11
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
    return (
        b[0] * exp(-b[1] * x)
        + b[2] * exp(-(((x - b[3]) / b[4]) ** 2))
        + b[5] * exp(-(((x - b[6]) / b[7]) ** 2))
    )


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


EXACT = "Lanczos1"
ENOUGH = 8  # digits of parameters and standard deviations
FLAT = {
    "Lanczos3": 6
}  # three nearly equal decays: moving along the valley by 1e-6 changes no digit of the rss


def digits(found, certified):
    """Agreeing significant digits, the fewest over all numbers (NIST's log relative error), at most 11.

    To a tenth of a digit: further ones depend on how a machine rounds.
    """
    with np.errstate(divide="ignore"):
        return np.min(np.minimum(11, -np.log10(np.abs(np.asarray(found) / certified - 1)))).round(1)


# From these starting points Levenberg-Marquardt ends elsewhere; nothing in the program starts from a guess
# like them.
ASTRAY = {("BoxBOD", 0), ("MGH10", 0), ("MGH17", 0)}


@pytest.mark.parametrize("start", [0, 1], ids=["start 1", "start 2"])
@pytest.mark.parametrize("name", MODELS)
def test_levenberg_marquardt_from_the_certified_starting_points(name, start):
    nist = read(name)

    def residual(b):
        return MODELS[name](b, nist.x) - nist.y

    def evaluate(x, rows):
        return np.stack([residual(b) for b in x]), np.stack([central_jacobian(residual, b).T for b in x])

    endless = np.full(nist.values.size, np.inf)
    x, rss = levenberg_marquardt(evaluate, nist.starts[start][None], -endless, endless)
    if (name, start) in ASTRAY:
        assert rss[0] > 1.01 * nist.rss, "it now arrives: take it off the list"
        pytest.xfail("another start than the certified values are reached from")
    assert digits(x[0], nist.values) >= FLAT.get(name, ENOUGH), digits(x[0], nist.values)
    if name == EXACT:
        assert rss[0] < 1e-19
        return
    covariance, _ = covariance_of(central_jacobian(residual, x[0]))
    deviations = np.sqrt(np.diag(covariance) * rss[0] / nist.df)
    assert digits(rss[0], nist.rss) >= 9.5, digits(rss[0], nist.rss)
    assert digits(deviations, nist.deviations) >= FLAT.get(name, ENOUGH), digits(deviations, nist.deviations)


def test_every_set_is_there_and_reached():
    assert {path.stem for path in FOLDER.glob("*.dat")} == set(MODELS)
    assert len(MODELS) == 27
    assert not {name for name in MODELS if (name, 0) in ASTRAY and (name, 1) in ASTRAY}
