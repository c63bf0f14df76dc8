"""The folders and files named on the command line, including the folder of the user's effects."""

from collections.abc import Mapping
from pathlib import Path

from sealfit.config import Config
from sealfit.errors import RUNS_TABLES, CampaignError, ConfigError, Fault, RequestError, did_you_mean, quoted
from sealfit.store.manifest import ConfigCopy, State, fingerprint

RUNS = "runs.csv"
FIX_PATH = "Fix the path."


def possible_tables(config: Config) -> tuple[str, ...]:
    """Return where the table of runs may be in a campaign: where the config says, or under a usual name."""
    return RUNS_TABLES if config.files.runs_table is None else (config.files.runs_table,)


def runs_tables(folder: Path, config: Config) -> list[str]:
    """Return those of `possible_tables` that a campaign folder holds."""
    paths = {name: folder / name for name in possible_tables(config)}
    return [name for name, path in paths.items() if path.exists() or path.is_symlink()]


def campaign_folder(path: Path, config: Config) -> Path:
    """Return `path`; CampaignError if there is no such folder, or no table of runs that the config needs."""
    if not path.is_dir():
        what, fix = "there is no such folder.", did_you_mean(path) or FIX_PATH
        if path.is_file():
            what, own = "is a file, not a campaign folder.", path.name in RUNS_TABLES
            fix = f"Give its folder: {quoted(path.parent)}" if own else f"Give the folder that holds {RUNS}."
        raise CampaignError([Fault("campaign_folder", what, str(path), fix=fix)])
    if config.files.glob is None and config.files.runs_table is None and not runs_tables(path, config):
        below = sorted(child.parent for child in path.glob(f"*/{RUNS}"))
        names = sorted(child.name + ("/" if child.is_dir() else "") for child in path.iterdir())
        shown = ", ".join(names[:5] or ["none"]) + (", ..." if len(names) > 5 else ".")
        fix = "It lists the trace files; or draft a config that finds them: "
        fix += f"sealfit init {quoted(path)}. Files here: {shown}"
        if below:
            fix = "Did you mean " + " or ".join(quoted(folder) for folder in below[:3]) + "?"
        raise CampaignError([Fault("runs_csv", f"{path} has no {RUNS}.", file=RUNS, fix=fix)])
    return path


def existing_file(path: Path, what: str) -> Path:
    """Return `path` if it is a file; else raise RequestError, which calls it `what`."""
    if path.is_file():
        return path
    if path.is_dir():
        raise RequestError(f"is a folder, not a {what}.", file=path, fix="Give the file itself.")
    fix = did_you_mean(path, Path.is_file) or FIX_PATH
    raise RequestError(f"there is no such {what}.", file=path, fix=fix)


# ---------------------------------------------------------------- own effects
# A campaign and a folder of results may come from somebody else, so Python is never run from them or from a
# path stored in them. The user names the folder, by --effects-folder or in the config given with --config.
# OUT keeps the hashes of the files to detect changes.

OPTION = "--effects-folder"
KEY = "key 'loop.effects_folder'"


def own_effects_folder(given: Path | None, config: ConfigCopy | None, *data: Path) -> Path | None:
    """Return the folder of the user's own effects, without symbolic links; None if none is named.

    `given` is what --effects-folder says; it comes before the config, which is the one that the command line
    names, never one that a folder of results keeps. ConfigError if there is no such folder, if it or one of
    its files lies in `data` (the campaign and OUT), or if a config that lies there names it.
    """
    folder, said = given, OPTION
    if given is None and config is not None:
        folder, said = config.effects_folder(), KEY
    if folder is None:
        return None
    if said == KEY and (place := _place_of(config.path, data)):
        reason = f"{KEY}: the config lies in {place}, so the folder that it names is not run."
        fix = f"Name the folder by {OPTION}, or move the config."
        raise ConfigError(reason, file=config.path, fix=fix)
    if not folder.is_dir():
        raise ConfigError(f"{said}: there is no folder {folder}.", fix=did_you_mean(folder) or FIX_PATH)
    for path in (folder, *sorted(folder.glob("*.py"))):
        if place := _place_of(path, data):
            fix = "Read the files; if you trust them, move them to a folder of your own."
            raise ConfigError(f"{said}: {path} lies in {place}, and Python is never run from there.", fix=fix)
    return folder.resolve()


def _place_of(path: Path, data: tuple[Path, ...]) -> Path | None:
    """Return the folder of `data` that contains a path, after symbolic links; None if there is none."""
    return next((place for place in data if path.resolve().is_relative_to(place.resolve())), None)


def effect_hashes(folder: Path) -> dict[str, str | None]:
    """Return the SHA-256 of every Python file in the folder, by name."""
    return {path.name: fingerprint(path).sha256 for path in sorted(folder.glob("*.py"))}


def effects_seen(given: Path | None, kept: State, config: ConfigCopy) -> dict[str, str | None]:
    """Return the present hashes of the user's own effects, as far as known; nothing is run.

    `given` is the folder that the command line names, `kept` what OUT keeps, and `config` its config as it
    stands now.
    """
    if given is not None:
        return effect_hashes(given)
    named = config.effects_folder()
    if named is None:  # given by the option, or removed from the config
        return kept.own_effects if kept.config.effects_folder() is None else {}
    return effect_hashes(named) if config.path.is_file() and named.is_dir() else kept.own_effects


def needed(what: str, names: Mapping[str, str | None] | list[str]) -> RequestError:
    """Return the error of a command that needs the user's own effects and was given none."""
    files = f" ({', '.join(sorted(names))})" if names else ""
    why = "Python is run only from a folder that the command line names."
    return RequestError(f"{what} your own effects{files}, and {why}", fix=f"Add {OPTION} FOLDER.")
