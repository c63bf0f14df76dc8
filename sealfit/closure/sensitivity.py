"""Sensitivity of a campaign: the smallest effect of each variable that it would have found.

The effect is a factor on mu, linear in the variable at one of its levels, or an offset force for the
direction. It is added to the residual, and the scatter is re-estimated, because part of the effect is taken
for scatter. The smallest effect exceeds the critical value of the whole search with a power of 80 %
(noncentral F), has the least size that is reported, and lowers the held-out error: by `LEAST_GAIN`, and with
weak evidence by `LEAST_FALL`. The stated size is larger by `TO_BE_ADDED`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from scipy.special import betaincinv, chdtri, fdtri, ncfdtrinc, ndtri, stdtrit

from sealfit.closure import criteria
from sealfit.closure.channels import FINER, Channel, scatter_level, too_short
from sealfit.closure.confirm import about_means, error_of_rise_N
from sealfit.closure.errors_and_intervals import degrees_of_freedom
from sealfit.closure.multiplicity import (
    N_VARIANCES,
    critical_many,
    critical_small_sample,
    moderated,
    number_of_contrasts,
)
from sealfit.closure.score_test import Candidate, ScoreTests, project
from sealfit.closure.selection import Selection
from sealfit.closure.small_sample_test import (
    ClusterTests,
    ContrastTest,
    SmallSampleTest,
    contrast_test,
    enough_specimens,
    least_share,
)
from sealfit.fit.joint import Fitted
from sealfit.fit.joint.rows import ALONG, CELL, LEVELS
from sealfit.fit.joint.variance_components import estimate_scatter, orthonormal
from sealfit.fit.joint.whitening import Whitening
from sealfit.tables import CALENDAR, HISTORY

TINY = 1e-6  # Size of an effect, as a share of the force, that changes no estimate.
# Ratio of the stated size to that which is significant with a power of 80 %. Some significant effects are
# refused, or another variable is taken for them. Of 53 effects of the significant size in designs drawn at
# random 64 % were added, of 42 effects 1.2 times as large 79 %, 1.35 times 83 %.
TO_BE_ADDED = 1.2
STEPS = 6  # Most sizes that are tried to reach `TARGET_POWER`.
CLOSE = 0.03  # Relative error of the size at which the iteration ends.
WANTED_PCT = 1.0  # Effect to which `files_needed` refers, in percent of the friction force.
SPECIMEN, SPECIMENS = "specimen_id", "specimen"
FRICTION = ("mu", "multiply")

# Channels that describe the order of the tests. They do not make the verdict `cannot_tell`.
ASIDE = (*HISTORY, "repeat")
LEVEL_NAMES = {
    "sample": "trace", "stroke": "stroke", "file": "repeat", "run": "run", "set_up": "set_up",
    "specimen": "condition",
}  # fmt: skip


def sensitivity(selection: Selection, alpha: float) -> list[dict]:
    """Return an entry per variable and level, at the family-wise level `alpha` of the search.

    Its keys are variable, level, acts_on, smallest_N, smallest_pct and files_needed. A variable that varies
    at several levels has an entry for each. `smallest_N` is the RMS over all rows of the smallest effect that
    is found with a power of 80 %, `smallest_pct` the same in percent of the RMS force; None if the variable
    cannot be tested. `files_needed` is the number of files, made like these, that would show an effect of 1 %
    of the force. A variable that can show nothing beside its effect in the model has no entry.
    """
    fitted = selection.after
    rows, force = fitted.rows, float(np.sqrt(fitted.rows.weight @ fitted.force**2))
    files, specimens = (rows.groups.starts[level].size for level in ("file", "specimen"))
    search, least = _Search(selection, alpha), criteria.LEAST_UNITS_OF_SLOPES
    in_model = _channels_in_model(selection)
    entries = []
    for name, channel in selection.channels.items():
        added = name == "direction" or channel.grouping or (name in ALONG and too_short(rows))
        target = ("force", "add") if added else FRICTION
        own = [c for c in search.candidates if (c.channels[-1], c.target) == (name, target)]
        own = [c for c in own if not (c.pair or c.place or c.category)]
        own = sorted(own, key=lambda c: c.columns.shape[1])[:1]  # a straight line
        for level, part in _parts(selection, channel, own):
            smallest = None
            if own:
                effect = part * fitted.slope(*target)
                effect *= force / np.sqrt(rows.weight @ effect**2)
                times = search.smallest(own[0], effect)
                times = max(
                    times, _times_to_confirm(fitted, effect, name, level, search.surer(times, own[0]))
                )
                rise = error_of_rise_N(rows) / force if level == "sample" else 0.0
                stated = max(TO_BE_ADDED * times, criteria.SIZE_MARGIN * max(criteria.LEAST_SIZE, rise))
                smallest = float(force * stated) if stated < 1 else None
            if smallest is not None:
                needed = int(np.ceil(files * (100 * smallest / force / WANTED_PCT) ** 2))
            elif name in in_model:
                continue
            else:
                units = rows.groups.starts[scatter_level([channel], rows)].size
                if channel.unit == "sample" and specimens > 1:
                    units = min(units, specimens)
                needed = int(np.ceil(files * least / units)) if units < least else None
            entry = {"variable": name, "level": LEVEL_NAMES[rows.level_name(level)], "acts_on": target[0]}
            percent = None if smallest is None else 100 * smallest / force
            entries.append({**entry, "smallest_N": smallest, "smallest_pct": percent, "files_needed": needed})
    # No variable describes how specimens differ.
    if len(rows.conditions) < specimens < least:
        needed = int(np.ceil(files * least / specimens))
        unknown = {"variable": SPECIMEN, "level": "condition", "acts_on": "mu", "smallest_N": None}
        entries.append({**unknown, "smallest_pct": None, "files_needed": needed})
    return entries


def _channels_in_model(selection: Selection) -> set[str]:
    return {name for added in selection.added for name in added.proposal.term.channels}


def _times_to_confirm(fitted: Fitted, effect: np.ndarray, name: str, level: str, surer: float) -> float:
    """Return the factor on an effect of a variable at a level, shape (n,), with which it is confirmed.

    It lowers the held-out error by `LEAST_GAIN` and, unless its evidence is strong (from the factor `surer`),
    by `LEAST_FALL`. Effect and error are taken about the means of the groups within which the effect varies,
    but for the direction and the calendar. Evidence for the calendar must be strong where it can be: of 14
    effects of the other size, in 24 designs of two laboratories, 6 were added.
    """
    rows, calendar = fitted.rows, name in CALENDAR
    around = dict(zip(FINER, (*LEVELS, None), strict=True))[level]
    around = None if calendar or name == "direction" else around
    free = ~fitted.at_limit
    white, tangent = fitted.white_jacobian.columns(free), fitted.jacobian.columns(free)
    score = white.against(fitted.whitening(effect[:, None])[:, 0])
    taken, *_ = np.linalg.lstsq(white.gram(), score, rcond=1e-10)
    own = effect - tangent @ taken  # not explained by the model
    squares = [rows.weight @ about_means(x, rows, around) ** 2 for x in (own, fitted.residual)]
    size, left = np.sqrt(squares).tolist()
    if not size > 0:
        return np.inf
    least = criteria.LEAST_GAIN * float(np.sqrt(rows.weight @ fitted.force**2))
    larger = np.array([left + least, left / (1 - criteria.LEAST_FALL)])
    gained, lowered = (criteria.SIZE_MARGIN * np.sqrt(larger**2 - left**2) / size).tolist()
    return max(gained, surer if calendar and np.isfinite(surer) else min(lowered, surer))


def _parts(
    selection: Selection, channel: Channel, own: Sequence[Candidate]
) -> Iterator[tuple[str, np.ndarray | None]]:
    """Yield each level at which a channel varies, and the part of its first column at that level."""
    groups, weight = selection.after.rows.groups, selection.after.rows.weight
    if not own or not channel.numeric or channel.name == "direction":
        yield channel.unit, (own[0].columns[:, 0] if own else None)
        return
    column = own[0].columns[:, 0]
    means = [column, *(groups.means(column, level)[groups.codes[level]] for level in LEVELS), 0 * column]
    sizes = [column.size, *(groups.starts[level].size for level in LEVELS), 1]
    parts, real, finer = {}, [], 0.0
    for k, level in enumerate(FINER):
        parts[level] = means[k] - means[k + 1]
        square = weight @ parts[level] ** 2
        each = square / max(sizes[k] - sizes[k + 1], 1)  # mean square
        if square > criteria.REAL_SHARE * (weight @ column**2) and each > criteria.REAL_RATIO * finer:
            real.append(level)
        finer = max(finer, each)
    if len(real) < 2:
        yield real[0] if real else channel.unit, column
    else:
        yield from ((level, parts[level]) for level in real)


class _Search:
    """The tests of the last search, applied to an effect that is added to the residual.

    The effect raises the estimated scatter and the variance that it is tested against.
    """

    def __init__(self, selection: Selection, alpha: float) -> None:
        self.fitted, self.channels = selection.after, selection.channels
        self.candidates = [c for c in selection.left_over if not c.temporary]
        self.level, self.tests = alpha / criteria.SEARCHES, ScoreTests(selection.after)
        results = [c.test_result for c in self.candidates]
        slopes = [j.slopes for j in results if j.slopes]
        small_sample = [test for c in self.candidates if (test := self._retested(c)) is not None]
        many = [j for j in results if j.small_sample is None and not j.slopes]
        contrasts = N_VARIANCES * number_of_contrasts(self.candidates)
        self.contrasts = {c.channels: n for c, n in zip(self.candidates, contrasts, strict=True)}
        tests = [test for own in slopes for test in own]
        self.moderated = {id(t): m for t, m in zip(tests, moderated(tests), strict=True)}
        lines = [c for c in self.candidates if c.test_result.slopes and c.target == FRICTION and not c.pair]
        columns = [c.columns[:, 0] for c in lines] or [np.ones(selection.after.force.size)]
        self.lines = np.column_stack(columns) * selection.after.slope(*FRICTION)[:, None]
        self.many = len(many)
        self.critical_many = critical_many(many, self.level / 2, np.random.default_rng(0)) if many else 0.0
        self.critical_small_sample = {}
        for name in {test.level for test in small_sample}:
            # Runs are also tested by slopes.
            level = self.level / (1 if name in (SPECIMENS, CELL) else N_VARIANCES)
            own = [t for t in small_sample if t.level == name]
            self.critical_small_sample[name] = critical_small_sample(self.fitted, own, level)

    def _retested(self, candidate: Candidate) -> SmallSampleTest | None:
        """Return a candidate's small-sample test on the final model, which may have fewer effects."""
        known = candidate.test_result.small_sample
        if known is None:
            return None
        columns = candidate.columns * self.fitted.slope(*candidate.target)[:, None]
        return self.tests.cluster_tests[known.level].test(project(self.fitted, columns), known.target)

    def surer(self, times: float, candidate: Candidate) -> float:
        """Return the factor on an effect, found with `TARGET_POWER`, with which its evidence is not weak.

        Infinite for few units without an F test, whose p-value falls too slowly.
        """
        test = candidate.test_result.small_sample
        if test is None and candidate.test_result.units < criteria.JACKKNIFE_UNITS:
            return np.inf
        df = candidate.test_result.units if test is None else test.error_df
        levels = np.array([self.level * criteria.SEARCHES, criteria.WEAK_P])
        quantiles = stdtrit(df, levels / 2 / criteria.SEARCHES / len(self.candidates))
        found, strong = ndtri(criteria.TARGET_POWER) - quantiles
        return times * float(strong / found)

    def smallest(self, candidate: Candidate, effect: np.ndarray) -> float:
        """Return the factor on an effect, shape (n,), that gives it `TARGET_POWER`; infinite if none does."""
        size, margin, before = TINY, self.margin(candidate, TINY * effect, self.fitted), None
        for _ in range(STEPS):
            if not 0 < margin < np.inf:
                return np.inf
            power = 1.0 if before is None else np.log(margin / before[1]) / np.log(size / before[0])
            before = size, margin
            size *= margin ** (-1 / min(max(power, criteria.LEAST_POWER), 1.0))
            if size > 1:
                return np.inf
            margin = self.margin(candidate, size * effect, _under(self.fitted, size * effect))
            if margin > 0 and abs(np.log(margin)) < CLOSE:
                break
        return size

    def margin(self, candidate: Candidate, effect: np.ndarray, fitted: Fitted) -> float:
        """Return the ratio of an effect to the size that is needed."""
        tests = ScoreTests(fitted)
        white = fitted.basis.project_out(fitted.whitening(np.column_stack([self.fitted.residual, effect])))
        noise, effect = (replace(fitted, white_residual=column) for column in white.T)
        for one in (noise, effect):
            one.__dict__["basis"] = fitted.basis
        columns = candidate.columns * noise.slope(*candidate.target)[:, None]
        variants = tests.variants(columns, self.channels[candidate.channels[-1]].unit)
        margin = self._by_units(candidate, noise, effect, variants)
        if all(enough_specimens(noise, left).all() for left in variants):
            return margin
        shares = [float(least_share(effect, left).max()) for left in variants]
        return min(margin, min(shares) / criteria.LARGE_SHARE)

    def _by_units(
        self, candidate: Candidate, noise: Fitted, effect: Fitted, variants: Sequence[np.ndarray]
    ) -> float:
        """Return the margin by the tests against the units' scatter."""
        channel, test_result = self.channels[candidate.channels[-1]], candidate.test_result
        known = test_result.small_sample
        by_test = 0.0
        if known is not None and known.level in self.critical_small_sample:
            tail = np.exp(self.critical_small_sample[known.level])
            units = [ClusterTests(one, known.level) for one in (noise, effect)]
            by_test = min(_by_numbers(units, left, known.target, tail) for left in variants)
        if test_result.slopes:
            tail = self.level / self.contrasts[candidate.channels] / (1 if known is None else N_VARIANCES)
            pairs = zip(variants, test_result.slopes, strict=True)
            return max(by_test, min(self._by_slopes(noise, effect, left, test, tail) for left, test in pairs))
        if known is not None:
            return by_test
        level = candidate.unit if channel.grouping else scatter_level([channel], noise.rows)
        return min(self._by_many(noise, effect, left, level, candidate) for left in variants)

    def _by_slopes(
        self, noise: Fitted, effect: Fitted, left: np.ndarray, known: ContrastTest, tail: float
    ) -> float:
        test, added = (contrast_test(one, left, known.level) for one in (noise, effect))
        if test is None or test.slope.size != known.slope.size:
            return 0.0
        variance, df = self.moderated[id(known)]
        prior_df = df - known.df
        prior = (df * variance - known.df * known.variance) / np.maximum(prior_df, 1e-9)
        others = contrast_test(effect, project(effect, self.lines), known.level)
        for along in set(others.along.tolist()) if others is not None else ():  # the effect enlarges them
            prior[known.along == along] *= np.exp(np.mean(np.log1p(others.variance[others.along == along])))
        own = variance * test.variance / known.variance
        share = test.df / (prior_df + test.df)
        both = (1 - share) * prior + share * own
        by_own = _margin(added.slope, own, added.variance, 1, test.df, tail)
        by_both = _margin(added.slope, both, share * added.variance, 1, prior_df + test.df, tail)
        return float(np.nanmax([by_own, by_both]))

    def _by_many(
        self, noise: Fitted, effect: Fitted, left: np.ndarray, level: str, candidate: Candidate
    ) -> float:
        basis = orthonormal(left)
        seen = basis @ (basis.T @ effect.white_residual)
        length = float(np.linalg.norm(seen))
        if length == 0:
            return 0.0
        scores = candidate.test_result.scores
        units, k = scores.shape
        sums = noise.rows.groups.sums
        each = [sums(seen / length * f.unit_residual(level), level) for f in (noise, effect)]
        own, added = (float((part**2).sum()) for part in each)
        own *= max(1.0, k / float((scores**2).sum()))  # not smaller than the noise is on average
        beyond = ndtri(criteria.TARGET_POWER) * np.sqrt(own)
        share = 1 - betaincinv((units - k) / 2, k / 2, np.exp(self.critical_many))
        margin = length / (np.sqrt(units * share * (own + added)) + beyond)
        if units < criteria.JACKKNIFE_UNITS:
            return margin
        tail = self.level / 2 / self.many
        spread = length / (np.sqrt(own * k * fdtri(k, units - k, 1 - tail)) + beyond)
        explained = length / (np.sqrt(chdtri(k, tail)) + beyond)
        for one in ("file", "run") if level in ("file", "run") else ():
            units = ClusterTests(noise, one), ClusterTests(effect, one)
            by_units = _by_numbers(units, left, candidate.target, tail, least=criteria.CONSTANT_IN_RUNS)
            explained = max(explained, by_units)
        return max(margin, min(spread, explained))


