"""The self-contained report.html: tables, sentences and embedded plots."""

import json
import math
from base64 import b64encode
from collections.abc import Mapping
from dataclasses import dataclass
from hashlib import sha256
from importlib.resources import files
from pathlib import PurePath

import numpy as np
import pandas as pd
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup, escape

from sealfit.config import Config
from sealfit.errors import Fault, examples, grouped, how_many, one_reason
from sealfit.progress import timed
from sealfit.report import notation, parameter_tables, words
from sealfit.report.drawing import Tables, draw, inline
from sealfit.report.figures import draw_all
from sealfit.report.figures.residual import MOST_CHANNELS
from sealfit.report.notation import ConditionNames, capital, channel_label, count, given, plain, true_units
from sealfit.report.summary import of_properties, of_specimens
from sealfit.report.summary_lines import (
    LACKING,
    PER_SERIES,
    property_sentences,
    specimens_clause,
    values_clause,
)
from sealfit.tables import FITTED, SCHEMAS

MOST_FINDINGS = 400  # listed in the page; quality.parquet has all
MOST_INPUTS = 2000  # listed with their hashes; inputs.parquet has all
MOST_BINS = 30_000  # of all runs that a page has, about 1 MB; of more, every second, third ... is left
LARGEST_STEP = 5  # traces of which fewer than every fifth bin would be left are not in the page
RANK = {"error": 0, "warning": 1, "info": 2}  # of a severity, in the order of the page
TEMPLATES = Environment(autoescape=True, undefined=StrictUndefined, loader=PackageLoader("sealfit", "report"))


def campaign_facts(tables: Tables, config: Config) -> list[str]:
    """Return the campaign in a few short phrases: files, runs, conditions, speeds, load."""
    steady, inputs, units = tables["steady"], tables["inputs"], config.units
    used = steady[steady["used"].astype(bool)]
    columns = {"file": "file", "run_id": "run", "condition": "condition"}
    facts = [count(used[column].nunique(), what) for column, what in columns.items()]
    if len(used):
        repeats = used.groupby("run_id")["file"].nunique()
        facts.append("no repeats" if repeats.max() == 1 else f"{_range(repeats)} repeats per run")
        speed = used["speed_set_mm_s"].fillna(used["speed_mm_s"].abs()).astype(float)
        both = ", both directions" if used["direction"].nunique() > 1 else ""
        facts.append(f"{units.quantity('speed')} {_range(speed)} {units.unit('speed')}{both}")
        if used["load_N"].notna().any():
            facts.append(f"{units.quantity('load')} {_range(used['load_N'], 4)} {units.unit('load')}")
        else:
            force = units.quantity("force")
            what = "forces are" if force == "friction force" else f"{force} is"
            facts.append(f"no load given: {what} fitted instead of coefficients")
    left_out = int((inputs["status"] == "left out").sum())
    return [*facts, f"{count(left_out, 'file')} left out"] if left_out else facts


def _range(values: pd.Series, digits: int = 3) -> str:
    low, high = given(float(values.min()), digits), given(float(values.max()), digits)
    return low if low == high else f"{low} to {high}"


def quality_counts(quality: pd.DataFrame) -> list[dict]:
    """Return the number of findings per check, severity and action, the most severe first."""
    names = ["check", "severity", "action"]
    keys = quality[names].fillna("").astype(str)
    keys["check"] = keys["check"].str.replace("_", " ")
    found = keys.assign(file=quality["file"]).groupby(names, sort=False)["file"]
    rows = found.agg(findings="size", files="nunique").reset_index().to_dict("records")
    return sorted(rows, key=lambda row: (RANK.get(row["severity"], 9), -row["findings"], row["check"]))


def quality_findings(quality: pd.DataFrame, config: Config) -> tuple[list[dict], int]:
    """Return the findings, the most severe first, one row for what many files share; and their number."""
    told = quality[(quality["severity"] != "info") | (quality["action"].fillna("kept") != "kept")]
    told = told.sort_values("severity", key=lambda names: names.map(RANK).fillna(9), kind="stable")
    groups = grouped(Fault.of_row(row) for row in told.to_dict("records"))
    return [_finding(group, config) for group in groups[:MOST_FINDINGS]], len(groups)


