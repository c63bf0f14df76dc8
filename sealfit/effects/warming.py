"""Warming: friction falls as the contact warms, with time, distance or the power of friction."""

import numpy as np

from sealfit.effects.contract import ROOM, Parameter, amplitude, deviation, effect, factors, reference

FRICTION = factors("mu", "mu_c", "mu_s", "force")
LOST = (0.0, 0.95)  # Bounds of the share of friction that is lost. Friction that grows is no warming.
FALL = "Fall with temperature: Grosch 1963, Proc. R. Soc. A 274, 21-39, doi:10.1098/rspa.1963.0112."
LUMPED = "Newtonian (lumped) warming: Carslaw & Jaeger 1959, Conduction of Heat in Solids, Oxford."


@effect(
    label="warming by sliding (time)",
    equation="h = -A (1 - exp(-t / tau))",
    reference="cold contact (time 0)",
    reads=("time_s",),
    acts_on=FRICTION,
    parameters=(
        amplitude("A", "{y}", 0.1, "share of friction lost when warm", LOST),
        Parameter("tau", "{x}", 5.0, (1e-4, 1e7), "time constant of warming", search="span"),
    ),
    source=f"{FALL} {LUMPED}",
    # By hand: at t = tau the contact has warmed by 1 - 1/e = 0.6321205588285577; a fifth of it is lost.
    worked=({"time_s": 4.0}, {"A": 0.2, "tau": 4.0}, -0.2 * 0.6321205588285577),
)
def warming_time(inputs, *, A, tau):
    r"""Warming by sliding, along time: friction falls as the contact warms, and approaches a limit.

    A body of heat capacity C that loses heat by conductance G, heated by the power P of friction, warms as
    :math:`\Delta T = (P / G)(1 - e^{-t / \tau})` with :math:`\tau = C / G`. Rubber friction falls with
    temperature above its peak (Grosch 1963), to first order in proportion. Time is that of the stroke or the
    file; before 0 the contact is cold. The power is assumed to be the same in every run; in `warming_power`
    it is proportional to speed and load.
    """
    time = np.maximum(np.asarray(inputs["time_s"], dtype=float), 0.0)
    return A * np.expm1(-time / tau)


@effect(
    label="warming by sliding (distance)",
    equation="h = -A (1 - exp(-s / s_0))",
    reference="cold contact (distance 0)",
    reads=("distance_mm",),
    acts_on=FRICTION,
    parameters=(
        amplitude("A", "{y}", 0.1, "share of friction lost when warm", LOST),
        Parameter("s_0", "{x}", 20.0, (1e-4, 1e7), "distance over which the contact warms", search="span"),
    ),
    source=f"{FALL} Approach over a distance: ours, from the heat balance in the docstring.",
    # By hand: at s = s_0 ln 2 the exponential is 1/2, so half of A = 0.3 is lost; ln 2 = 0.6931471805599453.
    worked=({"distance_mm": 6.931471805599453}, {"A": 0.3, "s_0": 10.0}, -0.15),
)
def warming_distance(inputs, *, A, s_0):
    r"""Warming by sliding, along distance: friction falls with the work of friction, and approaches a limit.

    At one normal force the heat up to a distance s is the work of friction, mu N s, at any speed. If the
    contact warms a fixed mass and loses heat to cold track in proportion to the distance slid, the
    temperature approaches its limit over a distance instead of a time. Two speeds are needed to distinguish
    it from `warming_time`.
    """
    distance = np.maximum(np.asarray(inputs["distance_mm"], dtype=float), 0.0)
    return A * np.expm1(-distance / s_0)


@effect(
    label="warming by sliding (power)",
    equation="h = -A (N |v| / (N_ref v_ref)) (1 - exp(-t / tau))",
    reference="cold contact (time 0)",
    reads=("time_s", "speed_mm_s", "load_N"),
    acts_on=FRICTION,
    parameters=(
        amplitude("A", "{y}", 0.05, "share of friction lost when warm at reference load and speed", LOST),
        Parameter("tau", "{x}", 5.0, (1e-4, 1e7), "time constant of warming", search="span"),
    ),
    source=f"{LUMPED} {FALL}",
    # By hand: twice the speed, half the load: the power is the reference's; t = tau gives 1 - 1/e =
    # 0.6321205588285577.
    worked=(
        {"time_s": 8.0, "speed_mm_s": -20.0, "speed_mm_s_ref": 10.0, "load_N": 25.0, "load_N_ref": 50.0},
        {"A": 0.1, "tau": 8.0},
        -0.1 * 0.6321205588285577,
    ),
)
def warming_power(inputs, *, A, tau):
    r"""Warming by the power of friction: as `warming_time`, but fast and heavily loaded runs warm more.

    The power that friction turns into heat is :math:`P = \mu N |v|`, so the limit :math:`P / G` of a lumped
    body's warming follows load times speed, and the share of friction lost follows it to first order. A is
    well below 1: the form is linear in the temperature, and P is computed without the fall of mu. Several
    speeds or loads are needed to distinguish it from `warming_time`.
    """
    time = np.maximum(np.asarray(inputs["time_s"], dtype=float), 0.0)
    return A * _relative(inputs, "load_N") * _relative(inputs, "speed_mm_s") * np.expm1(-time / tau)


