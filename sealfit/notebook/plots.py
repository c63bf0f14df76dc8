"""Every figure of the report, as a function that a notebook calls."""

from __future__ import annotations

from collections.abc import Callable

from matplotlib.figure import Figure

from sealfit.errors import RequestError
from sealfit.pipeline import reported
from sealfit.report.drawing import saved
from sealfit.report.figures import draw_all
from sealfit.report.page import answered
from sealfit.report.style import compose
from sealfit.store import Store


class ShownFigure(Figure):
    """A figure that a notebook shows as it is, without pyplot; its axes are there to be changed."""

    def _repr_png_(self) -> bytes:
        return saved(self, "png")


class Plots:
    """The report's figures by name: each method returns a matplotlib Figure in the report's look.

    Raises
    ------
    StaleError
        If the results are missing or stale, when a figure is asked for.
    RequestError
        If these results have nothing to draw in it.
    """

    def __init__(self, answered: Callable[[], Store]):
        self._answered = answered  # gives the store if its answer is current, else raises

    def finding(self) -> Figure:
        """Return the residual along the variable of the largest effect, and the errors, before and after."""
        return self._drawn("finding")

    def before_after(self) -> Figure:
        """Return the errors before and after with the noise floor, and the spread of run means' errors."""
        return self._drawn("before_after")

    def effect_shapes(self) -> Figure:
        """Return the shape of every effect along its channels, with its 95 % band."""
        return self._drawn("effect_shapes")

    def refused(self) -> Figure:
        """Return the residual along the variables of effects that were significant, but not accepted."""
        return self._drawn("refused")

    def residual_channels(self) -> Figure:
        """Return the mean residual along every channel, before and after."""
        return self._drawn("residual_channels")

    def variance_levels(self) -> Figure:
        """Return the variance of the residual at every level, before and after."""
        return self._drawn("variance_levels")

    def force_speed(self) -> Figure:
        """Return force against speed of every condition: the model and the run means."""
        return self._drawn("force_speed")

    def aging(self) -> Figure:
        """Return the coefficients over aging time, a panel per series: law with band, and each condition."""
        return self._drawn("aging")

    def master_curve(self) -> Figure:
        """Return the values of all series over aging time at one temperature, with the law for them all."""
        return self._drawn("master_curve")

    def starts(self) -> Figure:
        """Return how strokes begin: the mean force over the distance slid, and the model's."""
        return self._drawn("starts")

    def traces_mean(self) -> Figure:
        """Return some of the averaged traces, spread over conditions and speeds."""
        return self._drawn("traces_mean")

    def _drawn(self, name: str) -> Figure:
        store = self._answered()
        plots = draw_all(*answered(*reported(store)), store.config)
        if name not in plots:
            raise RequestError(
                f"these results have nothing to draw in the figure '{name}'.",
                fix=f"They have: {', '.join(plots)}.",
            )
        return compose(plots[name], ShownFigure)
