"""The law of aging of every series as the after-model has it: Eq. 15 from the joint fit, effects at their reference."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pandas as pd

from sealfit.closure.intervals import degrees_of_freedom, t_quantile
from sealfit.closure.reference import at_reference, is_kept
from sealfit.config import Config
from sealfit.fit.aging import CURVE_POINTS
from sealfit.fit.declared import series_of_curve
from sealfit.fit.estimate import Fitted
from sealfit.fit.joint import evaluate
from sealfit.fit.law import search_limits
from sealfit.fit.lawprofile import CurveInterval
from sealfit.fit.lawrows import Curve, Estimate, covariance_rows, law_rows, without_law
from sealfit.fit.rows import POWER, point_rows
from sealfit.fit.steady import FORCES, parameter_units, table_row
from sealfit.tables import AGING_CURVES, AGING_FIT

SLOW, FAST = 1e-6, 12.0  # of v_s: there the force is mu_s N, and mu_c N but for the viscous term
WIDEST = 700.0  # of a logarithm


def after_laws(after: Fitted, steady_fit: pd.DataFrame, config: Config) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Return tables `aging_fit_after` and `aging_curves_after`; empty without aging.

    Parameters
    ----------
    after : Fitted
        The after-model, fitted to all bins.
    steady_fit : DataFrame
        Table `steady_fit_after`: the values of single conditions, which the laws are compared with.
    config : Config
        Names the condition columns and the units.

    Notes
    -----
    mu_0, a and b are numbers of the joint fit, and so are their standard errors. Their intervals have Student's t on
    specimens less the numbers of one coefficient; that of b is symmetric in its logarithm. Effects that are part of the
    condition (of days) multiply or change the law; the curves hold them.
    """
    rows, curves = [], []
    open_columns = [name for name in config.series_columns if name in steady_fit.columns]
    for law in _laws(after, config) if config.aging else ():
        rows += [{"rubber": law.rubber, **row} for row in law.rows(steady_fit)]
        if law.place is not None:
            curves.append(law.curve())
    columns = [*AGING_FIT.names(), *open_columns]
    drawn = pd.concat(curves, ignore_index=True) if curves else pd.DataFrame(columns=AGING_CURVES.names())
    if not rows:
        return pd.DataFrame(columns=columns), drawn
    keys = steady_fit.groupby("series", sort=True)[open_columns].first().reset_index()
    table = pd.DataFrame(rows).merge(keys, on="series", how="left", validate="many_to_one")
    return table.assign(model="after")[columns], drawn


def law_df(after: Fitted) -> float:
    """Return the degrees of freedom of the laws' intervals: specimens less the numbers fitted to one coefficient.

    Few specimens show their scatter badly, often as none at all; that of the runs then has too many degrees of freedom.
    """
    left = after.rows.groups.starts["specimen"].size - after.model.declared.numbers_of_mu
    return min(degrees_of_freedom(after), float(max(left, 1)))


def _laws(after: Fitted, config: Config) -> Iterator[_Law]:
    """Yield every series and quantity: those that the forces determine in some condition of the rubber."""
    conditions, index = after.rows.conditions, after.model.declared.index
    series = series_of_curve(conditions, aging=True)
    aged = conditions["aging_days"].to_numpy(float) > 0
    for name in sorted(set(series[aged])):
        own = np.flatnonzero((series == name) & aged)
        rubber = (conditions["rubber"] == conditions["rubber"].iloc[own[0]]).to_numpy()
        for end in "sc":
            if (index[f"mu_0{end}"][rubber] >= 0).any():
                yield _Law(after, config, name, own, end)


