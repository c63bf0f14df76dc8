"""The tutorial is run as it is, and what it made is asked everything that a notebook may ask."""

import builtins
import doctest
import re
import shutil
import subprocess
import sys

import numpy as np
import numpy.testing as npt
import pandas as pd
import pytest
from matplotlib.figure import Figure
from page_helpers import DOCS, ROOT, assert_as_shown, called, examples, plain, ran, run

import sealfit
from sealfit import commands
from sealfit.closure.prediction_csv import ANSWERS
from sealfit.errors import OutError, RequestError, StaleError
from sealfit.notebook.plots import FIGURES
from sealfit.report.summary_lines import lifetime_lines
from sealfit.store import Store

TUTORIAL = DOCS / "tutorial.ipynb"
CONDITION = "temperature_C=60, compression_ratio_pct=80, aging_days=4"
KEYS = {
    "errors": ["error"],
    "effects": ["effect"],
    "effect_parameters": ["effect", "parameter"],
    "effect_curves": ["effect", "channel", "x"],
    "parameters": ["series", "condition", "parameter"],
    "laws": ["series", "quantity", "parameter"],
    "scatter": ["level"],
    "sensitivity": ["variable", "level", "acts_on"],
    "runs": ["file", "stroke"],
    "steady": ["file", "stroke"],
    "bins": ["file", "stroke", "bin"],
}
UNDRAWN = f"""
import sys

sys.path.append({str(ROOT / "tests")!r})
from drawing_helpers import undrawn

import sealfit.report.page

sealfit.report.page.draw = undrawn
"""  # no test looks at the drawings of the report: those of the notebook are its own
FORCES = [name for name in ANSWERS if name.endswith("_N")]
POINTS = pd.DataFrame(
    {
        "temperature_C": [60, 60, 80, 23],
        "compression_ratio_pct": [80, 80, 80, 100],
        "aging_days": [4, 12, 16, 0],
        "speed_mm_s": [3.0, 0.7, 40.0, 1 / 3],
        "load_N": 49.03,
        "distance_mm": [20.0, 5.0, 35.0, 10.1],
    },
    index=["a", "b", "c", "d"],
)


@pytest.fixture(scope="module")
def tutorial(tmp_path_factory):
    """The tutorial after it was run, and the folder in which it was."""
    import nbformat
    from nbclient import NotebookClient

    folder = tmp_path_factory.mktemp("tutorial")
    (folder / "docs").mkdir()
    shutil.copytree(ROOT / "sample_data" / "simulated", folder / "sample_data" / "simulated")
    document = nbformat.read(TUTORIAL, as_version=4)
    document.cells.insert(0, nbformat.v4.new_code_cell(UNDRAWN))
    client = NotebookClient(document, timeout=None, resources={"metadata": {"path": str(folder / "docs")}})
    return client.execute(), folder


@pytest.fixture(scope="module")
def out(tutorial):
    return tutorial[1] / "docs" / "tutorial-results"


@pytest.fixture(scope="module")
def clone(tutorial, out):
    """The folder of the tutorial with its results where pages of the documentation have them."""
    (tutorial[1] / "results").symlink_to(out)
    return tutorial[1]


@pytest.fixture(scope="module")
def results(out):
    return sealfit.open(str(out))


# ---------------------------------------------------------------- tutorial and documents
def test_the_tutorial_finds_what_the_simulator_hid(results):
    assert results.verdict["verdict"].tolist() == ["closed"]
    assert results.effects["id"].tolist() == ["warming_distance"]
    found = results.effect_parameters.set_index("parameter")
    for name, true in {"A": 0.06, "s_0": 10.0}.items():  # sample_data/simulated.spec.toml
        assert found.loc[name, "lo95"] < true < found.loc[name, "hi95"]
    assert found["unit"].to_dict() == {"A": "", "s_0": "mm"}


def test_the_tutorial_shows_it(tutorial):
    code = {cell.source: cell.outputs for cell in tutorial[0].cells if cell.cell_type == "code"}
    (shown,) = (output.data for output in code["results"])
    assert "<b>closed</b>: one effect was added" in shown["text/html"]
    (run,) = (outputs for source, outputs in code.items() if "sealfit.run" in source)
    assert {output.name for output in run} == {"stdout"}
    lines = "".join(output.text for output in run).splitlines()
    assert "reading trace files: 162 of 162" in lines
    assert [line for line in lines if "still at work" not in line][-1] == "drawing the report"
    pictures = [
        source for source, outputs in code.items() if any("image/png" in o.get("data", ()) for o in outputs)
    ]
    assert sum("results.plot." in source for source in pictures) == 3
    assert len(pictures) == 5


