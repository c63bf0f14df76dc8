"""Polluted input: every kind of Pollock's pollution on every text that sealfit reads, and on other formats.

    python benchmarks/torture/pollution.py [--seed N] [--jobs N] [--every] [--rivals]

Traces, runs.csv, the table of points, the table of values and the rig config are polluted at the header, the
first two, the middle and the last row and every column (`polluters`); with --every, traces at every row.
Sheets get the same cells, and files of the other formats are cut and altered. What the commands call is run
on each. It must give the numbers of the clean file, without the rows that it names as left out, or a fault
of one line. Counted are

- wrong: a number that is not that of the clean file, without a word;
- lost: a row or a value of the clean file that is not there and not named;
- tracebacks: an error that is not one of sealfit's;
- unplaced: faults of a record that name no line.

With --rivals (packages of the extra `bench`) traces, with records polluted at every row, are read by sealfit
and by pandas, DuckDB and polars instead, each told the dialect of the file (DuckDB with the options that
Pollock's authors chose), and all are scored as Pollock does: ten measures from 0 to 1 (success; precision,
recall and F1 of header, records and cells), their sum averaged over the files, simple and weighted by how
often a pollution occurs in Pollock's survey. Numbers count as equal if they are equal as numbers.
"""

from __future__ import annotations

import argparse
import contextlib
import csv
import io
import math
import shutil
import tempfile
import tomllib
import traceback
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from functools import cache, partial
from importlib.metadata import version
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import pandas as pd
from polluters import SURVEY, Polluted, Rows, polluted, text_of

from sealfit import __version__, commands
from sealfit.closure.prediction_csv import ANSWERS
from sealfit.config import parse_config
from sealfit.errors import Fault, SealfitError
from sealfit.ingest.campaign import ingest_campaign
from sealfit.ingest.columns import TraceRef
from sealfit.ingest.property_table import read_properties
from sealfit.ingest.reader import read_trace
from sealfit.pipeline import STEPS, run
from sealfit.simulation import load_spec, simulate
from sealfit.store.manifest import ConfigCopy

BAD = ("wrong", "lost", "traceback")
CONFIG = 'condition = ["aging_days"]\n'
LONGEST = 1000  # characters of a message


@dataclass(frozen=True)
class Outcome:
    """What sealfit made of a polluted file: exact, rows left out, fault, or one of `BAD`; and its words."""

    input: str
    kind: str
    place: str
    verdict: str
    said: str = ""
    placed: bool = True


@dataclass(frozen=True)
class Read:
    """Rows that were read, by what identifies them, and what was said of those that were not."""

    rows: dict[object, dict[str, object]]
    faults: Sequence[Fault] = field(default_factory=tuple)


# ---------------------------------------------------------------- clean inputs


def trace_rows(seed: int, rows: int = 60) -> Rows:
    """Return the cells of a trace at 5 mm/s with a channel of numbers and one of labels."""
    rng = np.random.default_rng(seed)
    force, humidity = 30 + rng.normal(0, 0.2, rows), 45 + rng.normal(0, 0.3, rows)
    cells = [
        [
            f"{0.1 * i:.1f}",
            f"{0.5 * i + 1:.2f}",
            f"{force[i]:.3f}",
            f"{humidity[i]:.2f}",
            f"oil {'AB'[2 * i // rows]}",
        ]
        for i in range(rows)
    ]
    return [["time_s", "displacement_mm", "force_N", "humidity_pct", "oil"], *cells]


