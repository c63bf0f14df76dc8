r"""The tangent of the joint model, the derivatives of all rows, stored by blocks of columns.

A row depends only on the parameters of its series and on a few that series share. Rows of a specimen share a
*block*: the columns on which any of them depends. Whitening combines rows of one specimen only and keeps the
blocks. Normal matrices are sums over blocks. A bordered block-diagonal factorisation orthonormalises the
columns of each block first, then those that blocks share. Time and memory are linear in the number of rows.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.sparse import csr_array

from sealfit.fit.joint.rows import Groups

# Share of a column's sum of squares below which others contain it.
COLLINEAR = 1e-9
# With a block of more than this share of all columns the tangent is stored dense.
LARGEST_BLOCK = 0.5


@dataclass(frozen=True)
class BlockLayout:
    """The columns of each block, and the block of each row."""

    size: int  # number of columns, p
    index: np.ndarray  # (blocks, k) column at each place of a block; p if the place is empty
    block: np.ndarray  # (n,)

    @cached_property
    def rows(self) -> list[slice | np.ndarray]:
        """Rows of each block; a slice if they are contiguous."""
        if len(self.index) == 1:
            return [slice(None)]
        order = np.argsort(self.block, kind="stable")
        parts = np.split(order, np.cumsum(np.bincount(self.block, minlength=len(self.index)))[:-1])
        whole = [part.size and part[-1] - part[0] == part.size - 1 for part in parts]
        return [slice(p[0], p[-1] + 1) if one else p for p, one in zip(parts, whole, strict=True)]

    @cached_property
    def places(self) -> np.ndarray:
        """Place of each column in each block, shape (blocks, p); -1 if the block lacks it."""
        found = np.full((len(self.index), self.size + 1), -1)
        np.put_along_axis(found, self.index, np.arange(self.index.shape[1])[None, :], axis=1)
        return found[:, :-1]

    def of(self, rows: np.ndarray) -> BlockLayout:
        """Return the layout of some rows."""
        return BlockLayout(self.size, self.index, self.block[rows])

    def gram(self, first: np.ndarray, second: np.ndarray) -> np.ndarray:
        """Return A' B of two sets of columns in this layout, shape (n, k) each -> (p, p)."""
        if self.whole:
            return first.T @ second
        parts = np.stack([first[rows].T @ second[rows] for rows in self.rows])
        wide = self.size + 1
        total = np.bincount(self.pairs, parts.ravel(), minlength=wide * wide).reshape(wide, wide)
        return total[:-1, :-1]

    @cached_property
    def pairs(self) -> np.ndarray:
        """Flat index of the blocks' Gram entries in the padded Gram matrix, shape (blocks * k * k,)."""
        return (self.index[:, :, None] * (self.size + 1) + self.index[:, None, :]).ravel()

    @cached_property
    def whole(self) -> bool:
        """Whether there is one block with all columns in order."""
        return len(self.index) == 1 and np.array_equal(self.index[0], np.arange(self.size))


