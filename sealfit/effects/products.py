"""Closed forms in two channels: a product, and a slope along one that changes with the other."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

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


class Scales(NamedTuple):
    """How two channels enter a product: x through u and z through w, both zero at the channel's reference.

    The references are the channels' means over the campaign, so that a product excludes what either channel
    does alone.
    """

    suffix: str  # of the id
    label: str
    u: str  # LaTeX
    w: str
    first: Callable  # (inputs, CHANNEL) -> u, shape (n,)
    second: Callable  # (inputs, SECOND) -> w, shape (n,)
    units: tuple[str, str, str]  # of A, B and C
    meaning: str  # of A in the product alone
    variables: str  # of the Taylor series
    inputs: dict[str, float]  # of the worked values
    worked: tuple[float, float]  # A u w at A = 0.5; A u w + B u + C w at A = 0.5, B = 1, C = 2


# ln x is for a channel that spans decades, such as the speed; it is NaN where x is not positive. ln(1 + z) is
# for a channel that starts at 0 and acts ever more slowly, as days of aging do; it is NaN where z is
# negative.
SCALES = (
    Scales(
        "", "{x} and {z}", "x - x_{ref}", "z - z_{ref}", deviation, deviation,
        ("{y}/({x} {z})", "{y}/{x}", "{y}/{z}"), "slope of a slope", "two channels",
        # By hand: u = 2, w = -3; 0.5 * 2 * -3 = -3, and -3 + 2 - 6.
        {"x": 12.0, "x_ref": 10.0, "z": 1.0, "z_ref": 4.0}, (-3.0, -7.0),
    ),
    Scales(
        "_log", "log {x} and {z}", r"\ln(x / x_{ref})", "z - z_{ref}", log_ratio, deviation,
        ("{y}/{z}", "{y}", "{y}/{z}"), "slope in z of the slope in ln x", "ln x and z",
        # By hand: u = ln e = 1, w = -3; -1.5, and -1.5 + 1 - 6.
        {"x": np.e, "x_ref": 1.0, "z": 1.0, "z_ref": 4.0}, (-1.5, -6.5),
    ),
    Scales(
        "_logs", "log {x} and log of 1 + {z}", r"\ln(x / x_{ref})", r"\ln((1 + z) / (1 + z_{ref}))",
        log_ratio, log_ratio_from_zero, ("{y}", "{y}", "{y}"), "slope of a slope, in logarithms",
        "ln x and ln(1 + z)",
        # By hand: u = ln e = 1, w = ln e^2 = 2; 1, and 1 + 1 + 4.
        {"x": np.e, "x_ref": 1.0, "z": np.e**2 - 1.0, "z_ref": 0.0}, (1.0, 6.0),
    ),
)  # fmt: skip


def bilinear_shape(first: Callable, second: Callable, inputs, *, A, B=0.0, C=0.0) -> np.ndarray:
    """Return A u w + B u + C w, shape (n,): a product of two channels, and with B and C a warped plane."""
    u, w = first(inputs, CHANNEL), second(inputs, SECOND)
    return A * u * w + B * u + C * w


def _plain(latex: str) -> str:
    return latex.replace("\\", "").replace("{ref}", "ref")


def _factor(latex: str) -> str:
    return latex if latex.startswith("\\") else f"({latex})"


def _closed_form(scales: Scales, kind: str, *, alone: bool) -> Effect:
    """Return the product of two channels, with the terms of each channel alone if wanted.

    A product alone is for an effect that shows only where both channels are away from their means. Speed
    times days: aged rubber loses more friction at high speed than unaged rubber does.
    """
    s, product = scales, f"{_factor(scales.u)} {_factor(scales.w)}"
    values = {"A": 0.5, "B": 1.0, "C": 2.0}
    meanings = (
        "slope of a slope" if alone else s.meaning,
        "slope in the first channel",
        "slope in the second channel",
    )
    names = ("A", "B", "C")[: 3 if alone else 1]
    return Effect(
        id=kind + s.suffix,
        label=f"product of {s.label}" + ", and each alone" * alone,
        equation=rf"h = A u w + B u + C w, \quad u = {s.u}, \; w = {s.w}" if alone else f"h = A {product}",
        form=f"A u w + B u + C w, u = {_plain(s.u)}, w = {_plain(s.w)}" if alone else f"A {_plain(product)}",
        reference=f"{{x}} = {{x_ref}} {'and' if alone else 'or'} {{z}} = {{z_ref}}",
        reads=(CHANNEL, SECOND),
        acts_on=ANYWHERE,
        parameters=tuple(
            Parameter(name, unit, 0.01 if name == "A" else 0.0, AMPLITUDE, meaning, linear=True)
            for name, unit, meaning in zip(names, s.units, meanings, strict=False)
        ),
        shape=partial(bilinear_shape, s.first, s.second),
        source=f"Form: ours, the first {'terms' if alone else 'mixed term'} of a Taylor series "
        f"in {s.variables}.",
        worked=(s.inputs, {name: values[name] for name in names}, s.worked[alone]),
        physical=False,
    )


PRODUCT, PRODUCT_LOG, PRODUCT_LOGS = (_closed_form(s, "product", alone=False) for s in SCALES)
BILINEAR, BILINEAR_LOG, BILINEAR_LOGS = (_closed_form(s, "bilinear", alone=True) for s in SCALES)
