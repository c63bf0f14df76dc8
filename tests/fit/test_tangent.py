"""A tangent by blocks says what the whole matrix says."""

import numpy as np
import numpy.testing as npt
import pytest

from sealfit.fit.joint.rows import Groups
from sealfit.fit.joint.tangent import BlockLayout, OwnColumns, Tangent, blocks_of
from sealfit.fit.joint.variance_components import GroupMeans, RestrictedLikelihood, orthonormal
from sealfit.fit.joint.whitening import Component, Scatter, Whitening

SETS = [
    frozenset({0, 2, 3}),
    frozenset({0}),
    frozenset({0, 1, 4, 5}),
    frozenset({0, 6, 7, 8}),
    frozenset({0, 4, 5}),
]
SPECIMENS = np.array([0, 2, 1, 3, 4, 0, 3, 2])  # which set each specimen depends on


def blocked(rng, rows=12):
    """Return a tangent of eight specimens, three series that share one number, and the whole matrix."""
    index, block = blocks_of([SETS[k] for k in SPECIMENS], 9)
    dense = rng.normal(size=(SPECIMENS.size * rows, 9))
    for k, row in zip(SPECIMENS.repeat(rows), dense, strict=True):
        row[[column not in SETS[k] for column in range(9)]] = 0.0
    padded = np.column_stack([dense, np.zeros(len(dense))])
    layout = BlockLayout(9, index, block.repeat(rows))
    return Tangent(layout, np.take_along_axis(padded, index[layout.block], axis=1)), dense


def groups(rows=12):
    specimen = np.arange(SPECIMENS.size * rows) // rows
    return Groups.of(
        {"stroke": np.arange(specimen.size) // 2, "run": np.arange(specimen.size) // 6, "specimen": specimen}
    )


def test_blocks_hold_each_set_and_sets_inside_others_share_theirs():
    index, block = blocks_of(SETS, 9)
    assert index.shape == (3, 4)
    assert all(own <= set(index[k]) for own, k in zip(SETS, block, strict=True))
    assert blocks_of([frozenset(range(9)), frozenset({1})], 9)[0].tolist() == [list(range(9))]


def test_products_are_those_of_the_whole_matrix():
    rng = np.random.default_rng(1)
    tangent, dense = blocked(rng)
    some, numbers, square = rng.normal(size=(len(dense), 3)), rng.normal(size=(9, 2)), rng.normal(size=(9, 9))
    npt.assert_array_equal(tangent.toarray(), dense)
    npt.assert_allclose(tangent.gram(), dense.T @ dense, rtol=1e-12, atol=1e-12)
    npt.assert_allclose(tangent.against(some), dense.T @ some, rtol=1e-12, atol=1e-12)
    npt.assert_allclose(tangent @ numbers, dense @ numbers, rtol=1e-12, atol=1e-12)
    npt.assert_allclose(tangent.squares(square), np.einsum("ij,jk,ik->i", dense, square, dense), atol=1e-11)
    npt.assert_allclose(tangent.norms(), np.linalg.norm(dense, axis=0), rtol=1e-12)
    mask = np.arange(9) % 3 > 0
    npt.assert_array_equal(tangent.columns(mask).toarray(), dense[:, mask])
    npt.assert_array_equal(tangent.append(some).toarray(), np.column_stack([dense, some]))
    npt.assert_allclose(
        tangent.sums(groups(), "run", some[:, 0]).toarray(),
        groups().sums(dense * some[:, :1], "run"),
        atol=1e-12,
    )


@pytest.mark.parametrize("dependent", [False, True])
def test_an_orthonormal_basis_spans_what_the_whole_matrix_spans(dependent):
    rng = np.random.default_rng(2)
    tangent, dense = blocked(rng)
    tangent, dense = tangent.append(rng.normal(size=len(dense))), None
    if dependent:  # a column within a block, and one that blocks share
        place = tangent.layout.places
        tangent.values[tangent.layout.block == place[:, 4].argmax()] = 0.0
        tangent = tangent.append(tangent.toarray()[:, [0]] + tangent.toarray()[:, [9]])
    dense = tangent.toarray()
    basis = tangent.orthonormal(1e-9)
    expected = orthonormal(dense / np.maximum(np.linalg.norm(dense, axis=0), 1e-300))
    whole = basis.toarray()
    assert basis.shape == expected.shape
    npt.assert_allclose(whole.T @ whole, np.eye(whole.shape[1]), atol=1e-12)
    npt.assert_allclose(whole @ (whole.T @ expected), expected, atol=1e-10)


def test_whitening_and_restricted_likelihood_by_blocks_are_those_of_the_whole():
    rng = np.random.default_rng(3)
    tangent, dense = blocked(rng)
    force = rng.normal(30.0, 5.0, len(dense))
    loads = np.column_stack([np.ones_like(force), force])
    parts = (
        Component("stroke", "offset", 0.1),
        Component("run", "gain", 0.01),
        Component("specimen", "gain", 0.02),
    )
    whitening = Whitening(Scatter(0.3, 0.01, parts, 1.5, 2.0), loads, groups())
    residual = whitening(rng.normal(size=(len(dense), 1)))[:, 0]
    for found, expected in zip(
        whitening.normal(tangent, residual), whitening.normal(Tangent.dense(dense), residual), strict=True
    ):
        npt.assert_allclose(found, expected, rtol=1e-10, atol=1e-10)
    npt.assert_allclose(whitening.of(tangent).toarray(), whitening(dense), atol=1e-12)
    means, number = tangent.means(groups(), "stroke"), groups().starts["stroke"].size
    kinds = [
        ("stroke", "offset"),
        ("stroke", "gain"),
        ("run", "offset"),
        ("run", "gain"),
        ("specimen", "gain"),
    ]
    given = (rng.normal(size=number), rng.uniform(0.1, 0.3, number), groups().means(loads, "stroke"))
    at = np.array([0.1, 1e-4, 0.2, 1e-4, 2e-4])
    answers = []
    for basis in (means.orthonormal(1e-9), Tangent.dense(orthonormal(means.toarray()))):
        answers.append(RestrictedLikelihood(GroupMeans(*given, groups().at("stroke")), basis, kinds)(at))
    npt.assert_allclose(answers[0][0], answers[1][0], rtol=1e-11)
    npt.assert_allclose(answers[0][1], answers[1][1], rtol=1e-8)


def test_a_column_per_specimen_is_taken_out_with_the_tangent():
    rng = np.random.default_rng(4)
    tangent, dense = blocked(rng)
    code, load = groups().codes["specimen"], rng.uniform(1.0, 2.0, len(dense))
    load[code == 3] = 0.0
    own = OwnColumns(code, load)
    basis = tangent.orthonormal(1e-9, project_out=own.project_out)
    columns = rng.normal(size=(len(dense), 2))
    each = load[:, None] * (code[:, None] == np.unique(code[load > 0]))
    expected = orthonormal(
        np.column_stack([dense / np.linalg.norm(dense, axis=0), each / np.linalg.norm(each, axis=0)])
    )
    assert own.count + basis.shape[1] == expected.shape[1]
    left = columns - expected @ (expected.T @ columns)
    npt.assert_allclose(basis.project_out(own.project_out(columns)), left, atol=1e-10)
    npt.assert_allclose(basis.project_out(own.project_out(columns[:, 0])), left[:, 0], atol=1e-10)
