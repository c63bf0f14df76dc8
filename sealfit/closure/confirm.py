"""Confirm on data that the fit did not see: whole groups held out, everything refitted without them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd

from sealfit.closure.channels import CALENDAR, FINER, LEAST_UNITS, unit_of
from sealfit.closure.forms import describe
from sealfit.closure.linearised import Proposal
from sealfit.closure.naming import rivals
from sealfit.closure.waves import agreement, pass_shifts
from sealfit.config import Config
from sealfit.fit.estimate import Fitted, as_smooth_as_wanted, fit
from sealfit.fit.joint import Model, evaluate
from sealfit.fit.rows import Rows
from sealfit.fit.whitening import Whitening

SURE = 0.005  # p-value, over files (Wilcoxon), at which a ripple of free phase helps the half it was not fitted to
COMPARED = 4  # rivals, best first, that are put to held-out data too
TRIES = 3  # proposals put to held-out data in a round before the residual is called unexplained


def heldout_level(rows: Rows) -> str:
    """Return the level whose groups are held out: run, or file or stroke where there are fewer than six."""
    for level in ("run", "file"):
        if rows.groups.starts[level].size >= LEAST_UNITS:
            return level
    return "stroke"


def folds(rows: Rows, level: str, count: int, seed: int) -> Iterator[np.ndarray]:
    """Yield masks of the rows held out, shape (n,): whole groups, dealt so that each condition keeps most of its own.

    Day 0 and the last day are never held out with all their groups, as a law is not asked to extrapolate.
    """
    start = rows.groups.starts[level]
    count = min(count, start.size)
    condition = rows.condition[start]
    rng = np.random.default_rng(seed)
    shuffled = rng.permutation(start.size)
    order = shuffled[np.argsort(condition[shuffled], kind="stable")]
    number = np.empty(start.size, dtype=int)
    number[order] = np.arange(start.size) % count
    yield from _masks(rows, level, number)


def blocks(rows: Rows, level: str, count: int, channel: str) -> Iterator[np.ndarray]:
    """Yield masks of the rows held out, shape (n,): groups that follow one another in the campaign's calendar.

    Neighbours in time resemble each other, and so do the conditions that were tested one after the other: with groups
    left out here and there any wavy line through the calendar seems to be confirmed.
    """
    start = rows.groups.starts[level]
    count = min(count, start.size)
    number = np.empty(start.size, dtype=int)
    number[np.argsort(rows.values(channel)[start], kind="stable")] = np.arange(start.size) * count // start.size
    yield from _masks(rows, level, number)


def _masks(rows: Rows, level: str, number: np.ndarray) -> Iterator[np.ndarray]:
    """Yield masks of the rows held out, shape (n,), from the fold of each group; no edge condition loses all groups."""
    start, code = rows.groups.starts[level], rows.codes(level)
    condition = rows.condition[start]
    for k in range(number.max() + 1):
        out = number == k
        for c in np.unique(condition[out]):
            if not (~out & (condition == c)).any() and _edge(rows, c):
                out = out & (condition != c)
        if out.any():
            yield out[code]


def _edge(rows: Rows, condition: int) -> bool:
    if not rows.has_aging:
        return True  # a condition of its own parameters cannot be predicted without its rows
    days = rows.conditions["aging_days"]
    series = rows.conditions["series"]
    own = days[series == series.iloc[condition]]
    return bool(days.iloc[condition] in (0.0, own.max()))


@dataclass(frozen=True)
class Gain:
    """What a proposal gains on held-out groups: in RMSE, and in the sum of squares with scatter accounted for."""

    rmse_N: float  # fall of the RMSE
    left_N: float  # RMSE with it
    deviance: float  # fall of the whitened sum of squares: what a piece of scatter moves as a whole counts once

    @property
    def real(self) -> bool:
        """Whether the held-out data speak for the proposal, in either way."""
        return self.deviance > 0 and self.rmse_N > 0


def heldout_gain(
    before: Fitted, proposal: Proposal, count: int, seed: int, samples: pd.DataFrame, known: dict[tuple, np.ndarray]
) -> Gain:
    """Return what a proposal gains on held-out groups of its own unit.

    The RMSE of a rig whose files scatter by newtons does not see a ripple of a tenth; the whitened sum of squares of
    the held-out groups does, as the offset and gain of a whole file or run cost it little. For the same reason the
    RMSE is taken about the means of the groups inside which the effect's channels vary. `known` keeps what the model
    without it leaves in each fold, for the next proposal.
    """
    if "shift" in proposal.term.fixed:
        return _gain_within_files(before, proposal, samples)
    rows, after, scatter = before.rows, proposal.fitted, before.scatter
    squares, white, total = np.zeros(2), np.zeros(2), 0.0
    calendar = [name for name in proposal.term.channels if name in CALENDAR]
    masks = blocks(rows, proposal.unit, count, calendar[0]) if calendar else folds(rows, proposal.unit, count, seed)
    for number, out in enumerate(masks):
        test = rows.subset(out)
        weight, whitening = rows.weight[out], Whitening(scatter, before.friction[out], test.groups)
        total += float(weight.sum())
        fold = (proposal.unit, *calendar[:1], number)
        if fold not in known:
            known[fold] = _left_in(before, before.model, out, test)
        for k, residual in enumerate((known[fold], _left_in(before, after.model, out, test))):
            inside = residual if calendar else _about(residual, test, proposal)  # a block of time is asked for whole
            squares[k] += float(weight @ inside**2)
            white[k] += float((whitening(residual[:, None]) ** 2).sum())
    rmse = np.sqrt(squares / max(total, 1e-300))
    return Gain(float(rmse[0] - rmse[1]), float(rmse[1]), float(white[0] - white[1]))


def _left_in(before: Fitted, model: Model, out: np.ndarray, test: Rows) -> np.ndarray:
    """Return measured minus model in the rows held out, the model fitted to the others, shape (held out,)."""
    train, friction = before.rows.subset(~out), before.friction[~out]
    model = as_smooth_as_wanted(model, train, before.scatter, friction)
    kept = fit(model, train, before.scatter, turns=0, friction=friction)
    return test.force - evaluate(kept.model, test, jacobian=False)[0]


def _about(residual: np.ndarray, rows: Rows, proposal: Proposal) -> np.ndarray:
    """Return a residual about the mean of its file, run or specimen: the finest whose groups the effect varies in."""
    units = [unit_of(rows.values(name), rows) for name in proposal.term.channels]
    finest = min(units, key=FINER.get)
    around = {"sample": "stroke", "stroke": "file", "file": "run", "run": "specimen"}.get(finest)
    if around is None or proposal.term.channels == ("direction",):
        return residual
    code = rows.codes(around) * 2 + (rows.speed > 0)  # in each direction apart: an offset between them is no shape
    return residual - (np.bincount(code, residual) / np.maximum(np.bincount(code), 1))[code]


def _gain_within_files(before: Fitted, proposal: Proposal, samples: pd.DataFrame) -> Gain:
    """Return the gain on one half of every file with each pass's phase taken from the other half.

    Halves are pairs of strokes there and back, taken in turn, or halves of the stroke in a file of one or two.
    """
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
        old, new = (_inside(test, evaluate(m, test, jacobian=False)[0]) for m in (before.model, model))
        weight = rows.weight[out]
        squares += weight @ old**2, weight @ new**2
    # Files differ in how strong their ripple is, so each is asked whether it is there at all, in both halves alike.
    from scipy.stats import wilcoxon  # here, as scipy.stats takes half a second to load

    both = agreement(samples, sample_first, length, axis)
    there = both.size > 1 and wilcoxon(both, alternative="greater").pvalue < SURE
    rmse = np.sqrt(squares)
    return Gain(float(rmse[0] - rmse[1]), float(rmse[1]), float(squares[0] - squares[1]) if there else -1.0)


def _first_half(table: pd.DataFrame, in_turn: bool) -> np.ndarray:
    """Return which rows or samples, those of a stroke one after the other, belong to the first half, shape (n,)."""
    if in_turn:
        return ((table["stroke"].to_numpy() - 1) // 2 % 2) == 0
    stroke = table["stroke_id"].to_numpy()
    start = np.flatnonzero(np.r_[True, stroke[1:] != stroke[:-1]])
    count = np.diff(np.r_[start, stroke.size])
    return np.arange(stroke.size) - np.repeat(start, count) < np.repeat(count, count) / 2


def _inside(rows: Rows, force: np.ndarray) -> np.ndarray:
    """Return measured minus model about its mean in each stroke, shape (n,)."""
    residual = rows.force - force
    return residual - rows.groups.means(residual, "stroke")[rows.codes("stroke")]


@dataclass(frozen=True)
class Added:
    """An accepted effect: the proposal, its gain on held-out data and the rivals these data cannot tell from it.

    `left_N` is the RMSE on the held-out data with it, and `rivals_rmse_N` with each rival in its place; NaN where that
    was not asked for. Where the effect varies inside files, runs or specimens, it is the RMSE about their means.
    """

    proposal: Proposal
    gain_N: float
    left_N: float
    rivals: tuple[Proposal, ...]
    rivals_rmse_N: tuple[float, ...]
    round: int


def confirmed(
    fitted: Fitted,
    proposals: Sequence[Proposal],
    samples: pd.DataFrame,
    config: Config,
    number: int,
    say: Callable[[str], None],
    *,
    compare: bool,
) -> Added | None:
    """Return the first of a round's best proposals that gains on held-out data; None where none does.

    Parameters
    ----------
    fitted : Fitted
        The current model.
    proposals : sequence of Proposal
        Best first.
    samples : DataFrame
        Raw samples with `residual_N`.
    config : Config
        Folds, seed and units.
    number : int
        Of the round.
    say : callable
        Told in words what is being done.
    compare : bool
        Whether its rivals are asked for the held-out data too.
    """
    folds_of = (config.loop.folds, config.loop.seed, samples, {})
    for proposal in proposals[:TRIES]:
        gain = heldout_gain(fitted, proposal, *folds_of)
        unit = config.units.unit("force")
        say(f"  round {number}: {describe(proposal.term)}: held-out gain {gain.rmse_N:.4g} {unit}")
        if gain.real:
            others = rivals(proposal, proposals)
            rmse = [heldout_gain(fitted, o, *folds_of).left_N for o in others[:COMPARED]] if compare else []
            rmse += [np.nan] * (len(others) - len(rmse))
            return Added(proposal, gain.rmse_N, gain.left_N, tuple(others), tuple(rmse), number)
    return None