def _by_numbers(
    both: Sequence[ClusterTests], left: np.ndarray, target: tuple[str, str], tail: float, least: float = 0.0
) -> float:
    """Return the margin by the F test of one number per unit, at a p-value; 0 if the columns are not that.

    The tests are those of the noise and of the effect.
    """
    test, added = (units.test(left, target) for units in both)
    if test is None or test.share <= least:
        return 0.0
    k, df = test.basis.shape[1], test.known + test.error_df
    squares = [float(np.sum(units.numbers(target).values ** 2)) for units in both]
    quiet, differs = (max(s - own.chi2, 0.0) / df for s, own in zip(squares, (test, added), strict=True))
    return float(_margin(np.sqrt(added.chi2), quiet + test.known / df, differs, k, df, tail))


def _margin(length: np.ndarray, quiet: np.ndarray, differs: np.ndarray, k: int, df: np.ndarray, tail: float):
    """Return the ratio of an effect to the size needed, by F with k and df degrees of freedom at a p-value.

    It is tested against a variance: `quiet` without the effect, plus `differs`, which the effect adds itself.
    """
    critical = fdtri(k, df, 1 - tail)
    return np.abs(length) / np.sqrt(
        quiet * ncfdtrinc(k, df, 1 - criteria.TARGET_POWER, critical) + k * critical * differs
    )


