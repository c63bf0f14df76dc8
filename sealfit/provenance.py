"""What results were made from and with, as provenance.json and the report say it."""

from __future__ import annotations

import platform
from importlib.metadata import PackageNotFoundError, version

from sealfit import __version__
from sealfit.state import State

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
