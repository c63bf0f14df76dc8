"""How the force comes up: the mean start at a few speeds, and the dynamic model's."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pandas as pd
from matplotlib.axes import Axes

from sealfit.config import Config
from sealfit.report.axes import evenly, natural, padded
from sealfit.report.numbers import given, number
from sealfit.report.style import BLACK, FLOOR, Key, Panel, Plot, shades
from sealfit.report.symbols import ConditionNames, is_unaged, plain, short
from sealfit.units import Units

MOST_PANELS = 6
MOST_SPEEDS = 3
UP = 0.98  # share of the last force at which a start counts as over
BEYOND = 1.5  # of that distance is shown


def draw_starts(ax: Axes, curves: pd.DataFrame, colours: Mapping[float, str], units: Units) -> None:
    """Draw the mean starts of a condition over the distance slid, with their standard error, and the model's.

    Parameters
    ----------
    ax : Axes
        Drawn on; the caller owns the figure.
    curves : DataFrame
        Rows of table `dynamic_curves`.
    colours : mapping
        Of each commanded speed.
    units : Units
        Give the labels their true units.
    """
    for (speed, direction), curve in curves.groupby(["speed_set_mm_s", "direction"], dropna=False, sort=True):
        curve = curve.sort_values("distance_mm")
        colour = colours.get(speed, BLACK)
        error = curve["force_se_N"].fillna(0.0)
        ax.fill_between(
            curve["distance_mm"], curve["force_N"] - error, curve["force_N"] + error, color=colour, alpha=0.2,
            linewidth=0,
        )  # fmt: skip
        ax.plot(
            curve["distance_mm"], curve["force_N"], linestyle="", marker="o" if direction > 0 else "<", markersize=2.6,
            color=colour, markerfacecolor=colour if direction > 0 else "white", markeredgewidth=0.7,
        )  # fmt: skip
        ax.plot(curve["distance_mm"], curve["model_N"], color=colour, linestyle="-" if direction > 0 else "--")
    ax.set_xlim(0.0, _reach(curves))
    ax.set_xlabel(plain(units.label("distance_mm")))
    ax.set_ylabel(plain(units.label("force_N")))


def _reach(curves: pd.DataFrame) -> float:
    """Return the distance to which starts are drawn: to where the slowest of them is over, and half of it beyond."""
    ends = []
    for _, curve in curves.groupby(["speed_set_mm_s", "direction"], dropna=False):
        curve = curve.sort_values("distance_mm")
        below = np.flatnonzero(curve["force_N"].to_numpy() < UP * curve["force_N"].iloc[-1])
        ends.append(curve["distance_mm"].iloc[min(below[-1] + 1 if len(below) else 0, len(curve) - 1)])
    return float(BEYOND * max(ends))


def starts(tables: Mapping[str, pd.DataFrame], config: Config) -> Plot | None:
    """Return the mean starts of up to six conditions at up to three speeds each, or None if no trace shows one."""
    curves = tables["dynamic_curves"]
    if curves.empty:
        return None
    names, units = ConditionNames.of(config), config.units
    ordered = sorted(curves["condition"].unique(), key=lambda c: (not is_unaged(c), natural((names(c), None))))
    picked = [ordered[k] for k in evenly(len(ordered), min(len(ordered), MOST_PANELS))]
    speeds = np.sort(curves["speed_set_mm_s"].dropna().unique())
    speeds = speeds[evenly(len(speeds), min(len(speeds), MOST_SPEEDS))]
    colours = dict(zip(speeds.tolist(), shades(len(speeds)), strict=True))
    shown = curves[curves["condition"].isin(picked)]
    shown = shown[shown["speed_set_mm_s"].isin(speeds) | shown["speed_set_mm_s"].isna()]
    span = padded(min(0.0, shown["force_N"].min()), shown["force_N"].max())
    panels = []
    for condition in picked:
        own = shown[shown["condition"] == condition]
        if own.empty:
            continue

        def draw(ax: Axes, own=own) -> None:
            draw_starts(ax, own, colours, units)
            ax.set_ylim(*span)

        alt = f"Starts of {names(condition)}: {units.quantity('force')} from {number(own['force_N'].min())} to "
        alt += f"{number(own['force_N'].max())} {units.unit('force')} over {number(_reach(own))} "
        alt += f"{units.unit('displacement')}."
        panels.append(Panel(short(names(condition)), alt, draw))
    legend = [Key(f"{given(speed)} {units.unit('speed')}", colour) for speed, colour in colours.items()]
    legend.append(Key("mean of the starts", FLOOR, "point"))
    if (shown["direction"] < 0).any():
        legend.append(Key("backward", FLOOR, "left"))
    if shown["model_N"].notna().any():
        legend.append(Key("dynamic model", FLOOR, "line"))
    return Plot("starts", "Starts", tuple(panels), tuple(legend))
