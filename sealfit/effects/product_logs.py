r"""Product of the logarithms of two channels, the second counted from one unit below zero, as days of aging are.

.. math:: h = A \ln(x / x_{ref}) \ln \frac{1 + z}{1 + z_{ref}}

As `product_log`, where z starts at zero and acts ever more slowly. NaN where x is not positive or z negative.
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


def shape(inputs, *, A):
    """Product of two logarithms, shape (n,), in the unit of A."""
    return A * log_ratio(inputs, CHANNEL) * log_ratio_from_zero(inputs, SECOND)


PRODUCT_LOGS = Effect(
    id="product_logs",
    label="product of log {x} and log of 1 + {z}",
    equation=r"h = A \ln(x / x_{ref}) \ln((1 + z) / (1 + z_{ref}))",
    form="A ln(x / x_ref) ln((1 + z) / (1 + z_ref))",
    reference="{x} = {x_ref} or {z} = {z_ref}",
    reads=(CHANNEL, SECOND),
    acts_on=ANYWHERE,
    parameters=(Parameter("A", "{y}", 0.01, AMPLITUDE, "slope of a slope, in logarithms", linear=True),),
    shape=shape,
    source="Form: ours, the first mixed term of a Taylor series in ln x and ln(1 + z).",
    # By hand: one factor e above the first reference, two above the second.
    worked=({"x": np.e, "x_ref": 1.0, "z": np.e**2 - 1.0, "z_ref": 0.0}, {"A": 0.5}, 1.0),
    physical=False,
)
