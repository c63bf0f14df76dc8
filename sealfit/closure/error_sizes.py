"""Sizes of errors, noise floor and lack of fit, and the rows that are held out to measure predictions."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np
import pandas as pd
from numpy.polynomial import Legendre
from scipy.special import fdtrc

from sealfit.closure.channels import level_values, settings
from sealfit.closure.criteria import (
    BLOCKS_OF_A_FOLD,
    LEAST_GROUPS_HELD_OUT,
    LEAST_HELD_OUT,
    OUTSIDE,
    SAME_SETTING,
)
from sealfit.closure.score_test import Candidate
from sealfit.fit.joint import Fitted
from sealfit.fit.joint.rows import LEVELS, POWER, Rows, point_rows, sliding_power
from sealfit.fit.joint.tangent import OwnColumns, Tangent

SHAPES = 3
"""Number of shapes along strokes in the lack-of-fit test: Legendre polynomials of degree 1 to 3."""

RANK = 1e-9  # Relative singular value below which a direction of a tangent is zero.


# ---------------------------------------------------------------- in sample


def errors(rows: Rows, residual: np.ndarray) -> dict[str, float]:
    """Return rmse_N, rmse_runs_N, max_abs_N and mean_abs_pct of a residual, shape (n,).

    Every file has the same weight.
    """
    weight = rows.weight
    run = pd.factorize(rows.table["run_id"])[0]
    per_run = np.bincount(run, weight)
    means = np.bincount(run, weight * residual) / per_run
    size = np.abs(np.bincount(run, weight * rows.force) / per_run)
    relative = np.abs(residual) / np.where(size > 0, size, np.nan)[run]
    known = np.isfinite(relative)
    return {
        "rmse_N": float(np.sqrt(weight @ residual**2)),
        "rmse_runs_N": float(np.sqrt(np.mean(means**2))),
        "max_abs_N": float(np.abs(residual).max()),
        "mean_abs_pct": float(100 * (weight[known] @ relative[known]) / weight[known].sum())
        if known.any()
        else None,
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


def pure_error(rows: Rows, residual: np.ndarray) -> tuple[float, float] | None:
    """Return (variance, df) of a bin about its run's mean over repeats; None without repeats.

    The mean shape over the repeats of a run and the mean pattern from one repeat to the next are not part of
    it.
    """
    table = rows.table
    clean = without_repeat_pattern(rows, residual)
    place = table.groupby(["run_id", "stroke", "bin"], sort=False).ngroup().to_numpy()
    count = np.bincount(place)
    mean = np.bincount(place, clean) / count
    repeated = count[place] > 1
    df = float((count[count > 1] - 1).sum())
    if df <= 0:
        return None
    return float(((clean - mean[place])[repeated] ** 2).sum() / df), df


def noise_floor(fitted: Fitted) -> float | None:
    """Return the RMSE of the true mean on these bins, from the repeats of runs; None without repeats.

    It does not contain the scatter of set-ups, which cannot be distinguished from lack of fit without
    replicated runs.
    """
    pure = pure_error(fitted.rows, fitted.residual)
    return None if pure is None else float(np.sqrt(pure[0]))


def lack_of_fit(fitted: Fitted) -> float | None:
    """Return the p-value of the residual's means and shapes in runs against repeats (F tests).

    This is the smallest one times the number of tests (Bonferroni); None without repeats.
    """
    means = _p_of_run_means(fitted)
    tests = [p for p in (means, *_p_of_shapes(fitted)) if p is not None]
    return None if means is None else min(1.0, len(tests) * min(tests))


def _p_of_shapes(fitted: Fitted) -> list[float]:
    """Return the p-values of shapes along strokes that the repeats of a run have in common.

    Each is one number per stroke, the coefficient of a Legendre polynomial, so that noise may be correlated
    within strokes.
    """
    rows = fitted.rows
    stroke, start = rows.codes("stroke"), rows.groups.starts["stroke"]
    count = np.bincount(stroke)
    place = (np.arange(stroke.size) - start[stroke] + 0.5) * 2 / count[stroke] - 1
    scale = fitted.scatter.noise_sd(fitted.force)[start]
    run, number = rows.table["run_id"].to_numpy()[start], rows.table["stroke"].to_numpy()[start]
    chosen = count > SHAPES
    found = []
    for degree in range(1, SHAPES + 1):
        shape = Legendre.basis(degree)(place)
        strokes = pd.DataFrame(
            {"run": run, "stroke": number, "z": np.bincount(stroke, shape * fitted.residual) / count}
        )
        strokes["z"] /= scale
        cells = strokes[chosen].groupby(["run", "stroke"])["z"]
        mean, files = cells.mean().to_numpy(), cells.size().to_numpy()
        df = float((files - 1).sum())
        if df > 0:
            pure = float((cells.var(ddof=0).to_numpy() * files).sum()) / df
            found.append(float(fdtrc(mean.size, df, (files @ mean**2 / mean.size) / max(pure, 1e-300))))
    return found


def _p_of_run_means(fitted: Fitted) -> float | None:
    """Return the p-value of run means against the scatter of files in runs (F test); None without repeats.

    The scatter of specimens is not lack of fit and is removed with the model.
    """
    rows = fitted.rows
    clean = without_repeat_pattern(rows, fitted.residual)
    keys = rows.table[["run_id"]].assign(file=rows.codes("file"), residual=clean, force=fitted.force)
    files = keys.groupby(["run_id", "file"], sort=False).mean().reset_index()
    spread = np.sqrt(fitted.scatter.level_variance("file", files["force"].to_numpy()) + 1e-300)
    noise = fitted.scatter.noise_sd(files["force"].to_numpy())
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
    left, rank = _residual_of_model(
        fitted, files["force"].to_numpy(), size, np.flatnonzero(first), root / scale[first]
    )
    df_fit = float(runs - rank)
    if df_pure < 1 or df_fit < 1:
        return None
    return float(fdtrc(df_fit, df_pure, (left @ left / df_fit) / max(pure / df_pure, 1e-300)))


def _residual_of_model(
    fitted: Fitted, force: np.ndarray, size: np.ndarray, chosen: np.ndarray, factor: np.ndarray
) -> tuple[np.ndarray, int]:
    """Return the residual of one number per run left by model and specimens, and their rank.

    Parameters
    ----------
    fitted : Fitted
        The model; its tangent at a file is the mean over the file's rows.
    force : ndarray, shape (files,)
        The model's mean force at each file of a run.
    size, factor : ndarray, shape (runs,)
        The numbers, and the factor on a file's tangent.
    chosen : ndarray, shape (runs,)
        Index of a file of each run.
    """
    rows = fitted.rows
    number = rows.table.groupby(["run_id", rows.codes("file")], sort=False).ngroup().to_numpy()
    order = np.argsort(number, kind="stable")
    start = np.flatnonzero(np.r_[True, np.diff(number[order]) > 0])
    means = np.add.reduceat(fitted.jacobian.values[order], start, axis=0) / np.bincount(number)[:, None]
    place = order[start][chosen]  # a row of each run
    tangent = Tangent(fitted.jacobian.layout.of(place), means[chosen] * factor[:, None])
    if not any(c.level == "specimen" and c.variance > 0 for c in fitted.scatter.components):
        basis = tangent.orthonormal(RANK)
        return basis.project_out(size), basis.shape[1]
    own = OwnColumns(rows.codes("specimen")[place], force[chosen] * factor)
    basis = tangent.orthonormal(RANK, project_out=own.project_out)
    return basis.project_out(own.project_out(size)), basis.shape[1] + own.count


def level_table(stage: str, fitted: Fitted, candidates: list[Candidate]) -> pd.DataFrame:
    """Return the residual's variance by level and, within the levels, by channel (table `levels`)."""
    rows, force = fitted.rows, fitted.force
    parts = {"sample": float(rows.weight @ fitted.scatter.noise_sd(force) ** 2)}
    df = {"sample": float(force.size - rows.groups.starts["stroke"].size)}
    for level in LEVELS:
        variance = float(rows.weight @ fitted.scatter.level_variance(level, force))
        known = [c for c in fitted.scatter.components if c.level == level]
        if known:
            parts[level], df[level] = variance, known[0].df
    total = sum(parts.values()) or 1.0
    records = [
        {
            "stage": stage,
            "level": level,
            "channel": None,
            "sd_N": np.sqrt(v),
            "share": v / total,
            "df": df[level],
            "p_value": None,
        }
        for level, v in parts.items()
    ]
    best: dict[tuple, Candidate] = {}
    for candidate in candidates:
        name = " ".join(candidate.channels)
        if name not in best or candidate.test_result.log_p < best[name].test_result.log_p:
            best[name] = candidate
    sd = float(np.sqrt(rows.weight @ fitted.residual**2))
    white = float(fitted.white_residual @ fitted.white_residual)
    for name, candidate in best.items():
        share = candidate.chi2 / max(white, 1e-300)
        records.append(
            {
                "stage": stage,
                "level": candidate.unit,
                "channel": name,
                "sd_N": sd * np.sqrt(share),
                "share": share,
                "df": float(candidate.test_result.df),
                "p_value": candidate.p_value,
            }
        )
    return pd.DataFrame(records)


