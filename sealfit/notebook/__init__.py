"""`sealfit.run`, `fit_properties` and `open`: the results of a campaign for a notebook or another program."""

import html
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import pandas as pd

from sealfit import commands, pipeline, progress
from sealfit.engine import one_thread
from sealfit.engine.run_map import cores
from sealfit.errors import RequestError, SealfitError, nearest
from sealfit.notebook import frames
from sealfit.report import summary, summary_lines
from sealfit.store import Store
from sealfit.store.manifest import BATCH
from sealfit.tables import SCHEMAS
from sealfit.units import Units

if TYPE_CHECKING:
    from sealfit.notebook.plots import Plots

ANSWERED = "close-loop"  # the step whose results are the answer
AFTER = "_after"  # ending of the tables with the loop's effects taken out
SHOWN = ("id", "label", "channels", "acts_on", "form", "p_value")  # of an effect, in what a notebook shows


def run(
    campaign: str | Path,
    out: str | Path,
    config: str | Path | None = None,
    *,
    workers: int | None = None,
    effects_folder: str | Path | None = None,
    **options: object,
) -> "Results":
    """Run all out-of-date steps, as `sealfit run` does, and return the results.

    Parameters
    ----------
    campaign, out : str or Path
        The campaign's folder, and the folder of results; that one is created if it is not there.
    config : str or Path, optional
        Rig config (TOML).
    workers : int, optional
        Processes to use; default: all cores.
    effects_folder : str or Path, optional
        Folder of your own effects. Python is run from it.
    **options
        `force`, `strict`, `scheduler` and `progress` of `sealfit.pipeline.run`.

    Raises
    ------
    SealfitError
        Whatever the user has to fix: the message says where, what and how.
    """
    one_thread()
    options.setdefault("progress", progress.for_notebook())
    folders = {"effects_folder": _path(effects_folder)}
    folders |= {"campaign": _path(campaign), "out": _path(out), "config": _path(config)}
    pipeline.run(**folders, workers=workers or cores(), **options)
    return Results(out, effects_folder)


def fit_properties(
    values: str | Path,
    out: str | Path,
    config: str | Path | None = None,
    *,
    properties: Sequence[str] = (),
    batch: str = BATCH,
    **options: object,
) -> "Results":
    """Fit the aging laws of properties of specimens, as `sealfit fit-aging --values` does.

    Parameters
    ----------
    values : str or Path
        CSV, Excel or Parquet file with a row per specimen.
    out, config
        As `run`.
    properties : sequence of str
        Columns of the properties; by default the only one there is.
    batch : str
        Column that names the batch of a specimen.
    **options
        `force` and `progress` of `sealfit.pipeline.fit_properties`.

    Raises
    ------
    SealfitError
        Whatever the user has to fix: the message says where, what and how.
    """
    one_thread()
    options.setdefault("progress", progress.for_notebook())
    folders = (_path(values), _path(out), _path(config))
    pipeline.fit_properties(*folders, names=tuple(properties), batch=batch, **options)
    return Results(out)


def open(out: str | Path, effects_folder: str | Path | None = None) -> "Results":
    """Return the results in a folder that `sealfit.run` or the command line made.

    Parameters
    ----------
    out : str or Path
        The folder of results.
    effects_folder : str or Path, optional
        Folder of your own effects, if the loop was closed with some: Python is run from it for predictions.

    Raises
    ------
    OutError
        If there is no such folder, or it holds no results.
    """
    one_thread()
    return Results(out, effects_folder)


def _path(given: str | Path | None) -> Path | None:
    return None if given is None else Path(given).expanduser()


def _of_closure(make: Callable[[Mapping, Units], pd.DataFrame]) -> property:
    """Return the property of `Results` that a function makes of closure.json."""
    return property(lambda self: make(*self._closure()), doc=make.__doc__)


def _stored(table: str, meaning: str) -> property:
    """Return the property of `Results` that is a table of OUT."""
    return property(lambda self: self.table(table), doc=meaning)


