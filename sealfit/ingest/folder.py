"""Files of a campaign folder as bytes: never one outside it, each opened once for its text and its fingerprint."""

from __future__ import annotations

import os
import re
import stat
from pathlib import Path, PurePosixPath

from sealfit.errors import BadFile, Fault
from sealfit.fingerprint import Fingerprint, fingerprint, fingerprint_of
from sealfit.ingest.text import HEAD_BYTES

_BLANK = b"\xef\xbb\xbf\xff\xfe \t\r\n\0"
_PACKED = {
    b"PK\x03\x04": "a zip archive or .xlsx workbook",
    b"\x1f\x8b": "gzip",
    b"\xd0\xcf\x11\xe0": "an .xls workbook",
}


class Folder:
    """A campaign folder; where its subfolders lie, links followed, is looked up once for all of their files."""

    def __init__(self, campaign: Path):
        self.campaign = campaign
        self._safe: dict[str, bool] = {}  # subfolder, and whether it lies inside

    def inside(self, file: str) -> str | None:
        """Return the path of `file` if it lies inside the campaign folder, links followed; otherwise None."""
        folder, _, name = file.rpartition("/")
        path = os.path.join(self.campaign, file)
        odd = name in ("", ".", "..") or file.startswith("/") or any(mark in file for mark in "\0\\:")
        if odd or not self._safe_folder(folder):
            return path if inside(self.campaign, file) is not None else None
        try:
            linked = stat.S_ISLNK(os.lstat(path).st_mode)
        except OSError:  # not there: said by who opens it
            return path
        return path if not linked or inside(self.campaign, file) is not None else None

    def _safe_folder(self, folder: str) -> bool:
        if folder not in self._safe:
            self._safe[folder] = not folder or inside(self.campaign, folder) is not None
        return self._safe[folder]

    def read(self, file: str) -> tuple[bytes, Fingerprint]:
        """Return the file's bytes, and the fingerprint of these very bytes.

        Raises
        ------
        BadFile
            As `read_bytes`.
        """
        raw, status = _read(self.inside(file), file)
        return raw, fingerprint_of(raw, status)

    def fingerprint(self, file: str) -> Fingerprint:
        """Return the fingerprint of a file that could not be read as a trace."""
        return fingerprint(self.campaign / file)


def inside(campaign: Path, file: str) -> Path | None:
    """Return the path of `file` if it lies inside the campaign folder, links followed; otherwise None."""
    pure = PurePosixPath(file)
    if pure.is_absolute() or re.match(r"[A-Za-z]:[\\/]|\\\\", file) or "\0" in file:
        return None
    path = campaign / pure
    try:
        resolved, root = path.resolve(), campaign.resolve()
    except (OSError, RuntimeError):  # a loop of links
        return None
    return path if resolved != root and resolved.is_relative_to(root) else None


def read_bytes(campaign: Path, file: str, *, head: bool = False) -> bytes:
    """Return the file's bytes, or with `head` its first ones.

    Raises
    ------
    BadFile
        If it is missing, outside the campaign, no file, not readable, empty, or packed.
    """
    return _read(Folder(campaign).inside(file), file, HEAD_BYTES if head else None)[0]


def _read(path: str | None, file: str, size: int | None = None) -> tuple[bytes, os.stat_result]:
    if path is None:
        raise _bad(file, "path_outside", "lies outside the campaign folder.", "Copy it into the folder of runs.csv.")
    try:
        # A pipe would be waited for forever, unless it is opened without waiting.
        handle = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
    except OSError as error:
        raise _not_opened(path, file, error) from None
    try:
        status = os.fstat(handle)
        if not stat.S_ISREG(status.st_mode):
            raise _bad(file, "unreadable_file", "is no file.", "Check the path.")
        raw = os.read(handle, status.st_size + 1 if size is None else size)
        # Short where it is the whole file; a network's file system, or a file above 2 GB, may give it piece by piece.
        while size is None and len(raw) != status.st_size and (more := os.read(handle, 1 << 24)):
            raw += more
    except OSError as error:
        raise _bad(file, "unreadable_file", f"cannot be read ({error.strerror}).", "Check its rights.") from error
    finally:
        os.close(handle)
    if not raw[:64].strip(_BLANK) and not raw.strip(_BLANK):
        raise _bad(file, "empty_file", "is empty.", "Export it again, or take it out of runs.csv.")
    for magic, what in _PACKED.items():
        if raw.startswith(magic):
            raise _bad(file, "binary_file", f"is {what}, not text.", "Export the trace as CSV.")
    return raw, status


def _not_opened(path: str, file: str, error: OSError) -> BadFile:
    if isinstance(error, FileNotFoundError):
        return _bad(file, "missing_file", "does not exist.", _similar(Path(path)))
    if os.path.exists(path) and not os.path.isfile(path):  # a folder, where folders cannot be opened
        return _bad(file, "unreadable_file", "is no file.", "Check the path.")
    return _bad(file, "unreadable_file", f"cannot be read ({error.strerror}).", "Check its rights.")


def _bad(file: str, check: str, reason: str, fix: str) -> BadFile:
    return BadFile(Fault(check, reason, file=file, action="file left out", fix=fix))


def _similar(path: Path) -> str:
    """Return a fix for a missing file: the same name in other case or place, if there is one."""
    try:
        for other in path.parent.iterdir():
            if other.name.lower() == path.name.lower():
                return f"There is '{other.name}': the case of letters matters."
    except OSError:
        return f"There is no folder '{path.parent.name}' either; paths are relative to the folder of runs.csv."
    return "Paths are relative to the folder of runs.csv."
