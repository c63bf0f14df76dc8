"""The one writer of OUT: files staged and then moved, and the lock and ownership of the folder."""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import shutil
import socket
import stat
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from sealfit.engine import undisturbed
from sealfit.errors import OutError, disk
from sealfit.store.manifest import STAGING, STATE, Fingerprints, State, fingerprint
from sealfit.tables import SCHEMAS
from sealfit.units import Units

if TYPE_CHECKING:
    import pandas as pd

PROVENANCE = "provenance.json"
PARQUET = ".parquet"

# ---------------------------------------------------------------- staged files
# Files are written in a temporary folder, which is renamed when all of them are there. Then they are moved to
# their places, state.json last. Whoever opens OUT after an interruption moves the rest of a complete folder,
# and removes an incomplete one.

COMPLETE = f"{STAGING}complete"


class Staged:
    """Files of one step, written in a temporary folder and moved together when the step is complete."""

    def __init__(self, out: Path, units: Units, step: str):
        self._out, self._units = out, units
        self._folder = out / f"{STAGING}{os.getpid()}-{step}"
        self.files: dict[str, int] = {}
        self.checksums: dict[str, str | None] = {}
        self.inputs: Fingerprints | None = None  # set by ingest: the files read

    def table(self, name: str, frame: pd.DataFrame) -> None:
        """Write table `name` of `tables.SCHEMAS`; ValueError if the frame lacks its columns or types."""
        from sealfit.store import parquet

        made = parquet.to_arrow(frame, SCHEMAS[name], self._units)
        self._write(f"{name}{PARQUET}", lambda path: parquet.write_arrow(made, path))

    def file(self, name: str, content: str | bytes) -> None:
        """Write a file; bytes of paths that are not UTF-8 become escapes, which JSON reads back."""
        raw = content.encode("utf-8", "backslashreplace") if isinstance(content, str) else content
        self._write(name, lambda path: path.write_bytes(raw))

    def folder(self) -> Path:
        """Return the folder in which other processes may write files of this step; see `adopt`."""
        with disk(self._out):
            self._folder.mkdir(exist_ok=True)
        return self._folder

    def adopt(self, files: Mapping[str, int]) -> None:
        """Add files with sizes to this step: those other processes wrote into `folder`, and those in OUT."""
        self.files |= files
        for file in files:
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

    def commit(self) -> None:
        """Declare the staged files complete, and move them to their places."""
        folders = {(self._folder / file).parent for file in self.files}
        for folder in {*folders, self._folder}:
            if folder.is_dir():  # else its files are in OUT already
                sync(folder)
        sync(self._out)
        os.replace(self._folder, self._out / COMPLETE)
        sync(self._out)
        finish(self._out)

    def replace_state(self) -> None:
        """Move state.json alone to its place."""
        os.replace(self._folder / STATE, self._out / STATE)

    def clear(self) -> None:
        """Remove the staged files, unless they are complete."""
        shutil.rmtree(self._folder, ignore_errors=True)


def finish(out: Path) -> None:
    """Move the files of a complete step to their places, remove what is left over, and move the state.

    It may be interrupted and called again. OutError if one of its folders is a link.
    """
    folder = out / COMPLETE
    if (state := State.read(folder)) is not None and state.steps:
        refuse_links(folder)
        step, done = list(state.steps.items())[-1]
        folders = sorted({(out / file).parent for file in done.files} - {out})
        for place in folders:
            if place.is_file():  # a table that was one file
                place.unlink()
            place.mkdir(exist_ok=True)
        sync(out)  # a power loss may not take a folder to which files were moved
        for file in (*done.files, PROVENANCE):
            if (folder / file).exists():  # else it is in OUT already
                os.replace(folder / file, out / file)
        for file in _left_over(out, step, done.files):
            (out / file).unlink(missing_ok=True)
        for place in (*folders, out):
            sync(place)
        os.replace(folder / STATE, out / STATE)
        sync(out)
    shutil.rmtree(folder, ignore_errors=True)


def _left_over(out: Path, step: str, files: Mapping[str, int]) -> set[str]:
    """Return the files of an earlier time of a step that are not its any more.

    In the folder of a table nothing else may lie, whoever left it there: readers take all of it.
    """
    kept = State.read(out)
    old = kept.steps[step].files if kept is not None and step in kept.steps else {}
    folders = {file.split("/")[0] for file in files if "/" in file and not file.startswith("plots/")}
    lying = {f"{folder}/{path.name}" for folder in folders for path in (out / folder).glob("*")}
    return (old.keys() | lying) - files.keys()


def refuse_links(folder: Path) -> None:
    """Raise OutError for a link to a folder in `folder`: files would be written and removed elsewhere."""
    for path in folder.iterdir():
        if path.is_symlink() and path.is_dir():
            raise OutError(f"'{path.name}' is a link to a folder.", file=folder, fix="Delete the link.")


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


