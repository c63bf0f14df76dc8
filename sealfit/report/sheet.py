"""A sheet that is drawn on once and gives pixels and SVG; the parts of the SVG can stand alone."""

from __future__ import annotations

import io
import warnings
from base64 import b64encode
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from html import escape

import numpy as np
from matplotlib.artist import Artist
from matplotlib.backend_bases import GraphicsContextBase, RendererBase
from matplotlib.backends.backend_agg import RendererAgg
from matplotlib.colors import to_hex
from matplotlib.font_manager import FontProperties
from matplotlib.image import imsave
from matplotlib.path import Path
from matplotlib.textpath import TextToPath
from matplotlib.transforms import Affine2D, Bbox, IdentityTransform, Transform

PT = 72.0  # points an inch
FINE = 10  # units of the SVG in a pixel of the PNG: whole numbers are short, and a unit is seen by nobody
LETTERS = {Path.MOVETO: "M", Path.LINETO: "L", Path.CURVE3: "Q", Path.CURVE4: "C"}
FINE_LETTERS = 4  # units of an outline in a hundredth of its size
FAST = 3  # compression of a PNG: slower is hardly smaller
WRITER = TextToPath()


@dataclass
class Part:
    """A piece of the SVG: its elements, and the names of the shapes and clips that they use."""

    elements: list[str] = field(default_factory=list)
    used: dict[str, None] = field(default_factory=dict)


@dataclass(frozen=True)
class Outline:
    """A text of size 100 as an outline."""

    path: Path
    data: str  # the same in the letters of an SVG
    size: tuple[float, float, float]  # width, height, and how far below its line it reaches
    lacks: bool  # a letter that the font does not have


