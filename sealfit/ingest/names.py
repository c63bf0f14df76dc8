"""What the name of a trace file says: named parts of a pattern, value maps, templates and computed columns."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass

from sealfit.config import Files
from sealfit.errors import ConfigError
from sealfit.ingest.expression import evaluate, parse
from sealfit.ingest.text import as_number

TEXT_COLUMNS = ("run_id", "specimen_id", "started_at")  # "007" is a name here, not the number 7
_FIELD = re.compile(r"\{([^{}]*)\}")


@dataclass(frozen=True, slots=True)
class NameParts:
    """What a name says; `matched` is False where the pattern does not match it. Helpers begin with `_`."""

    matched: bool
    values: Mapping[str, float | str]

    @property
    def channels(self) -> dict[str, float | str]:
        """The values that are channels: all but the helpers."""
        return {name: value for name, value in self.values.items() if not name.startswith("_")}


SAYS_NOTHING = NameParts(True, {})


def names_speak(settings: Files) -> bool:
    """Whether names of files say anything under the config's `files`."""
    return bool(settings.name_pattern is not None or settings.compute or settings.columns)


def name_parts(file: str, settings: Files) -> NameParts:
    """Return what the relative path `file` says under the config's `files`.

    Every named group of `name_pattern` is a part; a part with a value map takes the mapped value where the map has
    one; numbers become numbers; `compute` and the templates of `columns` then add columns. Empty parts say nothing.

    Raises
    ------
    ConfigError
        If a template or an expression reads a part that the pattern does not have.

    Examples
    --------
    >>> rig = Files(name_pattern=r"(?P<_sign>n?)(?P<_rpm>\\d+)\\.csv", values={"_sign": {"": 1, "n": -1}},
    ...             compute={"speed_mm_s": "_sign * _rpm"}, columns={"run_id": "{_rpm} rpm"})
    >>> name_parts("n120.csv", rig).channels
    {'speed_mm_s': -120.0, 'run_id': '120 rpm'}
    """
    if not names_speak(settings):
        return SAYS_NOTHING
    texts: dict[str, str] = {}
    values: dict[str, float | str] = {}
    if settings.name_pattern is not None:
        match = re.fullmatch(settings.name_pattern, file)
        if match is None:
            return NameParts(False, {})
        for name, text in match.groupdict(default="").items():
            mapped = settings.values.get(name, {}).get(text)
            if mapped is None:
                texts[name] = text
                values[name] = text if name in TEXT_COLUMNS else _value(text)
            else:
                texts[name] = f"{mapped:g}" if isinstance(mapped, int | float) else mapped
                values[name] = float(mapped) if isinstance(mapped, int | float) else mapped
    for name, expression in settings.compute.items():
        values[name] = float(evaluate(parse(expression), values))
        texts[name] = f"{values[name]:g}"
    for name, template in settings.columns.items():
        texts[name] = _FIELD.sub(lambda found: _part(found.group(1), texts, template), template)  # noqa: B023
        values[name] = texts[name] if name in TEXT_COLUMNS else _value(texts[name])
    return NameParts(True, {name: value for name, value in values.items() if value != "" or name.startswith("_")})


def _value(text: str) -> float | str:
    number = as_number(text)
    return text if number is None else number


def _part(name: str, texts: Mapping[str, str], template: str) -> str:
    if name not in texts:
        known = ", ".join(texts) or "none"
        raise ConfigError(f"template {template!r} reads a part '{name}' that the name has not.", fix=f"Parts: {known}.")
    return texts[name]
