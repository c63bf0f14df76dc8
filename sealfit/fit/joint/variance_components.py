"""Row noise, and the variance components of strokes, files, runs and specimens by REML."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import solve_triangular
from scipy.optimize import minimize

from sealfit.fit.joint.declared import declare, tested_speeds
from sealfit.fit.joint.rows import LEVELS, SET_UP, Groups, Rows, cached
from sealfit.fit.joint.tangent import Tangent
from sealfit.fit.joint.whitening import GAIN, KINDS, LEVELS_OF_FORCE, Component, Scatter
from sealfit.ingest.scatter import two_nonnegative

# ---------------------------------------------------------------- reml
# Variance components at nested levels by restricted maximum likelihood (REML), with its exact gradient.
#
# With B the loads of the k kinds of random effects, :math:`K_l` their variances at level l, and V_l the
# covariance up to that level, Woodbury's identity gives for each group
#
# .. math:: B^T V_l^{-1} B = Q - Q M Q, \quad M = K^{1/2} (1 + K^{1/2} Q K^{1/2})^{-1} K^{1/2},
#           \quad Q = \sum_\mathrm{inside} B^T V_{l-1}^{-1} B
#
# The likelihood goes from the finest level up, its gradient back. Searle, Casella & McCulloch 1992,
# *Variance Components*, doi:10.1002/9780470316856, chapter 6.

# Smallest start of a component, as a share of the residual variance.
LEAST_START = 0.03
# Largest relative standard deviation of a gain. With a larger one a force near 0 would fit any data.
MOST_GAIN = 0.5
# A component below this share of the residual variance counts as zero.
LEAST = 1e-5
# Share of the residual variance that is added to a component before the logarithm. In all of 623 estimates in
# 14 campaigns half the deviance is within 0.001 of the best of seven descents; with 1e-3 it is so in 621, in
# variances alone in 574.
SHIFT = 1e-4
# Largest component, as a multiple of the residual variance, which may be small with many parameters.
MOST_SHARE = 30.0

# Least share of a parameter's derivatives that lies in the means of strokes; the length of a ripple has less.
LEAST_BETWEEN = 0.1


@dataclass(frozen=True)
class GroupMeans:
    """Means over the m finest groups."""

    residual: np.ndarray  # (m,) in N
    variance: np.ndarray  # (m,) of each mean due to row noise, in N^2
    loads: np.ndarray  # (m, kinds) change per unit of each kind of random effect
    groups: Groups  # nested groups of the m means


def reml(
    means: GroupMeans,
    jacobian: Tangent,
    kinds: Sequence[tuple[str, str]],
    start: Sequence[float] | None = None,
) -> tuple[float, tuple[Component, ...]]:
    """Return half the restricted deviance and the variance components, finest level first, by REML."""
    total = max(float(np.var(means.residual)), float(np.mean(means.variance)), 1e-20)
    square = np.maximum(np.mean(means.loads**2, axis=0), 1e-24)
    unit = np.array([total / square[KINDS.index(kind)] for _, kind in kinds])
    # A lower limit of the noise variance keeps the likelihood from being dominated by rounding.
    means = replace(means, variance=np.maximum(means.variance, LEAST * total))
    likelihood = RestrictedLikelihood(means, jacobian.orthonormal(1e-9), kinds)

    def objective(share: np.ndarray) -> tuple[float, np.ndarray]:
        value, gradient = likelihood(unit * share)
        return value, gradient * unit

    limited = [kind in ("gain", "v_s") for _, kind in kinds]
    most = np.where(limited, MOST_GAIN**2 / unit, np.inf)
    high = np.clip(most, LEAST, MOST_SHARE)
    first = np.full(len(kinds), 0.2) if start is None else np.maximum(np.asarray(start) / unit, LEAST_START)
    value, share = _minimum(objective, np.minimum(first, 0.36 * high), high)
    variances = np.where(share > LEAST, unit * share, 0.0)
    parts = zip(kinds, variances.tolist(), strict=True)
    return value, tuple(Component(level, kind, v) for (level, kind), v in parts)


def _minimum(
    objective: Callable[[np.ndarray], tuple[float, np.ndarray]], start: np.ndarray, high: np.ndarray
) -> tuple[float, np.ndarray]:
    """Return the minimum of a function with its gradient, and the place between 0 and `high`, shape (k,).

    The descent is in u = log(1 + x / SHIFT). Among large components it is one in logarithms, as their slopes
    differ by orders of magnitude, which ends other descents early; and a component may become 0.
    """

    def shifted(u: np.ndarray) -> tuple[float, np.ndarray]:
        value, gradient = objective(SHIFT * np.expm1(u))
        return value, gradient * SHIFT * np.exp(u)

    options = {"maxiter": 200, "ftol": 1e-10}  # so that rounding in the residual changes no estimate
    bounds = [(0.0, most) for most in np.log1p(high / SHIFT)]
    first = np.log1p(start / SHIFT)
    best = minimize(shifted, first, jac=True, method="L-BFGS-B", bounds=bounds, options=options)
    return float(best.fun), SHIFT * np.expm1(best.x)


class RestrictedLikelihood:
    """Half the restricted deviance of group means, and its gradient, as functions of the variances."""

    def __init__(self, means: GroupMeans, basis: Tangent, kinds: Sequence[tuple[str, str]]) -> None:
        groups, self.variance = means.groups, means.variance
        every = basis.append(means.residual)
        self.columns = every.values
        used = list(dict.fromkeys(kind for _, kind in kinds))
        self.loads = means.loads[:, [KINDS.index(kind) for kind in used]]
        self.places = [(level, used.index(kind)) for level, kind in kinds]
        self.finest = next(iter(groups.starts))
        self.above = list(dict.fromkeys(level for level, _ in kinds if level != self.finest))
        self.groups = {}  # of the next finer groups, by level
        self.layout = {self.finest: every.layout}
        finer = self.finest
        for level in self.above:
            self.groups[level], finer = groups.at(finer), level
            self.layout[level] = every.layout.of(groups.starts[level])

    def __call__(self, variances: np.ndarray) -> tuple[float, np.ndarray]:
        """Return the value and its derivative with respect to each variance, shape (kinds,)."""
        size = {level: np.zeros(self.loads.shape[1]) for level in (self.finest, *self.above)}
        for (level, k), v in zip(self.places, variances, strict=True):
            size[level][k] = v
        own = self.variance + self.loads**2 @ size[self.finest]
        columns = self.columns / own[:, None]
        # B' V^-1 B, shape (groups, k, k), and B' V^-1 [X r], shape (groups, k, p + 1).
        square = self.loads[:, :, None] * (self.loads / own[:, None])[:, None, :]
        cross = self.loads[:, :, None] * columns[:, None, :]
        gram = self.layout[self.finest].gram(self.columns, columns)
        value = float(np.log(own).sum())
        steps, inner = [(square, cross)], []
        for level in self.above:
            q, t = (self._sums(part, level) for part in (square, cross))
            root = np.sqrt(size[level])
            both = np.eye(root.size) + root[:, None] * q * root
            m = root[:, None] * np.linalg.inv(both) * root
            value += float(np.linalg.slogdet(both)[1].sum())
            mt = m @ t
            gram -= sum(self.layout[level].gram(t[:, kind], mt[:, kind]) for kind in range(root.size))
            inner.append((m, mt, np.eye(root.size) - m @ q))
            square, cross = q - q @ m @ q, t - q @ mt
            steps.append((square, cross))
        chol = _root_of(gram[:-1, :-1])
        half = solve_triangular(chol, gram[:-1, -1], lower=True)
        value += 2.0 * float(np.log(np.diag(chol)).sum()) + float(gram[-1, -1] - half @ half)
        # Columns orthonormal under V^-1 and the GLS residual; the gradient is a function of their loadings.
        turn = np.zeros_like(gram)
        turn[:-1, :-1] = solve_triangular(chol, np.eye(half.size), lower=True).T
        turn[:-1, -1], turn[-1, -1] = -turn[:-1, :-1] @ half, 1.0
        # Its product with a Gram matrix is the sum of squares of the transformed columns.
        turned = turn @ turn.T
        slope = {}
        n = y = None
        for k in reversed(range(len(steps))):
            square, cross = steps[k]
            if k < len(self.above):
                m, mt, left = inner[k]
                if n is None:
                    n, y = m, mt
                else:
                    code = self._code(self.above[k + 1])
                    n, y = m + left @ n[code] @ left.swapaxes(1, 2), mt + left @ y[code]
                code = self._code(self.above[k])
                square, cross = square - square @ n[code] @ square, cross - square @ y[code]
            level = self.above[k - 1] if k else self.finest
            for kind in (kind for place, kind in self.places if place == level):
                taken = np.vdot(self.layout[level].gram(cross[:, kind], cross[:, kind]), turned)
                slope[level, kind] = float(square[:, kind, kind].sum()) - float(taken)
        return 0.5 * value, 0.5 * np.array([slope[place] for place in self.places])

    def _sums(self, values: np.ndarray, level: str) -> np.ndarray:
        """Return the sums over the groups of a level of values of the next finer groups, (groups, ...)."""
        found = self.groups[level].sums(values.reshape(len(values), -1), level)
        return found.reshape(-1, *values.shape[1:])

    def _code(self, level: str) -> np.ndarray:
        """Return the number of the group of a level of each next finer group."""
        return self.groups[level].codes[level]


def _root_of(gram: np.ndarray) -> np.ndarray:
    """Return a Gram matrix's lower Cholesky root, with the smallest ridge that makes it positive definite."""
    largest = float(np.diag(gram).max(initial=0.0)) or 1.0  # it depends on the unit of force
    ridge = 1e-12 * largest
    while True:
        try:
            return np.linalg.cholesky(gram + ridge * np.eye(gram.shape[0]))
        except np.linalg.LinAlgError:
            if not np.isfinite(gram).all() or ridge > largest:
                raise
            ridge *= 100


