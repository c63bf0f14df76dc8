"""Where the joint fit starts and how it descends: a global search of v_s and b, then Levenberg-Marquardt."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.optimize import lsq_linear

from sealfit.fit.joint.declared import SAME_SPEED, JointParameter, declare
from sealfit.fit.joint.model import Model, evaluate, friction_of
from sealfit.fit.joint.prior import centre_of, precision_of
from sealfit.fit.joint.rows import Rows
from sealfit.fit.joint.whitening import Scatter, Whitening

# ---------------------------------------------------------------- descent
# The way down: Levenberg-Marquardt on the whitened residual, and a grid over v_s and b for what lies behind a hill.

MAX_STEPS = 60
GRID_POINTS = 12  # points of log v_s and log b tried when an effect has come in
ROWS_FOR_START = 4  # of each stroke: v_s acts on a stroke as a whole
CREEPING = 1e-2  # several such steps in a row go along a valley in which the data hold nothing
SETTLED = 1e-4  # of the whitened sum of squares: the estimates then lie within a hundredth of a standard error


def descend(
    model: Model,
    rows: Rows,
    scatter: Scatter,
    centre: np.ndarray,
    friction: np.ndarray | None = None,
    *,
    near: float = SETTLED,
) -> Model:
    """Return the model at the least whitened sum of squares, by Levenberg-Marquardt with the scatter held fixed.

    It ends where a step gains less than `near`.
    """
    precision = precision_of(model)
    low, high = bounds_of(model, rows)
    vector = np.clip(model.vector(), low, high)
    model = model.at(vector)
    force, jacobian = evaluate(model, rows)
    if friction is None:
        friction = friction_of(model, rows)  # held, so that the criterion does not move under the search

    whitening = Whitening(scatter, friction, rows.groups)

    def cost_of(residual: np.ndarray, at: np.ndarray) -> float:
        return float(residual @ residual + (at - centre) @ precision @ (at - centre))

    residual = whitening((rows.force - force)[:, None])[:, 0]
    cost = cost_of(residual, vector)
    damping, crept = 1e-4, 0
    for _ in range(MAX_STEPS):
        normal, gradient = whitening.normal(jacobian, residual)
        gradient = gradient - precision @ (vector - centre)
        normal = normal + precision
        blocked = ((vector <= low) & (gradient < 0)) | ((vector >= high) & (gradient > 0))
        free = ~blocked & (np.diag(normal) > 0)
        scale = np.sqrt(np.diag(normal)[free])
        scaled = normal[np.ix_(free, free)] / np.outer(scale, scale)
        for _ in range(12):
            move = np.zeros_like(vector)
            move[free] = (
                np.linalg.solve(scaled + (damping + 1e-12) * np.eye(scale.size), gradient[free] / scale) / scale
            )
            trial = np.clip(vector + move, low, high)
            trial_model = model.at(trial)
            trial_force, _none = evaluate(trial_model, rows, jacobian=False)
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
        crept = crept + 1 if gain < CREEPING else 0
        if crept > 3 or (gain < near and damping < 1e-3):  # a step under heavy damping gains little anywhere
            return model
        _, jacobian = evaluate(model, rows)
    return model


def search_nonlinear(model: Model, rows: Rows, scatter: Scatter) -> Model:
    """Return the model with each v_s, and all b together, at the best point of a grid, what is linear solved anew.

    What an effect explains may have stood in them before, and the way out of there can lead over a hill. Series share
    mu_0, so that one v_s alone may not get out: all are tried together first, then each by itself.
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
    """Return the model with the numbers of a group, equal to one another, at the best of a few values or as it is.

    Rows on which the group does not act are summed once.
    """
    low, high = bounds_of(model, rows)
    prior = _linear_prior(model)
    held = np.diag(precision_of(model))[group]  # where the data hold nothing, v_s stays where it stands
    moving, still = _parted(model, rows, group)
    whitening = Whitening(scatter, moving.force, moving.groups)
    rest = None if still is None else _equations(model, still, Whitening(scatter, still.force, still.groups))

    def solved_at(at: Model, most: float = np.inf) -> tuple[float, Model]:
        own = _equations(at, moving, whitening)
        return _solve_linear(at, own if rest is None else own.plus(rest), *prior, (low, high), most=most)

    best, chosen = solved_at(model)
    for value in np.linspace(low[group[0]], high[group[0]], GRID_POINTS):
        vector = model.vector()
        away = value - vector[group]
        vector[group] = value
        pull = float(held @ away**2)
        cost, solved = solved_at(model.at(vector), best - pull)
        cost += pull
        if cost < best - 1e-9:
            best, chosen = cost, solved
    return model.at(np.clip(chosen.vector(), low, high))


