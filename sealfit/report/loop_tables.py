"""The loop's results as rows for the page: errors, effects, scatter, tests by channel, runs to do next."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence

import pandas as pd
from markupsafe import Markup

from sealfit.config import Config
from sealfit.report.figures.residual import LEVELS, shape_label, shape_scale
from sealfit.report.notation import (
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
)
from sealfit.report.summary import by_gain, level_words
from sealfit.report.words import acts, in_words, meaning, target_html, with_symbols

MOST_TESTS = 40
CURVE_PLACES = 7  # of a free shape that a card lists
FREE = {
    "smooth": "free smooth shape",
    "levels": "one level per category",
    "surface": "free smooth surface",
    "slopes": "one slope per category",
}


def error_rows(closure: Mapping, config: Config) -> list[dict]:
    """Return the rows of the table before and after: label, note, before, after, change."""
    unit, held = config.units.unit("force"), closure["heldout_unit"]
    floor, stages = closure["noise_floor_N"], ("before", "after")
    rows = (
        ("heldout_rmse_N", f"rms error, held-out {held}s", unit),
        ("rmse_N", "rms error of all bins, in sample", unit),
        ("rmse_runs_N", "rms error of run means, in sample", unit),
        ("max_abs_N", "largest error of a bin", unit),
        ("mean_abs_pct", "mean absolute error, relative to the run mean", "%"),
    )
    found = []
    for key, label, of in rows:
        before, after = (closure[stage][key] for stage in stages)
        texts = together([before, after, floor if key in ("rmse_N", "heldout_rmse_N") else None])
        change = _change(before, after) if known(before) and known(after) and before else NOTHING
        found.append({"label": label, "unit": of, "before": texts[0], "after": texts[1], "change": change})
    p = {stage: _p(closure[stage]["lack_of_fit_p"]) for stage in stages}
    return [*found, {"label": "lack of fit, p", "unit": "", **p, "change": ""}]


def _p(value: float | None) -> str:
    return p_value(value).removeprefix("= ") if known(value) else NOTHING


def sensitivity_rows(closure: Mapping, config: Config) -> list[dict]:
    """Return a row per variable and level: label, level and the smallest detectable effect."""
    unit = config.units.unit("force")
    return [
        {
            "variable": channel_label(entry["variable"], config.units),
            "level": level_words(entry["level"]),
            "smallest": _sized(entry["smallest_N"], unit, "none"),
            "share": _sized(entry["smallest_pct"], "%", NOTHING),
            "files": given(entry["files_needed"]),
        }
        for entry in closure["sensitivity"]
    ]


def _sized(value: float | None, unit: str, unknown: str = "") -> str:
    return of_unit(number(value, 2), unit) if known(value) else unknown


def refused_rows(closure: Mapping, config: Config) -> list[dict]:
    """Return the significant effects that were not accepted: label, p-value and reason."""
    return [
        {
            "label": Markup("{}, acting on {}").format(
                effect_label(entry, config.units), target_html(entry["acts_on"], config)
            ),
            "p": p_value(entry["p_value"]),
            "reason": in_words(entry["reason"], closure, config),
        }
        for entry in closure["refused"]
    ]


def _labels(channels: Sequence[str], config: Config) -> str:
    return joined([channel_label(name, config.units) for name in channels])


def _change(before: float, after: float) -> str:
    ratio = 100 * (after / before - 1)
    if not math.isfinite(ratio):
        return NOTHING
    percent = round(ratio)
    return f"{percent:+d}\u00a0%".replace("-", "−") if percent else "0\u00a0%"


def effect_cards(closure: Mapping, shapes: pd.DataFrame, config: Config) -> list[dict]:
    """Return every effect, added or candidate, with the content of its card; the largest gain first.

    A free shape has places of its curve in table `shapes`, and no parameters.
    """
    cards, unit = [], config.units.unit("force")
    for effect in by_gain(closure["effects"]):
        gain, left = effect["heldout_gain_N"], effect["heldout_rmse_N"]
        rivals = [_rival(rival, config) for rival in effect["alternatives"]]
        cards.append(
            {
                "index": closure["effects"].index(effect),
                "title": capital(effect_label(effect, config.units)),
                "named": effect["named"],
                "candidate": effect["candidate"],
                "acts": acts(effect, config),
                "given": _given(effect, config),
                "form": with_symbols(effect["form"], formula=True),
                "reference": effect["reference"],
                "level": level_words(effect["level"]),
                "channels": _labels(effect["channels"], config),
                "parameters": [_parameter(p, effect) for p in effect["parameters"] if effect["named"]],
                "curve": None if effect["named"] else _curve(effect, shapes, closure, config),
                "p": p_value(effect["p_value"]),
                "gain": _sized(gain, unit),
                "left": of_unit(number(left), unit) if known(left) else "",
                "rivals": list(dict.fromkeys(rivals)),
            }
        )
    return cards


def references(closure: Mapping, config: Config) -> list[dict]:
    """Return every effect of the after-model and the state in which it is zero, in words."""
    return [
        {"label": effect_label(effect, config.units), "state": effect["reference"]}
        for effect in closure["effects"]
        if not effect["candidate"]
    ]


def _given(effect: Mapping, config: Config) -> str | Markup:
    if effect["operation"] == "multiply":
        return "factor minus one"
    if effect["acts_on"] == "force":
        return f"added {config.units.quantity('force')}"
    return Markup("added to {}").format(symbol_html(effect["acts_on"]))


def _parameter(p: Mapping, effect: Mapping) -> dict:
    value, interval = measured(p["value"], *p["ci95"])
    return {
        "symbol": symbol_html(p["name"]),
        "meaning": meaning(effect["id"], p["name"]),
        "value": value,
        "interval": interval,
        "unit": p["unit"] or "",
    }


def _curve(effect: Mapping, shapes: pd.DataFrame, closure: Mapping, config: Config) -> dict | None:
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


def _rival(rival: Mapping, config: Config) -> Markup:
    from sealfit.effects import EFFECTS

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


def scatter_rows(closure: Mapping) -> list[dict]:
    """Return the variance components by level."""
    return [
        {
            "level": level_words(entry["level"]),
            "sd": number(entry["sd_N"], 2),
            "share": f"{number(100 * entry['sd_rel'], 2)} %" if known(entry["sd_rel"]) else NOTHING,
            "df": number(entry["df"], 2),
        }
        for entry in closure["scatter"]
    ]


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


def next_runs(closure: Mapping, config: Config) -> list[dict]:
    """Return the recommended runs: the reason and the conditions."""
    return [
        {
            "why": in_words(capital(entry["why"]), closure, config),
            "conditions": _wanted(entry["conditions"], config),
        }
        for entry in closure["next_runs"]
    ]


def _wanted(conditions: Mapping, config: Config) -> str:
    """Return the conditions to measure at, e.g. "aging temperature 60 °C, sliding speed 5 mm/s"."""
    parts = []
    for name, value in conditions.items():
        text = given(value) if known(value) else str(value)
        if name == "direction" and text in ("1", "−1"):
            text = "forward" if text == "1" else "backward"
        unit = config.units.of(name)
        parts.append(f"{channel_words(name, config.units)} {text}{' ' + unit if unit else ''}")
    return ", ".join(parts)
