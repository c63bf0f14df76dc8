"""A shim over the calls that change files: it counts them and makes the n-th go wrong.

It stands for the system as SQLite's test VFS does: every open for writing, write, fsync, rename, unlink,
mkdir, rmdir and truncate below one folder passes through it. A fault is one of

    eio     the call fails with EIO, once
    enospc  the call and every later one that needs space fail with ENOSPC
    short   a write takes half of what it is given
    kill    the process ends before the call, or in the middle of a write
    power   the same, and the power goes: see `Journal`
"""

from __future__ import annotations

import builtins
import errno
import io
import os
import pickle
import threading
from collections.abc import Callable
from pathlib import Path
from random import Random

FAULTS = ("eio", "enospc", "short", "kill", "power")
KILLED = 137  # exit code of a process that a fault ended, as a shell reports SIGKILL
WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND
SPACE = ("open", "write", "fsync", "rename", "mkdir")  # calls that a full disk refuses


# ---------------------------------------------------------------- power loss


class Journal:
    """What is on the disk for certain, and what is not yet.

    The model is that of POSIX, weaker than any journalling file system: the content of a file is certain
    as of its last fsync; an entry of a folder (created, renamed, removed) is certain once the folder has been
    synced; what is not certain may be there or not, each entry and each content by itself.
    """

    def __init__(self, root: Path):
        self.root = str(root)
        self.content: dict[int, bytes] = {}  # certain content of each file, by its number
        self.last: dict[int, bytes] = {}  # content at the moment of the power loss
        self.entries: list[tuple] = []  # changes of entries, in order: what, path, second path, file
        self.certain: list[bool] = []  # of each
        self._number: dict[tuple[int, int], int] = {}  # number of each file, by device and inode
        self.before: dict[str, int | None] = {}  # entries at the start; None for a folder
        for folder, folders, files in os.walk(self.root):
            for name in folders:
                self.before[os.path.join(folder, name)] = None
            for name in files:
                path = os.path.join(folder, name)
                number = self.before[path] = self._file(path)
                self.content[number] = _bytes(path)

    def _file(self, path: str, *, new: bool = False) -> int:
        status = os.stat(path)
        key = status.st_dev, status.st_ino
        if new or key not in self._number:
            self._number[key] = len(self.content) + len(self._number) + 1
            self.content.setdefault(self._number[key], b"")
        return self._number[key]

    def created(self, path: str) -> None:
        self._add("link", path, self._file(path, new=True))

    def synced(self, path: str) -> None:
        if os.path.isdir(path):
            for k, (_, *paths) in enumerate(self.entries):
                if any(isinstance(other, str) and os.path.dirname(other) == path for other in paths):
                    self.certain[k] = True
        else:
            self.content[self._file(path)] = _bytes(path)

    def renamed(self, source: str, target: str) -> None:
        self._keep(target)
        self._add("rename", source, target, self._file(source))

    def removed(self, path: str) -> None:
        self._keep(path)
        self._add("unlink", path)

    def folder(self, what: str, path: str) -> None:
        self._add(what, path)

    def _add(self, *entry: object) -> None:
        self.entries.append(entry)
        self.certain.append(False)

    def _keep(self, path: str) -> None:
        """Note the content of a file that is about to lose its name."""
        if os.path.isfile(path):
            self.last[self._file(path)] = _bytes(path)

    def ends(self) -> None:
        """Note the content of every file."""
        for folder, _, files in os.walk(self.root):
            for name in files:
                path = os.path.join(folder, name)
                self.last[self._file(path)] = _bytes(path)

    def rebuild(self, folder: Path, variant: str, random: Random) -> None:
        """Make `folder` look as it may after the power loss.

        Variants: "nothing" that is not certain survived; all "names" did, and no content; "some" of both.
        """
        entries: dict[str, int | None] = dict(self.before)
        for certain, (what, path, *more) in zip(self.certain, self.entries, strict=True):
            if not certain and (variant == "nothing" or (variant == "some" and random.random() < 0.5)):
                continue
            if what == "link":
                entries[path] = more[0]
            elif what == "mkdir":
                entries[path] = None
            elif what in ("unlink", "rmdir"):
                entries.pop(path, None)
            else:  # of a file, whether or not its creation was lost
                entries.pop(path, None)
                entries[more[0]] = more[1]
        for path in sorted(entries):
            target = folder / os.path.relpath(path, self.root)
            if not target.parent.is_dir():  # in a folder whose own entry was lost
                continue
            if entries[path] is None:
                target.mkdir(exist_ok=True)
            else:
                target.write_bytes(self._survived(entries[path], variant, random))

    def _survived(self, file: int, variant: str, random: Random) -> bytes:
        certain, last = self.content[file], self.last.get(file, b"")
        if certain == last or variant != "some":
            return certain
        return random.choice([certain, last, last[: len(last) // 2], bytes(len(last))])


def _bytes(path: str) -> bytes:
    handle = _REAL["open"](path, os.O_RDONLY)
    try:
        return os.read(handle, os.fstat(handle).st_size)
    finally:
        os.close(handle)


# ---------------------------------------------------------------- the shim

_REAL = {name: getattr(os, name) for name in ("open", "fsync", "replace", "rename", "unlink", "remove")}
_REAL |= {name: getattr(os, name) for name in ("mkdir", "rmdir", "ftruncate", "pwrite", "link")}
_REAL_OPEN = io.open


class Disk:
    """The calls of this process that change files below `root`; the `at`-th has a fault.

    Nothing is really synced, so that thousands of runs take minutes.
    """

    def __init__(self, root: Path, at: int = 0, fault: str = "", report: Path | None = None):
        self.root, self.at, self.fault, self.report = str(root), at, fault, report
        self.calls: list[str] = []  # kinds of the calls so far
        self.journal = Journal(root) if fault == "power" else None
        self._lock = threading.RLock()

    def install(self) -> None:
        """Put the shim in place, for the rest of this process."""
        os.open, io.open, builtins.open = self._os_open, self._io_open, self._io_open
        os.fsync = self._fsync
        os.replace = os.rename = self._rename
        os.unlink = os.remove = self._unlink
        os.mkdir, os.rmdir = self._mkdir, self._rmdir
        os.ftruncate, os.pwrite = self._ftruncate, self._pwrite
        os.link = self._link

    def end(self) -> None:
        """Write the report: the calls, and what a power loss may leave."""
        if self.journal is not None:
            self.journal.ends()
        if self.report is not None:
            handle = _REAL["open"](self.report, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
            os.write(handle, pickle.dumps((self.calls, self.journal)))
            os.close(handle)

    # ------------------------------------------------------------ counting
    def _path(self, path: object, folder: int | None = None) -> str:
        """Return the absolute path of a name, or "" if it lies elsewhere."""
        if isinstance(path, int):
            named = os.readlink(f"/proc/self/fd/{path}")
        elif folder is not None:
            named = os.path.join(os.readlink(f"/proc/self/fd/{folder}"), os.fspath(path))
        else:
            named = os.path.abspath(os.fspath(path))
        return named if named == self.root or named.startswith(self.root + os.sep) else ""

    def _call(self, kind: str, half: Callable[[], int] | None = None) -> int | None:
        """Count a call, and do what its fault says; the number written where a write was short."""
        self.calls.append(kind)
        if self.fault == "enospc" and len(self.calls) >= self.at > 0 and kind in SPACE:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        if len(self.calls) != self.at:
            return None
        if self.fault == "eio":
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        if half is not None and self.fault in ("short", "kill", "power"):
            written = half()
            if self.fault == "short":
                return written
        if self.fault in ("kill", "power"):
            self.end()
            os._exit(KILLED)
        return None

    # ------------------------------------------------------------ calls
    def _os_open(self, path, flags, mode=0o777, *, dir_fd=None):
        with self._lock:
            named = self._path(path, dir_fd) if flags & WRITING else ""
            new = bool(named) and flags & os.O_CREAT and not os.path.exists(named)
            if new or (named and flags & os.O_TRUNC):
                self._call("open")
            handle = _REAL["open"](path, flags, mode, dir_fd=dir_fd)
            if new and self.journal is not None:
                self.journal.created(named)
            return handle

    def _io_open(
        self, file, mode="r", buffering=-1, encoding=None, errors=None, newline=None, *more, **named
    ):
        writes = not isinstance(file, int) and set(mode) & set("wax+") and self._path(file)
        if not writes:
            return _REAL_OPEN(file, mode, buffering, encoding, errors, newline, *more, **named)
        flags = os.O_CREAT | os.O_WRONLY | (os.O_TRUNC if "w" in mode else os.O_EXCL if "x" in mode else 0)
        handle = self._os_open(file, flags | (os.O_APPEND if "a" in mode else 0) | os.O_CLOEXEC, 0o666)
        raw = io.BufferedWriter(_File(self, handle))
        return raw if "b" in mode else io.TextIOWrapper(raw, encoding, errors, newline)

    def _fsync(self, handle):
        with self._lock:
            if named := self._path(handle):
                self._call("fsync")
                if self.journal is not None:
                    self.journal.synced(named)

    def _rename(self, source, target, **folders):
        with self._lock:
            one, two = self._path(source), self._path(target)
            if two:
                self._call("rename")
                if self.journal is not None:
                    os.stat(source)  # one that does not exist is not renamed
                    self.journal.renamed(one, two)
            _REAL["replace"](source, target, **folders)

    def _unlink(self, path, *, dir_fd=None):
        with self._lock:
            if named := self._path(path, dir_fd):
                os.lstat(named)
                self._call("unlink")
                if self.journal is not None:
                    self.journal.removed(named)
            _REAL["unlink"](path, dir_fd=dir_fd)

    def _mkdir(self, path, mode=0o777, *, dir_fd=None):
        with self._lock:
            named = self._path(path, dir_fd)
            new = named and not os.path.exists(named)
            if new:
                self._call("mkdir")
            _REAL["mkdir"](path, mode, dir_fd=dir_fd)
            if new and self.journal is not None:
                self.journal.folder("mkdir", named)

    def _rmdir(self, path, *, dir_fd=None):
        with self._lock:
            named = self._path(path, dir_fd)
            if named:
                self._call("rmdir")
            _REAL["rmdir"](path, dir_fd=dir_fd)
            if named and self.journal is not None:
                self.journal.folder("rmdir", named)

    def _link(self, source, target, **more):
        if self._path(target):
            raise OSError(errno.EOPNOTSUPP, os.strerror(errno.EOPNOTSUPP))
        _REAL["link"](source, target, **more)

    def _ftruncate(self, handle, length):
        with self._lock:
            if self._path(handle):
                self._call("truncate")
            _REAL["ftruncate"](handle, length)

    def _pwrite(self, handle, data, offset):
        with self._lock:
            if self._path(handle):
                written = self._call("write", lambda: _REAL["pwrite"](handle, data[: len(data) // 2], offset))
                if written is not None:
                    return written
            return _REAL["pwrite"](handle, data, offset)

    def write(self, real: Callable[[bytes], int], data: bytes) -> int:
        with self._lock:
            written = self._call("write", lambda: real(bytes(data[: max(1, len(data) // 2)])))
            return real(data) if written is None else written


class _File(io.FileIO):
    """A file open for writing whose writes pass through the shim."""

    def __init__(self, disk: Disk, handle: int):
        super().__init__(handle, "wb")
        self._disk = disk

    def write(self, data) -> int:
        return self._disk.write(super().write, data)
