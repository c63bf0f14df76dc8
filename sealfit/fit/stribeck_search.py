"""Global search of Eq. 14 in many problems at once: all v_s, and every set of coefficients that may be zero.

With nothing held there are two fixed columns and a moving one (`stribeck_columns`). Where no coefficient comes out
negative that is the answer. Elsewhere some are zero, and each set of zeros is a problem of the same kind with fewer
fixed columns: the answer is the best of all sets' local minima whose coefficients are not negative, as a minimum of
the constrained sum of squares is one of its set's.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sealfit.fit.batch import DEPENDENT
from sealfit.fit.moving import Moving, chosen
from sealfit.fit.moving_grid import BLOCK, ROUNDING, Grid, common, polish_best, polish_peaks
from sealfit.fit.stribeck_columns import STEP, TINY, Weighted, weighted

MISSED = 1e-10  # of |F|^2: that far above what a grid point reaches, an optimum was dropped by mistake


@dataclass(frozen=True)
class Kind:
    """Eq. 14 with some coefficients zero: the fixed columns, and whether the moving one is R E or R (E - 1)."""

    zero: tuple[bool, bool, bool]  # mu_s, mu_c, sigma_2
    base: str  # "both", "load", "speed" or "none"
    falls: int = 0  # 1 where the moving column is R (E - 1), its coefficient -mu_c

    def moving(self, w: Weighted) -> Moving:
        """Return the problems as `polish` takes them."""
        base, rest = (), w.force
        if self.base == "both":
            base, rest = (w.load_unit, w.beyond[1]), w.rest
        elif self.base == "load":
            base, rest = (w.load_unit,), w.rest + w.beyond[1] * w.by_beyond
        elif self.base == "speed":
            base, rest = (w.speed_unit,), w.force - w.speed_unit * w.by_speed

        def column(u, rows):
            x = chosen(w.square, rows) * np.exp(-2 * u)
            load = chosen(w.load, rows)
            phi = np.exp(-x)
            first = x * phi
            if self.falls:
                phi -= 1
            phi *= load
            first *= load
            first *= 2
            x -= 1
            x *= first
            x *= 2
            return phi, first, x

        return Moving(column, base, rest, w.low, w.high)

    def on_grid(self, w: Weighted):
        """What the model explains of |F|^2 along the grid, less what the base does, and whether it is feasible.

        Returns
        -------
        grid : Grid
        base : ndarray, shape (B,)
            What the fixed columns explain alone.
        size : ndarray, shape (B, g) or (1, g)
            Of what the moving column has beyond the base: the pull over it is its coefficient.
        inner : tuple of ndarray, shape (B, g) or (1, g)
            Its inner products with the fixed columns.
        """
        s = w.sums
        load, beyond, own = s.load.T, s.speed.T, s.own.T  # problems last, as the scalars are
        if self.base in ("both", "load"):
            inner = (load, beyond) if self.base == "both" else (load,)
            product = None if self.base == "both" else w.rest_over(np.ones((1, 1))) + w.by_beyond * beyond
            base = w.by_load**2 + (w.by_beyond**2 if self.base == "both" else 0.0)
            left = own - load * load
            if self.base == "both":
                left -= beyond * beyond
        else:
            length = np.where(np.isfinite(w.beyond[0]), w.beyond[0], 0.0)
            product = w.rest_over(np.ones((1, 1))) + w.by_load * load + w.by_beyond * beyond
            along = (w.shared * load + length * beyond) / w.speed_size
            if self.falls:
                product = product - w.load_size * w.by_load
                along = along - w.load_size * w.shared / w.speed_size
                own = own - 2 * w.load_size * load + w.load_size**2
            left, inner, base = own, (), np.zeros(1)
            if self.base == "speed":
                product, left, inner, base = product - w.by_speed * along, own - along**2, (along,), w.by_speed**2
        share = left / np.maximum(own, TINY)
        size = np.sqrt(np.where(share > DEPENDENT, left, np.inf))
        pull = w.rest_over(size) if product is None else product / size
        ways = w.ways(size) if self.base == "both" and size.shape[1] == 1 else None
        return Grid(w.first, STEP, pull.T, share.T, w.total, w.inside, ways), base, size, inner

    def coefficients(self, w: Weighted, a, inner):
        """Return mu_s, mu_c, sigma_2 from the moving column's coefficient and inner products with the fixed ones."""
        nothing = np.zeros_like(a)
        if self.base in ("both", "load"):
            sigma_2 = (w.by_beyond - a * inner[1]) / w.beyond[0] if self.base == "both" else nothing
            mu_c = (w.by_load - a * inner[0] - sigma_2 * w.shared) / w.load_size
            return mu_c + a, mu_c, sigma_2
        sigma_2 = (w.by_speed - a * inner[0]) / w.speed_size if self.base == "speed" else nothing
        return (nothing, -a, sigma_2) if self.falls else (a, nothing, sigma_2)


