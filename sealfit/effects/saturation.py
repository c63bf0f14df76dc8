r"""Saturation by a hyperbola, from 0, in any channel that is not negative.

.. math:: h = A \frac{x}{x + x_{half}}

Slower than an exponential to reach its limit: half at x_half, nine tenths at nine times that. NaN where the channel is
negative.
"""

from __future__ import annotations

from sealfit.effects.contract import AMPLITUDE, ANYWHERE, CHANNEL, Effect, Parameter, not_negative


def shape(inputs, *, A, x_half):
    """Saturation to A, shape (n,), in the unit of A."""
    x = not_negative(inputs[CHANNEL])
    return A * x / (x + x_half)


SATURATION = Effect(
    id="saturation",
    label="saturation in {x}",
    equation=r"h = A x / (x + x_{half})",
    form="A x / (x + x_half)",
    reference="{x} = 0",
    reads=(CHANNEL,),
    acts_on=ANYWHERE,
    parameters=(
        Parameter("A", "{y}", 0.1, AMPLITUDE, "limit", linear=True),
        Parameter("x_half", "{x}", 1.0, (1e-6, 1e9), "where half of the limit is reached", search="span"),
    ),
    shape=shape,
    source="Form: Langmuir 1918, J. Am. Chem. Soc. 40(9), 1361-1403, doi:10.1021/ja02242a004: places that fill up.",
    # By hand: x = 3 x_half is three quarters of 2.
    worked=({"x": 6.0, "x_ref": 1.0}, {"A": 2.0, "x_half": 2.0}, 1.5),
    physical=False,
)
