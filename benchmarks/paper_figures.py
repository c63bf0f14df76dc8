"""Counterparts of the source paper's figures: the model's sensitivity, and what aging does to friction."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from paper_numbers import MEASURED, SERIES, UNAGED, as_printed, condition, printed_errors

from sealfit.config import Config
from sealfit.physics import aging_law, stribeck_force
from sealfit.report.drawing import BLACK, CYCLE, FLOOR, QUIET, Key, Panel, Plot, shades
from sealfit.report.figures.aging import aging_points, draw_aging
from sealfit.report.figures.speed import Line, draw_force_speed, run_points
from sealfit.report.notation import symbol_math

TEMPERATURES, COMPRESSIONS, DAYS = (20, 40, 60, 80), (80, 90, 100), (1, 2, 4, 8, 12, 16)
SENSITIVITY = {
    "mu_s": (0.25, 0.275, 0.30, 0.325, 0.35),
    "mu_c": (0.20, 0.225, 0.25, 0.275, 0.30),
}  # its section 2.3
HELD = {"mu_s": 0.30, "mu_c": 0.30, "v_s": 5.0, "sigma_2": 0.2}
# Normal load in N.
LOAD = 50.0
At = tuple[float, float, float]


@dataclass(frozen=True)
class Found:
    """What the pipeline found: its tables by name, and the config."""

    tables: Mapping[str, pd.DataFrame]
    config: Config

    def line(self, at: At | None, label: str, colour: str) -> Line:
        """Return one condition for a panel of force against speed: run means and the steady fit."""
        name = condition(at)
        points = run_points(self.tables["steady"])
        return Line(label, colour, (self.curve(name),), points[points["condition"] == name])

    def curve(self, name: str) -> pd.DataFrame:
        """Return the steady fit of one condition over its speeds, as a curve of `Line`."""
        fit, steady = self.tables["steady_fit"], self.tables["steady"]
        rows = fit[(fit["condition"] == name) & (fit["quantity"] == "steady")]
        values = rows.set_index("parameter")["value"][["mu_s", "mu_c", "v_s", "sigma_2"]]
        here = steady[(steady["condition"] == name) & steady["used"].astype(bool)]
        speeds = here["speed_mm_s"].abs()
        speed = np.geomspace(speeds.min() / 1.2, speeds.max() * 1.05, 80)
        force = stribeck_force(speed, here["load_N"].mean(), **values)
        curve = {"direction": 1.0, "speed": speed, "before": force, "after": force}
        return pd.DataFrame({**curve, "lo": np.nan, "hi": np.nan})

    def values(self, quantity: str, places: Sequence[At | None]) -> pd.DataFrame:
        """Return value, lo95 and hi95 of a coefficient at some conditions."""
        rows = self.tables["steady_fit"]
        rows = rows[(rows["quantity"] == "steady") & (rows["parameter"] == quantity)].set_index("condition")
        return rows.loc[[condition(at) for at in places], ["value", "lo95", "hi95"]]


def figures(found: Found) -> Iterator[Plot]:
    """Yield the figures in the paper's order."""
    yield _sensitivity("figure_04", "Figure 4: the static friction coefficient in the model", "mu_s")
    yield _sensitivity("figure_05", "Figure 5: the Coulomb friction coefficient in the model", "mu_c")
    pressed = [((60, percent, 1), f"{percent} %") for percent in COMPRESSIONS]
    yield _forces(found, "figure_08", "Figure 8: force and compression, 60 °C, day 1", pressed)
    yield _coefficients(
        found, "figure_09", "Figure 9: coefficients and compression, 60 °C", "height while aging (%)",
        COMPRESSIONS, [(day, [(60, percent, day) for percent in COMPRESSIONS]) for day in DAYS],
    )  # fmt: skip
    heated = [((celsius, 80, 2), f"{celsius} °C") for celsius in TEMPERATURES]
    yield _forces(found, "figure_10", "Figure 10: force and temperature, 80 %, day 2", heated)
    yield _coefficients(
        found, "figure_11", "Figure 11: coefficients and temperature, 80 %", "aging temperature (°C)",
        TEMPERATURES, [(day, [(celsius, 80, day) for celsius in TEMPERATURES]) for day in DAYS],
    )  # fmt: skip
    aged = [((60, 80, day), f"{day} d") for day in DAYS]
    yield _forces(found, "figure_12", "Figure 12: force and aging time, 60 °C, 80 %", aged)
    yield _law(found, "figure_13", "Figure 13: Eq. 15 as fitted and as printed, 60 °C, 80 %")
    last = [((80, 80, 16), "16 d")]
    yield _forces(found, "figure_14", "Figure 14: the model before and after aging, 80 °C, 80 %", last)
    yield _predicted(
        found, "figure_15", "Figure 15: predicted and measured, 80 °C, 80 %, day 16", (80, 80, 16)
    )


def _sensitivity(name: str, title: str, quantity: str) -> Plot:
    values = SENSITIVITY[quantity]
    speed = np.r_[np.linspace(-30, -1e-6, 200), np.linspace(1e-6, 30, 200)]

    def draw(ax: Axes) -> None:
        for value, colour in zip(values, shades(len(values)), strict=True):
            ax.plot(speed, stribeck_force(speed, LOAD, **{**HELD, quantity: value}), color=colour)
        ax.set_xlabel("speed (mm/s)")
        ax.set_ylabel("friction force (N)")

    alt = (
        f"Friction force over speed from -30 to 30 mm/s for {quantity} from {values[0]:g} to {values[-1]:g}."
    )
    legend = [Key(f"{value:g}", colour) for value, colour in zip(values, shades(len(values)), strict=True)]
    return Plot(name, title, (Panel("", alt, draw),), tuple(legend))


