"""Where the pre-sliding rise of the force ends and sliding is steady, from the force over distance."""

import math
from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize_scalar

# Rise lengths after which a rise is over: 1/50000 is left. 1/5000 still showed in means over a campaign.
SETTLED = np.log(50000.0)
# Rise lengths after a speed ramp: the bristles follow the changing speed over one of them.
AFTER_RAMP = 3.0
# The same where `SETTLED` would take more than a third of the stroke: 1 % is left.
ENOUGH = np.log(100.0)
# Share of the stroke at which a rise ends at the latest where what is left of it is known.
LATEST = 0.5
# Share of its level above which a force that begins there comes up, if at all, over a short distance.
HALF_WAY = 0.75
# Share of its level below which a force begins far from it: only a rise comes up from there, however long.
FAR_BELOW = 0.25
# Distance of `HALF_WAY`, as a share of the stroke. A longer climb is an effect (run-in, warming).
SHORT = 0.01
# Share of the stroke in which the fall of an overshoot, and of one that is `LARGE`, comes down by 63 %.
SOON, HIGH = 0.05, 1.0 / 3.0
# Share of the change of the force since rest from which a rise or fall on the plateau of the speed is large:
# damping explains it, and nothing that changes slowly. From `PART` on the bristles' law is asked there.
LARGE, PART = 0.25, 0.1
# Share of the variance of so many means of the force on the plateau that this law must explain.
EXPLAINED, MEANS = 0.9, 24
# Share of the distance between which the plateau is read: past any ordinary rise, and past a long one.
EARLY, LATE = (0.05, 0.5), (0.6, 0.95)
# Share of the stroke beyond which a rise to 63 % is long: the stroke is hardly longer than its pre-sliding.
LONG = 0.1
# Rise lengths that are tried, as multiples of the distance to 63 %.
LENGTHS = np.geomspace(0.3, 3.0, 25)
# Standard errors above which a transient of known length is clear.
CLEAR_TRANSIENT = 4.0
# Factor on the first arrival in the late band, which is early by a part of the last bend.
MARGIN = 1.05
# Rise lengths that are tried on the plateau of the speed, as multiples of the one found with the ramp.
REFINED = 1.06 ** np.arange(-16, 17)
# Rise lengths over which that fit reaches: nothing is left of the rise, and a slow change is still straight.
REACH = 16.0
# Rise lengths from which a slope beside the rise can be told from the rise itself.
SLOPED = 8.0
# Rivals (1 - x / k)^p: a straight rise (elasticity of the rig, fretting) and a rounded one: their powers p,
# and the lengths k that are tried, as multiples of the rise length.
POWERS, ENDS = (1, 2), np.geomspace(0.8, 8.0, 14)
# Twice the log likelihood by which a rival must be better. It is then no bristle, and nothing is taken out.
UNLIKELY = 10.0
# Factor by which the rise on the plateau must be longer than that from rest to be the bristles': the lengths
# that are tried reach three times as far as the force's arrival.
LONGER = 3.0
# Rise lengths on the plateau after which the law is asked again where it did not hold, and the rows that
# this takes at least: twice as many as the law has parameters.
SKIPPED, LEAST_ROWS = (1.0, 2.0), 8
# Largest ratio of a rise length found after such rows to the first one. A longer one belongs to a slow change
# such as warming.
SLOWER = 5.0
# Rise lengths after which nothing is left of a rise.
FAR = 200.0
# Means of rows from which the frequency of a wave is found, periods that they hold at least, and the factor
# by which the spectrum is finer than theirs.
ROWS_OF_WAVE, LEAST_PERIODS, FINER = 512, 2, 8
STRONG = 0.5  # share of the variance beside a parabola that a strong wave explains


class MotionStart(NamedTuple):
    """How a stretch of motion starts, and the row at which the speed has reached its plateau.

    Distance from standstill, never falling, and force, positive against the motion; both of shape (n,).
    """

    distance_mm: np.ndarray
    force_N: np.ndarray
    ramp_end: int

    @property
    def plateau_mm(self) -> float:
        """Distance at which the speed has reached its plateau."""
        return float(self.distance_mm[min(self.ramp_end, len(self.distance_mm) - 1)])


class Rise(NamedTuple):
    """Where the rise of one start is over, and what is left of it: `left_N * exp(-distance / length_mm)`.

    `left_N` is the force at distance 0 less that of steady sliding; 0 without a rise that follows the
    bristles' law. `length_mm` is 0 where there is no rise.
    """

    end_mm: float
    left_N: float = 0.0
    length_mm: float = 0.0

    def at(self, distance_mm: np.ndarray) -> np.ndarray:
        """Return what is left of the rise, in N, shape (n,)."""
        if not self.left_N:
            return np.zeros(len(distance_mm))
        return self.left_N * np.exp(-distance_mm / self.length_mm)


