import math
from pathlib import Path

import numpy as np
import numpy.testing as npt
import pandas as pd
import pytest
from simulation_helpers import ONE_CONDITION, POINT, effect, mean_forces, steady
from truths import true_force

from sealfit.effects import EFFECTS
from sealfit.effects.contract import Effect, Parameter
from sealfit.errors import ConfigError, RequestError
from sealfit.simulation import Spec, simulate

STIFF = 1e9  # N/mm: bristles so short that the force is that of steady sliding


@pytest.mark.parametrize(
    ("acts_on", "operation", "shape", "by_hand"),
    [
        # One load, 100 N; mu_s 0.8, mu_c 0.6, v_s 5, sigma_2 0.1; v = 5: the decay is 1/e.
        ("force", "add", 3.0, 60 + 20 / math.e + 0.5 + 3),
        ("force", "multiply", 0.1, (60 + 20 / math.e + 0.5) * 1.1),
        ("mu", "multiply", 0.1, (60 + 20 / math.e) * 1.1 + 0.5),
        ("mu", "add", 0.05, 60 + 20 / math.e + 5 + 0.5),
        ("mu_s", "add", 0.1, 60 + 30 / math.e + 0.5),
        ("mu_c", "multiply", 0.1, 66 + 14 / math.e + 0.5),
        ("v_s", "multiply", 1.0, 60 + 20 * math.exp(-0.25) + 0.5),
        ("sigma_2", "add", 0.2, 60 + 20 / math.e + 1.5),
        ("mu_0", "add", -0.1, 50 + 20 / math.e + 0.5),
    ],
)
def test_every_target_by_hand(campaign, acts_on, operation, shape, by_hand):
    physics = {"mu_s": {"mu_0": 0.8}, "mu_c": {"mu_0": 0.6}, "v_s": 5.0, "sigma_2": 0.1, "sigma_0": STIFF}
    design = {**ONE_CONDITION, "loads_N": (100.0,), "speeds_mm_s": (5.0,)}
    truth, runs, traces = campaign(
        physics=physics, design=design, effects=[effect(str(shape), acts_on, operation)]
    )
    assert mean_forces(runs, traces)[5.0] == pytest.approx(by_hand, abs=1e-6)
    assert truth["runs"][0]["mean_force_N"] == pytest.approx(by_hand, abs=1e-6)
    assert truth["effects"][0]["rms_N"] == pytest.approx(abs(by_hand - (60 + 20 / math.e + 0.5)), abs=1e-6)


@pytest.mark.parametrize(("acts_on", "shape"), [("a", 1.0), ("b", -0.5)])
def test_aging_parameters_change_both_coefficients(campaign, acts_on, shape):
    physics = {
        "mu_s": {"mu_0": 0.9, "a": 0.04, "b": 0.1},
        "mu_c": {"mu_0": 0.6, "a": 0.03, "b": 0.2},
        "sigma_2": 0.0,
    }
    design = {
        "days": (4.0,),
        "unaged": False,
        "speeds_mm_s": (0.001, 50.0),
        "repeats": 1,
        "loads_N": (100.0,),
    }
    _, runs, traces = campaign(
        physics=physics, design=design, effects=[effect(str(shape), acts_on, "multiply")]
    )
    force = mean_forces(runs, traces)
    a, b = (1 + shape, 1.0) if acts_on == "a" else (1.0, 1 + shape)
    assert force[0.001] == pytest.approx(90 - 4 * a * math.log1p(4 / (0.1 * b)), abs=1e-5)
    assert force[50.0] == pytest.approx(60 - 3 * a * math.log1p(4 / (0.2 * b)), abs=1e-5)


def test_order_of_application_parameters_mu_force_added(campaign):
    effects = [
        effect("2", "force", "add"),
        effect("0.1", "force", "multiply"),
        effect("0.2", "mu", "multiply"),
    ]
    physics = {"mu_s": {"mu_0": 0.5}, "mu_c": {"mu_0": 0.5}, "sigma_2": 0.1, "sigma_0": STIFF}
    design = {**ONE_CONDITION, "loads_N": (100.0,), "speeds_mm_s": (10.0,)}
    _, runs, traces = campaign(
        physics=physics, design=design, effects=[*effects, effect("0.1", "mu_c", "add")]
    )
    # mu_c 0.6 and e^-4 of the difference; * 1.2, + 0.1 * 10, * 1.1, + 2.
    mu = 0.6 - 0.1 * math.exp(-4)
    assert mean_forces(runs, traces)[10.0] == pytest.approx((100 * mu * 1.2 + 1.0) * 1.1 + 2, abs=1e-6)


