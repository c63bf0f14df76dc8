"""Strokes of some samples along an axis, each to be laid on an even grid."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd

LEAST_SAMPLES = 16  # a stroke with fewer steady samples says nothing of a ripple


@dataclass(frozen=True)
class Strokes:
    """Strokes along an axis, m of them with n samples together, and the grids that they are transformed on."""

    place: np.ndarray  # (n,) along the axis, in its unit, as `residual` a stroke after the other
    residual: np.ndarray  # (n,) in N
    start: np.ndarray  # (m,) first sample
    size: np.ndarray  # (m,) samples
    low: np.ndarray  # (m,) where each begins
    span: np.ndarray  # (m,) how far it goes
    unit: np.ndarray  # (m,) number of its file
    direction: np.ndarray  # (m,)

    @classmethod
    def of(cls, samples: pd.DataFrame, axis: str) -> Strokes:
        """Return the strokes of some samples that are long enough to say something of a ripple."""
        place, residual = (samples[name].to_numpy(dtype=float) for name in (axis, "residual_N"))
        stroke = samples["stroke_id"].to_numpy()
        start = np.flatnonzero(np.r_[True, stroke[1:] != stroke[:-1]][: stroke.size])
        size = np.diff(np.r_[start, stroke.size])
        low, high = (part.reduceat(place, start) if start.size else place for part in (np.minimum, np.maximum))
        good = (size >= LEAST_SAMPLES) & (high > low)
        unit, direction = (samples[name].to_numpy()[start[good]] for name in ("unit", "direction"))
        return cls(place, residual, start[good], size[good], low[good], (high - low)[good], unit, direction)

    def only(self, chosen: np.ndarray) -> Strokes:
        """Return some strokes and their samples alone."""
        size = self.size[chosen]
        start = np.cumsum(size) - size
        own = np.repeat(self.start[chosen] - start, size) + np.arange(size.sum())
        others = (getattr(self, name)[chosen] for name in ("low", "span", "unit", "direction"))
        return Strokes(self.place[own], self.residual[own], start, size, *others)

    def on_grids(self, chosen: np.ndarray, step: float, size: int) -> np.ndarray:
        """Return residuals of chosen strokes on even grids of `size` places from where each begins, (strokes, size)."""
        grid = step * np.arange(size)
        found = np.empty((chosen.size, size))
        for row, k in zip(found, chosen, strict=True):
            row[:] = np.interp(self.low[k] + grid, *self.along(k))
        return found

    def along(self, k: int) -> tuple[np.ndarray, np.ndarray]:
        """Return places and residuals of one stroke, sorted by place."""
        own = slice(self.start[k], self.start[k] + self.size[k])
        order = np.argsort(self.place[own], kind="stable")
        return self.place[own][order], self.residual[own][order]

    def together(self, chosen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return places and residuals of strokes of one size n, each sorted by place, shape (strokes, n) both."""
        own = self.start[chosen, None] + np.arange(self.size[chosen[0]])
        order = np.argsort(self.place[own], axis=1, kind="stable")
        return np.take_along_axis(self.place[own], order, 1), np.take_along_axis(self.residual[own], order, 1)
