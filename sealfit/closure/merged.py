"""The rows that the search works on: few enough whatever the campaign, enough of each stroke."""

from __future__ import annotations

import numpy as np
import pandas as pd

from sealfit.fit.rows import merge, thin

ROWS = 4_000  # that the search works on; more are merged along their strokes,
PER_STROKE = 8  # to about so many of each stroke,
MOST_ROWS = 8_000  # unless there are more than so many then.
LEAST_PER_STROKE = 4  # where even so many of each are more, some files keep `PER_STROKE`, the others one a stroke


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
    finely = _dealt(bins, MOST_ROWS / (PER_STROKE * strokes), seed)
    together = int(np.ceil(len(bins) / strokes / PER_STROKE))
    return merge(bins, np.where(finely, together, len(bins)))


def _dealt(bins: pd.DataFrame, share: float, seed: int) -> np.ndarray:
    """Return whether each row's file is of those drawn: one at random of every 1 / `share` beside each other."""
    file, names = pd.factorize(bins["file"])
    first = np.flatnonzero(np.diff(np.maximum.accumulate(file), prepend=-1))
    beside = np.lexsort([pd.factorize(bins[name])[0][first] for name in ("run_id", "condition")])
    group = np.floor(np.arange(len(names)) * share)
    shuffled = np.lexsort((np.random.default_rng(seed).random(len(names)), group))
    drawn = np.zeros(len(names), dtype=bool)
    drawn[beside[shuffled[np.flatnonzero(np.diff(group, prepend=-1))]]] = True
    return drawn[file]
