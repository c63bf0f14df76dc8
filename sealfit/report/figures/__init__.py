"""All plots of a report, from its tables; each subject is drawn in a file of its own."""

from collections.abc import Mapping

from sealfit.config import Config
from sealfit.report.drawing import Plot, Tables
from sealfit.report.figures import aging, residual, speed

# The figures of closure.json, and those of the tables alone, in the order of the report.
OF_LOOP = (residual.finding, residual.before_after, residual.effect_shapes, residual.refused)
OF_TABLES = (
    residual.variance_levels, residual.residual_channels, speed.force_speed, aging.aging, aging.master_curve,
    speed.starts, aging.traces_mean,
)  # fmt: skip


def draw_all(tables: Tables, closure: Mapping | None, config: Config) -> dict[str, Plot]:
    """Return the plots of tables, some perhaps empty, and closure.json (None of properties), by name."""
    plots = [] if closure is None else [make(tables, closure, config) for make in OF_LOOP]
    plots += [make(tables, config) for make in OF_TABLES]
    return {plot.name: plot for plot in plots if plot is not None}
