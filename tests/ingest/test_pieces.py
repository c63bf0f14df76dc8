import numpy as np
import numpy.testing as npt
import pytest
from scipy.ndimage import median_filter, uniform_filter1d

from sealfit.ingest.segments import Pieces, median, quantile, running_mean, running_median, weighted_medians

SIZES = (40, 9, 1, 200, 7, 2, 31)


def traces(kind, seed=0):
    rng = np.random.default_rng(seed)
    made = [rng.normal(size=n).cumsum() + 1e-3 * rng.normal(size=n) for n in SIZES]
    return [np.round(values, 1) for values in made] if kind == "steps" else made


@pytest.mark.parametrize("kind", ["fine", "steps"])
@pytest.mark.parametrize("samples", [2, 3, 4, 5, 6, 7, 9])
def test_running_filters_are_those_of_scipy_piece_by_piece(kind, samples):
    own = traces(kind)
    flat, pieces = np.concatenate(own), Pieces(SIZES)
    means = np.concatenate([uniform_filter1d(values, samples, mode="nearest") for values in own])
    npt.assert_array_equal(running_mean(flat, pieces, samples), means)
    medians = np.concatenate([median_filter(values, samples, mode="nearest") for values in own])
    npt.assert_array_equal(running_median(flat, pieces, samples), medians)
    mirrored = running_median(flat, pieces, samples, "mirror")
    for values, rows in zip(own, pieces.slices, strict=True):
        if len(values) > samples:
            npt.assert_array_equal(mirrored[rows], median_filter(values, samples, mode="mirror"))


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
    npt.assert_array_equal(pieces.steps(flat), np.concatenate([np.append(np.diff(values), 0.0) for values in own]))
    npt.assert_array_equal(pieces.of, np.repeat(np.arange(len(SIZES)), SIZES))
    for found, values in zip(pieces.split(np.flatnonzero(flat > 0)), own, strict=True):
        npt.assert_array_equal(found, np.flatnonzero(values > 0))


@pytest.mark.parametrize("kind", ["fine", "steps"])
def test_weighted_medians_are_those_of_the_sorted_values(kind):
    own, pieces = traces(kind, 2), Pieces(SIZES)
    weights = [np.maximum(values, 0.0) * (1.0 + np.arange(len(values))) for values in own]
    found = weighted_medians(np.concatenate(own), np.concatenate(weights), pieces)
    for made, values, weight in zip(found, own, weights, strict=True):
        order = np.argsort(values)
        covered = np.cumsum(weight[order])
        assert made == (values[order][np.searchsorted(covered, 0.5 * covered[-1])] if covered[-1] > 0 else 0.0)
