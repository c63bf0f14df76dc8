r"""Priors of fitted numbers: weak ones of v_s, b and mu_s - mu_c, and the roughness penalty of free shapes.

log v_s and log b have a Gaussian prior with standard deviation 3, a factor of 20, centred at the value of the
global search. mu_s - mu_c has one centred at 0, with a standard deviation of half of the friction. Both
determine a parameter that the data do not.

A free shape is a smoothing spline with many knots. Its amplitudes c have the prior precision :math:`\lambda
S`, where :math:`c^T S c` is the integral of the squared second derivative, so that a straight line, or a
plane for a surface of two channels, is not penalised. :math:`\lambda` maximises the restricted
likelihood,

.. math::
    -2 \log L(\lambda) = - g^T (G + \lambda S)^{-1} g + \log |G + \lambda S| - \mathrm{rank}(S) \log \lambda,

with G and g the normal matrix and gradient of the amplitudes after elimination of all other parameters.
Intervals are those of the posterior. Wood 2011, J. R. Stat. Soc. B 73(1), 3-36,
doi:10.1111/j.1467-9868.2010.00749.x; Nychka 1988, J. Am. Stat. Assoc. 83(404), 1134-1143,
doi:10.1080/01621459.1988.10478711.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sealfit.effects.free import roughness, surface_roughness
from sealfit.fit.joint.model import LOGARITHMIC, Model, Term

# Standard deviation of the prior of log v_s and log b.
PRIOR_SD = 3.0
# Decimal logarithms of the smoothness tried, relative to the one whose penalty weighs as much as the data.
DECADES = np.linspace(-8.0, 6.0, 57)
# Ridge of the normal matrix, as a share of its diagonal and of the mean of that. It is singular if the
# declared model contains the straight line, or no row lies near a knot of a surface.
RIDGE = 1e-10
# Ridge of a shape of the speed in one category, as a share of the mean penalty: the Stribeck curve of this
# category explains what it can, and the shape the rest.
RIDGE_OF_CATEGORY = 0.1
# Largest eigenvalue, as a share of the largest of all, of a direction in which a free shape is not rough.
ROUNDING = 1e-10


def roughness_of(term: Term) -> np.ndarray:
    """Return the penalty matrix S of a smooth shape or surface, shape (amplitudes, amplitudes)."""
    if "x_knots" in term.fixed:
        return surface_roughness(tuple(term.fixed["x_knots"]), tuple(term.fixed["z_knots"]))
    rough = roughness(tuple(term.fixed["knots"]))
    if "category" in term.fixed:
        rough = rough + RIDGE_OF_CATEGORY * np.trace(rough) / len(rough) * np.eye(len(rough))
    return rough


def precision_of(model: Model) -> np.ndarray:
    """Return the prior's precision of the fitted numbers, shape (model.size, model.size)."""
    own = [1.0 / PRIOR_SD**2 if p.quantity in LOGARITHMIC else 0.0 for p in model.declared.parameters]
    precision = np.zeros((model.size, model.size))
    precision[range(len(own)), range(len(own))] = own
    for pair, sd in model.declared.drops.items():
        precision[np.ix_(pair, pair)] += np.array([[1.0, -1.0], [-1.0, 1.0]]) / sd**2
    for number, term in enumerate(model.terms):
        if term.smoothness is not None:
            place = model.term_slice(number)
            precision[place, place] = term.smoothness * roughness_of(term)
    return precision


def centre_of(model: Model) -> np.ndarray:
    """Return the prior's mean, shape (model.size,): 0 for amplitudes of free shapes, mu_s and mu_c.

    Of mu_s and mu_c only the difference has a prior. Elsewhere it is the present value.
    """
    centre = model.vector()
    centre[[number for pair in model.declared.drops for number in pair]] = 0.0
    for number, term in enumerate(model.terms):
        if term.smoothness is not None:
            centre[model.term_slice(number)] = 0.0
    return centre


def covariance_of(normal: np.ndarray, precision: np.ndarray) -> np.ndarray:
    """Return the covariance of parameters from normal matrix and prior precision, shape (p, p) each."""
    normal = normal + precision
    size = np.sqrt(np.diag(normal))
    scale = np.divide(1.0, size, out=np.zeros_like(size), where=size > 0)  # 0 for a parameter without effect
    scale = np.outer(scale, scale)
    return np.linalg.pinv(normal * scale, rcond=1e-12, hermitian=True) * scale


def reml_smoothness(normal: np.ndarray, gradient: np.ndarray, rough: np.ndarray) -> float:
    """Return the smoothness lambda that maximises the restricted likelihood, from G and g at zero amplitudes.

    The null space of S, `rough`, shape (p, p), are straight lines of one channel, or planes of two.
    """
    unit = np.trace(normal) / np.trace(rough)
    if not unit > 0:
        return 1.0
    tried = unit * 10.0**DECADES
    size, axes = np.linalg.eigh(rough)  # along these axes a large penalty does not round small numbers off
    size[size < ROUNDING * size[-1]] = 0.0
    pull, rank = axes.T @ gradient, np.count_nonzero(size)
    posterior = _ridged(axes.T @ normal @ axes) + tried[:, None, None] * np.diag(size)
    solved = np.linalg.solve(posterior, pull[:, None])[..., 0]
    cost = -(solved @ pull) + np.linalg.slogdet(posterior)[1] - rank * np.log(tried)
    return float(tried[np.argmin(cost)])


def _ridged(normal: np.ndarray) -> np.ndarray:
    diagonal = np.diag(normal)
    return normal + RIDGE * np.diag(diagonal + diagonal.mean())


def penalised(normal: np.ndarray, gradient: np.ndarray, penalty: np.ndarray) -> tuple[np.ndarray, float]:
    """Return a free shape's amplitudes, (p,), and effective degrees of freedom tr (G + P)^-1 G."""
    covariance = covariance_of(_ridged(normal), penalty)
    return covariance @ gradient, float(np.trace(covariance @ normal))


def smoothed(model: Model, normal: np.ndarray, gradient: np.ndarray) -> Model:
    """Return the model with the smoothness of its free shapes estimated by REML, one after the other."""
    for number, term in enumerate(model.terms):
        if term.smoothness is None:
            continue
        place = model.term_slice(number)
        own, pull = free_of_others(model, normal, gradient, place)
        value = reml_smoothness(own, pull, roughness_of(term))
        terms = tuple(replace(t, smoothness=value) if k == number else t for k, t in enumerate(model.terms))
        model = replace(model, terms=terms)
    return model


def free_of_others(
    model: Model, normal: np.ndarray, gradient: np.ndarray, place: slice
) -> tuple[np.ndarray, np.ndarray]:
    """Return G and g of a term's amplitudes, at amplitudes of zero, all other parameters eliminated."""
    others = np.r_[0 : place.start, place.stop : model.size]
    precision = precision_of(model)
    pull = (gradient - precision @ (model.vector() - centre_of(model)))[others]
    cross = normal[place][:, others]
    square = (normal + precision)[np.ix_(others, others)]
    by_others = np.linalg.lstsq(square, np.c_[cross.T, pull], rcond=1e-12)[0]
    own = normal[place, place] - cross @ by_others[:, :-1]
    own = (own + own.T) / 2
    return own, gradient[place] - cross @ by_others[:, -1] + own @ model.vector()[place]
