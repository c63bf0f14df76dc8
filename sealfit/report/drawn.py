"""Plots as SVG and PNG for their files, and each panel as an SVG of its own for the page."""

from __future__ import annotations

import io
import warnings
from base64 import b64encode
from dataclasses import dataclass

from matplotlib.figure import Figure

from sealfit.report.style import WIDTH, Plot, compose, look, panel_figure

CSS = 96
"""Pixels of a page in an inch."""


@dataclass(frozen=True)
class Image:
    """A panel as the page shows it: SVG, and its size in CSS pixels."""

    svg: str
    width: int
    height: int


@dataclass(frozen=True)
class Drawn:
    """A plot as SVG, as PNG, and its panels."""

    svg: str
    png: bytes
    panels: tuple[Image, ...]


def draw(plot: Plot) -> Drawn:
    """Return a plot, drawn; the same plot gives the same bytes."""
    whole = compose(plot)
    panels = tuple(
        Image(_svg(panel_figure(panel)), round(CSS * WIDTH), round(CSS * panel.height)) for panel in plot.panels
    )
    return Drawn(_svg(whole), _saved(whole, "png", {"Software": None}), panels)


def data_uri(text: str) -> str:
    """Return SVG as an address that holds it, so that the page asks for nothing."""
    return "data:image/svg+xml;base64," + b64encode(text.encode()).decode()


def _svg(figure: Figure) -> str:
    return _saved(figure, "svg", {"Date": None, "Creator": None}).decode()


def _saved(figure: Figure, form: str, metadata: dict) -> bytes:
    buffer = io.BytesIO()
    with look(), warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Glyph .* missing from font")  # the SVG has it as text
        figure.savefig(buffer, format=form, metadata=metadata)
    return buffer.getvalue()