def _forces(found: Found, name: str, title: str, places: Sequence[tuple[At, str]]) -> Plot:
    shown = [found.line(None, UNAGED, BLACK)]
    shown += [
        found.line(at, label, colour) for (at, label), colour in zip(places, shades(len(places)), strict=True)
    ]

    def draw(ax: Axes) -> None:
        draw_force_speed(ax, shown, found.config.units, log=True)

    forces = pd.concat([line.points["force"] for line in shown])
    alt = f"Friction force over speed: unaged and {', '.join(label for _, label in places)}; run means from "
    alt += f"{forces.min():.3g} to {forces.max():.3g} N and the fitted model."
    legend = [Key(line.label, line.colour) for line in shown] + [Key("run means", FLOOR, "point")]
    return Plot(name, title, (Panel("", alt, draw),), tuple(legend))


def _coefficients(
    found: Found,
    name: str,
    title: str,
    label: str,
    x: Sequence[float],
    by_day: Sequence[tuple[float, Sequence[At]]],
) -> Plot:
    colours, panels = shades(len(by_day)), []
    for quantity in ("mu_s", "mu_c"):
        values = [found.values(quantity, places) for _, places in by_day]

        def draw(ax: Axes, quantity=quantity, values=values) -> None:
            for own, colour in zip(values, colours, strict=True):
                spread = np.abs(own[["lo95", "hi95"]].sub(own["value"], axis=0)).to_numpy().T
                ax.errorbar(x, own["value"], spread, color=colour, marker="o", capsize=1.5, elinewidth=0.8)
            ax.set_xticks(x)
            ax.set_xlabel(label)
            ax.set_ylabel(symbol_math(quantity))

        every = pd.concat(values)["value"]
        alt = f"{quantity} over {label}, a line per day: from {every.max():.3g} to {every.min():.3g}."
        panels.append(Panel("", alt, draw))
    legend = [Key(f"{day:g} d", colour) for (day, _), colour in zip(by_day, colours, strict=True)]
    return Plot(name, title, tuple(panels), tuple(legend))


def _predicted(found: Found, name: str, title: str, at: At) -> Plot:
    """Return the force that Eq. 15, fitted across the days, gives at a condition, and what was measured."""
    laws, steady = found.tables["aging_fit"], found.tables["steady_fit"]
    celsius, percent, day = at
    laws = laws[laws["series"] == f"temperature_C={celsius:g}, compression_ratio_pct={percent:g}"]
    own = steady[(steady["condition"] == condition(at)) & (steady["quantity"] == "steady")]
    shared = own.set_index("parameter")["value"]
    values = {}
    for quantity, law in laws[laws["parameter"].isin(["mu_0", "a", "b"])].groupby("quantity"):
        values[quantity] = aging_law(day, **law.set_index("parameter")["value"].to_dict())
    points = run_points(found.tables["steady"])
    points = points[points["condition"] == condition(at)]
    speed = np.geomspace(points["speed"].abs().min() / 1.5, points["speed"].abs().max() * 1.2, 200)
    load = float(found.tables["steady"]["load_N"].mean())
    force = stribeck_force(speed, load, **values, v_s=shared["v_s"], sigma_2=shared["sigma_2"])

    def draw(ax: Axes) -> None:
        ax.plot(speed, force, color=CYCLE[0])
        ax.plot(points["speed"].abs(), points["force"].abs(), "o", color=FLOOR)
        ax.set_xscale("log")
        ax.set_xlabel("speed (mm/s)")
        ax.set_ylabel("friction force (N)")

    off = points["force"].abs() / np.interp(points["speed"].abs(), speed, force) - 1.0
    alt = "Friction force over speed: run means and the prediction, which differ by at most "
    alt += f"{abs(off).max():.1%}."
    legend = (Key("predicted by Eq. 15", CYCLE[0]), Key("run means", FLOOR, "point"))
    return Plot(name, title, (Panel("", alt, draw),), legend)


def _law(found: Found, name: str, title: str) -> Plot:
    curves = found.tables["aging_curves"]
    curves = curves[curves["series"] == SERIES]
    points = aging_points(found.tables["steady_fit"])
    points = points[points["series"].isin([SERIES, UNAGED]) & points["quantity"].isin(["mu_s", "mu_c"])]
    days, needed = np.linspace(0, 16, 200), printed_errors()["start"]

    def draw(ax: Axes) -> None:
        draw_aging(ax, points, curves, curves.iloc[:0], ["mu_s", "mu_c"], found.config.units)
        for quantity in ("mu_s", "mu_c"):
            ax.plot(days, as_printed(quantity, days), color=BLACK, linestyle=":")
        ax.plot(days, as_printed("mu_c", days, needed), color=QUIET, linestyle="--")
        for section, _, at, value in MEASURED:
            if section == "4.3":
                ax.plot(0 if at is None else at[2], value, marker="x", color=BLACK, markersize=6)

    ends = points.groupby("quantity")["value"].agg(["max", "min"])
    alt = "Coefficients over aging time with the fitted Eq. 15: " + "; ".join(
        f"{q} from {row['max']:.3g} to {row['min']:.3g}" for q, row in ends.iterrows()
    ) + "."  # fmt: skip
    legend = [Key(q, CYCLE[k], symbol=True) for k, q in enumerate(("mu_s", "mu_c"))]
    legend += [Key("fit per condition, 95 %", FLOOR, "point"), Key("Eq. 15, 95 % band", FLOOR, "band")]
    legend += [Key("Eq. 15 as printed; x: printed values", BLACK, "dotted")]
    legend += [Key(f"the printed prediction, start {needed:.3f}", QUIET, "dashed")]
    return Plot(name, title, (Panel("", alt, draw),), tuple(legend))
