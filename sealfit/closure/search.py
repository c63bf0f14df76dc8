"""Search for channels that explain the residual: free shapes of channels and pairs, on every quantity."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from sealfit.closure import criteria
from sealfit.closure.channels import (
    FINER,
    Channel,
    flip_level,
    free_columns,
    intervals,
    kinks,
    main_columns,
    mixed_columns,
    run_means,
    scatter_level,
    steps,
    unit_of,
    without_trends,
)
from sealfit.closure.forms import ADDED
from sealfit.closure.multiplicity import adjust_all
from sealfit.closure.score_test import Candidate, ScoreTestResult, ScoreTests
from sealfit.closure.small_sample_test import log_p_of_numbers
from sealfit.effects.sensors import DAY_H, day_and_night
from sealfit.fit.joint import Fitted
from sealfit.fit.joint.model import Term
from sealfit.fit.joint.rows import LEVELS, POWER, Rows, open_columns
from sealfit.fit.joint.variance_components import orthonormal
from sealfit.tables import HISTORY

TARGETS = (
    ("mu", "multiply"), ("force", "add"), ("force", "multiply"), ("mu_s", "multiply"), ("mu_c", "multiply"),
    ("v_s", "multiply"), ("sigma_2", "add"), ("a", "multiply"), ("b", "multiply"),
)  # fmt: skip
MAIN_TARGETS = (("mu", "multiply"), ("force", "add"))
NOT_TESTED = ScoreTestResult(0.0, 0, 0, 0.0)


def search(tests: ScoreTests, channels: Sequence[Channel], rng: np.random.Generator) -> list[Candidate]:
    """Return every candidate with its adjusted p-value, strongest evidence first."""
    candidates = [c for channel in channels for c in channel_candidates(tests, channel)]
    candidates += _speed_in_categories(tests, channels)
    temporary = [c for c in candidates if c.temporary]
    lasting = [c for c in candidates if not c.temporary]
    found = adjust_all(tests, lasting, rng) if lasting else []
    for c in adjust_all(tests, temporary, rng) if temporary else []:
        found.append(replace(c, p_value=min(1.0, criteria.TEMPORARY_FACTOR * c.p_value)))
    for channel in (c for c in channels if c.name == "elapsed_h"):
        found += _at_best_places(tests, channel, rng)
    return sorted(found, key=lambda c: -c.evidence)


def channel_candidates(tests: ScoreTests, channel: Channel) -> Iterator[Candidate]:
    """Yield the candidates of one channel, with p-values that are not adjusted."""
    rows = tests.fitted.rows
    if channel.name == "direction":
        yield from _shape_candidates(tests, channel, np.ones((rows.force.size, 1)), TARGETS)
        return
    specimens = rows.groups.starts["specimen"].size
    few_units = channel.numeric and channel.unit == "specimen" and specimens < criteria.JACKKNIFE_UNITS
    shapes = free_columns(channel, criteria.FEW_DF if few_units else criteria.FREE_DF)
    parts = [slice(0, 1), slice(None)] if channel.numeric and shapes.shape[1] > 1 else [slice(None)]
    yield from _shape_candidates(tests, channel, shapes, TARGETS, parts)
    if (own := without_trends(channel, rows)) is not None:
        yield from _shape_candidates(tests, own, free_columns(own, criteria.FREE_DF), TARGETS, parts)
    if few_units:
        yield from _each_column(tests, channel, kinks(channel))
    if channel.name == "elapsed_h":
        yield from _each_column(tests, channel, steps(channel, rows))
        for candidate in _each_column(tests, channel, intervals(channel, rows)):
            yield replace(candidate, temporary=True)
    units = rows.groups.starts[flip_level(channel.unit, rows)].size
    fine = units >= criteria.FINE_UNITS and np.unique(channel.values).size > 2 * criteria.FINE_DF
    if channel.numeric and fine:
        yield from _shape_candidates(tests, channel, free_columns(channel, criteria.FINE_DF), MAIN_TARGETS)
    if channel.name == "elapsed_h" and day_and_night.effect.shown_by(channel.values):
        angle = 2 * np.pi * channel.values[:, None] / DAY_H
        yield from _shape_candidates(tests, channel, np.hstack([np.cos(angle), np.sin(angle)]), MAIN_TARGETS)
    if means := run_means(channel, rows):
        yield from channel_candidates(tests, means)


def _speed_in_categories(tests: ScoreTests, channels: Sequence[Channel]) -> Iterator[Candidate]:
    """Yield candidates of any dependence of mu on the speed in one category, such as a rubber of several."""
    rows, target = tests.fitted.rows, MAIN_TARGETS[0]
    curves = "full" in tests.fitted.model.declared.stribeck.values()
    for speed in (c for c in channels if curves and c.name == "speed_mm_s"):
        level, between = flip_level(speed.unit, rows), scatter_level([speed], rows)
        for channel in (c for c in _usable(channels) if not c.numeric and c.unit == "specimen"):
            for category in np.unique(channel.values):
                shapes = (channel.values == category)[:, None] * main_columns(speed)
                names = (channel.name, speed.name)
                whole = Candidate(names, *target, level, shapes, NOT_TESTED, category=str(category))
                yield from _tested(tests, whole, [slice(None)], speed.unit, between)


def _each_column(tests: ScoreTests, channel: Channel, shapes: np.ndarray) -> Iterator[Candidate]:
    """Yield candidates of every single column, one for each place along a channel."""
    if shapes.shape[1]:
        parts = [slice(k, k + 1) for k in range(shapes.shape[1])]
        for candidate in _shape_candidates(tests, channel, shapes, MAIN_TARGETS, parts):
            yield replace(candidate, place=True)


def _at_best_places(tests: ScoreTests, channel: Channel, rng: np.random.Generator) -> Iterator[Candidate]:
    """Yield for each target the step and the change that lasts for a while that explain most, if certain.

    They begin and end between any two files. `steps` and `intervals` are few, and lie between runs: what is
    large beside the scatter of repeats, and begins within a run, is not seen by them. P-values are multiplied
    by the number of places (Bonferroni). Those above `WEAK_P` are left to the few places.
    """
    rows = tests.fitted.rows
    time = rows.values(channel.name)[rows.groups.starts["file"]]
    times, block = np.unique(time, return_inverse=True)
    block = block * min(times.size, criteria.MOST_BLOCKS) // times.size
    files, block = np.bincount(block), block[rows.codes("file")]
    channel = replace(channel, values=time[rows.codes("file")], unit="file")
    for target in MAIN_TARGETS:
        for ends, places in _best_places(tests.fitted, block, files, target):
            shape = ((block >= ends[0]) & (block < ends[1])).astype(float)[:, None]
            for candidate in _shape_candidates(tests, channel, shape - shape.mean(), [target]):
                alone = adjust_all(tests, [candidate], rng)[0]
                p_value = criteria.TEMPORARY_FACTOR * len(MAIN_TARGETS) * places * alone.p_value
                if p_value <= criteria.WEAK_P:
                    temporary = ends[1] < files.size
                    yield replace(candidate, place=True, temporary=temporary, p_value=p_value)


def _best_places(
    fitted: Fitted, block: np.ndarray, files: np.ndarray, target: tuple[str, str]
) -> Iterator[tuple[tuple[int, int], int]]:
    """Yield the first and last place of the best step and change, and the number of places compared.

    `block` is the block of time of each row, shape (n,), `files` the number of files in each block.
    """
    columns = np.zeros((block.size, files.size))
    columns[np.arange(block.size), block] = fitted.slope(*target)
    white = fitted.whitening(columns)
    left = fitted.basis.project_out(white)
    first, last = np.triu_indices(files.size + 1, 1)
    inside = np.r_[0, files.cumsum()]
    inside = inside[last] - inside[first]
    whole, size = (_interval_sums(m.T @ m, first, last) for m in (white, left))
    score = np.r_[0.0, np.cumsum(left.T @ fitted.white_residual)]
    usable = np.minimum(inside, files.sum() - inside) >= criteria.LEAST_BESIDE_STEP
    usable &= size > criteria.IDENTIFIABLE * whole
    explained = np.where(usable, (score[last] - score[first]) ** 2 / np.where(usable, size, 1.0), 0.0)
    for kind in ((first > 0) & (last == files.size), (first > 0) & (last < files.size)):
        if (usable & kind).any():
            k = np.argmax(np.where(kind, explained, -1.0))
            yield (int(first[k]), int(last[k])), int((usable & kind).sum())


def _interval_sums(squares: np.ndarray, first: np.ndarray, last: np.ndarray) -> np.ndarray:
    """Return the sums of the square blocks of a matrix from `first` to before `last`, shape of both."""
    sums = np.pad(squares.cumsum(axis=0).cumsum(axis=1), ((1, 0), (1, 0)))
    return sums[last, last] - sums[first, last] - sums[last, first] + sums[first, first]


def _shape_candidates(
    tests: ScoreTests,
    channel: Channel,
    shapes: np.ndarray,
    targets: Sequence[tuple[str, str]],
    parts: Sequence[slice] = (slice(None),),
) -> Iterator[Candidate]:
    """Yield candidates of a channel's columns on every target, one for each part of the columns."""
    fitted, rows = tests.fitted, tests.fitted.rows
    if channel.name in ("speed_mm_s", POWER) and "full" not in fitted.model.declared.stribeck.values():
        return  # with few speeds a dependence on speed may be the Stribeck curve
    both_ways, loads = rows.speed.min() < 0 < rows.speed.max(), POWER in rows.table
    for acts_on, operation in targets:
        if not (_allowed(channel, acts_on, operation, both_ways, loads) and _declared(fitted, acts_on)):
            continue
        if not np.abs(fitted.slope(acts_on, operation)).max() > 0:
            continue
        halved = channel.name == "direction" and acts_on != "force"
        own = channel.values[:, None] / 2 if halved else shapes
        unit, names = channel.unit, (channel.name,)
        unsigned = both_ways and (acts_on, operation) == ADDED and channel.name != "direction"
        # it is seen only as a difference between directions
        if unsigned and FINER[channel.unit] > FINER["stroke"]:
            names = ("direction", channel.name)
            unit = min(unit, unit_of(np.sign(rows.speed), rows), key=FINER.get)
        level = flip_level(unit, rows)
        between = level if channel.grouping else scatter_level([channel], rows)
        tested = Candidate(names, acts_on, operation, level, own, NOT_TESTED)
        yield from _tested(tests, tested, parts, channel.unit, between)


