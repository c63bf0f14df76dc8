"""The build of the program: the commit, and the uncommitted changes."""

from __future__ import annotations

import hashlib
import subprocess
from pathlib import Path

HERE = Path(__file__).resolve().parent
# Files whose changes can change a number.
CODE = ("*.py", "*.toml")
# Number of characters of the hash of uncommitted changes.
SHOWN = 12


def newest_commit(folder: Path = HERE) -> str:
    """Return the hash of the newest commit of the repository of a folder."""
    return _git(folder, "rev-parse", "HEAD").strip()


def build(folder: Path = HERE) -> str:
    """Return the newest commit and, where code differs from it, "+" and a hash of the differences.

    Two builds with the same text are the same program; code that git does not know yet counts too.
    """
    top = Path(_git(folder, "rev-parse", "--show-toplevel").strip())
    changes = _git(top, "diff", "HEAD", "--", *CODE)
    for name in sorted(_git(top, "ls-files", "--others", "--exclude-standard", "--", *CODE).splitlines()):
        changes += f"{name}\n{(top / name).read_text('utf-8', errors='replace')}"
    if not changes:
        return newest_commit(top)
    return f"{newest_commit(top)}+{hashlib.sha256(changes.encode()).hexdigest()[:SHOWN]}"


def _git(folder: Path, *words: str) -> str:
    return subprocess.run(
        ["git", "-C", str(folder), *words], check=True, capture_output=True, text=True
    ).stdout
