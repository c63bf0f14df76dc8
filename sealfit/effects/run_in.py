r"""Run-in over strokes: the contact changes over the first strokes of a record and settles.

Sliding smooths the rubber's skin, spreads a film or clears it away; friction starts high or low and approaches a
steady value stroke by stroke,

.. math:: h = A (1 - e^{-(n - 1) / n_0})

with n the stroke in its file. A is the relative change once run in. It starts anew in every file: what lasts from
file to file is a drift along the campaign, and what lasts from repeat to repeat is conditioning.
"""

from __future__ import annotations

import numpy as np

from sealfit.effects.contract import Effect, Parameter


def shape(inputs, *, A, n_0):
    """Factor minus one, shape (n,); `stroke` counts from 1."""
    before = np.maximum(np.asarray(inputs["stroke"], dtype=float) - 1, 0.0)
    return -A * np.expm1(-before / n_0)


RUN_IN = Effect(
    id="run_in",
    label="run-in over strokes",
    equation=r"h = A (1 - e^{-(n - 1) / n_0})",
    form="A (1 - exp(-(n - 1) / n_0))",
    reference="first stroke",
    reads=("stroke",),
    acts_on=(("mu", "multiply"), ("force", "multiply"), ("mu_s", "multiply"), ("mu_c", "multiply")),
    parameters=(
        Parameter("A", "{y}", -0.05, (-0.95, 10.0), "relative change once run in", linear=True),
        Parameter(
            "n_0", "", 3.0, (0.1, 1e5), "strokes that run-in takes", search=(0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0)
        ),
    ),
    shape=shape,
    source="Blau 2005, Tribology International 38(11-12), 1007-1012, doi:10.1016/j.triboint.2005.07.020. "
    "Exponential in strokes: ours, the simplest approach to a steady value.",
    # By hand: 4 ln 2 strokes after the first with n_0 = 4: half of the way; ln 2 = 0.6931471805599453.
    worked=({"stroke": 1 + 4 * 0.6931471805599453}, {"A": -0.2, "n_0": 4.0}, -0.1),
)