RUNS = [
    ["file", "aging_days", "speed_mm_s", "load_N", "lab_C", "grease"],
    ["0.csv", "0", "5", "49.03", "21.5", "dry"],
    ["1.csv", "1", "5", "49.03", "21.7", "thin"],
    ["2.csv", "4", "5", "49.03", "20.9", "thin"],
    ["3.csv", "16", "5", "49.03", "21.1", "thick"],
]
VALUES = [
    ["aging_days", "batch", "hardness_shore_A"],
    *([str(day), "AB"[i % 2], f"{70 + 0.3 * day + i:.1f}"] for day in (0, 1, 4, 16, 64) for i in range(2)),
]
POINTS = [
    ["point", "temperature_C", "compression_ratio_pct", "aging_days", "speed_mm_s", "load_N"],
    *([f"p{i}", "60", "80", "4", f"{speed:g}", "49.03"] for i, speed in enumerate((0.5, 2, 5.5, 12, 30))),
]
SPEC = """
name = "small"
seed = {seed}
[design]
days = [1, 4, 16]
speeds_mm_s = [0.5, 5, 40]
repeats = 2
max_rows = 120
[[noise]]
kind = "white"
sd_N = 0.2
"""


def small_campaign(folder: Path, seed: int) -> Path:
    """Write a small simulated campaign below `folder` and return its folder."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "spec.toml").write_text(SPEC.format(seed=seed))
    simulate(load_spec(folder / "spec.toml"), folder / "campaign")
    return folder / "campaign"


@cache
def closed(work: Path, seed: int) -> Path:
    """Return a folder of results whose loop is closed."""
    out = work / f"out{seed}"
    if not out.is_dir():
        run(small_campaign(work / f"made{seed}", seed), out, steps=STEPS[:-1])  # nobody asks for the report
    return out


# ---------------------------------------------------------------- readers
# What the commands call for each input; a path and the polluted bytes to the rows that were read.


def faults_in(quality: pd.DataFrame) -> list[Fault]:
    """Return the findings of table `quality`."""
    rows = (
        {name: None if pd.isna(v) else v for name, v in row.items()} for row in quality.to_dict("records")
    )
    return [Fault(**row) for row in rows if row["check"] != "ok"]


def read_a_trace(folder: Path, raw: bytes, name: str = "0.csv", text: str = CONFIG) -> Read:
    """Return the rows of a trace in a campaign of two, by their time."""
    (folder / name).write_bytes(raw)
    (folder / "1.csv").write_text(text_of(trace_rows(99)))
    (folder / "runs.csv").write_text(f"file,aging_days,speed_mm_s\n{name},1,5\n1.csv,1,5\n")
    made = ingest_campaign(folder, parse_config(text, "rig.toml"))
    faults = [fault for fault in faults_in(made.tables["quality"]) if fault.file in (name, None)]
    traces = made.tables["traces"]
    columns = [
        column for column in traces if column not in ("file", "condition", "stroke", "presliding_N", "steady")
    ]
    mine = traces.loc[traces["file"] == name, columns].drop(columns="distance_mm")
    return Read({row["time_s"]: row for row in mine.to_dict("records")}, faults)


def read_runs(folder: Path, raw: bytes) -> Read:
    """Return the files of a campaign and what runs.csv says of them, by their names."""
    for i in range(4):
        (folder / f"{i}.csv").write_text(text_of(trace_rows(i, 40)))
    (folder / "runs.csv").write_bytes(raw)
    made = ingest_campaign(folder, parse_config(CONFIG, "rig.toml"))
    runs = made.tables["runs"].rename(columns={"speed_set_mm_s": "speed", "speed_mm_s": "measured"})
    runs = runs.rename(columns={"speed": "speed_mm_s"})
    faults = faults_in(made.tables["quality"])
    runs = runs[[column for column in runs if column in RUNS[0] or column not in made_columns()]]
    runs = runs.astype(object).where(runs.notna(), None)
    return Read({row["file"]: row for row in runs.to_dict("records")}, faults)


@cache
def made_columns() -> frozenset:
    """Return the columns of table `runs` that are not from runs.csv."""
    from sealfit.tables import RUNS as schema

    return frozenset(schema.names())


def read_values(folder: Path, raw: bytes) -> Read:
    """Return the rows of a table of properties, by the value, which is another in each."""
    (folder / "values.csv").write_bytes(raw)
    table, faults = read_properties(folder / "values.csv", parse_config(CONFIG, "rig.toml"))
    table = table.rename(columns={"value": "hardness_shore_A"})[["aging_days", "batch", "hardness_shore_A"]]
    table = table.astype(object).where(table.notna(), None)
    return Read({row["hardness_shore_A"]: row for row in table.to_dict("records")}, faults)


def read_points(out: Path, folder: Path, raw: bytes) -> Read:
    """Return the answers to points, by their speed; a point without an answer has a note, which names it."""
    (folder / "points.csv").write_bytes(raw)
    commands.predict(out, folder / "points.csv", folder / "answers.csv")
    answers = pd.read_csv(folder / "answers.csv")
    told = answers["force_after_N"].isna() & answers["note"].notna()
    faults = [
        Fault("note", note, line=i + 2, action="row left out") for i, note in answers["note"][told].items()
    ]
    kept = answers[~told][["speed_mm_s", *(column for column in ANSWERS if column != "note")]]
    return Read({float(row["speed_mm_s"]): row for row in kept.to_dict("records")}, faults)


def clean_rows(table: Rows, key: str, numbers: Sequence[int]) -> dict[object, dict[str, object]]:
    """Return the rows of a clean table, by one of its columns, which is another in each."""
    found = {}
    for cells in table[1:]:
        values = [float(cell) if i in numbers else cell for i, cell in enumerate(cells)]
        row = dict(zip(table[0], values, strict=True))
        found[row[key]] = row
    return found


# ---------------------------------------------------------------- judging


def judged(
    name: str, one: Polluted, read: Callable[[bytes], Read], clean: dict, texts: Sequence[str]
) -> Outcome:
    """Return what is to be said of one polluted file.

    Parameters
    ----------
    name : str
        The input.
    one : Polluted
        The polluted file.
    read : callable
        Reads its bytes.
    clean : dict
        The rows of the clean file.
    texts : sequence of str
        Columns of words: in the polluted row these are not compared, any word is as good as another.
    """
    about = (name, one.kind, one.place)
    try:
        found = read(one.raw)
    except SealfitError as error:
        faults = getattr(error, "faults", None) or [error]
        return _refused(about, one, faults)
    except Exception:
        return Outcome(*about, "traceback", traceback.format_exc(limit=-3))
    texts_said = [str(fault) for fault in found.faults]
    said, named = " | ".join(texts_said), {fault.column for fault in found.faults}
    if wrong := _first_wrong(found.rows, clean, texts if one.row else (), named, texts_said):
        return Outcome(*about, "wrong", f"{wrong}; {said}")
    left = [fault for fault in found.faults if fault.action.endswith("left out")]
    whole = any(fault.action in ("stroke left out", "file left out") for fault in left)
    told = len({fault.line for fault in left if fault.line is not None})
    told += sum(
        int(float(fault.value)) for fault in left if fault.line is None and fault.action == "row left out"
    )
    told += one.kind == "record delimiter missing"  # two records in one line
    missing = one.rows - sum(key in clean for key in found.rows)
    if missing > 0 and not whole and told < missing:
        return Outcome(*about, "lost", f"{missing} rows are not there, {told} are named; {said}")
    if missing > 0 or left:
        # That a file is not there is a fault of the file.
        placed = one.row is None or any(
            f.line is not None or f.check in ("missing_file", "unreadable_file") for f in left
        )
        return Outcome(*about, "left out", said, placed)
    return Outcome(*about, "exact", said)


def _refused(about: tuple, one: Polluted, faults: Sequence) -> Outcome:
    texts = [str(fault) for fault in faults]
    if odd := next((text for text in texts if "\n" in text or len(text) > LONGEST), None):
        return Outcome(*about, "traceback", f"not one line: {odd}")
    places = [
        fault for fault in faults if fault.file is not None and (one.row is None or fault.line is not None)
    ]
    return Outcome(*about, "fault", " | ".join(texts), bool(places))


def _first_wrong(rows: dict, clean: dict, texts: Sequence[str], named: set, said: Sequence[str]) -> str:
    """Return the first row or cell that is not that of the clean file; "" if there is none.

    A column that is named in a fault of the file may be missing in it, or be labels.
    """
    for key, row in rows.items():
        if key not in clean:
            return f"no clean row is {key!r}"
        for column, value in clean[key].items():
            if column in texts or column in named or (column not in row and value in row.values()):
                continue
            gone = pd.isna(row.get(column)) and any(
                column in text for text in said
            )  # it may have another name
            if not gone and not _equal(value, row.get(column)):
                return f"{key!r}: {column} is {row.get(column)!r}, not {value!r}"
    return ""


def _equal(one: object, other: object) -> bool:
    try:
        numbers = float(one), float(other)
    except (TypeError, ValueError):
        return str(one) == str(other)
    # Sums over other numbers of rows round otherwise.
    return math.isclose(*numbers, rel_tol=1e-12) or all(map(math.isnan, numbers))


# ---------------------------------------------------------------- the parts


def _of(name: str, work: Path, seed: int) -> tuple[Callable, dict, Rows, list[int], list[str]]:
    """Return reader, clean rows, clean table, columns of numbers and columns of words of a text input."""
    folder = Path(tempfile.mkdtemp(dir=work))
    if name == "trace":
        table, numbers = trace_rows(seed), [0, 1, 2, 3]
        return partial(read_a_trace, folder), clean_rows(table, "time_s", numbers), table, numbers, ["oil"]
    if name == "runs.csv":
        numbers = [1, 2, 3, 4]
        return partial(read_runs, folder), clean_rows(RUNS, "file", numbers), RUNS, numbers, ["grease"]
    if name == "values":
        return (
            partial(read_values, folder),
            clean_rows(VALUES, "hardness_shore_A", [0, 2]),
            VALUES,
            [0, 2],
            ["batch"],
        )
    read = partial(read_points, closed(work, seed), folder)
    return read, read(text_of(POINTS).encode()).rows, POINTS, [1, 2, 3, 4, 5], []


def text_outcomes(
    name: str, work: Path, seed: int, *, every: bool = False, share=(0, 1), step=1
) -> list[Outcome]:
    """Return the outcomes of every pollution of one text input, or of a share (i-th of n) of them.

    Every `step`-th pollution is run.
    """
    read, clean, table, numbers, texts = _of(name, work, seed)
    chosen = list(polluted(table, numbers=numbers, every=every))[::step][share[0] :: share[1]]
    found = []
    for one in chosen:
        with contextlib.redirect_stderr(io.StringIO()):
            found.append(judged(name, one, read, clean, texts))
    return found


CONFIG_TEXT = """name = "rig"
condition = ["aging_days"]
[trace]
encoding = "auto"
delimiter = ","
header_lines = 1
[trace.columns]
time_s = "t"
[files]
glob = "*.csv"
[quality]
max_bad_rows = 0.05
[units]
force = "N"
"""


def config_outcomes(work: Path) -> list[Outcome]:
    """Return the outcomes of polluted configs: the same config, or one line with the place."""
    clean_text = CONFIG_TEXT.replace('[units]\nforce = "N"\n', "")
    path = Path(tempfile.mkdtemp(dir=work)) / "rig.toml"
    path.write_text(clean_text)
    clean, found = ConfigCopy.at(path).parse(), []
    for kind, raw in _configs(clean_text):
        path.write_bytes(raw)
        about = ("config", kind, "")
        try:
            same = ConfigCopy.at(path).parse() == clean
            other = " = " in kind or "other case" in kind  # these say something else
            found.append(
                Outcome(*about, "exact" if same or other else "wrong", "" if same else "another config")
            )
        except SealfitError as error:
            said = str(error)
            one_line = "\n" not in said and len(said) <= LONGEST
            found.append(Outcome(*about, "fault" if one_line else "traceback", said, "rig.toml" in said))
        except Exception:
            found.append(Outcome(*about, "traceback", traceback.format_exc(limit=-3)))
    return found


def _configs(text: str) -> Iterator[tuple[str, bytes]]:
    """Yield polluted configs: those that mean something else are not among them."""
    raw, lines = text.encode(), text.splitlines()
    for name, codec in (
        ("UTF-16", "utf-16"),
        ("UTF-32", "utf-32"),
        ("EBCDIC", "cp500"),
        ("BOM", "utf-8-sig"),
    ):
        yield f"encoding {name}", text.encode(codec)
    yield "line ends CR LF", raw.replace(b"\n", b"\r\n")
    yield "line ends CR", raw.replace(b"\n", b"\r")
    yield "zeros", raw + b"\0" * 16
    yield "bytes that are no text", b"\xff" * 300
    yield "Latin-1", ("# Prüfstand\n" + text).encode("latin-1")
    yield "HTML", b"<html></html>"
    yield "JSON", b'{"name": "rig"}'
    yield "preamble", b"Rig 7\n" + raw
    yield "no line end at the end", raw[:-1]
    for i, line in enumerate(lines):

        def with_line(*new: str, i: int = i) -> bytes:
            return "\n".join([*lines[:i], *new, *lines[i + 1 :], ""]).encode()

        if len(line) > 3:
            cut = "\n".join([*lines[:i], line[:-1]]).encode()
            with contextlib.suppress(ValueError):
                if tomllib.loads(cut.decode()) is not None and line[-1].isdigit():
                    continue
            yield f"line {i + 1} cut", cut
        yield f"line {i + 1} twice", with_line(line, line)
        yield f"line {i + 1} with a quote", with_line('"' + line)
        yield f"line {i + 1} with a word", with_line(line + " slipped")
        yield f"line {i + 1} with a control character", with_line(line + "\x07")
        if "=" in line:
            key = line.split(" = ")[0]
            for value in (
                "",
                "[[",
                "nan",
                "-1",
                "{}",
                "1979-05-27",
                "[1, [2]]",
                '"""',
                "9" * 400,
                '"\\ud800"',
                "true",
            ):
                yield f"{key} = {value[:20]}", with_line(f"{key} = {value}")
            yield f"{key} in other case", with_line(line.replace(key, key.upper()))
            yield f"{key} with a colon", with_line(line.replace(" =", ":"))


