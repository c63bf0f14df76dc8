"""Where the pre-sliding rise of the force ends and sliding is steady, from the force over distance."""

from __future__ import annotations

import math

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
MARGIN = 1.05  # the first arrival in the later band is early by a part of the last bend


def rise_end_mm(distance_mm: np.ndarray, force_N: np.ndarray, ramp_end: int) -> float:
    """Return the distance from which the force is past its pre-sliding rise; 0 where there is none.

    A bristle at constant speed follows dz/dx = 1 - z / z_ss (LuGre, Eq. 2 divided by v), so the force comes up as
    F(x) = A + B x - C exp(-x / x_0); A + B x stands for whatever changes slowly beside it. For every x_0 on a grid
    the rest is linear least squares; the x_0 with the smallest sum of squares is taken, and the rise ends where
    1/50000 of it is left. A rig that comes up along a straight line (its own elasticity) is over well before.

    Where the rise takes more than a tenth of the stroke (a fretting stroke), no such law is asked: it ends where the
    force first arrives in the band of the late plateau.

    Only a force that begins below everything the plateau later shows is a rise: the trough of a ripple, or a force
    that warming lets fall, is not.

    Parameters
    ----------
    distance_mm : ndarray, shape (n,)
        Distance from standstill, never falling.
    force_N : ndarray, shape (n,)
        Force, positive against the motion.
    ramp_end : int
        Row at which the speed has reached its plateau.

    Returns
    -------
    float
        Distance in mm.

    Notes
    -----
    Canudas de Wit et al. 1995, IEEE Trans. Automatic Control 40(3), 419-425, doi:10.1109/9.376053.

    Examples
    --------
    >>> x = np.linspace(0.0, 40.0, 1001)
    >>> end = rise_end_mm(x, 30.0 * (1.0 - np.exp(-x / 0.5)), 0)  # 0.5 mm * ln(50000) = 5.41 mm
    >>> 5.1 < end < 5.8
    True
    """
    length = float(distance_mm[-1])
    low, high = (int(distance_mm.searchsorted(share * length)) for share in EARLY)
    low = max(low, ramp_end)
    plateau = force_N[low:high]
    if len(plateau) < 8:
        return 0.0
    level, begin = median(plateau), float(force_N[0])
    if level - begin <= 0.02 * abs(level):
        return 0.0
    if not _below(plateau, begin):
        return 0.0
    scale = _scale_mm(distance_mm[:high], force_N[:high], begin, level)
    if scale <= 0.0:
        return 0.0
    if scale > LONG * length and begin <= HALF_WAY * level:
        return MARGIN * _arrival_mm(distance_mm, force_N)
    fitted = _rise_length_mm(distance_mm, force_N, scale)
    if begin > HALF_WAY * level and fitted > SHORT * length:
        return 0.0
    settled = min(SETTLED * fitted, max(length / 3.0, ENOUGH * fitted))
    ramp = float(distance_mm[min(ramp_end, len(distance_mm) - 1)])
    return float(max(settled, ramp + AFTER_RAMP * fitted if ramp > 0.0 else 0.0))


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


def _scale_mm(distance_mm: np.ndarray, force_N: np.ndarray, begin: float, level: float) -> float:
    """Return the distance over which the force first comes up by 63 %, between samples; counted from where it begins
    to."""
    target = begin + (1.0 - np.exp(-1.0)) * (level - begin)
    above = force_N >= target
    after = int(above.argmax())
    if after == 0:  # none is, or the first one already
        return 0.0
    share = (target - force_N[after - 1]) / (force_N[after] - force_N[after - 1])
    return float(distance_mm[after - 1] + share * (distance_mm[after] - distance_mm[after - 1]))


def _rise_length_mm(distance_mm: np.ndarray, force_N: np.ndarray, scale_mm: float) -> float:
    """Return x_0 of F = A + B x - C exp(-x / x_0), by least squares on a grid around `scale_mm`.

    What A + B x explains is the same for every x_0. So both are taken out of the force and of each exponential, and
    the best x_0 is the one whose exponential's rest explains most of the force's rest.
    """
    rows = int(distance_mm.searchsorted(12.0 * scale_mm))
    rows = min(max(rows, 16), len(distance_mm))
    x, y = distance_mm[:rows], force_N[:rows]
    x = x - np.add.reduce(x) / rows
    square = float(x @ x)
    y = y - np.add.reduce(y) / rows
    y = y - (float(x @ y) / square) * x
    lengths = scale_mm * LENGTHS
    rise = np.exp(distance_mm[:rows] / -lengths[:, None])
    total, slope, explained = rise.sum(axis=1), rise @ x, rise @ y
    whole = np.einsum("ij,ij->i", rise, rise)
    rest = whole - total**2 / rows - slope**2 / square
    # Of two different distances only (a coarse sensor), a straight line explains all that an exponential can.
    gained = np.divide(explained**2, rest, out=np.zeros(len(rest)), where=rest > 1e-12 * whole)
    return float(lengths[np.argmax(gained)])
