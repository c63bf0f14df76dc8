"""The lifetime, the aging time until a quantity reaches a threshold, and the temperature for a lifetime."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq
from scipy.special import ndtri, stdtr

from sealfit.errors import RequestError
from sealfit.fit.aging.joint_law import DRIVERS, Aged, JointLaw
from sealfit.fit.least_squares import central_jacobian

# The lifetime t of a joint law solves :math:`a\, k^w \varphi(k^{1-w} t) = \mu_0 - \mu^*`. Its interval is
# that of ln t by the delta method; `resampled` checks it by a parametric bootstrap. ISO 11346 (rubber,
# estimation of life-time and maximum temperature of use) has a threshold relative to the start.

DAYS_PER_YEAR = 365.25
# Range of temperatures of use in degrees Celsius.
SPAN_C = (-80.0, 300.0)
# Step in degrees Celsius of the search for the ends of a temperature interval, and bisections after it.
STRIDE_C, HALVINGS = 2.0, 12
# Range of the height in use, in percent of the original height; above 100 the rubber is stretched.
SPAN_PCT = (1.0, 200.0)
# Conditions of use: name, range and unit.
USES = {
    "temperature_C": ("temperature", SPAN_C, "degC"),
    "compression_ratio_pct": ("compression", SPAN_PCT, "percent"),
}
# Range of lifetimes in days. A law has no meaning beyond it.
AT_ONCE, FOREVER = 1e-9, 1e9
# Ends of the 95 % interval of drawn lifetimes, and the method of quantiles: they may be inf.
ENDS, OF_DRAWS = (0.025, 0.975), "inverted_cdf"


@dataclass(frozen=True)
class Goal:
    """The end of life: a value, or a loss relative to the start (0.2: a fifth is lost)."""

    value: float | None = None
    loss: float | None = None

    def reached(self, start: float) -> float:
        """Return the value at the end of life for rubber with the unaged value `start`."""
        return self.value if self.loss is None else start * (1 - self.loss)


@dataclass(frozen=True)
class DaysToThreshold:
    """Days to a threshold, with 95 % interval: inf if it is not reached, 0 if unaged rubber is beyond it."""

    days: float
    low: float  # ends of the interval in days, inf if open
    high: float
    threshold: float  # value at the end of life
    beyond: float  # days over the longest test, in the time of the master curve; above 1 is extrapolated
    outside: tuple[str, ...]  # variables outside of the tested range: "temperature", "compression"

    @property
    def extrapolated(self) -> bool:
        """Whether the lifetime is extrapolated."""
        return self.beyond > 1.0 or bool(self.outside)


def lifetime(
    law: JointLaw, goal: Goal, temperature_C: float | None = None, compression_ratio_pct: float | None = None
):
    """Return the `DaysToThreshold` of rubber aged at a temperature and compression.

    The temperature in degrees Celsius and the height in percent in use are needed if the tests varied them.
    RequestError if one is missing, given though the tests did not vary it, or out of the range of use.
    """
    place = _place(law, temperature_C, compression_ratio_pct)
    days = _days(law, law.x, goal, place)
    if law.df <= 0:  # nothing shows the scatter of specimens
        low, high = 0.0, np.inf
    elif 0 < days < FOREVER:
        # The lifetime may be 0 or inf nearby, or change too fast.
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            slope = central_jacobian(lambda x: np.log(np.array([_days(law, x, goal, place)])), law.x)[0]
            known = np.isfinite(slope).all()
            half = law.t * float(np.sqrt(slope @ law.covariance @ slope)) if known else np.inf
        low, high = (float(days * np.exp(np.clip(s * half, -700, 700))) for s in (-1, 1))
    else:  # the start or the limit of the law may lie on the other side of the threshold
        low, high = (float(end) for end in np.quantile(_drawn(law, goal, place), ENDS, method=OF_DRAWS))
    low, high = 0.0 if low < AT_ONCE else low, np.inf if high > FOREVER else high
    asked = days * float(law.factors(place)[0][0])
    threshold, beyond = float(goal.reached(law.x[0])), asked / law.tested_days().max()
    return DaysToThreshold(days, low, high, threshold, beyond, _outside(law, place))


def over_laws(
    laws: Sequence[JointLaw],
    goal: Goal,
    temperature_C: float | None = None,
    compression_ratio_pct: float | None = None,
) -> tuple[float, float]:
    """Return the ends of the model-averaged 95 % interval of the lifetime, 0 or inf if open.

    The log lifetime of each law has a Student distribution, or that of values drawn anew where it is 0 or
    inf; the weights are exp(-BIC/2), as the law of least BIC is often not the true one. Buckland, Burnham &
    Augustin 1997, Biometrics 53(2), 603-618, doi:10.2307/2533961.
    """
    weights = np.exp(-0.5 * np.array([law.bic - min(one.bic for one in laws) for law in laws]))
    lives = [lifetime(law, goal, temperature_C, compression_ratio_pct) for law in laws]
    place = _place(laws[0], temperature_C, compression_ratio_pct)
    drawn = (
        None if 0 < life.days < FOREVER else _drawn(law, goal, place)
        for law, life in zip(laws, lives, strict=True)
    )
    found = list(zip(weights / weights.sum(), laws, lives, drawn, strict=True))

    def share(log_days: float) -> float:
        """Return the probability of a shorter life."""
        total = 0.0
        for weight, law, life, others in found:
            if others is None:
                error = np.log(life.days / max(life.low, 1e-300)) / law.t
                away = log_days - np.log(life.days)
                total += weight * (stdtr(max(law.df, 1), away / error) if error > 0 else float(away >= 0))
            else:
                total += weight * np.mean(others <= np.exp(log_days))
        return total

    limits = np.log(1e-12), np.log(FOREVER)
    ends = []
    for wanted in ENDS:
        if share(limits[0]) >= wanted:
            ends.append(0.0)
        elif share(limits[1]) < wanted:
            ends.append(np.inf)
        else:
            ends.append(float(np.exp(brentq(lambda x, wanted=wanted: share(x) - wanted, *limits, xtol=1e-9))))
    return ends[0], ends[1]


def _place(law: JointLaw, temperature_C: float | None, compression_ratio_pct: float | None) -> Aged:
    """Return the condition of use after checks; see `lifetime` for the errors raised."""
    given = (temperature_C, compression_ratio_pct)
    for (name, (column, _)), value in zip(DRIVERS.items(), given, strict=True):
        what, (least, most), unit = USES[column]
        if name in law.names and value is None:
            raise RequestError(
                f"the rubber was aged at more than one {what}.",
                fix=f"Say which: --{what}, in Python {column}.",
            )
        if value is not None and not least <= value <= most:
            raise RequestError(
                f"--{what} {value:g} is no {what} of use.", fix=f"Give {unit} between {least:g} and {most:g}."
            )
        only = np.unique(_tested(law, column))
        if value is not None and name not in law.names and not (only.size and np.allclose(value, only)):
            where = f"at {only[0]:g} {unit} only" if only.size else f"at one {what}, which is not on record"
            raise RequestError(
                f"the rubber was aged {where}.", fix=f"Leave --{what} away, or test at another {what}."
            )
    at = (None if value is None else np.array([float(value)]) for value in given)
    return Aged(np.ones(1), np.zeros(1), *at)


def _tested(law: JointLaw, column: str) -> np.ndarray:
    """Return the temperatures or compressions of the aged specimens; none if they are unknown."""
    tested = getattr(law.aged, column)
    return np.array([]) if tested is None else tested[law.aged.days > 0]


def _days(law: JointLaw, x: np.ndarray, goal: Goal, place: Aged) -> float:
    """Return the lifetime in days for parameters x; inf if the goal is not reached."""
    in_time, in_loss = (float(factor[0]) for factor in law.factors(place, x))
    own, a = [float(value[0]) for value in law.own(x)], x[1] * in_loss
    phi = (x[0] - goal.reached(x[0])) / a if a != 0 else np.inf
    if phi <= 0:
        return 0.0 if a > 0 else np.inf
    with np.errstate(over="ignore"):
        days = float(law.loss.time(phi, *own)) / in_time
    return days if days < FOREVER else np.inf


def _outside(law: JointLaw, place: Aged) -> tuple[str, ...]:
    found = []
    for column, (what, *_) in USES.items():
        value, tested = getattr(place, column), _tested(law, column)
        if value is not None and tested.size and (value < tested.min() or value > tested.max()):
            found.append(what)
    return tuple(found)


def resampled(
    law: JointLaw, goal: Goal, temperature_C: float | None = None, compression_ratio_pct: float | None = None
) -> tuple[float, float]:
    """Return the ends of the 95 % interval of the lifetime by a parametric bootstrap.

    Quantiles of the logarithm are multiplied by Student's over the normal one, as the scatter is an estimate.
    """
    place = _place(law, temperature_C, compression_ratio_pct)
    days, wider = _days(law, law.x, goal, place), law.t / ndtri(0.975)
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = np.log(np.quantile(_drawn(law, goal, place), ENDS, method=OF_DRAWS) / days)
    low, high = days * np.exp(np.clip(ends * wider, -700, 700))
    return float(low) if low > AT_ONCE else 0.0, float(high) if high < FOREVER else np.inf


def _drawn(law: JointLaw, goal: Goal, place: Aged) -> np.ndarray:
    """Return lifetimes in days of fits to values drawn anew, shape (RESAMPLES,)."""
    return np.array([_days(law, x, goal, place) for x in law.resamples])


def temperature_for(
    law: JointLaw, goal: Goal, years: float, compression_ratio_pct: float | None = None
) -> tuple[float, float, float]:
    """Return the temperature of use at which the lifetime is a number of years, and its 95 % interval.

    It is inf in degrees Celsius if the lifetime is longer at all temperatures searched, -inf if shorter. The
    interval has the temperatures whose lifetime interval contains the years (Fieller's method); an end that
    was not found is infinite. RequestError for rubber aged at one temperature only, or years that are not
    positive.
    """
    if not 0 < years < np.inf:
        raise RequestError(f"--years {years:g} is no time to last.", fix="Give a number above 0.")
    if "E" not in law.names:
        raise RequestError(
            "the rubber was aged at one temperature only.", fix="Test at two or more temperatures."
        )
    wanted = years * DAYS_PER_YEAR

    def longer(celsius: float) -> float:
        days = _days(law, law.x, goal, _place(law, celsius, compression_ratio_pct))
        return float(np.log(np.clip(days, 1e-12, 1e12) / wanted))

    def contains(celsius: float) -> bool:
        life = lifetime(law, goal, celsius, compression_ratio_pct)
        return life.low <= wanted <= life.high

    ends = [longer(celsius) for celsius in SPAN_C]
    if ends[0] * ends[1] > 0:
        return np.inf if ends[0] > 0 else -np.inf, -np.inf, np.inf
    celsius = float(brentq(longer, *SPAN_C, xtol=1e-6))
    return celsius, _last(contains, celsius, SPAN_C[0]), _last(contains, celsius, SPAN_C[1])


def _last(contains: Callable[[float], bool], inside: float, limit: float) -> float:
    """Return the end of the interval that contains `inside`, towards a limit; infinite if open."""
    direction = np.sign(limit - inside)
    outside = inside
    while (limit - outside) * direction > 0:
        inside, outside = outside, outside + direction * min(STRIDE_C, abs(limit - outside))
        if not contains(outside):
            for _ in range(HALVINGS):
                middle = (inside + outside) / 2
                inside, outside = (middle, outside) if contains(middle) else (inside, middle)
            return float(inside)
    return float(direction * np.inf)


def goal_of(threshold: float | None, loss_pct: float | None) -> Goal:
    """Return the goal of a request; RequestError unless exactly one of both is given, and in range."""
    if (threshold is None) == (loss_pct is None):
        raise RequestError(
            "what ends a life is not said." if threshold is None else "two ends of life were given.",
            fix="Give --threshold VALUE or --loss PERCENT; in Python threshold or loss_pct.",
        )
    if threshold is not None and not np.isfinite(threshold):
        raise RequestError(f"--threshold {threshold:g} is no value to reach.", fix="Give a number.")
    if loss_pct is not None and not 0 < loss_pct < 100:
        raise RequestError(
            f"--loss {loss_pct:g} is no share of the start.", fix="Give percent between 0 and 100."
        )
    return Goal(threshold) if loss_pct is None else Goal(loss=loss_pct / 100)


def unknown_scatter(law: JointLaw) -> list[str]:
    """Return a note if a law has no interval, as nothing shows the scatter of specimens; else none."""
    if law.df > 0:
        return []
    why = "the law has as many parameters as days, and the scatter of specimens is not known"
    return [f"of unknown uncertainty: {why}. Test more days, or two specimens of a condition"]


def answer(
    law: JointLaw,
    goal: Goal,
    years: float | None = None,
    *,
    temperature_C: float | None = None,
    compression_ratio_pct: float | None = None,
    resample: bool = False,
) -> dict:
    """Return a law's lifetime with its interval, or with `years` the temperature for it, as plain values.

    With `resample` the interval is checked by `resampled`. RequestError as `lifetime` and `temperature_for`.
    """
    if years is not None and temperature_C is not None:
        raise RequestError(
            "--years asks for the temperature, and --temperature gives it.", fix="Give one of the two."
        )
    if goal.loss is not None and (law.aged.days > 0).all():
        raise RequestError(
            "no unaged rubber was tested: there is no start of which a share could be lost.",
            fix="Give --threshold VALUE, or test unaged rubber.",
        )
    found = {"law": law.loss.name, "way": law.acts_on, "form": law.loss.form, "criterion": law.bic}
    found |= {"parameters": {name: value for name, value, *_ in law.parameters()}}
    found["lack_of_fit_p"] = _finite(law.lack_of_fit_p())
    if years is not None:
        celsius, *ends = temperature_for(law, goal, years, compression_ratio_pct)
        tested = law.aged.temperature_C[law.aged.days > 0]
        low, high = float(tested.min()), float(tested.max())
        return found | {
            "years": years,
            "temperature_C": _finite(celsius),
            "temperature_ci95": finite_ends(ends),
            "always": None if np.isfinite(celsius) else "longer" if celsius > 0 else "shorter",
            "extrapolated": not low <= celsius <= high,
            "tested_C": [low, high],
            "sought_C": list(SPAN_C),
        }
    life = lifetime(law, goal, temperature_C, compression_ratio_pct)
    found |= {
        "threshold": life.threshold,
        "days": _finite(life.days),
        "ci95": finite_ends((life.low, life.high)),
        "extrapolated": life.extrapolated,
        "beyond_tests": _finite(life.beyond),
        "outside": list(life.outside),
    }
    if resample and law.df > 0 and 0 < life.days < FOREVER:
        found["ci95_resampled"] = finite_ends(resampled(law, goal, temperature_C, compression_ratio_pct))
    return found


def finite_ends(interval: Sequence[float]) -> list[float | None]:
    """Return the ends of an interval, None for an open end."""
    return [_finite(end) for end in interval]


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