def orthonormal(columns: np.ndarray, tolerance: float = 1e-9) -> np.ndarray:
    """Return an orthonormal basis of the columns' span, shape (m, rank)."""
    left, size, _ = np.linalg.svd(columns, full_matrices=False)
    return left[:, size > tolerance * max(size.max(initial=0.0), 1e-300)]


# ---------------------------------------------------------------- scatter
# Smallest row noise, as a share of the force, below the resolution of any sensor.
LEAST_NOISE = 1e-6
# Fall of half the restricted deviance from which specimens differ in mu_s, v_s or sigma_2. Without v_s and
# sigma_2 the number of the run was significant in 34 of 40 campaigns in which specimens scatter by 3 % in dry
# friction alone; with them in none. Of 120 fits to specimens that differ in their whole friction alone 3 %
# have a fall above 2, none above 3.
CURVES_DIFFER = 3.0
# Number of speeds at which a specimen shows that.
SPEEDS_OF_A_SPECIMEN = {"mu_s": 3, "v_s": 3, "sigma_2": 2}
# Number of files from which differences in their shape along strokes are estimated.
LEAST_FILES = 6


def estimate_scatter(
    rows: Rows, residual: np.ndarray, loads: np.ndarray, jacobian: Tangent, start: Scatter | None = None
) -> Scatter:
    """Return row noise and variance components of the residual of a model, by REML.

    `residual`, measured minus model, has the shape (n,) and is in N; `loads`, shape (n, kinds), are changes
    of the force per unit of each kind. `start` has starting values, and the components to be estimated.
    """
    friction = loads[:, GAIN]
    s0, g, design_effect = row_noise(rows, residual, friction)
    shape = shape_scatter(rows, residual, np.sqrt((s0**2 + (g * friction) ** 2) * design_effect))
    start = Scatter(s0, g, () if start is None else start.components, design_effect, shape)
    return estimate_components(rows, residual, loads, jacobian, start)


