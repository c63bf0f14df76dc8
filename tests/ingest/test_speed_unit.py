import pytest

from sealfit.errors import ConfigError
from sealfit.units import Units


@pytest.mark.parametrize(
    ("displacement", "time", "speed", "factor"),
    [
        ("mm", "s", "mm/s", 1.0),
        ("turn", "s", "rpm", 60.0),
        ("deg", "s", "rpm", 60.0 / 360.0),
        ("mm", "s", "m/s", 1e-3),
        ("mm", "ms", "mm/s", 1e3),
        ("mm", "s", "mm/min", 60.0),
        ("pixel", "frame", "pixel/frame", 1.0),
    ],
)
def test_slope_of_displacement_over_time_in_the_speed_s_unit(displacement, time, speed, factor):
    units = Units({"displacement": ("way", displacement), "time": ("time", time), "speed": ("speed", speed)})
    assert units.speed_factor == pytest.approx(factor, rel=1e-12)


def test_units_that_do_not_fit_together_are_refused():
    with pytest.raises(
        ConfigError, match=r"displacement in 'turn' over time in 's' gives no speed in 'mm/s'"
    ):
        _ = Units({"displacement": ("angle", "turn")}).speed_factor
