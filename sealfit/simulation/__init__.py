"""Campaigns with known truth: the folder as a rig would leave it, and the truth beside it.

`load_spec` reads a SPEC, `simulate` writes the campaign.
"""

import io
import json
import os
import shutil
from contextlib import suppress
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.csv

from sealfit.errors import ConfigError, OutError, RequestError, disk
from sealfit.simulation import noise
from sealfit.simulation.model import CONDITIONS
from sealfit.simulation.motion import (
    Motion,
    SteadyLaw,
    finer,
    law_of_condition,
    move,
    move_at,
    steady_law,
    with_presliding,
)
from sealfit.simulation.spec import Spec, load_spec, plan_files

__all__ = ["Spec", "load_spec", "load_truth", "simulate", "truth_path"]

SCHEMA = 1
MADE_BY = "sealfit simulate"
DIGITS = 9  # decimals of a mean force in N, far below any noise
OF_EFFECT = ("id", "channels", "acts_on", "operation", "form", "parameters")
PER_FILE = (
    "file", "run_id", "direction", "speed_mm_s", "mean_force_N", "gain", "offset_N", "outlier", "defect",
)  # fmt: skip


def truth_path(campaign: Path) -> Path:
    """Return the path of the truth of a campaign, beside its folder."""
    campaign = Path(campaign)
    return campaign.with_name(campaign.name + ".truth.json")


def load_truth(path: Path) -> dict:
    """Return the truth document at `path`; RequestError if the file was not written by `simulate`."""
    with suppress(ValueError, RecursionError):
        document = json.loads(Path(path).read_text("utf-8"))
        if isinstance(document, dict) and document.get("made_by") == MADE_BY:
            return document
    what = "is not the truth of a simulated campaign."
    raise RequestError(what, file=path, fix="Simulate the campaign anew.")


def truth_document(spec: Spec, files: pd.DataFrame, effect_rms_N: np.ndarray) -> dict:
    """Return the truth of a campaign as plain values.

    `files` has a row per file and direction: `PER_FILE`, with the real, signed speed and the noise-free mean
    force over the steady rows, and the condition columns. `effect_rms_N`, shape (effects,), is the RMS over
    all steady rows of what each effect adds to the force.
    """
    physics = []
    for row in files.drop_duplicates("condition").to_dict("records"):
        given = {name: float(row[name]) for name in CONDITIONS if name in row}
        physics.append({"condition": row["condition"], **given, **law_of_condition(spec.physics, given)})
    means = files.groupby(["run_id", "direction"], sort=False)["mean_force_N"].mean()
    runs = means.round(DIGITS).reset_index()
    if spec.design.both_ways:
        runs["run_id"] += runs["direction"].map({1: "+", -1: "-"})
    return {
        "schema": SCHEMA,
        "made_by": MADE_BY,
        "spec": spec.model_dump(mode="json"),
        "physics": physics,
        "effects": [
            {**{name: getattr(e, name) for name in OF_EFFECT}, "rms_N": round(float(rms), DIGITS)}
            for e, rms in zip(steady_law(spec).effects, effect_rms_N, strict=True)
        ],
        "noise": [kind.model_dump(mode="json") for kind in spec.noise],
        "runs": runs.to_dict("records"),
        "files": [
            # pandas makes NaN of None
            {**row, "defect": row["defect"] if isinstance(row["defect"], str) else None}
            for row in files[list(PER_FILE)].round(DIGITS).to_dict("records")
        ],
    }


DISPLACEMENT_DECIMALS = 5  # of mm: 10 nm, the resolution of a linear encoder
NOT_IN_RUNS = ["condition", "direction", "run_order", "elapsed_h"]  # computed by ingest
CRAWL = 1e-3  # of the set speed, at least, where effects are evaluated: a law in log speed has no value at 0
RMS_ROWS = 64  # per file for the RMS of an effect: it gives two digits


