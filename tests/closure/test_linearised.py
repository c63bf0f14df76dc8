import itertools

import numpy as np
import pytest
from bins_helpers import make_bins

from sealfit.closure.channels import Channel
from sealfit.closure.forms import MOST_PLACES, free_term, grid_of
from sealfit.closure.linearised import linearised, middles
from sealfit.closure.score_test import Candidate, ScoreTestResult
from sealfit.effects import EFFECTS
from sealfit.fit.joint import fit_declared
from sealfit.fit.joint.model import Term
from sealfit.fit.joint.rows import make_rows


@pytest.mark.parametrize("place", [20, 47.3])
def test_a_jump_is_placed_between_the_right_neighbours_though_the_grid_leaves_places_out(place):
    bins = make_bins(
        2,
        repeats=1,
        bins=2,
        run_channels={"oil_ppm": lambda rng: rng.uniform(0, 100)},
        effect=lambda table, force: force + 2.0 * (table["oil_ppm"].to_numpy() >= place),
    )
    rows = make_rows(bins, has_aging=True)
    oil = rows.values("oil_ppm")
    assert middles(oil).size > MOST_PLACES
    term = Term(EFFECTS["step"], ("oil_ppm",), "force", "add", fixed={"x_ref": 50.0})
    test_result = ScoreTestResult(0.0, 1, np.unique(oil).size, 0.0)
    candidate = Candidate(("oil_ppm",), "force", "add", "run", np.empty((0, 0)), test_result, p_value=0.0)
    (found,) = linearised(fit_declared(rows), term, grid_of(EFFECTS["step"], oil), candidate)
    x_0 = found.values["x_0"]
    assert oil[oil < place].max() < x_0 < oil[oil >= place].min()
    assert found.values["A"] == pytest.approx(2.0, abs=0.2)
    sizes = [getattr(values, "size", 0) for _, values in rows.cache.values()]
    assert max(sizes) < rows.force.size * MOST_PLACES  # the rows do not keep the shapes of the grid


@pytest.mark.parametrize(
    ("clusters", "count"),
    [([(1.0, 1.6), (7.0, 13.0), (30.0, 94.0)], 17), ([(0.1, 0.2), (4.0, 5.0)], 12), ([(2.0, 9.0)], 9)],
)
def test_a_free_shape_has_no_knots_in_gaps_between_the_values(clusters, count):
    """Times of three speeds lie apart; the value of a knot between them is not determined."""
    values = np.concatenate([np.linspace(*ends, 200) for ends in clusters])
    knots = np.array(
        free_term(Channel("time_s", values, "sample"), "force", "add", knots=count).fixed["knots"]
    )
    assert (knots[0], knots[-1]) == (values[0], values[-1])
    assert len(knots) == count if len(clusters) == 1 else 4 <= len(knots) < count
    for (_, low), (high, _) in itertools.pairwise(clusters):
        assert ((knots > low) & (knots < high)).sum() <= 2  # at most one just outside each cluster


def test_knots_reach_both_ends_of_values_that_lie_close_together():
    values = np.linspace(1.0, 18.0, 12_000)
    knots = free_term(Channel("displacement_mm", values, "sample"), "mu", "multiply", knots=9).fixed["knots"]
    assert knots == pytest.approx(np.linspace(1.0, 18.0, 9))
