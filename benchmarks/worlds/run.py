"""One world from its draw to its scored record: written, given to sealfit's command, read back, compared."""

from __future__ import annotations

import json
import os
import re
import resource
import signal
import subprocess
import tempfile
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import pandas as pd
from process_tree import memory, tree

from worlds.campaign import draw_points, points_csv, truth_record, write_campaign
from worlds.motion import force_at
from worlds.parameters import HOLDS_FOR_TESTED, laws_inside, lifetime_answer, lifetime_question
from worlds.score import Target, explained_by, on_variables, scored
from worlds.true_form import CLAIM_LEVEL, CLEAR, Rows, codes, error_at, make_rows, unit_of, z_values
from worlds.world import World, draw_world

LOOK_EVERY_S = 0.2
LEAST_SHARE = 0.01  # of an effect beside the declared quantities: of less, nothing can be said to be the same
SAME_ORDER = 0.999  # rank correlation of channels that are one variable, as run_order and elapsed_h
THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")
POWER = "power"  # sealfit's derived channel: load times speed


@dataclass(frozen=True)
class Task:
    """Which world, and how sealfit is run on it."""

    seed_text: str
    index: int
    size: str
    python: str  # interpreter in which sealfit is installed
    workers: int = 1
    limit_s: float = 300.0
    keep: str | None = None  # folder in which campaign and results stay

    @property
    def key(self) -> tuple:
        """What a result is known by."""
        return (self.seed_text, self.index, self.size)


@dataclass(frozen=True)
class Ended:
    """How a command ended."""

    code: int | None  # None: killed at the time limit
    seconds: float
    cpu_seconds: float  # of all its processes, which a busy machine does not lengthen as it does the clock's
    peak_bytes: int  # resident, of the whole process tree
    output: str

    @property
    def traceback(self) -> str | None:
        """Last line of a traceback, else a library's first warning, which no user should see, or None."""
        lines = self.output.strip().splitlines()
        if "Traceback (most recent call last)" in self.output:
            return lines[-1][:300]
        return next((line[-300:] for line in lines if re.search(r"\wWarning: ", line)), None)


def command(words: list[str], limit_s: float) -> Ended:
    """Run a command with a time limit and look at the resident memory of all its processes."""
    started, spent, peak = time.monotonic(), _cpu_seconds(), 0
    with tempfile.TemporaryFile("w+", encoding="utf-8") as said:
        environment = {**os.environ, **dict.fromkeys(THREADS, "1")}
        process = subprocess.Popen(words, stdout=said, stderr=said, env=environment, start_new_session=True)
        while process.poll() is None:
            if time.monotonic() - started > limit_s:
                os.killpg(process.pid, signal.SIGKILL)
                process.wait()
                return Ended(None, time.monotonic() - started, _cpu_seconds() - spent, peak, "")
            peak = max(peak, memory(tree(process.pid), proportional=False)[0])
            time.sleep(LOOK_EVERY_S)
        said.seek(0)
        return Ended(
            process.returncode, time.monotonic() - started, _cpu_seconds() - spent, peak, said.read()
        )


