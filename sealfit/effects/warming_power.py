r"""Warming by the power of friction: as `warming_time`, but fast and heavily loaded runs warm more.

The power that friction turns into heat is :math:`P = \mu N |v|`, so the limit :math:`P / G` of a lumped body's
warming follows load times speed, and the share of friction lost follows it to first order:

.. math:: h = -A \frac{N |v|}{N_{ref} v_{ref}} (1 - e^{-t / \tau})

A is the share lost when warm at the reference load and speed. For a loss that is small against 1: the form is linear in
the temperature and takes P without the fall of mu itself. Needs several speeds or loads to be told from `warming_time`.
"""

from __future__ import annotations

import numpy as np

from sealfit.effects.contract import Effect, Parameter, reference


def shape(inputs, *, A, tau):
    """Factor minus one, shape (n,); time, speed and load in their slots' units."""
    time = np.maximum(np.asarray(inputs["time_s"], dtype=float), 0.0)
    speed = np.abs(np.asarray(inputs["speed_mm_s"], dtype=float)) / reference(inputs, "speed_mm_s", 1.0)
    load = np.asarray(inputs["load_N"], dtype=float) / reference(inputs, "load_N", 1.0)
    return A * load * speed * np.expm1(-time / tau)


WARMING_POWER = Effect(
    id="warming_power",
    label="warming by sliding (power)",
    equation=r"h = -A \frac{N |v|}{N_{ref} v_{ref}} (1 - e^{-t / \tau})",
    form="-A (N |v| / (N_ref v_ref)) (1 - exp(-t / tau))",
    reference="cold contact (time 0)",
    reads=("time_s", "speed_mm_s", "load_N"),
    acts_on=(("mu", "multiply"), ("mu_c", "multiply"), ("mu_s", "multiply"), ("force", "multiply")),
    parameters=(
        Parameter(
            "A", "{y}", 0.05, (-5.0, 0.95), "share of friction lost when warm at reference load and speed", linear=True
        ),
        Parameter("tau", "{x}", 5.0, (1e-4, 1e7), "time constant of warming", search="span"),
    ),
    shape=shape,
    source="Newtonian (lumped) warming: Carslaw & Jaeger 1959, Conduction of Heat in Solids, Oxford. "
    "Fall with temperature: Grosch 1963, Proc. R. Soc. A 274, 21-39, doi:10.1098/rspa.1963.0112.",
    # By hand: twice the speed, half the load: the power is the reference's; t = tau gives 1 - 1/e = 0.6321205588285577.
    worked=(
        {"time_s": 8.0, "speed_mm_s": -20.0, "speed_mm_s_ref": 10.0, "load_N": 25.0, "load_N_ref": 50.0},
        {"A": 0.1, "tau": 8.0},
        -0.1 * 0.6321205588285577,
    ),
)
