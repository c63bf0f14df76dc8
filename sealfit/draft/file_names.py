"""What the names of trace files and folders say: numbers by the letters around them, dates, words that vary.

Files whose names are cut alike share a pattern; a name in which a word such as `unaged` stands in the place
of temperature, compression and days is matched, too.
"""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import replace

from sealfit.draft.name_parts import (
    SUFFIX,
    Names,
    Part,
    Token,
    as_float,
    pattern_of,
    settings_with,
    shape_of,
    suffix_pattern,
    tokens,
)
from sealfit.draft.vocabulary import DIRECTIONS, RUBBERS, UNAGED, after_number, before_number

FEW = 12
"""Different values up to which a word is a label and a bare number may be a repeat."""

HEIGHT_FROM = 50.0
"""Percent: a smaller compression is how much the rubber was compressed; none is squeezed below half."""

ALIKE = 0.2
"""Share of the names that another way of naming must have for a word to be optional; fewer are slips."""

NO_COUNTS = ("temperature_C", "compression_ratio_pct", "load_N")
"""What numbers that count up from 1 are not, whatever letter stands before them: T1 and T2 are tests."""

COUNTED = 6
"""Files from which on a number that is another in each of them counts files, not repeats."""


def read_names(files: Sequence[str]) -> Names:
    """Return what the names of files, relative paths with forward slashes, say."""
    stems = {file: SUFFIX.sub("", file) for file in files}
    cut = {file: tokens(stem) for file, stem in stems.items()}
    groups: dict[tuple, list[str]] = defaultdict(list)
    for file, pieces in cut.items():
        groups[shape_of(pieces)].append(file)
    main = max(groups.values(), key=len)
    sign = None
    for base in sorted(groups.values(), key=lambda members: len(cut[members[0]])):
        if len(base) >= ALIKE * len(main) and (sign := _optional_word(base, groups, cut)) is not None:
            main = base
            break
    rows = [cut[file] for file in main]
    if sign is not None:
        signed = [pieces for pieces in cut.values() if _has_word(pieces, sign, rows[0])]
        rows += [pieces[: sign[0]] + pieces[sign[0] + 1 :] for pieces in signed]
    parts = _parts(rows)
    if not any(part.group for part in parts):
        return Names(None)
    middle, words = _unaged(rows[0], parts, [cut[f] for f in files if f not in set(main)])
    if sign is not None:
        parts = _with_sign(parts, sign)
    pattern = pattern_of(rows, parts, suffix_pattern(files), middle, words)
    names = settings_with(pattern, parts, middle)
    regex = re.compile(pattern)
    unmatched = tuple(file for file in files if not regex.fullmatch(file))
    return replace(names, unmatched=unmatched)


# ---------------------------------------------------------------- parts
# Which pieces stand for what.


def _parts(rows: Sequence[Sequence[Token]]) -> list[Part]:
    """Return the parts of names that are cut alike."""
    found: list[Part] = []
    for at, token in enumerate(rows[0]):
        texts = tuple(dict.fromkeys(row[at].text for row in rows))
        if token.kind in ("date", "dmy"):
            doubt = "the day is taken to stand before the month" if token.kind == "dmy" else ""
            found.append(Part(at, "started_at", f"_date_{at}", "", texts, "a date", doubt=doubt))
        elif token.kind == "word" and (part := _word(at, texts)):
            found.append(part)
        elif token.kind == "number":
            found.append(_number(at, rows, texts))
    return _named(_without_doubles(_with_bare_numbers(found, rows), rows))


def _word(at: int, texts: tuple[str, ...]) -> Part | None:
    """Return a word that varies; None for one that is the same in all names."""
    if len(texts) == 1:
        return None
    low, pattern = {text.lower() for text in texts}, r"[^\W\d_]+"
    if len(texts) <= FEW:
        pattern = "|".join(sorted(map(re.escape, texts), key=len, reverse=True))
    if low <= DIRECTIONS.keys():
        return Part(at, "direction", "_direction", pattern, texts, "a word for the direction")
    if low <= RUBBERS:
        return Part(at, "rubber", "rubber", pattern, texts, "the short name of a rubber")
    doubt = "what this word stands for is not known; it is kept as a label"
    return Part(at, f"label_{at}", f"label_{at}", pattern, texts, "a word that varies", doubt=doubt)


