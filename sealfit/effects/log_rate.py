r"""Logarithmic rate dependence: friction that changes by the same amount for every factor of the speed.

Contacts that break by thermal activation carry a stress that goes with the logarithm of the rate,

.. math:: h = A \ln(|v| / v_{ref})

A is the relative change per factor e of the speed: positive where breaking bonds decides (strengthening with rate),
negative where the age of the contacts does. Steady sliding only; at rest it says nothing.
"""

from __future__ import annotations

import numpy as np

from sealfit.effects.contract import Effect, Parameter, positive, reference


def shape(inputs, *, A):
    """Factor minus one or change, shape (n,); signed `speed_mm_s` in its slot's unit, NaN at rest."""
    return A * np.log(positive(np.abs(inputs["speed_mm_s"])) / reference(inputs, "speed_mm_s", 1.0))


LOG_RATE = Effect(
    id="log_rate",
    label="logarithmic rate dependence",
    equation=r"h = A \ln(|v| / v_{ref})",
    form="A ln(|v| / v_ref)",
    reference="{speed_mm_s} = {speed_mm_s_ref}",
    reads=("speed_mm_s",),
    acts_on=(("mu", "multiply"), ("mu_c", "multiply"), ("mu", "add"), ("mu_c", "add")),
    parameters=(Parameter("A", "{y}", 0.02, (-2.0, 2.0), "change per factor e of the speed", linear=True),),
    shape=shape,
    source="Rate term of rate-and-state friction; review: Baumberger & Caroli 2006, Adv. Phys. 55, 279-348.",
    # By hand: ten times the reference speed, backward: ln 10 = 2.302585092994046.
    worked=({"speed_mm_s": -50.0, "speed_mm_s_ref": 5.0}, {"A": 0.03}, 0.03 * 2.302585092994046),
)
