"""Friction in steady sliding: Eq. 14 and its exponential."""

from __future__ import annotations

import numpy as np

from sealfit.errors import ParameterError


def stribeck_decay(speed_mm_s, v_s):
    r"""Return the decay of the static rise mu_s - mu_c with speed, from 1 at rest to 0 at high speed.

    .. math:: E = e^{-(v / v_s)^2}

    Parameters
    ----------
    speed_mm_s : float or ndarray
        Sliding speed v in mm/s, of either sign.
    v_s : float or ndarray
        Stribeck speed in mm/s, broadcast against the speed.

    Returns
    -------
    float or ndarray
        E, without unit.

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
            f"v_s = {np.min(v_s):g}: the Stribeck speed must be positive.", fix="Give v_s > 0."
        )
    return np.exp(-((np.asarray(speed_mm_s, float) / v_s) ** 2))


def stribeck_force(speed_mm_s, load_N, *, mu_s, mu_c, v_s, sigma_2):
    r"""Return the friction force of the distributed LuGre model in steady sliding (Eq. 14), in N.

    .. math:: F = N [\mu_c + (\mu_s - \mu_c) e^{-(v / v_s)^2}] \mathrm{sgn}\,v + \sigma_2 v

    Parameters
    ----------
    speed_mm_s, load_N : float or ndarray, shape (n,)
        Sliding speed v in mm/s, signed; normal load N in N. A load of 1 turns the coefficients into forces
        F_s, F_c.
    mu_s, mu_c, v_s, sigma_2 : float or ndarray, shape (n,)
        Static and Coulomb coefficients; Stribeck speed in mm/s; viscous coefficient in N s/mm.

    Returns
    -------
    float or ndarray, shape (n,)
        Force in N, an odd function of the speed, with its sign for nonnegative coefficients.

    Raises
    ------
    ParameterError
        If any `v_s` is not positive or any load is negative.

    Notes
    -----
    In steady sliding sigma_0 and sigma_1 have no effect. F(0) = 0 is not the break-away force.
    Canudas de Wit et al. 1995, IEEE Trans. Automatic Control 40(3), 419-425, doi:10.1109/9.376053;
    Wu et al. 2020, Polymers 12(1), 102, doi:10.3390/polym12010102, Eq. 14.

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
