"""The columns of Eq. 14 in many problems at once, and their inner products along the grid of ln v_s.

With R = sqrt(w) N, V = sqrt(w) |v| and E = exp(-(v/v_s)^2), the model is mu_c R + sigma_2 V + (mu_s - mu_c) R E: two
fixed columns and a moving one. On an even grid of ln v_s hardly an exponential is needed: E is the square of the E of a
v_s larger by sqrt(2).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from sealfit.fit.batch import DEPENDENT
from sealfit.fit.moving import chosen, dot
from sealfit.fit.moving_grid import TABLE

SQUARED = 4  # steps of the grid down which E becomes its own square: 27 a decade, as E turns fast where v_s is large
ANEW = 10  # squares in a row before E is calculated anew: each doubles its relative error, 1e-16 becomes 1e-13
STEP = np.log(2) / 2 / SQUARED  # of ln v_s
TINY = 1e-300


@dataclass(frozen=True)
class Sums:
    """Inner products of the moving column along the grid, shape (B, g), or (1, g) where all problems share them."""

    load: np.ndarray  # with R / |R|
    speed: np.ndarray  # with what V has beyond R
    own: np.ndarray  # with itself
    rest: np.ndarray | None  # with the residual of R and V; None where `rest_over` takes it from the table


@dataclass(frozen=True)
class Weighted:
    """Problems of Eq. 14 with their weights applied, shape (n, B), or (n, 1) where all share them."""

    square: np.ndarray  # v^2
    load: np.ndarray  # R
    speed: np.ndarray  # V
    force: np.ndarray  # sqrt(w) F
    low: np.ndarray  # (B,) or (1,): ln v_s
    high: np.ndarray
    scatter: np.ndarray  # (B,) or (1,): sum of squares that no model explains, not counted in what follows

    def part(self, rows) -> Weighted:
        """Return some of the problems."""
        return Weighted(*(chosen(getattr(self, name), rows) for name in self.__dataclass_fields__))

    # orthonormal fixed columns, and the force's and V's inner products with them
    @cached_property
    def load_size(self):
        """|R|."""
        return np.maximum(np.sqrt(dot(self.load, self.load)), TINY)

    @cached_property
    def speed_size(self):
        """|V|."""
        return np.maximum(np.sqrt(dot(self.speed, self.speed)), TINY)

    @cached_property
    def load_unit(self):
        """R / |R|."""
        return self.load / self.load_size

    @cached_property
    def speed_unit(self):
        """V / |V|."""
        return self.speed / self.speed_size

    @cached_property
    def shared(self):
        """Inner product of V with R / |R|."""
        return dot(self.load_unit, self.speed)

    @cached_property
    def beyond(self):
        """What V has beyond R: its length (inf where nothing) and direction (zeros where nothing)."""
        left = self.speed - self.load_unit * self.shared
        size = dot(left, left)
        known = size > DEPENDENT * self.speed_size**2
        length = np.where(known, np.sqrt(size), np.inf)
        return length, left / length

    @cached_property
    def by_load(self):
        """Inner product of the force with R / |R|."""
        return dot(self.load_unit, self.force)

    @cached_property
    def by_beyond(self):
        """Inner product of the force with what V has beyond R."""
        return dot(self.beyond[1], self.force)

    @cached_property
    def by_speed(self):
        """Inner product of the force with V / |V|."""
        return dot(self.speed_unit, self.force)

    @cached_property
    def rest(self):
        """Force less its projection on R and V."""
        return self.force - self.load_unit * self.by_load - self.beyond[1] * self.by_beyond

    @cached_property
    def total(self):
        """|F|^2."""
        return dot(self.force, self.force)

    # ---------------------------------------------------------------- the grid
    @cached_property
    def first(self):
        """First ln v_s of the grid."""
        return self.low.min(keepdims=True) if self.square.shape[1] == 1 else self.low

    @cached_property
    def points(self) -> int:
        """Number of grid points: the last lies at the upper limit or less than a step above it."""
        return int(np.ceil(np.max(self.high - self.first) / STEP - 1e-9)) + 1

    @cached_property
    def sums(self) -> Sums:
        """Inner products of the moving column R E along the grid.

        E is its own square `SQUARED` steps lower, so the product with itself is |R| times that with R/|R| there.
        """
        if self.square.shape[1] == 1:  # sums over points are matrix products
            load, speed = ((self.load * other).T @ self.table for other in (self.load_unit, self.beyond[1]))
            rest = None
        else:
            vectors = [self.load * other for other in (self.load_unit, self.beyond[1], self.rest)]
            load, speed, rest = self._sums_of_own_speeds(vectors)
            rest = rest[:, SQUARED:]
        own = self.load_size[:, None] * load[:, :-SQUARED]
        return Sums(load[:, SQUARED:], speed[:, SQUARED:], own, rest)

    @cached_property
    def table(self):
        """E along the grid and `SQUARED` steps below it, one for all problems, shape (n, SQUARED + g)."""
        u = self.first + STEP * np.arange(-SQUARED, self.points)
        return np.exp(-self.square * np.exp(-2 * u))

    def rest_over(self, size):
        """Inner products of the moving column with the residual of R and V, shape (g, B), over `size`, (g, B or 1)."""
        if self.sums.rest is not None:
            return self.sums.rest.T / size
        table, rest = self.table[:, SQUARED:], (self.load * self.rest).T
        return (rest @ (table / size.T)).T if size.shape[1] == 1 else (rest @ table).T / size

    def ways(self, size):
        """Directions of what the moving column has beyond R and V, of length `size`, (g, 1), along the grid: (n, g)."""
        column = self.load * self.table[:, SQUARED:]
        return (column - self.load_unit * self.sums.load - self.beyond[1] * self.sums.speed) / size.T

    def _sums_of_own_speeds(self, vectors) -> np.ndarray:
        """Inner products of E with three vectors, shape (3, B, points + SQUARED), from the largest v_s down."""
        n, problems = self.square.shape
        rows = self.points + SQUARED
        blocks = -(-rows // SQUARED)  # of the table, rows by falling v_s: each is the square of the block before
        top = self.first + STEP * (self.points - 1)
        sums = np.empty((4, problems, rows))
        size = max(1, TABLE // (blocks * SQUARED * n))
        table = np.empty((blocks, SQUARED, min(size, problems), n))
        down = np.exp(2 * STEP * np.arange(blocks * SQUARED)).reshape(blocks, SQUARED, 1, 1)
        for start in range(0, problems, size):
            part = slice(start, start + size)
            square = self.square[:, part].T * np.exp(-2 * top[part])[:, None]
            own = table[:, :, : len(square)]
            for k in range(blocks):
                if k % ANEW:
                    np.square(own[k - 1], out=own[k])
                else:
                    np.exp(-square * down[k], out=own[k])
            columns = np.zeros((len(square), n, 4))  # a fourth, of zeros: BLAS is a quarter faster with it
            for k, vector in enumerate(vectors):
                columns[..., k] = np.broadcast_to(chosen(vector, part), (n, len(square))).T
            inner = own.reshape(-1, *own.shape[2:]).transpose(1, 0, 2) @ columns
            sums[:, part] = np.moveaxis(inner[:, rows - 1 :: -1], -1, 0)
        return sums[:3]

    @property
    def grid(self):
        """ln v_s along the grid, shape (B, g) or (1, g)."""
        return self.first[:, None] + STEP * np.arange(self.points)

    @cached_property
    def inside(self):
        """Whether grid points are less than a step out of the limits, shape (B, g), or None where all are."""
        near = STEP * (1 - 1e-9)
        last = self.first + STEP * (self.points - 1)
        if np.all(self.first > self.low - near) and np.all(last < self.high + near):
            return None
        return (self.grid > self.low[:, None] - near) & (self.grid < self.high[:, None] + near)

    @cached_property
    def within(self):
        """Whether grid points are in the limits, shape (B, g) or (1, g)."""
        return (self.grid >= self.low[:, None]) & (self.grid <= self.high[:, None])


def weighted(speed, load, force, root, low, high) -> Weighted:
    """Return the problems with points first; `root` is the square root of the weights, and each (1 or B, ...)."""
    if len(speed) == 1 and len(load) == 1:
        speed, load, force, root, scatter = gathered(speed, load, force, root)
    else:
        scatter = np.zeros(1)
    speed, load, force, root = (np.ascontiguousarray(x.T) for x in (speed, load, force, root))
    return Weighted(speed**2, root * load, root * speed, root * force, low[:, 0], high[:, 0], scatter)


def gathered(speed, load, force, root):
    """Return the problems with one point, at the weighted mean force, for each distinct speed and load.

    That loses nothing: the model is one number there. `scatter` is the sum of squares about the means, shape (B,).
    """
    points, place = np.unique(np.concatenate([speed, load]), axis=1, return_inverse=True)
    place = place.ravel()  # numpy 2.0 keeps the axis
    member = (place[:, None] == np.arange(points.shape[1])).astype(float)
    weight = root**2
    total = weight @ member
    mean = (force * weight) @ member / np.where(total > 0, total, 1.0)
    away = force - mean[:, place]
    away *= away
    scatter = away @ weight[0] if len(weight) == 1 else np.einsum("bn,bn->b", away, weight)
    return points[:1], points[1:], mean, np.sqrt(total), scatter