@dataclass(frozen=True)
class Tangent:
    """Derivatives of rows, shape (n, p), by blocks: `values`, shape (n, k), 0 at empty places."""

    layout: BlockLayout
    values: np.ndarray

    @classmethod
    def dense(cls, columns: np.ndarray) -> Tangent:
        """Return columns, shape (n, p), as one block."""
        n, p = columns.shape
        return cls(BlockLayout(p, np.arange(p)[None, :], np.zeros(n, dtype=int)), columns)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.values.shape[0], self.layout.size

    def toarray(self) -> np.ndarray:
        """Return all columns, shape (n, p)."""
        found = np.zeros((self.values.shape[0], self.layout.size + 1))
        np.put_along_axis(found, self.layout.index[self.layout.block], self.values, axis=1)
        return found[:, :-1]

    def with_values(self, values: np.ndarray) -> Tangent:
        """Return a tangent with other values, shape (n, k), in the same layout."""
        return Tangent(self.layout, values)

    def append(self, columns: np.ndarray) -> Tangent:
        """Return the tangent with columns, shape (n,) or (n, m), appended to every block."""
        values = np.column_stack([self.values, columns])
        first, size = self.layout.size, self.layout.size + values.shape[1] - self.values.shape[1]
        index = np.where(self.layout.index == first, size, self.layout.index)
        index = np.column_stack([index, np.tile(np.arange(first, size), (len(index), 1))])
        return Tangent(BlockLayout(size, index, self.layout.block), values)

    def gram(self) -> np.ndarray:
        """Return T' T, shape (p, p)."""
        return self.layout.gram(self.values, self.values)

    def against(self, columns: np.ndarray) -> np.ndarray:
        """Return T' C of columns, shape (n,) or (n, m) -> (p,) or (p, m)."""
        total = np.zeros((self.layout.size + 1, *columns.shape[1:]))
        for index, rows in zip(self.layout.index, self.layout.rows, strict=True):
            total[index] += self.values[rows].T @ columns[rows]
        return total[:-1]

    def __matmul__(self, numbers: np.ndarray) -> np.ndarray:
        """Return T x of numbers, shape (p,) or (p, m) -> (n,) or (n, m)."""
        padded = np.concatenate([numbers, np.zeros((1, *numbers.shape[1:]))])
        found = np.empty((self.values.shape[0], *numbers.shape[1:]))
        for index, rows in zip(self.layout.index, self.layout.rows, strict=True):
            found[rows] = self.values[rows] @ padded[index]
        return found

    def project_out(self, columns: np.ndarray) -> np.ndarray:
        """Return columns, (n,) or (n, m), minus their projection on the tangent; it must be orthonormal."""
        return columns - self @ self.against(columns)

    def squares(self, matrix: np.ndarray) -> np.ndarray:
        """Return t' M t of each row t for a matrix M, shape (p, p) -> (n,)."""
        padded, found = np.pad(matrix, (0, 1)), np.empty(self.values.shape[0])
        for index, rows in zip(self.layout.index, self.layout.rows, strict=True):
            own = self.values[rows]
            found[rows] = np.einsum("ij,ij->i", own @ padded[np.ix_(index, index)], own)
        return found

    def norms(self) -> np.ndarray:
        """Return the length of each column, shape (p,)."""
        squares = np.zeros(self.layout.size + 1)
        for index, rows in zip(self.layout.index, self.layout.rows, strict=True):
            squares[index] += np.einsum("ij,ij->j", self.values[rows], self.values[rows])
        return np.sqrt(squares[:-1])

    def scaled(self, factor: np.ndarray) -> Tangent:
        """Return the tangent with each column multiplied by a factor, shape (p,)."""
        return self.with_values(self.values * np.append(factor, 0.0)[self.layout.index][self.layout.block])

    def sums(self, groups: Groups, level: str, factor: np.ndarray | None = None) -> Tangent:
        """Return the sums over groups of the rows times a factor, shape (n,); groups lie within specimens."""
        values = self.values if factor is None else self.values * factor[:, None]
        return Tangent(self.layout.of(groups.starts[level]), groups.sums(values, level))

    def means(self, groups: Groups, level: str) -> Tangent:
        """Return the means over groups; groups lie within specimens."""
        return Tangent(self.layout.of(groups.starts[level]), groups.means(self.values, level))

    def columns(self, mask: np.ndarray) -> Tangent:
        """Return the columns for which `mask`, shape (p,), is true."""
        size, number = int(mask.sum()), np.append(np.cumsum(mask) - 1, 0)
        index = np.where(np.append(mask, False)[self.layout.index], number[self.layout.index], size)
        used = (index < size).any(axis=0)
        values = np.where((index < size)[self.layout.block], self.values, 0.0)
        return Tangent(BlockLayout(size, index[:, used], self.layout.block), values[:, used])

    def orthonormal(
        self, tolerance: float, project_out: Callable[[np.ndarray], np.ndarray] = lambda columns: columns
    ) -> Tangent:
        """Return an orthonormal basis of the span of the columns, scaled to length 1 first, shape (n, rank).

        Singular values below `tolerance` times the largest count as zero. `project_out`, (n, m) -> (n, m), is
        a projection of the scaled columns that combines rows of one specimen only.
        """
        unit = self.scaled(1 / np.maximum(self.norms(), 1e-300))
        unit = unit.with_values(project_out(unit.values))
        layout = self.layout
        shared = (layout.places >= 0).sum(axis=0) > 1
        border = unit.columns(shared).toarray() if shared.any() else None
        most = 1.0 if border is None else max(1.0, float(np.linalg.norm(border, 2)))  # columns have length 1
        parts = []
        for index, rows in zip(layout.index, layout.rows, strict=True):
            own = unit.values[rows][:, np.append(~shared, False)[index]]
            left, size, _ = np.linalg.svd(own, full_matrices=False)
            most = max(most, float(size.max(initial=0.0)))
            parts.append((left, size))
        parts = [left[:, size > tolerance * most] for left, size in parts]
        counts = np.array([part.shape[1] for part in parts])
        first = np.cumsum(counts) - counts
        places = np.arange(counts.max(initial=0))
        values = np.zeros((unit.values.shape[0], places.size))
        for part, rows in zip(parts, layout.rows, strict=True):
            values[rows, : part.shape[1]] = part
        size = int(counts.sum())
        index = np.where(places < counts[:, None], first[:, None] + places, size)
        own = Tangent(BlockLayout(size, index, layout.block), values)
        if border is None:
            return own
        border = own.project_out(own.project_out(border))  # the second projection removes rounding errors
        left, spread, _ = np.linalg.svd(border, full_matrices=False)
        return own.append(left[:, spread > tolerance * most])


