r"""One estimator for "before" and "after": generalised least squares with scatter at every level.

The weights come from the variance components (`variance_components.py`), estimated by REML. Model and scatter
are fitted alternately until they converge. Priors are in `prior.py`.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from sealfit.fit.joint import prior
from sealfit.fit.joint.model import Model, evaluate, loads_of, term_slope
from sealfit.fit.joint.rows import Cache, Rows, cached
from sealfit.fit.joint.search import descend, search_nonlinear, start_model
from sealfit.fit.joint.tangent import Tangent
from sealfit.fit.joint.variance_components import estimate_components, estimate_scatter, with_curves
from sealfit.fit.joint.whitening import GAIN, LEVELS_OF_FORCE, Scatter, Whitening

# Fall of the whitened sum of squares at which a descent ends when fits are only compared: rivals differ more.
COMPARED = 1e-2
# The same for the first fit, before the scatter is estimated.
ROUGH = 1.0
# Number of alternating fits of model and scatter; the third changes no estimate by 0.1 standard errors.
TURNS = 3
# Ratio of errors from which the scatter of specimens that differ in their curves counts as wrong. It is below
# this in 115 of 120 simulated campaigns with 3 % of scatter and v_s that differ by 10 or 20 %.
WRONG_SCATTER = 1.3
# Deviance per row by which a model is far better than that which the search on few rows has found.
WRONG_SEARCH = 1.0


@dataclass(frozen=True)
class Fitted:
    """A model fitted to rows: force, tangent and scatter at the optimum, whitened residual and tangent."""

    model: Model
    scatter: Scatter
    rows: Rows
    force: np.ndarray  # (n,)
    loads: np.ndarray  # (n, kinds) change of the force per unit of each kind of random effect
    jacobian: Tangent  # (n, p)
    white_residual: np.ndarray  # (n,)
    white_jacobian: Tangent  # (n, p)
    deviance: float  # whitened sum of squares + log det: -2 log likelihood without its constant
    whitening: Whitening  # at this scatter and friction
    cache: Cache = field(default_factory=Cache, init=False, compare=False, repr=False)

    @property
    def residual(self) -> np.ndarray:
        """Measured minus model, shape (n,)."""
        return self.rows.force - self.force

    @property
    def friction(self) -> np.ndarray:
        """Force without added forces, shape (n,): noise and gains are proportional to it."""
        return self.loads[:, GAIN]

    @property
    def rmse_N(self) -> float:
        """Root mean square of the residual; every file has the same weight."""
        return float(np.sqrt(self.rows.weight @ self.residual**2))

    @property
    def knows_specimens(self) -> bool:
        """Whether the scatter of specimens is estimated, if only as that of files with a specimen each."""
        starts = self.rows.groups.starts
        specimens, components = starts["specimen"].size, self.scatter.components
        each = any(c.kind in LEVELS_OF_FORCE and starts[c.level].size == specimens for c in components)
        return each and specimens - self.model.declared.mu_parameter_count >= 2

    @cached_property
    def basis(self) -> Tangent:
        """Orthonormal basis of the whitened tangent space without `at_limit`, of shape (n, rank)."""
        free = ~self.at_limit
        return (self.white_jacobian if free.all() else self.white_jacobian.columns(free)).orthonormal(1e-8)

    @cached_property
    def at_limit(self) -> np.ndarray:
        """Whether each fitted number is a sigma_2 of 0 that the data would make negative, shape (p,).

        The fit cannot follow the residual along it, so that it is no direction of the model.
        """
        return at_zero(self.model) & (self.white_jacobian.against(self.white_residual) < 0)

    @property
    def free_jacobian(self) -> Tangent:
        """The derivatives without those of a sigma_2 of 0, along which the fit does not follow the data."""
        return self.jacobian.columns(~at_zero(self.model))

    def refitted(self, model: Model) -> Fitted:
        """Return another model fitted to the same rows, to be compared: scatter and friction are the same."""
        return fit(model, self.rows, self.scatter, turns=0, loads=self.loads)

    def beside(self, columns: np.ndarray) -> Fitted:
        """Return this fit with whitened columns, shape (n, m), taken out of the residual.

        They are orthonormal and off the tangent space, which is the same.
        """
        own = replace(self, white_residual=self.white_residual - columns @ (columns.T @ self.white_residual))
        vars(own)["basis"] = self.basis
        own.cache.update({key: value for key, value in self.cache.items() if key[0] != "unit_residual"})
        return own

    @cached
    def slope(self, acts_on: str, operation: str) -> np.ndarray:
        """Return the force's derivative dF/dh for the shape h of a term not yet in the model, shape (n,)."""
        return term_slope(self.model, self.rows, acts_on, operation)

    @cached
    def unit_shares(self, level: str) -> tuple[np.ndarray, np.ndarray]:
        """Return eigenvalues, (g, k), and eigenvectors, (g, k, k), of each group's block of the hat matrix.

        The eigenvectors are in the coordinates of the basis columns of the group's block.
        """
        groups = np.split(self.basis.values, self.rows.groups.starts[level][1:])
        return np.linalg.eigh(np.stack([basis.T @ basis for basis in groups]))

    @cached
    def unit_residual(self, level: str) -> np.ndarray:
        """Return the whitened residual times (I - H_gg)^(-1/2) in each group of a level, shape (n,).

        H_gg is its block of the hat matrix (CR2: Bell & McCaffrey 2002, Survey Methodology 28(2), 169-181).
        """
        size, axes = self.unit_shares(level)
        size = np.clip(size, 0.0, 0.98)  # a leverage of 1 leaves no residual to correct
        grow = np.where(size > 1e-12, (1 / np.sqrt(1 - size) - 1) / np.maximum(size, 1e-12), 0.0)
        inner = self.basis.sums(self.rows.groups, level, self.white_residual).values
        back = np.einsum("gij,gj->gi", axes, np.einsum("gji,gj->gi", axes, inner) * grow)
        return self.white_residual + (self.basis.values * back[self.rows.codes(level)]).sum(axis=1)

    @cached_property
    def covariance(self) -> np.ndarray:
        """Covariance of all fitted numbers (v_s and b as logarithms), shape (p, p)."""
        return prior.covariance_of(self.white_jacobian.gram(), prior.precision_of(self.model))


