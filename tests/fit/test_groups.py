import numpy as np
import numpy.testing as npt

from sealfit.fit.joint.rows import Groups


def test_sums_and_means_of_groups():
    groups = Groups.of({"file": np.array([0, 0, 1, 1, 1])})
    values = np.array([1.0, 3.0, 2.0, 4.0, 6.0])
    npt.assert_allclose(groups.means(values, "file"), [2.0, 4.0])
    npt.assert_allclose(groups.sums(np.column_stack([values, -values]), "file"), [[4.0, -4.0], [12.0, -12.0]])


def test_sums_of_a_level_are_those_of_the_values_that_are_given():
    groups = Groups.of({"stroke": np.array([0, 1, 2]), "file": np.array([0, 0, 1])})
    for columns in (np.eye(3), np.ones((3, 1))):
        npt.assert_array_equal(groups.sums(columns, "file"), [columns[:2].sum(axis=0), columns[2]])
        npt.assert_array_equal(groups.sums(columns, "stroke"), columns)


def test_no_rows_have_no_groups():
    groups = Groups.of({"file": np.zeros(0, int)})
    assert groups.means(np.zeros(0), "file").size == 0
    assert groups.means(np.zeros((0, 2)), "file").shape == (0, 2)
