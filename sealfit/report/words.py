"""The report's sentences: the verdict, what an effect does, what is left."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

import numpy as np
import pandas as pd
from markupsafe import Markup

from sealfit.config import Config
from sealfit.report.notation import (
    NOTHING,
    channel_label,
    channel_words,
    effect_label,
    joined,
    known,
    measured,
    number,
    of_unit,
    p_value,
    split_channels,
    symbol_html,
    together,
)
from sealfit.report.summary import power_clause, quality_clause, untold_clause

# Share of its span: a shape that crosses zero by less is of one sign.
FLAT = 0.02
# Share of its span: a shape that starts nearer to zero and ends at its largest is described without "up to".
STARTS = 0.1
PARTS = {"trace": "within a trace", "stroke": "between strokes", "repeat": "between repeats", "run": "between runs",
         "condition": "between conditions", "campaign": "along the campaign", "file": "between files",
         "specimen": "between specimens", "sample": "within a stroke"}  # fmt: skip
COUNTED = dict(enumerate(["two", "three", "four", "five", "six", "seven", "eight", "nine", "ten"], start=2))
DETAILED = 2  # effects of which the verdict says how large they are; with more, the cards below do


def verdict(closure: Mapping | None, shapes: pd.DataFrame, config: Config) -> Markup:
    """Return the verdict in one plain sentence.

    Parameters
    ----------
    closure : mapping or None
        closure.json, or None where the loop was not run.
    shapes : DataFrame
        Table `shapes`, for what an effect does to the force.
    config : Config
        Gives the true units.
    """
    if closure is None:
        return Markup("The loop has not been closed on these data, so nothing is said yet about what the model misses.")
    errors = error_clause(closure, config)
    if known(closure["noise_floor_N"]):
        errors = Markup("{}; {}").format(errors, quality_clause(closure))
    if closure["verdict"] == "nothing_missing":
        text = Markup(
            "The declared model misses nothing that these data can show: no channel orders what it leaves over."
        )
        power = power_clause(closure, config.units)
        clauses = [errors, *([power] if power else [])]
        return Markup(" ").join([text, *(_sentence(clause) for clause in clauses)])
    if closure["verdict"] == "cannot_tell":
        return Markup("These files cannot tell what the declared model misses: {}. {}").format(
            untold_clause(closure, config.units), _sentence(errors)
        )
    added = [(k, e) for k, e in enumerate(closure["effects"]) if not e["candidate"]]
    missed = _missed_effects(added, shapes, config)
    many = COUNTED.get(len(added), str(len(added)))
    lead = Markup("{} things: {}").format(many, _joined(missed)) if len(added) > 1 else _joined(missed)
    if closure["verdict"] == "closed":
        if not missed:
            return _sentence(errors)
        them = "them" if len(added) > 1 else "it"
        text = Markup("The declared model missed {}; with {} {}.").format(lead, them, errors)
        untold = untold_clause(closure, config.units)
        return text + Markup(" These files cannot tell of {}.").format(untold) if untold else text
    where = _where(closure["left"], config)
    if missed:
        return Markup(
            "The declared model missed {}, and something more that no effect explains: {}; so far {}."
        ).format(lead, where, errors)
    return Markup("The declared model misses something that no effect explains: {}; {}.").format(where, errors)


def _missed_effects(added: Sequence[tuple[int, Mapping]], shapes: pd.DataFrame, config: Config) -> list[Markup]:
    """Return each effect with what it does; of many only the names, each once, so that the verdict stays a sentence."""
    labels = [effect_label(effect, config.units) for _, effect in added]
    if len(added) <= DETAILED:
        return [_missed(label, does(k, e, shapes, config)) for label, (k, e) in zip(labels, added, strict=True)]
    times = {label: labels.count(label) for label in labels}
    return [Markup("{}").format(label if n == 1 else f"{label} ({n} of them)") for label, n in times.items()]


def _missed(label: str, does: Markup) -> Markup:
    if not does:
        return Markup("{}").format(label)
    if label.endswith(")"):  # one pair of parentheses, not two
        return Markup("{}; {})").format(label.removesuffix(")"), does)
    return Markup("{} ({})").format(label, does)


def error_clause(closure: Mapping, config: Config) -> Markup:
    """Return the held-out error before and after, and the noise floor, in a clause."""
    unit = config.units.unit("force")
    key, what = "heldout_rmse_N", f"on {_units_of(closure)} the fit did not see"
    if not known(closure["before"].get(key)):
        key, what = "rmse_N", "on the data that were fitted (none could be held out)"
    before, after, floor = closure["before"].get(key), closure["after"].get(key), closure.get("noise_floor_N")
    texts = together([before, after, floor])
    if before == after or not known(after):
        change = f"the error {what} is {of_unit(texts[0], unit)}"
    else:
        way = "falls" if after < before else "rises"
        change = f"the error {what} {way} from {of_unit(texts[0], unit)} to {of_unit(texts[1], unit)}"
    end = f"noise floor {of_unit(texts[2], unit)}" if known(floor) else "the noise floor is not known without repeats"
    return Markup("{}; {}").format(change, end)


def does(index: int, effect: Mapping, shapes: pd.DataFrame, config: Config) -> Markup:
    """Return what an effect does, in a clause: by how much it changes its target, then its other parameters."""
    change = _change(effect, shapes[shapes["effect"] == index] if len(shapes) else shapes, config)
    linear = _amplitudes(effect) if change else set()
    rest = [p for p in effect["parameters"] if p["name"].rstrip("_") not in linear and p.get("unit") != "rad"]
    return Markup(", ").join([part for part in (change, *(parameter(p, effect) for p in rest[:2])) if part])


def parameter(p: Mapping, effect: Mapping) -> Markup:
    """Return "time constant τ = 4.0 s [3.6, 4.5]"; the words only where the catalogue knows the effect."""
    words = meaning(effect["id"], p["name"])
    text = Markup("{} = {}").format(symbol_html(p["name"]), _measured(p["value"], p.get("ci95"), p.get("unit")))
    return Markup("{} {}").format(words, text) if words and len(words) <= 40 else text


def _measured(value: float | None, ends: Sequence[float | None] | None, unit: str | None) -> str:
    text, interval = measured(value, *(ends or (None, None)), digits=1)
    return of_unit(text, unit or "") + (f" {interval}".replace(", ", ",\u00a0") if interval != NOTHING else "")


def _change(effect: Mapping, shape: pd.DataFrame, config: Config) -> Markup:
    """Return by how much the effect changes its target along its first channel; nothing where it changes nothing."""
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
    scale, unit = (100.0, "%") if factor else (1.0, next((u for u in shape["unit"] if isinstance(u, str) and u), ""))
    what = target_html(effect["acts_on"], config)
    if channel == "direction":
        return Markup("{} differs by {} between directions").format(what, of_unit(number(scale * span, 2), unit))
    if max(-value.min(), 0.0) > FLAT * span and max(value.max(), 0.0) > FLAT * span:
        size = of_unit(number(scale * span, 2), unit)
        return Markup("{} varies by {} along {}").format(what, size, channel_words(channel, config.units))
    k = int(np.argmax(np.abs(value)))  # of one sign: told by its largest size, against the model without the effect
    sign = 1.0 if value[k] > 0 else -1.0
    ends = sorted((scale * sign * lo[k], scale * sign * hi[k]))
    way = "rises" if sign > 0 else "falls"
    reestimated = k == len(value) - 1 and abs(value[0]) <= STARTS * span
    size = _measured(scale * abs(value[k]), ends, unit)
    return Markup("{} {} by {}{}").format(what, way, "" if reestimated else "up to ", size)


def target_html(target: str, config: Config) -> Markup:
    """Return what an effect acts on: a symbol, or the true name of the force."""
    return Markup("the {}").format(config.units.quantity("force")) if target == "force" else symbol_html(target)


def acts(effect: Mapping, config: Config) -> Markup:
    """Return how an effect enters the model, in a clause."""
    if effect["acts_on"] == "force":
        force = config.units.quantity("force")
        return Markup("scales the whole {}" if effect["operation"] == "multiply" else "adds to the {}").format(force)
    name = {"mu": Markup("the friction coefficient {}").format(symbol_html("mu"))}.get(effect["acts_on"])
    name = name or symbol_html(effect["acts_on"])
    return Markup("scales {}" if effect["operation"] == "multiply" else "adds to {}").format(name)


def meaning(effect_id: str, name: str) -> str:
    """Return what a parameter of an effect in the catalogue means, or "" for an effect that is in none."""
    from sealfit.effects import EFFECTS

    effect = EFFECTS.get(effect_id)
    return next((p.meaning for p in effect.parameters if p.name.rstrip("_") == name.rstrip("_")), "") if effect else ""


def _amplitudes(effect: Mapping) -> set[str]:
    from sealfit.effects import EFFECTS

    found = EFFECTS.get(effect["id"])
    return {name.rstrip("_") for name in found.linear} if found else set()


def left_over(closure: Mapping, config: Config) -> Markup:
    """Return what is left after the effects, in a sentence or two."""
    left, unit, floor = closure["left"], config.units.unit("force"), closure.get("noise_floor_N")
    rmse = closure["after"].get("rmse_N")
    said = []
    if known(rmse):
        size, ground = together([rmse, floor])
        beside = f" beside a noise floor of {of_unit(ground, unit)}" if known(floor) else ""
        said.append(f"The rms error that is left over all bins is {of_unit(size, unit)}{beside}")
        if known(floor) and known(left.get("rmse_N")) and 0 < left["rmse_N"] < rmse:
            said[0] += (
                f"; {of_unit(number(left['rmse_N'], 2), unit)} of it lies above the floor (roots of sums of squares)"
            )
        said[0] += "."
    if closure["verdict"] == "unexplained":
        said.append(f"It is not only noise: {_where(left, config)}.")
    elif left.get("channels") and any(effect["candidate"] for effect in closure["effects"]):
        said.append(f"What may order it is shown by too few specimens to be claimed: {_where(left, config)}.")
    elif left.get("channels"):
        said.append(f"No channel orders it more surely than chance would; where to look first: {_where(left, config)}.")
    else:
        said.append("No channel orders it: it is scatter.")
    return Markup(" ").join([part if isinstance(part, Markup) else Markup("{}").format(part) for part in said])


def _where(left: Mapping, config: Config) -> str:
    names, level = left.get("channels") or [], left.get("level")
    text = "structure is left"
    if names:
        text = f"the residual follows {joined([channel_label(name, config.units) for name in names])}"
    if level:
        text += f" {PARTS.get(level, 'at the level ' + str(level))}"
    return f"{text} (p {p_value(left.get('p_value'))})" if known(left.get("p_value")) else text


def with_left_channels(closure: Mapping, channels: Collection[str]) -> dict:
    """Return closure.json with `left.channels`, the names that `left.channel` joins; `channels` are those known."""
    left = closure["left"]
    return {**closure, "left": {**left, "channels": split_channels(left.get("channel"), channels)}}


def _units_of(closure: Mapping) -> str:
    return f"{closure.get('heldout_unit') or 'run'}s"


def _joined(parts: Sequence[Markup]) -> Markup:
    return Markup(" and ").join([Markup(", ").join(parts[:-1]), parts[-1]] if len(parts) > 1 else parts)


def _sentence(clause: Markup) -> Markup:
    text = str(clause)
    return Markup(text[:1].upper() + text[1:] + ".")
