"""The residual along every channel, and what the effects look like."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
import pandas as pd
from matplotlib.axes import Axes

from sealfit.config import Config
from sealfit.report.axes import capital, category_ticks, is_logarithmic, log_axis, value_ticks
from sealfit.report.figures_speed import LOG_SPAN as SPEED_SPAN
from sealfit.report.numbers import number, p_value
from sealfit.report.shown import MOST_MARKS
from sealfit.report.style import AFTER, BEFORE, FLOOR, QUIET, Key, Panel, Plot
from sealfit.report.symbols import channel_label, channel_words, effect_label, plain, short, symbol_math, symbol_plain
from sealfit.units import Units

MOST_CHANNELS = 18
MANY_CATEGORIES = 24
LOG_SPAN = 50.0
Z95 = 1.959964


# ---------------------------------------------------------------- residual by channel
def draw_channel(ax: Axes, rows: pd.DataFrame, channel: str, units: Units) -> None:
    """Draw the mean residual along one channel before and after, with 95 % intervals from whole units.

    Parameters
    ----------
    ax : Axes
        Drawn on; the caller owns the figure.
    rows : DataFrame
        Rows of table `channels` of this channel.
    channel : str
        Its name.
    units : Units
        Give the labels their true units.
    """
    numeric = rows["x"].notna().all() and channel != "direction"
    x = rows["x"].to_numpy(float) if numeric else np.arange(len(rows), dtype=float)
    log = numeric and is_logarithmic(x, LOG_SPAN)
    if numeric and channel in ("speed_mm_s", "speed_set_mm_s"):  # as force against speed is drawn
        log = bool(x.min() > 0 and x.max() / x.min() > SPEED_SPAN)
    # side by side, a little apart on the page, so that neither hides the other
    apart = 0.008 * (np.ptp(np.log(x)) if log else np.ptp(x)) if numeric else 0.09
    ax.axhline(0.0, color=QUIET, linewidth=0.8, zorder=1)
    many = not numeric and len(rows) > MANY_CATEGORIES  # drawn finer, or they are one blot
    for stage, colour, marker, shift in (("before", BEFORE, "o", -apart), ("after", AFTER, "s", apart)):
        spread = Z95 * rows[f"{stage}_se_N"].fillna(0.0).to_numpy(float)
        places, mean = x * np.exp(shift) if log else x + shift, rows[f"{stage}_N"]
        ax.errorbar(
            places,
            mean,
            spread,
            color=colour,
            marker=marker,
            markersize=1.8 if many else 3.6,
            markerfacecolor="white" if stage == "before" else colour,
            markeredgewidth=0.6 if many else 0.9,
            linestyle="-" if numeric else "",
            linewidth=0.8,
            elinewidth=0.4 if many else 0.9,
            capsize=0.0 if many else 1.8,
            zorder=2 if stage == "before" else 3,
            rasterized=len(rows) > MOST_MARKS,
        )
    if log:
        log_axis(ax)
    elif numeric:
        value_ticks(ax, x)
    else:
        category_ticks(ax, categories(rows, channel))
    ax.set_xlabel(plain(short(channel_label(channel, units), 44)))
    ax.set_ylabel(f"residual ({plain(units.unit('force'))})")


def categories(rows: pd.DataFrame, channel: str) -> list[str]:
    """Return the names of a category's rows; both directions in words."""
    if channel == "direction":
        return ["forward" if value > 0 else "backward" for value in rows["x"].fillna(rows["label"]).astype(float)]
    return rows["label"].astype(str).tolist()


def channel_order(channels: pd.DataFrame) -> list[str]:
    """Return the channels, the one that orders the residual most before the others."""
    z2 = (channels["before_N"] / channels["before_se_N"].replace(0.0, np.nan)) ** 2
    strength = z2.groupby(channels["channel"], sort=False).mean().fillna(0.0)
    return strength.sort_values(ascending=False, kind="stable").index.tolist()


def residual_channels(tables: Mapping[str, pd.DataFrame], config: Config) -> Plot | None:
    """Return the residual along every channel, before and after, or None if the loop was not run."""
    channels = tables["channels"]
    if channels.empty:
        return None
    span = _span(channels)
    tested = tables["levels"].dropna(subset=["channel", "p_value"])
    p = tested.groupby(["stage", "channel"])["p_value"].min().to_dict()
    panels = []
    for name in channel_order(channels)[:MOST_CHANNELS]:
        rows = channels[channels["channel"] == name]
        rows = rows.sort_values("x") if rows["x"].notna().all() else rows

        def draw(ax: Axes, rows=rows, name=name) -> None:
            draw_channel(ax, rows, name, config.units)
            ax.set_ylim(*span)

        words = channel_words(name, config.units)
        largest = [rows[f"{stage}_N"].abs().max() for stage in ("before", "after")]
        alt = f"Mean residual along {words}: largest {number(largest[0])} before, {number(largest[1])} "
        alt += f"{config.units.unit('force')} after"
        found = p.get(("before", name))
        alt += f"; p {p_value(found)} before." if found is not None else "."
        panels.append(Panel(short(capital(words), 38), alt, draw))
    legend = (Key("before", BEFORE, "open"), Key("after", AFTER, "point"))
    return Plot("residual_channels", "Residual by channel", tuple(panels), legend)


