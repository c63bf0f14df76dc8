"""Errors of the model, noise floor and lack of fit; intervals of its parameters and forces."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pandas as pd
from numpy.polynomial import Legendre
from scipy.special import fdtrc

from sealfit.closure.channels import FINER, Channel
from sealfit.closure.criteria import FEW_UNITS, LARGEST_LEVERAGE, LEAST_SPARE_RUNS
from sealfit.closure.score_test import Candidate
from sealfit.closure.small_sample_test import satterthwaite_df
from sealfit.effects.sensors import DAY_H
from sealfit.fit.joint import Fitted
from sealfit.fit.joint.model import Term
from sealfit.fit.joint.rows import LEVELS, Rows
from sealfit.fit.joint.tangent import OwnColumns, Tangent
from sealfit.fit.joint.variance_components import runs_show_scatter
from sealfit.fit.joint.whitening import KINDS, LEVELS_OF_FORCE
from sealfit.fit.least_squares import t_quantile
from sealfit.tables import LEVELS as TABLE_OF_LEVELS

SHAPES = 3  # Number of shapes along strokes in the lack-of-fit test: Legendre polynomials of degree 1 to 3.
RANK = 1e-9  # Relative singular value below which a direction of a tangent is zero.

# Least degrees of freedom of a sandwich at a point of a prediction. In 48 worlds drawn at random 98.7 % of
# 4,802 points that one or two groups determine lay inside without it, with intervals 2.2 times those by the
# variance components in the median and up to 15 times; 96.0 % with it, and 1.3 times.
LEAST_SANDWICH_DF = 2.0
# Largest ratio of a sandwich's half width to that by the variance components. In 55 of these worlds 93.2 % of
# 8,620 points lay inside without a limit, 93.0 % with it; the ratio was above 6 for 1 % of the points.
MOST_SANDWICH = 3.0

# Value and both ends of its 95 % interval.
Interval = tuple[float, float, float]
# Phases of waves: the amplitude of each, its period, and the largest value that is written.
PHASES = {"phi": ("A", 2 * np.pi, np.pi), "phi_2": ("B", 2 * np.pi, np.pi), "t_max": ("A", DAY_H, DAY_H)}


def errors(rows: Rows, residual: np.ndarray) -> dict[str, float]:
    """Return rmse_N, rmse_runs_N, max_abs_N and mean_abs_pct of a residual, (n,); files have equal weight."""
    weight = rows.weight
    run = pd.factorize(rows.table["run_id"])[0]
    per_run = np.bincount(run, weight)
    means = np.bincount(run, weight * residual) / per_run
    size = np.abs(np.bincount(run, weight * rows.force) / per_run)
    relative = np.abs(residual) / np.where(size > 0, size, np.nan)[run]
    known = np.isfinite(relative)
    percent = 100 * (weight[known] @ relative[known]) / weight[known].sum() if known.any() else None
    return {
        "rmse_N": float(np.sqrt(weight @ residual**2)),
        "rmse_runs_N": float(np.sqrt(np.mean(means**2))),
        "max_abs_N": float(np.abs(residual).max()),
        "mean_abs_pct": None if percent is None else float(percent),
    }


def without_repeat_pattern(rows: Rows, residual: np.ndarray) -> np.ndarray:
    """Return the residual less the mean pattern over first, second, third repeats, shape (n,)."""
    repeat = pd.factorize(rows.table["repeat"])[0]
    if repeat.max() == 0:
        return residual
    run = pd.factorize(rows.table["run_id"])[0]
    count = np.bincount(run)
    centred = residual - (np.bincount(run, residual) / count)[run]
    pattern = np.bincount(repeat, centred) / np.bincount(repeat)
    return residual - pattern[repeat]


def noise_floor(fitted: Fitted) -> float | None:
    """Return the RMS deviation of bins from their run's mean over repeats; None without repeats.

    It is the RMSE that the true mean would have on these bins. The mean pattern from one repeat to the next
    is not part of it, nor is the scatter of set-ups: without replicated runs it looks like lack of fit.
    """
    clean = without_repeat_pattern(fitted.rows, fitted.residual)
    place = fitted.rows.table.groupby(["run_id", "stroke", "bin"], sort=False).ngroup().to_numpy()
    count = np.bincount(place)
    mean = np.bincount(place, clean) / count
    repeated = count[place] > 1
    df = float((count - 1).sum())
    return float(np.sqrt(((clean - mean[place])[repeated] ** 2).sum() / df)) if df > 0 else None


def lack_of_fit(fitted: Fitted) -> float | None:
    """Return the p-value of the residual's means and shapes in runs against repeats (F tests).

    This is the smallest one times the number of tests (Bonferroni); None without repeats.
    """
    means = _p_of_run_means(fitted)
    tests = [p for p in (means, *_p_of_shapes(fitted)) if p is not None]
    return None if means is None else min(1.0, len(tests) * min(tests))


def _p_of_shapes(fitted: Fitted) -> list[float]:
    """Return the p-values of shapes along strokes that the repeats of a run have in common.

    Each is one number per file: noise may be correlated within strokes, and strokes of a file may be alike.
    """
    rows = fitted.rows
    stroke, start = rows.codes("stroke"), rows.groups.starts["stroke"]
    count = np.bincount(stroke)
    place = (np.arange(stroke.size) - start[stroke] + 0.5) * 2 / count[stroke] - 1
    scale = fitted.scatter.noise_sd(fitted.friction)[start]
    run, file = rows.table["run_id"].to_numpy()[start], rows.codes("file")[start]
    chosen = count > SHAPES
    found = []
    for degree in range(1, SHAPES + 1):
        shape = Legendre.basis(degree)(place)
        z = np.bincount(stroke, shape * fitted.residual) / count / scale
        strokes = pd.DataFrame({"run": run, "file": file, "z": z})
        cells = strokes[chosen].groupby(["run", "file"])["z"].mean().groupby("run")
        mean, files = cells.mean().to_numpy(), cells.size().to_numpy()
        df = float((files - 1).sum())
        if df > 0:
            pure = float((cells.var(ddof=0).to_numpy() * files).sum()) / df
            found.append(float(fdtrc(mean.size, df, (files @ mean**2 / mean.size) / max(pure, 1e-300))))
    return found


def _p_of_run_means(fitted: Fitted) -> float | None:
    """Return the p-value of run means against the scatter of files in runs (F test); None without repeats."""
    rows = fitted.rows
    clean = without_repeat_pattern(rows, fitted.residual)
    keys = rows.table[["run_id"]].assign(file=rows.codes("file"), residual=clean, friction=fitted.friction)
    files = keys.groupby(["run_id", "file"], sort=False).mean().reset_index()
    of_rows = pd.Series(fitted.scatter.level_variance("file", fitted.loads))
    spread = np.sqrt(of_rows.groupby(rows.codes("file")).mean()[files["file"]].to_numpy() + 1e-300)
    noise = fitted.scatter.noise_sd(files["friction"].to_numpy())
    per_file = len(rows.table) / len(files)
    scale = np.asarray(np.sqrt(spread**2 + noise**2 * fitted.scatter.design_effect / per_file))
    files["z"] = files["residual"] / scale
    by_run = files.groupby("run_id")["z"]
    count = by_run.transform("count").to_numpy()
    pattern = max(rows.table["repeat"].nunique() - 1, 0)
    runs = files["run_id"].nunique()
    df_pure = float(len(files) - runs - pattern)
    pure = float(((files["z"] - by_run.transform("mean")) ** 2).sum())
    mean = by_run.transform("mean").to_numpy()
    first = ~files["run_id"].duplicated().to_numpy()
    root = np.sqrt(count[first])
    size = mean[first] * root
    left, rank = _residual_of_model(fitted, size, np.flatnonzero(first), root / scale[first])
    df_fit = float(runs - rank)
    if df_pure < 1 or df_fit < 1:
        return None
    return float(fdtrc(df_fit, df_pure, (left @ left / df_fit) / max(pure / df_pure, 1e-300)))


def _residual_of_model(
    fitted: Fitted, size: np.ndarray, chosen: np.ndarray, factor: np.ndarray
) -> tuple[np.ndarray, int]:
    """Return the residual of one number per run, `size`, left by model and specimens, and their rank.

    `chosen` is a file of each run, and `factor` that on its tangent, the mean over the file's rows.
    """
    rows = fitted.rows
    number = rows.table.groupby(["run_id", rows.codes("file")], sort=False).ngroup().to_numpy()
    order = np.argsort(number, kind="stable")
    start = np.flatnonzero(np.r_[True, np.diff(number[order]) > 0])
    means, loads = (
        np.add.reduceat(values[order], start, axis=0)[chosen]
        / np.bincount(number)[chosen, None]
        * factor[:, None]
        for values in (fitted.free_jacobian.values, fitted.loads)
    )
    place = order[start][chosen]  # a row of each run
    tangent = Tangent(fitted.free_jacobian.layout.of(place), means)
    kinds = [c.kind for c in fitted.scatter.components if c.level == "specimen" and c.variance > 0]
    if not kinds:
        basis = tangent.orthonormal(RANK)
        return basis.project_out(size), basis.shape[1]
    own = OwnColumns(rows.codes("specimen")[place], loads[:, [KINDS.index(kind) for kind in kinds]])
    basis = tangent.orthonormal(RANK, project_out=own.project_out)
    return basis.project_out(own.project_out(size)), basis.shape[1] + own.count


def explained_variance(fitted: Fitted, candidate: Candidate) -> float:
    """Return the variance of the residual that a candidate's columns explain by weighted least squares."""
    root = np.sqrt(fitted.rows.weight)
    columns = candidate.columns * (fitted.slope(*candidate.target) * root)[:, None]
    found, *_ = np.linalg.lstsq(columns, fitted.residual * root, rcond=1e-10)
    return float(((columns @ found) ** 2).sum())


