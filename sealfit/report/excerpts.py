"""What of a large campaign is shown: as many panels, rows and keys as a person looks at, chosen, and said so."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TypeVar

import numpy as np
import pandas as pd

from sealfit.report.notation import count
from sealfit.report.style import evenly

MOST_PANELS = 12  # of a figure
MOST_KEYS = 16  # of a legend
MOST_MARKS = 300  # of a panel, until they are drawn as pixels: more makes an SVG large and shows nothing
MOST_ROWS = 200  # conditions or series of a table

Thing = TypeVar("Thing")


def spread(things: Sequence[Thing], most: int) -> list[Thing]:
    """Return at most so many of some things, evenly from the first to the last.

    Examples
    --------
    >>> spread("abcdefghi", 3), spread("ab", 3)
    (['a', 'e', 'i'], ['a', 'b'])
    """
    return [things[k] for k in evenly(len(things), min(most, len(things)))]


def telling(
    things: Sequence[Thing], misfit: Sequence[float], heat: Sequence[float], what: str
) -> tuple[list[Thing], str]:
    """Return the things that panels are drawn of, in their order, and in words which of how many they are.

    Parameters
    ----------
    things : sequence
        Series, say, in the order of the panels.
    misfit, heat : sequence of float
        Of each, how far measurements lie from the model and how hot it was; NaN where that is not known.
    what : str
        What several of them are called.

    Returns
    -------
    list, str
        All of them and "" where there are few; else those with the largest misfit, the hottest, and others spread
        evenly, a third each.

    Examples
    --------
    >>> telling(range(40), [0.0] * 39 + [1.0], [20.0] * 40, "series")[1]
    '12 of 40 series are drawn: the 4 with the largest misfit and 8 spread over the others.'
    """
    if len(things) <= MOST_PANELS:
        return list(things), ""
    third, picked, said = MOST_PANELS // 3, [], []
    for values, words in ((misfit, "with the largest misfit"), (heat, "hottest")):
        values = np.asarray(values, float)
        order = [k for k in np.argsort(-values, kind="stable").tolist() if np.isfinite(values[k]) and k not in picked]
        if len(set(values[np.isfinite(values)].tolist())) > 1:
            picked += order[:third]
            said.append(f"the {third} {words}")
    rest = spread([k for k in range(len(things)) if k not in picked], MOST_PANELS - len(picked))
    said.append(f"{len(rest)} spread over the others" if picked else "spread evenly")
    words = " and ".join([", ".join(said[:-1]), said[-1]]) if len(said) > 1 else said[0]
    text = f"{MOST_PANELS} of {count(len(things), what, what)} are drawn: {words}."
    return [things[k] for k in sorted([*picked, *rest])], text


def condition_misfits(tables: Mapping[str, pd.DataFrame]) -> dict[str, float]:
    """Return the rms misfit of every condition: of the closed loop, or of its own steady fit where that was not run."""
    residuals = tables["residuals_after"]
    if len(residuals):
        squares = residuals["residual_N"].astype(float) ** 2
        return np.sqrt(squares.groupby(residuals["condition"]).mean()).to_dict()
    fit = tables["steady_fit"]
    rows = fit[fit["parameter"].isin(["rmse_N", "rmse"])]
    return dict(zip(rows["condition"], rows["value"].astype(float), strict=True))


def rms(values: Iterable[float]) -> float:
    """Return the root of the mean square of the known values; NaN where there is none."""
    known = np.array([value for value in values if np.isfinite(value)], float)
    return float(np.sqrt(np.mean(known**2))) if len(known) else float("nan")
