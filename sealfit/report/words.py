"""Sentences of the report: the verdict, the size of an effect, the remaining residual."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

import numpy as np
import pandas as pd
from markupsafe import Markup, escape

from sealfit.config import Config
from sealfit.report.notation import (
    NOTHING,
    channel_label,
    channel_words,
    effect_label,
    given,
    joined,
    known,
    measured,
    number,
    of_unit,
    p_value,
    split_channels,
    symbol_html,
    together,
    true_units,
)
from sealfit.report.summary import level_words, outlier_clause, power_clause, quality_clause, untold_clause

# A shape that crosses zero by at most this share of its span counts as one of constant sign. 0.02 is about
# the resolution of a plot.
FLAT = 0.02
COUNTED = dict(enumerate(["two", "three", "four", "five", "six", "seven", "eight", "nine", "ten"], start=2))
# The verdict gives the sizes of at most this many effects; the sizes of more are in their cards.
DETAILED = 2


def verdict(closure: Mapping | None, shapes: pd.DataFrame, config: Config) -> Markup:
    """Return the verdict in a few sentences.

    Parameters
    ----------
    closure : mapping or None
        closure.json, or None where the loop was not run.
    shapes : DataFrame
        Table `shapes`, for the sizes of the effects.
    config : Config
        Gives the true units.
    """
    if closure is None:
        return Markup("The loop has not been run, so the lack of fit of the declared model is not known.")
    errors = [error_clause(closure, config)]
    if known(closure["noise_floor_N"]):
        errors.append(quality_clause(closure))
    errors.append(outlier_clause(closure))
    if closure["verdict"] == "nothing_missing":
        power = power_clause(closure, config.units)
        return _sentences("no effect beyond the declared model is significant", *errors, power)
    if closure["verdict"] == "cannot_tell":
        untold = untold_clause(closure, config.units)
        return _sentences(f"these files do not decide whether an effect is missing: {untold}", *errors)
    added = [(k, e) for k, e in enumerate(closure["effects"]) if not e["candidate"]]
    missed = _missed_effects(added, shapes, config)
    many = COUNTED.get(len(added), str(len(added)))
    lead = Markup("{} effects: {}").format(many, _joined(missed)) if len(added) > 1 else _joined(missed)
    lacked = Markup("the declared model lacks {}").format(lead) if missed else ""
    if missed:
        errors[0] = Markup("with {} {}").format("them," if len(added) > 1 else "it,", errors[0])
    if closure["verdict"] == "closed":
        return _sentences(lacked, *errors)
    left = f"a significant residual remains that no effect explains: {_where(closure['left'], config)}"
    return _sentences(lacked, left, *errors)


def undecided(closure: Mapping | None, config: Config) -> Markup:
    """Return what the files do not decide beside the effects that were found, in a sentence; may be empty."""
    untold = untold_clause(closure, config.units) if closure and closure["verdict"] == "closed" else ""
    return (
        _sentences(f"not decided by these files: {true_units(untold, config.units)}")
        if untold
        else Markup("")
    )


def _missed_effects(
    added: Sequence[tuple[int, Mapping]], shapes: pd.DataFrame, config: Config
) -> list[Markup]:
    """Return each effect with its size; of more than `DETAILED` effects only the names, each once."""
    labels = [effect_label(effect, config.units) for _, effect in added]
    if len(added) <= DETAILED:
        return [
            _missed(label, does(k, e, shapes, config)) for label, (k, e) in zip(labels, added, strict=True)
        ]
    times = {label: labels.count(label) for label in labels}
    return [Markup("{}").format(label if n == 1 else f"{label} ({n} of them)") for label, n in times.items()]


def _missed(label: str, does: Markup) -> Markup:
    if not does:
        return Markup("{}").format(label)
    if label.endswith(")"):  # a second pair of parentheses would follow
        return Markup("{}; {})").format(label.removesuffix(")"), does)
    return Markup("{} ({})").format(label, does)


def error_clause(closure: Mapping, config: Config) -> Markup:
    """Return the held-out error before and after, and the noise floor, in a clause."""
    unit = config.units.unit("force")
    key, what = "heldout_rmse_N", f"rms error on held-out {_units_of(closure)}"
    if not known(closure["before"].get(key)):
        key, what = "rmse_N", "in-sample rms error (nothing could be held out)"
    before, after, floor = closure["before"].get(key), closure["after"].get(key), closure.get("noise_floor_N")
    texts = together([before, after, floor])
    if before == after or not known(after):
        change = f"the {what} is {of_unit(texts[0], unit)}"
    else:
        way = "falls" if after < before else "rises"
        change = f"the {what} {way} from {of_unit(texts[0], unit)} to {of_unit(texts[1], unit)}"
    end = (
        f"noise floor: {of_unit(texts[2], unit)}"
        if known(floor)
        else "noise floor unknown: there are no repeats"
    )
    return Markup("{} ({})").format(change, end)


def does(index: int, effect: Mapping, shapes: pd.DataFrame, config: Config) -> Markup:
    """Return the largest change of the target by an effect, and its other parameters, in a clause."""
    change = _change(effect, shapes[shapes["effect"] == index] if len(shapes) else shapes, config)
    linear = _amplitudes(effect) if change else set()
    rest = [p for p in effect["parameters"] if p["name"].rstrip("_") not in linear and p.get("unit") != "rad"]
    return Markup(", ").join([part for part in (change, *(parameter(p, effect) for p in rest[:2])) if part])


def parameter(p: Mapping, effect: Mapping) -> Markup:
    """Return "time constant τ = 4.0 s [3.6, 4.5]", in words for an effect of the catalogue."""
    words = meaning(effect["id"], p["name"])
    text = Markup("{} = {}").format(
        symbol_html(p["name"]), _measured(p["value"], p.get("ci95"), p.get("unit"))
    )
    return Markup("{} {}").format(words, text) if words and len(words) <= 40 else text


def _measured(value: float | None, ends: Sequence[float | None] | None, unit: str | None) -> str:
    text, interval = measured(value, *(ends or (None, None)), digits=1)
    return of_unit(text, unit or "") + (
        f" {interval}".replace(", ", ",\u00a0") if interval != NOTHING else ""
    )


def _change(effect: Mapping, shape: pd.DataFrame, config: Config) -> Markup:
    """Return the target's largest change along the first variable, and where it occurs; empty for none."""
    shape = shape[shape["x"].notna() & shape["value"].notna()]
    if len(shape) < 2:
        return Markup("")
    channel = shape["channel"].iloc[0]
    shape = shape[shape["channel"] == channel].sort_values("x")
    value, lo, hi = (shape[name].to_numpy(float) for name in ("value", "lo95", "hi95"))
    span = value.max() - value.min()
    if not span > 0:
        return Markup("")
    factor = effect["operation"] == "multiply"
    scale, unit = (
        (100.0, "%") if factor else (1.0, next((u for u in shape["unit"] if isinstance(u, str) and u), ""))
    )
    what = target_html(effect["acts_on"], config)
    if channel == "direction":
        return Markup("{} differs by {} between directions").format(
            what, of_unit(number(scale * span, 2), unit)
        )
    if max(-value.min(), 0.0) > FLAT * span and max(value.max(), 0.0) > FLAT * span:
        size = of_unit(number(scale * span, 2), unit)
        return Markup("{} varies by {} along {}").format(what, size, channel_words(channel, config.units))
    # constant sign: the largest change against the model without the effect
    k = int(np.argmax(np.abs(value)))
    sign = 1.0 if value[k] > 0 else -1.0
    ends = sorted((scale * sign * lo[k], scale * sign * hi[k]))
    way = "rises" if sign > 0 else "falls"
    size = _measured(scale * abs(value[k]), ends, unit)
    place = of_unit(given(float(shape["x"].iloc[k])), config.units.of(channel) or "")
    return Markup("{} {} by up to {} at {} {}").format(
        what, way, size, channel_words(channel, config.units), place
    )


