"""P-values adjusted for the whole search, on scores made by hand."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import numpy.testing as npt
import pytest

from sealfit.closure.criteria import SEARCHES
from sealfit.closure.multiplicity import (
    FLIPS,
    MOST_FLIPS,
    adjust,
    adjust_all,
    adjust_slopes,
    adjust_small_sample,
    critical_many,
    number_of_contrasts,
    slope_log_p,
)
from sealfit.closure.score_test import Candidate, ScoreTestResult, log_p_of_score, to_orthonormal
from sealfit.closure.small_sample_test import ContrastTest, SmallSampleTest
from sealfit.closure.small_sample_test import log_p_of_numbers as small_sample_log_p

NOWHERE = -1e-9  # log of a p-value of 1
TARGET = ("mu", "multiply")


def statistic(total, scores):
    return float(np.sum((total @ to_orthonormal(scores)) ** 2))


def scored(scores):
    """A score test of columns whose units have these scores, shape (units, k)."""
    total = scores.sum(axis=0)
    units, df = scores.shape
    t = statistic(total, scores)
    return ScoreTestResult(
        float(total @ total), df, units, float(log_p_of_score(np.array([t]), df, units)[0]), scores=scores
    )


def alike(units):
    """Scores of one sign in all units: of the 2^n flips two give as large a sum, if they are equal."""
    return scored(np.ones((units, 1)))


def test_the_statistic_is_the_squared_sum_over_the_sum_of_squares():
    scores = np.array([[1.0], [2.0], [-1.0], [4.0]])
    assert statistic(np.array([6.0]), scores) == pytest.approx(36 / 22)
    # Columns that share no unit: the sum of both.
    apart = np.array([[1.0, 0.0], [1.0, 0.0], [0.0, 2.0], [0.0, 4.0]])
    assert statistic(np.array([2.0, 6.0]), apart) == pytest.approx(4 / 2 + 36 / 20)
    # A column twice counts once.
    assert statistic(np.array([6.0, 6.0]), np.hstack([scores, scores])) == pytest.approx(36 / 22)


@pytest.mark.parametrize("units", [5, 8])
def test_one_test_has_the_share_of_the_signs_that_say_as_much(units):
    p = 2 / 2**units
    (found,) = adjust([alike(units)], np.random.default_rng(0))
    assert found == pytest.approx(p, abs=4 * np.sqrt(p / FLIPS))  # four standard errors of so many draws


def test_a_test_that_is_made_twice_counts_once():
    """Of eight units 2 of the 256 flips agree on all; on either of two patterns 4 do."""
    one = alike(8)
    other = scored(np.array([[1.0], [-1.0]] * 4))  # says nothing by itself, but is looked at
    alone, twice, two = (
        adjust(k, np.random.default_rng(0), 20_000) for k in ([one], [one, one], [one, other])
    )
    assert twice[0] == twice[1] == pytest.approx(alone[0], abs=1e-12)
    assert alone[0] == pytest.approx(1 / 128, abs=0.0025)
    assert two[0] == pytest.approx(1 / 64, abs=0.004)
    assert two[1] > 0.5


def test_no_p_value_is_smaller_than_the_flips_resolve():
    assert adjust([alike(60)], np.random.default_rng(0)) == pytest.approx([1 / (MOST_FLIPS + 1)])


def test_a_p_value_near_the_level_hardly_depends_on_the_seed():
    """Of twelve units 2 of 4,096 flips agree on all: p = 0.0005, known to a third of itself."""
    found = [adjust([alike(12)], np.random.default_rng(seed))[0] for seed in range(20)]
    assert np.std(found) < 1.2 * 0.0005 / np.sqrt(MOST_FLIPS * 2 / 4096)
    assert np.mean(found) == pytest.approx(2 / 4096, rel=0.3)


def test_a_large_p_value_needs_no_more_flips():
    class Counted:
        def __init__(self):
            self.rng, self.count = np.random.default_rng(0), 0

        def choice(self, values, size):
            self.count += size[0]
            return self.rng.choice(values, size)

    rng = Counted()
    assert adjust([alike(5)], rng)[0] == pytest.approx(2 / 32, abs=0.02)
    assert rng.count == FLIPS


def test_the_critical_value_is_where_the_adjusted_p_value_is_the_level():
    rng = np.random.default_rng(1)
    results = [scored(rng.normal(size=(30, 2))) for _ in range(5)]
    critical = critical_many(results, 0.05, np.random.default_rng(0))
    at = [result._replace(log_p=critical) for result in results]
    npt.assert_allclose(adjust(at, np.random.default_rng(0)), 0.05, atol=0.002)


def along(log_p, column):
    """A test on four numbers, along one of them."""
    return SmallSampleTest(TARGET, np.eye(4)[:, [column]], 0.0, 1.0, log_p, 1.0, 3)


class FourNumbers:
    """Specimens whose numbers are four draws of a normal distribution."""

    level = "specimen"

    @staticmethod
    def draws(count, rng):
        return {TARGET: rng.normal(size=(count, 4))}


def test_tests_on_few_specimens_are_adjusted_by_draws_and_never_by_more_than_their_number():
    own = np.log(0.02)
    results = [
        ScoreTestResult(1.0, 1, 4, NOWHERE, small_sample=test) for test in (along(own, 0), along(NOWHERE, 1))
    ]
    plain = ScoreTestResult(1.0, 1, 4, NOWHERE)
    found = adjust_small_sample(FourNumbers, [*results, plain], np.random.default_rng(0), 20_000)
    # Squares of four numbers share one sum, so that two of them are seldom large together: 1 - 0.98^2 or a
    # bit more.
    assert found[0] == pytest.approx(0.04, abs=0.004)
    assert found[1] > 0.5
    assert found[2] == 1.0
    surer = [ScoreTestResult(1.0, 1, 4, NOWHERE, small_sample=along(-30.0, k)) for k in (0, 1)]
    npt.assert_allclose(adjust_small_sample(FourNumbers, surer, np.random.default_rng(0)), 2 * np.exp(-30.0))


def test_of_tests_with_unlike_degrees_of_freedom_the_smallest_p_value_counts():
    log_p = np.log(0.05)
    tests = [along(log_p, k) for k in (0, 1)]
    tests += [along(log_p, 2)._replace(basis=np.eye(4)[:, 2:], error_df=2)]
    tests += [along(log_p, 3)._replace(known=8.0)]
    drawn = FourNumbers.draws(FLIPS, np.random.default_rng(0))[TARGET]
    least = np.min([small_sample_log_p(drawn, test.basis, test.known) for test in tests], axis=0)
    results = [ScoreTestResult(1.0, 1, 4, NOWHERE, small_sample=test) for test in tests]
    found = adjust_small_sample(FourNumbers, results, np.random.default_rng(0))
    npt.assert_allclose(found, (1 + np.count_nonzero(least <= log_p)) / (FLIPS + 1))


def test_a_level_without_tests_adjusts_nothing():
    results = [ScoreTestResult(1.0, 1, 4, NOWHERE, small_sample=along(-9.0, 0)._replace(level="run"))]
    assert adjust_small_sample(FourNumbers, results, np.random.default_rng(0)).tolist() == [1.0]


def test_draws_of_four_numbers_have_uniform_p_values():
    drawn = FourNumbers.draws(4000, np.random.default_rng(3))[TARGET]
    p_values = np.exp(small_sample_log_p(drawn, np.eye(4)[:, [0]], 0.0))
    assert np.mean(p_values < 0.1) == pytest.approx(0.1, abs=0.02)  # four standard errors


def candidate(name, result):
    return Candidate((name,), "mu", "multiply", "run", np.ones((4, 1)), result)


def slopes_of(*sizes, seed=3):
    """Independent contrasts of some sizes, in standard errors, from eight units that differ by noise."""
    deviations = np.random.default_rng(2).normal(size=(8, len(sizes)))
    drawn = np.random.default_rng(seed).normal(size=(len(sizes), 300))
    own = np.full(len(sizes), 1.0)
    along = np.ones(len(sizes), dtype=bool)
    return ContrastTest(
        "run", np.array(sizes), own, np.full(len(sizes), 7.0), along, deviations, drawn, along
    )


def test_contrasts_are_adjusted_by_how_many_there_are():
    first, second = slopes_of(6.0, 0.5), slopes_of(1.0, seed=4)
    results = [ScoreTestResult(1.0, 1, 8, NOWHERE, slopes=(test,)) for test in (first, second)]
    results.append(ScoreTestResult(1.0, 1, 8, NOWHERE))
    found = adjust_slopes([candidate("oil", result) for result in results])
    logs = slope_log_p([first, second])
    assert found[0] == pytest.approx(3 * np.exp(logs[0].min()))  # three contrasts in all
    assert found[0] < 0.01
    assert found[1:].tolist() == [1.0, 1.0]


def test_contrasts_that_are_nearly_the_same_count_once():
    first = slopes_of(6.0)
    rest = [slopes_of(0.5)._replace(drawn=(1 + 0.01 * k) * first.drawn) for k in range(30)]
    results = [ScoreTestResult(1.0, 1, 8, NOWHERE, slopes=(test,)) for test in (first, *rest)]
    shapes = [candidate("oil", result) for result in results]
    assert number_of_contrasts(shapes).tolist() == [1.0] * 31
    places = [replace(shape, place=True) for shape in shapes[1:]]
    assert number_of_contrasts([shapes[0], *places]).tolist() == [31.0] * 31


def test_the_variables_of_operation_have_half_of_the_error_rate():
    first, second = slopes_of(6.0), slopes_of(*[0.5] * 20, seed=4)
    results = [ScoreTestResult(1.0, 1, 8, NOWHERE, slopes=(test,)) for test in (first, second)]
    of_speed, of_column = (
        adjust_slopes([candidate(name, results[0]), candidate("oil", results[1])])[0]
        for name in ("speed_mm_s", "humidity")
    )
    assert of_speed == pytest.approx(2 * np.exp(slope_log_p([first, second])[0][0]))
    assert of_column == pytest.approx(21 / 2 * of_speed)


def test_of_the_variants_of_a_contrast_that_counts_which_says_least():
    weak, strong = slopes_of(2.0), slopes_of(9.0)
    both = ScoreTestResult(1.0, 1, 8, NOWHERE, slopes=(strong, weak))
    (found,) = adjust_slopes([candidate("oil", both)])
    logs = slope_log_p([strong, weak])
    assert found == pytest.approx(np.exp(logs[1][0]))
    assert logs[0][0] < logs[1][0]


# ---------------------------------------------------------------- a whole search
def test_a_search_says_the_strongest_evidence_first_with_p_values_for_two_searches():
    given = [candidate("idle", scored(np.array([[1.0], [-1.0]] * 4))), candidate("oil", alike(8))]
    found = adjust_all(
        SimpleNamespace(cluster_tests={"specimen": FourNumbers}), given, np.random.default_rng(0)
    )
    assert [c.channels for c in found] == [("oil",), ("idle",)]
    assert found[0].p_value == pytest.approx(
        2 / 64, abs=0.012
    )  # 4 of 256 flips say as much of either; two searches
    assert found[1].p_value == 1.0


def test_two_ways_to_test_have_half_of_the_error_each():
    """The jackknife over 40 units, times the candidates; and F with contrasts, in few units."""
    strong = alike(40)._replace(log_p_jackknife=-20.0)
    found = adjust_all(
        SimpleNamespace(cluster_tests={"specimen": FourNumbers}),
        [candidate("a", strong)],
        np.random.default_rng(0),
    )
    assert found[0].p_value == pytest.approx(SEARCHES * 2 * np.exp(-20.0))
    both = ScoreTestResult(1.0, 1, 8, NOWHERE, small_sample=along(-30.0, 0), slopes=(slopes_of(0.1),))
    found = adjust_all(
        SimpleNamespace(cluster_tests={"specimen": FourNumbers}),
        [candidate("a", both)],
        np.random.default_rng(0),
    )
    assert found[0].p_value == pytest.approx(SEARCHES * 2 * np.exp(-30.0))


def test_a_claim_needs_enough_specimens_and_that_they_agree():
    shown = ScoreTestResult(1.0, 1, 8, NOWHERE)
    assert candidate("a", shown).claimable
    assert not candidate("a", shown._replace(consistent=False)).claimable
    assert not candidate(
        "a", shown._replace(small_sample=along(-9.0, 0)._replace(error_df=3))
    ).claimable  # of specimens: four
    assert candidate(
        "a", shown._replace(small_sample=along(-9.0, 0)._replace(error_df=3, level="run"))
    ).claimable
    differ = slopes_of(3.0, 1.0)._replace(consistent=np.array([False, True]))  # the stronger of the two does
    assert not candidate("a", shown._replace(slopes=(differ,))).claimable
