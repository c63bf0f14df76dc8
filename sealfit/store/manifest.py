"""What OUT knows of itself: what each step was made from and with, and the key under which it was made."""

from __future__ import annotations

import hashlib
import json
import math
import os
import platform
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from fnmatch import fnmatch
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path, PurePath
from typing import NamedTuple

from sealfit import __version__
from sealfit.config import Config, Files, Loop, Sensor, parse_config, read_config
from sealfit.errors import OutError

# ---------------------------------------------------------------- fingerprint
# What a result was made from: a fingerprint per input, and one key per step.
#
# A step is current if the key it was made under equals the key computed now. The key holds everything the step could
# see: the program's version, the part of the config that the step is given, its inputs, and the step before it.

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


@dataclass(frozen=True)
class Fingerprints(Mapping[str, Fingerprint]):
    """Fingerprints of files by their names, column by column, as they are many.

    `places` has the place of every file in the other columns, from 0, rising.
    """

    places: dict[str, int] = field(default_factory=dict)
    size: list[int | None] = field(default_factory=list)
    mtime_ns: list[int | None] = field(default_factory=list)
    sha256: list[str | None] = field(default_factory=list)

    @classmethod
    def of(cls, marks: Mapping[str, Fingerprint]) -> Fingerprints:
        """Return these fingerprints as columns."""
        return cls() | marks

    @classmethod
    def of_columns(cls, file: Sequence[str], **columns: list) -> Fingerprints:
        """Return what `columns` told; ValueError if they differ in length."""
        made = cls({name: i for i, name in enumerate(file)}, **columns)
        if any(len(column) != len(made) for column in made.columns().values()):
            raise ValueError("columns of different length")
        return made

    def columns(self) -> dict[str, list]:
        """Return the columns by their names, `file` and those of a fingerprint."""
        return {"file": list(self.places), "size": self.size, "mtime_ns": self.mtime_ns, "sha256": self.sha256}

    def __len__(self) -> int:
        return len(self.places)

    def __iter__(self) -> Iterator[str]:
        return iter(self.places)

    def __getitem__(self, file: str) -> Fingerprint:
        i = self.places[file]
        return Fingerprint(self.size[i], self.mtime_ns[i], self.sha256[i])

    def __or__(self, other: Mapping[str, Fingerprint]) -> Fingerprints:
        """Return these with those of `other`, which come in their places or after them."""
        if not other:
            return self
        made = Fingerprints(dict(self.places), list(self.size), list(self.mtime_ns), list(self.sha256))
        for file, mark in other.items():
            i = made.places.setdefault(file, len(made.places))
            for column, value in zip((made.size, made.mtime_ns, made.sha256), mark, strict=True):
                column[i : i + 1] = [value]
        return made

    def take(self, files: Sequence[str]) -> Fingerprints:
        """Return those of `files`, in this order; all None of a file that is not among these."""
        at = [self.places.get(file, -1) for file in files]
        told = {name: [*getattr(self, name), None] for name in Fingerprint._fields}
        return Fingerprints.of_columns(files, **{name: [column[i] for i in at] for name, column in told.items()})

    def readable(self) -> Fingerprints:
        """Return those of the files that could be read."""
        if None not in self.sha256:
            return self
        return Fingerprints.of({file: mark for file, mark in self.items() if mark.sha256 is not None})


def fingerprint(path: Path | str) -> Fingerprint:
    """Return the fingerprint of `path`, which is read."""
    try:
        stat = os.stat(path)
        with open(path, "rb") as file:
            digest = hashlib.file_digest(file, "sha256").hexdigest()
    except OSError:
        return Fingerprint()
    return Fingerprint(stat.st_size, stat.st_mtime_ns, digest)


def fingerprint_of(raw: bytes, status: os.stat_result) -> Fingerprint:
    """Return the fingerprint of a file from its bytes, and its status when they were read."""
    return Fingerprint(status.st_size, status.st_mtime_ns, hashlib.sha256(raw).hexdigest())