def test_the_tutorial_is_kept_without_what_it_shows():
    import nbformat

    code = [cell for cell in nbformat.read(TUTORIAL, as_version=4).cells if cell.cell_type == "code"]
    assert len(code) > 10
    assert all(not cell.outputs and cell.execution_count is None for cell in code)


def test_the_page_about_enough_runs_prints_what_it_says(clone):
    assert_as_shown(ran(DOCS / "how-to" / "enough-runs.md", clone))


def test_the_examples_of_commands_on_results_run(clone, monkeypatch):
    POINTS.to_csv(clone / "points.csv", index=False)
    lifetimes = [command.replace("OUT", "results") for command in plain(DOCS / "explanation" / "fits.md")]
    assert len(lifetimes) == 2
    for command in [*examples(of_results=True), *lifetimes]:
        assert called(command, clone, monkeypatch)


def test_the_readme_shows_what_make_demo_prints(clone):
    text = (ROOT / "README.md").read_text("utf-8")
    shown = re.findall(r"^    ((?:verdict|   |error|noise).*)$", text, re.MULTILINE)
    assert len(shown) == 4
    printed = run("sealfit run sample_data/simulated --out results", clone)
    assert all(line in printed for line in shown)


def test_the_page_about_notebooks_prints_what_it_says(clone, monkeypatch):
    page, known = DOCS / "how-to" / "notebook.md", {}
    monkeypatch.chdir(clone)
    (block,) = re.findall(r"```python\n(.*?)```", page.read_text("utf-8"), re.DOTALL)
    exec(block, known)
    failed, tried = doctest.testfile(str(page), module_relative=False, encoding="utf-8", globs=known)
    assert tried > 10
    assert not failed


# ---------------------------------------------------------------- tables
@pytest.mark.parametrize("name", KEYS)
def test_a_table_has_one_row_per_key(results, name):
    table = getattr(results, name)
    assert len(table)
    assert not table.duplicated(KEYS[name]).any()
    assert not table[KEYS[name]].isna().any(axis=None)


def test_parameters_hold_parameters_and_nothing_else(results):
    p = results.parameters
    assert p["parameter"].drop_duplicates().tolist() == [
        "mu_s",
        "mu_c",
        "v_s",
        "sigma_2",
        "sigma_0",
        "sigma_1",
    ]
    assert p[p.parameter == "mu_s"]["condition"].nunique() == 9
    assert (p.groupby(["series", "condition"]).size() == 6).all()


def test_unaged_rubber_starts_every_series(results):
    p = results.parameters
    mu_s = p[p.parameter == "mu_s"].pivot(
        index="aging_days", columns=["temperature_C", "compression_ratio_pct"], values="value"
    )
    assert mu_s.index.tolist() == [0, 1, 4, 8, 16]
    assert mu_s.columns.tolist() == [(60, 80), (80, 80)]
    assert mu_s.notna().all(axis=None)
    assert mu_s.loc[0].nunique() == 1
    assert (mu_s.diff().iloc[1:] < 0).all(axis=None)


def test_parameters_are_those_of_the_answer_beside_those_before(results, out):
    stored = {
        model: pd.read_parquet(out / f"steady_fit{ending}.parquet").set_index(["condition", "parameter"])[
            "value"
        ]
        for model, ending in (("value", "_after"), ("before", ""))
    }
    p = results.parameters
    for row in p[(p.condition == CONDITION) & p.parameter.isin(["mu_s", "v_s"])].to_dict("records"):
        for model, values in stored.items():
            assert row[model] == values[row["condition"], row["parameter"]]
    assert set(p["model"]) == {"after"}
    laws = results.laws
    assert laws["quantity"].drop_duplicates().tolist() == ["mu_s", "mu_c"]
    assert set(laws["parameter"]) == {"mu_0", "a", "b", "c"}
    assert (laws.query("parameter == 'mu_0'")["value"] > laws.query("parameter == 'mu_0'")["before"]).all()


def test_tables_have_their_units(results):
    assert results.runs.attrs["units"]["speed_mm_s"] == "mm/s"
    assert results.parameters.attrs["units"] == {
        "temperature_C": "°C", "compression_ratio_pct": "%", "aging_days": "d",
    }  # fmt: skip
    assert results.sensitivity.attrs["units"] == {"smallest_N": "N", "smallest_pct": "%"}
    assert results.bins.attrs["meaning"]["speed_set_mm_s"] == (
        "commanded speed, magnitude; that of the run where a stroke has several; null if not given"
    )
    assert results.predict(POINTS).attrs["units"]["meas_lo95_N"] == "N"


