"""Table `inputs`: every file of a campaign, what was read of it, and whether it is used."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import chain
from pathlib import Path

import numpy as np
import pandas as pd

from sealfit.errors import Fault
from sealfit.fingerprint import Fingerprint, fingerprint
from sealfit.ingest.refs import Listing
from sealfit.ingest.stored import Made


def inputs_table(
    campaign: Path,
    listing: Listing,
    plan: Sequence[np.ndarray],
    parts: Sequence[Made],
    used: np.ndarray,
    faults: Sequence[Fault],
) -> tuple[pd.DataFrame, dict[str, Fingerprint]]:
    """Return table `inputs`, every trace file of the campaign and those that are not used, and their fingerprints.

    Parameters
    ----------
    campaign : Path
        Campaign folder.
    listing : Listing
        The files that are listed.
    plan : sequence of ndarray
        The files of each part, by their numbers in the listing.
    parts : sequence of Made
        The parts.
    used : ndarray of bool, shape (files,)
        Which files of the listing have a stroke that is used.
    faults : sequence of Fault
        All findings; those that leave out files which are not in the listing name them.
    """
    order = np.argsort(np.concatenate(plan)).tolist()

    def in_order(of_parts: Iterable[Sequence]) -> list:
        values = list(chain.from_iterable(of_parts))
        return [values[i] for i in order]

    files, marks = list(listing.files), in_order(part.marks for part in parts)
    rows, found = in_order(part.rows for part in parts), in_order(part.found for part in parts)
    status = np.where(used, "used", "left out").tolist()
    known = set(files)
    for fault in faults:
        if fault.file is not None and fault.file not in known and fault.action == "file left out":
            known.add(fault.file)
            files.append(fault.file)
            marks.append(fingerprint(campaign / fault.file))
            rows.append(0)
            found.append(0)
            status.append("left out" if fault.severity == "error" else "not matched")
    table = pd.DataFrame(
        {
            "file": pd.array(files, "str"),
            "size": pd.array([mark.size for mark in marks], "Int64"),
            "mtime_ns": pd.array([mark.mtime_ns for mark in marks], "Int64"),
            "sha256": pd.array([mark.sha256 for mark in marks], "str"),
            "rows": rows,
            "strokes": found,
            "status": pd.array(status, "str"),
        }
    )
    return table, {file: mark for file, mark in zip(files, marks, strict=True) if mark.sha256 is not None}
