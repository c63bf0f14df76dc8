"""Errors before and after, the residual by level and variable, and the shapes of the effects."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from itertools import chain

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from scipy.special import stdtrit

from sealfit.config import Config
from sealfit.report import drawing
from sealfit.report.drawing import Key, Panel, Plot, Tables, explain
from sealfit.report.figures.speed import LOG_SPAN as SPEED_SPAN
from sealfit.report.notation import (
    capital,
    channel_label,
    channel_words,
    effect_label,
    known,
    number,
    p_value,
    plain,
    short,
    symbol_math,
    symbol_plain,
    together,
)
from sealfit.report.summary import by_gain
from sealfit.tables import CALENDAR
from sealfit.units import Units

LEVELS = ("specimen", "set_up", "run", "file", "stroke", "sample")
ERRORS = (("rmse_N", "all bins"), ("rmse_runs_N", "run means"), ("heldout_rmse_N", "held out"))
MOST_CHANNELS = 18
MANY_CATEGORIES = 24
LOG_SPAN = 50.0
Z95 = 1.959964
BARS = (Key("before", drawing.BEFORE, "bar"), Key("after", drawing.AFTER, "bar"))
STAGES = (Key("before", drawing.BEFORE, "open"), Key("after", drawing.AFTER, "point"))


def draw_errors(ax: Axes, closure: Mapping, units: Units) -> None:
    """Draw each error as a step from before to after, with the noise floor as a line."""
    rows = [(key, label) for key, label in ERRORS if known(closure["before"][key])]
    values = [closure[stage][key] for key, _ in rows for stage in ("before", "after")]
    texts = together(values)
    above = {"xytext": (0, 7), "textcoords": "offset points", "ha": "center"}
    box = {"facecolor": "white", "edgecolor": "none", "pad": 0.6, "alpha": 0.85}
    largest = max(value for value in values if known(value))
    for k, (key, _) in enumerate(rows):
        before, after = closure["before"][key], closure["after"][key]
        y = len(rows) - 1 - k
        if known(after) and after != before:
            ax.plot([before, after], [y, y], color=drawing.QUIET, linewidth=1.2, zorder=1)
            ax.plot(after, y, "o", color=drawing.AFTER, markersize=6.5, zorder=3)
            ax.annotate(texts[2 * k + 1], (after, y), color=drawing.AFTER, bbox=box, **above)
        ax.plot(before, y, "o", color=drawing.BEFORE, markersize=6.5, zorder=2)
        ax.annotate(texts[2 * k], (before, y), color=drawing.BEFORE, bbox=box, **above)
    floor = closure["noise_floor_N"]
    if known(floor):
        ax.axvline(floor, color=drawing.FLOOR, linestyle="--", linewidth=1.0, zorder=0)
        largest = max(largest, floor)
    ax.set_yticks(range(len(rows)), [label for _, label in reversed(rows)])
    ax.set_ylim(-0.6, len(rows) - 0.35)
    ax.set_xlim(0.0, 1.13 * largest or 1.0)
    ax.grid(axis="y", visible=False)
    ax.set_xlabel(f"rms error ({plain(units.unit('force'))})")


def draw_histogram(ax: Axes, before: np.ndarray, after: np.ndarray, units: Units, held_out: bool) -> None:
    """Draw histograms of the errors of the run means, before and after, in the same classes."""
    both = np.concatenate([before, after])
    edge = float(np.max(np.abs(both))) or 1.0
    edges = np.linspace(-edge, edge, 2 * int(np.clip(np.sqrt(len(before)), 4, 15)) + 2)
    ax.hist(before, edges, histtype="stepfilled", color=drawing.BEFORE, alpha=0.25)
    ax.hist(before, edges, histtype="step", color=drawing.BEFORE, linewidth=1.2)
    if not np.array_equal(before, after):
        ax.hist(after, edges, histtype="step", color=drawing.AFTER, linewidth=1.7)
    ax.axvline(0.0, color=drawing.QUIET, linewidth=0.8, zorder=0)
    ax.yaxis.get_major_locator().set_params(integer=True)
    kind = "held-out error" if held_out else "error"
    ax.set_xlabel(f"{kind} of the run mean ({plain(units.unit('force'))})")
    ax.set_ylabel("runs")


def run_means(residuals: pd.DataFrame, column: str) -> pd.Series:
    """Return the mean of `column` over every run, with equal weights of its files."""
    files = residuals.groupby(["run_id", "file"], sort=True)[column].mean()
    return files.groupby(level="run_id", sort=True).mean().dropna()


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def before_after(tables: Tables, closure: Mapping, config: Config) -> Plot | None:
    """Return the errors before and after with the noise floor, or None if no error is known."""
    if not any(known(closure["before"][key]) for key, _ in ERRORS):
        return None
    unit, floor = config.units.unit("force"), closure["noise_floor_N"]
    alt = "Rms errors: "
    for key, label in ERRORS:
        before, after = (number(closure[stage][key]) for stage in ("before", "after"))
        alt += f"{label} {before} before, {after} {unit} after; "
    alt += f"noise floor {f'{number(floor)} {unit}' if known(floor) else 'unknown'}."
    draw = partial(draw_errors, closure=closure, units=config.units)
    panels = [Panel("Errors and noise floor", alt, draw)]
    before, after = tables["residuals_before"], tables["residuals_after"]
    if len(before) and len(after):
        held = before["heldout_residual_N"].notna().any() and after["heldout_residual_N"].notna().any()
        column = "heldout_residual_N" if held else "residual_N"
        a, b = run_means(before, column).to_numpy(), run_means(after, column).to_numpy()
        if len(a) >= 4 and len(b) >= 4:
            alt = f"{'Held-out errors' if held else 'Errors'} of {len(a)} run means: rms "
            alt += f"{number(_rms(a))} before, {number(_rms(b))} {unit} after."
            draw = partial(draw_histogram, before=a, after=b, units=config.units, held_out=held)
            panels.append(Panel("Errors of run means", alt, draw))
    same = closure["before"] == closure["after"]
    legend = [Key("declared model", drawing.BEFORE, "bar")] if same else list(BARS)
    if known(floor):
        legend.append(Key("noise floor", drawing.FLOOR, "dashed"))
    return Plot("before_after", "Errors before and after", tuple(panels), tuple(legend))


def finding(tables: Tables, closure: Mapping, config: Config) -> Plot | None:
    """Return the evidence for the verdict: the residual along one variable, and the panels of the errors.

    The variable is that of the effect that reduces the held-out error most, or, without an effect, the most
    significant one. In place of the direction it is the signed speed, over which an offset, a factor and
    viscous friction of one direction differ. None if there is no residual.
    """
    errors, channels = before_after(tables, closure, config), tables["channels"]
    if errors is None or channels.empty:
        return None
    order = channel_order(tables)
    added = [effect for effect in by_gain(closure["effects"]) if not effect["candidate"]]
    own = chain.from_iterable(effect["channels"] for effect in added)
    panel = _own_panel(next((name for name in own if name in order), order[0]), tables, config)
    floor = (key for key in errors.legend if key.mark == "dashed")
    title = "Residual and errors before and after"
    return Plot("finding", title, (panel, *errors.panels), (*STAGES, *floor))


def _own_panel(name: str, tables: Tables, config: Config) -> Panel:
    """Return a panel of the residual along a channel, on a scale of its own; see `finding`."""
    rows = tables["channels"][tables["channels"]["channel"] == name]
    if name == "direction":
        name, rows = "speed_mm_s", signed_speeds(tables["residuals_before"], tables["residuals_after"])
    panel = _channel_panel(rows, name, tables, config)
    backward = rows["x"].min() < 0 and name == "speed_mm_s"
    return replace(panel, title=f"{panel.title}, negative backward") if backward else panel


def refused(tables: Tables, closure: Mapping, config: Config) -> Plot | None:
    """Return the residual along each variable of effects that were not accepted; None without a panel."""
    drawn = dict.fromkeys(tables["channels"]["channel"])
    entries = [entry["channels"] for entry in closure["refused"]]
    names = {name for own in entries for name in own if name != "direction" or len(own) == 1}
    panels = tuple(_own_panel(name, tables, config) for name in drawn if name in names)
    title = "Residual by variable of effects not accepted"
    return Plot("refused", title, panels, STAGES) if panels else None


def signed_speeds(before: pd.DataFrame, after: pd.DataFrame) -> pd.DataFrame:
    """Return the mean residuals at each commanded speed and direction, as rows of table `channels`.

    Where no speed was commanded, measured ones that agree to two digits are one. Intervals are from the
    strokes' means.
    """
    found, stroke = {}, ["run_id", "file", "stroke"]
    for stage, residuals in (("before", before), ("after", after)):
        values = residuals.reindex(columns=[*stroke, "speed_mm_s", "speed_set_mm_s", "residual_N"])
        means = values.groupby(stroke).mean().reset_index()
        measured = means["speed_mm_s"].map(lambda value: float(f"{value:.2g}"))
        speed = (np.sign(measured) * means["speed_set_mm_s"]).fillna(measured)
        groups, farthest = means.groupby(speed), means["residual_N"].abs().groupby(speed).idxmax()
        found[f"{stage}_N"] = groups["residual_N"].mean()
        found[f"{stage}_half_N"] = groups["residual_N"].sem() * stdtrit(groups.size() - 1, 0.975)
        found[f"{stage}_run"] = farthest.map(means["run_id"])
    return pd.DataFrame(found).rename_axis("x").reset_index().assign(along_motion=False)


def draw_levels(ax: Axes, levels: pd.DataFrame, units: Units) -> None:
    """Draw the residual variance at every level, before and after; beside each bar its standard deviation."""
    whole = levels[levels["channel"].isna()]
    names = [name for name in reversed(LEVELS) if name in set(whole["level"])]
    sd = {(row.stage, row.level): row.sd_N for row in whole.itertuples()}
    texts = dict(zip(sd, together(list(sd.values())), strict=True))
    largest = max([value**2 for value in sd.values() if known(value)], default=1.0) or 1.0
    single = not any(stage == "after" for stage in whole["stage"])
    for k, name in enumerate(names):
        for stage, colour, shift in (("before", drawing.BEFORE, 0.19), ("after", drawing.AFTER, -0.19)):
            value = sd.get((stage, name))
            if not known(value):
                continue
            place = (value**2, k if single else k + shift)
            ax.barh(place[1], place[0], 0.34, color=colour, linewidth=0)
            ax.annotate(texts[stage, name], place, (4, 0), textcoords="offset points", va="center", size=7.5)
    unit = plain(units.unit("force"))
    ax.set_yticks(range(len(names)), [name.replace("_", "-") for name in names])
    ax.set_ylim(-0.6, len(names) - 0.4)
    ax.set_xlim(0.0, 1.2 * largest)
    ax.grid(axis="y", visible=False)
    ax.set_xlabel(f"variance (({unit})²)" if " " in unit else f"variance ({unit}²)")


def variance_levels(tables: Tables, config: Config) -> Plot | None:
    """Return the residual's variance by level, or None of properties."""
    levels = tables["levels"]
    whole = levels[levels["channel"].isna() & levels["sd_N"].notna()]
    if whole.empty:
        return None
    unit = config.units.unit("force")
    parts = [f"{row.level} {row.stage} {number(row.sd_N)} {unit}" for row in whole.itertuples()]
    alt = f"Standard deviation of the residual by level: {', '.join(parts)}."
    height = max(0.82 + 0.42 * whole["level"].nunique(), 1.6)
    draw = partial(draw_levels, levels=levels, units=config.units)
    panel = Panel(f"Variance by level (labels: sd in {unit})", alt, draw)
    return Plot("variance_levels", "Residual variance by level", (panel,), BARS, height=height)