# ---------------------------------------------------------------- other formats


def format_outcomes(work: Path, seed: int, step: int = 1) -> list[Outcome]:
    """Return the outcomes of sheets with polluted cells, and of files that are cut or altered."""
    folder = Path(tempfile.mkdtemp(dir=work))
    table, numbers = trace_rows(seed), [0, 1, 2, 3]
    clean, found = clean_rows(table, "time_s", numbers), []
    for one in [one for one in polluted(table, numbers=numbers) if one.kind == "cell"][::step]:
        cells = list(csv.reader(io.StringIO(one.raw.decode())))
        sheet = Polluted(one.kind, one.place, _xlsx(cells, numbers), one.rows, one.row)
        found.append(judged("xlsx", sheet, partial(read_a_trace, folder, name="0.xlsx"), clean, ["oil"]))
    rng = np.random.default_rng(seed)
    for ending, raw in _files(table, numbers).items():
        read = partial(read_a_trace, folder, name=f"0.{ending}")
        for one in list(_damaged(raw, rng))[::step]:
            outcome = judged(ending, one, read, clean, ["oil"])
            if outcome.verdict == "wrong" and one.kind == "bytes altered" and ending in ("tdms", "mat"):
                # These formats have no checksum of their data: another number is as good as the first.
                outcome = Outcome(ending, one.kind, one.place, "unknowable", outcome.said)
            found.append(outcome)
    return found


