r"""The logarithms of two channels with their product, the second counted from one unit below zero.

.. math:: h = A u w + B u + C w, \quad u = \ln(x / x_{ref}), \; w = \ln((1 + z) / (1 + z_{ref}))

As `bilinear`, for a channel x that spans decades and one that starts at zero and acts ever more slowly, as days of
aging do. NaN where x is not positive or z negative.
"""

from __future__ import annotations

import numpy as np

from sealfit.effects.contract import (
    AMPLITUDE,
    ANYWHERE,
    CHANNEL,
    SECOND,
    Effect,
    Parameter,
    log_ratio,
    log_ratio_from_zero,
)


def shape(inputs, *, A, B, C):
    """Product and both terms alone, shape (n,), in the unit of what the effect gives."""
    u = log_ratio(inputs, CHANNEL)
    w = log_ratio_from_zero(inputs, SECOND)
    return A * u * w + B * u + C * w


BILINEAR_LOGS = Effect(
    id="bilinear_logs",
    label="product of log {x} and log of 1 + {z}, and each alone",
    equation=r"h = A u w + B u + C w, \quad u = \ln(x / x_{ref}), \; w = \ln((1 + z) / (1 + z_{ref}))",
    form="A u w + B u + C w, u = ln(x / x_ref), w = ln((1 + z) / (1 + z_ref))",
    reference="{x} = {x_ref} and {z} = {z_ref}",
    reads=(CHANNEL, SECOND),
    acts_on=ANYWHERE,
    parameters=(
        Parameter("A", "{y}", 0.01, AMPLITUDE, "slope of a slope", linear=True),
        Parameter("B", "{y}", 0.0, AMPLITUDE, "slope in the first channel", linear=True),
        Parameter("C", "{y}", 0.0, AMPLITUDE, "slope in the second channel", linear=True),
    ),
    shape=shape,
    source="Form: ours, the first terms of a Taylor series in ln x and ln(1 + z).",
    # By hand: 1 and 2: 1 + 1 + 4.
    worked=({"x": np.e, "x_ref": 1.0, "z": np.e**2 - 1.0, "z_ref": 0.0}, {"A": 0.5, "B": 1.0, "C": 2.0}, 6.0),
    physical=False,
)
