"""Effects of the history of a contact: conditioning, running-in and rest."""

from __future__ import annotations

import numpy as np

from sealfit.effects.contract import Effect, Parameter, not_negative


def conditioning_shape(inputs, *, A, n_0):
    r"""Conditioning over repeats (Mullins): the first repeat differs most, later ones settle.

    Filled rubber softens on its first deformations and keeps what it lost: stress falls most in the first
    cycle and reaches a steady state after some 10. Softer rubber changes contact area and hysteresis, so
    friction changes along with it,

    .. math:: h = A (1 - e^{-(n - 1) / n_0})

    with n the repeat. A is the relative change after conditioning. The exponential has a limit, as
    conditioning ends, unlike a logarithm (`log`); three repeats hardly distinguish the two.
    """
    before = np.maximum(np.asarray(inputs["repeat"], dtype=float) - 1, 0.0)
    return -A * np.expm1(-before / n_0)


CONDITIONING = Effect(
    id="conditioning",
    label="conditioning over repeats (Mullins)",
    equation=r"h = A (1 - e^{-(n - 1) / n_0})",
    form="A (1 - exp(-(n - 1) / n_0))",
    reference="first repeat",
    reads=("repeat",),
    acts_on=(("mu", "multiply"), ("force", "multiply"), ("mu_s", "multiply"), ("mu_c", "multiply")),
    parameters=(
        Parameter("A", "{y}", -0.05, (-0.95, 10.0), "relative change once conditioned", linear=True),
        Parameter(
            "n_0",
            "",
            1.0,
            (0.1, 1e3),
            "repeats that conditioning takes",
            search=(0.3, 0.6, 1.0, 2.0, 4.0, 8.0),
        ),
    ),
    shape=conditioning_shape,
    source="Mullins 1969, Rubber Chem. Technol. 42(1), 339-362, doi:10.5254/1.3539210; review: "
    "Diani, Fayolle & Gilormini 2009, Eur. Polym. J. 45(3), 601-612, "
    "doi:10.1016/j.eurpolymj.2008.11.017. Exponential in repeats: ours.",
    # By hand: two repeats after the first, n_0 = 2: 1 - 1/e = 0.6321205588285577 of the way.
    worked=({"repeat": 3.0}, {"A": -0.1, "n_0": 2.0}, -0.1 * 0.6321205588285577),
)


def run_in_shape(inputs, *, A, n_0):
    r"""Run-in over strokes: the contact changes over the first strokes of a record and settles.

    Sliding smooths the rubber's skin, spreads a film or clears it away; friction starts high or low and
    approaches a steady value stroke by stroke,

    .. math:: h = A (1 - e^{-(n - 1) / n_0})

    with n the stroke in its file. A is the relative change after run-in. It restarts in every file; a change
    that lasts from file to file is a drift along the campaign, and one from repeat to repeat is conditioning.
    """
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
            "n_0",
            "",
            3.0,
            (0.1, 1e5),
            "strokes that run-in takes",
            search=(0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0),
        ),
    ),
    shape=run_in_shape,
    source="Blau 2005, Tribology International 38(11-12), 1007-1012, doi:10.1016/j.triboint.2005.07.020. "
    "Exponential in strokes: ours, the simplest approach to a steady value.",
    # By hand: 4 ln 2 strokes after the first with n_0 = 4: half of the way; ln 2 = 0.6931471805599453.
    worked=({"stroke": 1 + 4 * 0.6931471805599453}, {"A": -0.2, "n_0": 4.0}, -0.1),
)


def rest_strengthening_shape(inputs, *, A, t_0):
    r"""Strengthening at rest: static friction grows with the time of stationary contact.

    Contacts creep and bonds form during rest: the static coefficient grows with the logarithm of the time at
    rest,

    .. math:: h = A \ln(1 + t / t_0)

    A is the relative growth per factor e of the time at rest, 0.01 to 0.05 for most solids; t_0 is the time
    at which growth sets in. It needs a column `rest_s`.
    """
    return A * np.log1p(not_negative(inputs["rest_s"]) / t_0)


REST_STRENGTHENING = Effect(
    id="rest_strengthening",
    label="strengthening at rest",
    equation=r"h = A \ln(1 + t / t_0)",
    form="A ln(1 + t / t_0)",
    reference="no rest before the stroke",
    reads=("rest_s",),
    acts_on=(("mu_s", "multiply"), ("mu", "multiply"), ("mu_c", "multiply")),
    parameters=(
        Parameter("A", "{y}", 0.02, (-0.5, 5.0), "relative growth per factor e of the rest", linear=True),
        Parameter(
            "t_0",
            "{x}",
            1.0,
            (1e-4, 1e6),
            "rest below which nothing shows",
            search=(0.01, 0.1, 1.0, 10.0, 100.0, 1e3),
        ),
    ),
    shape=rest_strengthening_shape,
    source="Dieterich 1972, J. Geophys. Res. 77(20), 3690-3697; review: "
    "Baumberger & Caroli 2006, Adv. Phys. 55, 279-348.",
    # By hand: a rest of 9 t_0 gives ln 10 = 2.302585092994046.
    worked=({"rest_s": 18.0}, {"A": 0.02, "t_0": 2.0}, 0.02 * 2.302585092994046),
)