def _xlsx(cells: Rows, numbers: Sequence[int]) -> bytes:
    import openpyxl

    book = openpyxl.Workbook()
    for row in cells:
        book.active.append([_number(cell) if i in numbers else cell for i, cell in enumerate(row)])
    made = io.BytesIO()
    book.save(made)
    return made.getvalue()


def _number(cell: str) -> object:
    try:
        number = float(cell)
    except ValueError:
        return cell
    return number if np.isfinite(number) else cell


def _files(table: Rows, numbers: Sequence[int]) -> dict[str, bytes]:
    """Return a trace as a file of every format but CSV."""
    from nptdms import ChannelObject, TdmsWriter
    from scipy.io import savemat

    columns = {name: np.array([row[i] for row in table[1:]]) for i, name in enumerate(table[0])}
    columns = {name: v.astype(float) if i in numbers else v for i, (name, v) in enumerate(columns.items())}
    numeric = {name: v for name, v in columns.items() if v.dtype.kind == "f"}
    tdms, mat, parquet = io.BytesIO(), io.BytesIO(), io.BytesIO()
    with TdmsWriter(tdms) as writer:
        writer.write_segment([ChannelObject("run", name, values) for name, values in numeric.items()])
    savemat(mat, {"run": numeric})
    pd.DataFrame(columns).to_parquet(parquet, write_page_checksum=True)
    return {
        "xlsx": _xlsx(table, numbers),
        "tdms": tdms.getvalue(),
        "mat": mat.getvalue(),
        "parquet": parquet.getvalue(),
    }


