import base64
import hashlib
import html.parser
import re

import pandas as pd
import pytest
from report.made_campaigns import NAMES, PROVENANCE, aging_campaign, paper_sized, torque_campaign
from report.made_tables import empty

from sealfit.config import Config
from sealfit.report.figures.residual import effect_shapes
from sealfit.report.page import LARGEST_STEP, MOST_BINS, build_report, run_traces

VOID = {"meta", "img", "br", "link", "path", "rect", "circle"}


class Page(html.parser.HTMLParser):
    """Collects what a page says, shows and asks for; notes tags that do not close."""

    def __init__(self, text):
        super().__init__()
        self.tags, self.images, self.addresses, self.ids, self.links, self.words = [], [], [], [], [], []
        self.open = []
        self.feed(text)
        self.close()
        assert not self.open

    def handle_starttag(self, tag, attrs):
        found = dict(attrs)
        self.tags.append(tag)
        if tag == "svg":
            self.images.append(found)
        asking = ("src", "href", "xlink:href", "data", "action", "srcset", "poster")
        self.addresses += [value for name, value in attrs if name in asking]
        self.ids += [found["id"]] if "id" in found else []
        self.links += [found["href"]] if tag == "a" else []
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        if tag not in VOID:
            assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and not {"style", "script", "svg"} & set(self.open):
            self.words.append(data)

    @property
    def text(self):
        return re.sub(r"[\s\u00a0]+", " ", " ".join(self.words))


FEW = {"speeds": (1, 10), "days": (4,)}
MADE = {
    "closed": aging_campaign,
    "nothing_missing": lambda: aging_campaign(verdict="nothing_missing", **FEW),
    "unexplained": lambda: aging_campaign(verdict="unexplained", **FEW),
    "torque": torque_campaign,
}


@pytest.fixture(scope="module")
def reports(only_drawings):
    return {name: build_report(*make().arguments) for name, make in MADE.items()}


@pytest.fixture
def small():
    """A campaign with two channels and the traces of one run: most of a page's time goes into its panels."""
    made = aging_campaign(**FEW)
    channels, traces = made.tables["channels"], made.tables["traces_mean"]
    made.tables["channels"] = channels[channels["channel"].isin(["time_s", "operator"])]
    made.tables["traces_mean"] = traces[traces["run_id"] == traces["run_id"].iloc[0]]
    return made


@pytest.fixture(scope="module")
def pages(reports):
    return {name: Page(report.html) for name, report in reports.items()}


@pytest.mark.parametrize("name", MADE)
def test_the_page_asks_for_nothing(name, reports, pages):
    for address in pages[name].addresses:
        assert address.startswith(("#", "data:image/png;base64,"))
    assert pages[name].tags.count("script") == 2
    script = re.search(r"<script>(.*?)</script>", reports[name].html, re.S)[1]
    own = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    assert f"script-src 'sha256-{own}'\"" in reports[name].html
    assert not re.search(r"https?:|fetch\(|import\(|eval\(|innerHTML", script)
    style = re.search(r"<style>(.*?)</style>", reports[name].html, re.S)[1]
    assert "url(" not in style
    assert "@import" not in style


@pytest.mark.parametrize("name", MADE)
def test_every_image_says_what_it_shows(name, pages):
    assert all(len(image["aria-label"]) > 20 for image in pages[name].images)
    assert pages[name].images


@pytest.mark.parametrize("name", MADE)
def test_contents_lead_somewhere_and_ids_are_single(name, pages):
    targets = [address[1:] for address in pages[name].links]
    assert len(targets) == 11
    assert set(targets) <= set(pages[name].ids)
    assert len(set(pages[name].ids)) == len(pages[name].ids)


@pytest.mark.parametrize("name", MADE)
def test_nothing_unavailable_is_printed_raw(name, pages):
    assert not re.search(r"\b(nan|None|NaN|inf|NaT|undefined)\b", pages[name].text)


