"""Bands and error bars, each as one artist: what a figure costs is how many artists it has."""

from __future__ import annotations

import itertools

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from numpy.typing import ArrayLike


def draw_band(ax: Axes, x: ArrayLike, low: ArrayLike, high: ArrayLike, colour: str, alpha: float) -> None:
    """Shade what lies between two lines, where both are known; what is drawn after it scales the axes."""
    x, low, high = (np.asarray(values, float) for values in (x, low, high))
    known = np.isfinite(x + low + high)
    upward, downward = np.column_stack([x, low]), np.column_stack([x, high])[::-1]
    ends = [0, *np.flatnonzero(np.diff(known)) + 1, len(x)]
    pieces = [
        np.concatenate([upward[begin:end], downward[len(x) - end : len(x) - begin]])
        for begin, end in itertools.pairwise(ends)
        if end > begin and known[begin]
    ]
    if pieces:
        ax.add_collection(PolyCollection(pieces, facecolor=colour, alpha=alpha, linewidth=0), autolim=False)
        ax.update_datalim(np.concatenate(pieces))


def draw_bars(
    ax: Axes, x: ArrayLike, y: ArrayLike, below: ArrayLike, above: ArrayLike, *, colour: str, width: float, cap: float,
    **look: object,
) -> None:  # fmt: skip
    """Draw bars from `y - below` to `y + above` as one line: matplotlib's error bars are four artists and a container.

    Parameters
    ----------
    ax : Axes
        Drawn on; the caller owns the figure.
    x, y, below, above : array, shape (n,)
        Where the bars stand, and how far they reach.
    colour : str
        Theirs and that of their caps.
    width, cap : float
        Of the line, and half of that of a cap (0: none), in points.
    **look
        What else matplotlib's `plot` shall know.
    """
    x, y, below, above = (np.asarray(values, float) for values in (x, y, below, above))
    gap = np.full(len(x), np.nan)
    ax.plot(
        np.column_stack([x, x, gap]).ravel(),
        np.column_stack([y - below, y + above, gap]).ravel(),
        color=colour,
        linewidth=width,
        marker="_" if cap else "",
        markersize=2 * cap,
        solid_capstyle="butt",
        **look,
    )
