"""Plots: selection of panels, axes, style and layout, and the files SVG, PNG and PDF."""

import io
import math
import re
import warnings
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from typing import Literal, TypeVar
from xml.sax.saxutils import escape, quoteattr

import matplotlib as mpl
import matplotlib.style
import numpy as np
import pandas as pd
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import AutoLocator, FuncFormatter, LogLocator, MaxNLocator, NullFormatter, NullLocator
from numpy.typing import ArrayLike

from sealfit.report.notation import count, plain, short, symbol_math

# ---------------------------------------------------------------- what is shown of a large campaign

MOST_PANELS = 12  # of a figure
MOST_KEYS = 16  # of a legend
LONGEST_KEY, LONGEST_TITLE = 60, 40  # letters of an entry of a legend, and of the title of a panel
MOST_MARKS = 300  # of a panel, until they are drawn as pixels: more makes an SVG large and shows nothing
MOST_ROWS = 200  # conditions or series of a table

Thing = TypeVar("Thing")
Tables = Mapping[str, pd.DataFrame]  # those of the report, by name


def spread(things: Sequence[Thing], most: int) -> list[Thing]:
    """Return at most `most` of `things`, selected evenly from the first to the last.

    >>> spread("abcdefghi", 3), spread("ab", 3)
    (['a', 'e', 'i'], ['a', 'b'])
    """
    return [things[k] for k in evenly(len(things), min(most, len(things)))]


def panels_of(things: Sequence[Thing], what: str) -> tuple[list[Thing], str]:
    """Return the things to draw, a panel each, and a note on the selection; `what` is their plural."""
    text = f"{MOST_PANELS} of {count(len(things), what, what)} are drawn, selected evenly."
    return spread(things, MOST_PANELS), text if len(things) > MOST_PANELS else ""


# ---------------------------------------------------------------- axes

MOST_TICKS = 8  # names of categories that fit below a panel
MOST_VALUES = 6  # values of four digits that fit there
TICK_APART = 0.11  # of the axis: closer ticks would write over each other


def is_logarithmic(x: np.ndarray, span: float) -> bool:
    """Return whether values span more than a factor and are more even on a logarithmic than a linear axis."""
    x = np.unique(x[np.isfinite(x)])
    if len(x) < 3 or x[0] <= 0 or x[-1] / x[0] <= span:
        return False
    gap, log_gap = np.diff(x).max() / np.ptp(x), np.diff(np.log(x)).max() / np.ptp(np.log(x))
    return bool(log_gap < 1.5 * gap)  # speeds and times are usually chosen by factors


def value_ticks(ax: Axes, x: np.ndarray) -> None:
    """Put the ticks at the values if these are few and far enough apart, else at round numbers."""
    x = np.unique(x)
    if 1 < len(x) <= MOST_VALUES and np.diff(x).min() > TICK_APART * np.ptp(x):
        ax.set_xticks(x, [f"{value:.4g}".replace("-", "−") for value in x])
    else:
        ax.xaxis.set_major_locator(round_ticks(integer=bool(np.array_equal(x, np.round(x)))))


def round_ticks(*, integer: bool = False) -> MaxNLocator:
    """Return a locator of round numbers, few enough for their labels to stand side by side."""
    return MaxNLocator(5, steps=[1, 2, 5, 10], integer=integer)


def log_axis(ax: Axes) -> None:
    """Make the x axis logarithmic, with ticks at 1, 2 and 5 written as plain numbers."""
    ax.set_xscale("log")
    low, high = ax.get_xlim()
    subs = (1.0, 2.0, 5.0) if np.log10(high / low) < 2.8 else (1.0,)
    ax.xaxis.set_major_locator(LogLocator(subs=subs, numticks=20))
    ax.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    ax.xaxis.set_minor_locator(NullLocator() if len(subs) > 1 else LogLocator(subs=(2.0, 5.0), numticks=40))
    ax.xaxis.set_minor_formatter(NullFormatter())


def category_ticks(ax: Axes, labels: Sequence[str]) -> None:
    """Name categories below the axis, each that fits; cut long names, skip evenly where there are many."""
    every = int(np.ceil(len(labels) / MOST_TICKS))
    shown = list(range(0, len(labels), every))
    room = max(4, int(42 / max(len(shown), 1)))
    ax.set_xticks(shown, [plain(short(labels[k], room)) for k in shown])
    ax.set_xlim(-0.6, len(labels) - 0.4)
    ax.grid(axis="x", visible=False)


