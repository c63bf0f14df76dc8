"""Which runs to make next: where rival models differ most, found by computing them, tested combinations or not."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from sealfit.closure.aliases import Alias, find_aliases
from sealfit.closure.confirm import AcceptedEffect
from sealfit.closure.forms import describe
from sealfit.closure.selection import Selection
from sealfit.config import Config
from sealfit.effects.contract import Effect
from sealfit.fit.estimate import Fitted
from sealfit.fit.joint import Model, evaluate
from sealfit.fit.rows import POWER, Rows, sliding_power

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
    if grown.after.rows.has_aging and not grown.after.scatter.knows("specimen"):
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
    without = evaluate(fitted.model.without_term(len(fitted.model.terms) - 1), fitted.rows, jacobian=False)[0]
    k = int(np.argmax(np.abs(fitted.force - without)))
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
    return replace(rows, table=table, speed=speed, pace=speed, days=days, load=load, cache={})


def _plain(value: object) -> object:
    value = value.item() if hasattr(value, "item") else value
    return float(f"{value:.4g}") if isinstance(value, float) else value
