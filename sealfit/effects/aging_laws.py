"""Other laws of aging than Eq. 15."""

import numpy as np

from sealfit.effects.contract import Parameter, amplitude, effect, factors, not_negative, positive, reference

GAS_CONSTANT = 8.314462618  # J/(mol K), CODATA 2018
ZERO_C = 273.15  # 0 degrees Celsius in K
STANDARD_C = 23.0  # laboratory temperature of rubber tests in degrees Celsius, ISO 23529
WU = "Wu et al. 2020, Polymers 12(1), 102, doi:10.3390/polym12010102"
ENERGIES = (-1.2e5, -8e4, -4e4, 2e4, 4e4, 8e4, 1.2e5)  # search grid of the activation energy in J/mol
E_MEANS = "activation energy; negative on b, which is a time"
# Targets of laws over the days of aging, most likely first.
ON_COEFFICIENTS = (
    ("mu", "multiply"), ("mu_c", "add"), ("mu_s", "add"), ("mu_c", "multiply"), ("mu_s", "multiply"),
)  # fmt: skip


@effect(
    label="Arrhenius acceleration of aging with temperature",
    equation="h = A (exp(E / R (1 / T_ref - 1 / T)) - 1)",
    reference="{temperature_C} = {temperature_C_ref}",
    reads=("temperature_C",),
    acts_on=factors("a", "b"),
    parameters=(
        amplitude("A", "{y}", 1.0, "share of the aging that is thermally activated", (-10.0, 10.0)),
        Parameter("E", "J/mol", 8e4, (-3e5, 3e5), E_MEANS, search=ENERGIES),
    ),
    source="Arrhenius 1889, Z. Phys. Chem. 4, 226-248; for the life of rubber: ISO 11346. "
    "With a share that is not activated: ours.",
    # By hand: E = R T_ref ln 16, T_ref = 300 K and T = 2 T_ref: the exponent is ln 4, and 0.5 (4 - 1) = 1.5.
    worked=({"temperature_C": 326.85, "temperature_C_ref": 26.85}, {"A": 0.5, "E": 6915.775585845}, 1.5),
)
def arrhenius_aging(inputs, *, A, E):
    r"""Arrhenius acceleration of aging with temperature: of the loss a, or of the time b of its onset.

    Oxidation, scission and cross-linking of network bonds have an activation energy E, and a rate
    proportional to :math:`e^{-E / R T}`, T in kelvin. A share A of the aging is of that kind; the rest is
    assumed to be independent of temperature. A = 1 is Arrhenius' law, a factor
    :math:`e^{E / R\, (1 / T_{ref} - 1 / T)}`. On a, the rate of the loss, E is positive. On b, a time, E is
    negative, and A = 1 shifts the curve of Eq. 15 along the logarithm of time (time-temperature
    superposition). Unaged rubber does not change.

    Two temperatures determine one parameter, three distinguish A and E; for a small exponent only A E is
    determined. The declared model has a separate a and b for each series. The effect can be seen only if one
    series contains several temperatures, that is if `condition` in the config does not list the temperature.
    """
    kelvin = positive(np.asarray(inputs["temperature_C"], dtype=float) + ZERO_C)
    at_reference = reference(inputs, "temperature_C", STANDARD_C) + ZERO_C
    return A * np.expm1(E / GAS_CONSTANT * (1 / at_reference - 1 / kelvin))


@effect(
    label="compression while aging",
    equation="h = A (100 - c) / 100",
    reference="not compressed (100 %)",
    reads=("compression_ratio_pct",),
    acts_on=factors("a", "b", "mu", "mu_s", "mu_c"),
    parameters=(amplitude("A", "{y}", 0.5, "relative change per whole height taken away"),),
    source=f"Friction after aging at 80, 90 and 100 % of the height: {WU}. First order: ours.",
    # By hand: a fifth of the height taken away.
    worked=({"compression_ratio_pct": 80.0}, {"A": 0.6}, 0.12),
)
def compression_factor(inputs, *, A):
    r"""Compression during aging: it changes aging, or friction after aging.

    A seal ages under compression. Strain changes which bonds form and break (compression set), and the
    surface has less contact with air. c is the height in per cent of the original height, and A the relative
    change per full compression, so that 80 % gives A / 5. On a or b it changes aging; on mu it also changes
    the friction of unaged rubber with a compression.

    The declared model has a separate a and b for each series. An effect on a or b can be seen only if one
    series contains several heights.
    """
    return A * (100.0 - np.asarray(inputs["compression_ratio_pct"], dtype=float)) / 100.0


@effect(
    label="aging with a floor",
    equation="h = A ln(max(1, t / t_f))",
    reference="no more than {t_f} days",
    reads=("aging_days",),
    acts_on=ON_COEFFICIENTS,
    parameters=(
        amplitude("A", "{y}", 0.03, "fall given back per factor e of the time", (-10.0, 10.0)),
        Parameter("t_f", "{x}", 8.0, (1e-3, 1e5), "day from which it is given back", search="inside"),
    ),
    source=f"Form: ours. The logarithm of Eq. 15, cut off: {WU}.",
    # By hand: twice the day of the floor, ln 2 = 0.6931471805599453.
    worked=({"aging_days": 16.0}, {"A": 0.04, "t_f": 8.0}, 0.04 * 0.6931471805599453),
)
def aging_floor(inputs, *, A, t_f):
    r"""Aging with a floor: after some day the coefficient falls less than by the logarithm.

    Eq. 15 has no limit, but aging ends when the reactants are consumed. After a day t_f the fall is reduced.
    As a change of mu_s or mu_c, A = a stops the fall of :math:`\mu_0 - a \ln(1 + t / b)` altogether for t
    well beyond b, and a smaller A slows it. As a factor on mu, A is relative to mu.
    """
    return A * np.log(np.maximum(np.asarray(inputs["aging_days"], dtype=float) / t_f, 1.0))


