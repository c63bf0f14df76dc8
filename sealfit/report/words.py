"""The loop's results as the page writes them: sentences, and rows of errors and of tests by variable."""

import json
import math
import re
from collections import Counter
from collections.abc import Collection, Mapping, Sequence

import pandas as pd
from markupsafe import Markup, escape

from sealfit.config import Config
from sealfit.effects import EFFECTS
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
    quality_clause,
    residual_clause,
    split_channels,
    verdict_clauses,
)
from sealfit.report.summary_lines import has_weak_evidence, weakness

MOST_TESTS = 40
CURVE_PLACES = 7  # of a free shape that a card lists
FREE = {
    "smooth": "free smooth shape", "levels": "one level per category",
    "surface": "free smooth surface", "slopes": "one slope per category",
}  # fmt: skip


def verdict(closure: Mapping, config: Config) -> Markup:
    """Return the verdict in a few sentences."""
    added = [effect for effect in by_gain(closure["effects"]) if not effect["candidate"]]
    error = error_clause(closure, config)
    clauses = verdict_clauses(closure, config.units)
    if added and not known(closure["noise_floor_N"]):  # the error says that there are no repeats
        clauses.remove(quality_clause(closure))
    said = [in_words(clause, closure, config) for clause in clauses]
    said.append(outlier_clause(closure))
    if not added:
        return _sentences(*said, error)
    times = Counter(effect_label(effect, config.units) for effect in added)
    labels = [label if n == 1 else f"{label} ({n} of them)" for label, n in times.items()]
    what, them = ("an effect", "it") if len(added) == 1 else (f"{len(added)} effects", "them")
    return _sentences(f"the declared model lacks {what}: {joined(labels)}", f"with {them}, {error}", *said)


def in_words(text: str, closure: Mapping, config: Config) -> Markup:
    """Return a sentence of closure.json with quantities and units for columns, and parameters as symbols."""
    names = [entry["variable"] for entry in closure["sensitivity"]]
    force = config.units.quantity("force").removeprefix("friction ")
    return with_symbols(true_units(re.sub(r"\bforce\b", force, text), config.units, names))


def error_clause(closure: Mapping, config: Config) -> str:
    """Return the held-out error before and after, and the noise floor, in a clause."""
    unit = config.units.unit("force")
    held = f"rms error on held-out {closure['heldout_unit']}s"
    errors = {
        "heldout_rmse_N": held,
        "heldout_extrapolated_rmse_N": f"{held}, all of them extrapolated,",
        "rmse_N": "in-sample rms error (nothing could be held out)",
    }
    key = next((key for key in errors if known(closure["before"][key])), "rmse_N")
    before, after, floor = closure["before"][key], closure["after"][key], closure["noise_floor_N"]
    texts = together([before, after, floor])
    change = f"the {errors[key]} is {of_unit(texts[0], unit)}"
    if before != after and known(after):
        way = "falls" if after < before else "rises"
        change = f"the {errors[key]} {way} from {of_unit(texts[0], unit)} to {of_unit(texts[1], unit)}"
    end = f": {of_unit(texts[2], unit)}" if known(floor) else " unknown: there are no repeats"
    return f"{change} (noise floor{end})"


def target_html(target: str, config: Config) -> Markup:
    """Return the target of an effect: a symbol, or the name of the measured force."""
    return escape(f"the {config.units.quantity('force')}") if target == "force" else symbol_html(target)