def _parted(model: Model, rows: Rows, group: list[int]) -> tuple[Rows, Rows | None]:
    """Return the rows that numbers of the declared model act on, and the others; all and None where they do not part.

    Rows of one specimen are not independent and stay together.
    """
    acts = np.any([np.isin(numbers, group) for numbers in model.declared.index.values()], axis=0)[rows.condition]
    specimen = rows.codes("specimen")
    acts = (np.bincount(specimen, acts) > 0)[specimen]
    if acts.all() or not acts.any():
        return rows, None
    key = ("parted", acts.tobytes())
    if key not in rows.cache:
        rows.cache[key] = (rows.subset(acts), rows.subset(~acts))
    return rows.cache[key]


def solve_linear(model: Model, rows: Rows, scatter: Scatter, friction: np.ndarray) -> Model:
    """Return the model with all that acts linearly solved for, v_s, b and the effects' own numbers where they stand.

    A term that has just come in takes over what others had explained for it: until they have given that back, a
    descent throws the rest anywhere.
    """
    low, high = bounds_of(model, rows)
    equations = _equations(model, rows, Whitening(scatter, friction, rows.groups))
    solved = _solve_linear(model, equations, *_linear_prior(model), (low, high))[1]
    return model.at(np.clip(solved.vector(), low, high))


def _linear_prior(model: Model) -> tuple[np.ndarray, np.ndarray]:
    """Return the prior's precision of the numbers that act linearly, and where it lies."""
    linear = ~model.nonlinear
    return precision_of(model)[np.ix_(linear, linear)], centre_of(model)[linear]


class _Equations(NamedTuple):
    """Normal equations of the numbers that act linearly, and the whitened sum of squares before they are solved."""

    normal: np.ndarray  # (k, k)
    gradient: np.ndarray  # (k,)
    square: float

    def plus(self, other: _Equations) -> _Equations:
        """Return the equations of these rows and of others that are independent of them."""
        return _Equations(self.normal + other.normal, self.gradient + other.gradient, self.square + other.square)


def _equations(model: Model, rows: Rows, whitening: Whitening) -> _Equations:
    force, jacobian = evaluate(model, rows)
    residual = whitening((rows.force - force)[:, None])[:, 0]
    linear = ~model.nonlinear  # one step far from the optimum would throw the others anywhere
    return _Equations(*whitening.normal(jacobian.columns(linear), residual), float(residual @ residual))


def _solve_linear(
    model: Model,
    equations: _Equations,
    precision: np.ndarray,
    centre: np.ndarray,
    bounds: tuple[np.ndarray, np.ndarray],
    *,
    most: float = np.inf,
) -> tuple[float, Model]:
    """Return the whitened sum of squares left, and the model, its linear numbers solved for at once in their bounds.

    Without the bounds, a v_s far off can seem the best, with a negative friction that the fit cannot have. Bounds only
    add to what is left: where that is more than `most` without them, they are not asked.
    """
    linear, vector = ~model.nonlinear, model.vector()
    away = vector[linear] - centre
    normal, gradient = equations.normal + precision, equations.gradient - precision @ away
    low, high = (bound[linear] - vector[linear] for bound in bounds)
    there = equations.square + float(away @ precision @ away)

    def left(step: np.ndarray) -> float:
        return there - 2 * float(step @ gradient) + float(step @ normal @ step)

    step = least_squares(normal, gradient)
    if left(step) < most:
        step = least_squares_within(normal, gradient, low, high, step)
    vector[linear] += step
    return left(step), model.at(vector)


def least_squares(normal: np.ndarray, gradient: np.ndarray) -> np.ndarray:
    """Return the smallest x that minimises x' normal x / 2 - gradient' x, shape (k,)."""
    return np.linalg.lstsq(normal, gradient, rcond=1e-10)[0]


def least_squares_within(
    normal: np.ndarray, gradient: np.ndarray, low: np.ndarray, high: np.ndarray, free: np.ndarray
) -> np.ndarray:
    """Return the x between bounds that does so, shape (k,), from `free`, the x that does so without them."""
    if np.all((free >= low) & (free <= high)):
        return free
    square = np.diag(normal)
    acts = square > 1e-30 * square.max()  # a column that does nothing keeps its scale
    scale = 1 / np.sqrt(np.where(acts, square, 1.0))
    size, axes = np.linalg.eigh(normal * np.outer(scale, scale))
    kept = size > 1e-10 * size[-1]
    root, axes = np.sqrt(size[kept]), axes[:, kept]
    inside = lsq_linear(root[:, None] * axes.T, (axes.T @ (gradient * scale)) / root, (low / scale, high / scale))
    return inside.x * scale


