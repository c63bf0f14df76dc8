"""The state of OUT: the inputs, config and version of each step, and its key."""

from __future__ import annotations

import contextlib
import hashlib
import json
import math
import os
import platform
import stat
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from fnmatch import fnmatchcase
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path, PurePath
from typing import Annotated, NamedTuple

from pydantic import AfterValidator, TypeAdapter

from sealfit import __version__
from sealfit.config import Config, Files, Loop, Sensor, parse_config, read_config
from sealfit.errors import OutError

# ---------------------------------------------------------------- fingerprint
# A step is current if its stored key equals the key computed now. The key depends on the program's version,
# the part of the config that the step uses, its inputs, and the step before it.

# The steps in order; each reads the tables of those before it.
STEPS = ("ingest", "fit-steady", "fit-aging", "fit-dynamic", "close-loop", "report")
STEPS_OF_PROPERTIES = ("fit-aging", "report")  # of a table of properties, which has no traces
# Parts of the config that a step does not use, with defaults; a change of them does not make it stale.
UNSEEN = {
    "ingest": {"sensor": Sensor(), "loop": Loop()},
    **{step: {"loop": Loop()} for step in ("fit-steady", "fit-aging", "fit-dynamic")},
}


class Fingerprint(NamedTuple):
    """Size in bytes, times of last change in ns, and SHA-256 of one file; all None for a missing file."""

    size: int | None = None
    mtime_ns: int | None = None  # of the content; programs may set it
    sha256: str | None = None
    ctime_ns: int | None = None  # of the content or the entry; they may not


Fingerprints = dict[str, Fingerprint]  # by file name


def fingerprint(path: Path | str) -> Fingerprint:
    """Return the fingerprint of the file at `path`; an empty one if it cannot be read, or is no file."""
    try:
        status = os.stat(path)
        if not stat.S_ISREG(status.st_mode):  # reading a pipe would wait for ever
            return Fingerprint()
        with open(path, "rb") as file:
            return _mark(status, hashlib.file_digest(file, "sha256").hexdigest())
    except OSError:
        return Fingerprint()


def fingerprint_of(raw: bytes, status: os.stat_result) -> Fingerprint:
    """Return the fingerprint of a file from its bytes and its status."""
    return _mark(status, hashlib.sha256(raw).hexdigest())


def _mark(status: os.stat_result, sha256: str | None) -> Fingerprint:
    return Fingerprint(status.st_size, status.st_mtime_ns, sha256, status.st_ctime_ns)


def changes(folder: Path, known: Fingerprints, files: Files) -> dict[str, Fingerprint]:
    """Return the current fingerprints of a campaign's trace files that are new or differ from those `known`.

    A file is read only if its size or a time differ from those known. New ones are those that the glob of
    `files` finds.
    """
    place, changed = os.path.join(folder, ""), []
    for file, mark in known.items():
        try:
            same = _mark(os.stat(place + file), mark.sha256) == mark
        except OSError:
            same = False
        if not same:
            changed.append(file)
    changed += [file for file in glob_names(folder, files) if file not in known]
    return {file: fingerprint(place + file) for file in changed}


def glob_names(folder: Path, files: Files) -> list[str]:
    """Return the trace files that the config's glob finds, relative to `folder`; none without a glob."""
    if files.glob is None:
        return []
    found = (name for name in found_by_glob(folder, files.glob) if (folder / name).is_file())
    return sorted(name for name in found if not any(fnmatchcase(name, pattern) for pattern in files.exclude))


def found_by_glob(folder: Path, glob: str) -> list[str]:
    """Return what a glob finds in `folder`, but folders, hidden files and results of sealfit below it."""
    found = [path.relative_to(folder) for path in folder.glob(glob) if not path.is_dir()]
    parents = {parent for path in found for parent in path.parents} - {Path()}
    results = {parent for parent in parents if (folder / parent / STATE).is_file()}
    return [
        path.as_posix()
        for path in found
        if results.isdisjoint(path.parents) and not any(part.startswith(".") for part in path.parts)
    ]