def test_traces_of_one_condition(results, out):
    every, one = results.traces(), results.traces(condition=CONDITION)
    assert len(every) == results.table("inputs")["rows"].sum()
    assert set(one["condition"]) == {CONDITION}
    assert len(one) == (every["condition"] == CONDITION).sum()
    mean = results.mean_traces(CONDITION)
    assert mean["run_id"].nunique() == 6
    assert not mean.duplicated(["run_id", "direction", "displacement_mm"]).any()


def test_residuals_of_both_models(results):
    errors = results.errors.set_index("error")
    for model in ("before", "after"):
        rows = results.residuals(model)
        rms = np.sqrt(np.average(rows["residual_N"] ** 2, weights=rows["weight"]))
        assert rms == pytest.approx(errors.loc["rmse_N", model], rel=1e-6)


@pytest.mark.parametrize(
    ("ask", "words"),
    [
        (
            lambda r: r.traces("temperature_C=60, compression_ratio_pct=80, aging_days=5"),
            "Did you mean '.*aging_days=.'",
        ),
        (lambda r: r.table("steady_fits"), r"there is no table 'steady_fits'\. Did you mean 'steady_fit'\?"),
        (lambda r: r.residuals("both"), r"there is no model 'both'\. Choose one of: after, before\."),
        (
            lambda r: r.predict(POINTS.drop(columns="distance_mm")),
            r"'distance_mm': is missing.*Add the column in mm",
        ),
        (lambda r: r.predict(POINTS.iloc[:0]), "has no rows"),
        (lambda r: r.predict(POINTS.assign(note="mine")), r"'note': is a column of the answer\. Rename it\."),
        (lambda r: r.lifetime("mu_x", threshold=0.7), "mu_x"),
    ],
)
def test_what_cannot_be_answered_says_why(results, ask, words):
    with pytest.raises(RequestError, match=words):
        ask(results)


# ---------------------------------------------------------------- what the commands answer
def test_a_prediction_is_the_commands_to_the_last_digit(results, out, tmp_path):
    POINTS.to_csv(tmp_path / "points.csv", index=False)
    commands.predict(out, tmp_path / "points.csv", tmp_path / "answers.csv")
    written = pd.read_csv(tmp_path / "answers.csv", dtype=str, keep_default_na=False)
    answers = results.predict(POINTS)
    assert answers.index.tolist() == POINTS.index.tolist()
    for name in FORCES:
        assert answers[name].tolist() == [float(text) for text in written[name]], name
    assert answers["extrapolated"].map(str).tolist() == written["extrapolated"].tolist()
    assert answers["note"].tolist() == written["note"].tolist()
    assert (answers["force_after_N"] > 0).all()


def test_points_as_words_are_points_as_numbers(results):
    npt.assert_array_equal(results.predict(POINTS.astype(str))[FORCES], results.predict(POINTS)[FORCES])
    npt.assert_array_equal(results.predict(POINTS.to_dict("list"))[FORCES], results.predict(POINTS)[FORCES])


def test_a_lifetime_is_the_commands(results, out):
    asked = {"threshold": 0.7, "temperature_C": 60.0}
    life = results.lifetime("mu_s", **asked)
    assert life == commands.lifetime(out, commands.LifetimeRequest(**asked))
    assert repr(life).splitlines() == lifetime_lines(life)
    assert life["days"] > 1
    shown = sealfit.Lifetime({**life, "form": "a < b"})._repr_html_()
    assert "a &lt; b" in shown
    with pytest.raises(RequestError, match="--threshold -1 is never reached: friction is above 0"):
        results.lifetime("mu_s", threshold=-1.0, temperature_C=60.0)


# ---------------------------------------------------------------- plots
def test_every_figure_of_the_report_is_a_function(out):
    assert {path.stem for path in (out / "plots").glob("*.svg")} == set(FIGURES) - {"refused"}


@pytest.mark.parametrize("name", sorted(set(FIGURES) - {"refused"}))
def test_a_plot_is_a_figure_that_a_notebook_shows(results, name):
    figure = getattr(results.plot, name)()
    assert isinstance(figure, Figure)
    assert all(ax.has_data() for ax in figure.axes)
    assert figure.axes
    assert figure._repr_png_().startswith(b"\x89PNG")


def test_a_figure_without_data_says_so(results, monkeypatch):
    with pytest.raises(RequestError, match="nothing to draw in the figure 'refused'"):  # nothing was
        results.plot.refused()
    monkeypatch.setattr(
        "sealfit.notebook.plots.draw_all", lambda tables, closure, config: {"force_speed": None}
    )
    with pytest.raises(
        RequestError, match=r"nothing to draw in the figure 'aging'\. They have: force_speed\."
    ):
        results.plot.aging()


