import os
import re
from pathlib import Path

import pytest
from simulation_helpers import ONE_CONDITION, effect, tree

from sealfit.errors import ConfigError, OutError, RequestError
from sealfit.simulation import Spec, load_spec, load_truth, simulate, truth_path

SAMPLE = Path(__file__).parents[1] / "sample_data"
SMALL = Spec(design={**ONE_CONDITION, "repeats": 2}, noise=[{"kind": "white", "sd_N": 0.1}])


def test_the_same_spec_gives_the_same_bytes_and_another_seed_others(tmp_path):
    simulate(SMALL, tmp_path / "a")
    simulate(SMALL, tmp_path / "b")
    simulate(SMALL.model_copy(update={"seed": 2}), tmp_path / "c")
    assert tree(tmp_path / "a") == tree(tmp_path / "b")
    assert truth_path(tmp_path / "a").read_bytes() == truth_path(tmp_path / "b").read_bytes()
    a, c = tree(tmp_path / "a"), tree(tmp_path / "c")
    assert a.keys() == c.keys()
    assert all(a[name] != c[name] for name in a)


def test_a_simulated_folder_is_replaced_whole(tmp_path):
    simulate(SMALL, tmp_path / "a")
    simulate(
        SMALL.model_copy(update={"design": SMALL.design.model_copy(update={"repeats": 1})}), tmp_path / "a"
    )
    assert len(list((tmp_path / "a" / "traces").iterdir())) == 3
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a", "a.truth.json"]


def test_a_foreign_folder_is_refused_and_left_as_it_was(tmp_path):
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "mine.csv").write_text("1\n")
    with pytest.raises(OutError, match=r"holds 'mine\.csv', which simulate did not write"):
        simulate(SMALL, tmp_path / "a")
    assert tree(tmp_path) == {"a/mine.csv": b"1\n"}


def test_a_file_added_to_a_simulated_folder_is_not_lost(tmp_path):
    simulate(SMALL, tmp_path / "a")
    (tmp_path / "a" / "traces" / "notes.txt").write_text("mine")
    before = tree(tmp_path)
    with pytest.raises(OutError, match=r"traces/notes\.txt"):
        simulate(SMALL.model_copy(update={"seed": 2}), tmp_path / "a")
    assert tree(tmp_path) == before


def test_a_foreign_truth_file_and_a_plain_file_are_refused(tmp_path):
    (tmp_path / "a.truth.json").write_text("{}")
    with pytest.raises(OutError, match=r"a\.truth\.json: was not written by simulate"):
        simulate(SMALL, tmp_path / "a")
    (tmp_path / "c.truth.json").mkdir()
    with pytest.raises(OutError, match=r"c\.truth\.json: was not written by simulate"):
        simulate(SMALL, tmp_path / "c")
    (tmp_path / "b").write_text("")
    with pytest.raises(OutError, match="is a file"):
        simulate(SMALL, tmp_path / "b")
    for text in ("{}", "[" * 4_000 + "]" * 4_000):
        (tmp_path / "a.truth.json").write_text(text)
        with pytest.raises(RequestError, match="is not the truth of a simulated campaign"):
            load_truth(tmp_path / "a.truth.json")


def test_a_failure_leaves_the_last_campaign_and_no_litter(tmp_path, monkeypatch):
    simulate(SMALL, tmp_path / "a")
    before = tree(tmp_path)
    real = os.replace

    def full(source, target):
        if Path(source).name == "new":
            raise OSError(28, "No space left on device")
        return real(source, target)

    monkeypatch.setattr("sealfit.simulation.os.replace", full)
    with pytest.raises(OutError, match="No space left on device"):
        simulate(SMALL.model_copy(update={"seed": 2}), tmp_path / "a")
    assert tree(tmp_path) == before


def test_a_ctrl_c_half_way_brings_the_last_campaign_back(tmp_path, monkeypatch):
    simulate(SMALL, tmp_path / "a")
    before = tree(tmp_path)
    real = os.replace

    def interrupted(source, target):
        if Path(source).name == "new":
            raise KeyboardInterrupt
        return real(source, target)

    monkeypatch.setattr("sealfit.simulation.os.replace", interrupted)
    with pytest.raises(KeyboardInterrupt):
        simulate(SMALL.model_copy(update={"seed": 2}), tmp_path / "a")
    assert tree(tmp_path) == before


