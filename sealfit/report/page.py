"""The self-contained report.html: tables, sentences and embedded plots."""

from __future__ import annotations

import json
from base64 import b64encode
from collections.abc import Mapping
from dataclasses import dataclass
from hashlib import sha256
from importlib.resources import files
from pathlib import PurePath

import pandas as pd
from jinja2 import Environment, StrictUndefined
from markupsafe import Markup

from sealfit.config import Config
from sealfit.errors import Fault, examples, grouped, how_many, one_reason
from sealfit.progress import timed
from sealfit.report import page
from sealfit.report.drawing import Drawn, data_uri, draw, run_traces
from sealfit.report.figures import draw_all
from sealfit.report.figures.residual import MOST_CHANNELS
from sealfit.report.loop_tables import (
    channel_tests,
    effect_cards,
    error_rows,
    next_runs,
    references,
    refused_rows,
    scatter_rows,
    sensitivity_rows,
)
from sealfit.report.notation import (
    ConditionNames,
    channel_label,
    count,
    given,
    number,
    symbol_html,
    true_units,
)
from sealfit.report.parameter_tables import break_away_rows, law_rows, parameter_tables
from sealfit.report.style import Plot
from sealfit.report.summary import of_properties
from sealfit.report.summary_lines import LACKING, property_sentences, values_clause
from sealfit.report.words import left_over, undecided, verdict, with_left_channels
from sealfit.tables import SCHEMAS

# ---------------------------------------------------------------- facts
# Campaign, data quality and provenance, as plain values for the page.

MOST_FINDINGS = 400  # listed in the page; quality.parquet has all
MOST_INPUTS = 2000  # listed with their hashes; inputs.parquet has all
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
            "no repeats"
            if high == 1
            else f"{low} repeats per run"
            if low == high
            else f"{low} to {high} repeats per run"
        )
        speed = (
            used["speed_set_mm_s"]
            .where(used["speed_set_mm_s"].notna(), used["speed_mm_s"].abs())
            .astype(float)
        )
        facts.append(f"{units.quantity('speed')} {_range(speed)} {units.unit('speed')}")
        if used["direction"].nunique() > 1:
            facts[-1] += ", both directions"
        if used["load_N"].notna().any():
            facts.append(f"{units.quantity('load')} {_range(used['load_N'], 4)} {units.unit('load')}")
        else:
            force = units.quantity("force")
            what = "forces are" if force == "friction force" else f"{force} is"
            facts.append(f"no load given: {what} fitted instead of coefficients")
    left_out = int((inputs["status"] == "left out").sum()) if len(inputs) else 0
    return [*facts, f"{count(left_out, 'file')} left out"] if left_out else facts


def _range(values: pd.Series, digits: int = 3) -> str:
    low, high = given(float(values.min()), digits), given(float(values.max()), digits)
    return low if low == high else f"{low} to {high}"


def quality_counts(quality: pd.DataFrame) -> list[dict]:
    """Return the number of findings per check, severity and action, the most severe first."""
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
    """Return the findings other than mere information, the most severe first, and the number of rows.

    What many files share is one row with a count and examples.
    """
    if quality.empty:
        return [], 0
    told = quality[(quality["severity"] != "info") | (quality["action"].fillna("kept") != "kept")]
    rank = told["severity"].map({name: k for k, name in enumerate(SEVERITIES)}).fillna(9)
    ordered = told.assign(rank=rank).sort_values("rank", kind="stable").drop(columns="rank").astype(object)
    faults = [_fault(row) for row in ordered.where(ordered.notna(), None).to_dict("records")]
    groups = grouped(faults)
    return [_finding(group, config) for group in groups[:MOST_FINDINGS]], len(groups)


def _fault(row: Mapping) -> Fault:
    texts = {name: row[name] or "" for name in ("check", "reason", "fix", "severity")}
    return Fault(**{**row, **texts, "action": row["action"] or "kept"})


def _finding(group: list[Fault], config: Config) -> dict:
    """Return a row of the list: one finding, or one that many files share, with the places of three."""
    first = group[0]
    row = first.as_dict()
    row |= {name: true_units(row[name], config.units) for name in ("reason", "fix")}
    row["column"] = channel_label(first.column, config.units) if first.column else ""
    row["check"] = first.check.replace("_", " ")
    if len(group) > 1:
        reason = row["reason"] if one_reason(group) else ""
        return {
            **row,
            "reason": reason,
            "file": how_many(group),
            "value": None,
            "place": "; ".join(examples(group)),
        }
    place = f"line {int(first.line)}" if first.line is not None else ""
    if first.stroke is not None:
        place = f"stroke {int(first.stroke)}{', ' + place if place else ''}"
    return {**row, "place": place}


def provenance_facts(provenance: Mapping) -> dict:
    """Return provenance.json with every key that the page reads."""
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
        "name": provenance.get("table") or PurePath(campaign).name or campaign,
        "config_name": config.get("name", ""),
        "config_path": config.get("path"),
        "config_text": config.get("text", ""),
        "inputs": inputs,
        "inputs_in_all": len(every),
        "steps": steps,
        "bytes": sum(entry.get("size") or 0 for entry in every),
    }