def _tested(
    tests: ScoreTests,
    whole: Candidate,
    parts: Sequence[slice],
    unit: str,
    between: str,
) -> Iterator[Candidate]:
    """Yield a candidate for each part of the columns of `whole` that can be tested."""
    variants = tests.variants(whole.columns * tests.fitted.slope(*whole.target)[:, None], unit)
    for part in parts:
        test_result = tests([v[:, part] for v in variants], between, whole.unit, whole.target)
        if test_result is not None:
            yield replace(whole, columns=whole.columns[:, part], test_result=test_result)


def _declared(fitted: Fitted, acts_on: str) -> bool:
    """Whether the declared model has the quantity; without a Stribeck curve, mu_c is mu."""
    needs = {"mu_s": "v_s", "mu_c": "v_s", "v_s": "v_s", "sigma_2": "sigma_2", "a": "a_c", "b": "b_c"}
    return acts_on not in needs or bool((fitted.model.declared.index[needs[acts_on]] >= 0).any())


def _allowed(channel: Channel, acts_on: str, operation: str, both_ways: bool, loads: bool) -> bool:
    if channel.name == "direction":
        return both_ways
    if channel.grouping or channel.added_only:
        return both_ways and (acts_on, operation) == ADDED
    if channel.name == "speed_mm_s":  # mu_s, mu_c, v_s and sigma_2 describe the dependence on it
        return acts_on in (("mu", "a", "sigma_2") if loads else ("mu", "a"))
    return not (channel.name == "load_N" and acts_on == "force")


