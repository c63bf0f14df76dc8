"""Samples of traces as table `traces` holds them, those of a stroke one after the other."""

from __future__ import annotations

import numpy as np
import pandas as pd


def strokes_of(traces: pd.DataFrame, strokes: pd.DataFrame) -> tuple[np.ndarray, np.ndarray]:
    """Return where each stroke's samples begin, the end of the last added, and which row of `strokes` each is.

    Parameters
    ----------
    traces : DataFrame
        Rows of table `traces`.
    strokes : DataFrame
        Columns `file` and `stroke`, a row per stroke.

    Returns
    -------
    edges : ndarray of int, shape (n + 1,)
        Samples edges[k] to edges[k + 1] are one stroke.
    own : ndarray of int, shape (n,)
        Its row in `strokes`; -1 where it is not among them.
    """
    file, stroke = traces["file"].to_numpy(), traces["stroke"].to_numpy()
    first = np.flatnonzero(np.r_[True, (file[1:] != file[:-1]) | (stroke[1:] != stroke[:-1])])
    own = pd.MultiIndex.from_frame(strokes[["file", "stroke"]]).get_indexer(
        pd.MultiIndex.from_arrays([file[first], stroke[first]])
    )
    return np.r_[first, file.size], own


def noise_from_bends(bends: np.ndarray) -> float:
    """Return the standard deviation of a sample from second differences of neighbours; 0 without any.

    Their variance is six times a sample's; the median absolute deviation is blind to where the signal itself bends.
    """
    return 1.4826 * float(np.median(np.abs(bends - np.median(bends)))) / np.sqrt(6.0) if bends.size else 0.0
