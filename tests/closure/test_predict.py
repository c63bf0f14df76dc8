import numpy as np
from bins_helpers import make_bins, make_traces

from sealfit.closure.loop import close_loop
from sealfit.closure.predict import predict
from sealfit.config import Config


def test_between_three_speeds_the_force_is_not_known():
    bins = make_bins(speeds=(1.0, 8.0, 64.0), bins=6)
    model = close_loop(bins, make_traces(bins), Config()).model
    points = bins.groupby("condition").head(1).assign(speed_mm_s=8.1)
    tested = predict(model, points)
    assert not tested["extrapolated"].any()
    between = predict(model, points.assign(speed_mm_s=20.0))
    assert between["extrapolated"].all()
    assert (
        between["note"].str.contains("too few speeds for the friction between them; tested: 1, 8, 64").all()
    )
    assert np.isfinite(between["force_after_N"]).all()