def scatter_list(fitted: Fitted) -> list[dict]:
    """Return closure.json's `scatter`: per level the SD in force units, relative to the force, and its df."""
    force = fitted.force
    mean_square = float(fitted.rows.weight @ force**2)
    result = []
    for level in LEVELS:
        known = [c for c in fitted.scatter.components if c.level == level]
        if not known:
            continue
        variance = float(fitted.rows.weight @ fitted.scatter.level_variance(level, force))
        if variance <= 0:
            continue
        result.append(
            {
                "level": level,
                "sd_rel": float(np.sqrt(variance / mean_square)),
                "sd_N": float(np.sqrt(variance)),
                "df": known[0].df,
            }
        )
    return result


# ---------------------------------------------------------------- held-out rows
# Whole groups, calendar blocks or whole settings, and whether the other rows cover them.


def heldout_level(rows: Rows) -> str:
    """Return the level whose groups are held out: run, or file or stroke if there are fewer than six."""
    for level in ("run", "file"):
        if rows.groups.starts[level].size >= LEAST_GROUPS_HELD_OUT:
            return foldable(rows, level)
    return "stroke"


def foldable(rows: Rows, level: str) -> str:
    """Return a level, or the next finer one at which conditions keep some groups while others are held out.

    A condition with one file and no aging law cannot be predicted without that file. Its strokes are held out
    then, and the error is that of predicting the same files.
    """
    for finer in reversed(LEVELS[: LEVELS.index(level) + 1]):
        start = rows.groups.starts[finer]
        groups = np.bincount(rows.condition[start], minlength=len(rows.conditions))
        lost = [c for c in np.flatnonzero(groups == 1) if _edge(rows, int(c))]
        if len(lost) <= np.count_nonzero(groups) / 2:
            return finer
    return LEVELS[0]


