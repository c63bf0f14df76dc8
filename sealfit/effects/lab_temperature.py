r"""Laboratory temperature: friction follows the room, a few per mille for each degree.

Above its peak over speed, rubber friction falls with temperature; over the few degrees of a laboratory a straight
line is enough,

.. math:: h = A (T - T_{ref})

A is the relative change per degree. Only where the campaign holds a column `lab_temperature_C`; a column of another
name is found as `linear` in it. The aging temperature is another thing.
"""

from __future__ import annotations

import numpy as np

from sealfit.effects.contract import AMPLITUDE, Effect, Parameter, reference


def shape(inputs, *, A):
    """Factor minus one or added force, shape (n,); `lab_temperature_C` in degrees Celsius."""
    temperature = np.asarray(inputs["lab_temperature_C"], dtype=float)
    return A * (temperature - reference(inputs, "lab_temperature_C", 0.0))


LAB_TEMPERATURE = Effect(
    id="lab_temperature",
    label="laboratory temperature",
    equation=r"h = A (T - T_{ref})",
    form="A (T - T_ref)",
    reference="{lab_temperature_C} = {lab_temperature_C_ref}",
    reads=("lab_temperature_C",),
    acts_on=(("mu", "multiply"), ("force", "add"), ("force", "multiply"), ("mu_s", "multiply"), ("mu_c", "multiply")),
    parameters=(Parameter("A", "{y}/{x}", -0.005, AMPLITUDE, "change per degree", linear=True),),
    shape=shape,
    source="Friction and temperature of rubber: Grosch 1963, Proc. R. Soc. A 274, 21-39, doi:10.1098/rspa.1963.0112. "
    "First order: ours.",
    # By hand: 3 degrees above the reference at -0.4 % per degree.
    worked=({"lab_temperature_C": 25.0, "lab_temperature_C_ref": 22.0}, {"A": -0.004}, -0.012),
)
