r"""P-values adjusted for the whole search: for every channel, quantity and width that was tried.

Flipping the signs of whole units at random many times costs one matrix product a candidate, and the largest
standardised T over all candidates gives the p-value adjusted for the search (Westfall & Young 1993; sign flips of score
contributions: Hemerik, Goeman & Finos 2020, doi:10.1111/rssb.12369). P-values by the jackknife are adjusted by the
number of candidates (Bonferroni); each way has half of the error. Tests on few specimens are adjusted by draws (`few`),
contrasts in few units by their number (`slopes`).
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sealfit.closure import small_sample_test
from sealfit.closure.contrasts import slope_log_p
from sealfit.closure.score_test import (
    JACKKNIFE_UNITS,
    Candidate,
    ScoreTestResult,
    ScoreTests,
    log_p_of,
    score_statistic,
)
from sealfit.closure.small_sample_test import ClusterTests, SmallSampleTest
from sealfit.fit.estimate import Fitted

FLIPS = 1999  # resolves p = 0.0005, a tenth of the family-wise level
MOST_SIGNS = 1 << 22  # drawn at once: 34 MB
SEARCHES = 2  # single channels and pairs of them: each search has half of the error


def judged(judge: ScoreTests, candidates: Sequence[Candidate], rng: np.random.Generator) -> list[Candidate]:
    """Return candidates with p-values adjusted over all of them, strongest evidence first."""
    judgements = [c.test_result for c in candidates]
    p_values = np.ones(len(candidates))
    many = [k for k, j in enumerate(judgements) if j.few is None and not j.slopes]
    if many:
        p_values[many] = adjust([judgements[k] for k in many], rng)
    for k in many:
        if judgements[k].scores.shape[0] >= JACKKNIFE_UNITS:  # of two ways, each has half of the error
            p_values[k] = 2 * min(p_values[k], len(many) * np.exp(judgements[k].log_p_jackknife))
    few_p = np.min([adjust_few(units, judgements, rng) for units in judge.few.values()], axis=0)
    p_values = np.minimum(p_values, np.minimum(few_p, adjust_slopes(judgements)))
    p_values[[j.few is not None and bool(j.slopes) for j in judgements]] *= 2  # of two ways, each has half of the error
    found = [replace(c, p_value=min(1.0, SEARCHES * float(p))) for c, p in zip(candidates, p_values, strict=True)]
    return sorted(found, key=lambda c: -c.evidence)


def adjust(judgements: Sequence[ScoreTestResult], rng: np.random.Generator, flips: int = FLIPS) -> np.ndarray:
    """Return each p-value adjusted over all judgements, by the maximum over sign flips, shape (m,).

    Those of as many units are flipped with the same signs, so that what they share counts once.
    """
    return _adjusted([j.log_p for j in judgements], _least(judgements, rng, flips))


def critical_many(judgements: Sequence[ScoreTestResult], level: float, rng: np.random.Generator) -> float:
    """Return the log p-value, not adjusted, that the smallest of all judgements falls below by chance at a level."""
    return float(np.quantile(_least(judgements, rng, FLIPS), level))


def critical_few(fitted: Fitted, tests: Sequence[SmallSampleTest], level: float) -> float:
    """Return the same for the tests on few units of one level."""
    units = ClusterTests(fitted, tests[0].level)
    for test in tests:
        units.numbers(test.target)
    return float(np.quantile(_least_few(units, tests, np.random.default_rng(0), FLIPS), level))


def _least(judgements: Sequence[ScoreTestResult], rng: np.random.Generator, flips: int) -> np.ndarray:
    """Return the smallest log p-value of all judgements under each of many random flips."""
    alike = defaultdict(lambda: defaultdict(list))
    for test_result in judgements:
        units, df = test_result.scores.shape
        alike[units][df].append(test_result.scores)
    least = np.zeros(flips)
    for units, by_df in alike.items():
        scores = np.column_stack([own for scores in by_df.values() for own in scores])
        totals = _flipped(scores, flips, rng)
        first = 0
        for df, scores in by_df.items():
            most = np.zeros(flips)  # the largest T has the smallest p-value where units and df are the same
            for own in scores:
                most = np.maximum(most, score_statistic(totals[:, first : first + df], own))
                first += df
            least = np.minimum(least, log_p_of(most, df, units))
    return least


def _flipped(scores: np.ndarray, flips: int, rng: np.random.Generator) -> np.ndarray:
    """Return the sums of scores, shape (units, m), under random signs -> (flips, m); a few flips at a time."""
    part = max(1, MOST_SIGNS // scores.shape[0])
    return np.concatenate(
        [
            rng.choice([-1.0, 1.0], size=(min(part, flips - first), scores.shape[0])) @ scores
            for first in range(0, flips, part)
        ]
    )


def adjust_few(
    units: ClusterTests, judgements: Sequence[ScoreTestResult], rng: np.random.Generator, draws: int = FLIPS
) -> np.ndarray:
    """Return the p-values of the tests on few units of a level, adjusted over all of them, shape (m,); 1 for none."""
    p_values = np.ones(len(judgements))
    tried = [k for k, j in enumerate(judgements) if j.few is not None and j.few.level == units.level]
    if tried:
        tests = [judgements[k].few for k in tried]
        logs = np.array([test.log_p for test in tests])
        least = _least_few(units, tests, rng, draws)
        p_values[tried] = np.minimum(_adjusted(logs, least), len(tried) * np.exp(logs))  # below what draws resolve
    return p_values


def _least_few(
    units: ClusterTests, tests: Sequence[SmallSampleTest], rng: np.random.Generator, draws: int
) -> np.ndarray:
    """Return the smallest log p-value of all tests on few units of one level in each of many draws."""
    drawn = units.draws(draws, rng)
    return np.min([small_sample_test.log_p_of(drawn[test.target], test.basis, test.known) for test in tests], axis=0)


def adjust_slopes(judgements: Sequence[ScoreTestResult]) -> np.ndarray:
    """Return the p-values of the contrasts in few units, times the number of all contrasts, shape (m,); 1 for none.

    A candidate has that of its strongest contrast, by the variant of it that says least.
    """
    p_values = np.ones(len(judgements))
    tried = [k for k, j in enumerate(judgements) if j.slopes]
    if tried:
        logs = iter(slope_log_p([test for k in tried for test in judgements[k].slopes]))
        least = [max(float(next(logs).min()) for _ in judgements[k].slopes) for k in tried]
        count = sum(judgements[k].slopes[0].slope.size for k in tried)
        p_values[tried] = np.minimum(count * np.exp(least), 1.0)
    return p_values


def _adjusted(own: Sequence[float], least: np.ndarray) -> np.ndarray:
    """Return p-values from log p and the least of all candidates under chance, drawn many times."""
    return (1 + np.searchsorted(np.sort(least), own, side="right")) / (least.size + 1)
