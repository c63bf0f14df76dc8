"""Campaigns, configs and results of somebody else read, write and run nothing of the user's.

Expressions are in ../ingest/test_expression.py, folders of own effects in ../test_own_effects.py, the page's
Content-Security-Policy in ../report/test_page.py, Dask over TLS in ../test_cluster.py.
"""

import ast
import csv
import html.parser
import io
import json
import os
import re
import sys
import time
import tomllib
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from xml.etree import ElementTree

import pandas as pd
import pytest
from drawing_helpers import only_svg
from trace_helpers import HEADER, ROWS, campaign, config, csv_of

import sealfit
from sealfit import cli, commands
from sealfit.closure.prediction_csv import ANSWERS, read_points, write_answers
from sealfit.draft import draft
from sealfit.errors import CampaignError, ConfigError, OutError, SealfitError
from sealfit.ingest.campaign import ingest_campaign
from sealfit.pipeline import run
from sealfit.simulation import load_spec, simulate
from sealfit.store.staged_writes import LOCK

SOURCE = Path(sealfit.__file__).parent
DAYS = 'condition = ["aging_days"]\n'
RUNS = "file,aging_days,speed_mm_s\na.csv,0,5\nb.csv,0,5\n"

# ---------------------------------------------------------------- code
RUNS_TEXT = {
    "eval",
    "exec",
    "compile",
    "__import__",
    "system",
    "popen",
    "read_pickle",
    "query",
    "exec_module",
}
HARMLESS = ("re.compile", "regex.compile", "platform.system")
NEVER = {"marshal", "shelve", "dill", "cloudpickle", "joblib", "subprocess", "code", "runpy"}
# The user's own effects from a folder on the command line; work handed to processes that sealfit starts.
MAY = {"effects/user.py": {"compile", "exec"}, "engine/run_map.py": {"pickle"}}


def test_no_text_is_run_as_code_and_nothing_is_unpickled():
    found = {}
    for path in SOURCE.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            names = set()
            if isinstance(node, ast.Call):
                function = node.func
                name = getattr(function, "attr", getattr(function, "id", None))
                names = {name} & RUNS_TEXT if ast.unparse(function) not in HARMLESS else set()
            elif isinstance(node, ast.Import):
                names = {alias.name.split(".")[0] for alias in node.names} & (NEVER | {"pickle"})
            elif isinstance(node, ast.ImportFrom):
                names = {(node.module or "").split(".")[0]} & (NEVER | {"pickle"})
            if names:
                found.setdefault(path.relative_to(SOURCE).as_posix(), set()).update(names)
    assert found == MAY


# ---------------------------------------------------------------- paths
OUTSIDE = (
    "../secret.csv", "./x/../../secret.csv", "..\\secret.csv", "x\\..\\..\\secret.csv", "{home}/secret.csv",
    "C:\\secret.csv", "C:secret.csv", "\\\\server\\share\\secret.csv", "//server/share/secret.csv",
    "file://{home}/secret.csv", "~/secret.csv", "$HOME/secret.csv", "%2e%2e/secret.csv", "．．/secret.csv",
    "..∕secret.csv", "․․/secret.csv", "‥/secret.csv", "link.csv", "folder/secret.csv",
    "/dev/zero", "/dev/stdin", "/proc/self/environ", "CON", "NUL.csv", "COM1", "zero", ".", "..", "...",
    "a.csv/", "a.csv/../../secret.csv",
)  # fmt: skip


@pytest.fixture
def place(tmp_path):
    """A campaign beside a file that is none of it, with links that lead there."""
    secret = csv_of([row.replace(",2.", ",7.") for row in ROWS])
    (tmp_path / "secret.csv").write_text(secret)
    folder = tmp_path / "campaign"
    folder.mkdir()
    campaign(folder, RUNS, files=("a.csv",))
    (folder / "a.csv").write_text(csv_of(ROWS))
    (folder / "link.csv").symlink_to(tmp_path / "secret.csv")
    (folder / "folder").symlink_to(tmp_path)
    (folder / "zero").symlink_to("/dev/zero")
    return folder


