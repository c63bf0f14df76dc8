r"""Shapes that the loss of friction by aging may have over time: Eq. 15 and its rivals.

All are :math:`\mu(t) = \mu_0 - a\, \varphi(t)` with :math:`\varphi(0) = 0`:

- ``log``, Eq. 15: :math:`\ln(1 + t/b)`. Wu et al. 2020, Polymers 12(1), 102, doi:10.3390/polym12010102.
- ``stretched``: :math:`1 - e^{-(t/\tau)^\beta}`, a floor of :math:`\mu_0 - a` that is approached as relaxation in a
  glassy or cross-linked network is. Kohlrausch 1854, Ann. Phys. 167, 56-82, doi:10.1002/andp.18541670103.
- ``power``: :math:`t^n` with t in days; n = 1/2 where diffusion sets the pace. Findley, Lai & Onaran 1976, Creep and
  Relaxation of Nonlinear Viscoelastic Materials, chapter 2.
- ``induction``: :math:`\ln(1 + \max(t - t_i, 0)/b)`, nothing before the stabiliser is used up. For induction periods
  of elastomers: Celina 2013, Polym. Degrad. Stab. 98(12), 2419-2429, doi:10.1016/j.polymdegradstab.2013.06.024.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Loss:
    """One shape of the loss over time.

    Attributes
    ----------
    name : str
        As above.
    form : str
        Equation in plain text.
    parameters : tuple of str
        Its own numbers, all positive: times in days, exponents.
    units : tuple of str
        Of these.
    value : callable
        (days, own numbers) -> phi, broadcast.
    time : callable
        (phi, own numbers) -> days until the loss is phi; inf where it is never reached.
    slopes : callable
        (days, own numbers) -> derivative of phi along ln t, and along the logarithm of each own number; broadcast.
    """

    name: str
    form: str
    parameters: tuple[str, ...]
    units: tuple[str, ...]
    value: Callable
    time: Callable
    slopes: Callable


def _log(days, b):
    return np.log1p(np.asarray(days, float) / b)


def _log_time(phi, b):
    return b * np.expm1(phi)


def _log_slopes(days, b):
    share = np.asarray(days, float) / (b + days)
    return share, -share


def _stretched(days, tau, beta):
    return -np.expm1(-((np.asarray(days, float) / tau) ** beta))


def _stretched_time(phi, tau, beta):
    phi = np.asarray(phi, float)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(phi < 1, tau * (-np.log1p(-np.minimum(phi, 1.0))) ** (1 / beta), np.inf)


def _stretched_slopes(days, tau, beta):
    ratio = np.asarray(days, float) / tau
    power = ratio**beta
    bend = beta * power * np.exp(-power)
    return bend, -bend, bend * np.log(np.where(ratio > 0, ratio, 1.0))


def _power(days, n):
    return np.asarray(days, float) ** n


def _power_time(phi, n):
    return np.asarray(phi, float) ** (1 / n)


def _power_slopes(days, n):
    days = np.asarray(days, float)
    bend = n * days**n
    return bend, bend * np.log(np.where(days > 0, days, 1.0))


def _induction(days, b, t_i):
    return np.log1p(np.maximum(np.asarray(days, float) - t_i, 0.0) / b)


def _induction_time(phi, b, t_i):
    return t_i + b * np.expm1(phi)


def _induction_slopes(days, b, t_i):
    late = np.maximum(np.asarray(days, float) - t_i, 0.0)
    per_day = (late > 0) / (b + late)
    return days * per_day, -late * per_day, -t_i * per_day


LOSSES = {
    loss.name: loss
    for loss in (
        Loss("log", "mu_0 - a ln(1 + t/b)", ("b",), ("d",), _log, _log_time, _log_slopes),
        Loss(
            "stretched", "mu_0 - a (1 - exp(-(t/tau)^beta))", ("tau", "beta"), ("d", ""),
            _stretched, _stretched_time, _stretched_slopes,
        ),
        Loss("power", "mu_0 - a t^n", ("n",), ("",), _power, _power_time, _power_slopes),
        Loss(
            "induction", "mu_0 - a ln(1 + max(t - t_i, 0)/b)", ("b", "t_i"), ("d", "d"),
            _induction, _induction_time, _induction_slopes,
        ),
    )
}  # fmt: skip
"""Every shape by name."""