def bounds_of(model: Model, rows: Rows) -> tuple[np.ndarray, np.ndarray]:
    """Return the least and greatest value of each fitted number, each of shape (model.size,)."""
    slowest, fastest = stribeck_range(np.abs(rows.groups.means(rows.speed, "stroke")))
    days = rows.days[rows.days > 0]
    first, last = (days.min(), days.max()) if days.size else (1.0, 1.0)
    limits = {
        "mu_0s": (0.0, np.inf),
        "mu_0c": (0.0, np.inf),
        "sigma_2": (0.0, np.inf),
        "v_s": (np.log(slowest), np.log(fastest)),
        "b_s": (np.log(first / 1000), np.log(last * 30)),
        "b_c": (np.log(first / 1000), np.log(last * 30)),
    }
    low = [limits.get(p.quantity, (-np.inf, np.inf))[0] for p in model.declared.parameters]
    high = [limits.get(p.quantity, (-np.inf, np.inf))[1] for p in model.declared.parameters]
    for term in model.terms:
        low += [p.bounds[0] for p in term.effect.parameters]
        high += [p.bounds[1] for p in term.effect.parameters]
    return np.array(low, dtype=float), np.array(high, dtype=float)


# ---------------------------------------------------------------- start
# Where the joint fit starts: a global search of v_s and b, everything linear exact.

GRID = 80  # values of v_s

EQUAL = 1e-10
"""Of the sum of squares of the forces, within which values of v_s fit equally well; the middle one of them is taken."""

RANK = 1e-10  # of the largest singular value, below which columns are as good as dependent


def start_model(rows: Rows, *, together: bool = False) -> Model:
    """Return the declared model with v_s and b from a global search and the rest from exact least squares.

    With `together`, all series start from one v_s and one sigma_2, which a few noisy runs cannot lead astray.
    """
    declared = declare(rows)
    theta = np.zeros(len(declared.parameters))
    number = {p: k for k, p in enumerate(declared.parameters)}
    speeds = np.abs(rows.groups.means(rows.speed, "stroke"))
    at = rows.groups.starts["stroke"]
    condition = rows.condition[at]
    load = rows.groups.means(rows.load, "stroke")
    size = rows.groups.means(rows.force * np.sign(rows.speed), "stroke")
    series = sorted({p.owner for p in declared.parameters if p.quantity in ("v_s", "sigma_2")})
    level = np.zeros((len(declared.conditions), 2))  # mu_s, mu_c of each condition
    chosen = np.zeros(len(declared.conditions), dtype=bool)
    curved = declared.index["v_s"] >= 0
    solved: dict[bytes, tuple] = {}  # together, all series of a kind ask the same
    for name in series:
        k = number.get(JointParameter("sigma_2", name), number.get(JointParameter("v_s", name)))
        full = JointParameter("v_s", name) in number
        uses = curved if together and full else (declared.index["sigma_2"] == k) | (declared.index["v_s"] == k)
        if uses.tobytes() not in solved:
            mine = uses[condition]
            solved[uses.tobytes()] = _per_condition(speeds[mine], load[mine], size[mine], condition[mine], full)
        values, sigma_2, v_s = solved[uses.tobytes()]
        for c, pair in values.items():
            level[c], chosen[c] = pair, True
        theta[k if not full else number[JointParameter("sigma_2", name)]] = sigma_2
        if full:
            theta[number[JointParameter("v_s", name)]] = np.log(v_s)
    for c in np.flatnonzero(~chosen):
        mine = condition == c
        level[c] = np.mean(size[mine] / load[mine])
    days = rows.conditions["aging_days"].to_numpy()
    for column, end in ((0, "s"), (1, "c")):
        index_0, index_a, index_b = (
            declared.index[f"{q}_{end}" if q != "mu_0" else f"mu_0{end}"] for q in ("mu_0", "a", "b")
        )
        for k in np.unique(index_0[(index_0 >= 0)]):
            mine = index_0 == k
            unaged = mine & (days == days[mine].min())
            theta[k] = level[unaged, column].mean()
        for k in np.unique(index_a[index_a >= 0]):
            mine = index_a == k
            mu_0 = theta[index_0[mine][0]]
            drop = mu_0 - level[mine, column]
            grid = np.geomspace(days[days > 0].min() / 100, days.max() * 3, 60)
            log = np.log1p(days[mine][:, None] / grid)
            a = (log * drop[:, None]).sum(0) / np.maximum((log**2).sum(0), 1e-300)
            best = int(np.argmin(((drop[:, None] - a * log) ** 2).sum(0)))
            theta[k] = a[best]
            theta[index_b[mine][0]] = np.log(grid[best])
    return Model(declared, theta)


