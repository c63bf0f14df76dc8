"""Force against speed, a panel per series; and the pre-sliding rise at selected speeds."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import chain, cycle

import numpy as np
import pandas as pd
from matplotlib.axes import Axes

from sealfit.config import Config
from sealfit.report import drawing
from sealfit.report.drawing import Key, Panel, Plot, Tables, explain
from sealfit.report.notation import (
    ConditionNames,
    by_number,
    capital,
    count,
    given,
    is_number,
    is_unaged,
    natural,
    number,
    plain,
    short,
)
from sealfit.units import Units

MOST_CURVES = 24  # in one panel
MOST_FILES = 4  # named under the pointer
MOST_COLOURS = 10  # in one panel; with more, each condition has its own, or numbers are thinned
TALL = 3.1  # inches, where one or two panels hold everything
LOG_SPAN = 20.0  # speeds that span this factor are drawn on a logarithmic axis


@dataclass(frozen=True)
class Line:
    """One condition in a panel of force against speed, all in the direction of motion (magnitudes)."""

    label: str
    colour: str
    curves: tuple[pd.DataFrame, ...]  # one for a direction and load: direction, speed, before, after, lo, hi
    points: pd.DataFrame  # speed, force, sd, direction


def draw_force_speed(ax: Axes, lines: Sequence[Line], units: Units, *, log: bool = False) -> None:
    """Draw force against speed of conditions: model with its band, declared model dotted, and run means."""
    dense = sum(len(line.points) for line in lines) > drawing.MOST_MARKS
    for line in lines:
        for curve in line.curves:
            speed = curve["speed"]
            drawing.draw_band(ax, speed, curve["lo"], curve["hi"], line.colour)
            if not curve["before"].equals(curve["after"]):
                ax.plot(speed, curve["before"], color=line.colour, linestyle=":", linewidth=0.9, alpha=0.8)
            backward = (curve["direction"] < 0).any()
            ax.plot(speed, curve["after"], color=line.colour, linestyle="--" if backward else "-")
        for direction, points in line.points.groupby("direction"):
            marker, face = ("o", line.colour) if direction > 0 else ("<", "white")
            drawn, *_ = ax.errorbar(
                points["speed"],
                points["force"],
                points["sd"].fillna(0.0),
                color=line.colour,
                fmt=marker,
                markersize=3.4,
                markerfacecolor=face,
                markeredgewidth=0.9,
                elinewidth=0.8,
                capsize=0.0 if dense else 1.5,
                rasterized=dense,
            )
            if not dense:
                explain(drawn, [_of_run(row, line.label, units) for row in points.to_dict("records")])
    if log:
        drawing.log_axis(ax)
    else:
        ax.set_xlim(left=0.0)
    ax.set_xlabel(plain(units.label("speed_mm_s")))
    ax.set_ylabel(plain(units.label("force_N")))


def _of_run(row: Mapping, condition: str, units: Units) -> str:
    scatter = f" ± {number(row['sd'], 2)}" if np.isfinite(row["sd"]) else ""
    force = f"{number(row['force'], 4)}{scatter} {units.unit('force')}, {count(int(row['n']), 'file')}"
    speed = f"{given(row['speed'])} {units.unit('speed')}"
    return "\n".join([force, f"{condition}, {speed}", row["run_id"], row["files"]])


def force_speed(tables: Tables, config: Config) -> Plot | None:
    """Return force against speed for every condition, a panel per series, or None if nothing was measured."""
    points, curves = run_points(tables["steady"]), curve_lines(tables)
    conditions = pd.unique(pd.concat([points["condition"], curves["condition"]], ignore_index=True))
    if not len(conditions):
        return None
    names = ConditionNames(config)
    last = "aging_days" if config.aging else config.condition[-1]
    rubber = tables["steady"].drop_duplicates("condition").set_index("condition")["rubber"].to_dict()
    unaged = [c for c in conditions if is_unaged(c)]
    groups = _groups([c for c in conditions if not is_unaged(c)], names, last) or {"": unaged}
    titles, note = drawing.panels_of(list(groups), "panels")
    groups = {title: groups[title] for title in titles}
    drawn = {*unaged, *chain.from_iterable(groups.values())}
    if len(drawn) < len(conditions):
        aged = count(len(conditions) - len(unaged), "condition")
        note = f"{note} They hold {len(drawn) - len(unaged)} of {aged}. ".lstrip()
        note += "steady.parquet and curves.parquet have all."
    levels = sorted({names.parts(c).get(last, "") for c in drawn} - {""}, key=by_number)
    numeric = all(is_number(level) for level in levels)
    colour = dict(zip(levels, drawing.shades(len(levels)) if numeric else cycle(drawing.CYCLE), strict=False))
    speeds = pd.concat([points["speed"], curves["speed"]])
    speeds = speeds[speeds > 0].astype(float)
    log = len(speeds) > 0 and speeds.max() / speeds.min() > LOG_SPAN
    # one scale for all panels, so that conditions can be compared across them
    force, sd = points["force"], points["sd"].fillna(0)
    shown = pd.concat([force + sd, force - sd, curves["after"], curves["before"]]).dropna()
    x_span = (speeds.min() / 1.2 if log else 0.0, speeds.max() * (1.2 if log else 1.06))
    limits = {"xlim": x_span, "ylim": drawing.padded(shown.min(), shown.max())}
    # curves of a condition: directions and loads
    most = max(2, MOST_CURVES // max(len(group) for group in groups.values()))
    own_curves = {
        c: tuple(drawing.spread([part for _, part in own.groupby(["direction", "load"], dropna=False)], most))
        for c, own in curves[curves["condition"].isin(drawn)].groupby("condition")
    }
    own_points = dict(list(points.groupby("condition", sort=False)))
    panels = []
    for title, group in groups.items():
        shared = [c for c in unaged if c not in group and rubber.get(c) in {rubber.get(g) for g in group}]
        lines = []
        for c in [*shared, *group]:
            own = own_curves.get(c, ()), own_points.get(c, points.iloc[:0])
            lines.append(
                Line(names(c), drawing.BLACK if is_unaged(c) else colour[names.parts(c)[last]], *own)
            )
        draw = partial(draw_force_speed, lines=lines, units=config.units, log=log)
        panels.append(Panel(title, _force_alt(title, lines, config), draw, limits=limits))
    legend = [Key(short(names(c)), drawing.BLACK) for c in drawing.spread(unaged, drawing.MOST_KEYS)]
    keys = drawing.spread(levels, drawing.MOST_KEYS)
    legend += [Key(short(names(f"{last}={level}")), colour[level]) for level in keys]
    kinds = (("run means", points, ("point", "left")), ("model", curves, ("line", "dashed")))
    for what, rows, marks in kinds:
        signs = rows["direction"].unique()
        for sign, way, mark in zip((1, -1), ("forward", "backward"), marks, strict=True):
            if sign in signs:
                legend.append(Key(f"{what}, {way}" if len(signs) > 1 else what, drawing.FLOOR, mark))
    if curves["lo"].notna().any():
        legend.append(Key("95 % band", drawing.FLOOR, "band"))
    gap = (curves["after"] - curves["before"]).abs().max()
    if gap > 1e-9 * max(curves["after"].abs().max(), 1e-300):
        legend.append(Key("declared model", drawing.FLOOR, "dotted"))
    title = f"{capital(config.units.quantity('force'))} against {config.units.quantity('speed')}"
    height = drawing.HEIGHT if len(groups) > 2 else TALL
    return Plot("force_speed", title, tuple(panels), tuple(legend), note, height)


def _force_alt(title: str, lines: Sequence[Line], config: Config) -> str:
    forces = [force for line in lines for force in line.points["force"].dropna()]
    text = f"{config.units.quantity('force')} against {config.units.quantity('speed')}"
    text += f"{', ' + title if title else ''}: {count(len(lines), 'condition')}"
    if forces:
        ends, unit = f"{number(min(forces))} to {number(max(forces))}", config.units.unit("force")
        text += f", run means from {ends} {unit}"
    return text + "."


def run_points(steady: pd.DataFrame) -> pd.DataFrame:
    """Return mean and scatter of every run: condition, direction, speed, force (along the motion), sd, n."""
    used = steady[steady["used"].astype(bool)]
    rows = used.assign(speed=used["speed_mm_s"].abs(), force=used["force_N"] * used["direction"])
    run = ["condition", "run_id", "direction"]
    files = rows.groupby([*run, "file"], sort=False)[["speed", "force"]].mean().reset_index()
    found = files.groupby(run, sort=False).agg(
        speed=("speed", "mean"),
        force=("force", "mean"),
        sd=("force", "std"),
        n=("force", "size"),
        files=("file", lambda own: ", ".join(drawing.spread(list(own), MOST_FILES))),
    )
    return found.reset_index()


def curve_lines(tables: Tables) -> pd.DataFrame:
    """Return the curves of the loop by magnitude of the speed."""
    curves = tables["curves"].rename(columns={"load_N": "load"})
    sign = np.sign(curves["speed_mm_s"]).replace(0.0, 1.0)
    ends = curves[["force_after_lo95_N", "force_after_hi95_N"]].mul(sign, axis=0)
    before, after = curves["force_before_N"] * sign, curves["force_after_N"] * sign
    found = curves[["condition", "load"]].assign(direction=sign, speed=curves["speed_mm_s"].abs())
    found = found.assign(before=before, after=after, lo=ends.min(axis=1), hi=ends.max(axis=1))
    return found.sort_values(["condition", "direction", "speed"])


def _groups(conditions: Sequence[str], names: ConditionNames, last: str) -> dict[str, list[str]]:
    """Return {title: conditions} of the panels: conditions that differ only in the last column share one."""
    groups: dict[str, list[str]] = {}
    for condition in conditions:
        others = {name: value for name, value in names.parts(condition).items() if name != last}
        title = names(", ".join(f"{name}={value}" for name, value in others.items())) if others else ""
        groups.setdefault(title, []).append(condition)
    level = {c: names.parts(c).get(last, "") for c in conditions}
    titles = sorted(groups, key=natural)
    groups = {title: sorted(groups[title], key=lambda c: by_number(level[c])) for title in titles}
    if all(len(group) <= MOST_COLOURS for group in groups.values()):
        return groups
    if len(conditions) > drawing.MOST_PANELS and all(map(is_number, level.values())):
        # numbers have an order
        return {title: drawing.spread(group, MOST_COLOURS) for title, group in groups.items()}
    return {names(c): [c] for group in groups.values() for c in group}


MOST_START_PANELS = 6
MOST_SPEEDS = 3
UP = 0.98  # share of the last force at which a start counts as over
BEYOND = 1.5  # of that distance is shown


def draw_starts(ax: Axes, curves: pd.DataFrame, colours: Mapping[float, str], units: Units) -> None:
    """Draw rows of table `dynamic_curves` of a condition, in the colours of the commanded speeds."""
    for (speed, direction), curve in curves.groupby(["speed_set_mm_s", "direction"], dropna=False, sort=True):
        curve = curve.sort_values("distance_mm")
        colour = colours.get(speed, drawing.BLACK)
        x, force, error = curve["distance_mm"], curve["force_N"], curve["force_se_N"].fillna(0.0)
        marker, face, line = ("o", colour, "-") if direction > 0 else ("<", "white", "--")
        drawing.draw_band(ax, x, force - error, force + error, colour)
        look = {"color": colour, "markerfacecolor": face, "markersize": 2.6, "markeredgewidth": 0.7}
        ax.plot(x, force, marker, **look)
        ax.plot(x, curve["model_N"], color=colour, linestyle=line)
    ax.set_xlim(0.0, _reach(curves))
    ax.set_xlabel(plain(units.label("distance_mm")))
    ax.set_ylabel(plain(units.label("force_N")))


def _reach(curves: pd.DataFrame) -> float:
    """Return the distance to draw: 1.5 times the distance at which the slowest rise has ended."""
    ends = []
    for _, curve in curves.groupby(["speed_set_mm_s", "direction"], dropna=False):
        curve = curve.sort_values("distance_mm")
        below = np.flatnonzero(curve["force_N"].to_numpy() < UP * curve["force_N"].iloc[-1])
        ends.append(curve["distance_mm"].iloc[min(below[-1] + 1 if len(below) else 0, len(curve) - 1)])
    return float(BEYOND * max(ends))


def starts(tables: Tables, config: Config) -> Plot | None:
    """Return the pre-sliding force of up to six conditions at up to three speeds each; None without one."""
    curves = tables["dynamic_curves"]
    if curves.empty:
        return None
    names, units = ConditionNames(config), config.units
    picked = drawing.spread(sorted(curves["condition"].unique(), key=names.place), MOST_START_PANELS)
    speeds = drawing.spread(np.sort(curves["speed_set_mm_s"].dropna().unique()).tolist(), MOST_SPEEDS)
    colours = dict(zip(speeds, drawing.shades(len(speeds)), strict=True))
    shown = curves[curves["condition"].isin(picked)]
    shown = shown[shown["speed_set_mm_s"].isin(speeds) | shown["speed_set_mm_s"].isna()]
    span = drawing.padded(min(0.0, shown["force_N"].min()), shown["force_N"].max())
    panels = []
    for condition in picked:
        own = shown[shown["condition"] == condition]
        if own.empty:
            continue
        alt = f"Pre-sliding, {names(condition)}: {units.quantity('force')} "
        alt += f"from {number(own['force_N'].min())} to {number(own['force_N'].max())} {units.unit('force')} "
        alt += f"over {number(_reach(own))} {units.unit('displacement')}."
        draw = partial(draw_starts, curves=own, colours=colours, units=units)
        panels.append(Panel(names(condition), alt, draw, limits={"ylim": span}))
    legend = [Key(f"{given(speed)} {units.unit('speed')}", colour) for speed, colour in colours.items()]
    legend.append(Key("mean of the strokes", drawing.FLOOR, "point"))
    if (shown["direction"] < 0).any():
        legend.append(Key("backward", drawing.FLOOR, "left"))
    if shown["model_N"].notna().any():
        legend.append(Key("dynamic model", drawing.FLOOR, "line"))
    return Plot("starts", "Pre-sliding", tuple(panels), tuple(legend))
