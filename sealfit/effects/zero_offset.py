r"""Zero offset of the force channel: a constant added force, the same both ways.

.. math:: h = A

Seen as the half-sum of forward and backward force; with one direction only it cannot be told from friction that does
not depend on speed. It reads the direction because only that tells it from mu. Below the sensor's accuracy it says
nothing.
"""

from __future__ import annotations

import numpy as np

from sealfit.effects.contract import AMPLITUDE, Effect, Parameter


def shape(inputs, *, A):
    """Added force, shape (n,), in the force slot's unit."""
    return A * np.ones_like(np.asarray(inputs["direction"], dtype=float))


ZERO_OFFSET = Effect(
    id="zero_offset",
    label="zero offset of the force",
    equation=r"h = A",
    form="A",
    reference="zero offset removed",
    reads=("direction",),
    acts_on=(("force", "add"),),
    parameters=(Parameter("A", "{y}", 0.1, AMPLITUDE, "force shown when none acts", linear=True),),
    shape=shape,
    source="Form: ours. Definition of a zero offset.",
    # By hand: the offset itself, whichever way the sample moves.
    worked=({"direction": -1.0}, {"A": 0.3}, 0.3),
)
