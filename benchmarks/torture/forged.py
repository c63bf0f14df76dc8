"""Forged results: every key of closure.json and model.json is changed, and their checksums are made again.

Somebody who sends results can make their checksums right. So every value is deleted or replaced: by another
type, by a number that is not finite or far too large, a list of another length, a matrix of another size, an
unknown word. Each command that reads the document then answers, or says in one line that sealfit did not
write it; none ends in a traceback.

    forged(work, seed, step)        # step: every so many of the forgeries, of some 10,000
"""

from __future__ import annotations

import copy
import hashlib
import json
from collections.abc import Iterator
from pathlib import Path

from fuzzing import Folder, Found, TooSlow, results_folder

READERS = {"closure": ("predict", "lifetime", "effects", "report", "run"), "model": ("predict",)}
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


def forgeries(document: dict) -> Iterator[tuple[str, object]]:
    """Yield what was changed, and the changed document."""
    for at in places(document):
        value = document
        for key in at:
            value = value[key]
        for other in changed(value):
            if not at:
                if other is not DELETED:
                    yield "the whole", other
                continue
            forgery = copy.deepcopy(document)
            holder = forgery
            for key in at[:-1]:
                holder = holder[key]
            if other is DELETED:
                del holder[at[-1]]
            else:
                holder[at[-1]] = other
            how = "deleted" if other is DELETED else f"is {json.dumps(other)[:40]}"
            yield f"{'.'.join(map(str, at))} {how}", forgery


def put(folder: Folder, name: str, document: object) -> None:
    """Write a document into OUT, with its size and checksum in state.json."""
    raw = json.dumps(document).encode()
    (folder.out / f"{name}.json").write_bytes(raw)
    state = json.loads(folder.files["state.json"])
    del state["steps"]["report"]  # which is drawn again
    done = state["steps"]["close-loop"]
    done["files"][f"{name}.json"] = len(raw)
    done["checksums"][f"{name}.json"] = hashlib.sha256(raw).hexdigest()
    (folder.out / "state.json").write_text(json.dumps(state))


def forged(work: Path, seed: int, step: int = 1) -> list[Found]:
    """Return what every reader says of every `step`-th forgery of both documents."""
    folder, found = results_folder(work, seed), []
    for name, readers in READERS.items():
        document = json.loads(folder.files[f"{name}.json"])
        for what, forgery in list(forgeries(document))[seed % step :: step]:
            put(folder, name, forgery)
            found += [Found(f"forged {name}.json", what, *_asked(folder, reader)) for reader in readers]
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
