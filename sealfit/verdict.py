"""Clauses that the summary and the report share: fit quality beside the verdict, and what could have been seen."""

from __future__ import annotations

from collections.abc import Mapping

from sealfit.units import Units

WITHIN = {
    "trace": "along a stroke", "stroke": "from stroke to stroke", "repeat": "from repeat to repeat",
    "run": "from run to run", "condition": "from specimen to specimen",
}  # fmt: skip
"""Words for the level at which a variable varies."""

NAMED = 3
"""Variables whose smallest effect a sentence gives."""


def quality_clause(closure: Mapping) -> str:
    """Return how the error compares with the scatter of repeats, in a clause."""
    quality = closure.get("fit_quality") or {"state": "unknown"}
    if quality["state"] == "unknown":
        return "whether the error is only scatter is not known without repeats"
    if quality["state"] == "within_scatter":
        return "the error is within the scatter of repeats"
    times, p_value = quality["ratio"], quality["p_value"]
    return f"the error is {times:.2g} times the scatter of repeats (lack of fit p = {p_value:.1g})"


def power_clause(closure: Mapping, units: Units) -> str:
    """Return the smallest effects that the campaign would have found, in a clause; empty where nothing is known."""
    known = [s for s in closure.get("sensitivity") or () if s["smallest_N"] is not None]
    if not known:
        return ""
    largest = sorted(known, key=lambda s: -s["smallest_N"])[:NAMED]
    texts = [f"{units.label(s['variable'])} {WITHIN[s['level']]} {s['smallest_pct']:.2g} %" for s in largest]
    return f"the least sensitive variables would have shown an effect of {', '.join(texts)} of the force"


def untold_clause(closure: Mapping, units: Units) -> str:
    """Return which variables the campaign could not tell of, and what would do, in a clause; empty for none."""
    texts = [
        f"{effect['label']} (shown by too few specimens, or differently: test more)"
        for effect in closure["effects"]
        if effect["candidate"]
    ]
    texts += [
        f"{item['label']} (p = {item['p_value']:.1g}, too weak to claim it: test more)"
        for item in closure.get("refused") or ()
        if item["weak"]
    ][:NAMED]
    for entry in [s for s in closure.get("sensitivity") or () if s["cannot_tell"]][:NAMED]:
        name, smallest, files = entry["variable"], entry["smallest_pct"], entry["files_needed"]
        size = "no effect" if smallest is None else f"no effect below {smallest:.2g} % of the force"
        more = f"; about {files} files like these would show one of 1 %" if files and smallest is not None else ""
        more = f"; at least {files} files are needed" if files and smallest is None else more
        texts.append(f"{units.label(name)} ({size} could be seen{more})")
    return ", ".join(texts)