def target_html(target: str, config: Config) -> Markup:
    """Return the target of an effect: a symbol, or the name of the measured force."""
    return (
        Markup("the {}").format(config.units.quantity("force")) if target == "force" else symbol_html(target)
    )


def acts(effect: Mapping, config: Config) -> Markup:
    """Return how an effect enters the model, in a clause."""
    if effect["acts_on"] == "force":
        force = config.units.quantity("force")
        return Markup(
            "scales the whole {}" if effect["operation"] == "multiply" else "adds to the {}"
        ).format(force)
    name = {"mu": Markup("the friction coefficient {}").format(symbol_html("mu"))}.get(effect["acts_on"])
    name = name or symbol_html(effect["acts_on"])
    return Markup("scales {}" if effect["operation"] == "multiply" else "adds to {}").format(name)


def meaning(effect_id: str, name: str) -> str:
    """Return the meaning of a parameter, or "" for an effect that is not in the catalogue."""
    from sealfit.effects import EFFECTS

    effect = EFFECTS.get(effect_id)
    return (
        next((p.meaning for p in effect.parameters if p.name.rstrip("_") == name.rstrip("_")), "")
        if effect
        else ""
    )


def _amplitudes(effect: Mapping) -> set[str]:
    from sealfit.effects import EFFECTS

    found = EFFECTS.get(effect["id"])
    return {name.rstrip("_") for name in found.linear} if found else set()


