"""Rows of table `aging_fit` for one curve: its law, lack of fit, and parameters that are not determined."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.special import chdtrc, fdtrc, ndtri, stdtrit

from sealfit.fit.aging.law import LawFit
from sealfit.fit.aging.law_profiles import CurveInterval
from sealfit.fit.steady.fit import table_row

# Number of days that a law needs: mu_0, a and b are three parameters.
DAYS_FOR_LAW = 3
# b is not determined if the ends of its 95 % interval differ by more than this ratio.
WIDE_B = 100.0
# Level of the test for lack of fit.
SIGNIFICANT = 0.05

LAW = ("mu_0", "a", "b", "c")
ERROR_DF = "degrees of freedom of intervals of the law's values, all series together"
NO_SCATTER = (
    "as many parameters as days: the interval excludes the scatter between specimens, which is not known."
)


@dataclass(frozen=True)
class Curve:
    """One quantity of one series: its number in the joint fit (-1 without a law) and the tested days."""

    series: str
    quantity: str
    place: int
    days: np.ndarray  # aged days tested, rising
    unaged: bool  # whether unaged rubber was tested
    unit: str


@dataclass(frozen=True)
class OneQuantity:
    """The separate fit of one quantity of all series, and the scatter between specimens."""

    alone: LawFit
    part: np.ndarray  # indices of its values among those of the joint fit
    tau: float  # relative standard deviation between specimens in excess of the steady fits' errors
    series: int  # number of series with a law

    @cached_property
    def squares(self) -> np.ndarray:
        """Squares of the whitened residuals, shape (n,)."""
        return (self.alone.values.whitening @ (self.alone.values.value - self.alone.model)) ** 2

    @property
    def df(self) -> float:
        """Degrees of freedom of the intervals of a, b and c: those of the scatter that they contain."""
        return self.alone.df if self.tau > 0 else self.alone.values.replicates_df or self.alone.df

    @property
    def level_df(self) -> float:
        """Degrees of freedom of the intervals of mu_0 and of the law's values."""
        return self.alone.df if self.tau > 0 else self.alone.values.level_df or self.alone.df

    @property
    def t(self) -> float:
        """Student's quantile of 95 % intervals of a, b and c."""
        return t_of_95(self.df)


def t_of_95(df: float) -> float:
    """Return Student's quantile of 95 % intervals; the normal one without degrees of freedom."""
    return float(stdtrit(df, 0.975) if df > 0 else ndtri(0.975))


@dataclass(frozen=True)
class Estimate:
    """mu_0, a and ln b of one curve."""

    x: np.ndarray  # (3,)
    covariance: np.ndarray  # (3, 3) of x
    shift: np.ndarray  # (3,) change of x if the sensor reads one standard uncertainty too high

    def error_of_c(self) -> float:
        """Return the standard error of c = -a ln b."""
        gradient = np.array([0.0, -self.x[2], -self.x[1]])
        with np.errstate(invalid="ignore"):
            return float(np.sqrt(gradient @ self.covariance @ gradient))

    def loss(self, days: float) -> tuple[float, float]:
        """Return the loss a ln(1 + t / b) up to a day, and its standard error."""
        _, a, u = self.x
        share = days * np.exp(-u)
        gradient = np.array([0.0, np.log1p(share), -a * share / (1.0 + share)])
        with np.errstate(invalid="ignore"):
            return float(a * gradient[1]), float(np.sqrt(gradient @ self.covariance @ gradient))


def law_rows(curve: Curve, found: Estimate, ends: CurveInterval, df: float) -> Iterator[dict]:
    """Return the rows of mu_0, a, b and c; `df` are the degrees of freedom of mu_0's interval."""
    mu_0, a, u = found.x
    b, se = np.exp(u), np.sqrt(np.diag(found.covariance))
    beside, t = "" if df > 0 else NO_SCATTER, t_of_95(df)
    move = np.where(np.abs(found.shift) > 1e-12 * np.abs(found.x), found.shift, 0.0)  # the rest is rounding
    judged = _judge(curve, found, ends, t)
    of_mu_0 = (mu_0 - t * se[0], mu_0 + t * se[0])
    for name, value, error, systematic, (low, high) in (
        ("mu_0", mu_0, se[0], move[0], of_mu_0),
        ("a", a, se[1], move[1], ends.a),
        ("b", b, b * se[2], b * move[2], ends.b),
        ("c", -a * u, found.error_of_c(), -u * move[1] - a * move[2], ends.c),
    ):
        yield table_row(
            quantity=curve.quantity,
            parameter=name,
            value=value,
            se=error,
            lo95=None if name == "b" and low == 0.0 else low,
            hi95=high,
            u_sys=abs(systematic),
            unit="d" if name == "b" else curve.unit,
            identified=judged[name][0],
            reason=" ".join(filter(None, (judged[name][1], beside))),
        ) | {"series": curve.series}


