"""One campaign of the loop's benchmark: simulated, closed, scored against its truth and beside the rivals."""

from __future__ import annotations

import tempfile
import time
import zlib
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import pandas as pd
from campaigns import campaign
from points import draw_points, force_at
from rivals import rival_forces
from scoring import Target, correlations, match, misplaced, named_right
from truths import NO_INTERVAL, TrueEffect, test_true_forms, true_effects, true_force, truth_in_claim

from sealfit.closure.loop import Closure, close_loop
from sealfit.closure.output import from_record
from sealfit.closure.predict import predict
from sealfit.closure.ripple_selection import numbered
from sealfit.closure.score_test import project
from sealfit.closure.subsampling import merged_bins
from sealfit.config import Config
from sealfit.fit.joint import fitted_at
from sealfit.fit.joint.model import Model, evaluate
from sealfit.fit.joint.rows import Rows, make_rows
from sealfit.fit.joint.whitening import Component, Scatter
from sealfit.ingest.campaign import ingest_campaign
from sealfit.simulation import Spec, load_truth, simulate, truth_path

POINTS = 200


@dataclass(frozen=True)
class Task:
    """Which campaign, and whether the rivals are learned on it."""

    kind: str
    strength: str
    seed: int
    size: str
    rivals: bool

    @property
    def key(self) -> tuple:
        """What a result is known by."""
        return (self.kind, self.strength, self.seed, self.size)

    @property
    def draw(self) -> int:
        """Seed of the campaign: each draws its own rig, or one unlucky specimen would count many times."""
        return 1000 * (zlib.crc32(f"{self.kind} {self.strength}".encode()) % 1_000_000) + self.seed

    def record(self) -> dict:
        """Return the head of the task's record."""
        return asdict(self)


