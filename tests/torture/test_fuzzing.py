"""The suite of fuzzing in a short form; benchmarks/torture/fuzzing.py is the long one."""

import forged as forging
import fuzzing
import pytest
from drawing_helpers import undrawn
from forged import forged, forged_tables
from fuzzing import BAD, INPUTS, crafted, drawn, fuzzed_input, fuzzed_results, limited


@pytest.fixture(scope="module", autouse=True)
def as_it_was():
    """The suite lets modules remember what they computed; other tests get them as they were.

    No command reads a plot: drawing them is most of the time that the results to damage take.
    """
    import importlib

    with pytest.MonkeyPatch.context() as patch:
        for module, name in fuzzing.COMPUTED:
            owner = importlib.import_module(module)
            patch.setattr(owner, name, getattr(owner, name))
        patch.setattr("sealfit.report.page.draw", undrawn)
        yield


@pytest.fixture(scope="module")
def results(tmp_path_factory, as_it_was):
    """A folder of results for all tests that damage some; each restores it."""
    return fuzzing.results_folder(tmp_path_factory.mktemp("results"), 1)


@pytest.fixture
def one_folder(results, monkeypatch):
    """Let the suite damage the folder of results that is there."""
    for module in (fuzzing, forging):
        monkeypatch.setattr(module, "results_folder", lambda work, seed: results)


def test_mutations_are_many_and_differ_from_the_file():
    found = list(drawn(b"time_s,force_N\n0,1\n1,2\n", [b"other"], 30, 1))
    assert len({raw for _, raw in found}) == len(found) == 30
    assert len({name.split()[0] for name, _ in found}) > 4
    assert found == list(drawn(b"time_s,force_N\n0,1\n1,2\n", [b"other"], 30, 1))


def test_what_takes_too_long_is_ended():
    def spin():
        with limited(0.05):
            while True:
                pass

    with pytest.raises(fuzzing.TooSlow):
        spin()


@pytest.mark.parametrize("name", [name for name in INPUTS if name != "points"])
def test_mutated_inputs_are_read_or_refused_in_a_line(tmp_path, monkeypatch, name):
    monkeypatch.setattr(fuzzing, "closed", lambda work, seed: work)  # of points only
    found = fuzzed_input(name, tmp_path, 5, 1)
    assert len(found) == 5
    assert [one for one in found if one.verdict in BAD] == []


def test_damaged_results_give_no_answer_and_are_made_again(tmp_path, one_folder):
    found = fuzzed_results(tmp_path, 1, 1, share=(0, 3), heal=9)
    assert len(found) > 40
    assert {"same", "refused", "healed"} <= {one.verdict for one in found}
    assert [one for one in found if one.verdict in BAD] == []


def test_no_python_is_run_from_crafted_results(tmp_path):
    found = crafted(tmp_path, 1)
    assert len(found) > 50
    assert [one for one in found if one.verdict in BAD] == []


def test_forged_results_with_right_checksums_end_in_an_answer_or_a_line(tmp_path, one_folder):
    found = forged(tmp_path, 1, 300)
    assert len(found) > 60
    assert {"read", "refused"} == {one.verdict for one in found}


def test_forged_tables_with_right_checksums_end_in_an_answer_or_a_line(tmp_path, one_folder):
    found = forged_tables(tmp_path, 1, 150)
    assert len(found) > 20
    assert {"read", "refused"} == {one.verdict for one in found}
