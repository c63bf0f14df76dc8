"""Which runs to make next: where rival models differ most, and effects that this campaign cannot see."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from sealfit.closure.confirm import AcceptedEffect, added_force
from sealfit.closure.criteria import IDENTIFIABLE
from sealfit.closure.forms import describe, grid_of, reference
from sealfit.closure.selection import Selection
from sealfit.config import Config
from sealfit.effects.contract import CHANNEL, Effect
from sealfit.fit.joint.estimate import Fitted
from sealfit.fit.joint.model import Model, Term, evaluate, mean_derivatives
from sealfit.fit.joint.rows import POWER, Rows, sliding_power
from sealfit.fit.joint.search import bounds_of

# ---------------------------------------------------------------- aliases
# Effects that this campaign cannot see: what they do, the current model takes up whole.
#
# An offset of the sensor in a campaign that runs one way is friction; a drift along it, with one specimen tested
# after the other, is aging. No residual shows them, so they are looked for in the design: of an alias, less than 1 % is
# left after projection on the tangent space of the model, whatever its numbers and whichever quantity it acts on.

SIZE = 0.01  # of the force's RMS that an alias is given
NEGLIGIBLE = 1e-6  # RMS of a shape of amplitude 1, below which it does nothing here


@dataclass(frozen=True)
class Alias:
    """An effect that is there without a trace: a model that holds it, and one without it that gives the same forces."""

    term: Term
    holding: Model
    lacking: Model
    size_N: float  # RMS of what it adds


def find_aliases(fitted: Fitted, effects: Mapping[str, Effect], taken: tuple[str, ...]) -> list[Alias]:
    """Return the mechanisms of the catalogue that the model takes up whole in this campaign.

    Parameters
    ----------
    fitted : Fitted
        The final model.
    effects : mapping
        The catalogue.
    taken : tuple of str
        Channels that make a condition: what differs between series is the model's own already.
    """
    known = set(fitted.rows.channels) - set(taken)
    own = [e for e in effects.values() if e.physical and CHANNEL not in e.reads and set(e.reads) <= known]
    found = []
    for effect in own:
        first = None
        for *form, left in (f for target in effect.acts_on for f in _at_grid(fitted, effect, target)):
            if left >= IDENTIFIABLE:
                break  # it shows there, and the rest of its grid need not be looked at
            first = first or form
        else:
            found += [_alias(fitted, *first)] if first else []
    return found


def _at_grid(
    fitted: Fitted, effect: Effect, target: tuple[str, str]
) -> Iterator[tuple[Term, dict[str, float], np.ndarray, float]]:
    """Yield a form over the grid of its nonlinear numbers: its values, what it adds, and the share that is left."""
    rows = fitted.rows
    values = {name: rows.values(name) for name in effect.reads}
    if any(v.dtype.kind != "f" or (np.ptp(v) == 0 and name != "direction") for name, v in values.items()):
        return  # what does not vary is no effect here
    slope = fitted.slope(*target)
    if np.abs(slope).max() <= 0:
        return
    fixed = {f"{name}_ref": reference(np.abs(v)) for name, v in values.items()}
    term = Term(effect, effect.reads, *target, fixed=fixed)
    searched = grid_of(effect, np.abs(values[effect.reads[0]]))
    for point in itertools.product(*searched.values()):
        at = {**effect.start(), **dict(zip(searched, point, strict=True))}
        for name, shape in zip(effect.linear, mean_derivatives(term, at, rows, only_linear=True), strict=True):
            column = slope * shape
            if np.isfinite(shape).all() and (column**2).mean() > NEGLIGIBLE**2 * (slope**2).mean():
                white = fitted.whitening(column[:, None])[:, 0]
                left = fitted.basis.project_out(white)
                amplitudes = {n: float(n == name) for n in effect.linear}
                yield term, {**at, **amplitudes}, column, float(left @ left / (white @ white))


def _alias(fitted: Fitted, term: Term, values: Mapping[str, float], column: np.ndarray) -> Alias:
    size = SIZE * float(np.sqrt((fitted.rows.force**2).mean()))
    scale = size / float(np.sqrt((column**2).mean()))
    white = fitted.whitening(scale * column[:, None])[:, 0]
    change = fitted.covariance @ fitted.white_jacobian.against(white)
    scaled = {name: value * (scale if name in term.effect.linear else 1.0) for name, value in values.items()}
    chosen = {p.name: scaled[p.name] for p in term.effect.parameters}
    model = fitted.model
    without = np.clip(model.vector() + change, *bounds_of(model, fitted.rows))
    return Alias(term, model.with_term(term, chosen), model.at(without), size)


# ---------------------------------------------------------------- next runs
# Which runs to make next: where rival models differ most, found by computing them, tested combinations or not.

BEYOND = 0.5  # of a channel's range by which a run may go beyond what was tested
SHOWN = 0.5  # of its size by which a run must show an effect to be worth making for it
TIE = 1e-9  # relative: closer than that, only rounding tells runs apart
ROWS = 4  # of each stroke at which forces are compared


def next_runs(grown: Selection, config: Config, effects: Mapping[str, Effect]) -> list[dict]:
    """Return for each effect with rivals the run that would tell it from the nearest one, and for what cannot be seen
    here the run that would show it.

    Parameters
    ----------
    grown : Selection
        The end of the loop.
    config : Config
        The rig.
    effects : mapping
        The catalogue.

    Returns
    -------
    list of dict
        `why` in words and `conditions`: the run's condition and the channels to set, of one run each.
    """
    wanted = []
    for item in grown.added:
        for rival in item.rivals[:1]:
            chosen = item.proposal
            channels = (*chosen.term.channels, *rival.term.channels)
            found = where_apart(chosen.fitted.model, rival.fitted.model, chosen.fitted.rows, channels, config)
            if found is not None:
                wanted.append(
                    {
                        "why": f"tells {describe(item.proposal.term)} from {describe(rival.term)}: "
                        f"they differ there by {found[1]:.3g} {config.units.unit('force')}",
                        "conditions": found[0],
                    }
                )
    if grown.unsure is not None:
        wanted.append(_replicates(grown.unsure, config))
    if grown.after.rows.has_aging and not grown.after.scatter.estimates("specimen"):
        wanted.append(_second_specimen(grown.after.rows, config))
    return [*wanted, *_unseen(grown.after, config, effects)]


def _second_specimen(rows: Rows, config: Config) -> dict:
    """Return the condition to test on a second specimen where nothing shows how specimens scatter: the last one."""
    k = int(np.argmax(rows.days))
    return {
        "why": "would show how specimens scatter, which this campaign leaves unknown and every interval leaves out: "
        "a second specimen of a tested condition",
        "conditions": {name: _plain(rows.table[name].iloc[k]) for name in config.condition},
    }


def _unseen(fitted: Fitted, config: Config, effects: Mapping[str, Effect]) -> Iterator[dict]:
    """Yield the run that would show each effect that the model takes up whole here; one for those of like channels."""
    taken = tuple(name for name in (*config.condition, *config.rubber) if name != "aging_days")
    alike: dict[tuple[str, ...], list[Alias]] = {}
    for alias in find_aliases(fitted, effects, taken):
        alike.setdefault(alias.term.channels, []).append(alias)
    for channels, aliases in alike.items():
        first = aliases[0]
        found = where_apart(first.holding, first.lacking, fitted.rows, channels, config)
        if found is not None and found[1] > SHOWN * first.size_N:
            names = " or ".join(describe(a.term) for a in aliases)
            yield {
                "why": f"would show {names}: in this campaign the model takes it up whole",
                "conditions": found[0],
            }


def _replicates(item: AcceptedEffect, config: Config) -> dict:
    """Return the condition to repeat on a new specimen: where an effect that too few specimens show is largest."""
    fitted = item.proposal.fitted
    k = int(np.argmax(np.abs(added_force(item.proposal))))
    count = fitted.rows.groups.starts["specimen"].size
    few = "one specimen is" if count == 1 else f"{count} specimens are"
    return {
        "why": f"{few} too few to tell {describe(item.proposal.term)} from how specimens scatter: "
        "test a second specimen of the same conditions, here first",
        "conditions": {name: _plain(fitted.rows.table[name].iloc[k]) for name in (*config.condition, "speed_mm_s")},
    }


def where_apart(
    chosen: Model, rival: Model, rows: Rows, channels: Sequence[str], config: Config
) -> tuple[dict, float] | None:
    """Return the run at which two models differ most, and by how much (force unit); None if nowhere.

    Every tested run is tried with each combination of low, usual and high values of the channels, which the effects
    read that tell the models apart: what always went together in the campaign (a condition and the calendar) is taken
    apart here.
    """
    rows = rows.sparse(ROWS)
    channels = tuple(dict.fromkeys(channels))
    best: tuple[dict, float] | None = None
    for changes in ({}, *_combinations(chosen, rows, channels)):
        moved = _moved(rows, changes)
        apart = np.abs(evaluate(chosen, moved, jacobian=False)[0] - evaluate(rival, moved, jacobian=False)[0])
        apart = np.where(np.isfinite(apart), apart, 0.0)
        k = int(np.argmax(apart >= apart.max() * (1 - TIE)))  # the first of those that only rounding tells apart
        if apart[k] > (0.0 if best is None else best[1] * (1 + TIE)):
            names = dict.fromkeys((*config.condition, "speed_mm_s", *channels))
            where = {name: _plain(moved.table[name].iloc[k]) for name in names if name in moved.table}
            best = (where, float(apart[k]))
    return best


def _combinations(model: Model, rows: Rows, channels: tuple[str, ...]) -> Iterator[dict[str, object]]:
    """Yield values to set each channel to; a channel that makes a condition's own parameters is left alone."""
    values: dict[str, list] = {}
    for name in channels:
        own = rows.values(name)
        law = bool(model.declared.law) and all(model.declared.law.values())
        if name == "direction":
            values[name] = [-1.0, 1.0]
            continue
        if name == "displacement_mm" or (name == "aging_days" and not law):
            continue
        if own.dtype.kind != "f":
            values[name] = list(np.unique(own))
            continue
        own = np.abs(own)
        low, high = float(own.min()), float(own.max())
        beyond = high if name == "repeat" else high + BEYOND * (high - low)
        values[name] = [low, float(np.median(own)), high, beyond]
    for point in itertools.product(*values.values()):
        yield dict(zip(values, point, strict=True))


def _moved(rows: Rows, changes: Mapping[str, object]) -> Rows:
    """Return rows with channels set to other values; time follows the speed."""
    if not changes:
        return rows
    table = rows.table.assign(**changes)
    speed, days, load = rows.speed, rows.days, rows.load
    if "direction" in changes:
        speed = np.abs(speed) * float(changes["direction"])
        table["speed_mm_s"] = speed
    if "speed_mm_s" in changes:
        speed = np.sign(speed) * float(changes["speed_mm_s"])
        table["speed_mm_s"] = speed
        if "time_s" not in changes:
            table["time_s"] = rows.table["time_s"] * np.abs(rows.speed / speed)
    if "aging_days" in changes:
        days = np.where(rows.days > 0, float(changes["aging_days"]), rows.days)  # unaged rubber has no law of its own
        table["aging_days"] = days
    if "load_N" in changes:
        load = np.full_like(rows.load, float(changes["load_N"]))
    if POWER in table and POWER not in changes:
        table[POWER] = sliding_power(load, speed)
    return replace(rows, table=table, speed=speed, pace=speed, days=days, load=load)


def _plain(value: object) -> object:
    value = value.item() if hasattr(value, "item") else value
    return float(f"{value:.4g}") if isinstance(value, float) else value
