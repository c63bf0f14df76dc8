"""Force at new points, before and after, with 95 % intervals of the mean and of one new measurement.

The mean is that of the population, with all random effects (specimen, set-up, repeat) at zero; its interval
includes their scatter. The interval of a measurement adds one draw of each level and the noise of a bin. The
sensor's accuracy is not included (GUM, type B).
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping
from dataclasses import replace

import numpy as np
import pandas as pd

from sealfit.closure.criteria import NEAR_TESTED_SPEED
from sealfit.closure.errors_and_intervals import Sandwich, mean_half_width, t_quantile
from sealfit.closure.forms import describe
from sealfit.closure.output import from_record
from sealfit.closure.prediction_csv import ANSWERS
from sealfit.config import Config
from sealfit.effects.contract import SECOND, Effect, deviation
from sealfit.errors import RequestError
from sealfit.fit.joint.declared import SPEEDS_BETWEEN
from sealfit.fit.joint.model import Model, evaluate, loads_of
from sealfit.fit.joint.rows import LEVELS, POWER, Lag, Rows, point_rows, sliding_power
from sealfit.fit.joint.whitening import GAIN, Component, Scatter
from sealfit.ingest.cells import OVERLOAD
from sealfit.ingest.columns import add_keys, condition_columns
from sealfit.ingest.derived_columns import with_day_0
from sealfit.ingest.quality import NO_VALUE
from sealfit.units import other_unit

BEYOND = 0.005  # Share of the largest tested value by which a point may exceed the range: rounded units.
FORCE_COLUMNS = list(ANSWERS[:-2])  # all but `extrapolated` and `note`
NO_INTERVAL = "no interval: as many parameters in the model as runs; test more speeds"
NOT_CONFIRMED = "not confirmed: {}; the interval holds the force with and without each"
TESTED_ONLY = "the scatter of specimens is not known: intervals hold for the tested ones"
BEYOND_DAYS = "beyond the tested days the interval holds the force with and without {}"
ALONG_MOTION = "no force: beyond the tests the model gives one in the direction of motion"
BETWEEN_DAYS = "no interval: these days were not tested, and the scatter of specimens is not known"


def predict(model: dict, points: pd.DataFrame, own: Mapping[str, Effect] | None = None) -> pd.DataFrame:
    """Return `points` with the forces before and after, their intervals, `extrapolated` and `note`.

    Parameters
    ----------
    model : dict
        The model record (OUT/model.json).
    points : DataFrame
        Condition columns, signed `speed_mm_s`, and every channel that the after-model reads; grouping columns
        such as `specimen_id` are ignored.
    own : mapping of str to Effect, optional
        The user's own effects, by id.

    Raises
    ------
    RequestError
        If a condition column, the speed or a channel of the after-model is missing, or the model has a user
        effect that is not in `own`.
    """
    before, after, unconfirmed, conditions = from_record(model, own)
    config = Config.model_validate(model["config"])
    table = _complete(points.reset_index(drop=True), model, after, config)
    notes = [[] for _ in range(len(table))]
    before, after, conditions, code = _conditions(before, after, conditions, table, notes, config)
    _check_values(table, after, model, notes)
    code = np.where([bool(note) for note in notes], -1, code)
    good = code >= 0
    answer = np.full((len(table), len(FORCE_COLUMNS)), np.nan)
    untested = np.zeros(len(table), dtype=bool)  # days between the tested ones, of which there is no specimen
    if not model["scatter"]["of_specimens"]:
        untested = good & (code >= len(model["conditions"]["condition"]))
        _note(notes, good & ~untested, TESTED_ONLY)
        _note(notes, untested, BETWEEN_DAYS)
    if unconfirmed:
        _note(notes, good, NOT_CONFIRMED.format(" and ".join(one["label"] for one in model["unconfirmed"])))
    if model["df"] == 0:
        _note(notes, good, NO_INTERVAL)
    for jump, inside in _in_gaps(model["jumps"], after, table):
        term = after.terms[jump["effect"]]
        where = f"{term.channels[0]} {jump['low']:g} and {jump['high']:g}, where nothing was tested"
        _note(notes, good & inside, f"{term.effect.id} changes somewhere between {where}")
    extrapolated = _outside(table, conditions, code, model, notes, after)
    if good.any():
        own = {"has_load": model["has_load"], "has_aging": model["has_aging"]}
        own["lag"] = Lag(model["compliance"], config.units.speed_factor)
        at = point_rows(table[good].reset_index(drop=True), code[good], conditions, **own)
        before_N, _ = evaluate(before, at, jacobian=False)
        at = replace(at, force=before_N)  # its lag
        mean, tangent = evaluate(after, at)
        least, most = _across_jumps(model["jumps"], after, at, mean)
        if aging := [term for term in after.terms if "aging_days" in term.channels]:
            later = at.days > _last_days(conditions, code, model)[good]
            least = np.where(later, np.minimum(least, before_N), least)
            most = np.where(later, np.maximum(most, before_N), most)
            names = " and ".join(describe(term, at) for term in aging)
            _note(notes, _placed(later, good), BEYOND_DAYS.format(names))
        for one in unconfirmed:
            others = _with_unconfirmed(replace(one, declared=after.declared), at, model["ranges"])
            least, most = np.minimum(least, np.min(others, axis=0)), np.maximum(most, np.max(others, axis=0))
        reach = t_quantile(model["df"])
        others = []
        for own in model["sandwiches"]:
            information = [(np.array(k), np.array(block)) for k, block in own["information"]]
            others.append(Sandwich(np.array(own["covariance"]), information))
        half = mean_half_width(tangent, np.array(model["covariance"]), model["df"], others)
        half = np.sqrt(half**2 + reach**2 * _of_unknown_phase(after, at, mean))
        one = _one_measurement(model["scatter"], loads_of(after, at))
        spread = reach * np.sqrt((half / reach) ** 2 + one)
        forces = (before_N, mean, least - half, most + half)
        answer[good] = np.column_stack([*forces, least - spread, most + spread])
        answer[untested, 2:] = np.nan
        along_motion = _placed(mean * at.speed < 0, good) & extrapolated
        answer[along_motion, 1:] = np.nan
        _note(notes, along_motion, ALONG_MOTION)
    return points.reset_index(drop=True).assign(
        **dict(zip(FORCE_COLUMNS, answer.T, strict=True)),
        extrapolated=extrapolated & ~np.isnan(answer[:, 1]),  # of `force_after_N`
        note=["; ".join(note) for note in notes],
    )


def _complete(points: pd.DataFrame, model: dict, after: Model, config: Config) -> pd.DataFrame:
    """Return the points with every column that the model reads: given, derived, or the only tested value."""
    ranges = model["ranges"]
    own = points[[name for name in condition_columns(config) if name in points]]
    cells = own.astype(object).where(own.notna(), None)
    unaged = with_day_0({name: cells[name].tolist() for name in cells}, config)  # a word may say it
    table = _with_derived(points.assign(**unaged, file=""), model)
    needed = [*config.condition, *config.rubber]
    if any(form != "constant" for form in after.declared.stribeck.values()) or "speed_mm_s" in points:
        needed.append("speed_mm_s")
    if model["has_load"]:
        needed.append("load_N")
    needed += [name for term in after.terms for name in term.channels]
    for name in dict.fromkeys(needed):
        if name in table:
            continue
        tested = ranges.get(name)
        one_value = tested is not None and len(tested) == 2 and tested[0] == tested[1]
        unit = config.units.of(name)
        others = _in_other_units(points, name, unit)
        if one_value and name not in config.condition and not others:
            table[name] = tested[0]
            continue
        fix = f"Convert {others[0]}" if others else "Add the column"
        fix += f" {'to' if others else 'in'} {unit}" if unit else ""
        fix += f"; tested from {tested[0]:g} to {tested[1]:g}." if _is_range(tested) else "."
        raise RequestError("is missing, and the model needs it.", column=name, fix=fix)
    if "speed_mm_s" not in table:
        table["speed_mm_s"] = ranges["speed_mm_s"][0]
    return table


def _in_other_units(points: pd.DataFrame, name: str, unit: str) -> list[str]:
    """Return the columns that hold the quantity of a column in another unit, such as load_kN for load_N."""
    words = {str(column): str(column).partition("_") for column in points}
    alike = [column for column, word in words.items() if word[0] == name.partition("_")[0]]
    return [column for column in alike if unit and other_unit(words[column][2].replace("_", "/"), unit)]


def _with_derived(table: pd.DataFrame, model: dict) -> pd.DataFrame:
    """Return the points with speed and load as numbers, and with derived columns."""
    for name in ("speed_mm_s", "load_N"):
        if name in table:
            table[name] = pd.to_numeric(table[name], errors="coerce")
    if "elapsed_h" not in table and "started_at" in table and model.get("first_started_at"):
        first = pd.Timestamp(model["first_started_at"])
        started = pd.to_datetime(table["started_at"], errors="coerce", utc=first.tzinfo is not None)
        table["elapsed_h"] = (started - first).dt.total_seconds() / 3600
    if "speed_mm_s" in table:  # a direction that is not given is that of the speed
        sign = np.sign(table["speed_mm_s"])
        table["direction"] = pd.to_numeric(table.get("direction", sign).fillna(sign), errors="coerce")
    if POWER not in table and {"load_N", "speed_mm_s"} <= set(table):
        table[POWER] = sliding_power(table["load_N"], table["speed_mm_s"])
    return table


def _is_range(tested: object) -> bool:
    return isinstance(tested, list) and len(tested) == 2 and not any(isinstance(x, str) for x in tested)


def _conditions(
    before: Model, after: Model, conditions: pd.DataFrame, table: pd.DataFrame, notes: list, config: Config
) -> tuple[Model, Model, pd.DataFrame, np.ndarray]:
    """Return the models with the points' conditions added, and each point's condition; -1 if it has none."""
    keys = add_keys(table, config)
    days = np.zeros(len(table))
    if config.aging:
        days = pd.to_numeric(table["aging_days"], errors="coerce").to_numpy(dtype=float)
    known = {name: k for k, name in enumerate(conditions["condition"])}
    declared = after.declared
    added, like = [], []  # conditions that were not tested, and for each one that was, with the same law
    code = np.full(len(table), -1)
    for k in range(len(table)):
        name, series, rubber = keys["condition"].iloc[k], keys["series"].iloc[k], keys["rubber"].iloc[k]
        if pd.isna(name):
            notes[k].append("an empty condition cell: fill it in")
            continue
        if name not in known:
            same = np.flatnonzero((conditions["series"] == series) & (conditions["rubber"] == rubber))
            lawful = same[declared.index["a_c"][same] >= 0]
            if not lawful.size or not 0 <= days[k] < OVERLOAD:
                fix = f"give a tested condition, such as {conditions['condition'].iloc[0]}"
                law = ""
                if config.aging:
                    law = " and has no fitted aging law"
                    fix += ", or other days of a tested series with three or more days"
                notes[k].append(f"condition {name} was not tested{law}: {fix}")
                continue
            known[name] = len(known)
            keys_of = {"condition": name, "series": series, "rubber": rubber}
            added.append({**keys_of, "aging_days": float(days[k])})
            like.append(lawful[0])
        code[k] = known[name]
    full = pd.concat([conditions, pd.DataFrame(added)], ignore_index=True) if added else conditions
    places = [*range(len(conditions)), *like]
    numbers = {quantity: own[places] for quantity, own in declared.index.items()}
    wider = replace(declared, index=numbers)
    return replace(before, declared=wider), replace(after, declared=wider), full, code


def _check_values(table: pd.DataFrame, after: Model, model: dict, notes: list) -> None:
    """Add a note to every point with an invalid cell."""
    speed = table["speed_mm_s"].to_numpy(dtype=float)
    slides = (np.abs(speed) < OVERLOAD) & (speed != 0)
    _note(notes, ~slides, "speed_mm_s must be a signed number other than 0 (the model holds in sliding)")
    if model["has_load"]:
        load = table["load_N"].to_numpy(dtype=float)
        _note(notes, ~((load > 0) & (load < OVERLOAD)), "load_N must be a positive number")
    for name in dict.fromkeys(n for term in after.terms for n in term.channels):
        tested = model["ranges"].get(name)
        if name == "direction":
            agrees = table[name].to_numpy() == np.sign(speed)
            _note(notes, slides & ~agrees, "direction must be 1 or -1, and speed_mm_s must have its sign")
        elif _is_range(tested):
            table[name] = pd.to_numeric(table[name], errors="coerce").astype(float)
            _note(notes, ~(np.abs(table[name].to_numpy()) < OVERLOAD), f"{name} must be a number")
        elif isinstance(tested, list):
            table[name] = table[name].astype(object).where(table[name].notna(), NO_VALUE).astype(str)
            _note(notes, ~table[name].isin(tested).to_numpy(), f"{name} must be one of {', '.join(tested)}")


def _placed(mask: np.ndarray, good: np.ndarray) -> np.ndarray:
    """Return a mask of the points that are answered as one of all points."""
    every = good.copy()
    every[good] = mask
    return every


def _note(notes: list[list[str]], points: np.ndarray, text: str) -> None:
    for k in np.flatnonzero(points):
        notes[k].append(text)


def _outside(
    table: pd.DataFrame, conditions: pd.DataFrame, code: np.ndarray, model: dict, notes: list, after: Model
) -> np.ndarray:
    """Return which points are extrapolated, with a note each. They are predicted all the same."""
    ranges = model["ranges"]
    outside = np.zeros(len(table), dtype=bool)
    series = np.array(conditions["series"], dtype=object)
    days, last = conditions["aging_days"].to_numpy(dtype=float), _last_days(conditions, code, model)
    for k in np.flatnonzero((code >= 0) & (days[code] > last)):
        outside[k] = True
        notes[k].append(f"aging_days is outside the tests: up to {last[k]:g}")
    speed = np.abs(pd.to_numeric(table["speed_mm_s"], errors="coerce").to_numpy(dtype=float))
    for k in np.flatnonzero(code >= 0):
        tested = np.array(model["speeds_mm_s"][series[code[k]]])
        if tested.size < SPEEDS_BETWEEN and not (np.abs(speed[k] / tested - 1) < NEAR_TESTED_SPEED).any():
            outside[k] = True
            speeds = ", ".join(f"{v:g}" for v in tested)
            notes[k].append(f"too few speeds for the friction between them; tested: {speeds}")
    read = ["speed_mm_s", *(["load_N"] if model["has_load"] else [])]
    read += [name for term in after.terms for name in term.channels]
    for name in dict.fromkeys(read):
        tested = ranges.get(name)
        by_series = name == "aging_days" and model["has_aging"]  # see above
        if not _is_range(tested) or name == "direction" or by_series:
            continue
        values = pd.to_numeric(table[name], errors="coerce").to_numpy(dtype=float)
        values = np.abs(values) if name == "speed_mm_s" else values
        slack = BEYOND * max(abs(tested[0]), abs(tested[1]), 1e-12)
        beyond = (code >= 0) & ((values < tested[0] - slack) | (values > tested[1] + slack))
        _note(notes, beyond, f"{name} is outside the tests: {tested[0]:g} to {tested[1]:g}")
        outside |= beyond
    if ranges.get("direction") == [1.0, 1.0]:  # a speed without a sign is forwards
        back = (code >= 0) & (table["direction"].to_numpy(dtype=float) < 0)
        _note(notes, back, "backward motion was not tested")
        outside |= back
    return outside


def _last_days(conditions: pd.DataFrame, code: np.ndarray, model: dict) -> np.ndarray:
    """Return the last tested day of the series of each point, shape (n,); inf where no day is untested."""
    last = np.full(len(code), np.inf)
    if model["has_aging"]:
        tested = len(model["conditions"]["condition"])
        days, series = (conditions[name].to_numpy() for name in ("aging_days", "series"))
        for k in np.flatnonzero(code >= tested):
            last[k] = days[:tested][series[:tested] == series[code[k]]].max()
    return last


def _in_gaps(jumps: list[dict], after: Model, table: pd.DataFrame) -> Iterator[tuple[dict, np.ndarray]]:
    """Yield each jump of an effect and which points lie where it may have been, shape (n,)."""
    for jump in jumps:
        channel = after.terms[jump["effect"]].channels[0]
        values = pd.to_numeric(table[channel], errors="coerce").to_numpy(dtype=float)
        yield jump, (values > jump["low"]) & (values < jump["high"])


def _across_jumps(
    jumps: list[dict], after: Model, at: Rows, mean: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the smallest and the largest mean force, shape (n,), wherever the jumps may be."""
    least, most = mean, mean
    for jump, inside in _in_gaps(jumps, after, at.table):
        for place in (jump["low"], jump["high"]):
            values = list(after.values)
            values[jump["effect"]] = {**values[jump["effect"]], jump["parameter"]: place}
            other, _ = evaluate(replace(after, values=tuple(values)), at, jacobian=False)
            least, most = np.where(inside, [np.minimum(least, other), np.maximum(most, other)], [least, most])
    return least, most


