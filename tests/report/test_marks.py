import numpy as np
import numpy.testing as npt
import pytest
from matplotlib.figure import Figure

from sealfit.report.marks import draw_band, draw_bars


@pytest.fixture
def ax():
    return Figure().add_subplot()


def test_a_band_goes_there_below_and_back_above(ax):
    draw_band(ax, [1.0, 2.0], [3.0, 4.0], [5.0, 6.0], "#0072B2", 0.2)
    (path,) = ax.collections[0].get_paths()
    npt.assert_array_equal(path.vertices[:4], [[1, 3], [2, 4], [2, 6], [1, 5]])
    npt.assert_array_equal(ax.dataLim.get_points(), [[1, 3], [2, 6]])


def test_a_band_has_gaps_where_an_end_is_not_known(ax):
    low = np.array([0.0, 0.0, np.nan, 0.0, 0.0, 0.0])
    draw_band(ax, np.arange(6), low, np.add(low, [1, 1, 1, 1, np.nan, 1]), "#0072B2", 0.2)
    spans = [(path.vertices[:, 0].min(), path.vertices[:, 0].max()) for path in ax.collections[0].get_paths()]
    assert spans == [(0, 1), (3, 3), (5, 5)]


def test_a_band_that_is_nowhere_known_is_not_drawn(ax):
    draw_band(ax, [1.0, 2.0], [np.nan, np.nan], [1.0, 2.0], "#0072B2", 0.2)
    draw_band(ax, [], [], [], "#0072B2", 0.2)
    assert not ax.collections


def test_bars_stand_apart_and_end_in_caps(ax):
    draw_bars(ax, [1.0, 2.0], [5.0, 6.0], [0.5, 1.0], [0.25, 2.0], colour="#0072B2", width=0.8, cap=1.5)
    (bars,) = ax.lines
    npt.assert_array_equal(bars.get_xdata(), [1, 1, np.nan, 2, 2, np.nan])
    npt.assert_array_equal(bars.get_ydata(), [4.5, 5.25, np.nan, 5, 8, np.nan])
    assert (bars.get_marker(), bars.get_markersize()) == ("_", 3.0)
