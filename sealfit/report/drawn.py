"""A plot drawn once: SVG and PNG for its files, and each panel cut out of the SVG for the page."""

from __future__ import annotations

import gc
import io
import re
import warnings
from base64 import b64encode
from collections.abc import Mapping
from dataclasses import dataclass

import matplotlib as mpl
from matplotlib.figure import Figure

from sealfit.report.style import DPI, WIDTH, Layout, Plot, compose, look

PT = 72.0  # points an inch: the unit of an SVG
_DEFINED = re.compile(r'<(?:path id="([^"]+)"[^>]*/>|clipPath id="([^"]+)">.*?</clipPath>)', re.S)
_USED = re.compile(r'(?:href="#|url\(#)([^")]+)')
_NAMED = re.compile(r'(?<=id=")[^"]+(?=")|(?<=href="#)[^"]+(?=")|(?<=url\(#)[^")]+(?=\))')
_BETWEEN = re.compile(r">\s+<")
_STYLED = re.compile(r' style="([^"]*)"')
_DIGITS = re.compile(r"(?:(?<=[1-9]\.\d\d)|(?<=\d\d\.\d\d))\d+")  # a hundredth of a point is seen by nobody


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
    figure = compose(plot)
    text = svg(figure)
    buffer = io.BytesIO()
    with look(), warnings.catch_warnings():
        warnings.filterwarnings("ignore", ".*missing from font")  # a box in its place
        figure.savefig(buffer, format="png", dpi=DPI, metadata={"Software": None})
    return Drawn(text, buffer.getvalue(), _panels(text, plot))


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


def _panels(text: str, plot: Plot) -> tuple[Image, ...]:
    """Cut the panels out of a plot's SVG, each with the glyphs, markers and clips it uses."""
    layout = Layout.of(plot)
    defined = {found[1] or found[2]: found[0] for found in _DEFINED.finditer(text)}
    style = text[text.index("<style") : text.index("</style>") + len("</style>")]
    images = []
    for k, (panel, (left, bottom)) in enumerate(zip(plot.panels, layout.corners, strict=True)):
        begin = text.index(f'  <g id="panel_{k}">')
        body = text[begin : text.index("\n  </g>\n", begin) + len("\n  </g>\n")]
        body = re.sub(r"<defs>.*?</defs>", "", body, flags=re.S)
        used = "".join(defined[name] for name in dict.fromkeys(_USED.findall(body)))
        x, y, width, height = left, layout.height - bottom - panel.height, WIDTH, panel.height
        box = " ".join(f"{PT * value:g}" for value in (x, y, width, height))
        images.append(
            Image(
                _short(
                    '<svg xmlns="http://www.w3.org/2000/svg" xmlns:xlink="http://www.w3.org/1999/xlink" '
                    f'width="{PT * width:g}pt" height="{PT * height:g}pt" viewBox="{box}">'
                    f'<defs>{style}{used}</defs><path d="M{PT * x:g} {PT * y:g}h{PT * width:g}v{PT * height:g}'
                    f'h{-PT * width:g}z" fill="#fff"/>{body}</svg>'
                ),
                round(96 * width),
                round(96 * height),
            )
        )
    return tuple(images)


def _short(text: str) -> str:
    """Return an SVG that draws the same in fewer letters: styles told once, short names, no digits nobody sees."""
    text = _BETWEEN.sub("><", re.sub(r"<!--.*?-->", "", text, flags=re.S))
    text = re.sub(r'<g id="[^"]*"', "<g", text)
    if "<text" not in text:  # all that is left are drawings
        text = _DIGITS.sub("", text.replace(" \n", ""))
        for command in "MLQC":
            text = text.replace(f"{command} ", command)
    names = {name: f"i{k:x}" for k, name in enumerate(dict.fromkeys(_NAMED.findall(text)))}
    text = _NAMED.sub(lambda found: names[found[0]], text)
    styles = {style: f"s{k:x}" for k, style in enumerate(dict.fromkeys(_STYLED.findall(text)))}
    text = _STYLED.sub(lambda found: f' class="{styles[found[1]]}"', text)
    rules = "".join(f".{name}{{{style}}}" for style, name in styles.items())
    return text.replace("</style>", f"{rules}</style>", 1)


def data_uri(text: str) -> str:
    """Return SVG as an address that holds it, so that the page asks for nothing."""
    return "data:image/svg+xml;base64," + b64encode(text.encode()).decode()
