r"""Two channels with their product: a plane that is warped.

.. math:: h = A u w + B u + C w, \quad u = x - x_{ref}, \; w = z - z_{ref}

What either channel does alone depends on where the other is, so a product rarely comes without it.
"""

from __future__ import annotations

from sealfit.effects.contract import AMPLITUDE, ANYWHERE, CHANNEL, SECOND, Effect, Parameter, deviation


def shape(inputs, *, A, B, C):
    """Product and both terms alone, shape (n,), in the unit of what the effect gives."""
    u = deviation(inputs, CHANNEL)
    w = deviation(inputs, SECOND)
    return A * u * w + B * u + C * w


BILINEAR = Effect(
    id="bilinear",
    label="product of {x} and {z}, and each alone",
    equation=r"h = A u w + B u + C w, \quad u = x - x_{ref}, \; w = z - z_{ref}",
    form="A u w + B u + C w, u = x - x_ref, w = z - z_ref",
    reference="{x} = {x_ref} and {z} = {z_ref}",
    reads=(CHANNEL, SECOND),
    acts_on=ANYWHERE,
    parameters=(
        Parameter("A", "{y}/({x} {z})", 0.01, AMPLITUDE, "slope of a slope", linear=True),
        Parameter("B", "{y}/{x}", 0.0, AMPLITUDE, "slope in the first channel", linear=True),
        Parameter("C", "{y}/{z}", 0.0, AMPLITUDE, "slope in the second channel", linear=True),
    ),
    shape=shape,
    source="Form: ours, the first terms of a Taylor series in two channels.",
    # By hand: 2 above one mean and 3 below the other: -3 + 2 - 6.
    worked=({"x": 12.0, "x_ref": 10.0, "z": 1.0, "z_ref": 4.0}, {"A": 0.5, "B": 1.0, "C": 2.0}, -7.0),
    physical=False,
)
