"""Reports without the drawings that a test does not look at: saving them is most of the time of a run."""

import os
import sys
from pathlib import Path

from sealfit.report import drawing
from sealfit.report.drawing import Drawn
from sealfit.report.style import Plot

COMMAND = """
import drawing_helpers
from sealfit.report import drawing, page
{patch}
from sealfit.__main__ import main
main()
"""
PATCHES = {
    "panels": "drawing._saved = drawing_helpers.only_svg",
    "none": "page.draw = drawing_helpers.undrawn",
}
SAVED = drawing._saved


def undrawn(plot: Plot) -> Drawn:
    """Stand for `draw` in reports that nobody looks at."""
    return Drawn("<svg/>", b"", b"", ("<svg/>",) * len(plot.panels))


def only_svg(figure, form, metadata, **options) -> bytes:
    """Stand for `_saved` in tests of what the page holds: the files for print are empty."""
    return SAVED(figure, form, metadata, **options) if form == "svg" else b""


def command(*words: object, drawn: str = "all") -> list[str]:
    """Return what runs a command line in a process of its own, where "all", "panels" or "none" is drawn."""
    as_it_is = drawn == "all" or words[0] not in ("run", "report")
    program = ["-m", "sealfit"] if as_it_is else ["-c", COMMAND.format(patch=PATCHES[drawn])]
    return [sys.executable, *program, *map(str, words)]


def environment(**settings: str) -> dict[str, str]:
    """Return the environment of such a process, which finds sealfit and this file."""
    here = Path(__file__).resolve().parent
    return {**os.environ, "PYTHONPATH": f"{here.parent}{os.pathsep}{here}", **settings}
