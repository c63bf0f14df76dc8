r"""One law of aging for all temperatures and compressions of a rubber, and the evidence for its shape.

.. math:: \mu(t, T, C) = \mu_0 - a\, k^{w}\, \varphi(k^{1-w}\, t), \quad
    \ln k = \frac{E}{R} \Big(\frac{1}{T_{ref}} - \frac{1}{T}\Big) + \kappa\, (C_{ref} - C)

with T in kelvin and C the height while aging in percent. Temperature and compression change the rate of aging (w = 0:
time-temperature superposition, all series fall on one master curve over k t) or the loss itself (w = 1). mu_0 is that
of the unaged rubber, shared by all. phi is one of `sealfit.physics.losses`; which shape and which way is chosen by
Schwarz's criterion, and the rivals are kept beside it.

Ferry 1980, Viscoelastic Properties of Polymers, chapter 11 (superposition); ISO 11346 (life of rubber by Arrhenius).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from scipy import stats
from scipy.optimize import brentq

from sealfit.errors import FitError
from sealfit.fit.polish import central_jacobian, polish
from sealfit.physics.losses import LOSSES, Loss

GAS_CONSTANT = 8.314462618e-3  # kJ/(mol K), CODATA 2018
ZERO_C = 273.15
WAYS = ("rate", "loss")  # what temperature and compression change
ENERGIES = (0.0, 50.0, 100.0)  # kJ/mol, to begin with
SHAPES = {"b": (0.01, 0.3, 10.0), "tau": (0.5, 5.0, 50.0), "beta": (0.5, 1.0), "n": (0.2, 0.5, 1.0), "t_i": (0.3, 3.0)}
LIMITS = {"b": (1e-9, 1e4), "tau": (1e-6, 1e6), "beta": (0.05, 5.0), "n": (0.01, 5.0), "t_i": (1e-3, 1e3)}
TURNS, SETTLED = 4, 0.02  # of the fit and the scatter, at most; relative change of the scatter that ends them
RIVAL = 6.0  # of the criterion: a rival law is less likely than the chosen one by less than exp(3)
KNOWN = np.log(100.0)  # a positive number whose 95 % interval spans more than this is not determined


@dataclass(frozen=True)
class Aged:
    """Values of one quantity: a specimen, or the mean of those of one condition, each.

    Attributes
    ----------
    days, value : ndarray, shape (n,)
        Aging time in days, and the value measured.
    temperature_C, compression_pct : ndarray, shape (n,), or None
        Of aging; whatever stands there for unaged specimens is not read. None where no such thing was varied.
    variance : ndarray, shape (n,)
        Of each value as measured; the scatter between specimens is estimated and added. 0 where it is all there is.
    """

    days: np.ndarray
    value: np.ndarray
    temperature_C: np.ndarray | None = None
    compression_pct: np.ndarray | None = None
    variance: np.ndarray | None = None

    def part(self, keep: np.ndarray) -> Aged:
        """Return some of the values."""
        taken = {
            name: None if getattr(self, name) is None else getattr(self, name)[keep]
            for name in ("temperature_C", "compression_pct", "variance")
        }
        return replace(self, days=self.days[keep], value=self.value[keep], **taken)

    def drivers(self) -> dict[str, np.ndarray]:
        """Return what multiplies E (kJ/mol) and kappa (per percent) in ln k, for those that vary, shape (n,) each."""
        aged, found = self.days > 0, {}
        for name, at, column in (("E", self.temperature_C, _inverse), ("kappa", self.compression_pct, _plain)):
            if at is not None and np.unique(at[aged]).size > 1:
                found[name] = np.where(aged, column(reference_of(at[aged])) - column(at), 0.0)
        return found

    def series(self) -> np.ndarray:
        """Return the number of each value's series, shape (n,); -1 for unaged specimens."""
        keys = [at for at in (self.temperature_C, self.compression_pct) if at is not None]
        number, aged = np.full(self.days.size, -1), self.days > 0
        number[aged] = 0
        if keys:
            number[aged] = np.unique(np.column_stack(keys)[aged], axis=0, return_inverse=True)[1].ravel()
        return number


def _inverse(celsius):
    return 1 / (GAS_CONSTANT * (np.asarray(celsius, float) + ZERO_C))


def _plain(percent):
    return np.asarray(percent, float)


def reference_of(tested: np.ndarray) -> float:
    """Return the middle of the tested temperatures or compressions, at which k is 1."""
    return float(np.median(np.unique(tested)))