class Clock:
    """CPU seconds of named parts."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    @contextmanager
    def part(self, name: str):
        """Time what is done inside."""
        started = time.process_time()
        yield
        self.seconds[name] = self.seconds.get(name, 0.0) + time.process_time() - started


def run_campaign(task: Task) -> dict:
    """Return everything the summary needs to know of one campaign, as JSON-able values."""
    clock, wall = Clock(), time.monotonic()
    strength = "medium" if task.strength == "-" else task.strength
    spec = campaign(task.kind, seed=task.draw, size=task.size, strength=strength)
    config = Config()
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder) / "campaign"
        with clock.part("simulate"):
            simulate(spec, place)
            truth = load_truth(truth_path(place))
        with clock.part("ingest"):
            tables = ingest_campaign(place, config).tables
    with clock.part("loop"):
        closure = close_loop(tables["bins"], tables["traces"], config)
    with clock.part("truth"):
        rows = _rows(tables["bins"], spec, config)
        before, after, _ = from_record(closure.model)
        scatter = _scatter(closure.model)
        true = true_effects(spec, rows)
        tests, true_fit = test_true_forms(before, rows, scatter, true)
        scored = _score(true, closure, before, after, rows, scatter)
    rng = np.random.default_rng([zlib.crc32(task.kind.encode()), task.seed])
    points = draw_points(tables["bins"].reset_index(drop=True), spec, POINTS, rng)
    with clock.part("predict"):
        answered = predict(closure.model, points)
        exact = true_force(truth, points)
    forces = {
        "after": answered["force_after_N"].to_numpy(),
        "plain": answered["force_before_N"].to_numpy(),
        "true_form": force_at(true_fit, points),
    }
    missing: dict[str, str] = {}
    if task.rivals:
        plain = fitted_at(before, rows, scatter)
        rivalled = rival_forces(rows, plain.residual, points, forces["plain"], task.seed)
        forces |= rivalled.force
        missing = rivalled.missing
        clock.seconds |= rivalled.seconds
    good = np.isfinite(np.column_stack(list(forces.values()))).all(axis=1)
    low, high = (answered[f"force_after_{end}95_N"].to_numpy() for end in ("lo", "hi"))
    document = closure.document
    for entry, tested in zip(scored["effects"], tests, strict=True):
        entry |= {"z": tested.z, "z_expected": tested.z_expected}
    return {
        **task.record(),
        "files": int(tables["bins"]["file"].nunique()),
        "rows": len(tables["bins"]),
        "verdict": document["verdict"],
        "before": document["before"]["heldout_rmse_N"],
        "after": document["after"]["heldout_rmse_N"],
        "floor": document["noise_floor_N"],
        **scored,
        "errors": {name: _rms((force - exact)[good]) for name, force in forces.items()},
        "points": int(good.sum()),
        "inside": int(((low <= exact) & (exact <= high))[good].sum()),
        "missing": missing,
        "seconds": {**clock.seconds, "wall": time.monotonic() - wall},
    }


def _rows(bins: pd.DataFrame, spec: Spec, config) -> Rows:
    """Return the rows the loop works on: merged as it does, bins as they are where there is a ripple."""
    counted = numbered(bins.reset_index(drop=True))
    as_they_are = any(e.id == "ripple" for e in spec.effects)  # merged bins would blur it
    return make_rows(
        counted if as_they_are else merged_bins(counted, config.loop.seed), has_aging=config.aging
    )


def _scatter(record: dict) -> Scatter:
    kept = record["scatter"]
    components = tuple(Component(**c) for c in kept["components"])
    return Scatter(kept["s0"], kept["g"], components, kept["alike"], kept["shape"])


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2))) if values.size else float("nan")


def _score(
    true: list[TrueEffect], closure: Closure, before: Model, after: Model, rows: Rows, scatter
) -> dict:
    """Return what each true effect and each claim came to."""
    claims = closure.document["effects"]
    targets = [
        Target(t.id, t.channels, t.level, t.term.acts_on, t.term.operation, t.catalogued) for t in true
    ]
    alike = np.zeros((len(true), len(claims)))
    if true and claims:
        whole = evaluate(after, rows, jacobian=False)[0]
        parts = [whole - evaluate(_silenced(after, k), rows, jacobian=False)[0] for k in range(len(claims))]
        plain = fitted_at(before, rows, scatter)
        left = project(plain, np.column_stack([*(t.column for t in true), *parts]))
        alike = correlations(left[:, : len(true)], left[:, len(true) :])
    found = match(targets, claims, alike)
    numbers = [k for k, _ in found]
    effects = []
    for j, (target, effect, (k, grade)) in enumerate(zip(targets, true, found, strict=True)):
        claim = claims[k] if k is not None else None
        named, named_leniently = named_right(target, claim)
        effects.append(
            {
                "id": target.id,
                "channels": list(target.channels),
                "level": target.level,
                "acts_on": target.acts_on,
                "operation": target.operation,
                "catalogued": target.catalogued,
                "rms_N": _rms(effect.column),
                "grade": grade,
                "claimed_id": claim and claim["id"],
                "named": named,
                "named_leniently": named_leniently,
                "correlation": float(alike[j, k]) if k is not None else None,
                "parameters": _parameters(effect, claim, after, k, rows) if named and grade == 2 else [],
            }
        )
    slim = ("id", "channels", "level", "acts_on", "operation", "named", "p_value")
    return {
        "effects": effects,
        "claims": [{name: c[name] for name in slim} for c in claims],
        "extra": len(claims) - sum(k is not None for k in numbers),
        "misplaced": len(misplaced(targets, numbers, claims)),
    }


def _silenced(model: Model, number: int) -> Model:
    """Return the model with one term's amplitudes at zero."""
    term, values = model.terms[number], dict(model.values[number])
    values |= dict.fromkeys(term.effect.linear, 0.0)
    return Model(
        model.declared,
        model.theta,
        model.terms,
        (*model.values[:number], values, *model.values[number + 1 :]),
    )


def _parameters(effect: TrueEffect, claim: dict, after: Model, number: int, rows: Rows) -> list[dict]:
    """Return each parameter's interval beside its true number."""
    term, found = after.terms[number], after.values[number]
    wanted = truth_in_claim(effect, term, found, rows)
    result = []
    for parameter, given in zip(term.effect.parameters, claim["parameters"], strict=True):
        low, high = given["ci95"]
        if low is None or (effect.id, parameter.name) in NO_INTERVAL:
            continue
        true = wanted[parameter.name]
        result.append(
            {"name": parameter.name, "value": given["value"], "low": low, "high": high, "true": true,
             "inside": bool(low <= true <= high)}
        )  # fmt: skip
    return result