def test_figures_are_named_for_the_store(reports):
    assert set(reports["closed"].figures) == {
        "finding", "before_after", "effect_shapes", "variance_levels", "residual_channels", "force_speed",
        "aging", "master_curve", "starts", "traces_mean",
    }  # fmt: skip
    assert set(reports["torque"].figures) == {"before_after", "force_speed"}


def test_the_verdict_stands_at_the_top(pages):
    text = pages["closed"].text
    assert text.index("The declared model lacks an effect: warming by sliding") < text.index(
        "rms error, held-out runs"
    )
    assert "No effect beyond the declared model is significant" in pages["nothing_missing"].text
    assert "A significant residual remains along" in pages["unexplained"].text


def test_before_and_after_stand_beside_the_floor(pages):
    text = pages["closed"].text
    for words in ("before after change", "rms error, held-out runs (N)", "noise floor", "lack of fit, p"):
        assert words in text
    assert "before after change" not in pages["nothing_missing"].text


def test_a_card_has_target_parameters_and_alternatives(pages):
    text = pages["closed"].text
    assert "It scales the friction coefficient μ and depends on time (s), which varies along strokes." in text
    assert "share of friction lost when warm" in text
    assert (
        "Not distinguishable from it with these data: 1 other form warming by sliding (distance), acting on μ"
        in text
    )
    assert "candidate, not applied" in text
    assert "Replicate specimens would show" in text


def test_a_candidate_has_a_panel_that_says_so(small, unsaved):
    for name in ("shapes", "shape_points"):
        own = small.tables[name]
        small.tables[name] = pd.concat([own, own.assign(effect=1, channel="aging_days")])
    page = build_report(*small.arguments).html
    (alt,) = re.findall(r'aria-label="(Shapes of the effects: [^"]*)', page)
    assert re.findall("Shape of (.*?) along", alt) == [
        "warming by sliding (time)", "candidate: aging with an induction time"
    ]  # fmt: skip
    assert "candidate, not applied" in page
    panels = effect_shapes(small.tables, small.closure, small.config).panels
    assert [panel.title for panel in panels] == [
        "1. Warming by sliding (time)", "2. Candidate: aging with an induction time"
    ]  # fmt: skip
    assert "2. Aging with an induction time <" in re.sub(r"\s+", " ", page)


def test_effects_not_accepted_have_the_residual_along_each_of_their_variables_once(small, unsaved):
    asked = (["time_s"], ["time_s"], ["direction", "operator"])
    common = {"label": "smooth", "acts_on": "mu", "p_value": 1e-5, "reason": "it is too small", "weak": False}
    small.closure["refused"] = [{**common, "channels": channels} for channels in asked]
    told = build_report(*small.arguments)
    listed = told.html.split("Significant, but not accepted")[1].split("<h2>")[0]
    along = re.findall(r"Mean residual along ([a-z ]+):", listed)
    assert sorted(along) == ["operator", "time"]
    assert "refused" in told.figures
    assert "95 % intervals" in listed


def test_a_card_shows_the_symbol_of_a_parameter_that_an_effect_is_added_to(small, unsaved):
    small.closure["effects"][0] |= {"acts_on": "v_s", "operation": "add"}
    assert "added to v s : " in Page(build_report(*small.arguments).html).text


def test_torque_is_never_called_force_nor_its_slot(reports, pages):
    text = pages["torque"].text + " ".join(image["aria-label"] for image in pages["torque"].images)
    for slot in ("force_N", "displacement_mm", "speed_mm_s", "load_N", "friction force", "mm/s"):
        assert slot not in text
    assert "mN m" in text
    assert "There is no aging law" in text
    assert "no load given: torque is fitted instead of coefficients" in text


