"""Where the pre-sliding rise of the force ends and sliding is steady, from the force over distance."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from sealfit.ingest.pieces import median, quantile

SETTLED = np.log(50000.0)  # the rise is over when 1/50000 is left: 1/5000 showed in means over a campaign
AFTER_RAMP = 3.0  # rise lengths after the speed ramp: the bristles follow the changing speed over one rise length
ENOUGH = np.log(100.0)  # where 1/50000 would take more than a third of the stroke, 1 % of the rise may stay
HALF_WAY = 0.75  # a force that begins above this share of its level comes up, if at all, over a short distance:
SHORT = 0.01  # this share of the stroke; a longer climb is an effect (run-in, warming), and stays inside
EARLY = (0.05, 0.5)  # share of the distance in which the plateau is read: near the rise, past any ordinary rise
LATE = (0.6, 0.95)  # the same where the rise takes so long that half of the stroke may still be part of it
LONG = 0.1  # rise to 63 % over more than this share of the stroke: a stroke hardly longer than its pre-sliding
LENGTHS = np.geomspace(0.3, 3.0, 25)  # rise lengths that are tried, as multiples of the distance to 63 %
GRID_ROWS = 8192  # rows of starts fitted at once: bounds the memory, times the lengths that are tried
MARGIN = 1.05  # the first arrival in the later band is early by a part of the last bend


class Start(NamedTuple):
    """How a stretch of motion starts: distance from standstill in mm, never falling, and force in N, positive against
    the motion, both of shape (n,); and the row at which the speed has reached its plateau."""

    distance_mm: np.ndarray
    force_N: np.ndarray
    ramp_end: int


def rise_end_mm(distance_mm: np.ndarray, force_N: np.ndarray, ramp_end: int) -> float:
    """Return the distance from which the force of one start is past its pre-sliding rise: see `rise_ends_mm`.

    Examples
    --------
    >>> x = np.linspace(0.0, 40.0, 1001)
    >>> end = rise_end_mm(x, 30.0 * (1.0 - np.exp(-x / 0.5)), 0)  # 0.5 mm * ln(50000) = 5.41 mm
    >>> 5.1 < end < 5.8
    True
    """
    return rise_ends_mm([Start(distance_mm, force_N, ramp_end)])[0]


def rise_ends_mm(starts: Sequence[Start]) -> list[float]:
    """Return, for every start, the distance in mm from which the force is past its pre-sliding rise; 0 without one.

    A bristle at constant speed follows dz/dx = 1 - z / z_ss (LuGre, Eq. 2 divided by v), so the force comes up as
    F(x) = A + B x - C exp(-x / x_0); A + B x stands for whatever changes slowly beside it. For every x_0 on a grid
    the rest is linear least squares; the x_0 with the smallest sum of squares is taken, and the rise ends where
    1/50000 of it is left. A rig that comes up along a straight line (its own elasticity) is over well before.

    Where the rise takes more than a tenth of the stroke (a fretting stroke), no such law is asked: it ends where the
    force first arrives in the band of the late plateau.

    Only a force that begins below everything the plateau later shows is a rise: the trough of a ripple, or a force
    that warming lets fall, is not.

    Notes
    -----
    Canudas de Wit et al. 1995, IEEE Trans. Automatic Control 40(3), 419-425, doi:10.1109/9.376053.
    """
    levels = [_level_N(start) for start in starts]
    scales = [_scale_mm(start, level) for start, level in zip(starts, levels, strict=True)]
    fast = [i for i, scale in enumerate(scales) if scale > 0.0 and not _slow(starts[i], levels[i], scale)]
    fitted = dict(zip(fast, _rise_lengths_mm([starts[i] for i in fast], [scales[i] for i in fast]), strict=True))
    ends = []
    for i, (start, level, scale) in enumerate(zip(starts, levels, scales, strict=True)):
        if i in fitted:
            ends.append(_settled_mm(start, level, fitted[i]))
        else:
            ends.append(MARGIN * _arrival_mm(*start[:2]) if scale > 0.0 else 0.0)
    return ends


def _level_N(start: Start) -> float | None:
    """Return the level of the plateau that the force comes up to; None where it does not come up."""
    distance, force = start.distance_mm, start.force_N
    low, high = (int(distance.searchsorted(share * distance[-1])) for share in EARLY)
    plateau = force[max(low, start.ramp_end) : high]
    if len(plateau) < 8:
        return None
    level, begin = median(plateau), float(force[0])
    return level if level - begin > 0.02 * abs(level) and _below(plateau, begin) else None


def _slow(start: Start, level_N: float, scale_mm: float) -> bool:
    """Return whether the rise takes so much of the stroke that no law is asked."""
    return scale_mm > LONG * float(start.distance_mm[-1]) and float(start.force_N[0]) <= HALF_WAY * level_N


def _settled_mm(start: Start, level_N: float, fitted_mm: float) -> float:
    """Return the distance at which a rise of that length is over."""
    distance = start.distance_mm
    length = float(distance[-1])
    if float(start.force_N[0]) > HALF_WAY * level_N and fitted_mm > SHORT * length:
        return 0.0
    settled = min(SETTLED * fitted_mm, max(length / 3.0, ENOUGH * fitted_mm))
    ramp = float(distance[min(start.ramp_end, len(distance) - 1)])
    return float(max(settled, ramp + AFTER_RAMP * fitted_mm if ramp > 0.0 else 0.0))


def _below(plateau_N: np.ndarray, begin_N: float) -> bool:
    """Return whether the force begins below everything that the plateau shows, its noise included."""
    steps = np.abs(plateau_N[1:] - plateau_N[:-1])
    to_noise = 1.0 / (0.6745 * math.sqrt(2.0))
    # A median is at most twice the mean: far below, no percentile is needed.
    if begin_N < float(plateau_N.min()) - 8.0 * to_noise * float(np.add.reduce(steps)) / len(steps):
        return True
    return begin_N < quantile(plateau_N, 0.01) - 4.0 * (median(steps) * to_noise)


def _arrival_mm(distance_mm: np.ndarray, force_N: np.ndarray) -> float:
    """Return the distance at which the force first comes into the band in which it stays late in the stroke."""
    low, high = np.searchsorted(distance_mm, [share * distance_mm[-1] for share in LATE])
    if high - low < 8:
        return 0.0
    return float(distance_mm[int(np.argmax(force_N >= quantile(force_N[low:high], 0.02)))])


def _scale_mm(start: Start, level_N: float | None) -> float:
    """Return the distance over which the force first comes up by 63 %, between samples; counted from where it begins
    to. 0 where it does not."""
    if level_N is None:
        return 0.0
    distance = start.distance_mm
    high = int(distance.searchsorted(EARLY[1] * distance[-1]))
    force = start.force_N[:high]
    target = force[0] + (1.0 - np.exp(-1.0)) * (level_N - force[0])
    above = force >= target
    after = int(above.argmax())
    if after == 0:  # none is, or the first one already
        return 0.0
    share = (target - force[after - 1]) / (force[after] - force[after - 1])
    return float(distance[after - 1] + share * (distance[after] - distance[after - 1]))


def _rise_lengths_mm(starts: Sequence[Start], scales_mm: Sequence[float]) -> list[float]:
    """Return x_0 of F = A + B x - C exp(-x / x_0) of every start, by least squares on a grid around its scale.

    What A + B x explains is the same for every x_0. So both are taken out of the force and of each exponential, and
    the best x_0 is the one whose exponential's rest explains most of the force's rest.
    """
    alike: dict[int, list[int]] = {}
    rows = []
    for i, (start, scale) in enumerate(zip(starts, scales_mm, strict=True)):
        rows.append(min(max(int(start.distance_mm.searchsorted(12.0 * scale)), 16), len(start.distance_mm)))
        alike.setdefault(rows[-1].bit_length(), []).append(i)
    made = [0.0] * len(starts)
    for bits, members in alike.items():
        size = max(GRID_ROWS >> bits, 1)
        for group in (members[i : i + size] for i in range(0, len(members), size)):
            lengths = np.array([scales_mm[i] for i in group])[:, None] * LENGTHS
            best = _best_of_grid([starts[i] for i in group], [rows[i] for i in group], lengths)
            for i, choices, place in zip(group, lengths, best.tolist(), strict=True):
                made[i] = float(choices[place])
    return made


def _best_of_grid(starts: Sequence[Start], rows: Sequence[int], lengths_mm: np.ndarray) -> np.ndarray:
    """Return which of the lengths, shape (starts, lengths), fits best the first `rows` rows of every start."""
    shape = len(starts), max(rows)
    distance, x, y = np.full(shape, np.inf), np.zeros(shape), np.zeros(shape)  # beyond its rows exp(-x / x_0) is 0
    square = np.empty((len(starts), 1))
    for i, (start, n) in enumerate(zip(starts, rows, strict=True)):
        own, force = start.distance_mm[:n], start.force_N[:n]
        distance[i, :n] = own
        own = own - np.add.reduce(own) / n
        force = force - np.add.reduce(force) / n
        square[i] = own @ own
        x[i, :n], y[i, :n] = own, force - (float(own @ force) / float(square[i, 0])) * own
    rise = np.exp(distance[:, None, :] / -lengths_mm[:, :, None])
    whole = np.einsum("kij,kij->ki", rise, rise)
    total, slope, explained = rise.sum(axis=2), (rise @ x[:, :, None])[:, :, 0], (rise @ y[:, :, None])[:, :, 0]
    rest = whole - total**2 / np.array(rows)[:, None] - slope**2 / square
    # Of two different distances only (a coarse sensor), a straight line explains all that an exponential can.
    gained = np.divide(explained**2, rest, out=np.zeros(rest.shape), where=rest > 1e-12 * whole)
    return np.argmax(gained, axis=1)