def test_truth_agrees_with_the_written_traces_at_every_steady_sample(campaign):
    truth, runs, traces = campaign(
        design={
            **ONE_CONDITION,
            "days": (2.0, 8.0),
            "directions": (1, -1),
            "repeats": 2,
            "specimens": 2,
            "loads_N": (20.0, 50.0),
            "start_scatter_mm": 1.0,
        },
        physics={"sigma_0": STIFF},
        channels=[
            {"kind": "numeric", "name": "humidity_pct", "level": "run", "mean": 50, "sd": 8},
            {
                "kind": "category",
                "name": "batch",
                "level": "specimen",
                "labels": ["A", "B"],
                "assignment": "balanced",
            },
            {"kind": "trace", "name": "oil_C", "mean": 30, "sd": 2},
        ],
        effects=[
            effect("0.06 * exp(-distance_mm / 10)", "mu", "multiply"),
            effect("0.3 * sin(2 * pi * displacement_mm / 4)"),
            effect("0.1 * time_s + 0.2 * direction"),
            effect("0.002 * (humidity_pct - 50) * (oil_C - 30)", "mu_c"),
            effect("-0.05 * log(repeat)", "force", "multiply"),
            effect("0.01 * elapsed_h + 0.001 * run_order"),
            {
                "id": "levels",
                "channels": ["batch"],
                "acts_on": "mu",
                "operation": "multiply",
                "parameters": {"B": 0.1},
            },
        ],
    )
    tried = 0
    for row in runs.itertuples():
        points = steady(traces[row.file])
        start = row.started_at
        points = points.assign(
            **{name: getattr(row, name) for name in runs.columns if name not in points},
        )
        points["speed_mm_s"] = row.speed_mm_s * (1 if "fwd" in row.run_id else -1)
        begin = traces[row.file]["displacement_mm"].iloc[0]
        points["distance_mm"] = (points["displacement_mm"] - begin).abs()
        started = pd.to_datetime(runs["started_at"])
        points["elapsed_h"] = (pd.Timestamp(start) - started.min()).total_seconds() / 3600
        points["run_order"] = (started <= pd.Timestamp(start)).sum()
        # What is left of the pre-sliding rise after 5 mm of 0.1 mm is nothing; displacement is rounded to 5
        # digits.
        npt.assert_allclose(points["force_N"], true_force(truth, points), atol=2e-5)
        tried += len(points)
    assert tried > 10_000


def test_catalogue_effects_are_resolved_with_their_shapes(campaign, monkeypatch):
    halving = Effect(
        id="halving",
        label="halving with {x}",
        equation="h = A 2^(-x/h)",
        reads=("x", "load_N"),
        acts_on=(("mu", "multiply"), ("force", "add")),
        parameters=(
            Parameter("A", "", 0.1, (-1.0, 1.0), "amplitude", linear=True),
            Parameter("h", "{x}", 1.0, (0.1, 100.0), "half-length"),
        ),
        shape=lambda inputs, *, A, h: A * 2 ** (-inputs["x"] / h) * inputs["load_N"] / inputs["load_N_ref"],
        source="test",
        worked=({"x": 1.0, "load_N": 2.0}, {"A": 1.0, "h": 1.0}, 1.0),
    )
    monkeypatch.setitem(EFFECTS, "halving", halving)
    entry = {"id": "halving", "channels": ["distance_mm", "load_N"], "parameters": {"A": 0.2, "h": 10.0}}
    entry["reference"] = {"load_N_ref": 25.0}
    physics = {"mu_s": {"mu_0": 0.5}, "mu_c": {"mu_0": 0.5}, "sigma_2": 0.0, "sigma_0": STIFF}
    design = {**ONE_CONDITION, "loads_N": (50.0,)}
    truth, _, _ = campaign(physics=physics, design=design, effects=[entry])
    assert truth["effects"][0]["acts_on"] == "mu"
    points = pd.DataFrame(
        {"temperature_C": 23.0, "compression_ratio_pct": 100.0, "aging_days": 0.0, "speed_mm_s": -5.0},
        index=[0, 1],
    )
    points["distance_mm"] = [10.0, 20.0]
    npt.assert_allclose(true_force(truth, points), [-25 * 1.2, -25 * 1.1], atol=1e-9)
    for change, words in (
        ({"id": "no_such"}, "no such effect"),
        ({"channels": ["distance_mm"]}, "reads 2 channels, 1 given"),
        ({"channels": []}, "channel of your choice"),
        ({"parameters": {"A": 0.2}}, "parameter 'h' is missing"),
        ({"parameters": {"A": 0.2, "h": 1000.0}}, "Give 0.1 to 100"),
        ({"parameters": {"A": 0.2, "h": 1.0, "q": 1.0}}, "no parameter 'q'"),
        ({"reference": {"load_ref": 1.0}}, "no reference 'load_ref'.*load_N_ref"),
        ({"acts_on": "v_s"}, "cannot act on v_s.*acts on mu by multiply"),
    ):
        with pytest.raises(ConfigError, match=words):
            simulate(Spec(effects=[{**entry, **change}]), Path("never-written"))