def rise_of(start: MotionStart) -> Rise:
    """Return where the pre-sliding rise of a start is over (0 mm without one), and what is left of it there.

    A bristle at constant speed follows dz/dx = 1 - z / z_ss (LuGre, Eq. 2 divided by v), so the force comes
    up as F(x) = A + B x - C exp(-x / x_0); A + B x stands for whatever changes slowly beside it. The x_0 is
    found by least squares on a grid, and the rise ends where 1/50000 of it is left.

    Where that would take more than a third of the stroke, the rise ends earlier; where it takes more than a
    tenth of the stroke to come up by 63 %, it ends where the force first arrives in the band of the late
    plateau. What is left then follows from the same law, fitted to the rows of constant speed.

    Only a force that begins below everything the plateau later shows is a rise. With much damping of the
    bristles (sigma_1) a fast stroke's force comes up at once, to more than its level, and falls to it by the
    same law; then the fall has to be over. A strong wave is taken out if the rise takes more than a third of
    the stroke. Canudas de Wit et al. 1995, IEEE Trans. Automatic Control 40(3), 419-425,
    doi:10.1109/9.376053.

    Examples
    --------
    >>> x = np.linspace(0.0, 40.0, 1001)
    >>> start = MotionStart(x, 30.0 * (1.0 - np.exp(-x / 0.5)), 0)
    >>> 5.1 < rise_of(start).end_mm < 5.8  # 0.5 mm * ln(50000) = 5.41 mm
    True
    """
    rise, length = _rise_or_fall(start), float(start.distance_mm[-1])
    if 0.0 < SETTLED * rise.length_mm < length / 3.0:
        return rise
    late = int(start.distance_mm.searchsorted(EARLY[1] * length))
    wave = strong_wave(start.distance_mm, start.force_N, late)
    without = _rise_or_fall(start._replace(force_N=start.force_N - wave)) if wave.any() else rise
    return without if SETTLED * without.length_mm >= length / 3.0 else rise


def _rise_or_fall(start: MotionStart) -> Rise:
    """Return the rise of a start, or the fall from the peak that damping makes of it."""
    if found := _turned(start):
        turned, peak_mm = found
        fall = _rise(turned)
        if _by_damping(start, turned, fall):
            left_N, length = _left_over(turned, fall.length_mm)
            if left_N < 0.0:  # it follows the law
                unsettled = _before(-left_N, peak_mm / length) if fall.left_N else 0.0
                return Rise(peak_mm + fall.end_mm, unsettled, length)
    return _rise(start)


def _turned(start: MotionStart) -> tuple[MotionStart, float] | None:
    """Return the fall from an early peak, turned upside down so that it comes up, and the peak's distance.

    None if the fall cannot be over soon enough (`_by_damping`), if the force is highest at the end of the
    first half of the stroke, or if no row lies where its level is read.
    """
    distance, force = start.distance_mm, start.force_N
    early, half = (int(distance.searchsorted(share * distance[-1])) for share in EARLY)
    if half < 2 or early == half:
        return None
    peak = int(force[:half].argmax())
    if peak >= half - 1 or distance[peak] > start.plateau_mm + SOON * distance[-1]:
        return None
    turned = 2.0 * np.median(force[max(early, peak) : half]) - force[peak:]
    fall = MotionStart(distance[peak:] - distance[peak], turned, max(start.ramp_end - peak, 0))
    return fall, float(distance[peak])


def _by_damping(start: MotionStart, turned: MotionStart, fall: Rise) -> bool:
    """Return whether a peak may be the bristles' damping: reached while the speed rises, and over soon.

    A peak of break-away falls over a longer distance, unless it is too high for a break-away or for warming.
    """
    length, level, peak_N = float(start.distance_mm[-1]), _level_N(turned), float(start.force_N.max())
    # The fall is as large in the turned force, whose level is the same.
    high = level is not None and level - turned.force_N[0] > LARGE * (peak_N - start.force_N[0])
    soon = 0.0 < fall.length_mm < (HIGH if high else SOON) * length
    peak_mm = length - float(turned.distance_mm[-1])
    return soon and peak_mm <= start.plateau_mm + fall.length_mm


