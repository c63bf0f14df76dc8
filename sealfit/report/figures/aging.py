"""Aging curves, the master curve, and a few averaged traces."""

from collections.abc import Mapping, Sequence
from functools import partial

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.ticker import FuncFormatter

from sealfit.config import Config
from sealfit.report import drawing
from sealfit.report.drawing import Key, Panel, Plot, Tables, explain
from sealfit.report.notation import (
    ConditionNames,
    capital,
    count,
    given,
    is_unaged,
    joined,
    measured,
    natural,
    number,
    plain,
    symbol_math,
    symbol_plain,
)
from sealfit.units import Units

TRACE_BUCKETS = 350  # of each, the lowest and the highest sample are drawn: what the eye can see of a trace
MOST_TRACES = 6
MOST_REPEATS = 6  # of a run that are drawn behind their mean, thinner than it
REPEAT_BUCKETS = 120
UNCORRECTED = Key("before, without the effects", drawing.FLOOR, "dotted")


def draw_aging(
    ax: Axes, points: pd.DataFrame, curves: pd.DataFrame, before: pd.DataFrame, quantities: Sequence[str],
    units: Units,
) -> None:  # fmt: skip
    """Draw the coefficients of one series over aging time: the law with its band, and each condition's fit.

    `points` are the fits per condition, with columns quantity, aging_days, value, lo95, hi95; `curves` are
    rows of table `aging_curves`, and `before` of that without effects; `quantities` are those of all series.
    """
    for k, quantity in enumerate(quantities):
        colour, marker = drawing.CYCLE[k % len(drawing.CYCLE)], "os^Dv"[k % 5]
        curve = curves[curves["quantity"] == quantity].sort_values("aging_days")
        drawing.draw_band(ax, curve["aging_days"], curve["lo95"], curve["hi95"], colour, alpha=0.18)
        ax.plot(curve["aging_days"], curve["value"], color=colour)
        earlier = before[before["quantity"] == quantity].sort_values("aging_days")
        ax.plot(earlier["aging_days"], earlier["value"], color=colour, linestyle=":", linewidth=1.1)
        here = points[points["quantity"] == quantity]
        spread = np.stack([here["value"] - here["lo95"], here["hi95"] - here["value"]]).astype(float)
        spread, look = np.abs(np.nan_to_num(spread)), {"fmt": marker, "elinewidth": 0.8, "capsize": 1.5}
        markers, *_ = ax.errorbar(here["aging_days"], here["value"], spread, color=colour, **look)
        explain(markers, [_of_point(row) for row in here.to_dict("records")])
    ax.xaxis.set_major_locator(drawing.round_ticks(integer=True))
    ax.set_xlabel(plain(units.label("aging_days")))
    if "mu_s" in quantities or "mu_c" in quantities:
        ax.set_ylabel("friction coefficient")
    elif {"F_s", "F_c"} & set(quantities):
        ax.set_ylabel(plain(units.label("force_N")))
    elif len(quantities) == 1:  # a property
        ax.set_ylabel(plain(units.label(quantities[0])))


def _of_point(row: Mapping) -> str:
    value, interval = measured(row["value"], row["lo95"], row["hi95"])
    return f"{symbol_plain(row['quantity'])} {value} {interval}\n{given(row['aging_days'])} d"


