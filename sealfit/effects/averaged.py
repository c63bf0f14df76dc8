r"""What is left of a wave in the mean over the samples of a bin.

.. math:: \frac{1}{n} \sum_k \sin(\alpha + \beta_k)
          = \frac{\sin(\pi w / \lambda)}{n \sin(\pi w / (n \lambda))} \sin \alpha

for n samples that lie evenly over a width w about the phase alpha (the Dirichlet kernel): in a bin that is longer than
the wave hardly anything, however long it is.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

SAMPLES = "samples"  # in an effect's inputs: how many a row is the mean of


def width_of(name: str) -> str:
    """Return where an effect's inputs hold how far a channel goes within each row."""
    return f"{name} width"


def left_of_wave(inputs: Mapping, name: str, wavelength: float):
    """Return the factor by which a wave is smaller in each row's mean, shape (n,); 1 where a row is one place.

    Examples
    --------
    Two samples half a wave apart cancel; many over a whole wave, too.

    >>> given = {"x width": np.array([1.0, 2.0, 0.5]), "samples": np.array([2.0, 2.0, 1.0])}
    >>> [round(float(f), 12) for f in left_of_wave(given, "x", 1.0)]
    [0.0, -1.0, 1.0]
    """
    width = inputs.get(width_of(name))
    if width is None:
        return 1.0
    half, samples = np.pi * np.asarray(width, float) / wavelength, np.asarray(inputs[SAMPLES], float)
    each = np.sin(half / samples)
    alike = np.abs(each) < 1e-9  # samples whole waves apart all show the same
    return np.where(alike, np.cos(half) * np.cos(half / samples), np.sin(half) / np.where(alike, 1.0, samples * each))
