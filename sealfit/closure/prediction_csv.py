"""P.csv and Q.csv: the points to predict, and the same rows with predictions."""

from __future__ import annotations

import csv
import io
from pathlib import Path

import pandas as pd

from sealfit.errors import RequestError
from sealfit.ingest.files import as_number
from sealfit.store.paths import existing_file
from sealfit.store.staged_writes import replace_file

MISSING = ("", "nan", "NaN", "NA", "null")
FORMULA = tuple("=+-@＝＋－＠")  # what a formula of a spreadsheet begins with
ANSWERS = (
    "force_before_N", "force_after_N", "force_after_lo95_N", "force_after_hi95_N", "meas_lo95_N",
    "meas_hi95_N", "extrapolated", "note",
)  # fmt: skip


def read_points(path: Path) -> pd.DataFrame:
    """Return the rows of a CSV of points (comma, UTF-8, one line of names) as text.

    RequestError, with the line, if the file does not exist or is not such a CSV.
    """
    try:
        raw = existing_file(path, "table of points").read_text("utf-8-sig")
    except UnicodeDecodeError as error:
        raise RequestError("is not UTF-8.", file=path, fix="Save it as CSV UTF-8.") from error
    except OSError as error:
        raise RequestError(f"cannot be read ({error.strerror}).", file=path, fix="Fix its rights.") from error
    lines, rows, begins = csv.reader(io.StringIO(raw, newline="")), [], 1
    for row in lines:
        if any("\n" in cell or "\r" in cell for cell in row):
            fix = "Close or delete it."
            raise RequestError("a quotation mark is left open.", file=path, line=begins, fix=fix)
        begins = lines.line_num + 1
        if any(cell.strip() for cell in row):
            if not rows:
                names = [name.strip() for name in row]
                _refuse_names(names, file=path, line=lines.line_num)
            rows.append(row)
            _refuse_width(row, rows[0], file=path, line=lines.line_num)
    if len(rows) < 2:
        what = "has no rows." if rows else "is empty."
        raise RequestError(what, file=path, fix="Give a line of column names, then one row per point.")
    return pd.DataFrame(rows[1:], columns=names, dtype=object)


def _refuse_width(row: list[str], names: list[str], **place: object) -> None:
    """Raise RequestError for a row that has not one cell per name, or names that no comma separates."""
    if len(names) == 1 and any(mark in names[0].strip() for mark in ";\t| "):
        raise RequestError("is not separated by commas.", fix="Save it with commas and points.", **place)
    if len(row) != len(names):
        what = f"has {len(row)} cells, and there are {len(names)} columns."
        fix = "Fix the row; a comma inside a cell needs quotes, a decimal comma a point."
        raise RequestError(what, fix=fix, **place)


def _refuse_names(names: list[str], **place: object) -> None:
    """Raise RequestError for numbers in place of names, columns there twice, or those of the answer."""
    if names and all(as_number(name) is not None for name in names):
        fix = "Put a line of column names above it."
        raise RequestError("the first line has numbers in place of column names.", fix=fix, **place)
    doubled = sorted({name for name in names if names.count(name) > 1})
    if doubled:
        raise RequestError("appears twice.", column=doubled[0], fix="Keep one of the two.", **place)
    taken = [name for name in ANSWERS if name in names]
    if taken:
        raise RequestError("is a column of the answer.", column=taken[0], fix="Rename it.", **place)


def points_of(frame: pd.DataFrame) -> pd.DataFrame:
    """Return points as `predict` takes them: numbers in numeric columns, as a CSV of them would give.

    RequestError if it has no rows, a column twice, or a column of the answer.

    Examples
    --------
    >>> points_of(pd.DataFrame({"aging_days": [1, 4], "speed_mm_s": ["2", "5"]})).dtypes.tolist()
    [dtype('float64'), dtype('float64')]
    """
    _refuse_names([str(name) for name in frame])
    if frame.empty:
        raise RequestError("the table of points has no rows.", fix="Give one row per point.")
    return frame.reset_index(drop=True).apply(_as_read)


def _as_read(column: pd.Series) -> pd.Series:
    """Return a column as it would come from a CSV: numbers as float, words without spaces around them."""
    if pd.api.types.is_numeric_dtype(column) and not pd.api.types.is_bool_dtype(column):
        return column.astype(float)
    cells = column.astype(object).where(column.notna(), "").map(str).str.strip()
    missing = cells.isin(MISSING)
    numbers = pd.to_numeric(cells.where(~missing), errors="coerce")
    if (numbers.notna() | missing).all():
        return numbers.astype(float)
    return cells.where(~missing, None)


def _no_formula(cell: str) -> str:
    """Return a cell of the points as it is, with an apostrophe before what a spreadsheet would execute.

    Examples
    --------
    >>> _no_formula("=cmd()"), _no_formula("-2.5"), _no_formula("-A1"), _no_formula("oil")
    ("'=cmd()", '-2.5', "'-A1", 'oil')
    """
    return f"'{cell}" if as_number(cell) is None and cell.lstrip().startswith(FORMULA) else cell


def write_answers(points: pd.DataFrame, answers: pd.DataFrame, output: Path, *, given: Path) -> dict:
    """Write the rows of file `given` and their predictions to `output`, completely or not at all.

    Return the counts. Cells that a spreadsheet would take as a formula get an apostrophe. RequestError if
    `output` is the table of points itself, or no name for a CSV; OutError if it cannot be written.
    """
    if output.exists() and output.resolve() == given.resolve():
        raise RequestError(f"--output {output} is the table of points.", fix="Give another name.")
    if not output.absolute().parent.is_dir():
        raise RequestError(f"there is no folder {output.parent} for --output.", fix="Make it first.")
    if output.exists() and not output.is_file():  # a device would be replaced by a file
        what = "a folder" if output.is_dir() else "no file"
        raise RequestError(f"--output {output} is {what}.", fix="Give a file name.")
    if output.exists() and output.suffix.lower() != ".csv":  # such as a config, or a file of OUT
        what = f"--output {output} is there, and its name is not that of a CSV."
        raise RequestError(what, fix="Give a name that ends in .csv.")
    # `answers` has the same rows in the same order.
    table = pd.concat([points.map(_no_formula), answers[list(ANSWERS)].reset_index(drop=True)], axis=1)
    table.columns = [_no_formula(name) for name in table.columns]
    replace_file(output, table.to_csv(index=False, lineterminator="\n"))
    answered = answers["force_after_N"].notna()
    extrapolated = answers["extrapolated"].fillna(False).astype(bool) & answered
    return {"rows": len(answers), "answered": int(answered.sum()), "extrapolated": int(extrapolated.sum())}
