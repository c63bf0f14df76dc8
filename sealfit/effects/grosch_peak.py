r"""Viscoelastic peak over log speed (Grosch): rubber friction has a maximum where its loss has one.

Asperities deform rubber at a rate that goes with the speed, and molecules adhere and let go at another; each gives a
bell over the logarithm of the speed, moved along by temperature as WLF says,

.. math:: h = A \exp[-(\log_{10}(|v| / v_p) / w)^2]

A is the height of the bell, relative to the Stribeck curve or as a coefficient of friction that is added to it. A
peak beyond the tested speeds is a slope, and its height is not determined.
"""

from __future__ import annotations

import numpy as np

from sealfit.effects.contract import Effect, Parameter, positive


def shape(inputs, *, A, v_p, w):
    """Factor minus one or added coefficient, shape (n,); signed `speed_mm_s` in its slot's unit; 0 at rest."""
    decades = np.log10(positive(np.abs(inputs["speed_mm_s"])) / v_p)
    return A * np.nan_to_num(np.exp(-((decades / w) ** 2)), nan=0.0)


GROSCH_PEAK = Effect(
    id="grosch_peak",
    label="viscoelastic peak over log speed (Grosch)",
    equation=r"h = A \exp[-(\log_{10}(|v| / v_p) / w)^2]",
    form="A exp(-(log10(|v| / v_p) / w)^2)",
    reference="peak over speed removed",
    reads=("speed_mm_s",),
    acts_on=(("mu", "multiply"), ("mu", "add"), ("mu_c", "multiply"), ("mu_c", "add")),
    parameters=(
        Parameter("A", "{y}", 0.1, (-0.95, 10.0), "height of the peak", linear=True),
        Parameter("v_p", "{x}", 10.0, (1e-6, 1e6), "speed at the peak", search="ratio"),
        Parameter("w", "decade", 1.0, (0.05, 10.0), "half-width at 1/e", search=(0.2, 0.4, 0.7, 1.0, 1.5, 2.5)),
    ),
    shape=shape,
    source="Bell over log speed: Grosch 1963, Proc. R. Soc. A 274, 21-39, doi:10.1098/rspa.1963.0112; shift: Williams, "
    "Landel & Ferry 1955, J. Am. Chem. Soc. 77, 3701-3707, doi:10.1021/ja01619a008. Gaussian form: ours.",
    # By hand: two decades above the peak with w = 2: 1/e = 0.36787944117144233.
    worked=({"speed_mm_s": -100.0}, {"A": 0.3, "v_p": 1.0, "w": 2.0}, 0.3 * 0.36787944117144233),
)
