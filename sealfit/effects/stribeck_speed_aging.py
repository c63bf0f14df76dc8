r"""Stribeck speed that changes with age: the declared model has one v_s for all days of a series.

v_s marks where a film or a molecular time scale takes over from boundary friction. Hardening rubber carries less of its
roughness flat and relaxes more slowly, so v_s moves with age; like the coefficients it is given the logarithm of time,

.. math:: h = A \ln(1 + t / t_0)

A is the relative change of v_s per factor e of the aging time, zero for unaged rubber.
"""

from __future__ import annotations

import numpy as np

from sealfit.effects.contract import Effect, Parameter, not_negative


def shape(inputs, *, A, t_0):
    """Factor minus one, shape (n,); `aging_days` in days (NaN where negative)."""
    return A * np.log1p(not_negative(inputs["aging_days"]) / t_0)


STRIBECK_SPEED_AGING = Effect(
    id="stribeck_speed_aging",
    label="Stribeck speed changing with age",
    equation=r"h = A \ln(1 + t / t_0)",
    form="A ln(1 + t / t_0)",
    reference="unaged",
    reads=("aging_days",),
    acts_on=(("v_s", "multiply"),),
    parameters=(
        Parameter("A", "{y}", 0.1, (-5.0, 20.0), "relative change of v_s per factor e of the aging time", linear=True),
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
    # By hand: t = t_0 gives ln 2 = 0.6931471805599453.
    worked=({"aging_days": 2.0}, {"A": 0.3, "t_0": 2.0}, 0.3 * 0.6931471805599453),
)
