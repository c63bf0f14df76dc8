"""The optimisation of the joint fit: start by a global search of v_s and b, then Levenberg-Marquardt."""

from __future__ import annotations

import numpy as np
from scipy.optimize import lsq_linear

from sealfit.fit.joint.declared import JointParameter, declare
from sealfit.fit.joint.model import Model, evaluate, loads_of
from sealfit.fit.joint.prior import centre_of, precision_of
from sealfit.fit.joint.rows import Rows
from sealfit.fit.joint.whitening import Scatter, Whitening
from sealfit.ingest.strokes import SPEEDS_APART

# Number of grid values of v_s.
GRID = 80
# Values of v_s fit equally well within this share of the sum of squared forces; the middle one is taken.
EQUAL = 1e-10
# Singular values below this share of the largest one count as zero.
RANK = 1e-10

# Largest number of Levenberg-Marquardt steps.
MAX_STEPS = 60
# Number of grid values of log v_s and of log b that are tried when an effect has been added.
GRID_POINTS = 12
# Number of rows of each stroke that the grid search uses. v_s and b act on a stroke as a whole.
ROWS_FOR_START = 4
# Fall of the whitened sum of squares below which a step is slow. The descent ends after four in a row: the
# data then determine nothing along its direction.
SLOW = 1e-2
# Fall below which the descent has converged: estimates are then within 0.01 standard errors of the optimum.
CONVERGED = 1e-4


def start_model(rows: Rows, *, together: bool = False) -> Model:
    """Return the declared model with v_s and b from a global search and the rest from exact least squares.

    With `together`, all series start from one v_s and one sigma_2, which a few noisy runs cannot make far
    wrong.
    """
    declared = declare(rows)
    theta = np.zeros(len(declared.parameters))
    number = {p: k for k, p in enumerate(declared.parameters)}
    speeds = np.abs(rows.groups.means(rows.speed, "stroke"))
    condition = rows.condition[rows.groups.starts["stroke"]]
    load = rows.groups.means(rows.load, "stroke")
    size = rows.groups.means(rows.force * np.sign(rows.speed), "stroke")
    series = sorted({p.owner for p in declared.parameters if p.quantity in ("v_s", "sigma_2")})
    level = np.zeros((len(rows.conditions), 2))  # mu_s, mu_c of each condition
    chosen = np.zeros(len(rows.conditions), dtype=bool)
    curved = declared.index["v_s"] >= 0
    solved: dict[bytes, tuple] = {}  # with `together`, series of one form share the solution
    for name in series:
        k, of_v_s = number[JointParameter("sigma_2", name)], number.get(JointParameter("v_s", name))
        full = of_v_s is not None
        uses = curved if together and full else declared.index["sigma_2"] == k
        if uses.tobytes() not in solved:
            mine = uses[condition]
            strokes = speeds[mine], load[mine], size[mine], condition[mine]
            solved[uses.tobytes()] = _per_condition(*strokes, full)
        own, pairs, theta[k], v_s = solved[uses.tobytes()]
        level[own], chosen[own] = pairs, True
        if full:
            theta[of_v_s] = np.log(v_s)
    present = np.bincount(condition, minlength=chosen.size) > 0  # its files may have been left out
    for c in np.flatnonzero(present & ~chosen):
        mine = condition == c
        level[c] = np.mean(size[mine] / load[mine])
    level[~present] = level[present].mean(axis=0)
    days = rows.conditions["aging_days"].to_numpy()
    for column, end in ((0, "s"), (1, "c")):
        index_0, index_a, index_b = (declared.index[name + end] for name in ("mu_0", "a_", "b_"))
        for k in np.unique(index_0[(index_0 >= 0)]):
            mine = _known(index_0 == k, present)
            unaged = mine & (days == days[mine].min())
            theta[k] = level[unaged, column].mean()
        for k in np.unique(index_a[index_a >= 0]):
            mine = _known(index_a == k, present)
            mu_0 = theta[index_0[mine][0]]
            drop = mu_0 - level[mine, column]
            grid = np.geomspace(days[days > 0].min() / 100, days.max() * 3, 60)
            log = np.log1p(days[mine][:, None] / grid)
            a = (log * drop[:, None]).sum(0) / np.maximum((log**2).sum(0), 1e-300)
            best = int(np.argmin(((drop[:, None] - a * log) ** 2).sum(0)))
            theta[k] = a[best]
            theta[index_b[mine][0]] = np.log(grid[best])
    return Model(declared, theta)


