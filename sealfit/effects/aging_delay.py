r"""Aging that starts late: nothing happens until a day t_i, and Eq. 15 runs from there.

Antioxidants hold oxidation off until they are spent. The declared law runs from day 0, so what is added is the
difference of the two clocks,

.. math:: h = A \left[\ln(1 + t / b) - \ln(1 + \max(t - t_i, 0) / b)\right]

which is zero at day 0 and dies out as :math:`A t_i / t`. Where A is the declared law's a (as a share of mu, for a
factor) and b its b, the declared law and the effect together are Eq. 15 with :math:`t - t_i` for t. `aging_induction`
is the smooth lag of a batch whose pieces start one after the other.
"""

from __future__ import annotations

import numpy as np

from sealfit.effects.contract import Effect, Parameter


def shape(inputs, *, A, t_i, b):
    """Factor minus one or change of the coefficient, shape (n,); `aging_days` in days."""
    days = np.maximum(np.asarray(inputs["aging_days"], dtype=float), 0.0)
    return A * (np.log1p(days / b) - np.log1p(np.maximum(days - t_i, 0.0) / b))


AGING_DELAY = Effect(
    id="aging_delay",
    label="aging that starts late",
    equation=r"h = A [\ln(1 + t / b) - \ln(1 + \max(t - t_i, 0) / b)]",
    form="A (ln(1 + t / b) - ln(1 + max(t - t_i, 0) / b))",
    reads=("aging_days",),
    acts_on=(("mu", "multiply"), ("mu_c", "add"), ("mu_s", "add"), ("mu_c", "multiply"), ("mu_s", "multiply")),
    parameters=(
        Parameter("A", "{y}", 0.05, (-10.0, 10.0), "loss for each unit of the logarithm", linear=True),
        Parameter("t_i", "{x}", 2.0, (1e-3, 1e5), "day on which aging starts", search="inside"),
        Parameter("b", "{x}", 0.1, (1e-3, 1e3), "time constant of the law", search=(0.03, 0.1, 0.3, 1.0)),
    ),
    shape=shape,
    reference="unaged",
    source="Eq. 15 with a later start; the induction period of oxidation: Celina, Gillen & Assink 2005, Polymer "
    "Degradation and Stability 90(3), 395-404, doi:10.1016/j.polymdegradstab.2005.05.004.",
    # By hand: day 4, start at day 2, b = 1: ln 5 - ln 3 = 1.6094379124341003 - 1.0986122886681098.
    worked=({"aging_days": 4.0}, {"A": 0.1, "t_i": 2.0, "b": 1.0}, 0.1 * (1.6094379124341003 - 1.0986122886681098)),
)