def simulate(spec: Spec, out: Path) -> None:
    """Write the campaign folder `out` and, beside it, `<out>.truth.json`.

    The same SPEC gives the same bytes. The folder is written completely or not at all. ConfigError if an
    effect is not in the catalogue or is not finite somewhere on this design. OutError if `out` holds files
    that `simulate` did not write, or cannot be written.
    """
    out = Path(os.path.abspath(out))
    _refuse_foreign(out)
    part = out.with_name(f".{out.name}.part-{os.getpid()}")
    try:
        with disk(out):
            (part / "new" / "traces").mkdir(parents=True)
            document = _write(spec, part / "new")
            text = json.dumps(document, indent=1, ensure_ascii=False, allow_nan=False) + "\n"
            (part / "truth.json").write_bytes(text.encode("utf-8"))
            if out.exists():
                os.replace(out, part / "old")
            os.replace(part / "new", out)
            os.replace(part / "truth.json", truth_path(out))
    finally:
        if (part / "old").exists() and not out.exists():
            os.replace(part / "old", out)  # restore the last campaign after any interruption
        shutil.rmtree(part, ignore_errors=True)


def _refuse_foreign(out: Path) -> None:
    """Raise unless `out` is missing, empty, or holds nothing but a campaign that `simulate` wrote."""
    fix = "Give --out another name, or move what is there."
    truth = truth_path(out)
    listed: set[str] = set()
    if truth.exists():
        try:
            listed = {"runs.csv", *(row["file"] for row in load_truth(truth)["files"])}
        except (OSError, RequestError, KeyError, TypeError) as error:
            raise OutError("was not written by simulate.", file=truth, fix=fix) from error
    if not out.exists():
        return
    if not out.is_dir():
        raise OutError("is a file, not a folder.", file=out, fix=fix)
    for path in sorted(out.rglob("*")):
        name = path.relative_to(out).as_posix()
        if name not in listed and not (path.is_dir() and listed):
            raise OutError(f"holds '{name}', which simulate did not write.", file=out, fix=fix)