def left_over(closure: Mapping, config: Config) -> Markup:
    """Return the size of the remaining residual, and the variable that explains it if any, in sentences."""
    left, unit, floor = closure["left"], config.units.unit("force"), closure.get("noise_floor_N")
    rmse = closure["after"].get("rmse_N")
    said = []
    if known(rmse):
        size, ground = together([rmse, floor])
        beside = f"; the noise floor is {of_unit(ground, unit)}" if known(floor) else ""
        said.append(f"the rms error of all bins is {of_unit(size, unit)}{beside}")
        if known(floor) and known(left.get("rmse_N")) and 0 < left["rmse_N"] < rmse:
            excess = of_unit(number(left["rmse_N"], 2), unit)
            said.append(
                f"the excess over the noise floor is {excess} (root of the difference of the squares)"
            )
    if closure["verdict"] == "unexplained":
        said.append(f"a significant residual remains: {_where(left, config)}")
    elif left.get("channels") and any(effect["candidate"] for effect in closure["effects"]):
        said.append(f"the evidence rests on too few specimens: {_where(left, config)}")
    elif left.get("channels"):
        said.append(f"no variable is significant. The smallest p-value: {_where(left, config)}")
    else:
        said.append("no variable explains it: it is consistent with scatter")
    return _sentences(*said)


def _where(left: Mapping, config: Config) -> str:
    names, level = left.get("channels") or [], left.get("level")
    text = "the residual varies"
    if names:
        text += f" with {joined([channel_label(name, config.units) for name in names])}"
    if level:
        text += f" {level_words(level)}"
    return f"{text} (p {p_value(left.get('p_value'))})" if known(left.get("p_value")) else text


def with_left_channels(closure: Mapping, channels: Collection[str]) -> dict:
    """Return closure.json with `left.channels`: `left.channel` split into the names in `channels`."""
    left = closure["left"]
    return {**closure, "left": {**left, "channels": split_channels(left.get("channel"), channels)}}


def _units_of(closure: Mapping) -> str:
    return f"{closure.get('heldout_unit') or 'run'}s"


def _joined(parts: Sequence[Markup]) -> Markup:
    return Markup(" and ").join([Markup(", ").join(parts[:-1]), parts[-1]] if len(parts) > 1 else parts)


def _sentences(*clauses: str | Markup) -> Markup:
    """Return the clauses that are not empty as sentences; plain text is escaped."""
    texts = [str(escape(clause)) for clause in clauses if clause]
    return Markup(" ".join(f"{text[:1].upper()}{text[1:]}." for text in texts))
