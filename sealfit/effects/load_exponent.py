r"""Load exponent of rubber: friction grows more slowly than the load, so the coefficient falls with it.

The true contact area of a smooth elastic asperity goes with the load to the power 2/3, so that :math:`F \propto N^n`
and :math:`\mu = \mu_{ref} (N / N_{ref})^{n - 1}` with n between 2/3 and 1. To first order in n - 1,

.. math:: h = A \ln(N / N_{ref}), \qquad A \approx n - 1

which is what is fitted: an amplitude then has an exact, linear place in the model. What is left out is :math:`\frac12
A^2 \ln^2(N / N_{ref})`, 0.7 % of friction at A = -1/6 and twice the load; `power` holds the full curve.

Where the local coefficient goes with the local pressure, :math:`\mu(p) \propto p^{n - 1}`, the load still enters by
the same exponent, and the pressure distribution by a constant factor that mu takes up.
"""

from __future__ import annotations

import numpy as np

from sealfit.effects.contract import Effect, Parameter, positive, reference


def shape(inputs, *, A):
    """Factor minus one, shape (n,); `load_N` in its slot's unit, positive (NaN where it is not)."""
    return A * np.log(positive(inputs["load_N"]) / reference(inputs, "load_N", 1.0))


LOAD_EXPONENT = Effect(
    id="load_exponent",
    label="load exponent of rubber",
    equation=r"h = A \ln(N / N_{ref}),\ A \approx n - 1",
    form="A ln(N / N_ref), A = n - 1 to first order in mu ~ N^(n-1)",
    reference="{load_N} = {load_N_ref}",
    reads=("load_N",),
    acts_on=(("mu", "multiply"), ("mu_c", "multiply"), ("mu_s", "multiply")),
    parameters=(Parameter("A", "{y}", -0.1, (-2.0, 2.0), "load exponent of friction minus one", linear=True),),
    shape=shape,
    source="Schallamach 1952, The load dependence of rubber friction, Proc. Phys. Soc. B 65, 657-661. "
    "First order: ours.",
    # By hand: twice the reference load, ln 2 = 0.6931471805599453.
    worked=({"load_N": 100.0, "load_N_ref": 50.0}, {"A": -0.2}, -0.2 * 0.6931471805599453),
)
