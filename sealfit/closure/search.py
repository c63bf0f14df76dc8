"""Does any channel order the residual? Free shapes of every channel, on every quantity they may act on."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from sealfit.closure.channels import (
    CALENDAR,
    FEW_DF,
    FINE_DF,
    FINE_UNITS,
    FINER,
    FREE_DF,
    Channel,
    flip_level,
    free_columns,
    kinks,
    scatter_level,
    unit_of,
)
from sealfit.closure.multiplicity import judged
from sealfit.closure.score_test import JACKKNIFE_UNITS, Candidate, ScoreTests
from sealfit.fit.estimate import Fitted
from sealfit.fit.rows import POWER, Rows

TARGETS = (
    ("mu", "multiply"),
    ("force", "add"),
    ("force", "multiply"),
    ("mu_s", "multiply"),
    ("mu_c", "multiply"),
    ("v_s", "multiply"),
    ("sigma_2", "add"),
    ("a", "multiply"),
    ("b", "multiply"),
)
MOST_NUMBERS = 1 << 22  # of columns on all rows that are projected at once: 34 MB
MAIN_TARGETS = (("mu", "multiply"), ("force", "add"))


def search(judge: ScoreTests, channels: Sequence[Channel], rng: np.random.Generator) -> list[Candidate]:
    """Return every candidate with its adjusted p-value, strongest evidence first.

    Parameters
    ----------
    judge : Judge
        Of the current model.
    channels : sequence of Channel
        Where to look.
    rng : Generator
        For the sign flips.
    """
    candidates = [c for channel in channels for c in of_channel(judge, channel)]
    return judged(judge, candidates, rng) if candidates else []


def of_channel(judge: ScoreTests, channel: Channel) -> Iterator[Candidate]:
    """Yield the candidates of one channel, not adjusted for any search."""
    rows = judge.fitted.rows
    if channel.name == "direction":
        yield from _of_shapes(judge, channel, np.ones((rows.force.size, 1)), TARGETS)
        return
    few = channel.numeric and channel.unit == "specimen" and rows.groups.starts["specimen"].size < JACKKNIFE_UNITS
    shapes = free_columns(channel, FEW_DF if few else FREE_DF)
    widths = (1, shapes.shape[1]) if channel.numeric else (shapes.shape[1],)
    yield from _of_shapes(judge, channel, shapes, TARGETS, widths)
    if few:
        for kink in kinks(channel).T:
            yield from _of_shapes(judge, channel, kink[:, None], MAIN_TARGETS)
    units = rows.groups.starts[flip_level(channel.unit, rows)].size
    fine = channel.numeric and channel.name not in CALENDAR and units >= FINE_UNITS
    if fine and np.unique(channel.values).size > 2 * FINE_DF:
        yield from _of_shapes(judge, channel, free_columns(channel, FINE_DF), MAIN_TARGETS)


def _of_shapes(
    judge: ScoreTests,
    channel: Channel,
    shapes: np.ndarray,
    targets: Sequence[tuple[str, str]],
    widths: Sequence[int] = (),
) -> Iterator[Candidate]:
    """Yield the candidates of a channel's columns, by the first so many of them, on every target that may take them."""
    fitted, rows = judge.fitted, judge.fitted.rows
    both_ways = rows.speed.min() < 0 < rows.speed.max()
    slopes, places = [], []
    for acts_on, operation in targets:
        if not (_allowed(channel, acts_on, operation, both_ways) and _declared(fitted, acts_on)):
            continue
        if channel.name in ("speed_mm_s", POWER) and "full" not in fitted.model.declared.stribeck.values():
            continue  # too few speeds to know the Stribeck curve: what depends on speed may be just that
        slope = fitted.slope(acts_on, operation)
        if np.abs(slope).max() <= 0:
            continue
        own = shapes
        if channel.name == "direction" and acts_on != "force":
            own = channel.values[:, None] / 2
        slopes.append(own * slope[:, None])
        places.append((acts_on, operation, own))
    if not slopes:
        return
    together = max(1, MOST_NUMBERS // shapes.size)
    variants: tuple[np.ndarray, ...] = ()
    for number, (acts_on, operation, own) in enumerate(places):
        if number % together == 0:
            variants = judge.variants(np.column_stack(slopes[number : number + together]), channel.unit)
        first = number % together * own.shape[1]
        unit = channel.unit
        names = (channel.name,)
        unsigned = both_ways and (acts_on, operation) == ("force", "add") and channel.name != "direction"
        if unsigned and FINER[channel.unit] > FINER["stroke"]:  # it shows only between directions
            names = ("direction", channel.name)
            unit = min(unit, _direction_unit(rows), key=FINER.get)
        level = flip_level(unit, rows)
        between = level if channel.grouping else scatter_level([channel], rows)
        for width in dict.fromkeys(widths or (own.shape[1],)):
            test_result = judge([v[:, first : first + width] for v in variants], between, level, (acts_on, operation))
            if test_result is not None:
                yield Candidate(names, acts_on, operation, level, own[:, :width], test_result)


def _direction_unit(rows: Rows) -> str:
    return unit_of(np.sign(rows.speed), rows)


def _declared(fitted: Fitted, acts_on: str) -> bool:
    """Whether the declared model holds the quantity here; mu_c alone is mu where no Stribeck curve is fitted."""
    needs = {"mu_s": "v_s", "mu_c": "v_s", "v_s": "v_s", "sigma_2": "sigma_2", "a": "a_c", "b": "b_c"}.get(acts_on)
    return needs is None or bool((fitted.model.declared.index[needs] >= 0).any())


def _allowed(channel: Channel, acts_on: str, operation: str, both_ways: bool) -> bool:
    if channel.name == "direction":
        return both_ways
    if channel.grouping:
        return both_ways and (acts_on, operation) == ("force", "add")
    if channel.name == "speed_mm_s":
        return acts_on in ("mu", "a")  # mu_s, mu_c, v_s and sigma_2 are themselves the dependence on speed
    return not (channel.name == "load_N" and acts_on == "force")