class Sheet(RendererBase):
    """What artists draw on: every stroke goes into the pixels and into the current part of the SVG.

    Parameters
    ----------
    width, height : int
        In pixels.
    dpi : float
        Pixels an inch.

    Notes
    -----
    Knows what the report draws: lines, areas, markers and texts of one family, clipped to rectangles.
    """

    def __init__(self, width: int, height: int, dpi: float):
        super().__init__()
        self.width, self.height, self.dpi = width, height, dpi
        self._canvases = [RendererAgg(width, height, dpi)]
        self._parts = [Part()]  # drawn on is the last
        self._defined: dict[str, str] = {}  # what a shape or clip is: its name

    # ---------------------------------------------------------------- what comes out
    def part(self, artists: Iterable[Artist]) -> Part:
        """Draw some artists, and return them as a part of the SVG."""
        self._parts = [Part()]
        for artist in artists:
            artist.draw(self)
        return self._parts[-1]

    def png(self) -> bytes:
        """Return everything drawn as a PNG."""
        return _png(np.asarray(self._canvases[0].buffer_rgba()), self.dpi)

    def svg(self, parts: Sequence[Part], box: Bbox | None = None) -> str:
        """Return some parts as an SVG on white: the whole sheet, or what lies in `box`, in pixels from the top left."""
        box = box or Bbox.from_bounds(0, 0, self.width, self.height)
        used = dict.fromkeys(name for part in parts for name in part.used)
        shapes = {name: shape for shape, name in self._defined.items()}
        x, y, width, height = (round(FINE * value) for value in box.bounds)
        inches = self.dpi * FINE
        return (
            '<svg xmlns="http://www.w3.org/2000/svg" xmlns:xlink="http://www.w3.org/1999/xlink" '
            f'width="{PT * width / inches:g}pt" height="{PT * height / inches:g}pt" '
            f'viewBox="{x} {y} {width} {height}"><defs>{"".join(shapes[name].format(name) for name in used)}</defs>'
            f'<path d="M{x} {y}h{width}v{height}h-{width}z" fill="#fff"/><g fill="none" stroke-linejoin="round">'
            f"{''.join(element for part in parts for element in part.elements)}</g></svg>\n"
        )

    # ---------------------------------------------------------------- what artists ask for
    def get_canvas_width_height(self) -> tuple[float, float]:
        """Return the size in pixels."""
        return self.width, self.height

    def points_to_pixels(self, points: float) -> float:
        """Return a length in pixels."""
        return points * self.dpi / PT

    def get_text_width_height_descent(self, s, prop, ismath):
        """Return the size of a text in pixels."""
        scale = self.points_to_pixels(prop.get_size_in_points()) / TextToPath.FONT_SCALE
        return tuple(scale * length for length in written(s, prop.get_weight(), bool(ismath)).size)

    def draw_path(self, gc, path, transform, rgbFace=None):
        """Draw a line or an area."""
        for canvas in self._canvases:
            canvas.draw_path(gc, path, transform, rgbFace)
        if data := self._data(path, transform):
            self._put(f'<path d="{data}"{_ink(gc, rgbFace, self.dpi)}{self._clip(gc)}/>')

    def draw_markers(self, gc, marker_path, marker_trans, path, trans, rgbFace=None):
        """Draw a marker at every vertex of a path."""
        for canvas in self._canvases:
            canvas.draw_markers(gc, marker_path, marker_trans, path, trans, rgbFace)
        places = trans.transform(path.vertices)
        places = self._units(places[np.isfinite(places).all(axis=1)])
        ink, clip = _ink(gc, rgbFace, self.dpi), self._clip(gc)
        if len(places) == 1:  # an area comes so, too
            data = _letters(marker_path, marker_trans, (FINE, -FINE), places[0])
            self._put(f'<path d="{data}"{ink}{clip}/>')
        elif len(places):
            outline = _letters(marker_path, marker_trans, (FINE, -FINE))
            name = self._name("m", f'<path id="{{}}" d="{outline}"/>')
            uses = "".join([f'<use xlink:href="#{name}" x="{x}" y="{y}"/>' for x, y in places.tolist()])
            self._put(f"<g{ink}{clip}>{uses}</g>")

    def draw_text(self, gc, x, y, s, prop, angle, ismath=False, mtext=None):
        """Draw a text as an outline, or in the SVG as text where the font lacks a letter of it."""
        outline = written(s, prop.get_weight(), bool(ismath))
        scale = self.points_to_pixels(prop.get_size_in_points()) / TextToPath.FONT_SCALE
        colour = gc.get_rgb()
        gc.set_linewidth(0.0)
        transform = Affine2D().scale(scale).rotate_deg(angle).translate(x, self.height - y)
        for canvas in self._canvases:
            canvas.draw_path(gc, outline.path, transform, colour)
        turned = f"rotate({-angle:g})" if angle else ""
        place = f'transform="translate({round(FINE * x)} {round(FINE * y)}){turned}'
        if outline.lacks:
            size = self.points_to_pixels(prop.get_size_in_points()) * FINE
            look = f'font-family="sans-serif" font-size="{size:.0f}" font-weight="{prop.get_weight()}"'
            self._put(f'<text {place}" {look}{_ink(gc, colour, self.dpi)}>{escape(s)}</text>')
        else:
            size = f"scale({FINE * scale / FINE_LETTERS:.4g})"
            self._put(f'<path {place}{size}" d="{outline.data}"{_ink(gc, colour, self.dpi)}/>')

    def start_rasterizing(self):
        """Keep what is drawn from now on as pixels in the SVG, too."""
        self._canvases.append(RendererAgg(self.width, self.height, self.dpi))
        self._parts.append(Part())

    def stop_rasterizing(self):
        """Put the pixels into the SVG."""
        pixels = np.asarray(self._canvases.pop().buffer_rgba())
        self._parts.pop()
        rows, columns = (np.flatnonzero(pixels[..., 3].any(axis=axis)) for axis in (1, 0))
        if not len(rows):
            return
        top, left = rows[0], columns[0]
        pixels = pixels[top : rows[-1] + 1, left : columns[-1] + 1]
        place = f'x="{FINE * left}" y="{FINE * top}" width="{FINE * pixels.shape[1]}" height="{FINE * pixels.shape[0]}"'
        self._put(f'<image {place} xlink:href="data:image/png;base64,{b64encode(_png(pixels, self.dpi)).decode()}"/>')

    # ---------------------------------------------------------------- how it is written
    def _put(self, element: str) -> None:
        self._parts[-1].elements.append(element)

    def _name(self, kind: str, shape: str) -> str:
        name = self._defined.setdefault(shape, f"{kind}{len(self._defined)}")
        self._parts[-1].used[name] = None
        return name

    def _clip(self, gc: GraphicsContextBase) -> str:
        box = gc.get_clip_rectangle()
        if box is None:
            return ""
        (left, bottom), (right, top) = self._units(box.get_points()).tolist()
        shape = f'<clipPath id="{{}}"><path d="M{left} {top}H{right}V{bottom}H{left}z"/></clipPath>'
        return f' clip-path="url(#{self._name("c", shape)})"'

    def _units(self, places: np.ndarray) -> np.ndarray:
        return np.rint(places * (FINE, -FINE) + (0, FINE * self.height)).astype(int)

    def _data(self, path: Path, transform: Transform) -> str:
        return _letters(path, transform, (FINE, -FINE), (0, FINE * self.height))


