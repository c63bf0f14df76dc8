"""P-values adjusted for the whole search: all channels, quantities and numbers of columns."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from scipy.optimize import brentq
from scipy.special import log_ndtr, polygamma, psi, stdtr

from sealfit.closure import small_sample_test
from sealfit.closure.criteria import JACKKNIFE_UNITS, SEARCHES, UNEQUAL_RUNS
from sealfit.closure.score_test import Candidate, ScoreTestResult, ScoreTests, log_p_of_score, to_orthonormal
from sealfit.closure.small_sample_test import ClusterTests, ContrastTest, SmallSampleTest
from sealfit.fit.joint import Fitted
from sealfit.fit.joint.rows import POWER

# The signs of whole units are flipped at random many times. The largest T over all candidates gives the
# p-value adjusted for the search (Westfall & Young 1993; sign flips of score contributions: Hemerik, Goeman &
# Finos 2020, doi:10.1111/rssb.12369). P-values by the jackknife are adjusted for the number of candidates
# (Bonferroni). Tests on few specimens are adjusted by random draws, contrasts in few units by their effective
# number. Draws continue until the smallest p-value is known well enough (sequential Monte Carlo p-values:
# Besag & Clifford 1991, Biometrika 78(2), 301-304, doi:10.1093/biomet/78.2.301).

FLIPS = 1999  # Number of random sign flips, or draws, that are made at a time.
# Their largest number: a p-value of 0.00125, four times which is 0.005, has an error of 13 %.
MOST_FLIPS = 25 * FLIPS
ENOUGH = 50  # Number of draws below the smallest p-value that determine it well enough.
# Share of the variance of contrasts that their effective number of principal components has. In 99,000 draws
# of noise (white, heavy-tailed, each unit with a slope of its own) in 22 designs, the smallest p-value of 90
# to 500 contrasts, adjusted by this number and that of the places, was below 0.0023 in 0.1, 0.1 and 0.25 %.
SHOWN_VARIANCE = 0.995
# Variables of operation: a rig is built to show how friction depends on them. They are few, and an effect of
# t = 10 between seven specimens was not significant among the contrasts of all columns. In 447 worlds without
# an effect, drawn at random, two of their p-values were below 0.1: 7e-5 (0.001 among all contrasts), 0.013.
OPERATION = frozenset({"speed_mm_s", "load_N", POWER, "direction"})
MOST_SIGNS = 1 << 22  # Signs of all units that are drawn at once (34 MB), or beyond `FLIPS`.


def adjust_all(
    tests: ScoreTests, candidates: Sequence[Candidate], rng: np.random.Generator
) -> list[Candidate]:
    """Return candidates with p-values adjusted over all of them, strongest evidence first."""
    results = [c.test_result for c in candidates]
    p_values = np.ones(len(candidates))
    many = [k for k, r in enumerate(results) if r.small_sample is None and not r.slopes]
    if many:
        p_values[many] = adjust([results[k] for k in many], rng)
    for k in many:
        if results[k].scores.shape[0] >= JACKKNIFE_UNITS:  # two tests, each with half of the error rate
            p_values[k] = 2 * min(p_values[k], len(many) * np.exp(results[k].log_p_jackknife))
    for units in tests.cluster_tests.values():
        p_values = np.minimum(p_values, adjust_small_sample(units, results, rng))
    p_values = np.minimum(p_values, adjust_slopes(candidates))
    p_values[[r.small_sample is not None and bool(r.slopes) for r in results]] *= 2  # two tests here as well
    adjusted = np.minimum(1.0, SEARCHES * p_values).tolist()
    found = [replace(c, p_value=p) for c, p in zip(candidates, adjusted, strict=True)]
    return sorted(found, key=lambda c: -c.evidence)


def adjust(results: Sequence[ScoreTestResult], rng: np.random.Generator, flips: int = FLIPS) -> np.ndarray:
    """Return each p-value adjusted over all results by the maximum over common sign flips, shape (m,)."""
    units = max(j.units for j in results)
    return _adjusted([j.log_p for j in results], lambda: _least(results, rng, flips), units)


def _adjusted(own: Sequence[float], draw: Callable[[], np.ndarray], units: int) -> np.ndarray:
    """Return adjusted p-values from log p and draws of the smallest log p under the null hypothesis."""
    least = draw()
    most = min(MOST_FLIPS, MOST_SIGNS // units)
    while np.count_nonzero(least <= min(own)) < ENOUGH and least.size < most:
        least = np.concatenate([least, draw()])
    return (1 + np.searchsorted(np.sort(least), own, side="right")) / (least.size + 1)


def critical_many(results: Sequence[ScoreTestResult], level: float, rng: np.random.Generator) -> float:
    """Return the critical value at a level of the smallest log p-value (not adjusted) of all results."""
    return float(np.quantile(_least(results, rng, FLIPS), level))


def critical_small_sample(fitted: Fitted, tests: Sequence[SmallSampleTest], level: float) -> float:
    """Return the same for the small-sample tests of one level."""
    units = ClusterTests(fitted, tests[0].level)
    for test in tests:
        units.numbers(test.target)
    least = _least_small_sample(units, tests, np.random.default_rng(0), FLIPS)
    return float(np.quantile(least, level) - np.log(_unequal(units.level)))


def _unequal(level: str) -> float:
    """Return the factor on p-values of F tests of one number per unit of a level.

    Files of one run scatter unequally where each run has a slope of its own.
    """
    return UNEQUAL_RUNS if level == "file" else 1.0


def _least(results: Sequence[ScoreTestResult], rng: np.random.Generator, flips: int) -> np.ndarray:
    """Return the smallest log p-value of all results under each of many random flips."""
    by_units = defaultdict(lambda: defaultdict(list))
    for test_result in results:
        units, df = test_result.scores.shape
        by_units[units][df].append(test_result.scores @ to_orthonormal(test_result.scores))
    least = np.zeros(flips)
    for units, by_df in by_units.items():
        scores = np.column_stack([own for scores in by_df.values() for own in scores])
        part = max(1, MOST_SIGNS // units)  # a few flips at a time
        counts = [min(part, flips - first) for first in range(0, flips, part)]
        totals = np.concatenate([rng.choice([-1.0, 1.0], size=(n, units)) @ scores for n in counts])
        first = 0
        for df, scores in by_df.items():
            own = totals[:, first : first + df * len(scores)].reshape(flips, -1, df)
            first += df * len(scores)
            # The largest T has the smallest p-value where units and df are the same.
            most = np.einsum("fck,fck->fc", own, own).max(axis=1)
            least = np.minimum(least, log_p_of_score(most, df, units))
    return least


def adjust_small_sample(
    units: ClusterTests, results: Sequence[ScoreTestResult], rng: np.random.Generator, draws: int = FLIPS
) -> np.ndarray:
    """Return the p-values of the small-sample tests of a level, adjusted over all, (m,); 1 if not tested."""
    p_values, every = np.ones(len(results)), [j.small_sample for j in results]
    tried = [k for k, test in enumerate(every) if test is not None and test.level == units.level]
    if tried:
        tests = [every[k] for k in tried]
        logs = np.array([test.log_p for test in tests])
        count = max(results[k].units for k in tried)
        drawn = _adjusted(logs, lambda: _least_small_sample(units, tests, rng, draws), count)
        # Bonferroni is for p-values that are smaller than the draws resolve.
        p_values[tried] = _unequal(units.level) * np.minimum(drawn, len(tried) * np.exp(logs))
    return p_values


def _least_small_sample(
    units: ClusterTests, tests: Sequence[SmallSampleTest], rng: np.random.Generator, draws: int
) -> np.ndarray:
    """Return the smallest log p-value of all small-sample tests of one level in each of many draws."""
    drawn, least = units.draws(draws, rng), np.zeros(draws)
    # The largest F has the smallest p-value where its degrees of freedom are the same.
    most = defaultdict(lambda: np.zeros(draws))
    for test in tests:
        d = test.error_df + test.basis.shape[1]
        f, *df = small_sample_test.f_of(drawn[test.target], test.basis, test.known, d)
        most[tuple(df)] = np.maximum(most[tuple(df)], f)
    for df, f in most.items():
        least = np.minimum(least, small_sample_test.log_p_of_f(f, *df))
    return least


def adjust_slopes(candidates: Sequence[Candidate]) -> np.ndarray:
    """Return the p-values of contrasts in few units, adjusted for their number, shape (m,); 1 if not tested.

    A candidate has the p-value of its strongest contrast in its weakest variant.
    """
    p_values, results = np.ones(len(candidates)), [c.test_result for c in candidates]
    tried = [k for k, j in enumerate(results) if j.slopes]
    if tried:
        logs = iter(slope_log_p([test for k in tried for test in results[k].slopes]))
        least = [max(float(next(logs).min()) for _ in results[k].slopes) for k in tried]
        p_values[tried] = np.minimum(number_of_contrasts(candidates)[tried] * np.exp(least), 1.0)
    return p_values


def number_of_contrasts(candidates: Sequence[Candidate]) -> np.ndarray:
    """Return the factor on the p-values of each candidate's contrasts in few units, shape (m,).

    The variables of operation, also in one category, and all others have half of the error rate each. Places
    of a step or a change count one by one, all other contrasts by their effective number.
    """
    own = [c.channels[-1:] if c.category else c.channels for c in candidates]
    family = np.array([set(names) <= OPERATION for names in own], dtype=int)
    shapes, places = ([], []), ([], [])
    for candidate, k in zip(candidates, family, strict=True):
        (places if candidate.place else shapes)[k].extend(candidate.test_result.slopes[:1])
    counts = np.array([effective_number(tests) for tests in shapes])
    counts += [sum(test.slope.size for test in tests) for tests in places]
    return (np.count_nonzero(counts) * counts)[family]


def effective_number(tests: Sequence[ContrastTest]) -> int:
    """Return the effective number of contrasts: principal components with `SHOWN_VARIANCE` of their variance.

    Contrasts of one channel on several quantities are nearly the same. Source: Gao, Starmer & Martin (2008),
    doi:10.1002/gepi.20310.
    """
    if not tests:
        return 0
    size = np.linalg.svd(np.concatenate([test.drawn for test in tests]), compute_uv=False) ** 2
    return int(np.searchsorted(np.cumsum(size), SHOWN_VARIANCE * size.sum()) + 1)


# ---------------------------------------------------------------- moderated variances
# All contrasts of one kind give a prior for their variances: moderated t (Smyth 2004,
# doi:10.2202/1544-6115.1027). Its degrees of freedom are limited by the number of independent directions of
# the scores. An effect is part of the scatter of all other contrasts, so the own variance alone is used, too:
# the p-value is twice the smaller of the two.

MOST_DF = 1e4  # Largest degrees of freedom of a prior. With more, the variance counts as known.
# Number of variances a contrast is tested against: moderated, and its own. Each has half the error rate.
N_VARIANCES = 2


def slope_log_p(tests: Sequence[ContrastTest]) -> list[np.ndarray]:
    """Return two-sided log p-values of several candidates' contrasts, not adjusted for their number."""
    found = []
    for test, (variance, df) in zip(tests, moderated(tests), strict=True):
        logs = [log_p_of_t(test.slope / np.sqrt(v), d) for v, d in ((variance, df), (test.variance, test.df))]
        found.append(np.minimum(np.log(N_VARIANCES) + np.minimum(*logs), 0.0))
    return found


