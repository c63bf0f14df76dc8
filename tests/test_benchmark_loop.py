import numpy as np
import pandas as pd
import pytest
from campaigns import campaign
from counts import bounds
from loop import key, plan, read
from loop_cost import with_idle_columns
from loop_summary import clustered, summarise
from points import draw_points
from scoring import LENIENT, NONE, STRICT, Target, correlations, grade, match, misplaced, named_right
from truths import true_effects, true_force, true_term, truth_in_claim

from sealfit.effects import EFFECTS
from sealfit.fit.joint.model import Term
from sealfit.fit.joint.rows import make_rows
from sealfit.simulation import load_truth, simulate, truth_path

OIL = Target("linear", ("oil_ppm",), "run", "mu", "multiply")
RIPPLE = Target("ripple", ("displacement_mm",), "trace", "force", "add")


def claim(
    id="linear", channels=("oil_ppm",), level="run", acts_on="mu", operation="multiply", alternatives=()
):
    return {
        "id": id,
        "channels": list(channels),
        "level": level,
        "acts_on": acts_on,
        "operation": operation,
        "alternatives": list(alternatives),
    }


def test_a_claim_with_the_same_place_and_quantity_is_found_whatever_its_form():
    assert grade(OIL, claim(id="smooth"), 0.5) == STRICT


@pytest.mark.parametrize(
    ("given", "correlation", "wanted"),
    [
        (claim(acts_on="force"), 0.5, NONE),
        (claim(acts_on="force"), 0.985, LENIENT),  # one effect at this design
        (
            claim(acts_on="force", alternatives=[{"id": "linear", "channels": ["oil_ppm"], "acts_on": "mu"}]),
            0.5,
            LENIENT,
        ),
        (claim(channels=("dust_mg",)), 0.99, NONE),  # another channel, and nothing said of the true one
        (
            claim(
                channels=("dust_mg",), alternatives=[{"id": "log", "channels": ["oil_ppm"], "acts_on": "mu"}]
            ),
            0.99,
            LENIENT,
        ),
        (claim(level="repeat"), 1.0, NONE),
    ],
)
def test_what_the_design_cannot_tell_apart_counts_leniently(given, correlation, wanted):
    assert grade(OIL, given, correlation) == wanted


def test_channels_are_compared_as_sets():
    target = Target("expression", ("speed_mm_s", "aging_days"), "run", "mu", "multiply", catalogued=False)
    assert grade(target, claim(channels=("aging_days", "speed_mm_s")), 0.0) == STRICT


def test_each_claim_stands_for_one_effect_and_the_rest_is_extra():
    claims = [
        claim(),
        claim(),
        claim(id="ripple", channels=("displacement_mm",), level="trace", acts_on="force", operation="add"),
    ]
    found = match([RIPPLE, OIL], claims, np.zeros((2, 3)))
    assert found[0] == (2, STRICT)
    assert found[1][1] == STRICT
    assert found[1][0] in (0, 1)


def test_of_two_equal_claims_the_one_with_the_true_name_is_taken():
    found = match([OIL], [claim(id="smooth"), claim()], np.zeros((1, 2)))
    assert found == [(1, STRICT)]


def test_more_claims_than_can_be_paired_at_once_are_paired_in_turn():
    found = match([OIL], [claim(id="smooth", acts_on="force")] * 9 + [claim()], np.zeros((1, 10)))
    assert found == [(9, STRICT)]


def test_the_right_column_under_the_wrong_quantity_is_misplaced():
    claims = [claim(acts_on="sigma_2"), claim(channels=("dust_mg",))]
    found = match([OIL], claims, np.zeros((1, 2)))
    assert found == [(None, NONE)]
    assert misplaced([OIL], [None], claims) == [0]


def test_the_same_equation_under_another_id_is_named_leniently():
    target = Target("drift", ("time_s",), "trace", "force", "add")
    assert named_right(target, claim(id="linear")) == (False, True)
    assert named_right(target, claim(id="drift")) == (True, True)
    assert named_right(target, claim(id="log")) == (False, False)
    assert named_right(target, None) == (False, False)


