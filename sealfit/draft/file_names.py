"""What the names of trace files and folders say: numbers by the letters around them, dates, words that vary.

Files whose names are cut alike share a pattern; a name in which a word such as `unaged` stands in the place
of temperature, compression and days is matched, too.
"""

import re
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple, Self

import numpy as np

from sealfit.config import AGING_CONDITION, Files
from sealfit.draft.vocabulary import AFTER, BEFORE, DIRECTIONS, RUBBERS, said_by
from sealfit.ingest.derived_columns import means_unaged
from sealfit.ingest.listing import NUMBERS
from sealfit.units import Units

# The ending of a file's name: with a letter, as in `v0.5` the last figure is none.
SUFFIX = re.compile(r"\.(?=[^./]*[^\W\d])[^./]*$")
_TOKEN = re.compile(
    r"(?P<date>(?<!\d)20\d\d(?P<_d>[-_.]?)(?:0[1-9]|1[0-2])(?P=_d)(?:0[1-9]|[12]\d|3[01])(?!\d)"
    r"(?:[T_\- ](?:[01]\d|2[0-3])(?P<_t>[-:.h]?)[0-5]\d(?:(?P=_t)[0-5]\d)?(?!\d))?"
    r"|(?<!\d)(?:0[1-9]|[12]\d|3[01])(?P<_g>[-.])(?:0[1-9]|1[0-2])(?P=_g)20\d\d(?!\d))"
    r"|(?P<word>(?<![^\W\d_])(?:[mµuc]?m|in)[-_ /]?(?:per|p)?(?:s|min)(?![^\W\d_])|[^\W\d_]+|[%°]+[^\W\d_]*)"
    r"|(?P<number>(?:(?:(?<=[/_\s=(])|^)-)?\d+(?:[.,]\d+|p\d+)?)"
    r"|(?P<sep>[^\w%°]+|_+)"
)
FEW = 12  # different values up to which a word is a label and a bare number may be a repeat
HEIGHT_FROM = 50.0  # percent: a smaller compression is how much was taken away; none is squeezed below half
ALIKE = 0.2  # share of names that another way of naming must have for a word to be optional; fewer are slips
# What numbers that count up from 1 are not, whatever letter stands before them: T1 and T2 are tests.
NO_COUNTS = ("temperature_C", "compression_ratio_pct", "load_N")
ONCE = "few values, each once per setting"  # why a number is a repeat
COUNTED = 6  # files from which on a number that is another in each of them counts files, not repeats


class Token(NamedTuple):
    """A piece of a name."""

    kind: str  # date, word, number or sep
    text: str


@dataclass(frozen=True)
class NamePart:
    """A piece of the names that stands for something."""

    at: int
    ours: str  # the column that it gives, "" for a piece that is matched only
    pattern: str
    texts: tuple[str, ...]  # its different values
    why: str
    expression: str = ""  # that computes the column where it is not the number itself
    unit: str = ""  # of the number, "" for the column's own
    doubt: str = ""
    signs: Mapping[str, float] = field(default_factory=dict)  # of words for a direction

    @property
    def group(self) -> str:
        """Its name in the pattern: that of the column, or with a leading `_` where that is made from it."""
        if self.expression or self.ours in ("direction", "specimen_id"):
            return f"_{self.ours.split('_')[0]}"
        return self.ours


@dataclass(frozen=True)
class Names:
    """What names of files say: the pieces of the first of them, and the parts that stand for something."""

    files: tuple[str, ...]
    pieces: tuple[Token, ...]
    parts: tuple[NamePart, ...]
    middle: tuple[int, int] | None  # the range of pieces in place of which one of the `words` may stand
    words: tuple[str, ...]  # for unaged rubber
    templates: Mapping[str, str] = field(default_factory=dict)  # of columns beside those of the parts

    @cached_property
    def settings(self) -> Files:
        """How a config reads the names; without a pattern if they say nothing."""
        return settings_of(self) if any(part.ours for part in self.parts) else Files()

    @property
    def given(self) -> set[str]:
        """Our columns that the names give."""
        return {part.ours for part in self.parts if part.ours} | set(self.settings.columns)

    @property
    def unmatched(self) -> tuple[str, ...]:
        """The files that the pattern does not match; none without a pattern."""
        pattern = self.settings.name_pattern
        return tuple(file for file in self.files if pattern and not re.fullmatch(pattern, file))

    def changed(self, part: NamePart, **changes: object) -> Self:
        """Return the names with one of the parts changed."""
        parts = tuple(replace(own, **changes) if own is part else own for own in self.parts)
        return replace(self, parts=parts)

    def without(self, part: NamePart) -> Self:
        """Return the names without what one of the parts says: it is matched only."""
        return self.changed(part, ours="", unit="", doubt="")


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