@pytest.mark.parametrize("path", OUTSIDE)
def test_a_listed_path_never_leads_outside(place, path):
    path = path.format(home=place.parent)
    (place / "runs.csv").write_text(RUNS.replace("b.csv", path))
    (place / "a.toml").write_text(DAYS)
    _, faults = commands.check(place, place / "a.toml")
    assert faults
    try:
        steady = ingest_campaign(place, config(DAYS)).tables["steady"]
    except CampaignError:
        return
    assert set(steady["file"]) <= {"a.csv"}
    assert steady["force_N"].max() < 7


@pytest.mark.parametrize("path", [path for path in OUTSIDE if path not in (".", "..", "a.csv/")])
def test_the_table_of_runs_is_never_outside(place, path):
    path = path.format(home=place.parent)
    (place.parent / "secret.csv").write_text("file,aging_days\na.csv,3\n")
    with pytest.raises(CampaignError, match=r"outside|does not exist|is not a file|no table of runs|format"):
        ingest_campaign(place, config(f"{DAYS}[files]\nruns_table = {json.dumps(path)}\n"))


@pytest.mark.parametrize("glob", ["**/*.csv", "*/*.csv", "folder/*.csv", "*", "[a-z]*", "zero"])
def test_a_glob_never_leads_outside(place, glob):
    (place / "runs.csv").unlink()
    text = f'condition = ["specimen_id"]\n[files]\nglob = "{glob}"\n[runs.constants]\nspeed_mm_s = 5.0\n'
    try:
        steady = ingest_campaign(place, config(text)).tables["steady"]
    except SealfitError:
        return
    assert set(steady["file"]) == {"a.csv"}
    assert steady["force_N"].max() < 7


# ---------------------------------------------------------------- time and memory
EXPONENTIAL = r"(a|aa)+x"
NAMES = {
    "files": "[files]\nglob = '*.csv'\nname_pattern = '''{}'''\n",
    "trace": "[trace]\nheader_ends_at = '''{}'''\n",
    "trace.header_fields": "[trace.header_fields]\noil = '''{}'''\n",
}


@pytest.mark.parametrize("table", NAMES)
def test_a_pattern_of_exponential_time_is_named(tmp_path, table):
    name = f"{'a' * 60}!.csv"
    campaign(tmp_path, RUNS.replace("b.csv", name), files=("a.csv",))
    (tmp_path / name).write_text(csv_of(ROWS, f"{HEADER},{'a' * 60}!").replace("\n0", "\n0,0"))
    began = time.process_time()
    with pytest.raises(SealfitError, match=r"pattern .* takes too long on"):
        ingest_campaign(tmp_path, config(DAYS + NAMES[table].format(EXPONENTIAL)))
    assert time.process_time() - began < 20


@pytest.mark.parametrize(
    "text",
    [
        f"a = {'[' * 10_000}{']' * 10_000}",
        f"a = {'{a=' * 5_000}1{'}' * 5_000}",
        f"[loop]\nseed = {'9' * 6_000}",
        f"[trace]\ndrop_first_rows = {'9' * 30}",
        f"[files]\nname_pattern = '{'(' * 400}a{')' * 400}'" + "\nglob = 1",
        f"[files]\nname_pattern = '{'a?' * 600}'",
        f"[files]\ndate_format = '{'%d ' * 50}'",
        f"[files]\nglob = '{'**/' * 9}*.csv'",
        f"[trace]\nkeep = '{'-' * 100}1 > 0'",
    ],
    ids=lambda text: text[:30],
)
def test_a_config_cannot_exhaust_the_program(text):
    began = time.process_time()
    with pytest.raises(ConfigError):
        config(text)
    assert time.process_time() - began < 5


