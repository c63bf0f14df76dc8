"""Eq. 14 fitted to many conditions at once, with exact intervals of nonnegative coefficients."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy.special import stdtr

from sealfit.fit.least_squares import Separable, covariance_of, even_grid, global_optimum, profile, solve_kept

# A coefficient is unbounded if other columns explain all but this share of its column's variance.
FREE = 1e-12


def constrained_ends(columns, y, limit, nonnegative):
    """Return the ends of {c_j : the least sum of squares at fixed c_j, the others nonnegative, <= `limit`}.

    For every active set of zeros the sum of squares is a parabola in c_j, and the constrained optimum at an
    end lies on one: the ends are the outermost feasible crossings. Columns, (problems, g, n, p), and y,
    (problems, g, n), are weighted; `limit` is (problems,). The ends, (problems, g, p), are NaN if the sum of
    squares exceeds the limit everywhere, inf if c_j is unbounded.
    """
    nonnegative = np.asarray(nonnegative, bool)
    norm = np.sqrt(np.einsum("...np,...np->...p", columns, columns))
    safe = np.where(norm > 0, norm, 1.0)
    scaled = columns / safe[..., None, :]
    transposed = np.swapaxes(scaled, -1, -2)
    gram = transposed @ scaled
    low, high = np.full(norm.shape, np.nan), np.full(norm.shape, np.nan)
    for kept in product(*((False, True) if may_be_zero else (True,) for may_be_zero in nonnegative)):
        keep = np.broadcast_to(kept, norm.shape)
        centre, rest = np.zeros(norm.shape), y
        for _ in range(2):  # the second time recovers the digits that normal equations lose
            centre = centre + solve_kept(gram, (transposed @ rest[..., None])[..., 0], keep)
            rest = y - (scaled @ centre[..., None])[..., 0]
        spare = limit[:, None] - np.einsum("...n,...n->...", rest, rest)
        for j in np.flatnonzero(kept):
            low_here, high_here = _ends(gram, centre, spare, j, keep, nonnegative)
            low[..., j], high[..., j] = np.fmin(low[..., j], low_here), np.fmax(high[..., j], high_here)
    low = np.where(nonnegative, np.maximum(low, 0.0), low)
    high = np.where(nonnegative & (high < 0), np.nan, high)
    low = np.where(np.isnan(high), np.nan, low)
    return low / safe, np.where(norm > 0, high / safe, np.inf)


def _ends(gram, centre, spare, j, keep, nonnegative):
    """Return the crossings of the parabola about `centre`: c_j moves, the others in `keep` are optimal."""
    others = keep & (np.arange(keep.shape[-1]) != j)
    pull = solve_kept(gram, gram[..., :, j], others)  # fall of the others per unit of c_j
    own = gram[..., j, j] - np.einsum("...k,...k->...", pull, gram[..., :, j])
    bounded, possible = own > FREE, spare >= 0
    half = np.where(bounded & possible, np.sqrt(np.maximum(spare, 0.0) / np.where(bounded, own, 1.0)), np.nan)
    least = -1e-12 * np.abs(centre).max(axis=-1, keepdims=True)  # smaller coefficients are rounding
    ends = []
    for away in (-half, half):
        negative = (centre - pull * away[..., None] < least) & others & nonnegative
        ends.append(np.where(negative.any(axis=-1), np.nan, centre[..., j] + away))
    low, high = ends
    falling = ((pull > 1e-9) & others & nonnegative).any(axis=-1)
    return low, np.where(~bounded & possible & ~falling, np.inf, high)


# F sgn(v) = N mu_s E + N mu_c (1 - E) + sigma_2 |v|, E = exp(-(v/v_s)^2). The coefficients of the three
# columns are nonnegative, as friction dissipates energy at every speed; mu_s < mu_c is allowed. Without load
# N = 1, and the coefficients are F_s and F_c.

# v_s is searched from a fifth of the slowest speed, below which E < 1e-10 at every speed, to twenty times the
# fastest, above which 1 - E < 0.0025.
SLOWEST, FASTEST = 1 / 5, 20.0
# Grid points of v_s per decade, 1 % apart. With four or five speeds a minimum can be that narrow.
PER_DECADE = 240
# Bisections of one grid cell. They give ln v_s to 1e-13.
HALVINGS = 40
# Points inside the interval of v_s at which the intervals of the other parameters are computed.
FINE = 61

NAMES = ("mu_s", "mu_c", "v_s", "sigma_2")
# mu_s, mu_c and sigma_2 are nonnegative.
PHYSICAL = (True, True, True)


@dataclass(frozen=True)
class StribeckFit:
    """Fits of many problems."""

    values: np.ndarray  # (problems, 4): mu_s, mu_c, v_s, sigma_2
    rss: np.ndarray  # (problems,)
    grid: np.ndarray  # (problems, g): ln v_s searched


def stribeck_basis(speed, load):
    """Return the columns of Eq. 14 along ln v_s for `profile`, from |v| and N, shape (problems, n) each."""

    def basis(u, rows):
        v, n = speed[rows][:, None, :], load[rows][:, None, :]
        decay = np.exp(-((v * np.exp(-u)[..., None]) ** 2))
        return np.stack([n * decay, n * (1 - decay), np.broadcast_to(v, decay.shape)], axis=-1)

    return basis


def search_grid(speed, weight, per_decade: int = PER_DECADE) -> np.ndarray:
    """Return the grid of ln v_s that is searched, shape (problems, g); speed and weight are (problems, n)."""
    used = weight > 0
    slowest = np.min(speed, axis=1, where=used, initial=np.inf)
    fastest = np.max(speed, axis=1, where=used, initial=0.0)
    return even_grid(np.log(slowest * SLOWEST), np.log(fastest * FASTEST), per_decade)


def solve_stribeck(speed, load, force, weight) -> StribeckFit:
    """Return the global weighted least-squares fit of Eq. 14 to many conditions.

    The arguments, shape (problems, n) each, are |v| > 0 in mm/s, N and F sgn(v) in N, and 1/variance, 0 for
    padding. FitError if a value is not finite.

    Examples
    --------
    >>> v = np.geomspace(0.5, 100, 9)[None, :]
    >>> force = 50 * (0.3 + 0.1 * np.exp(-((v / 6.0) ** 2))) + 0.02 * v
    >>> fit = solve_stribeck(v, np.full_like(v, 50.0), force, np.ones_like(v))
    >>> fit.values[0].round(8).tolist()
    [0.4, 0.3, 6.0, 0.02]
    """
    speed, load, force, weight = np.broadcast_arrays(
        *(np.asarray(x, float) for x in (speed, load, force, weight))
    )
    grid = search_grid(speed, weight)
    found = global_optimum(Separable(stribeck_basis(speed, load), force, weight, PHYSICAL), grid)
    mu_s, mu_c, sigma_2 = found.coefficients.T
    return StribeckFit(np.stack([mu_s, mu_c, np.exp(found.u), sigma_2], axis=1), found.rss, grid)


def stribeck_intervals(speed, load, force, weight, fit: StribeckFit, rise):
    """Return the ends of the profile-likelihood intervals of mu_s, mu_c, v_s, sigma_2, (problems, 4) each.

    That of v_s is where the least sum of squares exceeds the minimum by at most `rise`, shape (problems,):
    t^2 times the variance of unit weight. Its end is 0 or inf if it reaches a limit of the search. Those of
    the others are unions, over these v_s, of the exact interval at that v_s with nonnegative coefficients.
    """
    problems = Separable(stribeck_basis(speed, load), force, weight, PHYSICAL)
    limit = fit.rss + rise
    u_best = np.log(fit.values[:, 2])
    rss, _ = profile(problems, fit.grid)
    inside = rss <= limit[:, None]
    (u_low, open_low), (u_high, open_high) = (
        _crossing(problems, fit.grid, u_best, inside, limit, sign) for sign in (-1, 1)
    )
    fine = u_low[:, None] + (u_high - u_low)[:, None] * np.linspace(0, 1, FINE)
    fine = np.concatenate([fine, u_best[:, None]], axis=1)
    root = np.sqrt(weight)[:, None, :]
    columns = problems.basis(fine, np.arange(len(fine)))
    y = np.broadcast_to(force[:, None, :] * root, columns.shape[:-1])
    low, high = constrained_ends(columns * root[..., None], y, limit, PHYSICAL)
    with np.errstate(invalid="ignore"):  # NaN where the limit is exceeded
        low, high = np.fmin.reduce(low, axis=1), np.fmax.reduce(high, axis=1)
    estimate = fit.values[:, [0, 1, 3]]
    low, high = np.fmin(low, estimate), np.fmax(high, estimate)
    v_low, v_high = np.where(open_low, 0.0, np.exp(u_low)), np.where(open_high, np.inf, np.exp(u_high))
    return np.insert(low, 2, v_low, axis=1), np.insert(high, 2, v_high, axis=1)


def _crossing(problems: Separable, grid, u_best, inside, limit, sign):
    """Return the last u within the limit below (sign -1) or above (1) the optimum, and whether it is open."""
    along = sign * grid
    near = np.maximum(np.max(np.where(inside, along, -np.inf), axis=1), sign * u_best)
    far = np.min(np.where(along > near[:, None], along, np.inf), axis=1)
    open_ = ~np.isfinite(far)
    far = np.where(open_, near, far)
    for _ in range(HALVINGS):
        middle = (near + far) / 2
        value, _ = profile(problems, sign * middle[:, None])
        ok = value[:, 0] <= limit
        near, far = np.where(ok, middle, near), np.where(ok, far, middle)
    return sign * near, open_


def tangent(speed, load, values) -> np.ndarray:
    """Return derivatives of F sgn(v) with respect to mu_s, mu_c, v_s, sigma_2 at `values`, shape (n, 4)."""
    mu_s, mu_c, v_s, _ = values
    square = (speed / v_s) ** 2
    decay = np.exp(-square)
    along_v_s = load * (mu_s - mu_c) * decay * 2 * square / v_s
    return np.stack([load * decay, load * (1 - decay), along_v_s, speed], axis=1)


def free_parameters(names: Sequence[str], values: np.ndarray) -> np.ndarray:
    """Return which parameters are not fixed at their bound 0, shape (p,)."""
    return np.array([name == "v_s" or value > 0 for name, value in zip(names, values, strict=True)])


def linearised(jacobian, weight, values, names, moved):
    """Return the covariance at unit variance, shape (p, p), and the change of the parameters, shape (p, k).

    `moved`, shape (n, k), are changes of the forces. A coefficient at its bound 0 is fixed: its variance and
    change are 0.
    """
    free = free_parameters(names, values)
    covariance, _ = covariance_of(jacobian * np.sqrt(weight)[:, None], free)
    known = np.where(np.isfinite(covariance), covariance, 0.0)
    return covariance, known @ (jacobian.T @ (weight[:, None] * moved))


def flat_p_value(speed, columns, weight, grid, statistic, df) -> float:
    r"""Return the p-value of mu_s = mu_c against a Stribeck curve with free v_s.

    Under mu_s = mu_c v_s is not defined, so that the statistic is a maximum over v_s and not chi-square. As
    v_s varies, the normalised Stribeck column, with mu and sigma_2 projected out, moves along a curve of
    length kappa on the unit sphere. The volume of a tube around it gives

    .. math:: p = \frac{\kappa}{\pi} (1 + c^2/\nu)^{-\nu/2} + P(|t_\nu| > c)

    `columns`, shape (n, 1) or (n, 2), are those of the free parameters without Stribeck curve; `grid` is of
    ln v_s. `statistic` is c^2, the fall of the sum of squares over the variance of unit weight, and `df` the
    degrees of freedom of that variance, inf if it is known. Hotelling 1939, Am. J. Math. 61, 440-460; Davies
    1987, Biometrika 74(1), 33-43, doi:10.1093/biomet/74.1.33; with estimated variance: Knowles and Siegmund
    1989, Int. Stat. Rev. 57(3), 205-220, doi:10.2307/1403794.
    """
    root = np.sqrt(weight)
    base = columns * root[:, None]
    q, r = np.linalg.qr(base / np.linalg.norm(base, axis=0))
    q = q[:, np.abs(np.diag(r)) > 1e-10]
    curve = np.exp(-((speed * np.exp(-grid)[:, None]) ** 2)) * columns[:, 0] * root
    size = np.linalg.norm(curve, axis=1)
    residual = curve - (curve @ q) @ q.T
    length = np.linalg.norm(residual, axis=1)
    clear = (length > 1e-7 * np.maximum(size, 1e-300)) & (size > 1e-280)  # shorter residuals are rounding
    unit = residual[clear] / length[clear][:, None]
    chord = np.linalg.norm(np.diff(unit, axis=0), axis=1)
    kappa = float(np.sum(2 * np.arcsin(np.minimum(chord / 2, 1.0))))
    c2 = max(float(statistic), 0.0)
    tail = np.exp(-c2 / 2) if not np.isfinite(df) else (1 + c2 / df) ** (-df / 2)
    return float(min(1.0, kappa / np.pi * tail + 2 * stdtr(df, -np.sqrt(c2))))
