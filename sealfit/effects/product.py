r"""Product of two channels, for an effect that shows only where both are away from their means.

.. math:: h = A (x - x_{ref}) (z - z_{ref})

x_ref and z_ref are the channels' means over the campaign, so that what either does alone is none of it. Speed times
days: the aged rubber loses more of its friction at high speed than the fresh one does.
"""

from __future__ import annotations

from sealfit.effects.contract import AMPLITUDE, ANYWHERE, CHANNEL, SECOND, Effect, Parameter, deviation


def shape(inputs, *, A):
    """Product of two deviations, shape (n,), in the unit of A times both channels' units."""
    return A * deviation(inputs, CHANNEL) * deviation(inputs, SECOND)


PRODUCT = Effect(
    id="product",
    label="product of {x} and {z}",
    equation=r"h = A (x - x_{ref}) (z - z_{ref})",
    form="A (x - x_ref) (z - z_ref)",
    reference="{x} = {x_ref} or {z} = {z_ref}",
    reads=(CHANNEL, SECOND),
    acts_on=ANYWHERE,
    parameters=(Parameter("A", "{y}/({x} {z})", 0.01, AMPLITUDE, "slope of a slope", linear=True),),
    shape=shape,
    source="Form: ours, the first mixed term of a Taylor series in two channels.",
    # By hand: 2 above one mean and 3 below the other.
    worked=({"x": 12.0, "x_ref": 10.0, "z": 1.0, "z_ref": 4.0}, {"A": 0.5}, -3.0),
    physical=False,
)
