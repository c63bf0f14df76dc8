r"""Conditioning over repeats (Mullins): the first repeat differs most, later ones settle.

Filled rubber softens on its first deformations and keeps what it lost: stress falls most in the first cycle and
reaches a steady state after some 10. Softer rubber changes contact area and hysteresis, so friction changes along
with it,

.. math:: h = A (1 - e^{-(n - 1) / n_0})

with n the repeat. A is the relative change once conditioned. The approach to a limit is chosen before a logarithm,
which would go on for ever, because conditioning ends; with three repeats the data can hardly tell, and `log` is in
the list.
"""

from __future__ import annotations

import numpy as np

from sealfit.effects.contract import Effect, Parameter


def shape(inputs, *, A, n_0):
    """Factor minus one, shape (n,); `repeat` counts from 1."""
    before = np.maximum(np.asarray(inputs["repeat"], dtype=float) - 1, 0.0)
    return -A * np.expm1(-before / n_0)


CONDITIONING = Effect(
    id="conditioning",
    label="conditioning over repeats (Mullins)",
    equation=r"h = A (1 - e^{-(n - 1) / n_0})",
    form="A (1 - exp(-(n - 1) / n_0))",
    reference="first repeat",
    reads=("repeat",),
    acts_on=(("mu", "multiply"), ("force", "multiply"), ("mu_s", "multiply"), ("mu_c", "multiply")),
    parameters=(
        Parameter("A", "{y}", -0.05, (-0.95, 10.0), "relative change once conditioned", linear=True),
        Parameter("n_0", "", 1.0, (0.1, 1e3), "repeats that conditioning takes", search=(0.3, 0.6, 1.0, 2.0, 4.0, 8.0)),
    ),
    shape=shape,
    source="Mullins 1969, Rubber Chem. Technol. 42(1), 339-362, doi:10.5254/1.3539210; review: Diani, Fayolle & "
    "Gilormini 2009, Eur. Polym. J. 45(3), 601-612, doi:10.1016/j.eurpolymj.2008.11.017. Exponential in repeats: ours.",
    # By hand: two repeats after the first, n_0 = 2: 1 - 1/e = 0.6321205588285577 of the way.
    worked=({"repeat": 3.0}, {"A": -0.1, "n_0": 2.0}, -0.1 * 0.6321205588285577),
)
