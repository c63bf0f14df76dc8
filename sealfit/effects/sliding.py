"""Effects of sliding: history of the contact, and other laws of speed, load and humidity than declared."""

import numpy as np

from sealfit.effects.contract import (
    ROOM,
    Parameter,
    amplitude,
    deviation,
    effect,
    factors,
    log_ratio,
    not_negative,
    positive,
    reference,
)

# Search grids: repeats, strokes and rests over which a contact changes, Stribeck exponents, powers of the
# speed, and widths of a peak in decades.
REPEATS = (0.3, 0.6, 1.0, 2.0, 4.0, 8.0)
STROKES = (0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0)
RESTS = (0.01, 0.1, 1.0, 10.0, 100.0, 1e3)
EXPONENTS = (0.4, 0.6, 0.8, 1.0, 1.4, 3.0, 4.0, 6.0)
POWERS = (0.2, 0.35, 0.5, 0.7, 1.4, 2.0, 3.0)
WIDTHS = (0.2, 0.4, 0.7, 1.0, 1.5, 2.5)
REVIEW = (
    "Armstrong-Helouvry, Dupont & Canudas de Wit 1994, Automatica 30(7), 1083-1138, "
    "doi:10.1016/0005-1098(94)90209-7"
)


@effect(
    label="conditioning over repeats (Mullins)",
    equation="h = A (1 - exp(-(n - 1) / n_0))",
    reference="first repeat",
    reads=("repeat",),
    acts_on=factors("mu", "force", "mu_s", "mu_c"),
    parameters=(
        amplitude("A", "{y}", -0.05, "relative change once conditioned", (-0.95, 10.0)),
        Parameter("n_0", "", 1.0, (0.1, 1e3), "repeats that conditioning takes", search=REPEATS),
    ),
    source="Mullins 1969, Rubber Chem. Technol. 42(1), 339-362, doi:10.5254/1.3539210; review: "
    "Diani, Fayolle & Gilormini 2009, Eur. Polym. J. 45(3), 601-612, "
    "doi:10.1016/j.eurpolymj.2008.11.017. Exponential in repeats: ours.",
    # By hand: two repeats after the first, n_0 = 2: 1 - 1/e = 0.6321205588285577 of the way.
    worked=({"repeat": 3.0}, {"A": -0.1, "n_0": 2.0}, -0.1 * 0.6321205588285577),
)
def conditioning(inputs, *, A, n_0):
    r"""Conditioning over repeats (Mullins): the first repeat differs most, later ones settle.

    Filled rubber softens on its first deformations and keeps what it lost: stress falls most in the first
    cycle and reaches a steady state after some 10. Softer rubber changes contact area and hysteresis, so
    friction changes along with it. n is the repeat. The exponential has a limit, as conditioning ends, unlike
    a logarithm (`log`); three repeats hardly distinguish the two.
    """
    before = np.maximum(np.asarray(inputs["repeat"], dtype=float) - 1, 0.0)
    return -A * np.expm1(-before / n_0)


@effect(
    label="run-in over strokes",
    equation="h = A (1 - exp(-(n - 1) / n_0))",
    reference="first stroke",
    reads=("stroke",),
    acts_on=factors("mu", "force", "mu_s", "mu_c"),
    parameters=(
        amplitude("A", "{y}", -0.05, "relative change once run in", (-0.95, 10.0)),
        Parameter("n_0", "", 3.0, (0.1, 1e5), "strokes that run-in takes", search=STROKES),
    ),
    source="Blau 2005, Tribology International 38(11-12), 1007-1012, doi:10.1016/j.triboint.2005.07.020. "
    "Exponential in strokes: ours, the simplest approach to a steady value.",
    # By hand: 4 ln 2 strokes after the first with n_0 = 4: half of the way; ln 2 = 0.6931471805599453.
    worked=({"stroke": 1 + 4 * 0.6931471805599453}, {"A": -0.2, "n_0": 4.0}, -0.1),
)
def run_in(inputs, *, A, n_0):
    r"""Run-in over strokes: the contact changes over the first strokes of a record and settles.

    Sliding smooths the rubber's skin, spreads a film or clears it away; friction starts high or low and
    approaches a steady value stroke by stroke. n is the stroke in its file. It restarts in every file; a
    change that lasts from file to file is a drift along the campaign, and one from repeat to repeat is
    conditioning.
    """
    before = np.maximum(np.asarray(inputs["stroke"], dtype=float) - 1, 0.0)
    return -A * np.expm1(-before / n_0)


