"""One self-contained report.html: its tables and sentences, and every plot as an image inside it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from importlib.resources import files

import pandas as pd
from jinja2 import Environment, StrictUndefined
from markupsafe import Markup

from sealfit.config import Config
from sealfit.profiling import timed
from sealfit.report import facts
from sealfit.report.drawn import Drawn, data_uri, draw
from sealfit.report.figures import draw_all
from sealfit.report.figures_residual import MOST_CHANNELS
from sealfit.report.law_tables import law_rows
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
from sealfit.report.numbers import count, given, number
from sealfit.report.parameters import break_away_rows, parameter_tables
from sealfit.report.style import Plot
from sealfit.report.symbols import ConditionNames, symbol_html
from sealfit.report.words import left_over, verdict, with_left_channels

TABLES = (
    "inputs", "runs", "quality", "traces_mean", "steady", "steady_fit", "aging_fit", "aging_curves",
    "aging_laws", "master_curve", "dynamic_fit", "dynamic_curves", "effects",
    "residuals_before", "residuals_after", "levels", "channels", "shapes", "curves",
)  # fmt: skip
FITS = ("steady_fit", "aging_fit", "aging_curves", "aging_laws", "master_curve", "dynamic_fit", "dynamic_curves")
BEFORE = "{}_before"  # name of such a table without the loop's effects, beside that of the after-model
VERDICTS = {
    "closed": "Closed",
    "nothing_missing": "Nothing missing",
    "unexplained": "Unexplained",
    "cannot_tell": "Cannot tell",
    None: "Not closed yet",
}


@dataclass(frozen=True)
class Report:
    """The page, and its plots by name for whoever saves them as files."""

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
        Tables of OUT by name, as `sealfit.tables` describes them; what is missing or empty is said to be so.
    closure : mapping or None
        closure.json, or None where the loop was not run.
    provenance : mapping
        provenance.json.
    config : Config
        Names the conditions and gives every quantity its true unit.

    Returns
    -------
    Report
        The page asks for nothing outside itself. Figures are drawn once; the page shows their panels.
    """
    tables = with_answer(tables)
    if closure is not None:
        closure = with_left_channels(closure, set(tables["channels"]["channel"].dropna()))
    plots = draw_all(tables, closure, config)
    with timed("plots", rows=len(plots), of="plots"):
        figures = {name: draw(plot) for name, plot in plots.items()}
    images = {name: _images(plot, figures[name]) for name, plot in plots.items()}
    html = _environment().from_string(_text("template.html")).render(
        style=Markup(_text("style.css")), plots=images, **_content(tables, closure, provenance, config)
    )  # fmt: skip
    return Report(html, figures)


def with_answer(tables: Mapping[str, pd.DataFrame]) -> dict[str, pd.DataFrame]:
    """Return the report's tables, with the fits of the after-model in place of those before where there are any.

    Those before then stand under their names and `_before`.
    """
    complete = facts.complete(tables, TABLES)
    if not len(tables.get("steady_fit_after", ())):
        return complete
    before = {BEFORE.format(name): complete[name] for name in FITS}
    after = facts.complete({name: tables[f"{name}_after"] for name in FITS}, FITS)
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
    fitted += parameter_tables(dynamic[dynamic["quantity"] == "dynamic"], "condition", config, before["dynamic_fit"])
    break_aways, break_aways_in_all = break_away_rows(dynamic, config)
    findings, in_all = facts.quality_findings(tables["quality"], config)
    return {
        "closure": closure,
        "badge": VERDICTS[closure["verdict"] if closure else None],
        "verdict": verdict(closure, tables["shapes"], config),
        "facts": facts.campaign_facts(tables, config),
        "errors": error_rows(closure, config) if closure else [],
        "cards": effect_cards(closure, config) if closure else [],
        "scatter": scatter_rows(closure, config) if closure else [],
        "sensitivity": sensitivity_rows(closure, config) if closure else [],
        "refused": refused_rows(closure, config) if closure else [],
        "left": left_over(closure, config) if closure else "",
        "next_runs": next_runs(closure, config) if closure else [],
        "tests": channel_tests(tables["levels"], tables["channels"]["channel"].dropna(), config),
        "more_channels": max(0, tables["channels"]["channel"].nunique() - MOST_CHANNELS),
        "parameter_tables": sorted(fitted, key=lambda table: table.single),  # how well the fits do comes last
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
        "counts": facts.quality_counts(tables["quality"]),
        "findings": findings,
        "findings_in_all": in_all,
        "provenance": facts.provenance_facts(provenance),
    }


def _images(plot: Plot, drawn: Drawn) -> dict:
    """Return a plot as the template draws it: every panel an image of its own, so that they flow with the page."""
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
