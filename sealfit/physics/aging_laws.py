"""Laws of aging: Eq. 15 in its identifiable form, and its rivals."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

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
    r"""Return the coefficient (or force) after aging, shape (n,), in the unit of `mu_0`.

    .. math:: \mu(t) = \mu_0 - a \ln(1 + t / b)

    This is Eq. 15 with c = -a ln b, the only c for which mu(0) = mu_0. As printed, mu_0 - a ln(t + b) - c is
    not identifiable: only mu_0 - c is determined.

    Parameters
    ----------
    days : float or ndarray, shape (n,)
        Aging time t in days, at least 0.
    mu_0, a, b : float or ndarray
        Value of the unaged rubber; loss per factor e of time, same unit; time at which the loss sets in, in
        days.

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
    """Return the constant of Eq. 15 for the identifiable law, c = -a ln b, in the unit of `a`.

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


# ---------------------------------------------------------------- losses
# Shapes of the loss of friction over aging time: Eq. 15 and its rivals.
#
# All are :math:`\mu(t) = \mu_0 - a\, \varphi(t)` with :math:`\varphi(0) = 0`:
#
# - ``log``, Eq. 15: :math:`\ln(1 + t/b)`. Wu et al. 2020, Polymers 12(1), 102, doi:10.3390/polym12010102.
# - ``stretched``: :math:`1 - e^{-(t/\tau)^\beta}`, with the limit :math:`\mu_0 - a`, as in the relaxation of
#   glassy or cross-linked networks. Kohlrausch 1854, Ann. Phys. 167, 56-82, doi:10.1002/andp.18541670103.
# - ``power``: :math:`t^n` with t in days; n = 1/2 for diffusion. Findley, Lai & Onaran 1976, Creep and
#   Relaxation of Nonlinear Viscoelastic Materials, chapter 2.
# - ``induction``: :math:`\ln(1 + \max(t - t_i, 0)/b)`, no loss before the stabiliser is consumed. For
#   induction periods of elastomers: Celina 2013, Polym. Degrad. Stab. 98(12), 2419-2429,
#   doi:10.1016/j.polymdegradstab.2013.06.024.


@dataclass(frozen=True)
class Loss:
    """One shape of the loss over time; its parameters are positive: times in days, and exponents."""

    name: str
    form: str  # equation in plain text
    parameters: tuple[str, ...]
    units: tuple[str, ...]
    value: Callable  # (days, *parameters) -> phi, broadcast; days are a number or an array
    time: Callable  # (phi, *parameters) -> days until the loss is phi; inf if it is not reached
    slopes: Callable  # (days, *parameters) -> derivatives by ln t and the logarithm of each parameter


def _log_slopes(days, b):
    share = days / (b + days)
    return share, -share


def _stretched_time(phi, tau, beta):
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(phi < 1, tau * (-np.log1p(-np.minimum(phi, 1.0))) ** (1 / beta), np.inf)


def _stretched_slopes(days, tau, beta):
    ratio = days / tau
    power = ratio**beta
    slope = beta * power * np.exp(-power)
    return slope, -slope, slope * np.log(np.where(ratio > 0, ratio, 1.0))


def _power_slopes(days, n):
    slope = n * days**n
    return slope, slope * np.log(np.where(days > 0, days, 1.0))


def _induction_slopes(days, b, t_i):
    late = np.maximum(days - t_i, 0.0)
    per_day = (late > 0) / (b + late)
    return days * per_day, -late * per_day, -t_i * per_day


# Every shape by name.
LOSSES = {
    loss.name: loss
    for loss in (
        Loss(
            "log", "mu_0 - a ln(1 + t/b)", ("b",), ("d",),
            value=lambda days, b: np.log1p(days / b),
            time=lambda phi, b: b * np.expm1(phi),
            slopes=_log_slopes,
        ),
        Loss(
            "stretched", "mu_0 - a (1 - exp(-(t/tau)^beta))", ("tau", "beta"), ("d", ""),
            value=lambda days, tau, beta: -np.expm1(-((days / tau) ** beta)),
            time=_stretched_time,
            slopes=_stretched_slopes,
        ),
        Loss(
            "power", "mu_0 - a t^n", ("n",), ("",),
            value=lambda days, n: days**n,
            time=lambda phi, n: phi ** (1 / n),
            slopes=_power_slopes,
        ),
        Loss(
            "induction", "mu_0 - a ln(1 + max(t - t_i, 0)/b)", ("b", "t_i"), ("d", "d"),
            value=lambda days, b, t_i: np.log1p(np.maximum(days - t_i, 0.0) / b),
            time=lambda phi, b, t_i: t_i + b * np.expm1(phi),
            slopes=_induction_slopes,
        ),
    )
}  # fmt: skip
