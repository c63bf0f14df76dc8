"""A plot drawn once: SVG and PNG for its files, and each panel cut out of the SVG for the page."""

from __future__ import annotations

import io
import re
import warnings
from base64 import b64encode
from dataclasses import dataclass

import matplotlib as mpl
from matplotlib.figure import Figure

from sealfit.report.style import DPI, WIDTH, Layout, Plot, compose, look

PT = 72.0  # points an inch: the unit of an SVG
_DEFINED = re.compile(r'<(?:path id="([^"]+)"[^>]*/>|clipPath id="([^"]+)">.*?</clipPath>)', re.S)
_USED = re.compile(r'(?:href="#|url\(#)([^")]+)')
_GEOMETRY = re.compile(r' (?:d|x|y|transform)="[^"]*"')
_LONG = re.compile(r"([1-9]\d*\.\d\d)\d+")  # a hundredth of a point is seen by nobody


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
    """Return an SVG that draws the same in fewer letters."""
    text = re.sub(r"<!--.*?-->", "", text, flags=re.S)
    text = re.sub(r'<g id="[^"]*"', "<g", re.sub(r">\s+<", "><", text))
    return _GEOMETRY.sub(lambda found: _LONG.sub(r"\1", " ".join(found[0].split()).join((" ", ""))), text)


def data_uri(text: str) -> str:
    """Return SVG as an address that holds it, so that the page asks for nothing."""
    return "data:image/svg+xml;base64," + b64encode(text.encode()).decode()
