"""What is known of a trace file before it is read, and what its name says."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from sealfit.config import Files
from sealfit.errors import ConfigError, shortened
from sealfit.ingest.columns import Columns, taken
from sealfit.ingest.expression import evaluate, parse
from sealfit.ingest.files import TEXT_COLUMNS, as_number, found_by
from sealfit.units import Conversion


@dataclass(frozen=True, slots=True)
class TraceRef:
    """One trace file and all that runs.csv, its name, header or constant columns say of the whole file.

    `file` is relative to the campaign folder, with forward slashes. `channels` always holds `run_id`,
    `repeat`, `specimen_id` and the condition columns (day 0 may lack those other than the days); what is not
    known is not there. `cut` says that the file may end within a number.
    """

    file: str
    channels: Mapping[str, float | str]
    cut: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class Listing(Sequence[TraceRef]):
    """The trace files of a campaign, or some of them, in order.

    `columns` hold the channels, `conditions` words; files of `cut` may end within a number.
    """

    files: list[str]
    columns: Columns
    conditions: list[str]
    cut: frozenset[str] = frozenset()

    def __len__(self) -> int:
        return len(self.files)

    def __getitem__(self, i: int) -> TraceRef:
        known = ((name, column[i]) for name, column in self.columns.items())
        channels = {name: value for name, value in known if value is not None}
        return TraceRef(self.files[i], channels, self.files[i] in self.cut)

    def take(self, files: np.ndarray) -> Listing:
        """Return some of the files, by their numbers, with the columns in which any of them has a value."""
        columns = taken(self.columns, files)
        filled = {name: c for name, c in columns.items() if any(value is not None for value in c)}
        own = [self.files[i] for i in files]
        return Listing(own, filled, [self.conditions[i] for i in files], self.cut.intersection(own))


# ---------------------------------------------------------------- names
# What the name of a trace file says: named parts of a pattern, value maps, templates and computed columns.

_FIELD = re.compile(r"\{([^{}]*)\}")
Named = Mapping[str, float | str]  # what a name says; helpers begin with `_`


def name_parts(file: str, settings: Files, conversions: Mapping[str, Conversion]) -> Named | None:
    """Return what the relative path `file` says under the config's `files`; None if it does not match.

    Every named group of `name_pattern` is a part, with the value of its map where that has one; `compute` and
    the templates of `columns` then add columns. Empty parts say nothing, nor does what is computed from their
    numbers. Numbers in other units than ours are converted, those of parts first. ConfigError if a template
    or an expression reads a part that the pattern does not have, or as `found_by`.

    Examples
    --------
    >>> rig = Files(name_pattern=r"(?P<_sign>n?)(?P<_rpm>\\d+)\\.csv", values={"_sign": {"": 1, "n": -1}},
    ...             compute={"speed_mm_s": "_sign * _rpm"}, columns={"run_id": "{_rpm} rpm"})
    >>> channels_of(name_parts("n120.csv", rig, {}))
    {'speed_mm_s': -120.0, 'run_id': '120 rpm'}
    """
    texts: dict[str, str] = {}
    values: dict[str, float | str] = {}

    def say(name: str, text: str, value: float | str) -> None:
        if name in conversions and isinstance(value, float):
            value = conversions[name].of_cell(value)
            text = f"{value:.12g}"
        texts[name], values[name] = text, value

    if settings.name_pattern is not None:
        match = found_by(settings.name_pattern, file, whole=True)
        if match is None:
            return None
        for name, text in match.groupdict(default="").items():
            known = settings.values.get(name, {})
            mapped = known.get(text, text)
            stays = text in known or name in (*TEXT_COLUMNS, *settings.text_parts)
            if isinstance(mapped, int | float):
                say(name, f"{mapped:g}", float(mapped))
            else:
                say(name, mapped, mapped if stays else _value(mapped))
    for name, expression in settings.compute.items():
        value = float(evaluate(parse(expression), values))
        absent = any(values[part] == "" for part in parse(expression).numbers)
        say(name, *(("", "") if absent else (f"{value:g}", value)))
    for name, template in settings.columns.items():
        text = _FIELD.sub(lambda found: _part(found.group(1), texts, template), template)  # noqa: B023
        say(name, text, text if name in TEXT_COLUMNS else _value(text))
    return {name: value for name, value in values.items() if value != "" or name.startswith("_")}


def channels_of(named: Named | None, helpers: Collection[str] = ()) -> dict[str, float | str]:
    """Return what a name says, of the helpers only those asked for; nothing where it does not match."""
    said = (named or {}).items()
    return {name: v for name, v in said if v != "" and (not name.startswith("_") or name in helpers)}


def fits_up_to(pattern: str, file: str) -> str:
    """Return the longest beginning of a path with which a match of the pattern can begin.

    Examples
    --------
    >>> fits_up_to(r"T(?P<T>\\d+)_d(?P<aging_days>\\d+)[.]csv", "T80_C20_d4.csv")
    'T80_'
    """
    begins = (file[:length] for length in range(len(file), 0, -1))
    with suppress(ConfigError):  # it takes too long
        return next((begin for begin in begins if found_by(pattern, begin, whole=True, cut=True)), "")
    return ""


def unmatched(file: str, pattern: str) -> tuple[str, str]:
    """Return why a path does not match the config's pattern, without the path, and the fix."""
    begin = fits_up_to(pattern, file)
    up_to = f"it fits up to '{begin}', then" if begin else "from its start"
    rest = f"'{shortened(file[len(begin) :], 30)}'" if begin != file else "nothing more"
    where = f"{up_to} the path has {rest}"
    reason = f"the whole path below the campaign folder does not match files.name_pattern: {where}."
    fix = "Rename it, widen the pattern, or list it under files.exclude."
    if "/" in file and found_by(pattern, file.rpartition("/")[2], whole=True):
        fix = "The pattern matches the name without its folders: begin it with '(?:.*/)?'."
    return reason, fix


def _value(text: str) -> float | str:
    number = as_number(text)
    return text if number is None else number


def _part(name: str, texts: Mapping[str, str], template: str) -> str:
    if name not in texts:
        reason = f"template {template!r} reads a part '{name}' that the name has not."
        raise ConfigError(reason, fix=f"Parts: {', '.join(texts) or 'none'}.")
    return texts[name]