def _damaged(raw: bytes, rng: np.random.Generator, altered: int = 60) -> Iterator[Polluted]:
    """Yield a file cut at many places, with bytes altered, and with other bytes before and after it."""
    for end in sorted(
        {0, 1, 4, 8, 100, len(raw) - 1, *np.linspace(0, len(raw), 25, dtype=int)[:-1].tolist()}
    ):
        yield Polluted("file cut", f"after {end} bytes", raw[:end], 60)
    for place in rng.integers(0, len(raw), altered).tolist():
        changed = bytearray(raw)
        changed[place] ^= 1 << int(rng.integers(8))
        yield Polluted("bytes altered", f"byte {place}", bytes(changed), 60)
    yield Polluted("preamble", "", b"Rig 7\n" + raw, 60)
    yield Polluted("wrong size", "zeros", raw + b"\0" * 512, 60)
    yield Polluted("no payload", "", b"", 0)
    yield Polluted("other format", "text", text_of(trace_rows(0)).encode(), 60)


# ---------------------------------------------------------------- the score of Pollock

MEASURES = (
    "success",
    *(f"{of} {what}" for of in ("header", "record", "cell") for what in ("precision", "recall", "F1")),
)
OF_SEALFIT = {";": ";", "\t": "tab", " ": "whitespace", "|": "|", ", ": ","}


