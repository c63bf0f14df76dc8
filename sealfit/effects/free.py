"""Free shapes of one or two channels, sized by the data: splines, levels of a category, means over a bin."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import lru_cache, partial
from inspect import signature

import numpy as np

from sealfit.effects.contract import CHANNEL, SECOND, Effect, amplitude, closed_form, deviation
from sealfit.errors import ParameterError

# ---------------------------------------------------------------- categories
# Free shapes of a categorical channel: one level per category, or one straight line in another channel per
# category.
#
# .. math:: h = \sum_k d_k [x = k], \qquad h = \sum_k e_k [z = k] (x - x_{ref})
#
# They name no mechanism. If the mean of levels over the campaign is given it is subtracted, as the declared
# model has a constant already.

LEVELS, SLOPES = "levels", "slopes"
LESS_MEAN = "; less its mean over the campaign"


def levels_effect(categories: Sequence[str], means: Sequence[float] | None = None) -> Effect:
    """Return one level per category of the channel, as differences from the first category.

    Its amplitudes are `d_1`, `d_2`, ... for the categories after the first. With `means`, the share of each
    category in the campaign, the mean of the levels is zero; else the first one is. A category that is not
    listed gives NaN.

    ParameterError if there are fewer than two categories, or one stands twice.
    """
    names = _different(LEVELS, categories)
    levels = closed_form(
        id=LEVELS,
        label="levels of {x}",
        equation=f"h = d_k for category k of {listed(names)}; 0 for {names[0]}",
        reference=f"{{x}} = {names[0]}",
        parameters=tuple(
            amplitude(f"d_{k}", "{y}", 0.0, f"{name} less {names[0]}")
            for k, name in enumerate(names[1:], start=1)
        ),
        shape=partial(_levels, names, shares(means, len(names))),
        source="Form: ours. One number per category, as in any analysis of variance.",
    )
    return _centred(levels, means)


def _centred(shape: Effect, means: Sequence[float] | None, channels: str = "{x}") -> Effect:
    """Return the description of a shape from which its mean is subtracted, if `means` are given."""
    if means is None:
        return shape
    reference = f"mean over {channels} in the campaign"
    return replace(shape, equation=shape.equation + LESS_MEAN, reference=reference)


def _different(id: str, categories: Sequence[str]) -> tuple[str, ...]:
    names = tuple(str(c) for c in categories)
    if len(names) < 2 or len(set(names)) != len(names):
        reason = f"{id}: {list(names)} must be two or more different categories."
        raise ParameterError(reason, fix="List each once.")
    return names


def _levels(names: tuple[str, ...], means: tuple[float, ...], inputs: Mapping, **values) -> np.ndarray:
    given = np.asarray(inputs[CHANNEL]).astype(str)
    level = [0.0, *(values[f"d_{k}"] for k in range(1, len(names)))]
    mean = sum(d * m for d, m in zip(level, means, strict=True))
    result = np.full(given.shape, np.nan)
    for name, d in zip(names, level, strict=True):
        result[given == name] = d - mean
    return result


def slopes_effect(categories: Sequence[str]) -> Effect:
    """Return a straight line in a channel for each category of a second one, all zero at the reference.

    Its amplitudes `e_1`, `e_2`, ... are the slopes. A category that is not listed gives NaN.

    ParameterError if there are fewer than two categories, or one stands twice.
    """
    names = _different(SLOPES, categories)
    return closed_form(
        id=SLOPES,
        label="linear in {x}, by {z}",
        equation=f"h = e_k (x - x_ref) for category k of {listed(names)}",
        reads=(CHANNEL, SECOND),
        parameters=tuple(
            amplitude(f"e_{k}", "{y}/{x}", 0.0, f"slope for {name}") for k, name in enumerate(names, start=1)
        ),
        shape=partial(_slopes, names),
        source="Form: ours. One slope per category, as in any analysis of covariance.",
    )


def _slopes(names: tuple[str, ...], inputs: Mapping, **values) -> np.ndarray:
    given = np.asarray(inputs[SECOND]).astype(str)
    slope = np.full(given.shape, np.nan)
    for k, name in enumerate(names, start=1):
        slope[given == name] = values[f"e_{k}"]
    return slope * deviation(inputs, CHANNEL)


def shares(means: Sequence[float] | None, count: int) -> tuple[float, ...]:
    """Return the means to subtract from the functions of a shape: `means` over the campaign, or zeros."""
    if means is not None and len(means) != count:
        raise ParameterError(f"{len(means)} means of {count} functions.", fix="Give one mean per function.")
    return (0.0,) * count if means is None else tuple(float(m) for m in means)


def listed(values: Sequence[object]) -> str:
    """Return values as a comma-separated list."""
    return ", ".join(f"{v:.6g}" if isinstance(v, float) else str(v) for v in values)


# ---------------------------------------------------------------- free
# Free shapes, with a number of parameters that depends on the data: a smooth curve of a channel, a surface of
# two.
#
# They name no mechanism. `free_effect` builds them from plain values, which is the form in model files.
#
# .. math:: h = \sum_j c_j B_j(x)
#
# B_j are the natural cubic splines that are 1 at knot j and 0 at the others; the first knot has none.
# Beyond the outer knots the shape is constant, as nothing was measured there. If its mean over the campaign
# is given it is subtracted, as the declared model has a constant already.

SMOOTH, SURFACE = "smooth", "surface"
# A positive channel with at least this ratio of its largest to its smallest value is transformed by the
# logarithm.
WIDE = 20.0


def smooth_effect(knots: Sequence[float], means: Sequence[float] | None = None) -> Effect:
    """Return a natural cubic spline of the channel, with its values at the knots as amplitudes.

    Its amplitudes are `c_2`, `c_3`, ... for the knots after the first, at which the shape is zero. With
    `means`, the mean of each B_j over the campaign, its mean is zero.

    ParameterError if there are fewer than two knots, or they do not rise.
    """
    places = _rising(SMOOTH, knots)
    first = f"{places[0]:.6g}"
    spline = closed_form(
        id=SMOOTH,
        label="smooth in {x}",
        equation=f"h = natural cubic spline through (x_j, c_j), knots {listed(places)}, zero at {first}",
        reference=f"{{x}} = {first}",
        parameters=tuple(
            amplitude(f"c_{j}", "{y}", 0.0, f"value at {place:.6g} less that at {first}")
            for j, place in enumerate(places[1:], start=2)
        ),
        shape=partial(_spline, places, shares(means, len(places))),
        source="Form: ours. de Boor 2001, A Practical Guide to Splines, Springer; natural end conditions.",
    )
    return _centred(spline, means)


def _rising(id: str, knots: Sequence[float]) -> tuple[float, ...]:
    places = tuple(float(k) for k in knots)
    if len(places) < 2 or not np.isfinite(places).all() or not (np.diff(places) > 0).all():
        reason = f"{id}: knots {list(places)} must be two or more rising numbers."
        raise ParameterError(reason, fix="Sort them.")
    return places


def _spline(places: tuple[float, ...], means: tuple[float, ...], inputs: Mapping, **values) -> np.ndarray:
    basis = natural(places, np.asarray(inputs[CHANNEL], dtype=float)) - means
    amplitude = np.array([0.0, *(values[f"c_{j}"] for j in range(2, len(places) + 1))])
    return basis @ amplitude


@lru_cache(maxsize=64)
def _cardinal(places: tuple[float, ...]):
    """Return the cardinal splines of these knots."""
    from scipy.interpolate import CubicSpline  # a slow import that listing the effects does not need

    return CubicSpline(places, np.eye(len(places)), bc_type="natural")


def natural(places: tuple[float, ...], x: np.ndarray) -> np.ndarray:
    """Return every cardinal spline B_j at x, shape (..., knots): constant beyond the outer knots."""
    return _cardinal(places)(np.clip(x, places[0], places[-1]))


@lru_cache(maxsize=64)
def roughness(places: tuple[float, ...]) -> np.ndarray:
    r"""Return S with :math:`c^T S c = \int h''^2` of the spline through c at knots scaled to a range of 1.

    Its shape is (knots - 1, knots - 1), as the first knot has no amplitude. If the knots are positive with a
    ratio of `WIDE` or more, derivatives are with respect to their logarithm. The null space of S are straight
    lines in the channel, or in its logarithm.
    """
    return _gram(places, 2)[1:, 1:]


@lru_cache(maxsize=64)
def surface_roughness(x_places: tuple[float, ...], z_places: tuple[float, ...]) -> np.ndarray:
    r"""Return S with :math:`c^T S c = \int h_{xx}^2 + 2 h_{xz}^2 + h_{zz}^2`, scaled as in `roughness`.

    Its shape is (amplitudes, amplitudes) of `surface_effect`, and its null space are planes. It is the
    penalty of thin plate splines: Wood 2017, Generalized Additive Models, 2nd ed., CRC Press, 5.5.
    """
    x, z = ([_gram(places, order) for order in range(3)] for places in (x_places, z_places))
    whole = np.kron(x[2], z[0]) + 2 * np.kron(x[1], z[1]) + np.kron(x[0], z[2])
    return whole[1:, 1:]


def _gram(places: tuple[float, ...], order: int) -> np.ndarray:
    """Return the integrals of products of derivatives of the cardinal splines, shape (knots, knots)."""
    x = np.log(places) if places[0] > 0 and places[-1] / places[0] >= WIDE else np.array(places)
    x = (x - x[0]) / (x[-1] - x[0])
    node, weight = np.polynomial.legendre.leggauss(4)  # exact for products of cubics
    half = np.diff(x)[:, None] / 2
    at = _cardinal(tuple(x.tolist()))((x[:-1, None] + half * (1 + node)).ravel(), order)
    return at.T @ ((half * weight).ravel()[:, None] * at)


def surface_effect(
    x_knots: Sequence[float], z_knots: Sequence[float], means: Sequence[float] | None = None
) -> Effect:
    """Return a free surface of two channels: natural cubic splines of one times those of the other.

    Its amplitudes `c_jk` are the values at knot j of x and k of z less that at the first ones. With `means`,
    the mean of each product of splines over the campaign, z running faster, its mean is zero.

    ParameterError if there are fewer than two knots, or they do not rise.
    """
    x, z = _rising(SURFACE, x_knots), _rising(SURFACE, z_knots)
    places = list(np.ndindex(len(x), len(z)))
    less_first = "less that at the first knots"
    surface = closed_form(
        id=SURFACE,
        label="smooth in {x} and {z}",
        equation=f"h = natural cubic splines through (x_j, z_k, c_jk), knots {listed(x)} and {listed(z)}, "
        f"zero at {x[0]:.6g} and {z[0]:.6g}",
        reference=f"{{x}} = {x[0]:.6g} and {{z}} = {z[0]:.6g}",
        reads=(CHANNEL, SECOND),
        parameters=tuple(
            amplitude(f"c_{j + 1}{k + 1}", "{y}", 0.0, f"value at {x[j]:.6g} and {z[k]:.6g} {less_first}")
            for j, k in places[1:]
        ),
        shape=partial(_surface, (x, z), shares(means, len(places))),
        source="Form: ours. Wood 2017, Generalized Additive Models, 2nd ed., CRC Press.",
    )
    return _centred(surface, means, "{x} and {z}")


def _surface(
    knots: tuple[tuple[float, ...], ...], means: tuple[float, ...], inputs: Mapping, **values
) -> np.ndarray:
    u, w = (
        natural(given, np.asarray(inputs[name], dtype=float))
        for name, given in zip((CHANNEL, SECOND), knots, strict=True)
    )
    amplitude = np.array(
        [[values.get(f"c_{j + 1}{k + 1}", 0.0) for k in range(len(knots[1]))] for j in range(len(knots[0]))]
    )
    return np.einsum("...j,jk,...k->...", u, amplitude, w) - amplitude.ravel() @ means


# Every free shape. Its arguments have the names of the fixed values in model files.
FREE = {SMOOTH: smooth_effect, LEVELS: levels_effect, SURFACE: surface_effect, SLOPES: slopes_effect}


def free_effect(id: str, fixed: Mapping[str, object]) -> Effect:
    """Return the free shape `id` with the fixed values of a model file; other entries are ignored.

    Raises
    ------
    ParameterError
        If the id is unknown, or an entry is missing or invalid.

    Examples
    --------
    >>> effect = free_effect("smooth", {"knots": [0.0, 1.0, 2.0]})
    >>> effect.linear, [float(h) for h in effect.shape({"x": [0.0, 2.0, 3.0]}, c_2=1.0, c_3=2.0)]
    (('c_2', 'c_3'), [0.0, 2.0, 2.0])
    """
    if id not in FREE:
        raise ParameterError(f"'{id}' is no free shape.", fix=f"Use one of {', '.join(FREE)}.")
    arguments = signature(FREE[id]).parameters
    for name, argument in arguments.items():
        if argument.default is argument.empty and name not in fixed:
            raise ParameterError(f"{id}: '{name}' is missing.", fix=f"Give '{name}' in its fixed values.")
    return FREE[id](**{name: fixed[name] for name in arguments if name in fixed})