def moderated(tests: Sequence[ContrastTest]) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return the variances of each test's contrasts, moderated by all of one kind, and degrees of freedom."""
    priors = {kind: _prior(tests, *kind) for kind in {(t.level, bool(a)) for t in tests for a in t.along}}
    found = []
    for test in tests:
        variance, known = np.array([priors[test.level, bool(a)] for a in test.along]).T
        df = test.df + known
        found.append(((known * variance + test.df * test.variance) / df, df))
    return found


def log_p_of_t(t: np.ndarray, df: np.ndarray) -> np.ndarray:
    """Return the two-sided log p-value of Student's t, shape of `t`."""
    tail = np.log(np.maximum(stdtr(df, -np.abs(t)), 1e-300))
    return np.log(2) + np.where(df >= MOST_DF, log_ndtr(-np.abs(t)), tail)


def _prior(tests: Sequence[ContrastTest], level: str, along: bool) -> tuple[float, float]:
    """Return the prior variance of contrasts of one kind, and its degrees of freedom.

    They follow from the moments of their log variances without sampling error (Smyth 2004, 6.2).
    """
    chosen = [(t, t.along == along) for t in tests if t.level == level]
    variance = np.concatenate([t.variance[own] for t, own in chosen])
    df = np.concatenate([t.df[own] for t, own in chosen])
    deviations = np.concatenate([t.deviations[:, own] for t, own in chosen], axis=1)
    half = df / 2
    logs = np.log(np.maximum(variance, 1e-12)) - psi(half) + np.log(half)
    mean = float(np.mean(logs))
    spread = float(np.var(logs, ddof=1) - np.mean(polygamma(1, half))) if logs.size > 1 else 0.0
    known = _degrees_of_freedom(spread)
    half = known / 2
    typical = float(np.exp(mean + (psi(half) - np.log(half) if known < MOST_DF else 0.0)))
    return typical, min(known, (_independent_directions(deviations) - 1) * float(np.median(df)))


def _degrees_of_freedom(spread: float) -> float:
    """Return d such that the logarithm of a scaled inverse chi-squared of d degrees has this variance."""
    if spread <= polygamma(1, MOST_DF / 2):
        return MOST_DF
    if spread >= polygamma(1, 1e-3):
        return 0.0
    root = brentq(lambda x: polygamma(1, np.exp(x)) - spread, np.log(1e-3), np.log(MOST_DF / 2))
    return float(2 * np.exp(root))


def _independent_directions(deviations: np.ndarray) -> float:
    """Return the effective number of independent columns of scores: (tr R)^2 / tr R^2, at least 1."""
    size = np.sqrt((deviations**2).sum(axis=0))
    standardised = deviations[:, size > 0] / size[size > 0]
    if standardised.shape[1] == 0:
        return 1.0
    inner = standardised @ standardised.T  # tr R^2 is the same for the smaller product
    return float(max(standardised.shape[1] ** 2 / (inner**2).sum(), 1.0))