def level_table(
    stage: str,
    fitted: Fitted,
    searched: Fitted,
    candidates: Sequence[Candidate],
    channels: Mapping[str, Channel],
) -> pd.DataFrame:
    """Return the residual's variance by level and, within the levels, by channel (table `levels`).

    The level of a candidate is the finest at which one of its `channels` varies. The rows of the candidates
    are those of the fit that was `searched`, a part of all or means of them.
    """
    rows = fitted.rows
    noise = float(rows.weight @ fitted.scatter.noise_sd(fitted.friction) ** 2)
    free = float(rows.force.size - rows.groups.starts["stroke"].size)
    parts = [("sample", noise, free), *_scatter_by_level(fitted)]
    total = sum(variance for _, variance, _ in parts) or 1.0
    records = [
        (stage, rows.level_name(level), None, np.sqrt(variance), variance / total, df, None)
        for level, variance, df in parts
    ]
    best: dict[tuple, Candidate] = {}
    for candidate in candidates:
        name = " ".join(candidate.channels)
        if name not in best or candidate.test_result.log_p < best[name].test_result.log_p:
            best[name] = candidate
    for name, candidate in best.items():
        variance = explained_variance(searched, candidate)
        share = variance / max(searched.rmse_N**2, 1e-300)
        found = (np.sqrt(variance), share, float(candidate.test_result.df), candidate.p_value)
        units = [channels[own].unit for own in candidate.channels if own in channels] or [candidate.unit]
        records.append((stage, rows.level_name(min(units, key=FINER.get)), name, *found))
    return pd.DataFrame(records, columns=TABLE_OF_LEVELS.names())