def folds(rows: Rows, level: str, count: int, seed: int) -> Iterator[np.ndarray]:
    """Yield masks of the rows held out, shape (n,), in whole groups.

    The groups are spread so that each condition keeps most of its own. Day 0 and the last day always keep a
    group, so that the aging law does not have to extrapolate.
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


def blocks(rows: Rows, level: str, count: int, channel: str) -> list[np.ndarray]:
    """Return masks of the rows held out, shape (n,): blocks of groups that are consecutive in the calendar.

    Neighbours in time are correlated, and so are conditions tested one after the other. With single groups
    held out, any smooth curve through the calendar would be confirmed. If a block contains a whole condition
    that cannot be predicted without it, blocks are shortened, and a fold has several of them that are apart.
    """
    start = rows.groups.starts[level]
    count = min(count, start.size)
    place = np.empty(start.size, dtype=int)
    place[np.argsort(rows.values(channel)[start], kind="stable")] = np.arange(start.size)
    masks: list[np.ndarray] = []
    for parts in BLOCKS_OF_A_FOLD:
        masks = list(_masks(rows, level, place * min(count * parts, start.size) // start.size % count))
        if np.any(masks, axis=0).mean() > LEAST_HELD_OUT:
            break
    return masks


def _masks(rows: Rows, level: str, number: np.ndarray) -> Iterator[np.ndarray]:
    """Yield masks of the rows held out, shape (n,), from each group's fold; edge conditions keep a group."""
    start, code = rows.groups.starts[level], rows.codes(level)
    condition = rows.condition[start]
    for k in range(number.max() + 1):
        out = _without_lost_edges(number == k, condition, rows)
        if out.any():
            yield out[code]


