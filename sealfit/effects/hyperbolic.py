r"""Hyperbolic decay from A to 0, in any channel that is not negative.

.. math:: h = \frac{A}{1 + x / x_{half}}

What is off at the start and settles slowly: half is left at x_half, a tenth at nine times that. NaN where the channel
is negative.

It is a constant less `saturation`. Every coefficient, every parameter and the whole friction force hold a free
constant of their own, so on them the two are one form, and `saturation` has it. A force that is added has none: one
that starts off by A and settles at zero is this form alone, and a zero offset and a saturation otherwise. Hence it acts
there only. The hyperbola without a start, A (x_ref / x - 1), is `power` with n = -1.
"""

from __future__ import annotations

from sealfit.effects.contract import AMPLITUDE, CHANNEL, Effect, Parameter, not_negative


def shape(inputs, *, A, x_half):
    """Decay from A, shape (n,), in the unit of A."""
    return A / (1 + not_negative(inputs[CHANNEL]) / x_half)


HYPERBOLIC = Effect(
    id="hyperbolic",
    label="hyperbolic decay in {x}",
    equation=r"h = A / (1 + x / x_{half})",
    form="A / (1 + x / x_half)",
    reference="limit of large {x}",
    reads=(CHANNEL,),
    acts_on=(("force", "add"),),
    parameters=(
        Parameter("A", "{y}", 0.1, AMPLITUDE, "size at 0", linear=True),
        Parameter("x_half", "{x}", 1.0, (1e-6, 1e9), "where half of it is left", search="span"),
    ),
    shape=shape,
    source="Form: ours. What decays in proportion to the square of what is left.",
    # By hand: x = 3 x_half leaves a quarter of 2.
    worked=({"x": 6.0, "x_ref": 1.0}, {"A": 2.0, "x_half": 2.0}, 0.5),
    physical=False,
)
