"""Every figure of the report, as a function that a notebook calls."""

from collections.abc import Callable
from functools import partial

from matplotlib.figure import Figure

from sealfit.errors import RequestError
from sealfit.pipeline import reported
from sealfit.report.drawing import compose, saved
from sealfit.report.figures import OF_LOOP, OF_TABLES, draw_all
from sealfit.report.page import answered
from sealfit.store import Store

FIGURES = tuple(make.__name__ for make in (*OF_LOOP, *OF_TABLES))


class ShownFigure(Figure):
    """A figure that a notebook shows as it is, without pyplot; its axes are there to be changed."""

    def _repr_png_(self) -> bytes:
        return saved(self, "png")


class Plots:
    """The report's figures in its look: `results.plot.aging()` returns a matplotlib Figure.

    - finding: the residual along the variable of the largest effect, and the errors, before and after
    - before_after: the errors with the noise floor, and the distribution of the run means' errors
    - effect_shapes: every effect along its channels, with its 95 % band
    - refused: the residual along the variables of effects that were significant, but not accepted
    - residual_channels, variance_levels: the residual along every channel, and its variance at every level
    - force_speed: force against speed of every condition, the model and the run means
    - aging: the coefficients over aging time, a panel per series, the law with its band
    - master_curve: all series over aging time at one temperature, with the law for them all
    - starts: the mean force over the distance slid from rest, and the model's
    - traces_mean: some of the averaged traces

    Raises
    ------
    StaleError
        If the results are missing or stale, when a figure is asked for.
    RequestError
        If these results have nothing to draw in it.
    """

    def __init__(self, answered: Callable[[], Store]):
        self._answered = answered  # gives the store if its answer is current, else raises

    def __dir__(self) -> tuple[str, ...]:
        return FIGURES

    def __getattr__(self, name: str) -> Callable[[], Figure]:
        if name not in FIGURES:
            raise AttributeError(f"there is no figure '{name}'; there are {', '.join(FIGURES)}")
        return partial(self._drawn, name)

    def _drawn(self, name: str) -> Figure:
        store = self._answered()
        plots = draw_all(*answered(*reported(store)), store.config)
        if name not in plots:
            raise RequestError(
                f"these results have nothing to draw in the figure '{name}'.",
                fix=f"They have: {', '.join(plots)}.",
            )
        return compose(plots[name], ShownFigure)
