r"""Power of any positive channel, zero at its reference.

.. math:: h = A [(x / x_{ref})^n - 1]

n = -1 is a hyperbola, n = 1 the straight line; n towards 0 is the logarithm, with A growing as 1/n. NaN where the
channel is not positive.
"""

from __future__ import annotations

import numpy as np

from sealfit.effects.contract import AMPLITUDE, ANYWHERE, CHANNEL, Effect, Parameter, positive, reference


def shape(inputs, *, A, n):
    """Power less one, shape (n,), in the unit of A."""
    # expm1 keeps all digits where the power is close to one.
    return A * np.expm1(n * np.log(positive(inputs[CHANNEL]) / positive(reference(inputs, CHANNEL, 1.0))))


POWER = Effect(
    id="power",
    label="power of {x}",
    equation=r"h = A [(x / x_{ref})^n - 1]",
    form="A ((x / x_ref)^n - 1)",
    reference="{x} = {x_ref}",
    reads=(CHANNEL,),
    acts_on=ANYWHERE,
    parameters=(
        Parameter("A", "{y}", 0.1, AMPLITUDE, "size at the reference", linear=True),
        Parameter("n", "", 0.5, (-6.0, 6.0), "exponent", search=(-3.0, -2.0, -1.0, -0.5, 0.5, 1.5, 2.0, 3.0)),
    ),
    shape=shape,
    source="Form: ours. The dependence without a scale of its own.",
    # By hand: four times the reference: 2 * (sqrt(4) - 1).
    worked=({"x": 12.0, "x_ref": 3.0}, {"A": 2.0, "n": 0.5}, 2.0),
    physical=False,
)
