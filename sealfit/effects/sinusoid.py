r"""Sine of any channel: along time it is what the mains, a servo or a pump adds.

.. math:: h = A \sin(2 \pi x / \lambda + \varphi)

Along position the same form is a ripple, which has a mechanism and a file of its own.
"""

from __future__ import annotations

import numpy as np

from sealfit.effects.averaged import left_of_wave
from sealfit.effects.contract import AMPLITUDE, CHANNEL, Effect, Parameter


def shape(inputs, *, A, lambda_, phi):
    """Sine of the channel, shape (n,), in the unit of A."""
    angle = 2 * np.pi * np.asarray(inputs[CHANNEL], dtype=float) / lambda_ + phi
    return A * np.sin(angle) * left_of_wave(inputs, CHANNEL, lambda_)


SINUSOID = Effect(
    id="sinusoid",
    label="periodic in {x}",
    equation=r"h = A \sin(2 \pi x / \lambda + \varphi)",
    form="A sin(2 pi x / lambda + phi)",
    reference="mean over a wavelength",
    reads=(CHANNEL,),
    acts_on=(("force", "add"), ("mu", "multiply"), ("force", "multiply")),
    parameters=(
        Parameter("A", "{y}", 0.1, AMPLITUDE, "amplitude", linear=True),
        Parameter("lambda_", "{x}", 1.0, (1e-6, 1e9), "period", search="span"),
        Parameter("phi", "rad", 0.0, (-4 * np.pi, 4 * np.pi), "phase at 0", search=tuple(np.arange(4) * np.pi / 4)),
    ),
    shape=shape,
    source="Form: ours. The first Fourier term of anything periodic.",
    # By hand: 0.02 of a period of 0.04 is half a turn, and sin(pi + pi/6) = -sin(pi/6) = -1/2.
    worked=({"x": 0.02}, {"A": 4.0, "lambda_": 0.04, "phi": np.pi / 6}, -2.0),
    physical=False,
)
