"""The loop's results as the page writes them: sentences, and rows of errors and of tests by variable."""

from __future__ import annotations

import json
import math
import re
from collections import Counter
from collections.abc import Collection, Mapping, Sequence

import numpy as np
import pandas as pd
from markupsafe import Markup, escape

from sealfit.config import Config
from sealfit.effects import EFFECTS
from sealfit.effects.contract import Parameter
from sealfit.report.figures.residual import LEVELS, shape_label, shape_scale
from sealfit.report.notation import (
    GREEK,
    NOTHING,
    capital,
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
from sealfit.report.summary import (
    ERRORS,
    FLOORED,
    by_gain,
    level_words,
    outlier_clause,
    power_clause,
    quality_clause,
    untold_clause,
)

# A shape that crosses zero by at most this share of its span counts as one of constant sign. 0.02 is about
# the resolution of a plot.
FLAT = 0.02
COUNTED = dict(enumerate(["two", "three", "four", "five", "six", "seven", "eight", "nine", "ten"], start=2))
# The verdict gives the sizes of at most this many effects; the sizes of more are in their cards.
DETAILED = 2
MOST_TESTS = 40
CURVE_PLACES = 7  # of a free shape that a card lists
FREE = {
    "smooth": "free smooth shape",
    "levels": "one level per category",
    "surface": "free smooth surface",
    "slopes": "one slope per category",
}


def verdict(closure: Mapping, shapes: pd.DataFrame, config: Config) -> Markup:
    """Return the verdict in a few sentences; table `shapes` gives the sizes of the effects."""
    errors = [error_clause(closure, config)]
    if known(closure["noise_floor_N"]):
        errors.append(quality_clause(closure))
    errors.append(outlier_clause(closure))
    if closure["verdict"] == "nothing_missing":
        power = power_clause(closure, config.units)
        return _sentences("no effect beyond the declared model is significant", *errors, power)
    if closure["verdict"] == "cannot_tell":
        lead = Markup("these files do not decide whether an effect is missing: {}")
        return _sentences(
            lead.format(in_words(untold_clause(closure, config.units), closure, config)), *errors
        )
    effects = closure["effects"]
    added = [(effects.index(e), e) for e in by_gain(effects) if not e["candidate"]]
    lacked = left = better = ""
    if added:
        many = f"{COUNTED.get(len(added), len(added))} effects: " if len(added) > 1 else ""
        missed = Markup(joined(_missed_effects(added, shapes, config)))
        lacked = Markup("the declared model lacks {}{}").format(many, missed)
        better = Markup("with {}, {}").format("them" if len(added) > 1 else "it", errors.pop(0))
    if closure["verdict"] != "closed":
        left = f"a significant residual remains that no effect explains: {_where(closure['left'], config)}"
    elif closure["left"]["significant"]:
        left = f"{_where(closure['left'], config)}, by less than repeats scatter"
    return _sentences(lacked, better, left, *errors)


def undecided(closure: Mapping, config: Config) -> Markup:
    """Return what the files do not decide beside the effects that were found, in a sentence; may be empty."""
    untold = untold_clause(closure, config.units) if closure["verdict"] == "closed" else ""
    lead = Markup("not decided by these files: {}")
    return _sentences(lead.format(in_words(untold, closure, config)) if untold else "")


def in_words(text: str, closure: Mapping, config: Config) -> Markup:
    """Return a sentence of closure.json with quantities and units for columns, and parameters as symbols."""
    names = [entry["variable"] for entry in closure["sensitivity"]]
    force = config.units.quantity("force").removeprefix("friction ")
    return with_symbols(true_units(re.sub(r"\bforce\b", force, text), config.units, names))


def _missed_effects(
    added: Sequence[tuple[int, Mapping]], shapes: pd.DataFrame, config: Config
) -> list[Markup]:
    """Return each effect with its size; of more than `DETAILED` effects only the names, each once."""
    if len(added) <= DETAILED:
        return [_missed(effect_label(e, config.units), does(k, e, shapes, config)) for k, e in added]
    times = Counter(effect_label(effect, config.units) for _, effect in added)
    return [escape(label if n == 1 else f"{label} ({n} of them)") for label, n in times.items()]


def _missed(label: str, does: Markup) -> Markup:
    if not does:
        return escape(label)
    if label.endswith(")"):  # a second pair of parentheses would follow
        return Markup("{}; {})").format(label.removesuffix(")"), does)
    return Markup("{} ({})").format(label, does)


def error_clause(closure: Mapping, config: Config) -> Markup:
    """Return the held-out error before and after, and the noise floor, in a clause."""
    unit = config.units.unit("force")
    held = f"rms error on held-out {closure['heldout_unit']}s"
    errors = (
        ("heldout_rmse_N", held),
        ("heldout_extrapolated_rmse_N", f"{held}, all of them extrapolated,"),
        ("rmse_N", "in-sample rms error (nothing could be held out)"),
    )
    key, what = next((error for error in errors if known(closure["before"][error[0]])), errors[-1])
    before, after, floor = closure["before"][key], closure["after"][key], closure["noise_floor_N"]
    texts = together([before, after, floor])
    if before == after or not known(after):
        change = f"the {what} is {of_unit(texts[0], unit)}"
    else:
        way = "falls" if after < before else "rises"
        change = f"the {what} {way} from {of_unit(texts[0], unit)} to {of_unit(texts[1], unit)}"
    end = f": {of_unit(texts[2], unit)}" if known(floor) else " unknown: there are no repeats"
    return Markup("{} (noise floor{})").format(change, end)


def does(index: int, effect: Mapping, shapes: pd.DataFrame, config: Config) -> Markup:
    """Return the largest change of the target by an effect, and its other parameters, in a clause.

    The values of a free shape at its knots are not among them.
    """
    change = _change(effect, shapes[shapes["effect"] == index] if len(shapes) else shapes, config)
    rest = [p for p in effect["parameters"] if effect["named"] and p["unit"] != "rad"]
    if change:  # which says how large the amplitudes are
        found = [_catalogued(effect["id"], p["name"]) for p in rest]
        rest = [p for p, own in zip(rest, found, strict=True) if own is None or not own.linear]
    return Markup(", ").join(filter(None, [change, *(parameter(p, effect) for p in rest[:2])]))


def parameter(p: Mapping, effect: Mapping) -> Markup:
    """Return "time constant τ = 4.0 s [3.6, 4.5]", in words for an effect of the catalogue."""
    words = meaning(effect["id"], p["name"])
    value = _measured(p["value"], p["ci95"], p["unit"])
    text = Markup("{} = {}").format(symbol_html(p["name"]), value)
    return Markup("{} {}").format(words, text) if words and len(words) <= 40 else text


def _measured(value: float | None, ends: Sequence[float | None], unit: str | None) -> str:
    text, interval = measured(value, *ends, digits=1)
    tail = f" {interval}".replace(", ", ",\u00a0") if interval != NOTHING else ""
    return of_unit(text, unit or "") + tail


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
    scale, unit = 1.0, next((u for u in shape["unit"] if isinstance(u, str) and u), "")
    if effect["operation"] == "multiply":
        scale, unit = 100.0, "%"
    size, words = of_unit(number(scale * span, 2), unit), channel_words(channel, config.units)
    if channel == "direction":
        change = f"differs by {size} between directions"
    elif -value.min() > FLAT * span and value.max() > FLAT * span:
        change = f"varies by {size} along {words}"
    else:  # constant sign: the largest change against the model without the effect
        k = int(np.argmax(np.abs(value)))
        sign = 1.0 if value[k] > 0 else -1.0
        ends = sorted((scale * sign * lo[k], scale * sign * hi[k]))
        size = _measured(scale * abs(value[k]), ends, unit)
        place = of_unit(given(float(shape["x"].iloc[k])), config.units.of(channel))
        change = f"{'rises' if sign > 0 else 'falls'} by up to {size} at {words} {place}"
    return Markup("{} {}").format(target_html(effect["acts_on"], config), change)


def target_html(target: str, config: Config) -> Markup:
    """Return the target of an effect: a symbol, or the name of the measured force."""
    return escape(f"the {config.units.quantity('force')}") if target == "force" else symbol_html(target)


def with_symbols(text: object, *, formula: bool = False) -> Markup:
    """Return text as HTML with its parameters as symbols; single letters are parameters in a formula only.

    Examples
    --------
    >>> str(with_symbols("a mu_0 > 0"))
    'a <i>μ</i><sub>0</sub> &gt; 0'
    >>> str(with_symbols("A exp(-s / s_0) + t^2", formula=True))
    '<i>A</i> exp(-<i>s</i> / <i>s</i><sub>0</sub>) + <i>t</i><sup>2</sup>'
    """
    words = re.split(r"(\w+)", str(text))
    named = ("_" in word or word in GREEK or (formula and len(word) == 1) for word in words)
    pairs = zip(words, named, strict=True)
    html = Markup("").join(symbol_html(word) if symbol else escape(word) for word, symbol in pairs)
    return Markup(re.sub(r"\^(<i>\w</i>|\d+)", r"<sup>\1</sup>", str(html))) if formula else html


def acts(effect: Mapping, config: Config) -> Markup:
    """Return how an effect enters the model, in a clause."""
    target, factor = effect["acts_on"], effect["operation"] == "multiply"
    lead = {"mu": "the friction coefficient ", "force": "the whole " if factor else "the "}.get(target, "")
    name = config.units.quantity("force") if target == "force" else symbol_html(target)
    return Markup("{} {}{}").format("scales" if factor else "adds to", lead, name)


def meaning(effect_id: str, name: str) -> str:
    """Return the meaning of a parameter, or "" for an effect that is not in the catalogue."""
    found = _catalogued(effect_id, name)
    return found.meaning if found else ""


def _catalogued(effect_id: str, name: str) -> Parameter | None:
    parameters = EFFECTS[effect_id].parameters if effect_id in EFFECTS else ()
    return next((p for p in parameters if p.symbol == name.rstrip("_")), None)


def left_over(closure: Mapping, config: Config) -> Markup:
    """Return the size of the remaining residual, and the variable that explains it if any, in sentences."""
    left, unit, floor = closure["left"], config.units.unit("force"), closure["noise_floor_N"]
    rmse = closure["after"]["rmse_N"]
    said = []
    if known(rmse):
        size, ground = together([rmse, floor])
        beside = f"; the noise floor is {of_unit(ground, unit)}" if known(floor) else ""
        said.append(f"the rms error of all bins is {of_unit(size, unit)}{beside}")
        if known(floor) and known(left["rmse_N"]) and 0 < left["rmse_N"] < rmse:
            excess = of_unit(number(left["rmse_N"], 2), unit)
            said.append(
                f"the excess over the noise floor is {excess} (root of the difference of the squares)"
            )
    if left["significant"]:
        said.append(f"a significant residual remains: {_where(left, config)}")
    elif left["channels"] and any(effect["candidate"] for effect in closure["effects"]):
        said.append(f"the evidence rests on too few specimens: {_where(left, config)}")
    elif left["channels"]:
        said.append(f"no variable is significant. The smallest p-value: {_where(left, config)}")
    else:
        said.append("no variable explains it: it is consistent with scatter")
    return _sentences(*said)


def _where(left: Mapping, config: Config) -> str:
    names, level = left["channels"], left["level"]
    text = "the residual varies"
    if names:
        text += f" with {channel_labels(names, config)}"
    if level:
        text += f" {level_words(level)}"
    if not known(left["p_value"]):
        return text
    p = p_value(left["p_value"]).replace(" ", "\u00a0")  # on one line
    return f"{text} (p\u00a0{p})"


def without_load(closure: Mapping) -> dict:
    """Return closure.json of a campaign without a load: F_s and F_c are fitted in place of mu_s and mu_c."""
    text = re.sub(r'(?<="acts_on": ")mu(?=_[sc]")', "F", json.dumps(closure))
    return json.loads(text.replace('"acts_on": "mu"', '"acts_on": "friction"'))


def with_left_channels(closure: Mapping, channels: Collection[str]) -> dict:
    """Return closure.json with `left.channels`: `left.channel` split into the names in `channels`."""
    left = closure["left"]
    return {**closure, "left": {**left, "channels": split_channels(left["channel"], channels)}}


def _sentences(*clauses: str | Markup) -> Markup:
    """Return the clauses that are not empty as sentences; plain text is escaped."""
    return Markup(" ".join(f"{capital(str(escape(clause)))}." for clause in clauses if clause))


# ---------------------------------------------------------------- tables


def error_rows(closure: Mapping, config: Config) -> list[dict]:
    """Return the rows of the table before and after: label, note, before, after, change."""
    floor, stages, found = closure["noise_floor_N"], ("before", "after"), []
    for key, label in ERRORS.items():
        if key == "heldout_extrapolated_rmse_N":
            continue
        before, after = (closure[stage][key] for stage in stages)
        texts = together([before, after, floor if key in FLOORED else None])
        change = _percent(before, after) if known(before) and known(after) and before else NOTHING
        label, unit = label.format(held=closure["heldout_unit"]), config.units.of(key)
        found.append({"label": label, "unit": unit, "before": texts[0], "after": texts[1], "change": change})
    p = {stage: _p(closure[stage]["lack_of_fit_p"]) for stage in stages}
    floor_text = number(floor, 2) if known(floor) else "unknown"
    return [
        *found,
        {"label": "lack of fit, p", "unit": "", **p, "change": ""},
        {
            "label": "noise floor: error of a perfect model",
            "unit": config.units.unit("force"),
            "before": floor_text,
            "after": floor_text,
            "change": "",
        },
    ]


def _p(value: float | None) -> str:
    return p_value(value).removeprefix("= ") if known(value) else NOTHING


def sized(value: float | None, unit: str, unknown: str = "") -> str:
    """Return a value to two digits with its unit, or what is written where it is not known."""
    return of_unit(number(value, 2), unit) if known(value) else unknown


def _percent(before: float, after: float) -> str:
    ratio = 100 * (after / before - 1)
    if not math.isfinite(ratio):
        return NOTHING
    percent = round(ratio)
    return f"{percent:+d}\u00a0%".replace("-", "−") if percent else "0\u00a0%"


def channel_labels(channels: Sequence[str], config: Config) -> str:
    """Return channels with their units, in words."""
    return joined([channel_label(name, config.units) for name in channels])


def given_as(effect: Mapping, config: Config) -> str | Markup:
    """Return what the form of an effect gives, in words."""
    if effect["operation"] == "multiply":
        return "factor minus one"
    if effect["acts_on"] == "force":
        return f"added {config.units.quantity('force')}"
    return Markup("added to {}").format(symbol_html(effect["acts_on"]))


def curve_of(effect: Mapping, shapes: pd.DataFrame, closure: Mapping, config: Config) -> dict | None:
    """Return the head and a few places of a free shape along its first channel; None if it is not stored."""
    own = shapes[shapes["effect"] == closure["effects"].index(effect)]
    if own.empty:
        return None
    rows = own[own["channel"] == own["channel"].iloc[0]]
    step = max(1, (len(rows) - 1) // (CURVE_PLACES - 1))
    rows, scale = rows.iloc[::step], shape_scale(effect)
    places = rows["label"].where(rows["x"].isna(), rows["x"].map(given))
    values = [
        measured(*(scale * v for v in row)) for row in rows[["value", "lo95", "hi95"]].itertuples(index=False)
    ]
    return {
        "place": channel_label(rows["channel"].iloc[0], config.units),
        "value": with_symbols(shape_label(rows, effect, config.units, str)),
        "rows": [(place, *texts) for place, texts in zip(places, values, strict=True)],
    }


def rivals_of(effect: Mapping, config: Config) -> list[Markup]:
    """Return the forms that the data do not distinguish from an effect, each once."""
    return list(dict.fromkeys(_rival(rival, config) for rival in effect["alternatives"]))


def _rival(rival: Mapping, config: Config) -> Markup:
    names = [channel_words(name, config.units) for name in rival["channels"]]
    channels, label = joined(names), FREE.get(rival["id"], str(rival["id"]).replace("_", " "))
    if effect := EFFECTS.get(rival["id"]):
        first = names[0] if "{z}" in effect.label else channels
        label = effect.label.replace("{x}", first).replace("{z}", names[-1] if names else "")
    text = Markup("{}, acting on {}").format(label, target_html(rival["acts_on"], config))
    if channels and channels not in label:
        text += Markup(" along {}").format(channels)
    if known(error := rival["heldout_rmse_N"]):
        text += Markup(" (held-out error {})").format(of_unit(number(error), config.units.unit("force")))
    return text


def channel_tests(levels: pd.DataFrame, known_channels: Collection[str], config: Config) -> list[dict]:
    """Return the part of the residual each variable explains, before and after, most significant first."""
    rows: dict[tuple, dict] = {}
    names = set(known_channels) | {"direction"}
    for row in levels[levels["channel"].notna()].itertuples():
        words = joined([channel_words(part, config.units) for part in split_channels(row.channel, names)])
        entry = rows.setdefault(
            (row.channel, row.level),
            {"channel": words, "level": level_words(row.level), "rank": 1.0}
            | {f"{what}_{stage}": NOTHING for what in ("sd", "p") for stage in ("before", "after")},
        )
        entry[f"sd_{row.stage}"] = number(row.sd_N, 2)
        entry[f"p_{row.stage}"] = _p(row.p_value)
        if row.stage == "before" and known(row.p_value):
            entry["rank"] = row.p_value
    order = {level: k for k, level in enumerate(reversed(LEVELS))}
    listed = sorted(rows.items(), key=lambda item: (item[1]["rank"], order.get(item[0][1], 9)))
    return [entry for _, entry in listed[:MOST_TESTS]]


def wanted(conditions: Mapping, config: Config) -> str:
    """Return the conditions to measure at, e.g. "aging temperature 60 °C, sliding speed 5 mm/s"."""
    parts = []
    for name, value in conditions.items():
        text = given(value) if known(value) else str(value)
        if name == "direction" and text in ("1", "−1"):
            text = "forward" if text == "1" else "backward"
        unit = config.units.of(name)
        parts.append(f"{channel_words(name, config.units)} {text}{' ' + unit if unit else ''}")
    return ", ".join(parts)
