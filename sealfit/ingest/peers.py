"""What only a comparison of strokes shows: a force of the wrong sign, a dead sensor, a repeat that lies outside."""

from __future__ import annotations

import numpy as np
import pandas as pd

from sealfit.config import Config
from sealfit.errors import Fault
from sealfit.ingest.outlying import outlying_repeats
from sealfit.ingest.quality import FINE
from sealfit.ingest.scatter import repeat_means

AGAINST = -0.5  # share of its peers' force by which a force against its motion is of the wrong sign, not an offset


def reversed_strokes(strokes: pd.DataFrame) -> tuple[np.ndarray, list[Fault]]:
    """Return which strokes to keep, shape (n,), and findings on force signs that contradict the motion.

    Friction opposes the motion, so force times direction is positive. Where one stroke of a run has it negative
    against its peers (the other strokes of its run, else those of the same direction), it is left out: a sensor or a
    sign was turned round. Where most strokes of a direction have it negative, an offset or the sign convention is the
    cause: said once per file, and kept.

    Parameters
    ----------
    strokes : DataFrame
        One row per stroke: file, stroke, several (more strokes in the file), run, direction, force_N, used.
    """
    keep = np.ones(len(strokes), bool)
    force = (strokes["force_N"] * strokes["direction"]).to_numpy(float)
    used = strokes["used"].to_numpy(bool) & np.isfinite(force)
    against = used & (force < 0.0)
    if not against.any():
        return keep, []
    found = []
    group = strokes.groupby(["direction", "run"], sort=False).ngroup().to_numpy()
    runs, ways = _Leaving(force, used, group), _Leaving(force, used, strokes["direction"].to_numpy() > 0)
    for i in np.flatnonzero(against):
        usual = runs.median(i) if runs.others(i) >= 2 else ways.median(i)
        wrong = usual > 0.0 and force[i] < AGAINST * usual
        keep[i] = not wrong
        found.append(_against(strokes.iloc[i], force[i], bool(wrong)))
    return keep, found


class _Leaving:
    """Medians of the used values of a group, one of them left out."""

    def __init__(self, values: np.ndarray, used: np.ndarray, group: np.ndarray):
        order = np.lexsort((values, group))
        self.values, self.group = values, group
        order = order[used[order]]
        self.sorted, of = values[order], group[order]
        names, first, count = np.unique(of, return_index=True, return_counts=True)
        self.span = {
            name: (a, a + n) for name, a, n in zip(names.tolist(), first.tolist(), count.tolist(), strict=True)
        }

    def others(self, i: int) -> int:
        """Return how many others are in the group of the used row `i`."""
        first, last = self.span[self.group[i]]
        return last - first - 1

    def median(self, i: int) -> float:
        """Return the median of the others in the group of the used row `i`; nan without any."""
        first, last = self.span[self.group[i]]
        own = first + int(np.searchsorted(self.sorted[first:last], self.values[i]))
        n = last - first - 1
        if n == 0:
            return float("nan")
        middle = [first + (n - 1) // 2, first + n // 2]
        return float(np.mean([self.sorted[k + (k >= own)] for k in middle]))


def _against(row: pd.Series, force_N: float, wrong: bool) -> Fault:
    fix = (
        "Look for a turned sensor or a turned sign in this file."
        if wrong
        else "If the rig counts force the other way round, change its sign in the config: compute.force_N."
    )
    return Fault(
        "reversed",
        "the mean force has the direction of the motion"
        + (
            ", unlike in the other strokes."
            if wrong
            else ": an offset larger than the friction, or the sign convention."
        ),
        file=row["file"],
        stroke=int(row["stroke"]) if row["several"] else None,
        column="force_N",
        value=float(force_N),
        severity="error" if wrong else "warning",
        action="stroke left out" if wrong else "kept",
        fix=fix,
    )


def constant_strokes(strokes: pd.DataFrame) -> tuple[np.ndarray, list[Fault]]:
    """Return which strokes to keep, shape (n,), and findings on forces that never change in the steady window.

    Where the other strokes show noise larger than the sensor's steps, the sensor is dead, or at the end of its range if
    the value is the largest of the stroke. Where they do not, it is coarse (or without noise), and they are kept.

    Parameters
    ----------
    strokes : DataFrame
        One row per stroke: file, stroke, several, equal (share of samples equal to the one before), extreme (whether
        the window's largest force is the stroke's), force_N, used.
    """
    used = strokes["used"].to_numpy(bool)
    constant = used & (strokes["equal"].to_numpy(float) >= 1.0)
    keep = np.ones(len(strokes), bool)
    if not constant.any():
        return keep, []
    others = strokes["equal"].to_numpy(float)[used & ~constant]
    dead = bool(len(others) and np.median(others) < FINE)
    return (~constant if dead else keep), [_constant(row, dead) for _, row in strokes[constant].iterrows()]


def _constant(row: pd.Series, dead: bool) -> Fault:
    check, reason = "coarse", "and other strokes show no noise either: its steps are larger than the noise."
    fix = "Use a finer range if the sensor has one."
    if dead:
        check, reason = "stuck", "unlike in other strokes."
        fix = "Check the cable and the logger, and measure again."
    if dead and row["extreme"]:
        check = "saturated"
        fix = f"The sensor may be at the end of its range: use a larger one. {fix}"
    return Fault(
        check,
        f"the force is {row['force_N']:g} all along the steady window, {reason}",
        file=row["file"],
        stroke=int(row["stroke"]) if row["several"] else None,
        column="force_N",
        value=float(row["force_N"]),
        severity="error" if dead else "info",
        action="stroke left out" if dead else "kept",
        fix=fix,
    )


def outlying_files(steady: pd.DataFrame, config: Config) -> tuple[pd.DataFrame, list[Fault]]:
    """Return `steady` with `outlier` and `used`, and a finding per repeat that disagrees with its run.

    Flagged always, left out of the fits only where the config says `quality.drop_outliers`; and never where only two
    repeats disagree, since which of them is wrong cannot be known.
    """
    flagged = outlying_repeats(repeat_means(steady), config.quality.outlier_p)
    outlier, dropped, found = np.zeros(len(steady), bool), np.zeros(len(steady), bool), []
    near = np.flatnonzero(steady["file"].isin(flagged["file"]))
    places = steady.iloc[near].groupby(["file", "run_id"], sort=False).indices
    for row in flagged.itertuples(index=False):
        rows = near[places[row.file, row.run_id]]
        out = config.quality.drop_outliers and not row.alone
        outlier[rows] = True
        dropped[rows] |= out
        found.append(
            Fault(
                "outlier",
                _disagreement(row, config.units.unit("force")),
                file=row.file,
                column="force_N",
                value=float(row.force_N),
                severity="warning",
                action="file left out" if out else "kept",
                fix="Look into the notes of that test; quality.drop_outliers in the config leaves such repeats out.",
            )
        )
    return steady.assign(outlier=outlier, used=steady["used"].to_numpy(bool) & ~dropped), found


def _disagreement(row, unit: str) -> str:
    others = "its only other repeat gives" if row.alone else "the other repeats of its run give"
    return (
        f"repeat {row.repeat} of run {row.run_id} is {row.force_N:.4g} {unit}; {others} {row.run_mean_N:.4g} {unit}, "
        f"their common pattern removed: {abs(row.t):.1f} SDs of the scatter pooled over runs (p = {row.p:.1g})."
    )