# ---------------------------------------------------------------- what is shown
def test_results_show_verdict_errors_and_effects(results):
    shown = results._repr_html_()
    assert "<b>closed</b>: one effect was added; no significant residual remains" in shown
    assert shown.count("<table") == 3
    assert "rms error, held-out runs" in shown
    assert "warming by sliding (distance)" in shown
    assert repr(results).startswith("verdict     closed: one effect was added")


def test_names_in_what_is_shown_are_escaped(results, monkeypatch):
    closure = Store.open(results.out).read_json("closure")
    effect = {**closure["effects"][0], "id": "<i>id</i>", "label": "a & <b>b</b>", "channels": ["<script>"]}
    changed = {**closure, "effects": [effect]}
    monkeypatch.setattr(Store, "read_json", lambda store, name: changed)
    shown = results._repr_html_()
    assert "a &amp; &lt;b&gt;b&lt;/b&gt;" in shown
    for text in ("<script>", "<i>", "<b>b"):
        assert text not in shown


# ---------------------------------------------------------------- stale and missing results
def test_stale_results_are_not_shown(results, tutorial):
    path = next((tutorial[1] / "sample_data" / "simulated" / "traces").glob("*.csv"))
    kept = path.read_bytes()
    path.write_bytes(kept.replace(b"\n", b"\n\n", 1))
    try:
        for ask in (
            lambda: results.verdict,
            lambda: results.parameters,
            lambda: results.runs,
            lambda: results.traces("unaged"),
            lambda: results.plot.aging(),
            lambda: results.predict(POINTS),
            lambda: results.lifetime("mu_s", threshold=0.7, temperature_C=60.0),
        ):
            with pytest.raises(StaleError, match=r"inputs changed .*Run: sealfit ingest"):
                ask()
        for shown in (repr(results), results._repr_html_()):
            assert "ingest is stale: inputs changed" in shown
            assert "closed" not in shown
    finally:
        path.write_bytes(kept)
    assert results.verdict["verdict"].tolist() == ["closed"]


def test_missing_results_name_the_command_and_leave_what_is_there(out, tmp_path):
    copy = tmp_path / "copy"
    shutil.copytree(out, copy)
    results = sealfit.open(copy)
    (copy / "closure.json").unlink()
    with pytest.raises(StaleError, match=r"closure.json is missing.*Run: sealfit close-loop"):
        _ = results.errors
    assert len(results.table("steady_fit"))
    shutil.rmtree(copy)
    with pytest.raises(OutError, match="there is no such folder"):
        _ = results.runs


def test_a_folder_without_results_is_refused(tmp_path):
    with pytest.raises(OutError, match="holds no results of sealfit"):
        sealfit.open(str(tmp_path))


def test_a_moved_campaign_is_warned_of(out, tutorial, tmp_path):
    folder = tutorial[1] / "sample_data"
    folder.rename(tmp_path / "elsewhere")
    try:
        with pytest.warns(UserWarning, match="is missing, so changes cannot be detected"):
            results = sealfit.open(out)
        with pytest.warns(UserWarning, match="is missing"):
            assert results.verdict["verdict"].tolist() == ["closed"]
    finally:
        (tmp_path / "elsewhere").rename(folder)


def test_a_second_run_redoes_nothing(tutorial, out, capsys):
    again = sealfit.run(str(tutorial[1] / "sample_data" / "simulated"), out=str(out))
    assert again.out == out
    assert capsys.readouterr().err.count("current, not redone") == 6


def test_a_fault_is_shown_in_one_line():
    with pytest.raises(OutError) as caught:
        sealfit.open("nowhere/at/all")
    assert caught.value._render_traceback_() == [f"OutError: {caught.value}"]


# ---------------------------------------------------------------- the package
def test_importing_the_package_loads_nothing_heavy():
    program = """
import sys, sealfit
assert "open" in dir(sealfit)
heavy = {"numpy", "pandas", "matplotlib", "scipy", "pyarrow"}
assert not heavy & set(sys.modules), heavy & set(sys.modules)
sealfit.open
assert "pandas" in sys.modules
assert not {"matplotlib", "scipy"} & set(sys.modules)
"""
    subprocess.run([sys.executable, "-c", program], check=True)


def test_what_the_package_has():
    names = {}
    exec("from sealfit import *", names)
    assert {"run", "Results"} <= set(names)
    assert names.get("open", builtins.open) is builtins.open
    with pytest.raises(AttributeError, match="module 'sealfit' has no attribute 'nothing'"):
        _ = sealfit.nothing
