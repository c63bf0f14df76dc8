"""Errors before and after, and the level at which the residual sits."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pandas as pd
from matplotlib.axes import Axes

from sealfit.config import Config
from sealfit.report.numbers import known, number, together
from sealfit.report.style import AFTER, BEFORE, FLOOR, QUIET, Key, Panel, Plot
from sealfit.report.symbols import plain
from sealfit.units import Units

LEVELS = ("specimen", "run", "file", "stroke", "sample")
ERRORS = (("rmse_N", "all bins"), ("rmse_runs_N", "run means"), ("heldout_rmse_N", "held out"))


# ---------------------------------------------------------------- before and after
def draw_errors(ax: Axes, closure: Mapping, units: Units) -> None:
    """Draw each error as a step from before to after, with the noise floor as a line."""
    rows = [(key, label) for key, label in ERRORS if known(closure["before"].get(key))]
    values = [closure[stage].get(key) for key, _ in rows for stage in ("before", "after")]
    texts = together(values)
    box = {"facecolor": "white", "edgecolor": "none", "pad": 0.6, "alpha": 0.85}
    largest = max(value for value in values if known(value))
    for k, (key, _) in enumerate(rows):
        before, after = closure["before"][key], closure["after"].get(key)
        y = len(rows) - 1 - k
        if known(after) and after != before:
            ax.plot([before, after], [y, y], color=QUIET, linewidth=1.2, zorder=1)
            ax.plot(after, y, "o", color=AFTER, markersize=6.5, zorder=3)
            ax.annotate(
                texts[2 * k + 1], (after, y), (0, 7), textcoords="offset points", ha="center", color=AFTER, bbox=box
            )
        ax.plot(before, y, "o", color=BEFORE, markersize=6.5, zorder=2)
        ax.annotate(texts[2 * k], (before, y), (0, 7), textcoords="offset points", ha="center", color=BEFORE, bbox=box)
    floor = closure.get("noise_floor_N")
    if known(floor):
        ax.axvline(floor, color=FLOOR, linestyle="--", linewidth=1.0, zorder=0)
        largest = max(largest, floor)
    ax.set_yticks(range(len(rows)), [label for _, label in reversed(rows)])
    ax.set_ylim(-0.6, len(rows) - 0.35)
    ax.set_xlim(0.0, 1.13 * largest)
    ax.grid(axis="y", visible=False)
    ax.set_xlabel(f"rms error ({plain(units.unit('force'))})")


def draw_histogram(ax: Axes, before: np.ndarray, after: np.ndarray, units: Units, held_out: bool) -> None:
    """Draw how the errors of the run means are spread, before and after, in the same classes."""
    both = np.concatenate([before, after])
    edge = float(np.max(np.abs(both))) or 1.0
    edges = np.linspace(-edge, edge, 2 * int(np.clip(np.sqrt(len(before)), 4, 15)) + 2)
    ax.hist(before, edges, histtype="stepfilled", color=BEFORE, alpha=0.25)
    ax.hist(before, edges, histtype="step", color=BEFORE, linewidth=1.2)
    if not np.array_equal(before, after):
        ax.hist(after, edges, histtype="step", color=AFTER, linewidth=1.7)
    ax.axvline(0.0, color=QUIET, linewidth=0.8, zorder=0)
    ax.yaxis.get_major_locator().set_params(integer=True)
    kind = "held-out error" if held_out else "error"
    ax.set_xlabel(f"{kind} of the run mean ({plain(units.unit('force'))})")
    ax.set_ylabel("runs")


def run_means(residuals: pd.DataFrame, column: str) -> pd.Series:
    """Return the mean of `column` over every run, each file weighing the same."""
    files = residuals.groupby(["run_id", "file"], sort=True)[column].mean()
    return files.groupby(level="run_id", sort=True).mean().dropna()


def before_after(tables: Mapping[str, pd.DataFrame], closure: Mapping | None, config: Config) -> Plot | None:
    """Return the errors before and after with the noise floor, or None if the loop was not run."""
    if closure is None or not any(known(closure["before"].get(key)) for key, _ in ERRORS):
        return None
    unit = config.units.unit("force")
    pairs = [
        f"{label} {number(closure['before'].get(key))} before, {number(closure['after'].get(key))} {unit} after"
        for key, label in ERRORS
    ]
    floor = closure.get("noise_floor_N")
    alt = f"Rms errors: {'; '.join(pairs)}; noise floor {f'{number(floor)} {unit}' if known(floor) else 'unknown'}."
    panels = [Panel("Errors and the noise floor", alt, lambda ax: draw_errors(ax, closure, config.units), left=0.86)]
    before, after = tables["residuals_before"], tables["residuals_after"]
    if len(before) and len(after):
        held = before["heldout_residual_N"].notna().any() and after["heldout_residual_N"].notna().any()
        column = "heldout_residual_N" if held else "residual_N"
        a, b = run_means(before, column).to_numpy(), run_means(after, column).to_numpy()
        if len(a) >= 4 and len(b) >= 4:
            alt = f"Errors of {len(a)} run means: standard deviation {number(float(np.std(a)))} before, "
            alt += f"{number(float(np.std(b)))} {unit} after."
            panels.append(
                Panel("Errors of the run means", alt, lambda ax: draw_histogram(ax, a, b, config.units, bool(held)))
            )
    same = closure["before"] == closure["after"]
    legend = (
        [Key("declared model", BEFORE, "bar")] if same else [Key("before", BEFORE, "bar"), Key("after", AFTER, "bar")]
    )
    if known(floor):
        legend.append(Key("noise floor", FLOOR, "dashed"))
    return Plot("before_after", "Errors before and after", tuple(panels), tuple(legend))


# ---------------------------------------------------------------- residual by level
def draw_levels(ax: Axes, levels: pd.DataFrame, units: Units) -> None:
    """Draw the variance of the residual at every level, before and after; beside each bar its standard deviation."""
    whole = levels[levels["channel"].isna()]
    names = [name for name in LEVELS if name in set(whole["level"])]
    names += [name for name in dict.fromkeys(whole["level"]) if name not in LEVELS]
    bars = [(stage, name) for name in names for stage in ("before", "after")]
    sd = {(row.stage, row.level): row.sd_N for row in whole.itertuples()}
    found = [sd.get(bar) for bar in bars]
    texts = dict(zip(bars, together(found), strict=True))
    largest = max([value**2 for value in found if known(value)], default=1.0) or 1.0
    single = not any(stage == "after" for stage in whole["stage"])
    for k, name in enumerate(reversed(names)):
        for stage, colour, shift in (("before", BEFORE, 0.19), ("after", AFTER, -0.19)):
            value = sd.get((stage, name))
            if not known(value):
                continue
            y = k if single else k + shift
            ax.barh(y, value**2, 0.34, color=colour, linewidth=0)
            ax.annotate(texts[stage, name], (value**2, y), (4, 0), textcoords="offset points", va="center", size=7.5)
    unit = plain(units.unit("force"))
    ax.set_yticks(range(len(names)), list(reversed(names)))
    ax.set_ylim(-0.6, len(names) - 0.4)
    ax.set_xlim(0.0, 1.2 * largest)
    ax.grid(axis="y", visible=False)
    ax.set_xlabel(f"variance (({unit})²)" if " " in unit else f"variance ({unit}²)")


def variance_levels(tables: Mapping[str, pd.DataFrame], config: Config) -> Plot | None:
    """Return the residual's variance by level, or None if the loop was not run."""
    levels = tables["levels"]
    whole = levels[levels["channel"].isna() & levels["sd_N"].notna()]
    if whole.empty:
        return None
    unit = config.units.unit("force")
    parts = [f"{row.level} {row.stage} {number(row.sd_N)} {unit}" for row in whole.itertuples()]
    alt = f"Standard deviation of the residual by level: {', '.join(parts)}."
    height = 0.82 + 0.42 * whole["level"].nunique()
    title = f"Variance by level, and its root in {unit}"
    panel = Panel(title, alt, lambda ax: draw_levels(ax, levels, config.units), height=max(height, 1.6), left=0.86)
    legend = (Key("before", BEFORE, "bar"), Key("after", AFTER, "bar"))
    return Plot("variance_levels", "Where the residual's variance sits", (panel,), legend)
