"""Rows of table `aging_fit`: laws with errors and intervals, lack of fit, and what is not determined."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.optimize.elementwise import find_root
from scipy.special import chdtrc, fdtrc

from sealfit.fit.aging.law import PROFILED, EqualGroups, LawFit
from sealfit.fit.joint.declared import DAYS_FOR_LAW
from sealfit.fit.least_squares import CHUNK, covariance_of, levenberg_marquardt, t_quantile
from sealfit.fit.steady import table_row

# Tolerance of the ends of intervals in ln b: 0.1 % of b.
CLOSE = 1e-3
# First step along ln b from the optimum outwards; each further step is twice as long.
FIRST_STEP = 0.25

# b is not determined if the ends of its 95 % interval differ by more than this ratio.
WIDE_B = 100.0
# Earliest aging time at which a test is proposed, in days: a quarter of an hour.
EARLIEST = 0.01
# Level of the test for lack of fit.
SIGNIFICANT = 0.05

LAW = ("mu_0", "a", "b", "c")
ERROR_DF = "degrees of freedom of intervals of the law's values, all series together"
NO_SCATTER = (
    "as many parameters as days: the interval excludes the scatter between specimens, which is not known."
)


# ---------------------------------------------------------------- other series
# For one series all others are a Gaussian likelihood of mu_0: their laws are linearised, as mu_0 hardly
# changes along a profile, and their a and b are eliminated (Schur complement). The cost is proportional to
# the number of series.


def elsewhere(fit: LawFit, columns: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Return what all other groups contribute to the normal matrix of mu_0 and a whitened column.

    `columns`, shape (g, n) each, and the results, shape (g, m + 1, m + 1) each, are by `values.groups`. a and
    b of the other groups are eliminated. Groups are independent, and their contributions add.
    """
    pairs = zip(fit.values.groups, columns, strict=True)
    rows = [own.eliminated(fit.x, column) for own, column in pairs]
    each = np.concatenate([one @ np.swapaxes(one, 1, 2) for one in rows])
    none = np.zeros_like(each[:1])
    before = np.concatenate([none, np.cumsum(each[:-1], axis=0)])
    after = np.concatenate([np.cumsum(each[:0:-1], axis=0)[::-1], none])
    return np.split(before + after, np.cumsum([len(one) for one in rows])[:-1])


def likelihoods(fit: LawFit) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return the likelihood of mu_0 from the other groups, by `values.groups`.

    It is R, shape (g, m + 1, m), and r, (g, m + 1): their chi-square is |R (mu_0 - fitted) + r|^2.
    """
    found = []
    for square in elsewhere(fit, fit.residuals):
        share, axes = np.linalg.eigh(square)
        half = np.sqrt(np.maximum(share, 0.0))[..., None] * np.swapaxes(axes, 1, 2)
        found.append((half[..., :-1], half[..., -1]))
    return found


def curve_errors(fit: LawFit, moved: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the covariance of mu_0, a and ln b of curves, (curves, 3, 3), and their shift by `moved`."""
    values, m = fit.values, fit.values.origins
    covariance, shift = np.zeros((values.curves, 3, 3)), np.zeros((values.curves, 3))
    white = values.whitening @ moved
    pulls = elsewhere(fit, [white[own.rows] for own in values.groups])
    for own, (root, _), pull in zip(values.groups, likelihoods(fit), pulls, strict=True):
        every = np.arange(len(own.rows))[:, None]
        _, slope = own.at(fit.x)
        tangent = np.concatenate([slope, _of_mu_0(root, slope.shape[1])], axis=2)
        found, _ = covariance_of(np.swapaxes(tangent, 1, 2), own.free(fit.x))
        gradient = (slope @ white[own.rows][..., None])[..., 0]
        gradient[:, :m] += pull[:, :m, -1]
        step = (np.where(np.isfinite(found), found, 0.0) @ gradient[..., None])[..., 0]
        for place, curve in enumerate(own.curves.T):
            at = np.full((len(curve), 3), (0, m + place, m + own.width + place))
            at[:, 0] = values.places_of_curve[curve, 0]
            covariance[curve] = found[every[..., None], at[:, :, None], at[:, None, :]]
            shift[curve] = step[every, at]
    return covariance, shift


def _of_mu_0(root: np.ndarray, p: int) -> np.ndarray:
    """Return the derivatives of R (mu_0 - fitted), shape (g, p, m + 1), with respect to p parameters."""
    return np.pad(np.swapaxes(root, 1, 2), ((0, 0), (0, p - root.shape[2]), (0, 0)))


# 95 % intervals of a, b and c of one curve; an open end is 0 or inf for b, -inf or inf for a and c.
CurveInterval = dict[str, tuple[float, float]]
End = tuple[float, bool]  # of an interval of ln b, and whether it is open


