"""Effects of the force sensor and the set-up: offsets, drift and a ripple along the track."""

import numpy as np

from sealfit.effects.contract import (
    CHANNEL,
    PHASE,
    PHASES,
    Parameter,
    amplitude,
    deviation,
    effect,
    factors,
    mean_sine,
    reference,
)

WAVELENGTH = "wavelength: pitch of the screw, or its whole fraction"
# Targets of changes along the campaign, most likely first.
IN_TIME = (("mu", "multiply"), ("force", "add"), ("force", "multiply"))


@effect(
    label="ripple along the rig's position",
    equation="h = A sin(2 pi (x - x_ref) / lambda + phi)",
    reference="mean over a wavelength",
    reads=("displacement_mm",),
    acts_on=(("force", "add"), ("mu", "multiply"), ("force", "multiply")),
    parameters=(
        amplitude("A", "{y}", 0.1, "amplitude"),
        Parameter("lambda_", "{x}", 2.0, (1e-4, 1e6), WAVELENGTH, search="span"),
        Parameter("phi", "rad", 0.0, PHASE, "phase at position 0, or x_ref", search=PHASES),
    ),
    source="Form: ours. A cyclic error of a screw is periodic in its angle; "
    "the sine is its first Fourier term.",
    # By hand: 0.5 mm of a 2 mm pitch is a quarter turn, pi/2; with phi = pi/3 the sine is cos(pi/3) = 1/2.
    worked=({"displacement_mm": 0.5}, {"A": 3.0, "lambda_": 2.0, "phi": np.pi / 3}, 1.5),
    periodic=True,
)
def ripple(inputs, *, A, lambda_, phi):
    r"""Ripple along the rig's position, due to a screw, a guide or a periodic track.

    A lead screw with a pitch error, a bent shaft or an eccentric coupling gives a force that is periodic in
    the rig's coordinate. The wavelength is the pitch, or an integer fraction of it for a screw of several
    starts. It is an added force, the same in both directions, if the drive strains the sensor, and a factor
    on friction if the pressure or the surface of the contact is periodic along the track. A harmonic is a
    further ripple of half or a third of the wavelength. Positions beyond the tested ones are extrapolated in
    phase. x_ref is 0, or near the positions of a rig that counts from far away.
    """
    x = np.asarray(inputs["displacement_mm"], dtype=float) - reference(inputs, CHANNEL, 0.0)
    return A * mean_sine(inputs, "displacement_mm", 2 * np.pi * x / lambda_ + phi, lambda_)


@effect(
    label="sensor drift in time",
    equation="h = A t",
    reference="time 0 of the file",
    reads=("time_s",),
    acts_on=(("force", "add"),),
    parameters=(amplitude("A", "{y}/{x}", 0.01, "drift of the force per time"),),
    source="Form: ours. First order in time of a slow change of the zero.",
    # By hand: 20 s at 0.02 N/s.
    worked=({"time_s": 20.0}, {"A": 0.02}, 0.4),
)
def drift(inputs, *, A):
    r"""Drift of the force channel along a record: a strain-gauge bridge or its amplifier warming up.

    A is the rate. The added force does not depend on the direction of motion. Time is that of the file, so
    that the drift restarts with every file.
    """
    return A * np.asarray(inputs["time_s"], dtype=float)


@effect(
    label="zero offset of the force",
    equation="h = A",
    reference="zero offset removed",
    reads=("direction",),
    acts_on=(("force", "add"),),
    parameters=(amplitude("A", "{y}", 0.1, "force shown when none acts"),),
    source="Form: ours. Definition of a zero offset.",
    # By hand: the offset itself, in both directions.
    worked=({"direction": -1.0}, {"A": 0.3}, 0.3),
)
def zero_offset(inputs, *, A):
    r"""Zero offset of the force channel: a constant added force, the same in both directions.

    It is the half-sum of forward and backward force. Strokes in one direction do not distinguish it from
    friction that is independent of speed, so that it reads the direction. An offset within the sensor's
    accuracy is not significant.
    """
    return A * np.ones_like(np.asarray(inputs["direction"], dtype=float))


@effect(
    label="zero offset of the force that changes with {x}",
    equation="h = A (x - x_ref) + B",
    reference="zero offset removed",
    reads=(CHANNEL, "direction"),
    acts_on=(("force", "add"),),
    parameters=(
        amplitude("A", "{y}/{x}", 0.01, "slope of the offset"),
        amplitude("B", "{y}", 0.0, "offset at the reference"),
    ),
    source="Form: ours. Force on a piston, F = p A, and definition of a zero offset.",
    # By hand: 0.5 * (7 - 3) - 1.5, in both directions.
    worked=({"x": 7.0, "x_ref": 3.0, "direction": -1.0}, {"A": 0.5, "B": -1.5}, 0.5),
    physical=False,
)
def offset_slope(inputs, *, A, B):
    r"""Zero offset of the force that changes with a channel, the same in both directions.

    The force on a piston is pressure times area, so that an error dA of the area adds dA p to the measured
    friction. A is then the error of the area, and B that error times the reference pressure. Another cause is
    an amplifier whose zero depends on the room temperature.
    """
    return A * deviation(inputs, CHANNEL) + B


