"""One law of aging for all temperatures and compressions of a rubber, and the evidence for its shape."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import product

import numpy as np
from scipy.sparse import csr_array, diags_array
from scipy.special import fdtrc

from sealfit.effects import aging_laws
from sealfit.errors import FitError
from sealfit.fit.aging.law import Measured, paule_mandel
from sealfit.fit.joint.prior import covariance_of
from sealfit.fit.joint.whitening import blockwise, log_determinant, whitening_of
from sealfit.fit.least_squares import levenberg_marquardt, t_quantile
from sealfit.physics.aging_laws import LOSSES, Loss

# Gas constant in kJ/(mol K).
GAS_CONSTANT = aging_laws.GAS_CONSTANT / 1000
# Smallest variance of a value: without it the weights of values without scatter would be infinite.
TINY = 1e-280
# The same as a share of the largest variance; less is rounding.
ROUNDING = 1e-12
# Largest number of series that are left out in turn: it determines their RMS error to a tenth.
MOST_LEFT_OUT = 50
# Number of sets of values that are drawn anew.
RESAMPLES = 500
# Fewest degrees of freedom of a law that is compared with others that leave more.
SPARE = 2


# Variables that change the rate of aging: attribute, and its function in ln k beside the coefficient.
DRIVERS = {
    "E": ("temperature_C", lambda celsius: 1 / (GAS_CONSTANT * (celsius + aging_laws.ZERO_C))),
    "kappa": ("compression_ratio_pct", lambda percent: percent),
}


@dataclass(frozen=True)
class Aged(Measured):
    """Values of one quantity with the temperatures and compressions while aging."""

    temperature_C: np.ndarray | None = None  # not used for unaged specimens; None if unknown
    compression_ratio_pct: np.ndarray | None = None  # the same; height in percent
    variance: np.ndarray | csr_array | None = None  # of measurement, or its covariance, (n, n); None if 0
    # Relative scatter between specimens and its degrees of freedom, for laws that leave no residual.
    specimens: tuple[float, float] | None = None

    def part(self, keep: np.ndarray) -> "Aged":
        """Return the values in a mask, shape (n,)."""
        names = ("days", "value", "temperature_C", "compression_ratio_pct", "size")
        taken = {name: own[keep] for name in names if (own := getattr(self, name)) is not None}
        variance = self.variance
        if variance is not None:
            variance = variance[keep] if variance.ndim == 1 else variance[keep][:, keep]
        return replace(self, variance=variance, **taken)

    def covariance(self, scatter: float, about: np.ndarray | None = None) -> csr_array:
        """Return the covariance, shape (n, n), with scatter relative to `size`, `about` or the values."""
        measured = np.zeros(self.value.size) if self.variance is None else self.variance
        about = self.value if about is None else about
        measured = csr_array(diags_array(measured) if measured.ndim == 1 else measured)
        least = max(ROUNDING * measured.diagonal().max(), TINY)
        return measured + diags_array((scatter * self.scale(about)) ** 2 + least)

    def whitening(self, scatter: float) -> csr_array:
        """Return W with W C W' = 1 for the covariance C at a scatter, shape (n, n)."""
        return whitening_of(self.covariance(scatter))

    def chi2(self, residual: np.ndarray, scatter: float) -> float:
        """Return r' C^-1 r of a residual, shape (n,)."""
        return float(((self.whitening(scatter) @ residual) ** 2).sum())

    @cached_property
    def known(self) -> dict[str, np.ndarray]:
        """The variables on record, shape (n,) each, by the name of their coefficient."""
        found = {name: getattr(self, column) for name, (column, _) in DRIVERS.items()}
        return {name: at for name, at in found.items() if at is not None}

    def drivers(self) -> tuple[str, ...]:
        """Return the names of the coefficients in ln k of the variables that were varied."""
        return tuple(name for name, at in self.known.items() if np.unique(at[self.days > 0]).size > 1)

    @cached_property
    def middle(self) -> dict[str, float]:
        """Reference temperature and compression, the middle of the tested ones, by the coefficient's name."""
        return {name: float(np.median(np.unique(at[self.days > 0]))) for name, at in self.known.items()}

    def series(self) -> np.ndarray:
        """Return the number of each value's series, shape (n,); -1 for unaged specimens."""
        number = np.where(self.days > 0, 0, -1)
        if self.known:
            conditions = np.column_stack(list(self.known.values()))[number == 0]
            number[number == 0] = np.unique(conditions, axis=0, return_inverse=True)[1].ravel()
        return number

    def whole_series(self) -> list[np.ndarray]:
        """Return the mask of each series, shape (n,) each; of `MOST_LEFT_OUT`, evenly spread, if more."""
        series = self.series()
        chosen = np.linspace(0, series.max(), min(series.max() + 1, MOST_LEFT_OUT))
        return [series == k for k in np.unique(chosen.astype(int))]

    def last_days(self) -> list[np.ndarray]:
        """Return the mask of the last day of each of these series, shape (n,) each."""
        return [own & (self.days == self.days[own].max()) for own in self.whole_series()]


