"""The folder of the user's own effects, as the command line names it: the one place from which Python is run.

A campaign and a folder of results may come from somebody else. Nothing that lies in them, and no path that they keep,
leads to Python being run: the person who runs the command names the folder, by --effects-folder or in the config that
--config names. A folder of results keeps the hashes of the files, which tell whether they are the same.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from sealfit.errors import ConfigError, RequestError
from sealfit.fingerprint import fingerprint
from sealfit.state import ConfigCopy

OPTION = "--effects-folder"
KEY = "key 'loop.effects_folder'"


def own_effects_folder(given: Path | None, config: ConfigCopy | None, *data: Path) -> Path | None:
    """Return the folder from which the user's own effects are read, without symbolic links; None if none is named.

    Parameters
    ----------
    given : Path or None
        What --effects-folder says; it comes before the config.
    config : ConfigCopy or None
        The config that the command line names, never one that a folder of results keeps.
    *data : Path
        The campaign and the folder of results.

    Raises
    ------
    ConfigError
        If there is no such folder, if it or one of its files lies in `data`, or if a config that lies there names it.
    """
    folder, said = given, OPTION
    if given is None and config is not None:
        folder, said = config.effects_folder(), KEY
    if folder is None:
        return None
    if said == KEY and (place := _place_of(config.path, data)):
        raise ConfigError(
            f"{KEY}: the config lies in {place}, so the folder that it names is not run.",
            file=config.path,
            fix=f"Name the folder by {OPTION}, or move the config.",
        )
    if not folder.is_dir():
        raise ConfigError(f"{said}: there is no folder {folder}.", fix="Fix the path.")
    for path in (folder, *sorted(folder.glob("*.py"))):
        if place := _place_of(path, data):
            raise ConfigError(
                f"{said}: {path} lies in {place}, and Python is never run from there.",
                fix="Read the files; if you trust them, move them to a folder of your own.",
            )
    return folder.resolve()


def _place_of(path: Path, data: tuple[Path, ...]) -> Path | None:
    """Return the one of the folders `data` in which a path lies, symbolic links followed; None if in none."""
    return next((place for place in data if path.resolve().is_relative_to(place.resolve())), None)


def effect_hashes(folder: Path) -> dict[str, str | None]:
    """Return the SHA-256 of every Python file in the folder, by name."""
    return {path.name: fingerprint(path).sha256 for path in sorted(folder.glob("*.py"))}


def effects_seen(
    given: Path | None, kept: Mapping[str, str | None], kept_config: ConfigCopy, config: ConfigCopy
) -> dict[str, str | None]:
    """Return the hashes of the user's own effects as they are now, as far as it can be told; nothing is run.

    Parameters
    ----------
    given : Path or None
        The folder that the command line names.
    kept, kept_config
        The hashes and the config that the folder of results keeps.
    config : ConfigCopy
        The same config as it stands now, read again if its file is still there.
    """
    if given is not None:
        return effect_hashes(given)
    named = config.effects_folder()
    if named is None:  # they were given by the option, or the config has dropped them
        return dict(kept) if kept_config.effects_folder() is None else {}
    return effect_hashes(named) if config.path.is_file() and named.is_dir() else dict(kept)


def what_differs(kept: Mapping[str, str | None], now: Mapping[str, str | None]) -> str:
    """Return in words which files of the user's own effects differ; empty if none does."""
    names = sorted(name for name in kept.keys() | now.keys() if kept.get(name) != now.get(name))
    more = f" and {len(names) - 3} more" if len(names) > 3 else ""
    return f"your own effects are not those it was made with ({', '.join(names[:3])}{more})" if names else ""


def needed(what: str, names: Mapping[str, str | None] | list[str]) -> RequestError:
    """Return the error of a command that needs the user's own effects and was given none."""
    files = f" ({', '.join(sorted(names))})" if names else ""
    return RequestError(
        f"{what} your own effects{files}, and Python is run only from a folder that the command line names.",
        fix=f"Add {OPTION} FOLDER.",
    )