@effect(
    label="strengthening at rest",
    equation="h = A ln(1 + t / t_0)",
    reference="no rest before the stroke",
    reads=("rest_s",),
    acts_on=factors("mu_s", "mu", "mu_c"),
    parameters=(
        amplitude("A", "{y}", 0.02, "relative growth per factor e of the rest", (-0.5, 5.0)),
        Parameter("t_0", "{x}", 1.0, (1e-4, 1e6), "rest below which nothing shows", search=RESTS),
    ),
    source="Dieterich 1972, J. Geophys. Res. 77(20), 3690-3697; review: "
    "Baumberger & Caroli 2006, Adv. Phys. 55, 279-348.",
    # By hand: a rest of 9 t_0 gives ln 10 = 2.302585092994046.
    worked=({"rest_s": 18.0}, {"A": 0.02, "t_0": 2.0}, 0.02 * 2.302585092994046),
)
def rest_strengthening(inputs, *, A, t_0):
    r"""Strengthening at rest: static friction grows with the time of stationary contact.

    Contacts creep and bonds form during rest: the static coefficient grows with the logarithm of the time at
    rest. A is 0.01 to 0.05 for most solids. It needs a column `rest_s`.
    """
    return A * np.log1p(not_negative(inputs["rest_s"]) / t_0)


@effect(
    label="load exponent of rubber",
    equation="h = A ln(N / N_ref), A = n - 1 to first order in mu ~ N^(n-1)",
    reference="{load_N} = {load_N_ref}",
    reads=("load_N",),
    acts_on=factors("mu", "mu_c", "mu_s"),
    parameters=(amplitude("A", "{y}", -0.1, "load exponent of friction minus one", (-2.0, 2.0)),),
    source="Schallamach 1952, The load dependence of rubber friction, Proc. Phys. Soc. B 65, 657-661. "
    "First order: ours.",
    # By hand: twice the reference load, ln 2 = 0.6931471805599453.
    worked=({"load_N": 100.0, "load_N_ref": 50.0}, {"A": -0.2}, -0.2 * 0.6931471805599453),
)
def load_exponent(inputs, *, A):
    r"""Load exponent of rubber: friction grows more slowly than the load, so the coefficient falls with it.

    The true contact area of a smooth elastic asperity goes with the load to the power 2/3, so that :math:`F
    \propto N^n` and :math:`\mu = \mu_{ref} (N / N_{ref})^{n - 1}` with n between 2/3 and 1. The first order
    in n - 1 is fitted, as A is then a linear parameter. The neglected term is :math:`\frac12 A^2 \ln^2(N /
    N_{ref})`, 0.7 % of friction at A = -1/6 and twice the load; `power` is the full curve.

    If the local coefficient depends on the local pressure, :math:`\mu(p) \propto p^{n - 1}`, the exponent is
    the same, and the pressure distribution gives a constant factor on mu.
    """
    return A * log_ratio(inputs, "load_N")