def with_symbols(text: object, *, formula: bool = False) -> Markup:
    """Return text as HTML with its parameters as symbols; single letters are parameters in a formula only.

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
    parameters = EFFECTS[effect_id].parameters if effect_id in EFFECTS else ()
    return next((p.meaning for p in parameters if p.symbol == name.rstrip("_")), "")


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
            excess = f"{of_unit(number(left['rmse_N'], 2), unit)} (root of the difference of the squares)"
            said.append(f"the excess over the noise floor is {excess}")
    where = in_words(residual_clause(closure, config.units), closure, config)
    if left["significant"]:
        said.append(Markup("a significant residual remains{}").format(where))
    elif left["channel"] and any(effect["candidate"] for effect in closure["effects"]):
        said.append(Markup("the evidence rests on too few specimens: it varies{}").format(where))
    elif left["channel"] and has_weak_evidence(left):
        said.append(Markup("the evidence of what remains{} {}").format(where, weakness(left)))
    elif left["channel"]:
        said.append(Markup("no variable is significant. The smallest p-value:{}").format(where))
    else:
        within = closure["fit_quality"]["state"] == "within_scatter"
        said.append("no variable explains it" + (": it is consistent with scatter" if within else ""))
    return _sentences(*said)


def without_load(closure: Mapping) -> dict:
    """Return closure.json of a campaign without a load: F_s and F_c are fitted in place of mu_s and mu_c."""
    text = re.sub(r'(?<="acts_on": ")mu(?=_[sc]")', "F", json.dumps(closure))
    return json.loads(text.replace('"acts_on": "mu"', '"acts_on": "friction"'))


def _sentences(*clauses: str | Markup) -> Markup:
    """Return the clauses that are not empty as sentences; plain text is escaped."""
    return Markup(" ".join(f"{capital(str(escape(clause)))}." for clause in clauses if clause))


# ---------------------------------------------------------------- tables


def error_rows(closure: Mapping, config: Config) -> list[dict]:
    """Return the rows of the table before and after: label, unit, before, after, change."""
    floor, stages, found = closure["noise_floor_N"], ("before", "after"), []
    for key, label in ERRORS.items():
        before, after = (closure[stage][key] for stage in stages)
        if key == "heldout_extrapolated_rmse_N" and not known(before):
            continue
        texts = together([before, after, floor if key in FLOORED else None])
        change = _percent(before, after) if known(before) and known(after) and before else NOTHING
        label, unit = label.format(held=closure["heldout_unit"]), config.units.of(key)
        found.append({"label": label, "unit": unit, "before": texts[0], "after": texts[1], "change": change})
    p = {stage: _p(closure[stage]["lack_of_fit_p"]) for stage in stages}
    found.append({"label": "lack of fit, p", "unit": "", **p, "change": ""})
    floors = dict.fromkeys(stages, number(floor, 2) if known(floor) else "unknown")
    label, unit = "noise floor: error of a perfect model", config.units.unit("force")
    return [*found, {"label": label, "unit": unit, **floors, "change": ""}]


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
    step = 1 if rows["x"].isna().any() else max(1, (len(rows) - 1) // (CURVE_PLACES - 1))
    rows, scale = rows.iloc[::step], shape_scale(effect)  # every category, and some places along a number
    places = rows["label"].where(rows["x"].isna(), rows["x"].map(given))
    values = scale * rows[["value", "lo95", "hi95"]]
    texts = [(place, *measured(*own)) for place, own in zip(places, values.to_numpy().tolist(), strict=True)]
    place, value = rows["channel"].iloc[0], shape_label(rows, effect, config.units, str)
    return {"place": channel_label(place, config.units), "value": with_symbols(value), "rows": texts}


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
    names, found = set(known_channels) | {"direction"}, []
    order = {level: k for k, level in enumerate(reversed(LEVELS))}
    tests = levels[levels["channel"].notna()].set_index("stage")
    for (channel, level), own in tests.groupby(["channel", "level"], sort=False):
        words = joined([channel_words(part, config.units) for part in split_channels(channel, names)])
        row = {"channel": words, "level": level_words(level)}
        for stage in ("before", "after"):
            row[f"sd_{stage}"] = number(own["sd_N"].get(stage), 2)
            row[f"p_{stage}"] = _p(own["p_value"].get(stage))
        rank = own["p_value"].get("before")
        found.append((rank if known(rank) else 1.0, order.get(level, 9), row))
    return [row for *_, row in sorted(found, key=lambda one: one[:2])[:MOST_TESTS]]


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