# ---------------------------------------------------------------- joint law
# .. math:: \mu(t, T, C) = \mu_0 - a\, k^{w}\, \varphi(k^{1-w}\, t), \quad
#     \ln k = \frac{E}{R} \Big(\frac{1}{T_{ref}} - \frac{1}{T}\Big) + \kappa\, (C_{ref} - C)
#
# with T in kelvin and C the height while aging in percent. Temperature and compression change the rate of
# aging (w = 0: time-temperature superposition, all series fall on one master curve over k t) or the loss
# itself (w = 1). mu_0 is that of the unaged rubber, shared by all. phi is one of
# `sealfit.physics.aging_laws`. BIC chooses phi and w. Ferry 1980, Viscoelastic Properties of Polymers,
# chapter 11 (superposition); ISO 11346 (life of rubber by Arrhenius).

# Quantities that temperature and compression may change.
TARGETS = ("rate", "loss")
# Largest number of alternating fits of the law and the scatter.
TURNS = 4
# Relative change of the scatter at which these fits have converged.
CONVERGED = 0.02
# Logarithm from which a time in days, or its inverse, is no bound: 5e21 d.
UNBOUNDED = 50.0
# Largest difference in BIC of a rival law: it is less likely than the chosen law by a factor of up to exp(3).
RIVAL = 6.0
# A positive parameter is not determined if its 95 % interval spans more than this natural logarithm.
KNOWN = np.log(100.0)