def test_correlations_are_those_of_columns_and_zero_where_a_column_is_empty():
    found = correlations(np.array([[1.0, 0.0], [0.0, 0.0]]), np.array([[-2.0, 1.0], [0.0, 1.0]]))
    np.testing.assert_allclose(found, [[1.0, 1 / np.sqrt(2)], [0.0, 0.0]])


def test_clopper_pearson_bounds():
    # Exact: with 0 of n the upper bound is 1 - 0.025^(1/n); by symmetry with n of n.
    assert bounds(0, 160) == pytest.approx((0.0, 1 - 0.025 ** (1 / 160)))
    assert bounds(10, 10) == pytest.approx((0.025**0.1, 1.0))


def test_a_clustered_share_has_the_standard_error_of_its_campaigns():
    # Four campaigns of ten intervals, two all in, two half: mean 0.75, SD 0.2887, over sqrt(4).
    assert clustered([(10, 10), (10, 10), (5, 10), (5, 10)]) == pytest.approx((0.75, 0.288675 / 2), rel=1e-5)
    assert clustered([(0, 0), (3, 4)])[0] == 0.75


def test_the_plan_makes_the_last_seed_large_and_asks_little_of_faint_effects():
    tasks = plan(["ripple", "null_white"], ["faint", "strong"], [1, 2, 3, 4], list(range(1, 21)), rivals=True)
    assert len(tasks) == 2 + 4 + 20
    assert {(t.kind, t.seed) for t in tasks if t.size == "large"} == {("ripple", 4), ("null_white", 20)}
    assert all(t.strength != "faint" or not t.rivals for t in tasks)
    assert len({t.key for t in tasks}) == len(tasks)


def test_a_file_of_results_is_taken_up_and_failures_run_again(tmp_path):
    path = tmp_path / "r.jsonl"
    head = '{"kind": "ripple", "strength": "weak", "seed": %d, "size": "small"%s}\n'
    path.write_text(head % (1, "") + head % (2, ', "error": "x"') + head % (1, ', "again": 1'))
    records = read(path)
    assert [key(r) for r in records] == [("ripple", "weak", 1, "small")]
    assert records[0]["again"] == 1
    assert read(tmp_path / "none.jsonl") == []


def test_a_summary_counts_what_the_records_say():
    effect = {
        "z": 20.0,
        "grade": 2,
        "named": True,
        "named_leniently": True,
        "catalogued": True,
        "claimed_id": "ripple",
    }
    inside = {"parameters": [{"inside": True}, {"inside": False}]}
    base = {
        "seed": 1,
        "size": "small",
        "files": 216,
        "missing": {},
        "seconds": {"loop": 5.0, "wall": 9.0},
        "points": 200,
    }
    errors = {"after": 0.2, "plain": 0.5, "true_form": 0.1}
    one = {
        **base, "kind": "ripple", "strength": "strong", "verdict": "closed", "before": 0.5, "after": 0.2,
        "inside": 190,
        "effects": [effect | inside], "claims": [{}], "extra": 0, "misplaced": 0, "errors": errors,
    }  # fmt: skip
    null = {
        **one, "kind": "null_white", "strength": "-", "verdict": "nothing_missing", "before": 0.2,
        "claims": [],
        "effects": [], "errors": dict.fromkeys(errors, 0.1),
    }  # fmt: skip
    text = summarise([one, null])
    assert (
        "| clear effects found (channels, level, acts_on, operation) | 1 of 1, 100.0 % [2.5, 100.0] | 97 % |"
        in text
    )
    assert "| nulls with an effect claimed | 0 of 1, 0.0 % [0.0, 97.5] |" in text
    assert "50.0 % ± nan (2 intervals, 1 campaigns)" in text
    assert "| ripple | strong | 0.200 | 0.100 | 2.00 ** | 0.500 |" in text


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A small campaign with a ripple and a column, and the rows its bins would be, at the files' samples."""
    folder = tmp_path_factory.mktemp("loop") / "c"
    spec = campaign("three_at_once", rows=60)
    simulate(spec, folder)
    runs = pd.read_csv(folder / "runs.csv")
    rng = np.random.default_rng(1)
    bins = runs.loc[runs.index.repeat(3)].reset_index(drop=True)
    distance = np.tile([5.0, 15.0, 30.0], len(runs))
    bins = bins.assign(
        condition=bins["specimen_id"], rubber="rubber", stroke=1, direction=1, bin=0, n=10, force_sd_N=0.1,
        series=np.where(bins["aging_days"] > 0, bins["temperature_C"].astype(str), "unaged"),
        distance_mm=distance, displacement_mm=distance + rng.normal(size=len(bins)),
        speed_set_mm_s=bins["speed_mm_s"], time_s=distance / bins["speed_mm_s"],
        run_order=1.0 + bins.index // 3, elapsed_h=24.0 * bins["aging_days"],
    )  # fmt: skip
    truth = load_truth(truth_path(folder))
    return spec, truth, bins.assign(force_N=true_force(truth, bins))