def scored(header: Sequence[str], rows: Rows, clean: Rows) -> list[float]:
    """Return the ten measures of one file that was read."""
    expected = [_plain(name) for name in clean[0]], [[_plain(cell) for cell in row] for row in clean[1:]]
    read = [_plain(name) for name in header], [[_plain(cell) for cell in row] for row in rows]
    pairs = (
        (expected[0], read[0]),
        (["\0".join(row) for row in expected[1]], ["\0".join(row) for row in read[1]]),
        (
            [c for row in expected for one in ([row] if row is expected[0] else row) for c in one],
            [c for row in read for one in ([row] if row is read[0] else row) for c in one],
        ),
    )
    return [1.0, *(value for one, other in pairs for value in _f1(one, other))]


def _plain(cell: object) -> str:
    """Return a cell as it is compared: numbers by their value, without blanks around."""
    text = "" if cell is None or cell != cell else str(cell).strip()
    with contextlib.suppress(ValueError):
        return repr(float(text))
    return text


def _f1(expected: Sequence[str], read: Sequence[str]) -> tuple[float, float, float]:
    if not expected:
        return 1.0, 1.0, 1.0
    shared = sum((Counter(expected) & Counter(read)).values())
    if not shared:
        return 0.0, 0.0, 0.0
    precision, recall = shared / len(read), shared / len(expected)
    return precision, recall, 2 * precision * recall / (precision + recall)


def by_sealfit(path: Path, told: dict) -> tuple[Sequence[str], Rows]:
    """Return header and rows as sealfit reads them; raises for a file that it leaves out."""
    lines = ["[trace]"]
    if "delimiter" in told:
        lines.append(f'delimiter = "{OF_SEALFIT[told["delimiter"]]}"')
    if "preamble" in told:
        lines.append(f"header_lines = {told['preamble'] + 1}")
    names = trace_rows(0)[0]
    if told.get("header") is False:
        lines += ['names = "none"', "[trace.columns]", *(f"{name} = {i + 1}" for i, name in enumerate(names))]
    trace = read_trace(path.parent, TraceRef(path.name, {}), parse_config("\n".join(lines), "rig.toml"))
    return list(trace.columns), trace.table.astype(object).to_numpy().tolist()