def estimate_components(
    rows: Rows, residual: np.ndarray, loads: np.ndarray, jacobian: Tangent, scatter: Scatter
) -> Scatter:
    """Return a scatter with re-estimated components and the same row noise; see `estimate_scatter`."""
    known = [(part.level, part.kind) for part in scatter.components]
    kinds = [kind for kind in [*usable_components(rows), *curve_components(rows)] if kind in known]
    kinds = kinds if known else usable_components(rows)
    return _estimated(rows, residual, loads, jacobian, scatter, kinds)[1]


def with_curves(
    rows: Rows, residual: np.ndarray, loads: np.ndarray, jacobian: Tangent, scatter: Scatter
) -> Scatter | None:
    """Return a scatter with components of the specimens' curves; None if these do not differ."""
    if not (curves := curve_components(rows)):
        return None
    kinds = [(part.level, part.kind) for part in scatter.components]
    given = rows, residual, loads, jacobian, scatter
    (value, _), (less, found) = _estimated(*given, kinds), _estimated(*given, [*kinds, *curves])
    return found if less < value - CURVES_DIFFER else None


def _estimated(
    rows: Rows,
    residual: np.ndarray,
    loads: np.ndarray,
    jacobian: Tangent,
    scatter: Scatter,
    kinds: Sequence[tuple[str, str]],
) -> tuple[float, Scatter]:
    """Return half the restricted deviance, and the scatter with components of these levels and kinds."""
    groups, level = rows.groups, "stroke"
    means = groups.means(np.column_stack([residual, loads]), level)
    noise = groups.means(scatter.noise_sd(loads[:, GAIN]) ** 2, level)
    count = np.diff(np.r_[groups.starts[level], residual.size])
    known = {(part.level, part.kind): part.variance for part in scatter.components}
    between = jacobian.means(groups, level)
    inside = between.with_values(between.values * np.sqrt(count)[:, None]).norms() ** 2
    share = inside / np.maximum(jacobian.norms() ** 2, 1e-300)
    own_noise = noise * scatter.design_effect / count
    given = GroupMeans(means[:, 0], own_noise, means[:, 1:], groups.at(level))
    start = [known.get(kind, 0.0) for kind in kinds] if known else None
    value, components = reml(given, between.columns(share >= LEAST_BETWEEN), kinds, start)
    return value, replace(scatter, components=tuple(replace(c, df=_df(rows, c)) for c in components))


