"""Claims of closure.json against the truth: which true effects were found, which claims match none.

An effect is found strictly where a claim has the same channels (as sets, direction included where it counts),
level, acts_on and operation. It is found leniently also where

- channels and level are the same, and what claim and truth add to the force has a correlation of at least
  0.98 after
  projection on the declared model's tangent space (two such are one effect at this design), or the claim
  names the truth's acts_on with these channels among its `alternatives`; mu and the whole friction force are
  so exchanged where sigma_2 v is a small part; or
- that correlation is reached with other channels, and the claim names the truth's channels among its
  `alternatives`.

Named right is a found effect whose claim has the true id, when the catalogue has it; leniently also one whose
claim is the same equation of the same channel under another id (`SAME_EQUATION`). Each claim stands for one
true effect at most; claims left over are extra. Of those, a claim on exactly the channels of a true effect
that was not found is called misplaced (the right place, the wrong quantity or form), and counts as extra all
the same.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import permutations

import numpy as np

SAME = 0.98
SAME_EQUATION = {
    ("product", "bilinear"),  # about another centre
    ("drift", "linear"),
    ("campaign_drift", "linear"),
    ("lab_temperature", "linear"),
    ("humidity", "linear"),
    ("load_exponent", "log"),
    ("log_rate", "log"),
    ("ripple", "sinusoid"),
    ("rest_strengthening", "log_growth"),
    ("stribeck_speed_aging", "log_growth"),
    ("viscosity_aging", "log_growth"),
    ("warming_time", "exponential_approach"),
    ("warming_distance", "exponential_approach"),
}
NONE, LENIENT, STRICT = 0, 1, 2


@dataclass(frozen=True)
class Target:
    """What a true effect must be found as."""

    id: str
    channels: Sequence[str]
    level: str
    acts_on: str
    operation: str
    catalogued: bool = True


def grade(target: Target, claim: Mapping, correlation: float) -> int:
    """Return how well a claim matches a true effect: STRICT, LENIENT or NONE."""
    same_place = set(claim["channels"]) == set(target.channels) and claim["level"] == target.level
    if same_place and (claim["acts_on"], claim["operation"]) == (target.acts_on, target.operation):
        return STRICT
    others = claim["alternatives"]
    listed = [a for a in others if set(a["channels"]) == set(target.channels)]
    if same_place and (correlation >= SAME or any(a["acts_on"] == target.acts_on for a in listed)):
        return LENIENT
    return LENIENT if correlation >= SAME and listed else NONE


def match(
    targets: Sequence[Target], claims: Sequence[Mapping], correlation: np.ndarray
) -> list[tuple[int | None, int]]:
    """Return for each true effect its claim's number (None if not found) and the grade; the best pairing.

    Parameters
    ----------
    targets : sequence of Target
        The true effects, three or so.
    claims : sequence of mapping
        closure.json's `effects`.
    correlation : ndarray, shape (targets, claims)
        Of what they add to the force, projected.
    """
    grades = np.array(
        [[grade(t, c, correlation[j, k]) for k, c in enumerate(claims)] for j, t in enumerate(targets)]
    )
    slots = [*range(len(claims)), *[None] * len(targets)]
    best, most = [(None, NONE)] * len(targets), (-1.0, -1.0)
    for chosen in set(permutations(slots, len(targets))) if len(slots) <= 9 else [_greedy(grades)]:
        pairs = [(k, int(grades[j, k])) if k is not None else (None, NONE) for j, k in enumerate(chosen)]
        pairs = [(k, g) if g > NONE else (None, NONE) for k, g in pairs]
        named = sum(k is not None and claims[k]["id"] == targets[j].id for j, (k, _) in enumerate(pairs))
        score = (float(sum(g for _, g in pairs)), float(named))
        if score > most:
            best, most = pairs, score
    return best


def _greedy(grades: np.ndarray) -> list[int | None]:
    taken: list[int | None] = []
    for row in grades:
        order = [k for k in np.argsort(-row, kind="stable") if k not in taken and row[k] > NONE]
        taken.append(int(order[0]) if order else None)
    return taken


def named_right(target: Target, claim: Mapping | None) -> tuple[bool, bool]:
    """Return whether a found effect has its true name, strictly and leniently."""
    if claim is None:
        return False, False
    strict = claim["id"] == target.id
    return strict, strict or (target.id, claim["id"]) in SAME_EQUATION


def misplaced(targets: Sequence[Target], found: Sequence[int | None], claims: Sequence[Mapping]) -> list[int]:
    """Return the extra claims on channels of a true effect that was not found, one for each such effect."""
    free = [k for k in range(len(claims)) if k not in found]
    chosen = []
    for target, own in zip(targets, found, strict=True):
        if own is None:
            here = [k for k in free if set(claims[k]["channels"]) == set(target.channels) and k not in chosen]
            chosen += here[:1]
    return chosen


def correlations(true_columns: np.ndarray, claim_columns: np.ndarray) -> np.ndarray:
    """Return |correlation| of projected columns, (n, t) with (n, c) -> (t, c)."""
    size = np.linalg.norm(true_columns, axis=0)[:, None] * np.linalg.norm(claim_columns, axis=0)[None, :]
    product = np.abs(true_columns.T @ claim_columns)
    return np.divide(product, size, out=np.zeros_like(product), where=size > 0)