# ---------------------------------------------------------------- pairs
# Pairs of channels, for effects that are interactions, where no single channel explains the residual. The
# columns of a pair are tested beside the main effects of both channels: these have been tested before, or may
# be the Stribeck curve that a few speeds do not determine.

# The variable whose influence each coefficient describes.
VARIABLE_OF = {"a": "aging_days", "b": "aging_days", "v_s": "speed_mm_s", "sigma_2": "speed_mm_s"}
# Direction has tests of its own, and the calendar interacts with nothing.
NOT_IN_PAIRS = {"direction", *HISTORY}


def search_pairs(
    tests: ScoreTests, channels: Sequence[Channel], singles: Sequence[Candidate], rng: np.random.Generator
) -> list[Candidate]:
    """Return candidates of pairs, with p-values adjusted over single channels and pairs, strongest first.

    Of the campaign's own columns those that explain least alone (`singles` are sorted) are left out beyond
    `MOST_PAIRED`.
    """
    own = set(open_columns(tests.fitted.rows.table))
    ranked = list(dict.fromkeys(c.channels[-1] for c in singles if c.channels[-1] in own))
    usable = [c for c in _usable(channels) if c.name not in ranked[criteria.MOST_PAIRED :]]
    found = [c for pair in itertools.combinations(usable, 2) for c in _pair_candidates(tests, *pair)]
    if not found:
        return []
    singles = [c for c in singles if not c.temporary]
    pairs = [c for c in adjust_all(tests, [*found, *singles], rng) if c.pair]
    return [replace(c, p_value=min(1.0, criteria.PAIR_FACTOR * c.p_value)) for c in pairs]