def pattern_of(names: Names) -> str:
    """Return the regular expression that finds the parts of names."""
    optional = next((part for part in names.parts if part.texts[0] == ""), None)
    by_place = {part.at: part for part in names.parts if part is not optional}
    pieces = []
    for at, token in enumerate(names.pieces):
        part = by_place.get(at)
        if part is None:
            pieces.append(re.escape(token.text) if token.kind != "number" else r"\d+(?:[.,p]\d+)?")
        elif part.ours == "started_at":
            pieces.append(_date_pattern(token.text))
        else:
            pieces.append(f"(?P<{part.group}>{part.pattern})" if part.ours else f"(?:{part.pattern})")
        if optional is not None and optional.at == at:
            pieces[-1] = f"(?P<{optional.group}>{optional.pattern}){pieces[-1]}"
    if names.middle is not None:
        first, last = names.middle
        inner = "".join(pieces[first:last])
        pieces[first:last] = [f"(?:{inner}|{'|'.join(map(re.escape, names.words))})"]
    pattern = "".join(pieces).replace(r"\ ", " ").replace(r"\-", "-").replace(r"\%", "%")
    endings = sorted({re.escape(match.group()) for file in names.files if (match := SUFFIX.search(file))})
    return pattern + ("".join(endings) if len(endings) < 2 else f"(?:{'|'.join(endings)})")


def _date_pattern(text: str) -> str:
    """Return the pattern of a date, with its numbers named in their order."""
    names = iter(("_year", "_month", "_day", "_hour", "_minute", "_second"))
    numbers = r"^\d{4}|\d\d"
    if not text[:4].isdecimal():
        names, numbers = iter(("_day", "_month", "_year")), r"\d{4}$|\d\d"
    return re.sub(numbers, lambda found: rf"(?P<{next(names)}>\d{{{len(found[0])}}})", re.escape(text))


def settings_of(names: Names) -> Files:
    """Return the pattern of names, and the value maps, expressions, templates and units that go with it."""
    values: dict[str, dict[str, float | str]] = {}
    compute: dict[str, str] = {}
    ours = {part.ours: part for part in names.parts}
    if "direction" in ours and "speed_mm_s" in ours:
        names = names.changed(ours["speed_mm_s"], expression="_direction * {}")
    elif "direction" in ours:
        compute["direction_set"] = "_direction"
    pattern, middle = pattern_of(names), names.middle
    for part in names.parts:
        if part.ours in ("", "started_at"):
            continue
        numbers = [text for text in part.texts if re.match(r"-?\d", text)]
        if any(mark in text for text in numbers for mark in ",p"):
            values[part.group] = {text: as_float(text) for text in numbers}
        replaced = middle is not None and middle[0] <= part.at < middle[1]
        if replaced and (part.ours == "aging_days" or part.expression):
            values.setdefault(part.group, {})[""] = 0.0
        if part.ours == "direction":
            values[part.group] = dict(part.signs)
        elif part.expression:
            compute[part.ours] = part.expression.format(part.group)
    columns = _templates(names, pattern)
    units = {part.ours: part.unit for part in names.parts if part.unit}
    return Files(name_pattern=pattern, values=values, compute=compute, columns=columns, units=units)


def _templates(names: Names, pattern: str) -> dict[str, str]:
    """Return the columns put together from parts: the date, and the specimen with its condition."""
    made = {}
    if "_year" in pattern:
        seconds = "{_second}" if "_second" in pattern else "00"
        clock = f"T{{_hour}}:{{_minute}}:{seconds}" if "_hour" in pattern else ""
        made["started_at"] = "{_year}-{_month}-{_day}" + clock
    if any(part.ours == "specimen_id" for part in names.parts):
        settings = [part.group for part in names.parts if part.ours in ("rubber", *AGING_CONDITION)]
        made["specimen_id"] = " ".join("{" + name + "}" for name in [*settings, "_specimen"])
    return {**made, **names.templates}


