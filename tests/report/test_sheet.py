import base64
import io
import re
from xml.etree import ElementTree

import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.image import imread
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle
from matplotlib.text import Text
from matplotlib.transforms import Bbox, IdentityTransform

from sealfit.report.sheet import Sheet
from sealfit.report.style import look


@pytest.fixture
def sheet():
    return Sheet(100, 50, 144)  # two pixels a point


def drawn(sheet, artist):
    figure = Figure(figsize=(100 / 144, 50 / 144), dpi=144)
    artist.set_figure(figure)
    artist.set_transform(IdentityTransform())  # pixels from the lower left
    with look():
        (element,) = sheet.part([artist]).elements
    return element


def image(png):
    return imread(io.BytesIO(png))


def test_a_line_is_told_in_steps_from_the_upper_left(sheet):
    element = drawn(sheet, Line2D([10, 30, 30], [40, 40, 15], color="#0072B2", linewidth=2.0))
    assert 'd="M100 100l200 0 0 250"' in element
    assert 'stroke="#0072b2" stroke-width="40"' in element


def test_a_line_has_a_gap_where_it_is_not_known(sheet):
    element = drawn(sheet, Line2D([10, 20, np.nan, 50, 60], [40, 40, 40, 40, 30], color="k"))
    assert 'd="M100 100l100 0M500 100l100 100"' in element


def test_dashes_are_as_long_as_in_the_pixels(sheet):
    element = drawn(sheet, Line2D([10, 90], [25, 25], color="k", linewidth=1.0, dashes=(3.0, 1.5)))
    assert 'stroke-dasharray="60 30"' in element  # 3 and 1.5 points, in tenths of a pixel


def test_an_area_is_closed_and_lets_through(sheet):
    element = drawn(sheet, Rectangle((10, 10), 20, 30, facecolor="#D55E00", linewidth=0, alpha=0.25))
    assert 'd="M100 400l200 0 0-300-200 0z" fill="#d55e00"' in element
    assert 'opacity="0.25"' in element
    assert "stroke=" not in element


def test_many_markers_have_one_shape(sheet):
    line = Line2D([10, 30, np.nan, 70], [10, 20, 20, 40], color="k", linestyle="", marker="s", markersize=2.0)
    element = drawn(sheet, line)
    places = re.findall(r'<use xlink:href="#(\w+)" x="(\d+)" y="(\d+)"/>', element)
    assert [(int(x), int(y)) for _, x, y in places] == [(100, 400), (300, 300), (700, 100)]
    (name,) = {name for name, _, _ in places}
    page = sheet.svg([sheet.part([line])])
    assert page.count(f'id="{name}"') == 1
    assert re.search(rf'<path id="{name}" d="M-20 20l40 0 0-40-40 0z"/>', page)  # two points, four pixels


def test_what_is_clipped_is_clipped_in_both(sheet):
    line = Line2D([0, 100], [25, 25], color="k", linewidth=2.0)
    line.set_clip_box(Bbox.from_bounds(20, 0, 30, 50))
    assert 'clip-path="url(#c' in drawn(sheet, line)
    assert '<clipPath id="c0"><path d="M200 0H500V500H200z"/></clipPath>' in sheet.svg([sheet.part([line])])
    dark = np.flatnonzero(image(sheet.png())[25, :, 3] > 0.5)
    assert (dark.min(), dark.max()) == (20, 49)


def test_a_part_stands_alone_in_its_box(sheet):
    first, second = (Line2D([x, x + 20], [25, 25], color="k", linestyle="", marker="o") for x in (10, 60))
    drawn(sheet, first)
    drawn(sheet, second)
    page = ElementTree.fromstring(sheet.svg([sheet.part([second])], Bbox.from_bounds(50, 0, 50, 50)))
    assert page.get("viewBox") == "500 0 500 500"
    assert (page.get("width"), page.get("height")) == ("25pt", "25pt")
    assert len([element for element in page.iter() if element.tag.endswith("use")]) == 2


def test_a_text_has_its_place_and_size_in_both(sheet):
    text = Text(10, 20, "HHHH", fontsize=10)
    element = drawn(sheet, text)
    assert 'transform="translate(100 300)scale(0.5)"' in element  # outlines are 400 units large, this is 200
    rows, columns = np.nonzero(image(sheet.png())[..., 3] > 0.5)
    assert rows.max() + 1 == pytest.approx(30, abs=1)
    assert rows.max() + 1 - rows.min() == pytest.approx(0.729 * 20, abs=1)  # the capitals of DejaVu Sans
    begin = int(re.search(r' d="M(\d+)', element)[1])  # the left edge of the first letter
    assert columns.min() == pytest.approx(10 + 0.05 * begin, abs=1)


def test_letters_that_the_font_lacks_are_told_as_text(sheet):
    element = drawn(sheet, Text(10, 20, "<温度>", fontsize=10))
    assert element.startswith('<text transform="translate(100 300)"')
    assert "&lt;温度&gt;" in element


def test_what_is_too_much_for_an_svg_is_in_it_as_pixels(sheet):
    figure = Figure(figsize=(100 / 144, 50 / 144), dpi=144)
    ax = figure.add_axes((0, 0, 1, 1))
    ax.axis("off")
    ax.plot(range(99), [1, 2, 3] * 33, color="#0072B2", linestyle="", marker="o", rasterized=True)
    ax.plot([0, 98], [1, 3], color="#D55E00")
    with look():
        part = sheet.part([ax])
    pictures = [element for element in part.elements if element.startswith("<image")]
    assert len(pictures) == 1
    assert not any("<use" in element for element in part.elements)
    assert any("#d55e00" in element for element in part.elements)
    x, y, width, height = (int(n) // 10 for n in re.findall(r' (?:x|y|width|height)="(\d+)"', pictures[0]))
    inside = image(base64.b64decode(pictures[0].split("base64,")[1].split('"')[0]))
    assert inside.shape[:2] == (height, width)
    assert (inside[..., 3] > 0).sum() == pytest.approx(
        (image(sheet.png())[y : y + height, x : x + width, 3] > 0).sum(), rel=0.05
    )


def test_a_line_without_any_places_draws_nothing():
    figure = Figure(figsize=(1, 1), dpi=100)
    line = figure.add_artist(Line2D([0.2, 0.8], [np.nan, np.nan]))
    sheet = Sheet(100, 100, 100)
    with look():
        assert sheet.part([line]).elements == []
