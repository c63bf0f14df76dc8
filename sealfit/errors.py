"""Everything the user can fix: one root, typed, each with the place and the fix."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal


@dataclass(frozen=True, slots=True)
class Fault:
    """One thing found wrong (or worth saying) in a campaign: where, what, what was done, how to fix it.

    A `Fault` with `severity` "error" stops a run if it concerns the campaign; one that concerns a file or a cell
    leaves that file or row out (`action`) and the run goes on (design: a fault of a file, a fault of a cell).
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

    def __str__(self) -> str:
        place = self.file or ""
        if self.line is not None:
            place += f":{self.line}"
        if self.stroke is not None:
            place += f" stroke {self.stroke}"
        parts = [place] if place else []
        if self.column is not None:
            parts.append(f"column '{self.column}'")
        if self.value is not None:
            parts.append(repr(self.value))
        head = ": ".join(parts)
        text = f"{head}: {self.reason}" if head else self.reason
        return f"{text} {self.fix}".strip()

    def as_dict(self) -> dict:
        """Return the fault as plain values, as `--json` prints it."""
        return {name: getattr(self, name) for name in self.__slots__}


class SealfitError(Exception):
    """Something the user can fix: one line on stderr, exit code 1."""

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
        place = self.file or ""
        if line is not None:
            place += f":{line}"
        head = ": ".join([p for p in (place, f"column '{column}'" if column else "") if p])
        super().__init__(" ".join(p for p in (f"{head}: {message}" if head else message, fix) if p))

    def _render_traceback_(self) -> list[str]:
        """Return what a notebook shows in place of a traceback: the program is not at fault, and the fix is said."""
        return [f"{type(self).__name__}: {self}"]

    def as_dicts(self) -> list[dict]:
        """Return `[{file, line, column, value, fix, reason}]`, the `errors` of `--json`."""
        place = {"file": self.file, "line": self.line, "column": self.column, "value": None}
        return [{**place, "fix": self.fix, "reason": self.message}]


class CampaignError(SealfitError):
    """The campaign as a whole cannot be used: config, runs.csv, missing folder, path outside, duplicates."""

    def __init__(self, faults: Sequence[Fault]):
        self.faults = tuple(faults)
        super().__init__("\n".join(str(fault) for fault in self.faults))

    def __reduce__(self):
        return type(self), (self.faults,)  # so that it comes back whole from a worker process

    def as_dicts(self) -> list[dict]:
        """Return one dict per fault."""
        return [fault.as_dict() for fault in self.faults]


class BadFile(SealfitError):
    """A trace file that must be left out; the run goes on without it. `faults` says why, the deciding one last."""

    def __init__(self, *faults: Fault):
        self.faults = faults
        super().__init__("\n".join(str(fault) for fault in faults))

    @property
    def fault(self) -> Fault:
        """The fault that decided."""
        return self.faults[-1]

    def as_dicts(self) -> list[dict]:
        """Return one dict per fault."""
        return [fault.as_dict() for fault in self.faults]


class ConfigError(SealfitError):
    """A config file that cannot be used: unknown key, wrong type, unsafe expression."""


class RequestError(SealfitError):
    """What was asked cannot be answered: a missing column in P.csv, a quantity that was not fitted."""


class StaleError(SealfitError):
    """A step's predecessor is missing or stale; the fix names the command to run."""


class OutError(SealfitError):
    """OUT cannot be written: it belongs to another campaign, another process writes it, or the disk is full."""


class ParameterError(SealfitError):
    """A value outside the range for which an equation holds, e.g. v_s <= 0."""


class FitError(SealfitError):
    """A fit that cannot be done with these data, with the condition and the parameter."""


class WorkerError(SealfitError):
    """A worker process died (killed, or out of memory) before it had answered."""
