"""What people would use instead of the loop: the plain model's residual, learned from the same `bins` rows.

Each rival gets the channels that the loop's search may read (the rows' numeric channels and categories that
vary, no grouping, the speed as its size), at most `MOST_ROWS` rows drawn at random, and its package's
defaults or what is said at its function. Its prediction is the plain model's force plus the learned residual.
A package that is not there leaves its rival out, by name.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd

from sealfit.closure.channels import find_channels
from sealfit.fit.joint.rows import Rows

MOST_ROWS = 4000
EBM_ROUNDS = (
    500  # by itself it goes on, as a file's rows stand on both sides of its validation: no better, 90 s
)
# Ridge penalty on standardised columns, relative to the number of rows, as several channels are collinear.
RIDGE = 0.01
# Largest number of different values of a numeric channel that is a factor in the additive model.
FEW = 8
# Terms below this share of the standard deviation of the residual are dropped from the sparse regression.
THRESHOLD = 0.05


@dataclass(frozen=True)
class Inputs:
    """Channels of the rows to learn from and of the points, numbers and categories (as codes) apart."""

    train: np.ndarray  # (n, p)
    at: np.ndarray  # (m, p)
    names: tuple[str, ...]
    categories: tuple[bool, ...]

    @property
    def types(self) -> list[str]:
        """Feature types in interpret's words."""
        return ["nominal" if c else "continuous" for c in self.categories]


def make_inputs(rows: Rows, points: pd.DataFrame, ignore: Sequence[str] = ()) -> Inputs:
    """Return the channels of rows and points as two matrices."""
    train, at, names, categories = [], [], [], []
    for channel in find_channels(rows, ignore):
        name = channel.name
        if name == "started_at" or name not in points:
            continue
        if channel.numeric:
            values = points[name].to_numpy(dtype=float)
            train.append(channel.values)
            at.append(np.abs(values) if name == "speed_mm_s" else values)
        else:
            levels = np.unique(channel.values)
            code = dict(zip(levels, range(len(levels)), strict=True))
            train.append(np.searchsorted(levels, channel.values).astype(float))
            at.append(points[name].astype(str).map(code).to_numpy(dtype=float))
        names.append(name)
        categories.append(not channel.numeric)
    return Inputs(np.column_stack(train), np.column_stack(at), tuple(names), tuple(categories))


def boosting(inputs: Inputs, residual: np.ndarray, seed: int) -> np.ndarray:
    """Return the residual by scikit-learn's histogram gradient boosting with default settings, shape (m,)."""
    from sklearn.ensemble import HistGradientBoostingRegressor

    model = HistGradientBoostingRegressor(categorical_features=list(inputs.categories), random_state=seed)
    return model.fit(inputs.train, residual).predict(inputs.at)


def explainable_boosting(inputs: Inputs, residual: np.ndarray, seed: int) -> np.ndarray:
    """Return the residual by interpret's EBM with ten interactions, two bags and at most 500 rounds; (m,)."""
    from interpret.glassbox import ExplainableBoostingRegressor

    model = ExplainableBoostingRegressor(
        feature_names=list(inputs.names),
        feature_types=inputs.types,
        interactions=10,
        outer_bags=2,
        max_rounds=EBM_ROUNDS,
        n_jobs=1,
        random_state=seed,
    )
    return model.fit(inputs.train, residual).predict(inputs.at)


def additive(inputs: Inputs, residual: np.ndarray, seed: int) -> np.ndarray:
    """Return the residual by pyGAM's LinearGAM; shape (m,).

    It has a spline per number, a factor per category and the default penalty.
    """
    from pygam import LinearGAM, f, s

    terms = None
    for k, category in enumerate(inputs.categories):
        count = np.unique(inputs.train[:, k]).size
        own = (
            f(k)
            if category
            else s(k, n_splines=min(20, max(count, 4)), spline_order=min(3, max(count, 4) - 1))
        )
        terms = own if terms is None else terms + own
    return LinearGAM(terms).fit(inputs.train, residual).predict(inputs.at)


def sparse(inputs: Inputs, residual: np.ndarray, seed: int) -> np.ndarray:
    """Return the residual by PySINDy: sequentially thresholded least squares on its library of terms; (m,).

    The library holds polynomials to second order and two Fourier terms of every channel, each scaled to -1 to
    1 (the speed on a logarithmic scale). Its columns are standardised; a term stays while it gives 5 % of the
    residual's SD. The ridge is kept in the last fit, which otherwise runs away at new points where channels
    say the same.
    """
    import pysindy

    low, high = inputs.train.min(axis=0), inputs.train.max(axis=0)

    def scaled(values: np.ndarray) -> np.ndarray:
        values, a, b = values.copy(), low.copy(), high.copy()
        for k, name in enumerate(inputs.names):
            if name == "speed_mm_s":
                values[:, k], a[k], b[k] = np.log(values[:, k]), np.log(low[k]), np.log(high[k])
        return np.clip(2 * (values - a) / (b - a) - 1, -1.0, 1.0)

    library = pysindy.PolynomialLibrary(degree=2, include_bias=False) + pysindy.FourierLibrary(
        n_frequencies=2
    )
    x = scaled(inputs.train)
    columns = np.asarray(library.fit_transform(x))
    mean, spread = columns.mean(axis=0), columns.std(axis=0)
    used = spread > 1e-9
    size = float(residual.std()) or 1.0
    optimiser = pysindy.STLSQ(threshold=THRESHOLD, alpha=RIDGE * len(x), unbias=False)
    white = (columns[:, used] - mean[used]) / spread[used]
    optimiser.fit(white, ((residual - residual.mean()) / size)[:, None])
    new = (np.asarray(library.transform(scaled(inputs.at)))[:, used] - mean[used]) / spread[used]
    return residual.mean() + size * (new @ np.asarray(optimiser.coef_).ravel())


RIVALS: dict[str, Callable[[Inputs, np.ndarray, int], np.ndarray]] = {
    "boosting": boosting,
    "ebm": explainable_boosting,
    "pygam": additive,
    "pysindy": sparse,
}


@dataclass(frozen=True)
class Rivalled:
    """The rivals' forces at the points, what they cost, and why one is missing."""

    force: dict[str, np.ndarray]
    seconds: dict[str, float]
    missing: dict[str, str]


def rival_forces(
    rows: Rows, residual: np.ndarray, points: pd.DataFrame, plain_N: np.ndarray, seed: int
) -> Rivalled:
    """Return every rival's force at points, shape (m,) each: the plain model's plus the learned residual."""
    inputs = make_inputs(rows, points)
    chosen = np.random.default_rng(seed).permutation(residual.size)[:MOST_ROWS]
    some = Inputs(inputs.train[chosen], inputs.at, inputs.names, inputs.categories)
    force, seconds, missing = {}, {}, {}
    for name, learn in RIVALS.items():
        started = time.process_time()
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                force[name] = plain_N + np.asarray(learn(some, residual[chosen], seed), dtype=float)
        except ImportError as error:
            missing[name] = f"not installed: {error.name}"
        except Exception as error:  # one rival's failure is its own result, not the run's end
            missing[name] = f"{type(error).__name__}: {error}"
        seconds[name] = time.process_time() - started
    return Rivalled(force, seconds, missing)
