r"""Free shapes of one or two channels, with as many parameters as the data ask for.

They name no mechanism: levels of a category, a straight line for each category, natural cubic splines, and
products of two of these. If its mean over the campaign is given it is subtracted, as the declared model has a
constant already. `free_effect` builds them from plain values, which is the form in model files.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache, partial
from inspect import signature

import numpy as np

from sealfit.effects.contract import CHANNEL, SECOND, Effect, amplitude, closed_form, deviation
from sealfit.errors import ParameterError

LEVELS, SLOPES, SMOOTH, WITHIN, SURFACE = "levels", "slopes", "smooth", "within", "surface"
# Ratio of the largest to the smallest value of a positive channel from which its logarithm is used.
WIDE = 20.0


def _free(function: Callable, means: Sequence[float] | None, **description) -> Effect:
    """Return the effect whose shape is `function(amplitudes, inputs)`, less its mean if `means` are given.

    They are the means of what the amplitudes multiply, the first of which has none of its own.
    """
    names = tuple(p.name for p in description["parameters"])
    if means is not None:
        if len(means) != len(names) + 1:
            reason = f"{len(means)} means of {len(names) + 1} functions."
            raise ParameterError(reason, fix="Give one mean per function.")
        channels = "{x} and {z}" if "reads" in description else "{x}"
        description["equation"] += "; less its mean over the campaign"
        description["reference"] = f"mean over {channels} in the campaign"
    shape = partial(_shape, function, None if means is None else np.array(means, float)[1:], names)
    return closed_form(shape=shape, **description)


def _shape(function: Callable, means: np.ndarray | None, names: Sequence[str], inputs: Mapping, **values):
    amplitudes = np.array([values[name] for name in names])
    return function(amplitudes, inputs) - (0.0 if means is None else means @ amplitudes)


def _listed(values: Sequence[object]) -> str:
    return ", ".join(f"{v:.6g}" if isinstance(v, float) else str(v) for v in values)


def levels_effect(categories: Sequence[str], means: Sequence[float] | None = None) -> Effect:
    """Return one level per category of the channel, as differences from the first category.

    Its amplitudes are `d_1`, `d_2`, ... for the categories after the first. With `means`, the share of each
    category in the campaign, the mean of the levels is zero; else the first one is. A category that is not
    listed gives NaN. ParameterError if there are fewer than two categories, or one stands twice.
    """
    names = _different(LEVELS, categories)
    return _free(
        partial(_levels, names),
        means,
        id=LEVELS,
        label="levels of {x}",
        equation=f"h = d_k for category k of {_listed(names)}; 0 for {names[0]}",
        reference=f"{{x}} = {names[0]}",
        parameters=tuple(
            amplitude(f"d_{k}", "{y}", 0.0, f"{name} less {names[0]}")
            for k, name in enumerate(names[1:], start=1)
        ),
        source="Form: ours. One number per category, as in any analysis of variance.",
    )


def slopes_effect(categories: Sequence[str]) -> Effect:
    """Return a straight line in a channel for each category of a second one, all zero at the reference.

    Its amplitudes `e_1`, `e_2`, ... are the slopes. Categories and errors are as for `levels_effect`.
    """
    names = _different(SLOPES, categories)
    return _free(
        partial(_slopes, names),
        None,
        id=SLOPES,
        label="linear in {x}, by {z}",
        equation=f"h = e_k (x - x_ref) for category k of {_listed(names)}",
        reads=(CHANNEL, SECOND),
        parameters=tuple(
            amplitude(f"e_{k}", "{y}/{x}", 0.0, f"slope for {name}") for k, name in enumerate(names, start=1)
        ),
        source="Form: ours. One slope per category, as in any analysis of covariance.",
    )


def _different(id: str, categories: Sequence[str]) -> tuple[str, ...]:
    names = tuple(str(c) for c in categories)
    if len(names) < 2 or len(set(names)) != len(names):
        reason = f"{id}: {list(names)} must be two or more different categories."
        raise ParameterError(reason, fix="List each once.")
    return names


def _levels(names: tuple[str, ...], amplitudes: np.ndarray, inputs: Mapping) -> np.ndarray:
    return _by_category(names, [0.0, *amplitudes], inputs[CHANNEL])


def _slopes(names: tuple[str, ...], amplitudes: np.ndarray, inputs: Mapping) -> np.ndarray:
    return _by_category(names, amplitudes, inputs[SECOND]) * deviation(inputs, CHANNEL)


def _by_category(names: tuple[str, ...], values: Sequence[float], channel: np.ndarray) -> np.ndarray:
    given = np.asarray(channel).astype(str)
    found = np.full(given.shape, np.nan)
    for name, value in zip(names, values, strict=True):
        found[given == name] = value
    return found


def smooth_effect(knots: Sequence[float], means: Sequence[float] | None = None) -> Effect:
    """Return a natural cubic spline of the channel, with its values at the knots as amplitudes.

    Its amplitudes are `c_2`, `c_3`, ... for the knots after the first, at which the shape is zero. With
    `means`, the mean over the campaign of each cardinal spline, its mean is zero. ParameterError if there are
    fewer than two knots, or they do not rise.
    """
    places = _rising(SMOOTH, knots)
    first = f"{places[0]:.6g}"
    return _free(
        partial(_spline, places),
        means,
        id=SMOOTH,
        label="smooth in {x}",
        equation=f"h = natural cubic spline through (x_j, c_j), knots {_listed(places)}, zero at {first}",
        reference=f"{{x}} = {first}",
        parameters=tuple(
            amplitude(f"c_{j}", "{y}", 0.0, f"value at {place:.6g} less that at {first}")
            for j, place in enumerate(places[1:], start=2)
        ),
        source="Form: ours. de Boor 2001, A Practical Guide to Splines, Springer; natural end conditions.",
    )


def _spline(places: tuple[float, ...], amplitudes: np.ndarray, inputs: Mapping) -> np.ndarray:
    return natural(places, inputs[CHANNEL])[..., 1:] @ amplitudes


def within_effect(category: str, knots: Sequence[float]) -> Effect:
    """Return the same spline in one category of a second channel; it is zero in the others.

    Amplitudes and errors are those of `smooth_effect`.
    """
    spline = smooth_effect(knots)
    return replace(
        spline,
        id=WITHIN,
        label=f"smooth in {{x}} where {{z}} is {category}",
        equation=f"{spline.equation}, where {{z}} is {category}; 0 elsewhere",
        reads=(CHANNEL, SECOND),
        shape=partial(_within, category, spline.shape),
        source="Form: ours. Wood 2017, Generalized Additive Models, 2nd ed., CRC Press: a smooth by factor.",
    )


def _within(category: str, shape: Callable, inputs: Mapping, **values) -> np.ndarray:
    return np.where(np.asarray(inputs[SECOND]).astype(str) == category, shape(inputs, **values), 0.0)


def _rising(id: str, knots: Sequence[float]) -> tuple[float, ...]:
    places = tuple(float(k) for k in knots)
    if len(places) < 2 or not np.isfinite(places).all() or not (np.diff(places) > 0).all():
        reason = f"{id}: knots {list(places)} must be two or more rising numbers."
        raise ParameterError(reason, fix="Sort them.")
    return places


@lru_cache(maxsize=64)
def _cardinal(places: tuple[float, ...]):
    """Return the cardinal splines of these knots: natural, 1 at one knot and 0 at the others."""
    from scipy.interpolate import CubicSpline  # a slow import that listing the effects does not need

    return CubicSpline(places, np.eye(len(places)), bc_type="natural")


def natural(places: tuple[float, ...], x: np.ndarray) -> np.ndarray:
    """Return every cardinal spline at x, shape (..., knots): constant beyond the outer knots."""
    return _cardinal(places)(np.clip(np.asarray(x, float), places[0], places[-1]))


@lru_cache(maxsize=64)
def roughness(places: tuple[float, ...]) -> np.ndarray:
    r"""Return S with :math:`c^T S c = \int h''^2` of the spline through c at knots scaled to a range of 1.

    Its shape is (knots - 1, knots - 1), as the first knot has no amplitude. If the knots are positive with a
    ratio of `WIDE` or more, derivatives are with respect to their logarithm. Straight lines are not rough.
    """
    return _gram(places, 2)[1:, 1:]


@lru_cache(maxsize=64)
def surface_roughness(x_places: tuple[float, ...], z_places: tuple[float, ...]) -> np.ndarray:
    r"""Return S with :math:`c^T S c = \int h_{xx}^2 + 2 h_{xz}^2 + h_{zz}^2`, scaled as in `roughness`.

    Its shape is (amplitudes, amplitudes) of `surface_effect`; planes are not rough. It is the penalty of thin
    plate splines: Wood 2017, Generalized Additive Models, 2nd ed., CRC Press, 5.5.
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
    the mean of each product of splines over the campaign, z running faster, its mean is zero. ParameterError
    as for `smooth_effect`.
    """
    x, z = _rising(SURFACE, x_knots), _rising(SURFACE, z_knots)
    less_first = "less that at the first knots"
    return _free(
        partial(_surface, x, z),
        means,
        id=SURFACE,
        label="smooth in {x} and {z}",
        equation=f"h = natural cubic splines through (x_j, z_k, c_jk), knots {_listed(x)} and {_listed(z)}, "
        f"zero at {x[0]:.6g} and {z[0]:.6g}",
        reference=f"{{x}} = {x[0]:.6g} and {{z}} = {z[0]:.6g}",
        reads=(CHANNEL, SECOND),
        parameters=tuple(
            amplitude(f"c_{j + 1}{k + 1}", "{y}", 0.0, f"value at {x[j]:.6g} and {z[k]:.6g} {less_first}")
            for j, k in list(np.ndindex(len(x), len(z)))[1:]
        ),
        source="Form: ours. Wood 2017, Generalized Additive Models, 2nd ed., CRC Press.",
    )


def _surface(x_knots: tuple[float, ...], z_knots: tuple[float, ...], amplitudes: np.ndarray, inputs: Mapping):
    values = np.reshape([0.0, *amplitudes], (len(x_knots), len(z_knots)))
    x, z = natural(x_knots, inputs[CHANNEL]), natural(z_knots, inputs[SECOND])
    return np.einsum("...j,jk,...k->...", x, values, z)


# Every free shape. Its arguments have the names of the fixed values in model files.
FREE = {
    SMOOTH: smooth_effect, WITHIN: within_effect, LEVELS: levels_effect, SURFACE: surface_effect,
    SLOPES: slopes_effect,
}  # fmt: skip


def free_effect(id: str, fixed: Mapping[str, object]) -> Effect:
    """Return the free shape `id` with the fixed values of a model file; other entries are ignored.

    ParameterError if the id is unknown, or an entry is missing or invalid.

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
