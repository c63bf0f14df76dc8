r"""Viscous coefficient that changes with age: the declared model has one sigma_2 for all days of a series.

What is left of the lubricant, and the rubber's own damping, change as it ages. Like the coefficients, sigma_2 is
given the logarithm of time,

.. math:: h = A \ln(1 + t / t_0)

A is the change of sigma_2 per factor e of the aging time (as a factor: relative to it), zero for unaged rubber.
"""

from __future__ import annotations

import numpy as np

from sealfit.effects.contract import AMPLITUDE, Effect, Parameter, not_negative


def shape(inputs, *, A, t_0):
    """Change of sigma_2 or factor minus one, shape (n,); `aging_days` in days (NaN where negative)."""
    return A * np.log1p(not_negative(inputs["aging_days"]) / t_0)


VISCOSITY_AGING = Effect(
    id="viscosity_aging",
    label="viscous coefficient changing with age",
    equation=r"h = A \ln(1 + t / t_0)",
    form="A ln(1 + t / t_0)",
    reference="unaged",
    reads=("aging_days",),
    acts_on=(("sigma_2", "add"), ("sigma_2", "multiply")),
    parameters=(
        Parameter("A", "{y}", 0.01, AMPLITUDE, "change of sigma_2 per factor e of the aging time", linear=True),
        Parameter(
            "t_0",
            "{x}",
            1.0,
            (1e-4, 1e5),
            "aging time at which the change sets in",
            search=(0.01, 0.1, 1.0, 10.0, 100.0),
        ),
    ),
    shape=shape,
    source="Form: ours, after the law of the coefficients: Wu et al. 2020, Polymers 12(1), 102, "
    "doi:10.3390/polym12010102, Eq. 15.",
    # By hand: t = 9 t_0 gives ln 10 = 2.302585092994046.
    worked=({"aging_days": 9.0}, {"A": -0.02, "t_0": 1.0}, -0.02 * 2.302585092994046),
)
