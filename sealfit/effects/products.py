"""Closed forms in two channels: a product, and a slope along one that changes with the other."""

from __future__ import annotations

from functools import partial

import numpy as np

from sealfit.effects.contract import (
    AMPLITUDE,
    ANYWHERE,
    CHANNEL,
    SECOND,
    Effect,
    Parameter,
    deviation,
    log_ratio,
    log_ratio_from_zero,
)

# A closed form is of any two channels, acts anywhere and names no mechanism.
closed_form = partial(Effect, reads=(CHANNEL, SECOND), acts_on=ANYWHERE, physical=False)


def product_shape(inputs, *, A):
    r"""Product of two channels, for an effect that shows only where both are away from their means.

    x_ref and z_ref are the channels' means over the campaign, so that what either does alone is none of it. Speed times
    days: the aged rubber loses more of its friction at high speed than the fresh one does.
    """
    return A * deviation(inputs, CHANNEL) * deviation(inputs, SECOND)


PRODUCT = closed_form(
    id="product",
    label="product of {x} and {z}",
    equation=r"h = A (x - x_{ref}) (z - z_{ref})",
    form="A (x - x_ref) (z - z_ref)",
    reference="{x} = {x_ref} or {z} = {z_ref}",
    parameters=(Parameter("A", "{y}/({x} {z})", 0.01, AMPLITUDE, "slope of a slope", linear=True),),
    shape=product_shape,
    source="Form: ours, the first mixed term of a Taylor series in two channels.",
    # By hand: 2 above one mean and 3 below the other.
    worked=({"x": 12.0, "x_ref": 10.0, "z": 1.0, "z_ref": 4.0}, {"A": 0.5}, -3.0),
)


def product_log_shape(inputs, *, A):
    r"""Product of the logarithm of one channel and another, both counted from their means.

    As `product`, for a channel x that spans decades, such as the speed. NaN where x is not positive.
    """
    return A * log_ratio(inputs, CHANNEL) * deviation(inputs, SECOND)


PRODUCT_LOG = closed_form(
    id="product_log",
    label="product of log {x} and {z}",
    equation=r"h = A \ln(x / x_{ref}) (z - z_{ref})",
    form="A ln(x / x_ref) (z - z_ref)",
    reference="{x} = {x_ref} or {z} = {z_ref}",
    parameters=(Parameter("A", "{y}/{z}", 0.01, AMPLITUDE, "slope in z of the slope in ln x", linear=True),),
    shape=product_log_shape,
    source="Form: ours, the first mixed term of a Taylor series in ln x and z.",
    # By hand: ln 1 = 0 at the reference; ln e = 1 away from it.
    worked=({"x": np.e, "x_ref": 1.0, "z": 1.0, "z_ref": 4.0}, {"A": 0.5}, -1.5),
)


def product_logs_shape(inputs, *, A):
    r"""Product of the logarithms of two channels, the second counted from one unit below zero, as days of aging are.

    As `product_log`, where z starts at zero and acts ever more slowly. NaN where x is not positive or z negative.
    """
    return A * log_ratio(inputs, CHANNEL) * log_ratio_from_zero(inputs, SECOND)


PRODUCT_LOGS = closed_form(
    id="product_logs",
    label="product of log {x} and log of 1 + {z}",
    equation=r"h = A \ln(x / x_{ref}) \ln((1 + z) / (1 + z_{ref}))",
    form="A ln(x / x_ref) ln((1 + z) / (1 + z_ref))",
    reference="{x} = {x_ref} or {z} = {z_ref}",
    parameters=(Parameter("A", "{y}", 0.01, AMPLITUDE, "slope of a slope, in logarithms", linear=True),),
    shape=product_logs_shape,
    source="Form: ours, the first mixed term of a Taylor series in ln x and ln(1 + z).",
    # By hand: one factor e above the first reference, two above the second.
    worked=({"x": np.e, "x_ref": 1.0, "z": np.e**2 - 1.0, "z_ref": 0.0}, {"A": 0.5}, 1.0),
)


def bilinear_shape(inputs, *, A, B, C):
    r"""Two channels with their product: a plane that is warped.

    What either channel does alone depends on where the other is, so a product rarely comes without it.
    """
    u = deviation(inputs, CHANNEL)
    w = deviation(inputs, SECOND)
    return A * u * w + B * u + C * w


