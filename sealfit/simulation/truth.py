"""What the program that wrote a campaign knows about it: `<campaign>.truth.json`, and the force it stands for."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pandas as pd

from sealfit.errors import RequestError
from sealfit.simulation.law import CONDITIONS, law_of_condition, steady_law
from sealfit.simulation.spec import Spec

SCHEMA = 1
MADE_BY = "sealfit simulate"
DIGITS = 9  # of a mean force in N: a nanonewton, far below what any noise leaves visible


def truth_path(campaign: Path) -> Path:
    """Return where the truth of a campaign stands: beside its folder."""
    campaign = Path(campaign)
    return campaign.with_name(campaign.name + ".truth.json")


def load_truth(path: Path) -> dict:
    """Return the truth document at `path`.

    Raises
    ------
    RequestError
        If the file is missing or was not written by `simulate`.
    """
    try:
        document = json.loads(Path(path).read_text("utf-8"))
    except OSError as error:
        raise RequestError(f"cannot be read ({error.strerror}).", file=path, fix="Simulate the campaign.") from error
    except ValueError as error:
        document = error
    if not isinstance(document, dict) or document.get("made_by") != MADE_BY:
        raise RequestError("is not the truth of a simulated campaign.", file=path, fix="Simulate the campaign anew.")
    return document


def true_force(truth: Mapping, points: pd.DataFrame) -> np.ndarray:
    """Return the noise-free force of steady sliding at arbitrary points, in N, shape (n,).

    Parameters
    ----------
    truth : mapping
        The document of `load_truth`.
    points : DataFrame
        `speed_mm_s` (signed), the condition columns that the design has, and the channels that its effects read, in the
        names of sealfit's tables. `load_N` may be left out where the design has one load, `direction` always.

    Returns
    -------
    ndarray, shape (n,)
        Mean force of the population: average specimen, set-up and repeat.

    Raises
    ------
    RequestError
        If a column is missing or a cell is empty.
    """
    spec = Spec.model_validate(truth["spec"])
    law = steady_law(spec)
    table = points
    if "direction" not in table and "speed_mm_s" in table:
        table = table.assign(direction=np.sign(table["speed_mm_s"]))
    if "load_N" not in table and len(spec.design.loads_N) == 1:
        table = table.assign(load_N=spec.design.loads_N[0])
    own = [name for name, there in spec.design.columns.items() if there]
    needed = dict.fromkeys(["speed_mm_s", *own, *(name for e in law.effects for name in e.channels)])
    for name in needed:
        if name not in table:
            raise RequestError("the points lack a column.", column=name, fix="Add it; the truth depends on it.")
        if table[name].isna().any():
            raise RequestError(
                f"the points have {int(table[name].isna().sum())} empty cells.", column=name, fix="Fill them."
            )
    channels = {name: table[name].to_numpy() for name in needed}
    return np.broadcast_to(law.force_N(channels), (len(table),)).astype(float)


def truth_document(spec: Spec, files: pd.DataFrame, effect_rms_N: np.ndarray) -> dict:
    """Return the truth of a campaign as plain values.

    Parameters
    ----------
    spec : Spec
        What was simulated.
    files : DataFrame
        One row per file and direction: `file`, `run_id`, `direction`, `speed_mm_s` (real, signed), `mean_force_N`
        (noise-free, over the steady rows), `gain`, `offset_N`, `outlier`, `defect`, and the condition columns.
    effect_rms_N : ndarray, shape (effects,)
        RMS over all steady rows of what each effect adds to the force.
    """
    conditions = [name for name in CONDITIONS if name in files]
    per_file = ["file", "run_id", "direction", "speed_mm_s", "mean_force_N", "gain", "offset_N", "outlier", "defect"]
    runs = files.groupby(["run_id", "direction"], sort=False)["mean_force_N"].mean().round(DIGITS).reset_index()
    both = spec.design.strokes_per_file > 1
    sign = runs["direction"].map({1: "+", -1: "-"})
    runs["run_id"] = runs["run_id"] + sign if both else runs["run_id"]
    return {
        "schema": SCHEMA,
        "made_by": MADE_BY,
        "spec": spec.model_dump(mode="json"),
        "physics": [
            {"condition": row["condition"], **{c: float(row[c]) for c in conditions}}
            | law_of_condition(spec.physics, {c: float(row[c]) for c in conditions})
            for row in files.drop_duplicates("condition").to_dict("records")
        ],
        "effects": [
            {
                "id": e.id,
                "channels": list(e.channels),
                "acts_on": e.acts_on,
                "operation": e.operation,
                "form": e.form,
                "parameters": dict(e.parameters),
                "rms_N": round(float(rms), DIGITS),
            }
            for e, rms in zip(steady_law(spec).effects, effect_rms_N, strict=True)
        ],
        "noise": [kind.model_dump(mode="json") for kind in spec.noise],
        "runs": runs.to_dict("records"),
        "files": [
            {**row, "defect": row["defect"] if isinstance(row["defect"], str) else None}  # pandas makes NaN of None
            for row in files[per_file].round(DIGITS).to_dict("records")
        ],
    }
