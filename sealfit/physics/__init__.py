"""Equations as pure array functions; they know nothing of tables."""

from sealfit.physics.aging_laws import aging_constant, aging_law
from sealfit.physics.lugre import (
    PRESSURES,
    Bristles,
    Contact,
    LuGre,
    bristle_limit,
    lugre_force,
    stribeck_decay,
    stribeck_force,
)

__all__ = [
    "PRESSURES", "Bristles", "Contact", "LuGre", "aging_constant", "aging_law", "bristle_limit",
    "lugre_force", "stribeck_decay", "stribeck_force",
]  # fmt: skip
