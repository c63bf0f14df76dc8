r"""The LuGre model: force in steady sliding (Eq. 14), and for any speed history and pressure (Eqs. 1 to 11).

.. math::
    \dot z = v - \frac{|v|}{g(v)} z, \quad g(v) = \frac{N}{\sigma_0} [\mu_c + (\mu_s - \mu_c) e^{-(v/v_s)^2}],
    \quad F = \sigma_0 z + \sigma_1 \dot z + \sigma_2 v

Every element of the contact has the share :math:`f_n / F_n` of sigma_0 and sigma_1 (Eqs. 5 to 7). All
elements then have the same deflection, and the distribution cancels. If friction depends on the local
pressure, :math:`\mu \propto p^{n-1}`, elements under different pressure slide after different distances, and
the force does not rise as one exponential.

Canudas de Wit et al. 1995, IEEE Trans. Automatic Control 40(3), 419-425, doi:10.1109/9.376053; Wu et al.
2020, Polymers 12(1), 102, doi:10.3390/polym12010102.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from sealfit.errors import ParameterError

# Gauss-Legendre nodes and weights. 64 are exact to rounding for all four distributions, up to a decay of
# about 50.
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(64)


# ---------------------------------------------------------------- pressure
# Load per unit width in the contact, F_n / L s(x) at x = zeta / L from 0 to 1 (Eqs. 8 to 11). Each function
# returns s, the load relative to its mean, shape (n,).


def sine(x):
    r"""Return s of the sine distribution, :math:`\pi / 2 \sin \pi x`."""
    return np.pi / 2 * np.sin(np.pi * x)


def exponential(x, decay=1.0):
    r"""Return s of the exponential distribution, :math:`\lambda e^{-\lambda x} / (1 - e^{-\lambda})`.

    `decay` is lambda, dimensionless. At 0 the distribution is uniform; below 0 it increases.
    """
    if decay == 0:
        return np.ones_like(x)
    return decay * np.exp(-decay * x) / -np.expm1(-decay)


def parabolic(x):
    """Return s of the parabolic distribution, 6 x (1 - x)."""
    return 6 * x * (1 - x)


# The distributions by name.
PRESSURES = {"uniform": np.ones_like, "sine": sine, "exponential": exponential, "parabolic": parabolic}


@dataclass(frozen=True)
class Contact:
    r"""A contact whose friction depends on the local pressure, :math:`\mu \propto p^{n-1}`."""

    # One of `PRESSURES`, or another function of x: `partial(exponential, decay=2.0)`.
    pressure: Callable = np.ones_like
    width_mm: float = 1.0  # contact width L
    exponent: float = 1.0  # n; 1 for friction independent of the pressure, 2/3 to 1 for rubber
    # Load per width at which mu_s and mu_c are defined; default the mean of the present load.
    reference_N_mm: float | None = None

    def elements(self, load_N: float) -> tuple[np.ndarray, np.ndarray]:
        """Return each element's share of the load and mu relative to the reference, shape (elements,) each.

        Raises
        ------
        ParameterError
            If the load, the width or the reference is not positive.

        Examples
        --------
        >>> share, factor = Contact(PRESSURES["sine"], width_mm=2.0, exponent=0.8).elements(50.0)
        >>> round(float(share.sum()), 12), round(float(share @ factor), 3)
        (1.0, 0.975)
        """
        if not self.width_mm > 0:
            raise ParameterError(f"width_mm = {self.width_mm:g}: the contact width must be positive.")
        mean = load_N / self.width_mm
        reference = mean if self.reference_N_mm is None else self.reference_N_mm
        if not (load_N > 0 and reference > 0):
            raise ParameterError(f"load_N = {load_N:g}, reference {reference:g} N/mm: both must be positive.")
        relative = self.pressure((1 + _NODES) / 2)
        share = _WEIGHTS * relative
        return share / share.sum(), (mean * relative / reference) ** (self.exponent - 1)


# ---------------------------------------------------------------- steady sliding


def stribeck_decay(speed_mm_s, v_s):
    r"""Return the decay of the static rise mu_s - mu_c with speed, from 1 at rest to 0 at high speed.

    .. math:: E = e^{-(v / v_s)^2}

    Parameters
    ----------
    speed_mm_s, v_s : float or ndarray
        Sliding speed v in mm/s, of either sign; Stribeck velocity in mm/s, broadcast against it.

    Raises
    ------
    ParameterError
        If any `v_s` is not positive.

    Examples
    --------
    >>> round(float(stribeck_decay(5.0, 5.0)), 6)
    0.367879
    """
    v_s = np.asarray(v_s, float)
    if not np.all(v_s > 0):
        raise ParameterError(
            f"v_s = {np.min(v_s):g}: the Stribeck velocity must be positive.", fix="Give v_s > 0."
        )
    return np.exp(-((np.asarray(speed_mm_s, float) / v_s) ** 2))


def stribeck_force(speed_mm_s, load_N, *, mu_s, mu_c, v_s, sigma_2):
    r"""Return the friction force of the distributed LuGre model in steady sliding (Eq. 14), shape (n,), in N.

    .. math:: F = N [\mu_c + (\mu_s - \mu_c) e^{-(v / v_s)^2}] \mathrm{sgn}\,v + \sigma_2 v

    Parameters
    ----------
    speed_mm_s, load_N : float or ndarray, shape (n,)
        Sliding speed v in mm/s, signed; normal load N in N. A load of 1 turns the coefficients into forces
        F_s, F_c.
    mu_s, mu_c, v_s, sigma_2 : float or ndarray, shape (n,)
        Static and Coulomb coefficients; Stribeck velocity in mm/s; viscous coefficient in N s/mm.

    Raises
    ------
    ParameterError
        If any `v_s` is not positive or any load is negative.

    Notes
    -----
    The force has the sign of the speed. F(0) = 0 is not the break-away force; sigma_0 and sigma_1 have no
    effect in steady sliding. Canudas de Wit et al. 1995, IEEE Trans. Automatic Control 40(3), 419-425,
    doi:10.1109/9.376053; Wu et al. 2020, Polymers 12(1), 102, doi:10.3390/polym12010102, Eq. 14.

    Examples
    --------
    >>> round(float(stribeck_force(5.0, 100.0, mu_s=0.6, mu_c=0.4, v_s=5.0, sigma_2=0.0)), 4)
    47.3576
    """
    speed, load = np.asarray(speed_mm_s, float), np.asarray(load_N, float)
    if np.any(load < 0):
        raise ParameterError(f"load_N = {np.min(load):g}: a normal load cannot be negative.")
    mu_s, mu_c = np.asarray(mu_s, float), np.asarray(mu_c, float)
    mu = mu_c + (mu_s - mu_c) * stribeck_decay(speed, v_s)
    return load * mu * np.sign(speed) + np.asarray(sigma_2, float) * speed


# ---------------------------------------------------------------- history of the speed


@dataclass(frozen=True)
class Bristles:
    """Force, deflection and heat along a history of the speed, shape (n,) each."""

    force_N: np.ndarray  # friction force
    deflection_mm: np.ndarray  # mean deflection z, weighted by stiffness
    heat_mW: np.ndarray  # dissipated power: that of the force minus what is stored in the bristles


def bristle_limit(speed_mm_s, load_N, *, mu_s, mu_c, v_s, sigma_0):
    r"""Return the deflection of the bristles in steady sliding, g(v) of Eqs. 3 and 6, in mm.

    .. math:: g(v) = \frac{N}{\sigma_0} [\mu_c + (\mu_s - \mu_c) e^{-(v/v_s)^2}]

    Parameters as `stribeck_force`; sigma_0, the stiffness of the bristles, is in N/mm.

    Raises
    ------
    ParameterError
        If `v_s` or `sigma_0` is not positive, or a load is negative.

    Examples
    --------
    >>> float(bristle_limit(0.0, 50.0, mu_s=0.6, mu_c=0.4, v_s=5.0, sigma_0=100.0))
    0.3
    """
    if not np.all(np.asarray(sigma_0) > 0):
        raise ParameterError(f"sigma_0 = {np.min(sigma_0):g}: the bristles' stiffness must be positive.")
    if np.any(np.asarray(load_N) < 0):
        raise ParameterError(f"load_N = {np.min(load_N):g}: a normal load cannot be negative.")
    mu_c = np.asarray(mu_c, float)
    return (
        np.asarray(load_N, float)
        / sigma_0
        * (mu_c + (np.asarray(mu_s, float) - mu_c) * stribeck_decay(speed_mm_s, v_s))
    )


@dataclass(frozen=True)
class LuGre:
    """The parameters of the dynamic LuGre model."""

    mu_s: float  # static coefficient
    mu_c: float  # Coulomb coefficient
    v_s: float  # Stribeck velocity in mm/s
    sigma_0: float  # stiffness in N/mm
    sigma_1: float = 0.0  # damping of the bristles in N s/mm
    sigma_2: float = 0.0  # viscous coefficient in N s/mm
    contact: Contact | None = None  # with pressure-dependent friction

    def elements(self, load_N: float) -> tuple[np.ndarray, np.ndarray]:
        """Return each element's share of the load and factor on mu, by `Contact.elements`."""
        return (np.ones(1), np.ones(1)) if self.contact is None else self.contact.elements(load_N)


