r"""Product of the logarithm of one channel and another, both counted from their means.

.. math:: h = A \ln(x / x_{ref}) (z - z_{ref})

As `product`, for a channel x that spans decades, such as the speed. NaN where x is not positive.
"""

from __future__ import annotations

import numpy as np

from sealfit.effects.contract import AMPLITUDE, ANYWHERE, CHANNEL, SECOND, Effect, Parameter, deviation, log_ratio


def shape(inputs, *, A):
    """Product of a logarithm and a deviation, shape (n,), in the unit of A times the second channel's unit."""
    return A * log_ratio(inputs, CHANNEL) * deviation(inputs, SECOND)


PRODUCT_LOG = Effect(
    id="product_log",
    label="product of log {x} and {z}",
    equation=r"h = A \ln(x / x_{ref}) (z - z_{ref})",
    form="A ln(x / x_ref) (z - z_ref)",
    reference="{x} = {x_ref} or {z} = {z_ref}",
    reads=(CHANNEL, SECOND),
    acts_on=ANYWHERE,
    parameters=(Parameter("A", "{y}/{z}", 0.01, AMPLITUDE, "slope in z of the slope in ln x", linear=True),),
    shape=shape,
    source="Form: ours, the first mixed term of a Taylor series in ln x and z.",
    # By hand: ln 1 = 0 at the reference; ln e = 1 away from it.
    worked=({"x": np.e, "x_ref": 1.0, "z": 1.0, "z_ref": 4.0}, {"A": 0.5}, -1.5),
    physical=False,
)
