"""Closed forms of one channel and of two, for a residual without a known mechanism."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np

from sealfit.effects.contract import (
    CHANNEL,
    PHASE,
    PHASES,
    SECOND,
    Effect,
    Parameter,
    amplitude,
    closed_form,
    deviation,
    effect,
    factors,
    log_ratio,
    log_ratio_from_zero,
    mean_sine,
    not_negative,
)


@effect(
    closed_form,
    label="linear in {x}",
    equation="h = A (x - x_ref)",
    parameters=(amplitude("A", "{y}/{x}", 0.01, "slope"),),
    source="Form: ours. First order of any smooth dependence.",
    # By hand: 0.5 * (7 - 3).
    worked=({"x": 7.0, "x_ref": 3.0}, {"A": 0.5}, 2.0),
)
def linear(inputs, *, A):
    """Straight line in any channel; along `run_order`, the drift along the campaign counted in runs."""
    return A * deviation(inputs, CHANNEL)


@effect(
    closed_form,
    label="linear in {x}, with its own slope in each direction",
    equation="h = A_f (x - x_ref) forward, A_b (x - x_ref) backward",
    reads=(CHANNEL, "direction"),
    acts_on=factors("mu", "force"),
    parameters=(
        amplitude("A_f", "{y}/{x}", 0.01, "slope forward"),
        amplitude("A_b", "{y}/{x}", 0.0, "slope backward"),
    ),
    source="Form: ours. First order of any smooth dependence, in each direction by itself.",
    # By hand: backward, 0.25 * (7 - 3).
    worked=({"x": 7.0, "x_ref": 3.0, "direction": -1.0}, {"A_f": 0.5, "A_b": 0.25}, 1.0),
)
def linear_each_way(inputs, *, A_f, A_b):
    r"""Straight line in any channel with a separate slope in each direction.

    A lip that turns over or wears on one side changes the friction in one direction only. The interval of the
    slope in the other direction then contains 0.
    """
    return np.where(np.asarray(inputs["direction"]) > 0, A_f, A_b) * deviation(inputs, CHANNEL)


@effect(
    closed_form,
    label="quadratic in {x}",
    equation="h = A (x - x_ref) + B (x - x_ref)^2",
    parameters=(
        amplitude("A", "{y}/{x}", 0.01, "slope at the reference"),
        amplitude("B", "{y}/{x}^2", 0.001, "curvature, halved"),
    ),
    source="Form: ours. Second order of any smooth dependence.",
    # By hand: 2 from the reference: 0.5 * 2 - 0.25 * 4.
    worked=({"x": 5.0, "x_ref": 3.0}, {"A": 0.5, "B": -0.25}, 0.0),
    along_calendar=False,
)
def quadratic(inputs, *, A, B):
    """Parabola in any channel, zero at its reference."""
    away = deviation(inputs, CHANNEL)
    return A * away + B * away**2


@effect(
    closed_form,
    label="logarithmic in {x}",
    equation="h = A ln(x / x_ref)",
    parameters=(amplitude("A", "{y}", 0.05, "change per factor e of the channel"),),
    source="Form: ours. The dependence that is the same in every decade.",
    # By hand: ten times the reference, ln 10 = 2.302585092994046.
    worked=({"x": 30.0, "x_ref": 3.0}, {"A": 0.5}, 0.5 * 2.302585092994046),
)
def log(inputs, *, A):
    """Logarithm of any channel; NaN where it is not positive."""
    return A * log_ratio(inputs, CHANNEL)


@effect(
    closed_form,
    label="logarithmic growth in {x}",
    equation="h = A ln(1 + x / x_0)",
    reference="{x} = 0",
    parameters=(
        amplitude("A", "{y}", 0.05, "change per factor e of the channel, well beyond x_0"),
        Parameter("x_0", "{x}", 1.0, (1e-6, 1e9), "where the logarithm sets in", search="span"),
    ),
    source="Form: ours, after Eq. 15 of Wu et al. 2020, Polymers 12(1), 102, doi:10.3390/polym12010102.",
    # By hand: x = x_0, ln 2 = 0.6931471805599453.
    worked=({"x": 3.0, "x_ref": 1.0}, {"A": 0.5, "x_0": 3.0}, 0.5 * 0.6931471805599453),
)
def log_growth(inputs, *, A, x_0):
    """Logarithm of any channel that starts at 0, as in Eq. 15; NaN where it is negative."""
    return A * np.log1p(not_negative(inputs[CHANNEL]) / x_0)


@effect(
    closed_form,
    label="power of {x}",
    equation="h = A ((x / x_ref)^n - 1)",
    parameters=(
        amplitude("A", "{y}", 0.1, "size at the reference"),
        Parameter("n", "", 0.5, (-6.0, 6.0), "exponent", search=(-3.0, -2.0, -1.0, -0.5, 0.5, 1.5, 2.0, 3.0)),
    ),
    source="Form: ours. The dependence without a scale of its own.",
    # By hand: four times the reference: 2 * (sqrt(4) - 1).
    worked=({"x": 12.0, "x_ref": 3.0}, {"A": 2.0, "n": 0.5}, 2.0),
)
def power(inputs, *, A, n):
    """Power of any channel; NaN where it is not positive. n towards 0 is the logarithm, A growing as 1/n."""
    # expm1 keeps all digits where the power is close to one.
    return A * np.expm1(n * log_ratio(inputs, CHANNEL))


@effect(
    closed_form,
    label="exponential approach in {x}",
    equation="h = A (1 - exp(-x / tau))",
    reference="{x} = 0",
    parameters=(
        amplitude("A", "{y}", 0.1, "limit"),
        Parameter("tau", "{x}", 1.0, (1e-6, 1e9), "scale of the approach", search="span"),
    ),
    source="Form: ours. Relaxation at a rate proportional to the remaining difference.",
    # By hand: x = tau, 1 - 1/e = 0.6321205588285577.
    worked=({"x": 3.0, "x_ref": 1.0}, {"A": 2.0, "tau": 3.0}, 2.0 * 0.6321205588285577),
)
def exponential_approach(inputs, *, A, tau):
    """Exponential approach to a limit, from 0; NaN where the channel is negative."""
    return -A * np.expm1(-not_negative(inputs[CHANNEL]) / tau)


@effect(
    closed_form,
    label="saturation in {x}",
    equation="h = A x / (x + x_half)",
    reference="{x} = 0",
    parameters=(
        amplitude("A", "{y}", 0.1, "limit"),
        Parameter("x_half", "{x}", 1.0, (1e-6, 1e9), "where half of the limit is reached", search="span"),
    ),
    source="Form: Langmuir 1918, J. Am. Chem. Soc. 40(9), 1361-1403, doi:10.1021/ja02242a004: "
    "places that fill up.",
    # By hand: x = 3 x_half is three quarters of 2.
    worked=({"x": 6.0, "x_ref": 1.0}, {"A": 2.0, "x_half": 2.0}, 1.5),
)
def saturation(inputs, *, A, x_half):
    """Saturation by a hyperbola, from 0: slower than an exponential. NaN where the channel is negative."""
    x = not_negative(inputs[CHANNEL])
    return A * x / (x + x_half)


@effect(
    closed_form,
    label="hyperbolic decay in {x}",
    equation="h = A / (1 + x / x_half)",
    reference="limit of large {x}",
    acts_on=(("force", "add"),),
    parameters=(
        amplitude("A", "{y}", 0.1, "size at 0"),
        Parameter("x_half", "{x}", 1.0, (1e-6, 1e9), "where it has fallen to one half", search="span"),
    ),
    source="Form: ours. Decay at a rate proportional to the square of the value.",
    # By hand: x = 3 x_half gives a quarter of 2.
    worked=({"x": 6.0, "x_ref": 1.0}, {"A": 2.0, "x_half": 2.0}, 0.5),
)
def hyperbolic(inputs, *, A, x_half):
    """Hyperbolic decay from A to 0; NaN where the channel is negative.

    It equals a constant minus `saturation`, which is used where the declared model has a free constant. An
    added force has none; this form acts only there.
    """
    return A / (1 + not_negative(inputs[CHANNEL]) / x_half)


@effect(
    closed_form,
    label="step in {x}",
    equation="h = A if x >= x_0, else 0",
    reference="{x} below {x_0}",
    parameters=(
        amplitude("A", "{y}", 0.1, "height of the step"),
        Parameter("x_0", "{x}", 0.0, (-1e12, 1e12), "where it steps", search="between"),
    ),
    source="Form: ours. Definition of a step.",
    # By hand: at the step itself, the full height.
    worked=({"x": 3.0, "x_ref": 1.0}, {"A": -0.5, "x_0": 3.0}, -0.5),
)
def step(inputs, *, A, x_0):
    """Step in any channel: something was changed, repaired or knocked.

    Only the interval between two neighbouring values of the channel is determined for x_0.
    """
    x = np.asarray(inputs[CHANNEL], dtype=float)
    return A * np.where(np.isnan(x), np.nan, x >= x_0)


@effect(
    closed_form,
    label="local bump in {x}",
    equation="h = A exp(-((x - x_0) / w)^2)",
    reference="away from {x} = {x_0}",
    parameters=(
        amplitude("A", "{y}", 0.1, "height"),
        Parameter("x_0", "{x}", 0.0, (-1e12, 1e12), "middle", search="inside"),
        Parameter("w", "{x}", 1.0, (1e-6, 1e12), "half-width at 1/e", search="span"),
    ),
    source="Form: ours. A Gaussian bell, smooth and local.",
    # By hand: one half-width from the middle, 1/e = 0.36787944117144233.
    worked=({"x": 1.0, "x_ref": 0.0}, {"A": 2.0, "x_0": 3.0, "w": 2.0}, 2.0 * 0.36787944117144233),
    narrow=True,
    along_calendar=False,
)
def bump(inputs, *, A, x_0, w):
    r"""Local bump in any channel: a worn place, a joint in the track, an hour when the door stood open."""
    return A * np.exp(-(((np.asarray(inputs[CHANNEL], dtype=float) - x_0) / w) ** 2))


@effect(
    closed_form,
    label="periodic in {x}",
    equation="h = A sin(2 pi (x - x_ref) / lambda + phi)",
    reference="mean over a wavelength",
    acts_on=(("force", "add"), ("mu", "multiply"), ("force", "multiply")),
    parameters=(
        amplitude("A", "{y}", 0.1, "amplitude"),
        Parameter("lambda_", "{x}", 1.0, (1e-6, 1e9), "period", search="span"),
        Parameter("phi", "rad", 0.0, PHASE, "phase at 0, or x_ref", search=PHASES),
    ),
    source="Form: ours. The first Fourier term of anything periodic.",
    # By hand: 0.02 of a period of 0.04 is half a turn, and sin(pi + pi/6) = -sin(pi/6) = -1/2.
    worked=({"x": 0.02}, {"A": 4.0, "lambda_": 0.04, "phi": np.pi / 6}, -2.0),
    periodic=True,
)
def sinusoid(inputs, *, A, lambda_, phi):
    r"""Sine of any channel; along time it may be due to the mains, a servo or a pump.

    Along the position it is the physical effect `ripple`. x_ref is 0, or near values that are far from 0.
    """
    angle = 2 * np.pi * deviation(inputs, CHANNEL) / lambda_ + phi
    return A * mean_sine(inputs, CHANNEL, angle, lambda_)


@effect(
    closed_form,
    label="periodic in {x}, with an amplitude that changes with {z}",
    equation="h = (A + B (z - z_ref)) sin(2 pi (x - x_ref) / lambda + phi)",
    reference="mean over a wavelength",
    reads=(CHANNEL, SECOND),
    acts_on=sinusoid.effect.acts_on,
    parameters=(
        amplitude("A", "{y}", 0.1, "amplitude at z = z_ref"),
        amplitude("B", "{y}/{z}", 0.0, "its change with z"),
        *sinusoid.effect.parameters[1:],
    ),
    source="Form: ours. The first Fourier term, with the first order of a change of its amplitude.",
    # By hand: -1/2 as above, times 4 + 3 * (5 - 3).
    worked=(
        {"x": 0.02, "z": 5.0, "z_ref": 3.0},
        {"A": 4.0, "B": 3.0, "lambda_": 0.04, "phi": np.pi / 6},
        -5.0,
    ),
    periodic=True,
)
def sinusoid_changing(inputs, *, A, B, lambda_, phi):
    r"""Sine of any channel whose amplitude is a straight line in a second one.

    A screw that runs smoothly one way, a joint that is passed at speed, a guide that bends under load.
    """
    return (A + B * deviation(inputs, SECOND)) * sinusoid(inputs, A=1.0, lambda_=lambda_, phi=phi)


@effect(
    closed_form,
    label="periodic in {x}, with a second harmonic",
    equation="h = A sin(2 pi x / lambda + phi) + B sin(4 pi x / lambda + phi_2)",
    reference="mean over a wavelength",
    acts_on=sinusoid.effect.acts_on,
    parameters=(
        amplitude("A", "{y}", 0.1, "amplitude once per period"),
        amplitude("B", "{y}", 0.05, "amplitude twice per period"),
        Parameter("lambda_", "{x}", 1.0, (1e-6, 1e9), "period", search="span"),
        Parameter("phi", "rad", 0.0, PHASE, "phase at 0", search=PHASES),
        Parameter("phi_2", "rad", 0.0, PHASE, "phase of the harmonic at 0", search=PHASES),
    ),
    source="Form: ours. The first two Fourier terms of anything periodic.",
    # By hand: half a turn, 4 sin(pi + pi/6) = -2, and a whole one, 1.5 sin(2 pi + pi/2) = 1.5.
    worked=({"x": 0.02}, {"A": 4.0, "B": 1.5, "lambda_": 0.04, "phi": np.pi / 6, "phi_2": np.pi / 2}, -0.5),
    periodic=True,
)
def sinusoid_harmonics(inputs, *, A, B, lambda_, phi, phi_2):
    r"""Sine of any channel with its second harmonic, as of a bent and misaligned shaft.

    The loop does not try it, as it finds harmonics one at a time, each a ripple or sine with its own period.
    It is for simulated campaigns.
    """
    angle = 2 * np.pi * np.asarray(inputs[CHANNEL], dtype=float) / lambda_
    once = mean_sine(inputs, CHANNEL, angle + phi, lambda_)
    return A * once + B * mean_sine(inputs, CHANNEL, 2 * angle + phi_2, lambda_ / 2)


# ---------------------------------------------------------------- two channels
# A product of two channels, and the product with what each does alone: a slope along one channel that changes
# with the other. ln x is for a channel that spans decades, such as the speed; it is NaN where x is not
# positive. ln(1 + z) is for a channel that starts at 0 and acts ever more slowly, as days of aging do; it is
# NaN where z is negative. The references are the channels' means over the campaign, so that a product
# excludes what either channel does alone.


def bilinear_shape(first: Callable, second: Callable, inputs, *, A, B=0.0, C=0.0) -> np.ndarray:
    """Return A u w + B u + C w, shape (n,): u and w are functions of the inputs and x, and of these and z."""
    u, w = first(inputs, CHANNEL), second(inputs, SECOND)
    return A * u * w + B * u + C * w


product = partial(closed_form, reads=(CHANNEL, SECOND), reference="{x} = {x_ref} or {z} = {z_ref}")

# By hand: u = 2, w = -3; 0.5 * 2 * -3 = -3, and -3 + 2 - 6 = -7 with each alone.
PRODUCT = product(
    id="product",
    label="product of {x} and {z}",
    equation="h = A (x - x_ref) (z - z_ref)",
    parameters=(amplitude("A", "{y}/({x} {z})", 0.01, "slope of a slope"),),
    shape=partial(bilinear_shape, deviation, deviation),
    source="Form: ours, the first mixed term of a Taylor series in two channels.",
    worked=({"x": 12.0, "x_ref": 10.0, "z": 1.0, "z_ref": 4.0}, {"A": 0.5}, -3.0),
)
# By hand: u = ln e = 1, w = -3; -1.5, and -1.5 + 1 - 6 = -6.5.
PRODUCT_LOG = product(
    id="product_log",
    label="product of log {x} and {z}",
    equation="h = A ln(x / x_ref) (z - z_ref)",
    parameters=(amplitude("A", "{y}/{z}", 0.01, "slope in z of the slope in ln x"),),
    shape=partial(bilinear_shape, log_ratio, deviation),
    source="Form: ours, the first mixed term of a Taylor series in ln x and z.",
    worked=({"x": np.e, "x_ref": 1.0, "z": 1.0, "z_ref": 4.0}, {"A": 0.5}, -1.5),
)
# By hand: u = ln e = 1, w = ln e^2 = 2; 1, and 1 + 1 + 4 = 6.
PRODUCT_LOGS = product(
    id="product_logs",
    label="product of log {x} and log of 1 + {z}",
    equation="h = A ln(x / x_ref) ln((1 + z) / (1 + z_ref))",
    parameters=(amplitude("A", "{y}", 0.01, "slope of a slope, in logarithms"),),
    shape=partial(bilinear_shape, log_ratio, log_ratio_from_zero),
    source="Form: ours, the first mixed term of a Taylor series in ln x and ln(1 + z).",
    worked=({"x": np.e, "x_ref": 1.0, "z": np.e**2 - 1.0, "z_ref": 0.0}, {"A": 0.5}, 1.0),
)


def _with_each_alone(product: Effect, u: str, w: str, units: tuple[str, str], value: float) -> Effect:
    """Return a product and what each channel does alone, with u and w as text and the units of their slopes.

    `value` is the result by hand.
    """
    slopes = (amplitude("B", units[0], 0.0, "slope in the first channel"),)
    slopes += (amplitude("C", units[1], 0.0, "slope in the second channel"),)
    return replace(
        product,
        id=product.id.replace("product", "bilinear"),
        label=f"{product.label}, and each alone",
        equation=f"h = A u w + B u + C w, u = {u}, w = {w}",
        reference="{x} = {x_ref} and {z} = {z_ref}",
        parameters=(replace(product.parameters[0], meaning="slope of a slope"), *slopes),
        source=product.source.replace("mixed term", "terms"),
        worked=(product.worked[0], {"A": 0.5, "B": 1.0, "C": 2.0}, value),
    )


BILINEAR = _with_each_alone(PRODUCT, "x - x_ref", "z - z_ref", ("{y}/{x}", "{y}/{z}"), -7.0)
BILINEAR_LOG = _with_each_alone(PRODUCT_LOG, "ln(x / x_ref)", "z - z_ref", ("{y}", "{y}/{z}"), -6.5)
LOG_OF_Z = "ln((1 + z) / (1 + z_ref))"
BILINEAR_LOGS = _with_each_alone(PRODUCT_LOGS, "ln(x / x_ref)", LOG_OF_Z, ("{y}", "{y}"), 6.0)
