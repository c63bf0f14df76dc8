r"""Step in any channel: something was changed, repaired or knocked.

.. math:: h = A \quad (x \ge x_0), \qquad h = 0 \quad (x < x_0)

Only the interval between two neighbouring values of the channel is determined for x_0.
"""

from __future__ import annotations

import numpy as np

from sealfit.effects.contract import AMPLITUDE, ANYWHERE, CHANNEL, Effect, Parameter


def shape(inputs, *, A, x_0):
    """Step of height A, shape (n,), in the unit of A; NaN where the channel is."""
    x = np.asarray(inputs[CHANNEL], dtype=float)
    return A * np.where(np.isnan(x), np.nan, x >= x_0)


STEP = Effect(
    id="step",
    label="step in {x}",
    equation=r"h = A\,[x \ge x_0]",
    form="A if x >= x_0, else 0",
    reference="{x} below {x_0}",
    reads=(CHANNEL,),
    acts_on=ANYWHERE,
    parameters=(
        Parameter("A", "{y}", 0.1, AMPLITUDE, "height of the step", linear=True),
        Parameter("x_0", "{x}", 0.0, (-1e12, 1e12), "where it steps", search="between"),
    ),
    shape=shape,
    source="Form: ours. Definition of a step.",
    # By hand: at the step itself, the full height.
    worked=({"x": 3.0, "x_ref": 1.0}, {"A": -0.5, "x_0": 3.0}, -0.5),
    physical=False,
)