def test_an_effect_that_gives_no_number_is_said_and_nothing_written(tmp_path):
    with pytest.raises(ConfigError, match=r"no number in traces/.*Check their parameters"):
        simulate(Spec(design=ONE_CONDITION, effects=[effect("log(displacement_mm - 20)")]), tmp_path / "a")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("sed = 1", "unknown key 'sed'"),
        ("[design]\nspeed = 3", r"toml:2: unknown key 'design\.speed'"),
        (
            "seed = 1.5\n[design]\ndirections = [1, 2]",
            r"line 1: key 'seed': .* line 3: key 'design\.directions\.1'",
        ),
        ("[design\n", "is not TOML"),
        ("seed = -1", "toml:1: key 'seed': -1: Input should be greater than or equal to 0"),
        ("[design]\nstroke_mm = 2.0", r"too short for a rise .* of 0\.306 mm"),
        ("[design]\nstrokes_per_file = 2", "needs directions"),
        ("[design]\nsampling_Hz = 10", "samples in the fastest stroke"),
        ("[design]\ndays = [1, 1]", "names a value twice"),
        ("[physics]\nsigma_0 = 2", r"make it 516, or raise physics\.sigma_0"),
        ("[physics]\nv_s = nan", r"physics\.v_s"),
        ('[[noise]]\nkind = "pink"', "noise.0"),
        ('[[noise]]\nkind = "white"\nsd_N = -1', r"noise\.0\.white\.sd_N"),
        ('[[effects]]\nid = "expression"', "expression' and formula belong together"),
        ('[[effects]]\nid = "expression"\nformula = "humidity"', "no channel 'humidity'; known are time_s"),
        ('[[effects]]\nid = "expression"\nformula = "open(1)"', r"'open\(1\)' is not allowed"),
        ('[[effects]]\nid = "levels"\nchannels = ["repeat"]', "levels needs one channel"),
        (
            '[[channels]]\nkind = "category"\nname = "batch"\nlabels = ["A", "B"]\n'
            '[[effects]]\nid = "levels"\nchannels = ["batch"]\nparameters = {C = 0.1}',
            "'C' is no label of batch",
        ),
        ('[[effects]]\nid = "no_such_effect"', "there is no such effect. Known: "),
        ('[[effects]]\nid = "zero_ofset"', "there is no such effect. Did you mean 'zero_offset'"),
        ('[[channels]]\nkind = "constant"\nname = "load_N"\nvalue = 1', "'load_N' is taken"),
        ('[[channels]]\nkind = "category"\nname = "batch"', "give labels"),
        (
            '[design]\norder = "undated"\n[[channels]]\nkind = "slow"\nname = "lab_C"',
            "drifts with the calendar",
        ),
    ],
)
def test_a_wrong_spec_is_refused_with_its_fix(tmp_path, text, words):
    path = tmp_path / "spec.toml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=words) as raised:
        load_spec(path)
    assert raised.value.file == str(path)
    assert raised.value.fix


def test_a_missing_spec_is_said(tmp_path):
    with pytest.raises(ConfigError, match="cannot be read"):
        load_spec(tmp_path / "none.toml")


def test_the_sample_campaign_is_written_again_byte_for_byte(tmp_path):
    simulate(load_spec(SAMPLE / "simulated.spec.toml"), tmp_path / "simulated")
    assert tree(tmp_path / "simulated") == tree(SAMPLE / "simulated")
    assert truth_path(tmp_path / "simulated").read_bytes() == truth_path(SAMPLE / "simulated").read_bytes()


def test_the_sample_campaign_is_small_and_says_nothing_of_its_effect():
    files = tree(SAMPLE / "simulated")
    assert sum(len(content) for content in files.values()) < 3e6
    for content in files.values():
        header = content.split(b"\n", 1)[0]
        assert b"distance" not in header
        assert b"warming" not in header


def test_every_key_of_a_spec_is_in_the_readme():
    text = (SAMPLE / "README.md").read_text("utf-8")
    keys = set()

    def walk(schema):
        for name, entry in schema.get("properties", {}).items():
            keys.add(name)
            walk(entry)
        for entry in schema.get("$defs", {}).values():
            walk(entry)

    walk(Spec.model_json_schema())
    keys -= {"physics", "design", "effects", "channels", "noise", "growth", "series"}  # named as tables
    assert len(keys) > 60
    written = set(re.findall(r"\w+", " ".join(re.findall(r"`([^`]+)`", text))))
    assert sorted(keys - written) == []
