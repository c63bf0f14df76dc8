import pickle
import subprocess
import sys
from pathlib import Path

import numpy as np
import numpy.testing as npt
import pytest
from user_effects import WORN_PATCH

from sealfit.effects import EFFECTS
from sealfit.effects.user import contract_fault, load_user_effects
from sealfit.errors import ConfigError


def write(folder: Path, name: str, text: str) -> Path:
    folder.mkdir(exist_ok=True)
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def test_a_good_file_gives_its_effect(tmp_path):
    write(tmp_path, "patch.py", WORN_PATCH)
    effects = load_user_effects(tmp_path)
    assert list(effects) == ["worn_patch"]
    # By hand: two millimetres from the middle, a fifth of the amplitude.
    shape = effects["worn_patch"].shape({"displacement_mm": np.array([2.0, 6.0])}, A=-0.5, x_0=4.0)
    npt.assert_allclose(shape, [-0.1, -0.1], rtol=1e-15)


def test_effects_come_in_the_order_of_the_files_and_others_are_let_be(tmp_path):
    write(tmp_path, "b.py", WORN_PATCH.replace("worn_patch", "second"))
    write(tmp_path, "a.py", WORN_PATCH.replace("worn_patch", "first"))
    write(tmp_path, "_draft.py", "raise RuntimeError('not to be run')")
    write(tmp_path, "notes.txt", "not Python")
    assert list(load_user_effects(tmp_path)) == ["first", "second"]


def test_a_described_function_is_an_effect_as_well(tmp_path):
    page = (Path(__file__).parents[2] / "docs" / "how-to" / "own-effects.md").read_text("utf-8")
    write(tmp_path, "patch.py", page.split("```python\n")[1].split("```")[0])
    (found,) = load_user_effects(tmp_path).values()
    assert (found.id, found.form) == ("worn_patch", "A / (1 + (x - x_0)^2)")
    inputs = {"displacement_mm": np.array([3.0, 4.0])}
    for one in (found, pickle.loads(pickle.dumps(found))):
        npt.assert_array_equal(one.shape(inputs, A=-0.2, x_0=3.0), [-0.2, -0.1])


def test_an_empty_folder_has_no_effects(tmp_path):
    assert load_user_effects(tmp_path) == {}


def test_an_imported_effect_of_the_catalogue_is_not_the_files_own(tmp_path):
    write(tmp_path, "patch.py", "from sealfit.effects.closed_forms import linear\n" + WORN_PATCH)
    assert list(load_user_effects(tmp_path)) == ["worn_patch"]


def test_the_catalogue_is_left_as_it_was(tmp_path):
    before = dict(EFFECTS)
    write(tmp_path, "patch.py", WORN_PATCH)
    load_user_effects(tmp_path)
    assert before == EFFECTS


def test_a_file_is_read_anew_each_time(tmp_path):
    path = write(tmp_path, "patch.py", WORN_PATCH)
    assert load_user_effects(tmp_path)["worn_patch"].label == "worn patch of the track"
    path.write_text(
        WORN_PATCH.replace('label="worn patch', 'label="torn patch')
    )  # the same size, within a second
    assert load_user_effects(tmp_path)["worn_patch"].label == "torn patch of the track"
    assert [p.name for p in tmp_path.iterdir()] == ["patch.py"]


