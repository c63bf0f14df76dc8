"""How the platform moves: rest, ramp, constant speed, ramp, and back again where a file has strokes both ways."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from sealfit.simulation.design import STEADY_LENGTHS, Design

TICK_S = 1e-5  # time is logged to this; sampling intervals are whole ticks


@dataclass(frozen=True, slots=True)
class Motion:
    """One file's motion, sampled: arrays of shape (n,), and the rows of steady sliding."""

    time_s: np.ndarray  # the file's own clock
    stroke_time_s: np.ndarray  # what sealfit calls time_s: from the stroke's start in a file of several strokes
    displacement_mm: np.ndarray
    distance_mm: np.ndarray
    speed_mm_s: np.ndarray  # signed; zero at rest
    direction: np.ndarray
    stroke: np.ndarray
    cruising: np.ndarray  # bool: between the ramps
    steady: np.ndarray


def move(design: Design, speed_mm_s: float, direction: int, start_mm: float) -> Motion:
    """Return the motion of one file.

    Parameters
    ----------
    design : Design
        Stroke, ramp, rest and sampling.
    speed_mm_s : float
        Real speed of the platform, magnitude.
    direction : int
        +1 or -1: direction of the first stroke. The others alternate.
    start_mm : float
        Lower end of the stroke in the rig's coordinate.
    """
    length = design.stroke_mm
    ramp = min(design.ramp_s, 0.1 * length / speed_mm_s)
    rest = min(design.dwell_s, 0.1 * length / speed_mm_s)
    cruise = length / speed_mm_s - ramp
    period = rest + 2.0 * ramp + cruise
    total = design.strokes_per_file * period + 0.5 * rest
    step = max(1.0 / design.sampling_Hz, total / (design.max_rows - 1))
    step = np.ceil(np.round(step / TICK_S, 6)) * TICK_S
    time = np.round(np.arange(int(total / step) + 1) * step, 5)
    number = np.minimum((time / period).astype(int), design.strokes_per_file - 1)
    since = time - number * period - rest  # since the stroke began to move
    along, speed = _trapezoid(since, ramp, cruise, speed_mm_s, length)
    cruising = (since > ramp) & (since < ramp + cruise)
    settled = 0.5 * speed_mm_s * ramp + STEADY_LENGTHS * design.stiffness_mm
    sign = direction * np.where(number % 2, -1, 1)
    both = design.strokes_per_file > 1
    return Motion(
        time_s=time,
        stroke_time_s=np.maximum(since, 0.0) if both else time,
        displacement_mm=start_mm + np.where(sign > 0, along, length - along),
        distance_mm=along,
        speed_mm_s=sign * speed,
        direction=sign,
        stroke=number + 1,
        cruising=cruising,
        steady=cruising & (along > settled),
    )


def _trapezoid(
    since: np.ndarray, ramp: float, cruise: float, speed: float, length: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return distance and speed of one stroke, `since` seconds after it began to move."""
    left = 2.0 * ramp + cruise - since
    up, down = since < ramp, left < ramp
    rate = speed / ramp if ramp > 0.0 else 0.0
    distance = np.where(
        up, 0.5 * rate * since**2, np.where(down, length - 0.5 * rate * left**2, speed * (since - 0.5 * ramp))
    )
    moving = (since > 0.0) & (left > 0.0)
    distance = np.where(moving, distance, np.where(since > 0.0, length, 0.0))
    now = np.where(up, rate * since, np.where(down, rate * left, speed))
    return distance, np.where(moving, now, 0.0)


def with_presliding(friction_N: np.ndarray, motion: Motion, stiffness_mm: float) -> np.ndarray:
    r"""Return the friction with what the bristles make of it where the speed changes, shape (n,).

    .. math:: dF/dx = (F_{steady} - F) / x_0

    which is Eq. 2 over the distance x, with x_0 = g / sigma_0 taken as constant: the force rises from rest over x_0,
    passes a break-away where the ramp is longer than that, follows a stop as far as x_0 lets it, and holds at rest.
    While the speed is constant only what is left of the start decays, so the truth of steady sliding has no lag.

    Parameters
    ----------
    friction_N : ndarray, shape (n,)
        Force of steady sliding at every row's speed.
    motion : Motion
        The rows.
    stiffness_mm : float
        x_0 in mm.
    """
    left = np.exp(-np.abs(np.diff(motion.displacement_mm, prepend=motion.displacement_mm[0])) / stiffness_mm).tolist()
    result = friction_N.astype(float)
    phase = 2 * motion.stroke + motion.cruising
    edges = np.flatnonzero(np.diff(phase, prepend=-1, append=-1))
    force = 0.0
    for first, last in pairwise(edges.tolist()):
        if motion.cruising[first]:
            slid = np.abs(motion.displacement_mm[first:last] - motion.displacement_mm[first])
            result[first:last] += (force - friction_N[first]) * left[first] * np.exp(-slid / stiffness_mm)
            force = float(result[last - 1])
            continue
        for row, target in enumerate(friction_N[first:last].tolist(), start=first):
            force = target + (force - target) * left[row]
            result[row] = force
    return result
