"""Plots as SVG, PNG and PDF files, and each panel as an SVG for the page, with a text for every point."""

from __future__ import annotations

import io
import re
import warnings
from base64 import b64encode
from collections.abc import Sequence
from dataclasses import dataclass
from xml.sax.saxutils import escape

from matplotlib.artist import Artist
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from sealfit.report.style import WIDTH, Plot, compose, look, panel_figure

CSS = 96
"""Pixels of a page in an inch."""
PRINT = 300
"""Pixels of a PNG file in an inch."""


@dataclass(frozen=True)
class Image:
    """A panel as the page shows it: SVG, and its size in CSS pixels."""

    svg: str
    width: int
    height: int


@dataclass(frozen=True)
class Drawn:
    """A plot as SVG, as PNG and as PDF, and its panels."""

    svg: str
    png: bytes
    pdf: bytes
    panels: tuple[Image, ...]


def draw(plot: Plot) -> Drawn:
    """Return a plot, drawn; equal plots give equal bytes."""
    whole = compose(plot)
    panels = tuple(
        Image(_svg(panel_figure(panel)), round(CSS * WIDTH), round(CSS * panel.height))
        for panel in plot.panels
    )
    png = _saved(whole, "png", {"Software": None}, dpi=PRINT)
    pdf = _saved(whole, "pdf", {"CreationDate": None, "Creator": None, "Producer": None})
    return Drawn(_svg(whole), png, pdf, panels)


def data_uri(text: str) -> str:
    """Return SVG as a data URI."""
    return "data:image/svg+xml;base64," + b64encode(text.encode()).decode()


def explain(points: Line2D, texts: Sequence[str]) -> None:
    """Give each point of a line of markers a text, which the page shows under the pointer.

    Parameters
    ----------
    points : Line2D
        As `Axes.plot` or `Axes.errorbar` returned it, its values finite.
    texts : sequence of str
        A text for each point, in their order.
    """
    points.explained = tuple(texts)  # an attribute that `_svg` looks for


def _svg(figure: Figure) -> str:
    texts = {}
    for number, artist in enumerate(figure.findobj(_is_explained)):
        artist.set_gid(f"points{number}")
        texts[f"points{number}"] = artist.explained
    svg = _saved(figure, "svg", {"Date": None, "Creator": None}).decode()
    for name, own in texts.items():
        svg = _with_titles(svg, name, own)
    return svg


def _is_explained(artist: Artist) -> bool:
    return hasattr(artist, "explained")


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


def _saved(figure: Figure, form: str, metadata: dict, **options) -> bytes:
    buffer = io.BytesIO()
    with look(), warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Glyph .* missing from font")  # the SVG has it as text
        figure.savefig(buffer, format=form, metadata=metadata, **options)
    return buffer.getvalue()
