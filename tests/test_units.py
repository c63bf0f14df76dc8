import pytest

from sealfit.units import Units


@pytest.mark.parametrize(
    ("slot", "unit", "column"),
    [
        ("force", "mN", "force_N"),
        ("load", "mN", "load_N"),
        ("displacement", "m", "displacement_mm"),
        ("displacement", "m", "distance_mm"),
        ("speed", "m/s", "speed_mm_s"),
        ("speed", "m/s", "speed_set_mm_s"),
        ("time", "ms", "time_s"),
    ],
)
def test_a_column_has_the_unit_that_the_config_declares_for_its_slot(slot, unit, column):
    assert Units({slot: (slot, unit)}).of(column) == unit
    assert f"({unit})" in Units({slot: (slot, unit)}).label(column)


def test_the_sliding_power_has_the_unit_of_load_times_speed():
    assert Units({"load": ("normal load", "kN"), "speed": ("speed", "m/s")}).of("power") == "kN m/s"


def test_other_columns_keep_the_unit_of_their_name():
    declared = Units({"time": ("time", "ms")}, {"oil": "ppm"})
    assert [declared.of(name) for name in ("rest_s", "elapsed_h", "aging_days", "oil", "batch")] == [
        "s", "h", "d", "ppm", "",
    ]  # fmt: skip
