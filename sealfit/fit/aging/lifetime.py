"""Days until aging has carried a quantity to a threshold, and the temperature at which it lasts so many years."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq
from scipy.special import ndtri, stdtr

from sealfit.errors import RequestError
from sealfit.fit.aging.joint_law import DRIVERS, Aged, JointLaw
from sealfit.fit.aging.joint_least_squares import solved_many
from sealfit.fit.least_squares import central_jacobian

# ---------------------------------------------------------------- lifetime
# Days until aging has carried a quantity to a threshold, and the temperature at which it lasts so many years.
#
# From a joint law, :math:`a\, k^w \varphi(k^{1-w} t) = \mu_0 - \mu^*` solved for t. The interval is that of ln t by the
# delta method, with the law's whole covariance; `resampled` draws the values anew instead and checks it. In the spirit
# of ISO 11346 (rubber, estimation of life-time and maximum temperature of use), whose threshold is a share of the
# start.

DAYS_PER_YEAR = 365.25
SPAN_C = (-80.0, 300.0)  # of temperatures of use
STRIDE_C, HALVINGS = 2.0, 12  # in which the ends of the interval of a temperature are sought, and then halved
SPAN_PCT = (1.0, 200.0)  # of the original height in use; above 100 it is stretched
AT_ONCE, FOREVER = 1e-9, 1e9  # days: beyond, the law is asked for more than it can say


@dataclass(frozen=True)
class Goal:
    """What ends a life: the value itself, or a loss as a share of the start (0.2: a fifth is lost)."""

    value: float | None = None
    loss: float | None = None

    def reached(self, start: float) -> float:
        """Return the value at which life ends, for rubber that starts at `start`."""
        return self.value if self.loss is None else start * (1 - self.loss)


@dataclass(frozen=True)
class Lifetime:
    """Days to a threshold, ends of the 95 % interval (inf where open), and how far that lies beyond the tests.

    Attributes
    ----------
    days, low, high : float
        Estimate and interval; `days` is inf where the law never comes there, 0 where rubber starts beyond it.
    threshold : float
        The value at which life ends.
    beyond : float
        days over the longest test, in the master curve's time where there is one: above 1 it is extrapolated.
    outside : tuple of str
        What lies outside the tested range: "temperature", "compression".
    """

    days: float
    low: float
    high: float
    threshold: float
    beyond: float
    outside: tuple[str, ...]

    @property
    def extrapolated(self) -> bool:
        """Whether the answer goes beyond the tests."""
        return self.beyond > 1.0 or bool(self.outside)


def lifetime(law: JointLaw, goal: Goal, temperature_C: float | None = None, compression_pct: float | None = None):
    """Return the `Lifetime` of rubber aged at a temperature and compression.

    Parameters
    ----------
    law : JointLaw
        Fitted.
    goal : Goal
        What ends a life.
    temperature_C, compression_pct : float, optional
        Of use; needed where the tests varied them.

    Raises
    ------
    RequestError
        If one is missing that the law needs, given though the tests did not vary it, or out of any range of use.
    """
    place = _place(law, temperature_C, compression_pct)
    days = _days(law, law.x, goal, place)
    low, high = days, days
    if 0 < days < FOREVER:
        with np.errstate(divide="ignore", invalid="ignore"):  # near where it is never reached, or at once
            slope = central_jacobian(lambda x: np.log(np.array([_days(law, x, goal, place)])), law.x)[0]
        half = law.t * float(np.sqrt(slope @ law.covariance @ slope)) if np.isfinite(slope).all() else np.inf
        low, high = (float(days * np.exp(np.clip(s * half, -700, 700))) for s in (-1, 1))
        low, high = 0.0 if low < AT_ONCE else low, np.inf if high > FOREVER else high
    asked = days * (float(law.rate(place)[0]) if law.acts_on == "rate" else 1.0)
    threshold, beyond = float(goal.reached(law.x[0])), asked / law.tested_days().max()
    return Lifetime(days, low, high, threshold, beyond, _outside(law, temperature_C, compression_pct))


def over_laws(
    laws: Sequence[JointLaw], goal: Goal, temperature_C: float | None = None, compression_pct: float | None = None
) -> tuple[float, float]:
    """Return the ends of the 95 % interval of the lifetime when the law is not known: inf, or 0, where open.

    Each law's log lifetime has its Student distribution, weighed by exp(-1/2) of Schwarz's criterion: with few tests
    the likeliest law is often not the true one, and its own interval too short. Buckland, Burnham & Augustin 1997,
    Biometrics 53(2), 603-618, doi:10.2307/2533961.

    Parameters
    ----------
    laws : sequence of JointLaw
        Of the same values.
    goal, temperature_C, compression_pct
        As `lifetime`.
    """
    weights = np.exp(-0.5 * np.array([law.bic - min(one.bic for one in laws) for law in laws]))
    lives = [lifetime(law, goal, temperature_C, compression_pct) for law in laws]
    found = list(zip(weights / weights.sum(), laws, lives, strict=True))

    def share(log_days: float) -> float:
        """Return the probability of a shorter life."""
        total = 0.0
        for weight, law, life in found:
            if 0 < life.days < FOREVER:
                error = np.log(life.days / max(life.low, 1e-300)) / law.t
                away = log_days - np.log(life.days)
                total += weight * (stdtr(max(law.df, 1), away / error) if error > 0 else float(away >= 0))
            else:
                total += weight * (life.days == 0)
        return total

    limits = np.log(1e-12), np.log(FOREVER)
    ends = []
    for wanted in (0.025, 0.975):
        if share(limits[0]) >= wanted:
            ends.append(0.0)
        elif share(limits[1]) < wanted:
            ends.append(np.inf)
        else:
            ends.append(float(np.exp(brentq(lambda x, wanted=wanted: share(x) - wanted, *limits, xtol=1e-9))))
    return ends[0], ends[1]


def ends_of(values: np.ndarray) -> tuple[float, float]:
    """Return the least and the greatest."""
    return float(values.min()), float(values.max())


def _asked(law: JointLaw, temperature_C: float | None, compression_pct: float | None) -> Iterator[tuple]:
    """Yield per driver of aging its name, in words, what is asked, what was tested, what may be asked, and its unit."""
    asked = (temperature_C, compression_pct)
    spans = (("temperature", SPAN_C, "degC"), ("compression", SPAN_PCT, "percent"))
    for (name, column, _), value, (what, span, unit) in zip(DRIVERS, asked, spans, strict=True):
        yield name, what, value, getattr(law.aged, column), span, unit


def _place(law: JointLaw, temperature_C: float | None, compression_pct: float | None) -> Aged:
    """Return where the rubber is used, checked."""
    for name, what, value, tested, (least, most), unit in _asked(law, temperature_C, compression_pct):
        if name in law.names and value is None:
            raise RequestError(f"the rubber was aged at more than one {what}.", fix=f"Say which with --{what}.")
        if value is not None and not least <= value <= most:
            raise RequestError(
                f"--{what} {value:g} is no {what} of use.", fix=f"Give {unit} between {least:g} and {most:g}."
            )
        only = np.unique(tested[law.aged.days > 0]) if tested is not None else np.array([])
        if value is not None and name not in law.names and not (only.size and np.allclose(value, only)):
            where = f"at {only[0]:g} {unit} only" if only.size else f"at one {what}, which is not on record"
            raise RequestError(f"the rubber was aged {where}.", fix=f"Leave --{what} away, or test at another {what}.")
    at = (None if value is None else np.array([float(value)]) for value in (temperature_C, compression_pct))
    return Aged(np.ones(1), np.zeros(1), *at)


def _days(law: JointLaw, x: np.ndarray, goal: Goal, place: Aged) -> float:
    """Return the days to the goal for parameters x; inf where it is never reached."""
    k, own = float(law.rate(place, x)[0]), [float(value[0]) for value in law.own(x)]
    a = x[1] * (k if law.acts_on == "loss" else 1.0)
    phi = (x[0] - goal.reached(x[0])) / a if a != 0 else np.inf
    if phi <= 0:
        return 0.0 if a > 0 else np.inf
    with np.errstate(over="ignore"):
        days = float(law.loss.time(phi, *own)) / (k if law.acts_on == "rate" else 1.0)
    return days if days < FOREVER else np.inf


def _outside(law: JointLaw, temperature_C: float | None, compression_pct: float | None) -> tuple[str, ...]:
    found = []
    for _, what, value, tested, *_ in _asked(law, temperature_C, compression_pct):
        low, high = (np.nan, np.nan) if tested is None else ends_of(tested[law.aged.days > 0])
        if value is not None and (value < low or value > high):
            found.append(what)
    return tuple(found)


def resampled(
    law: JointLaw,
    goal: Goal,
    temperature_C: float | None = None,
    compression_pct: float | None = None,
    *,
    draws: int = 500,
    seed: int = 1,
) -> tuple[float, float]:
    """Return the ends of the 95 % interval of the lifetime from values drawn anew around the law, refitted each time.

    The logarithm's quantiles are spread by Student's over the normal quantile, as the scatter is itself an estimate.

    Parameters
    ----------
    draws, seed : int
        How many, and of which stream.
    """
    rng, place = np.random.default_rng(seed), _place(law, temperature_C, compression_pct)
    mean = law.at(law.aged)
    root = np.linalg.cholesky(law.aged.covariance(law.scatter, mean))
    drawn = mean + rng.standard_normal((draws, mean.size)) @ root.T
    found = [_days(law, x, goal, place) for x in solved_many(law, np.linalg.inv(root), drawn)]
    days, wider = _days(law, law.x, goal, place), law.t / ndtri(0.975)
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = np.log(np.quantile(found, [0.025, 0.975], method="inverted_cdf") / days)
    low, high = days * np.exp(np.clip(ends * wider, -700, 700))
    return float(low) if low > AT_ONCE else 0.0, float(high) if high < FOREVER else np.inf


def temperature_for(
    law: JointLaw, goal: Goal, years: float, compression_pct: float | None = None
) -> tuple[float, float, float]:
    """Return the temperature of use at which life is so many years, and its 95 % interval.

    Returns
    -------
    celsius, low, high : float
        In degrees Celsius; celsius is inf where life is longer at every temperature sought, -inf where it is shorter.
        The interval are the temperatures at which so many years lie in the interval of the life (Fieller's way); an end
        that was not found is infinite.

    Raises
    ------
    RequestError
        If the rubber was aged at one temperature only, or the years are no time.
    """
    if not 0 < years < np.inf:
        raise RequestError(f"--years {years:g} is no time to last.", fix="Give a number above 0.")
    if "E" not in law.names:
        raise RequestError("the rubber was aged at one temperature only.", fix="Test at two or more temperatures.")
    wanted = years * DAYS_PER_YEAR

    def longer(celsius: float) -> float:
        days = _days(law, law.x, goal, _place(law, celsius, compression_pct))
        return float(np.log(np.clip(days, 1e-12, 1e12) / wanted))

    def held(celsius: float) -> bool:
        life = lifetime(law, goal, celsius, compression_pct)
        return life.low <= wanted <= life.high

    ends = [longer(celsius) for celsius in SPAN_C]
    if ends[0] * ends[1] > 0:
        always = np.inf if ends[0] > 0 else -np.inf
        return always, -np.inf, np.inf
    celsius = float(brentq(longer, *SPAN_C, xtol=1e-6))
    return celsius, _last(held, celsius, SPAN_C[0]), _last(held, celsius, SPAN_C[1])


def _last(held: Callable[[float], bool], inside: float, limit: float) -> float:
    """Return where, from a place inside towards a limit, something ceases to hold; infinite where it never does."""
    direction = np.sign(limit - inside)
    outside = inside
    while (limit - outside) * direction > 0:
        inside, outside = outside, outside + direction * min(STRIDE_C, abs(limit - outside))
        if not held(outside):
            for _ in range(HALVINGS):
                middle = (inside + outside) / 2
                inside, outside = (middle, outside) if held(middle) else (inside, middle)
            return float(inside)
    return float(direction * np.inf)


# ---------------------------------------------------------------- lifetime answer
# What is asked of a lifetime, and the answer as plain values.


def goal_of(threshold: float | None, loss_pct: float | None) -> Goal:
    """Return the goal of a request.

    Raises
    ------
    RequestError
        If not exactly one of both is given, the threshold is no number, or the loss is no share of the start.
    """
    if (threshold is None) == (loss_pct is None):
        raise RequestError(
            "what ends a life is not said." if threshold is None else "two ends of life were given.",
            fix="Give --threshold VALUE or --loss PERCENT.",
        )
    if threshold is not None and not np.isfinite(threshold):
        raise RequestError(f"--threshold {threshold:g} is no value to reach.", fix="Give a number.")
    if loss_pct is not None and not 0 < loss_pct < 100:
        raise RequestError(f"--loss {loss_pct:g} is no share of the start.", fix="Give percent between 0 and 100.")
    return Goal(threshold) if loss_pct is None else Goal(loss=loss_pct / 100)


def answer(
    law: JointLaw,
    goal: Goal,
    years: float | None = None,
    *,
    temperature_C: float | None = None,
    compression_pct: float | None = None,
    resample: bool = False,
) -> dict:
    """Return a law's answer as plain values: days with interval, how far beyond the tests, the temperature for years.

    Parameters
    ----------
    law : JointLaw
        Fitted.
    goal : Goal
        What ends a life.
    years : float, optional
        Asks for the temperature at which life is so long, in place of the days.
    temperature_C, compression_pct : float, optional
        Of use.
    resample : bool
        Whether the interval is checked by drawing the values anew.

    Raises
    ------
    RequestError
        If the request cannot be answered: see `lifetime` and `temperature_for`.
    """
    if years is not None and temperature_C is not None:
        raise RequestError("--years asks for the temperature, and --temperature gives it.", fix="Give one of the two.")
    if goal.loss is not None and (law.aged.days > 0).all():
        raise RequestError(
            "no unaged rubber was tested: there is no start of which a share could be lost.",
            fix="Give --threshold VALUE, or test unaged rubber.",
        )
    found = {"law": law.loss.name, "way": law.acts_on, "form": law.loss.form, "criterion": law.bic}
    found |= {"parameters": {name: value for name, value, *_ in law.parameters()}}
    if years is not None:
        celsius, *ends = temperature_for(law, goal, years, compression_pct)
        low, high = ends_of(law.aged.temperature_C[law.aged.days > 0])
        found |= {"years": years, "temperature_C": _finite(celsius), "temperature_ci95": finite_ends(ends)}
        found |= {"always": None if np.isfinite(celsius) else "longer" if celsius > 0 else "shorter"}
        return {**found, "extrapolated": not low <= celsius <= high, "tested_C": [low, high], "sought_C": list(SPAN_C)}
    life = lifetime(law, goal, temperature_C, compression_pct)
    found |= {"threshold": life.threshold, "days": _finite(life.days), "ci95": finite_ends((life.low, life.high))}
    found |= {"extrapolated": life.extrapolated, "beyond_tests": _finite(life.beyond), "outside": list(life.outside)}
    if resample and 0 < life.days < FOREVER:
        found["ci95_resampled"] = finite_ends(resampled(law, goal, temperature_C, compression_pct))
    return found


def finite_ends(interval: Sequence[float]) -> list[float | None]:
    """Return the ends of an interval, None where it is open."""
    return [_finite(end) for end in interval]


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
