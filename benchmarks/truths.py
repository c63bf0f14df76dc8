"""What a campaign's truth file says in terms of the joint model: true effects as terms, tested and fitted.

The true-form test of an effect: the declared model with every true effect in its true form, what is nonlinear
in them held at its true value, fitted by the loop's own estimator to the rows the loop works on; z is the
effect's amplitude over its standard error, the wider of the fitted scatter's and the one that whole groups of
the effect's own unit show (as in the loop's intervals), with the sign of the true amplitude. For k amplitudes
at once it is sqrt(max(W - (k - 1), 0)), W the Wald statistic.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
from effect_kinds import FORMULA_OF

from sealfit.closure.channels import flip_level, unit_of
from sealfit.closure.errors_and_intervals import robust_covariance
from sealfit.closure.result import channels_of, effect_level
from sealfit.effects import EFFECTS
from sealfit.effects.contract import AMPLITUDE, Effect, Parameter
from sealfit.effects.free import LEVELS, levels_effect
from sealfit.errors import RequestError
from sealfit.fit.joint import Fitted, fit
from sealfit.fit.joint.model import Model, Term
from sealfit.fit.joint.rows import Rows
from sealfit.ingest.expression import evaluate, parse
from sealfit.simulation import Spec
from sealfit.simulation.motion import SteadyLaw, steady_law

UNITS = ("stroke", "file", "run", "specimen")
# Parameters without interval: a step is the same anywhere between two neighbouring values of the channel.
NO_INTERVAL = {("step", "x_0")}


def true_force(truth: Mapping, points: pd.DataFrame) -> np.ndarray:
    """Return the noise-free force at arbitrary points, in N, shape (n,), after the rise of each stroke.

    Bristles follow a slow change along a stroke one length of the rise behind; the sensor does not.

    Parameters
    ----------
    truth : mapping
        The document of `load_truth`.
    points : DataFrame
        `speed_mm_s` (signed), the condition columns that the design has, and the channels that its effects
        read, in the names of sealfit's tables. `load_N` may be left out where the design has one load,
        `direction` always.

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
    if "direction" not in points and "speed_mm_s" in points:
        points = points.assign(direction=np.sign(points["speed_mm_s"]))
    if "load_N" not in points and len(spec.design.loads_N) == 1:
        points = points.assign(load_N=spec.design.loads_N[0])
    channels = {}
    for name in ("speed_mm_s", *spec.design.columns, *(name for e in law.effects for name in e.channels)):
        if name not in points:
            raise RequestError(
                "the points lack a column.", column=name, fix="Add it; the truth depends on it."
            )
        if empty := int(points[name].isna().sum()):
            raise RequestError(f"the points have {empty} empty cells.", column=name, fix="Fill them.")
        channels[name] = points[name].to_numpy()
    *_, factor, added = law.parts(channels)
    limit, viscous, *_ = law.parts(_followed(channels, spec, law))
    return np.broadcast_to((limit + viscous) * factor + added, (len(points),)).astype(float)


def _followed(channels: Mapping[str, np.ndarray], spec: Spec, law: SteadyLaw) -> dict[str, np.ndarray]:
    """Return the channels one length of the rise before."""
    speed = channels["speed_mm_s"]
    rise = np.abs(law.parts(channels)[0]) / spec.physics.sigma_0
    behind = {"displacement_mm": np.sign(speed) * rise, "distance_mm": rise, "time_s": rise / np.abs(speed)}
    before = {name: channels[name] - behind[name] for name in behind if name in channels}
    if "distance_mm" in before:
        before["distance_mm"] = np.maximum(before["distance_mm"], spec.rise_mm)  # as the simulation begins
    return {**channels, **before}


@dataclass(frozen=True)
class TrueEffect:
    """One true effect: its term, the true numbers of its parameters, and what it adds to each row's force."""

    id: str
    term: Term
    values: Mapping[str, float]
    channels: tuple[str, ...]  # as closure.json names them
    level: str
    unit: str  # whose whole groups are its evidence
    column: np.ndarray  # (n,) with it less without it, noise-free

    @property
    def catalogued(self) -> bool:
        """Whether the catalogue, or levels of a category, can name it."""
        return self.id in EFFECTS or self.id == LEVELS