def _under(fitted: Fitted, effect: np.ndarray) -> Fitted:
    """Return a fit under the scatter that is estimated with an effect added to its residual."""
    rows, loads, residual = fitted.rows, fitted.loads, fitted.residual + effect
    scatter = estimate_scatter(rows, residual, loads, fitted.free_jacobian, fitted.scatter)
    whitening = Whitening(scatter, loads, rows.groups)
    return replace(fitted, scatter=scatter, whitening=whitening, white_jacobian=whitening.of(fitted.jacobian))


def undetectable_variables(
    selection: Selection, entries: Sequence[dict], scatter: Sequence[dict]
) -> dict[str, bool]:
    """Return the variables whose effects are not detectable in this campaign.

    The value is whether an error within the scatter of repeats does not exclude an effect: if repeats scatter
    strongly, or specimens do, as repeats are of one specimen, or if the model goes through the means of all
    runs.

    An effect is not detectable if it cannot reach the required p-value, and the variable varies along
    strokes, is the direction, or varies between fewer than five specimens; or if the units between which it
    varies, their repeats, or the rows of a stroke, scatter strongly, and an effect that explains all of that
    scatter would not have been found. No effect between runs is detectable if the model goes through their
    means.
    """
    fitted = selection.after
    rows, starts = fitted.rows, fitted.rows.groups.starts
    sizes = {rows.level_name(level): start.size for level, start in starts.items()}
    sd_N = float(np.sqrt(rows.weight @ about_means(fitted.residual, rows, "stroke") ** 2))
    within_strokes = {"sd_N": sd_N, "sd_rel": sd_N / float(np.sqrt(rows.weight @ fitted.force**2))}
    in_model, through_runs = _channels_in_model(selection), degrees_of_freedom(fitted) == 0
    undetectable, file = {}, rows.level_name("file")
    for entry in entries:
        if entry["variable"] == SPECIMEN:
            undetectable[SPECIMEN] = False
            continue
        channel: Channel = selection.channels[entry["variable"]]
        aside = channel.grouping or channel.name in in_model or channel.name in ASIDE
        if aside or entry["level"] != LEVEL_NAMES[rows.level_name(channel.unit)]:
            continue
        smallest = np.inf if entry["smallest_N"] is None else entry["smallest_N"]
        along = channel.unit == "sample"
        count = None if along else starts[channel.unit].size
        own = [within_strokes] if along else [s for s in scatter if sizes[s["level"]] == count]
        repeats = [s for s in scatter if not along and s["level"] == file and sizes[file] > count]
        much, of_repeats = _may_hide(smallest, own), _may_hide(smallest, repeats)
        few_specimens = channel.unit == "specimen" and count < criteria.LEAST_UNITS_OF_SLOPES
        decisive = along or channel.name == "direction" or few_specimens
        hidden = through_runs and channel.unit in ("run", "specimen")
        if hidden or much or of_repeats or (decisive and not np.isfinite(smallest)):
            undetectable[channel.name] = hidden or of_repeats or (much and channel.unit == "specimen")
    return undetectable


def _may_hide(smallest_N: float, scatter: Sequence[dict]) -> bool:
    """Return whether a scatter of some levels is strong, and its size would not be found as an effect."""
    return any(s["sd_rel"] > criteria.MATERIAL_SCATTER and s["sd_N"] < smallest_N for s in scatter)