def equivalent_pairs(
    tests: ScoreTests, significant: Sequence[Candidate], channels: Mapping[str, Channel]
) -> list[Candidate]:
    """Return the pairs that are equivalent to a single channel acting on a, b, v_s or sigma_2.

    a describes how mu changes with days, v_s how it changes with speed. The fits decide.
    """
    best: dict[frozenset, list[Candidate]] = {}
    for single in significant:
        pair = frozenset((*single.channels, VARIABLE_OF.get(single.acts_on)))
        if single.pair or len(pair) != 2 or not pair <= channels.keys() or pair in best:
            continue
        members = _usable([channels[name] for name in sorted(pair)])
        found = _pair_candidates(tests, *members) if len(members) == 2 else []
        best[pair] = []
        for target in MAIN_TARGETS:
            if own := [c for c in found if c.target == target]:
                strongest = max(own, key=lambda c: c.chi2)
                test = strongest.test_result._replace(chi2=max(strongest.chi2, single.chi2))
                best[pair].append(replace(strongest, test_result=test, p_value=single.p_value))
    return list(itertools.chain.from_iterable(best.values()))


def _usable(channels: Sequence[Channel]) -> list[Channel]:
    own = [c for c in channels if not (c.grouping or c.added_only or c.name in NOT_IN_PAIRS)]
    return [c for c in own if c.numeric or np.unique(c.values).size <= criteria.MOST_CATEGORIES]


def _pair_candidates(tests: ScoreTests, one: Channel, other: Channel) -> list[Candidate]:
    blocks = mixed_columns(one, other)
    if not blocks:
        return []
    rows, finer = tests.fitted.rows, min(one.unit, other.unit, key=FINER.get)
    between, level = scatter_level((one, other), rows), flip_level(finer, rows)
    shapes, alone = np.column_stack(blocks), np.column_stack([main_columns(one), main_columns(other)])
    ends = np.cumsum([0, *(block.shape[1] for block in blocks)])
    parts = [slice(*place) for place in itertools.pairwise(ends)]
    found = []
    for target in MAIN_TARGETS:
        if "load_N" not in (one.name, other.name) or target[0] != "force":
            whole = Candidate((one.name, other.name), *target, level, shapes, NOT_TESTED, pair=True)
            own = tests.beside(alone * tests.fitted.slope(*target)[:, None])
            found += _tested(own, whole, parts, finer, between)
    return found


def candidate_of(term: Term, pair: Sequence[Channel], rows: Rows, p_value: float) -> Candidate:
    """Return a candidate of a pair of channels for a term that no test suggested, with a given p-value."""
    level = flip_level(min((c.unit for c in pair), key=FINER.get), rows)
    test = NOT_TESTED._replace(df=len(term.effect.parameters), units=rows.groups.starts[level].size)
    return Candidate(term.channels, *term.target, level, np.empty((0, 0)), test, p_value, pair=True)


# ---------------------------------------------------------------- masked pairs
# Two effects that mask each other: each is part of the other's error, and neither is significant alone.
# Searched in few units, where nothing else is significant. Only simple pairs are tested: two straight lines
# (an offset, for the direction) that share a channel or of which one is of the direction, and a line along
# strokes with its change along a coarser channel. Both columns must change each unit along one direction, so
# that a unit is one number; then
#
# .. math:: F = \frac{(RSS_0 - RSS_{12}) / 2}{RSS_{12} / (d - 2)}
#
# tests both against the residual scatter of the units, exactly if that is normal with one variance. P-values
# are adjusted for the number of pairs (Bonferroni). Each of the two must be significant given the other.

OF_DIRECTION = (ADDED, ("mu", "multiply"), ("mu_c", "multiply"), ("sigma_2", "add"))
LEAST_SINGULAR = 1e-3  # Two unit columns with a smaller singular value are collinear.


class MaskedPair(NamedTuple):
    """Two effects that mask each other: their joint test and the keys of their candidates."""

    p_value: float  # adjusted
    chi2: float  # whitened sum of squares they explain
    keys: tuple[tuple, ...]  # of those that are not in the model yet

    def without(self, key: tuple) -> MaskedPair:
        """Return the pair without the one that is now in the model."""
        return MaskedPair(self.p_value, 0.0, tuple(k for k in self.keys if k != key))


