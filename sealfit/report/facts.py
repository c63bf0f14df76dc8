"""Facts about the campaign, its quality and its provenance, as plain values for the page."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import PurePath

import pandas as pd

from sealfit.config import Config
from sealfit.report.numbers import count, given
from sealfit.report.symbols import channel_label, true_units
from sealfit.tables import SCHEMAS

MOST_FINDINGS = 400  # listed in the page; all of them stand in quality.parquet
MOST_INPUTS = 2000  # listed with their hashes; all of them stand in inputs.parquet
SEVERITIES = ("error", "warning", "info")


def campaign_facts(tables: Mapping[str, pd.DataFrame], config: Config) -> list[str]:
    """Return the campaign in a few short phrases: files, runs, conditions, speeds, load."""
    steady, inputs, units = tables["steady"], tables["inputs"], config.units
    used = steady[steady["used"].astype(bool)] if len(steady) else steady
    facts = [count(used["file"].nunique(), "file"), count(used["run_id"].nunique(), "run")]
    facts.append(count(used["condition"].nunique(), "condition"))
    if len(used):
        repeats = used.groupby("run_id")["file"].nunique()
        low, high = int(repeats.min()), int(repeats.max())
        facts.append(
            "no repeats" if high == 1 else f"{low} repeats a run" if low == high else f"{low} to {high} repeats a run"
        )
        speed = used["speed_set_mm_s"].where(used["speed_set_mm_s"].notna(), used["speed_mm_s"].abs()).astype(float)
        facts.append(f"{units.quantity('speed')} {_range(speed)} {units.unit('speed')}")
        if used["direction"].nunique() > 1:
            facts[-1] += ", both ways"
        if used["load_N"].notna().any():
            facts.append(f"{units.quantity('load')} {_range(used['load_N'], 4)} {units.unit('load')}")
        else:
            force = units.quantity("force")
            what = "forces are" if force == "friction force" else f"{force} is"
            facts.append(f"no load given: {what} fitted in place of coefficients")
    left_out = int((inputs["status"] == "left out").sum()) if len(inputs) else 0
    return [*facts, f"{count(left_out, 'file')} left out"] if left_out else facts


def _range(values: pd.Series, digits: int = 3) -> str:
    low, high = given(float(values.min()), digits), given(float(values.max()), digits)
    return low if low == high else f"{low} to {high}"


def quality_counts(quality: pd.DataFrame) -> list[dict]:
    """Return how many findings there are of each check, severity and action, the worst first."""
    if quality.empty:
        return []
    keys = quality[["check", "severity", "action"]].fillna("").astype(str)
    grouped = keys.assign(file=quality["file"]).groupby(["check", "severity", "action"], sort=False)["file"]
    rows = [
        {
            "check": check.replace("_", " "),
            "severity": severity,
            "action": action,
            "findings": len(files),
            "files": files.nunique(),
        }
        for (check, severity, action), files in grouped
    ]
    rank = {name: k for k, name in enumerate(SEVERITIES)}
    return sorted(rows, key=lambda row: (rank.get(row["severity"], 9), -row["findings"], row["check"]))


def quality_findings(quality: pd.DataFrame, config: Config) -> tuple[list[dict], int]:
    """Return the findings worth listing (all but what is only said), the worst first, and how many there are in all."""
    if quality.empty:
        return [], 0
    effective_df = quality[(quality["severity"] != "info") | (quality["action"].fillna("kept") != "kept")]
    rank = effective_df["severity"].map({name: k for k, name in enumerate(SEVERITIES)}).fillna(9)
    effective_df = effective_df.assign(rank=rank).sort_values("rank", kind="stable").drop(columns="rank")
    shown = effective_df.head(MOST_FINDINGS).astype(object)
    rows = []
    for row in shown.where(shown.notna(), None).to_dict("records"):
        place = f"line {int(row['line'])}" if row["line"] is not None else ""
        if row["stroke"] is not None:
            place = f"stroke {int(row['stroke'])}{', ' + place if place else ''}"
        texts = {name: true_units(row[name] or "", config.units) for name in ("reason", "fix")}
        column = channel_label(row["column"], config.units) if row["column"] else ""
        rows.append({**row, **texts, "place": place, "column": column, "check": (row["check"] or "").replace("_", " ")})
    return rows, len(effective_df)


def provenance_facts(provenance: Mapping) -> dict:
    """Return provenance.json with every key that the page reads, in a form fit to print."""
    config = provenance.get("config") or {}
    campaign = str(provenance.get("campaign") or "")
    every = provenance.get("inputs") or []
    inputs = [
        {"file": entry.get("file", ""), "size": entry.get("size"), "sha256": entry.get("sha256") or ""}
        for entry in every[:MOST_INPUTS]
    ]
    steps = [
        {**step, "finished_at": str(step.get("finished_at", "")).replace("T", " ").replace("+00:00", " UTC")}
        for step in provenance.get("steps") or []
    ]
    return {
        "version": provenance.get("version", ""),
        "python": provenance.get("python", ""),
        "system": provenance.get("system", ""),
        "packages": dict(provenance.get("packages") or {}),
        "campaign": campaign,
        "name": PurePath(campaign).name or campaign,
        "config_name": config.get("name", ""),
        "config_path": config.get("path"),
        "config_text": config.get("text", ""),
        "inputs": inputs,
        "inputs_in_all": len(every),
        "steps": steps,
        "bytes": sum(entry.get("size") or 0 for entry in every),
    }


def complete(tables: Mapping[str, pd.DataFrame], names: tuple[str, ...]) -> dict[str, pd.DataFrame]:
    """Return every table of `names`; one without rows, with its columns, in place of one that is missing."""
    found = {}
    for name in names:
        frame = tables.get(name)
        if frame is None or not len(frame):
            frame = pd.DataFrame({c.name: pd.Series(dtype=c.dtype.to_pandas_dtype()) for c in SCHEMAS[name].columns})
        found[name] = frame
    return found
