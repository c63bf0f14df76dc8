"""Forged tables: the tables of results are changed, and their checksums are made again.

Somebody who sends results can make their checksums right. So of every table each column is deleted or has
another type. Each command that reads it then answers, or says in one line that sealfit did not write it; none
ends in a traceback.

    forged_tables(work, seed, step)     # step: every so many of the forgeries, of some 1,500
"""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Iterator
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
from fuzzing import Folder, Found, TooSlow, results_folder

TABLE_READERS = ("predict", "lifetime", "report")


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
