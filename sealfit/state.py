"""What OUT knows of itself: its campaign, its config, its inputs, and the key under which each step was made."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path, PurePath

from sealfit.config import Config, parse_config, read_config
from sealfit.errors import OutError
from sealfit.fingerprint import Fingerprints

STATE = "state.json"
FORMAT = 5
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

        Only a config that the command line names may lead to its being run: see `own_effects`.
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