def changes(folder: Path, known: Fingerprints, config: Config) -> dict[str, Fingerprint]:
    """Return the fingerprints, now, of what is new or not as it is `known` among the trace files of a campaign.

    A file is read only if its size or time differ from those known.
    """
    place, changed = os.path.join(folder, ""), []
    for file, size, mtime_ns in zip(known.places, known.size, known.mtime_ns, strict=True):
        try:
            status = os.stat(place + file)
        except OSError:
            changed.append(file)
            continue
        if status.st_mtime_ns != mtime_ns or status.st_size != size:
            changed.append(file)
    changed += [file for file in glob_names(folder, config.files) if file not in known.places]
    return {file: fingerprint(place + file) for file in changed}


def glob_names(folder: Path, files: Files) -> list[str]:
    """Return the trace files that the config's glob finds, relative to `folder`; none without a glob."""
    if files.glob is None:
        return []
    found = (path.relative_to(folder).as_posix() for path in folder.glob(files.glob) if path.is_file())
    return sorted(name for name in found if not any(fnmatch(name, pattern) for pattern in files.exclude))


def seen_config(step: str, config: Config) -> Config:
    """Return the config as `step` may see it: parts that are none of its business stand at their defaults."""
    return config.model_copy(update=UNSEEN.get(step, {}))


def step_keys(inputs: Fingerprints, config: Config, effects: Mapping[str, str | None] | None = None) -> dict[str, str]:
    """Return the key of every step, in order, for these inputs, this config and this version of the program.

    `effects` are the hashes of the user's own effects; where their folder lies does not matter.
    """
    config = config.model_copy(update={"loop": config.loop.model_copy(update={"effects_folder": None})})
    keys: dict[str, str] = {}
    names = sorted(inputs.places)
    hashes = (inputs.sha256[inputs.places[name]] or "" for name in names)
    known = "\0".join([*names, *hashes])  # \0 stands in no path
    before = hashlib.sha256(os.fsencode(known)).hexdigest()
    for step in STEPS:
        seen = [__version__, step, seen_config(step, config).model_dump(mode="json"), before]
        if step == "close-loop" and effects:
            seen.append(dict(effects))
        keys[step] = before = hashlib.sha256(json.dumps(seen, sort_keys=True).encode()).hexdigest()
    return keys


# ---------------------------------------------------------------- provenance
# What results were made from and with, as provenance.json and the report say it.

PACKAGES = ("numpy", "pandas", "scipy", "pyarrow", "matplotlib", "pydantic", "jinja2", "typer", "rich")


def provenance(state: State) -> dict:
    """Return versions, campaign, config, every input with its hash, and when each step was done."""
    known = state.inputs
    return {
        "program": "sealfit",
        "version": __version__,
        "python": platform.python_version(),
        "system": f"{platform.system()} {platform.machine()}",
        "packages": {name: found for name in PACKAGES if (found := _version(name)) is not None},
        "campaign": str(state.campaign),
        "config": {
            "name": state.config.name,
            "path": str(state.config.path) if state.config.path else None,
            "text": state.config.text,
        },
        "inputs": [
            {"file": name, "size": size, "sha256": sha256}
            for name, size, sha256 in zip(known.places, known.size, known.sha256, strict=True)
            if sha256 is not None
        ],
        "own_effects": [{"file": name, "sha256": sha256} for name, sha256 in state.effects.items()],
        "steps": [
            {"step": name, "version": done.version, "finished_at": done.finished_at, "seconds": done.seconds}
            for name, done in state.steps.items()
        ],
    }


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None


# ---------------------------------------------------------------- state
# What OUT knows of itself: its campaign, its config, its inputs, and the key under which each step was made.

STATE = "state.json"
FORMAT = 6
DEFAULT = "default"