def draw_band(ax: Axes, x: ArrayLike, lo: ArrayLike, hi: ArrayLike, colour: str, alpha: float = 0.2) -> None:
    """Shade what lies between `lo` and `hi`, without an outline."""
    ax.fill_between(x, lo, hi, color=colour, alpha=alpha, linewidth=0)


def padded(low: float, high: float) -> tuple[float, float]:
    """Return the ends of a scale that holds both values with a little room."""
    room = 0.06 * (high - low) or 0.05 * abs(high) or 1.0
    return float(low - room), float(high + room)


def evenly(count: int, wanted: int) -> list[int]:
    """Return `wanted` places of `count`, spread evenly from first to last; some twice if there are fewer."""
    return [round(k * (count - 1) / max(wanted - 1, 1)) for k in range(wanted)]


# ---------------------------------------------------------------- style

# Okabe & Ito, Color Universal Design (2008): distinguishable with all common kinds of colour vision.
# Yellow is left out: it is too light for lines on white.
BLUE, VERMILION, GREEN, PURPLE, ORANGE, SKY, BLACK = (
    "#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#222222",
)  # fmt: skip
CYCLE = (BLUE, VERMILION, GREEN, PURPLE, ORANGE, SKY, BLACK)
BEFORE, AFTER, FLOOR, QUIET = VERMILION, BLUE, "#5f6670", "#8a9099"

WIDTH, HEIGHT = 3.5, 2.6  # inches of a panel: three side by side are as wide as the page
ROW = 3  # panels side by side
DPI = 150  # of a figure on a screen


@dataclass(frozen=True)
class Key:
    """One entry of a legend: a label, or a parameter's symbol."""

    label: str
    colour: str
    mark: Literal["line", "dotted", "dashed", "band", "point", "open", "left", "bar"] = "line"
    symbol: bool = False  # the label is a parameter's name, shown as its symbol


@dataclass(frozen=True)
class Panel:
    """One pair of axes, with a text alternative; `limits` are set before `draw`, as by `Axes.set`."""

    title: str
    alt: str
    draw: Callable[[Axes], None]
    limits: Mapping[str, tuple[float, float]] = field(default_factory=dict)


@dataclass(frozen=True)
class Plot:
    """Panels with one legend, and a note on the selection in a large campaign."""

    name: str
    title: str
    panels: tuple[Panel, ...]
    legend: tuple[Key, ...] = ()
    note: str = ""
    height: float = HEIGHT  # inches of a panel


def look() -> AbstractContextManager:
    """Draw in the report's style, independent of a matplotlibrc; the caller's settings are restored."""
    return mpl.style.context("sealfit.report.plots", after_reset=True)


def shades(n: int) -> list[str]:
    """Return `n` colours from dark to light (viridis without its pale end)."""
    scale = mpl.colormaps["viridis"]
    return [to_hex(scale(0.82 * k / max(n - 1, 1))) for k in range(n)]


