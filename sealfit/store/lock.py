"""Lock and ownership of the output folder, and delayed interrupts."""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import shutil
import signal
import socket
import threading
from collections.abc import Iterator
from pathlib import Path

from sealfit.errors import OutError
from sealfit.store.manifest import STAGING, STATE, State
from sealfit.store.staged_writes import disk, finish, refuse_links, sync

# ---------------------------------------------------------------- interrupts
# Ctrl-C is delayed while files are moved, because an incomplete move leaves OUT stale.


@contextlib.contextmanager
def undisturbed() -> Iterator[None]:
    """Delay Ctrl-C until the block has ended."""
    before = signal.getsignal(signal.SIGINT)
    if threading.current_thread() is not threading.main_thread() or not callable(before):
        yield  # signals reach the main thread only
        return
    waiting: list[object] = []
    signal.signal(signal.SIGINT, lambda *caught: waiting.append(caught))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
        if waiting:
            signal.raise_signal(signal.SIGINT)


# ---------------------------------------------------------------- lock
# One writer per OUT: the lock names host and process.
#
# The kernel drops the lock with the process that held it, however that ended, so the lock of a dead process
# of this host is taken over at once. Another host's lock is never taken over: what runs there cannot be seen
# from here. Where the file system has no locks, the process that the file names is looked for.

LOCK = ".lock"


@contextlib.contextmanager
def taken(path: Path, option: str = "--out") -> Iterator[int]:
    """Open and lock the file at `path`, and give its descriptor; it is created if missing.

    A link is replaced by a file of its own. OutError, whose fix names the `option`, if another process has
    locked it, or if it cannot be written.
    """
    handle = _take(path, option)
    try:
        yield handle
    finally:
        os.close(handle)


def _take(path: Path, option: str) -> int:
    while True:
        try:
            if path.is_symlink():  # what it leads to would be written
                path.unlink()
            handle = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o666)
        except OSError as error:
            fix = f"Choose another {option}, or fix its rights."
            raise OutError(f"cannot be written ({error.strerror}).", file=path.parent, fix=fix) from error
        try:
            locked = _locked(handle)
            if _same_file(handle, path):  # otherwise its owner has just removed it: try again
                _refuse_owner(handle, path, option, locked)
                return handle
        except BaseException:
            os.close(handle)
            raise
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
    """Raise OutError if another process holds the file, or may hold it.

    It holds the file if this one could not lock it. If it runs on another host, or if there are no locks, its
    name in the file has to do.
    """
    owner = _owner(handle)
    if locked is False:
        raise _busy(path, owner, option)
    if owner and owner.get("host") != socket.gethostname():
        raise _busy(path, owner, option, f" If no sealfit runs on that host any more, delete {path}.")
    if locked is None and _runs(owner.get("pid")):
        raise _busy(path, owner, option, f" If that process is no sealfit, delete {path}.")


def _runs(pid: object) -> bool:
    if not isinstance(pid, int):
        return False
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except OSError:  # it runs, and is another user's
        return True
    return True


def _busy(path: Path, owner: dict, option: str, more: str = "") -> OutError:
    host, pid = owner.get("host", "an unknown host"), owner.get("pid", "unknown")
    what = f"another sealfit (host {host}, process {pid}) is writing here."
    return OutError(what, file=path.parent, fix=f"Wait for it to end, or choose another {option}.{more}")


def _sign(handle: int, path: Path) -> None:
    owner = json.dumps({"host": socket.gethostname(), "pid": os.getpid()}).encode()
    try:
        os.ftruncate(handle, 0)
        os.pwrite(handle, owner, 0)
        os.fsync(handle)
    except OSError as error:
        what = f"cannot be written ({error.strerror})."
        raise OutError(what, file=path.parent, fix="Free some space.") from error


# ---------------------------------------------------------------- own folder
# Ownership of the output folder: create it, or refuse one made by another program; one writer holds it.


@contextlib.contextmanager
def held(out: Path) -> Iterator[None]:
    """Hold `out` as its only writer.

    It is created if missing, and removed if it stays empty. What an interrupted step left to be moved is
    moved; other staged files are removed.

    Raises
    ------
    OutError
        If `out` is a file, a folder that sealfit did not make, in use by another process, or cannot be
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
    state = State.read(out)
    if state is not None and state.moving is not None:
        with undisturbed(), disk(out):
            finish(out, state)
    for left in out.glob(f"{STAGING}*"):
        shutil.rmtree(left, ignore_errors=True)


def _make(out: Path) -> bool:
    """Create `out` if missing, and return whether it was created; refuse a folder not made by sealfit."""
    if out.exists() and not out.is_dir():
        raise OutError("is a file.", file=out, fix="Give --out a folder.")
    if out.is_dir():
        strangers = [p.name for p in out.iterdir() if p.name != LOCK and not p.name.startswith(STAGING)]
        if strangers and STATE not in strangers:
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
