import pandas as pd
import pytest
from report.made_campaigns import torque_campaign

from sealfit.config import Config
from sealfit.report.page import fit_badge
from sealfit.report.summary import of_fit, outlier_clause, quality_clause
from sealfit.report.words import acts, in_words, left_over, verdict

NUMBERS = {
    "rmse_N": 1.3,
    "rmse_runs_N": 0.9,
    "heldout_rmse_N": 1.4212,
    "heldout_extrapolated_rmse_N": None,
    "max_abs_N": 4.0,
    "mean_abs_pct": 3.0,
    "lack_of_fit_p": 0.0001,
}
WARMING = {
    "id": "warming_time",
    "label": "warming by sliding, factor on mu",
    "level": "trace",
    "channels": ["time_s"],
    "acts_on": "mu",
    "operation": "multiply",
    "form": "-A (1 - exp(-t / tau))",
    "named": True,
    "candidate": False,
    "parameters": [
        {"name": "A", "value": 0.061, "ci95": [0.055, 0.067], "unit": ""},
        {"name": "tau", "value": 4.02, "ci95": [3.61, 4.48], "unit": "s"},
    ],
    "p_value": 0.0005,
    "heldout_gain_N": 1.1,
    "alternatives": [],
}
RIPPLE = {
    **WARMING,
    "id": "my_own",
    "label": "ripple along displacement_mm, added to force",
    "channels": ["displacement_mm"],
    "acts_on": "force",
    "operation": "add",
    "parameters": [{"name": "lambda", "value": 5.02, "ci95": [5.01, 5.03], "unit": "mm"}],
}


def document(kind="closed", effects=(WARMING,), floor=0.2899, **left):
    after = {**NUMBERS, "heldout_rmse_N": 0.3121, "rmse_N": 0.31} if effects else NUMBERS
    left = {"rmse_N": 0.31, "level": None, "channel": None, "p_value": None, "significant": False, **left}
    found = {
        "verdict": kind,
        "before": NUMBERS,
        "after": after,
        "noise_floor_N": floor,
        "heldout_unit": "run",
        "sensitivity": [],
        "refused": [],
        "outlier_files": [],
    }
    found["fit_quality"] = {"state": "above_scatter", "ratio": 1.07, "p_value": 0.0002}
    return {**found, "effects": list(effects), "left": left}


def said(closure, config=None):
    text = str(verdict(closure, config or Config()))
    return text.replace("\u00a0", " ").replace("<i>", "").replace("</i>", "").replace("p &lt; ", "p < ")


def test_closed_says_which_effect_was_missing_and_the_errors():
    assert said(document()) == (
        "The declared model lacks an effect: warming by sliding. With it, the rms error on held-out runs "
        "falls from 1.42 N to 0.31 N (noise floor: 0.29 N). No significant residual remains. The error is "
        "1.1 times the scatter of repeats (lack of fit: p = 0.0002)."
    )


def test_candidates_are_not_among_the_effects():
    text = said(document(effects=(WARMING, RIPPLE, {**RIPPLE, "candidate": True})))
    assert text.startswith(
        "The declared model lacks 2 effects: warming by sliding and ripple along displacement. With them"
    )


def test_many_effects_are_named_once_each():
    text = said(document(effects=(WARMING, RIPPLE, RIPPLE, RIPPLE)))
    assert text.startswith(
        "The declared model lacks 4 effects: warming by sliding and ripple along displacement (3 of them). "
    )


def test_nothing_missing_gives_one_error():
    assert said(document("nothing_missing", effects=())) == (
        "No effect beyond the declared model is significant. The error is 1.1 times the scatter of repeats "
        "(lack of fit: p = 0.0002). The rms error on held-out runs is 1.42 N (noise floor: 0.29 N)."
    )


SEEN = {
    "variable": "displacement_mm",
    "level": "trace",
    "acts_on": "mu",
    "smallest_N": 0.5,
    "smallest_pct": 1.25,
    "files_needed": 40,
}
SEEN["cannot_tell"] = True


def test_nothing_missing_states_the_sensitivity():
    text = said({**document("nothing_missing", effects=()), "sensitivity": [SEEN]})
    assert "in percent of the force, are 1.2 % for displacement (mm) along strokes." in text


