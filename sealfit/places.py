"""The folders and files that a command line names: found, or refused with the likeliest one that is there."""

from __future__ import annotations

import shlex
from difflib import get_close_matches
from pathlib import Path

from sealfit.config import Config
from sealfit.errors import CampaignError, Fault, RequestError
from sealfit.state import STATE

RUNS = "runs.csv"


def campaign_folder(path: Path, config: Config) -> Path:
    """Return `path` if it is a folder that can be a campaign.

    Raises
    ------
    CampaignError
        If there is no such folder, or no runs.csv in it where the config needs one; the fix names the likeliest.
    """
    if path.is_file():
        fix = f"Give its folder: {_quoted(path.parent)}" if path.name == RUNS else f"Give the folder that holds {RUNS}."
        raise CampaignError([Fault("campaign_folder", f"{path} is a file, not a campaign folder.", fix=fix)])
    if not path.is_dir():
        raise CampaignError([Fault("campaign_folder", f"there is no folder {path}.", fix=_did_you_mean(path))])
    if config.files.glob is None and not (path / RUNS).is_file():
        below = sorted(child.parent for child in path.glob(f"*/{RUNS}"))
        fix = f"It lists the trace files; or set files.glob in a config (--config). Files here: {_some_files(path)}"
        if below:
            fix = "Did you mean " + " or ".join(_quoted(folder) for folder in below[:3]) + "?"
        raise CampaignError([Fault("runs_csv", f"{path} has no {RUNS}.", file=RUNS, fix=fix)])
    return path


def existing_out(out: Path) -> Path:
    """Return `out` if it is a folder.

    Raises
    ------
    RequestError
        If it is not; the fix names the likeliest folder of results, or the command that makes one.
    """
    if out.is_dir():
        return out
    fix = _did_you_mean(out, lambda folder: (folder / STATE).is_file())
    raise RequestError(f"there is no folder {out}.", fix=fix or f"Make it: sealfit run CAMPAIGN --out {_quoted(out)}")


def existing_file(path: Path, what: str) -> Path:
    """Return `path` if it is a file; else raise RequestError, which calls it `what`."""
    if path.is_file():
        return path
    if path.is_dir():
        raise RequestError(f"{path} is a folder, not a {what}.", fix="Give the file itself.")
    raise RequestError(f"there is no {what} {path}.", fix=_did_you_mean(path, Path.is_file))


def _did_you_mean(path: Path, fits=Path.is_dir) -> str:
    parent = path.absolute().parent
    missing = None
    while not parent.is_dir():
        missing, parent = parent, parent.parent
    wanted = (missing or path.absolute()).name
    try:
        there = sorted(
            child.name for child in parent.iterdir() if not child.name.startswith(".") and (missing or fits(child))
        )
    except OSError:
        return ""
    likely = get_close_matches(wanted, there, n=1, cutoff=0.5)
    if likely:
        return f"Did you mean {_quoted(path.parent / likely[0] if missing is None else parent / likely[0])}?"
    return ""


def _some_files(folder: Path) -> str:
    names = sorted(child.name + ("/" if child.is_dir() else "") for child in folder.iterdir())
    if not names:
        return "none."
    return ", ".join(names[:5]) + (", ..." if len(names) > 5 else ".")


def _quoted(path: Path) -> str:
    return shlex.quote(str(path))