@effect(
    label="direction asymmetry",
    equation="h = A d / 2, d = +1 forward, -1 backward",
    reference="mean of the two directions",
    reads=("direction",),
    acts_on=(
        *factors("mu", "force", "mu_c", "mu_s", "v_s"),
        ("sigma_2", "add"),
        *factors("sigma_2", "a", "b", "mu_0"),
    ),
    parameters=(amplitude("A", "{y}", 0.05, "forward minus backward"),),
    source="Form: ours. The odd part in direction of any two values, halved so that A is their difference.",
    # By hand: backward, half of the difference below the mean.
    worked=({"direction": -1.0}, {"A": 0.1}, -0.05),
)
def asymmetry(inputs, *, A):
    r"""Direction asymmetry: a parameter that differs between the two directions.

    Friction of a lip seal, a misaligned sample or a polished track depends on the direction d, +1 or -1. A is
    the forward value minus the backward one, relative to their mean, or in its unit for an added change. The
    mean of the two directions does not change.
    """
    return A * np.asarray(inputs["direction"], dtype=float) / 2


@effect(
    label="drift along the campaign",
    equation="h = A t",
    reference="start of the campaign",
    reads=("elapsed_h",),
    acts_on=IN_TIME,
    parameters=(amplitude("A", "{y}/{x}", 1e-4, "change per time of the campaign"),),
    source="Form: ours. First order in time of a slow change.",
    # By hand: 200 h at 0.05 % per hour.
    worked=({"elapsed_h": 200.0}, {"A": 5e-4}, 0.1),
)
def campaign_drift(inputs, *, A):
    r"""Drift along the campaign: a slow change over the days of testing.

    It may be due to a track that polishes, a sensor that ages, or rubber that goes on aging in the
    laboratory's air. t is the time since the campaign's first file. A is the change per time, relative for
    friction, in N for the zero. A drift along the order of runs is `linear` in `run_order`. If tests follow
    the calendar of aging it is not distinguishable from the aging law.
    """
    return A * np.asarray(inputs["elapsed_h"], dtype=float)


def _dated(hours: np.ndarray) -> bool:
    return bool(np.isfinite(hours).all())  # NaN where the start of a file is not known


@effect(
    label="change that lasts for a while",
    equation="h = A if t_1 <= t < t_2, else 0",
    reference="before {t_1} and from {t_2} on",
    reads=("elapsed_h",),
    acts_on=IN_TIME,
    parameters=(
        amplitude("A", "{y}", 0.02, "size of the change"),
        Parameter("t_1", "{x}", 0.0, (-1e6, 1e6), "when it begins", search="between"),
        Parameter("t_2", "{x}", 1.0, (-1e6, 1e6), "when it ends", search="between"),
    ),
    source="Form: ours. Two steps of equal height.",
    # By hand: at t_1 it has its full size.
    worked=({"elapsed_h": 3.0}, {"A": 0.04, "t_1": 3.0, "t_2": 5.0}, 0.04),
    shown_by=_dated,
)
def temporary_change(inputs, *, A, t_1, t_2):
    r"""Change that lasts for a while: another operator, fixture or bottle of oil in some week.

    t is the time since the campaign's first file. Only the interval between two neighbouring files is
    determined for t_1 and for t_2. A change that lasts to the end of the campaign is a `step`.
    """
    hours = np.asarray(inputs["elapsed_h"], dtype=float)
    return A * np.where(np.isnan(hours), np.nan, (hours >= t_1) & (hours < t_2))


DAY_H = 24.0
TIME_OF_DAY = "a time of day at which it is largest, since the campaign's first file"
# Days of tests, and the part of each that its tests must span, from which a daily change is looked for.
LEAST_DAYS, LEAST_PART = 2, 0.25


def _shows_days(hours: np.ndarray) -> bool:
    if not _dated(hours):
        return False
    day = np.floor((hours - hours.min()) / DAY_H).astype(int)
    spans = [np.ptp(hours[day == k]) for k in np.unique(day)]
    return sum(span >= LEAST_PART * DAY_H for span in spans) >= LEAST_DAYS


@effect(
    label="change with the time of day",
    equation="h = A cos(2 pi (t - t_max) / 24 h)",
    reference="mean over a day",
    reads=("elapsed_h",),
    acts_on=IN_TIME,
    parameters=(
        amplitude("A", "{y}", 0.02, "amplitude"),
        Parameter("t_max", "{x}", 6.0, (-DAY_H, 2 * DAY_H), TIME_OF_DAY, search=(0.0, 3.0, 6.0, 9.0)),
    ),
    source="Form: ours. The first Fourier term of anything that repeats every day.",
    # By hand: 4 h from the largest value is a sixth of a day, and cos 60 degrees = 1/2.
    worked=({"elapsed_h": 58.0}, {"A": 0.04, "t_max": 6.0}, 0.02),
    shown_by=_shows_days,
)
def day_and_night(inputs, *, A, t_max):
    r"""Change with the time of day: laboratory, drive and oil are warmer in the afternoon than at night.

    t is the time since the campaign's first file. With files in working hours only it describes the change
    within them and must not be used for the night.
    """
    hours = np.asarray(inputs["elapsed_h"], dtype=float) - t_max
    return A * np.cos(2 * np.pi * hours / DAY_H)