def draw_channel(ax: Axes, rows: pd.DataFrame, channel: str, units: Units) -> None:
    """Draw the mean residual along one channel, `rows` of table `channels`, with 95 % intervals."""
    numeric = rows["x"].notna().all() and channel != "direction"
    x = rows["x"].to_numpy(float) if numeric else np.arange(len(rows), dtype=float)
    log = numeric and channel not in CALENDAR and drawing.is_logarithmic(x, LOG_SPAN)
    if numeric and channel in ("speed_mm_s", "speed_set_mm_s"):  # as force against speed is drawn
        log = bool(x.min() > 0 and x.max() / x.min() > SPEED_SPAN)
    # The two stages are drawn side by side, so that neither hides the other.
    apart = 0.008 * (np.ptp(np.log(x)) if log else np.ptp(x)) if numeric else 0.09
    ax.axhline(0.0, color=drawing.QUIET, linewidth=0.8, zorder=1)
    size = {"markersize": 3.6, "markeredgewidth": 0.9, "elinewidth": 0.9, "capsize": 1.8}
    if not numeric and len(rows) > MANY_CATEGORIES:  # drawn finer, or they are one blot
        size = {"markersize": 1.8, "markeredgewidth": 0.6, "elinewidth": 0.4, "capsize": 0.0}
    for stage, colour, marker, shift in (
        ("before", drawing.BEFORE, "o", -apart),
        ("after", drawing.AFTER, "s", apart),
    ):
        spread = rows[f"{stage}_half_N"].fillna(0.0).to_numpy(float)
        places, mean = x * np.exp(shift) if log else x + shift, rows[f"{stage}_N"]
        face, above = ("white", 2) if stage == "before" else (colour, 3)
        points, *_ = ax.errorbar(
            places,
            mean,
            spread,
            color=colour,
            marker=marker,
            markerfacecolor=face,
            zorder=above,
            linestyle="-" if numeric else "",
            linewidth=0.8,
            rasterized=len(rows) > drawing.MOST_MARKS,
            **size,
        )
        if len(rows) <= drawing.MOST_MARKS:
            names = [number(value, 4) for value in x] if numeric else categories(rows, channel)
            texts = (f"{number(m, 3)} ± {number(s, 2)}" for m, s in zip(mean, spread, strict=True))
            place, unit = channel_label(channel, units), units.unit("force")
            said = zip(texts, names, rows[f"{stage}_run"], strict=True)
            most = "largest in run"  # a click on the point opens it
            explain(points, [f"{stage}: {v} {unit}\n{place}: {name}\n{most}\n{run}" for v, name, run in said])
    if log:
        drawing.log_axis(ax)
    elif numeric:
        drawing.value_ticks(ax, x)
    else:
        drawing.category_ticks(ax, categories(rows, channel))
    ax.set_xlabel(plain(short(channel_label(channel, units), 44)))
    along = " along the motion" if rows["along_motion"].any() else ""
    ax.set_ylabel(f"residual{along} ({plain(units.unit('force'))})")