def read_names(files: Sequence[str]) -> Names:
    """Return what the names of files, relative paths with forward slashes, say."""
    stems = {file: SUFFIX.sub("", file) for file in files}
    cut = {file: tokens(stem) for file, stem in stems.items()}
    groups: dict[tuple, list[str]] = defaultdict(list)
    for file, pieces in cut.items():
        groups[shape_of(pieces)].append(file)
    # A word for unaged rubber may stand for what other names spell out, not the other way round.
    unaged = {id(own) for own in groups.values() if any(means_unaged(one.text) for one in cut[own[0]])}
    main = max(groups.values(), key=lambda own: len(own) * (ALIKE if id(own) in unaged else 1.0))
    sign = None
    for base in sorted(groups.values(), key=lambda members: len(cut[members[0]])):
        if len(base) >= ALIKE * len(main) and (sign := _optional_word(base, groups, cut)) is not None:
            main = base
            break
    rows = [cut[file] for file in main]
    if sign is not None:
        added = (sign[0], *sign)
        signed = [pieces for pieces in cut.values() if added in _words_instead(pieces, rows[0])]
        rows += [pieces[: sign[0]] + pieces[sign[0] + 1 :] for pieces in signed]
    parts = _parts(rows)
    middle, words = _unaged(rows[0], parts, [cut[f] for f in files if f not in set(main)])
    if sign is not None and any(part.ours for part in parts):
        parts = _with_sign(parts, sign)
    return Names(tuple(files), tuple(rows[0]), tuple(parts), middle, tuple(words))


def _parts(rows: Sequence[Sequence[Token]]) -> list[NamePart]:
    """Return the parts of names that are cut alike."""
    found: list[NamePart] = []
    for at, token in enumerate(rows[0]):
        texts = tuple(dict.fromkeys(row[at].text for row in rows))
        if token.kind == "date":
            doubt = "" if token.text[:4].isdecimal() else "the day is taken to stand before the month"
            found.append(NamePart(at, "started_at", "", texts, "a date", doubt=doubt))
        elif token.kind == "word" and (part := _word(at, texts)):
            found.append(part)
        elif token.kind == "number":
            found.append(_number(at, rows, texts))
    return _without_doubles(_with_bare_numbers(found, rows), rows)


def _word(at: int, texts: tuple[str, ...]) -> NamePart | None:
    """Return a word that varies; None for one that is the same in all names."""
    if len(texts) == 1:
        return None
    low, pattern = {text.lower() for text in texts}, r"[^\W\d_]+"
    if len(texts) <= FEW:
        pattern = "|".join(sorted(map(re.escape, texts), key=len, reverse=True))
    if low <= DIRECTIONS.keys():
        signs = {text: DIRECTIONS[text.lower()] for text in texts}
        return NamePart(at, "direction", pattern, texts, "a word for the direction", signs=signs)
    if low <= RUBBERS:
        return NamePart(at, "rubber", pattern, texts, "the short name of a rubber")
    if _same_unit(texts):
        return NamePart(at, "", pattern, texts, "a unit in singular and plural")
    doubt = "what this word stands for is not known; it is kept as a label"
    return NamePart(at, f"label_{at}", pattern, texts, "a word that varies", doubt=doubt)


def _number(at: int, rows: Sequence[Sequence[Token]], texts: tuple[str, ...]) -> NamePart:
    """Return a number with what the letters around it say; without `ours` where they say nothing."""
    pattern = _number_pattern(texts)
    after, before = _around(rows, at)
    unit = doubt = ""
    if after and (said := said_by(AFTER, re.sub(r"[-_ /]", "", after))):
        (ours, unit), why = said, f"'{after}' stands after the number"
    else:
        ours = said_by(BEFORE, before) or ""
        why = f"'{before}' stands before the number" if before else "a bare number"
        if ours in NO_COUNTS and _counts_up(texts):
            ours = ""
        if ours in NUMBERS and rows[0][at + 1 : at + 2] and rows[0][at + 1].text == after:
            doubt = f"'{after}' behind it is no unit that is known here; {Units().of(ours)} is assumed"
    return _as_height(NamePart(at, ours, pattern, texts, why, unit=unit, doubt=doubt), before)