def _rise(start: MotionStart) -> Rise:
    """Return the rise of a start whose force comes up, and none of any other.

    At the start of a fast stroke damping brings up a part of the force at once, and the bristles the rest. If
    that is at least a tenth, the rise is that on the plateau of the speed where it is longer than the one
    from rest, or alone follows the law of the bristles.
    """
    rise = _rise_from_rest(start)
    moving = start._replace(ramp_end=max(start.ramp_end, 1))  # the row before is of rest, or another motion
    ramp, plateau = moving.plateau_mm, _on_plateau(moving)
    level = _level_N(plateau) if rise.length_mm > 0.0 else None
    if level is None or level - plateau.force_N[0] < PART * (level - start.force_N[0]):
        return rise
    later = _rise_from_rest(plateau)
    better = later.length_mm > LONGER * rise.length_mm or (later.left_N != 0.0 and rise.left_N == 0.0)
    if not (better and _explained(plateau, later.length_mm) > EXPLAINED):
        return rise
    return Rise(ramp + later.end_mm, _before(later.left_N, ramp / later.length_mm), later.length_mm)


def _explained(start: MotionStart, length_mm: float) -> float:
    """Return the share of the variance of the force, its noise averaged out, that an exponential explains."""
    n = _rows_within(start, REACH * length_mm)
    edges = np.linspace(0, n, min(MEANS, n) + 1).astype(int)[:-1]
    count = np.diff(np.r_[edges, n])
    distance, force = (np.add.reduceat(values[:n], edges) / count for values in start[:2])
    beside = _Beside(distance, False)
    force = beside.free(force)
    return 1.0 - beside.fitted(_shape(distance, length_mm), force)[1] / max(force @ force, 1e-300)


def _on_plateau(start: MotionStart, begin_mm: float | None = None) -> MotionStart:
    """Return a start from where the speed has reached its plateau, or from a later distance."""
    begin_mm = start.plateau_mm if begin_mm is None else begin_mm
    rows = slice(max(start.ramp_end, int(start.distance_mm.searchsorted(begin_mm))), None)
    return MotionStart(start.distance_mm[rows] - begin_mm, start.force_N[rows], 0)


def _rise_from_rest(start: MotionStart) -> Rise:
    level = _level_N(start)
    scale = _scale_mm(start, level)
    if not scale > 0.0:
        return Rise(0.0)
    # A rise that takes so much of the stroke: no law is asked.
    slow = scale > LONG * float(start.distance_mm[-1]) and float(start.force_N[0]) <= HALF_WAY * level
    length = _rise_length_mm(start, 12.0 * scale, scale * LENGTHS, not slow)
    end = MARGIN * _arrival_mm(start) if slow else _settled_mm(start, level, length)
    if not end > 0.0:
        return Rise(end)
    ramp = start.plateau_mm if start.plateau_mm > length else 0.0  # along a short one nothing else happens
    if end >= ramp + 0.99 * SETTLED * length:
        return Rise(end, 0.0, length)
    left_N, length = _left_over(start, length)
    return Rise(min(end, max(LATEST * float(start.distance_mm[-1]), ramp)) if left_N else end, left_N, length)


def _left_over(start: MotionStart, length_mm: float) -> tuple[float, float]:
    """Return C and x_0 of F = A + B x + C exp(-x / x_0) of a start, from its rows of constant speed.

    C is 0 where a rival fits better. Without the first rise lengths the law has to fit better itself.
    """
    left_N, found, better = _law_on(_on_plateau(start), length_mm)
    if better > -UNLIKELY:
        return _before(left_N, start.plateau_mm / found), found
    for skipped in SKIPPED:  # each time a longer one can be found
        begin_mm = start.plateau_mm + skipped * found
        later = _on_plateau(start, begin_mm)
        if len(later.force_N) < LEAST_ROWS:
            break
        left_N, found, better = _law_on(later, found)
        if found > SLOWER * length_mm:
            return 0.0, length_mm
        if better > UNLIKELY:
            return _before(left_N, begin_mm / found), found
    return 0.0, found


def _law_on(plateau: MotionStart, length_mm: float) -> tuple[float, float, float]:
    """Return C, x_0, and twice the log likelihood of the law less that of its best rival."""
    reach = REACH * length_mm
    sloped = min(plateau.distance_mm[-1], reach) >= SLOPED * length_mm
    length = _rise_length_mm(plateau, reach, length_mm * REFINED, sloped)
    n = _rows_within(plateau, reach)
    x, beside = plateau.distance_mm[:n], _Beside(plateau.distance_mm[:n], sloped)
    force = beside.free(plateau.force_N[:n])
    left, squares = beside.fitted(_shape(x, length), force)
    rivals = []
    for power in POWERS:
        end = _rise_length_mm(plateau, reach, length * ENDS, sloped, power)
        rivals.append(beside.fitted(_shape(x, end, power), force)[1])
    return left, length, n * math.log(max(min(rivals), 1e-300) / max(squares, 1e-300))


