r"""Straight line in any channel with a slope of its own in each direction: what grows in one direction only.

.. math:: h = A_f (x - x_{ref}) \text{ forward}, \quad h = A_b (x - x_{ref}) \text{ backward}

A lip that turns over or wears on one side changes the friction one way and leaves the other. A slope whose interval
holds zero is the direction in which nothing changes.
"""

from __future__ import annotations

import numpy as np

from sealfit.effects.contract import AMPLITUDE, CHANNEL, Effect, Parameter, deviation


def shape(inputs, *, A_f, A_b):
    """Straight line, shape (n,), by the direction, which is +1 or -1."""
    return np.where(np.asarray(inputs["direction"]) > 0, A_f, A_b) * deviation(inputs, CHANNEL)


LINEAR_EACH_WAY = Effect(
    id="linear_each_way",
    label="linear in {x}, with its own slope in each direction",
    equation=r"h = A_f (x - x_{ref}) \text{ forward}, \; A_b (x - x_{ref}) \text{ backward}",
    form="A_f (x - x_ref) forward, A_b (x - x_ref) backward",
    reference="{x} = {x_ref}",
    reads=(CHANNEL, "direction"),
    acts_on=(("mu", "multiply"), ("force", "multiply")),
    parameters=(
        Parameter("A_f", "{y}/{x}", 0.01, AMPLITUDE, "slope forward", linear=True),
        Parameter("A_b", "{y}/{x}", 0.0, AMPLITUDE, "slope backward", linear=True),
    ),
    shape=shape,
    source="Form: ours. First order of any smooth dependence, in each direction by itself.",
    # By hand: backward, 0.25 * (7 - 3).
    worked=({"x": 7.0, "x_ref": 3.0, "direction": -1.0}, {"A_f": 0.5, "A_b": 0.25}, 1.0),
    physical=False,
)
