r"""Free shapes of a category: a level for each, or a straight line in another channel for each.

.. math:: h = \sum_k d_k [x = k], \qquad h = \sum_k e_k [z = k] (x - x_{ref})

Like the others (`sealfit.effects.free`) they name no mechanism. Levels are counted from their mean over the campaign
where that is given: a constant that came in with them would stand for friction.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial

import numpy as np

from sealfit.effects.contract import AMPLITUDE, ANYWHERE, CHANNEL, SECOND, Effect, Parameter, reference
from sealfit.errors import ParameterError

LEVELS, SLOPES = "levels", "slopes"
LESS_MEAN = "; less its mean over the campaign"
MEAN_OF_CAMPAIGN = "mean over {x} in the campaign"  # the reference of a shape less its mean


def levels_effect(categories: Sequence[str], means: Sequence[float] | None = None) -> Effect:
    """Return one level per category of the channel, as differences from the first category.

    Parameters
    ----------
    categories : sequence of str
        At least two different categories.
    means : sequence of float, optional
        Share of each category in the campaign, for levels whose mean is zero; else the first category is zero.

    Returns
    -------
    Effect
        Amplitudes `d_1`, `d_2`, ... for the categories after the first. A category that is not listed gives NaN.

    Raises
    ------
    ParameterError
        If there are fewer than two categories, or one stands twice.
    """
    names = _different(LEVELS, categories)
    return Effect(
        id=LEVELS,
        label="levels of {x}",
        equation=r"h = \sum_k d_k [x = k]",
        form=f"d_k for category k of {listed(names)}; 0 for {names[0]}" + LESS_MEAN * (means is not None),
        reference=MEAN_OF_CAMPAIGN if means is not None else f"{{x}} = {names[0]}",
        reads=(CHANNEL,),
        acts_on=ANYWHERE,
        parameters=tuple(
            Parameter(f"d_{k}", "{y}", 0.0, AMPLITUDE, f"{name} less {names[0]}", linear=True)
            for k, name in enumerate(names[1:], start=1)
        ),
        shape=partial(_levels, names, shares(means, len(names))),
        source="Form: ours. One number per category, as in any analysis of variance.",
        # By hand: the last category has its own difference.
        worked=(
            {CHANNEL: names[-1]},
            {f"d_{k}": k / 10 for k in range(1, len(names))},
            (len(names) - 1) / 10 - sum(k / 10 * m for k, m in enumerate(shares(means, len(names)))),
        ),
        physical=False,
    )


def _different(id: str, categories: Sequence[str]) -> tuple[str, ...]:
    names = tuple(str(c) for c in categories)
    if len(names) < 2 or len(set(names)) != len(names):
        raise ParameterError(f"{id}: {list(names)} must be two or more different categories.", fix="List each once.")
    return names


def _levels(names: tuple[str, ...], means: tuple[float, ...], inputs: Mapping, **values) -> np.ndarray:
    given = np.asarray(inputs[CHANNEL]).astype(str)
    level = [0.0, *(values[f"d_{k}"] for k in range(1, len(names)))]
    mean = sum(d * m for d, m in zip(level, means, strict=True))
    result = np.full(given.shape, np.nan)
    for name, d in zip(names, level, strict=True):
        result[given == name] = d - mean
    return result


def slopes_effect(categories: Sequence[str]) -> Effect:
    """Return a straight line in a channel for each category of a second one, all zero at the reference.

    Parameters
    ----------
    categories : sequence of str
        At least two different categories.

    Returns
    -------
    Effect
        Amplitudes `e_1`, `e_2`, ..., the slope of each category. A category that is not listed gives NaN.

    Raises
    ------
    ParameterError
        If there are fewer than two categories, or one stands twice.
    """
    names = _different(SLOPES, categories)
    return Effect(
        id=SLOPES,
        label="linear in {x}, by {z}",
        equation=r"h = \sum_k e_k [z = k] (x - x_{ref})",
        form=f"e_k (x - x_ref) for category k of {listed(names)}",
        reference="{x} = {x_ref}",
        reads=(CHANNEL, SECOND),
        acts_on=ANYWHERE,
        parameters=tuple(
            Parameter(f"e_{k}", "{y}/{x}", 0.0, AMPLITUDE, f"slope for {name}", linear=True)
            for k, name in enumerate(names, start=1)
        ),
        shape=partial(_slopes, names),
        source="Form: ours. One slope per category, as in any analysis of covariance.",
        # By hand: 3 above the reference, in the last category.
        worked=(
            {CHANNEL: 5.0, "x_ref": 2.0, SECOND: names[-1]},
            {f"e_{k}": k / 10 for k in range(1, len(names) + 1)},
            0.3 * len(names),
        ),
        physical=False,
    )


def _slopes(names: tuple[str, ...], inputs: Mapping, **values) -> np.ndarray:
    x = np.asarray(inputs[CHANNEL], dtype=float) - reference(inputs, CHANNEL, 0.0)
    given = np.asarray(inputs[SECOND]).astype(str)
    slope = np.full(given.shape, np.nan)
    for k, name in enumerate(names, start=1):
        slope[given == name] = values[f"e_{k}"]
    return slope * x


def shares(means: Sequence[float] | None, count: int) -> tuple[float, ...]:
    """Return what is taken off a shape, by its amplitudes: their `means` over the campaign, or nothing."""
    return (0.0,) * count if means is None else tuple(float(m) for m in means)


def listed(values: Sequence[object]) -> str:
    """Return values in words."""
    return ", ".join(f"{v:.6g}" if isinstance(v, float) else str(v) for v in values)