def true_effects(spec: Spec, rows: Rows) -> list[TrueEffect]:
    """Return the true effects of a campaign, on the rows of its bins."""
    law = steady_law(spec)
    given = row_channels(law, rows)
    whole = np.broadcast_to(law.force_N(given), rows.force.shape)
    found = []
    for number, entry in enumerate(spec.effects):
        term, values = true_term(entry, law.effects[number].channels)
        name = FORMULA_OF.get(entry.formula, entry.id)
        found.append(
            TrueEffect(
                name if name in EFFECTS else entry.id,
                term,
                values,
                tuple(channels_of(term, rows)),
                effect_level(term, rows),
                evidence_unit(term, rows),
                whole - law.without(number).force_N(given),
            )
        )
    return found


def row_channels(law: SteadyLaw, rows: Rows) -> dict[str, np.ndarray]:
    """Return what a law reads, from rows."""
    names = {"speed_mm_s", "direction", "temperature_C", "compression_ratio_pct", "aging_days", "load_N"}
    names |= {name for effect in law.effects for name in effect.channels}
    return {name: rows.values(name) for name in names if name in rows.table}


def evidence_unit(term: Term, rows: Rows) -> str:
    """Return the level of the unit of evidence of an effect: that of its finest channel."""
    order = ("sample", *UNITS)
    finest = min((unit_of(rows.values(name), rows) for name in channels_of(term, rows)), key=order.index)
    return flip_level(finest, rows)


def true_term(entry, channels: tuple[str, ...]) -> tuple[Term, dict[str, float]]:
    """Return an effect of a SPEC as a term of the joint model, and its true numbers in its parameters."""
    target = (entry.acts_on, entry.operation)
    if entry.id == LEVELS:
        categories = sorted(entry.parameters)
        base = entry.parameters[categories[0]]
        scale = 1.0 + base if entry.operation == "multiply" else 1.0
        values = {
            f"d_{k}": (entry.parameters[c] - base) / scale for k, c in enumerate(categories[1:], start=1)
        }
        return Term(
            levels_effect(categories), channels, *target, fixed={"categories": tuple(categories)}
        ), values
    if entry.formula is not None:
        return Term(formula_effect(entry.formula, entry.parameters, target), channels, *target), dict(
            entry.parameters
        )
    return Term(EFFECTS[entry.id], channels, *target, fixed=dict(entry.reference)), dict(entry.parameters)


def formula_effect(text: str, values: Mapping[str, float], target: tuple[str, str]) -> Effect:
    """Return a formula that is proportional to each of its parameters as an effect."""
    formula = parse(text)
    reads = tuple(name for name in sorted(formula.names) if name not in values)

    def shape(inputs, **given) -> np.ndarray:
        numbers = {name: np.float64(value) for name, value in given.items()}
        return evaluate(formula, {**{name: inputs[name] for name in reads}, **numbers})

    parameters = tuple(Parameter(n, "{y}", 0.0, AMPLITUDE, "size", linear=True) for n in values)
    return Effect("expression", text, text, reads, (target,), parameters, shape, "SPEC", ({}, {}, 0.0))


@dataclass(frozen=True)
class Tested:
    """The true-form test of one effect: z as measured, and z at the true amplitude."""

    z: float
    z_expected: float