def _before(left_N: float, lengths: float) -> float:
    """Return what is left of a rise so many rise lengths earlier; 0 if nothing can be known of it there."""
    return left_N * math.exp(lengths) if lengths < FAR else 0.0


class _Beside:
    """What stands beside a rise, A + B x, and is taken out of what is fitted; B is 0 without a slope."""

    def __init__(self, x_mm: np.ndarray, has_slope: bool) -> None:
        self.x = x_mm - x_mm.mean() if has_slope else None

    def free(self, values: np.ndarray) -> np.ndarray:
        """Return values without the A + B x that fits them best, shape (n,)."""
        values = values - values.mean()
        return values if self.x is None else values - (self.x @ values) / (self.x @ self.x) * self.x

    def fitted(self, shape: np.ndarray, force_N: np.ndarray) -> tuple[float, float]:
        """Return C of A + B x + C shape by least squares, and the sum of squares left of a free force."""
        shape = self.free(shape)
        square = float(shape @ shape)
        left = float(shape @ force_N) / square if square > 0.0 else 0.0
        residual = force_N - left * shape
        return left, float(residual @ residual)


def has_transient(distance_mm: np.ndarray, force_N: np.ndarray, length_mm: float) -> bool:
    """Return whether C of F = A + B x + C exp(-x / length) is clearly not 0; arrays of shape (n,)."""
    beside = _Beside(distance_mm, True)
    force = beside.free(force_N)
    squares = beside.fitted(_shape(distance_mm, length_mm), force)[1]
    return bool(force @ force - squares > CLEAR_TRANSIENT**2 * squares / (len(force) - 3))


def _shape(x_mm: np.ndarray, length_mm: np.ndarray | float, power: int | None = None) -> np.ndarray:
    """Return exp(-x / length), or with a power (1 - x / length)^power up to where it is 0."""
    share = x_mm / length_mm
    return np.exp(-share) if power is None else np.maximum(1.0 - share, 0.0) ** power


def _level_N(start: MotionStart) -> float | None:
    """Return the level of the plateau that the force comes up to; None where it does not come up."""
    distance, force = start.distance_mm, start.force_N
    low, high, *late = (int(distance.searchsorted(share * distance[-1])) for share in (*EARLY, *LATE))
    plateau = force[max(low, start.ramp_end) : high]
    if len(plateau) < 8:
        return None
    level, begin = np.median(plateau), float(force[0])
    below = _below(plateau, begin) or (begin < FAR_BELOW * level and _below(force[slice(*late)], begin))
    return level if level - begin > 0.02 * abs(level) and below else None


def _settled_mm(start: MotionStart, level_N: float, fitted_mm: float) -> float:
    """Return the distance at which a rise of that length is over."""
    length, ramp = float(start.distance_mm[-1]), start.plateau_mm
    if float(start.force_N[0]) > HALF_WAY * level_N and fitted_mm > SHORT * length:
        return 0.0
    reestimated = min(SETTLED * fitted_mm, max(length / 3.0, ENOUGH * fitted_mm))
    return float(max(reestimated, ramp + AFTER_RAMP * fitted_mm if ramp > 0.0 else 0.0))


def _below(plateau_N: np.ndarray, begin_N: float) -> bool:
    """Return whether the force begins below everything that the plateau shows, its noise included."""
    if len(plateau_N) < 2:
        return False
    to_noise = 1.0 / (0.6745 * math.sqrt(2.0))
    noise = np.median(np.abs(np.diff(plateau_N))) * to_noise
    return begin_N < np.quantile(plateau_N, 0.01) - 4.0 * noise


def _arrival_mm(start: MotionStart) -> float:
    """Return the distance at which the force first enters the band in which it stays late in the stroke."""
    distance, force = start.distance_mm, start.force_N
    low, high = np.searchsorted(distance, [share * distance[-1] for share in LATE])
    if high - low < 8:
        return 0.0
    return float(distance[int(np.argmax(force >= np.quantile(force[low:high], 0.02)))])


def _scale_mm(start: MotionStart, level_N: float | None) -> float:
    """Return the distance over which the force first comes up by 63 %, between samples; 0 if it does not."""
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


