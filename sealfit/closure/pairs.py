"""Pairs of channels, for an effect that shows only in two of them together.

Looked at where no single channel orders the residual. The columns of a pair are mixed terms alone: what either channel
does by itself was tested before and is none of the pair's.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from sealfit.closure.channels import FINER, Channel, even_knots, flip_level, off_zero, scatter_level
from sealfit.closure.multiplicity import judged
from sealfit.closure.score_test import Candidate, ScoreTests
from sealfit.closure.search import MAIN_TARGETS
from sealfit.effects.free import BENDS, evenly

BEHIND = {"a": "aging_days", "b": "aging_days", "v_s": "speed_mm_s", "sigma_2": "speed_mm_s"}  # along it each acts
ALONE = {"direction", "run_order", "elapsed_h"}  # direction has its own tests; the calendar drifts by itself
LOGARITHMIC = 5.0  # span of a positive channel from which its logarithm is tried as well
RARE = 2.0  # pairs are many and seldom at work: they get half of their share of the error
MOST_CATEGORIES = 12  # a slope for each of more would find what single units do


def search_pairs(
    judge: ScoreTests, channels: Sequence[Channel], singles: Sequence[Candidate], rng: np.random.Generator
) -> list[Candidate]:
    """Return candidates of two channels, adjusted over these and the single ones, strongest evidence first.

    Parameters
    ----------
    judge : Judge
        Of the current model.
    channels : sequence of Channel
        Where to look.
    singles : sequence of Candidate
        What the search of single channels has tried on this model.
    rng : Generator
        For the sign flips.
    """
    found = [c for pair in itertools.combinations(_usable(channels), 2) for c in _of_pair(judge, *pair)]
    if not found:
        return []
    pairs = [c for c in judged(judge, [*found, *singles], rng) if c.pair]
    return [replace(c, p_value=min(1.0, RARE * c.p_value)) for c in pairs]


def pairs_in_disguise(
    judge: ScoreTests, significant: Sequence[Candidate], channels: Mapping[str, Channel]
) -> list[Candidate]:
    """Return the pairs that a channel's change of a or of v_s may stand for.

    a is how mu changes with days, v_s how it changes with speed. The pair explains the same significant structure, so
    it is tried beside the single channel whatever its own p-value; the fits decide.

    Parameters
    ----------
    judge : Judge
        Of the current model.
    significant : sequence of Candidate
        What the search has accepted on it.
    channels : mapping
        Channels by name.
    """
    best: dict[frozenset, list[Candidate]] = {}
    for single in significant:
        pair = frozenset((*single.channels, BEHIND.get(single.acts_on)))
        if single.pair or len(pair) != 2 or not pair <= channels.keys() or pair in best:
            continue
        members = _usable([channels[name] for name in sorted(pair)])
        found = _of_pair(judge, *members) if len(members) == 2 else []
        strongest = [max(own, key=lambda c: c.chi2) for t in MAIN_TARGETS if (own := [c for c in found if _on(c, t)])]
        best[pair] = [
            replace(c, test_result=c.test_result._replace(chi2=max(c.chi2, single.chi2)), p_value=single.p_value)
            for c in strongest
        ]
    return list(itertools.chain.from_iterable(best.values()))


def _on(candidate: Candidate, target: tuple[str, str]) -> bool:
    return (candidate.acts_on, candidate.operation) == target


def _usable(channels: Sequence[Channel]) -> list[Channel]:
    return [
        c
        for c in channels
        if not (c.grouping or c.name in ALONE) and (c.numeric or np.unique(c.values).size <= MOST_CATEGORIES)
    ]


def _of_pair(judge: ScoreTests, one: Channel, other: Channel) -> list[Candidate]:
    blocks = mixed_columns(one, other)
    if not blocks:
        return []
    fitted, finer = judge.fitted, min(one.unit, other.unit, key=FINER.get)
    between = scatter_level((one, other), fitted.rows)
    level = flip_level(finer, fitted.rows)
    shapes = np.column_stack(blocks)
    ends = np.cumsum([0, *(block.shape[1] for block in blocks)])
    found = []
    for target in MAIN_TARGETS:
        if "load_N" in (one.name, other.name) and target[0] == "force":
            continue
        variants = judge.variants(shapes * fitted.slope(*target)[:, None], finer)
        for block, first, last in zip(blocks, ends[:-1], ends[1:], strict=True):
            test_result = judge([v[:, first:last] for v in variants], between, level, target)
            if test_result is not None:
                names = (one.name, other.name)
                found.append(Candidate(names, *target, level, block, test_result, pair=True))
    return found


def mixed_columns(one: Channel, other: Channel) -> list[np.ndarray]:
    """Return the mixed terms of two channels, blocks of shape (n, k) to be judged each; none for two categories.

    The plain product, also of logarithms where a channel spans enough for them to matter: what either does alone may
    hold nearly all of a product, and the rest depends on its exact shape. Then bent terms, for what is no product.
    """
    if not (one.numeric or other.numeric):
        return []
    if one.numeric and other.numeric:
        products = [(u * w)[:, None] for u in _scales(one) for w in _scales(other)]
        u, w = _even(one), _even(other)
        blocks = [*products, np.column_stack([u**j * w**k for j, k in BENDS])]
    else:
        number, category = (one, other) if one.numeric else (other, one)
        u = _even(number)
        levels = np.unique(category.values)
        blocks = [(category.values[:, None] == levels[None, 1:]) * u[:, None]]
    sizes = [np.sqrt((columns**2).mean(axis=0)) for columns in blocks]
    blocks = [columns[:, size > 1e-9] / size[size > 1e-9] for columns, size in zip(blocks, sizes, strict=True)]
    return [columns for columns in blocks if columns.shape[1]]


def _scales(channel: Channel) -> list[np.ndarray]:
    """Return a channel, centred, and its logarithm where that is another shape (from 0 on, moved by its least)."""
    x = channel.values
    scales = [x]
    if x.min() >= 0 and x.max() > LOGARITHMIC * x[x > 0].min(initial=np.inf):
        scales.append(np.log(off_zero(x)))
    return [_centred(x) / max(float(np.ptp(x)), 1e-300) for x in scales]


def _even(channel: Channel) -> np.ndarray:
    return _centred(evenly(channel.values, even_knots(channel.values)))


def _centred(values: np.ndarray) -> np.ndarray:
    return values - values.mean()
