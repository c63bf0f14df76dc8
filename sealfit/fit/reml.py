r"""The size of scatter at several nested levels, by restricted maximum likelihood (REML), with its exact gradient.

With B = [1, F] the loadings of offset and gain, :math:`K_l` their variances at level l, and V_l the covariance up to
that level, Woodbury's identity gives for each group

.. math:: B^T V_l^{-1} B = Q - Q M Q, \quad M = K^{1/2} (1 + K^{1/2} Q K^{1/2})^{-1} K^{1/2},
          \quad Q = \sum_\mathrm{inside} B^T V_{l-1}^{-1} B

so that nothing larger than 2 x 2 is inverted: from the finest level up for the likelihood, and down again for the
traces in its gradient.

Searle, Casella & McCulloch 1992, *Variance Components*, doi:10.1002/9780470316856, chapter 6.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.linalg import solve_triangular
from scipy.optimize import minimize

from sealfit.fit.groups import Groups
from sealfit.fit.whitening import Component

REVIVED = 0.03  # share at which a component starts though it was nothing before: from zero it could not come back
MOST_GAIN = 0.5  # no rig's gain scatters more: a model near zero with gains of any size would fit every force
KINDS = ("offset", "gain")


def reml(
    residual: np.ndarray,
    jacobian: np.ndarray,
    variance: np.ndarray,
    force: np.ndarray,
    groups: Groups,
    kinds: Sequence[tuple[str, str]],
    start: Sequence[float] | None = None,
) -> tuple[Component, ...]:
    """Return the variance components of group means by restricted maximum likelihood.

    Parameters
    ----------
    residual : ndarray, shape (m,)
        Mean residual of each finest group, at the fitted model.
    jacobian : ndarray, shape (m, p)
        Mean tangent of the model; the degrees of freedom it takes are accounted for.
    variance : ndarray, shape (m,)
        Variance of each mean from the rows' own noise.
    force : ndarray, shape (m,)
        Mean force of the model, signed.
    groups : Groups
        Groups of the m means.
    kinds : sequence of (level, kind)
        Components sought, finest level first.
    start : sequence of float, optional
        Variances to start from.
    """
    if not kinds:
        return ()
    scale_force = max(float(np.sqrt(np.mean(force**2))), 1e-12)
    total = max(float(np.var(residual)), float(np.mean(variance)), 1e-20)
    unit = np.array([total / (scale_force**2 if kind == "gain" else 1.0) for _, kind in kinds])
    basis = orthonormal(jacobian / np.maximum(np.linalg.norm(jacobian, axis=0), 1e-300))
    likelihood = RestrictedLikelihood(residual, basis, variance, force, groups, kinds)

    def objective(log_share: np.ndarray) -> tuple[float, np.ndarray]:
        value, gradient = likelihood(unit * np.exp(log_share))
        return value, gradient * unit * np.exp(log_share)

    low = np.log(1e-7)
    high = np.log(
        [min(30.0, MOST_GAIN**2 / u) if kind == "gain" else 30.0 for u, (_, kind) in zip(unit, kinds, strict=True)]
    )
    high = np.maximum(high, low + 2.0)
    first = np.full(len(kinds), np.log(0.2)) if start is None else np.log(np.maximum(np.asarray(start) / unit, REVIVED))
    best = minimize(
        objective,
        np.clip(first, low + 1.0, high - 1.0),
        jac=True,
        method="L-BFGS-B",
        bounds=[(low, most) for most in high],
        options={"maxiter": 40, "ftol": 1e-6},
    )
    share = np.exp(best.x)
    variances = np.where(share > 1e-5, unit * share, 0.0)
    return tuple(Component(level, kind, float(v)) for (level, kind), v in zip(kinds, variances, strict=True))


class RestrictedLikelihood:
    """Half the restricted deviance of group means, and its gradient, as functions of the variances.

    Parameters
    ----------
    residual, variance, force : ndarray, shape (m,)
        As for `reml`.
    basis : ndarray, shape (m, p)
        Columns of full rank that span the model's tangent.
    groups : Groups
        Groups of the m means.
    kinds : sequence of (level, kind)
        Components, finest level first.
    """

    def __init__(
        self,
        residual: np.ndarray,
        basis: np.ndarray,
        variance: np.ndarray,
        force: np.ndarray,
        groups: Groups,
        kinds: Sequence[tuple[str, str]],
    ) -> None:
        self.variance = variance
        self.columns = np.column_stack([basis, residual])
        self.loads = np.column_stack([np.ones_like(force), force])
        self.places = [(level, KINDS.index(kind)) for level, kind in kinds]
        self.finest = next(iter(groups.starts))
        self.above = list(dict.fromkeys(level for level, _ in kinds if level != self.finest))
        self.groups = {}  # level -> (first finer group in each group, group of each finer group)
        finer = groups.starts[self.finest]
        for level in self.above:
            own = np.searchsorted(finer, groups.starts[level])
            self.groups[level] = (own, groups.codes[level][finer])
            finer = groups.starts[level]

    def __call__(self, variances: np.ndarray) -> tuple[float, np.ndarray]:
        """Return the value and its derivative with respect to each variance, shape (kinds,)."""
        size = {level: np.zeros(2) for level in (self.finest, *self.above)}
        for (level, k), v in zip(self.places, variances, strict=True):
            size[level][k] = v
        own = self.variance + self.loads**2 @ size[self.finest]
        loads, columns = self.loads / own[:, None], self.columns / own[:, None]
        square = loads[:, :, None] * self.loads[:, None, :]  # B' V^-1 B, (groups, 2, 2)
        cross = loads[:, :, None] * self.columns[:, None, :]  # B' V^-1 [X r], (groups, 2, p + 1)
        gram = self.columns.T @ columns
        value = float(np.log(own).sum())
        steps = [(square, cross)]
        inner = []
        for level in self.above:
            start, _ = self.groups[level]
            q, t = np.add.reduceat(square, start), np.add.reduceat(cross, start)
            root = np.sqrt(size[level])
            m, logdet = _inverse(np.eye(2) + root[:, None] * q * root)
            m *= root[:, None] * root
            mt = np.einsum("gij,gjk->gik", m, t)
            value += float(logdet.sum())
            gram -= t.reshape(-1, t.shape[2]).T @ mt.reshape(-1, t.shape[2])
            mq = np.einsum("gij,gjk->gik", m, q)
            inner.append((m, mt, np.eye(2) - mq))
            square = q - np.einsum("gij,gjk->gik", q, mq)
            cross = t - np.einsum("gij,gjk->gik", q, mt)
            steps.append((square, cross))
        chol = np.linalg.cholesky(gram[:-1, :-1] + 1e-12 * np.eye(gram.shape[0] - 1))
        half = solve_triangular(chol, gram[:-1, -1], lower=True)
        value += 2.0 * float(np.log(np.diag(chol)).sum()) + float(gram[-1, -1] - half @ half)
        # Columns that are orthonormal under V, and what is left of the residual: the gradient is in their loads.
        turn = np.zeros_like(gram)
        turn[:-1, :-1] = solve_triangular(chol, np.eye(half.size), lower=True).T
        turn[:-1, -1], turn[-1, -1] = -turn[:-1, :-1] @ half, 1.0
        slope = {}
        n = y = None
        for k in reversed(range(len(steps))):
            square, cross = steps[k]
            if k < len(self.above):
                m, mt, left = inner[k]
                if n is None:
                    n, y = m, mt
                else:
                    code = self.groups[self.above[k + 1]][1]
                    n = m + np.einsum("gij,gjk,glk->gil", left, n[code], left)
                    y = mt + np.einsum("gij,gjk->gik", left, y[code])
                code = self.groups[self.above[k]][1]
                cross = cross - np.einsum("gij,gjk->gik", square, y[code])
                square = square - np.einsum("gij,gjk,gkl->gil", square, n[code], square)
            turned = (cross.reshape(-1, cross.shape[2]) @ turn).reshape(cross.shape)
            level = self.above[k - 1] if k else self.finest
            slope[level] = np.einsum("gii->i", square) - np.einsum("gik,gik->i", turned, turned)
        return 0.5 * value, 0.5 * np.array([slope[level][k] for level, k in self.places])


def _inverse(a: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the inverse and log determinant of symmetric positive 2 x 2 matrices, shapes (g, 2, 2) and (g,)."""
    det = a[:, 0, 0] * a[:, 1, 1] - a[:, 0, 1] * a[:, 1, 0]
    turned = np.empty_like(a)
    turned[:, 0, 0], turned[:, 1, 1] = a[:, 1, 1], a[:, 0, 0]
    turned[:, 0, 1], turned[:, 1, 0] = -a[:, 0, 1], -a[:, 1, 0]
    return turned / det[:, None, None], np.log(det)


def orthonormal(columns: np.ndarray, tolerance: float = 1e-9) -> np.ndarray:
    """Return an orthonormal basis of the columns' span, shape (m, rank)."""
    left, size, _ = np.linalg.svd(columns, full_matrices=False)
    return left[:, size > tolerance * max(size.max(initial=0.0), 1e-300)]
