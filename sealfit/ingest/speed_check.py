"""Does the displacement move as fast as commanded? A factor that is wrong in a known way names the unit mixed up."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from sealfit.config import Config
from sealfit.errors import Fault
from sealfit.ingest.pieces import Pieces, quantile
from sealfit.ingest.refs import TraceRef
from sealfit.ingest.speed_unit import speed_factor
from sealfit.ingest.strokes import displacement_noises_mm

BLOCKS = 100  # pieces that one or two strokes are cut into: long enough to average noise out, short beside a stroke
FEWEST = 6  # pieces of which a noisy trace is cut at least: a rest at either end, and sliding between
NOISE_OF_PATH = 0.1  # noise of a step between the means of two pieces, as a share of the step
GROSS = 1.5  # beyond this factor the file contradicts itself and is left out; below, the commanded speed may be nominal


def measured_speed(time_s: np.ndarray, displacement_mm: np.ndarray) -> tuple[float, float]:
    """Return the mean speed of a trace, rests included, and its plateau speed: see `measured_speeds`.

    Examples
    --------
    >>> t = np.linspace(0.0, 10.0, 201)
    >>> mean, plateau = measured_speed(t, np.where(t < 5, 3 * t, 15.0))  # slides at 3 mm/s, then rests
    >>> round(mean, 6), round(plateau, 6)
    (1.5, 3.0)
    """
    mean, plateau = measured_speeds(time_s, displacement_mm, Pieces([len(time_s)]))
    return float(mean[0]), float(plateau[0])


def measured_speeds(time_s: np.ndarray, displacement_mm: np.ndarray, traces: Pieces) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean speed of every trace, rests included, and its plateau speed; magnitudes, nan if there is none.

    Parameters
    ----------
    time_s, displacement_mm : ndarray, shape (n,)
        Rising time and displacement of traces, one after the other, in any unit; the speeds are in their quotient.
    traces : Pieces
        Where each of them lies.

    Notes
    -----
    A trace is cut into 100 pieces, or 50 per stroke. The mean is that of all pieces; the plateau is the median of
    those faster than half their 90th percentile, so rests, turns and ramps do not count. In stick-slip the speed that
    was set is the mean, in a stroke with rests it is the plateau; elsewhere the two agree.
    """
    pieces = np.full(len(traces), BLOCKS)
    for i in np.flatnonzero(~_slides_once(displacement_mm, traces)).tolist():
        pieces[i] *= max(1, _strokes(displacement_mm[traces.slices[i]]) // 2)
    cuts = np.minimum(traces.size, pieces + 1)
    mean, plateau = np.full(len(traces), np.nan), np.full(len(traces), np.nan)
    for count in np.unique(cuts[cuts > 1]).tolist():
        alike = np.flatnonzero(cuts == count)
        at = np.linspace(0, traces.size[alike] - 1, count, axis=1).astype(np.int64) + traces.start[alike, None]
        mean[alike], plateau[alike] = _of_cuts(time_s[at], displacement_mm[at])
    return mean, plateau


def _of_cuts(time_s: np.ndarray, displacement_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and plateau of traces of which so many rows are given, shape (traces, rows)."""
    with np.errstate(all="ignore"):  # beyond 1e308 there is no speed: nan or inf, and no check
        path, time = np.abs(np.diff(displacement_mm)), np.diff(time_s)
        speeds = np.sort(path / time)
        usual = np.quantile(speeds, 0.9, axis=1)
        slow = (speeds <= 0.5 * usual[:, None]).sum(axis=1)
        fast = speeds.shape[1] - slow
        # The middle of those that are faster, which stand at the end.
        ends = np.minimum(slow + np.array([(fast - 1) // 2, fast // 2]), speeds.shape[1] - 1)
        low, high = np.take_along_axis(speeds, ends.T, axis=1).T
        return path.sum(axis=1) / time.sum(axis=1), np.where(fast > 0, (low + high) / 2.0, np.nan)


def _slides_once(displacement_mm: np.ndarray, traces: Pieces) -> np.ndarray:
    """Return which traces surely hold less than four strokes, shape (traces,).

    A stroke, as `_strokes` counts it, covers half of what lies between the 1st and the 99th percentile. Where a
    hundredth of the samples lies in the tenth at either end, that is 0.4 of the range.
    """
    low, high = traces.min(displacement_mm), traces.max(displacement_mm)
    tenth, few = 0.1 * (high - low), 0.01 * (traces.size - 1) + 1.0
    below = traces.sum(displacement_mm <= traces.spread(low + tenth))
    above = traces.sum(displacement_mm >= traces.spread(high - tenth))
    path = traces.sum(np.abs(traces.steps(displacement_mm)))
    return (below >= few + 1.0) & (above >= few + 1.0) & (path < 4.0 * 0.4 * (high - low))


def _strokes(displacement_mm: np.ndarray) -> int:
    """Return how often the trace goes from its lowest quarter to its highest or back: roughly, its strokes."""
    low, high = quantile(displacement_mm, 0.01), quantile(displacement_mm, 0.99)
    ends = displacement_mm[
        (displacement_mm < low + 0.25 * (high - low)) | (displacement_mm > high - 0.25 * (high - low))
    ]
    return int(np.count_nonzero(np.diff(ends > 0.5 * (low + high))))


def speed_faults(
    time_s: np.ndarray, displacement_mm: np.ndarray, traces: Pieces, refs: Sequence[TraceRef], config: Config
) -> list[Fault | None]:
    """Return, for every trace, a fault if time and displacement disagree with the commanded speed.

    None if they agree or no speed is commanded. They agree if the commanded speed lies between the measured mean and
    the plateau, or misses them by no more than `quality.speed_disagreement`. Up to a factor of 1.5 the file is kept
    with a warning: every table holds the measured speed. Beyond, the file is left out, and the fix names the mix-up
    that fits the factor. Arguments as in `measured_speeds`.
    """
    commanded = [_commanded(ref) for ref in refs]
    if not any(commanded):
        return [None] * len(refs)
    factor = speed_factor(config.units)
    speeds = (factor * speed for speed in measured_speeds(time_s, displacement_mm, traces))
    faults: list[Fault | None] = []
    for ref, speed, mean, plateau, own in zip(
        refs, commanded, *(s.tolist() for s in speeds), traces.slices, strict=True
    ):
        fault = None
        if speed and 0 < plateau < math.inf and mean < math.inf:  # else nothing moves: said where strokes are sought
            fault = _disagreement(ref, speed, mean, plateau, time_s[own], displacement_mm[own], config)
        faults.append(fault)
    return faults


def _commanded(ref: TraceRef) -> float | None:
    speed = ref.channels.get("speed_set_mm_s")
    return speed if isinstance(speed, int | float) and speed > 0 else None


def _disagreement(
    ref: TraceRef,
    commanded: float,
    mean: float,
    plateau: float,
    time_s: np.ndarray,
    displacement: np.ndarray,
    config: Config,
) -> Fault | None:
    tolerance = config.quality.speed_disagreement
    measured = _nearest(commanded, mean, plateau)
    if abs(measured / commanded - 1) <= tolerance:
        return None
    of_means = speed_factor(config.units) * np.array(_speeds_of_means(time_s, displacement))
    if np.isfinite(of_means).all():
        measured = _nearest(commanded, *of_means.tolist())
    ratio = measured / commanded
    if abs(ratio - 1) <= tolerance:
        return None
    unit = config.units.unit("speed")
    reason = f"displacement over time gives {measured:.4g} {unit}, commanded are {commanded:.4g} {unit}."
    gross = not 1 / GROSS <= ratio <= GROSS
    fix = (
        _mix_up(ratio, time_s, displacement, tolerance) if gross else "Check the commanded speed, or slip in the drive."
    )
    return Fault(
        "speed_disagreement",
        reason,
        file=ref.file,
        column="displacement_mm",
        value=measured,
        severity="error" if gross else "warning",
        action="file left out" if gross else "kept",
        fix=fix,
    )


def _nearest(commanded: float, mean: float, plateau: float) -> float:
    """Return what lies between the mean and the plateau speed and nearest to the commanded one."""
    return min(max(commanded, min(mean, plateau)), max(mean, plateau))


def _speeds_of_means(time_s: np.ndarray, displacement_mm: np.ndarray) -> tuple[float, float]:
    """Return mean and plateau speed of one trace from the means of pieces, as few as its noise asks for; else nan.

    The mean of a piece of m samples has a noise of sd / sqrt(m), and two make a step; the path of `count` steps is
    longer by noise that must stay small beside the travel.
    """
    n, travel = len(time_s), float(np.ptp(displacement_mm))
    noise = float(displacement_noises_mm(displacement_mm, Pieces([n]))[0])
    if noise <= 0.0 or n < 2 * FEWEST:
        return math.nan, math.nan
    count = int((NOISE_OF_PATH * travel / noise * math.sqrt(n / 2.0)) ** (2.0 / 3.0))
    if not FEWEST <= count < BLOCKS:
        return math.nan, math.nan
    cut = np.linspace(0, n, count + 1).astype(np.int64)
    means = [np.add.reduceat(values, cut[:-1]) / np.diff(cut) for values in (time_s, displacement_mm)]
    mean, plateau = _of_cuts(*(values[None, :] for values in means))
    return float(mean[0]), float(plateau[0])


def _mix_up(ratio: float, time_s: np.ndarray, displacement: np.ndarray, tolerance: float) -> str:
    """Return the likely fix for a measured speed that is `ratio` times the commanded one."""
    step, travel = float(np.median(np.diff(time_s))), float(np.ptp(displacement))
    time_in_ms = 'Is the time in ms? Set compute.time_s = "time_ms / 1000" in the rig config.'
    metres = "Is the displacement in m? Compute displacement_mm from it, times 1000."
    known = (
        # Both are a factor of 1000: rigs sample faster than once a second and travel farther than 1 mm.
        (1e-3, time_in_ms if step >= 0.5 or travel >= 1.0 else metres),
        (1e3, "Is the displacement in µm, or the commanded speed in m/s?"),
        (1e-6, "Is the time in µs, or in ms with the displacement in m?"),
        (0.1, "Is the displacement in cm?"),
        (10.0, "Is the commanded speed in cm/s?"),
        (1 / 25.4, "Is the displacement in inches?"),
        (60.0, "Is the time in minutes?"),
        (1 / 60.0, "Is the commanded speed per minute, not per second?"),
        (3600.0, "Is the time in hours?"),
        (1000.0 / 60.0, "Is the commanded speed in m/min?"),
    )
    factor, fix = min(known, key=lambda row: abs(math.log(ratio / row[0])))
    if abs(math.log(ratio / factor)) <= math.log1p(tolerance):
        return fix
    return "Check the commanded speed, the decimal mark, and the units of time and displacement."
