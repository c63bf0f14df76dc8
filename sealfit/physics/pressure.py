"""Pressure along the contact: the four distributions of Eqs. 8 to 11, and Eq. 14 summed over them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np

from sealfit.errors import ParameterError
from sealfit.physics.stribeck import stribeck_decay

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(64)  # 64: exact to rounding for all four, up to decay of about 50


def _inside(zeta_mm, width_mm):
    zeta = np.asarray(zeta_mm, float)
    if not width_mm > 0:
        raise ParameterError(f"width_mm = {width_mm:g}: the contact width must be positive.")
    if np.any((zeta < 0) | (zeta > width_mm)):
        raise ParameterError(f"zeta_mm must lie in the contact, from 0 to {width_mm:g} mm.")
    return zeta


def uniform(zeta_mm, load_N, *, width_mm):
    r"""Load per unit width, the same everywhere (Eq. 8), in N/mm: :math:`f_n = F_n / L`.

    Parameters
    ----------
    zeta_mm : float or ndarray, shape (n,)
        Place in the contact, 0 <= zeta <= L, in mm.
    load_N : float
        Total load F_n in N.
    width_mm : float
        Contact width L in mm.

    Raises
    ------
    ParameterError
        If the width is not positive or zeta lies outside the contact.

    Examples
    --------
    >>> float(uniform(1.0, 50.0, width_mm=2.0))
    25.0
    """
    return np.full_like(_inside(zeta_mm, width_mm), load_N / width_mm)


def sine(zeta_mm, load_N, *, width_mm):
    r"""Load per unit width, half a sine (Eq. 9), in N/mm: :math:`f_n = \frac{\pi F_n}{2L} \sin(\pi\zeta/L)`.

    Parameters and errors as `uniform`.

    Examples
    --------
    >>> round(float(sine(1.0, 50.0, width_mm=2.0)), 4)
    39.2699
    """
    zeta = _inside(zeta_mm, width_mm)
    return np.pi * load_N / (2 * width_mm) * np.sin(np.pi * zeta / width_mm)


def exponential(zeta_mm, load_N, *, width_mm, decay=1.0):
    r"""Load per unit width, falling exponentially (Eq. 10), in N/mm.

    .. math:: f_n = \frac{\lambda F_n}{L (1 - e^{-\lambda})} e^{-\lambda\zeta/L}

    Parameters and errors as `uniform`; `decay` is lambda, without unit. Zero is the limit, `uniform`; negative rises.

    Examples
    --------
    >>> round(float(exponential(0.0, 50.0, width_mm=2.0, decay=1.0)), 4)
    39.5494
    """
    zeta = _inside(zeta_mm, width_mm)
    if decay == 0:
        return uniform(zeta, load_N, width_mm=width_mm)
    return decay * load_N / (-width_mm * np.expm1(-decay)) * np.exp(-decay * zeta / width_mm)


def parabolic(zeta_mm, load_N, *, width_mm):
    r"""Load per unit width, a parabola (Eq. 11), in N/mm: :math:`\frac{3F_n}{2L}[1 - (\frac{\zeta - L/2}{L/2})^2]`.

    Parameters and errors as `uniform`.

    Examples
    --------
    >>> float(parabolic(1.0, 50.0, width_mm=2.0))
    37.5
    """
    zeta = _inside(zeta_mm, width_mm)
    half = width_mm / 2
    return 3 * load_N / (2 * width_mm) * (1 - ((zeta - half) / half) ** 2)


PRESSURES: dict[str, Callable] = {
    "uniform": uniform,
    "sine": sine,
    "exponential": exponential,
    "parabolic": parabolic,
}


@dataclass(frozen=True)
class Contact:
    r"""A contact whose friction depends on the local pressure, :math:`\mu \propto p^{n-1}`.

    Attributes
    ----------
    pressure : callable
        One of `PRESSURES`, or another of the same arguments, in N/mm.
    width_mm : float
        Contact width L in mm.
    exponent : float
        n, of the friction force over the load; 1: friction does not depend on the pressure. Rubber: 2/3 to 1.
    reference_N_mm : float, optional
        Load per width at which mu_s and mu_c hold; default: the mean of the load at hand.
    shape : mapping
        Further arguments of the distribution, such as `decay`.
    """

    pressure: Callable = uniform
    width_mm: float = 1.0
    exponent: float = 1.0
    reference_N_mm: float | None = None
    shape: Mapping[str, float] = field(default_factory=dict)

    def elements(self, load_N: float) -> tuple[np.ndarray, np.ndarray]:
        """Return each element's share of the load, and its mu over that at the reference, of shape (elements,) each.

        Raises
        ------
        ParameterError
            If the load, the width or the reference is not positive.

        Examples
        --------
        >>> share, factor = Contact(sine, width_mm=2.0, exponent=0.8).elements(50.0)
        >>> round(float(share.sum()), 12), round(float(share @ factor), 3)
        (1.0, 0.975)
        """
        reference = load_N / self.width_mm if self.reference_N_mm is None else self.reference_N_mm
        if not (load_N > 0 and reference > 0):
            raise ParameterError(f"load_N = {load_N:g}, reference {reference:g} N/mm: both must be positive.")
        local = self.pressure(self.width_mm / 2 * (1 + _NODES), load_N, width_mm=self.width_mm, **self.shape)
        share = _WEIGHTS * local
        return share / share.sum(), (local / reference) ** (self.exponent - 1)


def total_load(pressure: Callable, load_N: float, *, width_mm: float, **shape) -> float:
    """Integral of a pressure distribution over the contact, in N, by Gauss-Legendre quadrature.

    Parameters
    ----------
    pressure : callable
        One of `PRESSURES`, or another of the same arguments, in N/mm.
    load_N, width_mm : float
        As the distribution takes them.
    **shape
        Further arguments of the distribution, such as `decay`.

    Examples
    --------
    >>> round(total_load(sine, 50.0, width_mm=2.0), 9)
    50.0
    """
    zeta = width_mm / 2 * (1 + _NODES)
    return float(width_mm / 2 * np.sum(_WEIGHTS * pressure(zeta, load_N, width_mm=width_mm, **shape)))


def distributed_force(
    speed_mm_s, load_N: float, *, pressure: Callable, width_mm: float, mu_s, mu_c, v_s, sigma_2, **shape
):
    r"""Steady friction force as the sum over the elements of the contact (Eq. 14 before its integral is taken), in N.

    .. math:: F = \int_0^L [\mu_c + (\mu_s - \mu_c) e^{-(v/v_s)^2}] f_n(\zeta)\,d\zeta\;\mathrm{sgn}\,v + \sigma_2 v

    The elements share one speed, so the bracket does not depend on zeta and the distribution cancels: friction depends
    on the pressure's shape only if mu depends on the local pressure, which `mu_s` and `mu_c` may here: a callable gets
    the local load per width in N/mm and returns the coefficient.

    Parameters
    ----------
    speed_mm_s : float or ndarray, shape (n,)
        Sliding speed in mm/s, signed.
    load_N : float
        Total load in N.
    pressure, width_mm, **shape
        Distribution and its arguments, see `PRESSURES`.
    mu_s, mu_c : float or callable
        Coefficients, or functions of the local load per width.
    v_s, sigma_2 : float
        Stribeck speed in mm/s, viscous coefficient in N s/mm.

    Raises
    ------
    ParameterError
        If `v_s` or the width is not positive.
    """
    speed = np.asarray(speed_mm_s, float)
    zeta = width_mm / 2 * (1 + _NODES)
    local = pressure(zeta, load_N, width_mm=width_mm, **shape)
    static, coulomb = (mu(local) if callable(mu) else np.full_like(local, mu) for mu in (mu_s, mu_c))
    decay = stribeck_decay(speed, v_s)[..., None]
    elements = (coulomb + (static - coulomb) * decay) * local * _WEIGHTS * width_mm / 2
    return elements.sum(axis=-1) * np.sign(speed) + sigma_2 * speed
