r"""Warming by sliding, seen along time: friction falls as the contact warms, and settles.

A body of heat capacity C that loses heat by conductance G, heated by the power P of friction, warms as
:math:`\Delta T = (P / G)(1 - e^{-t / \tau})` with :math:`\tau = C / G`. Rubber friction falls with temperature above
its peak (Grosch 1963), to first order in proportion, so mu is multiplied by one plus

.. math:: h = -A (1 - e^{-t / \tau})

A is the share of friction lost when warm; it is negative where friction rises with temperature. Time counts from the
stroke's or the file's first row (design: the file's own clock); before 0 the contact is cold. The power is taken as
the same in every run; `warming_power` lets it follow speed and load.
"""

from __future__ import annotations

import numpy as np

from sealfit.effects.contract import Effect, Parameter


def shape(inputs, *, A, tau):
    """Factor minus one, shape (n,); `time_s` in its slot's unit."""
    time = np.maximum(np.asarray(inputs["time_s"], dtype=float), 0.0)
    return A * np.expm1(-time / tau)


WARMING_TIME = Effect(
    id="warming_time",
    label="warming by sliding (time)",
    equation=r"h = -A (1 - e^{-t / \tau})",
    form="-A (1 - exp(-t / tau))",
    reference="cold contact (time 0)",
    reads=("time_s",),
    acts_on=(("mu", "multiply"), ("mu_c", "multiply"), ("mu_s", "multiply"), ("force", "multiply")),
    parameters=(
        Parameter("A", "{y}", 0.1, (-5.0, 0.95), "share of friction lost when warm", linear=True),
        Parameter("tau", "{x}", 5.0, (1e-4, 1e7), "time constant of warming", search="span"),
    ),
    shape=shape,
    source="Fall with temperature: Grosch 1963, Proc. R. Soc. A 274, 21-39, doi:10.1098/rspa.1963.0112. "
    "Newtonian (lumped) warming: Carslaw & Jaeger 1959, Conduction of Heat in Solids, Oxford.",
    # By hand: at t = tau the contact has warmed by 1 - 1/e = 0.6321205588285577; a fifth of it is lost.
    worked=({"time_s": 4.0}, {"A": 0.2, "tau": 4.0}, -0.2 * 0.6321205588285577),
)