def categories(rows: pd.DataFrame, channel: str) -> list[str]:
    """Return the names of a category's rows; both directions in words."""
    if channel == "direction":
        signs = rows["x"].fillna(rows["label"]).astype(float)
        return ["forward" if sign > 0 else "backward" for sign in signs]
    return rows["label"].astype(str).tolist()


def channel_order(tables: Tables) -> list[str]:
    """Return the channels by the p-value of what they explain of the residual, the smallest first."""
    tests, names = tables["levels"], tables["channels"]["channel"].unique()
    tests = tests[(tests["stage"] == "before") & tests["p_value"].notna()]
    first = tests.sort_values(["p_value", "sd_N"], ascending=[True, False])["channel"]
    return [name for name in dict.fromkeys([*first, *names]) if name in names]


def residual_channels(tables: Tables, config: Config) -> Plot | None:
    """Return the residual along every channel, before and after, or None of properties."""
    channels = tables["channels"]
    if channels.empty:
        return None
    span = _span(channels)
    panels = [
        _channel_panel(channels[channels["channel"] == name], name, tables, config, span)
        for name in channel_order(tables)[:MOST_CHANNELS]
    ]
    return Plot("residual_channels", "Residual by variable", tuple(panels), STAGES)


def _channel_panel(
    rows: pd.DataFrame, name: str, tables: Tables, config: Config, span: tuple[float, float] | None = None
) -> Panel:
    """Return a panel of the mean residual along a channel; `span` is that of its axis of forces."""
    rows = rows.sort_values("x") if rows["x"].notna().all() else rows
    draw = partial(draw_channel, rows=rows, channel=name, units=config.units)
    words = channel_words(name, config.units)
    largest = [rows[f"{stage}_N"].abs().max() for stage in ("before", "after")]
    alt = f"Mean residual along {words}: largest {number(largest[0])} before, {number(largest[1])} "
    alt += f"{config.units.unit('force')} after"
    tested = tables["levels"].dropna(subset=["channel", "p_value"])
    p = tested.loc[(tested["stage"] == "before") & (tested["channel"] == name), "p_value"]
    alt += f"; p {p_value(p.min())} before." if len(p) else "."
    return Panel(capital(words), alt, draw, limits={"ylim": span or _span(rows)})