def at_zero(model: Model) -> np.ndarray:
    """Return whether each fitted number is a sigma_2 of 0, its lower bound, shape (p,)."""
    quantities = [parameter.quantity for parameter in model.declared.parameters]
    found = np.zeros(model.size, dtype=bool)
    found[: len(quantities)] = (np.array(quantities) == "sigma_2") & (model.theta == 0.0)
    return found


def fit_declared(rows: Rows) -> Fitted:
    """Return the declared model fitted to `rows` ("before"); with several v_s, the better of two starts."""
    fitted = fit(start_model(rows), rows)
    if sum(p.quantity == "v_s" for p in fitted.model.declared.parameters) > 1:
        other = fit(start_model(rows, together=True), rows)
        return min(fitted, other, key=lambda f: f.deviance)
    return fitted


def fit(
    model: Model,
    rows: Rows,
    scatter: Scatter | None = None,
    *,
    turns: int = TURNS,
    loads: np.ndarray | None = None,
) -> Fitted:
    """Return the model fitted to `rows`, physics and effects together.

    `model` is the start, with v_s and b from a global search. The scatter is re-estimated and the model
    refitted `turns` times; specimens get no component of their own if the error is much smaller without one.
    With 0 the scatter is fixed, and so are the loads, shape (n, kinds), which fits to be compared must share.
    """
    centre = prior.centre_of(model)
    if scatter is None:
        scatter = Scatter(s0=max(float(np.std(rows.force)) * 0.01, 1e-12), g=0.0)
        model = descend(model, rows, scatter, centre, tolerance=ROUGH)
    if not turns:
        model = descend(model, rows, scatter, centre, loads, tolerance=COMPARED)
        return fitted_at(model, rows, scatter, loads)
    if model.terms:
        model = _searched(model, rows, scatter)
    found = _alternately(model, rows, None, centre, turns)
    if scatter := with_curves(rows, found.residual, found.loads, found.free_jacobian, found.scatter):
        other = _alternately(found.model, rows, scatter, centre, 1)
        if other.deviance > found.deviance:  # the loads of v_s depend on v_s
            other = _alternately(other.model, rows, other.scatter, centre, 1)
        found = min(found, other, key=lambda f: f.deviance)
    if _misses_levels(found):
        within = tuple(part for part in found.scatter.components if part.level != "specimen")
        other = _alternately(model, rows, replace(found.scatter, components=within), centre, turns)
        return other if other.rmse_N * WRONG_SCATTER < found.rmse_N else found
    return found


