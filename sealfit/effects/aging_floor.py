r"""Aging with a floor: from some day on the coefficient falls less than the logarithm says.

Eq. 15 falls for ever; real aging ends when what reacts is used up. Beyond a day t_f part of the fall is given back,

.. math:: h = A \ln(t / t_f) \quad (t > t_f), \qquad h = 0 \quad (t \le t_f)

As a change of mu_s or mu_c, A = a stops the fall of :math:`\mu_0 - a \ln(1 + t / b)` altogether for t well beyond b,
and a smaller A slows it. As a factor on mu, A is relative to mu.
"""

from __future__ import annotations

import numpy as np

from sealfit.effects.contract import Effect, Parameter


def shape(inputs, *, A, t_f):
    """Change of the coefficient or factor minus one, shape (n,); `aging_days` in days."""
    return A * np.log(np.maximum(np.asarray(inputs["aging_days"], dtype=float) / t_f, 1.0))


AGING_FLOOR = Effect(
    id="aging_floor",
    label="aging with a floor",
    equation=r"h = A \ln \max(1, t / t_f)",
    form="A ln(max(1, t / t_f))",
    reference="no more than {t_f} days",
    reads=("aging_days",),
    acts_on=(("mu", "multiply"), ("mu_c", "add"), ("mu_s", "add"), ("mu_c", "multiply"), ("mu_s", "multiply")),
    parameters=(
        Parameter("A", "{y}", 0.03, (-10.0, 10.0), "fall given back per factor e of the time", linear=True),
        Parameter("t_f", "{x}", 8.0, (1e-3, 1e5), "day from which it is given back", search="inside"),
    ),
    shape=shape,
    source="Form: ours. The logarithm of Eq. 15, cut off: Wu et al. 2020, Polymers 12(1), 102, "
    "doi:10.3390/polym12010102.",
    # By hand: twice the day of the floor, ln 2 = 0.6931471805599453.
    worked=({"aging_days": 16.0}, {"A": 0.04, "t_f": 8.0}, 0.04 * 0.6931471805599453),
)
