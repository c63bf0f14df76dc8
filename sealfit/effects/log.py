r"""Logarithm of any positive channel, zero at its reference.

.. math:: h = A \ln(x / x_{ref})

A is the change per factor e of the channel; NaN where the channel is not positive.
"""

from __future__ import annotations

import numpy as np

from sealfit.effects.contract import AMPLITUDE, ANYWHERE, CHANNEL, Effect, Parameter, positive, reference


def shape(inputs, *, A):
    """Logarithm, shape (n,), in the unit of A."""
    return A * np.log(positive(inputs[CHANNEL]) / positive(reference(inputs, CHANNEL, 1.0)))


LOG = Effect(
    id="log",
    label="logarithmic in {x}",
    equation=r"h = A \ln(x / x_{ref})",
    form="A ln(x / x_ref)",
    reference="{x} = {x_ref}",
    reads=(CHANNEL,),
    acts_on=ANYWHERE,
    parameters=(Parameter("A", "{y}", 0.05, AMPLITUDE, "change per factor e of the channel", linear=True),),
    shape=shape,
    source="Form: ours. The dependence that is alike in every decade.",
    # By hand: ten times the reference, ln 10 = 2.302585092994046.
    worked=({"x": 30.0, "x_ref": 3.0}, {"A": 0.5}, 0.5 * 2.302585092994046),
    physical=False,
)
