"""Claims of closure.json against the hidden effects of a world.

An effect is found where a claim that is no candidate

- stands on the effect's variables, with or without the channels that say where it sits (the direction is free
  for an
  added force), or is its mechanism of several variables, at the effect's level; or
- cannot be told from it with these files: the claim lists the effect's variables among its `alternatives`, or
  a
  smooth function of the claim's channels explains 96 % (correlation 0.98) of what the effect adds beyond the
  declared quantities.

It is named rightly, or honestly left without a name, where the claim says `named: false`, carries one of the
effect's names, or is a closed form (linear, log, bump, ...) of the variable. A claim stands for one effect at
most; claims left over are extra, and are counted apart where they stand on the variable of a true effect.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

SAME = 0.98
KNOTS = 5  # columns of a smooth function of one channel
CLOSED_FORMS = frozenset(
    [
        "linear",
        "quadratic",
        "product",
        "product_log",
        "product_logs",
        "bilinear",
        "bilinear_log",
        "bilinear_logs",
        "log",
        "log_growth",
        "power",
        "exponential_approach",
        "saturation",
        "hyperbolic",
        "step",
        "bump",
        "sinusoid",
        "sinusoid_harmonics",
        "levels",
        "smooth",
    ]
)
NONE, SAME_AT_DESIGN, RIGHT = 0, 1, 2


@dataclass(frozen=True)
class Target:
    """What a hidden effect must be found as."""

    variables: Sequence[str]
    place: Sequence[str]
    levels: Sequence[str]
    names: Sequence[str]
    free_direction: bool  # an added force: with both directions its channels include the direction or not


def on_variables(target: Target, channels: Sequence[str]) -> bool:
    """Return whether channels are the effect's variables, with or without those that say where it sits."""
    claimed, place = set(channels), set(target.place)
    core = set(target.variables)
    free = {"direction"} if target.free_direction or len(core) > 1 else set()
    if core - free or core == {"direction"}:
        core = core - free or core
        return core <= claimed <= core | place | free
    return bool(claimed & place) and claimed <= place | free


def grade(target: Target, claim: Mapping, explained: float) -> int:
    """Return RIGHT, SAME_AT_DESIGN or NONE.

    `explained` is the correlation of a smooth function of the claim's channels.
    """
    several = (
        len(claim["channels"]) > 1
    )  # then the mechanism's variables are fixed: power is v x load, at a time
    own_mechanism = several and claim["id"] in target.names and claim["id"] not in CLOSED_FORMS
    if (own_mechanism or on_variables(target, claim["channels"])) and claim["level"] in target.levels:
        return RIGHT
    listed = any(on_variables(target, a["channels"]) for a in claim.get("alternatives") or ())
    return SAME_AT_DESIGN if listed or explained >= SAME else NONE


def named_rightly(target: Target, claim: Mapping) -> bool:
    """Return whether a claim that found an effect names it rightly or says that it has no name."""
    return not claim["named"] or claim["id"] in target.names or claim["id"] in CLOSED_FORMS


def match(
    targets: Sequence[Target], claims: Sequence[Mapping], explained: np.ndarray
) -> list[tuple[int | None, int]]:
    """Return for each effect the number of its claim (None if not found) and the grade: the best pairing."""
    if not targets or not claims:
        return [(None, NONE)] * len(targets)
    grades = np.array(
        [[grade(t, c, explained[j, k]) for k, c in enumerate(claims)] for j, t in enumerate(targets)]
    )
    # Of several effects of one variable, the claim is for the one that it names.
    names = np.array([[named_rightly(t, c) + 0.1 * (c["id"] in t.names) for c in claims] for t in targets])
    chosen = dict(zip(*linear_sum_assignment(-(grades + 0.1 * names * (grades > 0))), strict=True))
    pairs = [(chosen.get(j), int(grades[j, chosen[j]]) if j in chosen else NONE) for j in range(len(targets))]
    return [(int(k), g) if g else (None, NONE) for k, g in pairs]


def scored(targets: Sequence[Target], claims: Sequence[Mapping], explained: np.ndarray) -> dict:
    """Return what each effect and each claim came to: `effects`, `extra` and `extra_on_true_variable`."""
    pairs = match(targets, claims, explained)
    found = []
    for target, (k, own) in zip(targets, pairs, strict=True):
        claim = claims[k] if k is not None else None
        found.append(
            {
                "grade": own,
                "claimed_id": claim and claim["id"],
                "claim_named": bool(claim and claim["named"]),
                "named_rightly": bool(claim and named_rightly(target, claim)),
            }
        )
    left = [c for k, c in enumerate(claims) if k not in {k for k, _ in pairs}]
    near = sum(any(set(c["channels"]) & {*t.variables, *t.place} for t in targets) for c in left)
    return {"effects": found, "extra": len(left), "extra_on_true_variable": int(near)}


def explained_by(
    values: Mapping[str, np.ndarray], y: np.ndarray, others: np.ndarray, scale: np.ndarray
) -> float:
    """Return the correlation of `y` with the best smooth function of some channels, beyond `others`.

    Parameters
    ----------
    values : mapping of str to ndarray, shape (n,)
        The channels, numbers or texts.
    y : ndarray, shape (n,)
        What an effect adds, weighted.
    others : ndarray, shape (n, k)
        What else may explain it (the declared quantities, the other effects), weighted.
    scale : ndarray, shape (n, m)
        What the smooth function is multiplied with: the weights for an added force, weights times the force
        for a gain.
    """
    basis = np.ones((y.size, 1))
    for value in values.values():
        basis = (basis[:, :, None] * _smooth(value)[:, None, :]).reshape(y.size, -1)
    columns = np.hstack([basis * s[:, None] for s in scale.T])
    u = _span(np.hstack([others, scale]))  # a constant is no function of these channels
    left = y - u @ (u.T @ y)
    columns = columns - u @ (u.T @ columns)
    v = _span(columns)
    total = float(left @ left)
    if total <= 1e-12 * float(y @ y) or v.shape[1] == 0:
        return 0.0
    return float(np.sqrt(min(1.0, float(((v.T @ left) ** 2).sum()) / total)))


def _smooth(value: np.ndarray) -> np.ndarray:
    """Return a few smooth columns of a channel, or one per category."""
    if value.dtype.kind not in "fi":
        return (value[:, None] == np.unique(value.astype(str))[None, :8]).astype(float)
    low, high = np.nanmin(value), np.nanmax(value)
    if low > 0 and high / low >= 20:
        value, low, high = np.log(value), np.log(low), np.log(high)
    x = 2 * (value - low) / max(high - low, 1e-300) - 1
    degree = min(KNOTS - 1, np.unique(np.round(x, 6)).size - 1)
    return np.polynomial.chebyshev.chebvander(x, max(degree, 0))


def _span(x: np.ndarray) -> np.ndarray:
    size = np.linalg.norm(x, axis=0)
    x = x[:, size > 1e-9 * max(size.max(initial=0.0), 1e-300)]
    if not x.shape[1]:
        return np.zeros((x.shape[0], 0))
    u, s, _ = np.linalg.svd(x / np.linalg.norm(x, axis=0), full_matrices=False)
    return u[:, s > 1e-6 * s[0]]
