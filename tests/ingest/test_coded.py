import math

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from sealfit.ingest.categorical import Coded, columns_of, in_order, overlaid

cells = st.lists(st.sampled_from([None, "a", "b", "1", 1.0, -0.0, 0.0, 2.5]), min_size=1, max_size=12)


def written(column):
    return [repr(cell) for cell in column]


@given(cells)
def test_cells_come_back_as_they_were(given_cells):
    column = Coded.of(given_cells)
    assert written(column.cells()) == written(given_cells)
    assert written(column[i] for i in range(len(given_cells))) == written(given_cells)
    assert column.known.tolist() == [cell is not None for cell in given_cells]


@given(cells, st.data())
def test_some_files_have_their_cells_and_no_other_values(given_cells, data):
    files = data.draw(st.lists(st.integers(0, len(given_cells) - 1), max_size=8))
    taken = Coded.of(given_cells).take(np.array(files, int))
    assert written(taken.cells()) == written(given_cells[i] for i in files)
    alone = Coded.of(given_cells[i] for i in files)
    assert (taken.codes.tolist(), written(taken.values)) == (alone.codes.tolist(), written(alone.values))


@given(cells, st.data())
def test_cells_that_are_put_or_laid_over_are_there(given_cells, data):
    n = len(given_cells)
    put = data.draw(st.dictionaries(st.integers(0, n - 1), st.sampled_from(["a", "new", 3.0])))
    wanted = [put.get(i, cell) for i, cell in enumerate(given_cells)]
    assert written(Coded.of(given_cells).put(put).cells()) == written(wanted)
    over = Coded.of(put.get(i) for i in range(n)).over(Coded.of(given_cells))
    assert written(over.cells()) == written(wanted)


def test_words_that_become_equal_are_one_value():
    column = Coded.of([" a", "a", None, "b"]).map(str.strip)
    assert column.values == ["a", "b"]
    assert column.codes.tolist() == [0, 0, -1, 1]
    assert Coded.of([math.nan, 1.0, None]).where(math.isnan).tolist() == [True, False, False]


def test_the_last_source_that_says_something_is_believed():
    header = columns_of([{"days": "99", "oven": "B2"}, {"days": "99"}])
    table = columns_of([{"load": "5"}, {"days": "4", "load": "6"}])
    whole = overlaid(header, table)
    assert {name: column.cells() for name, column in whole.items()} == {
        "days": ["99", "4"],
        "oven": ["B2", None],
        "load": ["5", "6"],
    }
    none = Coded.of([None, None])
    assert list(in_order({"late": Coded.of([None, "x"]), "none": none, **whole})) == ["days", "oven", "load", "late"]
