r"""Logarithm of any channel that starts at 0: first in proportion, then alike in every decade.

.. math:: h = A \ln(1 + x / x_0)

The law of Eq. 15 for channels that have a zero, such as time; NaN where the channel is negative.
"""

from __future__ import annotations

import numpy as np

from sealfit.effects.contract import AMPLITUDE, ANYWHERE, CHANNEL, Effect, Parameter, not_negative


def shape(inputs, *, A, x_0):
    """Logarithm from 0, shape (n,), in the unit of A."""
    return A * np.log1p(not_negative(inputs[CHANNEL]) / x_0)


LOG_GROWTH = Effect(
    id="log_growth",
    label="logarithmic growth in {x}",
    equation=r"h = A \ln(1 + x / x_0)",
    form="A ln(1 + x / x_0)",
    reference="{x} = 0",
    reads=(CHANNEL,),
    acts_on=ANYWHERE,
    parameters=(
        Parameter("A", "{y}", 0.05, AMPLITUDE, "change per factor e of the channel, well beyond x_0", linear=True),
        Parameter("x_0", "{x}", 1.0, (1e-6, 1e9), "where the logarithm sets in", search="span"),
    ),
    shape=shape,
    source="Form: ours, after Eq. 15 of Wu et al. 2020, Polymers 12(1), 102, doi:10.3390/polym12010102.",
    # By hand: x = x_0, ln 2 = 0.6931471805599453.
    worked=({"x": 3.0, "x_ref": 1.0}, {"A": 0.5, "x_0": 3.0}, 0.5 * 0.6931471805599453),
    physical=False,
)