def test_without_a_load_effects_act_on_friction_and_the_forces(unsaved):
    made = torque_campaign()
    why = "would distinguish linear in dust_mg, factor on friction from linear in dust_mg, added to F_s"
    wear = {**aging_campaign().closure["effects"][0], "label": "linear in dust_mg, factor on friction"}
    place = {"variable": "dust_mg", "level": "run", "acts_on": "mu"}
    made.closure |= {
        "verdict": "unexplained",
        "effects": [{**wear, "channels": ["dust_mg"]}],
        "next_runs": [{"why": why, "conditions": {"dust_mg": 2.0}}],
        "sensitivity": [{**dict.fromkeys(("smallest_N", "smallest_pct", "files_needed")), **place}],
    }
    text = Page(build_report(*made.arguments).html).text
    assert "The declared model lacks an effect: linear in dust mg." in text
    assert "It scales friction and depends on dust mg" in text
    assert "linear in dust mg, factor on friction from linear in dust mg, added to F s Measure" in text
    assert "μ" not in text.split("Next runs")[0].split("Not distinguishable")[0]


def test_parameters_say_what_is_not_identified(pages):
    text = pages["closed"].text
    assert re.search("v s not identified – – (– )?mm/s fewer than two speeds lie below 2 v s", text)
    assert "u sys" in text


def test_text_from_data_is_escaped(small):
    made = small
    nasty = "<script>alert('x')</script>"
    made.tables["channels"] = made.tables["channels"].replace({"channel": {"operator": nasty}})
    made.tables["levels"] = made.tables["levels"].replace({"channel": {"operator": nasty}})
    made.closure["effects"][0]["label"] = nasty
    made.closure["effects"][0]["form"] = nasty
    made.closure["next_runs"] = [{"why": nasty, "conditions": {nasty: nasty}}]
    residuals = made.tables["residuals_after"]
    made.tables["residuals_after"] = residuals.assign(run_id=nasty)
    made.provenance = {**made.provenance, "campaign": f"/data/{nasty.replace('/', '')}"}
    report = build_report(*made.arguments)
    page = Page(report.html)
    assert page.tags.count("script") == 2  # the traces of runs, and what works the page
    assert "b" not in page.tags
    assert nasty in page.text
    assert 'traces/a "quoted" <b>.csv' in page.text


@pytest.mark.parametrize("missing", NAMES)
def test_any_table_may_be_missing(missing, small, unsaved):
    del small.tables[missing]
    assert "hydrothermal-2024: friction report" in Page(build_report(*small.arguments).html).text


def test_with_no_tables_at_all_it_still_says_so():
    page = Page(build_report({}, torque_campaign().closure, PROVENANCE, Config()).html)
    for words in (
        "no steady window to draw",
        "No aging law was fitted",
        "No parameters were fitted",
        "no averaged traces",
        "no quality table",
    ):
        assert words in page.text


def test_null_everywhere_is_a_page_too(small, unsaved):
    made = small
    nothing = dict.fromkeys(made.closure["before"])
    unknown = {"state": "unknown", "ratio": None, "p_value": None}
    made.closure.update(before=nothing, after=dict(nothing), noise_floor_N=None, fit_quality=unknown)
    made.closure["left"] = {**dict.fromkeys(made.closure["left"]), "significant": False}
    for effect in made.closure["effects"]:
        effect.update(p_value=None, heldout_gain_N=None)
        for p in effect["parameters"]:
            p.update(value=None, ci95=[None, None])
    for entry in made.closure["scatter"]:
        entry.update(sd_rel=None, sd_N=None, df=None)
    text = Page(build_report(*made.arguments).html).text
    assert "the noise floor and the lack of fit are unknown" in text
    assert not re.search(r"\b(nan|None)\b", text)


def test_findings_are_counted_and_listed(pages):
    text = pages["closed"].text
    assert "bad number error row left out 1 1" in text
    assert "friction force (N) jumps by 40 between two samples. Look at the cable." in text


def test_many_findings_are_cut_and_counted(small, unsaved):
    made = small
    row = made.tables["quality"].iloc[[-1]]
    made.tables["quality"] = pd.concat([row] * 900, ignore_index=True)
    assert "The first 400 of 900" in Page(build_report(*made.arguments).html).text


