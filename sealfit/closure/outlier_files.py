"""Files that went wrong as a whole: their mean force is far off what all other files predict."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.special import stdtr

from sealfit.fit.joint import Fitted, fit, fit_declared, fitted_at
from sealfit.fit.joint.rows import SAME_SPEED, Rows

# A file is tried if its residual in the fit to all files has a p-value below this, times the number of files.
SCREEN_P = 0.05
# Files that are tried, those with the largest residuals.
MOST_SUSPECTS = 3
# Largest p-value of an outlier, times the number of files. With 0.01, 5 of 73 worlds drawn at random lost a
# sound file: their scatter was not normal.
OUTLIER_P = 1e-3
# Largest p-value beside the files of the same speed. Where these scatter more than others, or differ from the
# model like the file, it is no outlier.
SAME_SPEED_P = 0.01
# Fewest files of the same speed from which their scatter is estimated.
LEAST_OF_SPEED = 3
# Least share of the force by which an outlier is off.
OUTLIER_SHARE = 0.05
# Largest share of the files that may be outliers. If there are more, they are not exceptions.
MOST_OUTLIERS = 0.1
# Least degrees of freedom of the files. With fewer, all files together do not predict another one.
LEAST_DF = 4
# Rows of each stroke in the fits. The mean of a file needs no more.
ROWS = 8


class OutlierFile(NamedTuple):
    """A file that went wrong as a whole."""

    file: str
    deviation: float  # its mean force over that predicted, less 1
    p_value: float  # times the number of files
    conditions: dict  # the columns of its first row


def outlier_files(rows: Rows) -> list[OutlierFile]:
    """Return the files whose mean force is far off what all other files predict, the farthest first.

    Model and scatter are fitted without the file, so that it does not hide itself. It is an outlier if the
    gain that would explain it is significant beside the scatter of the others. These are then judged without
    it. In linear regression the test is that of the deletion residual (Cook & Weisberg 1982, *Residuals and
    Influence in Regression*, section 2.2.2).
    """
    rows = rows.sparse(ROWS)
    fitted, found = fit_declared(rows), []
    for _ in range(int(MOST_OUTLIERS * rows.groups.starts["file"].size)):
        tried = [_without(fitted, number) for number in _suspects(fitted)]
        one, kept = min(tried, key=lambda pair: pair[0].p_value, default=(None, fitted))
        if one is None or one.p_value > OUTLIER_P or abs(one.deviation) < OUTLIER_SHARE:
            break
        found.append(one)
        fitted = kept
    return sorted(found, key=lambda one: -abs(one.deviation))


def _df(fitted: Fitted) -> int:
    """Return the degrees of freedom of the files, one of them left out."""
    return fitted.rows.groups.starts["file"].size - 1 - fitted.basis.shape[1]


def _suspects(fitted: Fitted) -> list[int]:
    """Return the numbers of the files with the largest mean residuals, where these may be outliers.

    A residual over a standard deviation that was estimated without it has Student's distribution; here that
    of all files is known, which contains it.
    """
    groups, df = fitted.rows.groups, _df(fitted)
    if df < LEAST_DF:
        return []
    along = fitted.unit_residual("file") * np.sign(fitted.rows.speed)
    square = groups.sums(along, "file") ** 2 / np.bincount(groups.codes["file"])
    alone = square * df / np.maximum(df + 1 - square, 1e-9)
    suspect = 2 * stdtr(df, -np.sqrt(alone)) * square.size < SCREEN_P
    return [int(k) for k in np.argsort(-square)[:MOST_SUSPECTS] if suspect[k]]


def _without(fitted: Fitted, number: int) -> tuple[OutlierFile, Fitted]:
    """Return the test of one file, and the fit to the others.

    The file's gain is a further parameter of the model, with the estimates and the scatter of the others.
    """
    rows, own = fitted.rows, fitted.rows.codes("file") == number
    kept = fit(fitted.model, rows.subset(~own), fitted.scatter, turns=2)
    at = fitted_at(kept.model, rows, kept.scatter)
    column = at.basis.project_out(at.whitening(np.where(own, at.friction, 0.0)[:, None])[:, 0])
    size = max(float(np.linalg.norm(column)), 1e-9)  # 0 if only this file determines a parameter
    deviation = float(column @ at.white_residual) / size**2
    p_value = 2 * stdtr(_df(at), -abs(deviation) * size) * rows.groups.starts["file"].size
    if _like_others_of_its_speed(at, number):
        p_value = 1.0
    first = rows.table.iloc[rows.groups.starts["file"][number]]
    return OutlierFile(str(first["record"]), deviation, float(min(p_value, 1.0)), dict(first)), kept


def _like_others_of_its_speed(fitted: Fitted, number: int) -> bool:
    """Whether a file's relative residual is within those of the other files of its speed (t test)."""
    groups = fitted.rows.groups
    relative = groups.sums(fitted.friction * fitted.residual, "file") / groups.sums(
        fitted.friction**2, "file"
    )
    speed = groups.means(np.abs(fitted.rows.speed), "file")
    ratio = speed / speed[number]
    same = np.maximum(ratio, 1 / ratio) < SAME_SPEED
    same[number] = False
    others = relative[same]
    if others.size < LEAST_OF_SPEED:
        return False
    sd = float(np.std(others, ddof=1)) * np.sqrt(1 + 1 / others.size)
    t = abs(relative[number] - others.mean()) / max(sd, 1e-300)
    return 2 * stdtr(others.size - 1, -t) > SAME_SPEED_P
