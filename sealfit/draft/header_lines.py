"""What the header lines of trace files say of the whole file: when it was started and how the rig was set."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime

from sealfit.draft.vocabulary import Unit, name_and_unit, plain, setting, unit_of
from sealfit.ingest.files import as_number
from sealfit.units import conversion

SETTINGS = {
    "temperature_C": "temperature",
    "compression_ratio_pct": "share",
    "aging_days": "time",
    "load_N": "force",
    "speed_mm_s": "speed",
}
"""What header lines may set, and what its unit measures."""

_LINE = re.compile(r'^\W*(?P<key>[^\W\d][^:=;\t"]*?)"?\s*[:=;,\t]+\s*"?(?P<value>.*)$')
_SPECIMEN = re.compile(r"(specimen|probe|sample|pruefling|muster)( (id|nr|no|number|nummer|name))?")
_NUMBER = re.compile(r"^[-+]?\d+(?:[.,]\d+)?(?=$|[\s;,\t\"°%A-Za-zµ])")
_SIZE = re.compile(r"[-+]?\d+(?:[.,]\d+)?(?:[eE][-+]?\d+)?")
_SAMPLED = r"(?:sampl|abtast|mess|scan|acqui|logg|data|daten|campion|echantillon|muestre)"
_RATE = re.compile(rf"{_SAMPLED}.*(?:rate|freq)|(?:rate|freq).*{_SAMPLED}")  # not that of a motion
_STEP = re.compile(rf"{_SAMPLED}.*(?:interval|period)|(?:interval|period).*{_SAMPLED}|\bdt\b|\bdelta [tx]\b")
RATE = "_rate"
"""The header field that an expression for the rate reads; by its first letter it is no channel."""
_ISO = re.compile(r"20\d\d-[01]\d-[0-3]\d[T ][0-2]\d:[0-5]\d(?::[0-5]\d)?(?!\d)")
_DAYS = (
    (re.compile(r"[0-3]?\d\.[01]?\d\.20\d\d"), "%d.%m.%Y"),
    (re.compile(r"20\d\d-[01]\d-[0-3]\d"), "%Y-%m-%d"),
    (re.compile(r"20\d\d/[01]\d/[0-3]\d"), "%Y/%m/%d"),
    (re.compile(r"(?<!\d)[01]?\d/[0-3]?\d/20\d\d"), "%m/%d/%Y"),
    (re.compile(r"[0-3]?\d/[01]?\d/20\d\d"), "%d/%m/%Y"),
)
CLOCK = re.compile(
    r"(?P<clock>[0-2]?\d:[0-5]\d(?P<second>:[0-5]\d)?)(?:[.,]\d+)?(?P<half>\s*[AP]M)?", re.IGNORECASE
)


@dataclass(frozen=True, slots=True)
class Setting:
    """A setting in a header line: our name of it, the pattern that finds it, its unit and the line.

    `counts` is whether no two files have the same.
    """

    ours: str
    pattern: str
    unit: Unit | None
    line: int
    text: str
    counts: bool = False


@dataclass(frozen=True, slots=True)
class When:
    """A date in header lines: the pattern that finds it and its format, "" for ISO 8601.

    `clock` is the pattern for the time of day where that stands in a line of its own.
    """

    pattern: str
    format: str
    line: int
    text: str
    clock: str = ""


def settings_in(headers: Sequence[Sequence[str]], decimal: str) -> list[Setting]:
    """Return the settings that the header lines of every file give, those that their words name."""
    found: dict[str, Setting] = {}
    for number, line in enumerate(headers[0], start=1):
        match = _LINE.match(line)
        if match and match["key"].count("/") > 1:
            continue  # group/channel/property of a TDMS file: it is about the channel
        if match and _SPECIMEN.fullmatch(plain(match["key"])):
            pattern = _after(match["key"], r'([^\s;,"][^;,\t"]*)')
            values = _found(pattern, headers)
            if "" not in values and len(set(values)) > 1:
                counts = len(set(values)) == len(values)
                found.setdefault(
                    "specimen_id", Setting("specimen_id", pattern, None, number, line.strip(), counts)
                )
            continue
        number_found = _NUMBER.match(match["value"].strip()) if match else None
        if number_found is None or as_number(number_found.group(), decimal or ".") is None:
            continue
        name, unit = name_and_unit(match["key"])
        rest = match["value"].strip()[number_found.end() :].strip(' ;,\t"')
        unit = unit or unit_of(rest)
        ours = setting(name)
        if ours not in SETTINGS or ours in found or (unit is not None and unit.dimension != SETTINGS[ours]):
            continue
        pattern = _after(match["key"], r"([-+]?[\d.,]*\d)")
        if _everywhere(pattern, headers):
            found[ours] = Setting(ours, pattern, unit, number, line.strip())
    return list(found.values())


def rate_in(headers: Sequence[Sequence[str]], decimal: str) -> tuple[float | str, str, str] | None:
    """Return the rows per second that a header line gives, the line, and the pattern of its number; or None.

    Where files differ in them they are an expression over the number, `RATE`.
    """
    for line in headers[0]:
        match = _LINE.match(line)
        size = _SIZE.match(match["value"]) if match else None
        value = as_number(size.group(), decimal or ".") if size else None
        if not value or value < 0:
            continue
        pattern = _after(match["key"], f"({_SIZE.pattern})")
        if not _everywhere(pattern, headers):
            continue
        differ = len(set(_found(pattern, headers))) > 1
        words, unit = plain(match["key"]), name_and_unit(match["key"])[1]
        unit = unit or unit_of(match["value"][size.end() :].strip(' ;,\t"'))
        if _RATE.search(words):
            scale = 1000.0 if unit is not None and unit.name == "kHz" else 1.0
            return f"{scale:g} * {RATE}" if differ else value * scale, line.strip(), pattern
        if _STEP.search(words) and (unit is None or unit.dimension == "time"):
            scale = conversion(unit.name if unit else "s", "s")(1.0)
            rate = f"1 / ({scale:g} * {RATE})" if differ else float(f"{1 / (scale * value):.9g}")
            return rate, line.strip(), pattern
    return None


def started_in(headers: Sequence[Sequence[str]]) -> When | None:
    """Return the date that the header lines of every file give; None if there is none."""
    for number, line in enumerate(headers[0], start=1):
        if match := _ISO.search(line):
            pattern = _leading(line[: match.start()]) + r"(20\d\d-\d\d-\d\d[T ]\d\d:\d\d(?::\d\d)?)"
            if _everywhere(pattern, headers):
                return When(pattern, "", number, line.strip())
    for number, line in enumerate(headers[0], start=1):
        for days, spelled in _DAYS:
            match = days.search(line)
            when = match and _with_clock(headers, number, line, match, spelled)
            if when and all(_is_day(text, days, spelled) for text in _found(when.pattern, headers)):
                return when
    return None


def _is_day(text: str, days: re.Pattern, spelled: str) -> bool:
    try:
        return bool(datetime.strptime(days.search(text)[0], spelled))
    except (TypeError, ValueError):  # 14/03/2024 is no date where the month stands first
        return False


def _with_clock(headers, number: int, line: str, match: re.Match, spelled: str) -> When | None:
    """Return the date with the time of day after it in the same line, or in the next line."""
    start = _leading(line[: match.start()])
    clock = CLOCK.search(line, match.end())
    if clock is not None:
        between = line[match.end() : clock.start()]
        full = f"{spelled}{between.replace('%', '%%')}{_clock_format(clock)}"
        end = clock.end() if clock["half"] else clock.end("clock")  # strptime reads no fraction of a second
        pattern = start + "(" + re.sub(r"\d+", r"\\d+", re.escape(line[match.start() : end])) + ")"
        pattern = re.sub(r"[AP]M\)$", "[AP]M)", pattern).replace(r"\ ", " ")
        return When(pattern, full, number, line.strip()) if _everywhere(pattern, headers) else None
    pattern = start + "(" + re.sub(r"\d+", r"\\d+", re.escape(match.group())) + ")"
    following = headers[0][number] if number < len(headers[0]) else ""
    beside = CLOCK.search(following)
    if not _everywhere(pattern, headers):
        return None
    if beside is None:
        return When(pattern, spelled, number, line.strip())
    own = _leading(following[: beside.start()]) + r"(\d+:\d+(?::\d+)?)"
    return When(pattern, f"{spelled} {_clock_format(beside)}", number, line.strip(), own)


def _clock_format(clock: re.Match) -> str:
    hours = "%I" if clock["half"] else "%H"
    return f"{hours}:%M" + (":%S" if clock["second"] else "") + (" %p" if clock["half"] else "")


def _leading(text: str) -> str:
    """Return a pattern for what stands before the date in its line: the words, and whatever numbers."""
    words = re.escape(text).replace(r"\ ", " ").replace("\\\t", r"\t")
    return "^" + re.sub(r"\d+(?:[.,]\d+)?", r"[\\d.,]+", words)


def _after(key: str, value: str) -> str:
    """Return the pattern of a value behind the key of its line."""
    return rf'^\W*{re.escape(key)}"?[\s:=;,"]*'.replace(r"\ ", " ") + value


def _everywhere(pattern: str, headers: Sequence[Sequence[str]]) -> bool:
    return "" not in _found(pattern, headers)


def _found(pattern: str, headers: Sequence[Sequence[str]]) -> list[str]:
    """Return what a pattern finds in the header lines of each file, "" for nothing."""
    searched = ((re.search(pattern, line) for line in header) for header in headers)
    return [next((match[1].strip() for match in found if match), "") for found in searched]