# ---------------------------------------------------------------- what is written
def test_a_link_in_out_is_not_written_through(tmp_path):
    campaign(tmp_path / "campaign", RUNS, files=("a.csv", "b.csv"))
    (tmp_path / "rig.toml").write_text(DAYS)
    given = (tmp_path / "campaign", tmp_path / "out", tmp_path / "rig.toml")
    run(*given, steps=("ingest",))
    mine = tmp_path / "mine"
    mine.mkdir()
    (mine / "thesis.tex").write_text("years")
    (tmp_path / "out" / "bins.parquet").rename(tmp_path / "away")
    (tmp_path / "out" / "bins.parquet").symlink_to(mine)
    with pytest.raises(OutError, match=r"'bins.parquet' is a link to a folder\. Delete the link"):
        run(*given, steps=("ingest",), force=True)
    assert [path.name for path in mine.iterdir()] == ["thesis.tex"]


def test_the_lock_is_not_written_through_a_link(tmp_path):
    campaign(tmp_path / "campaign", RUNS, files=("a.csv", "b.csv"))
    (tmp_path / "rig.toml").write_text(DAYS)
    given = (tmp_path / "campaign", tmp_path / "out", tmp_path / "rig.toml")
    run(*given, steps=("ingest",))
    (tmp_path / "thesis.tex").write_text("years")
    (tmp_path / "out" / LOCK).symlink_to(tmp_path / "thesis.tex")
    run(*given, steps=("ingest",), force=True)
    assert (tmp_path / "thesis.tex").read_text() == "years"
    assert not os.path.lexists(tmp_path / "out" / LOCK)


def test_answers_are_not_written_through_a_link(tmp_path):
    (tmp_path / "mine").write_text("years")
    (asked := tmp_path / "points.csv").write_text("oil\n1\n")
    answers = pd.DataFrame({name: [None] for name in ANSWERS}, dtype=object)
    (tmp_path / ".q.csv.part").symlink_to(tmp_path / "mine")
    (tmp_path / "q.csv").symlink_to(tmp_path / "mine")
    write_answers(read_points(asked), answers, tmp_path / "q.csv", given=asked)
    assert (tmp_path / "mine").read_text() == "years"
    assert (tmp_path / "q.csv").read_text().startswith("oil,")


@pytest.mark.parametrize(
    "line", ["x\n[loop]\neffects_folder='mine'\n", "'''\"\"\"", "\\u0041\\", '"]\t[loop', "#"]
)
def test_names_in_a_draft_stay_text(tmp_path, line):
    folder = tmp_path / line.replace("/", "")
    folder.mkdir()
    for number in range(3):
        content = csv_of([f"{row},{i % 7}" for i, row in enumerate(ROWS)], f"{HEADER},{line.splitlines()[0]}")
        (folder / f"{number}_{line}.csv").write_text(content)
    made = tomllib.loads(draft(folder).text)
    assert "loop" not in made
    assert made["name"] == folder.name


# ---------------------------------------------------------------- hostile words through a whole run
SPEC = """
name = "plain"
seed = 3
[design]
days = []
unaged = true
speeds_mm_s = [1.0, 5.0, 20.0]
repeats = 2
max_rows = 100
[[noise]]
kind = "white"
sd_N = 0.2
"""
SCRIPT, TAG, FORMULA = "<script>alert(1)</script>", "<img src=x onerror=alert(2)>", "=cmd()|' /C calc'!A0"
BIDI = "\u202e"  # turns the order of what follows


