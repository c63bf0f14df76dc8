"""What the parts of a SPEC share: unknown keys refused, and random numbers that depend on the seed and their use."""

from __future__ import annotations

from dataclasses import dataclass
from zlib import crc32

import numpy as np
from pydantic import BaseModel, ConfigDict
from scipy.signal import lfilter

# ---------------------------------------------------------------- strict
# The base of every table of a SPEC: unknown keys refused, values fixed, numbers finite.


class Strict(BaseModel):
    """A table of a SPEC that refuses what it does not know."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


# ---------------------------------------------------------------- draws
# Random numbers that depend on the seed and on what they are for, and on nothing else.
#
# Adding a noise kind or a channel to a SPEC leaves every other draw as it was, so campaigns can be compared draw by
# draw.


@dataclass(frozen=True, slots=True)
class Draws:
    """A SPEC's source of randomness."""

    seed: int

    def stream(self, *purpose: str | int) -> np.random.Generator:
        """Return a generator for one purpose, e.g. `stream("white", 12)` for the thirteenth file."""
        key = [crc32(part.encode("utf-8")) if isinstance(part, str) else part for part in purpose]
        return np.random.default_rng([self.seed, *key])


def remembering(kicks: np.ndarray, memory: float) -> np.ndarray:
    """Return unit noise whose neighbours correlate by `memory`, from independent unit `kicks`, shape (n,).

    The exact discretisation of an Ornstein-Uhlenbeck process at equal steps, stationary from the first value on.
    """
    scaled = np.sqrt(1.0 - memory**2) * kicks
    scaled[0] = kicks[0]
    return lfilter([1.0], [1.0, -memory], scaled)
