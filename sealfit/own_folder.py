"""Whose a folder OUT is: made where there is none, refused where others made it, and held by one writer."""

from __future__ import annotations

import contextlib
import shutil
from collections.abc import Iterator
from pathlib import Path

from sealfit.errors import OutError
from sealfit.lock import LOCK, only_writer
from sealfit.staging import STAGING, disk
from sealfit.state import STATE


@contextlib.contextmanager
def held(out: Path) -> Iterator[None]:
    """Hold `out` as its only writer, free of what a killed run left there; made, and gone again if it stays empty.

    Raises
    ------
    OutError
        If `out` is a file, a folder that sealfit did not make, in use by another process, or cannot be written.
    """
    made = _make(out)
    try:
        with only_writer(out):
            for left in out.glob(f"{STAGING}*"):
                shutil.rmtree(left, ignore_errors=True)
            yield
    finally:
        if made:
            with contextlib.suppress(OSError):  # stays if it holds anything
                out.rmdir()


def _make(out: Path) -> bool:
    """Make `out` if it is not there, and return whether it was made; refuse a folder that sealfit did not make."""
    if out.exists() and not out.is_dir():
        raise OutError("is a file.", file=out, fix="Give --out a folder.")
    if out.is_dir():
        strangers = [p.name for p in out.iterdir() if p.name != LOCK and not p.name.startswith(STAGING)]
        if strangers and STATE not in strangers:
            raise OutError(
                f"is not empty (it holds {sorted(strangers)[0]}) and was not made by sealfit.",
                file=out,
                fix="Choose another --out.",
            )
        return False
    with disk(out):
        out.mkdir(parents=True)
    return True