@dataclass(frozen=True)
class JointLaw:
    """A law fitted to all series of one quantity."""

    aged: Aged
    loss: Loss  # its shape
    acts_on: str  # what temperature and compression change: "rate" or "loss"
    names: tuple[str, ...]  # parameters: mu_0, a, those of the shape, and E and kappa if varied
    x: np.ndarray  # (p,) estimates; those of the shape are logarithms
    covariance: np.ndarray  # (p, p) of x
    scatter: float  # relative standard deviation between specimens, beyond the measurement variance
    bic: float  # -2 log L + p log n

    @property
    def df(self) -> float:
        """Degrees of freedom of intervals of the law's values: those of the scatter that they contain."""
        return self._df(level=True)

    def _df(self, *, level: bool) -> float:
        left = self.aged.value.size - self.x.size
        if left <= 0 and self.aged.specimens:
            left = self.aged.specimens[1]
        return self.aged.df(left, self.scatter, level=level)

    @property
    def t(self) -> float:
        """Student's quantile of 95 % intervals of the law's values."""
        return float(t_quantile(max(self.df, 1)))

    def lack_of_fit_p(self) -> float:
        """Return the p-value of the law's lack of fit against the replicates (F test); nan without them."""
        error, left = self.aged.replicates_df, self.aged.value.size - self.x.size
        if not (error > 0 and left > 0):
            return np.nan
        x = solved(self, self.aged, self.aged.whitening(0.0), self.x)
        chi2 = self.aged.chi2(self.aged.value - self.at(self.aged, x), 0.0)
        return float(fdtrc(left, error, chi2 / left))

    def at(self, aged: Aged, x: np.ndarray | None = None) -> np.ndarray:
        """Return the law at other conditions, shape (n,), or (..., n) for x of shape (..., p)."""
        x = self.x if x is None else x
        in_time, in_loss = self.factors(aged, x)
        return x[..., :1] - x[..., 1:2] * (in_loss * self.loss.value(aged.days * in_time, *self.own(x)))

    def factors(self, aged: Aged, x: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Return the factors of temperature and compression on time and on the loss, shape (..., n) each."""
        x, logarithm = self.x if x is None else x, np.zeros(aged.days.size)
        for name, away in self.away(aged).items():
            logarithm = logarithm + x[..., self.names.index(name), None] * away
        k = np.exp(np.clip(logarithm, -50, 50))
        return (k, np.ones_like(k)) if self.acts_on == "rate" else (np.ones_like(k), k)

    def own(self, x: np.ndarray) -> list[np.ndarray]:
        """Return the parameters of the shape, shape (..., 1) each."""
        return [np.exp(x[..., 2 + k, None]) for k in range(len(self.loss.parameters))]

    def away(self, aged: Aged) -> dict[str, np.ndarray]:
        """Return the factors of E and kappa, if varied, in ln k at the conditions, shape (n,) each."""
        found = {}
        for name in self.names[2 + len(self.loss.parameters) :]:
            of = DRIVERS[name][1]
            away = of(self.aged.middle[name]) - of(aged.known[name])
            found[name] = np.where(aged.days > 0, away, 0.0)
        return found

    def slope(self, aged: Aged, x: np.ndarray | None = None) -> np.ndarray:
        """Return the derivatives with respect to x, shape (p, n), or (..., p, n) for x of shape (..., p)."""
        x = self.x if x is None else x
        (in_time, in_loss), own, a = self.factors(aged, x), self.own(x), x[..., 1:2]
        lost = in_loss * self.loss.value(aged.days * in_time, *own)
        along_time, *along_own = (in_loss * slope for slope in self.loss.slopes(aged.days * in_time, *own))
        along_k = along_time if self.acts_on == "rate" else lost
        along = [*along_own, *(along_k * away for away in self.away(aged).values())]
        return np.stack([np.ones_like(lost), -lost, *(-a * slope for slope in along)], axis=-2)

    def tested_days(self) -> np.ndarray:
        """Return the aging times in days, scaled to the master curve if the rate changes, shape (n,)."""
        return self.aged.days * self.factors(self.aged)[0]

    @cached_property
    def resamples(self) -> np.ndarray:
        """Parameters of fits to values drawn anew, shape (RESAMPLES, p): a parametric bootstrap."""
        mean = self.at(self.aged)
        covariance = self.aged.covariance(self.scatter, mean)
        normal = np.random.default_rng(1).standard_normal((RESAMPLES, mean.size))
        values = mean + normal @ blockwise(np.linalg.cholesky, covariance).T
        return solved_many(self, whitening_of(covariance), values)

    def parameters(self) -> Iterator[tuple[str, float, float, float, bool]]:
        """Yield name, value, ends of the 95 % interval (NaN: no bound), and whether the values determine it.

        Without a loss (a may be 0) its shape, E and kappa have no meaning.
        """
        df = self._df(level=False)
        t = float(t_quantile(max(df, 1)))
        lost = bool(abs(self.x[1]) > t * np.sqrt(self.covariance[1, 1]))
        for k, name in enumerate(self.names):
            half = (self.t if name == "mu_0" else t) * float(np.sqrt(self.covariance[k, k]))
            if name in self.loss.parameters:
                ends = self.x[k] - half, self.x[k] + half
                low, high = (float(np.exp(end)) if abs(end) < UNBOUNDED else np.nan for end in ends)
                yield name, float(np.exp(self.x[k])), low, high, bool(lost and 2 * half < KNOWN)
            else:
                known = np.isfinite(half) and (lost or name == "mu_0")
                yield name, float(self.x[k]), float(self.x[k] - half), float(self.x[k] + half), bool(known)


# ---------------------------------------------------------------- least squares
# Starting values of E in kJ/mol.
ENERGIES = (0.0, 50.0, 100.0)
# Starting values and bounds of the parameters of the shapes: days, and exponents.
SHAPES = {
    "b": (0.01, 0.3, 10.0), "tau": (0.5, 5.0, 50.0), "beta": (0.5, 1.0), "n": (0.2, 0.5, 1.0),
    "t_i": (0.3, 3.0),
}  # fmt: skip
LIMITS = {"b": (1e-9, 1e4), "tau": (1e-6, 1e6), "beta": (0.05, 5.0), "n": (0.01, 5.0), "t_i": (1e-3, 1e3)}
# Number of linear parameters: mu_0 and a.
LINEAR = 2
# Number of starting points that are polished.
POLISHED = 4
# The loss is constant, and a not determined, if mu_0 explains all but this share of its square.
DEPENDENT = 1e-20


def solved(law: JointLaw, aged: Aged, white: csr_array, start: np.ndarray | None = None) -> np.ndarray:
    """Return the least-squares parameters, shape (p,), from a start or a grid; `white` whitens `aged`."""
    problem = _Projected(law, aged, white, aged.value[None])
    nonlinear = problem.grid() if start is None else start[None, LINEAR:]
    x, rss = problem.polished(nonlinear, np.zeros(len(nonlinear), int))
    return x[np.argmin(rss)]


def solved_many(law: JointLaw, white: csr_array, values: np.ndarray) -> np.ndarray:
    """Return the parameters for many sets of values, (sets, n) -> (sets, p), from the law's parameters."""
    starts = np.tile(law.x[LINEAR:], (len(values), 1))
    return _Projected(law, law.aged, white, values).polished(starts, np.arange(len(values)))[0]


class _Projected:
    """Variable projection of a law on sets of values, shape (sets, n): mu_0 and a are solved for.

    Golub & Pereyra 1973, SIAM J. Numer. Anal. 10(2), 413-432, doi:10.1137/0710036, with the tangent of
    Kaufman 1975, BIT 15, 49-57, doi:10.1007/BF01932995.
    """

    def __init__(self, law: JointLaw, aged: Aged, white: csr_array, values: np.ndarray) -> None:
        self.law, self.aged, self.values, self.white = law, aged, values, white
        level = white.sum(axis=1)
        self.column = level / np.linalg.norm(level)  # of mu_0
        self.level = (level / (level @ level)) @ white
        self.measured = self._whitened(values[:, None])
        self.reach = float((white.data**2).sum())

    def _whitened(self, many: np.ndarray) -> np.ndarray:
        """Return rows, shape (r, m, n), whitened, with mu_0 projected out."""
        many = (self.white @ many.reshape(-1, many.shape[2]).T).T.reshape(many.shape)
        return many - (many @ self.column)[..., None] * self.column

    def solve(self, nonlinear: np.ndarray, of: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return mu_0 and a, shape (r, 2), the whitened residual, (r, n), and its derivative, (r, p - 2, n).

        `nonlinear`, shape (r, p - 2), are all other parameters of the sets of values `of`, shape (r,).
        """
        law, measured = self.law, self.measured[of]
        # The law with mu_0 = 0 and a = -1 is the loss.
        unit = np.concatenate([np.tile([0.0, -1.0], (len(nonlinear), 1)), nonlinear], axis=1)
        plain = law.slope(self.aged, unit)[:, 1:]
        columns = self._whitened(plain)
        square = (columns[:, :1] ** 2).sum(axis=2, keepdims=True)
        sound = square > DEPENDENT * self.reach * (plain[:, :1] ** 2).max(axis=2, keepdims=True)
        column = np.divide(columns[:, :1], np.sqrt(square), out=np.zeros(measured.shape), where=sound)
        along = (measured * column).sum(axis=2, keepdims=True)
        a = np.divide(along, np.sqrt(square), out=np.zeros(square.shape), where=sound)
        slope = columns[:, 1:] - (columns[:, 1:] * column).sum(axis=2, keepdims=True) * column
        mu_0 = ((self.values[of] - a[:, 0] * plain[:, 0]) @ self.level)[:, None]
        return np.concatenate([mu_0, a[:, 0]], axis=1), (along * column - measured)[:, 0], -a * slope

    def grid(self) -> np.ndarray:
        """Return the best points of a grid, shape (POLISHED, p - 2)."""
        own = self.law.loss.parameters
        grids = [np.log(SHAPES[name]) for name in own]
        grids += [ENERGIES if name == "E" else (0.0,) for name in self.law.names[LINEAR + len(own) :]]
        points = np.array(list(product(*grids)))
        rest = self.solve(points, np.zeros(len(points), int))[1]
        return points[np.argsort((rest**2).sum(axis=1), kind="stable")[:POLISHED]]

    def polished(self, nonlinear: np.ndarray, of: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return all parameters, shape (r, p), and sums of squares, shape (r,), at the optima from starts."""
        free = (-np.inf, np.inf)
        own = self.law.loss.parameters
        limits = [np.log(LIMITS[name]) if name in own else free for name in self.law.names[LINEAR:]]
        low, high = np.reshape(limits, (-1, 2)).T
        found, rss = levenberg_marquardt(lambda x, rows: self.solve(x, of[rows])[1:], nonlinear, low, high)
        return np.concatenate([self.solve(found, of)[0], found], axis=1), rss


def fit_joint_law(aged: Aged, loss: str = "log", acts_on: str = "rate") -> JointLaw:
    """Fit one law to all series of a quantity, and the scatter between specimens.

    `loss` is a name in `LOSSES`; the law acts on "rate" or "loss". FitError if there are fewer different
    conditions than parameters, or no aged specimen.
    """
    shape, drivers = LOSSES[loss], aged.drivers()
    names = ("mu_0", "a", *shape.parameters, *drivers)
    conditions = len(set(zip(aged.series().tolist(), aged.days.tolist(), strict=True)))
    if not (aged.days > 0).any():
        raise FitError("no aged rubber was tested.", fix="Test at least two aged conditions.")
    if conditions < len(names):
        raise FitError(
            f"{conditions} conditions do not determine the {len(names)} parameters of the law '{loss}'.",
            fix="Test more days, or choose a law with fewer parameters. Conditions where the value is not "
            "identified do not count; the report says why.",
        )
    unknown = np.zeros(len(names)), np.zeros((len(names),) * 2)
    empty = JointLaw(aged, shape, acts_on, names, *unknown, 0.0, np.inf)
    x, scatter, before = None, 0.05, np.inf
    for _ in range(TURNS):
        x = solved(empty, aged, aged.whitening(scatter), x)
        residual = aged.value - empty.at(aged, x)
        relative, chi2 = residual / aged.scale(aged.value), partial(aged.chi2, residual)
        before, scatter = scatter, paule_mandel(chi2, aged.value.size - len(names), relative)
        if abs(scatter - before) <= CONVERGED * before:
            break
    if aged.value.size <= len(names) and aged.specimens:
        scatter = aged.specimens[0]
    white = aged.whitening(scatter)
    chi2 = float(((white @ (aged.value - empty.at(aged, x))) ** 2).sum())
    bic = chi2 + log_determinant(white) + len(names) * float(np.log(aged.value.size))
    slope = white @ empty.slope(aged, x).T
    covariance = covariance_of(slope.T @ slope, np.zeros((len(names),) * 2))
    return replace(empty, x=x, covariance=covariance, scatter=scatter, bic=bic)


def fit_laws(aged: Aged, losses: Sequence[str] = tuple(LOSSES)) -> list[JointLaw]:
    """Return every law that the values determine, acting on rate and on loss, in order of BIC.

    Laws that leave fewer than `SPARE` degrees of freedom are left out if another leaves more: such a law
    often passes through all values, and its BIC is far too small. FitError if they determine none.
    """
    found, first = [], None
    for loss in losses:
        both = aged.drivers() and loss != "power"  # a power of k t is a power of k times one of t
        for acts_on in TARGETS if both else TARGETS[:1]:
            try:
                found.append(fit_joint_law(aged, loss, acts_on))
            except FitError as error:
                first = first or error  # of the law with the fewest parameters
    if not found:
        raise first
    enough = min(aged.value.size - min(len(law.names) for law in found), SPARE)
    compared = [law for law in found if aged.value.size - len(law.names) >= enough]
    return sorted(compared, key=lambda law: law.bic)


def rivals_of(laws: Sequence[JointLaw]) -> list[JointLaw]:
    """Return the laws that are not distinguishable from the first: their BIC differs by less than `RIVAL`."""
    return [law for law in laws[1:] if law.bic - laws[0].bic < RIVAL]


def left_out(law: JointLaw) -> dict[str, float]:
    """Return a law's RMS held-out error at whole series and at last days; NaN if none can be left out."""
    aged, whole = law.aged, law.aged.whole_series()
    found = {}
    for name, masks in (("series", whole if len(whole) > 2 else []), ("last_day", aged.last_days())):
        errors = [np.zeros(0)]
        for out in masks:
            part = aged.part(~out)
            if part.drivers() == aged.drivers():
                x = solved(law, part, part.whitening(law.scatter), law.x)
                errors.append((law.at(aged, x) - aged.value)[out])
        errors = np.concatenate(errors)
        found[name] = float(np.sqrt(np.mean(errors**2))) if errors.size else np.nan
    return found
