"""The suite of invariances: its own parts by hand, and a short form of it on small campaigns."""

import json
import subprocess

import invariances
import numpy as np
import pandas as pd
import pytest
from commit import build, newest_commit
from invariances import CHANGES, Campaign, Change, campaign, closed, factor, in_proportion, moved_by, moves

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


def closure(*effects, verdict="closed", after=0.1):
    return {
        "verdict": verdict,
        "effects": list(effects),
        "before": {"rmse_N": 0.5},
        "after": {"rmse_N": after},
    }


def with_values(**values):
    changed = [{**p, **values.get(p["name"], {})} for p in EFFECT["parameters"]]
    return {**EFFECT, "parameters": changed}


# ---------------------------------------------------------------- the parts
@pytest.mark.parametrize(
    ("unit", "value"),
    [
        ("", 1),
        ("N", 1),
        ("mN", 1e-3),
        ("N s/mm", 1e3),
        ("1/mm", 1e3),
        ("N/(mm/s)", 1e3),
        ("mm/ms", 1),
        ("rad", 1),
    ],
)
def test_units_by_hand(unit, value):
    assert factor(unit) == pytest.approx(value)


def test_what_moved_is_said():
    assert moves(closure(EFFECT), closure(EFFECT), AS_IS) == []
    assert moves(closure(EFFECT), closure(verdict="nothing_missing"), AS_IS) == [
        "verdict closed -> nothing_missing",
        "lost ripple(displacement_mm) add force",
    ]
    assert moves(closure(EFFECT), closure(EFFECT, after=0.2), AS_IS) == ["error after over before 0.2 -> 0.4"]
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


def test_a_jitter_ten_times_as_large_moves_numbers_ten_times_as_far():
    closures = [
        closure(with_values(A={"value": a}, phi={"value": phi})) for a, phi in ((0.5, 3.1), (0.51, -3.1))
    ]
    (moved,) = in_proportion(*closures)["effects"]
    assert [p["value"] for p in moved["parameters"]] == pytest.approx(
        [0.6, 5.0, 3.1 + 10 * (2 * np.pi - 6.2)]
    )


def test_fewer_data_move_numbers_by_chance():
    # Half of one of five runs: 3 sqrt(0.1 / 0.9) = 1 standard error, 0.1 N.
    for value, what in ((0.59, []), (0.61, ["ripple A by 1.1 se"])):
        closures = {"as it is": closure(EFFECT), "half_rate": closure(with_values(A={"value": value}))}
        assert moved_by("half_rate", closures, runs=5) == what


def test_a_copy_counts_as_the_column():
    own, copy = ({**EFFECT, "channels": [name]} for name in ("oil_ppm", "oil_ppm_again"))
    assert moves(closure(own), closure(copy), CHANGES["copied_column"]) == []
    assert moves(closure(own), closure(copy), AS_IS) != []


@pytest.mark.parametrize("name", CHANGES)
def test_every_change_leaves_a_campaign_that_its_config_reads(name):
    runs = pd.DataFrame(
        {
            "file": [f"f{k}.csv" for k in range(4)],
            "speed_mm_s": 5.0,
            "load_N": 50.0,
            "oil_ppm": [1.0, 2.0, 3.0, 4.0],
        }
    )
    time = np.linspace(0.0, 2.0, 201)
    place = 11.0 - np.abs(10.0 * time - 10.0)  # there and back
    trace = pd.DataFrame(
        {"time_s": time, "displacement_mm": place, "force_N": np.where(time < 1.0, 20.0, -20.0)}
    )
    given = Campaign(runs, dict.fromkeys(runs["file"], trace), "")
    made = CHANGES[name].make(given, np.random.default_rng(0))
    assert set(made.runs["file"]) == set(made.traces)
    config = parse_config(made.config, name)
    changed = (
        not made.runs.equals(runs)
        or made.config != ""
        or any(not t.equals(trace) for t in made.traces.values())
    )
    assert changed
    assert (config.trace.compute != {}) == name.endswith("_turned")
    assert runs["speed_mm_s"].tolist() == [5.0] * 4  # the campaign as it was is let be


# ---------------------------------------------------------------- one build a table
def test_a_build_is_its_commit_and_what_differs_from_it(tmp_path):
    def git(*words):
        who = ("-c", "user.name=n", "-c", "user.email=e@example.org", "-c", "commit.gpgsign=false")
        subprocess.run(["git", "-C", tmp_path, *who, *words], check=True, capture_output=True)

    git("init")
    code = tmp_path / "fit.py"
    code.write_text("a = 1\n")
    (tmp_path / "README.md").write_text("one\n")
    git("add", ".")
    git("commit", "-m", "first")
    first = build(tmp_path)
    assert first == newest_commit(tmp_path)
    (tmp_path / "README.md").write_text("two\n")
    assert build(tmp_path) == first
    code.write_text("a = 2\n")
    second = build(tmp_path)
    code.write_text("a = 3\n")
    assert len({first, second, build(tmp_path)}) == 3
    assert second.startswith(first + "+")
    code.write_text("a = 1\n")
    assert build(tmp_path) == first
    (tmp_path / "new.py").write_text("b = 1\n")
    assert build(tmp_path) != first


def test_pairs_of_another_build_are_run_again(tmp_path, monkeypatch, capsys):
    ran = []
    monkeypatch.setattr(
        invariances, "closed", lambda given: ran.append(given) or closure(verdict="nothing_missing")
    )
    out = tmp_path / "pairs.jsonl"
    asked = ["--campaigns", "short", "--changes", "renamed", "--out", str(out)]
    for own, runs in (("one", 2), ("one", 2), ("two", 4)):
        monkeypatch.setattr(invariances, "build", lambda own=own: own)
        assert invariances.main(asked) == 0
        assert len(ran) == runs
        assert capsys.readouterr().out.startswith(f"build {own}\n")
    assert [json.loads(line)["build"] for line in out.read_text().splitlines()] == ["one"] * 2 + ["two"] * 2


# ---------------------------------------------------------------- the short form
SHORT = {
    "short": ("jitter_time_1e-6", "jitter_position_1e-4", "jitter_position_1e-3", "jitter_samples_1e-6",
              "jitter_commanded_1e-3", "renamed", "mN", "ms", "serial_number"),
    "there_and_back": ("split", "jitter_time_1e-3"),
}  # fmt: skip


@pytest.mark.parametrize(
    ("name", "effect"),
    [pytest.param("short", "ripple", marks=pytest.mark.long), ("there_and_back", "zero_offset")],
)
def test_claims_do_not_hang_on_what_does_not_matter(name, effect):
    given = campaign(name).told(loop={"folds": 2})
    changed = {change: CHANGES[change].make(given, np.random.default_rng(5)) for change in SHORT[name]}
    closures = {change: closed(made) for change, made in {"as it is": given, **changed}.items()}
    assert [found["id"] for found in closures["as it is"]["effects"]] == [effect]
    moved = {change: moved_by(change, closures, given.runs["run_id"].nunique()) for change in SHORT[name]}
    assert {change: what for change, what in moved.items() if what} == {}
