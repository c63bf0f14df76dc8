"""Writes a simulated campaign: the folder as a rig would leave it, and the truth beside it."""

from __future__ import annotations

import io
import json
import os
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.csv

from sealfit.errors import ConfigError, OutError, RequestError
from sealfit.simulation.channels import TraceChannel, add_channels, trace_channel
from sealfit.simulation.defects import draw_defects, spoil
from sealfit.simulation.design import plan_files
from sealfit.simulation.draws import Draws
from sealfit.simulation.law import SteadyLaw, steady_law
from sealfit.simulation.motion import Motion, finer, move, move_at, with_presliding
from sealfit.simulation.noise import displacement_noise_mm, draw_scatter, quantised, sample_noise_N
from sealfit.simulation.spec import Spec
from sealfit.simulation.truth import load_truth, truth_document, truth_path

DISPLACEMENT_DECIMALS = 5  # 10 nm, as fine as any linear encoder on such a rig
NOT_IN_RUNS = ["condition", "direction", "run_order", "elapsed_h"]  # keys and derived channels, which ingest makes
CRAWL = 1e-3  # of the speed: slow enough for break-away; at zero itself a law in log speed has no value
RMS_ROWS = 64  # rows per file on which an effect's RMS is taken; the rest would not change its second digit


def simulate(spec: Spec, out: Path) -> None:
    """Write the campaign folder `out` and, beside it, `<out>.truth.json`.

    The same SPEC gives the same bytes. The folder appears at once and whole, or not at all.

    Raises
    ------
    ConfigError
        If an effect is not the catalogue's or gives no number somewhere on this design.
    OutError
        If `out` holds files that `simulate` did not write, or cannot be written.
    """
    out = Path(os.path.abspath(out))
    _refuse_foreign(out)
    part = out.with_name(f".{out.name}.part-{os.getpid()}")
    try:
        try:
            (part / "new" / "traces").mkdir(parents=True)
            document = _write(spec, part / "new")
            text = json.dumps(document, indent=1, ensure_ascii=False, allow_nan=False) + "\n"
            (part / "truth.json").write_bytes(text.encode("utf-8"))
            if out.exists():
                os.replace(out, part / "old")
            os.replace(part / "new", out)
            os.replace(part / "truth.json", truth_path(out))
        except OSError as error:
            raise OutError(
                f"cannot be written ({error.strerror}).", file=out, fix="Check the disk and the folder's permissions."
            ) from error
    finally:
        if (part / "old").exists() and not out.exists():
            os.replace(part / "old", out)  # whatever stopped it, Ctrl-C too: the last campaign comes back
        shutil.rmtree(part, ignore_errors=True)


