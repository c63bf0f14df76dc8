import numpy as np
from bins_helpers import make_bins, make_traces

from sealfit.closure.intervals import robust_level
from sealfit.closure.loop import close_loop
from sealfit.closure.predict import predict
from sealfit.config import Config
from sealfit.fit.rows import make_rows


def test_the_interval_of_the_mean_is_the_wider_of_two():
    bins = make_bins(2, bins=6, setup=0.005)
    model = close_loop(bins, make_traces(bins), Config()).model
    points = bins.groupby("condition").head(1)
    narrow = predict({**model, "robust_covariance": model["covariance"]}, points)
    both = predict(model, points)
    width = [(p["force_after_hi95_N"] - p["force_after_lo95_N"]).to_numpy() for p in (narrow, both)]
    assert np.all(width[1] >= width[0] * (1 - 1e-12))
    doubled = predict({**model, "robust_covariance": (4 * np.array(model["covariance"])).tolist()}, points)
    wide = (doubled["force_after_hi95_N"] - doubled["force_after_lo95_N"]).to_numpy()
    np.testing.assert_allclose(wide, 2 * width[0], rtol=1e-9)


def test_whole_runs_say_how_far_numbers_scatter_where_there_are_fewer_than_ten_specimens():
    rows = make_rows(make_bins(bins=4), has_aging=True)
    assert rows.groups.starts["specimen"].size == 9
    assert robust_level(rows) == "run"