def _with_unconfirmed(model: Model, at: Rows, ranges: dict) -> list[np.ndarray]:
    """Return the forces with an effect that is not confirmed, shape (n,) each.

    Its channels are limited to what was tested. For one that some points lack, both ends of its range are
    tried, or all its categories.
    """
    given, tried = {}, {}
    for name in ranges.keys() & set(model.terms[-1].channels) - {"direction", "speed_mm_s"}:
        values = at.table.get(name, pd.Series(np.nan, at.table.index))
        if _is_range(ranges[name]):
            values = pd.to_numeric(values, errors="coerce").clip(*ranges[name])
        else:
            values = values.astype(str).where(values.isin(ranges[name]))
        if values.isna().any():
            tried[name] = ranges[name]
        else:
            given[name] = values
    places = itertools.product(*tried.values())
    tables = [at.table.assign(**given, **dict(zip(tried, place, strict=True))) for place in places]
    return [evaluate(model, replace(at, table=table), jacobian=False)[0] for table in tables]


def _of_unknown_phase(after: Model, at: Rows, force: np.ndarray) -> np.ndarray:
    """Return the variance of ripples with a phase per pass, which is unknown for a new one, shape (n,)."""
    total = np.zeros_like(force)
    for term, values in zip(after.terms, after.values, strict=True):
        if "shift" in term.fixed:
            inputs, amplitude = term.inputs(at), values["A"]
            if SECOND in inputs:
                amplitude = amplitude + values["B"] * deviation(inputs, SECOND)
            total += (amplitude * (1.0 if term.operation == "add" else force)) ** 2 / 2
    return total


def _one_measurement(scatter: dict, loads: np.ndarray) -> np.ndarray:
    """Return the variance of one new bin on a new specimen, set-up and repeat, shape (n,)."""
    known = Scatter(scatter["s0"], scatter["g"], tuple(Component(**c) for c in scatter["components"]))
    total = known.noise_sd(loads[:, GAIN]) ** 2
    for level in LEVELS:
        total = total + known.level_variance(level, loads)
    return total
