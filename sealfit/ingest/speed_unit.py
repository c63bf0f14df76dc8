"""From the slope of displacement over time to the unit that the campaign's speed is stated in."""

from __future__ import annotations

import math

from sealfit.errors import ConfigError
from sealfit.units import Units

LENGTH = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "µm": 1e-6, "um": 1e-6, "μm": 1e-6, "in": 25.4e-3}
ANGLE = {"turn": 2 * math.pi, "rev": 2 * math.pi, "rad": 1.0, "deg": math.pi / 180, "°": math.pi / 180}
TIME = {"s": 1.0, "ms": 1e-3, "min": 60.0, "h": 3600.0}
SHORT = {"rpm": ("turn", "min"), "rps": ("turn", "s")}


def speed_factor(units: Units) -> float:
    """Return what turns displacement unit per time unit into the speed's unit: 60 for turn, s and rpm; 1 for mm, s
    and mm/s.

    Raises
    ------
    ConfigError
        If the units do not fit together (turn and mm/s), or are not known and not spelled "<displacement>/<time>".

    Examples
    --------
    >>> speed_factor(Units({"displacement": ("angle", "turn"), "speed": ("speed", "rpm")}))
    60.0
    """
    displacement, time, speed = (units.unit(slot) for slot in ("displacement", "time", "speed"))
    way, _, per = speed.partition("/") if speed not in SHORT else (SHORT[speed][0], "/", SHORT[speed][1])
    if (way, per) == (displacement, time):
        return 1.0
    for sizes in (LENGTH, ANGLE):
        if {way, displacement} <= sizes.keys() and {per, time} <= TIME.keys():
            return (sizes[displacement] / sizes[way]) * (TIME[per] / TIME[time])
    raise ConfigError(
        f"displacement in {displacement!r} over time in {time!r} does not give a speed in {speed!r}.",
        column="quantities",
        fix=f"Declare the speed's unit as '{displacement}/{time}', or units known here: "
        f"{', '.join([*LENGTH, *ANGLE, *TIME, *SHORT])}.",
    )
