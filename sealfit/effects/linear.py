r"""Straight line in any channel, zero at its reference.

.. math:: h = A (x - x_{ref})

Along `run_order` it is the drift along the campaign counted in runs.
"""

from __future__ import annotations

import numpy as np

from sealfit.effects.contract import AMPLITUDE, ANYWHERE, CHANNEL, Effect, Parameter, reference


def shape(inputs, *, A):
    """Straight line, shape (n,), in the unit of A times that of the channel."""
    return A * (np.asarray(inputs[CHANNEL], dtype=float) - reference(inputs, CHANNEL, 0.0))


LINEAR = Effect(
    id="linear",
    label="linear in {x}",
    equation=r"h = A (x - x_{ref})",
    form="A (x - x_ref)",
    reference="{x} = {x_ref}",
    reads=(CHANNEL,),
    acts_on=ANYWHERE,
    parameters=(Parameter("A", "{y}/{x}", 0.01, AMPLITUDE, "slope", linear=True),),
    shape=shape,
    source="Form: ours. First order of any smooth dependence.",
    # By hand: 0.5 * (7 - 3).
    worked=({"x": 7.0, "x_ref": 3.0}, {"A": 0.5}, 2.0),
    physical=False,
)