def _cpu_seconds() -> float:
    """Return the processor time of all commands that have ended."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def run_world(task: Task) -> dict:
    """Return the record of one world, as JSON-able values."""
    world = draw_world(task.seed_text, task.index, task.size)
    with tempfile.TemporaryDirectory() as temporary:
        home = Path(task.keep or temporary) / f"{task.size}_{task.index}"
        home.mkdir(parents=True, exist_ok=True)
        started = time.monotonic()
        config = write_campaign(world, home / "campaign")
        (home / "campaign.truth.json").write_text(json.dumps(truth_record(world)), encoding="utf-8")
        rows = make_rows(world)
        record = {
            "seed_text": task.seed_text, "index": task.index, "size": task.size, "features": world.features,
            "files": len(world.files), "series": int(world.files["series"].nunique()),
            "days": int(world.days.size),
            "speeds": int(world.speeds_mm_s.size), "mean_N": world.rig["mean_N"],
            "stroke_bristles": world.rig["stroke_bristles"],
            "effects": true_effects(world, rows), "simulated_s": time.monotonic() - started,
        }  # fmt: skip
        words = [task.python, "-m", "sealfit", "run", str(home / "campaign"), "--out", str(home / "out")]
        words += ["--workers", str(task.workers), *(["--config", str(config)] if config else [])]
        ended = command(words, task.limit_s)
        record |= {
            "exit": ended.code,
            "traceback": ended.traceback,
            "seconds": ended.seconds,
            "cpu_s": ended.cpu_seconds,
            "peak_MB": ended.peak_bytes / 1e6,
        }
        if ended.code != 0:
            record["said"] = ended.output[-3000:]
        else:
            closure = json.loads((home / "out" / "closure.json").read_text("utf-8"))
            record |= read_closure(world, rows, closure, record["effects"])
            record |= predicted(task, world, rows, home)
            if not world.effects and world.days.size:
                record |= {"laws": laws_inside(world, home / "out"), "lifetime": lifetime(task, world, home)}
    return json.loads(json.dumps(record, default=float))


def lifetime(task: Task, world: World, home: Path) -> dict | None:
    """Return what `lifetime` says of the first aged series, or None where it cannot be asked."""
    question = lifetime_question(world)
    if question is None:
        return None
    words, true = question
    ended = command([task.python, "-m", "sealfit", "lifetime", str(home / "out"), *words], task.limit_s)
    if ended.code != 0:
        return {"exit": ended.code, "traceback": ended.traceback, "said": ended.output[-500:]}
    return {"exit": 0, **lifetime_answer(ended.output[ended.output.index("{") :], true)}


def true_effects(world: World, rows: Rows) -> list[dict]:
    """Return what is known of each hidden effect: what it is, its unit, its z, its size."""
    found = []
    for effect, z, place in zip(world.effects, z_values(rows, world), rows.effects, strict=True):
        column = rows.columns[:, place]
        found.append(
            {
                **{k: v for k, v in asdict(effect).items() if k not in ("parameters", "amplitude")},
                "place": effect.place,
                **z,
                "clear": bool(min(z["z"], z["z_expected"]) >= CLEAR),
                "rms_N": float(np.sqrt(np.mean(column**2))),
                "own_rms_N": float(np.sqrt(np.mean(column**2) * min(1.0, max(0.0, z["share"])))),
                "half_range_N": float(np.ptp(column) / 2),
            }
        )
    return found


def targets(effects: list[dict], rows: Rows) -> list[Target]:
    """Return what each effect must be found as; with a place, the level of variables alone is right, too."""
    units, found = codes(rows), []
    order = list(CLAIM_LEVEL)
    both_ways = bool(rows.table.groupby("file")["direction"].nunique().max() > 1)
    for e in effects:
        names = [n for n in e["variables"] if n in rows.table]
        alone = [unit_of(_set(rows, n), units) for n in names]
        levels = {e["level"], *([CLAIM_LEVEL[min(alone, key=order.index)]] if alone else [])}
        if not names:  # a plain change in one place: wherever that place is known
            levels |= {CLAIM_LEVEL[unit_of(_set(rows, n), units)] for n in e["place"]}
            levels |= {"run"} if "elapsed_h" in e["place"] else set()  # though it may begin within a run
        added = (e["acts_on"], e["operation"]) == ("force", "add")
        if both_ways and (added or "direction" in e["variables"]):
            levels.add("stroke")  # it shows between the strokes of a file
        if levels & {"repeat", "run"}:  # where set-ups take the place of runs
            levels |= {"repeat", "set_up"}
        found.append(Target(e["variables"], e["place"], sorted(levels), e["names"], added))
    return found


def _set(rows: Rows, name: str) -> np.ndarray:
    return rows.table["speed_set_mm_s" if name == "speed_mm_s" else name].to_numpy()


def read_closure(world: World, rows: Rows, closure: dict, effects: list[dict]) -> dict:
    """Return the verdict, the claims and how they compare with the hidden effects."""
    entries = closure["effects"]
    claims = [e for e in entries if not e.get("candidate")]
    explained = np.zeros((len(effects), len(claims)))
    table = rows.table.assign(**{POWER: rows.table.get("load_N", 1.0) * rows.table["speed_mm_s"]})
    root = 1 / np.sqrt(rows.variance + 1e-4 * rows.table["mean"].to_numpy() ** 2)
    for j, place in enumerate(rows.effects):
        if effects[j]["share"] < LEAST_SHARE:
            continue
        others = np.delete(rows.columns, place, axis=1) * root[:, None]
        for k, claim in enumerate(claims):
            names = claim["channels"]
            if all(n in table and table[n].notna().all() for n in names) and len(names) <= 2:
                values = {n: table[n].to_numpy() for n in names}
                scale = np.column_stack([root, root * rows.table["mean"]])
                explained[j, k] = explained_by(values, rows.columns[:, place] * root, others, scale)
    aims = targets(effects, rows)
    same = copies(
        table, {n for t in aims for n in (*t.variables, *t.place)}, {n for c in claims for n in c["channels"]}
    )
    result = scored(
        aims, [c | {"channels": [same.get(n, n) for n in c["channels"]]} for c in claims], explained
    )
    slim = (
        "id",
        "channels",
        "level",
        "acts_on",
        "operation",
        "named",
        "p_value",
        "heldout_gain_N",
        "candidate",
    )
    stated = closure.get("sensitivity")
    merged = []
    for effect, aim, came in zip(effects, aims, result.pop("effects"), strict=True):
        own = [s for s in stated or [] if on_variables(aim, _names(s["variable"])) and s.get("smallest_N")]
        merged.append(effect | came | {"smallest_N": own[0]["smallest_N"] if own else None})
    return {
        "verdict": closure["verdict"], "claims": [{n: c.get(n) for n in slim} for c in entries],
        "candidates": len(entries) - len(claims), **result, "effects": merged,
        "before": closure["before"]["heldout_rmse_N"], "after": closure["after"]["heldout_rmse_N"],
        "rmse_before": closure["before"]["rmse_N"], "rmse_after": closure["after"]["rmse_N"],
        "floor": closure["noise_floor_N"], "left": closure["left"], "fit_quality": closure.get("fit_quality"),
        "outliers": [one["file"] for one in closure.get("outlier_files", [])],
        "wrong": world.files.loc[world.files["_wrong"], "file"].tolist(),
        "refused": closure.get("refused"), "has_sensitivity": stated is not None,
    }  # fmt: skip


def copies(table: pd.DataFrame, true: set[str], claimed: set[str]) -> dict[str, str]:
    """Return the true variable of claimed channels that order the rows as it does (the calendar's do)."""
    varying = {n for n in table if table[n].dtype.kind in "fi" and table[n].nunique() > 1}
    numeric, others = sorted(true & varying), sorted((claimed - true) & varying)
    return {
        o: n for n in numeric for o in others if abs(table[n].corr(table[o], method="spearman")) > SAME_ORDER
    }


def _names(variable) -> list[str]:
    return [variable] if isinstance(variable, str) else list(variable)


def predicted(task: Task, world: World, rows: Rows, home: Path) -> dict:
    """Return how `predict` compares with the noise-free truth at new points and with the fitted true form."""
    points = draw_points(world)
    exact = force_at(world, points)
    points_csv(world, points).to_csv(home / "points.csv", index=False)
    words = [task.python, "-m", "sealfit", "predict", str(home / "out"), "--points", str(home / "points.csv")]
    ended = command([*words, "--output", str(home / "predicted.csv")], task.limit_s)
    if ended.code != 0:
        return {
            "predict_exit": ended.code,
            "predict_traceback": ended.traceback,
            "predict_said": ended.output[-3000:],
        }
    answer = pd.read_csv(home / "predicted.csv")
    before, after = (answer[f"force_{name}_N"].to_numpy(float) for name in ("before", "after"))
    low, high = (answer[f"force_after_{end}95_N"].to_numpy(float) for end in ("lo", "hi"))
    outside = answer["extrapolated"].astype(str).str.lower().isin(["true", "1"]).to_numpy()
    good = np.isfinite(after) & np.isfinite(before) & ~outside
    oracle = error_at(world, rows, points)
    own_only = answer["note"].astype(str).str.contains(HOLDS_FOR_TESTED).to_numpy()
    meant = np.where(
        own_only, force_at(world, points, tested=True), exact
    )  # what each interval says it is of
    inside = (low <= meant) & (meant <= high) & good
    given = np.isfinite(low) & np.isfinite(high) & good

    def rms(error: np.ndarray) -> float | None:
        return float(np.sqrt(np.mean(error[good] ** 2))) if good.any() else None

    return {
        "predict_exit": 0,
        "points": int(good.sum()),
        "unanswered": int((~np.isfinite(after)).sum()),
        "extrapolated": int(outside.sum()),
        "errors": {"before": rms(before - exact), "after": rms(after - exact), "true_form": rms(oracle)},
        "inside": int(inside.sum()),
        "of_tested_specimens": {
            "points": int((given & own_only).sum()),
            "inside": int((inside & own_only).sum()),
        },
        "with_interval": int(given.sum()),
        "half_width_N": float(np.median((high - low)[given] / 2)) if given.any() else None,
    }
