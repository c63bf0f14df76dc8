"""The start of the joint fit: a global search of v_s and b, with the linear parameters solved for."""

from __future__ import annotations

import numpy as np

from sealfit.fit.joint.declared import SAME_SPEED, JointParameter, declare
from sealfit.fit.joint.model import Model
from sealfit.fit.joint.rows import Rows

# Number of grid values of v_s.
GRID = 80
# Values of v_s whose sums of squares differ by less than this share of the sum of squared forces fit equally
# well. The middle one is taken.
EQUAL = 1e-10
# Singular values below this share of the largest one count as zero.
RANK = 1e-10


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
    level = np.zeros((len(declared.conditions), 2))  # mu_s, mu_c of each condition
    chosen = np.zeros(len(declared.conditions), dtype=bool)
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
        values, theta[k], v_s = solved[uses.tobytes()]
        for c, pair in values.items():
            level[c], chosen[c] = pair, True
        if full:
            theta[of_v_s] = np.log(v_s)
    for c in np.flatnonzero(~chosen):
        mine = condition == c
        level[c] = np.mean(size[mine] / load[mine])
    days = rows.conditions["aging_days"].to_numpy()
    for column, end in ((0, "s"), (1, "c")):
        index_0, index_a, index_b = (declared.index[name + end] for name in ("mu_0", "a_", "b_"))
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
    """Return {condition: (mu_s, mu_c)}, sigma_2 and v_s of a series by a grid over v_s, others solved for.

    Through few speeds a wrong v_s fits exactly, with a negative coefficient. Its cost is that with 0 instead.
    """
    own, code = np.unique(condition, return_inverse=True)
    grid = np.geomspace(*stribeck_range(speed), GRID) if full else np.array([1.0])
    solved, costs = [], []
    for v_s in grid:
        decay = np.exp(-((speed / v_s) ** 2)) if full else np.zeros_like(speed)
        columns = load * np.stack([decay, 1 - decay])
        pairs, sigma_2, _ = pairs_and_shared(columns, code, speed, size)
        pairs = np.maximum(pairs, 0.0)
        residual = size - (pairs[code].T * columns).sum(axis=0) - sigma_2 * speed
        costs.append(float(residual @ residual))
        solved.append((pairs, sigma_2, v_s))
    equal = np.flatnonzero(np.array(costs) <= min(costs) + EQUAL * float(size @ size))
    pairs, sigma_2, v_s = solved[equal[equal.size // 2]]
    mu_s, mu_c = pairs.T if full else (pairs[:, 1], pairs[:, 1])
    return {int(c): (s, k) for c, s, k in zip(own, mu_s, mu_c, strict=True)}, float(sigma_2), float(v_s)


def pairs_and_shared(
    columns: np.ndarray, code: np.ndarray, shared: np.ndarray, values: np.ndarray
) -> tuple[np.ndarray, float, int]:
    """Return the least squares solution of two numbers per group and one, not below 0, that all groups share.

    Each group's two columns are orthonormalised and projected out, which leaves one equation for the shared
    number. Among several solutions it is the one of least norm.

    Parameters
    ----------
    columns : ndarray, shape (2, n)
        Columns of the two numbers of each group.
    code : ndarray, shape (n,)
        Number of each value's group, from 0.
    shared, values : ndarray, shape (n,)
        Column of the shared number; the values to fit.

    Returns
    -------
    pairs : ndarray, shape (groups, 2)
    number : float
    rank : int
        That of the pairs' columns; with one value of both columns a pair is not distinguishable.
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

    Below that range only the slowest speed would depend on mu_s, which would not be bounded. Above it the
    exponential is close to a parabola, which sigma_2 and mu_c can imitate (v_s needs two speeds below about 2
    v_s).
    """
    positive = np.sort(speeds[speeds > 0])
    above = positive[positive > SAME_SPEED * positive[0]]
    second = above[0] if above.size else positive[0]
    return float(second / 2), float(positive[-1])