def _span(channels: pd.DataFrame) -> tuple[float, float]:
    ends = [
        channels[f"{s}_N"] + sign * Z95 * channels[f"{s}_se_N"].fillna(0)
        for s in ("before", "after")
        for sign in (-1, 1)
    ]
    values = pd.concat([*ends, pd.Series([0.0])]).dropna()
    means = pd.concat([channels["before_N"], channels["after_N"]]).abs().max()
    low, high = max(values.min(), -2.5 * means), min(values.max(), 2.5 * means)  # a wide bar does not flatten the rest
    room = 0.07 * (high - low) or 1.0
    return low - room, high + room


# ---------------------------------------------------------------- shapes of effects
def draw_shape(ax: Axes, rows: pd.DataFrame, effect: Mapping, units: Units) -> None:
    """Draw an effect along one channel: its form with the 95 % band, and the free shape it was compared with.

    Parameters
    ----------
    ax : Axes
        Drawn on; the caller owns the figure.
    rows : DataFrame
        Rows of table `shapes` of this effect and channel.
    effect : mapping
        Its entry in closure.json.
    units : Units
        Give the labels their true units.
    """
    channel, scale = rows["channel"].iloc[0], shape_scale(effect)
    numeric = rows["x"].notna().all() and channel != "direction"
    if channel == "direction" and rows["x"].notna().all():
        rows = rows[rows["x"].abs() == 1.0]  # there is nothing between forward and backward
    value, lo, hi, free = (scale * rows[name].to_numpy(float) for name in ("value", "lo95", "hi95", "free"))
    ax.axhline(0.0, color=QUIET, linewidth=0.8, zorder=1)
    if numeric:
        x = rows["x"].to_numpy(float)
        ax.fill_between(x, lo, hi, color=AFTER, alpha=0.2, linewidth=0)
        ax.plot(x, free, color=FLOOR, linestyle="--", linewidth=1.1)
        ax.plot(x, value, color=AFTER)
        ax.set_xlim(x.min(), x.max() if x.max() > x.min() else x.min() + 1)
        if is_logarithmic(x, LOG_SPAN):
            log_axis(ax)
    else:
        x = np.arange(len(rows))
        spread = np.nan_to_num(np.abs(np.stack([value - lo, hi - value])))
        ax.errorbar(x, value, spread, color=AFTER, fmt="o", elinewidth=1.4, capsize=2.0)
        ax.plot(x, free, color=FLOOR, marker="_", linestyle="", markersize=12)
        category_ticks(ax, categories(rows, channel))
    ax.set_xlabel(plain(short(channel_label(channel, units), 44)))
    ax.set_ylabel(shape_label(rows, effect, units, symbol_math))


def shape_scale(effect: Mapping) -> float:
    """Return 100 where a shape is a factor minus one, drawn in percent, else 1."""
    return 100.0 if effect.get("operation") == "multiply" else 1.0


def shape_label(rows: pd.DataFrame, effect: Mapping, units: Units, symbol: Callable[[str], str] = symbol_plain) -> str:
    """Return what a shape's values are, with the unit: "added force (N)", "change of μ (%)"."""
    target = effect.get("acts_on", "force")
    force = plain(units.quantity("force"))
    if effect.get("operation") == "multiply":
        return f"change of {force if target == 'force' else symbol(target)} (%)"
    unit = next((u for u in rows["unit"] if isinstance(u, str) and u), "")
    tail = f" ({plain(unit)})" if unit else ""
    return f"added {force}{tail}" if target == "force" else f"change of {symbol(target)}{tail}"


def effect_shapes(tables: Mapping[str, pd.DataFrame], closure: Mapping | None, config: Config) -> Plot | None:
    """Return the shape of every effect, a panel for each channel it is drawn along, or None if there is none."""
    shapes = tables["shapes"]
    if closure is None or shapes.empty:
        return None
    panels = []
    for (index, channel), rows in shapes.groupby(["effect", "channel"], sort=False):
        if not 0 <= int(index) < len(closure["effects"]):
            continue
        effect = closure["effects"][int(index)]
        rows = rows.sort_values("x") if rows["x"].notna().all() else rows

        def draw(ax: Axes, rows=rows, effect=effect) -> None:
            draw_shape(ax, rows, effect, config.units)

        scale = shape_scale(effect)
        words = effect_label(effect, config.units)
        alt = f"Shape of {words} along {channel_words(channel, config.units)}: "
        alt += f"{shape_label(rows, effect, config.units)} from {number(scale * rows['value'].min())} to "
        alt += f"{number(scale * rows['value'].max())}."
        panels.append(Panel(short(capital(words), 40), alt, draw, effect=int(index)))
    if not panels:
        return None
    legend = [Key("effect, 95 % band", AFTER)]
    if shapes["free"].notna().any():
        legend.append(Key("free shape", FLOOR, "dashed"))
    return Plot("effect_shapes", "Shapes of the effects", tuple(panels), tuple(legend))