FREE = Kind((False, False, False), "both")
SOME_ZERO = (
    Kind((False, False, True), "load"),
    Kind((False, True, False), "speed"),
    Kind((True, False, False), "speed", 1),
    Kind((False, True, True), "none"),
    Kind((True, False, True), "none", 1),
)


@dataclass(frozen=True)
class Found:
    """Optimum of every problem."""

    u: np.ndarray  # (B,)
    coefficients: np.ndarray  # (3, B): mu_s, mu_c, sigma_2
    rss: np.ndarray  # (B,)


def search_free(w: Weighted) -> Found:
    """Global optimum with no coefficient held."""
    grid, base, *_ = FREE.on_grid(w)
    best = polish_best(FREE.moving(w), grid, base)
    return Found(best.u, np.stack(FREE.coefficients(w, best.a, best.inner)), best.rss + w.scatter)


def feasible(coefficients, held):
    """Whether no held coefficient, shape (3, ...), is negative."""
    return np.all([c >= 0 for c, hold in zip(coefficients, held, strict=True) if hold], axis=0)


def search_held(w: Weighted, held, *, prune: bool = True) -> Found:
    """Global optimum with the coefficients `held` not negative, the best over all sets of zeros.

    `prune` leaves out peaks that cannot reach what a grid point reaches for certain; where nothing then reaches it
    (rounding, with as many coefficients as points), all peaks are polished after all.
    """
    by_speed = np.maximum(w.by_speed, 0.0) if held[2] else w.by_speed
    zero = np.zeros_like(w.total)
    best = Found(w.low + zero, np.stack([zero, zero, by_speed / w.speed_size]), w.total - by_speed**2)
    kinds = [kind for kind in (FREE, *SOME_ZERO) if not np.any(np.array(kind.zero) & ~np.asarray(held))]
    grids, certain = [], by_speed**2
    for kind in kinds:
        grid, base, size, inner = kind.on_grid(w)
        allowed = feasible(kind.coefficients(w, grid.pull.T / size, inner), held).T
        error = ROUNDING * w.total[:, None] / np.maximum(grid.share, DEPENDENT)
        sure = np.where(allowed & w.within, grid.pull**2 - error, -np.inf)
        certain = np.maximum(certain, np.max(sure, axis=1) + base)
        grids.append((kind, grid, base))
    for kind, grid, base in grids:
        rows, k = grid.peaks(certain - base if prune else np.full(w.total.size, -np.inf))
        beat = (w.total - certain)[rows] if prune else None
        tried = polish_peaks(kind.moving(w), grid, rows, k, base, beat)
        values = np.stack(kind.coefficients(w.part(rows), tried.a, tried.inner))
        better = feasible(values, held) & (tried.rss < best.rss[rows])
        order = np.flatnonzero(better)[np.argsort(-tried.rss[better], kind="stable")]  # the best is written last
        at = rows[order]
        best.u[at], best.coefficients[:, at], best.rss[at] = tried.u[order], values[:, order], tried.rss[order]
    missed = np.flatnonzero(best.rss > w.total - certain + MISSED * w.total)
    best.rss[:] += w.scatter
    if prune and missed.size:
        again = search_held(w.part(missed), held, prune=False)
        best.u[missed], best.coefficients[:, missed], best.rss[missed] = again.u, again.coefficients, again.rss
    return best


# ---------------------------------------------------------------- many problems
def search(speed, load, force, weight, low, high, held) -> Found:
    """Global least-squares optimum of Eq. 14 in every problem.

    Parameters
    ----------
    speed, load, force, weight : ndarray, shape (problems, n)
        |v| in mm/s, N, F sgn(v) in N, 1/variance (0 for padding).
    low, high : ndarray, shape (problems,)
        Limits of ln v_s.
    held : three bool
        Whether mu_s, mu_c and sigma_2 must not be negative.
    """
    parts = [common(x) for x in (speed, load, force, np.sqrt(weight), low[:, None], high[:, None])]
    problems = len(force)
    found = Found(np.empty(problems), np.empty((3, problems)), np.empty(problems))

    def fill(rows, solve):
        own = weighted(*(x if len(x) == 1 else x[rows] for x in parts))
        part = solve(own)
        found.u[rows], found.coefficients[:, rows], found.rss[rows] = part.u, part.coefficients, part.rss

    block = BLOCK if len(parts[0]) == 1 else BLOCK // 2  # speeds of their own need more room
    for start in range(0, problems, block):
        fill(slice(start, min(start + block, problems)), search_free)
    bad = np.flatnonzero(~feasible(found.coefficients, held))
    for start in range(0, bad.size, block):
        fill(bad[start : start + block], lambda own: search_held(own, held))
    return found
