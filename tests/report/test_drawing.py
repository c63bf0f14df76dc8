"""The report looks the same whatever matplotlib is told elsewhere."""

import io
import os
import subprocess
import sys

import matplotlib as mpl

from sealfit.report.drawing import BLUE, Key, Panel, Plot, compose, draw, look

HOSTILE = {
    "font.size": 21.0, "axes.labelsize": "xx-large", "xtick.labelsize": "small", "ytick.labelsize": "large",
    "xtick.labelcolor": "inherit", "axes.linewidth": 6.0, "lines.linewidth": 9.0,
    "lines.dashed_pattern": [1, 1], "axes.xmargin": 0.4, "axes.prop_cycle": mpl.cycler(color=["r"]),
    "figure.facecolor": "0.3", "axes.facecolor": "0.5",
    "legend.fontsize": "xx-small", "text.color": "red", "axes.titlesize": "small", "mathtext.fontset": "stix",
    "svg.fonttype": "none", "path.simplify": False, "axes.unicode_minus": False, "lines.markeredgewidth": 4.0,
}  # fmt: skip


def draw_lines(ax):
    ax.plot([1.0, 40.0], [-0.3, 1.4], "o--")
    ax.set_xlabel(r"$\mu_s$ of speed (mm/s)")
    ax.set_ylabel("force (N)")


PLOT = Plot("one", "One plot", (Panel("a) forces", "", draw_lines),), (Key("mu_s", BLUE, symbol=True),))


def test_settings_of_the_user_change_nothing():
    before = draw(PLOT)
    with mpl.rc_context(HOSTILE):
        after = draw(PLOT)
    assert after["svg"] == before["svg"]
    assert after["png"] == before["png"]
    assert after["pdf"] == before["pdf"]


def test_text_is_text_in_files_for_print():
    drawn = draw(PLOT)
    assert ">force (N)</text>" in drawn["svg"]
    assert b"/TrueType" in drawn["pdf"] or b"/CIDFontType2" in drawn["pdf"]
    assert b"/Type3" not in drawn["pdf"]


def test_a_matplotlibrc_changes_nothing(tmp_path):
    (tmp_path / "matplotlibrc").write_text("font.size: 21\nxtick.labelsize: xx-large\nlines.linewidth: 9\n")
    program = (
        "import sys; sys.path[:0] = sys.argv[1:]; import matplotlib, test_drawing; "
        "from sealfit.report.drawing import draw;"
        "assert matplotlib.rcParams['font.size'] == 21; sys.stdout.write(draw(test_drawing.PLOT)['svg'])"
    )
    environment = {**os.environ, "MATPLOTLIBRC": str(tmp_path)}
    here = os.path.dirname(__file__)
    done = subprocess.run(
        [sys.executable, "-c", program, here], capture_output=True, text=True, check=True, env=environment
    )
    assert done.stdout == draw(PLOT)["svg"]


def test_settings_are_as_before_afterwards():
    with mpl.rc_context(HOSTILE):
        with look():
            assert mpl.rcParams["font.size"] == 8.5
        assert mpl.rcParams["font.size"] == 21.0
        assert mpl.rcParams["xtick.labelsize"] == "small"


def test_a_figure_is_saved_where_sizes_are_words():
    """Matplotlib's own defaults are words: "medium" for a size, "inherit" for a colour."""
    figure = compose(PLOT)
    with mpl.rc_context():
        mpl.rcdefaults()
        assert mpl.rcParams["xtick.labelsize"] == "medium"
        assert mpl.rcParams["xtick.labelcolor"] == "inherit"
        buffer = io.BytesIO()
        figure.savefig(buffer, format="png")
    assert len(buffer.getvalue()) > 1000
