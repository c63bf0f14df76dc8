"""Checks of a trace: single samples that cannot be right, and a speed that is not the commanded one."""

import math
from collections.abc import Sequence
from contextlib import suppress

import numpy as np
from scipy.ndimage import median_filter

from sealfit.config import Config, Quality
from sealfit.errors import KEPT, ROW_OUT, ConfigError, Fault
from sealfit.ingest.cells import Trace
from sealfit.ingest.files import bad_file
from sealfit.ingest.strokes import Stroke, displacement_noise_mm
from sealfit.ingest.window import weighted_median
from sealfit.units import Units, conversion

NEIGHBOURS = 5  # samples of the running median: blind to one or two wrong ones, and exact on any slope
# A spike is so many times as far off as this share of the samples (of noise: 7.8 SDs); else it is a burst.
APART, USUAL = 4.0, 0.95
STEPS = 5.0  # usual steps by which a spike of displacement is off, at least


def displacement_spikes(
    displacement_mm: np.ndarray, line: np.ndarray, settings: Quality
) -> tuple[np.ndarray, list[Fault]]:
    """Return which rows to keep, shape (n,): none whose displacement jumps away and back; a finding for each.

    More than `max_bad_rows` of them are the nature of the signal, and all are kept.
    """
    keep = np.ones(len(displacement_mm), bool)
    if len(displacement_mm) < 4 * NEIGHBOURS:
        return keep, []
    off = displacement_mm - median_filter(displacement_mm, NEIGHBOURS, mode="mirror")
    # At a turn the median lags by one step of the fastest samples around, never by more than a few of the
    # usual ones.
    step = np.median(np.abs(np.diff(displacement_mm)))
    noise = displacement_noise_mm(displacement_mm)
    least = max(STEPS * step, APART * np.quantile(np.abs(off), USUAL), 1e-9 * float(np.ptp(displacement_mm)))
    spikes = np.abs(off) > max(settings.spike_sigma * noise, least)
    # At its ends the median of a motion that does not rest is a step behind.
    for end, beside in ((0, slice(1, NEIGHBOURS)), (-1, slice(-NEIGHBOURS, -1))):
        spikes[end] &= abs(off[end]) > STEPS * np.abs(np.diff(displacement_mm[beside])).max()
    spikes = np.flatnonzero(spikes)
    if len(spikes) > settings.max_bad_rows * len(off):
        return keep, []
    keep[spikes] = False
    return keep, [_spike(None, "displacement_mm", displacement_mm[i], off[i], line[i]) for i in spikes]


def force_spikes(
    force_N: np.ndarray, strokes: Sequence[Stroke], line: np.ndarray, settings: Quality
) -> tuple[np.ndarray, list[Fault]]:
    """Return which rows to keep, shape (n,): no single force far off its neighbours; a finding for each.

    "Far" is `spike_sigma` robust standard deviations of what steady samples are off the median of their
    neighbours, and apart from the bulk of these. Outside the windows, where a break-away peak may be as
    sharp, a spike must also reach beyond the rest of the trace by half of its range. More than `max_bad_rows`
    spikes are the nature of the signal: said, and kept.
    """
    keep = np.ones(len(force_N), bool)
    if len(force_N) < 4 * NEIGHBOURS:
        return keep, []
    steady = np.zeros(len(force_N), bool)
    off = force_N - median_filter(force_N, NEIGHBOURS, mode="mirror")
    for stroke in strokes:
        steady[stroke.rows] = True
    usual = off[steady] if steady.any() else off
    least = max(0.5 * resolution(force_N), 1e-9 * np.median(np.abs(force_N)), 1e-300)
    noise = max(1.4826 * np.median(np.abs(usual)), least)
    apart = APART * np.quantile(np.abs(usual), USUAL)
    suspects = np.abs(off) > max(settings.spike_sigma * noise, apart)
    rest = np.where(suspects, 0.0, force_N)  # at rest the force may be zero
    low, high = min(rest.min(), 0.0), max(rest.max(), 0.0)
    beyond = np.maximum(low - force_N, force_N - high) > 0.5 * (high - low)
    spikes = np.flatnonzero(suspects & (steady | beyond))
    count = len(spikes)
    if count > settings.max_bad_rows * len(force_N):
        reason = f"{count} samples jump away from their neighbours: too many to be single wrong samples."
        fix = "Look for stick-slip or electrical noise; filter the signal if it is the latter."
        return keep, [Fault("spikes", reason, column="force_N", value=float(count), fix=fix, **KEPT)]
    keep[spikes] = False
    number = np.searchsorted([stroke.start for stroke in strokes], spikes, side="right").tolist()
    of = number if len(strokes) > 1 else [None] * count
    return keep, [_spike(n, "force_N", force_N[i], off[i], line[i]) for n, i in zip(of, spikes, strict=True)]


def resolution(values: np.ndarray) -> float:
    """Return the smallest step between different values: the sensor's resolution if coarse, else near 0."""
    different = np.unique(values)
    return float(np.diff(different).min()) if len(different) > 1 else 0.0


