"""What a result was made from: a fingerprint per input, and one key per step.

A step is current if the key it was made under equals the key computed now. The key holds everything the step could
see: the program's version, the part of the config that the step is given, its inputs, and the step before it.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping
from fnmatch import fnmatch
from pathlib import Path
from typing import NamedTuple

from sealfit import __version__
from sealfit.config import Config, Files, Loop, Sensor

STEPS = ("ingest", "fit-steady", "fit-aging", "fit-dynamic", "close-loop", "report")
"""Every step, each reading what those before it wrote."""

FITS = ("fit-steady", "fit-aging", "fit-dynamic")
"""Those of which close-loop reads nothing: it fits its own model to the bins."""

UNSEEN = {
    "ingest": {"sensor": Sensor(), "loop": Loop()},
    "fit-steady": {"loop": Loop()},
    "fit-aging": {"loop": Loop()},
    "fit-dynamic": {"loop": Loop()},
}
"""Parts of the config that a step is not given, so that a change of them does not make it stale."""


class Fingerprint(NamedTuple):
    """Size in bytes, time of last change in ns, and SHA-256 of one file; all None for a file that is not there."""

    size: int | None = None
    mtime_ns: int | None = None
    sha256: str | None = None


def fingerprint(path: Path | str, known: Fingerprint | None = None) -> Fingerprint:
    """Return the fingerprint of `path`; the file is read only if its size or time differ from those `known`."""
    try:
        stat = os.stat(path)
        if known is not None and (stat.st_size, stat.st_mtime_ns) == (known.size, known.mtime_ns):
            return known
        with open(path, "rb") as file:
            digest = hashlib.file_digest(file, "sha256").hexdigest()
    except OSError:
        return Fingerprint()
    return Fingerprint(stat.st_size, stat.st_mtime_ns, digest)


def fingerprint_of(raw: bytes, status: os.stat_result) -> Fingerprint:
    """Return the fingerprint of a file from its bytes, and its status when they were read."""
    return Fingerprint(status.st_size, status.st_mtime_ns, hashlib.sha256(raw).hexdigest())


def fingerprints(folder: Path, known: Mapping[str, Fingerprint], config: Config) -> dict[str, Fingerprint]:
    """Return the fingerprints, now, of every `known` file of the campaign `folder` and of every new trace file."""
    place = os.path.join(folder, "")
    now = {name: fingerprint(place + name, mark) for name, mark in known.items()}
    return now | {name: fingerprint(place + name) for name in glob_names(folder, config.files) if name not in now}


def glob_names(folder: Path, files: Files) -> list[str]:
    """Return the trace files that the config's glob finds, relative to `folder`; none without a glob."""
    if files.glob is None:
        return []
    found = (path.relative_to(folder).as_posix() for path in folder.glob(files.glob) if path.is_file())
    return sorted(name for name in found if not any(fnmatch(name, pattern) for pattern in files.exclude))


def seen_config(step: str, config: Config) -> Config:
    """Return the config as `step` may see it: parts that are none of its business stand at their defaults."""
    return config.model_copy(update=UNSEEN.get(step, {}))


def step_keys(inputs: Mapping[str, Fingerprint], config: Config) -> dict[str, str]:
    """Return the key of every step, in order, for these inputs, this config and this version of the program."""
    keys: dict[str, str] = {}
    names = sorted(inputs)
    known = "\0".join([*names, *(inputs[name].sha256 or "" for name in names)])  # \0 stands in no path
    before = hashlib.sha256(os.fsencode(known)).hexdigest()
    for step in STEPS:
        seen = [__version__, step, seen_config(step, config).model_dump(mode="json"), before]
        if step == "close-loop" and config.loop.effects_folder is not None:
            seen.append(folder_hashes(Path(config.loop.effects_folder)))
        keys[step] = before = hashlib.sha256(json.dumps(seen, sort_keys=True).encode()).hexdigest()
    return keys


def folder_hashes(folder: Path) -> dict[str, str | None]:
    """Return the hash of every Python file below the users' folder of effects."""
    return {path.relative_to(folder).as_posix(): fingerprint(path).sha256 for path in sorted(folder.rglob("*.py"))}
