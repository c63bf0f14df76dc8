r"""Direction asymmetry: a parameter that is larger one way than the other.

A lip seal, a sample glued askew or a polished track rubs differently forward and back. With d = +1 or -1,

.. math:: h = A d / 2

so that A is the forward value minus the backward one, relative to (or, for a change that is added, in the unit of) the
mean of both, and the mean keeps its meaning.
"""

from __future__ import annotations

import numpy as np

from sealfit.effects.contract import AMPLITUDE, Effect, Parameter


def shape(inputs, *, A):
    """Factor minus one or change of the parameter, shape (n,); `direction` is +1 or -1."""
    return A * np.asarray(inputs["direction"], dtype=float) / 2


ASYMMETRY = Effect(
    id="asymmetry",
    label="direction asymmetry",
    equation=r"h = A d / 2",
    form="A d / 2, d = +1 forward, -1 backward",
    reference="mean of the two directions",
    reads=("direction",),
    acts_on=(
        ("mu", "multiply"),
        ("force", "multiply"),
        ("mu_c", "multiply"),
        ("mu_s", "multiply"),
        ("v_s", "multiply"),
        ("sigma_2", "add"),
        ("sigma_2", "multiply"),
        ("a", "multiply"),
        ("b", "multiply"),
        ("mu_0", "multiply"),
    ),
    parameters=(Parameter("A", "{y}", 0.05, AMPLITUDE, "forward minus backward", linear=True),),
    shape=shape,
    source="Form: ours. The odd part in direction of any two values, halved so that A is their difference.",
    # By hand: backward, half of the difference below the mean.
    worked=({"direction": -1.0}, {"A": 0.1}, -0.05),
)