def _per_condition(speed, load, size, condition, full: bool):
    """Return {condition: (mu_s, mu_c)}, sigma_2 and v_s of one series by a grid over v_s, the rest exact."""
    own, code = np.unique(condition, return_inverse=True)
    grid = np.geomspace(*stribeck_range(speed), GRID) if full else np.array([1.0])
    solved, costs = [], []
    for v_s in grid:
        decay = np.exp(-((speed / v_s) ** 2)) if full else np.zeros_like(speed)
        columns = (load * decay, load * (1 - decay))
        pairs, sigma_2 = pairs_and_shared(columns, code, speed, size)
        first, second = pairs.T
        left = size - first[code] * columns[0] - second[code] * columns[1] - sigma_2 * speed
        costs.append(float(left @ left))
        solved.append((pairs, sigma_2, v_s))
    alike = np.flatnonzero(np.array(costs) <= min(costs) + EQUAL * float(size @ size))
    pairs, sigma_2, v_s = solved[alike[alike.size // 2]]
    mu_s, mu_c = pairs.T if full else (pairs[:, 1], pairs[:, 1])
    return {int(c): (s, k) for c, s, k in zip(own, mu_s, mu_c, strict=True)}, float(sigma_2), float(v_s)


def pairs_and_shared(
    columns: tuple[np.ndarray, np.ndarray], code: np.ndarray, shared: np.ndarray, values: np.ndarray
) -> tuple[np.ndarray, float]:
    """Return the least squares of two numbers per group and one, not below 0, that all share; the smallest of many.

    Each group's two columns are made orthogonal and taken out, which leaves one equation for the shared number.

    Parameters
    ----------
    columns : tuple of ndarray, shape (n,) each
        What a group's own numbers multiply.
    code : ndarray, shape (n,)
        Group of each value, from 0 on.
    shared, values : ndarray, shape (n,)
        What the shared number multiplies; the values.

    Returns
    -------
    tuple
        Pairs, shape (groups, 2), and the shared number.
    """
    one, length = _unit(columns[0], code)
    along = np.bincount(code, one * columns[1])
    two, rest = _unit(columns[1] - along[code] * one, code)
    triangle = np.zeros((length.size, 2, 2))
    triangle[:, 0, 0], triangle[:, 0, 1], triangle[:, 1, 1] = length, along, rest
    left, spread, right = np.linalg.svd(triangle)
    least = RANK * max(float(spread.max()), float(np.linalg.norm(shared)), 1e-300)
    inverse = np.divide(1.0, spread, out=np.zeros_like(spread), where=spread > least)

    def taken(column: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return a column's coefficients on the groups' own, shape (groups, 2), and what is left of it."""
        inside = np.column_stack([np.bincount(code, one * column), np.bincount(code, two * column)])
        pairs = np.einsum("gji,gj->gi", right, np.einsum("gji,gj->gi", left, inside) * inverse)
        first, second = pairs.T
        return pairs, column - first[code] * columns[0] - second[code] * columns[1]

    of_shared, shared_left = taken(shared)
    of_values, values_left = taken(values)
    square = float(shared_left @ shared_left)
    if np.sqrt(square) > least:
        number = float(shared_left @ values_left) / square
    else:
        number = float((of_values * of_shared).sum()) / (1.0 + float((of_shared**2).sum()))
    number = max(number, 0.0)
    return of_values - number * of_shared, number


def _unit(column: np.ndarray, code: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return a column made of length 1 in each group, and its lengths; zeros stay."""
    length = np.sqrt(np.bincount(code, column**2))
    return column * np.divide(1.0, length, out=np.zeros_like(length), where=length > 0)[code], length


def stribeck_range(speeds: np.ndarray) -> tuple[float, float]:
    """Return where v_s is looked for: from half the second slowest speed to the fastest.

    Below that range only the slowest speed would see mu_s, which could then be any size; above it the exponential is a
    parabola that sigma_2 and mu_c make as well (v_s needs two speeds below about 2 v_s).
    """
    positive = np.sort(speeds[speeds > 0])
    above = positive[positive > SAME_SPEED * positive[0]]
    second = above[0] if above.size else positive[0]
    return float(second / 2), float(positive[-1])
