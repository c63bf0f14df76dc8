"""What a condition's table says of sigma_0 and sigma_1, and why where one of them is not determined."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from sealfit.config import Config
from sealfit.fit.rises import Curve
from sealfit.fit.steady import parameter_units, table_row
from sealfit.fit.stiffness import Stiffness

NO_START = "no stroke begins at rest or at a reversal within its rows: the rise of the force is not in these traces"
ALONG = "the sliding force of some strokes lies along the motion: check the offset between the directions, and the sign"
TOO_FAST = "the force comes up within a few samples: sample faster, or start more slowly"
MISSED = "the force does not come up as the model's does: {share:.0%} of the sliding force is left"
NO_CURVE = "the Stribeck curve is not known: what it does along the ramp looks like damping"
ONE_START = "one start alone: no scatter is known; measure repeats"
WIDE = "the starts disagree: only that it lies between {low:.3g} and {high:.3g} {unit} is known"


def bristle_rows(found: Stiffness | None, curve: Curve, config: Config, *, braked: bool = True) -> Iterator[dict]:
    """Yield rows of table `dynamic_fit` for one condition: sigma_0, sigma_1 and what the fit rests on.

    Parameters
    ----------
    found : Stiffness or None
        None where no stroke shows its beginning.
    curve : Curve
        That the strokes were fitted with.
    config : Config
        Gives the units and the sensor's accuracy.
    braked : bool
        Whether the sliding force of every stroke opposes the motion.
    """
    units = dynamic_units(config)
    if found is None or not found.seen:
        reason = TOO_FAST if found is not None else NO_START if braked else ALONG
        for name in ("sigma_0", "sigma_1"):
            yield table_row(quantity="dynamic", parameter=name, unit=units[name], identified=False, reason=reason)
        return
    yield _stiffness_row(found, curve, units["sigma_0"], config)
    yield _damping_row(found, curve, units["sigma_1"])
    rise = curve.coulomb_N / found.sigma_0
    for name, value, unit in (
        ("rise", rise, config.units.unit("displacement")),
        ("samples_in_rise", found.within, ""),
        ("files", found.files, ""),
        ("rmse", found.rmse_N, config.units.unit("force")),
    ):
        yield table_row(quantity="statistics", parameter=name, value=value, unit=unit, identified=True)


def _stiffness_row(found: Stiffness, curve: Curve, unit: str, config: Config) -> dict:
    value = found.sigma_0
    row = {"quantity": "dynamic", "parameter": "sigma_0", "unit": unit, "value": value}
    if found.files < 2:
        return table_row(**row, identified=False, reason=ONE_START)
    half = found.log_half_width()
    low, high = (value * np.exp(np.clip(sign * half, -50, 50)) for sign in (-1.0, 1.0))
    row |= {"se": value * np.sqrt(found.covariance[0, 0]), "lo95": low, "hi95": high}
    row["u_sys"] = value * config.sensor.u / abs(curve.coulomb_N)
    remark = MISSED.format(share=found.rmse_N / curve.coulomb_N) if found.misses(curve.coulomb_N) else ""
    reason = remark if found.stiffness_known else WIDE.format(low=low, high=high, unit=unit)
    return table_row(**row, identified=found.stiffness_known, reason=reason)


def _damping_row(found: Stiffness, curve: Curve, unit: str) -> dict:
    row = {"quantity": "dynamic", "parameter": "sigma_1", "unit": unit, "value": found.sigma_1}
    if found.files < 2 or not found.stiffness_known:
        why = ONE_START if found.files < 2 else "sigma_0 is not determined"
        return table_row(**row, identified=False, reason=why)
    if not curve.known:
        return table_row(**row, identified=False, reason=NO_CURVE)
    half = found.damping_half_width()
    low, high = max(found.sigma_1 - half, 0.0), found.sigma_1 + half
    row |= {"lo95": low, "hi95": high, "se": found.damping_se}
    if low > 0.0:
        return table_row(**row, identified=True)
    return table_row(**row, identified=False, reason=f"no damping of the bristles is seen: at most {high:.2g} {unit}")


def dynamic_units(config: Config) -> Mapping[str, str]:
    """Return the units of sigma_0 and sigma_1 under the config's units."""
    units = config.units
    return {
        "sigma_0": f"{units.unit('force')}/{units.unit('displacement')}",
        "sigma_1": parameter_units(units, has_load=True)["sigma_2"],
    }