@dataclass(frozen=True, slots=True)
class ConfigCopy:
    """A config as text, and where it came from: `path` is None for the default inside the package."""

    path: Path | None
    text: str

    @classmethod
    def at(cls, path: Path | None) -> ConfigCopy:
        """Return the config file at `path`, or the default.

        Raises
        ------
        ConfigError
            If it cannot be read.
        """
        return cls(path.resolve() if path else None, read_config(path))

    @property
    def name(self) -> str:
        """What messages call it."""
        return self.path.name if self.path else DEFAULT

    def now(self) -> ConfigCopy:
        """Return the config as it stands now: read again if its file is still there, else this copy."""
        if self.path is None or self.path.is_file():
            return ConfigCopy.at(self.path)
        return self

    def parse(self) -> Config:
        """Return the checked config.

        Raises
        ------
        ConfigError
            If the text is not a config.
        """
        return parse_config(self.text, str(self.path or DEFAULT))

    def effects_folder(self) -> Path | None:
        """Return the folder that `loop.effects_folder` names, relative to the config's own folder; None without it.

        Only a config that the command line names may lead to its being run: see `own_effects_folder`.
        """
        named = self.parse().loop.effects_folder
        return None if named is None else (self.path.parent if self.path else Path()) / named


@dataclass(frozen=True, slots=True)
class Done:
    """One step as it was last completed."""

    key: str
    version: str
    finished_at: str  # ISO 8601, UTC
    seconds: float
    files: dict[str, int]  # what it wrote, relative to OUT, and the size of each in bytes


@dataclass(frozen=True, slots=True)
class State:
    """The content of state.json."""

    campaign: Path
    config: ConfigCopy
    inputs: Fingerprints = field(default_factory=Fingerprints)
    effects: dict[str, str | None] = field(default_factory=dict)  # SHA-256 of the user's own effects, by file name
    steps: dict[str, Done] = field(default_factory=dict)

    def as_dict(self) -> dict:
        """Return the state as it is written."""
        return {
            "program": "sealfit",
            "format": FORMAT,
            "campaign": str(self.campaign),
            "config": {"path": str(self.config.path) if self.config.path else None, "text": self.config.text},
            "inputs": self.inputs.columns(),
            "own_effects": self.effects,
            "steps": {name: asdict(done) for name, done in self.steps.items()},
        }

    @classmethod
    def read(cls, out: Path) -> State | None:
        """Return the state kept in `out`, or None if it has none.

        Raises
        ------
        OutError
            If state.json is not one that this version of sealfit wrote.
        """
        path = out / STATE
        try:
            kept = json.loads(path.read_text("utf-8"))
            if kept["program"] != "sealfit" or kept["format"] > FORMAT:
                raise ValueError
            at = kept["config"]["path"]
            belongs = Path(kept["campaign"]), ConfigCopy(Path(at) if at else None, kept["config"]["text"])
            if kept["format"] < FORMAT:  # of an earlier version: all is to be done again
                return cls(*belongs)
            return cls(
                *belongs,
                Fingerprints.of_columns(**kept["inputs"]),
                dict(kept.get("own_effects", {})),
                {name: _inside(Done(**done)) for name, done in kept["steps"].items()},
            )
        except (FileNotFoundError, NotADirectoryError):
            return None
        except OSError as error:
            raise OutError(f"cannot be read ({error.strerror}).", file=path, fix="Fix its rights.") from error
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise OutError(
                "is not a state that this version of sealfit can read.", file=path, fix="Choose another --out."
            ) from error


def _inside(done: Done) -> Done:
    """Return `done`; ValueError if a file of it lies outside OUT: what a step wrote is read, and removed, again."""
    for file in done.files:
        if PurePath(file).is_absolute() or ".." in PurePath(file).parts:
            raise ValueError(f"{file} lies outside")
    return done


def to_json(document: object, *, indent: int | None = 1) -> str:
    """Return `document` as JSON text: numbers that are not finite become null, numpy's become Python's."""
    style = {"indent": indent, "ensure_ascii": False, "allow_nan": False}
    try:
        return json.dumps(document, **style) + "\n"
    except (TypeError, ValueError):  # what JSON does not know, or a number that is not finite
        return json.dumps(_plain(document), **style) + "\n"


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