def usable_components(rows: Rows) -> list[tuple[str, str]]:
    """Return (level, kind) of the random effects that these groups distinguish, finest level first."""
    counts = {level: rows.groups.starts[level].size for level in LEVELS}
    used = ["stroke"] if counts["stroke"] > counts["file"] else []
    known = runs_show_scatter(rows)
    for level in LEVELS[1:]:
        if not used or (2 < counts[level] < counts[used[-1]] and (known or level != "run")):
            used.append(level)
    # Specimen scatter needs replicates of a condition, or a law across conditions.
    if used[-1] == "specimen" and counts["specimen"] - declare(rows).mu_parameter_count < 2:
        used.pop()
    size = np.abs(rows.force)
    if not (rows.speed.min() < 0 < rows.speed.max() or np.ptp(size) > 0.2 * size.max()):
        return [(level, "offset") for level in used]
    # Specimens differ in friction, not in the sensor's zero.
    pairs = [(level, kind) for level in used for kind in LEVELS_OF_FORCE]
    return [pair for pair in pairs if pair != ("specimen", "offset")]


@cached
def runs_show_scatter(rows: Rows) -> bool:
    """Return whether there are more runs, or set-ups, than declared parameters that their means determine.

    Else the model goes through every run, but for a sigma_2 at its limit 0. A set-up with several speeds
    determines the level of friction, but not its dependence on the speed.
    """
    declared = declare(rows)
    count = len(declared.parameters)
    if SET_UP in rows.table and rows.table.groupby(rows.codes("run"))["speed_set_mm_s"].nunique().max() > 1:
        count = declared.mu_parameter_count
    return rows.groups.starts["run"].size > count


@cached
def curve_components(rows: Rows) -> list[tuple[str, str]]:
    """Return (level, kind) of the numbers of the Stribeck curve that specimens may show to differ."""
    if "specimen" not in {level for level, _ in usable_components(rows)}:
        return []  # curves would stand in for levels
    starts = rows.groups.starts["specimen"]
    parts = np.split(np.arange(rows.force.size), starts[1:])
    speeds = np.array([tested_speeds(rows, own).size for own in parts])
    count = Counter(p.quantity for p in declare(rows).parameters)
    count["mu_s"] = sum(count[name] for name in ("mu_0s", "a_s", "b_s"))
    return [
        ("specimen", kind)
        for kind, least in SPEEDS_OF_A_SPECIMEN.items()
        if count[kind] and np.count_nonzero(speeds >= least) - count[kind] >= 2
    ]


def _df(rows: Rows, component: Component) -> float:
    counts = [rows.groups.starts[level].size for level in LEVELS]
    own, *above = counts[LEVELS.index(component.level) :]
    return float(own - next((count for count in above if count < own), 1))


def row_noise(rows: Rows, residual: np.ndarray, force: np.ndarray) -> tuple[float, float, float]:
    """Return (s0, g, design effect) of the row noise, sqrt(s0^2 + (gF)^2) within strokes.

    The mean pattern of all strokes along the bins is not noise and is subtracted first.
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
    return float(np.sqrt(max(a, floor))), float(np.sqrt(b)), _design_effect(inside, code, start, count)


def _design_effect(inside: np.ndarray, code: np.ndarray, start: np.ndarray, count: np.ndarray) -> float:
    """Return the design effect: 1 + 2 sum of autocorrelations over bins, up to the first below 0.05."""
    scale = np.sqrt(np.maximum(np.add.reduceat(inside**2, start) / count, 1e-300))[code]
    unit = inside / scale
    total, effect = max(float((unit**2).mean()), 1e-300), 1.0
    for lag in range(1, max(2, int(count.min()) // 3)):
        same = code[lag:] == code[:-lag]
        rho = float((unit[lag:] * unit[:-lag])[same].mean()) / total
        if rho < 0.05:
            break
        effect += 2 * rho
    return effect


def shape_scatter(rows: Rows, residual: np.ndarray, sd: np.ndarray) -> float:
    """Return the variance of shapes along strokes between files over that expected of row noise, at least 1.

    Slope and curvature of each pass along displacement are compared with their mean over all passes of that
    direction. Without this factor hundreds of rows would outweigh the few files they come from.
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
    for load in (np.ones_like(size), size / max(size.mean(), 1e-300)):  # added, or proportional to friction
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