def test_true_forms(
    declared: Model, rows: Rows, scatter, true: list[TrueEffect]
) -> tuple[list[Tested], Fitted]:
    """Return the test of each true effect, and the fit of the true form with all parameters free."""
    held = declared
    for effect in true:
        fixed = {p.name: (effect.values[p.name],) * 2 for p in effect.term.effect.nonlinear}
        own = dict(effect.term.fixed) | ({"held": fixed} if fixed else {})
        held = held.with_term(replace(effect.term, fixed=own), effect.values)
    known = fit(held, rows, scatter, turns=2)
    tests = []
    for number, effect in enumerate(true):
        first = held.term_slice(number).start
        places = [first + k for k, p in enumerate(effect.term.effect.parameters) if p.linear]
        covariance = _wider(known, effect.unit)[np.ix_(places, places)]
        fitted = known.model.values[number]
        linear = list(effect.term.effect.linear)
        found, wanted = (np.array([v[n] for n in linear]) for v in (fitted, effect.values))
        sign = 1.0 if len(linear) > 1 else float(np.sign(wanted[0]))
        tests.append(Tested(sign * _z(found, covariance), abs(_z(wanted, covariance))))
    free = known.model
    for _ in true:
        free = free.without_term(0)
    for number, effect in enumerate(true):
        free = free.with_term(effect.term, {**known.model.values[number], **_between(effect, rows)})
    return tests, fit(free, rows, known.scatter, turns=2)


def _between(effect: TrueEffect, rows: Rows) -> dict[str, float]:
    """Return the place of a step as a fit finds it: halfway between its channel's values on both sides."""
    if effect.id != "step":
        return {}
    values, place = rows.values(effect.term.channels[0]), effect.values["x_0"]
    return {"x_0": float((values[values < place].max() + values[values >= place].min()) / 2)}


test_true_forms.__test__ = False  # a test of effects, not of this program


def _wider(fitted: Fitted, unit: str) -> np.ndarray:
    """Return the covariance of the fitted scatter, or the cluster-robust one of a unit if larger."""
    usual, robust = fitted.covariance, robust_covariance(fitted, unit)
    grow = np.sqrt(np.maximum(np.diag(robust) / np.maximum(np.diag(usual), 1e-300), 1.0))
    return usual * np.outer(grow, grow)


def _z(amplitude: np.ndarray, covariance: np.ndarray) -> float:
    if amplitude.size == 1:
        return float(amplitude[0] / np.sqrt(max(covariance[0, 0], 1e-300)))
    score_statistic = float(amplitude @ np.linalg.pinv(covariance) @ amplitude)
    return float(np.sqrt(max(score_statistic - (amplitude.size - 1), 0.0)))


def truth_in_claim(
    effect: TrueEffect, claimed: Term, found: Mapping[str, float], rows: Rows
) -> dict[str, float]:
    """Return the true numbers as the claimed term writes them: its references, its phase's turn, its sign.

    Two forms with other references are one effect where 1 + h' = c (1 + h) for a factor, or h' = h + c for a
    change: the constant goes into the declared model. Amplitudes follow from least squares over the rows;
    nonlinear numbers mean the same in both. Only for a claim with the true id and target.
    """
    values = dict(effect.values)
    if "phi" in values:
        turn = 2 * np.pi
        if np.sign(found["A"]) != np.sign(values["A"]):
            values = {**values, "A": -values["A"], "phi": values["phi"] + np.pi}
        values["phi"] += turn * np.round((found["phi"] - values["phi"]) / turn)
        return values
    own = effect.term.effect.shape(effect.term.inputs(rows), **values)
    if np.allclose(claimed.effect.shape(claimed.inputs(rows), **values), own):
        return values
    zero = dict.fromkeys(effect.term.effect.linear, 0.0)
    columns = [
        claimed.effect.shape(claimed.inputs(rows), **{**values, **zero, name: 1.0})
        for name in claimed.effect.linear
    ]
    if effect.term.operation == "multiply":  # c (1 + own) - sum A g = 1
        matrix, wanted = np.column_stack([*(-c for c in columns), 1 + own]), np.ones_like(own)
    else:
        matrix, wanted = np.column_stack([*columns, -np.ones_like(own)]), own
    solved, *_ = np.linalg.lstsq(matrix, wanted, rcond=None)
    return values | dict(zip(claimed.effect.linear, (float(x) for x in solved[: len(columns)]), strict=True))