def aging(tables: Tables, config: Config) -> Plot | None:
    """Return the aging curves, a panel per series, or None without aging days."""
    curves = tables["aging_curves"]
    if curves.empty or not config.aging:
        return None
    names = ConditionNames(config)
    quantities = list(dict.fromkeys(curves["quantity"]))
    values = tables.get("property_values", ())
    of_property = len(values) > 0
    points = property_means(values) if of_property else aging_points(tables["steady_fit"])
    points = points[points["quantity"].isin(quantities)]
    series = sorted(dict.fromkeys(curves["series"]), key=lambda s: natural(names(s)))
    series, note = drawing.panels_of(series, "series")
    if note:
        note += " steady_fit.parquet and aging_curves.parquet have all."
    rubber = points.drop_duplicates("series").set_index("series")["rubber"].to_dict()
    before = tables.get("aging_curves_before", curves.iloc[:0])
    right = max(curves["aging_days"].max(), points["aging_days"].max() if len(points) else 0.0)
    panels = []
    # Properties have units of their own, and panels of their own.
    for drawn in [[quantity] for quantity in quantities] if of_property else [quantities]:
        own, fits, earlier = (one[one["quantity"].isin(drawn)] for one in (curves, points, before))
        limits = {"xlim": (-0.03 * right, 1.03 * right), "ylim": _span(own, fits, earlier, of_property)}
        unaged = fits["series"].map(is_unaged).astype(bool)
        for name in series:
            curve = own[own["series"] == name]
            if curve.empty:
                continue
            here = fits[(fits["series"] == name) | (unaged & (fits["rubber"] == rubber.get(name)))]
            rows = {"points": here, "curves": curve, "before": earlier[earlier["series"] == name]}
            draw = partial(draw_aging, **rows, quantities=drawn, units=config.units)
            symbols = [symbol_plain(quantity) for quantity in dict.fromkeys(curve["quantity"])]
            title = f"{names(name)}, {symbols[0]}" if of_property and len(quantities) > 1 else names(name)
            alt = f"Aging, {names(name)}: {joined(symbols)} over {number(right)} d; "
            alt += f"{symbols[0]} starts at {number(float(curve['value'].iloc[0]))}."
            panels.append(Panel(title, alt, draw, limits=limits))
    keys = [] if of_property and len(quantities) > 1 else quantities
    legend = [Key(q, drawing.CYCLE[k % len(drawing.CYCLE)], symbol=True) for k, q in enumerate(keys)]
    of_point = "mean of a condition, 95 %" if of_property else "fit per condition, 95 %"
    legend += [Key(of_point, drawing.FLOOR, "point"), Key("aging law, 95 % band", drawing.FLOOR, "band")]
    legend += [UNCORRECTED] if len(before) else []
    return Plot("aging", "Aging", tuple(panels), tuple(legend), note)


def _span(
    curves: pd.DataFrame, points: pd.DataFrame, before: pd.DataFrame, of_property: bool
) -> tuple[float, float]:
    """Return the ends of the axis of values; intervals of means have bounds, those of fits may have none."""
    ends = [points["lo95"], points["hi95"]] if of_property else []
    ends += [curves["value"], curves["lo95"], curves["hi95"], points["value"], before["value"]]
    shown = pd.concat(ends).dropna()
    out = 0.0 if of_property else 0.002  # share of a campaign's values that may lie outside
    return drawing.padded(shown.quantile(out), shown.quantile(1 - out))


def property_means(values: pd.DataFrame) -> pd.DataFrame:
    """Return the means of table `property_values` per condition as `aging_points` does."""
    from sealfit.fit.aging.property import means_of

    parts = []
    for (rubber, quantity), own in values.groupby(["rubber", "quantity"]):
        means = means_of(own)
        half, value = means.half_width(), means.table["value"]
        kept = means.table[["series", "aging_days", "value"]].astype({"aging_days": float})
        parts.append(kept.assign(rubber=rubber, quantity=quantity, lo95=value - half, hi95=value + half))
    return pd.concat(parts, ignore_index=True)


def aging_points(steady_fit: pd.DataFrame) -> pd.DataFrame:
    """Return the identified coefficients of every condition with its aging days."""
    rows = steady_fit[(steady_fit["quantity"] == "steady") & steady_fit["identified"].astype(bool)]
    columns = ["series", "rubber", "aging_days", "value", "lo95", "hi95"]
    rows = rows.reindex(columns=[*columns, "parameter"]).astype({"aging_days": float})
    return rows.rename(columns={"parameter": "quantity"})


def draw_trace(ax: Axes, trace: pd.DataFrame, repeats: pd.DataFrame, units: Units) -> None:
    """Draw one run's mean force along its displacement with its standard error; the steady window is shaded.

    `trace` are its rows of table `traces_mean`, `repeats` those of its strokes in table `traces` with their
    direction; the force is drawn in the direction of motion.
    """
    for _, stroke in repeats.groupby(["file", "stroke"]):
        one = envelope(along_motion(stroke), REPEAT_BUCKETS)
        ax.plot(one["displacement_mm"], one["force_N"], color=drawing.QUIET, linewidth=0.5, zorder=1)
    thin = envelope(along_motion(trace))
    x, force, error = thin["displacement_mm"], thin["force_N"], thin["force_se_N"].fillna(0)
    drawing.draw_band(ax, x, force - error, force + error, drawing.AFTER, alpha=0.25)
    whole = thin["n"] == thin["n"].max()  # where a repeat begins later, its own start pulls the mean
    ax.plot(x, force, color=drawing.SKY, linewidth=0.8)
    ax.plot(x, force.where(whole), color=drawing.AFTER, linewidth=0.9)
    trace = trace.sort_values("displacement_mm")
    window = {"where": trace["steady"].astype(bool), "transform": ax.get_xaxis_transform(), "zorder": 0}
    ax.fill_between(trace["displacement_mm"], 0, 1, color=drawing.QUIET, alpha=0.12, linewidth=0, **window)
    ax.set_xlabel(plain(units.label("displacement_mm")))
    ax.set_ylabel(plain(units.label("force_N")))


