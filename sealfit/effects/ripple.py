r"""Ripple along the rig's position: what a screw, a guide or a worn spot adds once per turn.

A lead screw with a pitch error, a bent shaft or an eccentric coupling pushes once per turn, so the force is periodic
in the rig's own coordinate, with the pitch (or a whole fraction of it, for a screw of several starts) as wavelength.
The push is an added force, the same both ways, when the drive strains the sensor; it follows the friction when the
contact's pressure or surface repeats along the track. A harmonic is a further ripple of half or a third of the
wavelength.

.. math:: h = A \sin(2 \pi x / \lambda + \varphi)

The wavelength holds within the run that it was fitted to; positions beyond it are extrapolated in phase.
"""

from __future__ import annotations

import numpy as np

from sealfit.effects.averaged import left_of_wave
from sealfit.effects.contract import AMPLITUDE, Effect, Parameter


def shape(inputs, *, A, lambda_, phi):
    """Sine of the position, shape (n,), in the unit of A; `displacement_mm` in its slot's unit."""
    angle = 2 * np.pi * np.asarray(inputs["displacement_mm"], dtype=float) / lambda_ + phi
    return A * np.sin(angle) * left_of_wave(inputs, "displacement_mm", lambda_)


RIPPLE = Effect(
    id="ripple",
    label="ripple along the rig's position",
    equation=r"h = A \sin(2 \pi x / \lambda + \varphi)",
    form="A sin(2 pi x / lambda + phi)",
    reference="mean over a wavelength",
    reads=("displacement_mm",),
    acts_on=(("force", "add"), ("mu", "multiply"), ("force", "multiply")),
    parameters=(
        Parameter("A", "{y}", 0.1, AMPLITUDE, "amplitude", linear=True),
        Parameter(
            "lambda_", "{x}", 2.0, (1e-4, 1e6), "wavelength: pitch of the screw, or its whole fraction", search="span"
        ),
        Parameter(
            "phi", "rad", 0.0, (-4 * np.pi, 4 * np.pi), "phase at position 0", search=tuple(np.arange(4) * np.pi / 4)
        ),
    ),
    shape=shape,
    source="Form: ours. A cyclic error of a screw is periodic in its angle; the sine is its first Fourier term.",
    # By hand: 0.5 mm of a 2 mm pitch is a quarter turn, pi/2; with phi = pi/3 the sine is cos(pi/3) = 1/2.
    worked=({"displacement_mm": 0.5}, {"A": 3.0, "lambda_": 2.0, "phi": np.pi / 3}, 1.5),
)
