"""Plots as SVG, PNG and PDF; for the page texts of points, and traces of runs."""

import io
import math
import re
import warnings
from collections.abc import Sequence
from xml.sax.saxutils import escape, quoteattr

import numpy as np
import pandas as pd
from markupsafe import Markup
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from sealfit.config import Config
from sealfit.report.notation import ConditionNames, given, plain
from sealfit.report.style import Plot, Tables, compose, look

PRINT = 300  # pixels of a PNG file in an inch
NEAR = 8.0  # points: size of the place around a marker at which its text is shown
MOST_BINS = 30_000  # of all runs that a page has, about 1 MB; of more, every second, third ... is left
LARGEST_STEP = 5  # traces of which fewer than every fifth bin would be left are not in the page


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


def run_traces(tables: Tables, config: Config) -> dict:
    """Return the measured force and the model's along every run, which the page draws on a click.

    Returned are labels `x` and `y`, and `runs`: by run_id its label and its strokes with file, x, force and
    model at every `every`-th bin. There are no runs of properties, or where there are too many bins.
    """
    units = config.units
    made = {"x": plain(units.label("displacement_mm")), "y": plain(units.label("force_N")), "runs": {}}
    rows = next((t for s in ("after", "before") if len(t := tables[f"residuals_{s}"])), pd.DataFrame())
    made["every"] = every = max(1, math.ceil(len(rows) / MOST_BINS))
    if rows.empty or every > LARGEST_STEP:
        return made
    names = ConditionNames(config)
    for run_id, run in rows[rows["bin"] % every == 0].groupby("run_id", sort=False):
        first = run.iloc[0]
        speed = f"{given(abs(run['speed_mm_s'].mean()), 3)} {units.unit('speed')}"
        columns = {"x": "displacement_mm", "force": "force_N", "model": "model_N"}
        strokes = [
            {"file": file, **{name: _rounded(own[column]) for name, column in columns.items()}}
            for (file, _), own in run.sort_values("bin").groupby(["file", "stroke"])
        ]
        label = f"{names(first['condition'])}, {speed}, run {run_id}"
        made["runs"][str(run_id)] = {"label": label, "strokes": strokes}
    return made


def _rounded(values: pd.Series) -> list[float | None]:
    return [float(f"{value:.5g}") if np.isfinite(value) else None for value in values]


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