def _scatter_by_level(fitted: Fitted) -> Iterator[tuple[str, float, float]]:
    """Yield each level that has a variance component, its mean variance and its degrees of freedom."""
    for level in LEVELS:
        df = next((c.df for c in fitted.scatter.components if c.level == level), None)
        if df is not None:
            yield level, float(fitted.rows.weight @ fitted.scatter.level_variance(level, fitted.loads)), df


def scatter_list(fitted: Fitted) -> list[dict]:
    """Return closure.json's `scatter`: per level the SD in force units, relative to the force, and its df."""
    mean_square = float(fitted.rows.weight @ fitted.force**2)
    found = []
    for level, variance, df in _scatter_by_level(fitted):
        if variance > 0:
            sizes = {"sd_rel": float(np.sqrt(variance / mean_square)), "sd_N": float(np.sqrt(variance))}
            found.append({"level": fitted.rows.level_name(level), **sizes, "df": df})
    return found


class Sandwich(NamedTuple):
    """Sandwich covariance of the parameters from whole groups of a level."""

    covariance: np.ndarray  # (p, p)
    information: Sequence[tuple[np.ndarray, np.ndarray]]
    """Parameters each group depends on, shape (k,), and their information, (k, k); empty with many groups."""


def degrees_of_freedom(fitted: Fitted) -> float:
    """Return the degrees of freedom of a mean force, by Satterthwaite's approximation over the levels.

    A level that scatters contributes its variance over the number of its units. It has as many degrees of
    freedom as units, less what the model takes from their mean forces; for specimens the levels and aging
    laws are counted. The result is 0 if the scatter of runs is not estimable: the model takes the means of
    nearly all, or it has as many parameters as there are runs, and only their repeats scatter.
    """
    rows, starts = fitted.rows, fitted.rows.groups.starts
    repeats = starts["run"].size < starts["file"].size
    spare = starts["run"].size - _taken(fitted, "run")
    if spare < LEAST_SPARE_RUNS or (repeats and not runs_show_scatter(rows)):
        return 0.0
    active = [c.level for c in fitted.scatter.components if c.variance > 0 and c.kind in LEVELS_OF_FORCE]
    levels = [level for level in dict.fromkeys(active) if level != "stroke"] or ["file"]
    variance = [rows.weight @ fitted.scatter.level_variance(level, fitted.loads) for level in levels]
    share = np.array(variance) / [starts[level].size for level in levels]
    share = np.where(share.any(), share / max(share.sum(), 1e-300), 1.0)
    df = np.array([_df_of_level(fitted, level) for level in levels])
    return float(1 / (share**2 / df).sum())