def curve_intervals(fit: LawFit, rise_of_origin: np.ndarray) -> list[CurveInterval]:
    """Return the profile-likelihood intervals of every curve.

    That of b is where the least chi-square at fixed ln b rises by at most t^2 of each quantity, shape
    (origins,). Those of a and c = -a ln b are the unions of their intervals over these b.
    """
    intervals: dict[int, CurveInterval] = {}
    for own, others in zip(fit.values.groups, likelihoods(fit), strict=True):
        for place, curves in enumerate(own.curves.T):
            profile = _Profile(fit, own, others, place)
            rise = rise_of_origin[fit.values.places_of_curve[curves, 0]]
            intervals |= zip(curves.tolist(), _intervals(profile, rise), strict=True)
    return [intervals[curve] for curve in range(fit.values.curves)]


def _intervals(profile: "_Profile", rise: np.ndarray) -> list[CurveInterval]:
    """Return the intervals of a curve of each group; `rise`, shape (g,), is that of chi-square."""
    limit = profile.chi2 + rise
    low, high = (profile.ends(sign, limit) for sign in (-1, 1))
    points = np.concatenate([np.linspace(low[0], high[0], PROFILED), profile.log_b[None]]).T
    of = np.repeat(np.arange(len(points)), points.shape[1])
    chi2, a, variance = (found.reshape(points.shape) for found in profile.at(points.ravel(), of))
    room = limit[:, None] - chi2
    half = np.sqrt(np.where(room > 0, room * variance, 0.0))
    ends = (zip(*end, strict=True) for end in (low, high))
    return [_interval(*row) for row in zip(points, a, half, *ends, strict=True)]


