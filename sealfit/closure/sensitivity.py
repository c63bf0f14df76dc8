"""What a campaign could have shown: for each variable the smallest effect that it would have found.

The effect is a straight line in the variable (an offset, for the direction), added to the force or a factor on mu,
whichever shows sooner. It is found with 80 % chance where its size over its standard error exceeds the critical value
of the search by the 80 % quantile of Student's t.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.special import stdtrit

from sealfit.closure.adjusted import SEARCHES
from sealfit.closure.channels import Channel, scatter_level
from sealfit.closure.grow import Grown
from sealfit.closure.judge import Candidate, project
from sealfit.closure.search import MAIN_TARGETS
from sealfit.closure.slopes import LEAST_UNITS, WAYS, moderated

POWER = 0.8
"""Chance with which the smallest effect is found."""

WANTED_PCT = 1.0
"""Of the friction: the effect that `files_needed` refers to."""

ASIDE = ("run_order", "elapsed_h", "repeat")
"""Channels of the order of tests: what they show is no reason to doubt the model of friction."""

MATERIAL = 0.02
"""Of the force: scatter between units that would matter if it were an effect."""

LEVEL_NAMES = {"sample": "trace", "stroke": "stroke", "file": "repeat", "run": "run", "specimen": "condition"}


def sensitivity(grown: Grown, alpha: float) -> list[dict]:
    """Return per variable: variable, level, smallest_N, smallest_pct and files_needed.

    Parameters
    ----------
    grown : Grown
        The end of the loop, with the candidates of its last search.
    alpha : float
        Family-wise level of the search.

    Returns
    -------
    list of dict
        `smallest_N` is the RMS over all rows of the smallest effect found with 80 % chance, `smallest_pct` the same in
        percent of the RMS force; None where the variable cannot be tested in this campaign. `files_needed` is how many
        files, made like these, would show an effect of 1 % of the force.
    """
    fitted = grown.after
    rows, force = fitted.rows, float(np.sqrt(fitted.rows.weight @ fitted.force**2))
    files = rows.groups.starts["file"].size
    tested = _errors(grown.last)
    entries = []
    for name, channel in grown.channels.items():
        own = [k for k, c in enumerate(grown.last) if not c.pair and c.channels[-1] == name and k in tested]
        sizes = [_smallest(grown, grown.last[k], alpha, *tested[k]) for k in own if _main(grown.last[k])]
        smallest = min((size for size in sizes if np.isfinite(size)), default=None)
        if smallest is None:
            units = rows.groups.starts[scatter_level([channel], rows)].size
            needed = int(np.ceil(files * LEAST_UNITS / units)) if units < LEAST_UNITS else None
        else:
            needed = int(np.ceil(files * (100 * smallest / force / WANTED_PCT) ** 2))
        entries.append(
            {
                "variable": name,
                "level": LEVEL_NAMES[channel.unit],
                "smallest_N": smallest,
                "smallest_pct": None if smallest is None else 100 * smallest / force,
                "files_needed": needed,
            }
        )
    return entries


def _main(candidate: Candidate) -> bool:
    return (candidate.acts_on, candidate.operation) in MAIN_TARGETS


def _errors(candidates: Sequence[Candidate]) -> dict[int, tuple[float, float, int]]:
    """Return by number of a candidate the variance of its first contrast, its df, and of how many tests it is one."""
    slopes = [k for k, c in enumerate(candidates) if c.judgement.slopes]
    count = WAYS * sum(candidates[k].judgement.slopes[0].slope.size for k in slopes)
    found = {}
    for k, (variance, df) in zip(slopes, moderated([candidates[k].judgement.slopes[0] for k in slopes]), strict=True):
        found[k] = float(variance[0]), float(df[0]), count
    few = [k for k, c in enumerate(candidates) if c.judgement.few is not None]
    for k in few:
        test = candidates[k].judgement.few
        found[k] = 1.0, test.known + test.error_df, len(few)
    many = [k for k in range(len(candidates)) if k not in found]
    for k in many:
        found[k] = 1.0, float(candidates[k].judgement.scores.shape[0] - 1), len(many)
    return found


def _smallest(grown: Grown, candidate: Candidate, alpha: float, variance: float, df: float, count: int) -> float:
    """Return the RMS of the smallest effect along a candidate's first column; infinite where none can be found."""
    fitted = grown.after
    column = candidate.columns[:, :1] * fitted.slope(candidate.acts_on, candidate.operation)[:, None]
    size = float(np.linalg.norm(project(fitted, column)))
    if size == 0 or df < 1:
        return np.inf
    reach = stdtrit(df, 1 - alpha / (2 * SEARCHES * count)) + stdtrit(df, POWER)
    return float(reach * np.sqrt(variance) / size * np.sqrt(fitted.rows.weight @ column[:, 0] ** 2))


def cannot_tell(grown: Grown, entries: Sequence[dict], scatter: Sequence[dict]) -> list[str]:
    """Return the variables of which this campaign could not have told; empty where it could.

    A variable cannot be told if it varies along strokes, or is speed or direction, and cannot be tested at all; or if
    the units that it varies between scatter by much, and an effect that explains all of that would not have been seen.

    Parameters
    ----------
    grown : Grown
        The end of the loop.
    entries : sequence of dict
        As `sensitivity` gives them.
    scatter : sequence of dict
        closure.json's `scatter`.
    """
    starts = grown.after.rows.groups.starts
    open_ = []
    for entry in entries:
        channel: Channel = grown.channels[entry["variable"]]
        if channel.grouping or channel.name in ASIDE:
            continue
        smallest = np.inf if entry["smallest_N"] is None else entry["smallest_N"]
        own = [s for s in scatter if channel.unit != "sample" and starts[s["level"]].size == starts[channel.unit].size]
        much = any(s["sd_rel"] > MATERIAL and s["sd_N"] < smallest for s in own)
        if much or (channel.scatters and not np.isfinite(smallest)):
            open_.append(channel.name)
    return open_