def _span(channels: pd.DataFrame) -> tuple[float, float]:
    """Return the ends of a scale for all means and intervals; a wide interval does not flatten the rest."""
    means = channels[["before_N", "after_N"]].fillna(0.0)
    half = channels[["before_half_N", "after_half_N"]].fillna(0.0).to_numpy()
    largest = 2.5 * means.abs().max().max()
    low = max((means - half).min().min(), -largest)
    high = min((means + half).max().max(), largest)
    low, high = min(low, 0.0), max(high, 0.0)
    room = 0.07 * (high - low) or 1.0
    return low - room, high + room


def draw_shape(ax: Axes, rows: pd.DataFrame, points: pd.DataFrame, effect: Mapping, units: Units) -> None:
    """Draw an effect along one channel: its form with the 95 % band, and the free shape it was compared with.

    `rows` of table `shapes` and `points` of table `shape_points` are those of this effect and channel.
    """
    channel, scale = rows["channel"].iloc[0], shape_scale(effect)
    numeric = rows["x"].notna().all() and channel != "direction"
    if channel == "direction" and rows["x"].notna().all():
        rows = rows[rows["x"].abs() == 1.0]  # there is nothing between forward and backward
    value, lo, hi, free = (scale * rows[name].to_numpy(float) for name in ("value", "lo95", "hi95", "free"))
    ax.axhline(0.0, color=drawing.QUIET, linewidth=0.8, zorder=1)
    if numeric:
        x = rows["x"].to_numpy(float)
        drawing.draw_band(ax, x, lo, hi, drawing.AFTER)
        ax.plot(x, free, color=drawing.FLOOR, linestyle="--", linewidth=1.1)
        ax.plot(x, value, color=drawing.AFTER)
        ax.set_xlim(x.min(), x.max() if x.max() > x.min() else x.min() + 1)
        if channel not in CALENDAR and drawing.is_logarithmic(x, LOG_SPAN):
            drawing.log_axis(ax)
        elif len(points):
            drawing.value_ticks(ax, points["x"].to_numpy(float))
    else:
        x = np.arange(len(rows))
        spread = np.nan_to_num(np.abs(np.stack([value - lo, hi - value])))
        ax.errorbar(x, value, spread, color=drawing.AFTER, fmt="o", elinewidth=1.4, capsize=2.0)
        ax.plot(x, free, color=drawing.FLOOR, marker="_", linestyle="", markersize=12)
        drawing.category_ticks(ax, categories(rows, channel))
    if len(points):
        places = points["x"] if numeric else np.arange(len(points)) + 0.15
        ax.errorbar(
            places,
            scale * points["value"],
            Z95 * scale * points["se"],
            color=drawing.FLOOR,
            fmt="o",
            markersize=2.6,
            elinewidth=0.8,
            capsize=1.5,
            zorder=1.5,
        )
    ax.set_xlabel(plain(short(channel_label(channel, units), 44)))
    ax.set_ylabel(shape_label(rows, effect, units, symbol_math))


