"""A plot drawn once: SVG and PNG for its files, and each panel cut out of the SVG for the page."""

from __future__ import annotations

import gc
from base64 import b64encode
from collections.abc import Mapping
from dataclasses import dataclass

from matplotlib.transforms import Bbox

from sealfit.report.sheet import Sheet
from sealfit.report.style import DPI, WIDTH, Layout, Plot, compose, look

CSS = 96  # pixels of a page in an inch


@dataclass(frozen=True)
class Image:
    """A panel as the page shows it: SVG, its size in CSS pixels."""

    svg: str
    width: int
    height: int


@dataclass(frozen=True)
class Drawn:
    """A plot as SVG, as PNG, and its panels."""

    svg: str
    png: bytes
    panels: tuple[Image, ...]


def draw_plots(plots: Mapping[str, Plot]) -> dict[str, Drawn]:
    """Return every plot, drawn.

    A figure is a web of artists that refer to each other, so memory is searched for rubbish again and again while one
    is made, a sixth of the time; the few figures of a report are let go together.
    """
    searched = gc.isenabled()
    gc.disable()
    try:
        return {name: draw(plot) for name, plot in plots.items()}
    finally:
        if searched:
            gc.enable()


def draw(plot: Plot) -> Drawn:
    """Return a plot, drawn; the same plot gives the same bytes."""
    layout, figure = Layout.of(plot), compose(plot)
    sheet = Sheet(int(DPI * layout.width), int(DPI * layout.height), DPI)  # a part of a pixel would be grey
    with look():
        heading = sheet.part([figure.patch, *figure.texts, *figure.legends])
        parts = [sheet.part([ax]) for ax in figure.axes]
    panels = []
    for panel, part, (left, bottom) in zip(plot.panels, parts, layout.corners, strict=True):
        width, height = DPI * WIDTH, DPI * panel.height
        svg = sheet.svg([part], Bbox.from_bounds(DPI * left, sheet.height - DPI * bottom - height, width, height))
        panels.append(Image(svg, round(CSS * WIDTH), round(CSS * panel.height)))
    return Drawn(sheet.svg([heading, *parts]), sheet.png(), tuple(panels))


def data_uri(text: str) -> str:
    """Return SVG as an address that holds it, so that the page asks for nothing."""
    return "data:image/svg+xml;base64," + b64encode(text.encode()).decode()
