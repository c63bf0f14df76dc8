"""Intervals of the joint model: parameters of effects, and the mean force at points."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.special import stdtrit

from sealfit.closure.criteria import FEW_UNITS, LARGEST_LEVERAGE, LEAST_SPARE_RUNS
from sealfit.closure.small_sample_test import satterthwaite_df
from sealfit.fit.joint.estimate import Fitted
from sealfit.fit.joint.rows import LEVELS
from sealfit.fit.joint.tangent import Tangent

Interval = tuple[float, float, float]
"""Value and both ends of its 95 % interval."""

PHASES = {"A": "phi", "B": "phi_2"}
"""Amplitudes of sines, and the phase of each."""


class Sandwich(NamedTuple):
    """Covariance of the fitted numbers that whole groups of a level show, whatever it is that these differ in."""

    covariance: np.ndarray  # (p, p)
    information: Sequence[tuple[np.ndarray, np.ndarray]]
    """Of each group the numbers it depends on, shape (k,), and their information, shape (k, k); empty if many."""


def degrees_of_freedom(fitted: Fitted) -> float:
    """Return the degrees of freedom of the coarsest level that scatters: units there less the levels they estimate.

    0 where the model has as many numbers as there are runs: nothing then shows how runs scatter.
    """
    groups = fitted.rows.groups
    white = fitted.whitening(fitted.friction[:, None])[:, 0]
    white = white / np.sqrt(groups.sums(white**2, "run"))[groups.codes["run"]]
    taken = float((fitted.basis.sums(groups, "run", white).values ** 2).sum())
    if groups.starts["run"].size - taken < LEAST_SPARE_RUNS:
        return 0.0
    active = [c.level for c in fitted.scatter.components if c.variance > 0]
    level = active[-1] if active else "file"
    units = fitted.rows.groups.starts[LEVELS[max(LEVELS.index(level), 1)]].size
    between = len({(p.quantity, p.owner) for p in fitted.model.declared.parameters if p.quantity in ("mu_0c", "a_c")})
    return float(max(units - (between if level == "specimen" else fitted.basis.shape[1]), 1))


def t_quantile(df: float) -> float:
    """Return the two-sided 95 % quantile of Student's t; NaN for no degrees of freedom."""
    return float(stdtrit(df, 0.975))


def robust_covariance(fitted: Fitted, level: str) -> np.ndarray:
    """Return the sandwich covariance from whole groups of a level (CR2), shape (p, p)."""
    scores = fitted.white_jacobian.sums(fitted.rows.groups, level, fitted.unit_residual(level))
    return fitted.covariance @ scores.gram() @ fitted.covariance


def sandwiches(fitted: Fitted) -> list[Sandwich]:
    """Return the sandwich covariances of whole files, runs and specimens, and of one level with many groups at most.

    Specimens and runs may differ in numbers that no variance component holds, such as v_s.
    """
    found, rows, white = [], fitted.rows, fitted.white_jacobian
    for level in reversed(LEVELS[1:]):
        starts = rows.groups.starts[level]
        if starts.size < 2:
            continue
        information = []
        if starts.size < FEW_UNITS:
            for first, last in itertools.pairwise([*starts, white.shape[0]]):
                layout = replace(white.layout, block=white.layout.block[first:last])
                gram = Tangent(layout, white.values[first:last]).gram()
                numbers = np.flatnonzero(np.diag(gram))
                information.append((numbers, gram[np.ix_(numbers, numbers)]))
        found.append(Sandwich(robust_covariance(fitted, level), information))
        if starts.size >= FEW_UNITS:
            break
    return found


def effect_intervals(fitted: Fitted, number: int, level: str) -> dict[str, Interval]:
    """Return {parameter: (value, lo95, hi95)} of one effect.

    The wider of two standard errors counts: that of the fitted scatter, and the one that whole units of the effect's
    own level show, so that an effect which itself scatters between units is not given too short an interval.
    """
    term = fitted.model.terms[number]
    held = term.fixed.get("held", {})
    place = fitted.model.term_slice(number)
    variance = np.diag(robust_covariance(fitted, level))[place]
    if not held:  # a wave is finer than the shapes in which files differ, which the fitted scatter holds against it
        variance = np.maximum(variance, np.diag(fitted.covariance)[place])
    units = fitted.rows.groups.starts[level].size
    reach = t_quantile(max(units - variance.size - 1, 2)) * np.sqrt(variance)
    values = fitted.model.values[number]
    result = {}
    for p, r in zip(term.effect.parameters, reach, strict=True):
        low, high = held.get(p.name, (values[p.name] - r, values[p.name] + r))
        result[p.name] = (values[p.name], float(low), float(high))
    return waves_upright(result)


def waves_upright(intervals: dict[str, Interval]) -> dict[str, Interval]:
    """Return intervals with the amplitude of every sine positive and its phase above -pi and at most pi.

    -A at a phase is A half a turn on: without a choice, where the position is counted from decides on the sign.
    """
    made = dict(intervals)
    for amplitude, phase in PHASES.items():
        if amplitude not in made or phase not in made:
            continue
        value, low, high = made[amplitude]
        turn = np.pi if value < 0 else 0.0
        if value < 0:
            made[amplitude] = (-value, -high, -low)
        value, low, high = made[phase]
        turn += 2 * np.pi * np.floor((np.pi - value - turn) / (2 * np.pi))
        made[phase] = (value + turn, low + turn, high + turn)
    return made


def mean_se(tangent: Tangent, covariance: np.ndarray) -> np.ndarray:
    """Return the standard error of the model's force from its tangent, of shape (n, p), and covariance -> (n,)."""
    return np.sqrt(np.maximum(tangent.squares(covariance), 0.0))


def mean_half_width(tangent: Tangent, covariance: np.ndarray, df: float, others: Sequence[Sandwich]) -> np.ndarray:
    """Return half the 95 % interval of the model's force, shape (n,): the widest of several.

    One is that of the variance components. The others are those of whole groups, each with the degrees of freedom by
    Satterthwaite that its groups leave at this point; one group that decides on a force alone says nothing of it.

    Parameters
    ----------
    tangent : Tangent, shape (n, p)
        Of the model at the points.
    covariance : ndarray, shape (p, p)
        By the variance components.
    df : float
        Its degrees of freedom.
    others : sequence of Sandwich
        By whole groups.
    """
    half = t_quantile(df) * mean_se(tangent, covariance)
    for covariance_of_groups, information in others:
        reach = np.full(half.shape, t_quantile(df))
        if len(information):
            share = np.stack([tangent.squares(covariance[:, k] @ own @ covariance[k]) for k, own in information])
            share /= np.maximum(share.sum(axis=0), 1e-300)
            reach = np.where(share.max(axis=0) > LARGEST_LEVERAGE, 0.0, stdtrit(satterthwaite_df(share), 0.975))
        half = np.maximum(half, reach * mean_se(tangent, covariance_of_groups))
    return half
