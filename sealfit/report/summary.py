"""Summaries of the steps as plain values, and clauses on the verdict that the report shares."""

from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from sealfit.config import AGING_CONDITION
from sealfit.effects.contract import CHANNEL, Effect
from sealfit.report.summary_lines import has_weak_evidence, weakness
from sealfit.units import Units

if TYPE_CHECKING:
    from sealfit.store import Store

STATISTICS = "statistics"  # `quantity` of rows about the fit itself
OF_INGEST = ("inputs", "runs", "quality", "steady")  # tables that its summary counts
CLOSURE_KEYS = (
    "verdict", "fit_quality", "sensitivity", "refused", "units", "noise_floor_N", "before", "after",
    "heldout_unit", "left", "next_runs", "outlier_files",
)  # fmt: skip
EFFECT_KEYS = (
    "id", "label", "form", "acts_on", "operation", "channels", "named", "candidate", "parameters",
    "reference",
)  # fmt: skip
ERRORS = {  # of closure.json, before and after; {held} is the unit that is held out
    "heldout_rmse_N": "rms error, held-out {held}s",
    "heldout_extrapolated_rmse_N": "rms error, held-out {held}s beyond what the others cover",
    "rmse_N": "rms error of all bins, in sample",
    "rmse_runs_N": "rms error of run means, in sample",
    "max_abs_N": "largest error of a bin",
    "mean_abs_pct": "mean absolute error, relative to the run mean",
}
FLOORED = ("rmse_N", "heldout_rmse_N")  # errors that the noise floor is compared with