def _refuse_foreign(out: Path) -> None:
    """Raise unless `out` is missing, empty, or holds nothing but a campaign that `simulate` wrote."""
    fix = "Give --out another name, or move what is there."
    truth = truth_path(out)
    listed: set[str] = set()
    if truth.exists():
        try:
            listed = {"runs.csv", *(row["file"] for row in load_truth(truth)["files"])}
        except (RequestError, KeyError, TypeError) as error:
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
    draws = Draws(spec.seed)
    law = steady_law(spec)
    spec = spec.risen()
    files = add_channels(plan_files(spec.design, draws.stream("order")), spec.channels, draws)
    scatter = draw_scatter(spec.noise, files, draws)
    starts = spec.design.start_mm + spec.design.start_scatter_mm * draws.stream("start").standard_normal(len(files))
    defects = draw_defects(spec.noise, len(files), draws)
    squares, weights, known = np.zeros(len(law.effects)), 0, []
    records = files.to_dict("records")
    for number, record in enumerate(records):
        speed = record["speed_mm_s"] * scatter.speed[number]
        motion = move(spec.design, speed, record["direction"], starts[number])
        along = {c.name: _along(c, motion, number, draws) for c in spec.channels if isinstance(c, TraceChannel)}
        channels = _channels(record, motion, along)
        force = _force(
            spec, law, motion, channels, scatter.gain[number], scatter.offset_N[number], speed, number, draws
        )
        noise = displacement_noise_mm(spec.noise, len(force), number, draws)
        columns = {
            "time_s": motion.time_s,
            "displacement_mm": np.round(motion.displacement_mm + noise, DISPLACEMENT_DECIMALS),
            "force_N": force,
            **along,
        }
        if number in defects:
            columns = spoil(columns, defects[number], draws.stream("bad_data", number))
        _write_trace(columns, folder / record["file"])
        steady = _rows(channels, motion.steady)
        true = np.broadcast_to(law.force_N(steady), steady["direction"].shape)
        for sign in np.unique(steady["direction"])[::-1].tolist():
            own = steady["direction"] == sign
            known.append(
                {
                    **record,
                    "direction": sign,
                    "speed_mm_s": sign * speed,
                    "mean_force_N": float(true[own].mean()),
                    "gain": scatter.gain[number],
                    "offset_N": scatter.offset_N[number],
                    "outlier": bool(scatter.outlier[number]),
                    "defect": defects.get(number),
                }
            )
        few = slice(None, None, max(1, len(true) // RMS_ROWS))
        sample, whole = _rows(steady, few), true[few]
        squares += [np.mean((whole - law.without(k).force_N(sample)) ** 2) for k in range(len(law.effects))]
        weights += 1
    _write_runs(files, folder / "runs.csv")
    return truth_document(spec, pd.DataFrame(known), np.sqrt(squares / weights))


def _along(channel: TraceChannel, motion: Motion, number: int, draws: Draws) -> np.ndarray:
    return trace_channel(channel, motion.time_s, draws.stream("channel", channel.name, number))


def _channels(record: dict, motion: Motion, along: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return a file's channels in the names of sealfit's tables: those of the file of shape (1,), the others (n,)."""
    return {
        **{name: np.array([value]) for name, value in record.items()},
        **along,
        "time_s": motion.stroke_time_s,
        "displacement_mm": motion.displacement_mm,
        "distance_mm": motion.distance_mm,
        "speed_mm_s": motion.speed_mm_s,
        "direction": motion.direction,
        "stroke": motion.stroke,
    }


def _rows(channels: dict[str, np.ndarray], rows: np.ndarray | slice) -> dict[str, np.ndarray]:
    return {name: values[rows] if len(values) > 1 else values for name, values in channels.items()}


def _force(
    spec: Spec,
    law: SteadyLaw,
    motion: Motion,
    channels: dict[str, np.ndarray],
    gain: float,
    offset_N: float,
    speed: float,
    number: int,
    draws: Draws,
) -> np.ndarray:
    """Return a trace's measured force in N, shape (n,)."""
    parts = law.parts({**channels, **_begun(spec, motion, speed)})
    limit, viscous, added = (np.broadcast_to(part, motion.time_s.shape) for part in parts)
    if not (np.isfinite(limit + viscous).all() and np.isfinite(added).all()):
        raise ConfigError(
            f"the effects give no number in {channels['file'][0]}.", fix="Check their parameters and formulas."
        )
    if spec.physics.sigma_0 is None:  # all that friction is comes up over one length
        friction = with_presliding(limit + viscous, motion, np.full(motion.time_s.size, spec.design.stiffness_mm))
    else:
        friction = _dynamic(spec, law, motion, channels, speed) + viscous
    clean = gain * friction + added + offset_N
    noisy = clean + sample_noise_N(spec.noise, clean, motion.time_s, speed, number, draws)
    return np.round(quantised(spec.noise, noisy), spec.force_decimals)


def _dynamic(spec: Spec, law: SteadyLaw, motion: Motion, channels: dict[str, np.ndarray], speed: float) -> np.ndarray:
    """Return the bristles' force in N, shape (n,), followed through the ramps in steps finer than the file's rows."""
    time = finer(motion, spec.design, speed)
    between = {
        name: np.interp(time, motion.time_s, values) if len(values) == motion.time_s.size else values
        for name, values in channels.items()
    }
    start = motion.displacement_mm[0] - (0.0 if motion.direction[0] > 0 else spec.design.stroke_mm)
    fine = move_at(spec.design, speed, int(motion.direction[0]), start, time)
    limit, _, _ = law.parts({**between, **_begun(spec, fine, speed)})
    limit = np.broadcast_to(limit, time.shape)
    rise = np.abs(limit) / spec.physics.sigma_0
    force = with_presliding(limit, fine, rise, spec.physics.sigma_1 / spec.physics.sigma_0)
    return force[np.searchsorted(time, motion.time_s)]


def _begun(spec: Spec, motion: Motion, speed: float) -> dict[str, np.ndarray]:
    """Return the channels by which a rest is the beginning of motion.

    At rest the bristles keep the last direction: a crawl stands for it, at which the law gives the break-away force.
    Within a bristle's length nothing has slid yet, nor at the clock's zero: a law in their logarithm starts after.
    """
    return {
        "speed_mm_s": motion.direction * np.maximum(np.abs(motion.speed_mm_s), CRAWL * speed),
        "distance_mm": np.maximum(motion.distance_mm, spec.design.stiffness_mm),
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
