"""File names cut into words, numbers and what stands between, and the pattern that finds the pieces again."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from sealfit.config import AGING_CONDITION
from sealfit.draft.vocabulary import DIRECTIONS

SUFFIX = re.compile(r"\.(?=[^./]*[^\W\d])[^./]*$")
"""The ending of a file's name: with a letter, as in `v0.5` the last figure is none."""

_TOKEN = re.compile(
    r"(?P<date>(?<!\d)20\d\d(?P<_d>[-_.]?)(?:0[1-9]|1[0-2])(?P=_d)(?:0[1-9]|[12]\d|3[01])(?!\d)"
    r"(?:[T_\- ](?:[01]\d|2[0-3])(?P<_t>[-:.h]?)[0-5]\d(?:(?P=_t)[0-5]\d)?(?!\d))?)"
    r"|(?P<dmy>(?<!\d)(?:0[1-9]|[12]\d|3[01])(?P<_g>[-.])(?:0[1-9]|1[0-2])(?P=_g)20\d\d(?!\d))"
    r"|(?P<word>(?<![^\W\d_])(?:[mµuc]?m|in)[-_ /]?(?:per|p)?(?:s|min)(?![^\W\d_])|[^\W\d_]+|[%°]+[^\W\d_]*)"
    r"|(?P<number>(?:(?:(?<=[/_\s=(])|^)-)?\d+(?:[.,]\d+|p\d+)?)"
    r"|(?P<sep>[^\w%°]+|_+)"
)
_ISO = re.compile(r"(20\d\d)([-_.]?)(\d\d)\2(\d\d)(?:([T_\- ])(\d\d)([-:.h]?)(\d\d)(?:\7(\d\d))?)?$")


@dataclass(frozen=True, slots=True)
class Token:
    """A piece of a name: `kind` is date, dmy, word, number or sep."""

    kind: str
    text: str


@dataclass(frozen=True)
class Part:
    """A piece of the names that stands for something.

    `ours` is the column that it gives, "" for none; `group` names it in the pattern, "" for a piece that is
    matched only. `texts` are its different values; `expression` what computes the column where it is not the
    number itself; `unit` that of the number, "" for the column's own.
    """

    at: int
    ours: str
    group: str
    pattern: str
    texts: tuple[str, ...]
    why: str
    expression: str = ""
    unit: str = ""
    doubt: str = ""


@dataclass(frozen=True)
class Names:
    """What names say, ready for a config: the pattern, value maps, expressions, templates and units."""

    pattern: str | None
    parts: tuple[Part, ...] = ()
    values: Mapping[str, Mapping[str, float | str]] = field(default_factory=dict)
    compute: Mapping[str, str] = field(default_factory=dict)
    columns: Mapping[str, str] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)
    unmatched: tuple[str, ...] = ()

    @property
    def given(self) -> set[str]:
        """Our columns that the names give."""
        return {part.ours for part in self.parts if part.ours} | set(self.columns)


def tokens(name: str) -> list[Token]:
    """Return the pieces of a path without its suffix.

    Examples
    --------
    >>> [token.text for token in tokens("T80_d4/v0.5 mm_s")]
    ['T', '80', '_', 'd', '4', '/', 'v', '0.5', ' ', 'mm_s']
    """
    return [Token(match.lastgroup, match.group()) for match in _TOKEN.finditer(name)]


def shape_of(pieces: Sequence[Token]) -> tuple:
    """Return what names that are cut alike have in common."""
    return tuple((token.kind, token.text if token.kind == "sep" else "") for token in pieces)


def as_float(text: str) -> float:
    """Return the number in a part of a name: 0.5, 0,5 and 0p5 are half."""
    return float(text.replace(",", ".").replace("p", "."))


# ---------------------------------------------------------------- pattern
# The regular expression and the settings that go with it.


