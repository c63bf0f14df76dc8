"""Does the displacement move as fast as commanded? A factor that is wrong in a known way names the unit mixed up."""

from __future__ import annotations

import math

import numpy as np

from sealfit.config import Config
from sealfit.errors import Fault
from sealfit.ingest.refs import TraceRef
from sealfit.ingest.speed_unit import speed_factor

BLOCKS = 100  # pieces that one or two strokes are cut into: long enough to average noise out, short beside a stroke
GROSS = 1.5  # beyond this factor the file contradicts itself and is left out; below, the commanded speed may be nominal


def measured_speed(time_s: np.ndarray, displacement_mm: np.ndarray) -> tuple[float, float]:
    """Return the mean speed of a trace, rests included, and its plateau speed; magnitudes, nan if there is none.

    Parameters
    ----------
    time_s, displacement_mm : ndarray, shape (n,)
        Rising time and displacement, in any unit; the speeds are in their quotient.

    Notes
    -----
    The trace is cut into 100 pieces, or 50 per stroke. The mean is that of all pieces; the plateau is the median of
    those faster than half their 90th percentile, so rests, turns and ramps do not count. In stick-slip the speed that
    was set is the mean, in a stroke with rests it is the plateau; elsewhere the two agree.

    Examples
    --------
    >>> t = np.linspace(0.0, 10.0, 201)
    >>> mean, plateau = measured_speed(t, np.where(t < 5, 3 * t, 15.0))  # slides at 3 mm/s, then rests
    >>> round(mean, 6), round(plateau, 6)
    (1.5, 3.0)
    """
    pieces = BLOCKS * max(1, _strokes(displacement_mm) // 2)
    at = np.unique(np.linspace(0, len(time_s) - 1, min(len(time_s), pieces + 1)).astype(int))
    if len(at) < 2:
        return math.nan, math.nan
    with np.errstate(all="ignore"):  # beyond 1e308 there is no speed: nan or inf, and no check
        path, time = np.abs(np.diff(displacement_mm[at])), np.diff(time_s[at])
        speeds = path / time
        moving = speeds[speeds > 0.5 * np.quantile(speeds, 0.9)]
        return float(path.sum() / time.sum()), float(np.median(moving)) if len(moving) else math.nan


def _strokes(displacement_mm: np.ndarray) -> int:
    """Return how often the trace goes from its lowest quarter to its highest or back: roughly, its strokes."""
    low, high = np.quantile(displacement_mm, (0.01, 0.99))
    ends = displacement_mm[
        (displacement_mm < low + 0.25 * (high - low)) | (displacement_mm > high - 0.25 * (high - low))
    ]
    return int(np.count_nonzero(np.diff(ends > 0.5 * (low + high))))


def check_speed(time_s: np.ndarray, displacement: np.ndarray, ref: TraceRef, config: Config) -> Fault | None:
    """Return a fault if time and displacement disagree with the commanded speed, None if they agree or none is known.

    They agree if the commanded speed lies between the measured mean and the plateau, or misses them by no more than
    `quality.speed_disagreement`. Up to a factor of 1.5 the file is kept with a warning: every table holds the measured
    speed. Beyond, the file is left out, and the mend names the mix-up that fits the factor.
    """
    commanded = ref.channels.get("speed_set_mm_s")
    if not isinstance(commanded, int | float) or not commanded > 0:
        return None
    factor = speed_factor(config.units)
    mean, plateau = (factor * speed for speed in measured_speed(time_s, displacement))
    if not (0 < plateau < math.inf and mean < math.inf):
        return None  # nothing moves: said where strokes are sought
    measured = min(max(commanded, min(mean, plateau)), max(mean, plateau))  # the nearest to the commanded one
    ratio = measured / commanded
    tolerance = config.quality.speed_disagreement
    if abs(ratio - 1) <= tolerance:
        return None
    unit = config.units.unit("speed")
    reason = f"displacement over time gives {measured:.4g} {unit}, commanded are {commanded:.4g} {unit}."
    gross = not 1 / GROSS <= ratio <= GROSS
    mend = (
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
        mend=mend,
    )


def _mix_up(ratio: float, time_s: np.ndarray, displacement: np.ndarray, tolerance: float) -> str:
    """Return the likely mend for a measured speed that is `ratio` times the commanded one."""
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
    factor, mend = min(known, key=lambda row: abs(math.log(ratio / row[0])))
    if abs(math.log(ratio / factor)) <= math.log1p(tolerance):
        return mend
    return "Check the commanded speed, the decimal mark, and the units of time and displacement."
