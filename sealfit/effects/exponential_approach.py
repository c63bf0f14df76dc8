r"""Exponential approach to a limit, from 0, in any channel that is not negative.

.. math:: h = A (1 - e^{-x / \tau})

NaN where the channel is negative.
"""

from __future__ import annotations

import numpy as np

from sealfit.effects.contract import AMPLITUDE, ANYWHERE, CHANNEL, Effect, Parameter, not_negative


def shape(inputs, *, A, tau):
    """Approach to A, shape (n,), in the unit of A."""
    return -A * np.expm1(-not_negative(inputs[CHANNEL]) / tau)


EXPONENTIAL_APPROACH = Effect(
    id="exponential_approach",
    label="exponential approach in {x}",
    equation=r"h = A (1 - e^{-x / \tau})",
    form="A (1 - exp(-x / tau))",
    reference="{x} = 0",
    reads=(CHANNEL,),
    acts_on=ANYWHERE,
    parameters=(
        Parameter("A", "{y}", 0.1, AMPLITUDE, "limit", linear=True),
        Parameter("tau", "{x}", 1.0, (1e-6, 1e9), "scale of the approach", search="span"),
    ),
    shape=shape,
    source="Form: ours. What decays in proportion to what is left.",
    # By hand: x = tau, 1 - 1/e = 0.6321205588285577.
    worked=({"x": 3.0, "x_ref": 1.0}, {"A": 2.0, "tau": 3.0}, 2.0 * 0.6321205588285577),
    physical=False,
)