class OwnColumns:
    """A few columns per specimen, zero outside its rows: those of different specimens are orthogonal.

    `code`, shape (n,), is the specimen of each row, and `loads`, shape (n,) or (n, k), the values of its
    columns there. Columns of zeros, and those that others of the specimen contain, do not count.
    """

    def __init__(self, code: np.ndarray, loads: np.ndarray) -> None:
        self.code, self.count, self.units = code, 0, []
        for load in np.atleast_2d(loads.T):
            left = self.project_out(load)
            square = np.bincount(code, left**2)
            kept = square > COLLINEAR * np.bincount(code, load**2)
            unit = np.where(kept, 1 / np.sqrt(np.where(kept, square, 1.0)), 0.0)[code] * left
            self.units.append((unit, csr_array((unit, (code, np.arange(code.size))))))
            self.count += int(kept.sum())

    def project_out(self, columns: np.ndarray) -> np.ndarray:
        """Return columns, shape (n,) or (n, m), minus their projection on the specimens' columns."""
        for unit, summing in self.units:
            columns = columns - (unit * (summing @ columns)[self.code].T).T
        return columns


def blocks_of(sets: Sequence[frozenset[int]], size: int) -> tuple[np.ndarray, np.ndarray]:
    """Return blocks that contain sets of columns, and each set's block; one block if a set has most columns.

    The blocks have the column at each place, shape (blocks, k), or `size`, the number of columns, if the
    place is empty. The number of each set's block has the shape (sets,).
    """
    kept: list[frozenset[int]] = []
    home: dict[frozenset[int], int] = {}
    for one in sorted(set(sets), key=len, reverse=True):
        home[one] = next((k for k, block in enumerate(kept) if one <= block), len(kept))
        if home[one] == len(kept):
            kept.append(one)
    most = max(map(len, kept), default=0)
    if len(kept) < 2 or most > LARGEST_BLOCK * size:
        return np.arange(size)[None, :], np.zeros(len(sets), dtype=int)
    index = np.full((len(kept), most), size)
    for k, block in enumerate(kept):
        index[k, : len(block)] = sorted(block)
    return index, np.array([home[one] for one in sets])
