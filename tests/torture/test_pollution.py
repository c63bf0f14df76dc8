"""The suite of polluted input in a short form; benchmarks/torture/pollution.py is the long one."""

import pytest
from polluters import Polluted, polluted, text_of
from pollution import BAD, CONFIG, config_outcomes, format_outcomes, scored, text_outcomes, trace_rows

from sealfit.errors import Fault


@pytest.mark.parametrize(("name", "step"), [("trace", 37), ("runs.csv", 37), ("values", 11), ("points", 41)])
def test_no_number_is_wrong_no_row_is_lost_and_no_fault_is_a_traceback(tmp_path, name, step):
    found = text_outcomes(name, tmp_path, 1, step=step)
    assert len(found) > 10
    assert [one for one in found if one.verdict in BAD or not one.placed] == []


def test_configs_are_read_as_they_are_or_refused_in_a_line(tmp_path):
    found = config_outcomes(tmp_path)
    assert len(found) > 100
    assert [one for one in found if one.verdict in BAD] == []


def test_files_of_other_formats_that_are_cut_or_altered_are_told(tmp_path):
    found = format_outcomes(tmp_path, 1, step=23)
    assert {one.input for one in found} == {"xlsx", "tdms", "mat", "parquet"}
    assert [one for one in found if one.verdict in BAD] == []


def test_every_kind_of_pollution_is_at_every_place():
    found = list(polluted(trace_rows(1, 8), numbers=[0, 1, 2, 3]))
    assert len(found) > 700
    assert len({one.kind for one in found}) > 25
    assert {one.row for one in found if one.kind == "delimiter missing"} == {0, 1, 2, 4, 8}
    (plain,) = (one for one in found if one.kind == "none")
    assert plain.raw.decode() == text_of(trace_rows(1, 8))
    assert all(isinstance(one, Polluted) for one in found)


@pytest.mark.parametrize(
    ("rows", "faults", "verdict"),
    [
        ({0: {"F": 1.0}, 1: {"F": 2.0}}, [], "exact"),
        ({0: {"F": 1.0}, 1: {"F": 3.0}}, [], "wrong"),
        ({0: {"F": 1.0}, 7: {"F": 2.0}}, [], "wrong"),
        ({0: {"F": 1.0}}, [], "lost"),
        ({0: {"F": 1.0}}, [Fault("a", "b", line=3, action="row left out")], "left out"),
        ({0: {"F": 1.0}}, [Fault("a", "b", line=3, action="kept")], "lost"),
    ],
)
def test_the_judge_sees_wrong_and_lost_rows(rows, faults, verdict):
    from pollution import Read, judged

    one = Polluted("none", "", b"", 2)
    clean = {0: {"F": 1.0}, 1: {"F": 2.0}}
    assert judged("trace", one, lambda raw: Read(rows, faults), clean, []).verdict == verdict


def test_an_error_that_is_not_ours_is_a_traceback():
    from pollution import judged

    def broken(raw):
        raise IndexError

    assert judged("trace", Polluted("none", "", b"", 2), broken, {}, []).verdict == "traceback"


def test_the_score_of_a_file_is_that_of_pollock():
    clean = [["t", "F"], ["0", "1.50"], ["1", "2"]]
    assert scored(["t", "F"], [["0.0", "1.5"], ["1", "2"]], clean) == [1.0] * 10
    success, *measures = scored(["t", "F"], [["0", "1.5"]], clean)
    assert success == 1
    assert measures[:3] == [1, 1, 1]  # the header
    assert measures[3:6] == pytest.approx([1, 0.5, 2 / 3])  # records: one of two is there
    assert measures[6:] == pytest.approx([1, 4 / 6, 0.8])  # cells: four of six
    assert CONFIG