def _without_lost_edges(out: np.ndarray, condition: np.ndarray, rows: Rows) -> np.ndarray:
    """Return what is held out, without edge conditions that would lose all groups, shape of `out`."""
    for c in np.unique(condition[out]):
        if not (~out & (condition == c)).any() and _edge(rows, c):
            out = out & (condition != c)
    return out


def _edge(rows: Rows, condition: int) -> bool:
    if not rows.has_aging:
        return True  # a condition of its own parameters cannot be predicted without its rows
    days = rows.conditions["aging_days"]
    series = rows.conditions["series"]
    own = days[series == series.iloc[condition]]
    return bool(days.iloc[condition] in (0.0, own.max()))


def covered(rows: Rows, out: np.ndarray, channels: Iterable[str] = ()) -> np.ndarray:
    """Return which held-out rows are covered by the other rows, shape (n,); the rest are extrapolated.

    Parameters
    ----------
    rows : Rows
        All rows.
    out : ndarray of bool, shape (n,)
        Which are held out.
    channels : iterable of str
        Channels of the effects in the model.
    """
    inside = out.copy()
    series = rows.conditions["series"].to_numpy()[rows.condition]
    speed = np.abs(rows.speed)
    for own in np.unique(series[out]):
        here = series == own
        seen = here & ~out
        tested = np.unique(rows.condition[seen])
        lawful = rows.has_aging and tested.size > 1
        days = rows.days[seen | (~out & (rows.days == 0))]  # every series starts from unaged rubber
        new = here & out & ~np.isin(rows.condition, tested)
        if not lawful:
            inside &= ~new
        else:
            inside &= ~(new & ((rows.days < days.min()) | (rows.days > days.max())))
        if seen.any():
            inside &= ~(here & out & _outside(speed, speed[seen]))
    for name in channels:
        values = rows.values(name)
        if values.dtype.kind == "f":
            inside &= ~_outside(values, values[~out])
        else:
            inside &= np.isin(values, np.unique(values[~out]))
    return inside


def _outside(values: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """Return which values lie outside the range of those seen, by more than values of one setting differ."""
    low, high = float(seen.min()), float(seen.max())
    slack = OUTSIDE * (high - low) + SAME_SETTING * max(abs(low), abs(high))
    return (values < low - slack) | (values > high + slack)


def whole_settings(rows: Rows, values: np.ndarray) -> Iterator[np.ndarray]:
    """Yield masks of the rows held out, shape (n,): all rows at each inner setting of a channel in turn.

    A free shape may fit every setting it has seen and still not predict those between them.
    """
    for setting in np.unique(values)[1:-1]:
        out = _without_lost_edges(values == setting, rows.condition, rows)
        if out.any():
            yield out


def between_speeds(rows: Rows) -> Rows:
    """Return rows moved halfway, on a log scale, to the next higher tested speed of their series."""
    speed = settings(level_values(np.abs(rows.speed), rows))
    series = rows.conditions["series"].to_numpy()[rows.condition]
    halfway = np.full(speed.size, np.nan)
    for own in np.unique(series):
        here = series == own
        tested, place = np.unique(speed[here], return_inverse=True)
        halfway[here] = np.r_[np.sqrt(tested[1:] * tested[:-1]), np.nan][place]
    there = np.isfinite(halfway)
    table = rows.table[there].assign(**{name: values[there] for name, values in rows.filled.items()})
    table["speed_mm_s"] = np.sign(rows.speed[there]) * halfway[there]
    if POWER in table:
        table[POWER] = sliding_power(table["load_N"], table["speed_mm_s"])
    return point_rows(
        table.reset_index(drop=True),
        rows.condition[there],
        rows.conditions,
        has_load=rows.has_load,
        has_aging=rows.has_aging,
    )
