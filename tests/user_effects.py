"""A user's own effect, as its file is written."""

WORN_PATCH = '''
"""A worn patch of the track: friction falls over it."""
import numpy as np
from sealfit.effects.contract import Effect, Parameter

def shape(inputs, *, A, x_0):
    return A / (1 + (np.asarray(inputs["displacement_mm"], float) - x_0) ** 2)

WORN_PATCH = Effect(
    id="worn_patch",
    label="worn patch of the track",
    equation="h = A / (1 + (x - x_0)^2)",
    reads=("displacement_mm",),
    acts_on=(("mu", "multiply"),),
    parameters=(
        Parameter("A", "{y}", -0.1, (-0.9, 1.0), "change at the middle", linear=True),
        Parameter("x_0", "{x}", 0.0, (-100.0, 100.0), "middle", search="inside"),
    ),
    shape=shape,
    source="Form: ours.",
    worked=({"displacement_mm": 4.0}, {"A": -0.2, "x_0": 3.0}, -0.1),
)
'''
