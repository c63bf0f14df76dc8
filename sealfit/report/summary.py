"""Summaries of the steps as plain values, and clauses on the verdict that the report shares."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

from sealfit.units import Units

if TYPE_CHECKING:
    import pandas as pd

    from sealfit.effects.contract import Effect
    from sealfit.store.out_folder import Store


# ---------------------------------------------------------------- summary
# The main figures of each step as plain values, for --json; `summary_lines` puts them in words.

# `quantity` of rows about the fit itself
NOT_PARAMETERS = ("statistics", "covariance", "sensor_shift", "effect_shift")

OF_INGEST = {  # columns that its summary counts
    "inputs": ["status"],
    "runs": ["used", "run_id"],
    "quality": ["action", "severity", "check", "column", "value", "reason"],
    "steady": ["condition"],
}
EFFECT_KEYS = (
    "id",
    "label",
    "form",
    "acts_on",
    "operation",
    "channels",
    "named",
    "candidate",
    "parameters",
    "reference",
)


def of_steps(store: Store, steps: Iterable[str]) -> dict:
    """Return the summaries of `steps`, all of them current."""
    make = {
        "ingest": lambda: of_ingest({name: store.read(name, columns) for name, columns in OF_INGEST.items()}),
        "fit-steady": lambda: of_fit(store.read("steady_fit"), "condition"),
        "fit-aging": lambda: of_aging(store),
        "fit-dynamic": lambda: of_dynamic(store.read("dynamic_fit")),
        "close-loop": lambda: (
            of_closure(store.read_json("closure"), store.config.units) | {"fits": of_after(store)}
        ),
        "report": lambda: {"file": str(store.out / "report.html")},
    }
    return {step.replace("-", "_"): make[step]() for step in steps}


def of_ingest(tables: Mapping[str, pd.DataFrame]) -> dict:
    """Return how many files, runs and conditions there are, and how many faults."""
    inputs, quality, steady = tables["inputs"], tables["quality"], tables["steady"]
    runs = tables["runs"][tables["runs"]["used"].astype(bool)]
    return {
        "files": {
            "used": int((inputs["status"] == "used").sum()),
            "left_out": int((inputs["status"] == "left out").sum()),
            "not_matched": int((inputs["status"] == "not matched").sum()),
        },
        "rows_left_out": int((quality["action"] == "row left out").sum()),
        "strokes_left_out": int((quality["action"] == "stroke left out").sum()),
        "faults": {
            severity: int((quality["severity"] == severity).sum()) for severity in ("error", "warning")
        },
        "incomplete_columns": _incomplete(quality),
        "runs": int(runs["run_id"].nunique()),
        "conditions": int(steady["condition"].nunique()),
    }


def _incomplete(quality: pd.DataFrame) -> list[dict]:
    """Return the columns that have no value in some files, and the consequence."""
    rows = quality[quality["check"] == "incomplete_column"]
    return [
        {"column": column, "files_without": int(float(value)), "reason": reason}
        for column, value, reason in zip(rows["column"], rows["value"], rows["reason"], strict=True)
    ]


def of_fit(fit: pd.DataFrame, of: str) -> dict:
    """Return the range of each parameter over the conditions or series of `fit` in which it is identified."""
    rows = fit[~fit["quantity"].isin(NOT_PARAMETERS)]
    ranges = []
    for (quantity, parameter, unit), group in rows.groupby(
        ["quantity", "parameter", "unit"], sort=False, dropna=False
    ):
        known = group.loc[group["identified"].astype(bool), "value"].dropna()
        why = group.loc[~group["identified"].astype(bool), "reason"].dropna().mode()
        ranges.append(
            {
                "quantity": quantity,
                "parameter": parameter,
                "unit": unit or "",
                "min": float(known.min()) if len(known) else None,
                "max": float(known.max()) if len(known) else None,
                "identified": len(known),
                "of": len(group),
                "reason": str(why.iloc[0]) if len(why) else "",  # the most frequent reason
            }
        )
    return {of: int(fit[of].nunique()), "parameters": ranges}


def of_aging(store: Store) -> dict:
    """Return the ranges of the aging law's parameters; of properties, also their scatter and their laws."""
    fit = store.read("aging_fit")
    found = of_fit(fit, "series")
    if store.state.properties is not None:
        found["properties"] = of_properties(store.read("property_values"), fit, store.read("aging_laws"))
    return found


def of_properties(values: pd.DataFrame, fit: pd.DataFrame, laws: pd.DataFrame) -> list[dict]:
    """Return the summary of every property in tables `property_values`, `aging_fit` and `aging_laws`."""
    return [
        _of_property(own, fit, laws[(laws["rubber"] == rubber) & (laws["quantity"] == quantity)])
        for (rubber, quantity), own in values.groupby(["rubber", "quantity"])
    ]