def test_a_worker_process_that_never_loaded_the_folder_gets_the_effect(tmp_path):
    write(tmp_path / "effects", "patch.py", WORN_PATCH)
    effect = load_user_effects(tmp_path / "effects")["worn_patch"]
    (tmp_path / "effect.pickle").write_bytes(pickle.dumps(effect))
    code = (
        "import pickle, sys, numpy as np; effect = pickle.load(open(sys.argv[1], 'rb')); "
        "print(effect.id, float(effect.shape({'displacement_mm': np.array([4.0])}, A=-0.2, x_0=3.0)[0]))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path / "effect.pickle")],
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.split() == ["worn_patch", "-0.1"]


def refused(folder: Path, *, file: str, words: str) -> ConfigError:
    with pytest.raises(ConfigError, match=words) as caught:
        load_user_effects(folder)
    assert caught.value.file.endswith(file)
    assert caught.value.fix
    return caught.value


def test_refuses_a_missing_folder(tmp_path):
    refused(tmp_path / "gone", file="gone", words=r"no such folder.*loop\.effects_folder")


@pytest.mark.parametrize("taken", ["ripple", "smooth", "levels"])
def test_refuses_an_id_of_the_catalogue(tmp_path, taken):
    write(tmp_path, "patch.py", WORN_PATCH.replace('id="worn_patch"', f'id="{taken}"'))
    refused(tmp_path, file="patch.py", words=f"catalogue has an effect '{taken}' already.*another id")


def test_refuses_an_id_of_another_file(tmp_path):
    write(tmp_path, "a.py", WORN_PATCH)
    write(tmp_path, "b.py", WORN_PATCH)
    refused(tmp_path, file="b.py", words="another file of the folder has an effect 'worn_patch'")


def test_refuses_an_id_that_is_no_plain_name(tmp_path):
    write(tmp_path, "patch.py", WORN_PATCH.replace('id="worn_patch"', 'id="worn patch"'))
    refused(tmp_path, file="patch.py", words="'worn patch' is not a plain name")


def test_refuses_a_file_without_an_effect(tmp_path):
    write(tmp_path, "empty.py", "x = 1\n")
    refused(tmp_path, file="empty.py", words="holds no effect")


def test_names_the_line_of_a_file_that_cannot_be_run(tmp_path):
    write(tmp_path, "broken.py", "x = 1\ny = x / 0\n")
    error = refused(tmp_path, file="broken.py", words=r"cannot be run: ZeroDivisionError")
    assert error.line == 2
    assert isinstance(error.__cause__, ZeroDivisionError)


def test_names_the_line_of_a_file_that_is_not_python(tmp_path):
    write(tmp_path, "broken.py", "x = 1\n\ndef shape(:\n")
    assert refused(tmp_path, file="broken.py", words="cannot be run: SyntaxError").line == 3


def test_a_file_that_exits_is_refused_too(tmp_path):
    write(tmp_path, "broken.py", "raise SystemExit(3)\n")
    refused(tmp_path, file="broken.py", words="cannot be run: SystemExit")


def test_gives_the_contracts_own_words(tmp_path):
    write(tmp_path, "patch.py", WORN_PATCH.replace('("mu", "multiply")', '("speed", "multiply")'))
    refused(tmp_path, file="patch.py", words="effect worn_patch: cannot act on speed by multiply")


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("-0.1),\n)", "-0.2),\n)", r"gives -0\.1 where its worked value says -0\.2"),
        ("return A /", "return A**2 /", "worked value says"),
        ("return A / (1 +", "return -0.1 + 0 * A / (1 +", "not linear in A"),
        ("return A / (1 +", "return 1e-13 + A / (1 +", "not zero where A is zero"),
        ("return A / (1 +", "return 1.0 * A / (0.0 * x_0 +", r"gives \S+ where its worked value"),
        (
            "return A",
            'inputs["displacement_mm"] -= 0; inputs["displacement_mm"][:1] = 4.5; return A',
            "gives|edits its inputs",
        ),
        ("    return A", "    return A * np.ones((2, 1))", r"shape \(2, 3\) for three rows"),
        ("    return A", "    return A * inputs['speed_mm_s']", "fails with its worked inputs: KeyError"),
        ('source="Form: ours."', 'source=" "', "its source is empty"),
        ('acts_on=(("mu", "multiply"),)', "acts_on=()", "acts_on is empty"),
        ('reads=("displacement_mm",)', 'reads=("x", "displacement_mm")', "mixes 'x'"),
        ('reads=("displacement_mm",)', 'reads=("displacement_mm", "load_N")', "worked value gives no load_N"),
        ('{"A": -0.2, "x_0": 3.0}', '{"A": -0.2}', "gives parameters"),
        ("worked=({", "# ({", "no worked value"),
        ("(-100.0, 100.0)", '(-100.0, float("inf"))', "bounds of x_0 are not finite"),
        ('search="inside"', 'search="outside"', "search of x_0 is 'outside'"),
        ('Parameter("x_0"', 'Parameter("A"', "two parameters share a name"),
        ("** 2)", "** 2) / np.abs(x_0 - 100) * 97", "not finite at the bound x_0 = 100"),
    ],
)
def test_refuses_what_breaks_the_contract(tmp_path, old, new, words):
    text = WORN_PATCH.replace(old, new)
    assert text != WORN_PATCH
    write(tmp_path, "patch.py", text)
    refused(tmp_path, file="patch.py", words=f"effect 'worn_patch': .*({words})")


@pytest.mark.parametrize("effect", EFFECTS.values(), ids=EFFECTS)
def test_the_catalogue_itself_passes_what_users_must(effect):
    assert contract_fault(effect) == ""