BILINEAR = closed_form(
    id="bilinear",
    label="product of {x} and {z}, and each alone",
    equation=r"h = A u w + B u + C w, \quad u = x - x_{ref}, \; w = z - z_{ref}",
    form="A u w + B u + C w, u = x - x_ref, w = z - z_ref",
    reference="{x} = {x_ref} and {z} = {z_ref}",
    parameters=(
        Parameter("A", "{y}/({x} {z})", 0.01, AMPLITUDE, "slope of a slope", linear=True),
        Parameter("B", "{y}/{x}", 0.0, AMPLITUDE, "slope in the first channel", linear=True),
        Parameter("C", "{y}/{z}", 0.0, AMPLITUDE, "slope in the second channel", linear=True),
    ),
    shape=bilinear_shape,
    source="Form: ours, the first terms of a Taylor series in two channels.",
    # By hand: 2 above one mean and 3 below the other: -3 + 2 - 6.
    worked=({"x": 12.0, "x_ref": 10.0, "z": 1.0, "z_ref": 4.0}, {"A": 0.5, "B": 1.0, "C": 2.0}, -7.0),
)


def bilinear_log_shape(inputs, *, A, B, C):
    r"""The logarithm of a channel and another channel with their product.

    As `bilinear`, for a channel x that spans decades. NaN where x is not positive.
    """
    u = log_ratio(inputs, CHANNEL)
    w = deviation(inputs, SECOND)
    return A * u * w + B * u + C * w


BILINEAR_LOG = closed_form(
    id="bilinear_log",
    label="product of log {x} and {z}, and each alone",
    equation=r"h = A u w + B u + C w, \quad u = \ln(x / x_{ref}), \; w = z - z_{ref}",
    form="A u w + B u + C w, u = ln(x / x_ref), w = z - z_ref",
    reference="{x} = {x_ref} and {z} = {z_ref}",
    parameters=(
        Parameter("A", "{y}/{z}", 0.01, AMPLITUDE, "slope of a slope", linear=True),
        Parameter("B", "{y}", 0.0, AMPLITUDE, "slope in the first channel", linear=True),
        Parameter("C", "{y}/{z}", 0.0, AMPLITUDE, "slope in the second channel", linear=True),
    ),
    shape=bilinear_log_shape,
    source="Form: ours, the first terms of a Taylor series in ln x and z.",
    # By hand: 1 and -3: -1.5 + 1 - 6.
    worked=({"x": np.e, "x_ref": 1.0, "z": 1.0, "z_ref": 4.0}, {"A": 0.5, "B": 1.0, "C": 2.0}, -6.5),
)


def bilinear_logs_shape(inputs, *, A, B, C):
    r"""The logarithms of two channels with their product, the second counted from one unit below zero.

    As `bilinear`, for a channel x that spans decades and one that starts at zero and acts ever more slowly, as days of
    aging do. NaN where x is not positive or z negative.
    """
    u = log_ratio(inputs, CHANNEL)
    w = log_ratio_from_zero(inputs, SECOND)
    return A * u * w + B * u + C * w


BILINEAR_LOGS = closed_form(
    id="bilinear_logs",
    label="product of log {x} and log of 1 + {z}, and each alone",
    equation=r"h = A u w + B u + C w, \quad u = \ln(x / x_{ref}), \; w = \ln((1 + z) / (1 + z_{ref}))",
    form="A u w + B u + C w, u = ln(x / x_ref), w = ln((1 + z) / (1 + z_ref))",
    reference="{x} = {x_ref} and {z} = {z_ref}",
    parameters=(
        Parameter("A", "{y}", 0.01, AMPLITUDE, "slope of a slope", linear=True),
        Parameter("B", "{y}", 0.0, AMPLITUDE, "slope in the first channel", linear=True),
        Parameter("C", "{y}", 0.0, AMPLITUDE, "slope in the second channel", linear=True),
    ),
    shape=bilinear_logs_shape,
    source="Form: ours, the first terms of a Taylor series in ln x and ln(1 + z).",
    # By hand: 1 and 2: 1 + 1 + 4.
    worked=({"x": np.e, "x_ref": 1.0, "z": np.e**2 - 1.0, "z_ref": 0.0}, {"A": 0.5, "B": 1.0, "C": 2.0}, 6.0),
)
