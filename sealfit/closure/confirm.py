"""Confirmation on held-out data: whole groups are held out and everything is refitted without them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import pandas as pd

from sealfit.closure import criteria
from sealfit.closure.channels import follows_strokes, level_values, out_and_back, settings, varies
from sealfit.closure.errors_and_intervals import mean_se
from sealfit.closure.forms import describe
from sealfit.closure.left_out import between_speeds, blocks, covered, foldable, folds, whole_settings
from sealfit.closure.linearised import Proposal
from sealfit.closure.naming import LINEAR, rivals
from sealfit.closure.ripples import agreement, pass_shifts, unresolved_wave, waves_of
from sealfit.config import Config, Loop
from sealfit.effects.contract import Effect
from sealfit.effects.free import WITHIN
from sealfit.fit.joint import Fitted, fit, with_reml_smoothness
from sealfit.fit.joint.model import Model, Term, evaluate, shape_of
from sealfit.fit.joint.rows import ALONG, LEVELS, Rows
from sealfit.fit.joint.whitening import Whitening
from sealfit.progress import Silent
from sealfit.tables import CALENDAR

# Least and most settings for which interpolation is tested: fewer have no inner one, and more are dense.
LEAST_SETTINGS, MOST_SETTINGS = 3, 15

TOO_FINE = "it is smaller than the resolution of the recorded force"
TOO_SMALL = f"it is less than {criteria.LEAST_SIZE:.2%} of the force"
OF_THE_RISE = f"it is less than {criteria.RISE_ERROR:.0%} of the pre-sliding rise subtracted along strokes"
AT_THE_START = (
    f"it explains the force only within {criteria.RISE_LENGTHS:g} bristle lengths of the start of the strokes"
)
NO_AMPLITUDE = (
    "the bins are as long as its waves and do not determine its amplitude: raise per_stroke, or lower "
    "min_samples, under [bins]"
)
NO_GAIN = f"it lowers the error on held-out data by less than {criteria.LEAST_GAIN:.2%} of the force"
NOT_HELD_OUT = "no rows can be held out to confirm it: repeat the runs"
# Reasons of a refusal after which nothing is left to explain: the effect is too small to matter.
NEGLIGIBLE = (TOO_FINE, TOO_SMALL, OF_THE_RISE, AT_THE_START, NO_GAIN)
NEGATIVE = "it multiplies a quantity by a negative number"
WHOLE = ("mu", "force")  # Targets that are the whole friction.


@dataclass(frozen=True)
class Gain:
    """Gain of a proposal on held-out groups: in RMSE and in the whitened sum of squares."""

    rmse_N: float  # fall of the RMSE
    left_N: float  # RMSE with it
    deviance: float  # fall of the whitened sum of squares
    error: float = 0.0  # standard error of that fall, from the groups held out
    known: bool = True  # whether any rows could be held out that the others cover

    @property
    def real(self) -> bool:
        """Whether both errors fall, and the deviance by more than its standard error."""
        return self.deviance > self.error and self.rmse_N > 0

    @property
    def share(self) -> float:
        """Fall of the RMSE, as a share of the RMSE without the proposal."""
        return self.rmse_N / max(self.rmse_N + self.left_N, 1e-300)


def heldout_gain(before: Fitted, proposal: Proposal, loop: Loop, samples: pd.DataFrame) -> Gain:
    """Return the gain of a proposal on held-out groups of its own unit.

    If files scatter by newtons, the RMSE hardly changes with a ripple of 0.1 N. The whitened sum of squares
    does. For the same reason both are taken about the means of the groups within which the effect varies.
    """
    if "shift" in proposal.term.fixed:
        return _gain_within_files(before, proposal, samples)
    rows = before.rows
    calendar = [name for name in proposal.term.channels if name in CALENDAR]
    level = foldable(rows, proposal.unit)
    if calendar:
        masks = blocks(rows, level, loop.folds, calendar[0])
    else:
        masks = folds(rows, level, loop.folds, loop.seed)
    around = None if calendar else varies_within(proposal)  # a block of time is predicted as a whole
    return _gain(before, proposal, masks, around, (level, loop.folds, loop.seed, *calendar[:1]))


def gain_between_settings(before: Fitted, proposal: Proposal) -> Iterator[Gain]:
    """Yield the gain of a proposal if all files at an inner setting of one of its channels are held out."""
    rows = before.rows
    if len(proposal.term.effect.parameters) == 1:  # it cannot follow single settings
        return
    for name in proposal.term.channels:
        values = rows.unsigned(name)
        if name in CALENDAR or values.dtype.kind != "f" or not varies(values):
            continue
        values = settings(level_values(values, rows))
        if LEAST_SETTINGS <= np.unique(values).size <= MOST_SETTINGS:
            yield _gain(before, proposal, whole_settings(rows, values), None, ("setting", name))


def _gain(
    before: Fitted, proposal: Proposal, masks: Iterable[np.ndarray], around: str | None, folds_of: tuple
) -> Gain:
    """Return the gain on rows held out by `masks`, about the means of the groups of level `around` if given.

    The means are over the rows of all folds, as a specimen may have a single run in one. Both residuals are
    whitened by the scatter estimated with the proposal; without it the effect is part of the scatter. The
    residual without the proposal is cached; `folds_of` is what the masks depend on.
    """
    rows, after = before.rows, proposal.fitted
    left = np.full((2, rows.force.size), np.nan)
    for number, out in enumerate(masks):
        inside = covered(rows, out, proposal.term.channels) & out
        if not inside.any():
            continue
        held = rows.subset(out)
        make = partial(_heldout_residual, before, before.model, out, held)
        without = before.cache.once(("held out", *folds_of, number), make)
        left[0, inside] = without[inside[out]]
        left[1, inside] = _heldout_residual(before, after.model, out, held)[inside[out]]
    scored = np.isfinite(left[0])
    if not scored.any():
        return Gain(0.0, 0.0, 0.0, known=False)
    test, weight = rows.subset(scored), rows.weight[scored]
    whitening = Whitening(after.scatter, before.loads[scored], test.groups)
    about = [about_means(own, test, around) for own in left[:, scored]]
    rmse = [float(np.sqrt(np.average(own**2, weights=weight))) for own in about]
    white = [test.groups.sums(whitening(own[:, None])[:, 0] ** 2, proposal.unit) for own in about]
    fall = white[0] - white[1]
    error = float(np.std(fall) * np.sqrt(fall.size))
    return Gain(rmse[0] - rmse[1], rmse[1], float(fall.sum()), error)


def _heldout_residual(before: Fitted, model: Model, out: np.ndarray, test: Rows) -> np.ndarray:
    """Return measured minus model in the rows held out, the model fitted to the others, shape (held out,)."""
    train, loads = before.rows.subset(~out), before.loads[~out]
    model = with_reml_smoothness(model, train, before.scatter, loads)
    kept = fit(model, train, before.scatter, turns=0, loads=loads)
    return test.force - evaluate(kept.model, test, jacobian=False)[0]


def varies_within(proposal: Proposal, share: float = criteria.MOST_WITHIN) -> str | None:
    """Return the finest level in whose groups a share of the variance of the effect's shape lies, or None.

    The added force differs between runs as friction does, and the declared model explains that part.
    """
    rows, term, model = proposal.fitted.rows, proposal.term, proposal.fitted.model
    if term.channels == ("direction",):
        return None
    shape = shape_of(term, model.values[-1], rows)
    least = share * float(np.var(shape))
    return next((level for level in LEVELS if np.mean(about_means(shape, rows, level) ** 2) >= least), None)


def about_means(values: np.ndarray, rows: Rows, level: str | None) -> np.ndarray:
    """Return values about their mean in each group of a level and direction, shape (n,)."""
    if level is None:
        return values
    code = rows.codes(level) * 2 + (rows.speed > 0)
    return values - (np.bincount(code, values) / np.maximum(np.bincount(code), 1))[code]


def _gain_within_files(before: Fitted, proposal: Proposal, samples: pd.DataFrame) -> Gain:
    """Return the gain on one half of every file, with the phases of passes estimated from the other half."""
    rows, after, axis = before.rows, proposal.fitted, proposal.term.channels[0]
    in_turn = rows.table["stroke"].max() >= 4
    first, sample_first = (_first_half(table, in_turn) for table in (rows.table, samples))
    length = after.model.values[-1]["lambda_"]
    squares = np.zeros(2)
    for out, seen in ((first, ~sample_first), (~first, sample_first)):
        test = rows.subset(out)
        shift = pass_shifts(samples[seen], rows, length, axis)
        term = replace(proposal.term, fixed={**proposal.term.fixed, "shift": shift})
        model = replace(after.model, terms=(*after.model.terms[:-1], term))
        residuals = (test.force - evaluate(m, test, jacobian=False)[0] for m in (before.model, model))
        old, new = (own - test.groups.means(own, "stroke")[test.codes("stroke")] for own in residuals)
        weight = rows.weight[out]
        squares += weight @ old**2, weight @ new**2
    from scipy.stats import wilcoxon  # imported here: scipy.stats takes half a second to load

    # The amplitude of a ripple differs between files: each is tested for the same wave in both halves.
    both = agreement(samples, sample_first, length, axis)
    there = both.size > 1 and wilcoxon(both, alternative="greater").pvalue < criteria.RIPPLE_CONFIRMED_P
    rmse = np.sqrt(squares)
    return Gain(float(rmse[0] - rmse[1]), float(rmse[1]), float(squares[0] - squares[1]) if there else -1.0)


def _first_half(table: pd.DataFrame, in_turn: bool) -> np.ndarray:
    """Return which rows or samples (ordered by stroke) belong to the first half, shape (n,).

    Halves are alternate pairs of forward and backward strokes, or else halves of each stroke.
    """
    if in_turn:
        return ((table["stroke"].to_numpy() - 1) // 2 % 2) == 0
    strokes = table.groupby("stroke_id")["stroke_id"]
    return (strokes.cumcount() < strokes.transform("size") / 2).to_numpy()


@dataclass(frozen=True)
class AcceptedEffect:
    """An accepted effect: the proposal, its gain on held-out data and the rivals these data do not exclude.

    `left_N` is the RMSE on the held-out data with it, and the number beside each rival is that with the rival
    instead; NaN if not computed.
    """

    proposal: Proposal
    gain_N: float
    left_N: float
    rivals: tuple[tuple[Proposal, float], ...]
    round: int


@dataclass(frozen=True)
class RefusedEffect:
    """A significant effect that is in no model, with the reason."""

    proposal: Proposal
    reason: str

    @property
    def negligible(self) -> bool:
        """Whether it is too small to matter."""
        return self.reason in NEGLIGIBLE


@dataclass(frozen=True)
class Context:
    """Settings of every round of the loop."""

    config: Config
    effects: Mapping[str, Effect]  # the catalogue, the user's own effects included
    say: Callable[[str], None] = Silent().say  # called with a line on what is being done
    compare: bool = True  # whether the held-out error of rivals is computed too
    workers: int = 1  # processes for the folds


def confirmed(
    fitted: Fitted, proposals: Sequence[Proposal], samples: pd.DataFrame, context: Context, number: int
) -> tuple[AcceptedEffect | None, list[RefusedEffect]]:
    """Return the first of a round's best proposals that has a gain on held-out data; None if none has.

    If none is confirmed, the significant ones are returned too, best first, each with the reason.
    """
    config = context.config
    refused: list[RefusedEffect] = []
    for proposal in proposals[: criteria.MOST_PROPOSALS]:
        gain = heldout_gain(fitted, proposal, config.loop, samples)
        negative = turns_negative(proposal.fitted)
        reason = NEGATIVE if negative else _reason_refused(fitted, proposal, gain, samples)
        unit = config.units.unit("force")
        label = describe(proposal.term, fitted.rows)
        context.say(f"  round {number}: {label}: held-out gain {gain.rmse_N:.4g} {unit}")
        if reason is None:
            others = rivals(proposal, proposals)
            if context.compare:
                others = _by_stroke_number(proposal, context.effects[LINEAR]) + others
            most = criteria.MOST_RIVALS if context.compare else 0
            left = [heldout_gain(fitted, rival, config.loop, samples).left_N for rival in others[:most]]
            left += [np.nan] * (len(others) - len(left))
            others = tuple(zip(others, left, strict=True))
            return AcceptedEffect(proposal, gain.rmse_N, gain.left_N, others, number), []
        if proposal.p_value <= config.loop.family_error:
            refused.append(RefusedEffect(proposal, reason))
    return None, refused


def _by_stroke_number(proposal: Proposal, linear: Effect) -> list[Proposal]:
    """Return an asymmetry as an effect of the stroke number if that only distinguishes the directions."""
    term = proposal.term
    if term.effect.id != "asymmetry" or not out_and_back(proposal.fitted.rows):
        return []
    rows = proposal.fitted.rows
    forward = rows.values("stroke")[rows.speed > 0][0]
    middle = float(rows.values("stroke").min() + rows.values("stroke").max()) / 2
    model = proposal.fitted.model
    own = Term(linear, ("stroke",), *term.target, fixed={"x_ref": middle})
    slope = model.values[-1]["A"] / (2 * (forward - middle))
    model = model.without_term(len(model.terms) - 1).with_term(own, {"A": float(slope)})
    return [replace(proposal, term=own, fitted=replace(proposal.fitted, model=model))]


def _reason_refused(fitted: Fitted, proposal: Proposal, gain: Gain, samples: pd.DataFrame) -> str | None:
    """Return the reason why a proposal is refused; None if it is confirmed."""
    rows, added = fitted.rows, added_force(proposal)
    force, size = _rms(rows.force), _rms(added)
    if reason := _reason_too_small(proposal, added, rows, samples):
        return reason
    if _amplitude_too_large(proposal, samples):
        return NO_AMPLITUDE
    if only_at_start(fitted, proposal):
        return AT_THE_START
    if not gain.known:
        return NOT_HELD_OUT
    if not gain.real:
        small = size <= criteria.SMALL_SIZE * force and not proposal.term.effect.periodic
        return NO_GAIN if small else "it does not lower the error on held-out data"
    if gain.rmse_N < criteria.LEAST_GAIN * force and not _wave_of_its_own(proposal):
        return NO_GAIN
    if reason := _reason_of_weak_evidence(proposal, gain, rows):
        return reason
    if not all(g.real for g in gain_between_settings(fitted, proposal)):
        return "it does not predict held-out settings between those it was fitted to"
    if not proposal.term.effect.periodic and vague_between_speeds(fitted, proposal):
        return "with it the force between the tested speeds is less certain than the error that it removes"
    return None


def _wave_of_its_own(proposal: Proposal) -> bool:
    fitted = proposal.fitted
    return proposal.term.effect.periodic and not unresolved_wave(fitted.model, fitted.rows)


def _reason_too_small(proposal: Proposal, added: np.ndarray, rows: Rows, samples: pd.DataFrame) -> str | None:
    """Return the reason why the force that a proposal adds, shape (n,), is too small to matter, or None."""
    if _rms(added) <= rounding_error_N(samples):
        return TOO_FINE
    if _rms(added) <= criteria.LEAST_SIZE * _rms(rows.force):
        return TOO_SMALL
    along_strokes = acts_along_strokes(proposal, rows) and not proposal.term.effect.periodic
    least = error_of_rise_N(rows) if along_strokes else 0.0
    if least and _rms(about_means(added, rows, "stroke")) <= least:
        return OF_THE_RISE
    return None


def _reason_of_weak_evidence(proposal: Proposal, gain: Gain, rows: Rows) -> str | None:
    """Return the reason why a proposal with a gain is refused because of its p-value, or None."""
    halved, p_value = gain.share > 1 - criteria.HALVED, proposal.p_value
    above = "its p-value is above"
    if p_value > criteria.CURVE_P and not halved and _changes_the_curve(proposal):
        return f"{above} {criteria.CURVE_P:g}, and the scatter of such a coefficient is not known"
    along_strokes = acts_along_strokes(proposal, rows)
    if p_value > criteria.WITHIN_P and not halved and along_strokes and not proposal.term.effect.physical:
        return f"{above} {criteria.WITHIN_P:g}, and it is a shape along strokes without a mechanism"
    if proposal.weak and gain.share < criteria.LEAST_FALL:
        lowers = f"it lowers the held-out error by less than {criteria.LEAST_FALL:.0%}"
        return f"{above} {criteria.WEAK_P:g}, and {lowers}"
    return None


def turns_negative(fitted: Fitted) -> bool:
    """Whether the last effect of a fit multiplies a quantity by a negative number at some row."""
    term, values = fitted.model.terms[-1], fitted.model.values[-1]
    return term.operation == "multiply" and bool((shape_of(term, values, fitted.rows) <= -1).any())


def vague_between_speeds(before: Fitted, proposal: Proposal) -> bool:
    """Whether the largest standard error between tested speeds doubles and exceeds the residual."""
    points, fits = between_speeds(before.rows), (before, proposal.fitted)
    if points.speed.size == 0:
        return False
    largest = [float(mean_se(evaluate(f.model, points)[1], f.covariance).max()) for f in fits]
    return largest[1] > max(criteria.VAGUER * largest[0], before.rmse_N)


def _amplitude_too_large(proposal: Proposal, samples: pd.DataFrame) -> bool:
    """Whether the amplitude of a ripple on the bins is several times that on the samples."""
    term, fitted = proposal.term, proposal.fitted
    if not term.effect.periodic or "residual_N" not in samples:
        return False
    values = fitted.model.values[-1]
    own = waves_of(samples, np.array([values["lambda_"]]), term.channels[0]).amplitudes[:, 0]
    size = 1.0 if term.operation == "add" else _rms(fitted.rows.force)
    wave = np.nan_to_num(term.effect.shape(term.inputs(fitted.rows), **values))  # not averaged over bins
    return np.sqrt(2) * _rms(wave) * size > criteria.AMPLITUDE_RATIO * _rms(np.hypot(*own.T))


def _changes_the_curve(proposal: Proposal) -> bool:
    """Whether it acts on one coefficient, or is a shape of the speed and another variable.

    Mechanisms between strokes are exempt, and so is what differs between specimens. A shape of the speed in
    one category is tested against the scatter of specimens if they are enough.
    """
    term = proposal.term
    if proposal.unit == "specimen":
        return False
    if term.effect.id == WITHIN:
        return proposal.fitted.rows.groups.starts["specimen"].size < criteria.LEAST_UNITS_OF_SLOPES
    if term.effect.physical:
        return term.acts_on not in WHOLE and not set(ALONG).isdisjoint(term.channels)
    by_speed = len(term.channels) > 1 and "speed_mm_s" in term.channels
    return by_speed or term.acts_on not in WHOLE


def acts_along_strokes(proposal: Proposal, rows: Rows) -> bool:
    """Whether one of the effect's channels is the same along all strokes to a part."""
    return any(follows_strokes(name, rows) for name in proposal.term.channels)