def by_pandas(path: Path, told: dict) -> tuple[Sequence[str], Rows]:
    """Return header and rows as pandas reads them."""
    quoted = told.get("quote", '"') or '"'
    named = {"header": None, "names": trace_rows(0)[0]} if told.get("header") is False else {}
    frame = pd.read_csv(
        path, sep=told.get("delimiter", ","), quotechar=quoted, encoding=told.get("encoding"), dtype=str,
        escapechar=told.get("escape") or None, skiprows=told.get("preamble", 0), engine="python", **named,
    )  # fmt: skip
    return list(frame.columns), frame.astype(object).to_numpy().tolist()


def by_duckdb(path: Path, told: dict) -> tuple[Sequence[str], Rows]:
    """Return header and rows as DuckDB reads them, with the options of Pollock's authors."""
    import duckdb

    names, skipped = trace_rows(0)[0], told.get("preamble", 0) + (told.get("header") is not False)
    read = duckdb.connect().read_csv(
        str(path), delimiter=told.get("delimiter", ","), quotechar=told.get("quote", '"') or '"',
        escapechar=told.get("escape", '"') or '"', skiprows=skipped, header=False,
        columns=dict.fromkeys(names, "VARCHAR"), auto_detect=False, strict_mode=False, ignore_errors=True,
        null_padding=True,
    )  # fmt: skip
    return names, read.fetchall()


def by_polars(path: Path, told: dict) -> tuple[Sequence[str], Rows]:
    """Return header and rows as polars reads them, as tolerant as it can be."""
    import polars

    frame = polars.read_csv(
        path, separator=told.get("delimiter", ","), quote_char=told.get("quote", '"') or None,
        skip_rows=told.get("preamble", 0), has_header=told.get("header") is not False, infer_schema=False,
        encoding="utf8" if told.get("encoding", "utf-8") in ("utf-8", None) else told["encoding"],
        ignore_errors=True, truncate_ragged_lines=True,
    )  # fmt: skip
    return frame.columns, frame.rows()


READERS = {"sealfit": by_sealfit, "duckdb": by_duckdb, "pandas": by_pandas, "polars": by_polars}


def scores(work: Path, seed: int, readers: dict[str, Callable], step: int = 1) -> pd.DataFrame:
    """Return what each reader scores on polluted traces: a row per file and reader.

    `silent` says that a file was read without an error, and a number in it is not one of the clean file at
    its place, without the reader having named the row.
    """
    table = trace_rows(seed)
    clean = {row[0]: [_plain(cell) for cell in row] for row in table[1:]}
    path, found = Path(tempfile.mkdtemp(dir=work)) / "t.csv", []
    for one in list(polluted(table, numbers=[0, 1, 2, 3], every=True))[::step]:
        if one.kind not in (*SURVEY, "none"):
            continue
        path.write_bytes(one.raw)
        source = table[: one.rows + 1]
        for name, read in readers.items():
            try:
                header, rows = read(path, one.dialect)
                measures = scored(header, rows, source)
                silent = any(_is_other(row, clean) for row in rows)
            except Exception:  # each library has its own
                measures, silent = [0.0] * 10, False
            found.append(
                {
                    "reader": name,
                    "kind": one.kind,
                    "silent": silent,
                    **dict(zip(MEASURES, measures, strict=True)),
                }
            )
    return pd.DataFrame(found)


def _is_other(row: Sequence[object], clean: dict) -> bool:
    """Whether a row that was read begins with three numbers that are not those of the clean file."""
    numbers = [_plain(cell) for cell in row[:3]]
    try:
        values = [float(cell) for cell in numbers]
    except ValueError:
        return False
    known = {cells[0]: cells[1:3] for cells in clean.values()}
    return bool(np.isfinite(values).all()) and known.get(numbers[0]) != numbers[1:]


