"""The suite of invariances: its own parts by hand, and a short form of it on small campaigns."""

import numpy as np
import pandas as pd
import pytest
from invariances import CHANGES, Campaign, Change, campaign, closed, factor, moves

from sealfit.config import parse_config

EFFECT = {
    "id": "ripple", "channels": ["displacement_mm"], "acts_on": "force", "operation": "add", "named": True,
    "candidate": False,
    "parameters": [
        {"name": "A", "value": 0.5, "ci95": [0.304, 0.696], "unit": "N"},
        {"name": "lambda", "value": 5.0, "ci95": [4.9, 5.1], "unit": "mm"},
        {"name": "phi", "value": 0.7, "ci95": [0.6, 0.8], "unit": "rad"},
    ],
}  # fmt: skip
AS_IS = Change(lambda given, rng: given)


def closure(*effects, verdict="closed"):
    return {"verdict": verdict, "effects": list(effects)}


def with_values(**values):
    changed = [{**p, **values.get(p["name"], {})} for p in EFFECT["parameters"]]
    return {**EFFECT, "parameters": changed}


# ---------------------------------------------------------------- the parts
@pytest.mark.parametrize(
    ("unit", "value"),
    [("", 1), ("N", 1), ("mN", 1e-3), ("N s/mm", 1e3), ("1/mm", 1e3), ("N/(mm/s)", 1e3), ("mm/ms", 1), ("rad", 1)],
)
def test_units_by_hand(unit, value):
    assert factor(unit) == pytest.approx(value)


def test_what_moved_is_said():
    assert moves(closure(EFFECT), closure(EFFECT), AS_IS) == []
    assert moves(closure(EFFECT), closure(verdict="nothing_missing"), AS_IS) == [
        "verdict closed -> nothing_missing",
        "lost ripple(displacement_mm) add force",
    ]
    # the standard error of A is 0.1 N
    assert moves(closure(EFFECT), closure(with_values(A={"value": 0.509})), AS_IS) == []
    assert moves(closure(EFFECT), closure(with_values(A={"value": 0.52})), AS_IS) == ["ripple A by 0.2 se"]


def test_numbers_are_compared_after_units_shifts_and_mirrors():
    milli = with_values(A={"value": 500.0, "unit": "mN"}, **{"lambda": {"value": 5e-3, "unit": "m"}})
    assert moves(closure(EFFECT), closure(milli), AS_IS) == []
    turned = with_values(phi={"value": 0.7 - 2 * np.pi * 1.5 / 5.0 + 2 * np.pi})
    assert moves(closure(EFFECT), closure(turned), Change(AS_IS.make, shift_mm=1.5)) == []
    assert moves(closure(EFFECT), closure(turned), AS_IS) != []
    mirrored = with_values(A={"value": -0.5}, phi={"value": 2.0})
    assert moves(closure(EFFECT), closure(mirrored), Change(AS_IS.make, mirrored=True)) == []


def test_a_copy_counts_as_the_column():
    own, copy = ({**EFFECT, "channels": [name]} for name in ("oil_ppm", "oil_ppm_again"))
    assert moves(closure(own), closure(copy), CHANGES["copied_column"]) == []
    assert moves(closure(own), closure(copy), AS_IS) != []


@pytest.mark.parametrize("name", CHANGES)
def test_every_change_leaves_a_campaign_that_its_config_reads(name):
    runs = pd.DataFrame(
        {"file": [f"f{k}.csv" for k in range(4)], "speed_mm_s": 5.0, "load_N": 50.0, "oil_ppm": [1.0, 2.0, 3.0, 4.0]}
    )
    trace = pd.DataFrame({"time_s": [0.0, 0.1], "displacement_mm": [1.0, 1.5], "force_N": [20.0, 21.0]})
    given = Campaign(runs, dict.fromkeys(runs["file"], trace), "")
    made = CHANGES[name].make(given, np.random.default_rng(0))
    assert set(made.runs["file"]) == set(made.traces)
    config = parse_config(made.config, name)
    changed = not made.runs.equals(runs) or made.config != "" or any(not t.equals(trace) for t in made.traces.values())
    assert changed
    assert (config.trace.compute != {}) == name.endswith("_turned")
    assert runs["speed_mm_s"].tolist() == [5.0] * 4  # the campaign as it was is let be


# ---------------------------------------------------------------- the short form
SHORT = ("jitter_time_1e-6", "jitter_commanded_1e-3", "renamed", "mN", "ms", "serial_number")


def test_claims_do_not_hang_on_what_does_not_matter():
    given = campaign("short")
    before = closed(given)
    assert [effect["id"] for effect in before["effects"]] == ["ripple"]
    moved = {
        change: moves(before, closed(CHANGES[change].make(given, np.random.default_rng(5))), CHANGES[change])
        for change in SHORT
    }
    assert {change: what for change, what in moved.items() if what} == {}