class _Law:
    """Eq. 15 of one quantity of one series in the after-model; `place` is None where it has none."""

    def __init__(self, after: Fitted, config: Config, series: str, conditions: np.ndarray, end: str) -> None:
        self.after, self.config, self.series, self.end = after, config, series, end
        table, declared = after.rows.conditions, after.model.declared
        self.conditions = conditions  # aged
        self.rubber = str(table["rubber"].iloc[conditions[0]])
        days = table["aging_days"].to_numpy(float)
        self.unaged = bool((days[(table["rubber"] == self.rubber).to_numpy()] == 0).any())
        symbol = f"mu_{end}"
        self.quantity = symbol if declared.has_load else FORCES[symbol]
        self.unit = parameter_units(config.units, declared.has_load)["mu_s"]
        names = (f"mu_0{end}", f"a_{end}", f"b_{end}")
        number = [int(declared.index[name][self.conditions[0]]) for name in names]
        self.place = number if min(number) >= 0 else None
        self.curve_of = Curve(series, self.quantity, 0, np.unique(days[self.conditions]))
        self.df = law_df(after)

    def rows(self, steady_fit: pd.DataFrame) -> Iterator[dict]:
        """Yield the rows of `aging_fit_after`."""
        if self.place is None:
            yield from without_law(self.curve_of, self.unit, self.unaged)
            return
        found = self._estimate()
        words, interval = "; ".join(self._kept_words()), self._interval(found)
        for row in law_rows(
            self.curve_of, found, t_quantile(self.df), interval, self.unit, unaged=self.unaged, df=self.df
        ):
            yield {**row, "reason": " ".join(part for part in (row["reason"], words) if part)}
        yield from self._statistics(steady_fit)
        yield from covariance_rows(self.curve_of, found.covariance, self.unit)

    def _estimate(self) -> Estimate:
        after, at = self.after, self.place
        sensor = after.whitening((np.sign(after.rows.speed) * self.config.sensor.u)[:, None])[:, 0]
        shift = after.covariance[at] @ after.white_jacobian.against(sensor)
        return Estimate(after.model.theta[at], after.covariance[np.ix_(at, at)], shift)

    def _interval(self, found: Estimate) -> CurveInterval:
        """Return the 95 % limits of a, b and c; b is open beyond where a law is ever sought."""
        t, error = t_quantile(self.df), np.sqrt(np.diag(found.covariance))
        low, high = (found.x[2] + s * t * error[2] for s in (-1, 1))
        first, last = search_limits(self.curve_of.days)
        b = (float(np.exp(low)) if low > first else 0.0, float(np.exp(min(high, WIDEST))) if high < last else np.inf)
        c, half = -found.x[1] * found.x[2], t * found.error_of_c()
        return CurveInterval((found.x[1] - t * error[1], found.x[1] + t * error[1]), b, (c - half, c + half))

    def _kept_words(self) -> list[str]:
        changed = {"force", "mu", f"mu_{self.end}", "mu_0", "a", "b"}
        kept = [t for t in self.after.model.terms if is_kept(t, self.config) and t.acts_on in changed]
        return [f"The effect {t.effect.id} of {' and '.join(t.channels)} acts on top of it." for t in kept]

    def _statistics(self, steady_fit: pd.DataFrame) -> Iterator[dict]:
        """Yield how far the values of single conditions lie from the law, and what its intervals rest on."""
        own = steady_fit[(steady_fit["quantity"] == "steady") & (steady_fit["parameter"] == self.quantity)]
        own = own[own["identified"].astype(bool)].set_index("condition")["value"]
        names = self.after.rows.conditions["condition"].to_numpy()[self.conditions]
        days = self.after.rows.conditions["aging_days"].to_numpy(float)[self.conditions]
        measured = own.reindex(names).to_numpy(float)
        law = self._values(days)[0]
        gap = (law - measured)[np.isfinite(measured)]
        share = (law / measured - 1)[np.isfinite(measured)]
        friction = self.after.friction
        specimen = self.after.scatter.level_variance("specimen", friction).mean() / np.mean(friction**2)
        for name, value, unit in (
            ("specimen_sd_pct", 100 * np.sqrt(specimen), "%"),
            ("error_df", self.df, ""),
            ("max_error_pct", 100 * np.abs(share).max() if share.size else None, "%"),
            ("rmse", np.sqrt(np.mean(gap**2)) if gap.size else None, self.unit),
            ("n_days", self.curve_of.days.size + self.unaged, ""),
            ("last_day", self.curve_of.days[-1], "d"),
        ):
            parameter = f"{self.quantity}:{name}"
            row = table_row(quantity="statistics", parameter=parameter, value=value, unit=unit, identified=True)
            yield {**row, "series": self.series}

    def curve(self) -> pd.DataFrame:
        """Return the law along aging time with its 95 % band, the effects of the condition in it."""
        days = self.curve_of.days[-1] * np.linspace(0, 1, CURVE_POINTS) ** 2
        value, error = self._values(days)
        half = t_quantile(self.df) * error
        columns = {"aging_days": days, "value": value, "lo95": value - half, "hi95": value + half}
        return pd.DataFrame({"series": self.series, "quantity": self.quantity, **columns})[AGING_CURVES.names()]

    def _values(self, days: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the coefficient at some days and its standard error, shape (n,) each."""
        after, config, rows = self.after, self.config, self.after.rows
        model = at_reference(after.model, config)
        for number in reversed([k for k, term in enumerate(model.terms) if term.acts_on in ("v_s", "sigma_2")]):
            model = model.without_term(number)  # they change no coefficient
        declared = model.declared
        condition = int(self.conditions[0])
        index = {name: int(declared.index[name][condition]) for name in ("v_s", "sigma_2")}
        v_s = float(np.exp(model.theta[index["v_s"]])) if index["v_s"] >= 0 else 1.0
        theta = model.theta.copy()
        if index["sigma_2"] >= 0:
            theta[index["sigma_2"]] = 0.0
        load = float(rows.load.mean())
        first = rows.table[rows.condition == condition].iloc[[0]]
        table = pd.concat([first] * days.size, ignore_index=True)
        table = table.assign(aging_days=days, speed_mm_s=v_s * (SLOW if self.end == "s" else FAST), load_N=load)
        code = np.full(days.size, condition)
        at = point_rows(
            table.drop(columns=[POWER], errors="ignore"),
            code,
            rows.conditions,
            has_load=rows.has_load,
            has_aging=rows.has_aging,
        )
        force, tangent = evaluate(replace(model, theta=theta), replace(at, days=days))
        kept = [np.arange(after.model.size)[after.model.place(after.model.terms.index(term))] for term in model.terms]
        slope = np.zeros((days.size, after.model.size))
        slope[:, np.concatenate([np.arange(theta.size), *kept])] = tangent.toarray()
        slope[:, list(index.values())] = 0.0
        scale = load if rows.has_load else 1.0
        return force / scale, np.sqrt(np.einsum("ni,ij,nj->n", slope, after.covariance, slope)) / scale
