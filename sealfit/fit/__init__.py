"""The fits. Each returns the tables in which it is stored, by name, and takes those of the fits before it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np


def covariance_matrix(covariances: Mapping[tuple[str, str], float], names: Sequence[str]) -> np.ndarray:
    """Return the covariance of parameters, shape (p, p), from values by ("mu_s", "mu_c"); 0 if unknown."""
    upper = np.array([[covariances.get((one, other), 0.0) for other in names] for one in names])
    upper = np.where(np.isfinite(upper), upper, 0.0)
    return upper + np.triu(upper, 1).T
