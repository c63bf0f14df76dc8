"""The friction law of a world: a condition's declared coefficients, and what hidden effects make of them."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import TYPE_CHECKING

import numpy as np

from worlds.effects import change

if TYPE_CHECKING:
    from worlds.world import World

SLOWEST_SHARE = (
    0.01  # effects of the logarithm of speed stop changing below this share of the slowest tested speed
)
QUANTITIES = ("mu_0s", "mu_0c", "a_s", "a_c", "b_s", "b_c", "v_s", "sigma_2")


def parameters(
    world: World,
    channels: Mapping[str, np.ndarray],
    *,
    without: Collection[int] = (),
    nudge: Mapping[str, float] | None = None,
) -> dict[str, np.ndarray]:
    """Return mu_s, mu_c, v_s, sigma_2, the factor on the whole force and the added force at given channels.

    Parameters
    ----------
    world : World
        Its series and effects.
    channels : mapping of str to ndarray
        `series` (number of the series), `aging_days`, `speed_mm_s` (magnitude), `direction`, and whatever the
        effects read; arrays that broadcast.
    without : collection of int
        Numbers of effects left out.
    nudge : mapping of str to float, optional
        Relative changes of declared quantities (`QUANTITIES`).
    """
    nudge = nudge or {}
    number = np.asarray(channels["series"], dtype=int)
    own = {q: np.array([s[q] for s in world.series])[number] * (1 + nudge.get(q, 0.0)) for q in QUANTITIES}
    floor = SLOWEST_SHARE * world.speeds_mm_s[0]
    given = {**channels, "speed_mm_s": np.maximum(np.abs(channels["speed_mm_s"]), floor)}
    factor = dict.fromkeys(("mu", "mu_s", "mu_c", "v_s", "sigma_2", "force"), 1.0)
    added = dict.fromkeys(factor, 0.0)
    for k, effect in enumerate(world.effects):
        if k in without:
            continue
        if effect.operation == "multiply":
            factor[effect.acts_on] = factor[effect.acts_on] * (1 + change(effect, given))
        else:
            added[effect.acts_on] = added[effect.acts_on] + change(effect, given)
    days = np.asarray(channels["aging_days"], dtype=float)
    mu = {
        end: (own[f"mu_0{end}"] - own[f"a_{end}"] * np.log1p(days / own[f"b_{end}"])) * factor[f"mu_{end}"]
        + added[f"mu_{end}"]
        for end in "sc"
    }
    return {
        "mu_s": mu["s"] * factor["mu"] + added["mu"],
        "mu_c": mu["c"] * factor["mu"] + added["mu"],
        "v_s": own["v_s"] * factor["v_s"] + added["v_s"],
        "sigma_2": own["sigma_2"] * factor["sigma_2"] + added["sigma_2"],
        "factor": factor["force"],
        "added_N": added["force"],
    }


def quasi_steady_N(world: World, channels: Mapping[str, np.ndarray], **more) -> np.ndarray:
    """Return the signed force of settled bristles: only to scale effects, never a campaign's force."""
    p = parameters(world, channels, **more)
    speed = np.abs(channels["speed_mm_s"])
    mu = p["mu_c"] + (p["mu_s"] - p["mu_c"]) * np.exp(-((speed / p["v_s"]) ** 2))
    return (
        channels["direction"] * (mu * channels["load_N"] + p["sigma_2"] * speed) * p["factor"] + p["added_N"]
    )