def lugre_force(time_s, speed_mm_s, load_N: float, model: LuGre, *, deflection_mm: float = 0.0) -> Bristles:
    """Return the friction force of the dynamic LuGre model along a history of the speed (Eqs. 1 to 7), in N.

    The speed is constant between times, and each step is exact.

    Parameters
    ----------
    time_s : ndarray, shape (n,)
        Rising times in s.
    speed_mm_s : ndarray, shape (n,)
        Signed speed in mm/s: value k from time k - 1 to time k.
    load_N : float
        Normal load in N.
    model : LuGre
        Parameters.
    deflection_mm : float
        Initial deflection of all bristles in mm.

    Raises
    ------
    ParameterError
        If a parameter is out of its range, times do not rise, or shapes differ.

    Notes
    -----
    The heat is not negative with sigma_1 = 0. With damping this is true for every history if and only if
    sigma_2 >= sigma_1 (mu_s - mu_c) / mu_c (Barahanov & Ortega 2000, IEEE Trans. Automatic Control 45(4),
    830-832, doi:10.1109/9.847131).

    Examples
    --------
    From rest at 2 mm/s the force rises over a length of 0.25 mm; the first step reaches half of its final
    value.

    >>> import numpy as np
    >>> model = LuGre(mu_s=0.5, mu_c=0.5, v_s=5.0, sigma_0=100.0)
    >>> found = lugre_force([0.0, 0.125 * np.log(2), 10.0], [0.0, 2.0, 2.0], 50.0, model)
    >>> [round(float(f), 6) for f in found.force_N]
    [0.0, 12.5, 25.0]
    """
    time = np.asarray(time_s, float)
    if time.ndim != 1 or not time.size or not (np.diff(time) > 0).all():
        raise ParameterError(
            "time_s must be one-dimensional and increasing.", fix="Sort the rows and drop repeated times."
        )
    if not (model.sigma_1 >= 0 and model.sigma_2 >= 0):
        raise ParameterError(
            f"sigma_1 = {model.sigma_1:g}, sigma_2 = {model.sigma_2:g}: neither can be negative."
        )
    if not load_N > 0:
        raise ParameterError(f"load_N = {load_N:g}: bristles need a load above 0.", fix="Give a load in N.")
    share, factor = model.elements(load_N)
    speed = np.asarray(speed_mm_s, float)
    if speed.shape != time.shape:
        raise ParameterError(
            f"speed_mm_s has shape {speed.shape}, time_s {time.shape}: give one speed a time."
        )
    parameters = {name: getattr(model, name) for name in ("mu_s", "mu_c", "v_s", "sigma_0")}
    limit = bristle_limit(speed, load_N, **parameters)[:, None] * factor
    z = _stepped(time, speed, limit, np.full(share.size, float(deflection_mm)))
    rate = speed[:, None] - np.abs(speed)[:, None] * z / limit
    force = (model.sigma_0 * z + model.sigma_1 * rate) @ share + model.sigma_2 * speed
    return Bristles(force, z @ share, force * speed - model.sigma_0 * (z * rate) @ share)


def _stepped(time: np.ndarray, speed: np.ndarray, limit: np.ndarray, start: np.ndarray) -> np.ndarray:
    """Return every element's deflection, shape (n, elements), exact for a speed constant between times."""
    slid = np.abs(speed) * np.diff(time, prepend=time[0])
    kept, end = np.exp(-slid[:, None] / limit), np.sign(speed)[:, None] * limit
    z, path = start, np.empty_like(kept)
    for k in range(len(time)):
        z = end[k] + (z - end[k]) * kept[k]
        path[k] = z
    return path