def _df_of_level(fitted: Fitted, level: str) -> float:
    if level == "specimen":
        parameters = fitted.model.declared.parameters
        taken = len({(p.quantity, p.owner) for p in parameters if p.quantity in ("mu_0c", "a_c")})
    else:
        taken = round(_taken(fitted, level))
    return float(max(fitted.rows.groups.starts[level].size - taken, 1))


def _taken(fitted: Fitted, level: str) -> float:
    """Return how many degrees of freedom the model takes of one number per unit of a level, its friction."""
    groups = fitted.rows.groups
    white = fitted.whitening(fitted.friction[:, None])[:, 0]
    white = white / np.sqrt(groups.sums(white**2, level))[groups.codes[level]]
    return float((fitted.basis.sums(groups, level, white).values ** 2).sum())


def robust_covariance(fitted: Fitted, level: str) -> np.ndarray:
    """Return the sandwich covariance from whole groups of a level (CR2), shape (p, p)."""
    scores = fitted.white_jacobian.sums(fitted.rows.groups, level, fitted.unit_residual(level))
    return fitted.covariance @ scores.gram() @ fitted.covariance


def covariance_with_specimens(fitted: Fitted) -> np.ndarray:
    """Return the covariance by the variance components, (p, p), widened to the sandwich of specimens.

    Each standard error is at least that of the sandwich, but at most `MOST_SANDWICH` times its own. The
    sandwich contains the scatter of specimens where no variance component does.
    """
    own, units = fitted.covariance, fitted.rows.groups.starts["specimen"].size
    if units < 2:
        return own
    robust = np.diag(robust_covariance(fitted, "specimen"))
    factor = np.sqrt(np.clip(robust / np.maximum(np.diag(own), 1e-300), 1.0, MOST_SANDWICH**2))
    return own * np.outer(factor, factor)


