r"""Arrhenius acceleration of aging with temperature: the loss a, or the time b of its onset, follows the oven.

Oxidation and the breaking and joining of network bonds need an activation energy E, so their rate grows as
:math:`e^{-E / R T}`. A share A of the aging is of that kind; the rest, physical relaxation, is taken as the same at
every temperature,

.. math:: h = A [e^{E / R\, (1 / T_{ref} - 1 / T)} - 1]

with T in kelvin. A = 1 is Arrhenius' law itself, a factor :math:`e^{E / R\, (1 / T_{ref} - 1 / T)}`. On a it is the
rate of the loss, E positive. On b, a time, E is negative: A = 1 then shifts the whole curve of Eq. 15 along the
logarithm of time, which is time-temperature superposition. Unaged rubber is unchanged whatever its temperature.

Two temperatures determine one number, three tell A from E; where the exponent is small, only A E is determined. The
declared model has an a and a b of its own for each series, and where temperature makes series they take all of it up:
there is something to find only where one series holds several, as with a config whose `condition` leaves it out.
"""

from __future__ import annotations

import numpy as np

from sealfit.effects.contract import Effect, Parameter, positive, reference

GAS_CONSTANT = 8.314462618  # J/(mol K), CODATA 2018
ZERO_C = 273.15  # K
STANDARD_C = 23.0  # degC, standard laboratory temperature of rubber tests, ISO 23529


def shape(inputs, *, A, E):
    """Factor minus one, shape (n,); `temperature_C` of aging in degrees Celsius (NaN at or below absolute zero)."""
    kelvin = positive(np.asarray(inputs["temperature_C"], dtype=float) + ZERO_C)
    at_reference = reference(inputs, "temperature_C", STANDARD_C) + ZERO_C
    return A * np.expm1(E / GAS_CONSTANT * (1 / at_reference - 1 / kelvin))


ARRHENIUS_AGING = Effect(
    id="arrhenius_aging",
    label="Arrhenius acceleration of aging with temperature",
    equation=r"h = A [e^{E / R\, (1 / T_{ref} - 1 / T)} - 1]",
    form="A (exp(E / R (1 / T_ref - 1 / T)) - 1)",
    reference="{temperature_C} = {temperature_C_ref}",
    reads=("temperature_C",),
    acts_on=(("a", "multiply"), ("b", "multiply")),
    parameters=(
        Parameter("A", "{y}", 1.0, (-10.0, 10.0), "share of the aging that is thermally activated", linear=True),
        Parameter(
            "E",
            "J/mol",
            8e4,
            (-3e5, 3e5),
            "activation energy; negative on b, which is a time",
            search=(-1.2e5, -8e4, -4e4, 2e4, 4e4, 8e4, 1.2e5),
        ),
    ),
    shape=shape,
    source="Arrhenius 1889, Z. Phys. Chem. 4, 226-248; for the life of rubber: ISO 11346. With a share that is not "
    "activated: ours.",
    # By hand: E = R T_ref ln 16 and T = 2 T_ref: the exponent is ln 16 / 2 = ln 4, and 0.5 (4 - 1) = 1.5. In numbers:
    # T_ref = 300 K, E = 8.314462618 * 300 * 2.772588722239781, T = 600 K.
    worked=(
        {"temperature_C": 326.85, "temperature_C_ref": 26.85},
        {"A": 0.5, "E": 8.314462618 * 300 * 2.772588722239781},
        1.5,
    ),
)
