"""What is asked of a lifetime, and the answer as plain values."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sealfit.errors import RequestError
from sealfit.fit.joint_law import JointLaw
from sealfit.fit.lifetime import FOREVER, SPAN_C, Goal, ends_of, lifetime, resampled, temperature_for


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
    found = {"law": law.loss.name, "way": law.way, "form": law.loss.form, "criterion": law.bic}
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
