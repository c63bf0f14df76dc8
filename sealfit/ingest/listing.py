"""What lies in the folders of a campaign: each folder is looked into once, however many files are listed in it."""

from __future__ import annotations

import os
from collections.abc import Collection, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from sealfit.ingest.folder import inside


class _Names(NamedTuple):
    """What lies in a folder, as paths below the campaign."""

    plain: frozenset[str]  # what is no link and lies inside the campaign, as its folder does
    all: frozenset[str]


@dataclass(frozen=True)
class Folders:
    """The folders of `campaign` that were asked for; a folder is its path below the campaign, "" for the campaign."""

    campaign: Path
    _seen: dict[str, _Names] = field(default_factory=dict)

    def hold(self, file: str) -> bool:
        """Return whether a path, there or not, lies inside the campaign, links followed: as `folder.inside`."""
        if not _may_be_a_drive(file) and file in self._names(file.rpartition("/")[0]).plain:
            return True
        return inside(self.campaign, file) is not None

    def outside(self, files: Collection[str]) -> set[str]:
        """Return those of the paths that do not lie inside the campaign: as `hold`, a folder at a time."""
        odd = set(files).difference(*(self._names(folder).plain for folder in _folders(files)))
        if _may_be_a_drive("/".join(files)):
            odd |= {file for file in files if _may_be_a_drive(file)}
        return {file for file in odd if not self.hold(file)}

    def beside(self, files: Collection[str]) -> set[str]:
        """Return the files that lie beside `files`, in the same folders and with one of their endings; not `files`."""
        others = set().union(*(self._names(folder).all for folder in _folders(files))).difference(files)
        if not others:
            return others
        wanted = {_ending(file) for file in others}
        endings = {ending for ending in wanted if any(_ending(file) == ending for file in files)}  # the first has it
        return {file for file in others if _ending(file) in endings and (self.campaign / file).is_file()}

    def _names(self, folder: str) -> _Names:
        if folder not in self._seen:
            below = f"{folder}/" if folder else ""
            try:
                with os.scandir(self.campaign / folder) as entries:
                    link = {below + entry.name: entry.is_symlink() for entry in entries}
            except OSError:  # no folder, or one that may not be read: its files will say so when they are read
                link = {}
            within = not folder or inside(self.campaign, folder) is not None
            plain = (file for file, is_link in link.items() if within and not is_link)
            self._seen[folder] = _Names(frozenset(plain), frozenset(link))
        return self._seen[folder]


def _folders(files: Iterable[str]) -> set[str]:
    return {file.rpartition("/")[0] for file in files}


def _may_be_a_drive(path: str) -> bool:
    return ":" in path or "\\" in path


def _ending(file: str) -> str:
    """Return the suffix of a path as pathlib has it: none of `.csv` and `name.`."""
    name = file.rpartition("/")[2]
    dot = name.rfind(".")
    return name[dot:] if 0 < dot < len(name) - 1 else ""