def _counts_up(texts: Sequence[str]) -> bool:
    """Whether numbers are 1, 2, 3 or 0, 1, 2."""
    if not all(text.isdecimal() for text in texts):
        return False
    numbers = sorted({int(text) for text in texts})
    return len(numbers) > 1 and numbers[0] <= 1 and numbers[-1] - numbers[0] == len(numbers) - 1


def _around(rows: Sequence[Sequence[Token]], at: int) -> tuple[str, str]:
    """Return the words after and before a number, "" where none belongs to it in every name."""
    row = rows[0]
    after = before = ""
    step = 2 if at + 2 < len(row) and row[at + 1].text == " " else 1
    following = {own[at + step] for own in rows if at + step < len(own)}
    if {token.kind for token in following} == {"word"} and _same_unit(token.text for token in following):
        leads = at + step + 1 < len(row) and row[at + step + 1].kind == "number"
        after = "" if leads else row[at + step].text
    if at >= 1 and row[at - 1].kind == "word":
        before = row[at - 1].text if _same(rows, at - 1) else ""
    elif at >= 2 and row[at - 1].text in ("=", "_", " ", "-") and row[at - 2].kind == "word":
        trails = at >= 3 and row[at - 3].kind == "number"
        before = row[at - 2].text if _same(rows, at - 2) and not trails else ""
    return after, before


def _same_unit(texts: Iterable[str]) -> bool:
    """Return whether words behind a number are one word, or say the same: week and weeks."""
    texts = set(texts)
    return len(texts) == 1 or len({said_by(AFTER, text) or text for text in texts}) == 1


def _same(rows: Sequence[Sequence[Token]], at: int) -> bool:
    return len({row[at].text for row in rows}) == 1


def _number_pattern(texts: Sequence[str]) -> str:
    sign = "-?" if any(text.startswith("-") for text in texts) else ""
    marks = "".join(sorted({char for text in texts for char in text if char in ".,p"}))
    mark = re.escape(marks) if len(marks) == 1 else f"[{marks}]"
    return f"{sign}\\d+(?:{mark}\\d+)?" if marks else f"{sign}\\d+"


def _as_height(part: NamePart, before: str) -> NamePart:
    """Return the part; a number that says how far the rubber was compressed gives the height left."""
    if part.ours != "compression_ratio_pct" or before.lower() in ("h", "height"):
        return part
    if max(as_float(text) for text in part.texts) >= HEIGHT_FROM:
        return part
    taken = f"{', '.join(part.texts[:4])} is taken as how much the rubber was compressed"
    otherwise = "if it is the height that was left, let the part be called compression_ratio_pct"
    return replace(part, expression="100 - {}", doubt=f"{taken}; {otherwise}")


def _with_bare_numbers(parts: Sequence[NamePart], rows: Sequence[Sequence[Token]]) -> list[NamePart]:
    """Return the parts with what numbers without letters are: repeats, running numbers, or not known."""
    known = [part for part in parts if part.ours and part.ours not in ("repeat", "started_at")]
    has_repeat = any(part.ours == "repeat" for part in parts)
    made = []
    for part in parts:
        if part.ours == "repeat" and len(part.texts) == len(rows) > COUNTED:
            made.append(replace(part, ours="", why=f"{part.why}; it counts the files"))
        elif part.ours:
            made.append(part)
        elif len(part.texts) == 1:
            continue
        elif rows[0][part.at].kind == "word":  # a unit
            made.append(part)
        elif not has_repeat and _repeats(part, known, rows):
            has_repeat = True
            made.append(replace(part, ours="repeat", why=f"{part.why}, {ONCE}"))
        elif len(part.texts) == len(rows) and np.ptp(list(map(as_float, part.texts))) < 2 * len(rows):
            made.append(replace(part, why=f"{part.why} that counts the files"))
        else:
            doubt = "what this number stands for is not known; it is kept as a channel"
            made.append(replace(part, ours=f"part_{part.at}", doubt=doubt))
    return made


