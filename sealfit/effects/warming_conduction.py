r"""Warming limited by conduction into the rubber: friction falls with the root of speed times distance.

Rubber conducts badly: during a stroke heat enters a thin layer and nothing leaves on the far side. The surface of a
half-space under a steady flux q has warmed by :math:`2 q \sqrt{t / (\pi k \rho c)}` after a time t. Friction's flux
is :math:`q \propto \mu p |v|`, and :math:`t = s / |v|`, so

.. math:: \Delta T \propto p |v| \sqrt{s / |v|} = p \sqrt{|v| s}, \qquad h = -A \sqrt{\frac{|v| s}{v_{ref} s_{ref}}}

A is the share of friction lost at the reference speed and distance. At one load; with several, the flux follows the
load: `warming_conduction_load`. Holds until the warm layer reaches the back of the sample, and for a loss that is
small against 1.
"""

from __future__ import annotations

import numpy as np

from sealfit.effects.contract import Effect, Parameter, reference


def shape(inputs, *, A):
    """Factor minus one, shape (n,); distance (from the stroke's start) and speed in their slots' units."""
    distance = np.maximum(np.asarray(inputs["distance_mm"], dtype=float), 0.0) / reference(inputs, "distance_mm", 1.0)
    speed = np.abs(np.asarray(inputs["speed_mm_s"], dtype=float)) / reference(inputs, "speed_mm_s", 1.0)
    return -A * np.sqrt(speed * distance)


WARMING_CONDUCTION = Effect(
    id="warming_conduction",
    label="warming by sliding (conduction-limited: speed times distance)",
    equation=r"h = -A \sqrt{|v| s / (v_{ref} s_{ref})}",
    form="-A sqrt(|v| s / (v_ref s_ref))",
    reference="cold contact (distance 0)",
    reads=("distance_mm", "speed_mm_s"),
    acts_on=(("mu", "multiply"), ("mu_c", "multiply"), ("mu_s", "multiply"), ("force", "multiply")),
    parameters=(
        Parameter(
            "A", "{y}", 0.05, (-5.0, 0.95), "share of friction lost at reference speed and distance", linear=True
        ),
    ),
    shape=shape,
    source="Half-space under a steady flux: Carslaw & Jaeger 1959, Conduction of Heat in Solids, Oxford; "
    "sliding contacts: Jaeger 1942, J. Proc. R. Soc. New South Wales 76, 203-224. "
    "First order in the temperature: ours.",
    # By hand: twice the speed and twice the distance: sqrt(4) = 2.
    worked=(
        {"distance_mm": 40.0, "distance_mm_ref": 20.0, "speed_mm_s": -10.0, "speed_mm_s_ref": 5.0},
        {"A": 0.05},
        -0.1,
    ),
)