def weighted(found: pd.DataFrame) -> pd.DataFrame:
    """Return every reader's simple and weighted score, out of 10, and its files read with wrong numbers."""
    found = found.assign(score=found[list(MEASURES)].sum(axis=1))
    files = found.groupby(["reader", "kind"])["score"].transform("size")
    weight = found["kind"].map({**SURVEY, "none": 1}) / files
    sums = (found["score"] * weight).groupby(found["reader"]).sum() / weight.groupby(found["reader"]).sum()
    means = found.groupby("reader")[["success", "header F1", "record F1", "cell F1"]].mean()
    return means.assign(
        simple=found.groupby("reader")["score"].mean(),
        weighted=sums,
        files=found.groupby("reader").size(),
        silently_wrong=found.groupby("reader")["silent"].sum(),
    )


# ---------------------------------------------------------------- main

INPUTS = ("trace", "runs.csv", "values", "points")


def _part(job: tuple) -> list[Outcome]:
    name, work, seed, every, share = job
    if name == "config":
        return config_outcomes(work)
    if name == "formats":
        return format_outcomes(work, seed)
    return text_outcomes(name, work, seed, every=every and name == "trace", share=share)


def outcomes(work: Path, seed: int, jobs: int, every: bool) -> list[Outcome]:
    """Return the outcomes of all inputs."""
    closed(work, seed)
    parts = 4 * jobs
    asked = [(name, work, seed, every, (i, parts)) for name in INPUTS for i in range(parts)]
    asked += [(name, work, seed, every, (0, 1)) for name in ("formats", "config")]
    with ProcessPoolExecutor(jobs, mp_context=get_context("fork")) as pool:
        return [one for part in pool.map(_part, asked[::-1]) for one in part]


def table_of(found: Sequence[Outcome]) -> pd.DataFrame:
    """Return how many files of each input had which outcome."""
    frame = pd.DataFrame({"input": [o.input for o in found], "verdict": [o.verdict for o in found]})
    table = pd.crosstab(frame["input"], frame["verdict"])
    for verdict in ("exact", "left out", "fault", "unknowable", *BAD):
        if verdict not in table:
            table[verdict] = 0
    table["unplaced"] = pd.Series(Counter(o.input for o in found if not o.placed))
    table = table.fillna(0).astype(int)
    return table[["exact", "left out", "fault", "unknowable", *BAD, "unplaced"]]


def main() -> int:
    parser = argparse.ArgumentParser(description="polluted input; see the top of the file")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--every", action="store_true", help="records of traces at every row")
    parser.add_argument("--rivals", action="store_true", help="scores beside pandas, DuckDB and polars")
    parser.add_argument("--step", type=int, default=1, help="with --rivals: every so many-th file")
    asked = parser.parse_args()
    work = Path(tempfile.mkdtemp(prefix="pollution-"))
    try:
        if asked.rivals:
            others = ", ".join(f"{name} {version(name)}" for name in READERS if name != "sealfit")
            print(f"sealfit {__version__}, {others}")
            print(weighted(scores(work, asked.seed, READERS, asked.step)).round(3).to_string())
            return 0
        found = outcomes(work, asked.seed, asked.jobs, asked.every)
    finally:
        shutil.rmtree(work, ignore_errors=True)
    print(table_of(found).to_string())
    for one in (one for one in found if one.verdict in BAD or not one.placed):
        verdict = one.verdict if one.placed else f"{one.verdict} (unplaced)"
        print(f"\n{verdict}: {one.input}, {one.kind}, {one.place}: {one.said[:600]}")
    total = Counter(one.verdict for one in found)
    counts = ", ".join(f"{total[verdict]} {verdict}" for verdict in BAD)
    print(f"\n{len(found)} polluted files, seed {asked.seed}: {counts}")
    return int(any(one.verdict in BAD for one in found))


if __name__ == "__main__":
    raise SystemExit(main())