def seen_config(step: str, config: Config) -> Config:
    """Return the config as `step` uses it: other parts have their defaults."""
    return config.model_copy(update=UNSEEN.get(step, {}))


def step_keys(state: State, inputs: Fingerprints, config: Config) -> dict[str, str]:
    """Return the key of every step, in order, for these inputs, this config and this version of the program.

    Of the state, what is asked of a table of properties counts, and the user's own effects: their content,
    not where their folder lies.
    """
    config = config.model_copy(update={"loop": config.loop.model_copy(update={"effects_folder": None})})
    keys: dict[str, str] = {}
    names = sorted(inputs)
    known = "\0".join([*names, *(inputs[name].sha256 or "" for name in names)])  # no path contains \0
    before = hashlib.sha256(os.fsencode(known)).hexdigest()
    for step in state.order:
        seen = [__version__, step, seen_config(step, config).model_dump(mode="json"), before]
        if step == "close-loop" and state.own_effects:
            seen.append(state.own_effects)
        if state.properties is not None:
            seen.append(asdict(state.properties))
        keys[step] = before = hashlib.sha256(json.dumps(seen, sort_keys=True).encode()).hexdigest()
    return keys


# ---------------------------------------------------------------- provenance

PACKAGES = ("numpy", "pandas", "scipy", "pyarrow", "matplotlib", "pydantic", "jinja2", "typer", "rich")


def provenance(state: State) -> dict:
    """Return versions, campaign, config, every input with its hash, and when each step was done."""
    packages = {}
    for name in PACKAGES:
        with contextlib.suppress(PackageNotFoundError):
            packages[name] = version(name)
    config, path = state.config, state.config.path
    return {
        "program": "sealfit",
        "version": __version__,
        "python": platform.python_version(),
        "system": f"{platform.system()} {platform.machine()}",
        "packages": packages,
        "campaign": str(state.campaign),
        "table": None if state.properties is None else state.properties.table,
        "config": {"name": config.name, "path": str(path) if path else None, "text": config.text},
        "inputs": [
            {"file": name, "size": mark.size, "sha256": mark.sha256}
            for name, mark in state.inputs.items()
            if mark.sha256 is not None
        ],
        "own_effects": [{"file": name, "sha256": sha256} for name, sha256 in state.own_effects.items()],
        "steps": [
            {"step": name, "version": done.version, "finished_at": done.finished_at, "seconds": done.seconds}
            for name, done in state.steps.items()
        ],
    }


# ---------------------------------------------------------------- state

STATE = "state.json"
STAGING = ".staging-"  # the beginning of the name of a folder of staged files
FORMAT = 10
BATCH = "batch"  # column that names the batch, if nothing else is said
DEFAULT = "default"


@dataclass(frozen=True, slots=True)
class ConfigCopy:
    """A config as text, with its path; `path` is None, and the text empty, for the default."""

    path: Path | None
    text: str

    @classmethod
    def at(cls, path: Path | None) -> ConfigCopy:
        """Return the config file at `path`, or the empty one; ConfigError if it cannot be read."""
        text = read_config(path)  # first, as a link that leads to itself has no path to resolve
        return cls(path.resolve() if path else None, text)

    @property
    def name(self) -> str:
        """Name of the config in messages."""
        return self.path.name if self.path else DEFAULT

    def now(self) -> ConfigCopy:
        """Return the current config: its file if it still exists, else this copy."""
        if self.path is None or self.path.is_file():
            return ConfigCopy.at(self.path)
        return self

    def parse(self) -> Config:
        """Return the checked config; ConfigError if the text is none."""
        return parse_config(self.text, str(self.path or DEFAULT))

    def effects_folder(self) -> Path | None:
        """Return the folder named by `loop.effects_folder`, relative to the config's folder; None without it.

        Only a config that the command line names may lead to its being run: see `own_effects_folder`.
        """
        named = self.parse().loop.effects_folder
        return None if named is None else (self.path.parent if self.path else Path()) / named