def test_nothing_missing_names_variables_that_show_no_effect_of_any_size():
    names = ("humidity_pct", "oil temp", "batch", "run_order", "aging_days")  # the last makes the conditions
    none = [
        {**SEEN, "variable": name, "level": "run", "smallest_N": None} for name in (*names, SEEN["variable"])
    ]
    text = said({**document("nothing_missing", effects=()), "sensitivity": [SEEN, *none]})
    others = "humidity (%) between runs, oil temp between runs, batch between runs and 1 more"
    assert f"displacement (mm) along strokes; no effect is detectable for {others}." in text


def test_cannot_tell_says_of_what_and_what_would_do():
    unseen = {
        **SEEN,
        "variable": "oil temp",
        "level": "run",
        "smallest_N": None,
        "smallest_pct": None,
        "files_needed": 12,
    }
    closure = {**document("cannot_tell", effects=()), "sensitivity": [SEEN, unseen]}
    text = said(closure)
    assert (
        "These files do not decide whether an effect is missing: displacement (mm) along strokes "
        "(detection limit 1.2 % of the force; 1 % needs about 40 files), "
        "oil temp between runs (no effect is detectable; at least 12 files are needed)."
    ) in text
    large = {**SEEN, "smallest_pct": 49.0, "files_needed": 310000}  # of four specimens
    text = said({**closure, "sensitivity": [large]})
    assert "detection limit 49 % of the force; 1 % needs more than 100 times as many files" in text


def test_unexplained_says_where_it_sits():
    left = {"channel": "displacement_mm oil temp", "level": "trace", "p_value": 0.0005}
    names = [{**SEEN, "variable": name, "cannot_tell": False} for name in ("displacement_mm", "oil temp")]
    where = "A significant residual remains along displacement (mm) and oil temp along strokes (p = 0.0005)."
    for effects in ((), (WARMING,)):
        text = said({**document("unexplained", effects=effects, **left), "sensitivity": names})
        assert where in text
        assert text.startswith("The declared model lacks an effect: warming") == bool(effects)


def test_an_error_that_grows_is_not_called_falling():
    closure = document()
    closure["after"] = {**closure["after"], "heldout_rmse_N": 1.6}
    assert "rises from 1.42 N to 1.60 N" in said(closure)


def test_without_repeats_the_floor_is_unknown():
    unknown = {"state": "unknown", "ratio": None, "p_value": None}
    text = said({**document(floor=None), "fit_quality": unknown})
    assert "(noise floor unknown: there are no repeats)." in text


def test_a_reason_of_some_conditions_is_said_to_be_theirs():
    fit = pd.DataFrame(
        {"condition": ["a", "b", "c"], "identified": False, "reason": ["few", "at most 7", "few"]}
    )
    fit = fit.assign(quantity="dynamic", parameter="sigma_1", unit="", value=1.0)
    assert of_fit(fit, "condition")["parameters"][0]["reason"] == "For example, a: few"
    assert of_fit(fit[::2], "condition")["parameters"][0]["reason"] == "few"


def test_without_held_out_errors_the_fitted_ones_are_named_so():
    closure = document()
    for stage in ("before", "after"):
        closure[stage] = {**closure[stage], "heldout_rmse_N": None}
    assert "the in-sample rms error (nothing could be held out) falls from 1.30 N to 0.31 N" in said(closure)
    for stage, error in (("before", 2.5), ("after", 1.8)):
        closure[stage] = {**closure[stage], "heldout_extrapolated_rmse_N": error}
    found = said(closure)
    assert "the rms error on held-out runs, all of them extrapolated, falls from 2.50 N to 1.80 N" in found


def test_the_units_are_the_declared_ones():
    made = torque_campaign()
    text = said(made.closure, made.config)
    assert "1.5 mN m (noise floor: 1.2 mN m)" in text


def test_labels_from_data_are_escaped():
    assert "&lt;script&gt;" in said(document(effects=({**WARMING, "label": "<script>alert(1)</script>"},)))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({}, "scales the friction coefficient <i>μ</i>"),
        ({"acts_on": "force"}, "scales the whole friction force"),
        ({"acts_on": "force", "operation": "add"}, "adds to the friction force"),
        ({"acts_on": "v_s", "operation": "add"}, "adds to <i>v</i><sub>s</sub>"),
    ],
)
def test_how_an_effect_acts(change, words):
    assert str(acts({**WARMING, **change}, Config())) == words