def search_masked_pairs(
    tests: ScoreTests, channels: Mapping[str, Channel], candidates: Sequence[Candidate], alpha: float
) -> list[MaskedPair]:
    """Return the pairs that are significant jointly, most significant first.

    `alpha` is the level of the search, and of each of the two given the other.
    """
    tested = [(two, _joint_test(tests, two, level)) for two, level in _pairs(tests, channels, candidates)]
    tested = [(two, test) for two, test in tested if test is not None]
    found = []
    for two, (joint, given, chi2) in tested:
        p_value = min(1.0, criteria.SEARCHES * len(tested) * float(np.exp(joint)))
        if given <= np.log(alpha) and p_value <= alpha:
            found.append(MaskedPair(p_value, chi2, tuple(c.key for c in two)))
    return sorted(found)


def _pairs(
    tests: ScoreTests, channels: Mapping[str, Channel], candidates: Sequence[Candidate]
) -> Iterator[tuple[tuple[Candidate, Candidate], str]]:
    """Yield the pairs to test and the level of their units."""
    rows = tests.fitted.rows
    straight = [c for c in candidates if c.straight and c.claimable]
    between = {c.channels: [channels[n] for n in c.channels if n != "direction"] for c in straight}
    level = {id(c): scatter_level(between[c.channels] or [channels["direction"]], rows) for c in straight}
    targets = {("direction",): OF_DIRECTION}
    lines = [c for c in straight if not c.pair and c.target in targets.get(c.channels, MAIN_TARGETS)]
    lines = list({c.key: c for c in reversed(lines)}.values())
    products = [c for c in straight if c.pair]
    for one, other in (*itertools.combinations(lines, 2), *itertools.product(lines, products)):
        own, others = level[id(one)], level[id(other)]
        if one.channels[0] == other.channels[0] == "direction" and one.target == other.target == ADDED:
            own = others = min(own, others, key=LEVELS.index)  # specimens do not differ in a sensor's zero
        units = rows.groups.starts[own].size
        few_units = criteria.LEAST_UNITS_OF_SLOPES <= units < criteria.JACKKNIFE_UNITS
        if own == others and few_units and _is_simple_pair(one, other, channels):
            yield (one, other), own


def _is_simple_pair(line: Candidate, other: Candidate, channels: Mapping[str, Channel]) -> bool:
    """Whether a line and another line, or a product, are a simple pair (see above)."""
    name = line.channels[-1]
    if not other.pair:
        return name == other.channels[-1] or ("direction",) in (line.channels, other.channels)
    inside = [n for n in other.channels if channels[n].unit == "sample"]  # along strokes
    return inside == [name] and line.acts_on == other.acts_on


def _joint_test(
    tests: ScoreTests, two: tuple[Candidate, Candidate], level: str
) -> tuple[float, float, float] | None:
    """Return log p of two candidates jointly, the larger log p of one given the other, and their chi-squared.

    Of several variants the weakest result counts. None if they are no pair.
    """
    fitted, groups = tests.fitted, tests.fitted.rows.groups
    columns = np.column_stack([c.columns * fitted.slope(*c.target)[:, None] for c in two])
    unit = min((c.unit for c in two), key=lambda name: groups.starts[name].size)
    white = fitted.whitening(columns)
    larger = groups.sums(white**2, level).argmax(axis=1)[groups.codes[level]]  # both may change it along this
    numbers = tests.cluster_tests[level].along(white[np.arange(len(white)), larger])
    found = []
    for left in tests.variants(columns, unit):
        own = groups.sums(numbers.direction[:, None] * left, level)
        varies = (own**2).sum(axis=0) <= criteria.CONSTANT_IN_RUNS * (left**2).sum(axis=0)
        if varies.any() or not left.any(axis=0).all():
            return None
        made = numbers.root @ own
        made = made / np.sqrt((made**2).sum(axis=0))
        basis = orthonormal(made, LEAST_SINGULAR)
        if basis.shape[1] < 2 or numbers.df - 2 < criteria.LEAST_ERROR_DF_OF_RUNS:
            return None
        joint = log_p_of_numbers(numbers.values[None, :], basis, 0.0, numbers.df)[0]
        given = max(_conditional_log_p(numbers.values, *own, numbers.df) for own in (made.T, made.T[::-1]))
        explained = orthonormal(left, LEAST_SINGULAR).T @ fitted.white_residual
        found.append((joint, given, -float((explained**2).sum())))
    joint, given, chi2 = np.max(found, axis=0).tolist()
    return joint, given, -chi2


def _conditional_log_p(values: np.ndarray, one: np.ndarray, other: np.ndarray, df: int) -> float:
    """Return log p of a unit column of independent numbers given another unit column, all of shape (d,)."""
    rest = one - (one @ other) * other
    left = values - (values @ other) * other
    return float(log_p_of_numbers(left[None, :], rest[:, None] / np.linalg.norm(rest), 0.0, df - 1)[0])
