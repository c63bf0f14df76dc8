import pytest

from sealfit.config import Config
from sealfit.report.notation import (
    ConditionNames,
    channel_label,
    effect_label,
    plain,
    short,
    symbol_html,
    symbol_math,
    symbol_plain,
    true_units,
)
from sealfit.units import Units

TORQUE = Units(
    {"force": ("torque", "mN m"), "displacement": ("angle", "turn"), "speed": ("rotational speed", "rpm")},
    {"oil": "°C"},
)


@pytest.mark.parametrize(
    ("name", "html", "text"),
    [
        ("mu_s", "<i>μ</i><sub>s</sub>", "μ_s"),
        ("sigma_2", "<i>σ</i><sub>2</sub>", "σ_2"),
        ("tau", "<i>τ</i>", "τ"),
        ("A1", "<i>A</i><sub>1</sub>", "A_1"),
        ("rate", "rate", "rate"),
        ("my effect", "my effect", "my effect"),
        ("<script>", "&lt;script&gt;", "<script>"),
    ],
)
def test_symbols(name, html, text):
    assert str(symbol_html(name)) == html
    assert symbol_plain(name) == text


def test_a_dollar_in_a_name_starts_no_formula():
    assert symbol_math("price$") == r"price\$"
    assert plain("a$b$c") == r"a\$b\$c"


@pytest.mark.parametrize(
    ("column", "label"),
    [
        ("force_N", "torque (mN m)"),
        ("displacement_mm", "angle (turn)"),
        ("distance_mm", "sliding distance (turn)"),
        ("speed_mm_s", "rotational speed (rpm)"),
        ("speed_set_mm_s", "commanded rotational speed (rpm)"),
        ("time_s", "time (s)"),
        ("oil", "oil (°C)"),
        ("elapsed_h", "time since first run (h)"),
        ("batch", "batch"),
    ],
)
def test_channels_carry_their_true_unit(column, label):
    assert channel_label(column, TORQUE) == label


def test_sentences_of_others_lose_slot_names():
    text = true_units("force_N jumps at displacement_mm = 3; my_force_N stays", TORQUE)
    assert text == "torque (mN m) jumps at angle (turn) = 3; my_force_N stays"


@pytest.mark.parametrize(
    ("label", "words"),
    [
        ("zero offset of the force, added to force", "zero offset of the torque"),
        ("ripple, added to force, separate phase per stroke", "ripple, separate phase per stroke"),
        ("smooth in elapsed_h, added to force", "smooth in time since first run"),
    ],
)
def test_labels_of_effects_are_in_words_of_the_rig(label, words):
    assert effect_label({"label": label, "acts_on": "force", "channels": []}, TORQUE) == words


def test_conditions_are_values_with_units():
    names = ConditionNames(Config(condition=["pressure_bar", "oil", "material"], column_units={"oil": "°C"}))
    assert names("pressure_bar=2, oil=40, material=NBR, black") == "2 bar · 40 °C · NBR, black"
    assert names.parts("pressure_bar=2, oil=40, material=a=b") == {
        "pressure_bar": "2",
        "oil": "40",
        "material": "a=b",
    }


def test_a_number_without_unit_keeps_its_name():
    assert ConditionNames(Config(condition=["batch"]))("batch=3") == "batch 3"


@pytest.mark.parametrize("text", ["unaged", "unaged, NBR", "all"])
def test_other_series_stay_as_they_are(text):
    assert ConditionNames(Config())(text) == text


def test_long_names_are_cut_with_an_ellipsis():
    assert short("a" * 40, 10) == "a" * 9 + "…"
    assert short("abc", 10) == "abc"
