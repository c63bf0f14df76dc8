r"""Viscous friction by a power of the speed: shear-thinning grease, or a film that thickens with speed.

A Newtonian film of fixed thickness drags in proportion to speed, which is the declared sigma_2 v. A shear-thinning
film drags as :math:`|v|^n` with n < 1; one that the speed itself drags in, as under a hydrodynamic seal lip, grows as
the root of the speed and drags with n near 1/2.

.. math:: h = A\, \mathrm{sgn}(v)\, (|v| / v_{ref})^n

A is the force at the reference speed. At n = 1 it is sigma_2 v and cannot be told from it.
"""

from __future__ import annotations

import numpy as np

from sealfit.effects.contract import AMPLITUDE, Effect, Parameter, reference


def shape(inputs, *, A, n):
    """Added force, shape (n,), in the force slot's unit, odd in the speed; 0 at rest."""
    speed = np.asarray(inputs["speed_mm_s"], dtype=float)
    return A * np.sign(speed) * (np.abs(speed) / reference(inputs, "speed_mm_s", 1.0)) ** n


POWER_VISCOUS = Effect(
    id="power_viscous",
    label="viscous friction by a power of the speed",
    equation=r"h = A\, \mathrm{sgn}(v)\, (|v| / v_{ref})^n",
    form="A sgn(v) (|v| / v_ref)^n",
    reference="additional viscous force removed",
    reads=("speed_mm_s",),
    acts_on=(("force", "add"),),
    parameters=(
        Parameter("A", "{y}", 1.0, AMPLITUDE, "force at the reference speed", linear=True),
        Parameter("n", "", 0.5, (0.05, 4.0), "exponent of the speed", search=(0.2, 0.35, 0.5, 0.7, 1.4, 2.0, 3.0)),
    ),
    shape=shape,
    source="Form: Ostwald-de Waele power law as a friction term; speed-dependent friction terms: Armstrong-Helouvry, "
    "Dupont & Canudas de Wit 1994, Automatica 30(7), 1083-1138, doi:10.1016/0005-1098(94)90209-7.",
    # By hand: four times the reference speed, backward: -2 * sqrt(4).
    worked=({"speed_mm_s": -20.0, "speed_mm_s_ref": 5.0}, {"A": 2.0, "n": 0.5}, -4.0),
)
