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
from scipy.sparse import csr_array

from sealfit.fit.groups import Groups
from sealfit.fit.tangent import Tangent
from sealfit.fit.whitening import Component

REVIVED = 0.03  # share at which a component starts though it was nothing before: from zero it could not come back
MOST_GAIN = 0.5  # no rig's gain scatters more: a model near zero with gains of any size would fit every force
LEAST = 1e-5  # share of all scatter below which a component is nothing
MOST_SHARE = 30.0  # of the residual, of which the model has taken much where it has nearly as many numbers
KINDS = ("offset", "gain")


def reml(
    residual: np.ndarray,
    jacobian: Tangent,
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
    jacobian : Tangent, shape (m, p)
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
    basis = jacobian.orthonormal(1e-9)
    variance = np.maximum(variance, LEAST * total)  # less is nothing beside the scatter, and rounding would be more
    likelihood = RestrictedLikelihood(residual, basis, variance, force, groups, kinds)

    def objective(sd: np.ndarray) -> tuple[float, np.ndarray]:
        value, gradient = likelihood(unit * sd**2)
        return value, 2.0 * gradient * unit * sd

    most = [MOST_GAIN**2 / u if kind == "gain" else np.inf for u, (_, kind) in zip(unit, kinds, strict=True)]
    high = np.sqrt(np.clip(most, LEAST, MOST_SHARE))
    first = np.full(len(kinds), 0.2) if start is None else np.maximum(np.asarray(start) / unit, REVIVED)
    # Over standard deviations: a component that is nothing is a minimum at 0 there, over logarithms an endless slope.
    best = minimize(
        objective,
        np.minimum(np.sqrt(first), 0.6 * high),
        jac=True,
        method="L-BFGS-B",
        bounds=[(0.0, most) for most in high],
        options={"maxiter": 200, "ftol": 1e-10},  # far below what rounding in the residual should move
    )
    share = best.x**2
    variances = np.where(share > LEAST, unit * share, 0.0)
    return tuple(Component(level, kind, float(v)) for (level, kind), v in zip(kinds, variances, strict=True))


class RestrictedLikelihood:
    """Half the restricted deviance of group means, and its gradient, as functions of the variances.

    Parameters
    ----------
    residual, variance, force : ndarray, shape (m,)
        As for `reml`.
    basis : Tangent, shape (m, p)
        Orthonormal columns that span the model's tangent.
    groups : Groups
        Groups of the m means.
    kinds : sequence of (level, kind)
        Components, finest level first.
    """

    def __init__(
        self,
        residual: np.ndarray,
        basis: Tangent,
        variance: np.ndarray,
        force: np.ndarray,
        groups: Groups,
        kinds: Sequence[tuple[str, str]],
    ) -> None:
        self.variance = variance
        every = basis.beside(residual)
        self.columns = every.values
        self.loads = np.column_stack([np.ones_like(force), force])
        self.places = [(level, KINDS.index(kind)) for level, kind in kinds]
        self.finest = next(iter(groups.starts))
        self.above = list(dict.fromkeys(level for level, _ in kinds if level != self.finest))
        self.groups = {}  # level -> (what sums the finer groups in each group, group of each finer group)
        self.layout = {self.finest: every.layout}
        finer = groups.starts[self.finest]
        for level in self.above:
            own = np.searchsorted(finer, groups.starts[level])
            summing = csr_array((np.ones(finer.size), np.arange(finer.size), np.r_[own, finer.size]))
            self.groups[level] = (summing, groups.codes[level][finer])
            finer = groups.starts[level]
            self.layout[level] = every.layout.of(finer)

    def __call__(self, variances: np.ndarray) -> tuple[float, np.ndarray]:
        """Return the value and its derivative with respect to each variance, shape (kinds,)."""
        size = {level: np.zeros(2) for level in (self.finest, *self.above)}
        for (level, k), v in zip(self.places, variances, strict=True):
            size[level][k] = v
        own = self.variance + self.loads**2 @ size[self.finest]
        loads, columns = self.loads / own[:, None], self.columns / own[:, None]
        square = (loads[:, 0], loads[:, 1], loads[:, 1] * self.loads[:, 1])  # B' V^-1 B: 11, 12 and 22, each (groups,)
        cross = (columns, columns * self.loads[:, 1:])  # B' V^-1 [X r], a row of each, (groups, p + 1)
        gram = self.layout[self.finest].gram(self.columns, columns)
        value = float(np.log(own).sum())
        steps = [(square, cross)]
        inner = []
        for level in self.above:
            summing, _ = self.groups[level]
            q = tuple(summing @ part for part in square)
            t = tuple(summing @ part for part in cross)
            m, logdet = _shrinkage(q, size[level])
            mt = _applied(m, t)
            value += float(logdet.sum())
            gram -= self.layout[level].gram(t[0], mt[0]) + self.layout[level].gram(t[1], mt[1])
            mq = _product(m, q)
            left = (1.0 - mq[0], -mq[1], -mq[2], 1.0 - mq[3])
            inner.append((m, mt, left))
            # q - q m q and t - q m t: what is left between the groups of this level
            square = (q[0] * left[0] + q[1] * left[2], q[0] * left[1] + q[1] * left[3], q[1] * left[1] + q[2] * left[3])
            cross = tuple(x - y for x, y in zip(t, _applied(q, mt), strict=True))
            steps.append((square, cross))
        chol = _root_of(gram[:-1, :-1])
        half = solve_triangular(chol, gram[:-1, -1], lower=True)
        value += 2.0 * float(np.log(np.diag(chol)).sum()) + float(gram[-1, -1] - half @ half)
        # Columns that are orthonormal under V, and what is left of the residual: the gradient is in their loads.
        turn = np.zeros_like(gram)
        turn[:-1, :-1] = solve_triangular(chol, np.eye(half.size), lower=True).T
        turn[:-1, -1], turn[-1, -1] = -turn[:-1, :-1] @ half, 1.0
        turned = turn @ turn.T  # whose product with a Gram matrix is the sum of squares of the turned columns
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
                    n = tuple(x + z for x, z in zip(m, _sandwich(left, tuple(x[code] for x in n)), strict=True))
                    first, second = (x[code] for x in y)
                    y = (
                        mt[0] + left[0][:, None] * first + left[1][:, None] * second,
                        mt[1] + left[2][:, None] * first + left[3][:, None] * second,
                    )
                code = self.groups[self.above[k]][1]
                cross = tuple(x - z for x, z in zip(cross, _applied(square, tuple(x[code] for x in y)), strict=True))
                taken = _sandwich((square[0], square[1], square[1], square[2]), tuple(x[code] for x in n))
                square = tuple(x - z for x, z in zip(square, taken, strict=True))
            level = self.above[k - 1] if k else self.finest
            for kind in (kind for place, kind in self.places if place == level):
                taken = np.vdot(self.layout[level].gram(cross[kind], cross[kind]), turned)
                slope[level, kind] = float(square[2 * kind].sum()) - float(taken)
        return 0.5 * value, 0.5 * np.array([slope[place] for place in self.places])


def _root_of(gram: np.ndarray) -> np.ndarray:
    """Return the lower Cholesky root of a Gram matrix; directions that only rounding holds are given a little size."""
    ridge = 1e-12
    while True:
        try:
            return np.linalg.cholesky(gram + ridge * np.eye(gram.shape[0]))
        except np.linalg.LinAlgError:
            largest = float(np.diag(gram).max())
            if not np.isfinite(gram).all() or ridge > max(largest, 1.0):
                raise
            ridge = max(100 * ridge, 1e-12 * largest)


Symmetric = tuple[np.ndarray, np.ndarray, np.ndarray]
"""2 x 2 matrices by their entries 11, 12 and 22, each (groups,): far quicker than products of stacks so small."""


def _shrinkage(q: Symmetric, size: np.ndarray) -> tuple[Symmetric, np.ndarray]:
    """Return (S^-1 + q)^-1 and log det (1 + S q), shape (groups,), for S the diagonal of `size`; S may hold zeros."""
    a, b, c = 1.0 + size[0] * q[0], np.sqrt(size[0] * size[1]) * q[1], 1.0 + size[1] * q[2]
    det = a * c - b * b
    return (size[0] * c / det, -np.sqrt(size[0] * size[1]) * b / det, size[1] * a / det), np.log(det)


def _applied(m: Symmetric, rows: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return m times two rows of columns, each (groups, columns)."""
    off = m[1][:, None]
    return m[0][:, None] * rows[0] + off * rows[1], off * rows[0] + m[2][:, None] * rows[1]


def _product(m: Symmetric, q: Symmetric) -> tuple[np.ndarray, ...]:
    """Return m q by its entries 11, 12, 21 and 22."""
    return (
        m[0] * q[0] + m[1] * q[1],
        m[0] * q[1] + m[1] * q[2],
        m[1] * q[0] + m[2] * q[1],
        m[1] * q[1] + m[2] * q[2],
    )


def _sandwich(left: Sequence[np.ndarray], n: Symmetric) -> Symmetric:
    """Return L n L' for L by its entries 11, 12, 21 and 22."""
    a, b, c, d = left
    first, second = a * n[0] + b * n[1], a * n[1] + b * n[2]
    third, fourth = c * n[0] + d * n[1], c * n[1] + d * n[2]
    return first * a + second * b, first * c + second * d, third * c + fourth * d


def orthonormal(columns: np.ndarray, tolerance: float = 1e-9) -> np.ndarray:
    """Return an orthonormal basis of the columns' span, shape (m, rank)."""
    left, size, _ = np.linalg.svd(columns, full_matrices=False)
    return left[:, size > tolerance * max(size.max(initial=0.0), 1e-300)]