def complete(tables: Mapping[str, pd.DataFrame], names: tuple[str, ...]) -> dict[str, pd.DataFrame]:
    """Return every table of `names`; an empty one with its columns replaces a missing one."""
    found = {}
    for name in names:
        frame = tables.get(name)
        if frame is None or not len(frame):
            frame = pd.DataFrame(
                {c.name: pd.Series(dtype=c.dtype.to_pandas_dtype()) for c in SCHEMAS[name].columns}
            )
        found[name] = frame
    return found


# ---------------------------------------------------------------- page

TABLES = (
    "inputs", "runs", "quality", "traces_mean", "steady", "steady_fit", "aging_fit", "aging_curves",
    "aging_laws", "property_values", "master_curve", "dynamic_fit", "dynamic_curves", "effects",
    "residuals_before", "residuals_after", "levels", "channels", "shapes", "curves",
)  # fmt: skip
FITS = (
    "steady_fit",
    "aging_fit",
    "aging_curves",
    "aging_laws",
    "master_curve",
    "dynamic_fit",
    "dynamic_curves",
)
BEFORE = "{}_before"  # name of such a table without the loop's effects
VERDICTS = {
    "closed": "Closed",
    "nothing_missing": "Nothing missing",
    "unexplained": "Unexplained",
    "cannot_tell": "Cannot tell",
    None: "Loop not run",
}


@dataclass(frozen=True)
class Report:
    """The page, and its plots by name."""

    html: str
    figures: dict[str, Drawn]


def build_report(
    tables: Mapping[str, pd.DataFrame],
    closure: Mapping | None,
    provenance: Mapping,
    config: Config,
) -> Report:
    """Return the report of one campaign.

    Parameters
    ----------
    tables : mapping of str to DataFrame
        Tables of OUT by name, as in `sealfit.tables`; they may be missing or empty.
    closure : mapping or None
        closure.json, or None where the loop was not run.
    provenance : mapping
        provenance.json.
    config : Config
        Names the conditions and gives every quantity its true unit.

    Returns
    -------
    Report
        The page loads nothing. Figures are drawn once; the page shows their panels.
    """
    content = _content(*answered(tables, closure), provenance, config)
    tables, closure = to_draw(tables, closure)
    if len(tables["property_values"]):
        content |= _of_properties(tables)
    plots = draw_all(tables, closure, config)
    with timed("plots", rows=len(plots), of="plots"):
        figures = {name: draw(plot) for name, plot in plots.items()}
    images = {name: _images(plot, figures[name]) for name, plot in plots.items()}
    # "<" is escaped, as a name could otherwise end the script.
    runs = json.dumps(run_traces(tables, config), separators=(",", ":")).replace("<", "\\u003c")
    html = _environment().from_string(_text("template.html")).render(
        style=Markup(_text("style.css")), script=Markup(_text("report.js")), plots=images, runs=Markup(runs),
        script_hash=b64encode(sha256(_text("report.js").encode()).digest()).decode(), **content
    )  # fmt: skip
    return Report(html, figures)


def property_means(values: pd.DataFrame) -> pd.DataFrame:
    """Return the means of properties per condition as rows of table `steady_fit`, for the plot of the law.

    Parameters
    ----------
    values : DataFrame
        Table `property_values`.
    """
    from sealfit.fit.aging.property import means_of

    parts = []
    for (rubber, quantity), own in values.groupby(["rubber", "quantity"]):
        means = means_of(own)
        half = means.half_width()
        value = means.table["value"]
        kept = means.table[["condition", "series", "value"]]
        parts.append(
            kept.assign(
                rubber=rubber, quantity="steady", parameter=quantity, identified=True,
                lo95=value - half, hi95=value + half,
            )
        )  # fmt: skip
    return pd.concat(parts, ignore_index=True)


def _of_properties(tables: Mapping[str, pd.DataFrame]) -> dict:
    """Return what the page says of properties in place of the campaign and the loop."""
    properties = of_properties(*(tables[name] for name in ("property_values", "aging_fit", "aging_laws")))
    known = [p for one in properties if (p := one["lack_of_fit_p"]) is not None]
    fits = not known or min(known) >= LACKING
    return {
        "of_properties": True,
        "badge": "Fit: not known" if not known else "The law fits" if fits else "The law does not fit",
        "verdict": " ".join(map(property_sentences, properties)),
        "facts": [f"{one['quantity']}: {values_clause(one)}" for one in properties],
    }


def to_draw(
    tables: Mapping[str, pd.DataFrame], closure: Mapping | None
) -> tuple[dict[str, pd.DataFrame], Mapping | None]:
    """Return tables and closure.json as the figures use them, properties as the means of conditions."""
    tables, closure = answered(tables, closure)
    if len(tables["property_values"]):
        tables["steady_fit"] = property_means(tables["property_values"])
    return tables, closure