def _rows_within(start: MotionStart, reach_mm: float) -> int:
    """Return how many rows lie within a distance; at least 16 where there are so many."""
    return min(max(int(start.distance_mm.searchsorted(reach_mm)), 16), len(start.distance_mm))


def _rise_length_mm(
    start: MotionStart, reach_mm: float, lengths_mm: np.ndarray, sloped: bool, power: int | None = None
) -> float:
    """Return x_0 of F = A + B x - C exp(-x / x_0) by least squares on a grid of lengths, refined.

    A + B x is taken out of the force and of each exponential; the best x_0 explains most of the force's rest.
    B is 0 where the start is not `sloped`; with a `power`, the exponential is that of `_shape`.
    """
    n = _rows_within(start, reach_mm)
    beside = _Beside(start.distance_mm[:n], sloped)
    force = beside.free(start.force_N[:n])
    shapes = _shape(start.distance_mm[:n], lengths_mm[:, None], power)
    whole = np.einsum("ij,ij->i", shapes, shapes)
    rest = whole - shapes.sum(axis=1) ** 2 / n
    if sloped:
        rest -= (shapes @ beside.x) ** 2 / float(beside.x @ beside.x)
    # Of two different distances only (a coarse sensor), a straight line explains all that an exponential can.
    explained = np.divide((shapes @ force) ** 2, rest, out=np.zeros(len(rest)), where=rest > 1e-12 * whole)
    return _at_most(lengths_mm, explained)


def _at_most(lengths_mm: np.ndarray, explained: np.ndarray) -> float:
    """Return the length at which most is explained: the vertex of a parabola over the logarithm.

    The parabola goes through the best of the lengths and the two beside it, so the length never jumps.

    >>> lengths_mm, explained = np.array([1.0, 2.0, 4.0, 8.0]), np.array([0.0, 3.0, 3.0, 0.0])
    >>> round(_at_most(lengths_mm, explained), 4)  # the square root of 8
    2.8284
    """
    best, step = int(np.argmax(explained)), 0.0
    if 0 < best < len(lengths_mm) - 1:
        before, here, after = explained[best - 1 : best + 2]
        bend = before - 2.0 * here + after
        step = 0.5 * (before - after) / bend if bend < 0.0 else 0.0
    return float(lengths_mm[best] * (lengths_mm[1] / lengths_mm[0]) ** step)


def strong_wave(x: np.ndarray, values: np.ndarray, late: int) -> np.ndarray:
    """Return the sine that explains most of the variance of `values` from row `late` on, shape (n,).

    A parabola is fitted beside it. It is 0 if no sine explains half of the variance that the parabola leaves.
    `x` rises evenly from row `late` on.

    Examples
    --------
    >>> x = np.linspace(0.0, 10.0, 400)
    >>> wave = strong_wave(x, 5.0 - 4.0 * np.exp(-x) + np.sin(7.0 * x), 200)
    >>> bool(np.abs(wave - np.sin(7.0 * x)).max() < 0.05)
    True
    """
    size = max((len(x) - late) // ROWS_OF_WAVE, 1)
    n = (len(x) - late) // size
    if n < 4 * LEAST_PERIODS:
        return np.zeros(len(x))
    along, mean = (part[late : late + n * size].reshape(n, size).mean(axis=1) for part in (x, values))
    place = 2.0 * (along - along[0]) / (along[-1] - along[0]) - 1.0
    parabola = np.vander(place, 3)

    def sines(periods: float, at: np.ndarray) -> np.ndarray:
        return np.stack([np.sin(np.pi * periods * at), np.cos(np.pi * periods * at)], axis=1)

    def fitted(periods: float) -> tuple[np.ndarray, float]:
        columns = np.hstack([sines(periods, place), parabola])
        factors = np.linalg.lstsq(columns, mean, rcond=None)[0]
        return factors[:2], float(np.sum((mean - columns @ factors) ** 2))

    beside = mean - parabola @ np.linalg.lstsq(parabola, mean, rcond=None)[0]
    power = np.abs(np.fft.rfft(beside, FINER * n)) ** 2
    least, whole = LEAST_PERIODS * FINER, float(beside @ beside)
    peak = least + int(np.argmax(power[least:]))
    if not 2.0 * power[peak] > STRONG * n * whole:
        return np.zeros(len(x))
    ends = ((peak - 1) / FINER, (peak + 1) / FINER)
    periods = minimize_scalar(lambda k: fitted(k)[1], bounds=ends, method="bounded").x
    return sines(periods, 2.0 * (x - along[0]) / (along[-1] - along[0]) - 1.0) @ fitted(periods)[0]
