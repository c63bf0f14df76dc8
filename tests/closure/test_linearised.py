import numpy as np
import pytest
from bins_helpers import make_bins

from sealfit.closure.forms import MOST_PLACES, grid_of
from sealfit.closure.linearised import Linearised, middles
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
    (found,) = Linearised(fit_declared(rows))(term, grid_of(EFFECTS["step"], oil), candidate)
    x_0 = found.values["x_0"]
    assert oil[oil < place].max() < x_0 < oil[oil >= place].min()
    assert found.values["A"] == pytest.approx(2.0, abs=0.2)