@dataclass(frozen=True)
class JointLaw:
    """A law fitted to all series of one quantity.

    Attributes
    ----------
    aged : Aged
        What it was fitted to.
    loss, way : Loss, str
        Shape, and what temperature and compression change.
    names : tuple of str
        mu_0, a, the shape's own, E, kappa, those that there are.
    x : ndarray, shape (p,)
        Estimates in this order; the shape's own as logarithms.
    covariance : ndarray, shape (p, p)
        Of x.
    scatter : float
        Relative standard deviation between specimens beyond the measured variance.
    criterion : float
        Schwarz's: -2 log L + p log n.
    """

    aged: Aged
    loss: Loss
    way: str
    names: tuple[str, ...]
    x: np.ndarray
    covariance: np.ndarray
    scatter: float
    criterion: float

    @property
    def df(self) -> int:
        """Values less parameters."""
        return self.aged.value.size - self.x.size

    @property
    def t(self) -> float:
        """Student's quantile of 95 % intervals."""
        return float(stats.t.ppf(0.975, max(self.df, 1)))

    def at(self, aged: Aged, x: np.ndarray | None = None) -> np.ndarray:
        """Return the law at other conditions, shape (n,); their references are those of the fit."""
        return _law(self, self.x if x is None else x, aged.days, self.log_rate(aged, x))

    def log_rate(self, aged: Aged, x: np.ndarray | None = None) -> np.ndarray:
        """Return ln k at some conditions, shape (n,)."""
        x, total = self.x if x is None else x, np.zeros(aged.days.size)
        tested = self.aged.days > 0
        for name, at, there, column in (
            ("E", aged.temperature_C, self.aged.temperature_C, _inverse),
            ("kappa", aged.compression_pct, self.aged.compression_pct, _plain),
        ):
            if name in self.names:
                away = column(reference_of(there[tested])) - column(at)
                total = total + x[self.names.index(name)] * np.where(aged.days > 0, away, 0.0)
        return total

    def parameters(self) -> Iterator[tuple[str, float, float, float, bool]]:
        """Yield name, value, ends of the 95 % interval, and whether the values determine it."""
        for k, name in enumerate(self.names):
            half = self.t * float(np.sqrt(self.covariance[k, k]))
            if name in self.loss.parameters:
                low, high = (float(np.exp(np.clip(self.x[k] + s * half, -700, 700))) for s in (-1, 1))
                yield name, float(np.exp(self.x[k])), low, high, bool(2 * half < KNOWN)
            else:
                known = np.isfinite(half) and (name != "a" or abs(self.x[k]) > half)
                yield name, float(self.x[k]), float(self.x[k] - half), float(self.x[k] + half), bool(known)


def _law(law: JointLaw, x: np.ndarray, days: np.ndarray, log_rate: np.ndarray) -> np.ndarray:
    own = np.exp(x[2 : 2 + len(law.loss.parameters)])
    k = np.exp(np.clip(log_rate, -50, 50))
    if law.way == "rate":
        return x[0] - x[1] * law.loss.value(days * k, *own)
    return x[0] - x[1] * k * law.loss.value(days, *own)


def fit_joint_law(aged: Aged, loss: str = "log", way: str = "rate") -> JointLaw:
    """Fit one law to all series of a quantity, the scatter between specimens estimated with it.

    Parameters
    ----------
    aged : Aged
        Values of at least as many conditions as the law has numbers.
    loss : str
        Name in `LOSSES`.
    way : str
        "rate" or "loss".

    Raises
    ------
    FitError
        If there are fewer different conditions than parameters, or no aged specimen.
    """
    shape, drivers = LOSSES[loss], aged.drivers()
    names = ("mu_0", "a", *shape.parameters, *drivers)
    conditions = len(set(zip(aged.series().tolist(), aged.days.tolist(), strict=True)))
    if conditions < len(names) or not (aged.days > 0).any():
        raise FitError(
            f"{conditions} conditions do not determine the {len(names)} numbers of the law '{loss}'.",
            mend="Test more days, or choose a law with fewer numbers.",
        )
    empty = JointLaw(aged, shape, way, names, np.zeros(len(names)), np.zeros((len(names),) * 2), 0.0, np.inf)
    measured = np.zeros(aged.value.size) if aged.variance is None else aged.variance
    x, scatter, before = None, 0.05, np.inf
    for _ in range(TURNS):
        sd = np.sqrt(measured + (scatter * aged.value) ** 2 + 1e-300)
        x = _solved(empty, sd, x)
        residual = aged.value - empty.at(aged, x)
        before, scatter = scatter, _scatter(residual, measured, aged.value, aged.value.size - len(names))
        if abs(scatter - before) <= SETTLED * before:
            break
    sd = np.sqrt(measured + (scatter * aged.value) ** 2 + 1e-300)
    white = central_jacobian(lambda at: empty.at(aged, at), x) / sd[:, None]
    size = np.maximum(np.linalg.norm(white, axis=0), 1e-300)
    inverse = np.linalg.pinv((white / size).T @ (white / size), rcond=1e-12, hermitian=True)
    chi2 = float(((aged.value - empty.at(aged, x)) ** 2 / sd**2).sum())
    criterion = chi2 + float(2 * np.log(sd).sum()) + len(names) * np.log(aged.value.size)
    return replace(empty, x=x, covariance=inverse / np.outer(size, size), scatter=scatter, criterion=criterion)