@effect(
    label="Stribeck exponent other than 2",
    equation="h = A (exp(-(|v| / v_s)^n) - exp(-(v / v_s)^2))",
    reference="Stribeck exponent 2",
    reads=("speed_mm_s",),
    acts_on=(("mu", "add"), ("mu", "multiply")),
    parameters=(
        amplitude("A", "{y}", 0.3, "drop of friction across the Stribeck curve", (-10.0, 10.0)),
        Parameter("v_s", "{x}", 5.0, (1e-6, 1e6), "Stribeck velocity", search="ratio"),
        Parameter("n", "", 1.0, (0.2, 10.0), "Stribeck exponent", search=EXPONENTS, vanishes_at=2.0),
    ),
    source="Exponents from 1/2 upwards: Bo & Pavelescu 1982, Wear 82(3), 277-289; review: "
    f"{REVIEW}. As a difference: ours.",
    # By hand: twice v_s, n = 1: exp(-2) - exp(-4) = 0.11701964434787852.
    worked=({"speed_mm_s": -10.0}, {"A": 0.3, "v_s": 5.0, "n": 1.0}, 0.3 * 0.11701964434787852),
)
def stribeck_exponent(inputs, *, A, v_s, n):
    r"""Stribeck exponent other than 2: friction falls with speed more gradually or abruptly than declared.

    The declared curve falls from mu_s to mu_c as a Gaussian of the speed, by convention. A wide distribution
    of contact strengths gives n near 1 or below; the sudden formation of a film gives n well above 2. The
    effect is the difference of the two decays, which is zero at rest, at v_s, far above v_s, and everywhere
    for n = 2. With A = mu_s - mu_c and the declared v_s, the curve with the effect is exactly
    :math:`\mu_c + (\mu_s - \mu_c) e^{-(|v| / v_s)^n}`. As a factor on mu, A is relative to mu, and this is an
    approximation for small changes of mu around v_s.

    Three parameters here and four of the declared curve need seven speeds in one direction, several on each
    side of v_s. Near n = 2 the shape is :math:`A (2 - n) r^2 \ln r\, e^{-r^2}` with :math:`r = |v| / v_s`, so
    that only the product A (2 - n) is determined.
    """
    ratio = np.abs(np.asarray(inputs["speed_mm_s"], dtype=float)) / v_s
    return A * (np.exp(-(ratio**n)) - np.exp(-(ratio**2)))


@effect(
    label="logarithmic rate dependence",
    equation="h = A ln(|v| / v_ref)",
    reference="{speed_mm_s} = {speed_mm_s_ref}",
    reads=("speed_mm_s",),
    acts_on=(("mu", "multiply"), ("mu_c", "multiply"), ("mu", "add"), ("mu_c", "add")),
    parameters=(amplitude("A", "{y}", 0.02, "change per factor e of the speed", (-2.0, 2.0)),),
    source="Rate term of rate-and-state friction; review: Baumberger & Caroli 2006, Adv. Phys. 55, 279-348.",
    # By hand: ten times the reference speed, backward: ln 10 = 2.302585092994046.
    worked=({"speed_mm_s": -50.0, "speed_mm_s_ref": 5.0}, {"A": 0.03}, 0.03 * 2.302585092994046),
)
def log_rate(inputs, *, A):
    r"""Logarithmic rate dependence: friction that changes by the same amount for every factor of the speed.

    The stress of contacts that break by thermal activation is proportional to the logarithm of the rate. A is
    positive if the breaking of bonds dominates (strengthening with rate), negative if the age of the contacts
    does. It is not defined at rest.
    """
    return A * np.log(positive(np.abs(inputs["speed_mm_s"])) / reference(inputs, "speed_mm_s", 1.0))