def _relative(inputs, name: str) -> np.ndarray:
    """Return the magnitude of a channel relative to its reference, shape (n,)."""
    return np.abs(np.asarray(inputs[name], dtype=float)) / reference(inputs, name, 1.0)


@effect(
    label="warming by sliding (conduction-limited: speed times distance)",
    equation="h = -A sqrt(|v| s / (v_ref s_ref))",
    reference="cold contact (distance 0)",
    reads=("distance_mm", "speed_mm_s"),
    acts_on=FRICTION,
    parameters=(amplitude("A", "{y}", 0.05, "share of friction lost at reference speed and distance", LOST),),
    source="Half-space under a steady flux: Carslaw & Jaeger 1959, Conduction of Heat in Solids, Oxford; "
    "sliding contacts: Jaeger 1942, J. Proc. R. Soc. New South Wales 76, 203-224. "
    "First order in the temperature: ours.",
    # By hand: twice the speed and twice the distance: sqrt(4) = 2.
    worked=(
        {"distance_mm": 40.0, "distance_mm_ref": 20.0, "speed_mm_s": -10.0, "speed_mm_s_ref": 5.0},
        {"A": 0.05},
        -0.1,
    ),
)
def warming_conduction(inputs, *, A):
    r"""Warming limited by conduction into the rubber: friction falls with the root of speed times distance.

    Rubber is a poor conductor: during a stroke heat enters a thin layer only. The surface of a half-space
    under a constant flux q warms by :math:`2 q \sqrt{t / (\pi k \rho c)}` in a time t. The flux of friction
    is :math:`q \propto \mu p |v|`, and :math:`t = s / |v|`, so that :math:`\Delta T \propto p \sqrt{|v| s}`.
    This is for one load, `warming_conduction_load` for several. It is valid until the warm layer reaches the
    back of the sample, and for a loss well below 1.
    """
    return -A * _root_of_speed_times_distance(inputs)


def _root_of_speed_times_distance(inputs) -> np.ndarray:
    """Return the root of speed times distance, both relative to their references, shape (n,)."""
    distance = np.maximum(np.asarray(inputs["distance_mm"], dtype=float), 0.0)
    return np.sqrt(_relative(inputs, "speed_mm_s") * (distance / reference(inputs, "distance_mm", 1.0)))


@effect(
    label="warming by sliding (conduction-limited, at several loads)",
    equation="h = -A (N / N_ref) sqrt(|v| s / (v_ref s_ref))",
    reference="cold contact (distance 0)",
    reads=("distance_mm", "speed_mm_s", "load_N"),
    acts_on=FRICTION,
    parameters=(
        amplitude("A", "{y}", 0.05, "share of friction lost at reference load, speed and distance", LOST),
    ),
    source=warming_conduction.effect.source,
    # By hand: three times the load; nine times the distance at the same speed: 3 * sqrt(9) = 9.
    worked=(
        {"distance_mm": 90.0, "distance_mm_ref": 10.0, "speed_mm_s": 5.0, "speed_mm_s_ref": 5.0}
        | {"load_N": 150.0, "load_N_ref": 50.0},
        {"A": 0.05},
        -0.45,
    ),
)
def warming_conduction_load(inputs, *, A):
    r"""Warming limited by conduction into the rubber, at several loads: `warming_conduction` times the load.

    The flux of friction is :math:`q \propto \mu p |v|`. For a constant contact area the pressure p is
    proportional to the load. A is small against 1.
    """
    return -A * _relative(inputs, "load_N") * _root_of_speed_times_distance(inputs)


@effect(
    label="laboratory temperature",
    equation="h = A (T - T_ref)",
    reference="{lab_temperature_C} = {lab_temperature_C_ref}",
    reads=("lab_temperature_C",),
    acts_on=ROOM,
    parameters=(amplitude("A", "{y}/{x}", -0.005, "change per degree"),),
    source="Friction and temperature of rubber: Grosch 1963, Proc. R. Soc. A 274, 21-39, "
    "doi:10.1098/rspa.1963.0112. First order: ours.",
    # By hand: 3 degrees above the reference at -0.4 % per degree.
    worked=({"lab_temperature_C": 25.0, "lab_temperature_C_ref": 22.0}, {"A": -0.004}, -0.012),
)
def lab_temperature(inputs, *, A):
    r"""Laboratory temperature: friction follows the room, a few per mille for each degree.

    Above its peak over speed, rubber friction falls with temperature. Over the few degrees of a laboratory
    the effect is about linear. It needs a column `lab_temperature_C`, which is not the aging temperature; for
    another name the effect is `linear`.
    """
    return A * deviation(inputs, "lab_temperature_C")
