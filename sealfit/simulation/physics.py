"""The declared model of a SPEC: Eq. 14 with Eq. 15, one law for all series or one each."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from pydantic import Field

from sealfit.simulation.strict import Strict

# The model's numbers before any effect; the endings _s and _c stand for mu_s and mu_c.
QUANTITIES = ("mu_0s", "a_s", "b_s", "mu_0c", "a_c", "b_c", "v_s", "sigma_2")


class Law(Strict):
    """Eq. 15 in its identifiable form, mu_0 - a ln(1 + t/b); forces in N where the design has no load."""

    mu_0: float = Field(gt=0, description="unaged rubber")
    a: float = Field(0.0, description="loss per e-fold of time")
    b: float = Field(1.0, gt=0, description="days after which the loss sets in")


class Growth(Strict):
    """How `a` grows with temperature and compression where no series is declared by itself."""

    reference_temperature_C: float = Field(60.0, description="temperature at which `a` is as declared")
    doubling_C: float = Field(40.0, gt=0, description="degrees that double `a`; ten is van 't Hoff's rule for a rate")
    reference_compression_pct: float = Field(80.0, description="compression ratio at which `a` is as declared")
    per_pct: float = Field(0.005, description="relative growth of `a` per percent of height taken away")

    def factor(self, temperature_C, compression_pct):
        """Return the factor on `a`, broadcast over both arguments."""
        thermal = 2.0 ** ((temperature_C - self.reference_temperature_C) / self.doubling_C)
        return thermal * (1.0 + self.per_pct * (self.reference_compression_pct - compression_pct))


class SeriesLaw(Strict):
    """One series declared by itself; what is left out is as in `physics`. mu_0 belongs to the unaged rubber."""

    temperature_C: float | None = None
    compression_ratio_pct: float | None = None
    a_s: float | None = None
    b_s: float | None = Field(None, gt=0)
    a_c: float | None = None
    b_c: float | None = Field(None, gt=0)
    v_s: float | None = Field(None, gt=0)
    sigma_2: float | None = None


class Physics(Strict):
    """The declared model: Eq. 14 with Eq. 15. The defaults are the paper's numbers for 60 degC and 80 %."""

    mu_s: Law = Law(mu_0=0.93513, a=0.04448, b=0.0804)
    mu_c: Law = Law(mu_0=0.609, a=0.03307, b=0.1324)
    v_s: float = Field(5.0, gt=0, description="mm/s")
    sigma_2: float = Field(0.05, description="N s/mm")
    sigma_0: float | None = Field(None, gt=0, description="N/mm; none: every rise is design.stiffness_mm long")
    sigma_1: float = Field(0.0, ge=0, description="N s/mm; only with sigma_0")
    growth: Growth | None = Field(None, description="none: one law for all series")
    series: tuple[SeriesLaw, ...] = ()


def declared_parameters(physics: Physics, conditions: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the declared model's numbers at given conditions, before any effect: `QUANTITIES`, each of shape (n,).

    Parameters
    ----------
    physics : Physics
        The SPEC's.
    conditions : mapping of str to ndarray, shape (n,)
        `temperature_C`, `compression_ratio_pct` and `aging_days`, those that the design has. Unaged rubber (day 0) has
        v_s and sigma_2 of `physics` itself, whatever its temperature cell says.
    """
    n = len(next(iter(conditions.values()))) if conditions else 1
    temperature = conditions.get("temperature_C")
    compression = conditions.get("compression_ratio_pct")
    days = conditions.get("aging_days", np.ones(n))
    values = {
        **{f"{name}_s": np.full(n, getattr(physics.mu_s, name)) for name in ("a", "b")},
        **{f"{name}_c": np.full(n, getattr(physics.mu_c, name)) for name in ("a", "b")},
        "mu_0s": np.full(n, physics.mu_s.mu_0),
        "mu_0c": np.full(n, physics.mu_c.mu_0),
        "v_s": np.full(n, physics.v_s),
        "sigma_2": np.full(n, physics.sigma_2),
    }
    if physics.growth is not None:
        growth = physics.growth
        factor = growth.factor(
            growth.reference_temperature_C if temperature is None else temperature,
            growth.reference_compression_pct if compression is None else compression,
        )
        values["a_s"], values["a_c"] = values["a_s"] * factor, values["a_c"] * factor
    for series in physics.series:
        own = np.asarray(days) > 0
        for wanted, found in ((series.temperature_C, temperature), (series.compression_ratio_pct, compression)):
            if wanted is not None:
                own = own & (found == wanted if found is not None else False)
        for name in ("a_s", "b_s", "a_c", "b_c", "v_s", "sigma_2"):
            value = getattr(series, name)
            if value is not None:
                values[name] = np.where(own, value, values[name])
    return {name: values[name] for name in QUANTITIES}
