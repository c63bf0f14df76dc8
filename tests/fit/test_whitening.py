"""Whitening by hand: against the dense covariance."""

import numpy as np
import numpy.testing as npt
from hypothesis import given, settings
from hypothesis import strategies as st

from sealfit.fit.joint.rows import Groups
from sealfit.fit.joint.tangent import Tangent
from sealfit.fit.joint.whitening import Component, Scatter, Whitening

CODES = {
    "stroke": np.repeat(np.arange(10), 3),
    "file": np.repeat(np.arange(5), 6),
    "run": np.repeat(np.arange(2), [12, 18]),
}


def covariance(scatter, force):
    """The model's covariance as a dense matrix: rows about their stroke's weighted mean, and components."""
    sd = np.sqrt(scatter.design_effect * (scatter.s0**2 + (scatter.g * force) ** 2))
    load = {"offset": np.ones_like(force), "gain": force}
    found = np.zeros((force.size, force.size))
    for stroke in range(10):
        own = CODES["stroke"] == stroke
        along = (own / sd) / np.linalg.norm(own / sd)
        shared = np.outer(along, along)
        found += np.outer(sd, sd) * (shared + scatter.shape * (np.diag(own.astype(float)) - shared))
    for part in scatter.components:
        same = CODES[part.level][:, None] == CODES[part.level][None, :]
        found += part.variance * np.outer(load[part.kind], load[part.kind]) * same
    return found


@settings(max_examples=30, deadline=None)
@given(
    st.integers(0, 10_000),
    st.floats(0, 2),
    st.floats(0, 0.5),
    st.floats(0, 3),
    st.floats(1, 9),
    st.floats(1, 4),
)
def test_whitening_is_a_root_of_the_inverse_covariance(seed, offset, gain, run, shape, alike):
    force = np.random.default_rng(seed).normal(5, 2, 30)
    parts = (
        Component("stroke", "offset", offset / 2),
        Component("stroke", "gain", gain / 2),
        Component("file", "offset", offset),
        Component("file", "gain", gain),
        Component("run", "offset", run),
    )
    scatter = Scatter(0.4, 0.1, parts, alike, shape)
    whitening = Whitening(scatter, np.column_stack([np.ones_like(force), force]), Groups.of(CODES))
    root, dense = whitening(np.eye(30)), covariance(scatter, force)
    normal, gradient = whitening.normal(Tangent.dense(np.eye(30)), root[:, 0])
    npt.assert_allclose(normal, root.T @ root, atol=1e-8)
    npt.assert_allclose(gradient, normal[0], atol=1e-8)
    npt.assert_allclose(root.T @ root @ dense, np.eye(30), atol=1e-8)
    npt.assert_allclose(whitening.logdet, np.linalg.slogdet(dense)[1], rtol=1e-9, atol=1e-9)


def test_a_force_that_does_not_vary_in_its_stroke_has_only_a_mean():
    force = np.repeat(np.arange(3.0, 13.0), 3)
    scatter = Scatter(0.4, 0.1, (Component("file", "gain", 0.02),), 1.0, 4.0)
    whitening = Whitening(scatter, np.column_stack([np.ones_like(force), force]), Groups.of(CODES))
    root, dense = whitening(np.eye(30)), covariance(scatter, force)
    npt.assert_allclose(root.T @ root @ dense, np.eye(30), atol=1e-8)
    npt.assert_allclose(whitening.logdet, np.linalg.slogdet(dense)[1], rtol=1e-9)
