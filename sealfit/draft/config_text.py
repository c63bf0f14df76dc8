"""Guesses and doubts as the text of a config: TOML, each key with its evidence above it."""

import json
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from sealfit.draft.dialect import When
from sealfit.units import Unit, Units, unit_of

WIDTH = 110  # characters of a comment's line
SECTIONS = (
    "", "files", "files.columns", "files.values", "files.compute", "files.units", "files.runs_columns",
    "runs.compute", "trace", "trace.columns", "trace.header_fields", "trace.compute", "quantities",
    "strokes",
)  # fmt: skip

Value = str | int | float | bool | list | dict


@dataclass(frozen=True, slots=True)
class Guess:
    """A key of the config with its value, and what speaks for it."""

    key: str  # with its table: trace.columns.time_s
    value: Value
    evidence: str


@dataclass(frozen=True, slots=True)
class Doubt:
    """What could not be determined: about which key, what was found, and what to do."""

    key: str
    reason: str
    fix: str
    lines: tuple[str, ...] = ()  # of config, written as comments: to be switched on by hand

    def as_dict(self) -> dict:
        """Return the doubt as plain values."""
        return {"key": self.key, "reason": self.reason, "fix": self.fix}


@dataclass
class Notes:
    """Guesses and doubts, collected in the order in which they are made."""

    guesses: list[Guess] = field(default_factory=list)
    doubts: list[Doubt] = field(default_factory=list)

    def guess(self, key: str, value: Value, evidence: str) -> None:
        """Add a guess."""
        self.guesses.append(Guess(key, value, evidence))

    def doubt(self, key: str, reason: str, fix: str, lines: Sequence[str] = ()) -> None:
        """Add a doubt."""
        self.doubts.append(Doubt(key, reason, fix, tuple(lines)))


def file_column(name: str | int, unit: Unit | None, ours: str) -> Value:
    """Return a column of a file as a config writes it: with its unit where that is not the unit of `ours`."""
    return name if is_own_unit(unit, ours) else {"name": name, "unit": unit.name}


def is_own_unit(unit: Unit | None, ours: str) -> bool:
    """Return whether a unit is that of our column, or not known."""
    return unit is None or unit == unit_of(Units().of(ours))


def date_keys(when: When) -> dict[str, Value]:
    """Return the keys of the config that a date in header lines needs."""
    fields, files = "trace.header_fields", {"files.date_format": when.format} if when.format else {}
    if not when.clock:
        return {f"{fields}.started_at": when.pattern, **files}
    together = {"files.started_at": {"date": "started_day", "time": "started_clock"}}
    return {f"{fields}.started_day": when.pattern, f"{fields}.started_clock": when.clock, **together, **files}


def literal(text: str) -> str:
    """Return a string as TOML writes it, without escapes where it can."""
    return f"'{text}'" if "'" not in text and text.isprintable() else json.dumps(text, ensure_ascii=False)


def toml(value: Value) -> str:
    """Return a value as TOML.

    Examples
    --------
    >>> toml({"": 0.0, "a b": "x"}), toml(["*.csv"]), toml(True)
    ("{ '' = 0.0, 'a b' = 'x' }", "['*.csv']", 'true')
    """
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, int | float):
        return repr(value)
    if isinstance(value, str):
        return literal(value)
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{_key(k)} = {toml(v)}" for k, v in value.items()) + " }"
    return "[" + ", ".join(toml(one) for one in value) + "]"


def _key(name: str) -> str:
    bare = name.isascii() and name.replace("_", "").replace("-", "").isalnum()
    return name if bare else literal(name)


def config_text(name: str, folder: str, notes: Notes) -> str:
    """Return the whole config."""
    count = len(notes.doubts)
    doubted = {0: "Nothing is", 1: "One thing is"}.get(count, f"{count} things are")
    lines = _comment(f"Drafted by `sealfit init {folder}`. Each guess has its evidence above it.")
    lines += _comment(f"{doubted} marked DOUBT. Run `sealfit check` with this file.")
    lines.append(f"name = {literal(name)}")
    doubts: dict[str, list[str]] = {}
    for doubt in notes.doubts:
        about = _comment(f"DOUBT: {doubt.reason} {doubt.fix}") + [f"#     {line}" for line in doubt.lines]
        doubts.setdefault(doubt.key, []).extend(about)
    for section in SECTIONS:
        guesses = [guess for guess in notes.guesses if guess.key.rpartition(".")[0] == section]
        if not guesses and section not in doubts:
            continue
        lines += ["", f"[{section}]"] if section else []
        lines += doubts.pop(section, [])
        for guess in guesses:
            lines += _comment(guess.evidence) + doubts.pop(guess.key, [])
            lines.append(f"{_key(guess.key.rpartition('.')[2])} = {toml(guess.value)}")
    rest = [line for about in doubts.values() for line in about]
    return "\n".join([*lines, *([""] if rest else []), *rest]) + "\n"


def _comment(text: str) -> list[str]:
    printable = "".join(char if char.isprintable() else " " for char in text)
    return [f"# {line}" for line in textwrap.wrap(printable, WIDTH - 2)] if printable else []
