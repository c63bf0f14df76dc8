r"""Zero offset of the force that changes with a channel, the same both ways.

.. math:: h = A (x - x_{ref}) + B

The force on a piston is the pressure times its area, so an area that is wrong by dA leaves dA p in what is taken for
friction: A is then the error of the area, and B that error times the reference pressure. An amplifier whose zero moves
with the temperature of the room does the same.
"""

from __future__ import annotations

from sealfit.effects.contract import AMPLITUDE, CHANNEL, Effect, Parameter, deviation


def shape(inputs, *, A, B):
    """Added force, shape (n,), whichever way the sample moves."""
    return A * deviation(inputs, CHANNEL) + B


OFFSET_SLOPE = Effect(
    id="offset_slope",
    label="zero offset of the force that changes with {x}",
    equation=r"h = A (x - x_{ref}) + B",
    form="A (x - x_ref) + B",
    reference="zero offset removed",
    reads=(CHANNEL, "direction"),
    acts_on=(("force", "add"),),
    parameters=(
        Parameter("A", "{y}/{x}", 0.01, AMPLITUDE, "slope of the offset", linear=True),
        Parameter("B", "{y}", 0.0, AMPLITUDE, "offset at the reference", linear=True),
    ),
    shape=shape,
    source="Form: ours. Force on a piston, F = p A, and definition of a zero offset.",
    # By hand: 0.5 * (7 - 3) - 1.5, whichever way.
    worked=({"x": 7.0, "x_ref": 3.0, "direction": -1.0}, {"A": 0.5, "B": -1.5}, 0.5),
    physical=False,
)