def _number(at: int, rows: Sequence[Sequence[Token]], texts: tuple[str, ...]) -> Part:
    """Return a number with what the letters around it say; without `ours` where they say nothing."""
    pattern = _number_pattern(texts)
    after, before = _around(rows, at)
    if after and (said := after_number(re.sub(r"[-_ /]", "", after))):
        ours, unit = said
        why = f"'{after}' stands after the number"
        return _as_height(Part(at, ours, "", pattern, texts, why, unit=unit), before)
    ours = before_number(before) if before else ""
    if ours in NO_COUNTS and _counts_up(texts):
        ours = ""
    why = f"'{before}' stands before the number" if before else "a bare number"
    return _as_height(Part(at, ours, "", pattern, texts, why), before)


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
    if at + step < len(row) and row[at + step].kind == "word" and _same(rows, at + step):
        leads = at + step + 1 < len(row) and row[at + step + 1].kind == "number"
        after = "" if leads else row[at + step].text
    if at >= 1 and row[at - 1].kind == "word":
        before = row[at - 1].text if _same(rows, at - 1) else ""
    elif at >= 2 and row[at - 1].text in ("=", "_", " ", "-") and row[at - 2].kind == "word":
        trails = at >= 3 and row[at - 3].kind == "number"
        before = row[at - 2].text if _same(rows, at - 2) and not trails else ""
    return after, before


def _same(rows: Sequence[Sequence[Token]], at: int) -> bool:
    return len({row[at].text for row in rows}) == 1


def _number_pattern(texts: Sequence[str]) -> str:
    sign = "-?" if any(text.startswith("-") for text in texts) else ""
    marks = "".join(sorted({char for text in texts for char in text if char in ".,p"}))
    mark = re.escape(marks) if len(marks) == 1 else f"[{marks}]"
    return f"{sign}\\d+(?:{mark}\\d+)?" if marks else f"{sign}\\d+"


def _as_height(part: Part, before: str) -> Part:
    """Return the part; a number that says how far the rubber was compressed gives the height left."""
    if part.ours != "compression_ratio_pct" or before.lower() in ("h", "height"):
        return part
    if max(as_float(text) for text in part.texts) >= HEIGHT_FROM:
        return part
    taken = f"{', '.join(part.texts[:4])} is taken as how much the rubber was compressed"
    otherwise = "if it is the height that was left, let the part be called compression_ratio_pct"
    return replace(part, expression="100 - {}", doubt=f"{taken}; {otherwise}")


def _with_bare_numbers(parts: Sequence[Part], rows: Sequence[Sequence[Token]]) -> list[Part]:
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
        elif not has_repeat and _repeats(part, known, rows):
            has_repeat = True
            made.append(replace(part, ours="repeat", why=f"{part.why}, few values, each once per setting"))
        elif len(part.texts) == len(rows) and _counts(part):
            made.append(replace(part, why=f"{part.why} that counts the files"))
        else:
            doubt = "what this number stands for is not known; it is kept as a channel"
            made.append(replace(part, ours=f"part_{part.at}", doubt=doubt))
    return made


def _counts(part: Part) -> bool:
    numbers = [as_float(text) for text in part.texts]
    return max(numbers) - min(numbers) < 2 * len(numbers)


def _repeats(part: Part, known: Sequence[Part], rows: Sequence[Sequence[Token]]) -> bool:
    """Whether a number counts from 0 or 1 and differs between files of the same settings."""
    all_differ = len(part.texts) == len(rows) > COUNTED
    if len(part.texts) > FEW or all_differ or not _counts_up(part.texts):
        return False
    seen = Counter(tuple(row[other.at].text for other in (*known, part)) for row in rows)
    settings = {tuple(row[other.at].text for other in known) for row in rows}
    return max(seen.values()) == 1 and len(settings) < len(rows)


