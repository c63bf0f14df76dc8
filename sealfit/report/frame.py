"""The grid, ticks and labels of a pair of axes in a few strokes: matplotlib makes five artists of every tick."""

from __future__ import annotations

from dataclasses import dataclass

import matplotlib as mpl
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.backend_bases import RendererBase
from matplotlib.cbook import is_math_text
from matplotlib.font_manager import FontProperties
from matplotlib.path import Path
from matplotlib.transforms import Bbox, IdentityTransform

TICK, MINOR = 3.5, 2.0  # points
PAD, LABEL_PAD = 3.5, 4.0  # points from a tick to its label, and from there to the axis's label
ASCENT, DESCENT = 0.76, 0.24  # of the letters of DejaVu Sans, in its size


@dataclass(frozen=True)
class Ticks:
    """What stands along an axis, 0 for x and 1 for y: places in pixels, labels, and whether there is a grid."""

    along: int
    places: np.ndarray
    minor: np.ndarray
    labels: list[str]
    title: str
    grid: bool

    @classmethod
    def of(cls, axis: Axis, along: int) -> Ticks:
        """Return what an axis was told to show; a power of ten that its labels lack is put behind its title."""
        formatter, values = axis.get_major_formatter(), axis.get_majorticklocs()
        labels = formatter.format_ticks(values)
        places, inside = _places(axis, values, along)
        minor, minor_inside = _places(axis, axis.get_minorticklocs(), along)
        labels = [label for label, shown in zip(labels, inside, strict=True) if shown]
        title = "   ".join([text for text in (axis.get_label_text(), formatter.get_offset()) if text])
        return cls(along, places[inside], minor[minor_inside], labels, title, bool(axis.get_tick_params()["gridOn"]))

    def strokes(self, box: Bbox, length: float | None = None, *, minor: bool = False) -> np.ndarray:
        """Return the ends, shape (n, 2, 2), of a stroke at every tick: across the whole box, or outwards."""
        places = self.minor if minor else self.places
        across, ends = 1 - self.along, np.empty((len(places), 2, 2))
        ends[:, :, self.along] = places[:, None]
        ends[:, :, across] = (box.min[across], box.max[across] if length is None else box.min[across] - length)
        return ends


class Frame(Artist):
    """Draws what both axes of `ax` were told (locators, formatters, labels, a grid or none) in place of their artists.

    Below all else that stands in the axes; the rest is as the current look has it.
    """

    zorder = 0.5

    def __init__(self, ax: Axes):
        super().__init__()
        self._ax = ax
        ax.xaxis.set_visible(False)
        ax.yaxis.set_visible(False)

    def draw(self, renderer: RendererBase) -> None:
        """Draw grid, ticks, their labels and the titles of both axes."""
        box, pixel = self._ax.bbox, renderer.points_to_pixels(1.0)
        both = [Ticks.of(axis, along) for along, axis in enumerate((self._ax.xaxis, self._ax.yaxis))]
        _stroke(renderer, [ticks.strokes(box) for ticks in both if ticks.grid], "grid.color", "grid.linewidth")
        ends = [ticks.strokes(box, TICK * pixel) for ticks in both]
        _stroke(renderer, ends, "xtick.color", "xtick.major.width")
        ends = [ticks.strokes(box, MINOR * pixel, minor=True) for ticks in both]
        _stroke(renderer, ends, "xtick.color", "xtick.minor.width")

        x, y = both
        small, size = Words("xtick", renderer), Words("axes", renderer)
        line = box.y0 - (TICK + PAD + ASCENT * small.points) * pixel
        for place, label in zip(x.places, x.labels, strict=True):
            small.write(label, place - small.width(label) / 2, line)
        line -= (DESCENT * small.points + LABEL_PAD + ASCENT * size.points) * pixel
        size.write(x.title, (box.x0 + box.x1 - size.width(x.title)) / 2, line)
        right = box.x0 - (TICK + PAD) * pixel
        for place, label in zip(y.places, y.labels, strict=True):
            small.write(label, right - small.width(label), place - ASCENT / 2 * small.points * pixel)
        left = right - max([small.width(label) for label in y.labels], default=0.0)
        left -= (LABEL_PAD + DESCENT * size.points) * pixel
        size.write(y.title, left, (box.y0 + box.y1 - size.width(y.title)) / 2, angle=90)


class Words:
    """Writes in the size and colour that the current look has for labels of "xtick" or "axes"."""

    def __init__(self, of: str, renderer: RendererBase):
        self._font = FontProperties(size=mpl.rcParams[f"{of}.labelsize"])
        self.points = self._font.get_size_in_points()  # the setting may be a word, as "medium"
        self._renderer, self._gc = renderer, renderer.new_gc()
        colour = mpl.rcParams[f"{of}.labelcolor"]
        self._gc.set_foreground(mpl.rcParams[f"{of}.color"] if colour == "inherit" else colour)

    def width(self, text: str) -> float:
        """Return the width of a text in pixels."""
        text, formula = _read(text)
        return self._renderer.get_text_width_height_descent(text, self._font, formula)[0] if text else 0.0

    def write(self, text: str, x: float, y: float, angle: float = 0.0) -> None:
        """Write a text from a place, in pixels from the lower left, along its baseline."""
        text, formula = _read(text)
        if text:
            height = self._renderer.get_canvas_width_height()[1]
            self._renderer.draw_text(self._gc, x, height - y, text, self._font, angle, formula)


def _read(text: str) -> tuple[str, bool]:
    """Return a label as it is drawn, in one line, and whether it is a formula."""
    formula = bool(is_math_text(text))
    return (text if formula else text.replace(r"\$", "$")).replace("\n", " "), formula


def _places(axis: Axis, values: np.ndarray, along: int) -> tuple[np.ndarray, np.ndarray]:
    """Return where values stand along an axis, in pixels, and whether each of them is within its ends."""
    ax = axis.axes
    points = np.zeros((len(values), 2))
    points[:, along] = values
    places = (ax.get_yaxis_transform() if along else ax.get_xaxis_transform()).transform(points)[:, along]
    return places, (places > ax.bbox.min[along] - 0.01) & (places < ax.bbox.max[along] + 0.01)


def _stroke(renderer: RendererBase, ends: list[np.ndarray], colour: str, width: str) -> None:
    vertices = np.concatenate([*ends, np.empty((0, 2, 2))]).reshape(-1, 2)
    if len(vertices):
        gc = renderer.new_gc()
        gc.set_foreground(mpl.rcParams[colour])
        gc.set_linewidth(mpl.rcParams[width])
        codes = np.tile([Path.MOVETO, Path.LINETO], len(vertices) // 2)
        renderer.draw_path(gc, Path(vertices, codes), IdentityTransform())
