"""The loop's results as the page writes them: errors, effects, tests by channel, runs to do next."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from functools import partial

import pandas as pd
from markupsafe import Markup

from sealfit.config import Config
from sealfit.report.figures.residual import LEVELS, shape_label, shape_scale
from sealfit.report.notation import (
    NOTHING,
    capital,
    channel_label,
    channel_words,
    count,
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
from sealfit.report.summary import level_words
from sealfit.report.words import acts, in_words, meaning, target_html, with_symbols

MOST_TESTS = 40
CURVE_PLACES = 7  # of a free shape that a card lists
FREE = {
    "smooth": "free smooth shape",
    "levels": "one level per category",
    "surface": "free smooth surface",
    "slopes": "one slope per category",
}


def vocabulary(closure: Mapping | None, shapes: pd.DataFrame, config: Config) -> dict[str, Callable]:
    """Return the functions by which the template writes values, those of closure.json above all."""
    plain = (
        capital, count, given, known, level_words, number, of_unit, p_value, parameter_cells, sized,
        with_symbols,
    )  # fmt: skip
    of_units = (channel_label, effect_label)
    of_config = (acts, channel_labels, given_as, rivals_of, target_html, wanted)
    return {
        **{function.__name__: function for function in plain},
        **{function.__name__: partial(function, units=config.units) for function in of_units},
        **{function.__name__: partial(function, config=config) for function in of_config},
        "curve_of": partial(curve_of, shapes=shapes, closure=closure, config=config),
        "in_words": partial(in_words, closure=closure, config=config),
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


def sized(value: float | None, unit: str, unknown: str = "") -> str:
    """Return a value to two digits with its unit, or what is written where it is not known."""
    return of_unit(number(value, 2), unit) if known(value) else unknown


def _change(before: float, after: float) -> str:
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


def parameter_cells(p: Mapping, effect: Mapping) -> dict:
    """Return the cells of a parameter of an effect."""
    value, interval = measured(p["value"], *p["ci95"])
    return {
        "symbol": symbol_html(p["name"]),
        "meaning": meaning(effect["id"], p["name"]),
        "value": value,
        "interval": interval,
        "unit": p["unit"] or "",
    }


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
