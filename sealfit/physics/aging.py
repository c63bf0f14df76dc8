"""The aging law (Eq. 15), in the form that data determine and in the form that is printed."""

from __future__ import annotations

import numpy as np

from sealfit.errors import ParameterError


def _checked(days, b):
    days, b = np.asarray(days, float), np.asarray(b, float)
    if not np.all(b > 0):
        raise ParameterError(f"b = {np.min(b):g} d: the aging law needs b > 0.", fix="Give b > 0.")
    if np.any(days < 0):
        raise ParameterError(f"aging_days = {np.min(days):g}: aging time cannot be negative.")
    return days, b


def aging_law(days, *, mu_0, a, b):
    r"""Coefficient (or force) after aging, in the unit of `mu_0`.

    .. math:: \mu(t) = \mu_0 - a \ln(1 + t / b)

    This is Eq. 15 with c = -a ln b, the only c for which mu(0) = mu_0. Eq. 15 itself has one parameter too many: with
    mu_0 fitted as well, only mu_0 - c is determined.

    Parameters
    ----------
    days : float or ndarray, shape (n,)
        Aging time t in days, from 0.
    mu_0, a, b : float or ndarray
        Value of the unaged rubber; loss per e-fold of time, same unit; time after which the loss sets in, in days.

    Raises
    ------
    ParameterError
        If any `b` is not positive or any time is negative.

    Notes
    -----
    Wu et al. 2020, Polymers 12(1), 102, doi:10.3390/polym12010102, Eq. 15.

    Examples
    --------
    >>> round(float(aging_law(4.0, mu_0=0.93566, a=0.04448, b=0.0804)), 4)
    0.761
    """
    days, b = _checked(days, b)
    return np.asarray(mu_0, float) - np.asarray(a, float) * np.log1p(days / b)


def aging_constant(a, b):
    """The c of Eq. 15 that belongs to the identifiable law, c = -a ln b, in the unit of `a`.

    Raises
    ------
    ParameterError
        If any `b` (in days) is not positive.

    Examples
    --------
    >>> round(float(aging_constant(0.04448, 0.0804)), 4)
    0.1121
    """
    _, b = _checked(0.0, b)
    return -np.asarray(a, float) * np.log(b)


def aging_law_as_printed(days, *, mu_0, a, b, c):
    r"""Coefficient after aging as Eq. 15 is printed, with its four parameters.

    .. math:: \mu(t) = \mu_0 - a \ln(t + b) - c

    Parameters and errors as `aging_law`; `c` has the unit of `mu_0`.

    Examples
    --------
    >>> round(float(aging_law_as_printed(16.0, mu_0=0.93513, a=0.04448, b=0.0804, c=0.11159)), 4)
    0.7
    """
    days, b = _checked(days, b)
    return np.asarray(mu_0, float) - np.asarray(a, float) * np.log(days + b) - np.asarray(c, float)
