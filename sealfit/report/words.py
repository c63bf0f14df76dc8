"""The report's sentences: the verdict, what an effect does, what is left."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

import pandas as pd
from markupsafe import Markup

from sealfit.config import Config
from sealfit.report.numbers import NOTHING, known, measured, number, of_unit, p_value, together
from sealfit.report.symbols import channel_label, channel_words, effect_label, joined, symbol_html

FALLS = 0.02  # of its span: a shape that turns back by less is called falling or rising
STARTS = 0.1  # of its span: a shape that starts nearer to zero than this is told by its end
PARTS = {"trace": "within a trace", "stroke": "between strokes", "repeat": "between repeats", "run": "between runs",
         "condition": "between conditions", "campaign": "along the campaign", "file": "between files",
         "specimen": "between specimens", "sample": "within a stroke"}  # fmt: skip
COUNTED = {2: "two", 3: "three", 4: "four", 5: "five", 6: "six"}


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
    if closure["verdict"] == "nothing_missing":
        text = Markup(
            "The declared model misses nothing that these data can show: no channel orders what it leaves over."
        )
        return text + Markup(" {}").format(_sentence(errors))
    added = [(k, e) for k, e in enumerate(closure["effects"]) if not e["candidate"]]
    missed = [_missed(effect_label(e, config.units), does(k, e, shapes, config)) for k, e in added]
    lead = (
        Markup("{} {}").format(f"{COUNTED.get(len(missed), len(missed))} things:", _joined(missed))
        if len(missed) > 1
        else None
    )
    if closure["verdict"] == "closed":
        if not missed:
            return _sentence(errors)
        them = "them" if len(missed) > 1 else "it"
        return Markup("The declared model missed {}; with {} {}.").format(lead or missed[0], them, errors)
    where = _where(closure["left"], config)
    if missed:
        return Markup(
            "The declared model missed {}, and something more that no effect explains: {}; so far {}."
        ).format(lead or missed[0], where, errors)
    return Markup("The declared model misses something that no effect explains: {}; {}.").format(where, errors)


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
    """Return what an effect does, in a clause: the change along its channel, then its other parameters."""
    change = _change(effect, shapes[shapes["effect"] == index] if len(shapes) else shapes, config)
    linear = _amplitudes(effect)
    rest = [p for p in effect["parameters"] if p["name"] not in linear] if change else effect["parameters"]
    said = [parameter(p, effect) for p in rest[:3]]
    return Markup(", ").join([part for part in (change, *said) if part])


def parameter(p: Mapping, effect: Mapping) -> Markup:
    """Return "time constant τ = 4.0 s [3.6, 4.5]"; the words only where the catalogue knows the effect."""
    words = meaning(effect["id"], p["name"])
    text = Markup("{} = {}").format(symbol_html(p["name"]), _measured(p["value"], p.get("ci95"), p.get("unit")))
    return Markup("{} {}").format(words, text) if words and len(words) <= 40 else text


def _measured(value: float | None, ends: Sequence[float | None] | None, unit: str | None) -> str:
    text, interval = measured(value, *(ends or (None, None)), digits=1)
    return of_unit(text, unit or "") + (f" {interval}".replace(", ", ",\u00a0") if interval != NOTHING else "")


def _change(effect: Mapping, shape: pd.DataFrame, config: Config) -> Markup:
    """Return by how much the effect changes its target along its first channel; nothing if there is no such shape."""
    shape = shape[shape["x"].notna() & shape["value"].notna()]
    if shape.empty or len(shape) < 2:
        return Markup("")
    shape = shape[shape["channel"] == shape["channel"].iloc[0]].sort_values("x")
    value, lo, hi = (shape[name].to_numpy(float) for name in ("value", "lo95", "hi95"))
    factor = effect["operation"] == "multiply"
    scale, unit = (100.0, "%") if factor else (1.0, next((u for u in shape["unit"] if isinstance(u, str) and u), ""))
    what = target_html(effect["acts_on"], config)
    span = value.max() - value.min()
    end = value[-1]
    turns_back = min(
        abs(value.max() - end) + abs(value[0] - value.min()), abs(end - value.min()) + abs(value.max() - value[0])
    )
    if span > 0 and turns_back <= FALLS * span:
        way = "falls" if end < value[0] else "rises"
        if abs(value[0]) <= STARTS * span:
            sign = 1.0 if end > 0 else -1.0
            ends = sorted((scale * sign * lo[-1], scale * sign * hi[-1]))
            return Markup("{} {} by {}").format(what, way, _measured(scale * abs(end), ends, unit))
    else:
        way = "varies"
    size = of_unit(number(scale * span, 2), unit)
    return Markup("{} {} by {} along {}").format(what, way, size, channel_words(shape["channel"].iloc[0], config.units))


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
    return next((p.meaning for p in effect.parameters if p.name == name), "") if effect else ""


def _amplitudes(effect: Mapping) -> set[str]:
    from sealfit.effects import EFFECTS

    found = EFFECTS.get(effect["id"])
    return set(found.linear) if found else set()


def left_over(closure: Mapping, config: Config) -> Markup:
    """Return what is left after the effects, in a sentence or two."""
    left, unit, floor = closure["left"], config.units.unit("force"), closure.get("noise_floor_N")
    rmse = closure["after"].get("rmse_N")
    said = []
    if known(rmse):
        size, ground = together([rmse, floor])
        beside = f" beside a noise floor of {of_unit(ground, unit)}" if known(floor) else ""
        said.append(f"The rms error that is left over all bins is {of_unit(size, unit)}{beside}")
        if known(floor) and known(left.get("rmse_N")) and left["rmse_N"] < rmse:
            said[0] += (
                f"; {of_unit(number(left['rmse_N'], 2), unit)} of it lies above the floor (roots of sums of squares)"
            )
        said[0] += "."
    if closure["verdict"] == "unexplained":
        said.append(f"It is not only noise: {_where(left, config)}.")
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
    """Return closure.json with `left.channels`: the channels whose names, joined by spaces, `left.channel` is.

    A column's own name may hold spaces, so the names that are known decide where to cut.
    """
    text = closure["left"].get("channel") or ""
    names, words = [], text.split(" ") if text else []
    while words:
        n = next((n for n in range(len(words), 0, -1) if " ".join(words[:n]) in channels), 1)
        names.append(" ".join(words[:n]))
        words = words[n:]
    return {**closure, "left": {**closure["left"], "channels": names}}


def _units_of(closure: Mapping) -> str:
    return f"{closure.get('heldout_unit') or 'run'}s"


def _joined(parts: Sequence[Markup]) -> Markup:
    return Markup(" and ").join([Markup(", ").join(parts[:-1]), parts[-1]]) if len(parts) > 1 else parts[0]


def _sentence(clause: Markup) -> Markup:
    text = str(clause)
    return Markup(text[:1].upper() + text[1:] + ".")
