"""Equations as pure array functions; they know nothing of tables."""

from sealfit.physics.aging_laws import aging_constant, aging_law, aging_law_as_printed
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
    "PRESSURES", "Bristles", "Contact", "LuGre", "aging_constant", "aging_law", "aging_law_as_printed",
    "bristle_limit", "lugre_force", "stribeck_decay", "stribeck_force",
]  # fmt: skip
