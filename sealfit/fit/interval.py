"""Exact intervals of coefficients that must not be negative, from the sum of squares alone."""

from __future__ import annotations

from itertools import product

import numpy as np

from sealfit.fit.variable_projection import solve_kept

FREE = 1e-12  # share of a column's variance that is its own, below which its coefficient is not bounded at all


def constrained_ends(columns, y, limit, nonnegative):
    """Ends of {c_j : the best sum of squares with c_j fixed, the others not negative, is at most `limit`}.

    With c_j fixed, every set of zeros among the others gives a parabola in c_j. The constrained optimum at an end lies
    on one of them, so the ends are the outermost crossings at which the others come out feasible: exact, no iteration.

    Parameters
    ----------
    columns : ndarray, shape (problems, g, n, p)
        Weighted columns.
    y : ndarray, shape (problems, g, n)
        Weighted measured values.
    limit : ndarray, shape (problems,)
        Largest sum of squares allowed.
    nonnegative : sequence of bool, length p
        Which coefficients must not be negative.

    Returns
    -------
    low, high : ndarray, shape (problems, g, p)
        NaN where no c_j reaches the limit; inf where c_j is not bounded.
    """
    nonnegative = np.asarray(nonnegative, bool)
    p = columns.shape[-1]
    norm = np.sqrt(np.einsum("...np,...np->...p", columns, columns))
    safe = np.where(norm > 0, norm, 1.0)
    scaled = columns / safe[..., None, :]
    # costs are counted from the unconstrained optimum: no digits are lost to |y|^2
    gram = np.swapaxes(scaled, -1, -2) @ scaled
    everything = np.ones((*gram.shape[:-2], p), bool)
    moment = (np.swapaxes(scaled, -1, -2) @ y[..., None])[..., 0]
    centre = solve_kept(gram, moment, everything)
    rest = y - (scaled @ centre[..., None])[..., 0]
    centre = centre + solve_kept(gram, (np.swapaxes(scaled, -1, -2) @ rest[..., None])[..., 0], everything)
    rest = y - (scaled @ centre[..., None])[..., 0]
    floor = np.einsum("...n,...n->...", rest, rest)
    spare = limit[:, None] - floor  # what c may cost: (c - centre)' gram (c - centre) <= spare
    low, high = np.full(moment.shape, np.nan), np.full(moment.shape, np.nan)
    for j in range(p):
        others = [k for k in range(p) if k != j and nonnegative[k]]
        for zeros in product((False, True), repeat=len(others)):
            keep = np.ones(p, bool)
            keep[[k for k, zero in zip(others, zeros, strict=True) if zero]] = False
            low_here, high_here = _ends(gram, centre, spare, j, keep, nonnegative)
            low[..., j], high[..., j] = np.fmin(low[..., j], low_here), np.fmax(high[..., j], high_here)
    if nonnegative.any():
        low[..., nonnegative] = np.maximum(low[..., nonnegative], 0.0)
        high[..., nonnegative] = np.where(high[..., nonnegative] < 0, np.nan, high[..., nonnegative])
        low = np.where(np.isnan(high), np.nan, low)
    return low / safe, np.where(norm > 0, high / safe, np.inf)


def _ends(gram, centre, spare, j, keep, nonnegative):
    """Crossings of one parabola: c_k = 0 for k not in `keep`, c_j = t, the rest of `keep` at its best."""
    rest = keep.copy()
    rest[j] = False
    mask = np.broadcast_to(rest, centre.shape)
    off = ~keep
    # cost(t) in d = c - centre: d_k = -centre_k off, d_j = t - centre_j; rest minimised. Linear-quadratic in d_j.
    fixed = np.where(off, -centre, 0.0)
    pull = (gram @ fixed[..., None])[..., 0]
    by_fixed = solve_kept(gram, pull, mask)  # -d_rest at d_j = 0
    by_j = solve_kept(gram, gram[..., :, j], mask)  # -d_rest per unit of d_j
    own = gram[..., j, j] - np.einsum("...k,...k->...", by_j, gram[..., :, j] * rest)
    cross = pull[..., j] - np.einsum("...k,...k->...", by_fixed, gram[..., :, j] * rest)
    base = np.einsum("...k,...k->...", fixed, pull) - np.einsum("...k,...k->...", by_fixed, pull * rest)
    bounded = own > FREE
    safe = np.where(bounded, own, 1.0)
    least = -cross / safe
    spread = (spare - base + np.where(bounded, cross**2 / safe, 0.0)) / safe
    possible = spread >= 0
    half = np.sqrt(np.maximum(spread, 0.0))
    ends = []
    for sign in (-1, 1):
        d_j = least + sign * half
        d_rest = -by_fixed - by_j * d_j[..., None]
        c_rest = centre + d_rest
        feasible = ~np.any((c_rest < -1e-12 * np.abs(centre).max(axis=-1, keepdims=True)) & rest & nonnegative, axis=-1)
        value = np.where(possible & bounded & feasible, centre[..., j] + d_j, np.nan)
        if sign > 0:  # not bounded: only if moving up for ever breaks nobody's sign
            open_ = ~bounded & (spare - base >= 0) & ~np.any((by_j > 1e-9) & rest & nonnegative, axis=-1)
            value = np.where(open_, np.inf, value)
        ends.append(value)
    return ends
