"""Everything the user can fix: one root, typed, each with the place and the fix."""

from __future__ import annotations

import contextlib
import difflib
import errno
import os
import re
import shlex
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal


@dataclass(frozen=True, slots=True)
class Fault:
    """One thing found wrong (or worth saying) in a campaign: where, what, what was done, how to fix it.

    An error of the campaign stops a run; one of a file or a cell leaves that file or row out (`action`).
    """

    check: str  # short name of the rule, e.g. "missing_column"
    reason: str  # a sentence: what was found
    file: str | None = None  # relative to the campaign folder
    stroke: int | None = None
    line: int | None = None  # 1-based, as an editor shows it
    column: str | None = None
    value: str | float | None = None
    severity: Literal["info", "warning", "error"] = "error"
    action: Literal["kept", "row left out", "file left out", "stroke left out", "stopped"] = "stopped"
    fix: str = ""

    @classmethod
    def of_row(cls, row: Mapping) -> Fault:
        """Return the fault of a row of table `quality`, whose numbers may have become floats beside NaN."""
        known = {name: value for name, value in row.items() if value is not None and value == value}
        return cls(**{**known, **{name: int(known[name]) for name in ("stroke", "line") if name in known}})

    def __str__(self) -> str:
        place = shortened(self.file or "", LONGEST_PATH)
        if self.line is not None:
            place += f":{self.line}"
        if self.stroke is not None:
            place += f" stroke {self.stroke}"
        parts = [place] if place else []
        if self.column is not None:
            parts.append(f"column '{self.column}'")
        if self.value is not None and (shown := _shown(self.value)) not in self.reason.split():
            parts.append(shown)
        return printable(f"{': '.join([*parts, self.reason])} {self.fix}".strip())

    def as_dict(self) -> dict:
        """Return the fault as plain values, as `--json` prints it; a long cell is cut."""
        value = shortened(self.value, LONGEST_PATH) if isinstance(self.value, str) else self.value
        return {name: getattr(self, name) for name in self.__slots__} | {"value": value}


# Severity and action of findings that leave nothing out, a row, or a stroke: fields of `Fault`.
KEPT = {"severity": "warning", "action": "kept"}
NOTED = {"severity": "info", "action": "kept"}
ROW_OUT = {"severity": "warning", "action": "row left out"}
STROKE_OUT = {"severity": "error", "action": "stroke left out"}
LONGEST_VALUE = 80  # characters of a cell that a message shows
LONGEST_PATH = 400  # and of the path of a file


def _shown(value: str | float) -> str:
    """Return a value as a message shows it: text in quotes, a number with six digits."""
    return f"{value:.6g}" if isinstance(value, float) else shortened(repr(value))


def shortened(text: str, most: int = LONGEST_VALUE) -> str:
    """Return a text, or its beginning and three dots where it is longer than so many characters."""
    return text if len(text) <= most else f"{text[: most - 3]}..."


def printable(text: str) -> str:
    """Return a text with control characters, and bytes of names that are not UTF-8, as escapes.

    >>> printable("caf\\udce9\\x1b[2J")
    'caf\\\\xe9\\\\x1b[2J'
    """
    return "".join(c if c.isprintable() or c == "\n" else _escaped(c) for c in text)


def _escaped(character: str) -> str:
    if "\udc80" <= character <= "\udcff":  # stands for a byte
        return f"\\x{ord(character) - 0xDC00:02x}"
    return character.encode("unicode_escape").decode()


# ---------------------------------------------------------------- a fault that many files share

EXAMPLES = 3  # places that such a message names; no more files than that are named each by itself
RUNS_TABLES = ("runs.csv", "runs.xlsx", "runs.parquet")  # their lines are trace files


def grouped(faults: Iterable[Fault]) -> list[list[Fault]]:
    """Return the faults, grouped if more than `EXAMPLES` places share them, in the order of their first.

    A place is a line, a stroke or a file. Faults are shared that differ in their place, their value and in
    numbers of their reason only.
    """
    order: dict[int, int] = {}
    alike: dict[tuple, list[Fault]] = {}
    for place, fault in enumerate(faults):
        order.setdefault(id(fault), place)
        alike.setdefault(_shared(fault), []).append(fault)
    found = []
    for group in alike.values():
        shared = len({(fault.file, fault.stroke, fault.line) for fault in group}) > EXAMPLES
        found += [group] if shared else [[fault] for fault in group]
    return sorted(found, key=lambda group: order[id(group[0])])


