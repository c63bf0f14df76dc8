r"""Parabola in any channel, zero at its reference.

.. math:: h = A (x - x_{ref}) + B (x - x_{ref})^2
"""

from __future__ import annotations

import numpy as np

from sealfit.effects.contract import AMPLITUDE, ANYWHERE, CHANNEL, Effect, Parameter, reference


def shape(inputs, *, A, B):
    """Parabola, shape (n,), in the unit of A times that of the channel."""
    away = np.asarray(inputs[CHANNEL], dtype=float) - reference(inputs, CHANNEL, 0.0)
    return A * away + B * away**2


QUADRATIC = Effect(
    id="quadratic",
    label="quadratic in {x}",
    equation=r"h = A (x - x_{ref}) + B (x - x_{ref})^2",
    form="A (x - x_ref) + B (x - x_ref)^2",
    reference="{x} = {x_ref}",
    reads=(CHANNEL,),
    acts_on=ANYWHERE,
    parameters=(
        Parameter("A", "{y}/{x}", 0.01, AMPLITUDE, "slope at the reference", linear=True),
        Parameter("B", "{y}/{x}^2", 0.001, AMPLITUDE, "curvature, halved", linear=True),
    ),
    shape=shape,
    source="Form: ours. Second order of any smooth dependence.",
    # By hand: 2 from the reference: 0.5 * 2 - 0.25 * 4.
    worked=({"x": 5.0, "x_ref": 3.0}, {"A": 0.5, "B": -0.25}, 0.0),
    physical=False,
)
