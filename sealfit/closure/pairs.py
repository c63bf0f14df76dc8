"""Pairs of channels, for an effect that shows only in two of them together.

Looked at where no single channel orders the residual. The columns of a pair are mixed terms alone: what either channel
does by itself was tested before and is none of the pair's.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sealfit.closure.channels import FINER, Channel, even_knots, flip_level
from sealfit.closure.search import MAIN_TARGETS, Candidate, inside_specimens, judged, project, weaker
from sealfit.effects.free import BENDS, evenly
from sealfit.fit.estimate import Fitted
from sealfit.fit.joint import term_slope

ALONE = {"direction", "run_order", "elapsed_h"}  # direction has its own tests; the calendar drifts by itself
RARE = 2.0  # pairs are many and seldom at work: they get half of their share of the error
MOST_CATEGORIES = 12  # a slope for each of more would find what single units do


def search_pairs(
    fitted: Fitted, channels: Sequence[Channel], singles: Sequence[Candidate], rng: np.random.Generator
) -> list[Candidate]:
    """Return candidates of two channels, adjusted over these and the single ones, strongest evidence first.

    Parameters
    ----------
    fitted : Fitted
        The current model at its optimum.
    channels : sequence of Channel
        Where to look.
    singles : sequence of Candidate
        What the search of single channels has tried on this model.
    rng : Generator
        For the sign flips.
    """
    usable = [
        c
        for c in channels
        if not (c.grouping or c.name in ALONE) and (c.numeric or np.unique(c.values).size <= MOST_CATEGORIES)
    ]
    found = []
    for one, other in itertools.combinations(usable, 2):
        found += _of_pair(fitted, one, other)
    if not found:
        return []
    pairs = [c for c in judged([*found, *singles], rng) if c.pair]
    return [replace(c, p_value=min(1.0, RARE * c.p_value)) for c in pairs]


def _of_pair(fitted: Fitted, one: Channel, other: Channel) -> list[Candidate]:
    shapes = mixed_columns(one, other)
    if shapes.shape[1] == 0:
        return []
    rows, unit = fitted.rows, flip_level(min(one.unit, other.unit, key=FINER.get), fitted.rows)
    slopes = [term_slope(fitted.model, rows, *target) for target in MAIN_TARGETS]
    left = project(fitted, np.column_stack([shapes * slope[:, None] for slope in slopes]))
    inside = inside_specimens(fitted, left, min(one.unit, other.unit, key=FINER.get))
    width = shapes.shape[1]
    found = []
    for k, target in enumerate(MAIN_TARGETS):
        if "load_N" in (one.name, other.name) and target[0] == "force":
            continue
        place = slice(k * width, (k + 1) * width)
        for columns in dict.fromkeys((1, width)) if one.numeric and other.numeric else (width,):
            judgement = weaker(fitted, left[:, place][:, :columns], inside[:, place][:, :columns], unit)
            if judgement is not None:
                chi2, df, units, log_p, jackknife, scores = judgement
                found.append(
                    Candidate(
                        (one.name, other.name),
                        *target,
                        unit,
                        shapes[:, :columns],
                        chi2,
                        df,
                        units,
                        log_p,
                        jackknife,
                        scores=scores,
                        pair=True,
                    )
                )
    return found


def mixed_columns(one: Channel, other: Channel) -> np.ndarray:
    """Return the mixed terms of two channels, first the plain product, shape (n, k); none for two categories."""
    if not (one.numeric or other.numeric):
        return np.empty((one.values.size, 0))
    if one.numeric and other.numeric:
        u, w = (_centred(c) for c in (one, other))
        columns = np.column_stack([u**j * w**k for j, k in BENDS])
    else:
        number, category = (one, other) if one.numeric else (other, one)
        u = _centred(number)
        levels = np.unique(category.values)
        columns = (category.values[:, None] == levels[None, 1:]) * u[:, None]
    size = np.sqrt((columns**2).mean(axis=0))
    return columns[:, size > 1e-9] / size[size > 1e-9]


def _centred(channel: Channel) -> np.ndarray:
    mapped = evenly(channel.values, even_knots(channel.values))
    return mapped - mapped.mean()
