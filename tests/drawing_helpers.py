"""Reports without the drawings that a test does not look at: saving them is most of the time of a run."""

import os
import sys
from pathlib import Path

from sealfit.report import drawing
from sealfit.report.drawing import Panel, Plot, compose

UNDRAWN = """
import drawing_helpers
from sealfit.report import page
page.draw = drawing_helpers.undrawn
from sealfit.__main__ import main
main()
"""
SAVED = drawing.saved


def undrawn(plot: Plot) -> dict:
    """Stand for `draw` in reports that nobody looks at."""
    return {"png": b"", "pdf": b"", "svg": "<svg/>"}


def only_svg(figure, form, metadata, **options) -> bytes:
    """Stand for `saved` in tests of what the page holds: the files for print are empty."""
    return SAVED(figure, form, metadata, **options) if form == "svg" else b""


def panel_figure(panel: Panel):
    """Return a figure of one panel."""
    return compose(Plot("one", "", (panel,)))


def command(*words: str) -> list[str]:
    """Return what runs a command line in a process of its own; of a report nothing is drawn."""
    program = ["-c", UNDRAWN] if words[0] in ("run", "report") else ["-m", "sealfit"]
    return [sys.executable, *program, *words]


def environment(**settings: str) -> dict[str, str]:
    """Return the environment of such a process, which finds sealfit and this file."""
    here = Path(__file__).resolve().parent
    return {**os.environ, "PYTHONPATH": f"{here.parent}{os.pathsep}{here}", **settings}
