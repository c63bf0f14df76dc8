r"""Stribeck exponent other than 2: friction falls with speed more gradually, or more abruptly, than the declared curve.

The declared curve falls from mu_s to mu_c as a Gaussian of the speed. Nothing but custom says so: contacts whose
strengths or heights are spread widely let go one after the other, n near 1 or below; a film that takes over all at once
makes a cliff, n well above 2. What is added to the declared curve is the difference of the two decays,

.. math:: h = A [e^{-(|v| / v_s)^n} - e^{-(v / v_s)^2}]

which is zero at rest, at v_s, far above v_s, and everywhere for n = 2. With A = mu_s - mu_c and the v_s of the declared
curve, declared curve and effect together are exactly :math:`\mu_c + (\mu_s - \mu_c) e^{-(|v| / v_s)^n}`. As a factor on
mu, A is relative to mu, and the same only as far as mu hardly changes around v_s.

Three numbers here and four of the declared curve need seven speeds in one direction, several on either side of v_s.
Near n = 2 the shape is :math:`A (2 - n) r^2 \ln r\, e^{-r^2}` with :math:`r = |v| / v_s`: there only the product
A (2 - n) is determined, and A and n apart only well off 2, or with A held to mu_s - mu_c.
"""

from __future__ import annotations

import numpy as np

from sealfit.effects.contract import Effect, Parameter


def shape(inputs, *, A, v_s, n):
    """Added coefficient or factor minus one, shape (n,); signed `speed_mm_s` in its slot's unit; 0 at rest."""
    ratio = np.abs(np.asarray(inputs["speed_mm_s"], dtype=float)) / v_s
    return A * (np.exp(-(ratio**n)) - np.exp(-(ratio**2)))


STRIBECK_EXPONENT = Effect(
    id="stribeck_exponent",
    label="Stribeck exponent other than 2",
    equation=r"h = A [e^{-(|v| / v_s)^n} - e^{-(v / v_s)^2}]",
    form="A (exp(-(|v| / v_s)^n) - exp(-(v / v_s)^2))",
    reference="Stribeck exponent 2",
    reads=("speed_mm_s",),
    acts_on=(("mu", "add"), ("mu", "multiply")),
    parameters=(
        Parameter("A", "{y}", 0.3, (-10.0, 10.0), "drop of friction across the Stribeck curve", linear=True),
        Parameter("v_s", "{x}", 5.0, (1e-6, 1e6), "Stribeck speed", search="ratio"),
        Parameter("n", "", 1.0, (0.2, 10.0), "Stribeck exponent", search=(0.4, 0.6, 0.8, 1.0, 1.4, 3.0, 4.0, 6.0)),
    ),
    shape=shape,
    source="Exponents from 1/2 upwards: Bo & Pavelescu 1982, Wear 82(3), 277-289; review: Armstrong-Helouvry, Dupont & "
    "Canudas de Wit 1994, Automatica 30(7), 1083-1138, doi:10.1016/0005-1098(94)90209-7. As a difference: ours.",
    # By hand: twice v_s, n = 1: exp(-2) - exp(-4) = 0.1353352832366127 - 0.01831563888873418.
    worked=(
        {"speed_mm_s": -10.0},
        {"A": 0.3, "v_s": 5.0, "n": 1.0},
        0.3 * (0.1353352832366127 - 0.01831563888873418),
    ),
)
