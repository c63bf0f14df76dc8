"""All plots of a report, from its tables; each subject is drawn in a file of its own."""

from __future__ import annotations

from collections.abc import Mapping

from sealfit.config import Config
from sealfit.report.figures.aging import aging, master_curve, traces_mean
from sealfit.report.figures.residual import (
    before_after,
    effect_shapes,
    finding,
    refused,
    residual_channels,
    variance_levels,
)
from sealfit.report.figures.speed import force_speed, starts
from sealfit.report.style import Plot, Tables

# The figures of closure.json, and those of the tables alone, in the order of the report.
OF_LOOP = (finding, before_after, effect_shapes, refused)
OF_TABLES = (variance_levels, residual_channels, force_speed, aging, master_curve, starts, traces_mean)


def draw_all(tables: Tables, closure: Mapping | None, config: Config) -> dict[str, Plot]:
    """Return the plots of tables, some perhaps empty, and closure.json (None of properties), by name."""
    plots = [] if closure is None else [make(tables, closure, config) for make in OF_LOOP]
    plots += [make(tables, config) for make in OF_TABLES]
    return {plot.name: plot for plot in plots if plot is not None}