def _of_property(values: pd.DataFrame, fit: pd.DataFrame, laws: pd.DataFrame) -> dict:
    """Return number and scatter of one property's values, how the laws fit, and the likeliest for all series.

    The lack of fit of the laws per series is their smallest p-value times their number (Bonferroni).
    """
    from sealfit.fit.aging.property import means_of

    first, means = values.iloc[0], means_of(values)
    own = fit[(fit["rubber"] == first["rubber"]) & fit["parameter"].str.startswith(f"{first['quantity']}:")]
    named = own.set_index(own["parameter"].str.replace(f"{first['quantity']}:", "", regex=False))["value"]
    p_values = named[named.index == "lack_of_fit_p"].dropna() if means.df else named.iloc[:0]
    best = laws[laws["rank"] == 1]
    energy = best[(best["parameter"] == "E") & best["identified"].astype(bool)]
    return {
        "rubber": first["rubber"],
        "quantity": first["quantity"],
        "unit": first["unit"] or "",
        "values": len(values),
        "conditions": int(values["condition"].nunique()),
        "mean": float(values["value"].mean()),
        "replicate_sd": means.specimen_sd if means.df else None,
        "batch_sd": means.batch_sd if means.batch_sd == means.batch_sd else None,
        "lack_of_fit_p": min(1.0, len(p_values) * float(p_values.min())) if len(p_values) else None,
        "law": None
        if best.empty
        else {
            **{name: best[name].iloc[0] for name in ("law", "way", "form")},
            "drivers": [name for name in ("E", "kappa") if (best["parameter"] == name).any()],
            "lack_of_fit_p": float(best["lack_of_fit_p"].iloc[0]),
            "E": None if energy.empty else energy[["value", "lo95", "hi95"]].iloc[0].tolist(),
        },
    }


def of_dynamic(fit: pd.DataFrame) -> dict:
    """Return the ranges of sigma_0 and sigma_1, and the largest break-away above the sliding force."""
    ratios = fit[fit["parameter"] == "F_ba/F"]
    broken = ratios[ratios["identified"].astype(bool) & (ratios["reason"] == "")]
    most = broken.loc[broken["value"].idxmax()] if len(broken) else None
    return {
        **of_fit(fit[fit["quantity"] == "dynamic"], "condition"),
        "break_aways": len(ratios),
        "above_sliding": len(broken),
        "largest_ratio": None if most is None else float(most["value"]),
        "largest_at": None if most is None else str(most["condition"]),
    }


def of_closure(closure: Mapping, units: Units) -> dict:
    """Return the verdict, the errors before and after, the effects and the remaining residual."""
    kept = (
        "verdict", "fit_quality", "sensitivity", "refused", "units", "noise_floor_N", "before", "after",
        "heldout_unit", "left", "next_runs", "outlier_files",
    )  # fmt: skip
    effects = [{key: effect[key] for key in EFFECT_KEYS} for effect in closure["effects"]]
    return {
        **{key: closure[key] for key in kept},
        "sentence": verdict_sentence(closure, units),
        "effects": effects,
    }


def of_after(store: Store) -> dict:
    """Return the summaries of the fits with the loop's effects taken out; empty where none was added."""
    if all(effect["candidate"] for effect in store.read_json("closure")["effects"]):
        return {}
    return {
        "fit_steady": of_fit(store.read("steady_fit_after"), "condition"),
        "fit_aging": of_fit(store.read("aging_fit_after"), "series"),
        "fit_dynamic": of_dynamic(store.read("dynamic_fit_after")),
    }


def verdict_sentence(closure: Mapping, units: Units) -> str:
    """Return the verdict in one sentence."""
    return "; ".join(filter(None, [_verdict_clause(closure, units), outlier_clause(closure)]))


def _verdict_clause(closure: Mapping, units: Units) -> str:
    count = sum(not effect["candidate"] for effect in closure["effects"])
    added = {0: "no effect was added", 1: "one effect was added"}.get(count, f"{count} effects were added")
    quality = quality_clause(closure)
    if closure["verdict"] == "nothing_missing":
        power = power_clause(closure, units)
        return "; ".join(filter(None, ["no effect beyond the declared model is significant", quality, power]))
    if closure["verdict"] == "cannot_tell":
        return (
            f"{quality}; these files do not decide whether an effect is missing: "
            f"{untold_clause(closure, units)}"
        )
    if closure["verdict"] == "closed":
        untold = untold_clause(closure, units)
        beside = f"; not decided by these files: {untold}" if untold else ""
        return f"{added}; no significant residual remains; {quality}{beside}"
    return f"{added}; a significant residual remains{_where(closure['left'], units)}; {quality}"


def _where(left: Mapping, units: Units) -> str:
    where = f" {level_words(left['level'])}" if left["level"] else ""
    along = f" along {units.label(left['channel'])}" if left["channel"] else ""
    return along + where + (f" (p = {left['p_value']:.2g})" if left["p_value"] is not None else "")