def added_force(proposal: Proposal) -> np.ndarray:
    """Return what a fitted proposal adds to the force of the model without it, shape (n,)."""
    fitted = proposal.fitted
    without = fitted.model.without_term(len(fitted.model.terms) - 1)
    return fitted.force - evaluate(without, fitted.rows, jacobian=False)[0]


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def error_of_rise_N(rows: Rows) -> float:
    """Return the RMS change along strokes that an error of the subtracted pre-sliding rise may make."""
    if "presliding_N" not in rows.table:
        return 0.0
    subtracted = rows.table["presliding_N"].to_numpy(dtype=float)
    return criteria.RISE_ERROR * _rms(about_means(subtracted, rows, "stroke"))


def only_at_start(before: Fitted, proposal: Proposal) -> bool:
    """Whether an effect along strokes explains nothing beyond `RISE_LENGTHS` bristle lengths of their start.

    It is what is left of the pre-sliding rise then. What is explained is the fall of the sum of squares about
    the means of strokes.
    """
    rows = before.rows
    along_strokes = acts_along_strokes(proposal, rows) and not proposal.term.effect.periodic
    if not along_strokes or not rows.lag.compliance:
        return False
    force = np.abs(rows.groups.means(rows.force, "stroke"))[rows.codes("stroke")]
    beyond = rows.values("distance_mm") > criteria.RISE_LENGTHS * rows.lag.compliance * force
    if not beyond.any():
        return False
    explained = []
    for own in (np.ones_like(beyond), beyond):
        part = rows.subset(own)
        left = [about_means(f.residual[own], part, "stroke") for f in (before, proposal.fitted)]
        explained.append(float(rows.weight[own] @ (left[0] ** 2 - left[1] ** 2)))
    return explained[1] < criteria.BEYOND_START * explained[0]


def rounding_error_N(samples: pd.DataFrame) -> float:
    r"""Return the RMS rounding error of the recorded force if noise does not average it out, else 0.

    A force in steps of q has a rounding error of :math:`q / \sqrt{12}`. With noise of half a step or more the
    means of many samples resolve less than a step. With less noise, rounding errors repeat from file to file.
    """
    force = samples["force_N"].to_numpy(dtype=float)
    steps = np.diff(np.unique(force))
    if steps.size == 0 or steps.size > force.size / criteria.SAMPLES_PER_VALUE:
        return 0.0
    step = float(np.median(steps))
    same = np.diff(samples["stroke_id"].to_numpy()) == 0
    noise = float(np.std(np.diff(force)[same]) / np.sqrt(2)) if same.any() else 0.0
    return step / np.sqrt(12) if noise < step / 2 else 0.0
