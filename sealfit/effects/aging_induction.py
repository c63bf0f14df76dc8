r"""Aging with an induction time: at first less happens than the logarithm says.

Antioxidants hold oxidation off until they are spent, so the coefficient stays up for a while and then catches up with
Eq. 15. What it lies above the law rises from zero at day 0, is largest at t_i and dies out:

.. math:: h = A \frac{t}{t_i} e^{1 - t / t_i}

A is that largest lag.
"""

from __future__ import annotations

import numpy as np

from sealfit.effects.contract import Effect, Parameter


def shape(inputs, *, A, t_i):
    """Factor minus one or change of the coefficient, shape (n,); `aging_days` in days."""
    ratio = np.maximum(np.asarray(inputs["aging_days"], dtype=float), 0.0) / t_i
    return A * ratio * np.exp(1 - ratio)


AGING_INDUCTION = Effect(
    id="aging_induction",
    label="aging with an induction time",
    equation=r"h = A (t / t_i) e^{1 - t / t_i}",
    form="A (t / t_i) exp(1 - t / t_i)",
    reference="unaged",
    reads=("aging_days",),
    acts_on=(("mu", "multiply"), ("mu_c", "add"), ("mu_s", "add"), ("mu_c", "multiply"), ("mu_s", "multiply")),
    parameters=(
        Parameter("A", "{y}", 0.05, (-10.0, 10.0), "largest lag behind the logarithmic law", linear=True),
        Parameter("t_i", "{x}", 2.0, (1e-3, 1e5), "day of the largest lag", search="inside"),
    ),
    shape=shape,
    source="Form: ours. The simplest lag that starts at zero, has one maximum and dies out.",
    # By hand: at twice t_i, 2 exp(-1) = 2 * 0.36787944117144233.
    worked=({"aging_days": 4.0}, {"A": 0.1, "t_i": 2.0}, 0.1 * 2 * 0.36787944117144233),
)