def of_effects(effects: Iterable[Effect], units: Units) -> list[dict]:
    """Return the catalogue as plain values; parameters have their units for the likeliest way to act."""
    from types import SimpleNamespace

    from sealfit.closure.result import parameter_unit
    from sealfit.effects.contract import CHANNEL

    units = replace(units, channels={**units.channels, CHANNEL: "unit of x"})
    listed = []
    for effect in effects:
        target, operation = effect.acts_on[0]
        likeliest = SimpleNamespace(channels=effect.reads, acts_on=target, operation=operation)
        listed.append(
            {
                "id": effect.id,
                "label": effect.label.replace("{x}", "a channel x").replace("{z}", "a channel z"),
                "form": effect.form,
                "equation": effect.equation,
                "reads": list(effect.reads),
                "acts_on": [
                    {"target": target, "operation": operation} for target, operation in effect.acts_on
                ],
                "physical": effect.physical,
                "source": effect.source,
                "parameters": [
                    {"name": p.name, "unit": parameter_unit(p.unit, likeliest, units), "meaning": p.meaning}
                    for p in effect.parameters
                ],
            }
        )
    return listed


# ---------------------------------------------------------------- verdict
# Clauses that the summary and the report share: fit quality and sensitivity.

LEVEL_WORDS = {
    "trace": "along strokes", "sample": "along strokes", "stroke": "between strokes",
    "repeat": "between repeats", "file": "between repeats", "run": "between runs",
    "condition": "between specimens", "specimen": "between specimens",
}  # fmt: skip
"""Words for the levels of closure.json and of table `levels`."""

NAMED = 3
"""Variables whose smallest effect a sentence gives."""


def outlier_clause(closure: Mapping) -> str:
    """Return which files the loop left out; empty if none."""
    outliers = closure.get("outlier_files") or []
    if not outliers:
        return ""
    named = [f"{one['file']} ({one['deviation_pct']:+.2g} %)" for one in outliers[:NAMED]]
    more = f" and {len(outliers) - NAMED} more" if len(outliers) > NAMED else ""
    what = "a file whose force is" if len(outliers) == 1 else f"{len(outliers)} files whose force is"
    return f"left out: {what} far off what all others predict: {', '.join(named)}{more}"


def level_words(level: str) -> str:
    """Return a level in words, e.g. "between runs"."""
    return LEVEL_WORDS.get(level, level)


def quality_clause(closure: Mapping) -> str:
    """Return how the error compares with the scatter of repeats, in a clause."""
    quality = closure.get("fit_quality") or {"state": "unknown"}
    if quality["state"] == "unknown":
        if closure.get("noise_floor_N") is not None:
            return "the model has too many parameters for these runs to test its lack of fit"
        return "without repeats it is not known whether the error exceeds the scatter"
    if quality["state"] == "within_scatter":
        return "the error is within the scatter of repeats"
    times, p_value = quality["ratio"], quality["p_value"]
    return f"the error is {times:.2g} times the scatter of repeats (lack of fit: p = {p_value:.1g})"


def power_clause(closure: Mapping, units: Units) -> str:
    """Return the smallest detectable effects of the least sensitive variables, in a clause.

    It is empty if none is known.
    """
    known = [s for s in closure.get("sensitivity") or () if s["smallest_N"] is not None]
    if not known:
        return ""
    largest = sorted(known, key=lambda s: -s["smallest_N"])[:NAMED]
    texts = [
        f"{s['smallest_pct']:.2g} % for {units.label(s['variable'])} {level_words(s['level'])}"
        for s in largest
    ]
    return f"the largest detection limits, in percent of the force, are {', '.join(texts)}"


def untold_clause(closure: Mapping, units: Units) -> str:
    """Return what the campaign does not decide, and the data it needs, in a clause; empty for none."""
    texts = [
        f"{effect['label']} (too few specimens, or specimens that disagree: test more)"
        for effect in closure["effects"]
        if effect["candidate"]
    ]
    texts += [
        f"{item['label']} (p = {item['p_value']:.1g}, weak evidence: test more)"
        for item in closure.get("refused") or ()
        if item["weak"]
    ][:NAMED]
    for entry in [s for s in closure.get("sensitivity") or () if s["cannot_tell"]][:NAMED]:
        name, smallest, files = entry["variable"], entry["smallest_pct"], entry["files_needed"]
        size = (
            "no effect is detectable"
            if smallest is None
            else f"detection limit {smallest:.2g} % of the force"
        )
        more = f"; 1 % needs about {files} files" if files and smallest is not None else ""
        more = f"; at least {files} files are needed" if files and smallest is None else more
        texts.append(f"{units.label(name)} ({size}{more})")
    return ", ".join(texts)
