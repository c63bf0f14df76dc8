r"""Warming limited by conduction into the rubber, at several loads: as `warming_conduction`, with the flux's load.

The flux of friction is :math:`q \propto \mu p |v|`; where the contact's area stays the same, its pressure p follows the
load, so the surface warms as :math:`N \sqrt{|v| s}` and

.. math:: h = -A \frac{N}{N_{ref}} \sqrt{\frac{|v| s}{v_{ref} s_{ref}}}

A is the share of friction lost at the reference load, speed and distance; small against 1.
"""

from __future__ import annotations

import numpy as np

from sealfit.effects.contract import Effect, Parameter, reference


def shape(inputs, *, A):
    """Factor minus one, shape (n,); distance (from the stroke's start), speed and load in their slots' units."""
    distance = np.maximum(np.asarray(inputs["distance_mm"], dtype=float), 0.0) / reference(inputs, "distance_mm", 1.0)
    speed = np.abs(np.asarray(inputs["speed_mm_s"], dtype=float)) / reference(inputs, "speed_mm_s", 1.0)
    load = np.asarray(inputs["load_N"], dtype=float) / reference(inputs, "load_N", 1.0)
    return -A * load * np.sqrt(speed * distance)


WARMING_CONDUCTION_LOAD = Effect(
    id="warming_conduction_load",
    label="warming by sliding (conduction-limited, at several loads)",
    equation=r"h = -A \frac{N}{N_{ref}} \sqrt{|v| s / (v_{ref} s_{ref})}",
    form="-A (N / N_ref) sqrt(|v| s / (v_ref s_ref))",
    reference="cold contact (distance 0)",
    reads=("distance_mm", "speed_mm_s", "load_N"),
    acts_on=(("mu", "multiply"), ("mu_c", "multiply"), ("mu_s", "multiply"), ("force", "multiply")),
    parameters=(
        Parameter(
            "A", "{y}", 0.05, (-5.0, 0.95), "share of friction lost at reference load, speed and distance", linear=True
        ),
    ),
    shape=shape,
    source="Half-space under a steady flux: Carslaw & Jaeger 1959, Conduction of Heat in Solids, Oxford; "
    "sliding contacts: Jaeger 1942, J. Proc. R. Soc. New South Wales 76, 203-224. "
    "First order in the temperature: ours.",
    # By hand: three times the load; nine times the distance at the same speed: 3 * sqrt(9) = 9.
    worked=(
        {
            "distance_mm": 90.0,
            "distance_mm_ref": 10.0,
            "speed_mm_s": 5.0,
            "speed_mm_s_ref": 5.0,
            "load_N": 150.0,
            "load_N_ref": 50.0,
        },
        {"A": 0.05},
        -0.45,
    ),
)
