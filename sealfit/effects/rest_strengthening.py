r"""Strengthening at rest: the longer a contact has stood still, the higher its static friction.

Contacts creep and bonds form while the sample stands: the static coefficient grows with the logarithm of the rest,

.. math:: h = A \ln(1 + t / t_0)

A is the relative growth per factor e of the rest, some 0.01 to 0.05 for most solids; t_0 is the rest below which
nothing shows. Only where the campaign holds a column `rest_s`.
"""

from __future__ import annotations

import numpy as np

from sealfit.effects.contract import Effect, Parameter, not_negative


def shape(inputs, *, A, t_0):
    """Factor minus one, shape (n,); `rest_s` in s, not negative (NaN where it is)."""
    return A * np.log1p(not_negative(inputs["rest_s"]) / t_0)


REST_STRENGTHENING = Effect(
    id="rest_strengthening",
    label="strengthening at rest",
    equation=r"h = A \ln(1 + t / t_0)",
    form="A ln(1 + t / t_0)",
    reference="no rest before the stroke",
    reads=("rest_s",),
    acts_on=(("mu_s", "multiply"), ("mu", "multiply"), ("mu_c", "multiply")),
    parameters=(
        Parameter("A", "{y}", 0.02, (-0.5, 5.0), "relative growth per factor e of the rest", linear=True),
        Parameter(
            "t_0", "{x}", 1.0, (1e-4, 1e6), "rest below which nothing shows", search=(0.01, 0.1, 1.0, 10.0, 100.0, 1e3)
        ),
    ),
    shape=shape,
    source="Dieterich 1972, J. Geophys. Res. 77(20), 3690-3697; review: Baumberger & Caroli 2006, Adv. Phys. 55, "
    "279-348.",
    # By hand: a rest of 9 t_0 gives ln 10 = 2.302585092994046.
    worked=({"rest_s": 18.0}, {"A": 0.02, "t_0": 2.0}, 0.02 * 2.302585092994046),
)
