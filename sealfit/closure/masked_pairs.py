r"""Two effects that hide each other: each stands in the other's error, and neither passes a test of its own.

Looked at where nothing else is significant, in few units. The pairs are simple ones only: two straight lines (an
offset, for the direction) that share a channel or of which one is of the direction, and a line along strokes with its
change along a coarser channel. Both columns must move each unit along one direction, so that a unit is one number; then

.. math:: F = \frac{(RSS_0 - RSS_{12}) / 2}{RSS_{12} / (d - 2)}

holds both against what the units scatter by beside them, exactly where that scatter is normal and alike. P-values are
adjusted for the number of pairs (Bonferroni). A pair counts where each of the two is significant given the other.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from sealfit.closure.channels import Channel, scatter_level
from sealfit.closure.contrasts import LEAST_UNITS
from sealfit.closure.multiplicity import SEARCHES
from sealfit.closure.score_test import CONSTANT, JACKKNIFE_UNITS, Candidate, ScoreTests
from sealfit.closure.search import MAIN_TARGETS
from sealfit.closure.small_sample_test import LEAST_ERROR_OF_RUNS, log_p_of
from sealfit.fit.reml import orthonormal

OF_DIRECTION = (("force", "add"), ("mu", "multiply"), ("mu_c", "multiply"), ("sigma_2", "add"))
SEPARATE = 1e-3  # singular value of two columns of length 1 below which they are one


class MaskedPair(NamedTuple):
    """Two effects that hide each other: what the tests say of both together, and the keys of their candidates."""

    p_value: float  # adjusted
    chi2: float  # whitened sum of squares they explain
    keys: tuple[tuple, ...]  # of those not in the model yet

    def without(self, key: tuple) -> MaskedPair:
        """Return what is left once one of them is in the model."""
        return MaskedPair(self.p_value, 0.0, tuple(k for k in self.keys if k != key))


def search_masked_pairs(
    judge: ScoreTests, channels: Mapping[str, Channel], candidates: Sequence[Candidate], alpha: float
) -> list[MaskedPair]:
    """Return the pairs that are significant jointly, most significant first.

    Parameters
    ----------
    judge : Judge
        Of the current model.
    channels : mapping
        Channels by name.
    candidates : sequence of Candidate
        What the searches of single channels and of pairs have tried on this model.
    alpha : float
        Level of the search, and of each of the two given the other.
    """
    tested = [(two, _tested(judge, two, level)) for two, level in _pairs(judge, channels, candidates)]
    tested = [(two, test) for two, test in tested if test is not None]
    found = [
        MaskedPair(min(1.0, SEARCHES * len(tested) * float(np.exp(joint))), chi2, tuple(c.key for c in two))
        for two, (joint, given, chi2) in tested
        if given <= np.log(alpha)
    ]
    return sorted(pair for pair in found if pair.p_value <= alpha)


def _pairs(
    judge: ScoreTests, channels: Mapping[str, Channel], candidates: Sequence[Candidate]
) -> Iterator[tuple[tuple[Candidate, Candidate], str]]:
    """Yield the pairs to be tested and the level of their units."""
    rows = judge.fitted.rows
    straight = [c for c in candidates if c.columns.shape[1] == 1 and c.sure]
    between = {c.channels: [channels[n] for n in c.channels if n != "direction"] for c in straight}
    level = {id(c): scatter_level(between[c.channels] or [channels["direction"]], rows) for c in straight}
    lines = [c for c in straight if not c.pair and (c.acts_on, c.operation) in _targets(c)]
    lines = list({c.key: c for c in reversed(lines)}.values())
    products = [c for c in straight if c.pair]
    for one, other in (*itertools.combinations(lines, 2), *itertools.product(lines, products)):
        shared = level[id(one)] == level[id(other)]
        few = LEAST_UNITS <= rows.groups.starts[level[id(one)]].size < JACKKNIFE_UNITS
        if shared and few and _together(one, other, channels):
            yield (one, other), level[id(one)]


def _together(line: Candidate, other: Candidate, channels: Mapping[str, Channel]) -> bool:
    """Whether a line and another, or a product, are one of the simple pairs."""
    name = line.channels[-1]
    if not other.pair:
        return name == other.channels[-1] or ("direction",) in (line.channels, other.channels)
    inside = [channels[n].unit == "sample" for n in other.channels]
    return (
        name in other.channels and channels[name].unit == "sample" and not all(inside) and line.acts_on == other.acts_on
    )


def _targets(candidate: Candidate) -> Sequence[tuple[str, str]]:
    return OF_DIRECTION if candidate.channels == ("direction",) else MAIN_TARGETS


def _tested(judge: ScoreTests, two: tuple[Candidate, Candidate], level: str) -> tuple[float, float, float] | None:
    """Return log p of two candidates jointly, the larger of each given the other, and what they explain; else None.

    None is where they are no pair. Of all variants in which they must hold, what says least.
    """
    fitted = judge.fitted
    columns = np.column_stack([c.columns * fitted.slope(c.acts_on, c.operation)[:, None] for c in two])
    unit = min((c.unit for c in two), key=lambda name: fitted.rows.groups.starts[name].size)
    white = fitted.whitening(columns)
    numbers = judge.few[level].along(_larger(white, fitted.rows.groups, level))
    found = []
    for left in judge.variants(columns, unit):
        own = fitted.rows.groups.sums(numbers.direction[:, None] * left, level)
        if ((own**2).sum(axis=0) <= CONSTANT * (left**2).sum(axis=0)).any() or not left.any(axis=0).all():
            return None
        made = numbers.root @ own
        made = made / np.sqrt((made**2).sum(axis=0))
        basis = orthonormal(made, SEPARATE)
        if basis.shape[1] < 2 or numbers.df - 2 < LEAST_ERROR_OF_RUNS:
            return None
        joint = log_p_of(numbers.values[None, :], basis, 0.0, numbers.df)[0]
        given = max(_given(numbers.values, *made.T[order], numbers.df) for order in ([0, 1], [1, 0]))
        found.append((joint, given, -float(((orthonormal(left, SEPARATE).T @ fitted.white_residual) ** 2).sum())))
    joint, given, chi2 = np.max(found, axis=0).tolist()
    return joint, given, -chi2


def _given(values: np.ndarray, one: np.ndarray, other: np.ndarray, df: int) -> float:
    """Return log p of one column of independent numbers given another, all of shape (d,), the columns of length 1."""
    rest = one - (one @ other) * other
    left = values - (values @ other) * other
    return float(log_p_of(left[None, :], rest[:, None] / np.linalg.norm(rest), 0.0, df - 1)[0])


def _larger(white: np.ndarray, groups, level: str) -> np.ndarray:
    """Return in each unit the larger of two columns, shape (n,): the direction along which both may move it."""
    size = groups.sums(white**2, level)
    return white[np.arange(len(white)), size.argmax(axis=1)[groups.codes[level]]]
