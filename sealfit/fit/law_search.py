"""Global search of the aging law mu_0 - a ln(1 + t/b) in many curves at once: all b.

With weights applied there is one fixed column and a moving one, sqrt(w) ln(1 + t/b): see `moving`, u is ln b.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sealfit.fit.batch import DEPENDENT
from sealfit.fit.moving import Moving, chosen, dot
from sealfit.fit.moving_grid import BLOCK, TABLE, Grid, common, polish_best

STEP = np.log(10) / 4  # of ln b: ln(1 + t/b) changes over a decade of b


@dataclass(frozen=True)
class LawFound:
    """Optimum of every curve."""

    u: np.ndarray  # (curves,), ln b
    coefficients: np.ndarray  # (2, curves): mu_0 and a
    rss: np.ndarray  # (curves,)


def search_law(days, value, weight, low, high) -> LawFound:
    """Global least-squares optimum of the aging law in every curve.

    Parameters
    ----------
    days, value, weight : ndarray, shape (curves, n)
        Days, measured value, 1/variance (0 for padding).
    low, high : ndarray, shape (curves,)
        Limits of ln b.
    """
    parts = [common(x) for x in (days, value, np.sqrt(weight), low[:, None], high[:, None])]
    found = LawFound(np.empty(len(value)), np.empty((2, len(value))), np.empty(len(value)))
    for start in range(0, len(value), BLOCK):
        rows = slice(start, start + BLOCK)
        part = _search(*(np.ascontiguousarray((x if len(x) == 1 else x[rows]).T) for x in parts))
        found.u[rows], found.coefficients[:, rows], found.rss[rows] = part.u, part.coefficients, part.rss
    return found


def _search(days, value, root, low, high) -> LawFound:
    """As `search_law`, points first, (n, B), or (n, 1) where all curves share them; limits (1, B) or (1, 1)."""
    low, high = low[0], high[0]
    size = np.sqrt(dot(root, root))
    unit = root / size
    measured = root * value
    fixed = dot(unit, measured)
    rest = measured - unit * fixed

    def column(u, rows):
        x, weight = chosen(days, rows) * np.exp(-u), chosen(root, rows)
        more = 1 + x
        first = x / more
        # ln(1 + x) to all digits: what rounding took from 1 + x is put back (np.log1p is five times slower)
        phi = np.log(more) + (x - (more - 1)) / more
        return weight * phi, -weight * first, weight * (first / more)

    first = low.min(keepdims=True) if days.shape[1] == 1 else low
    points = int(np.ceil(np.max(high - first) / STEP - 1e-9)) + 1
    near, u = STEP * (1 - 1e-9), first[:, None] + STEP * np.arange(points)
    inside = (u > low[:, None] - near) & (u < high[:, None] + near)
    along, own, product = _sums(days, u, root * unit, root**2, root * rest)
    left = own - along**2
    share = left / own
    pull = product / np.sqrt(np.where(share > DEPENDENT, left, np.inf))
    grid = Grid(first, STEP, pull, share, dot(measured, measured), None if inside.all() else inside)
    best = polish_best(Moving(column, (unit,), rest, low, high), grid, fixed**2)
    return LawFound(best.u, np.stack([(fixed - best.a * best.inner[0]) / size, -best.a]), best.rss)


def _sums(days, u, unit, square, rest):
    """Inner products of ln(1 + t/b) along the grid: with two vectors, and of its square with one, each (B or 1, g)."""
    if days.shape[1] == 1:
        table = np.log1p(days * np.exp(-u))
        return unit.T @ table, square.T @ table**2, rest.T @ table
    n, curves = days.shape
    sums = np.empty((3, curves, u.shape[1]))
    size = max(1, TABLE // (n * u.shape[1]))
    for start in range(0, curves, size):
        part = slice(start, start + size)
        count = days[:, part].shape[1]
        vectors = [np.broadcast_to(chosen(x, part), (n, count)).T for x in (unit, rest, square)]
        table = np.exp(-u[part])[:, :, None] * days[:, part].T[:, None, :]
        table += 1
        np.log(table, out=table)
        sums[:2, part] = np.moveaxis(table @ np.stack(vectors[:2], axis=-1), -1, 0)
        table *= table
        sums[2, part] = (table @ vectors[2][:, :, None])[..., 0]
    return sums[0], sums[2], sums[1]