def _repeats(part: NamePart, known: Sequence[NamePart], rows: Sequence[Sequence[Token]]) -> bool:
    settings = [tuple(row[other.at].text for other in known) for row in rows]
    return is_repeat(part, [row[part.at].text for row in rows], settings)


def is_repeat(part: NamePart, numbers: Sequence[object], settings: Sequence[tuple]) -> bool:
    """Return whether a part's numbers count from 0 or 1 and differ between files of the same settings.

    `numbers` and `settings` are those of each file.
    """
    all_differ = len(part.texts) == len(numbers) > COUNTED
    if len(part.texts) > FEW or all_differ or not _counts_up(part.texts):
        return False
    seen = Counter(zip(settings, numbers, strict=True))
    return max(seen.values(), default=0) == 1 and len(set(settings)) < len(numbers)


def _without_doubles(parts: Sequence[NamePart], rows: Sequence[Sequence[Token]]) -> list[NamePart]:
    """Return the parts with one for each of our columns: the last, as file names say more than folders."""
    made: list[NamePart] = []
    for i, part in enumerate(parts):
        later = next((other for other in parts[i + 1 :] if part.ours and other.ours == part.ours), None)
        if later is None:
            made.append(part)
        elif part.ours == "started_at":
            why = "a date before another one"
            made.append(replace(part, ours="", pattern=r"[\dTh:_. -]+", why=why))
        elif all(row[part.at].text == row[later.at].text for row in rows):
            made.append(replace(part, ours="", why=f"{part.why}, said again later in the path"))
        else:
            doubt = f"a second number that looks like {part.ours}; it is kept as a channel"
            made.append(replace(part, ours=f"part_{part.at}", expression="", unit="", doubt=doubt))
    return made


def _words_instead(pieces: Sequence[Token], main: Sequence[Token]) -> Iterator[tuple[int, int, str]]:
    """Yield the words of a name that stand in place of a range of the main ones, which may be empty."""
    for at, token in enumerate(pieces):
        last = len(main) - (len(pieces) - at - 1)
        around = (shape_of(pieces[:at]), shape_of(pieces[at + 1 :]))
        if token.kind == "word" and at <= last and around == (shape_of(main[:at]), shape_of(main[last:])):
            yield at, last, token.text


def _unaged(
    main: Sequence[Token], parts: Sequence[NamePart], others: Sequence[Sequence[Token]]
) -> tuple[tuple[int, int] | None, list[str]]:
    """Return the range of pieces that a word such as `unaged` replaces, and these words."""
    aging = [part.at for part in parts if part.ours in AGING_CONDITION]
    instead = [one for pieces in others for one in _words_instead(pieces, main) if means_unaged(one[2])]
    ranges = Counter((first, last) for first, last, _ in instead)
    first, last = ranges.most_common(1)[0][0] if ranges else (0, 0)
    if not any(first <= at < last for at in aging):  # RT_0d beside 70C_7d has its days in the name
        return None, []
    return (first, last), sorted({word for _, _, word in instead})


def _optional_word(
    main: Sequence[str], groups: Mapping[tuple, Sequence[str]], cut: Mapping[str, list[Token]]
) -> tuple[int, str] | None:
    """Return place and text of a word before a number that only some names have: `n25` beside `25`."""
    row = cut[main[0]]
    for members in groups.values():
        if len(members) >= ALIKE * len(main):
            for first, last, word in _words_instead(cut[members[0]], row):
                if first == last < len(row) and row[first].kind == "number":
                    return first, word
    return None


def _with_sign(parts: Sequence[NamePart], sign: tuple[int, str]) -> list[NamePart]:
    """Return the parts with the optional word as the direction."""
    at, text = sign
    why = f"'{text}' stands before the number in some names"
    doubt = f"'{text}' is taken for the other direction"
    pattern, direction = f"(?:{re.escape(text)})?", DIRECTIONS.get(text.lower(), -1.0)
    signs = {"": -direction, text: direction}
    return [*parts, NamePart(at, "direction", pattern, ("", text), why, doubt=doubt, signs=signs)]
