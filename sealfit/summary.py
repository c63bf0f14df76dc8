"""What a command ends with: the main figures as plain values (for --json), and the same in a few lines."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

from sealfit.tables import Units
from sealfit.verdict import predicts_worse

if TYPE_CHECKING:
    import pandas as pd

    from sealfit.effects.contract import Effect
    from sealfit.store import Store

NOT_PARAMETERS = ("statistics", "covariance", "sensor_shift")  # `quantity` of rows about the fit itself

OF_INGEST = {  # columns that its summary counts
    "inputs": ["status"],
    "runs": ["used", "run_id"],
    "quality": ["action", "severity"],
    "steady": ["condition"],
}
EFFECT_KEYS = ("id", "label", "form", "acts_on", "operation", "channels", "named", "candidate", "parameters")


# ---------------------------------------------------------------- plain values
def of_steps(store: Store, steps: Iterable[str]) -> dict:
    """Return the summaries of `steps`, all of them current."""
    make = {
        "ingest": lambda: of_ingest({name: store.read(name, columns) for name, columns in OF_INGEST.items()}),
        "fit-steady": lambda: of_fit(store.read("steady_fit"), "condition"),
        "fit-aging": lambda: of_fit(store.read("aging_fit"), "series"),
        "fit-dynamic": lambda: of_dynamic(store.read("dynamic_fit")),
        "close-loop": lambda: of_closure(store.read_json("closure"), store.config.units),
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
        "faults": {severity: int((quality["severity"] == severity).sum()) for severity in ("error", "warning")},
        "runs": int(runs["run_id"].nunique()),
        "conditions": int(steady["condition"].nunique()),
    }


def of_fit(fit: pd.DataFrame, of: str) -> dict:
    """Return the range of every parameter over the conditions or series of `fit` in which it is identified."""
    rows = fit[~fit["quantity"].isin(NOT_PARAMETERS)]
    ranges = []
    for (quantity, parameter, unit), group in rows.groupby(["quantity", "parameter", "unit"], sort=False, dropna=False):
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
                "reason": str(why.iloc[0]) if len(why) else "",  # the commonest why not
            }
        )
    return {of: int(fit[of].nunique()), "parameters": ranges}


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
    """Return the verdict, the errors before and after, the effects and what is left."""
    kept = ("verdict", "units", "noise_floor_N", "before", "after", "heldout_unit", "left", "next_runs")
    effects = [{key: effect[key] for key in EFFECT_KEYS} for effect in closure["effects"]]
    return {**{key: closure[key] for key in kept}, "sentence": verdict_sentence(closure, units), "effects": effects}


def verdict_sentence(closure: Mapping, units: Units) -> str:
    """Return the verdict in one sentence."""
    count = sum(not effect["candidate"] for effect in closure["effects"])
    added = {0: "no effect was added", 1: "one effect was missing and is added"}.get(
        count, f"{count} effects were missing and are added"
    )
    if closure["verdict"] == "nothing_missing":
        return "the declared model explains these measurements down to their own scatter"
    if closure["verdict"] == "closed":
        return f"{added}; no significant structure is left"
    if predicts_worse(closure) and not closure["left"]["channel"]:
        after, before = (closure[name]["heldout_rmse_N"] for name in ("after", "before"))
        them, change = "it" if count == 1 else "them", f"{before:.3g} -> {after:.3g} {units.unit('force')}"
        return f"{added}, but what is held out is predicted worse with {them} ({change}): do not predict with {them}"
    return f"{added}, and something is left that could not be named{_where(closure['left'], units)}"


def _where(left: Mapping, units: Units) -> str:
    where = f", at the level of the {left['level']}" if left["level"] else ""
    along = f", along {units.label(left['channel'])}" if left["channel"] else ""
    return where + along + (f" (p = {left['p_value']:.2g})" if left["p_value"] is not None else "")


def of_effects(effects: Iterable[Effect], units: Units) -> list[dict]:
    """Return the catalogue as plain values; parameters have their units for the likeliest way to act."""
    from types import SimpleNamespace

    from sealfit.closure.document import parameter_unit
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
                "acts_on": [{"target": target, "operation": operation} for target, operation in effect.acts_on],
                "physical": effect.physical,
                "source": effect.source,
                "parameters": [
                    {"name": p.name, "unit": parameter_unit(p.unit, likeliest, units), "meaning": p.meaning}
                    for p in effect.parameters
                ],
            }
        )
    return listed


# ---------------------------------------------------------------- the same in lines
def lines(summary: Mapping) -> list[str]:
    """Return the summary of one step or of all of them, a line for each thing worth knowing."""
    writers = {
        "ingest": ingest_lines,
        "fit_steady": lambda part: _fit_lines("steady fit", part),
        "fit_aging": lambda part: _fit_lines("aging", part),
        "fit_dynamic": dynamic_lines,
        "close_loop": closure_lines,
        "report": lambda part: [line("report", part["file"])],
    }
    return [line for name, write in writers.items() if name in summary for line in write(summary[name])]


def ingest_lines(part: Mapping) -> list[str]:
    """Return the lines of an ingest."""
    files, faults = part["files"], part["faults"]
    text = f"{files['used']} used, {files['left_out']} left out"
    if files["not_matched"]:
        text += f", {files['not_matched']} not matched by the file-name pattern"
    found = [line("files", text)]
    left_out = [_count(part[f"{what}s_left_out"], what) for what in ("stroke", "row") if part[f"{what}s_left_out"]]
    if sum(faults.values()):
        text = f"{_count(faults['error'], 'error')}, {_count(faults['warning'], 'warning')}"
        more = f"; left out: {', '.join(left_out)}" if left_out else ""
        found.append(line("faults", f"{text}{more} (table quality)"))
    found.append(line("conditions", f"{part['conditions']} in {_count(part['runs'], 'run')}"))
    return found


def _fit_lines(title: str, part: Mapping) -> list[str]:
    ranges = part["parameters"]
    if not ranges:
        return [line(title, "nothing to fit")]
    quantities = list(dict.fromkeys(entry["quantity"] for entry in ranges))
    found = []
    for quantity in quantities:
        texts = [_range(entry) for entry in ranges if entry["quantity"] == quantity]
        name = "" if len(quantities) == 1 else f"{quantity}: "
        found.append(line(title if not found else "", name + ", ".join(texts)))
    lacking = [entry for entry in ranges if entry["identified"] < entry["of"]]
    if lacking:
        names = [f"{e['quantity']} {e['parameter']}" if len(quantities) > 1 else e["parameter"] for e in lacking]
        texts = [
            f"{name} in {entry['of'] - entry['identified']} of {entry['of']}" if entry["of"] > 1 else name
            for name, entry in zip(names, lacking, strict=True)
        ]
        reason = next((entry["reason"] for entry in lacking if entry["reason"]), "")
        found.append(line("", f"not identified: {', '.join(texts)}. {reason}".rstrip()))
    return found


def dynamic_lines(part: Mapping) -> list[str]:
    """Return the lines of the dynamic fit."""
    found = _fit_lines("pre-sliding", part)
    if part["above_sliding"]:
        more = f"{part['largest_ratio'] - 1:.1%} at most, {part['largest_at']}"
        text = f"above the sliding force in {part['above_sliding']} of {part['break_aways']} cases of condition, speed "
        text += f"and direction ({more})"
        found.append(line("break-away", text))
    return found


def _range(entry: Mapping) -> str:
    unit = f" {entry['unit']}" if entry["unit"] else ""
    if entry["min"] is None:
        return f"{entry['parameter']} not identified"
    if entry["min"] == entry["max"]:
        return f"{entry['parameter']} {entry['min']:.4g}{unit}"
    return f"{entry['parameter']} {entry['min']:.4g} to {entry['max']:.4g}{unit}"


def closure_lines(part: Mapping) -> list[str]:
    """Return the lines of a closed loop."""
    unit, before, after = part["units"]["force_N"], part["before"], part["after"]
    found = [line("verdict", f"{part['verdict']}: {part['sentence']}")]
    for effect in part["effects"]:
        status = "candidate, not applied: " if effect["candidate"] else "+ "
        known = [p for p in effect["parameters"] if p["value"] is not None or p["name"] != "phi"]
        values = ", ".join(_value(p) for p in known) if effect["named"] else "no form does as well"
        found.append(line("", f"{status}{effect['label']}: {values}"))
    rows = (("rmse", "rmse_N"), ("held out", "heldout_rmse_N"), ("run means", "rmse_runs_N"), ("largest", "max_abs_N"))
    texts = [f"{name} {_number(before[key])} -> {_number(after[key])}" for name, key in rows]
    found.append(line(f"error ({unit})", "; ".join(texts)))
    if part["noise_floor_N"] is not None:
        found.append(line("noise floor", f"{_number(part['noise_floor_N'])} {unit}"))
    if part["left"]["channel"] is not None:
        found.append(line("left", _left(part["left"], part["verdict"], unit)))
    for run in part["next_runs"][:3]:
        found.append(line("next runs", run["why"]))
    return found


def _left(left: Mapping, verdict: str, unit: str) -> str:
    """Return what is left: how much above the floor, along which channels, and whether chance could have made it."""
    above = f"rmse {_number(left['rmse_N'])} {unit} above the floor, " if left["rmse_N"] else ""
    sure = "" if verdict == "unexplained" else ": no claim, a place to look"
    return f"{above}along {left['channel']} (p {left['p_value']:.2g}){sure}"


def _value(parameter: Mapping) -> str:
    unit = f" {parameter['unit']}" if parameter["unit"] else ""
    return f"{parameter['name']} {_number(parameter['value'])}{unit}"


def _acts(effect: Mapping) -> str:
    how = {"add": "added to", "multiply": "a factor on"}[effect["operation"]]
    return f"{how} {'the force' if effect['acts_on'] == 'force' else effect['acts_on']}"


def effects_lines(listed: Mapping) -> list[str]:
    """Return the catalogue, an effect after the other."""
    found = []
    for effect in listed["effects"]:
        mark = "  [in the model of this OUT]" if effect["id"] in (listed.get("added") or ()) else ""
        found.append(f"{effect['id']}: {effect['label']}{mark}")
        acts = ", ".join(_acts({**way, "acts_on": way["target"]}) for way in effect["acts_on"])
        found.append(f"    {effect['form']}")
        found.append(f"    {acts}")
        for p in effect["parameters"]:
            found.append(f"    {p['name']}{' [' + p['unit'] + ']' if p['unit'] else ''}: {p['meaning']}")
    if listed.get("added", ()) is None:
        found.append("The loop of this OUT is not closed, or stale: which effects it added is not known.")
    return found


def predict_lines(part: Mapping) -> list[str]:
    """Return the lines of a prediction."""
    text = f"{part['answered']} of {_count(part['rows'], 'row')} answered, {part['extrapolated']} extrapolated"
    refused = part["rows"] - part["answered"]
    if refused:
        text += f"; {_count(refused, 'row')} could not be, and the column note says why"
    return [line("points", text), line("answers", part["output"])]


def line(title: str, text: str) -> str:
    """Return a line of a summary under its title."""
    return f"{title:<11} {text}"


def _count(number: int, what: str) -> str:
    return f"{number} {what}{'' if number == 1 else 's'}"


def _number(value: float | None) -> str:
    return "unknown" if value is None else f"{value:.3g}"
