"""The break-away force: the peak of the force before steady sliding, at each commanded speed and direction."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np
import pandas as pd
from scipy import stats

from sealfit.config import Config
from sealfit.fit.starts import Start, cell_means
from sealfit.fit.steady import table_row
from sealfit.fit.stiffness import together

SAMPLES, SHARE = 8, 1 / 40  # of the window over which a peak is averaged: samples of a start, share of the distance
FORCE, RATIO, SLIDING = "F_ba", "F_ba/F", "F"
TOP, NOISE, PLACES, WHERE = "top", "noise", "places", "where"
LARGEST = "F_max/F"
INTO = "{where:.3g} {unit} into strokes of {reach:.3g} {unit}"
NO_PEAK = "the force comes up to its sliding value without passing above it"
FEW = "no repeats: no scatter is known"
FAMILY = 0.01  # chance of a peak anywhere in a campaign where there is none


def peaks(starts: Sequence[Start], distance: np.ndarray, force: np.ndarray, steady: pd.DataFrame) -> pd.DataFrame:
    """Return the break-away force F_ba and its share of the sliding force, per file, or per stroke of a single file.

    The sliding force is that of the line through where steady sliding has just begun, taken back to the peak: what
    warming takes off along a stroke is no break-away. Where the peak lies is read from the mean of the other units, and
    a start's own force is then taken there: the largest of noisy samples is always too high. For a test of whether
    there is a peak at all, `top` is its force above sliding where the mean of all is largest, `noise` the standard
    error of that in those of a sample, and `places` how many places there are; `F` is the sliding force.

    Parameters
    ----------
    starts : sequence of Start
        At one condition, commanded speed and direction.
    distance, force : ndarray, shape (cells,) and (starts, cells)
        Middles of cells of distance, in mm, and their mean force there, in N, as `cell_means` gives them.
    steady : DataFrame
        Rows of table `steady`, one per start, in the same order.
    """
    samples = float(np.median([s.force_N.size for s in starts]))
    half = int(np.ceil(force.shape[1] * max(SAMPLES / samples, SHARE) / 2))  # of the window, in cells
    sliding = np.array([s.sliding.at(distance) for s in starts])
    total, hits = (_window(x, half) for x in (np.nan_to_num(force), np.isfinite(force)))
    mean = np.where(hits > 0, total / np.maximum(hits, 1), np.nan)
    unit = steady["file"].to_numpy() if steady["file"].nunique() > 1 else np.arange(len(force))
    own, whole = _places(_window(np.nan_to_num(force - sliding), half), hits, unit)
    each = np.arange(len(force))
    peak, line = mean[each, own], sliding[each, own]
    per_cell = samples / force.shape[1]
    line_error = np.array([s.sliding.error(distance[whole]) for s in starts])
    table = {
        FORCE: np.where(peak > 0.0, peak, np.nan),
        RATIO: np.where((peak > 0.0) & (line > 0.0), peak / line, np.nan),
        SLIDING: [s.sliding.force_N for s in starts],
        TOP: mean[:, whole] - sliding[:, whole],
        NOISE: np.hypot(line_error, 1 / np.sqrt(np.maximum(hits[:, whole] * per_cell, 1.0))),
        PLACES: max(force.shape[1] / (2 * half + 1), 1.0),
        WHERE: distance[whole],
    }
    return pd.DataFrame(table).groupby(unit, sort=False).mean().dropna()


def break_away_rows(
    found: Sequence[tuple[Mapping, pd.DataFrame]], widened: tuple[float, float], config: Config
) -> Iterator[dict]:
    """Yield rows of table `dynamic_fit` for all break-aways of a campaign.

    The scatter of repeats is pooled within a condition: that of the force as a share of it, that of the ratio as the
    force above the sliding force over its noise, since what does not cancel in it is the noise of the samples. The
    force is also widened by the scatter of set-ups, which all repeats of a run share. A peak is one where the largest
    mean stands above the sliding force by a t-test at 1 % for all places of all starts of the campaign (Bonferroni);
    elsewhere `reason` says that there is none, and there is no interval.

    Parameters
    ----------
    found : sequence of (keys, DataFrame)
        The condition, commanded speed and direction as columns of the table, and what `peaks` gave there.
    widened : (float, float)
        How many times the variance that repeats give them run means have, and on how many degrees of freedom that
        rests: from the steady fit.
    config : Config
        Gives the units and the sensor's accuracy.
    """
    pooled = {}
    for condition in dict.fromkeys(at["condition"] for at, _ in found):
        alike = [own for at, own in found if at["condition"] == condition]
        for name in (FORCE, SLIDING):
            pooled[condition, name] = _pooled([np.log(own[name]) for own in alike])
        pooled[condition, RATIO] = _pooled([own[FORCE] * (1 - 1 / own[RATIO]) / own[NOISE] for own in alike])
        pooled[condition, TOP] = _pooled([own[TOP] / own[NOISE] for own in alike])
    places = sum(float(own[PLACES].max()) for _, own in found)
    for at, own in found:
        condition = at["condition"]
        setup = max(widened[0] - 1, 0.0) * pooled[condition, SLIDING][0] ** 2
        spread, df = pooled[condition, FORCE]
        above = pooled[condition, RATIO][0] * own[NOISE].mean() / own[FORCE].mean()
        error = pooled[condition, TOP][0] * own[NOISE].mean() / np.sqrt(len(own))
        peak = df >= 1 and own[TOP].mean() > stats.t.isf(FAMILY / places, df) * error
        reason = "" if peak else NO_PEAK if df >= 1 else FEW
        force_df = together(((spread**2, df), (setup, widened[1])))
        for name, unit, u_sys, variance, error_df in (
            (FORCE, config.units.unit("force"), config.sensor.u, spread**2 + setup, force_df),
            (RATIO, "", None, above**2, df),
        ):
            value = float(np.exp(np.log(own[name]).mean()))
            row = {"quantity": "break_away", "parameter": name, "value": value, "unit": unit, "u_sys": u_sys}
            if peak:
                error = np.sqrt(variance / len(own))
                half = stats.t.ppf(0.975, error_df) * error
                row |= {"se": value * error, "lo95": value * np.exp(-half), "hi95": value * np.exp(half)}
            yield {**table_row(**row, identified=bool(peak), reason=reason), **at}


def largest_row(strokes: Sequence[Start], steady: pd.DataFrame, config: Config) -> dict | None:
    """Return the row of table `dynamic_fit` for the largest force anywhere in strokes, over their sliding force.

    It may come at the end as well as at the start, so it describes strokes and is no break-away; where it lies stands
    in `reason`. None where the force never opposes the motion.

    Parameters
    ----------
    strokes : sequence of Start
        Whole strokes at one condition, commanded speed and direction.
    steady : DataFrame
        Rows of table `steady`, one per stroke, in the same order.
    config : Config
        Gives the units.
    """
    distance, force = cell_means(strokes, [s.force_N for s in strokes])
    own = peaks(strokes, distance, force, steady)
    if own.empty:
        return None
    reach = float(np.median([s.distance_mm[-1] for s in strokes]))
    where = INTO.format(where=own[WHERE].iloc[0], reach=reach, unit=config.units.unit("displacement"))
    value = float(np.exp(np.log(own[RATIO]).mean()))
    return table_row(quantity="largest", parameter=LARGEST, value=value, unit="", identified=True, reason=where)


def _pooled(groups: Sequence[pd.Series]) -> tuple[float, int]:
    """Return the standard deviation within groups, and its degrees of freedom."""
    df = sum(values.size - 1 for values in groups)
    squares = sum(float(((values - values.mean()) ** 2).sum()) for values in groups)
    return float(np.sqrt(squares / df)) if df else np.nan, df


def _places(above: np.ndarray, hits: np.ndarray, unit: np.ndarray) -> tuple[np.ndarray, int]:
    """Return the cell where the mean of the others is largest for each start, shape (starts,), and that of all.

    Parameters
    ----------
    above, hits : ndarray, shape (starts, cells)
        Sum of the force above sliding over a window about each cell, and of how many cells.
    unit : ndarray, shape (starts,)
        Of evidence.
    """

    def highest(starts: np.ndarray) -> int:
        count = hits[starts].sum(axis=0)
        sure = count > count.max() / 2  # a mean of few is mostly noise
        return int(np.argmax(np.where(sure, above[starts].sum(axis=0) / np.maximum(count, 1), -np.inf)))

    everywhere = np.ones(len(above), bool)
    others = [unit != own if (unit != own).any() else everywhere for own in unit]
    return np.array([highest(mask) for mask in others]), highest(everywhere)


def _window(values: np.ndarray, half: int) -> np.ndarray:
    """Return the sum over each cell and `half` cells to either side, shape of `values`."""
    padded = np.pad(values.astype(float), ((0, 0), (half, half)))
    return sum(padded[:, k : k + values.shape[1]] for k in range(2 * half + 1))
