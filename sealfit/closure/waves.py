r"""The wave of each pass at one wavelength, from the raw samples: a sharp wavelength, and the phases of the passes.

A pass is a file in one direction. A stroke's residual is taken as a parabola plus a sine and a cosine of its place, by
least squares weighted with a Hann window (ends weigh little, where a stroke starts and stops); the strokes of a pass
share the sine and the cosine. No grid of bins or frequencies limits it, and a wave of a few periods is not mistaken for
its trend.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import pandas as pd

from sealfit.closure.strokes import Strokes
from sealfit.fit.rows import Rows
from sealfit.fit.terms import passes

AROUND = np.linspace(-0.5, 0.5, 101)  # periods per stroke on each side of a peak that are looked at once more


def strokes_of(samples: pd.DataFrame, axis: str) -> Iterator[tuple[int, np.ndarray, np.ndarray]]:
    """Yield (row of the first sample, place, residual) of each stroke long enough, sorted by place.

    Parameters
    ----------
    samples : DataFrame
        Samples of a stroke one after the other: stroke_id, unit, direction, the axis, `residual_N`.
    axis : str
        Column along which the wave runs.
    """
    strokes = Strokes.of(samples, axis)
    for k, first in enumerate(strokes.start.tolist()):
        yield first, *strokes.along(k)


@dataclass(frozen=True)
class Wave:
    """Normal equations of a sine and a cosine, summed over strokes, at each of m wavelengths."""

    square: np.ndarray  # (m, 2, 2)
    product: np.ndarray  # (m, 2)
    total: float  # sum of squares of the residual freed of its trend
    middle: float  # sum of the strokes' mean places
    strokes: int = 1

    def __add__(self, other: Wave) -> Wave:
        return Wave(
            self.square + other.square,
            self.product + other.product,
            self.total + other.total,
            self.middle + other.middle,
            self.strokes + other.strokes,
        )

    @property
    def amplitudes(self) -> np.ndarray:
        """Amplitudes of sine and cosine, shape (m, 2)."""
        return np.einsum("mij,mj->mi", np.linalg.pinv(self.square, hermitian=True), self.product)

    @property
    def share(self) -> np.ndarray:
        """Share of the sum of squares that the wave explains, shape (m,)."""
        return np.einsum("mi,mi->m", self.amplitudes, self.product) / max(self.total, 1e-300)


def waves_of(samples: pd.DataFrame, lengths: np.ndarray, axis: str) -> dict[tuple[int, float], Wave]:
    """Return the wave of each pass, keyed by (number of the file, direction), at m wavelengths.

    Parameters
    ----------
    samples : DataFrame
        As for `strokes_of`.
    lengths : ndarray, shape (m,)
        Wavelengths in the unit of the axis.
    axis : str
        Column along which the wave runs.
    """
    unit, direction = samples["unit"].to_numpy(), samples["direction"].to_numpy()
    waves: dict[tuple[int, float], Wave] = {}
    for a, place, value in strokes_of(samples, axis):
        key = (unit[a], direction[a])
        wave = _wave(place, value, lengths)
        waves[key] = waves[key] + wave if key in waves else wave
    return waves


def _wave(place: np.ndarray, value: np.ndarray, lengths: np.ndarray) -> Wave:
    root = np.sqrt(np.hanning(place.size + 2)[1:-1])
    trend, _ = np.linalg.qr(root[:, None] * np.vander(2 * (place - place.mean()) / np.ptp(place), 3))
    turn = 2 * np.pi * place[:, None] / lengths
    columns = root[:, None] * np.column_stack([np.sin(turn), np.cos(turn), value])
    columns -= trend @ (trend.T @ columns)
    sine, cosine, y = columns[:, : lengths.size], columns[:, lengths.size : -1], columns[:, -1]
    mixed = (sine * cosine).sum(axis=0)
    square = np.array([[(sine**2).sum(axis=0), mixed], [mixed, (cosine**2).sum(axis=0)]])
    return Wave(np.moveaxis(square, 2, 0), np.column_stack([y @ sine, y @ cosine]), float(y @ y), float(place.mean()))


def common_wavelength(samples: pd.DataFrame, wavelength: float, axis: str) -> tuple[float, float]:
    """Return the wavelength near a peak that explains most where each pass has its own phase, and its standard error.

    The error is a jackknife over files.
    """
    span = np.median([place[-1] - place[0] for _, place, _ in strokes_of(samples, axis)])
    lengths = 1 / (1 / wavelength + AROUND / span)
    waves = waves_of(samples, lengths, axis)
    files = sorted({file for file, _ in waves})
    share = np.zeros((len(files), lengths.size))
    for (file, _), wave in waves.items():
        share[files.index(file)] += wave.share
    without = np.array([_top(lengths, share.sum(axis=0) - own) for own in share])
    spread = (len(files) - 1) / len(files) * ((without - without.mean()) ** 2).sum()
    return _top(lengths, share.sum(axis=0)), float(np.sqrt(spread))


def _top(lengths: np.ndarray, power: np.ndarray) -> float:
    """Return where a sampled curve is highest, by the parabola through its highest point and two neighbours."""
    k = int(np.clip(np.argmax(power), 1, power.size - 2))
    left, middle, right = power[k - 1 : k + 2]
    bend = left - 2 * middle + right
    if bend >= 0:
        return float(lengths[k])
    return float(lengths[k] + 0.25 * (left - right) / bend * (lengths[k + 1] - lengths[k - 1]))


def agreement(samples: pd.DataFrame, first: np.ndarray, wavelength: float, axis: str) -> np.ndarray:
    """Return per file how far its two halves hold the same wave: the product of their amplitudes, shape (files,).

    Without a wave the phases of the halves are unrelated, and the sign is as often negative as positive.

    Parameters
    ----------
    samples : DataFrame
        As for `strokes_of`.
    first : ndarray of bool, shape (n,)
        Which samples make the first half.
    wavelength : float
        In the unit of the axis.
    axis : str
        Column along which the wave runs.
    """
    one, other = (waves_of(samples[mask], np.array([wavelength]), axis) for mask in (first, ~first))
    cross: dict[int, float] = {}
    for key in one.keys() & other.keys():
        cross[key[0]] = cross.get(key[0], 0.0) + float(one[key].amplitudes[0] @ other[key].amplitudes[0])
    return np.array([cross[unit] for unit in sorted(cross)])


def pass_shifts(samples: pd.DataFrame, rows: Rows, wavelength: float, axis: str) -> dict[str, float]:
    """Return per pass how far its own origin lies from the wave's, in the unit of the axis.

    Of the origins a wavelength apart the one nearest the pass's middle is taken, so that the phase there holds
    whatever becomes of the wavelength.
    """
    strokes = rows.table.iloc[rows.groups.starts["stroke"]]
    names = dict(zip(strokes["stroke_id"], passes(strokes), strict=True))
    first = samples.drop_duplicates(["unit", "direction"]).set_index(["unit", "direction"])["stroke_id"]
    shifts = {}
    for key, wave in waves_of(samples, np.array([wavelength]), axis).items():
        sine, cosine = wave.amplitudes[0]
        shift = wavelength * np.arctan2(cosine, sine) / (2 * np.pi)
        middle = wave.middle / wave.strokes
        shifts[names[first[key]]] = float(shift - wavelength * np.round((middle + shift) / wavelength))
    return shifts