def told(group: Sequence[Fault]) -> str:
    """Return the message of one group: the fault, or how many files have it and examples.

    >>> told([Fault("empty_file", "is empty.", file=f"{i}.csv", fix="Export it again.") for i in range(84)])
    '84 files: is empty. For example 0.csv; 1.csv; 2.csv. Export it again.'
    """
    if len(group) == 1:
        return str(group[0])
    first = group[0]
    column = f"column '{first.column}': " if first.column is not None else ""
    reason = f"{first.reason} For example " if one_reason(group) else "for example "
    return f"{how_many(group)}: {column}{reason}{'; '.join(examples(group))}. {first.fix}".strip()


def how_many(group: Sequence[Fault]) -> str:
    """Return how many files a group concerns, or lines or strokes of one, and how often if that is more."""
    files = len({_file(fault) for fault in group})
    for what in ("line", "stroke") if files == 1 else ():
        if getattr(group[0], what) is not None:
            return f"{len({getattr(fault, what) for fault in group})} {what}s of {group[0].file}"
    return f"{files} files" if files == len(group) else f"{files} files, {len(group)} times"


def examples(group: Sequence[Fault]) -> list[str]:
    """Return the places of a group, three at most, with value, and reason if it differs between files."""
    whole, places = one_reason(group), {}
    several = len({fault.file for fault in group}) > 1
    for fault in group:
        places.setdefault(_file(fault) if several else (fault.file, fault.stroke, fault.line), fault)
    found = []
    for fault in list(places.values())[:EXAMPLES]:
        place = f"{fault.file or ''}{'' if fault.line is None else f':{fault.line}'}"
        place += "" if fault.stroke is None else f" stroke {fault.stroke}"
        value = "" if fault.value is None else _shown(fault.value)
        said = value if whole else fault.reason.rstrip(".")
        found.append(": ".join(part for part in (place, said) if part))
    return found


def one_reason(group: Sequence[Fault]) -> bool:
    """Return whether all faults of a group have the same reason, word by word."""
    return len({fault.reason for fault in group}) == 1


def _file(fault: Fault) -> tuple:
    return (fault.file, fault.line) if fault.file in RUNS_TABLES else (fault.file,)


def _shared(fault: Fault) -> tuple:
    """Return what the faults of a group have in common."""
    words = f"{fault.reason}\0{fault.fix}"
    words = re.sub(r"\d[\d.,]*", "#", words.replace(fault.file, "") if fault.file else words)
    return (fault.check, fault.severity, fault.action, fault.column, fault.file in RUNS_TABLES, words)


# ---------------------------------------------------------------- what a mistyped name most likely means


def nearest(name: str, known: Iterable[str]) -> str:
    """Return the known name that `name` most likely means: equal but for case, or a close one; "" if none."""
    known = [other for other in known if other]
    by_case = [other for other in known if other.lower() == name.lower()]
    folded = {other.lower(): other for other in known}
    close = difflib.get_close_matches(name.lower(), list(folded), n=1, cutoff=0.6)
    return by_case[0] if by_case else folded[close[0]] if close else ""


def did_you_mean(path: Path, fits: Callable[[Path], bool] = Path.is_dir, campaign: Path | None = None) -> str:
    """Return a fix for a missing path: the nearest name that `fits`, beside it or its folder; "" if none.

    With `campaign` the path is given as a trace file's, relative to that folder.
    """
    parent = path.absolute().parent
    missing = None
    while not parent.is_dir():
        missing, parent = parent, parent.parent
    try:
        shown = [child for child in parent.iterdir() if not child.name.startswith(".")]
        there = sorted(child.name for child in shown if missing or fits(child))
    except OSError:
        return ""
    wanted = missing or path.absolute()
    # Without endings, which make any names near where they are alike; of equal names the same ending counts.
    there.sort(key=lambda name: Path(name).suffix == wanted.suffix)
    names = {Path(name).stem: name for name in there}
    likely = names.get(nearest(wanted.stem, names), "")
    meant = parent / likely if missing else path.parent / likely
    meant = meant if campaign is None else os.path.relpath(meant, campaign)
    return f"Did you mean {quoted(meant)}?" if likely else ""


def quoted(path: Path | str) -> str:
    """Return a path or a name as a shell reads it."""
    return shlex.quote(str(path))


