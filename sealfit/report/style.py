"""One look for every plot: colours, sizes, and how panels become a figure."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Literal

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import AutoLocator

from sealfit.report.axes import round_ticks
from sealfit.report.symbols import plain, symbol_math

# Okabe & Ito, Color Universal Design (2008): told apart by all common kinds of colour vision. Yellow is left out: too
# light for lines on white.
BLUE, VERMILION, GREEN, PURPLE, ORANGE, SKY, BLACK = (
    "#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#222222",
)  # fmt: skip
CYCLE = (BLUE, VERMILION, GREEN, PURPLE, ORANGE, SKY, BLACK)
BEFORE, AFTER, FLOOR, QUIET = VERMILION, BLUE, "#5f6670", "#8a9099"

WIDTH = 3.55  # inches of one panel: 340 px of a page, so its text is as large as the page's small print
HEIGHT = 2.55
DPI = 150  # a half-page plot stays sharp in print
_EDGE, _BOTTOM, _TOP = 0.14, 0.5, 0.32  # inches around the axes

RC = {
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],
    "font.size": 8.5,
    "axes.titlesize": 8.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.titlepad": 6,
    "axes.labelsize": 8.5,
    "axes.labelcolor": "#333333",
    "axes.edgecolor": "#8a9099",
    "axes.linewidth": 0.7,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.formatter.limits": (-3, 5),
    "grid.color": "#e6e8eb",
    "grid.linewidth": 0.7,
    "xtick.labelsize": 8,
    "ytick.labelsize": 8,
    "xtick.color": "#8a9099",
    "ytick.color": "#8a9099",
    "xtick.labelcolor": "#333333",
    "ytick.labelcolor": "#333333",
    "xtick.major.width": 0.7,
    "ytick.major.width": 0.7,
    "xtick.minor.width": 0.5,
    "lines.linewidth": 1.4,
    "lines.markersize": 4,
    "legend.frameon": False,
    "text.parse_math": True,
    "svg.fonttype": "none",
    "svg.hashsalt": "sealfit",
}

Mark = Literal["line", "dotted", "dashed", "band", "point", "open", "left", "bar"]


@dataclass(frozen=True)
class Key:
    """One entry of a legend: a label as it stands, or a parameter's symbol."""

    label: str
    colour: str
    mark: Mark = "line"
    symbol: bool = False  # the label is a parameter's name, shown as its symbol


@dataclass(frozen=True)
class Panel:
    """One pair of axes: what is drawn on it, and the same in words for who cannot see it."""

    title: str
    alt: str
    draw: Callable[[Axes], None]
    height: float = HEIGHT  # inches
    left: float = 0.68  # inches left of the axes, for their tick labels
    effect: int | None = None  # row in the closure's effects that it belongs to


@dataclass(frozen=True)
class Plot:
    """Panels that belong together, with one legend; a note says what of a large campaign is left out."""

    name: str
    title: str
    panels: tuple[Panel, ...]
    legend: tuple[Key, ...] = ()
    note: str = ""


@contextmanager
def look() -> Iterator[None]:
    """Draw in the report's look, whatever a matplotlibrc says; the caller's settings are as before afterwards."""
    with mpl.rc_context():
        mpl.rcdefaults()
        mpl.rcParams.update(RC)
        yield


def shades(n: int) -> list[str]:
    """Return `n` colours from dark to light, in an order that is seen without colour (viridis, its pale end cut)."""
    scale = mpl.colormaps["viridis"]
    return [to_hex(scale(0.82 * k / max(n - 1, 1))) for k in range(n)]


def compose(plot: Plot) -> Figure:
    """Return all panels of a plot in one figure, up to four a row, below its title and its legend."""
    columns = min(len(plot.panels), 4 if len(plot.panels) > 6 else 3)
    rows = [plot.panels[k : k + columns] for k in range(0, len(plot.panels), columns)]
    heights = [max(panel.height for panel in row) for row in rows]
    width = columns * WIDTH
    lines = _legend_lines(plot.legend, width)
    total = sum(heights) + 0.36 + 0.19 * lines
    with look():
        figure = Figure(figsize=(width, total), dpi=DPI)
        figure.text(_EDGE / width, 1 - 0.1 / total, plot.title, va="top", weight="bold", size=10)
        if plot.legend:
            figure.legend(
                handles=[_handle(key) for key in plot.legend],
                loc="upper left",
                bbox_to_anchor=(_EDGE / width, 1 - 0.32 / total),
                ncols=math.ceil(len(plot.legend) / lines),
                handlelength=1.8,
                columnspacing=1.4,
                labelspacing=0.35,
                borderaxespad=0,
                borderpad=0,
                fontsize=8,
            )
        for r, row in enumerate(rows):
            for c, panel in enumerate(row):
                _place(figure, panel, c * WIDTH, sum(heights[r:]) + 0.04 - panel.height)
        return figure


def panel_figure(panel: Panel) -> Figure:
    """Return a figure of one panel, without title and legend."""
    with look():
        figure = Figure(figsize=(WIDTH, panel.height), dpi=DPI)
        _place(figure, panel, 0.0, 0.0)
        return figure


def _place(figure: Figure, panel: Panel, left: float, bottom: float) -> Axes:
    width, height = figure.get_figwidth(), figure.get_figheight()
    box = (
        (left + panel.left) / width,
        (bottom + _BOTTOM) / height,
        (WIDTH - panel.left - _EDGE) / width,
        (panel.height - _BOTTOM - _TOP) / height,
    )
    ax = figure.add_axes(box)
    panel.draw(ax)
    if ax.get_xscale() == "linear" and isinstance(ax.xaxis.get_major_locator(), AutoLocator):
        ax.xaxis.set_major_locator(round_ticks())
    if panel.title:
        ax.set_title(plain(panel.title), x=-(panel.left - _EDGE) / (WIDTH - panel.left - _EDGE))
    return ax


def _legend_lines(legend: Sequence[Key], width: float) -> int:
    if not legend:
        return 0
    widest = max(len(key.label) for key in legend) * 0.062 + 0.5  # inches; columns are as wide as their widest entry
    return math.ceil(len(legend) / max(1, int((width - 0.1) // widest)))


def _handle(key: Key) -> Line2D | Patch:
    # matplotlib leaves out labels that begin with an underscore
    label = (
        symbol_math(key.label)
        if key.symbol
        else plain(key.label).replace("_", " ", 1)
        if key.label[:1] == "_"
        else plain(key.label)
    )
    if key.mark in ("band", "bar"):
        return Patch(color=key.colour, alpha=0.25 if key.mark == "band" else 1.0, label=label, linewidth=0)
    if key.mark in ("point", "open", "left"):
        marker = {"point": "o", "open": "o", "left": "<"}[key.mark]
        face = "white" if key.mark == "open" else key.colour
        return Line2D([], [], color=key.colour, marker=marker, markerfacecolor=face, linestyle="", label=label)
    style = {"line": "-", "dotted": ":", "dashed": "--"}[key.mark]
    return Line2D([], [], color=key.colour, linestyle=style, label=label)
