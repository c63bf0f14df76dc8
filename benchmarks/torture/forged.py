"""Forged results: closure.json, model.json and the tables are changed, and their checksums are made again.

Somebody who sends results can make their checksums right. So every value of the documents is deleted or
replaced: by another type, by a number that is not finite or far too large, a list of another length, a matrix
of another size, an unknown word. Of every table each column is deleted or has another type. Each command
that reads it then answers, or says in one line that sealfit did not write it; none ends in a traceback.

    forged(work, seed, step)            # step: every so many of the forgeries, of some 10,000
    forged_tables(work, seed, step)     # of some 1,500
"""

from __future__ import annotations

import copy
import hashlib
import io
import json
from collections.abc import Iterator
from itertools import islice
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
from fuzzing import Folder, Found, TooSlow, results_folder

READERS = {"closure": ("predict", "lifetime", "effects", "report", "run"), "model": ("predict",)}
TABLE_READERS = ("predict", "lifetime", "report")
DELETED = object()
OTHERS = (
    None, True, -1, 0, 7, 2**70, 10**400, 0.5, 1e308, float("nan"), float("inf"), "", "x", "a b, c", "\ud800",
    [], [1], ["x"], [None], [[1]], {}, {"x": None},
)  # fmt: skip


def places(value: object, at: tuple = ()) -> Iterator[tuple]:
    """Yield the path of every value in a document, of lists the first and last entries."""
    yield at
    if isinstance(value, dict):
        for name in value:
            yield from places(value[name], (*at, name))
    elif isinstance(value, list) and value:
        for number in sorted({0, len(value) - 1}):
            yield from places(value[number], (*at, number))


def changed(value: object) -> Iterator[object]:
    """Yield what a value is replaced by."""
    yield DELETED
    yield from (other for other in OTHERS if type(other) is not type(value) or other != value)
    if isinstance(value, list) and value:
        yield from (value[:-1], [*value, value[-1]], value[::-1], [value], [*value[:-1], None])
        yield from ([*value[:-1], "x"], [*value[:-1], float("nan")])
    elif isinstance(value, dict):
        yield {**value, "more": 1}
    elif isinstance(value, float):
        yield from (-value, 1e200, 1e-320)
    elif isinstance(value, str):
        yield from (value + "x", "<b>{{x}}$\\int")


def forgeries(document: dict) -> Iterator[tuple[tuple, object]]:
    """Yield the path of a value and what it is replaced by."""
    for at in places(document):
        yield from ((at, other) for other in changed(at_path(document, at)) if at or other is not DELETED)


def at_path(value: object, at: tuple) -> object:
    """Return the value at a path of a document."""
    for key in at:
        value = value[key]
    return value


def forgery(document: dict, at: tuple, other: object) -> tuple[str, object]:
    """Return what was changed, and the changed document."""
    if not at:
        return "the whole", other
    made = copy.deepcopy(document)
    holder = at_path(made, at[:-1])
    if other is DELETED:
        del holder[at[-1]]
    else:
        holder[at[-1]] = other
    how = "deleted" if other is DELETED else f"is {json.dumps(other)[:40]}"
    return f"{'.'.join(map(str, at))} {how}", made


def put(folder: Folder, name: str, raw: bytes) -> None:
    """Write a file into OUT, with its size and checksum in state.json."""
    (folder.out / name).write_bytes(raw)
    state = json.loads(folder.files["state.json"])
    del state["steps"]["report"]  # which is drawn again
    for done in state["steps"].values():
        if name in done["files"]:
            done["files"][name] = len(raw)
            done["checksums"][name] = hashlib.sha256(raw).hexdigest()
    (folder.out / "state.json").write_text(json.dumps(state))


def forged(work: Path, seed: int, step: int = 1) -> list[Found]:
    """Return what every reader says of every `step`-th forgery of both documents."""
    folder, found = results_folder(work, seed), []
    for name, readers in READERS.items():
        document = json.loads(folder.files[f"{name}.json"])
        for at, other in islice(forgeries(document), seed % step, None, step):
            what, made = forgery(document, at, other)
            put(folder, f"{name}.json", json.dumps(made).encode())
            found += [Found(f"forged {name}.json", what, *_asked(folder, reader)) for reader in readers]
    folder.restore()
    return found


def changed_tables(table: pa.Table) -> Iterator[tuple[str, pa.Table]]:
    """Yield what was changed, and the changed table."""
    rows = table.num_rows
    for at, field in enumerate(table.schema):
        yield f"{field.name} deleted", table.remove_column(at)
        for what, column in {"text": pa.array(["x"] * rows), "flags": pa.array([True] * rows)}.items():
            if column.type != field.type:
                own = field.with_type(column.type)
                yield f"{field.name} {what}", table.set_column(at, own, column)
    yield "no metadata", table.replace_schema_metadata(None)
    yield "another table's name", table.replace_schema_metadata({"sealfit": '{"table": "no"}'})


def forged_tables(work: Path, seed: int, step: int = 1) -> list[Found]:
    """Return what every reader says of every `step`-th forgery of all tables."""
    folder, found, forgeries = results_folder(work, seed), [], []
    for name, raw in folder.files.items():
        if ".parquet" in name:
            forgeries += [(name, *one) for one in changed_tables(pq.read_table(io.BytesIO(raw)))]
    for name, what, table in forgeries[seed % step :: step]:
        raw = io.BytesIO()
        pq.write_table(table, raw)
        put(folder, name, raw.getvalue())
        found += [Found(f"forged {name}", what, *_asked(folder, reader)) for reader in TABLE_READERS]
        folder.restore()
    return found


def _asked(folder: Folder, reader: str) -> tuple[str, str]:
    """Return verdict and words of one command: an answer, one line, or a fault of the program."""
    try:
        code, _, said = folder.ask(reader)
    except TooSlow as error:
        return "slow", f"{reader}: {error}"
    lines = [line for line in said.splitlines() if line.startswith("sealfit: ")]
    if code not in (0, 1) or "Traceback" in said or len(lines) != code:
        return "traceback", f"{reader}: {said[-900:]}"
    return ("refused", f"{reader}: {said[:300]}") if code else ("read", reader)
