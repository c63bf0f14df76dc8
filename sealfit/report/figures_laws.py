"""The master curve: every condition's value over its aging time, scaled by the rate at its temperature."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.ticker import FuncFormatter

from sealfit.config import Config
from sealfit.report.axes import padded
from sealfit.report.numbers import given, number
from sealfit.report.shown import MOST_KEYS, MOST_PANELS, spread
from sealfit.report.style import BLACK, FLOOR, Key, Panel, Plot, shades
from sealfit.report.symbols import plain, symbol_math, symbol_plain
from sealfit.units import Units

MARKERS = "os^Dv<>"
SCALED = "scaled aging time"


def draw_master_curve(
    ax: Axes, rows: pd.DataFrame, colours: Mapping[float, str], units: Units, before: pd.DataFrame | None = None
) -> None:
    """Draw one quantity's values over scaled aging time, and the law with its 95 % band.

    Parameters
    ----------
    ax : Axes
        Drawn on; the caller owns the figure.
    rows : DataFrame
        Rows of table `master_curve`.
    colours : mapping
        Of each aging temperature.
    units : Units
        Give the labels their true units.
    before : DataFrame, optional
        Rows of the same table without the loop's effects: their law is drawn.
    """
    values, law = rows[rows["kind"] == "value"], rows[rows["kind"] == "law"].sort_values("scaled_days")
    aged = values[values["scaled_days"] > 0]
    ax.set_xscale("symlog", linthresh=float(aged["scaled_days"].min()), linscale=0.7)
    ax.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    ax.fill_between(law["scaled_days"], law["lo95"], law["hi95"], color=FLOOR, alpha=0.2, linewidth=0)
    ax.plot(law["scaled_days"], law["value"], color=FLOOR)
    if before is not None:
        earlier = before[before["kind"] == "law"].sort_values("scaled_days")
        ax.plot(earlier["scaled_days"], earlier["value"], color=FLOOR, linestyle=":")
    fresh = values[values["scaled_days"] == 0]
    ax.plot(fresh["scaled_days"], fresh["value"], linestyle="", marker="o", color=BLACK, clip_on=False)
    percents = np.sort(aged["compression_ratio_pct"].dropna().unique())
    for (celsius, percent), own in aged.groupby(["temperature_C", "compression_ratio_pct"], dropna=False):
        marker = MARKERS[int(np.searchsorted(percents, percent)) % len(MARKERS)] if np.isfinite(percent) else "o"
        ax.plot(
            own["scaled_days"],
            own["value"],
            linestyle="",
            marker=marker,
            markersize=4,
            color=colours.get(celsius, BLACK),
        )
    quantity = str(rows["quantity"].iloc[0])
    ax.set_xlabel(f"{SCALED} ({plain(units.of('aging_days'))})")
    ax.set_ylabel(symbol_math(quantity))


def master_curve(tables: Mapping[str, pd.DataFrame], config: Config) -> Plot | None:
    """Return the master curves, a panel per rubber and quantity, or None where there is no joint law."""
    table = tables["master_curve"]
    if table.empty:
        return None
    celsius = np.sort(table["temperature_C"].dropna().unique())
    colours = dict(zip(celsius.tolist(), shades(len(celsius)), strict=True))
    several = table["rubber"].nunique() > 1
    panels, groups = [], list(table.groupby(["rubber", "quantity"], sort=False))
    before = tables.get("master_curve_before", table.iloc[:0])
    for (rubber, quantity), rows in spread(groups, MOST_PANELS):
        earlier = before[(before["rubber"] == rubber) & (before["quantity"] == quantity)]
        shown = pd.concat([rows["value"], earlier.loc[earlier["kind"] == "law", "value"]])
        span = padded(shown.min(), shown.max())

        def draw(ax: Axes, rows=rows, span=span, earlier=earlier) -> None:
            draw_master_curve(ax, rows, colours, config.units, earlier)
            ax.set_ylim(*span)

        title = f"{rubber}, {symbol_plain(quantity)}" if several else symbol_plain(quantity)
        alt = f"Master curve of {title}: from {number(rows['value'].max())} to {number(rows['value'].min())}."
        panels.append(Panel(title, alt, draw))
    legend = [Key(f"{given(t)} °C", colour, "point") for t, colour in spread(list(colours.items()), MOST_KEYS)]
    legend += [Key("unaged", BLACK, "point"), Key("law, 95 % band", FLOOR, "band")]
    legend += [Key("before, without the effects", FLOOR, "dotted")] if len(before) else []
    note = "" if len(groups) == len(panels) else f"{len(panels)} of {len(groups)}; all stand in master_curve.parquet."
    return Plot("master_curve", "Master curve", tuple(panels), tuple(legend), note)