def compose(plot: Plot, kind: type[Figure] = Figure) -> Figure:
    """Return the panels of a plot in one figure of a `kind`, below its title and legend."""
    columns = min(len(plot.panels), ROW)
    rows = math.ceil(len(plot.panels) / columns)
    # inches; columns of a legend are as wide as their widest entry
    widest = max((min(len(key.label), LONGEST_KEY) for key in plot.legend), default=0) * 0.062 + 0.5
    entries = max(1, int(columns * WIDTH // widest))
    head = 0.25 + 0.19 * math.ceil(len(plot.legend) / entries)
    with look():
        size = (columns * WIDTH, rows * plot.height + head)
        figure = kind(figsize=size, dpi=DPI, layout="constrained")
        axes = figure.subplots(rows, columns, squeeze=False).flat
        for panel in plot.panels:
            _draw(panel, next(axes))
        for ax in axes:
            ax.remove()
        legend = figure.legend(
            handles=[_handle(key) for key in plot.legend],
            loc="outside upper left",
            title=plain(plot.title),
            title_fontproperties={"weight": "bold", "size": 10},
            ncols=entries,
            handlelength=1.8,
            columnspacing=1.4,
            labelspacing=0.35,
            fontsize=8,
        )
        legend.set_alignment("left")
        return figure


def _draw(panel: Panel, ax: Axes) -> None:
    ax.set(**panel.limits)
    panel.draw(ax)
    if ax.get_xscale() == "linear" and isinstance(ax.xaxis.get_major_locator(), AutoLocator):
        ax.xaxis.set_major_locator(round_ticks())
    ax.set_title(plain(short(panel.title, LONGEST_TITLE)))


def _handle(key: Key) -> Line2D | Patch:
    label = symbol_math(key.label) if key.symbol else plain(short(key.label, LONGEST_KEY))
    if not key.symbol and key.label[:1] == "_":  # matplotlib leaves out labels that begin with an underscore
        label = label.replace("_", " ", 1)
    if key.mark in ("band", "bar"):
        return Patch(color=key.colour, alpha=0.25 if key.mark == "band" else 1.0, label=label, linewidth=0)
    drawn = Line2D([], [], color=key.colour, label=label)
    if key.mark in ("point", "open", "left"):
        face = "white" if key.mark == "open" else key.colour
        drawn.set(linestyle="", marker="<" if key.mark == "left" else "o", markerfacecolor=face)
    else:
        drawn.set_linestyle({"line": "-", "dotted": ":", "dashed": "--"}[key.mark])
    return drawn


# ---------------------------------------------------------------- files

PRINT = 300  # pixels of a PNG file in an inch
NEAR = 8.0  # points: size of the place around a marker at which its text is shown


def draw(plot: Plot) -> dict[str, str | bytes]:
    """Return a plot as "png", "pdf" and "svg"; equal plots give equal bytes."""
    figure = compose(plot)
    png = saved(figure, "png", {"Software": None}, dpi=PRINT)
    with look():
        figure.set_layout_engine(None)  # it has been laid out, which takes as long as drawing it
    pdf = saved(figure, "pdf", {"CreationDate": None, "Creator": None, "Producer": None})
    return {"png": png, "pdf": pdf, "svg": _svg(figure)}


def explain(points: Line2D, texts: Sequence[str]) -> None:
    """Give each point of a line of markers, all finite, a text, which a browser shows under the pointer."""
    x, y = points.get_data()
    (over,) = points.axes.plot(x, y, "o", markersize=NEAR, alpha=0.0, zorder=9)
    over.explained = tuple(texts)  # an attribute that `_svg` looks for


def inline(svg: str, name: str, alt: str) -> Markup:
    """Return a drawing as an element of the page, its ids preceded by a name, with a text alternative."""
    svg = svg[svg.index("<svg") :]
    svg = re.sub(r"<style.*?</style>", "", svg, flags=re.DOTALL)  # it would hold for the whole page
    svg = re.sub(r'( id="|xlink:href="#|url\(#)', rf"\1{name}-", svg)
    return Markup(svg.replace("<svg", f'<svg role="img" aria-label={quoteattr(alt)}', 1))


def _svg(figure: Figure) -> str:
    explained = [line for ax in figure.axes for line in ax.lines if hasattr(line, "explained")]
    for number, artist in enumerate(explained):
        artist.set_gid(f"points{number}")
    svg = saved(figure, "svg", {"Date": None, "Creator": None, "Format": None, "Type": None}).decode()
    for artist in explained:
        svg = _with_titles(svg, artist.get_gid(), artist.explained)
    return svg


def _with_titles(svg: str, name: str, texts: Sequence[str]) -> str:
    """Return SVG with a title in each marker of a group; as it is where markers and texts do not match."""
    start = max(svg.find(f'<g id="{name}">'), 0)
    end = svg.find('<g id="', start + 1)
    group = svg[start:end]
    if len(re.findall(r"<use [^>]*/>", group)) != len(texts):
        return svg
    titles = iter(texts)
    group = re.sub(
        r"<use ([^>]*)/>", lambda use: f"<use {use[1]}><title>{escape(next(titles))}</title></use>", group
    )
    return svg[:start] + group + svg[end:]


def saved(figure: Figure, form: str, metadata: dict | None = None, **options) -> bytes:
    """Return a figure as a file of a format, drawn in the report's style."""
    buffer = io.BytesIO()
    with look(), warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Glyph .* missing from font")  # the SVG has it as text
        figure.savefig(buffer, format=form, metadata=metadata, **options)
    return buffer.getvalue()
