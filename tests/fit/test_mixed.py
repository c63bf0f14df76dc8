import numpy as np
import numpy.testing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sealfit.fit.mixed import Component, Groups, reml, whiten


def nested(files_per_run, runs_per_specimen, specimens):
    files = files_per_run * runs_per_specimen * specimens
    return {
        "file": np.arange(files),
        "run": np.arange(files) // files_per_run,
        "specimen": np.arange(files) // (files_per_run * runs_per_specimen),
    }


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10_000), st.floats(0, 2), st.floats(0, 0.5), st.floats(0, 3))
def test_whitening_is_a_root_of_the_inverse_covariance(seed, offset, gain, run):
    rng = np.random.default_rng(seed)
    codes = {"file": np.repeat(np.arange(10), 3), "run": np.repeat(np.arange(5), 6)}
    force, sd = rng.normal(5, 2, 30), rng.uniform(0.3, 1.0, 30)
    same = {level: code[:, None] == code[None, :] for level, code in codes.items()}
    covariance = (
        np.diag(sd**2) + offset * same["file"] + gain * np.outer(force, force) * same["file"] + run * same["run"]
    )
    parts = [Component("file", "offset", offset), Component("file", "gain", gain), Component("run", "offset", run)]
    root, logdet = whiten(np.eye(30), sd, force, Groups.of(codes), parts)
    npt.assert_allclose(root.T @ root @ covariance, np.eye(30), atol=1e-8)
    npt.assert_allclose(logdet, np.linalg.slogdet(covariance)[1], rtol=1e-9, atol=1e-9)


def test_whitening_knows_that_files_have_shapes_of_their_own():
    rng = np.random.default_rng(1)
    codes = {"stroke": np.repeat(np.arange(6), 5), "file": np.repeat(np.arange(3), 10)}
    groups, force, sd = Groups.of(codes), rng.normal(5, 2, 30), rng.uniform(0.3, 1.0, 30)
    parts = [Component("file", "gain", 0.02)]
    root, logdet = whiten(np.eye(30), sd, force, groups, parts, shape=9.0)
    rows = np.zeros((30, 30))
    for stroke in range(6):
        own = codes["stroke"] == stroke
        along = (own / sd) / np.linalg.norm(own / sd)
        mean = np.outer(along, along)
        rows += np.outer(sd, sd) * (mean + 9.0 * (np.diag(own.astype(float)) - mean))
    covariance = rows + 0.02 * np.outer(force, force) * (codes["file"][:, None] == codes["file"][None, :])
    npt.assert_allclose(root.T @ root @ covariance, np.eye(30), atol=1e-8)
    npt.assert_allclose(logdet, np.linalg.slogdet(covariance)[1], rtol=1e-9)


def test_reml_recovers_scatter_of_files_runs_and_specimens():
    codes = nested(3, 8, 25)
    rng = np.random.default_rng(3)
    found = []
    for _ in range(12):
        force = rng.uniform(20, 50, 200)[codes["run"]]
        residual = (
            rng.normal(0, 0.05, force.size)
            + force * rng.normal(0, 0.01, force.size)
            + rng.normal(0, 0.2, 200)[codes["run"]]
            + force * rng.normal(0, 0.02, 25)[codes["specimen"]]
        )
        tangent = np.column_stack([np.ones(force.size), force])
        kinds = [("file", "gain"), ("run", "offset"), ("specimen", "gain")]
        parts = reml(residual, tangent, np.full(force.size, 0.05**2), force, Groups.of(codes), kinds)
        found.append([np.sqrt(p.variance) for p in parts])
    npt.assert_allclose(np.mean(found, axis=0), [0.01, 0.2, 0.02], rtol=0.15)


def test_reml_counts_the_degrees_of_freedom_that_the_model_took():
    # 40 groups of one, 20 of whose means the model owns: the plain mean square would be half the variance.
    rng = np.random.default_rng(5)
    codes = {"file": np.arange(40)}
    found = []
    for _ in range(200):
        tangent = rng.normal(0, 1, (40, 20))
        error = rng.normal(0, 1.0, 40)
        residual = error - tangent @ np.linalg.lstsq(tangent, error, rcond=None)[0]
        (part,) = reml(residual, tangent, np.full(40, 1e-6), np.ones(40), Groups.of(codes), [("file", "offset")])
        found.append(part.variance)
    assert np.mean(found) == pytest.approx(1.0, abs=0.08)  # SE of the mean: sqrt(2/20/200) = 0.022


def test_group_means():
    groups = Groups.of({"file": np.array([0, 0, 1, 1, 1])})
    npt.assert_allclose(groups.means(np.array([1.0, 3.0, 2.0, 4.0, 6.0]), "file"), [2.0, 4.0])
