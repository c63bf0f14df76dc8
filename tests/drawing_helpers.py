"""Reports without the drawings that a test does not look at: saving them is most of the time of a run."""

import sys

from sealfit.report import drawing
from sealfit.report.drawing import Drawn
from sealfit.report.style import Plot

UNDRAWN_COMMAND = """
import sys
from drawing_helpers import undrawn
from sealfit.report import page
page.draw = undrawn
from sealfit.__main__ import main
main()
"""
SAVED = drawing._saved


def undrawn(plot: Plot) -> Drawn:
    """Stand for `draw` in reports that nobody looks at."""
    return Drawn("<svg/>", b"", b"", ("<svg/>",) * len(plot.panels))


def only_svg(figure, form, metadata, **options) -> bytes:
    """Stand for `_saved` in tests of what the page holds: the files for print are empty."""
    return SAVED(figure, form, metadata, **options) if form == "svg" else b""


def command(*words: object, drawn: bool = True) -> list[str]:
    """Return what runs a command line in a process of its own; the folder of this file is on its path."""
    draws = words[0] in ("run", "report")
    program = ["-m", "sealfit"] if drawn or not draws else ["-c", UNDRAWN_COMMAND]
    return [sys.executable, *program, *map(str, words)]