def along_motion(traces: pd.DataFrame) -> pd.DataFrame:
    """Return traces with the force positive where it opposes the motion."""
    return traces.assign(force_N=traces["force_N"] * traces["direction"])


def envelope(trace: pd.DataFrame, buckets: int = TRACE_BUCKETS) -> pd.DataFrame:
    """Return a trace thinned to the lowest and highest force of each bucket; ripples keep their height."""
    trace = trace[trace["force_N"].notna()].sort_values("displacement_mm")
    if len(trace) <= 2 * buckets:
        return trace
    bucket = (np.arange(len(trace)) * buckets) // len(trace)
    force = trace["force_N"].reset_index(drop=True)
    ends = force.groupby(bucket).agg(["idxmin", "idxmax"]).to_numpy().ravel()
    return trace.iloc[np.unique(np.concatenate([ends, [0, len(trace) - 1]]))]


def traces_mean(tables: Tables, config: Config) -> Plot | None:
    """Return a few averaged traces, spread over conditions and speeds, or None if there are none."""
    traces = tables["traces_mean"]
    chosen = example_runs(traces, tables["runs"])
    if chosen.empty:
        return None
    names, units, single = ConditionNames(config), config.units, tables["traces"]
    traces = traces[traces["run_id"].isin(chosen["run_id"])]
    ends = along_motion(single)["force_N"].quantile([0.002, 0.998]) if len(single) else None  # but spikes
    shown = pd.concat([along_motion(traces)["force_N"], ends])
    span = drawing.padded(shown.min(), shown.max())
    panels = []
    for run in chosen.itertuples():
        trace = traces[traces["run_id"] == run.run_id]
        speed = f", {given(run.speed)} {units.unit('speed')}" if np.isfinite(run.speed) else ""
        repeats = int(trace["n"].max())
        title = f"{names(run.condition)}{speed}"
        alt = f"Mean trace of {title}, {count(repeats, 'stroke')} averaged: {units.quantity('force')} from "
        alt += f"{number(trace['force_N'].min())} to {number(trace['force_N'].max())} {units.unit('force')}."
        own = single[single["run_id"] == run.run_id] if len(single) else single
        draw = partial(draw_trace, trace=trace, units=units, repeats=own)
        panels.append(Panel(title, alt, draw, limits={"ylim": span}))
    legend = [Key("mean of all repeats", drawing.AFTER)]
    if (traces["n"] < traces.groupby("run_id")["n"].transform("max")).any():
        legend.append(Key("mean of fewer repeats", drawing.SKY))
    legend += [Key(f"single repeats, up to {MOST_REPEATS}", drawing.QUIET)] if len(single) else []
    legend += [Key("± standard error", drawing.AFTER, "band"), Key("steady window", drawing.QUIET, "band")]
    return Plot("traces_mean", "Averaged traces", tuple(panels), tuple(legend))


def example_runs(traces: pd.DataFrame, runs: pd.DataFrame) -> pd.DataFrame:
    """Return up to six runs: conditions spread evenly, and along them the speeds from slow to fast.

    `traces` has columns run_id and condition, one row or more of a run; table `runs` gives the speeds. The
    result has columns run_id, condition and speed; of six runs or fewer it has all, in their order.
    """
    speed = runs["speed_set_mm_s"].fillna(runs["speed_mm_s"].abs()).astype(float)
    speed = speed.groupby(runs["run_id"]).mean()
    known = traces.drop_duplicates("run_id")[["run_id", "condition"]]
    known = known.assign(speed=known["run_id"].map(speed).astype(float))
    if len(known) <= MOST_TRACES:
        return known
    groups = [g.sort_values("speed") for _, g in known.groupby("condition", sort=False)]
    picked = []
    for k, group in enumerate(groups[place] for place in drawing.evenly(len(groups), MOST_TRACES)):
        left = group[~group["run_id"].isin([row["run_id"] for row in picked])]
        if len(left):
            picked.append(left.iloc[drawing.evenly(len(left), MOST_TRACES)[k]])
    return pd.DataFrame(picked)