def _solved(law: JointLaw, sd: np.ndarray, start: np.ndarray | None, aged: Aged | None = None) -> np.ndarray:
    """Return the parameters of least weighted squares: from a start, or from the best few of a grid."""
    aged, own = aged or law.aged, law.loss.parameters
    low = np.array([np.log(LIMITS[n][0]) if n in own else -np.inf for n in law.names])
    high = np.array([np.log(LIMITS[n][1]) if n in own else np.inf for n in law.names])

    def residual(x):
        return (law.at(aged, x) - aged.value) / sd

    if start is not None:
        return polish(residual, None, start, (low, high)).x
    grids = [[np.log(v) for v in SHAPES[name]] for name in own]
    grids += [ENERGIES if name == "E" else (0.0,) for name in law.names[2 + len(own) :]]
    tried = []
    for point in product(*grids):
        x = np.r_[0.0, 1.0, point]
        basis = np.column_stack([np.ones(aged.value.size), law.at(aged, x)]) / sd[:, None]
        x[:2], *_ = np.linalg.lstsq(basis, aged.value / sd, rcond=1e-10)
        tried.append((float((residual(x) ** 2).sum()), x))
    tried.sort(key=lambda entry: entry[0])
    found = [polish(residual, None, x, (low, high)) for _, x in tried[:4]]
    return min(found, key=lambda f: f.rss).x


def refitted(law: JointLaw, aged: Aged, sd: np.ndarray) -> JointLaw:
    """Return a law fitted to other values, their standard deviations given, shape (n,); references stay the law's."""
    return replace(law, x=_solved(law, sd, law.x, aged))


def _scatter(residual: np.ndarray, measured: np.ndarray, size: np.ndarray, df: int) -> float:
    """Return the relative scatter beyond the measured variance at which chi-square is its degrees of freedom.

    Paule & Mandel 1982, J. Res. NBS 87(5), 377-385, doi:10.6028/jres.087.022.
    """
    if df < 1:
        return 0.0

    def excess(tau):
        return float((residual**2 / (measured + (tau * size) ** 2 + 1e-300)).sum()) - df

    if excess(0.0) <= 0:
        return 0.0
    high = float(np.sqrt(np.mean((residual / size) ** 2))) + 1e-9
    while excess(high) > 0:
        high *= 2
    return float(brentq(excess, 0.0, high, xtol=1e-6 * high))


def fit_laws(aged: Aged, losses: Sequence[str] = tuple(LOSSES)) -> list[JointLaw]:
    """Return every law that these values determine, both ways, likeliest first.

    Raises
    ------
    FitError
        If they determine none.
    """
    found, last = [], None
    for loss in losses:
        both = aged.drivers() and loss != "power"  # a power of k t is a power of k times one of t
        for way in WAYS if both else WAYS[:1]:
            try:
                found.append(fit_joint_law(aged, loss, way))
            except FitError as error:
                last = error
    if not found:
        raise last
    return sorted(found, key=lambda law: law.criterion)


def rivals_of(laws: Sequence[JointLaw]) -> list[JointLaw]:
    """Return the laws that these values cannot tell from the first."""
    return [law for law in laws[1:] if law.criterion - laws[0].criterion < RIVAL]


def left_out(law: JointLaw) -> dict[str, float]:
    """Return the RMS error of a law at whole series, and at last days, that it was not fitted to; NaN without any."""
    aged, series = law.aged, law.aged.series()
    measured = np.zeros(aged.value.size) if aged.variance is None else aged.variance
    sd = np.sqrt(measured + (law.scatter * aged.value) ** 2 + 1e-300)
    numbers = np.unique(series[series >= 0])
    whole = [series == k for k in numbers]
    ends = [(series == k) & (aged.days == aged.days[series == k].max()) for k in numbers]
    found = {}
    for name, masks in (("series", whole if len(whole) > 2 else []), ("last_day", ends)):
        squares = []
        for out in masks:
            part = aged.part(~out)
            if part.drivers().keys() == aged.drivers().keys():
                x = refitted(law, part, sd[~out]).x
                squares += list((law.at(aged.part(out), x) - aged.value[out]) ** 2)
        found[name] = float(np.sqrt(np.mean(squares))) if squares else np.nan
    return found