def _finding(group: list[Fault], config: Config) -> dict:
    """Return a row of the list: one finding, or one that many files share, with the places of three."""
    first = group[0]
    row = first.as_dict()
    row |= {name: true_units(row[name], config.units) for name in ("reason", "fix")}
    row["column"] = channel_label(first.column, config.units) if first.column else ""
    row["check"] = first.check.replace("_", " ")
    if len(group) == 1:
        places = [f"{what} {row[what]}" for what in ("stroke", "line") if row[what] is not None]
        return {**row, "place": ", ".join(places)}
    row |= {"file": how_many(group), "value": None, "place": "; ".join(examples(group))}
    return row if one_reason(group) else {**row, "reason": ""}


def name_of(provenance: Mapping, config: Config) -> str:
    """Return what the page is called: the config's name, or that of the table or the folder."""
    own = config.name if config.name != Config().name else ""
    campaign = provenance["campaign"]
    return own or provenance["table"] or PurePath(campaign).name or campaign


@dataclass(frozen=True)
class Report:
    """The page, and its plots by name and format."""

    html: str
    figures: dict[str, dict[str, str | bytes]]


def build_report(tables: Tables, closure: Mapping | None, provenance: Mapping, config: Config) -> Report:
    """Return the report of one campaign.

    `tables` are those of OUT by name, which may be missing or empty; `closure` and `provenance` are its JSON
    files, `closure` None of properties. The page loads nothing.
    """
    tables, closure = answered(tables, closure)
    opening = _of_properties(tables) if closure is None else _of_loop(tables, closure, config)
    plots = draw_all(tables, closure, config)
    with timed("plots", rows=len(plots), of="plots"):
        figures = {name: draw(plot) for name, plot in plots.items()}
    images = {}
    for name, plot in plots.items():
        alt = f"{plot.title}: {' '.join(panel.alt for panel in plot.panels)}"
        images[name] = inline(figures[name]["svg"], name, alt)
    # "<" is escaped, as a name could otherwise end the script.
    runs = json.dumps(run_traces(tables, config), separators=(",", ":")).replace("<", "\\u003c")
    html = TEMPLATES.get_template("template.html").render(
        tables=tables,
        closure=closure,
        provenance=provenance,
        config=config,
        units=config.units,
        unit=config.units.unit("force"),
        force=config.units.quantity("force"),
        name=name_of(provenance, config),
        names=ConditionNames(config),
        plots=plots,
        images=images,
        runs=Markup(runs),
        fitted=_fitted(tables, config),
        specimens=specimens_clause(of_specimens(tables["steady_fit"])),
        **opening,
    )
    return Report(html, figures)


def _of_properties(tables: Tables) -> dict:
    """Return the head of the page of properties."""
    properties = of_properties(tables["property_values"], tables["aging_fit"], tables["aging_laws"])
    known = [p for one in properties if (p := one["lack_of_fit_p"]) is not None]
    fits = not known or min(known) >= LACKING
    return {
        "of_properties": True,
        "badge": "Fit: not known" if not known else "The law fits" if fits else "The law does not fit",
        "tone": "" if not known else "within_scatter" if fits else "above_scatter",
        "fit": ("", ""),
        "verdict": Markup(" ").join(map(_of_property, properties)),
        "facts": [f"{one['quantity']}: {values_clause(one)}" for one in properties],
        "references": [],
        "left_out": False,
    }


def _of_property(one: Mapping) -> Markup:
    """Return the sentences of a property, with the equations of its laws and the energy as symbols."""
    said = escape(property_sentences(one))
    for law in sorted({PER_SERIES, one["law"]["form"] if one["law"] else PER_SERIES}, key=len, reverse=True):
        said = said.replace(escape(law), words.with_symbols(law, formula=True))
    return said.replace(", E ", Markup(", <i>E</i>&nbsp;"))


def answered(tables: Tables, closure: Mapping | None) -> tuple[Tables, Mapping | None]:
    """Return tables and closure.json as the page uses them; see `with_after_fits`."""
    tables = with_after_fits(tables)
    if closure is not None and len(tables["steady"]) and tables["steady"]["load_N"].isna().all():
        closure = words.without_load(closure)
    return tables, closure


