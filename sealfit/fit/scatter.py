"""What is random in a residual: the rows' own noise, and the variance of strokes, files, runs and specimens."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sealfit.fit.declared import declare
from sealfit.fit.reml import reml
from sealfit.fit.rows import LEVELS, Rows
from sealfit.fit.tangent import Tangent
from sealfit.fit.whitening import Component, Scatter
from sealfit.ingest.scatter import two_nonnegative

LEAST_NOISE = 1e-6  # of the force: below what any sensor resolves; keeps noise-free data from weights without end
LEAST_FILES = 6  # from which files can be compared in shape


def estimate_scatter(
    rows: Rows, residual: np.ndarray, friction: np.ndarray, jacobian: Tangent, start: Scatter | None = None
) -> Scatter:
    """Return row noise and variance components of the residual at a model, its degrees of freedom taken out.

    Parameters
    ----------
    rows : Rows
        The rows.
    residual, friction : ndarray, shape (n,)
        Measured minus model, and the model's friction, which noise and gains load on.
    jacobian : Tangent, shape (n, p)
        The model's.
    start : Scatter, optional
        An earlier estimate, to start from.
    """
    s0, g, inflation = row_noise(rows, residual, friction)
    shape = shape_scatter(rows, residual, np.sqrt((s0**2 + (g * friction) ** 2) * inflation))
    start = Scatter(s0, g, () if start is None else start.components, inflation, shape)
    return estimate_components(rows, residual, friction, jacobian, start)


def estimate_components(
    rows: Rows, residual: np.ndarray, friction: np.ndarray, jacobian: Tangent, scatter: Scatter
) -> Scatter:
    """Return a scatter with its components estimated anew and its row noise as it is.

    Parameters
    ----------
    rows : Rows
        The rows.
    residual, friction : ndarray, shape (n,)
        Measured minus model, and the model's friction.
    jacobian : Tangent, shape (n, p)
        The model's, whose degrees of freedom are taken out.
    scatter : Scatter
        Row noise, and where the components start.
    """
    groups, level = rows.groups, "stroke"
    means = groups.means(np.column_stack([residual, friction]), level)
    noise = groups.means(scatter.noise_sd(friction) ** 2, level)
    count = np.diff(np.r_[groups.starts[level], residual.size])
    kinds = usable_components(rows)
    known = {(c.level, c.kind): c.variance for c in scatter.components}
    components = reml(
        means[:, 0],
        jacobian.means(groups, level),
        noise * scatter.alike / count,
        means[:, 1],
        groups.at(level),
        kinds,
        [known.get(kind, 0.0) for kind in kinds] if known else None,
    )
    return replace(scatter, components=tuple(replace(c, df=_df(rows, c)) for c in components))


def usable_components(rows: Rows) -> list[tuple[str, str]]:
    """Return the (level, kind) of random effects that these groups can tell apart, finest level first."""
    counts = {level: rows.groups.starts[level].size for level in LEVELS}
    used, finer = [], None
    for level in LEVELS:
        if finer is None:
            if counts[level] > counts["file"] or level != "stroke":
                used.append(level)
                finer = level
        elif counts[level] < counts[finer] and counts[level] > 2:
            used.append(level)
            finer = level
    if used and used[-1] == "specimen" and not _specimens_free(rows):
        used.pop()
    both = rows.speed.min() < 0 < rows.speed.max() or np.ptp(np.abs(rows.force)) > 0.2 * np.abs(rows.force).max()
    kinds = {level: ("offset", "gain") if both else ("offset",) for level in used}
    if both and "specimen" in kinds:
        kinds["specimen"] = ("gain",)  # a piece of rubber has a friction of its own, not a zero of the sensor
    return [(level, kind) for level in used for kind in kinds[level]]


def _specimens_free(rows: Rows) -> bool:
    """Whether specimens scatter about something: replicate specimens of a condition, or a law across conditions."""
    return rows.groups.starts["specimen"].size - declare(rows).numbers_of_mu >= 2


def _df(rows: Rows, component: Component) -> float:
    order = list(LEVELS)
    counts = [rows.groups.starts[level].size for level in order]
    at = order.index(component.level)
    above = [counts[k] for k in range(at + 1, len(order)) if counts[k] < counts[at]]
    return float(counts[at] - (above[0] if above else 1))


def row_noise(rows: Rows, residual: np.ndarray, force: np.ndarray) -> tuple[float, float, float]:
    """Return (s0, g, inflation): row noise sqrt(s0^2 + (gF)^2) inside strokes, and how correlation widens a mean.

    What the strokes have in common at a bin is not noise and is taken out first.
    """
    groups = rows.groups
    code, start = groups.codes["stroke"], groups.starts["stroke"]
    count = np.diff(np.r_[start, residual.size])
    inside = residual - groups.means(residual, "stroke")[code]
    place = np.arange(residual.size) - start[code]
    if start.size >= 8:
        pattern_n = np.bincount(place)
        sign = np.sign(rows.speed)
        for part in (np.ones_like(sign), sign):
            pattern = np.bincount(place, inside * part) / np.maximum(pattern_n, 1)
            inside = inside - np.where(pattern_n >= 5, pattern, 0.0)[place] * part
    size = np.abs(groups.means(force, "stroke"))
    long = count >= 3
    if not long.any():
        return max(float(np.std(residual)), 1e-9), 0.0, 1.0
    variance = np.add.reduceat(inside**2, start)[long] / (count[long] - 1)
    floor = (LEAST_NOISE * float(np.sqrt(np.mean(force**2)))) ** 2 + 1e-300
    square = size[long] ** 2
    guess = np.full(long.sum(), float(np.mean(variance)) + floor)
    for _ in range(4):
        a, b = two_nonnegative(square, variance + floor, count[long] / guess**2)
        guess = np.maximum(a + b * square, floor)
    return float(np.sqrt(max(a, floor))), float(np.sqrt(b)), _inflation(inside, code, start, count)


def _inflation(inside: np.ndarray, code: np.ndarray, start: np.ndarray, count: np.ndarray) -> float:
    """Return 1 + 2 sum of autocorrelations over bins, cut at the first one that is not positive."""
    scale = np.sqrt(np.maximum(np.add.reduceat(inside**2, start) / count, 1e-300))[code]
    unit = inside / scale
    total, inflation = max(float((unit**2).mean()), 1e-300), 1.0
    for lag in range(1, max(2, int(count.min()) // 3)):
        same = code[lag:] == code[:-lag]
        rho = float((unit[lag:] * unit[:-lag])[same].mean()) / total
        if rho < 0.05:
            break
        inflation += 2 * rho
    return inflation


def shape_scatter(rows: Rows, residual: np.ndarray, sd: np.ndarray) -> float:
    """Return by what factor files differ in shape along their strokes more than the noise of their rows lets them.

    Each pass's slope and bend along displacement are held against the mean of all passes of that direction: what they
    have in common is no scatter. Without it hundreds of rows would outweigh the few files they come from.

    Parameters
    ----------
    rows : Rows
        The rows.
    residual, sd : ndarray, shape (n,)
        Measured minus model, and the rows' own noise.
    """
    groups = rows.groups
    code, start = groups.codes["stroke"], groups.starts["stroke"]
    if groups.starts["file"].size < LEAST_FILES:
        return 1.0
    place = rows.table["displacement_mm"].to_numpy(dtype=float)
    place = place - groups.means(place, "stroke")[code]
    place = np.sign(rows.speed) * place / np.maximum(np.maximum.reduceat(np.abs(place), start), 1e-300)[code]
    inside = residual - groups.means(residual, "stroke")[code]
    number = 2 * groups.codes["file"] + (rows.speed > 0)
    size = np.abs(groups.means(rows.force, "stroke"))[code]
    factors = []
    for load in (np.ones_like(size), size / max(size.mean(), 1e-300)):  # an added force, or one that follows friction
        found = []
        for shape in (place, place**2 - groups.means(place**2, "stroke")[code]):
            weight = np.bincount(number, (shape * load / sd) ** 2)
            slope = np.bincount(number, shape * load * inside / sd**2) / np.maximum(weight, 1e-300)
            for side in (0, 1):
                w, b = weight[side::2], slope[side::2]
                w, b = w[w > 0], b[w > 0]
                if w.size >= LEAST_FILES:
                    found.append((w * (b - w @ b / w.sum()) ** 2).sum() / (w.size - 1))
        factors.append(np.mean(found) if found else 1.0)
    return float(max(1.0, min(factors)))
