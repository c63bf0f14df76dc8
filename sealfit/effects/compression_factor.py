r"""Compression while aging: rubber held at a lower height ages, and rubs, differently.

A seal ages under squeeze. Strain holds the chains apart in one place and together in another while bonds form and break
(compression set), and shuts the surface off from air. With c the height in per cent of the original one, the height
taken away counts to first order,

.. math:: h = A (100 - c) / 100

A is the relative change per whole height taken away, so that 80 % gives A / 5; rubber that was not compressed is the
reference. On a or b aging itself changes; on mu the friction of unaged rows follows their cell, too.

The declared model has an a and a b of its own for each series, and where compression makes series they take up all of
a change of a or b: there is something to find on them only where one series holds several heights.
"""

from __future__ import annotations

import numpy as np

from sealfit.effects.contract import AMPLITUDE, Effect, Parameter


def shape(inputs, *, A):
    """Factor minus one, shape (n,); `compression_ratio_pct` in per cent of the original height."""
    return A * (100.0 - np.asarray(inputs["compression_ratio_pct"], dtype=float)) / 100.0


COMPRESSION_FACTOR = Effect(
    id="compression_factor",
    label="compression while aging",
    equation=r"h = A (100 - c) / 100",
    form="A (100 - c) / 100",
    reference="not compressed (100 %)",
    reads=("compression_ratio_pct",),
    acts_on=(("a", "multiply"), ("b", "multiply"), ("mu", "multiply"), ("mu_s", "multiply"), ("mu_c", "multiply")),
    parameters=(Parameter("A", "{y}", 0.5, AMPLITUDE, "relative change per whole height taken away", linear=True),),
    shape=shape,
    source="Friction after aging at 80, 90 and 100 % of the height: Wu et al. 2020, Polymers 12(1), 102, "
    "doi:10.3390/polym12010102. First order: ours.",
    # By hand: a fifth of the height taken away.
    worked=({"compression_ratio_pct": 80.0}, {"A": 0.6}, 0.12),
)