def _spike(stroke: int | None, column: str, value: float, off: float, line: int) -> Fault:
    reason = f"a single sample, {abs(off):.4g} off its neighbours."
    place = {"stroke": stroke, "line": int(line), "column": column, "value": float(value)}
    return Fault("spike", reason, fix="Correct the cell if the true value is known.", **place, **ROW_OUT)


def motion_fault(trace: Trace, strokes: Sequence[Stroke], config: Config) -> Fault | None:
    """Return a fault if nothing moves in a trace, or if its angle begins anew at each turn; else None."""
    place, unit = trace.columns["displacement_mm"], config.units.unit("displacement")
    span, step = np.ptp(place), np.abs(np.diff(place)).max(initial=0.0)
    turn = None
    if step > 0.5 * span:
        with suppress(ConfigError):  # no angle
            turn = conversion("turn", unit).of_cell(1.0)
    if turn is not None and span <= turn < 2.0 * step:
        check, reason = "wrapped", "it stays within a turn and jumps from its one end to the other: it wraps."
        fix = f"Set turn = {turn:g} under [strokes]: the angle is then unwrapped, and each turn is a stroke."
    elif strokes:
        return None
    else:
        check, reason = "no_motion", f"nothing moves: displacement stays within {span:.3g} {unit}."
        fix = "Check the displacement column and its unit, or set strokes.min_travel_mm in the config."
    return bad_file(check, reason, fix, column="displacement_mm").fault


GROSS = 1.5  # factor beyond which a file contradicts itself; below it the commanded speed may be nominal


def measured_speeds(trace: Trace, strokes: Sequence[Stroke], units: Units) -> tuple[float, float]:
    """Return the mean speed of a trace, rests included, and the usual one of its strokes; magnitudes.

    The speed that was set is the first in stick-slip, and the second in a stroke with rests. Without steady
    sliding both are nan.
    """
    speed = np.abs([stroke.speed_mm_s for stroke in strokes])
    rows = np.array([len(stroke.rows) for stroke in strokes])[np.isfinite(speed)]
    if not rows.any():
        return math.nan, math.nan
    time_s, displacement = trace.columns["time_s"], trace.columns["displacement_mm"]
    path = sum(np.ptp(displacement[stroke.start : stroke.stop]) for stroke in strokes)
    mean, usual = path / (time_s[-1] - time_s[0]), weighted_median(speed[np.isfinite(speed)], rows)
    return units.speed_factor * float(mean), units.speed_factor * usual


def speed_fault(trace: Trace, strokes: Sequence[Stroke], config: Config) -> Fault | None:
    """Return a fault if time and displacement of a trace disagree with the commanded speed; else None.

    They agree if the commanded speed lies between the measured mean and that of the strokes, or misses them
    by no more than `quality.speed_disagreement`. Up to a factor of 1.5 the file is kept: every table holds
    the measured speed. Beyond, it is left out, and the fix names the mix-up that fits the factor.
    """
    commanded = trace.channels.get("speed_set_mm_s")
    if not isinstance(commanded, int | float) or not commanded > 0:
        return None
    speeds = measured_speeds(trace, strokes, config.units)
    if not 0 < min(speeds) <= max(speeds) < math.inf:
        return None
    measured = sorted((commanded, *speeds))[1]  # between the two, nearest to the commanded one
    ratio = measured / commanded
    if abs(ratio - 1) <= config.quality.speed_disagreement:
        return None
    unit = config.units.unit("speed")
    reason = f"displacement over time gives {measured:.4g} {unit}, commanded are {commanded:.4g} {unit}."
    place = {"column": "displacement_mm", "value": float(measured)}
    if 1 / GROSS <= ratio <= GROSS:
        fix = "Check the commanded speed, or slip in the drive."
        return Fault("speed_disagreement", reason, fix=fix, **place, **KEPT)
    columns = [(name, config.trace.columns.get(name)) for name in ("time_s", "displacement_mm")]
    declared = [f"{name} in {column.unit}" for name, column in columns if column and column.unit]
    first = f"Is the unit in the rig config right ({', '.join(declared)})? " if declared else ""
    fix = first + _mix_up(ratio, trace.columns["time_s"], trace.columns["displacement_mm"], config)
    return Fault("speed_disagreement", reason, action="file left out", fix=fix, **place)


def with_unit(column: str, unit: str, config: Config) -> str:
    """Return the fix for a column of traces, ours by name, whose numbers are in another unit."""
    if column in config.trace.compute:
        return f"Correct compute.{column} in the rig config."
    theirs = config.trace.their_columns.get(column, column)
    name = "" if theirs == column else f"name = {theirs!r}, "
    return f'Set {column} = {{{name}unit = "{unit}"}} under [trace.columns] in the rig config.'


def _mix_up(ratio: float, time_s: np.ndarray, displacement: np.ndarray, config: Config) -> str:
    """Return the likely fix for a measured speed that is `ratio` times the commanded one."""
    step, travel = float(np.median(np.diff(time_s))), float(np.ptp(displacement))
    time_in_ms = f"Is the time in ms? {with_unit('time_s', 'ms', config)}"
    metres = f"Is the displacement in m? {with_unit('displacement_mm', 'm', config)}"
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
    if abs(math.log(ratio / factor)) <= math.log1p(config.quality.speed_disagreement):
        return fix
    return "Check the commanded speed, the decimal mark, and the units of time and displacement."
