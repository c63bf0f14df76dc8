import os

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sealfit.config import Config, parse_config
from sealfit.store.manifest import Fingerprint, Fingerprints, changes, fingerprint, step_keys

files = st.sampled_from([f"{folder}{name}.csv" for folder in ("", "one/", "two/") for name in "abcd"])
marks = st.one_of(
    st.just(Fingerprint()),
    st.builds(Fingerprint, st.integers(0, 9), st.integers(0, 9), st.sampled_from(["hash", "other", "third"])),
)
many = st.dictionaries(files, marks)


@given(many, many)
def test_columns_are_a_mapping_that_is_put_together_as_dictionaries_are(known, more):
    columns = Fingerprints.of(known)
    assert dict(columns) == known
    assert list(columns) == list(known)
    assert list((columns | more).items()) == list((known | more).items())
    assert dict(columns) == known  # which is not changed
    assert columns | {} is columns
    assert Fingerprints.of_columns(**columns.columns()) == columns


@given(many, st.lists(files, unique=True))
def test_what_is_taken_comes_in_the_order_asked_for_and_what_is_not_known_as_missing(known, wanted):
    taken = Fingerprints.of(known).take(wanted)
    assert list(taken.items()) == [(file, known.get(file, Fingerprint())) for file in wanted]


@given(many)
def test_readable_are_those_with_a_hash(known):
    readable = Fingerprints.of(known).readable()
    assert list(readable.items()) == [(file, mark) for file, mark in known.items() if mark.sha256]


@pytest.mark.parametrize("file", [["a"], ["a", "b", "c"], ["a", "a"]])
def test_columns_of_different_length_are_refused(file):
    with pytest.raises(ValueError, match="different length"):
        Fingerprints.of_columns(file, size=[1, 2], mtime_ns=[1, 2], sha256=["x", "y"])


@given(many, st.randoms())
def test_keys_do_not_depend_on_the_order_of_the_inputs(known, random):
    shuffled = list(known.items())
    random.shuffle(shuffled)
    keys = step_keys(Fingerprints.of(known), Config())
    assert step_keys(Fingerprints.of(dict(shuffled)), Config()) == keys
    assert step_keys(Fingerprints.of(known | {"new.csv": Fingerprint(1, 1, "new")}), Config()) != keys


def test_changes_are_what_is_new_other_or_gone(tmp_path):
    for name in ("same", "other", "touched", "gone"):
        (tmp_path / f"{name}.csv").write_text(name)
    known = Fingerprints.of({path.name: fingerprint(path) for path in tmp_path.iterdir()})
    assert changes(tmp_path, known, Config()) == {}
    (tmp_path / "other.csv").write_text("OTHER")
    os.utime(tmp_path / "other.csv", ns=(7, 7))
    os.utime(tmp_path / "touched.csv", ns=(7, 7))
    (tmp_path / "gone.csv").unlink()
    (tmp_path / "new.csv").write_text("new")
    found = changes(tmp_path, known, Config())
    assert found.keys() == {"other.csv", "touched.csv", "gone.csv"}
    assert found["gone.csv"] == Fingerprint()
    assert found["touched.csv"] == known["touched.csv"]._replace(mtime_ns=7)
    assert found["other.csv"].sha256 != known["other.csv"].sha256
    globbed = parse_config("[files]\nglob = '*.csv'", "rig")
    assert changes(tmp_path, known, globbed).keys() == found.keys() | {"new.csv"}
