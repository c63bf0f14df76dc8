"""Single samples that cannot be right: a displacement that jumps away and back, a force far off its neighbours."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sealfit.config import Quality
from sealfit.errors import Fault
from sealfit.ingest.pieces import Pieces, median, quantile
from sealfit.ingest.running import running_median
from sealfit.ingest.strokes import Stroke, displacement_noises_mm

NEIGHBOURS = 5  # a median over five samples is blind to one or two wrong ones, and exact on any slope
# A spike stands apart, four times as far off as 95 % of the samples (of noise: 7.8 SDs); else it is one of many bursts.
APART, USUAL = 4.0, 0.95
STEPS = 5.0  # a spike of displacement is off by more than so many of the usual steps: see `displacement_spikes`
FIX = "Correct the cell if the true value is known."


def displacement_suspects(
    displacement_mm: np.ndarray, traces: Pieces, noise_mm: np.ndarray, settings: Quality
) -> np.ndarray:
    """Return which traces may hold a spike of displacement, shape (traces,): of the others none is found."""
    off = np.abs(displacement_mm - running_median(displacement_mm, traces, NEIGHBOURS, "mirror"))
    farthest = traces.max(off)
    # Where more than half of the steps are as large as a share of the farthest, so is their median.
    large = np.abs(traces.steps(displacement_mm)) >= traces.spread(farthest * ((1.0 + 1e-9) / STEPS))
    return (
        (traces.size >= 4 * NEIGHBOURS)
        & (farthest > settings.spike_sigma * noise_mm)
        & (2 * traces.sum(large) < traces.size + 1)
    )


def force_suspects(force_N: np.ndarray, steady: np.ndarray, traces: Pieces, settings: Quality) -> np.ndarray:
    """Return which traces may hold a spike of force, shape (traces,): of the others none is found."""
    off = np.abs(force_N - running_median(force_N, traces, NEIGHBOURS, "mirror"))
    # Where more than half of the usual samples are off by a share of the farthest, so is their median.
    noisy = off >= traces.spread(traces.max(off) * ((1.0 + 1e-9) / (1.4826 * settings.spike_sigma)))
    usual = traces.sum(steady)
    usual, noisy = np.where(usual > 0, (usual, traces.sum(noisy & steady)), (traces.size, traces.sum(noisy)))
    may = (traces.size >= 4 * NEIGHBOURS) & (2 * noisy < usual + 2)
    if not may.any():
        return may
    limit = np.full(len(traces), np.inf)
    for i in np.flatnonzero(may).tolist():
        own = off[traces.slices[i]]
        inside = own[steady[traces.slices[i]]]
        limit[i] = settings.spike_sigma * (1.4826 * median(inside if len(inside) else own))
    far = off > traces.spread(limit)
    return traces.sum(far & (steady | _beyond(force_N, far, traces))) > 0


def _beyond(force_N: np.ndarray, suspects: np.ndarray, traces: Pieces) -> np.ndarray:
    """Return which samples reach beyond their trace without its suspects by half of its range, shape (n,)."""
    rest = np.where(suspects, 0.0, force_N)  # at rest the force may be zero
    low, high = np.minimum(traces.min(rest), 0.0), np.maximum(traces.max(rest), 0.0)
    reach = np.maximum(traces.spread(low) - force_N, force_N - traces.spread(high))
    return reach > traces.spread(0.5 * (high - low))


def displacement_spikes(
    file: str, displacement_mm: np.ndarray, line: np.ndarray, settings: Quality
) -> tuple[np.ndarray, list[Fault]]:
    """Return which rows to keep, shape (n,): not those whose displacement jumps away and back; a finding for each.

    More than `max_bad_rows` of them are the nature of the signal, and all are kept.
    """
    keep = np.ones(len(displacement_mm), bool)
    if len(displacement_mm) < 4 * NEIGHBOURS:
        return keep, []
    one = Pieces([len(displacement_mm)])
    off = displacement_mm - running_median(displacement_mm, one, NEIGHBOURS, "mirror")
    # At a turn the median lags by one step of the fastest samples around, never by more than a few of the usual ones.
    step = median(np.abs(np.diff(displacement_mm)))
    (noise,) = displacement_noises_mm(displacement_mm, one)
    least = max(STEPS * step, APART * quantile(np.abs(off), USUAL), 1e-9 * float(np.ptp(displacement_mm)))
    spikes = np.flatnonzero(np.abs(off) > max(settings.spike_sigma * noise, least))
    if len(spikes) > settings.max_bad_rows * len(off):
        return keep, []
    keep[spikes] = False
    return keep, [_spike(file, None, "displacement_mm", displacement_mm[i], off[i], line[i]) for i in spikes]


def force_spikes(
    file: str, force_N: np.ndarray, strokes: Sequence[Stroke], line: np.ndarray, settings: Quality
) -> tuple[np.ndarray, list[Fault]]:
    """Return which rows to keep, shape (n,): not single samples of force far off their neighbours; a finding for each.

    "Far" is `spike_sigma` robust standard deviations of what the samples of the steady windows are off the median of
    their neighbours, and apart from the bulk of these. Outside the windows, where a break-away peak may be as sharp,
    a spike must also reach beyond the rest of the trace by half of its range. More than `max_bad_rows` spikes are the
    nature of the signal: said, and kept.
    """
    keep = np.ones(len(force_N), bool)
    if len(force_N) < 4 * NEIGHBOURS:
        return keep, []
    one, steady = Pieces([len(force_N)]), np.zeros(len(force_N), bool)
    off = force_N - running_median(force_N, one, NEIGHBOURS, "mirror")
    for stroke in strokes:
        steady[stroke.rows] = True
    usual = off[steady] if steady.any() else off
    least = max(0.5 * resolution(force_N), 1e-9 * median(np.abs(force_N)), 1e-300)
    noise = max(1.4826 * median(np.abs(usual)), least)
    apart = APART * quantile(np.abs(usual), USUAL)
    suspects = np.abs(off) > max(settings.spike_sigma * noise, apart)
    if not suspects.any():
        return keep, []
    spikes = np.flatnonzero(suspects & (steady | _beyond(force_N, suspects, one)))
    if len(spikes) > settings.max_bad_rows * len(force_N):
        reason = f"{len(spikes)} samples jump away from their neighbours: too many to be single wrong samples."
        fix = "Look for stick-slip or electrical noise; filter the signal if it is the latter."
        value = float(len(spikes))
        return keep, [
            Fault("spikes", reason, file, None, None, "force_N", value, severity="warning", action="kept", fix=fix)
        ]
    keep[spikes] = False
    starts = np.array([stroke.start for stroke in strokes])
    several = len(strokes) > 1
    found = []
    for i in spikes:
        number = int(np.searchsorted(starts, i, side="right")) if several else None
        found.append(_spike(file, number, "force_N", force_N[i], off[i], line[i]))
    return keep, found


def resolution(values: np.ndarray) -> float:
    """Return the smallest step between different values: the sensor's resolution if coarse, else next to nothing."""
    different = np.unique(values)
    return float(np.diff(different).min()) if len(different) > 1 else 0.0


def _spike(file: str, stroke: int | None, column: str, value: float, off: float, line: int) -> Fault:
    return Fault(
        "spike",
        f"a single sample, {abs(off):.4g} off its neighbours.",
        file=file,
        stroke=stroke,
        line=int(line),
        column=column,
        value=float(value),
        severity="warning",
        action="row left out",
        fix=FIX,
    )