@pytest.fixture(scope="module")
def hostile(tmp_path_factory):
    """A campaign of hostile words, its results made under a strict umask, and what the terminal got."""
    home = tmp_path_factory.mktemp("hostile")
    (home / "spec.toml").write_text(SPEC)
    simulate(load_spec(home / "spec.toml"), home / "campaign")
    runs = pd.read_csv(home / "campaign" / "runs.csv")
    runs["run_id"] += '"><svg onload=alert(3)>'
    runs["specimen_id"] = "$\\int$ {{7*7}} {% raw %}" + BIDI
    runs[f"../../{TAG}"] = [SCRIPT, FORMULA] * (len(runs) // 2)
    runs[TAG] = range(len(runs))
    runs.to_csv(home / "campaign" / "runs.csv", index=False)
    (home / "rig.toml").write_text(
        f"name = '{SCRIPT}'\n[column_units]\n'{TAG}' = '<b>'\n[loop]\nmax_rounds = 1\n"
    )
    before, old, said = set(home.rglob("*")), os.umask(0o077), io.StringIO()
    command = ["sealfit", "run", home / "campaign", "--out", home / "out", "--config", home / "rig.toml"]
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(said), redirect_stderr(said):
        patch.setattr(sys, "argv", [str(word) for word in command])
        patch.setattr("sealfit.report.drawing.saved", only_svg)
        code = cli.exit_code(cli.app)
    os.umask(old)
    assert code == 0, said.getvalue()
    new = {path for path in home.rglob("*") if path not in before}
    assert all(path.is_relative_to(home / "out") for path in new)
    return home, said.getvalue()


def test_files_of_out_follow_the_umask(hostile):
    paths = [hostile[0] / "out", *(hostile[0] / "out").rglob("*")]
    assert {(path.is_dir(), path.stat().st_mode & 0o777) for path in paths} == {(True, 0o700), (False, 0o600)}


def test_the_terminal_gets_no_control_characters(hostile):
    assert BIDI not in hostile[1]
    assert {c for c in hostile[1] if not c.isprintable()} <= {"\n"}


class Tags(html.parser.HTMLParser):
    """Collects the elements of a page, their attributes, and the texts of its scripts."""

    def __init__(self, text):
        super().__init__()
        self.found, self.attributes = [], []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.found.append(tag)
        self.attributes += attrs


def test_the_report_holds_no_element_of_the_data(hostile):
    text = (hostile[0] / "out" / "report.html").read_text("utf-8")
    page = Tags(text)
    assert page.found.count("script") == 2  # the traces of runs, and what works the page
    assert "b" not in page.found
    assert html.escape(TAG) in text
    assert "{{7*7}}" in text or "49" not in re.findall(r"\$.int\$ (\w+)", text)
    assert not [name for name, _ in page.attributes if name.startswith("on")]
    sources = [value for name, value in page.attributes if name in ("src", "href")]
    assert all(value.startswith(("#", "data:image/svg+xml;base64,")) for value in sources)


def test_plots_hold_no_script_and_no_address(hostile):
    plots = list((hostile[0] / "out" / "plots").glob("*.svg"))
    assert plots
    for path in plots:
        for element in ElementTree.parse(path).iter():
            tag = str(element.tag).rpartition("}")[2]
            assert tag not in ("script", "foreignObject", "image", "a", "iframe")
            for name, value in element.attrib.items():
                assert not name.startswith("on")
                assert not name.endswith("href") or value.startswith("#")


def test_answers_hold_no_formulas(hostile):
    home = hostile[0]
    points = pd.read_csv(home / "campaign" / "runs.csv").iloc[:4].assign(displacement_mm=20.0)
    points = points.drop(columns="started_at").assign(run_order=1, elapsed_h=1.0)
    words = ["+1+cmd", "\t=2", "-2+3", "＝1+1"]
    points = points.assign(**{"=x": words, "@y": words})
    points.to_csv(home / "points.csv", index=False)
    commands.predict(home / "out", home / "points.csv", home / "q.csv")
    for row in csv.reader(io.StringIO((home / "q.csv").read_text("utf-8"))):
        for cell in row:
            begins = cell.lstrip()[:1] in tuple("=+-@＝＋－＠") and cell.strip()
            assert not begins or re.fullmatch(r"-[\d.e-]+", cell), cell