def shape_scale(effect: Mapping) -> float:
    """Return 100 where a shape is a factor minus one, drawn in percent, else 1."""
    return 100.0 if effect["operation"] == "multiply" else 1.0


def shape_label(
    rows: pd.DataFrame, effect: Mapping, units: Units, symbol: Callable[[str], str] = symbol_plain
) -> str:
    """Return the axis label of a shape, with the unit: "added force (N)", "change of μ (%)"."""
    target = effect["acts_on"]
    force = plain(units.quantity("force"))
    if effect["operation"] == "multiply":
        return f"change of {force if target == 'force' else symbol(target)} (%)"
    unit = next((u for u in rows["unit"] if isinstance(u, str) and u), "")
    tail = f" ({plain(unit)})" if unit else ""
    return f"added {force}{tail}" if target == "force" else f"change of {symbol(target)}{tail}"


def effect_shapes(tables: Tables, closure: Mapping, config: Config) -> Plot | None:
    """Return the shape of every effect, a panel for each channel it is drawn along; None if there is none."""
    shapes, points = tables["shapes"], tables["shape_points"]
    if shapes.empty:
        return None
    effects = closure["effects"]
    place = [by_gain(effects).index(effect) for effect in effects]  # of their texts in the page
    shapes = shapes.sort_values("effect", key=lambda index: index.map(lambda k: place[int(k)]), kind="stable")
    panels = []
    for (index, channel), rows in shapes.groupby(["effect", "channel"], sort=False):
        effect = effects[int(index)]
        rows = rows.sort_values("x") if rows["x"].notna().all() else rows
        own = points[(points["effect"] == index) & (points["channel"] == channel)]
        draw = partial(draw_shape, rows=rows, points=own, effect=effect, units=config.units)
        values = shape_scale(effect) * rows["value"]
        words = ("candidate: " if effect["candidate"] else "") + effect_label(effect, config.units)
        alt = f"Shape of {words} along {channel_words(channel, config.units)}: "
        alt += f"{shape_label(rows, effect, config.units)} "
        alt += f"from {number(values.min())} to {number(values.max())}."
        if effect["id"] == "slopes":
            words = f"{rows['category'].iloc[0]}: {words}"
        number_of = f"{place[int(index)] + 1}. " if len(effects) > 1 else ""
        panels.append(Panel(number_of + capital(words), alt, draw))
    legend = [Key("effect, 95 % band", drawing.AFTER)]
    if shapes["free"].notna().any():
        legend.append(Key("free shape", drawing.FLOOR, "dashed"))
    if len(points):
        legend.append(Key("partial residual: effect plus mean residual, 95 %", drawing.FLOOR, "point"))
    return Plot("effect_shapes", "Shapes of the effects", tuple(panels), tuple(legend))
