"""Table `inputs`: every file of a campaign, what was read of it, and whether it is used."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from sealfit.errors import Fault
from sealfit.fingerprint import Fingerprints, fingerprint
from sealfit.ingest.stored import Made


def inputs_table(
    campaign: Path,
    marks: Fingerprints,
    plan: Sequence[np.ndarray],
    parts: Sequence[Made],
    used: np.ndarray,
    faults: Sequence[Fault],
) -> tuple[pd.DataFrame, Fingerprints]:
    """Return table `inputs`, every trace file of the campaign and those that are not used, and their fingerprints.

    Parameters
    ----------
    campaign : Path
        Campaign folder.
    marks : Fingerprints
        The files of the listing, as they were read.
    plan : sequence of ndarray
        The files of each part, by their numbers in the listing.
    parts : sequence of Made
        The parts.
    used : ndarray of bool, shape (files,)
        Which files of the listing have a stroke that is used.
    faults : sequence of Fault
        All findings; those that leave out files which are not in the listing name them.
    """
    others: dict[str, str] = {}  # files that are not in the listing, and their status
    for fault in faults:
        if fault.file is not None and fault.file not in marks.places and fault.action == "file left out":
            others.setdefault(fault.file, "left out" if fault.severity == "error" else "not matched")
    marks |= {file: fingerprint(campaign / file) for file in others}
    counts = np.zeros((2, len(marks)), np.int64)
    counts[:, np.concatenate(plan)] = np.concatenate([[part.rows, part.found] for part in parts], axis=1)
    table = pd.DataFrame(
        {
            "file": pd.array(list(marks), "str"),
            "size": pd.array(marks.size, "Int64"),
            "mtime_ns": pd.array(marks.mtime_ns, "Int64"),
            "sha256": pd.array(marks.sha256, "str"),
            "rows": counts[0],
            "strokes": counts[1],
            "status": pd.array([*np.where(used, "used", "left out").tolist(), *others.values()], "str"),
        }
    )
    return table, marks.readable()
