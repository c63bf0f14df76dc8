import numpy as np
import numpy.testing as npt
import pytest

from sealfit.ingest.segments import Pieces, median, quantile, weighted_median

SIZES = (40, 9, 1, 200, 7, 2, 31)


def traces(kind, seed=0):
    rng = np.random.default_rng(seed)
    made = [rng.normal(size=n).cumsum() + 1e-3 * rng.normal(size=n) for n in SIZES]
    return [np.round(values, 1) for values in made] if kind == "steps" else made


def test_quantiles_are_those_of_numpy():
    rng = np.random.default_rng(1)
    for n in range(1, 60):
        values = np.round(rng.normal(size=n), rng.integers(0, 12))
        assert median(values) == np.median(values)
        for share in (0.0, 0.01, 0.02, 0.05, 0.5, 0.9, 0.95, 0.99, 1.0):
            assert quantile(values, share) == np.quantile(values, share)


def test_what_is_computed_of_every_piece_is_what_each_gives_alone():
    own, pieces = traces("fine"), Pieces(SIZES)
    flat = np.concatenate(own)
    npt.assert_array_equal(pieces.max(flat), [values.max() for values in own])
    npt.assert_array_equal(pieces.min(flat), [values.min() for values in own])
    npt.assert_allclose(pieces.sum(flat), [values.sum() for values in own], rtol=1e-12)
    npt.assert_allclose(pieces.mean(flat), [values.mean() for values in own], rtol=1e-12)
    npt.assert_array_equal(pieces.sum(flat > 0), [(values > 0).sum() for values in own])
    npt.assert_array_equal(pieces.of, np.repeat(np.arange(len(SIZES)), SIZES))


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