def test_true_effects_carry_their_channels_level_and_share_of_the_force(made):
    spec, _, bins = made
    rows = make_rows(bins, has_aging=True)
    found = true_effects(spec, rows)
    assert [(e.id, e.channels, e.level) for e in found] == [
        ("warming_distance", ("distance_mm",), "trace"),
        ("linear", ("oil_ppm",), "run"),
        ("ripple", ("displacement_mm",), "trace"),
    ]
    # An added force is its own share.
    ripple = 0.3 * np.sin(2 * np.pi * rows.values("displacement_mm") / 5.0 + 0.7)
    np.testing.assert_allclose(found[2].column, ripple, atol=1e-9)


def test_a_true_number_is_told_in_the_claims_reference_and_turn(made):
    spec, _, bins = made
    rows = make_rows(bins, has_aging=True)
    _, column, ripple = true_effects(spec, rows)
    other = Term(EFFECTS["linear"], ("oil_ppm",), "mu", "multiply", fixed={"x_ref": 40.0})
    # By hand: 1 + A (x - 50) = (1 - 10 A) (1 + A / (1 - 10 A) (x - 40)).
    a = 0.0021
    assert truth_in_claim(column, other, {"A": 0.002}, rows)["A"] == pytest.approx(a / (1 - 10 * a), rel=1e-9)
    turned = truth_in_claim(ripple, ripple.term, {"A": -0.3, "lambda_": 5.0, "phi": 0.7 - np.pi}, rows)
    assert turned == pytest.approx({"A": -0.3, "lambda_": 5.0, "phi": 0.7 - np.pi})


def test_a_number_without_reference_is_told_as_it_is(made):
    _, _, bins = made
    bins = bins.assign(
        direction=np.where(bins.index % 2, 1, -1),
        speed_mm_s=bins["speed_mm_s"] * np.where(bins.index % 2, 1, -1),
    )
    rows = make_rows(bins, has_aging=True)
    (offset,) = true_effects(campaign("zero_offset", strength="strong"), rows)
    claimed = Term(EFFECTS["zero_offset"], ("direction",), "force", "add", fixed={"direction_ref": 1.0})
    assert offset.channels == ("direction",)
    assert truth_in_claim(offset, claimed, {"A": 1.4}, rows) == {"A": 1.5}


def test_levels_are_told_as_differences_from_the_first():
    entry = campaign("column_category_mu", strength="strong").effects[0]
    _, values = true_term(entry, ("cleaner",))
    assert values == pytest.approx({"d_1": 1 / 0.92 - 1, "d_2": 1.08 / 0.92 - 1})


def test_points_are_new_and_within_what_was_tested(made):
    spec, truth, bins = made
    points = draw_points(bins, spec, 300, np.random.default_rng(2))
    assert len(points) == 300
    for name in ("speed_mm_s", "time_s", "aging_days", "oil_ppm", "distance_mm", "elapsed_h"):
        assert points[name].between(bins[name].min() - 1e-9, bins[name].max() + 1e-9).all(), name
    assert (~points["aging_days"].isin(bins["aging_days"])).sum() > 50
    assert ((points["aging_days"] == 0) == (points["series"] == "unaged")).all()
    assert np.isfinite(true_force(truth, points)).all()


def test_ten_idle_columns_are_added():
    spec = campaign("three_at_once", size="large")
    assert len(with_idle_columns(spec).channels) == len(spec.channels) + 10
