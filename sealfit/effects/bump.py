r"""Local bump in any channel: a worn place, a joint in the track, an hour when the door stood open.

.. math:: h = A e^{-((x - x_0) / w)^2}
"""

from __future__ import annotations

import numpy as np

from sealfit.effects.contract import AMPLITUDE, ANYWHERE, CHANNEL, Effect, Parameter


def shape(inputs, *, A, x_0, w):
    """Bell of height A, shape (n,), in the unit of A."""
    return A * np.exp(-(((np.asarray(inputs[CHANNEL], dtype=float) - x_0) / w) ** 2))


BUMP = Effect(
    id="bump",
    label="local bump in {x}",
    equation=r"h = A e^{-((x - x_0) / w)^2}",
    form="A exp(-((x - x_0) / w)^2)",
    reference="away from {x} = {x_0}",
    reads=(CHANNEL,),
    acts_on=ANYWHERE,
    parameters=(
        Parameter("A", "{y}", 0.1, AMPLITUDE, "height", linear=True),
        Parameter("x_0", "{x}", 0.0, (-1e12, 1e12), "middle", search="inside"),
        Parameter("w", "{x}", 1.0, (1e-6, 1e12), "half-width at 1/e", search="span"),
    ),
    shape=shape,
    source="Form: ours. A Gaussian bell, smooth and local.",
    # By hand: one half-width from the middle, 1/e = 0.36787944117144233.
    worked=({"x": 1.0, "x_ref": 0.0}, {"A": 2.0, "x_0": 3.0, "w": 2.0}, 2.0 * 0.36787944117144233),
    physical=False,
)