FREELY = {"x": "distance_mm", "z": "time_s"}  # what the effects of any channel are made of here
SETTING = {"rest_s": 30.0, "humidity_pct": 55.0, "lab_temperature_C": 24.0}


@pytest.mark.parametrize("known", EFFECTS.values(), ids=EFFECTS)
def test_every_effect_of_the_catalogue_can_be_simulated(campaign, known):
    """Amplitudes of 0.01 in its first role, other numbers as they start: the truth moves by its shape."""
    values = {p.name: 0.01 if p.linear else p.start for p in known.parameters}
    values |= {"x_0": 20.0, "w": 5.0} if known.id == "bump" else {}  # it starts at 0, before steady sliding
    entry = {"id": known.id, "parameters": values, "channels": [FREELY.get(n, n) for n in known.reads]}
    channels = [{"kind": "constant", "name": n, "value": SETTING[n]} for n in known.reads if n in SETTING]
    design = {**ONE_CONDITION, "days": (16.0,), "speeds_mm_s": (2.0,), "directions": (1, -1)}
    physics = {"sigma_0": STIFF}
    truth, runs, traces = campaign(
        design=design, physics=physics, channels=channels, effects=[entry], noise=()
    )
    runs = runs.assign(
        direction=[1 if "fwd" in run else -1 for run in runs["run_id"]], stroke=1, elapsed_h=0.0
    )
    moved = 0.0
    for row in runs.itertuples():
        points = steady(traces[row.file])
        points = points.assign(**{n: getattr(row, n) for n in runs.columns if n not in points})
        points["speed_mm_s"] = row.speed_mm_s * row.direction
        points["distance_mm"] = (
            points["displacement_mm"] if row.direction > 0 else 40 - points["displacement_mm"]
        )
        points["elapsed_h"] = (
            pd.Timestamp(row.started_at) - pd.Timestamp("2024-01-08T08:00:00")
        ).total_seconds() / 3600
        found = true_force(truth, points)
        npt.assert_allclose(points["force_N"], found, atol=2e-5)
        bare = true_force({"spec": {**truth["spec"], "effects": []}}, points)
        inputs = {read: points[n].to_numpy() for read, n in zip(known.reads, entry["channels"], strict=True)}
        shape = known.shape(inputs, **values)
        role = known.acts_on[0]
        if role == ("force", "add"):
            npt.assert_allclose(found - bare, shape, atol=1e-9)
        elif role == ("mu", "multiply"):
            npt.assert_allclose(found - bare, shape * (bare - 0.05 * points["speed_mm_s"]), atol=1e-9)
        moved = max(moved, np.abs(found - bare).max())
    assert moved > 0 or known.id in (
        "conditioning",
        "run_in",
    )  # one repeat and one stroke: nothing to settle yet


def test_a_smooth_shape_passes_its_knots(campaign):
    entry = {
        "id": "smooth",
        "channels": ["displacement_mm"],
        "acts_on": "force",
        "operation": "add",
        "knots": [10.0, 20.0, 30.0],
        "parameters": {"c_2": 1.5, "c_3": -0.5},
    }
    truth, _, _ = campaign(design=ONE_CONDITION, effects=[entry])
    points = pd.DataFrame(
        {"displacement_mm": [10.0, 20.0, 30.0], "speed_mm_s": 2.0, **POINT, "aging_days": 0.0}
    )
    force = true_force(truth, points)
    npt.assert_allclose(force - force[0], [0.0, 1.5, -0.5], atol=1e-9)
    with pytest.raises(ConfigError, match="knots"):
        simulate(Spec(effects=[{**entry, "knots": []}]), Path("never-written"))


def test_truth_names_the_missing_column(campaign):
    truth, _, _ = campaign(design=ONE_CONDITION, effects=[effect("0.01 * time_s")])
    points = pd.DataFrame({"temperature_C": [23.0], "compression_ratio_pct": 100.0, "aging_days": 0.0})
    with pytest.raises(RequestError, match="speed_mm_s"):
        true_force(truth, points)
    with pytest.raises(RequestError, match="time_s"):
        true_force(truth, points.assign(speed_mm_s=1.0))
    with pytest.raises(RequestError, match="1 empty cells"):
        true_force(truth, points.assign(speed_mm_s=1.0, time_s=np.nan))
