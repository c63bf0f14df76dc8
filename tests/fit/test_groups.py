import numpy as np
import numpy.testing as npt

from sealfit.fit.joint.rows import Groups


def test_sums_and_means_of_groups():
    groups = Groups.of({"file": np.array([0, 0, 1, 1, 1])})
    values = np.array([1.0, 3.0, 2.0, 4.0, 6.0])
    npt.assert_allclose(groups.means(values, "file"), [2.0, 4.0])
    npt.assert_allclose(groups.sums(np.column_stack([values, -values]), "file"), [[4.0, -4.0], [12.0, -12.0]])


def test_no_rows_have_no_groups():
    groups = Groups.of({"file": np.zeros(0, int)})
    assert groups.means(np.zeros(0), "file").size == 0
    assert groups.means(np.zeros((0, 2)), "file").shape == (0, 2)
