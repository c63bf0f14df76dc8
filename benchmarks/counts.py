"""Counts with their uncertainty."""

from __future__ import annotations

from scipy import stats


def bounds(count: int, of: int) -> tuple[float, float]:
    """Return the 95 % Clopper-Pearson interval of a share.

    Examples
    --------
    >>> [round(x, 4) for x in bounds(0, 24)]
    [0.0, 0.1425]
    """
    low = stats.beta.ppf(0.025, count, of - count + 1) if count else 0.0
    high = stats.beta.ppf(0.975, count + 1, of - count) if count < of else 1.0
    return float(low), float(high)