def pattern_of(
    rows: Sequence[Sequence[Token]],
    parts: Sequence[Part],
    suffix: str,
    middle: tuple[int, int] | None,
    words: Sequence[str],
) -> str:
    """Return the regular expression that finds parts of names; `middle` is what one of the words replaces."""
    optional = next((part for part in parts if part.texts[0] == ""), None)
    by_place = {part.at: part for part in parts if part is not optional}
    pieces = []
    for at, token in enumerate(rows[0]):
        part = by_place.get(at)
        if part is None:
            pieces.append(re.escape(token.text) if token.kind != "number" else r"\d+(?:[.,p]\d+)?")
        elif part.group.startswith("_date"):
            pieces.append(_date_pattern(token.text, token.kind))
        else:
            pieces.append(f"(?P<{part.group}>{part.pattern})" if part.group else f"(?:{part.pattern})")
        if optional is not None and optional.at == at:
            pieces[-1] = f"(?P<{optional.group}>{optional.pattern}){pieces[-1]}"
    if middle is not None:
        first, last = middle
        inner = "".join(pieces[first:last])
        pieces[first:last] = [f"(?:{inner}|{'|'.join(map(re.escape, words))})"]
    return "".join(pieces).replace(r"\ ", " ").replace(r"\-", "-").replace(r"\%", "%") + suffix


def _date_pattern(text: str, kind: str) -> str:
    if kind == "dmy":
        mark = re.escape(text[2])
        return rf"(?P<_day>\d\d){mark}(?P<_month>\d\d){mark}(?P<_year>\d{{4}})"
    match = _ISO.match(text)
    between = re.escape(match[2])
    pattern = rf"(?P<_year>\d{{4}}){between}(?P<_month>\d\d){between}(?P<_day>\d\d)"
    if match[5] is not None:
        colon = re.escape(match[7])
        pattern += rf"{re.escape(match[5])}(?P<_hour>\d\d){colon}(?P<_minute>\d\d)"
        pattern += rf"{colon}(?P<_second>\d\d)" if match[9] is not None else ""
    return pattern


def settings_with(pattern: str, parts: Sequence[Part], middle: tuple[int, int] | None) -> Names:
    """Return the value maps, expressions, templates and units that go with the pattern."""
    values: dict[str, dict[str, float | str]] = {}
    compute: dict[str, str] = {}
    for part in parts:
        if not part.group or part.ours == "started_at":
            continue
        if any(mark in text for text in part.texts for mark in ",p") and part.ours != "rubber":
            values[part.group] = {text: as_float(text) for text in part.texts if text[:1] in "-0123456789"}
        replaced = middle is not None and middle[0] <= part.at < middle[1]
        if replaced and (part.ours == "aging_days" or part.expression):
            values.setdefault(part.group, {})[""] = 0.0
        if part.ours == "direction":
            signs = {text: DIRECTIONS.get(text.lower(), -1 if text else 1) for text in part.texts}
            values[part.group] = {text: float(sign) for text, sign in signs.items()}
        elif part.expression or (part.group.startswith("_") and part.ours != "specimen_id"):
            compute[part.ours] = (part.expression or "{}").format(part.group)
    columns = _date_template(pattern) | _specimen_template(parts)
    compute |= signed_speed(parts, compute)
    units = {part.ours: part.unit for part in parts if part.unit}
    return Names(pattern, tuple(parts), values, compute, columns, units)


def _date_template(pattern: str) -> dict[str, str]:
    if "_year" not in pattern:
        return {}
    text = "{_year}-{_month}-{_day}"
    if "_hour" in pattern:
        text += "T{_hour}:{_minute}" + (":{_second}" if "_second" in pattern else ":00")
    return {"started_at": text}


def _specimen_template(parts: Sequence[Part]) -> dict[str, str]:
    """Return the template of specimen_id: numbers that start again in every condition name pieces of each."""
    if not any(part.ours == "specimen_id" for part in parts):
        return {}
    settings = [part.group for part in parts if part.ours in ("rubber", *AGING_CONDITION)]
    return {"specimen_id": " ".join("{" + name + "}" for name in [*settings, "_specimen"])}


def signed_speed(parts: Sequence[Part], compute: Mapping[str, str]) -> dict[str, str]:
    """Return the expression of a speed with the sign of its direction, where names say it in a word."""
    if not any(part.ours == "direction" for part in parts):
        return {}
    speed = next((part for part in parts if part.ours == "speed_mm_s"), None)
    if speed is None:
        return {"direction_set": "_direction"}
    return {"speed_mm_s": f"_direction * ({compute.get('speed_mm_s', speed.group)})"}


def suffix_pattern(files: Sequence[str]) -> str:
    """Return the pattern of the suffixes of files."""
    endings = sorted({match.group() for file in files if (match := SUFFIX.search(file))})
    if len(endings) == 1:
        return re.escape(endings[0])
    return "(?:" + "|".join(re.escape(ending) for ending in endings) + ")" if endings else ""