def of_steps(store: "Store", steps: Iterable[str]) -> dict:
    """Return the summaries of `steps`, all of them current."""
    make = {
        "ingest": lambda: of_ingest({name: store.read(name) for name in OF_INGEST}),
        "fit-steady": lambda: of_steady(store.read("steady_fit")),
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
    quality, runs, inputs = tables["quality"], tables["runs"], tables["inputs"]
    files = Counter(inputs["status"])
    others = quality[quality["file"].isin(inputs.loc[inputs["status"] == "not matched", "file"])]
    actions, severities = Counter(quality["action"]), Counter(quality["severity"])
    return {
        "files": {status.replace(" ", "_"): files[status] for status in ("used", "left out", "not matched")},
        "not_traces": {check: rows["file"].tolist() for check, rows in others.groupby("check", sort=False)},
        "rows_left_out": _rows_left_out(quality[quality["action"] == "row left out"]),
        "strokes_left_out": actions["stroke left out"],
        "faults": {severity: severities[severity] for severity in ("error", "warning")},
        "incomplete_columns": [
            {"column": row.column, "files_without": int(float(row.value)), "reason": row.reason}
            for row in quality[quality["check"] == "incomplete_column"].itertuples()
        ],
        "repeats_of_force": quality.loc[quality["check"] == "repeats_force", "column"].tolist(),
        "runs": int(runs.loc[runs["used"].astype(bool), "run_id"].nunique()),
        "conditions": int(tables["steady"]["condition"].nunique()),
    }


def _rows_left_out(faults: pd.DataFrame) -> int:
    """Return how many rows are left out: a row may have several faults, a fault may count several rows."""
    listed = faults["line"].notna()
    more = faults.loc[~listed, "value"].astype(float).groupby(faults["file"]).max().sum()
    return len(faults.loc[listed, ["file", "line"]].drop_duplicates()) + int(more)


def of_fit(fit: pd.DataFrame, of: str) -> dict:
    """Return the range of each parameter over the conditions or series of `fit` in which it is identified.

    `reason` is the most frequent one of those in which it is not, `remark` that of the others.
    """
    rows, ranges = fit[fit["quantity"] != STATISTICS], []
    keys = ["quantity", "parameter", "unit"]
    for (quantity, parameter, unit), group in rows.groupby(keys, sort=False, dropna=False):
        identified = group["identified"].astype(bool)
        known = group.loc[identified, "value"].dropna()
        lacking = group[~identified & group["reason"].notna()]
        why = "".join(lacking["reason"].mode()[:1])  # the most frequent reason
        if lacking["reason"].nunique() > 1:
            why = f"For example, {lacking.loc[lacking['reason'] == why, of].iloc[0]}: {why}"
        remark = "".join(group.loc[identified & (group["reason"].fillna("") != ""), "reason"].mode()[:1])
        low, high = (float(known.min()), float(known.max())) if len(known) else (None, None)
        row = {"quantity": quantity, "parameter": parameter, "unit": unit or "", "min": low, "max": high}
        row |= {"identified": len(known), "of": len(group), "reason": why, "remark": remark}
        ranges.append(row)
    return {of: int(fit[of].nunique()), "parameters": ranges}


def of_steady(fit: pd.DataFrame) -> dict:
    """Return the ranges of the steady parameters, and the scatter of specimens."""
    return {**of_fit(fit, "condition"), "specimens": of_specimens(fit)}


def of_specimens(fit: pd.DataFrame) -> dict:
    """Return the scatter of specimens in %, None if unknown, and whether the intervals contain it."""
    scatter = fit.loc[fit["parameter"] == "specimen_sd_pct", ["value", "reason"]]
    sd_pct, remark = scatter.iloc[0] if len(scatter) else (np.nan, "")
    return {"sd_pct": None if np.isnan(sd_pct) else float(sd_pct), "remark": remark or ""}


def of_aging(store: "Store") -> dict:
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
    from sealfit.fit.aging.property import far_off, means_of

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
        "far_off": far_off(values).to_dict("records"),
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
    found = {key: closure[key] for key in CLOSURE_KEYS} | {"sentence": verdict_sentence(closure, units)}
    effects = [{key: effect[key] for key in EFFECT_KEYS} for effect in by_gain(closure["effects"])]
    return found | {"effects": effects}


def of_after(store: "Store") -> dict:
    """Return the summaries of the fits after the loop; empty if it added no effect and left out no file."""
    closure = store.read_json("closure")
    if all(effect["candidate"] for effect in closure["effects"]) and not closure["outlier_files"]:
        return {}
    return {
        "fit_steady": of_steady(store.read("steady_fit_after")),
        "fit_aging": of_fit(store.read("aging_fit_after"), "series"),
        "fit_dynamic": of_dynamic(store.read("dynamic_fit_after")),
    }


def by_gain(effects: Sequence[Mapping]) -> list[Mapping]:
    """Return effects of closure.json, the largest reduction of the held-out error first."""
    return sorted(effects, key=lambda effect: -(effect["heldout_gain_N"] or 0.0))


def verdict_sentence(closure: Mapping, units: Units) -> str:
    """Return the verdict in one sentence."""
    count = sum(not effect["candidate"] for effect in closure["effects"])
    added = {0: "no effect was added", 1: "one effect was added"}.get(count, f"{count} effects were added")
    lead = [added] if closure["verdict"] in ("closed", "unexplained") else []
    said = [*lead, *verdict_clauses(closure, units), outlier_clause(closure)]
    return "; ".join(filter(None, said))


def verdict_clauses(closure: Mapping, units: Units) -> list[str]:
    """Return what the verdict says beside the effects that were added, in clauses; some may be empty."""
    kind, quality = closure["verdict"], quality_clause(closure)
    if kind == "nothing_missing":
        return ["no effect beyond the declared model is significant", quality, power_clause(closure, units)]
    if kind == "unexplained":
        return [f"a significant residual remains{residual_clause(closure, units)}", quality]
    untold = untold_clause(closure, units)
    if kind == "cannot_tell":
        return [quality, f"these files do not decide whether an effect is missing: {untold}"]
    remains = "no significant residual remains"
    if closure["left"]["significant"]:
        remains = f"what remains{residual_clause(closure, units)} is less than repeats scatter by"
    elif has_weak_evidence(closure["left"]):
        end = weakness(closure["left"])
        remains = f"the evidence of what remains{residual_clause(closure, units)} {end}"
    return [remains, quality, f"not decided by these files: {untold}" if untold else ""]


def residual_clause(closure: Mapping, units: Units) -> str:
    """Return along which variable and at which level the residual remains, and its p-value."""
    left = closure["left"]
    known = {entry["variable"] for entry in closure["sensitivity"]} | {"direction"}
    known |= {name for effect in closure["effects"] for name in effect["channels"]}
    names = [units.label(name) for name in split_channels(left["channel"], known)]
    where = f" {level_words(left['level'])}" if left["level"] else ""
    along = f" along {' and '.join(names)}" if names else ""
    return along + where + (f" (p = {left['p_value']:.2g})" if left["p_value"] is not None else "")


def split_channels(text: str | None, known: Collection[str]) -> list[str]:
    """Return the channel names, some of which may contain spaces, that `text` joins by spaces.

    >>> split_channels("direction oil temp", {"direction", "oil temp"})
    ['direction', 'oil temp']
    """
    names, words = [], text.split(" ") if text else []
    while words:
        n = next((n for n in range(len(words), 0, -1) if " ".join(words[:n]) in known), 1)
        names.append(" ".join(words[:n]))
        words = words[n:]
    return names


def of_effects(effects: Iterable[Effect], units: Units) -> list[dict]:
    """Return the catalogue as plain values; parameters have their units for the likeliest way to act."""
    from types import SimpleNamespace

    from sealfit.closure.result import parameter_unit

    units = replace(units, channels={**units.channels, CHANNEL: "unit of x"})
    listed = []
    for effect in effects:
        ways = [{"target": target, "operation": operation} for target, operation in effect.acts_on]
        target, operation = effect.acts_on[0]
        likeliest = SimpleNamespace(channels=effect.reads, acts_on=target, operation=operation)
        parameters = [
            {"name": p.name, "unit": parameter_unit(p.unit, likeliest, units), "meaning": p.meaning}
            for p in effect.parameters
        ]
        label = effect.label.replace("{x}", "a channel x").replace("{z}", "a channel z")
        named = {"id": effect.id, "label": label, "form": effect.form, "equation": effect.equation}
        named |= {"reads": list(effect.reads), "acts_on": ways, "physical": effect.physical}
        listed.append({**named, "source": effect.source, "parameters": parameters})
    return listed


# ---------------------------------------------------------------- clauses that the report shares

# Words for the levels of closure.json and of table `levels`.
LEVEL_WORDS = {
    "trace": "along strokes", "sample": "along strokes", "stroke": "between strokes",
    "repeat": "between files", "file": "between files", "run": "between runs",
    "set_up": "between set-ups", "condition": "between specimens", "specimen": "between specimens",
}  # fmt: skip
NAMED = 3  # variables whose smallest effect a sentence gives


def outlier_clause(closure: Mapping) -> str:
    """Return which files the loop left out; empty if none."""
    outliers = closure["outlier_files"]
    if not outliers:
        return ""
    sizes = [(one["file"], one["deviation_pct"]) for one in outliers[:NAMED]]
    named = [f"{file} ({size:+.{int(abs(size) < 10)}f} %)" for file, size in sizes]
    more = f" and {len(outliers) - NAMED} more" if len(outliers) > NAMED else ""
    what = "a file whose force is" if len(outliers) == 1 else f"{len(outliers)} files whose force is"
    return f"left out: {what} far off what all others predict: {', '.join(named)}{more}"


def level_words(level: str) -> str:
    """Return a level in words, e.g. "between runs"."""
    return LEVEL_WORDS.get(level, level)


def quality_clause(closure: Mapping) -> str:
    """Return how the error compares with the scatter of repeats, in a clause."""
    quality = closure["fit_quality"]
    if quality["state"] == "unknown":
        if closure["noise_floor_N"] is not None:
            return "the model has too many parameters for these runs to test its lack of fit"
        return "without repeats it is not known whether the error exceeds the scatter"
    if quality["state"] == "within_scatter":
        floor = closure["noise_floor_N"]
        between = any(s["level"] == "specimen" and s["sd_N"] > floor for s in closure["scatter"])
        apart = "apart from differences between specimens, " if between else ""
        return f"{apart}the error is within the scatter of repeats"
    times = f"the error is {quality['ratio']:.2g} times the scatter of repeats"
    if quality["ratio"] < 1:
        times += ", but a part of it is the same in all repeats"
    return f"{times} (lack of fit: p = {quality['p_value']:.1g})"


def power_clause(closure: Mapping, units: Units) -> str:
    """Return the smallest detectable effects of the least sensitive variables, in a clause; or "".

    Variables that show no effect of any size at any level come last, without those of the conditions.
    """
    entries = [(f"{units.label(s['variable'])} {level_words(s['level'])}", s) for s in closure["sensitivity"]]
    sized = [one for one in entries if one[1]["smallest_N"] is not None]
    sized.sort(key=lambda one: -one[1]["smallest_N"])
    texts = [f"{_two_digits(s['smallest_pct'])} % for {name}" for name, s in sized[:NAMED]]
    said = f"the largest detection limits, in percent of the force, are {', '.join(texts)}" if texts else ""
    known = {*AGING_CONDITION, *(s["variable"] for _, s in sized)}
    none = [name for name, s in entries if s["variable"] not in known]
    if none:
        more = f" and {len(none) - NAMED} more" if len(none) > NAMED else ""
        said += f"{'; ' if said else ''}no effect is detectable for {', '.join(none[:NAMED])}{more}"
    return said


def _two_digits(value: float) -> str:
    """Return a number with two significant digits and no exponent: 41, 0.5, 150000."""
    return f"{float(f'{value:.2g}'):.12g}"


def untold_clause(closure: Mapping, units: Units) -> str:
    """Return what the campaign does not decide, and the data it needs, in a clause; empty for none."""
    texts = [
        f"{effect['label']} (too few specimens, or specimens that disagree: test more)"
        for effect in closure["effects"]
        if effect["candidate"]
    ]
    undecided = closure["verdict"] == "cannot_tell"
    texts += [
        f"{item['label']} (p = {item['p_value']:.1g}, "
        f"{'weak evidence: test more' if item['weak'] else 'refused: ' + item['reason']})"
        for item in closure["refused"]
        if item["weak"] or undecided
    ][:NAMED]
    for entry in [s for s in closure["sensitivity"] if s["cannot_tell"]][:NAMED]:
        smallest, files = entry["smallest_pct"], entry["files_needed"]
        size, more = "no effect is detectable", f"; at least {files} files are needed"
        if smallest is not None:
            size = f"detection limit {_two_digits(smallest)} % of the force"
            many = "more than 100 times as many" if smallest > 10 else f"about {_two_digits(files or 0)}"
            more = f"; 1 % needs {many} files"
        variable = f"{units.label(entry['variable'])} {level_words(entry['level'])}"
        if entry["variable"] == "specimen_id":  # it has no level of its own
            variable, size = "differences between specimens", "too few specimens"
        texts.append(f"{variable} ({size}{more if files else ''})")
    return ", ".join(texts)
