r"""Sine of any channel with its second harmonic: what repeats in each period but is no pure sine.

.. math:: h = A \sin(2 \pi x / \lambda + \varphi) + B \sin(4 \pi x / \lambda + \varphi_2)

A shaft that is bent and joined askew, or a motor's torque with its pole pairs, gives once and twice per turn. The loop
finds harmonics one at a time, as a ripple or a sine each with a period of its own, and does not try this form; it is
for simulated campaigns and for effects of one's own.
"""

from __future__ import annotations

import numpy as np

from sealfit.effects.averaged import left_of_wave
from sealfit.effects.contract import AMPLITUDE, CHANNEL, Effect, Parameter

TURN = 4 * np.pi  # two turns either way: a phase may pass its end


def shape(inputs, *, A, B, lambda_, phi, phi_2):
    """Sum of two sines of the channel, shape (n,), in the unit of A and B."""
    angle = 2 * np.pi * np.asarray(inputs[CHANNEL], dtype=float) / lambda_
    once, twice = (left_of_wave(inputs, CHANNEL, lambda_ / k) for k in (1, 2))
    return A * np.sin(angle + phi) * once + B * np.sin(2 * angle + phi_2) * twice


SINUSOID_HARMONICS = Effect(
    id="sinusoid_harmonics",
    label="periodic in {x}, with a second harmonic",
    equation=r"h = A \sin(2 \pi x / \lambda + \varphi) + B \sin(4 \pi x / \lambda + \varphi_2)",
    form="A sin(2 pi x / lambda + phi) + B sin(4 pi x / lambda + phi_2)",
    reference="mean over a wavelength",
    reads=(CHANNEL,),
    acts_on=(("force", "add"), ("mu", "multiply"), ("force", "multiply")),
    parameters=(
        Parameter("A", "{y}", 0.1, AMPLITUDE, "amplitude once per period", linear=True),
        Parameter("B", "{y}", 0.05, AMPLITUDE, "amplitude twice per period", linear=True),
        Parameter("lambda_", "{x}", 1.0, (1e-6, 1e9), "period", search="span"),
        Parameter("phi", "rad", 0.0, (-TURN, TURN), "phase at 0", search=tuple(np.arange(4) * np.pi / 4)),
        Parameter(
            "phi_2", "rad", 0.0, (-TURN, TURN), "phase of the harmonic at 0", search=tuple(np.arange(4) * np.pi / 4)
        ),
    ),
    shape=shape,
    source="Form: ours. The first two Fourier terms of anything periodic.",
    # By hand: 0.02 of a period of 0.04 is half a turn: 4 sin(pi + pi/6) = -2; a whole one: 1.5 sin(2 pi + pi/2) = 1.5.
    worked=({"x": 0.02}, {"A": 4.0, "B": 1.5, "lambda_": 0.04, "phi": np.pi / 6, "phi_2": np.pi / 2}, -0.5),
    physical=False,
)
