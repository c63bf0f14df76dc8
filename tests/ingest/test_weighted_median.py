import numpy as np
import pytest

from sealfit.ingest.window import weighted_median

SIZES = (40, 9, 1, 200, 7, 2, 31)


def traces(kind, seed=0):
    rng = np.random.default_rng(seed)
    made = [rng.normal(size=n).cumsum() + 1e-3 * rng.normal(size=n) for n in SIZES]
    return [np.round(values, 1) for values in made] if kind == "steps" else made


@pytest.mark.parametrize("kind", ["fine", "steps"])
def test_half_of_the_weight_lies_at_or_below_a_weighted_median_and_less_than_half_below(kind):
    for values in traces(kind, 2):
        weight = np.maximum(values, 0.0) * (1.0 + np.arange(len(values)))
        found = weighted_median(values, weight)
        if not weight.any():
            assert found == 0.0
            continue
        assert weight[values <= found].sum() >= 0.5 * weight.sum() * (1 - 1e-12)
        assert weight[values < found].sum() <= 0.5 * weight.sum() * (1 + 1e-12)