def _alternately(model: Model, rows: Rows, scatter: Scatter | None, centre: np.ndarray, turns: int) -> Fitted:
    """Return the model fitted in turns with the scatter, which has the components that it starts with."""
    for _ in range(turns):
        force, jacobian = evaluate(model, rows)
        free = jacobian.columns(~at_zero(model))
        scatter = estimate_scatter(rows, rows.force - force, loads_of(model, rows), free, scatter)
        model = descend(with_reml_smoothness(model, rows, scatter), rows, scatter, centre)
    return fitted_at(model, rows, scatter)


def _misses_levels(fitted: Fitted) -> bool:
    """Whether least squares without the scatter of specimens would leave a much smaller error."""
    parts = [part for part in fitted.scatter.components if part.level == "specimen"]
    if not any(part.variance > 0 and part.kind not in LEVELS_OF_FORCE for part in parts):
        return False
    root = np.sqrt(fitted.rows.weight)
    scaled = fitted.jacobian.with_values(fitted.jacobian.values * root[:, None])
    left = scaled.orthonormal(1e-9).project_out(root * fitted.residual)
    return float(left @ left) * WRONG_SCATTER**2 < fitted.rmse_N**2


def _searched(model: Model, rows: Rows, scatter: Scatter) -> Model:
    """Return the model from a search on few rows, or the model itself if that is far better on all rows."""
    found = search_nonlinear(model, rows, scatter)
    kept, own = (fitted_at(m, rows, scatter) for m in (model, found))
    return model if kept.deviance + WRONG_SEARCH * rows.force.size < own.deviance else found


def fitted_at(model: Model, rows: Rows, scatter: Scatter, loads: np.ndarray | None = None) -> Fitted:
    """Return the `Fitted` of a model without refitting."""
    force, jacobian = evaluate(model, rows)
    loads = loads_of(model, rows) if loads is None else loads
    whitening = Whitening(scatter, loads, rows.groups)
    residual, white = whitening((rows.force - force)[:, None])[:, 0], whitening.of(jacobian)
    deviance = float(residual @ residual) + whitening.logdet
    return Fitted(model, scatter, rows, force, loads, jacobian, residual, white, deviance, whitening)


def reestimated(fitted: Fitted, *, noise: bool = False) -> Fitted:
    """Return a fit with variance components, and row noise if wanted, re-estimated from its own residual.

    An effect that a model lacks inflates its components, under which all models fit about equally well. Fits
    to be compared share the friction, which is kept, and the row noise of the best fit.
    """
    rows, estimate = fitted.rows, estimate_scatter if noise else estimate_components
    scatter = estimate(rows, fitted.residual, fitted.loads, fitted.free_jacobian, fitted.scatter)
    model = with_reml_smoothness(fitted.model, rows, scatter, fitted.loads)
    model = descend(model, rows, scatter, prior.centre_of(model), fitted.loads, tolerance=COMPARED)
    return fitted_at(model, rows, scatter, fitted.loads)


def effective_df(fitted: Fitted, number: int) -> float:
    """Return the effective degrees of freedom of a term's free shape at its smoothness."""
    model, white = fitted.model, fitted.white_jacobian
    place = model.term_slice(number)
    own, pull = prior.free_of_others(model, white.gram(), white.against(fitted.white_residual), place)
    return prior.penalised(own, pull, prior.precision_of(model)[place, place])[1]


def with_reml_smoothness(
    model: Model, rows: Rows, scatter: Scatter, loads: np.ndarray | None = None
) -> Model:
    """Return the model with the smoothness of its free shapes estimated by REML under this scatter."""
    if all(term.smoothness is None for term in model.terms):
        return model
    at = fitted_at(model, rows, scatter, loads)
    return prior.smoothed(model, at.white_jacobian.gram(), at.white_jacobian.against(at.white_residual))