def test_the_arguments_are_left_as_they_were(small, unsaved):
    made = small
    before = {name: frame.copy() for name, frame in made.tables.items()}
    left = dict(made.closure["left"])
    build_report(*made.arguments)
    assert made.closure["left"] == left
    for name, frame in before.items():
        pd.testing.assert_frame_equal(made.tables[name], frame)


def test_traces_of_runs_are_in_the_page_thinned_where_they_are_many(small):
    rows = small.tables["residuals_after"]
    bins = rows["bin"].nunique()
    made = run_traces(small.tables, small.config)
    assert made["runs"].keys() == set(rows["run_id"])
    first = next(iter(made["runs"].values()))["strokes"][0]
    own = rows[rows["file"] == first["file"]]
    assert first["force"] == pytest.approx(own["force_N"].to_numpy(), rel=1e-4)
    assert first["model"] == pytest.approx(own["model_N"].to_numpy(), rel=1e-4)
    for times, kept in ((2, 2), (LARGEST_STEP + 1, None)):
        more = pd.concat([rows] * (times * MOST_BINS // len(rows)))
        many = run_traces({**small.tables, "residuals_after": more}, small.config)
        assert many["every"] == times
        assert bool(many["runs"]) == (kept is not None)
    assert bins > 2
    unfitted = {"residuals_after": rows[:0], "residuals_before": rows[:0]}
    assert run_traces({**small.tables, **unfitted}, small.config)["runs"] == {}


@pytest.mark.long
def test_paper_sized_campaign_gives_a_page_that_can_be_mailed(only_drawings):
    made = paper_sized()
    assert made.tables["steady"]["file"].nunique() == 1752
    assert made.tables["steady"]["condition"].nunique() == 73
    report = build_report(*made.arguments)
    assert len(report.html.encode()) < 8e6
    assert report.html.count("<figure") == len(report.figures) - 1  # the finding has the panels of the errors


def test_empty_tables_may_lack_columns(small, unsaved):
    made = small
    made.tables["shapes"] = pd.DataFrame()
    made.tables["aging_curves"] = empty("aging_curves")
    assert "effect_shapes" not in build_report(*made.arguments).figures


def test_the_page_states_the_sensitivity_and_the_effects_not_accepted(small, unsaved):
    seen = {"variable": "displacement_mm", "level": "trace", "smallest_N": 0.123, "smallest_pct": 0.31}
    seen["files_needed"] = 44
    unseen = dict.fromkeys(("smallest_N", "smallest_pct", "files_needed"))
    seen["acts_on"] = "mu"
    unseen |= {"variable": "speed_mm_s", "level": "run", "acts_on": "force"}
    label = "ripple along displacement_mm, factor on mu_s"
    refused = {"label": label, "acts_on": "mu_s", "channels": ["displacement_mm"], "p_value": 1e-6}
    refused = {**refused, "reason": "it is too small", "weak": False}
    sensitivity = [{**one, "cannot_tell": False} for one in (seen, unseen)]
    closure = {**small.closure, "sensitivity": sensitivity, "refused": [refused]}
    text = Page(build_report(small.tables, closure, small.provenance, small.config).html).text
    assert "displacement (mm) along strokes μ 0.12 N 0.31 % 44" in text
    assert "sliding speed (mm/s) between runs the friction force none – –" in text
    assert "ripple along displacement, acting on μ s (p < 0.001): it is too small." in text


def test_an_earlier_report_is_no_step_of_this_one(small, unsaved):
    again = {"step": "report", "version": "0.1.0", "finished_at": "2024-05-02T09:35:00+00:00", "seconds": 3.0}
    provenance = {**small.provenance, "steps": [*small.provenance["steps"], again]}
    first, second = (
        build_report(small.tables, small.closure, one, small.config).html
        for one in (small.provenance, provenance)
    )
    assert "2024-05-02 09:33:40 UTC" in first
    assert first == second
