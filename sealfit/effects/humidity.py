r"""Humidity of the laboratory: a film of water between rubber and track.

Water that the surfaces take up from the air weakens the adhesion between them and lubricates at speed; over the
humidities of a laboratory a straight line is enough,

.. math:: h = A (H - H_{ref})

A is the relative change per per cent of relative humidity. Only where the campaign holds a column `humidity_pct`; a
column of another name is found as `linear` in it.
"""

from __future__ import annotations

import numpy as np

from sealfit.effects.contract import AMPLITUDE, Effect, Parameter, reference


def shape(inputs, *, A):
    """Factor minus one or added force, shape (n,); `humidity_pct` in per cent."""
    return A * (np.asarray(inputs["humidity_pct"], dtype=float) - reference(inputs, "humidity_pct", 0.0))


HUMIDITY = Effect(
    id="humidity",
    label="humidity of the laboratory",
    equation=r"h = A (H - H_{ref})",
    form="A (H - H_ref)",
    reference="{humidity_pct} = {humidity_pct_ref}",
    reads=("humidity_pct",),
    acts_on=(("mu", "multiply"), ("force", "add"), ("force", "multiply"), ("mu_s", "multiply"), ("mu_c", "multiply")),
    parameters=(Parameter("A", "{y}/{x}", -0.001, AMPLITUDE, "change per per cent of relative humidity", linear=True),),
    shape=shape,
    source="Form: ours. First order in the humidity about its mean.",
    # By hand: 20 % below the reference at -0.1 % of friction per per cent.
    worked=({"humidity_pct": 35.0, "humidity_pct_ref": 55.0}, {"A": -0.001}, 0.02),
)
