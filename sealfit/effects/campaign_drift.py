r"""Drift along the campaign: everything that changes a little from day to day of testing.

A track that polishes, a sensor that ages, rubber that goes on aging in the laboratory's air:

.. math:: h = A t

with t the time since the campaign's first file. A is the change per time: of friction, relative, or of the zero.
Along the order of runs instead of the clock it is `linear` in `run_order`. Where tests follow the calendar of aging
it cannot be told from the aging law.
"""

from __future__ import annotations

import numpy as np

from sealfit.effects.contract import AMPLITUDE, Effect, Parameter


def shape(inputs, *, A):
    """Factor minus one or added force, shape (n,); `elapsed_h` in h."""
    return A * np.asarray(inputs["elapsed_h"], dtype=float)


CAMPAIGN_DRIFT = Effect(
    id="campaign_drift",
    label="drift along the campaign",
    equation=r"h = A t",
    form="A t",
    reference="start of the campaign",
    reads=("elapsed_h",),
    acts_on=(("mu", "multiply"), ("force", "add"), ("force", "multiply")),
    parameters=(Parameter("A", "{y}/{x}", 1e-4, AMPLITUDE, "change per time of the campaign", linear=True),),
    shape=shape,
    source="Form: ours. First order in time of a slow change.",
    # By hand: 200 h at 0.05 % per hour.
    worked=({"elapsed_h": 200.0}, {"A": 5e-4}, 0.1),
)