def with_after_fits(tables: Tables) -> Tables:
    """Return all tables, with the fits after the loop in place of those before it, if there are any.

    Those before then have the suffix `_before`. A missing table is an empty one with its columns.
    """
    found = {name: tables[name] for name in SCHEMAS if len(tables.get(name, ()))}
    for name in SCHEMAS.keys() - found.keys():
        columns = SCHEMAS[name].columns
        found[name] = pd.DataFrame({c.name: pd.Series(dtype=c.dtype.to_pandas_dtype()) for c in columns})
    if len(found["steady_fit_after"]):
        for name in (fit.name for fit in FITTED):
            found[f"{name}_before"], found[name] = found[name], found[f"{name}_after"]
    return found


def _of_loop(tables: Tables, closure: Mapping, config: Config) -> dict:
    """Return the head of the page, and the effects at whose reference state the fits are."""
    added = [effect for effect in closure["effects"] if not effect["candidate"]]
    return {
        "of_properties": False,
        "badge": capital(closure["verdict"].replace("_", " ")),
        "tone": closure["verdict"],
        "fit": fit_badge(closure),
        "verdict": words.verdict(closure, config),
        "facts": campaign_facts(tables, config),
        "references": added if "steady_fit_before" in tables else [],
        "left_out": "steady_fit_before" in tables,
    }


def _fitted(tables: Tables, config: Config) -> list[parameter_tables.ParameterTable]:
    """Return the tables of fitted parameters; those of the goodness of fit come last."""
    found = []
    for name in parameter_tables.TITLES:
        fit = tables[name]
        fit = fit[fit["quantity"] == "dynamic"] if name == "dynamic_fit" else fit
        found += parameter_tables.parameter_tables(fit, name, config, tables.get(f"{name}_before"))
    return sorted(found, key=lambda table: table.statistics)


def fit_badge(closure: Mapping) -> tuple[str, str]:
    """Return how well the model fits: the state, and a few words."""
    state, ratio = (closure["fit_quality"][name] for name in ("state", "ratio"))
    if state == "unknown":
        return state, "Fit: not known"
    if state == "within_scatter":
        return state, "Fit: within the scatter of repeats"
    if (ratio or 0) < 1:
        return state, "Fit: a lack of fit, below the scatter of repeats"
    return state, f"Fit: {ratio:.2g} times the scatter of repeats"


def _text(name: str) -> str:
    return files("sealfit.report").joinpath(name).read_text("utf-8")


# The template writes values, those of closure.json above all, by the functions of these modules.
for module in (notation, words, parameter_tables):
    TEMPLATES.globals |= vars(module)
TEMPLATES.globals |= {"quality_counts": quality_counts, "quality_findings": quality_findings}
TEMPLATES.globals |= {"most_channels": MOST_CHANNELS, "most_inputs": MOST_INPUTS}
script = _text("report.js")
TEMPLATES.globals |= {"style": Markup(_text("style.css")), "script": Markup(script)}
TEMPLATES.globals["script_hash"] = b64encode(sha256(script.encode()).digest()).decode()


def run_traces(tables: Tables, config: Config) -> dict:
    """Return the measured force and the model's along every run, which the page draws on a click.

    Returned are labels `x` and `y`, and `runs`: by run_id its label and its strokes with file, x, force and
    model at every `every`-th bin. There are no runs of properties, or where there are too many bins.
    """
    units = config.units
    made = {"x": plain(units.label("displacement_mm")), "y": plain(units.label("force_N")), "runs": {}}
    rows = next((t for s in ("after", "before") if len(t := tables[f"residuals_{s}"])), pd.DataFrame())
    made["every"] = every = max(1, math.ceil(len(rows) / MOST_BINS))
    if rows.empty or every > LARGEST_STEP:
        return made
    names = ConditionNames(config)
    for run_id, run in rows[rows["bin"] % every == 0].groupby("run_id", sort=False):
        first = run.iloc[0]
        speed = f"{given(abs(run['speed_mm_s'].mean()), 3)} {units.unit('speed')}"
        columns = {"x": "displacement_mm", "force": "force_N", "model": "model_N"}
        strokes = [
            {"file": file, **{name: _rounded(own[column]) for name, column in columns.items()}}
            for (file, _), own in run.sort_values("bin").groupby(["file", "stroke"])
        ]
        label = f"{names(first['condition'])}, {speed}, run {run_id}"
        made["runs"][str(run_id)] = {"label": label, "strokes": strokes}
    return made


def _rounded(values: pd.Series) -> list[float | None]:
    return [float(f"{value:.5g}") if np.isfinite(value) else None for value in values]
