"""Equations as pure array functions; they know nothing of tables."""

from sealfit.physics.aging import aging_constant, aging_law, aging_law_as_printed
from sealfit.physics.pressure import PRESSURES, distributed_force, total_load
from sealfit.physics.stribeck import stribeck_decay, stribeck_force

__all__ = [
    "PRESSURES",
    "aging_constant",
    "aging_law",
    "aging_law_as_printed",
    "distributed_force",
    "stribeck_decay",
    "stribeck_force",
    "total_load",
]
