"""The break-away force: the peak of the force before steady sliding, at each commanded speed and direction."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np
import pandas as pd
from scipy import stats

from sealfit.config import Config
from sealfit.fit.starts import Start
from sealfit.fit.steady import table_row
from sealfit.fit.stiffness import together

SAMPLES, SHARE = 8, 1 / 40  # of the window over which a peak is averaged: samples of a start, share of the distance
FORCE, RATIO, SLIDING = "F_ba", "F_ba/F", "F"
TOP, PLACES = "top", "places"  # the force where the mean of all units is largest, and of how many places that is one
NO_PEAK = "the force comes up to its sliding value without passing above it"
FEW = "no repeats: no scatter is known"
FAMILY = 0.01  # chance of a peak anywhere in a campaign where there is none


def peaks(starts: Sequence[Start], force: np.ndarray, steady: pd.DataFrame) -> pd.DataFrame:
    """Return the break-away force F_ba and its share of the sliding force, per file, or per stroke of a single file.

    Where the peak lies is read from the mean of the other units, and a start's own force is then taken there: the
    largest of noisy samples is always too high. `top` is its force above sliding where the mean of all is largest, and
    `places` how many places there are: what a test needs of whether there is a peak at all.

    Parameters
    ----------
    starts : sequence of Start
        At one condition, commanded speed and direction.
    force : ndarray, shape (starts, cells)
        Their mean force in cells of distance, in N, as `cell_means` gives it.
    steady : DataFrame
        Rows of table `steady`, one per start, in the same order.
    """
    samples = float(np.median([s.force_N.size for s in starts]))
    half = int(np.ceil(force.shape[1] * max(SAMPLES / samples, SHARE) / 2))  # of the window, in cells
    sliding = np.array([s.sliding_N for s in starts])
    unit = steady["file"].to_numpy() if steady["file"].nunique() > 1 else np.arange(len(force))
    peak, top = _peaks(*(_window(x, half) for x in (np.nan_to_num(force), np.isfinite(force))), unit)
    places = max(force.shape[1] / (2 * half + 1), 1.0)
    table = {FORCE: peak, RATIO: peak / sliding, TOP: top - sliding, PLACES: places}
    return pd.DataFrame(table).groupby(unit, sort=False).mean().dropna()


def break_away_rows(
    found: Sequence[tuple[Mapping, pd.DataFrame]], widened: Mapping[str, tuple[float, float]], config: Config
) -> Iterator[dict]:
    """Yield rows of table `dynamic_fit` for all break-aways of a campaign.

    The scatter of repeats is pooled within a condition: that of the force as a share of it, that of the ratio as the
    force above the sliding force in N, since what does not cancel in it is the noise of the samples. The force is also
    widened by the scatter of set-ups, which all repeats of a run share. A peak is one where the largest mean stands
    above the sliding force by a t-test at 1 % for all places of all starts of the campaign (Bonferroni); elsewhere
    `reason` says that there is none, and there is no interval.

    Parameters
    ----------
    found : sequence of (keys, DataFrame)
        The condition, commanded speed and direction as columns of the table, and what `peaks` gave there.
    widened : mapping
        Condition -> by how much run means scatter more than repeats would have them (Birge's ratio), and on how many
        degrees of freedom that rests: from the steady fit.
    config : Config
        Gives the units and the sensor's accuracy.
    """
    pooled = {}
    for condition in dict.fromkeys(at["condition"] for at, _ in found):
        alike = [own for at, own in found if at["condition"] == condition]
        pooled[condition, FORCE] = _pooled([np.log(own[FORCE]) for own in alike])
        pooled[condition, SLIDING] = _pooled([np.log(own[FORCE] / own[RATIO]) for own in alike])
        pooled[condition, RATIO] = _pooled([own[FORCE] * (1 - 1 / own[RATIO]) for own in alike])
        pooled[condition, TOP] = _pooled([own[TOP] for own in alike])
    places = sum(float(own[PLACES].max()) for _, own in found)
    for at, own in found:
        condition = at["condition"]
        birge, birge_df = widened.get(condition, (1.0, 1.0))
        setup = max(birge**2 - 1, 0.0) * pooled[condition, SLIDING][0] ** 2
        spread, df = pooled[condition, FORCE]
        above = pooled[condition, RATIO][0] / own[FORCE].mean()
        critical = (
            stats.t.isf(FAMILY / places, df) * pooled[condition, TOP][0] / np.sqrt(len(own)) if df >= 1 else np.inf
        )
        reason = FEW if df < 1 else "" if own[TOP].mean() > critical else NO_PEAK
        force_df = together(((spread**2, df), (setup, birge_df)))
        for name, unit, u_sys, variance, error_df in (
            (FORCE, config.units.unit("force"), config.sensor.u, spread**2 + setup, force_df),
            (RATIO, "", None, above**2, df),
        ):
            value = float(np.exp(np.log(own[name]).mean()))
            row = {"quantity": "break_away", "parameter": name, "value": value, "unit": unit, "u_sys": u_sys}
            if not reason:
                error = np.sqrt(variance / len(own))
                half = stats.t.ppf(0.975, error_df) * error
                row |= {"se": value * error, "lo95": value * np.exp(-half), "hi95": value * np.exp(half)}
            yield {**table_row(**row, identified=not reason, reason=reason), **at}


def _pooled(groups: Sequence[pd.Series]) -> tuple[float, int]:
    """Return the standard deviation within groups, and its degrees of freedom."""
    df = sum(values.size - 1 for values in groups)
    squares = sum(float(((values - values.mean()) ** 2).sum()) for values in groups)
    return float(np.sqrt(squares / df)) if df else np.nan, df


def _peaks(total: np.ndarray, hits: np.ndarray, unit: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return each start's force where the mean of the other units is largest, and of all units, shape (starts,) each.

    Parameters
    ----------
    total, hits : ndarray, shape (starts, cells)
        Sum of the force over a window about each cell, and of how many cells.
    unit : ndarray, shape (starts,)
        Of evidence.
    """

    def highest(starts: np.ndarray) -> int:
        count = hits[starts].sum(axis=0)
        sure = count > count.max() / 2  # a mean of few is mostly noise
        return int(np.argmax(np.where(sure, total[starts].sum(axis=0) / np.maximum(count, 1), -np.inf)))

    everywhere, each = np.ones(len(total), bool), np.arange(len(total))
    others = [unit != own if (unit != own).any() else everywhere for own in unit]
    force = np.where(hits > 0, total / np.maximum(hits, 1), np.nan)
    found = (force[each, [highest(mask) for mask in others]], force[:, highest(everywhere)])
    return tuple(np.where(values > 0.0, values, np.nan) for values in found)


def _window(values: np.ndarray, half: int) -> np.ndarray:
    """Return the sum over each cell and `half` cells to either side, shape of `values`."""
    padded = np.pad(values.astype(float), ((0, 0), (half, half)))
    return sum(padded[:, k : k + values.shape[1]] for k in range(2 * half + 1))
