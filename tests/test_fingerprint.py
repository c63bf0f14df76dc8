import os
from pathlib import Path

from hypothesis import given
from hypothesis import strategies as st

from sealfit.config import Config, Files, parse_config
from sealfit.store.manifest import ConfigCopy, Fingerprint, State, changes, fingerprint, step_keys

files = st.sampled_from([f"{folder}{name}.csv" for folder in ("", "one/", "two/") for name in "abcd"])
marks = st.one_of(
    st.just(Fingerprint()),
    st.builds(Fingerprint, st.integers(0, 9), st.integers(0, 9), st.sampled_from(["hash", "other", "third"])),
)
many = st.dictionaries(files, marks)


@given(many, st.randoms())
def test_keys_do_not_depend_on_the_order_of_the_inputs(known, random):
    shuffled = list(known.items())
    random.shuffle(shuffled)
    state = State(Path("campaign"), ConfigCopy.at(None))
    keys = step_keys(state, known, Config())
    assert step_keys(state, dict(shuffled), Config()) == keys
    assert step_keys(state, known | {"new.csv": Fingerprint(1, 1, "new")}, Config()) != keys


def test_changes_are_what_is_new_other_or_gone(tmp_path):
    for name in ("same", "other", "touched", "gone"):
        (tmp_path / f"{name}.csv").write_text(name)
    known = {path.name: fingerprint(path) for path in tmp_path.iterdir()}
    assert changes(tmp_path, known, Files()) == {}
    (tmp_path / "other.csv").write_text("OTHER")
    os.utime(tmp_path / "other.csv", ns=(7, 7))
    os.utime(tmp_path / "touched.csv", ns=(7, 7))
    (tmp_path / "gone.csv").unlink()
    (tmp_path / "new.csv").write_text("new")
    found = changes(tmp_path, known, Files())
    assert found.keys() == {"other.csv", "touched.csv", "gone.csv"}
    assert found["gone.csv"] == Fingerprint()
    ctime = found["touched.csv"].ctime_ns
    assert found["touched.csv"] == known["touched.csv"]._replace(mtime_ns=7, ctime_ns=ctime)
    assert found["other.csv"].sha256 != known["other.csv"].sha256
    globbed = parse_config("[files]\nglob = '*.csv'", "rig")
    assert changes(tmp_path, known, globbed.files).keys() == found.keys() | {"new.csv"}


def test_a_changed_file_whose_time_was_set_back_is_seen(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("1.25", "utf-8")
    known = {"a.csv": fingerprint(path)}
    path.write_text("7.25", "utf-8")
    os.utime(path, ns=(known["a.csv"].mtime_ns, known["a.csv"].mtime_ns))
    assert path.stat().st_mtime_ns == known["a.csv"].mtime_ns
    assert changes(tmp_path, known, Files())["a.csv"].sha256 != known["a.csv"].sha256