MARKERS = "os^Dv<>"
QUANTITIES = {
    "mu_s": "static friction coefficient", "mu_c": "Coulomb friction coefficient",
    "F_s": "static friction", "F_c": "Coulomb friction",
}  # fmt: skip


def draw_master_curve(
    ax: Axes, rows: pd.DataFrame, before: pd.DataFrame, colours: Mapping[float, str], units: Units
) -> None:
    """Draw one quantity's values over scaled aging time, and the law with its 95 % band.

    `rows` are of table `master_curve`, and `before` is the law without effects; `colours` by temperature.
    """
    values, law = rows[rows["kind"] == "value"], rows[rows["kind"] == "law"].sort_values("scaled_days")
    aged = values[values["scaled_days"] > 0]
    ax.set_xscale("symlog", linthresh=float(aged["scaled_days"].min()), linscale=0.7)
    ax.xaxis.get_major_locator().set_params(numticks=6)  # where factors of temperature differ by many decades
    ax.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    drawing.draw_band(ax, law["scaled_days"], law["lo95"], law["hi95"], drawing.FLOOR)
    ax.plot(law["scaled_days"], law["value"], color=drawing.FLOOR)
    before = before.sort_values("scaled_days")
    ax.plot(before["scaled_days"], before["value"], color=drawing.FLOOR, linestyle=":")
    fresh = values[values["scaled_days"] == 0]
    if not fresh.empty:  # an unclipped line without points has its place at the corner of the figure
        ax.plot(fresh["scaled_days"], fresh["value"], "o", color=drawing.BLACK, clip_on=False)
    percents = np.sort(aged["compression_ratio_pct"].dropna().unique())
    for (celsius, percent), own in aged.groupby(["temperature_C", "compression_ratio_pct"], dropna=False):
        rank = int(np.searchsorted(percents, percent)) if np.isfinite(percent) else 0
        marker, colour = MARKERS[rank % len(MARKERS)], colours.get(celsius, drawing.BLACK)
        (points,) = ax.plot(own["scaled_days"], own["value"], marker, markersize=4, color=colour)
        known = [(value, unit) for value, unit in ((celsius, "°C"), (percent, "%")) if np.isfinite(value)]
        place = ", ".join(f"{given(value)} {unit}" for value, unit in known)
        texts = zip(own["value"], own["aging_days"], strict=True)
        explain(points, [f"{number(value, 4)}\n{place}, {given(days)} d" for value, days in texts])
    ax.set_xlabel(f"scaled aging time ({plain(units.of('aging_days'))})")
    ax.set_ylabel(symbol_math(rows["quantity"].iloc[0]))


def master_curve(tables: Tables, config: Config) -> Plot | None:
    """Return the master curves, a panel per rubber and quantity, or None where there is no joint law."""
    table = tables["master_curve"]
    if table.empty:
        return None
    celsius = np.sort(table["temperature_C"].dropna().unique())
    colours = dict(zip(celsius.tolist(), drawing.shades(len(celsius)), strict=True))
    several = table["rubber"].nunique() > 1
    panels = []
    groups, note = drawing.panels_of(list(table.groupby(["rubber", "quantity"], sort=False)), "curves")
    before = tables.get("master_curve_before", table.iloc[:0])
    for (rubber, quantity), rows in groups:
        earlier = before[(before["rubber"] == rubber) & (before["quantity"] == quantity)]
        earlier = earlier[earlier["kind"] == "law"]
        shown = pd.concat([rows["value"], rows["lo95"], rows["hi95"], earlier["value"]])
        limits = {"ylim": drawing.padded(shown.min(), shown.max())}
        draw = partial(draw_master_curve, rows=rows, before=earlier, colours=colours, units=config.units)
        words = QUANTITIES.get(quantity, symbol_plain(quantity))
        title = f"{rubber}, {words}" if several else words
        alt = f"Master curve of {title}: from {number(rows['value'].max())} to {number(rows['value'].min())}."
        panels.append(Panel(capital(title), alt, draw, limits=limits))
    keys = drawing.spread(list(colours.items()), drawing.MOST_KEYS)
    legend = [Key(f"{given(t)} °C", colour, "point") for t, colour in keys]
    if ((table["kind"] == "value") & (table["scaled_days"] == 0)).any():
        legend.append(Key("unaged", drawing.BLACK, "point"))
    legend.append(Key("law, 95 % band", drawing.FLOOR, "band"))
    legend += [UNCORRECTED] if len(before) else []
    note += " master_curve.parquet has all." if note else ""
    return Plot("master_curve", "Master curve", tuple(panels), tuple(legend), note)