@effect(
    label="aging with an induction time",
    equation="h = A (t / t_i) exp(1 - t / t_i)",
    reference="unaged",
    reads=("aging_days",),
    acts_on=ON_COEFFICIENTS,
    parameters=(
        amplitude("A", "{y}", 0.05, "largest lag behind the logarithmic law", (-10.0, 10.0)),
        Parameter("t_i", "{x}", 2.0, (1e-3, 1e5), "day of the largest lag", search="inside"),
    ),
    source="Form: ours. The simplest lag that starts at zero, has one maximum and dies out.",
    # By hand: at twice t_i, 2 exp(-1) = 2 * 0.36787944117144233.
    worked=({"aging_days": 4.0}, {"A": 0.1, "t_i": 2.0}, 0.1 * 2 * 0.36787944117144233),
)
def aging_induction(inputs, *, A, t_i):
    r"""Aging with an induction time: at first the coefficient falls less than by the logarithm.

    Antioxidants delay oxidation until they are consumed. The difference from Eq. 15 is zero at day 0, largest
    (A) at t_i, and vanishes later.
    """
    ratio = np.maximum(np.asarray(inputs["aging_days"], dtype=float), 0.0) / t_i
    return A * ratio * np.exp(1 - ratio)


@effect(
    label="aging that starts late",
    equation="h = A (ln(1 + t / b) - ln(1 + max(t - t_i, 0) / b))",
    reads=("aging_days",),
    acts_on=ON_COEFFICIENTS,
    parameters=(
        amplitude("A", "{y}", 0.05, "loss for each unit of the logarithm", (-10.0, 10.0)),
        Parameter("t_i", "{x}", 2.0, (1e-3, 1e5), "day on which aging starts", search="inside"),
        Parameter("b", "{x}", 0.1, (1e-3, 1e3), "time constant of the law", search=(0.03, 0.1, 0.3, 1.0)),
    ),
    reference="unaged",
    source="Eq. 15 with a later start; the induction period of oxidation: Celina, Gillen & Assink 2005, "
    "Polymer Degradation and Stability 90(3), 395-404, doi:10.1016/j.polymdegradstab.2005.05.004.",
    # By hand: day 4, start at day 2, b = 1: ln 5 - ln 3 = 0.5108256237659907.
    worked=({"aging_days": 4.0}, {"A": 0.1, "t_i": 2.0, "b": 1.0}, 0.1 * 0.5108256237659907),
)
def aging_delay(inputs, *, A, t_i, b):
    r"""Aging with a delay: Eq. 15 starts at a day t_i.

    Antioxidants delay oxidation until they are consumed. The declared law starts at day 0, so the effect is
    the difference of the two laws, which is zero at day 0 and vanishes as :math:`A t_i / t`. If A is the a of
    the declared law (relative to mu, for a factor) and b its b, the law with the effect is Eq. 15 with
    :math:`t - t_i` for t. `aging_induction` is a smooth delay.
    """
    days = np.maximum(np.asarray(inputs["aging_days"], dtype=float), 0.0)
    return A * (np.log1p(days / b) - np.log1p(np.maximum(days - t_i, 0.0) / b))


ONSETS = (0.01, 0.1, 1.0, 10.0, 100.0)
ONSET = Parameter("t_0", "{x}", 1.0, (1e-4, 1e5), "aging time at which the change sets in", search=ONSETS)


@effect(
    label="Stribeck velocity changing with age",
    equation="h = A ln(1 + t / t_0)",
    reference="unaged",
    reads=("aging_days",),
    acts_on=(("v_s", "multiply"),),
    parameters=(
        amplitude("A", "{y}", 0.1, "relative change of v_s per factor e of the aging time", (-5.0, 20.0)),
        ONSET,
    ),
    source=f"Form: ours, after the law of the coefficients: {WU}, Eq. 15.",
    # By hand: t = t_0 gives ln 2 = 0.6931471805599453.
    worked=({"aging_days": 2.0}, {"A": 0.3, "t_0": 2.0}, 0.3 * 0.6931471805599453),
)
def stribeck_speed_aging(inputs, *, A, t_0):
    r"""Stribeck velocity that changes with age; the declared model has one for all days.

    v_s is the speed of the transition from boundary friction to a film or a molecular time scale. Hardened
    rubber conforms less to roughness and relaxes more slowly, which changes v_s. As for the coefficients, the
    change is a logarithm of time.
    """
    return A * np.log1p(not_negative(inputs["aging_days"]) / t_0)


@effect(
    label="viscous coefficient changing with age",
    equation="h = A ln(1 + t / t_0)",
    reference="unaged",
    reads=("aging_days",),
    acts_on=(("sigma_2", "add"), ("sigma_2", "multiply")),
    parameters=(amplitude("A", "{y}", 0.01, "change of sigma_2 per factor e of the aging time"), ONSET),
    source=f"Form: ours, after the law of the coefficients: {WU}, Eq. 15.",
    # By hand: t = 9 t_0 gives ln 10 = 2.302585092994046.
    worked=({"aging_days": 9.0}, {"A": -0.02, "t_0": 1.0}, -0.02 * 2.302585092994046),
)
def viscosity_aging(inputs, *, A, t_0):
    r"""Viscous coefficient that changes with age; the declared model has one for all days.

    The remaining lubricant and the damping of the rubber change with age, and sigma_2 with them.
    """
    return A * np.log1p(not_negative(inputs["aging_days"]) / t_0)
