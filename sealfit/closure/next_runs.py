"""Runs to make next: where rival models differ most, and for effects that these runs cannot show."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd

from sealfit.closure.channels import too_short
from sealfit.closure.confirm import added_force
from sealfit.closure.criteria import IDENTIFIABLE
from sealfit.closure.forms import AGING, describe, grid_of, reference
from sealfit.closure.left_out import OutlierFile
from sealfit.closure.linearised import Proposal
from sealfit.closure.selection import Selection
from sealfit.config import Config
from sealfit.effects.contract import CHANNEL, Effect
from sealfit.fit.joint import Fitted
from sealfit.fit.joint.declared import series_of_curve
from sealfit.fit.joint.model import Model, Term, evaluate, mean_derivatives
from sealfit.fit.joint.rows import ALONG, POWER, Rows, sliding_power
from sealfit.fit.joint.search import bounds_of
from sealfit.ingest.columns import condition_columns
from sealfit.tables import CALENDAR, HISTORY

# ---------------------------------------------------------------- aliases
# A sensor offset in a campaign with one direction is the same as friction; a drift over time, with one
# specimen tested after the other, is the same as aging. The residual does not contain such aliases. Of each,
# less than 1 % is left after projection off the tangent space of the model, for all its parameters and
# targets.

SIZE = 0.01  # Assumed size of an alias, as a share of the RMS force.
NEGLIGIBLE = 1e-6  # A shape of amplitude 1 with a smaller RMS has no effect here.


@dataclass(frozen=True)
class Alias:
    """An effect, the model with it, and the model without it that gives the same forces."""

    term: Term
    holding: Model
    lacking: Model
    size_N: float  # RMS of what it adds


def find_aliases(fitted: Fitted, effects: Mapping[str, Effect], taken: tuple[str, ...]) -> list[Alias]:
    """Return the physical effects of channels not `taken` that are the same as the model with these runs."""
    known = set(fitted.rows.channels) - set(taken)
    own = [e for e in effects.values() if e.physical and CHANNEL not in e.reads and set(e.reads) <= known]
    found = []
    for effect in own:
        forms = (form for target in effect.acts_on for form in _at_grid(fitted, effect, target))
        first = next(forms, None)
        if first is not None and all(form[-1] < IDENTIFIABLE for form in itertools.chain([first], forms)):
            found.append(_alias(fitted, *first[:-1]))
    return found


def _at_grid(
    fitted: Fitted, effect: Effect, target: tuple[str, str]
) -> Iterator[tuple[Term, dict[str, float], np.ndarray, float]]:
    """Yield a form at each grid point of its nonlinear parameters: term, values, column and share left."""
    rows = fitted.rows
    values = {name: rows.unsigned(name) for name in effect.reads if name != "direction"}
    if any(v.dtype.kind != "f" or np.ptp(v) == 0 for v in values.values()):
        return  # a constant has no effect here
    if effect.shown_by and not effect.shown_by(rows.values(effect.reads[0])):
        return
    slope = fitted.slope(*target)
    if np.abs(slope).max() <= 0:
        return
    fixed = {f"{name}_ref": reference(v) for name, v in values.items()}
    term = Term(effect, effect.reads, *target, fixed=fixed)
    searched = grid_of(effect, rows.unsigned(effect.reads[0]))
    for point in itertools.product(*searched.values()):
        at = {**effect.start(), **dict(zip(searched, point, strict=True))}
        shapes = mean_derivatives(term, at, rows, only_linear=True)
        for name, shape in zip(effect.linear, shapes, strict=True):
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
BEYOND = 0.5  # Share of the range of a channel by which a run may exceed it: the calendar, and `EXTENDED`.
EXTENDED = (AGING, "speed_mm_s")  # A rig may not reach other settings beyond what was tested.
MOST_REFUSED = 2  # Refused effects for which a run is proposed.
SHOWN = 0.5  # Least share of an effect's size that a proposed run must show.
DISTINCT = 0.1  # Least difference between two models that a run is to show, as a share of the RMSE.
TIE = 1e-9  # Relative difference below which two runs differ by rounding only.
LONGER_STROKES = (
    "would show effects along the strokes, which end before the friction is steady: slide eleven times the "
    "length of the rise to 63 %"
)
SLOWER_SPEED = (
    "would help to determine the Stribeck curve, which needs four speeds in one direction, two of them below "
    "about 2 v_s: a slower speed at every condition"
)
SECOND_SPECIMEN = (
    "would show the scatter of specimens, which these do not determine, and no interval has it: "
    "another specimen of a tested condition"
)
UNDECIDED = (
    "would show effects of {}, which these files do not decide: another specimen of each tested condition, "
    "here first"
)
ONE_ORDER = 0.99  # Rank correlation above which a channel follows another one.
ROWS = 4  # Rows per stroke at which forces are compared.


def next_runs(
    selection: Selection,
    config: Config,
    effects: Mapping[str, Effect],
    outliers: Sequence[OutlierFile] = (),
    undecided: Sequence[str] = (),
) -> list[dict]:
    """Return the runs that would distinguish effects from rivals, and those that would show aliases.

    The runs of files that were left out come first: they are to be repeated. Then there is a run for each
    effect, which would distinguish it from its nearest rival, runs for effects that were not confirmed and
    for `undecided` variables, and a run for each alias, which would show it.

    Returns
    -------
    list of dict
        `why`, a text, and `conditions`: the condition and the channels of one run.
    """
    wanted = [_run_to_repeat(one, config) for one in outliers]
    for item in selection.added:
        for rival, _ in item.rivals[:1]:
            chosen, own = item.proposal, item.proposal.fitted
            channels = (*chosen.term.channels, *rival.term.channels)
            found = largest_difference(own.model, rival.fitted.model, own.rows, channels, config)
            noise_N = float(np.sqrt(np.mean(own.residual**2)))
            if found is not None and found[1] > DISTINCT * noise_N:
                conditions, difference_N = found
                tested = "more repeats of a tested run " if _is_tested(conditions, own.rows) else ""
                forms = " from ".join(describe(one.term, own.rows) for one in (chosen, rival))
                size = f"{difference_N:.3g} {config.units.unit('force')}"
                why = f"{tested}would distinguish {forms}: they differ there by {size}"
                wanted.append({"why": why, "conditions": conditions})
    if selection.inconclusive is not None:
        wanted.append(_replicate_of(selection.inconclusive.proposal, config))
    refused = [item for item in selection.refused if not item.negligible and item.proposal.fitted]
    wanted += [_replicate_of(item.proposal, config, item.reason) for item in refused[:MOST_REFUSED]]
    rows = selection.after.rows
    if not selection.after.knows_specimens:
        last = rows.table.iloc[int(np.argmax(rows.days))]
        wanted.append({"why": SECOND_SPECIMEN, "conditions": _settings(last, condition_columns(config))})
    elif undecided:
        condition = rows.table.groupby("condition")["specimen_id"].nunique().idxmin()
        first = rows.table[rows.table["condition"] == condition].iloc[0]
        names = ["differences between specimens" if name == "specimen_id" else name for name in undecided]
        why = UNDECIDED.format(", ".join(names))
        wanted.append({"why": why, "conditions": _settings(first, condition_columns(config))})
    if too_short(rows):
        wanted.append({"why": LONGER_STROKES, "conditions": {}})
    wanted += _runs_for_aliases(selection.after, config, effects)
    return [*wanted, *_slower_speed(selection.after, config)]


def _is_tested(conditions: Mapping[str, object], rows: Rows) -> bool:
    """Return whether a run of these conditions is in the campaign, its numbers equal to three digits."""
    same = np.ones(rows.force.size, dtype=bool)
    for name, value in conditions.items():
        own = rows.table[name].to_numpy()
        if name in ALONG:
            most = np.max(own)  # another place of a stroke is not another run
            same &= value <= most + 1e-3 * abs(most)
        elif isinstance(value, float) and name != "direction":
            same &= np.isclose(np.abs(own.astype(float)), abs(value), rtol=1e-3)
        else:
            same &= own == value
    return bool(same.any())


def _run_to_repeat(one: OutlierFile, config: Config) -> dict:
    """Return the run of a file that was left out, or would have been if no other could be the wrong one."""
    names = (*condition_columns(config), "speed_mm_s", "load_N")
    side = "above" if one.deviation > 0 else "below"
    done = "was left out: look at it, and repeat its run"
    if one.instead:
        others = " or ".join(one.instead)
        done = f"was kept, as {others} may be the wrong file instead: look at them, and repeat their runs"
    why = f"file {one.file} is {abs(one.deviation):.0%} {side} what all others predict and {done}"
    return {"why": why, "conditions": _settings(one.conditions, names)}


def _slower_speed(fitted: Fitted, config: Config) -> list[dict]:
    """Return a run at a new speed where several speeds are too few for a Stribeck curve; none elsewhere."""
    rows, forms = fitted.rows, fitted.model.declared.stribeck
    few = [name for name, form in forms.items() if form in ("interpolated", "viscous")]
    if not few:
        return []
    series = series_of_curve(rows.conditions, rows.has_aging)[rows.condition]
    row = rows.table.iloc[int(np.argmax(series == few[0]))].copy()
    row["speed_mm_s"] = float(np.abs(rows.speed[series == few[0]]).min()) / 2
    return [{"why": SLOWER_SPEED, "conditions": _settings(row, (*condition_columns(config), "speed_mm_s"))}]


def _runs_for_aliases(fitted: Fitted, config: Config, effects: Mapping[str, Effect]) -> Iterator[dict]:
    """Yield the run that would show each alias; one run for aliases of the same channels."""
    taken = tuple(name for name in condition_columns(config) if name != "aging_days")
    by_channel: dict[tuple[str, ...], list[Alias]] = {}
    for alias in find_aliases(fitted, effects, taken):
        by_channel.setdefault(alias.term.channels, []).append(alias)
    for channels, aliases in by_channel.items():
        first = aliases[0]
        models = first.holding, first.lacking
        found = largest_difference(*models, fitted.rows, channels, config, untested=True)
        if found is not None and found[1] > SHOWN * first.size_N:
            names = " or ".join(describe(a.term, fitted.rows) for a in aliases)
            why = f"would show {names}, which is not distinguishable from the model with these runs"
            yield {"why": why, "conditions": found[0]}


def _replicate_of(proposal: Proposal, config: Config, reason: str = "") -> dict:
    """Return the condition to repeat on a new specimen: where an effect that is not confirmed is largest."""
    fitted = proposal.fitted
    k = int(np.argmax(np.abs(added_force(proposal))))
    count = fitted.rows.groups.starts["specimen"].size
    label = describe(proposal.term, fitted.rows)
    if reason:
        why = f"would confirm or refute {label}, which was refused ({reason})"
    else:
        few = "one specimen is" if count == 1 else f"{count} specimens are"
        why = f"{few} too few to distinguish {label} from the scatter of specimens"
    why += ": test another specimen of the same conditions, here first"
    conditions = _settings(fitted.rows.table.iloc[k], (*condition_columns(config), "speed_mm_s"))
    return {"why": why, "conditions": conditions}


def largest_difference(
    chosen: Model,
    rival: Model,
    rows: Rows,
    channels: Sequence[str],
    config: Config,
    *,
    untested: bool = False,
) -> tuple[dict, float] | None:
    """Return the run at which two models differ most, and the difference (force unit); None if there is none.

    Every tested run is tried with each combination of low, median and high values of the channels of their
    effects. With `untested`, a combination whose largest difference is at a tested run is passed over.
    """
    every, rows = rows, rows.sparse(ROWS)
    channels = tuple(dict.fromkeys(channels))
    best: tuple[dict, float] | None = None
    for changes in ({}, *_combinations(chosen, rows, channels)):
        moved = _rows_with(rows, changes)
        apart = np.abs(evaluate(chosen, moved, jacobian=False)[0] - evaluate(rival, moved, jacobian=False)[0])
        apart = np.where(np.isfinite(apart), apart, 0.0)
        k = int(np.argmax(apart >= apart.max() * (1 - TIE)))  # the first of those equal but for rounding
        if apart[k] > (0.0 if best is None else best[1] * (1 + TIE)):
            names = (*condition_columns(config), "speed_mm_s", *channels)
            settings = _settings(moved.table.iloc[k], names)
            if not (untested and _is_tested(settings, every)):
                best = settings, float(apart[k])
    return best


def _combinations(model: Model, rows: Rows, channels: tuple[str, ...]) -> Iterator[dict[str, object]]:
    """Yield combinations of values of the channels; days are kept without an aging law.

    Only speeds, days and the calendar, in which runs to make are late, go beyond what was tested. A channel
    that follows an earlier one, as two sensors of one pressure do, follows it here too.
    """
    values: dict[str, list] = {}
    followed = _followed(rows, channels)
    aged = rows.conditions["series"][rows.conditions["aging_days"] > 0]
    law = bool(len(aged)) and all(model.declared.law[series] for series in aged)
    for name in channels:
        own = rows.unsigned(name)
        if name == "direction":
            values[name] = [-1.0, 1.0]
            continue
        if name == "displacement_mm" or name in followed or (name == "aging_days" and not law):
            continue
        if own.dtype.kind != "f":
            values[name] = list(np.unique(own))
            continue
        low, high = float(own.min()), float(own.max())
        later = [high, high + BEYOND * (high - low)]
        inside = [low, _middle_of_gap(own), float(np.median(own))]
        values[name] = later if name in CALENDAR else [*inside, *(later if name in EXTENDED else [high])]
    for point in itertools.product(*values.values()):
        changes = dict(zip(values, point, strict=True))
        for name, leader in followed.items():
            if leader in changes:
                x, first = np.unique(rows.unsigned(leader), return_index=True)
                changes[name] = float(np.interp(changes[leader], x, rows.unsigned(name)[first]))
        yield changes


def _middle_of_gap(values: np.ndarray) -> float:
    """Return the middle of the widest gap between the values of a channel, shape (n,).

    Repeats and other consecutive whole numbers have no gap: the value below it is returned.
    """
    x = np.unique(values)
    k = int(np.argmax(np.diff(x, append=x[-1])))
    counts = bool((x == np.round(x)).all()) and np.diff(x).max(initial=1.0) <= 1.0
    return float(x[k] if counts else x[k : k + 2].mean())


def _followed(rows: Rows, channels: Sequence[str]) -> dict[str, str]:
    """Return the channels whose order is that of an earlier one, and which that is.

    Days are no such channel: what was confounded with them in the campaign is to be separated.
    """
    found: dict[str, str] = {}
    numeric = [n for n in channels if n not in ("direction", AGING) and rows.unsigned(n).dtype.kind == "f"]
    ranks = {name: pd.Series(rows.unsigned(name)).rank() for name in numeric}
    for one, other in itertools.combinations(numeric, 2):
        calendar = (one in HISTORY) + (other in HISTORY)
        if calendar != 1 and one not in found and abs(ranks[one].corr(ranks[other])) > ONE_ORDER:
            found.setdefault(other, one)
    return found


def _rows_with(rows: Rows, changes: Mapping[str, object]) -> Rows:
    """Return rows with channels set to other values; time is scaled with the speed."""
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
        days = np.where(rows.days > 0, float(changes["aging_days"]), rows.days)  # unaged rubber stays unaged
        table["aging_days"] = days
    if "load_N" in changes:
        load = np.full_like(rows.load, float(changes["load_N"]))
    if POWER in table and POWER not in changes:
        table[POWER] = sliding_power(load, speed)
    filled = {name: values for name, values in rows.filled.items() if name not in changes}
    return replace(rows, table=table, filled=filled, speed=speed, pace=speed, days=days, load=load)


def _settings(row: Mapping[str, object], names: Sequence[str]) -> dict[str, object]:
    """Return the settings of a run that are known, numbers to four digits, speeds as magnitudes."""
    found = {}
    for name in dict.fromkeys(names):
        value = row.get(name)
        value = value.item() if isinstance(value, np.generic) else value
        if not pd.isna(value):
            value = abs(value) if name == "speed_mm_s" else value
            found[name] = float(f"{value:.4g}") if isinstance(value, float) else value
    return found
