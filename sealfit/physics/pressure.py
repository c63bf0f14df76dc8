"""Pressure along the contact: the four distributions of Eqs. 8 to 11."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np

from sealfit.errors import ParameterError

# Gauss-Legendre nodes and weights. 64 are exact to rounding for all four distributions, up to a decay of
# about 50.
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(64)


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
        Position in the contact, 0 <= zeta <= L, in mm.
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

    Parameters and errors as `uniform`; `decay` is lambda, dimensionless. At 0 it is `uniform`; below 0 it
    increases.

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
    r"""Load per unit width, a parabola (Eq. 11), in N/mm.

    .. math:: f_n = \frac{3F_n}{2L} [1 - (\frac{\zeta - L/2}{L/2})^2]

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
        One of `PRESSURES`, or another function with the same arguments, in N/mm.
    width_mm : float
        Contact width L in mm.
    exponent : float
        n; 1 for friction independent of the pressure, 2/3 to 1 for rubber.
    reference_N_mm : float, optional
        Load per width at which mu_s and mu_c are defined; default the mean of the present load.
    shape : mapping
        Further arguments of the distribution, such as `decay`.
    """

    pressure: Callable = uniform
    width_mm: float = 1.0
    exponent: float = 1.0
    reference_N_mm: float | None = None
    shape: Mapping[str, float] = field(default_factory=dict)

    def elements(self, load_N: float) -> tuple[np.ndarray, np.ndarray]:
        """Return each element's share of the load and mu relative to the reference, shape (elements,) each.

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