def sandwiches(fitted: Fitted) -> list[Sandwich]:
    """Return the sandwich covariances of specimens, runs and files, to the first level with many groups."""
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

    The larger of two standard errors is used, by the variance components and by the sandwich of the units of
    the effect's level, as the effect may scatter between units. The place of a jump is only known to lie
    between two neighbouring values of the channel. No interval of a nonlinear parameter but a phase leaves
    its bounds: a time is not below 0.
    """
    term = fitted.model.terms[number]
    held = dict(term.fixed.get("held", {}))
    place = fitted.model.term_slice(number)
    variance = np.diag(robust_covariance(fitted, level))[place]
    if "held" not in term.fixed:  # the variance components describe coarser shapes than a wave
        variance = np.maximum(variance, np.diag(fitted.covariance)[place])
    units = fitted.rows.groups.starts[level].size
    reach = t_quantile(max(units - variance.size - 1, 2)) * np.sqrt(variance)
    values = fitted.model.values[number]
    held |= places_of_jumps(term, values, fitted.rows)
    result = {}
    for p, r in zip(term.effect.parameters, reach, strict=True):
        low, high = held.get(p.name, (values[p.name] - r, values[p.name] + r))
        if not p.linear and p.name not in PHASES:
            low, high = np.clip((low, high), *p.bounds)
        result[p.name] = (values[p.name], float(low), float(high))
    return normalised_waves(result)


def places_of_jumps(term: Term, values: Mapping[str, float], rows: Rows) -> dict[str, tuple[float, float]]:
    """Return the two tested values between which each jump of an effect lies, by parameter."""
    found = {}
    for name in (p.name for p in term.effect.nonlinear if p.search == "between"):
        along = np.unique(term.inputs(rows)[term.effect.reads[0]])
        after = int(np.clip(along.searchsorted(values[name]), 1, along.size - 1))
        found[name] = float(along[after - 1]), float(along[after])
    return found


def normalised_waves(intervals: dict[str, Interval]) -> dict[str, Interval]:
    """Return intervals with the amplitude of every wave positive and its phase within one period.

    An amplitude -A is the same as A half a period later, and B, by which an amplitude A changes, as -B.
    """
    made = dict(intervals)
    changing = "B" in made and "phi_2" not in made
    for phase, (amplitude, period, last) in PHASES.items():
        if amplitude not in made or phase not in made:
            continue
        shift = 0.0
        if made[amplitude][0] < 0:
            shift = period / 2
            for name in (amplitude, "B") if changing else (amplitude,):
                value, low, high = made[name]
                made[name] = (-value, -high, -low)
        value, low, high = made[phase]
        shift += period * np.floor((last - value - shift) / period)
        made[phase] = (value + shift, low + shift, high + shift)
    return made


def mean_se(tangent: Tangent, covariance: np.ndarray) -> np.ndarray:
    """Return the standard error of the model's force from its tangent, (n, p), and covariance -> (n,)."""
    return np.sqrt(np.maximum(tangent.squares(covariance), 0.0))


def mean_half_width(
    tangent: Tangent, covariance: np.ndarray, df: float, others: Sequence[Sandwich]
) -> np.ndarray:
    """Return half the 95 % interval of the model's force, shape (n,): the largest of several.

    One uses the covariance by the variance components, shape (p, p), with `df` degrees of freedom. The others
    are sandwiches, each with Satterthwaite's degrees of freedom at this point, but `LEAST_SANDWICH_DF` at
    least, except where one group alone determines the force. They make it at most `MOST_SANDWICH` times as
    wide: beside a model that nearly interpolates its groups they are much too large. The tangent at the
    points has shape (n, p).
    """
    half = own_half = t_quantile(df) * mean_se(tangent, covariance)
    for covariance_of_groups, information in others:
        reach = np.full(half.shape, t_quantile(df))
        if len(information):
            parts = [tangent.squares(covariance[:, k] @ own @ covariance[k]) for k, own in information]
            share = np.maximum(parts, 0.0)
            share /= np.maximum(share.sum(axis=0), 1e-300)
            reach = t_quantile(np.maximum(satterthwaite_df(share), LEAST_SANDWICH_DF))
            reach[share.max(axis=0) > LARGEST_LEVERAGE] = 0.0
        half = np.maximum(half, reach * mean_se(tangent, covariance_of_groups))
    return np.minimum(half, MOST_SANDWICH * own_half)
