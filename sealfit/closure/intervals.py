"""Intervals of the joint model: for parameters of effects and for the mean force at points."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.special import stdtrit

from sealfit.closure.criteria import FEW_UNITS, LARGEST_LEVERAGE, LEAST_SPARE_RUNS
from sealfit.closure.small_sample_test import satterthwaite_df
from sealfit.fit.joint import Fitted
from sealfit.fit.joint.rows import LEVELS
from sealfit.fit.joint.tangent import Tangent

Interval = tuple[float, float, float]
"""Value and both ends of its 95 % interval."""

PHASES = {"A": "phi", "B": "phi_2"}
"""Amplitudes of sines, and the phase of each."""


class Sandwich(NamedTuple):
    """Sandwich covariance of the parameters from whole groups of a level."""

    covariance: np.ndarray  # (p, p)
    information: Sequence[tuple[np.ndarray, np.ndarray]]
    """Parameters each group depends on, shape (k,), and their information, (k, k); empty with many groups."""


def degrees_of_freedom(fitted: Fitted) -> float:
    """Return the degrees of freedom of the coarsest level that scatters.

    This is the number of its units less the parameters they estimate; 0 if the model has as many parameters
    as there are runs, because the scatter of runs is then not estimable.
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
    between = len(
        {(p.quantity, p.owner) for p in fitted.model.declared.parameters if p.quantity in ("mu_0c", "a_c")}
    )
    return float(max(units - (between if level == "specimen" else fitted.basis.shape[1]), 1))


def t_quantile(df: float) -> float:
    """Return the two-sided 95 % quantile of Student's t; NaN for 0 degrees of freedom."""
    return float(stdtrit(df, 0.975))


def robust_covariance(fitted: Fitted, level: str) -> np.ndarray:
    """Return the sandwich covariance from whole groups of a level (CR2), shape (p, p)."""
    scores = fitted.white_jacobian.sums(fitted.rows.groups, level, fitted.unit_residual(level))
    return fitted.covariance @ scores.gram() @ fitted.covariance


def sandwiches(fitted: Fitted) -> list[Sandwich]:
    """Return the sandwich covariances of specimens, runs and files, down to the first level with many groups.

    Specimens and runs may differ in parameters that have no variance component, such as v_s.
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

    The larger of two standard errors is used: by the variance components, and by the sandwich of the units of
    the effect's level. An effect that scatters between units would otherwise get too short an interval.
    """
    term = fitted.model.terms[number]
    held = term.fixed.get("held", {})
    place = fitted.model.term_slice(number)
    variance = np.diag(robust_covariance(fitted, level))[place]
    if not held:  # the variance components describe coarser shapes than a wave
        variance = np.maximum(variance, np.diag(fitted.covariance)[place])
    units = fitted.rows.groups.starts[level].size
    reach = t_quantile(max(units - variance.size - 1, 2)) * np.sqrt(variance)
    values = fitted.model.values[number]
    result = {}
    for p, r in zip(term.effect.parameters, reach, strict=True):
        low, high = held.get(p.name, (values[p.name] - r, values[p.name] + r))
        result[p.name] = (values[p.name], float(low), float(high))
    return normalised_waves(result)


def normalised_waves(intervals: dict[str, Interval]) -> dict[str, Interval]:
    """Return intervals with the amplitude of every sine positive and its phase in (-pi, pi].

    An amplitude -A is the same as A with the phase shifted by pi.
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
    """Return the standard error of the model's force from its tangent, (n, p), and covariance -> (n,)."""
    return np.sqrt(np.maximum(tangent.squares(covariance), 0.0))


def mean_half_width(
    tangent: Tangent, covariance: np.ndarray, df: float, others: Sequence[Sandwich]
) -> np.ndarray:
    """Return half the 95 % interval of the model's force, shape (n,): the largest of several.

    One uses the variance components. The others are sandwiches of whole groups, each with Satterthwaite's
    degrees of freedom at this point. They are not used where one group alone determines the force.

    Parameters
    ----------
    tangent : Tangent, shape (n, p)
        Tangent of the model at the points.
    covariance : ndarray, shape (p, p)
        Covariance by the variance components.
    df : float
        Its degrees of freedom.
    others : sequence of Sandwich
        Sandwich covariances of whole groups.
    """
    half = t_quantile(df) * mean_se(tangent, covariance)
    for covariance_of_groups, information in others:
        reach = np.full(half.shape, t_quantile(df))
        if len(information):
            parts = [tangent.squares(covariance[:, k] @ own @ covariance[k]) for k, own in information]
            share = np.maximum(parts, 0.0)
            share /= np.maximum(share.sum(axis=0), 1e-300)
            reach = np.where(
                share.max(axis=0) > LARGEST_LEVERAGE, 0.0, stdtrit(satterthwaite_df(share), 0.975)
            )
        half = np.maximum(half, reach * mean_se(tangent, covariance_of_groups))
    return half