def answered(
    tables: Mapping[str, pd.DataFrame], closure: Mapping | None
) -> tuple[dict[str, pd.DataFrame], Mapping | None]:
    """Return tables and closure.json as the page uses them; see `with_after_fits`."""
    tables = with_after_fits(tables)
    if closure is not None:
        closure = with_left_channels(closure, set(tables["channels"]["channel"].dropna()))
    return tables, closure


def with_after_fits(tables: Mapping[str, pd.DataFrame]) -> dict[str, pd.DataFrame]:
    """Return the report's tables, with the fits after the loop in place of those before it, if there are any.

    Those before then have the suffix `_before`.
    """
    complete = page.complete(tables, TABLES)
    if not len(tables.get("steady_fit_after", ())):
        return complete
    before = {BEFORE.format(name): complete[name] for name in FITS}
    after = page.complete({name: tables[f"{name}_after"] for name in FITS}, FITS)
    return {**complete, **after, **before}


def _content(
    tables: Mapping[str, pd.DataFrame],
    closure: Mapping | None,
    provenance: Mapping,
    config: Config,
) -> dict:
    before = {name: tables.get(BEFORE.format(name)) for name in FITS}
    fitted = parameter_tables(tables["steady_fit"], "condition", config, before["steady_fit"])
    fitted += parameter_tables(tables["aging_fit"], "series", config, before["aging_fit"])
    dynamic = tables["dynamic_fit"]
    fitted += parameter_tables(
        dynamic[dynamic["quantity"] == "dynamic"], "condition", config, before["dynamic_fit"]
    )
    break_aways, break_aways_in_all = break_away_rows(dynamic, config)
    findings, in_all = page.quality_findings(tables["quality"], config)
    return {
        "of_properties": False,
        "closure": closure,
        "badge": VERDICTS[closure["verdict"] if closure else None],
        "fit": fit_badge(closure),
        "verdict": verdict(closure, tables["shapes"], config),
        "undecided": undecided(closure, config),
        "facts": page.campaign_facts(tables, config),
        "errors": error_rows(closure, config) if closure else [],
        "cards": effect_cards(closure, config) if closure else [],
        "scatter": scatter_rows(closure, config) if closure else [],
        "sensitivity": sensitivity_rows(closure, config) if closure else [],
        "refused": refused_rows(closure, config) if closure else [],
        "left": left_over(closure, config) if closure else "",
        "next_runs": next_runs(closure, config) if closure else [],
        "tests": channel_tests(tables["levels"], tables["channels"]["channel"].dropna(), config),
        "more_channels": max(0, tables["channels"]["channel"].nunique() - MOST_CHANNELS),
        "parameter_tables": sorted(fitted, key=lambda table: table.single),  # goodness of fit comes last
        "aging_fitted": len(tables["aging_fit"]) > 0,
        "aging": config.aging,
        "laws": law_rows(tables["aging_laws"], before["aging_laws"]),
        "references": references(closure, config) if before["steady_fit"] is not None else [],
        "break_aways": break_aways,
        "break_aways_in_all": break_aways_in_all,
        "condition_key": ConditionNames.of(config).key,
        "sensor": config.sensor,
        "unit": config.units.unit("force"),
        "speed_unit": config.units.unit("speed"),
        "force": config.units.quantity("force"),
        "counts": page.quality_counts(tables["quality"]),
        "findings": findings,
        "findings_in_all": in_all,
        "provenance": page.provenance_facts(provenance),
    }


def fit_badge(closure: Mapping | None) -> tuple[str, str]:
    """Return how well the model fits: the state, and a few words; both empty if the loop was not run."""
    quality = (closure or {}).get("fit_quality") or {"state": ""}
    words = {
        "": "",
        "unknown": "Fit: not known",
        "within_scatter": "Fit: within the scatter of repeats",
        "above_scatter": f"Fit: {quality.get('ratio') or 0:.2g} times the scatter of repeats",
    }
    return quality["state"], words[quality["state"]]


def _images(plot: Plot, drawn: Drawn) -> dict:
    """Return a plot for the template: every panel a separate image."""
    panels = [
        {
            "src": data_uri(image.svg),
            "alt": panel.alt,
            "effect": panel.effect,
            "width": image.width,
            "height": image.height,
        }
        for panel, image in zip(plot.panels, drawn.panels, strict=True)
    ]
    legend = [
        {"label": symbol_html(key.label) if key.symbol else key.label, "colour": key.colour, "mark": key.mark}
        for key in plot.legend
    ]
    return {"title": plot.title, "panels": panels, "legend": legend, "note": plot.note}


def _environment() -> Environment:
    environment = Environment(autoescape=True, undefined=StrictUndefined)
    environment.globals |= {"count": count, "number": number, "given": given}
    return environment


def _text(name: str) -> str:
    return files("sealfit.report").joinpath(name).read_text("utf-8")
