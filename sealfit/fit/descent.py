"""The way down: Levenberg-Marquardt on the whitened residual, and a grid over v_s and b for what lies behind a hill."""

from __future__ import annotations

import numpy as np
from scipy.optimize import lsq_linear

from sealfit.fit.joint import Model, evaluate, friction_of
from sealfit.fit.prior import centre_of, precision_of
from sealfit.fit.rows import Rows
from sealfit.fit.start import stribeck_range
from sealfit.fit.whitening import Scatter, Whitening

MAX_STEPS = 60
GRID = 12  # points of log v_s and log b tried when an effect has come in
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
    whitening = Whitening(scatter, rows.force, rows.groups)
    quantities = [p.quantity for p in model.declared.parameters]
    stribeck = [k for k, name in enumerate(quantities) if name == "v_s"]
    if stribeck:
        model = _best_on_grid(model, rows, whitening, stribeck)
    for number in stribeck if len(stribeck) > 1 else ():
        model = _best_on_grid(model, rows, whitening, [number])
    laws = [k for k, name in enumerate(quantities) if name in ("b_s", "b_c")]
    return _best_on_grid(model, rows, whitening, laws) if laws else model


def _best_on_grid(model: Model, rows: Rows, whitening: Whitening, group: list[int]) -> Model:
    """Return the model with the numbers of a group, equal to one another, at the best of a few values or as it is."""
    low, high = bounds_of(model, rows)
    prior = _linear_prior(model)
    best, chosen = _linear_solved(model, *prior, rows, whitening)
    for value in np.linspace(low[group[0]], high[group[0]], GRID):
        vector = model.vector()
        vector[group] = value
        cost, solved = _linear_solved(model.at(vector), *prior, rows, whitening)
        if cost < best - 1e-9:
            best, chosen = cost, solved
    return model.at(np.clip(chosen.vector(), low, high))


def linear_solved(model: Model, rows: Rows, scatter: Scatter, friction: np.ndarray) -> Model:
    """Return the model with all that acts linearly solved for, v_s, b and the effects' own numbers where they stand.

    A term that has just come in takes over what others had explained for it: until they have given that back, a
    descent throws the rest anywhere.
    """
    low, high = bounds_of(model, rows)
    solved = _linear_solved(model, *_linear_prior(model), rows, Whitening(scatter, friction, rows.groups))[1]
    return model.at(np.clip(solved.vector(), low, high))


def _linear_prior(model: Model) -> tuple[np.ndarray, np.ndarray]:
    """Return the prior's precision of the numbers that act linearly, and where it lies."""
    linear = ~model.bent
    return precision_of(model)[np.ix_(linear, linear)], centre_of(model)[linear]


def _linear_solved(
    model: Model, precision: np.ndarray, centre: np.ndarray, rows: Rows, whitening: Whitening
) -> tuple[float, Model]:
    """Return the whitened sum of squares left, and the model, its linear numbers solved for at once in their bounds.

    Without the bounds, a v_s far off can seem the best, with a negative friction that the fit cannot have.
    """
    force, jacobian = evaluate(model, rows)
    residual = whitening((rows.force - force)[:, None])[:, 0]
    linear = ~model.bent  # one step far from the optimum would throw the others anywhere
    normal, gradient = whitening.normal(jacobian.columns(linear), residual)
    vector = model.vector()
    away = vector[linear] - centre
    normal, gradient = normal + precision, gradient - precision @ away
    low, high = (bound[linear] - vector[linear] for bound in bounds_of(model, rows))
    step = least_squares_within(normal, gradient, low, high)
    vector[linear] += step
    left = residual @ residual + away @ precision @ away - 2 * step @ gradient + step @ normal @ step
    return float(left), model.at(vector)


def least_squares_within(normal: np.ndarray, gradient: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return the x between bounds that minimises x' normal x / 2 - gradient' x, shape (k,)."""
    step, *_ = np.linalg.lstsq(normal, gradient, rcond=1e-10)
    if np.all((step >= low) & (step <= high)):
        return step
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