def _judge(curve: Curve, found: Estimate, ends: CurveInterval, t: float) -> dict[str, tuple[bool, str]]:
    verdict = dict.fromkeys(LAW, (True, ""))
    first, last, b = curve.days[0], curve.days[-1], float(np.exp(found.x[2]))
    low, high = ends.b
    loss, error = found.loss(last)
    if ends.a[0] <= 0.0 <= ends.a[1] and abs(loss) > t * error:
        why = f"all of the loss of {loss:.3g} up to {last:g} d may come before {first:g} d, and a may be 0: "
        why += "test earlier days."
        verdict["a"] = (False, why)
    elif ends.a[0] <= 0.0 <= ends.a[1]:
        why = f"no aging is seen up to {last:g} d: a may be 0, and b then has no meaning."
        verdict["a"] = (bool(np.all(np.isfinite(ends.a))), why)
    elif np.isinf(high):
        mean = f"{loss / last:.3g} per day"
        why = f"the loss may be linear up to {last:g} d: only its mean, {mean}, is determined."
        verdict["a"] = (False, why)
    elif low == 0.0 or high > WIDE_B * low:
        span = f"from {low:.2g} to {high:.2g} d" if low > 0 else f"anything up to {high:.2g} d"
        why = (
            f"b may be {span}: it trades off with a and mu_0; "
            f"tests before {max(min(high, first), 1e-3):.2g} d decide."
        )
    else:
        why = ""
        remark = ""
        if b < first and curve.unaged:
            remark = f"below the first day tested ({first:g} d): it rests on the unaged rubber's value."
        elif b > last:
            remark = f"beyond the last day tested ({last:g} d): it rests on how little the loss bends."
        verdict["b"] = (True, remark)
    if why:
        verdict["b"] = (False, why)
        verdict["c"] = (False, f"c = -a ln b, and b is not determined: {why}")
    if not curve.unaged:
        verdict["mu_0"] = (not why, "no unaged rubber was tested: mu_0 is extrapolated to day 0 by the law.")
    return verdict


def without_law(curve: Curve) -> Iterator[dict]:
    """Return the rows of a curve with too few days: no values, and a reason."""
    days = ", ".join(f"{day:g}" for day in ([0.0, *curve.days] if curve.unaged else curve.days)) or "none"
    needs = f"the law needs {DAYS_FOR_LAW} distinct days where {curve.quantity} is determined"
    row = {"quantity": curve.quantity, "identified": False, "reason": f"{needs}; there are: {days}."}
    for name in LAW:
        unit = "d" if name == "b" else curve.unit
        yield table_row(parameter=name, unit=unit, **row) | {"series": curve.series}


def statistics_rows(curve: Curve, joint: LawFit, quantity: OneQuantity) -> Iterator[dict]:
    """Return the rows with the statistics of the fit of this curve."""
    part, squares, share, tau = quantity.part, quantity.squares, quantity.series, quantity.tau
    values = joint.values
    own = values.curve == curve.place
    q = values.origin[own][0]
    unaged = (values.curve < 0) & (values.origin == q)
    chi2 = float(squares[own[part]].sum() + squares[unaged[part]].sum() / share)
    own_df = float(own.sum() - 2 + (unaged.sum() - 1) / share)
    shown = own | unaged
    error = (joint.model - values.value)[shown] / values.scale(values.value)[shown]
    replicates = values.replicates_df
    p = np.nan
    if own_df > 0:
        p = float(fdtrc(own_df, replicates, chi2 / own_df) if replicates else chdtrc(own_df, chi2))
    reason = ""
    if not own_df > 0:
        reason = "as many parameters as days: the law cannot disagree with them."
    elif p < SIGNIFICANT and replicates:
        reason = (
            "the means deviate from the law by more than replicates scatter: the law is wrong, or conditions "
            f"differ by more than they should (by {100 * tau:.2g} %). The intervals include this."
        )
    elif p < SIGNIFICANT:
        reason = (
            f"the values scatter about the law by {100 * tau:.2g} % more than their errors: "
            "specimens differ, or the law is wrong. The intervals include this; replicate specimens would "
            "distinguish the two."
        )
    name, known = curve.quantity, "replicates" if values.size is not None else "steady fits"
    for statistic, value, its_unit, why in (
        ("chi2", chi2, "", f"against the covariance of the {known} alone"),
        ("df", own_df, "", "this series' share, mu_0 being shared"),
        ("lack_of_fit_p", p, "", reason),
        ("specimen_sd_pct", 100 * tau, "%", f"scatter beyond that of the {known}, all series together"),
        ("error_df", quantity.level_df, "", ERROR_DF),
        ("max_error_pct", 100 * np.abs(error).max(), "%", "largest error of the law over the days tested"),
        ("rmse", np.sqrt(np.mean((joint.model - values.value)[shown] ** 2)), curve.unit, ""),
        ("n_days", shown.sum(), "", "days tested, day 0 included"),
        ("last_day", curve.days[-1], "d", ""),
    ):
        yield table_row(
            quantity="statistics",
            parameter=f"{name}:{statistic}",
            value=value,
            unit=its_unit,
            reason=why,
        ) | {"series": curve.series}


def covariance_rows(curve: Curve, covariance: np.ndarray) -> Iterator[dict]:
    """Return the rows with the covariance of mu_0, a and ln b, shape (3, 3)."""
    names, units = ("mu_0", "a", "ln b"), (curve.unit, curve.unit, "")
    for i in range(3):
        for j in range(i + 1):
            yield table_row(
                quantity="covariance",
                parameter=f"{curve.quantity}:{names[j]},{curve.quantity}:{names[i]}",
                value=covariance[j, i],
                unit=" ".join(f"({u})" for u in (units[j], units[i]) if u),
                identified=bool(np.isfinite(covariance[j, i])),
            ) | {"series": curve.series}
