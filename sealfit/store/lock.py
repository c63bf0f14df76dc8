"""Lock and ownership of the output folder, and delayed interrupts."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
import socket
import threading
from collections.abc import Iterator
from pathlib import Path

from sealfit.errors import OutError
from sealfit.store.manifest import STATE
from sealfit.store.staged_writes import STAGING, disk

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
# One writer per OUT: the lock holds host and process, and is released when the process dies.

try:
    import fcntl
except ImportError:  # pragma: no cover  (Windows)
    fcntl = None

LOCK = ".lock"


@contextlib.contextmanager
def only_writer(folder: Path) -> Iterator[None]:
    """Hold `folder` for writing while the block runs.

    The kernel drops the lock with the process that held it, however that ended, so the lock of a dead process
    of this host is taken over at once. Another host's lock is never taken over: what runs there cannot be
    seen from here.

    Raises
    ------
    OutError
        If another process holds the folder (its host and process id are named), or if the lock cannot be
        written.
    """
    path = folder / LOCK
    handle = _take(path)
    try:
        _sign(handle, path)
        yield
    finally:
        with contextlib.suppress(OSError):  # the folder may have been removed meanwhile
            path.unlink()
        os.close(handle)


def _take(path: Path) -> int:
    while True:
        try:
            handle = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
        except OSError as error:
            raise OutError(
                f"cannot be written ({error.strerror}).",
                file=path.parent,
                fix="Choose another --out, or fix its rights.",
            ) from error
        try:
            if _locked(handle) and _same_file(handle, path):
                _refuse_live_owner(handle, path)
                return handle
        except BaseException:
            os.close(handle)
            raise
        busy = _owner(handle)
        gone = not _same_file(handle, path)
        os.close(handle)
        if not gone:  # otherwise its owner has just removed it: try again
            raise _busy(path, busy)


def _locked(handle: int) -> bool:
    if fcntl is None:
        return True
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        return True  # a file system without locks: only the name in the file is known
    return True


def _same_file(handle: int, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(handle), os.stat(path))
    except OSError:
        return False


def _owner(handle: int) -> dict:
    try:
        owner = json.loads(os.pread(handle, 10_000, 0))
    except (ValueError, OSError):
        return {}
    return owner if isinstance(owner, dict) else {}


def _refuse_live_owner(handle: int, path: Path) -> None:
    owner = _owner(handle)
    if owner and owner.get("host") != socket.gethostname():
        raise _busy(path, owner, f" If no sealfit runs on that host any more, delete {path}.")


def _busy(path: Path, owner: dict, more: str = "") -> OutError:
    host, pid = owner.get("host", "an unknown host"), owner.get("pid", "unknown")
    return OutError(
        f"another sealfit (host {host}, process {pid}) is writing here.",
        file=path.parent,
        fix=f"Wait for it to end, or choose another --out.{more}",
    )


def _sign(handle: int, path: Path) -> None:
    owner = json.dumps({"host": socket.gethostname(), "pid": os.getpid()}).encode()
    try:
        os.ftruncate(handle, 0)
        os.pwrite(handle, owner, 0)
        os.fsync(handle)
    except OSError as error:
        raise OutError(
            f"cannot be written ({error.strerror}).", file=path.parent, fix="Free some space."
        ) from error


# ---------------------------------------------------------------- own folder
# Ownership of the output folder: create it, or refuse one made by another program; one writer holds it.


@contextlib.contextmanager
def held(out: Path) -> Iterator[None]:
    """Hold `out` as its only writer.

    It is created if missing, cleared of staged files, and removed if it stays empty.

    Raises
    ------
    OutError
        If `out` is a file, a folder that sealfit did not make, in use by another process, or cannot be
        written.
    """
    made = _make(out)
    try:
        with only_writer(out):
            for left in out.glob(f"{STAGING}*"):
                shutil.rmtree(left, ignore_errors=True)
            yield
    finally:
        if made:
            with contextlib.suppress(OSError):  # stays if it is not empty
                out.rmdir()


def _make(out: Path) -> bool:
    """Create `out` if missing, and return whether it was created; refuse a folder not made by sealfit."""
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
