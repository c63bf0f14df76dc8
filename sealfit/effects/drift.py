r"""Drift of the force channel along a record: a strain-gauge bridge or its amplifier warming up.

.. math:: h = A t

A is the rate. The force is added as it stands, with no regard to the direction of motion: an instrument does not know
which way the sample slides. Time is the file's own clock, so the drift starts anew with every file that is zeroed.
"""

from __future__ import annotations

import numpy as np

from sealfit.effects.contract import AMPLITUDE, Effect, Parameter


def shape(inputs, *, A):
    """Added force, shape (n,), in the force slot's unit; `time_s` in its slot's unit."""
    return A * np.asarray(inputs["time_s"], dtype=float)


DRIFT = Effect(
    id="drift",
    label="sensor drift in time",
    equation=r"h = A t",
    form="A t",
    reference="time 0 of the file",
    reads=("time_s",),
    acts_on=(("force", "add"),),
    parameters=(Parameter("A", "{y}/{x}", 0.01, AMPLITUDE, "drift of the force per time", linear=True),),
    shape=shape,
    source="Form: ours. First order in time of a slow change of the zero.",
    # By hand: 20 s at 0.02 N/s.
    worked=({"time_s": 20.0}, {"A": 0.02}, 0.4),
)
