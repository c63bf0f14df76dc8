"""What lies in the folders of a campaign: each folder is looked into once, however many files are listed in it."""

from __future__ import annotations

import os
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from sealfit.ingest.folder import inside


class _Names(NamedTuple):
    plain: frozenset[str]  # what is no link and lies inside the campaign, as its folder does
    all: frozenset[str]


@dataclass(frozen=True)
class Folders:
    """The folders of `campaign` that were asked for; a folder is its path below the campaign, "" for the campaign."""

    campaign: Path
    _seen: dict[str, _Names] = field(default_factory=dict)

    def hold(self, file: str) -> bool:
        """Return whether a path, there or not, lies inside the campaign, links followed: as `folder.inside`."""
        if ":" not in file and "\\" not in file:  # these may mean a drive
            folder, _, name = file.rpartition("/")
            if name in self._names(folder).plain:
                return True
        return inside(self.campaign, file) is not None

    def outside(self, files: Iterable[str]) -> set[str]:
        """Return those of the paths that do not lie inside the campaign: as `hold`, a folder at a time."""
        odd: set[str] = set()
        for folder, names in _by_folder(files).items():
            plain = self._names(folder).plain
            odd |= {file for name, file in names.items() if name not in plain or ":" in file or "\\" in file}
        return {file for file in odd if not self.hold(file)}

    def beside(self, files: Iterable[str]) -> set[str]:
        """Return the files that lie beside `files`, in the same folders and with one of their endings; not `files`."""
        others = {
            f"{folder}/{name}" if folder else name
            for folder, own in _by_folder(files).items()
            for name in self._names(folder).all - own.keys()
        }
        if not others:
            return others
        wanted = {_ending(file) for file in others}
        endings = {ending for ending in wanted if any(_ending(file) == ending for file in files)}  # the first has it
        return {file for file in others if _ending(file) in endings and (self.campaign / file).is_file()}

    def _names(self, folder: str) -> _Names:
        if folder not in self._seen:
            try:
                with os.scandir(self.campaign / folder) as entries:
                    link = {entry.name: entry.is_symlink() for entry in entries}
            except OSError:  # no folder, or one that may not be read: its files will say so when they are read
                link = {}
            within = not folder or inside(self.campaign, folder) is not None
            plain = (name for name, is_link in link.items() if within and not is_link)
            self._seen[folder] = _Names(frozenset(plain), frozenset(link))
        return self._seen[folder]


def _by_folder(files: Iterable[str]) -> dict[str, dict[str, str]]:
    """Return the paths by their folder and their name in it."""
    found: dict[str, dict[str, str]] = {}
    for file in files:
        folder, _, name = file.rpartition("/")
        found.setdefault(folder, {})[name] = file
    return found


def _ending(file: str) -> str:
    """Return the suffix of a path as pathlib has it: none of `.csv` and `name.`."""
    name = file.rpartition("/")[2]
    dot = name.rfind(".")
    return name[dot:] if 0 < dot < len(name) - 1 else ""
