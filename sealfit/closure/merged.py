"""The rows that the search works on: few enough whatever the campaign, enough of each stroke."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import pandas as pd

from sealfit.fit.declared import declare
from sealfit.fit.rows import POWER, Rows, make_rows, merge, thin

STROKES = 4_000  # that are searched; of more, whole runs are dealt,
RUNS = 1_000  # at least so many, as they are the evidence of most channels,
LEAST_RUNS = 20  # and at least so many for each number of the declared model,
FURTHER = 4  # and so many times as many strokes where the campaign shows more than they do
ROWS = 4_000  # that the search works on; more are merged along their strokes,
PER_STROKE = 8  # to about so many of each stroke,
MOST_ROWS = 8_000  # unless there are more than so many then.
LEAST_PER_STROKE = 4  # where even so many of each are more, some files keep `PER_STROKE`, the others one a stroke


@dataclass(frozen=True)
class Searched:
    """What of a campaign is searched: some runs, or all, and their rows merged along the strokes.

    The same objects stand where there is nothing to leave out or to merge.
    """

    rows: Rows
    coarse: Rows
    every: Rows  # the whole campaign, merged

    @property
    def whole(self) -> bool:
        """Whether all runs are searched."""
        return self.coarse is self.every


def searched(rows: Rows, seed: int) -> Iterator[Searched]:
    """Yield more and more of a campaign's runs, dealt evenly over its conditions, the last time all of them.

    The first part bounds what a search costs by the model, not by the number of files.

    Parameters
    ----------
    rows : Rows
        The campaign, made of bins as `numbered` gives them.
    seed : int
        Of the deal.
    """
    every, most, searched_before = _merged(rows, rows, seed), STROKES, 0
    strokes, runs = (rows.groups.starts[level].size for level in ("stroke", "run"))
    while most < strokes:
        drawn = _dealt(rows, min(max(most / strokes, RUNS / runs), 1.0), seed)
        if searched_before < np.count_nonzero(drawn) < drawn.size:
            part = rows.subset(drawn)
            yield Searched(part, _merged(part, rows, seed), every)
            searched_before = part.force.size
        most *= FURTHER
    yield Searched(rows, every, every)


def _merged(part: Rows, campaign: Rows, seed: int) -> Rows:
    """Return rows merged along their strokes, their conditions and declared model those of the whole campaign."""
    few = merged_bins(part.table.drop(columns=POWER, errors="ignore"), seed)
    if len(few) == part.force.size:
        return part
    made = make_rows(few, has_aging=campaign.has_aging, conditions=campaign.conditions)
    declare(made, as_in=campaign)
    return made


def _dealt(rows: Rows, share: float, seed: int) -> np.ndarray:
    """Return which rows are of the runs drawn, shape (n,): one at random of every 1 / `share` beside each other.

    At least one of each condition, and `LEAST_RUNS` of those that tell a number of the declared model.
    """
    first = rows.groups.starts["run"]
    condition = rows.condition[first]
    drawn = _one_of_each(np.lexsort([np.abs(rows.speed[first]), condition]), share, seed)
    rng = np.random.default_rng(seed)
    _fill(drawn, condition, 1, rng)
    for numbers in declare(rows).index.values():
        _fill(drawn, numbers[condition], LEAST_RUNS, rng)
    return drawn[rows.codes("run")]


def _fill(drawn: np.ndarray, number: np.ndarray, least: int, rng: np.random.Generator) -> None:
    """Draw more at random until there are so many of each number, or all; none of numbers below 0."""
    wanted = least - np.bincount(number[drawn & (number >= 0)], minlength=number.max(initial=0) + 1)
    left = rng.permutation(np.flatnonzero(~drawn & (number >= 0)))
    left = left[np.argsort(number[left], kind="stable")]
    own = number[left]
    place = np.arange(left.size) - np.searchsorted(own, own)
    drawn[left[place < wanted[own]]] = True


def merged_bins(bins: pd.DataFrame, seed: int) -> pd.DataFrame:
    """Return the bins that the search works on: neighbours of a stroke merged where there are many.

    Of very many strokes some files, dealt evenly over the campaign, show what happens along a stroke, in `MOST_ROWS`
    rows; of the others the means are enough.

    Parameters
    ----------
    bins : DataFrame
        As `numbered` gives them.
    seed : int
        Of the deal.
    """
    strokes = bins["stroke_id"].nunique()
    if LEAST_PER_STROKE * strokes <= MOST_ROWS:
        return thin(bins, int(np.clip(PER_STROKE * strokes, ROWS, MOST_ROWS)))
    finely = _files_dealt(bins, MOST_ROWS / (PER_STROKE * strokes), seed)
    together = int(np.ceil(len(bins) / strokes / PER_STROKE))
    return merge(bins, np.where(finely, together, len(bins)))


def _files_dealt(bins: pd.DataFrame, share: float, seed: int) -> np.ndarray:
    """Return whether each row's file is of those drawn, shape (n,): one of every 1 / `share` beside each other."""
    file = pd.factorize(bins["file"])[0]
    first = np.flatnonzero(np.diff(np.maximum.accumulate(file), prepend=-1))
    beside = np.lexsort([pd.factorize(bins[name])[0][first] for name in ("run_id", "condition")])
    return _one_of_each(beside, share, seed)[file]


def _one_of_each(beside: np.ndarray, share: float, seed: int) -> np.ndarray:
    """Return what is drawn, one at random of every 1 / `share` in the order `beside`, shape (n,)."""
    group = np.floor(np.arange(beside.size) * share)
    shuffled = np.lexsort((np.random.default_rng(seed).random(beside.size), group))
    drawn = np.zeros(beside.size, dtype=bool)
    drawn[beside[shuffled[np.flatnonzero(np.diff(group, prepend=-1))]]] = True
    return drawn