def _file_of_out(file: str) -> str:
    """Return `file`; ValueError if it is not in OUT or a folder of it: these files are read and removed."""
    parts = PurePath(file).parts
    if PurePath(file).is_absolute() or ".." in parts or len(parts) > 2:
        raise ValueError(f"{file} lies outside")
    return file


def _file_name(name: str) -> str:
    if PurePath(name).name != name:
        raise ValueError(f"{name} is no file name")
    return name


FileOfOut = Annotated[str, AfterValidator(_file_of_out)]  # relative to OUT


@dataclass(frozen=True, slots=True)
class Done:
    """The last completion of a step."""

    key: str
    version: str
    finished_at: str  # ISO 8601, UTC
    seconds: float
    files: dict[FileOfOut, int]  # with their sizes in bytes
    checksums: dict[str, str | None]  # SHA-256


@dataclass(frozen=True, slots=True)
class Properties:
    """A table of properties of specimens in the campaign's folder, and what is asked of it."""

    table: Annotated[str, AfterValidator(_file_name)]
    names: tuple[str, ...]  # columns of the properties; none for the only one there is
    batch: str  # column that names the batch


@dataclass(frozen=True, slots=True)
class State:
    """The content of state.json."""

    campaign: Path
    config: ConfigCopy
    properties: Properties | None = None  # where the results are of such a table and not of traces
    inputs: Fingerprints = field(default_factory=dict)
    own_effects: dict[str, str | None] = field(default_factory=dict)  # SHA-256 by file name
    steps: dict[str, Done] = field(default_factory=dict)

    @property
    def order(self) -> tuple[str, ...]:
        """The steps in order."""
        return STEPS if self.properties is None else STEPS_OF_PROPERTIES

    def as_dict(self) -> dict:
        """Return the state as it is written."""
        return {"program": "sealfit", "format": FORMAT, **_STATE.dump_python(self, mode="json")}

    @classmethod
    def read(cls, out: Path) -> State | None:
        """Return the state kept in `out`, or None; OutError if this version of sealfit cannot read it."""
        path = out / STATE
        if any("\ud800" <= character <= "\udfff" for character in str(out)):
            raise OutError("is a path that is not UTF-8.", file=out, fix="Choose another --out.")
        try:
            kept = json.loads(path.read_text("utf-8"))
            if kept["program"] != "sealfit" or kept["format"] > FORMAT:
                raise ValueError
            if kept["format"] < FORMAT:  # of an earlier version: every step is out of date
                kept = {name: kept.get(name) for name in ("campaign", "config", "properties")}
            return _STATE.validate_python(kept)
        except (FileNotFoundError, NotADirectoryError):
            return None
        except OSError as error:
            raise OutError(f"cannot be read ({error.strerror}).", file=path, fix="Fix its rights.") from error
        except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
            what = "is not a state that this version of sealfit can read."
            raise OutError(what, file=path, fix="Choose another --out.") from error


_STATE = TypeAdapter(State)


def to_json(document: object, *, indent: int | None = 1, ensure_ascii: bool = False) -> str:
    """Return `document` as JSON text: numbers that are not finite become null, numpy's become Python's."""
    text = json.dumps(_plain(document), indent=indent, ensure_ascii=ensure_ascii, allow_nan=False)
    return f"{text}\n"


def _plain(value: object) -> object:
    if isinstance(value, Mapping):
        return {str(key): _plain(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple | set | frozenset):
        return [_plain(inner) for inner in value]
    if value is None or isinstance(value, bool | int | str):
        return value
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if hasattr(value, "tolist"):  # numpy scalars and arrays, whatever they hold
        return _plain(value.tolist())
    return None if type(value).__name__ in ("NAType", "NaTType") else str(value)  # pandas's missing values