# ---------------------------------------------------------------- errors


class SealfitError(Exception):
    """Something the user can fix: one line on stderr, exit code 1."""

    faults: tuple[Fault, ...] = ()  # of a campaign or a file

    def __init__(
        self,
        message: str,
        *,
        file: str | Path | None = None,
        line: int | None = None,
        column: str | None = None,
        fix: str = "",
    ):
        self.message, self.line, self.column, self.fix = message, line, column, fix
        self.file = str(file) if file is not None else None
        super().__init__(str(Fault("", message, self.file, line=line, column=column, fix=fix)))

    def _render_traceback_(self) -> list[str]:
        """Return what a notebook shows, not a traceback: the program is not at fault, and the fix is said."""
        return [f"{type(self).__name__}: {self}"]

    def as_dicts(self) -> list[dict]:
        """Return `[{file, line, column, value, fix, reason}]`, the `errors` of `--json`, one per fault."""
        if self.faults:
            return [fault.as_dict() for fault in self.faults]
        place = {"file": self.file, "line": self.line, "column": self.column, "value": None}
        return [{**place, "fix": self.fix, "reason": self.message}]


class CampaignError(SealfitError):
    """The campaign as a whole cannot be used: config, runs.csv, missing folder, path outside, duplicates."""

    def __init__(self, faults: Sequence[Fault]):
        self.faults = tuple(faults)
        super().__init__("\n".join(told(group) for group in grouped(self.faults)))

    def __reduce__(self):
        return type(self), (self.faults,)  # so that it comes back whole from a worker process


class BadFile(SealfitError):
    """A trace file that is left out; the run goes on without it. `faults` says why, the deciding one last."""

    def __init__(self, *faults: Fault):
        self.faults = faults
        super().__init__("\n".join(str(fault) for fault in faults))

    @property
    def fault(self) -> Fault:
        """The fault that decided."""
        return self.faults[-1]


class ConfigError(SealfitError, ValueError):  # as which pydantic names the key whose value is refused
    """A config file that cannot be used: unknown key, wrong type, unsafe expression."""


class RequestError(SealfitError):
    """What was asked cannot be answered: a missing column in P.csv, a quantity that was not fitted."""


class StaleError(SealfitError):
    """A step's predecessor is missing or stale; the fix names the command to run."""


class OutError(SealfitError):
    """OUT cannot be written: it is another campaign's, another process writes it, or the disk is full."""


class ParameterError(SealfitError):
    """A value outside the range for which an equation holds, e.g. v_s <= 0."""


class FitError(SealfitError):
    """A fit that cannot be done with these data, with the condition and the parameter."""


class WorkerError(SealfitError):
    """A worker process died (killed, or out of memory) before it had answered."""


@contextlib.contextmanager
def disk(path: Path, option: str = "--out") -> Iterator[None]:
    """Turn an error of the file system into an OutError of `path`, for which the `option` stands."""
    try:
        yield
    except OSError as error:
        reason = error.strerror or str(error)
        fix = f"Choose another {option}, or fix the rights of the folder."
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            fix = "Free some space and run the command again."
        raise OutError(f"cannot be written ({reason}).", file=path, fix=fix) from error


_NO_MEMORY = (
    "failed to map segment from shared object", "annot allocate memory", "can't start new thread",
    "Failed to launch worker thread", "without setting an exception", "without exception set",
)  # fmt: skip
MEMORY = "memory ran out; what was complete before is kept."
MORE_MEMORY = "Use fewer workers (--workers 1), or a computer with more memory."


def memory_ran_out(error: BaseException) -> bool:
    """Whether an error, or one that led to it, says that the system had no memory left.

    A shared object that cannot be mapped is an ImportError, a mapped file an OSError, a thread a RuntimeError
    or an exception of Arrow's own; a module in C that is loaded and gives up is a SystemError.

    >>> memory_ran_out(ImportError("libm.so: failed to map segment from shared object"))
    True
    """
    if isinstance(error, MemoryError) or (isinstance(error, OSError) and error.errno == errno.ENOMEM):
        return True
    arrows = type(error).__module__ == "pyarrow.lib"
    said_by_library = arrows or isinstance(error, ImportError | OSError | RuntimeError | SystemError)
    if said_by_library and any(sign in str(error) for sign in _NO_MEMORY):
        return True
    before = error.__cause__ or error.__context__
    return before is not None and memory_ran_out(before)
