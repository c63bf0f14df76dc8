"""Plots as SVG, PNG and PDF files; for the page each panel as SVG, texts of points and traces of runs."""

from __future__ import annotations

import io
import math
import re
import warnings
from base64 import b64encode
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from xml.sax.saxutils import escape

import numpy as np
import pandas as pd
from matplotlib.artist import Artist
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from sealfit.config import Config
from sealfit.report.notation import ConditionNames, given, plain
from sealfit.report.style import WIDTH, Plot, compose, look, panel_figure

CSS = 96
"""Pixels of a page in an inch."""
PRINT = 300
"""Pixels of a PNG file in an inch."""

MOST_BINS = 30_000
"""Bins of all runs that a page carries, about 1 MB; of more, every second, third ... is left."""

LARGEST_STEP = 5
"""Traces of which fewer than every fifth bin would be left are not in the page."""


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


def run_traces(tables: Mapping[str, pd.DataFrame], config: Config) -> dict:
    """Return the measured force and the model's along every run, which the page draws on a click.

    Parameters
    ----------
    tables : mapping of str to DataFrame
        Tables `residuals_after` and `residuals_before`; the model is that of the first that has rows.

    Returns
    -------
    dict
        Labels `x` and `y`, and `runs`: by run_id its label and its strokes with file, x, force and model.
        They have every `every`-th bin. Without runs where the loop was not run or there are too many bins.
    """
    units = config.units
    made = {"x": plain(units.label("displacement_mm")), "y": plain(units.label("force_N")), "runs": {}}
    rows = next((t for s in ("after", "before") if len(t := tables[f"residuals_{s}"])), pd.DataFrame())
    made["every"] = every = max(1, math.ceil(len(rows) / MOST_BINS))
    if rows.empty or every > LARGEST_STEP:
        return made
    names = ConditionNames.of(config)
    for run_id, run in rows[rows["bin"] % every == 0].groupby("run_id", sort=False):
        first = run.iloc[0]
        speed = f"{given(abs(run['speed_mm_s'].mean()), 3)} {units.unit('speed')}"
        strokes = [
            {
                "file": file,
                "x": _rounded(own["displacement_mm"]),
                "force": _rounded(own["force_N"]),
                "model": _rounded(own["model_N"]),
            }
            for (file, _), own in run.sort_values("bin").groupby(["file", "stroke"])
        ]
        label = f"{names(first['condition'])}, {speed}, run {run_id}"
        made["runs"][str(run_id)] = {"label": label, "strokes": strokes}
    return made


def _rounded(values: pd.Series) -> list[float | None]:
    return [float(f"{value:.5g}") if np.isfinite(value) else None for value in values]


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
