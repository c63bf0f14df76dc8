r"""The logarithm of a channel and another channel with their product.

.. math:: h = A u w + B u + C w, \quad u = \ln(x / x_{ref}), \; w = z - z_{ref}

As `bilinear`, for a channel x that spans decades. NaN where x is not positive.
"""

from __future__ import annotations

import numpy as np

from sealfit.effects.contract import AMPLITUDE, ANYWHERE, CHANNEL, SECOND, Effect, Parameter, deviation, log_ratio


def shape(inputs, *, A, B, C):
    """Product and both terms alone, shape (n,), in the unit of what the effect gives."""
    u = log_ratio(inputs, CHANNEL)
    w = deviation(inputs, SECOND)
    return A * u * w + B * u + C * w


BILINEAR_LOG = Effect(
    id="bilinear_log",
    label="product of log {x} and {z}, and each alone",
    equation=r"h = A u w + B u + C w, \quad u = \ln(x / x_{ref}), \; w = z - z_{ref}",
    form="A u w + B u + C w, u = ln(x / x_ref), w = z - z_ref",
    reference="{x} = {x_ref} and {z} = {z_ref}",
    reads=(CHANNEL, SECOND),
    acts_on=ANYWHERE,
    parameters=(
        Parameter("A", "{y}/{z}", 0.01, AMPLITUDE, "slope of a slope", linear=True),
        Parameter("B", "{y}", 0.0, AMPLITUDE, "slope in the first channel", linear=True),
        Parameter("C", "{y}/{z}", 0.0, AMPLITUDE, "slope in the second channel", linear=True),
    ),
    shape=shape,
    source="Form: ours, the first terms of a Taylor series in ln x and z.",
    # By hand: 1 and -3: -1.5 + 1 - 6.
    worked=({"x": np.e, "x_ref": 1.0, "z": 1.0, "z_ref": 4.0}, {"A": 0.5, "B": 1.0, "C": 2.0}, -6.5),
    physical=False,
)