def _write(spec: Spec, folder: Path) -> dict:
    law, seed = steady_law(spec), spec.seed
    files = noise.add_channels(plan_files(spec.design, noise.stream(seed, "order")), spec.channels, seed)
    scatter = noise.draw_scatter(spec.noise, files, seed)
    shifts = noise.stream(seed, "start").standard_normal(len(files))
    starts = spec.design.start_mm + spec.design.start_scatter_mm * shifts
    defects = noise.draw_defects(spec.noise, len(files), seed)
    squares, known = np.zeros(len(law.effects)), []
    for number, record in enumerate(files.to_dict("records")):
        speed = record["speed_mm_s"] * scatter.speed[number]
        motion = move(spec, speed, record["direction"], starts[number])
        along = {
            c.name: noise.trace_channel(c, motion.time_s, noise.stream(seed, "channel", c.name, number))
            for c in spec.channels
            if isinstance(c, noise.TraceChannel)
        }
        channels = _channels(record, motion, along)
        friction, added = _forces(spec, law, motion, channels, speed)
        clean = scatter.gain[number] * friction + added + scatter.offset_N[number]
        force, displacement = noise.logged(spec.noise, clean, motion, speed, number, seed)
        columns = {
            "time_s": motion.time_s,
            "displacement_mm": np.round(displacement, DISPLACEMENT_DECIMALS),
            "force_N": np.round(force, spec.force_decimals),
            **along,
        }
        if number in defects:
            columns = noise.spoil(columns, defects[number], noise.stream(seed, "bad_data", number))
        _write_trace(columns, folder / record["file"])
        steady = _rows(channels, motion.steady)
        true = np.broadcast_to(law.force_N(steady), steady["direction"].shape)
        for sign in np.unique(steady["direction"])[::-1].tolist():
            own = steady["direction"] == sign
            found = {"mean_force_N": float(true[own].mean()), "defect": defects.get(number)}
            drawn = {name: scatter[name][number] for name in ("gain", "offset_N", "outlier")}
            known.append(record | {"direction": sign, "speed_mm_s": sign * speed} | found | drawn)
        few = slice(None, None, max(1, len(true) // RMS_ROWS))
        sample, whole = _rows(steady, few), true[few]
        squares += [np.mean((whole - law.without(k).force_N(sample)) ** 2) for k in range(len(law.effects))]
    _write_runs(files, folder / "runs.csv")
    return truth_document(spec, pd.DataFrame(known), np.sqrt(squares / len(files)))


def _channels(record: dict, motion: Motion, along: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return a file's channels as sealfit's tables name them: shape (1,) for those of the file, else (n,)."""
    names = ("displacement_mm", "distance_mm", "speed_mm_s", "direction", "stroke")
    of_file = {name: np.array([value]) for name, value in record.items()}
    of_motion = {name: getattr(motion, name) for name in names}
    return {**of_file, **along, "time_s": motion.stroke_time_s, **of_motion}


def _rows(channels: dict[str, np.ndarray], rows: np.ndarray | slice) -> dict[str, np.ndarray]:
    return {name: values[rows] if len(values) > 1 else values for name, values in channels.items()}


def _forces(
    spec: Spec, law: SteadyLaw, motion: Motion, channels: dict[str, np.ndarray], speed: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return a trace's friction and the force that effects add to it, without noise, in N, (n,) each."""
    parts = law.parts({**channels, **_begun(spec, motion, speed)})
    limit, viscous, factor, added = (np.broadcast_to(part, motion.time_s.shape) for part in parts)
    if not np.isfinite((limit + viscous) * factor + added).all():
        reason = f"the effects give no number in {channels['file'][0]}."
        raise ConfigError(reason, fix="Check their parameters and formulas.")
    viscous = np.where(motion.speed_mm_s == 0, 0.0, viscous)
    return (_bristle_force(spec, law, motion, channels, speed) + viscous) * factor, added


def _bristle_force(
    spec: Spec, law: SteadyLaw, motion: Motion, channels: dict[str, np.ndarray], speed: float
) -> np.ndarray:
    """Return the bristles' force in N, (n,), followed through the ramps in finer steps than the file's."""
    time = finer(motion, spec.design, speed)
    between = {
        name: np.interp(time, motion.time_s, values) if len(values) == motion.time_s.size else values
        for name, values in channels.items()
    }
    start = motion.displacement_mm[0] - (0.0 if motion.direction[0] > 0 else spec.design.stroke_mm)
    fine = move_at(spec, speed, int(motion.direction[0]), start, time)
    limit, *_ = law.parts({**between, **_begun(spec, fine, speed)})
    limit = np.broadcast_to(limit, time.shape)
    rise = np.abs(limit) / spec.physics.sigma_0
    force = with_presliding(limit, fine, rise, spec.physics.sigma_1 / spec.physics.sigma_0)
    return force[np.searchsorted(time, motion.time_s)]


def _begun(spec: Spec, motion: Motion, speed: float) -> dict[str, np.ndarray]:
    """Return the channels by which a rest is the beginning of motion.

    At rest the bristles keep the last direction: a crawl stands for it, at which the law gives the break-away
    force. Within a bristle's length nothing has slid yet, nor at the clock's zero: a law in their logarithm
    starts after.
    """
    return {
        "speed_mm_s": motion.direction * np.maximum(np.abs(motion.speed_mm_s), CRAWL * speed),
        "distance_mm": np.maximum(motion.distance_mm, spec.rise_mm),
        "time_s": np.maximum(motion.stroke_time_s, motion.time_s[1]),
    }


def _write_trace(columns: dict[str, np.ndarray], path: Path) -> None:
    buffer = io.BytesIO()
    buffer.write((",".join(columns) + "\n").encode("utf-8"))
    # Adding zero turns -0.0, which no rig writes, into 0.0; NaN becomes an empty cell.
    table = pa.table({name: pa.array(values + 0.0, from_pandas=True) for name, values in columns.items()})
    pyarrow.csv.write_csv(table, buffer, pyarrow.csv.WriteOptions(include_header=False, quoting_style="none"))
    path.write_bytes(buffer.getbuffer())


def _write_runs(files: pd.DataFrame, path: Path) -> None:
    listed = files.drop(columns=[name for name in NOT_IN_RUNS if name in files])
    # Twelve digits: enough for any cell here, and 0.1 + 0.2 is written 0.3.
    path.write_bytes(listed.to_csv(index=False, lineterminator="\n", float_format="%.12g").encode("utf-8"))
