"""Staged writes: files are written in a temporary folder and then moved, so that OUT has no partial files."""

from __future__ import annotations

import contextlib
import errno
import os
import shutil
import stat
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from sealfit.errors import OutError
from sealfit.store.manifest import STAGING, STATE, Fingerprints, State, fingerprint, to_json
from sealfit.tables import SCHEMAS
from sealfit.units import Units

if TYPE_CHECKING:
    import pandas as pd

    from sealfit.report.drawing import Drawn

PROVENANCE = "provenance.json"
BEGUN, ENDED = "begun.json", "ended.json"  # state.json while the files of a step are moved, and after that
PARQUET = ".parquet"


class Staged:
    """Files of one step, written in a temporary folder and moved together when the step is complete."""

    def __init__(self, out: Path, units: Units, step: str):
        self._out, self._units = out, units
        self.name = f"{STAGING}{os.getpid()}-{step}"
        self._folder = out / self.name
        self.files: dict[str, int] = {}
        self.checksums: dict[str, str | None] = {}
        self.inputs: Fingerprints | None = None  # set by ingest: the files read
        self.committed = False  # whether state.json says that these files are being moved

    def table(self, name: str, frame: pd.DataFrame) -> None:
        """Write table `name` of `tables.SCHEMAS`; ValueError if the frame lacks its columns or types."""
        from sealfit.store import parquet

        self._write(f"{name}{PARQUET}", lambda path: parquet.write(frame, SCHEMAS[name], self._units, path))

    def json(self, name: str, document: Mapping) -> None:
        """Write `document` as `<name>.json`; numbers that are not finite become null."""
        self.text(f"{name}.json", to_json(document))

    def text(self, name: str, text: str) -> None:
        """Write a text file; bytes of paths that are not UTF-8 become escapes, which JSON reads back."""
        self._write(name, lambda path: path.write_bytes(text.encode("utf-8", "backslashreplace")))

    def figure(self, name: str, figure: Drawn) -> None:
        """Write a drawn figure as `plots/<name>.png`, `.pdf` and `.svg`."""
        self._write(f"plots/{name}.png", lambda path: path.write_bytes(figure.png))
        self._write(f"plots/{name}.pdf", lambda path: path.write_bytes(figure.pdf))
        self.text(f"plots/{name}.svg", figure.svg)

    def folder(self) -> Path:
        """Return the folder in which other processes may write files of this step; see `adopt`."""
        with disk(self._out):
            self._folder.mkdir(exist_ok=True)
        return self._folder

    def adopt(self, files: Mapping[str, int]) -> None:
        """Add files with sizes to this step: those other processes wrote into `folder`, and those in OUT."""
        self.files |= files
        for file in (file for file in files if not file.endswith(PARQUET)):  # whose pages have checksums
            here = self._folder / file
            self.checksums[file] = fingerprint(here if here.exists() else self._out / file).sha256

    def _write(self, name: str, write: Callable[[Path], object]) -> None:
        path = self._folder / name
        with disk(self._out):
            path.parent.mkdir(parents=True, exist_ok=True)
            write(path)
            sync(path)
            self.files[name] = path.stat().st_size
            self.checksums[name] = fingerprint(path).sha256

    def sync(self) -> None:
        """Sync the folders of the staged files to the disk; the files are synced as they are written."""
        folders = {(self._folder / file).parent for file in self.files}
        for folder in {*folders, self._folder}:
            if folder.is_dir():  # else its files are in OUT already
                sync(folder)
        sync(self._out)

    def replace(self, name: str, target: str) -> None:
        """Move a staged file to `target` in OUT, atomically."""
        os.replace(self._folder / name, self._out / target)

    def clear(self) -> None:
        """Remove the staged files, unless they are to be moved to their places."""
        if not self.committed:
            shutil.rmtree(self._folder, ignore_errors=True)


def finish(out: Path, state: State) -> None:
    """Finish the step whose files are being moved: move the rest, remove what is left over, store the state.

    Whatever of it has been done already stays, so it may be interrupted and called again. OutError if the
    staged files are not there any more, or a folder of them is a link.
    """
    folder, (*_, done) = out / state.moving.folder, state.steps.values()
    if not folder.is_dir():
        what = f"lacks {folder.name}, with files of a step that was interrupted."
        raise OutError(what, file=out, fix="Delete the folder, or choose another --out.")
    refuse_links(folder)
    folders = sorted({(out / file).parent for file in done.files} - {out})
    for place in folders:
        if place.is_file():  # a table that was one file
            place.unlink()
        place.mkdir(exist_ok=True)
    sync(out)  # a power loss may not take a folder to which files were moved
    for file in (*done.files, PROVENANCE):
        if (folder / file).exists():  # else it is in OUT already
            os.replace(folder / file, out / file)
    for file in state.moving.left_over:
        (out / file).unlink(missing_ok=True)
    for place in (*folders, out):
        sync(place)
    os.replace(folder / ENDED, out / STATE)
    sync(out)
    shutil.rmtree(folder, ignore_errors=True)


def refuse_links(folder: Path) -> None:
    """Raise OutError for a link to a folder in `folder`: files would be written and removed elsewhere."""
    for path in folder.iterdir():
        if path.is_symlink() and path.is_dir():
            raise OutError(f"'{path.name}' is a link to a folder.", file=folder, fix="Delete the link.")


@contextlib.contextmanager
def disk(out: Path) -> Iterator[None]:
    """Turn an error of the file system into an OutError."""
    try:
        yield
    except OSError as error:
        reason = error.strerror or str(error)
        fix = "Fix the rights of the folder, or choose another --out."
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            fix = "Free some space and run the command again."
        raise OutError(f"cannot be written ({reason}).", file=out, fix=fix) from error


def file_size(path: str) -> int | None:
    """Return the size of a file in bytes; None where there is no file."""
    try:
        status = os.stat(path)
    except OSError:
        return None
    return status.st_size if stat.S_ISREG(status.st_mode) else None


def sync(path: Path) -> None:
    """Sync `path`, a file or a folder, to the disk."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