def test_a_significant_residual_below_the_scatter_of_repeats_is_said_beside_closed():
    left = {"channel": "displacement_mm", "level": "trace", "p_value": 0.0005}
    words = "What remains along displacement (mm) along strokes (p = 0.0005) is less than repeats scatter by."
    assert words in said(document(**left, significant=True))
    assert "The evidence of what remains along" in said(document(**left, significant=False))
    assert "No significant residual remains." in said(document(**{**left, "p_value": 0.2}, significant=False))


def test_what_is_not_decided_has_names_in_words():
    seen = {**SEEN, "variable": "dust_mg", "smallest_pct": None, "cannot_tell": True}
    refused = {"label": "linear in time_s, factor on mu_s", "p_value": 1e-4, "weak": True}
    closure = document() | {"sensitivity": [seen], "refused": [refused]}
    text = str(verdict(closure, Config()))
    assert "Not decided by these files: linear in time (s), factor on <i>μ</i><sub>s</sub> (p" in text
    assert "dust mg along strokes (no effect" in text
    seen |= {"variable": "specimen_id", "level": "condition", "files_needed": 40}
    text = str(verdict(document() | {"sensitivity": [seen], "refused": []}, Config()))
    assert "differences between specimens (too few specimens; at least 40 files are needed)" in text
    untold = verdict(closure | {"verdict": "cannot_tell"}, Config())
    assert "is missing: linear in time (s), factor on <i>μ</i><sub>s</sub> (p" in untold


def test_what_is_left_is_called_scatter_only_if_it_is():
    within = document() | {"fit_quality": {"state": "within_scatter", "ratio": 1.0, "p_value": 0.4}}
    apart = {"scatter": [{"level": "specimen", "sd_N": 1.0}], "noise_floor_N": 0.4}
    assert quality_clause(within | apart).startswith("apart from differences between specimens, the error is")
    assert "consistent with scatter" in left_over(within, Config())
    assert left_over(document(), Config()).endswith("No variable explains it.")
    left = {"channel": "displacement_mm", "level": "trace", "p_value": 0.0005, "significant": True}
    text = left_over(document("unexplained", **left), Config())
    assert "A significant residual remains along displacement (mm) along strokes (p = 0.0005)." in text
    assert "scatter" not in text
    weak = left_over(document(**left | {"significant": False}), Config())
    assert "The evidence of what remains along displacement (mm) along strokes (p = 0.0005) is weak." in weak
    few = left_over(document(**left | {"significant": False, "p_value": 1e-9}), Config())
    assert "(p = 1e-09) rests on too few specimens or runs." in few
    none = left_over(document(**left | {"significant": False, "p_value": 0.3}), Config())
    assert "No variable is significant. The smallest p-value: along displacement (mm)" in none


def test_why_the_lack_of_fit_is_not_known_is_said():
    unknown = {"fit_quality": {"state": "unknown", "ratio": None, "p_value": None}}
    assert "without repeats" in quality_clause({**unknown, "noise_floor_N": None})
    assert "too many parameters" in quality_clause({**unknown, "noise_floor_N": 0.1})


def test_a_lack_of_fit_below_the_scatter_of_repeats_is_not_called_a_multiple_of_it():
    small = {"fit_quality": {"state": "above_scatter", "ratio": 0.85, "p_value": 6e-4}, "noise_floor_N": 0.1}
    assert (
        "0.85 times the scatter of repeats, but a part of it is the same in all repeats ("
        in quality_clause(small)
    )
    assert fit_badge(small) == ("above_scatter", "Fit: a lack of fit, below the scatter of repeats")


def test_sentences_name_the_torque_where_it_is_measured():
    closure = {"refused": [], "sensitivity": []}
    text = in_words("ripple, added to force: less than 1 % of the force", closure, torque_campaign().config)
    assert text == "ripple, added to torque: less than 1 % of the torque"


def test_files_that_were_left_out_are_named():
    left_out = [{"file": "a_12.csv", "deviation_pct": -12.34, "p_value": 1e-6}]
    assert "a_12.csv (-12 %)" in said(document() | {"outlier_files": left_out})
    assert outlier_clause({"outlier_files": []}) == ""
    files = [{"file": f"{k}.csv", "deviation_pct": -12.34 + 5 * k, "p_value": 1e-6} for k in range(4)]
    one = "left out: a file whose force is far off what all others predict: 0.csv (-12 %)"
    assert outlier_clause({"outlier_files": files[:1]}) == one
    assert outlier_clause({"outlier_files": files}).endswith(
        "(-12 %), 1.csv (-7.3 %), 2.csv (-2.3 %) and 1 more"
    )