@effect(
    label="viscous friction by a power of the speed",
    equation="h = A sgn(v) (|v| / v_ref)^n",
    reference="additional viscous force removed",
    reads=("speed_mm_s",),
    acts_on=(("force", "add"),),
    parameters=(
        amplitude("A", "{y}", 1.0, "force at the reference speed"),
        Parameter("n", "", 0.5, (0.05, 4.0), "exponent of the speed", search=POWERS),
    ),
    source=f"Form: Ostwald-de Waele power law as a friction term; speed-dependent friction terms: {REVIEW}.",
    # By hand: four times the reference speed, backward: -2 * sqrt(4).
    worked=({"speed_mm_s": -20.0, "speed_mm_s_ref": 5.0}, {"A": 2.0, "n": 0.5}, -4.0),
)
def power_viscous(inputs, *, A, n):
    r"""Viscous friction by a power of the speed: shear-thinning grease, or a film that thickens with speed.

    The drag of a Newtonian film of constant thickness is the declared sigma_2 v. That of a shear-thinning
    film is proportional to :math:`|v|^n` with n < 1. A hydrodynamic film, as under a seal lip, has a
    thickness proportional to the root of the speed and n near 1/2.

    A is the force at the reference speed. At n = 1 it is not distinguishable from sigma_2 v.
    """
    speed = np.asarray(inputs["speed_mm_s"], dtype=float)
    return A * np.sign(speed) * (np.abs(speed) / reference(inputs, "speed_mm_s", 1.0)) ** n


@effect(
    label="viscoelastic peak over log speed (Grosch)",
    equation="h = A exp(-(log10(|v| / v_p) / w)^2)",
    reference="peak over speed removed",
    reads=("speed_mm_s",),
    acts_on=(("mu", "multiply"), ("mu", "add"), ("mu_c", "multiply"), ("mu_c", "add")),
    parameters=(
        amplitude("A", "{y}", 0.1, "height of the peak", (0.0, 10.0)),
        Parameter("v_p", "{x}", 10.0, (1e-6, 1e6), "speed at the peak", search="ratio"),
        Parameter("w", "decade", 1.0, (0.05, 10.0), "half-width at 1/e", search=WIDTHS),
    ),
    source="Bell over log speed: Grosch 1963, Proc. R. Soc. A 274, 21-39, doi:10.1098/rspa.1963.0112; "
    "shift: Williams, Landel & Ferry 1955, J. Am. Chem. Soc. 77, 3701-3707, doi:10.1021/ja01619a008. "
    "Gaussian form: ours.",
    # By hand: two decades above the peak with w = 2: 1/e = 0.36787944117144233.
    worked=({"speed_mm_s": -100.0}, {"A": 0.3, "v_p": 1.0, "w": 2.0}, 0.3 * 0.36787944117144233),
)
def grosch_peak(inputs, *, A, v_p, w):
    r"""Viscoelastic peak over log speed (Grosch): rubber friction has a maximum where its loss has one.

    Deformation by asperities and molecular adhesion dissipate most at different rates. Each gives a bell over
    the logarithm of the speed, shifted by temperature (WLF). A is the height of the bell, relative to the
    Stribeck curve or as an added coefficient of friction. The height of a peak beyond the tested speeds is
    not determined.
    """
    decades = np.log10(positive(np.abs(inputs["speed_mm_s"])) / v_p)
    return A * np.nan_to_num(np.exp(-((decades / w) ** 2)), nan=0.0)


@effect(
    label="humidity of the laboratory",
    equation="h = A (H - H_ref)",
    reference="{humidity_pct} = {humidity_pct_ref}",
    reads=("humidity_pct",),
    acts_on=ROOM,
    parameters=(amplitude("A", "{y}/{x}", -0.001, "change per percent of relative humidity"),),
    source="Form: ours. First order in the humidity about its mean.",
    # By hand: 20 % below the reference at -0.1 % of friction per percent.
    worked=({"humidity_pct": 35.0, "humidity_pct_ref": 55.0}, {"A": -0.001}, 0.02),
)
def humidity(inputs, *, A):
    r"""Humidity of the laboratory: a film of water between rubber and track.

    Water from the air weakens adhesion and lubricates at speed. Over the humidities of a laboratory the
    effect is about linear. It needs a column `humidity_pct`; for another name the effect is `linear`.
    """
    return A * deviation(inputs, "humidity_pct")