def _without_doubles(parts: Sequence[Part], rows: Sequence[Sequence[Token]]) -> list[Part]:
    """Return the parts with one for each of our columns: the last, as file names say more than folders."""
    made: list[Part] = []
    for i, part in enumerate(parts):
        later = next((other for other in parts[i + 1 :] if part.ours and other.ours == part.ours), None)
        if later is None:
            made.append(part)
        elif part.ours == "started_at":
            any_date = replace(part, ours="", group="", pattern=r"[\dTh:_. -]+")
            made.append(replace(any_date, why="a date before another one"))
        elif all(row[part.at].text == row[later.at].text for row in rows):
            made.append(replace(part, ours="", why=f"{part.why}, said again later in the path"))
        else:
            doubt = f"a second number that looks like {part.ours}; it is kept as a channel"
            made.append(replace(part, ours=f"part_{part.at}", group="", expression="", unit="", doubt=doubt))
    return made


def _named(parts: Sequence[Part]) -> list[Part]:
    """Return the parts with the names of their groups: a leading `_` where the column is made from them."""
    made = []
    for part in parts:
        if part.group or not part.ours:
            made.append(part)
        elif part.expression or part.ours == "specimen_id":
            made.append(replace(part, group=f"_{part.ours.split('_')[0]}"))
        else:
            made.append(replace(part, group=part.ours))
    return made


# ---------------------------------------------------------------- unaged
# Names in which one word stands for the state of rubber that was not aged.


def _unaged(
    main: Sequence[Token], parts: Sequence[Part], others: Sequence[Sequence[Token]]
) -> tuple[tuple[int, int] | None, list[str]]:
    """Return the range of pieces that a word such as `unaged` replaces, and these words."""
    days = [part.at for part in parts if part.ours == "aging_days"]
    ranges: Counter = Counter()
    words: list[str] = []
    for pieces in others:
        for at, token in enumerate(pieces):
            if token.kind == "word" and token.text.lower() in UNAGED:
                left, right = at, len(pieces) - at - 1
                head, tail = shape_of(main)[:left], shape_of(main)[len(main) - right :]
                if (head, tail) == (shape_of(pieces)[:left], shape_of(pieces)[at + 1 :]):
                    ranges[left, len(main) - right] += 1
                    words.append(token.text)
    if not ranges or not days:
        return None, []
    first, last = ranges.most_common(1)[0][0]
    if not first <= days[0] < last:
        return None, []
    return (first, last), sorted(set(words))


# ---------------------------------------------------------------- sign
# A word before a number in some names and not in others: `n25` beside `25` is the other direction.


def _optional_word(
    main: Sequence[str], groups: Mapping[tuple, Sequence[str]], cut: Mapping[str, list[Token]]
) -> tuple[int, str] | None:
    """Return place and text of a word before a number that many names have and the main ones do not."""
    row = cut[main[0]]
    for members in groups.values():
        pieces = cut[members[0]]
        if len(pieces) != len(row) + 1 or len(members) < ALIKE * len(main):
            continue
        for at, token in enumerate(row):
            word = (at, pieces[at].text)
            if token.kind == "number" and pieces[at].kind == "word" and _has_word(pieces, word, row):
                return word
    return None


def _has_word(pieces: list[Token], word: tuple[int, str], row: Sequence[Token]) -> bool:
    at, text = word
    if len(pieces) != len(row) + 1 or pieces[at].text != text:
        return False
    return shape_of(pieces[:at] + pieces[at + 1 :]) == shape_of(row)


def _with_sign(parts: Sequence[Part], sign: tuple[int, str]) -> list[Part]:
    """Return the parts with the optional word as the direction."""
    at, text = sign
    why = f"'{text}' stands before the number in some names"
    doubt = f"'{text}' is taken for the other direction"
    pattern = f"(?:{re.escape(text)})?"
    return [*parts, Part(at, "direction", "_direction", pattern, ("", text), why, doubt=doubt)]