@lru_cache(maxsize=4000)  # the same few numbers stand at every axis
def written(text: str, weight: str | int, formula: bool) -> Outline:
    """Return a text as an outline, in the family of the current look."""
    font = FontProperties(weight=weight, size=TextToPath.FONT_SCALE)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        vertices, codes = WRITER.get_text_path(font, text, ismath=formula)
        size = WRITER.get_text_width_height_descent(text, font, formula)
    path = Path(np.reshape(vertices, (-1, 2)), np.array(codes, Path.code_type))
    lacks = any("missing from font" in str(warning.message) for warning in caught)
    return Outline(path, _letters(path, IdentityTransform(), (FINE_LETTERS, -FINE_LETTERS)), size, lacks)


def _letters(path: Path, transform: Transform, scale: tuple[float, float], origin: Sequence[float] = (0, 0)) -> str:
    """Return a path in the letters of an SVG, in whole units; gaps where it is not finite."""
    clean = path.cleaned(transform, remove_nans=True, simplify=None, curves=True)
    places, codes = np.rint(clean.vertices[:-1] * scale + origin).astype(int), clean.codes[:-1]  # the last is a stop
    curved = ((codes == Path.CURVE3) | (codes == Path.CURVE4)).any()
    return _curves(places, codes) if curved else _lines(places, codes)


def _lines(places: np.ndarray, codes: np.ndarray) -> str:
    """Return straight lines by the steps from each vertex to the next: these are short."""
    begins = np.flatnonzero(codes == Path.MOVETO)
    pieces = []
    for begin, end in zip(begins, np.append(begins, len(codes))[1:], strict=True):  # none of a path without places
        closed = bool(codes[end - 1] == Path.CLOSEPOLY)
        steps = np.diff(places[begin : end - closed], axis=0)
        steps = steps[steps.any(axis=1)]
        if len(steps):
            x, y = places[begin].tolist()
            numbers = " ".join(map(str, steps.ravel().tolist()))
            pieces.append(f"M{x} {y}l{numbers}{'z' if closed else ''}")
    return "".join(pieces).replace(" -", "-")


def _curves(places: np.ndarray, codes: np.ndarray) -> str:
    """Return lines and curves by their vertices."""
    pieces, before = [], None
    for code, (x, y) in zip(codes.tolist(), places.tolist(), strict=True):
        if code == Path.CLOSEPOLY:
            pieces.append("z")
        else:
            pieces.append(f"{LETTERS[code] if code != before or code == Path.MOVETO else ' '}{x} {y}")
        before = code
    return "".join(pieces).replace(" -", "-")


def _ink(gc: GraphicsContextBase, face, dpi: float) -> str:
    """Return the attributes of a stroke and of what it encloses."""
    text, forced = "", gc.get_forced_alpha()
    if face is not None:
        text += f' fill="{to_hex(face)}"'
        if len(face) > 3 and face[3] != 1.0 and not forced:
            text += f' fill-opacity="{face[3]:g}"'
    if forced and gc.get_alpha() != 1.0:
        text += f' opacity="{gc.get_alpha():g}"'
    if width := gc.get_linewidth():
        pixel = dpi / PT * FINE
        text += f' stroke="{to_hex(gc.get_rgb())}" stroke-width="{pixel * width:.3g}"'
        if gc.get_rgb()[3] != 1.0 and not forced:
            text += f' stroke-opacity="{gc.get_rgb()[3]:g}"'
        _, dashes = gc.get_dashes()
        if dashes is not None:
            text += f' stroke-dasharray="{" ".join(f"{pixel * length:.3g}" for length in dashes)}"'
        if (join := gc.get_joinstyle()) != "round":
            text += f' stroke-linejoin="{join}"'
        if (cap := gc.get_capstyle()) != "butt":
            text += f' stroke-linecap="{"square" if cap == "projecting" else cap}"'
    return text


def _png(pixels: np.ndarray, dpi: float) -> bytes:
    buffer = io.BytesIO()
    imsave(buffer, pixels, format="png", dpi=dpi, metadata={"Software": None}, pil_kwargs={"compress_level": FAST})
    return buffer.getvalue()
