"""When files were started, as the log writes it: to ISO 8601, and to the order and hours of the campaign."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from datetime import UTC, datetime, timedelta
from itertools import islice

import pandas as pd

from sealfit.config import Config
from sealfit.errors import Fault
from sealfit.ingest.categorical import Column, Columns, mapped
from sealfit.ingest.columns import suggestion
from sealfit.ingest.files import as_number
from sealfit.ingest.listing import Entry

EXCEL_DAY_0 = datetime(1899, 12, 30)
EXCEL_DAYS = (32874, 73415)  # 1990 to 2100: other numbers are hours, or seconds, or no times at all
_USUAL = ("%d.%m.%Y", "%d/%m/%Y", "%m/%d/%Y", "%Y/%m/%d", "%d.%m.%y", "%d-%m-%Y", "%d %b %Y", "%Y%m%d")
_CLOCKS = (" %H:%M:%S", " %H:%M", " %I:%M:%S %p", " %I:%M %p", "", "T%H:%M:%S", "_%H%M%S", "_%H%M")


def join_date_and_time(entries: list[Entry], columns: Columns, config: Config) -> tuple[Columns, list[Fault]]:
    """Return the columns with `started_at` in place of the config's date and time; faults of these."""
    two = config.files.started_at
    if two is None:
        return columns, []
    place = {"file": entries[0].table, "line": 1} if entries[0].line is not None else {}
    missing = [name for name in (two.date, two.time) if name not in columns]
    if missing:
        reason = "there is no such column, but files.started_at names it."
        return columns, [
            Fault("missing_column", reason, column=name, fix=suggestion(name, list(columns)), **place)
            for name in missing
        ]
    joined: Column = []
    faults = []
    for i, cells in enumerate(zip(columns[two.date], columns[two.time], strict=True)):
        if (cells[0] is None) != (cells[1] is None):
            empty, other = (two.date, two.time) if cells[0] is None else (two.time, two.date)
            reason, fix = f"the cell is empty, but '{other}' is not.", "Fill it, or empty both."
            faults.append(entries[i].fault("empty_cell", reason, empty, value="", fix=fix))
        # A workbook's date is a midnight: 2024-03-01 00:00:00.
        day = re.sub(r"[ T]00:00(:00)?$", "", str(cells[0]).strip())
        joined.append(None if None in cells else f"{day} {str(cells[1]).strip()}")
    rest = {name: column for name, column in columns.items() if name not in (two.date, two.time)}
    return rest | {"started_at": joined}, faults


def add_order(entries: list[Entry], columns: Columns, config: Config) -> tuple[Columns, list[Fault]]:
    """Return the columns with `run_order` and `elapsed_h` where files have start times; faults of bad times.

    Times in one of the config's formats, and Excel's serial numbers, become ISO 8601. Equal times share the
    order of the first of them. A time with a zone is an instant; one without is taken as it stands, and as
    UTC beside others with zones, so that one campaign with and without zones keeps one order.
    """
    if "started_at" not in columns:
        return columns, []
    formats = config.files.date_format
    texts = mapped(columns["started_at"], lambda value: str(value).strip())
    read = {text: time_of(text, formats) for text in set(texts) if text is not None}
    times = mapped(texts, read.__getitem__)
    faults = [
        entries[i].fault("not_a_time", _reason(formats), "started_at", value=text, fix=_fix(text))
        for i, (text, time) in enumerate(zip(texts, times, strict=True))
        if text is not None and time is None
    ]
    as_given = not formats and config.files.started_at is None
    as_iso = {
        text: time.isoformat() if time and not (as_given and _read(datetime.fromisoformat, text)) else text
        for text, time in read.items()
    }
    columns = columns | {"started_at": mapped(texts, as_iso.__getitem__)}
    if any(time.tzinfo for time in times if time is not None):
        times = mapped(
            times, lambda time: (time if time.tzinfo else time.replace(tzinfo=UTC)).astimezone(UTC)
        )
    moments = pd.Series(pd.to_datetime(pd.Series(times, dtype=object), utc=True))
    if not moments.notna().any():
        return columns, faults
    hours = (moments - moments.min()) / pd.Timedelta(hours=1)
    derived = {"run_order": moments.rank(method="min"), "elapsed_h": hours}
    return columns | {name: _with_none(values) for name, values in derived.items()}, faults


def _with_none(values: pd.Series) -> Column:
    return [None if math.isnan(value) else value for value in values.tolist()]


def time_of(text: str, formats: Sequence[str] = ()) -> datetime | None:
    """Return the time by the first format that fits, else ISO 8601, else Excel's serial number, or None."""
    in_formats = (_read(datetime.strptime, text, one) for one in formats)
    return next(filter(None, in_formats), None) or _read(datetime.fromisoformat, text) or excel_time(text)


def _read(reader: Callable[..., datetime], *given: str) -> datetime | None:
    try:
        return reader(*given)
    except ValueError:
        return None


def excel_time(text: str) -> datetime | None:
    """Return the time of a day's serial number, or of a day's and a share's: 45352.395833, 45352 0.395833.

    None for other texts.
    """
    numbers = [as_number(part) for part in text.split()]
    if not numbers or None in numbers or not EXCEL_DAYS[0] <= sum(numbers) < EXCEL_DAYS[1]:
        return None
    return EXCEL_DAY_0 + timedelta(milliseconds=round(sum(numbers) * 86_400_000))


def usual_formats(texts: Sequence[str]) -> list[str]:
    """Return the first two of the usual formats in which all of these dates are, as a config writes them.

    Examples
    --------
    >>> usual_formats(["14/03/2024 09:30"]), usual_formats(["03/02/2024", "14/02/2024"])
    (["'%d/%m/%Y %H:%M'"], ["'%d/%m/%Y'"])
    """
    usual = (date + clock for clock in _CLOCKS for date in _USUAL)
    fits = (repr(one) for one in usual if all(_read(datetime.strptime, text, one) for text in texts))
    return list(islice(fits, 2))


def _reason(formats: Sequence[str]) -> str:
    tried = ", ".join(repr(one) for one in formats)
    return f"fits none of the formats tried: {tried}, ISO 8601." if formats else "is not an ISO 8601 time."


def _fix(text: str) -> str:
    """Return a fix: the formats that a date is in, by the usual ones, or how it should be written."""
    likely = usual_formats([text])
    if likely:
        return f"Set date_format = {' or '.join(likely)} under [files] in the rig config."
    fix = "Write it as 2024-03-01T09:30:00, or give its format: "
    return fix + "date_format = '%d.%m.%Y %H:%M' under [files]."
