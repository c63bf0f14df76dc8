"""How the platform moves: rest, ramp, constant speed, ramp, and back again where a file has strokes both ways."""

from __future__ import annotations

from dataclasses import dataclass

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
        steady=(since > ramp) & (since < ramp + cruise) & (along > STEADY_LENGTHS * design.stiffness_mm),
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
    r"""Return the friction with its pre-sliding rise, shape (n,).

    .. math:: F(x) = F_{steady} (1 - e^{-x/x_0}) + F_{before} e^{-x/x_0}

    the solution of Eqs. 2 and 3 in the distance x at constant speed, with x_0 = g / sigma_0; F_before is what the last
    stroke left behind, nothing in a file's first.
    """
    left = np.exp(-motion.distance_mm / stiffness_mm)
    result = friction_N * (1.0 - left)
    for stroke in range(2, int(motion.stroke[-1]) + 1):
        own = motion.stroke == stroke
        result[own] += result[np.flatnonzero(motion.stroke == stroke - 1)[-1]] * left[own]
    return result