def _known(mine: np.ndarray, present: np.ndarray) -> np.ndarray:
    """Return those of some conditions that have rows, or all if none has."""
    return mine & present if (mine & present).any() else mine


def _per_condition(speed, load, size, condition, full: bool):
    """Return the conditions of a series, their mu_s and mu_c, sigma_2 and v_s, by a grid over v_s."""
    own, code = np.unique(condition, return_inverse=True)
    grid = np.geomspace(*stribeck_range(speed), GRID) if full else np.array([1.0])
    solved, costs = [], []
    for v_s in grid:
        decay = np.exp(-((speed / v_s) ** 2)) if full else np.zeros_like(speed)
        columns = load * np.stack([decay, 1 - decay])
        pairs, sigma_2, _ = pairs_and_shared(columns, code, speed, size)
        pairs = np.maximum(pairs, 0.0)  # a wrong v_s may fit few speeds exactly, with a negative coefficient
        residual = size - (pairs[code].T * columns).sum(axis=0) - sigma_2 * speed
        costs.append(float(residual @ residual))
        solved.append((pairs, sigma_2, v_s))
    equal = np.flatnonzero(np.array(costs) <= min(costs) + EQUAL * float(size @ size))
    pairs, sigma_2, v_s = solved[equal[equal.size // 2]]
    return own, pairs if full else pairs[:, [1, 1]], float(sigma_2), float(v_s)


def pairs_and_shared(
    columns: np.ndarray, code: np.ndarray, shared: np.ndarray, values: np.ndarray
) -> tuple[np.ndarray, float, int]:
    """Return the least squares solution of two numbers per group and one, not below 0, that all groups share.

    Each group's two columns, (2, n), are projected out, which leaves one equation for the number of `shared`,
    (n,). Among several solutions it is the one of least norm. `code`, shape (n,), is each value's group.
    Returns the pairs, shape (groups, 2), the shared number, and the rank of the pairs' columns.
    """
    one, length = _unit(columns[0], code)
    along = np.bincount(code, one * columns[1])
    two, rest = _unit(columns[1] - along[code] * one, code)
    triangle = np.zeros((length.size, 2, 2))
    triangle[:, 0, 0], triangle[:, 0, 1], triangle[:, 1, 1] = length, along, rest
    left, spread, right = np.linalg.svd(triangle)
    least = RANK * max(float(spread.max()), float(np.linalg.norm(shared)), 1e-300)
    inverse = np.divide(1.0, spread, out=np.zeros_like(spread), where=spread > least)

    def projected(column: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the coefficients on the groups' columns, shape (groups, 2), and the residual, shape (n,)."""
        inside = np.column_stack([np.bincount(code, one * column), np.bincount(code, two * column)])
        pairs = np.einsum("gji,gj->gi", right, np.einsum("gji,gj->gi", left, inside) * inverse)
        return pairs, column - (pairs[code].T * columns).sum(axis=0)

    of_shared, shared_left = projected(shared)
    of_values, values_left = projected(values)
    square = float(shared_left @ shared_left)
    if np.sqrt(square) > least:
        number = float(shared_left @ values_left) / square
    else:
        number = float((of_values * of_shared).sum()) / (1.0 + float((of_shared**2).sum()))
    number = max(number, 0.0)
    return of_values - number * of_shared, number, int((spread > least).sum())


def _unit(column: np.ndarray, code: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return a column scaled to length 1 in each group, and its lengths; a column of zeros stays zero."""
    length = np.sqrt(np.bincount(code, column**2))
    return column * np.divide(1.0, length, out=np.zeros_like(length), where=length > 0)[code], length


def stribeck_range(speeds: np.ndarray) -> tuple[float, float]:
    """Return the range in which v_s is searched: from half the second slowest speed to the fastest, in mm/s.

    Below it mu_s is not bounded; above it sigma_2 and mu_c can imitate the exponential.
    """
    positive = np.sort(speeds[speeds > 0])
    above = positive[positive > SPEEDS_APART * positive[0]]
    second = above[0] if above.size else positive[0]
    return float(second / 2), float(positive[-1])


def descend(
    model: Model,
    rows: Rows,
    scatter: Scatter,
    centre: np.ndarray,
    loads: np.ndarray | None = None,
    *,
    tolerance: float = CONVERGED,
) -> Model:
    """Return the model of least penalised whitened sum of squares at fixed scatter, by Levenberg-Marquardt.

    The start, `model`, is moved inside the bounds. `centre`, shape (model.size,), is the mean of the prior.
    `loads`, shape (n, kinds), by default the model's at the start, are fixed, so that all steps minimise the
    same function. The descent ends when the sum of squares falls by less than `tolerance`.
    """
    precision = precision_of(model)
    low, high = bounds_of(model, rows)
    vector = np.clip(model.vector(), low, high)
    model = model.at(vector)
    force, jacobian = evaluate(model, rows)
    if loads is None:
        loads = loads_of(model, rows)
    whitening = Whitening(scatter, loads, rows.groups)

    def cost_of(residual: np.ndarray, at: np.ndarray) -> float:
        return float(residual @ residual + (at - centre) @ precision @ (at - centre))

    residual = whitening((rows.force - force)[:, None])[:, 0]
    cost = cost_of(residual, vector)
    damping, slow_steps = 1e-4, 0
    for _ in range(MAX_STEPS):
        normal, gradient = whitening.normal(jacobian, residual)
        gradient = gradient - precision @ (vector - centre)
        normal = normal + precision
        blocked = ((vector <= low) & (gradient < 0)) | ((vector >= high) & (gradient > 0))
        free = ~blocked & (np.diag(normal) > 0)
        scale = np.sqrt(np.diag(normal)[free])
        scaled = normal[np.ix_(free, free)] / np.outer(scale, scale)
        for _ in range(12):
            move, damped = np.zeros_like(vector), scaled + (damping + 1e-12) * np.eye(scale.size)
            move[free] = np.linalg.solve(damped, gradient[free] / scale) / scale
            trial = np.clip(vector + move, low, high)
            trial_model = model.at(trial)
            trial_force = evaluate(trial_model, rows, jacobian=False)[0]
            trial_residual = whitening((rows.force - trial_force)[:, None])[:, 0]
            trial_cost = cost_of(trial_residual, trial)
            if np.isfinite(trial_cost) and trial_cost <= cost:
                break
            damping = max(damping, 1e-6) * 8
        else:
            return model
        gain = cost - trial_cost
        vector, model, residual, cost = trial, trial_model, trial_residual, trial_cost
        damping /= 10
        slow_steps = slow_steps + 1 if gain < SLOW else 0
        # Under heavy damping every step gains little.
        if slow_steps > 3 or (gain < tolerance and damping < 1e-3):
            return model
        _, jacobian = evaluate(model, rows)
    return model


def search_nonlinear(model: Model, rows: Rows, scatter: Scatter) -> Model:
    """Return the model with each v_s, and all b together, at the best of a grid.

    Without the effect that was added they may have converged to another local minimum. As series share mu_0,
    first all v_s get the same value, then each is searched by itself.
    """
    rows = rows.sparse(ROWS_FOR_START)
    quantities = [p.quantity for p in model.declared.parameters]
    stribeck = [k for k, name in enumerate(quantities) if name == "v_s"]
    if stribeck:
        model = _best_on_grid(model, rows, scatter, stribeck)
    for number in stribeck if len(stribeck) > 1 else ():
        model = _best_on_grid(model, rows, scatter, [number])
    laws = [k for k, name in enumerate(quantities) if name in ("b_s", "b_c")]
    return _best_on_grid(model, rows, scatter, laws) if laws else model


def _best_on_grid(model: Model, rows: Rows, scatter: Scatter, group: list[int]) -> Model:
    """Return the model of least cost among itself and grid values of a group of parameters, all set equal.

    The cost is the penalised whitened sum of squares, with the linear parameters at their optimum. The normal
    equations of rows on which the group does not act are computed once.
    """
    low, high = bounds_of(model, rows)
    precision = np.diag(precision_of(model))[group]  # of the prior, which is centred at the present values
    acted_on, *others = _split_by_action(model, rows, group)
    whitening, *of_others = (
        Whitening(scatter, loads_of(model, own, own.force), own.groups) for own in (acted_on, *others)
    )
    constant = [_equations(model, own, white) for own, white in zip(others, of_others, strict=True)]

    def optimum(trial: Model) -> tuple[float, Model]:
        parts = zip(_equations(trial, acted_on, whitening), *constant, strict=True)
        return _linear_optimum(trial, tuple(sum(own) for own in parts), (low, high))

    least_cost, best = optimum(model)
    for value in np.linspace(low[group[0]], high[group[0]], GRID_POINTS):
        vector = model.vector()
        penalty = float(precision @ (value - vector[group]) ** 2)
        vector[group] = value
        cost, solved = optimum(model.at(vector))
        if cost + penalty < least_cost - 1e-9:
            least_cost, best = cost + penalty, solved
    return model.at(np.clip(best.vector(), low, high))


def _split_by_action(model: Model, rows: Rows, group: list[int]) -> tuple[Rows, ...]:
    """Return rows on which declared parameters act, and the others; all rows if one part is empty.

    Rows of one specimen are correlated and stay together.
    """
    conditions = np.any([np.isin(numbers, group) for numbers in model.declared.index.values()], axis=0)
    specimen = rows.codes("specimen")
    acts = (np.bincount(specimen, conditions[rows.condition]) > 0)[specimen]
    if acts.all() or not acts.any():
        return (rows,)
    return rows.cache.once(("split", acts.tobytes()), lambda: (rows.subset(acts), rows.subset(~acts)))


def solve_linear(model: Model, rows: Rows, scatter: Scatter, loads: np.ndarray) -> Model:
    """Return the model with its linear parameters at their optimum, all nonlinear parameters fixed.

    A new term explains part of what others did; from there a descent would start far off and might diverge.
    """
    bounds = bounds_of(model, rows)
    equations = _equations(model, rows, Whitening(scatter, loads, rows.groups))
    solved = _linear_optimum(model, equations, bounds)[1]
    return model.at(np.clip(solved.vector(), *bounds))


# Normal matrix, (k, k), and gradient, (k,), of the linear parameters, and the sum of squares.
Equations = tuple[np.ndarray, np.ndarray, float]


def _equations(model: Model, rows: Rows, whitening: Whitening) -> Equations:
    force, jacobian = evaluate(model, rows)
    residual = whitening((rows.force - force)[:, None])[:, 0]
    linear = jacobian.columns(~model.nonlinear)
    return *whitening.normal(linear, residual), float(residual @ residual)


def _linear_optimum(
    model: Model, equations: Equations, bounds: tuple[np.ndarray, np.ndarray]
) -> tuple[float, Model]:
    """Return the penalised sum of squares and the model, its linear parameters optimal within the bounds."""
    linear, vector = ~model.nonlinear, model.vector()
    precision = precision_of(model)[np.ix_(linear, linear)]
    away = (vector - centre_of(model))[linear]
    normal, gradient, square = equations
    normal, gradient = normal + precision, gradient - precision @ away
    low, high = (bound[linear] - vector[linear] for bound in bounds)
    step = least_squares_within(normal, gradient, low, high)
    vector[linear] += step
    cost = square + away @ precision @ away - 2 * step @ gradient + step @ normal @ step
    return float(cost), model.at(vector)


def least_squares_within(
    normal: np.ndarray, gradient: np.ndarray, low: np.ndarray, high: np.ndarray
) -> np.ndarray:
    """Return x within bounds, of least norm inside, that minimises x' normal x / 2 - gradient' x, (k,)."""
    free = np.linalg.lstsq(normal, gradient, rcond=1e-10)[0]
    inside = np.clip(free, low, high)  # stays for columns of zeros
    if np.all(inside == free):
        return free
    square = np.diag(normal)
    acts = np.flatnonzero(square > 1e-30 * square.max())
    scale = 1 / np.sqrt(square[acts])
    size, axes = np.linalg.eigh(normal[np.ix_(acts, acts)] * np.outer(scale, scale))
    kept = size > 1e-10 * size[-1]
    root, axes = np.sqrt(size[kept]), axes[:, kept]
    bounds = (low[acts] / scale, high[acts] / scale)
    target = (axes.T @ (gradient[acts] * scale)) / root
    inside[acts] = lsq_linear(root[:, None] * axes.T, target, bounds, method="bvls").x * scale
    return inside


def bounds_of(model: Model, rows: Rows) -> tuple[np.ndarray, np.ndarray]:
    """Return the lower and upper bounds of all fitted numbers, shape (model.size,) each."""
    slowest, fastest = stribeck_range(np.abs(rows.groups.means(rows.speed, "stroke")))
    days = rows.days[rows.days > 0]
    first, last = (days.min(), days.max()) if days.size else (1.0, 1.0)
    of_b = np.log(first / 1000), np.log(last * 30)
    limits = dict.fromkeys(("mu_0s", "mu_0c", "sigma_2"), (0.0, np.inf))
    limits |= {"v_s": (np.log(slowest), np.log(fastest)), "b_s": of_b, "b_c": of_b}
    declared = [limits.get(p.quantity, (-np.inf, np.inf)) for p in model.declared.parameters]
    added = [p.bounds for term in model.terms for p in term.effect.parameters]
    low, high = np.array([*declared, *added], dtype=float).T
    return low, high
