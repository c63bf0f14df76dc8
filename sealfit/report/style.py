"""One look for every plot: colours, sizes, and how panels become a figure or an image in the page."""

from __future__ import annotations

import io
import math
import warnings
from base64 import b64encode
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
    "axes.formatter.use_mathtext": True,
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
    "svg.fonttype": "path",
    "svg.hashsalt": "sealfit",  # the same tables give the same bytes
    "text.parse_math": True,
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
    """Panels that belong together, with one legend."""

    name: str
    title: str
    panels: tuple[Panel, ...]
    legend: tuple[Key, ...] = ()


@contextmanager
def look() -> Iterator[None]:
    """Draw in the report's look; the caller's settings are as before afterwards."""
    with mpl.rc_context(RC):
        yield


def shades(n: int) -> list[str]:
    """Return `n` colours from dark to light, in an order that is seen without colour (viridis, its pale end cut)."""
    scale = mpl.colormaps["viridis"]
    return [to_hex(scale(0.82 * k / max(n - 1, 1))) for k in range(n)]


def panel_figure(panel: Panel) -> Figure:
    """Return a figure of one panel."""
    with look():
        figure = Figure(figsize=(WIDTH, panel.height), dpi=150)
        _place(figure, panel, 0.0, 0.0)
        return figure


def compose(plot: Plot) -> Figure:
    """Return all panels of a plot in one figure, with its title and legend."""
    columns = min(len(plot.panels), 4 if len(plot.panels) > 6 else 3)
    rows = math.ceil(len(plot.panels) / columns)
    heights = [max(p.height for p in plot.panels[r * columns : (r + 1) * columns]) for r in range(rows)]
    width = columns * WIDTH
    lines = _legend_lines(plot.legend, width)
    head = 0.32 + 0.19 * lines
    with look():
        figure = Figure(figsize=(width, sum(heights) + head + 0.04), dpi=150)
        total = figure.get_figheight()
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
        top = total - head
        for r in range(rows):
            for c, panel in enumerate(plot.panels[r * columns : (r + 1) * columns]):
                _place(figure, panel, c * WIDTH, top - sum(heights[:r]) - panel.height)
        return figure


def _place(figure: Figure, panel: Panel, left: float, bottom: float) -> None:
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


def svg(figure: Figure) -> str:
    """Return a figure as SVG; text as outlines, or as text where the plot's font lacks a letter of it."""
    for outlines in ("path", "none"):
        with look(), mpl.rc_context({"svg.fonttype": outlines}), warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            buffer = io.StringIO()
            figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None})
        if not any("missing from font" in str(warning.message) for warning in caught):
            break
    return buffer.getvalue()


def data_uri(text: str) -> str:
    """Return SVG as an address that holds it, so that the page asks for nothing."""
    return "data:image/svg+xml;base64," + b64encode(text.encode()).decode()
