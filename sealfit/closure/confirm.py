"""Confirm on data that the fit did not see: whole groups held out, everything refitted without them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from sealfit.closure.naming import Proposal, file_shifts
from sealfit.closure.ripple import Peak
from sealfit.fit.estimate import Fitted, fit, fitted_at
from sealfit.fit.joint import Model, evaluate
from sealfit.fit.rows import Rows

LEAST_RUNS = 6  # below six runs whole files are held out, below six files strokes (design: held-out unit)


def heldout_level(rows: Rows) -> str:
    """Return the level whose groups are held out: run, or file or stroke where there are fewer than six."""
    for level in ("run", "file"):
        if rows.groups.starts[level].size >= LEAST_RUNS:
            return level
    return "stroke"


def folds(rows: Rows, level: str, count: int, seed: int) -> Iterator[np.ndarray]:
    """Yield masks of the rows held out, shape (n,): whole groups, dealt so that each condition keeps most of its own.

    Day 0 and the last day are never held out with all their groups, as a law is not asked to extrapolate.
    """
    start, code = rows.groups.starts[level], rows.codes(level)
    count = min(count, start.size)
    condition = rows.condition[start]
    rng = np.random.default_rng(seed)
    shuffled = rng.permutation(start.size)
    order = shuffled[np.argsort(condition[shuffled], kind="stable")]
    number = np.empty(start.size, dtype=int)
    number[order] = np.arange(start.size) % count
    for k in range(count):
        out = number == k
        for c in np.unique(condition[out]):
            if not (~out & (condition == c)).any() and _edge(rows, c):
                out &= condition != c
        if out.any():
            yield out[code]


def _edge(rows: Rows, condition: int) -> bool:
    if not rows.has_aging:
        return True  # a condition of its own parameters cannot be predicted without its rows
    days = rows.conditions["aging_days"]
    series = rows.conditions["series"]
    own = days[series == series.iloc[condition]]
    return bool(days.iloc[condition] in (0.0, own.max()))


def heldout_force(model: Model, fitted: Fitted, level: str, count: int, seed: int) -> np.ndarray:
    """Return each row's force by the model refitted without the row's group, shape (n,); NaN where never held out."""
    rows = fitted.rows
    force = np.full(rows.force.size, np.nan)
    for out in folds(rows, level, count, seed):
        kept = fit(model, rows.subset(~out), fitted.scatter, turns=0)
        force[out] = evaluate(kept.model, rows.subset(out), jacobian=False)[0]
    return force


def heldout_gain(before: Fitted, proposal: Proposal, count: int, seed: int) -> float:
    """Return by how much a proposal lowers the RMSE on held-out groups of its own unit, in force units."""
    after = proposal.fitted
    if "shift" in proposal.term.fixed:
        return _gain_within_files(before, proposal)
    level = proposal.unit
    old = heldout_force(before.model, before, level, count, seed)
    new = heldout_force(after.model, after, level, count, seed)
    known = np.isfinite(old) & np.isfinite(new)
    weight = before.rows.weight[known] / before.rows.weight[known].sum()
    measured = before.rows.force[known]
    return float(np.sqrt(weight @ (measured - old[known]) ** 2) - np.sqrt(weight @ (measured - new[known]) ** 2))


def _gain_within_files(before: Fitted, proposal: Proposal) -> float:
    """Return the gain on one half of every stroke with each file's phase taken from the other half."""
    rows, after = before.rows, proposal.fitted
    start, code = rows.groups.starts["stroke"], rows.codes("stroke")
    count = np.diff(np.r_[start, code.size])
    first = np.arange(code.size) - start[code] < count[code] / 2
    length = after.model.values[-1]["lambda_"]
    peak = Peak(proposal.term.channels[0], length, True, False, 0.0, 0.0, 0.0)
    old, new = 0.0, 0.0
    for out in (first, ~first):
        train = rows.subset(~out)
        shift = file_shifts(fitted_at(before.model, train, before.scatter), peak)
        term = replace(proposal.term, fixed={**proposal.term.fixed, "shift": shift})
        model = replace(after.model, terms=(*after.model.terms[:-1], term))
        test = rows.subset(out)
        for which, m in (("old", before.model), ("new", model)):
            residual = test.force - evaluate(m, test, jacobian=False)[0]
            level = test.groups.means(residual, "stroke")[test.codes("stroke")]
            error = float(test.weight @ (residual - level) ** 2)
            if which == "old":
                old += error
            else:
                new += error
    return float(np.sqrt(old / 2) - np.sqrt(new / 2))