# ---------------------------------------------------------------- lock
# The kernel drops the lock with the process that held it, however that ended, so the lock of a dead process
# of this host is taken over at once. Another host's lock is never taken over: what runs there cannot be seen
# from here. Where the file system has no locks, the process that the file names is looked for.

LOCK = ".lock"


@contextlib.contextmanager
def taken(path: Path, option: str = "--out") -> Iterator[int]:
    """Open (or create) and lock the file at `path`, and give its descriptor; a link is replaced by a file.

    OutError, whose fix names the `option`, if another process has locked it, or if it cannot be written.
    """
    while True:
        with disk(path.parent, option):
            if path.is_symlink():  # what it leads to would be written
                path.unlink()
            handle = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o666)
        try:
            locked = _locked(handle)
            if _same_file(handle, path):  # otherwise its owner has just removed it: try again
                _refuse_owner(handle, path, option, locked)
                yield handle
                return
        finally:
            os.close(handle)


def _locked(handle: int) -> bool | None:
    """Lock a file, and return whether that was possible; None where the file system has no locks."""
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        return None  # only the name in the file is known
    return True


def _same_file(handle: int, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(handle), os.stat(path))
    except OSError:
        return False


def _owner(handle: int) -> dict:
    try:
        owner = json.loads(os.pread(handle, 10_000, 0))
    except (ValueError, RecursionError, OSError):
        return {}
    return owner if isinstance(owner, dict) else {}


def _refuse_owner(handle: int, path: Path, option: str, locked: bool | None) -> None:
    """Raise OutError if another process holds the file, or may hold it by its name in the file."""
    owner = _owner(handle)
    if locked is False:
        more = ""
    elif owner and owner.get("host") != socket.gethostname():
        more = f" If no sealfit runs on that host any more, delete {path}."
    elif locked is None and _runs(owner.get("pid")):
        more = f" If that process is no sealfit, delete {path}."
    else:
        return
    host, pid = owner.get("host", "an unknown host"), owner.get("pid", "unknown")
    what = f"another sealfit (host {host}, process {pid}) is writing here."
    raise OutError(what, file=path.parent, fix=f"Wait for it to end, or choose another {option}.{more}")


def _runs(pid: object) -> bool:
    try:
        os.kill(pid, 0)
    except (ProcessLookupError, TypeError, OverflowError):  # or it is no number
        return False
    except OSError:  # it runs, and is another user's
        return True
    return True


def _sign(handle: int, path: Path) -> None:
    owner = json.dumps({"host": socket.gethostname(), "pid": os.getpid()}).encode()
    with disk(path.parent):
        os.ftruncate(handle, 0)
        os.pwrite(handle, owner, 0)
        os.fsync(handle)


def replace_file(output: Path, text: str) -> None:
    """Write the file that --output names completely or not at all; OutError if it cannot be written."""
    staged = output.with_name(f".{output.name}.part")
    with taken(staged, "--output") as handle, disk(output, "--output"):
        try:
            with open(handle, "wb", closefd=False) as file:
                file.truncate(0)
                file.write(text.encode("utf-8"))
            os.fsync(handle)
            os.replace(staged, output)
        except OSError:
            staged.unlink(missing_ok=True)
            raise
        sync(output.absolute().parent)


# ---------------------------------------------------------------- own folder


@contextlib.contextmanager
def held(out: Path) -> Iterator[None]:
    """Hold `out` as its only writer; it is created if missing, and removed if it stays empty.

    OutError if `out` is a file, a folder that sealfit did not make, in use by another process, or cannot be
    written.
    """
    made, path = _make(out), out / LOCK
    try:
        with taken(path) as handle:
            try:
                _sign(handle, path)
                _tidy(out)
                yield
            finally:
                with contextlib.suppress(OSError):  # the folder may have been removed meanwhile
                    path.unlink()
    finally:
        if made:
            with contextlib.suppress(OSError):  # stays if it is not empty
                out.rmdir()


def _tidy(out: Path) -> None:
    """Move what an interrupted step left to be moved, and remove other staged files."""
    if (out / COMPLETE).exists():
        with undisturbed(), disk(out):
            finish(out)
    for left in out.glob(f"{STAGING}*"):
        shutil.rmtree(left, ignore_errors=True)


def _make(out: Path) -> bool:
    """Create `out` if missing, and return whether it was created; refuse a folder not made by sealfit."""
    if out.exists() and not out.is_dir():
        raise OutError("is a file.", file=out, fix="Give --out a folder.")
    if out.is_dir():
        strangers = [p.name for p in out.iterdir() if p.name != LOCK and not p.name.startswith(STAGING)]
        if strangers and STATE not in strangers and not (out / COMPLETE).exists():
            what = f"is not empty (it holds {min(strangers)}) and was not made by sealfit."
            raise OutError(what, file=out, fix="Choose another --out.")
        refuse_links(out)
        return False
    missing = [folder for folder in (out, *out.absolute().parents) if not folder.exists()]
    with disk(out):
        out.mkdir(parents=True)
        for folder in missing:
            sync(folder.absolute().parent)
    return True