class Results:
    """What sealfit found in a campaign: tables, plots, predictions and lifetimes.

    Everything is read when it is asked for. If it is missing, or the campaign, the config or the program has
    changed since, StaleError says which command brings it up to date. `attrs["units"]` of every table has the
    unit of a column. Parameters and laws are those of the answer: with the loop's effects taken out, where it
    added some.
    """

    def __init__(self, out: str | Path, effects_folder: str | Path | None = None):
        self.out = Path(out).expanduser()
        self._effects_folder = _path(effects_folder)
        self._open()

    # ------------------------------------------------------------ what the loop found
    verdict = _of_closure(frames.verdict)
    errors = _of_closure(frames.errors)
    effects = _of_closure(frames.effects)
    effect_parameters = _of_closure(frames.effect_parameters)
    scatter = _of_closure(frames.scatter)
    sensitivity = _of_closure(frames.sensitivity)
    effect_curves = _stored(
        "shapes",
        "A row per effect, channel and place along it: what the effect does there, with its 95 % band.",
    )

    # ------------------------------------------------------------ fits
    @property
    def parameters(self) -> pd.DataFrame:
        """A row per condition and parameter of Eqs. 1 to 14; unaged rubber has them in each of its series.

        `before` is the value without the loop's effects, `value` the answer, with `lo95`, `hi95` and `unit`.
        """
        store = self._current(ANSWERED)
        names = ("steady_fit", "dynamic_fit")
        fits, before = [self._answer(store, name) for name in names], [store.read(name) for name in names]
        return frames.with_units(frames.parameters(fits, before, store.config), store.config.units)

    @property
    def laws(self) -> pd.DataFrame:
        """A row per series, quantity and parameter of the aging law (Eq. 15); empty if no rubber was aged."""
        store = self._answered()
        fit, before = self._answer(store, "aging_fit"), store.read("aging_fit")
        return frames.with_units(frames.laws(fit, before, store.config), store.config.units)

    # ------------------------------------------------------------ data
    runs = _stored("runs", "A row per stroke, with all that is known of its file and run.")
    quality = _stored(
        "quality", "A row per finding in the data: where, what, what was done about it, and how to fix it."
    )
    steady = _stored("steady", "A row per stroke: means over its steady window.")
    bins = _stored("bins", "A row per bin of a steady window: what the joint model is fitted to.")

    def residuals(self, model: str = "after") -> pd.DataFrame:
        """Return a row per bin: measured minus model, fitted and held out; `model` is "after" or "before".

        Raises
        ------
        RequestError
            If there is no such model.
        """
        commands.require_model(model)
        return self.table(f"residuals_{model}")

    def traces(self, condition: str | None = None) -> pd.DataFrame:
        """Return a row per sample of every trace, or of those of one condition, as table `runs` spells it.

        Raises
        ------
        RequestError
            If no such condition was tested; the fix names the nearest.
        """
        return self._of_condition("traces", condition)

    def mean_traces(self, condition: str | None = None) -> pd.DataFrame:
        """Return a row per run and displacement: the mean of repeats; `condition` and errors as `traces`."""
        return self._of_condition("traces_mean", condition)

    def table(self, name: str) -> pd.DataFrame:
        """Return any table of OUT as it is stored, with `attrs["meaning"]` of its columns.

        Raises
        ------
        RequestError
            If there is no such table; the fix names the nearest, or all.
        """
        return self._table(self._current(_step_of(name)), name)

    # ------------------------------------------------------------ what follows
    @property
    def plot(self) -> "Plots":
        """The report's figures: `results.plot.aging()` returns a matplotlib Figure."""
        from sealfit.notebook.plots import Plots

        return Plots(self._answered)

    def predict(self, points: pd.DataFrame | Mapping[str, Sequence]) -> pd.DataFrame:
        """Return the points with the force, before and after, and 95 % intervals, as `sealfit predict` does.

        Parameters
        ----------
        points : DataFrame, or mapping of column names to values
            The condition columns, signed `speed_mm_s`, and what else the model needs; a message says what is
            missing.

        Raises
        ------
        RequestError
            If a column is missing that the model needs, or is there twice.
        """
        from sealfit.closure.prediction_csv import points_of

        store, points = self._current(ANSWERED), pd.DataFrame(points)
        answers = commands.answers_to(points_of(points), store)
        return frames.with_units(answers.set_axis(points.index), store.config.units)

    def lifetime(
        self,
        quantity: str = "mu_s",
        threshold: float | None = None,
        *,
        loss_pct: float | None = None,
        temperature_C: float | None = None,
        **options: object,
    ) -> "Lifetime":
        """Return the days until a quantity reaches a threshold, as `sealfit lifetime` does.

        Parameters
        ----------
        quantity : str
            mu_s, mu_c, F_s, F_c, or a property.
        threshold, loss_pct : float
            Value at which life ends, or percent of the start that may be lost: one of the two.
        temperature_C : float, optional
            Temperature of use, in degrees Celsius; needed where several were tested.
        **options
            `compression_ratio_pct`, `years` (find the temperature that lasts so long), `law`, `model`, and
            `rubber`, where several were aged.

        Raises
        ------
        RequestError
            If the request does not fit the campaign.
        """
        asked = commands.LifetimeRequest(quantity, threshold, loss_pct, temperature_C, **options)
        return Lifetime(commands.lifetime(self.out, asked))

    # ------------------------------------------------------------ how it shows itself
    def __repr__(self) -> str:
        try:
            store = self._answered()
            if store.state.properties is not None:
                return "\n".join(summary_lines.lines(summary.of_steps(store, ["fit-aging"])))
            closure = store.read_json("closure")
        except SealfitError as error:
            return f"results in {self.out}: {error}"
        return "\n".join(summary_lines.closure_lines(summary.of_closure(closure, store.config.units)))

    def _repr_html_(self) -> str:
        try:
            store = self._answered()
            if store.state.properties is not None:
                said = map(summary_lines.property_sentences, summary.of_aging(store)["properties"])
                return "\n".join([*(f"<p>{html.escape(text)}</p>" for text in said), _table_html(self.laws)])
            closure = store.read_json("closure")
        except SealfitError as error:
            return f"<p>Results in {html.escape(str(self.out))}: {html.escape(str(error))}</p>"
        units = store.config.units
        sentence = html.escape(summary.verdict_sentence(closure, units))
        tables = [frames.errors(closure, units)[["meaning", "before", "after", "noise_floor", "unit"]]]
        if closure["effects"]:
            tables.append(frames.effects(closure, units)[list(SHOWN)])
            tables.append(frames.effect_parameters(closure, units).drop(columns="effect"))
        verdict = f"<p><b>{html.escape(closure['verdict'])}</b>: {sentence}.</p>"
        return "\n".join([verdict, *map(_table_html, tables)])

    # ------------------------------------------------------------ reading
    def _open(self) -> Store:
        store = Store.open(self.out, self._effects_folder)
        for warning in store.warnings:
            warnings.warn(warning, stacklevel=2)
        return store

    def _current(self, step: str) -> Store:
        """Return the store as it is now if `step` is current; else raise StaleError."""
        store = self._open()
        store.require(step)
        return store

    def _answered(self) -> Store:
        """Return the store if its answer is current: what the report, the last step, would show."""
        store = self._open()
        store.require(store.state.order[-2])
        return store

    def _closure(self) -> tuple[dict, Units]:
        store = self._current(ANSWERED)
        return store.read_json("closure"), store.config.units

    @staticmethod
    def _answer(store: Store, name: str) -> pd.DataFrame:
        """Return a table of the after-model, or that before where no effect was added."""
        if store.state.properties is not None:
            return store.read(name)
        after = store.read(f"{name}{AFTER}")
        return after if len(after) else store.read(name)

    @staticmethod
    def _table(store: Store, name: str, **which: object) -> pd.DataFrame:
        return frames.with_units(store.read(name, **which), store.config.units, SCHEMAS[name])

    def _of_condition(self, name: str, condition: str | None) -> pd.DataFrame:
        store = self._current(_step_of(name))
        if condition is None:
            return self._table(store, name)
        known = store.read("steady", ["condition"])["condition"].dropna().unique().tolist()
        if condition not in known:
            raise RequestError(f"no condition '{condition}' was tested.", fix=_nearest(condition, known))
        return self._table(store, name, where={"condition": [condition]})


class Lifetime(dict):
    """What `sealfit lifetime` answers: its figures by name, shown in the lines that the command prints."""

    def __repr__(self) -> str:
        return "\n".join(summary_lines.lifetime_lines(self))

    def _repr_html_(self) -> str:
        return f"<pre>{html.escape(repr(self))}</pre>"


def _step_of(table: str) -> str:
    made = {**pipeline.MADE, "fit-aging": (*pipeline.MADE["fit-aging"], *pipeline.OF_PROPERTIES)}
    step = next((step for step, names in made.items() if table in names), None)
    if step is None:
        raise RequestError(f"there is no table '{table}'.", fix=_nearest(table, pipeline.TABLES))
    return step


def _nearest(wanted: str, known: list[str] | tuple[str, ...]) -> str:
    likely = nearest(wanted, known)
    return f"Did you mean '{likely}'?" if likely else f"There are: {', '.join(known)}."


def _table_html(frame: pd.DataFrame) -> str:
    return frame.to_html(index=False, border=0, na_rep="", float_format="{:.4g}".format)
