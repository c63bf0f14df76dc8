r"""Warming by sliding, seen along distance: friction falls with the work done on the contact, and settles.

At one normal force the heat that friction makes up to a distance s is its work, mu N s, whatever the speed. Where the
contact warms a fixed mass and gives heat to fresh, cold track at a rate that also goes with the distance slid, the
temperature approaches its limit over a distance instead of a time:

.. math:: h = -A (1 - e^{-s / s_0})

A is the share of friction lost when warm. At one speed it cannot be told from `warming_time`; two speeds separate them.
"""

from __future__ import annotations

import numpy as np

from sealfit.effects.contract import Effect, Parameter


def shape(inputs, *, A, s_0):
    """Factor minus one, shape (n,); `distance_mm` in its slot's unit, from the stroke's start."""
    distance = np.maximum(np.asarray(inputs["distance_mm"], dtype=float), 0.0)
    return A * np.expm1(-distance / s_0)


WARMING_DISTANCE = Effect(
    id="warming_distance",
    label="warming by sliding (distance)",
    equation=r"h = -A (1 - e^{-s / s_0})",
    form="-A (1 - exp(-s / s_0))",
    reference="cold contact (distance 0)",
    reads=("distance_mm",),
    acts_on=(("mu", "multiply"), ("mu_c", "multiply"), ("mu_s", "multiply"), ("force", "multiply")),
    parameters=(
        Parameter("A", "{y}", 0.1, (-5.0, 0.95), "share of friction lost when warm", linear=True),
        Parameter("s_0", "{x}", 20.0, (1e-4, 1e7), "distance over which the contact warms", search="span"),
    ),
    shape=shape,
    source="Fall with temperature: Grosch 1963, Proc. R. Soc. A 274, 21-39, doi:10.1098/rspa.1963.0112. "
    "Approach over a distance: ours, from the heat balance in the docstring.",
    # By hand: at s = s_0 ln 2 the exponential is 1/2, so half of A = 0.3 is lost; ln 2 = 0.6931471805599453.
    worked=({"distance_mm": 6.931471805599453}, {"A": 0.3, "s_0": 10.0}, -0.15),
)