class _Profile:
    """The profile of chi-square along ln b of the curves at one `place` in groups of equal size.

    `others` is the likelihood of mu_0 from all other groups, as in `likelihoods`. `chi2` and `log_b`, shape
    (g,), are those of the joint optimum.
    """

    def __init__(
        self, fit: LawFit, own: EqualGroups, others: tuple[np.ndarray, np.ndarray], place: int
    ) -> None:
        self.own, (self.root, self.miss) = own, others
        self.at_a, self.at_b = own.m + place, own.m + own.width + place
        self.x = fit.x[own.places]
        self.log_b = self.x[:, self.at_b]
        self.chi2 = (self._evaluate(self.x, np.arange(len(self.x)))[0] ** 2).sum(axis=1)

    def at(self, log_b: np.ndarray, of: np.ndarray) -> np.ndarray:
        """Return the least chi-square, a and the variance of a at fixed ln b of groups, shape (3, r)."""
        rows = self.own.rows.shape[1] + self.miss.shape[1]
        parts = 1 + of.size * self.x.shape[1] * rows // CHUNK
        split = (np.array_split(one, parts) for one in (log_b, of))
        return np.concatenate([self._at(*part) for part in zip(*split, strict=True)], axis=1)

    def _at(self, log_b: np.ndarray, of: np.ndarray) -> np.ndarray:
        x, (low, high) = self.x[of], self.own.bounds[:, of]
        x[:, self.at_b] = low[:, self.at_b] = high[:, self.at_b] = log_b
        found, chi2 = levenberg_marquardt(lambda x, rows: self._evaluate(x, of[rows]), x, low, high)
        slope = self._evaluate(found, of)[1]
        covariance, _ = covariance_of(np.swapaxes(slope, 1, 2), (found > low) & (found < high))
        return np.array([chi2, found[:, self.at_a], covariance[:, self.at_a, self.at_a]])

    def _evaluate(self, x: np.ndarray, of: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return whitened residuals, shape (r, n + m + 1), and derivatives; those of others are last."""
        rest, slope = self.own.evaluate(x, of)
        away = (x - self.x[of])[:, : self.own.m, None]
        others = (self.root[of] @ away)[..., 0] + self.miss[of]
        beside = _of_mu_0(self.root[of], x.shape[1])
        return np.hstack([rest, others]), np.concatenate([slope, beside], axis=2)

    def ends(self, sign: int, limit: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return ln b where the profiles reach the limit, from the optimum outwards, and which are open."""
        edge = self.own.bounds[int(sign > 0), :, self.at_b]
        near, far, is_open = self.log_b.copy(), self.log_b.copy(), np.ones(len(edge), bool)

        def above(log_b: np.ndarray, of: np.ndarray) -> np.ndarray:
            return self.at(log_b, of.astype(int))[0] - limit[of.astype(int)]

        todo, step = np.flatnonzero(sign * (edge - near) > 0), FIRST_STEP
        while todo.size:
            far[todo] = sign * np.minimum(sign * near[todo] + step, sign * edge[todo])
            is_open[todo] = ~(above(far[todo], todo) > 0)
            todo = todo[is_open[todo]]
            near[todo], step = far[todo], 2 * step
            todo = todo[sign * (edge[todo] - near[todo]) > 0]
        reached = np.flatnonzero(~is_open)
        if reached.size:
            bracket, stops = (near[reached], far[reached]), {"xatol": CLOSE, "xrtol": 0.0, "fatol": 0.0}
            near[reached] = find_root(above, bracket, args=(reached,), tolerances=stops).x
        return near, is_open


def _interval(log_b: np.ndarray, a: np.ndarray, half: np.ndarray, low: End, high: End) -> CurveInterval:
    """Return the interval of a curve from a and its half-width at fixed values of ln b between the ends."""
    around = {}
    for name, factor in (("a", 1.0), ("c", -log_b)):
        middle, reach = factor * a, np.abs(factor) * half
        around[name] = [float((middle - reach).min()), float((middle + reach).max())]
    for outer, reached in ((1, around["a"][1] > 0), (0, around["a"][0] < 0)):
        endless = np.inf if outer else -np.inf
        if reached and high[1]:  # a grows without bound with b
            around["a"][outer], around["c"][1 - outer] = endless, -endless
        if reached and low[1]:  # c grows without bound as b goes to 0
            around["c"][outer] = endless
    b = (0.0 if low[1] else float(np.exp(low[0])), np.inf if high[1] else float(np.exp(high[0])))
    return {"a": tuple(around["a"]), "b": b, "c": tuple(around["c"])}


@dataclass(frozen=True)
class SeriesCurve:
    """One quantity of one series: its number in the joint fit (-1 without a law) and the tested days."""

    series: str
    quantity: str
    place: int
    days: np.ndarray  # aged days tested, rising
    unaged: bool  # whether unaged rubber was tested
    unit: str


class OneQuantity(NamedTuple):
    """The separate fit of one quantity of all series, and the scatter between specimens."""

    part: np.ndarray  # indices of its values among those of the joint fit
    squares: np.ndarray  # (n,) of its whitened residuals
    tau: float  # relative standard deviation between specimens in excess of the steady fits' errors
    series: int  # number of series with a law
    t: float  # Student's quantile of intervals of a, b and c, with the df of the scatter they contain
    level_df: float  # degrees of freedom of the intervals of mu_0 and of the law's values


@dataclass(frozen=True)
class Estimate:
    """mu_0, a and ln b of one curve."""

    x: np.ndarray  # (3,)
    covariance: np.ndarray  # (3, 3) of x
    shift: np.ndarray  # (3,) change of x if the sensor reads one standard uncertainty too high

    def error(self, gradient: list[float]) -> float:
        """Return the standard error of a function of x with a gradient, shape (3,)."""
        with np.errstate(invalid="ignore"):
            return float(np.sqrt(np.array(gradient) @ self.covariance @ gradient))

    def error_of_c(self) -> float:
        """Return the standard error of c = -a ln b."""
        return self.error([0.0, -self.x[2], -self.x[1]])

    def loss(self, days: float) -> tuple[float, float]:
        """Return the loss a ln(1 + t / b) up to a day, and its standard error."""
        _, a, u = self.x
        share = days * np.exp(-u)
        lost = float(np.log1p(share))
        return a * lost, self.error([0.0, lost, -a * share / (1.0 + share)])


def law_rows(curve: SeriesCurve, found: Estimate, ends: CurveInterval, df: float) -> Iterator[dict]:
    """Return the rows of mu_0, a, b and c; `df` are the degrees of freedom of mu_0's interval."""
    mu_0, a, u = found.x
    b, se = np.exp(u), np.sqrt(np.diag(found.covariance))
    beside, t = "" if df > 0 else NO_SCATTER, t_quantile(df or np.inf)
    move = np.where(np.abs(found.shift) > 1e-12 * np.abs(found.x), found.shift, 0.0)  # the rest is rounding
    judged = _judge(curve, found, ends, t)
    of_mu_0 = (mu_0 - t * se[0], mu_0 + t * se[0])
    for name, value, error, systematic, (low, high) in (
        ("mu_0", mu_0, se[0], move[0], of_mu_0),
        ("a", a, se[1], move[1], ends["a"]),
        ("b", b, b * se[2], b * move[2], ends["b"]),
        ("c", -a * u, found.error_of_c(), -u * move[1] - a * move[2], ends["c"]),
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


def _judge(curve: SeriesCurve, found: Estimate, ends: CurveInterval, t: float) -> dict[str, tuple[bool, str]]:
    verdict = dict.fromkeys(LAW, (True, ""))
    first, last, b = curve.days[0], curve.days[-1], float(np.exp(found.x[2]))
    low, high = ends["b"]
    loss, error = found.loss(last)
    if ends["a"][0] <= 0.0 <= ends["a"][1] and abs(loss) > t * error:
        why = f"all of the loss of {loss:.3g} up to {last:g} d may come before {first:g} d, and a may be 0: "
        why += "test earlier days."
        verdict["a"] = (False, why)
    elif ends["a"][0] <= 0.0 <= ends["a"][1]:
        why = f"no aging is seen up to {last:g} d: a may be 0, and b then has no meaning."
        if abs(loss) > t_quantile(np.inf) * error:  # only few degrees of freedom hide it
            why = f"the loss is {loss:.3g} up to {last:g} d, but with so few days a may be 0: test more days."
        verdict["a"] = (bool(np.all(np.isfinite(ends["a"]))), why)
    elif np.isinf(high):
        why = f"the loss may be linear up to {last:g} d: only its mean, {loss / last:.3g} per day, is "
        why += "determined."
        verdict["a"] = (False, why)
    elif low == 0.0 or high > WIDE_B * low:
        span = f"from {low:.2g} to {high:.2g} d" if low > 0 else f"anything up to {high:.2g} d"
        why = f"b may be {span}: it trades off with a and mu_0; "
        early = min(high, first)
        when = (
            f"tests before {early:.2g} d decide" if early >= EARLIEST else "most of the loss may be at once"
        )
        why += f"{when}."
    else:
        why = remark = ""
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


def without_law(curve: SeriesCurve) -> Iterator[dict]:
    """Return the rows of a curve with too few days: no values, and a reason."""
    days = ", ".join(f"{day:g}" for day in ([0.0, *curve.days] if curve.unaged else curve.days)) or "none"
    needs = f"the law needs {DAYS_FOR_LAW} distinct days where {curve.quantity} is determined"
    row = {"quantity": curve.quantity, "identified": False, "reason": f"{needs}; there are: {days}."}
    for name in LAW:
        unit = "d" if name == "b" else curve.unit
        yield table_row(parameter=name, unit=unit, **row) | {"series": curve.series}


def statistics_rows(curve: SeriesCurve, joint: LawFit, quantity: OneQuantity) -> Iterator[dict]:
    """Return the rows with the statistics of the fit of this curve."""
    part, squares, share, tau = quantity.part, quantity.squares, quantity.series, quantity.tau
    values, replicates = joint.values, joint.values.replicates_df
    own = values.curve == curve.place
    q = values.origin[own][0]
    unaged = (values.curve < 0) & (values.origin == q)
    chi2 = float(squares[own[part]].sum() + squares[unaged[part]].sum() / share)
    own_df = float(own.sum() - 2 + (unaged.sum() - 1) / share)
    shown = own | unaged
    error = (joint.model - values.value)[shown] / values.scale(values.value)[shown]
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
    spread, whose = 100 * tau, f"scatter beyond that of the {known}, all series together"
    if not quantity.level_df > 0:
        spread, whose = None, NO_SCATTER
    for statistic, value, its_unit, why in (
        ("chi2", chi2, "", f"against the covariance of the {known} alone"),
        ("df", own_df, "", "this series' share, mu_0 being shared"),
        ("lack_of_fit_p", p, "", reason),
        ("specimen_sd_pct", spread, "%", whose),
        ("error_df", quantity.level_df, "", ERROR_DF),
        ("max_error_pct", 100 * np.abs(error).max(), "%", "largest error of the law over the days tested"),
        ("rmse", np.sqrt(np.mean((joint.model - values.value)[shown] ** 2)), curve.unit, ""),
        ("n_days", shown.sum(), "", "days tested, day 0 included"),
        ("last_day", curve.days[-1], "d", ""),
    ):
        yield table_row(
            quantity="statistics", parameter=f"{name}:{statistic}", value=value, unit=its_unit, reason=why
        ) | {"series": curve.series}


def covariance_rows(curve: SeriesCurve, covariance: np.ndarray) -> Iterator[dict]:
    """Return the rows of table `aging_covariance`: the covariance of mu_0, a and ln b, shape (3, 3)."""
    names, units = ("mu_0", "a", "ln b"), (curve.unit, curve.unit, "")
    for i, j in zip(*np.tril_indices(3), strict=True):
        known = bool(np.isfinite(covariance[j, i]))
        row = {"series": curve.series, "model": "before", "quantity": curve.quantity, "parameter": names[j]}
        row |= {"other": names[i], "value": float(covariance[j, i]) if known else np.nan}
        yield row | {"unit": " ".join(f"({u})" for u in (units[j], units[i]) if u), "identified": known}
