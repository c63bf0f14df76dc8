import numpy as np
import pandas as pd
import pytest
from bins_helpers import LOAD_N, TRUE, make_bins, with_another_curve

from sealfit.closure.channels import (
    channels_of,
    find_channels,
    flip_level,
    follows_strokes,
    free_columns,
    run_means,
    searched,
    unit_of,
    without_trends,
)
from sealfit.closure.confirm import added_force
from sealfit.closure.forms import room_along, terms_of
from sealfit.closure.naming import propose
from sealfit.closure.score_test import Candidate, ScoreTestResult, ScoreTests, log_p_of_score
from sealfit.closure.search import search
from sealfit.config import Config
from sealfit.effects import EFFECTS
from sealfit.fit.joint import fit_declared
from sealfit.fit.joint.rows import ALONG, make_rows
from sealfit.tables import CALENDAR

CHANNELS = {
    "lab_temperature_C": lambda rng: 22 + rng.normal(),
    "batch": lambda rng: str(rng.choice(list("ABC"))),
}


def rows_of(seed=0, **options):
    return make_rows(
        make_bins(seed, run_channels=CHANNELS, setup=0.01, specimen=0.02, **options), has_aging=True
    )


def test_units_of_evidence():
    rows = rows_of(repeats=2, bins=4)
    units = {c.name: c.unit for c in find_channels(rows)}
    assert units["time_s"] == "sample"
    assert units["repeat"] == "file"
    assert units["lab_temperature_C"] == units["batch"] == "run"
    assert units["aging_days"] == "specimen"


@pytest.mark.parametrize(
    ("left", "share", "along"), [(0.005, 1.0, True), (0.03, 0.4, True), (0.03, 0.6, False)]
)
def test_effects_along_strokes_are_not_searched_where_strokes_end_before_the_friction_is_steady(
    left, share, along
):
    bins = make_bins(repeats=2, bins=4)
    short = bins["file"].factorize()[0] < share * bins["file"].nunique()
    bins["presliding_N"] = np.where(short, -left * bins["force_N"], 0.0)
    rows = make_rows(bins, has_aging=True)
    names = {c.name for c in find_channels(rows)}
    assert names - {c.name for c in searched(find_channels(rows), rows)} == (
        set() if along else names & set(ALONG)
    )


def test_a_drift_of_the_sensor_is_found_in_short_strokes_that_go_both_ways():
    """What is left of the rise opposes the motion; a force that time adds does not."""
    bins = make_bins(repeats=2, bins=4, directions=(1, -1), noise_N=0.05)
    rest = -0.03 * bins["force_N"] * np.exp(-bins["distance_mm"] / 20)
    left = bins.assign(presliding_N=-0.03 * bins["force_N"], force_N=bins["force_N"] + rest)
    found = []
    for drift in (0.0, 0.02):  # N/s
        rows = make_rows(left.assign(force_N=left["force_N"] + drift * left["time_s"]), has_aging=True)
        channels = searched(find_channels(rows), rows)
        assert {c.name for c in channels} & set(ALONG) == {"time_s"}
        tested = search(ScoreTests(fit_declared(rows)), channels, np.random.default_rng(0))
        assert {c.target for c in tested if "time_s" in c.channels} == {("force", "add")}
        found.append(min(c.p_value for c in tested if "time_s" in c.channels))
    assert found[0] > 0.005
    assert found[1] < 1e-6


def test_a_text_of_more_than_a_hundred_values_is_no_channel():
    bins = make_bins(days=(1.0, 2.0, 4.0, 8.0, 16.0, 32.0), bins=2)
    number = bins["file"].factorize()[0]
    bins["noted_at"], bins["tray"] = (
        (number % 150).astype(str),
        (number % 90).astype(str),
    )  # neither is a file's own
    names = {c.name for c in find_channels(make_rows(bins, has_aging=True))}
    assert "tray" in names
    assert "noted_at" not in names


@pytest.mark.parametrize(("share", "several"), [(0.002, False), (0.1, True)])
def test_the_noise_of_one_load_is_no_channel(share, several):
    """The force does not follow the noise of the load's sensor, and mu would seem to fall with it."""
    bins = make_bins(bins=4, repeats=1)
    rng = np.random.default_rng(0)
    bins["load_N"] *= 1 + share * rng.uniform(-1, 1, len(bins))
    names = {c.name for c in find_channels(make_rows(bins, has_aging=True))}
    assert ({"load_N", "power"} <= names) == several
    assert several or names.isdisjoint({"load_N", "power"})


def test_a_column_that_is_the_force_is_no_channel_and_a_pressure_that_it_follows_is():
    bins = make_bins(repeats=1, directions=(1, -1))
    force, load = bins["force_N"].to_numpy(), bins["load_N"].to_numpy()
    mean = bins.groupby(["file", "stroke"])["force_N"].transform("mean").abs()
    bins["force_kN"], bins["cof"] = force / 1000, np.abs(force) / load
    bins["filtered"] = np.convolve(np.pad(np.abs(force), 1, mode="edge"), [0.1, 0.8, 0.1], "valid")
    bins["pressure_bar"] = mean / 10 * (1 + 0.001 * np.random.default_rng(0).normal(size=len(bins)))
    names = {c.name for c in find_channels(make_rows(bins, has_aging=True))}
    assert "pressure_bar" in names
    assert names.isdisjoint({"force_kN", "cof", "filtered"})


def test_a_condition_may_be_called_rubber():
    """Table `bins` has a column of this name in any case, which is no channel of its own."""
    bins = make_bins(bins=4)
    bins["compound"] = bins["rubber"] = np.where(bins["temperature_C"] == 60.0, "NBR", "FKM")
    rows = make_rows(bins, has_aging=True)
    for column in ("rubber", "compound"):
        names = {c.name for c in channels_of(rows, Config(name="", rubber=(column,)))}
        assert column in names
        assert ("rubber" in names) == (column == "rubber")


def test_a_serial_number_is_a_grouping_and_not_a_channel():
    bins = make_bins(repeats=2, bins=4)
    bins["serial"] = "no " + bins["file"]
    names = {c.name for c in find_channels(make_rows(bins, has_aging=True))}
    assert "serial" not in names
    assert "run_order" in names


def test_strokes_out_and_back_are_told_by_the_direction():
    bins = make_bins(repeats=1, bins=4, directions=(1, -1))
    bins["stroke"] = np.where(bins["direction"] > 0, 1, 2)
    names = {c.name for c in find_channels(make_rows(bins, has_aging=True))}
    assert "direction" in names
    assert "stroke" not in names
    assert "stroke" in {c.name for c in find_channels(make_rows(bins, has_aging=True), ["direction"])}
    bins["stroke"] += 2 * (bins["repeat"] > 0) * (bins.groupby(["run_id", "direction"]).cumcount() > 1)
    assert "stroke" in {c.name for c in find_channels(make_rows(bins, has_aging=True))}


def test_contrasts_inside_files_are_judged_between_runs_where_there_are_twenty():
    rows = rows_of(repeats=2, bins=4)
    assert flip_level("sample", rows) == "run"
    assert flip_level("specimen", rows) == "specimen"
    few = rows.subset(rows.codes("run") < 6)
    assert flip_level("sample", few) == "file"


def test_free_columns_hold_a_straight_line_first():
    rows = rows_of(repeats=1, bins=8)
    channel = next(c for c in find_channels(rows) if c.name == "displacement_mm")
    columns = free_columns(channel)
    assert abs(np.corrcoef(columns[:, 0], channel.values)[0, 1]) == pytest.approx(1.0)
    assert columns.mean(axis=0) == pytest.approx(np.zeros(columns.shape[1]), abs=1e-9)


def test_hotelling_p_is_students_t_for_one_column():
    from scipy import stats

    # Scores 1..6 all of one sign: T = (sum)^2 / sum of squares = 441/91; t = mean/(sd/sqrt 6).
    scores = np.arange(1.0, 7.0)
    t = stats.ttest_1samp(scores, 0.0)
    assert np.exp(log_p_of_score(np.array([441 / 91]), 1, 6)[0]) == pytest.approx(t.pvalue, rel=1e-9)


@pytest.mark.long
def test_p_values_of_nulls_are_not_too_small():
    smallest = []
    for seed in range(24):
        rows = rows_of(seed + 100, temperatures=(60.0,), bins=4, autocorrelation=0.5 * (seed % 2))
        found = search(ScoreTests(fit_declared(rows)), find_channels(rows), np.random.default_rng(seed))
        smallest.append(min(c.p_value for c in found))
    # Each campaign's smallest adjusted p is uniform: of 24, two below 0.1 on average, and more than seven
    # with p 0.003.
    assert sum(p < 0.1 for p in smallest) <= 7
    assert min(smallest) > 0.001


def test_a_channel_that_orders_the_residual_is_found_at_its_unit():
    rows = rows_of(bins=6, effect=lambda t, f: f * (1 + 0.02 * (t["lab_temperature_C"].to_numpy() - 22)))
    best = search(ScoreTests(fit_declared(rows)), find_channels(rows), np.random.default_rng(0))[0]
    assert best.channels == ("lab_temperature_C",)
    assert best.unit == "run"
    assert best.p_value <= 0.001


def test_unit_of_a_constant_is_the_coarsest_level():
    rows = rows_of(repeats=1, bins=4)
    assert unit_of(np.ones(rows.force.size), rows) == "specimen"


def test_a_channel_may_change_how_soon_a_rubber_ages():
    def sooner(table, force):  # b halves with every 4 degrees: the logarithm grows where days have passed
        days, warmer = table["aging_days"].to_numpy(), table["lab_temperature_C"].to_numpy() - 22
        return force - 49.03 * 0.04 * (np.log1p(days / (0.1 * 2 ** (-warmer / 4))) - np.log1p(days / 0.1))

    rows = rows_of(bins=6, effect=sooner)
    found = search(ScoreTests(fit_declared(rows)), find_channels(rows), np.random.default_rng(0))
    keys = {c.key for c in found if c.p_value < 0.005}
    assert (("lab_temperature_C",), "b", "multiply") in keys


def test_sliding_power_is_a_channel_where_loads_differ():
    bins = make_bins(repeats=1, bins=4)
    assert "power" not in make_rows(bins, has_aging=True).channels
    rounded = bins.assign(
        load_N=bins["load_N"] * (1 + 1e-12 * (np.arange(len(bins)) % 2))
    )  # as means of rows are
    assert "power" not in make_rows(rounded, has_aging=True).channels
    bins["load_N"] = np.where(bins["aging_days"] > 4, 25.0, 50.0)
    rows = make_rows(bins, has_aging=True)
    assert rows.values("power") == pytest.approx(rows.load * np.abs(rows.speed))
    assert "power" in {c.name for c in find_channels(rows)}


def test_three_speeds_show_no_effect_of_speed_beside_the_stribeck_curve_they_cannot_hold():
    bins = make_bins(speeds=(1.0, 8.0, 64.0), bins=6)
    rows = make_rows(bins.assign(load_N=np.where(bins["aging_days"] > 4, 25.0, 50.0)), has_aging=True)
    found = search(ScoreTests(fit_declared(rows)), find_channels(rows), np.random.default_rng(0))
    assert not any({"speed_mm_s", "power"} & set(c.channels) for c in found)


WEEK = {"elapsed_h": lambda rng: rng.uniform(0.0, 120.0)}


@pytest.mark.parametrize("hours", [24.0, 17.0])
def test_a_wave_with_the_time_of_day_has_a_test_of_its_own(hours):
    def wave(table, force):
        return force + 0.4 * np.sin(2 * np.pi * table["elapsed_h"].to_numpy() / hours)

    rows = make_rows(make_bins(bins=4, setup=0.005, run_channels=WEEK, effect=wave), has_aging=True)
    found = search(ScoreTests(fit_declared(rows)), find_channels(rows), np.random.default_rng(0))
    significant = [c for c in found if c.channels == ("elapsed_h",) and c.p_value < 0.005]
    assert {c.columns.shape[1] for c in significant} == ({2} if hours == 24.0 else set())


@pytest.mark.parametrize(
    ("hours", "shown"),
    [
        (np.arange(0.0, 50.0, 2.0), True),  # around the clock
        (np.add.outer(24.0 * np.arange(3), np.arange(0.0, 9.0, 3.0)).ravel(), True),  # three working days
        (np.r_[np.linspace(0.0, 2.0, 20), np.linspace(53.0, 54.0, 20)], False),  # two short visits
        (np.linspace(0.0, 24.0, 40), False),  # one day
        (np.full(9, np.nan), False),  # no file says when it began
    ],
)
def test_a_change_with_the_time_of_day_needs_two_days_of_tests(hours, shown):
    assert EFFECTS["day_and_night"].shown_by(hours) == shown


@pytest.mark.parametrize("late", [0.0, 0.05])
def test_a_step_between_runs_is_seen_although_repeats_are_far_more_precise(late):
    def recalibrated(table, force):
        return force * (1 + late * (table["elapsed_h"].to_numpy() > 60.0))

    bins = make_bins(bins=4, noise_N=0.02, gain=0.0002, repeats=2, run_channels=WEEK, effect=recalibrated)
    rows = make_rows(bins.assign(elapsed_h=bins["elapsed_h"] + 3.0 * bins["repeat"]), has_aging=True)
    assert {c.name: c.unit for c in find_channels(rows)}["elapsed_h"] == "file"
    found = search(ScoreTests(fit_declared(rows)), find_channels(rows), np.random.default_rng(0))
    assert any(c.p_value < 0.001 for c in found if c.channels == ("elapsed_h",)) == (late > 0)


def passes(seed=3, drift=0.0):
    """Sixteen runs, repeated in three passes of four hours; the last hour is measured on the next day."""
    few = {"temperatures": (50.0, 60.0, 80.0), "days": (4.0,), "speeds": (0.5, 2.0, 8.0, 32.0)}
    bins = make_bins(seed, bins=2, noise_N=0.02, gain=0.004, **few)
    run = bins["run_id"].factorize()[0]
    hours = 4.0 * (bins["repeat"] - 1) + 0.25 * np.random.default_rng(seed).permutation(16)[run]
    hours += 12.0 * (hours >= 11.0)
    oil = 50.0 + hours + np.random.default_rng(seed).normal(0, 3, run.max() + 1)[run]
    force = bins["force_N"] * (1 + drift * (hours - hours.mean()))
    return make_rows(bins.assign(elapsed_h=hours, oil_age_h=oil, force_N=force), has_aging=True)


def test_a_drift_between_repeats_of_few_runs_is_seen_and_named_by_the_calendar():
    fitted = fit_declared(passes(drift=0.02))
    channels = {c.name: c for c in find_channels(fitted.rows)}
    assert channels["elapsed_h"].unit == "file"
    found = search(ScoreTests(fitted), list(channels.values()), np.random.default_rng(0))
    assert found[0].channels == ("elapsed_h",)
    assert found[0].p_value < 1e-6
    named = propose(fitted, [c for c in found if c.p_value < 0.005], channels, EFFECTS)[0]
    assert named.term.effect.id == "campaign_drift"
    assert named.fitted.model.values[-1]["A"] == pytest.approx(0.02, rel=0.25)


@pytest.mark.long
def test_repeats_of_few_runs_that_drift_each_its_own_way_are_no_drift():
    """Each run has a slope of its own along its repeats: the files of one run scatter unequally."""
    alarms = 0
    for seed in range(6):
        rows = passes(seed)
        own = np.random.default_rng(seed).normal(0, 0.01, 16)[rows.codes("run")]
        force = rows.force * (1 + own * (rows.values("repeat") - 2.0))
        rows = make_rows(rows.table.assign(force_N=force), has_aging=True)
        found = search(ScoreTests(fit_declared(rows)), find_channels(rows), np.random.default_rng(0))
        alarms += min(c.p_value for c in found) < 0.005
    assert alarms == 0


def test_means_of_runs_are_tested_only_where_they_hold_most_of_a_channel():
    bins = make_bins(bins=4, repeats=2, run_channels=WEEK)
    rows = make_rows(bins.assign(elapsed_h=bins["elapsed_h"] + 3.0 * bins["repeat"]), has_aging=True)
    channels = {c.name: c for c in find_channels(rows)}
    means = run_means(channels["elapsed_h"], rows)
    assert unit_of(means.values, rows) == means.unit == "run"
    assert run_means(channels["repeat"], rows) is None
    assert run_means(channels["time_s"], rows) is None
    assert run_means(channels["speed_mm_s"], rows) is None


@pytest.mark.parametrize(("follows", "left"), [(0.0, True), (1.0, False)])
def test_a_column_of_the_traces_is_searched_less_the_trends_of_its_strokes_unless_it_follows_them(
    follows, left
):
    """Specimens differ in their profiles along strokes, which hide what a column of the traces does."""
    bins = make_bins(0, days=(1.0, 8.0), speeds=(1.0, 10.0, 100.0), bins=12, noise_N=0.05)
    rng = np.random.default_rng(0)
    column = rng.normal(size=len(bins)) + follows * bins["distance_mm"] / bins["distance_mm"].std()
    slope = rng.normal(0, 0.05, bins["file"].nunique())[bins["file"].factorize()[0]]
    profile = slope * (bins["distance_mm"] - bins.groupby("file")["distance_mm"].transform("mean"))
    bins = bins.assign(current_A=column, force_N=bins["force_N"] + profile + 0.1 * column)
    rows = make_rows(bins, has_aging=True)
    (channel,) = [c for c in find_channels(rows) if c.name == "current_A"]
    assert follows_strokes("current_A", rows) == (not left)
    own = without_trends(channel, rows)
    assert (own is not None) == left
    if left:
        for power in (0, 1, 2):
            moments = rows.groups.sums(rows.values("distance_mm") ** power * own.values, "stroke")
            assert np.abs(moments).max() < 1e-6 * np.abs(bins["distance_mm"]).max() ** power * len(bins)
        assert channel_of_least_p(rows) == "current_A"


def channel_of_least_p(rows):
    found = search(ScoreTests(fit_declared(rows)), find_channels(rows), np.random.default_rng(0))
    return min(found, key=lambda c: c.p_value).channels[-1]


def test_a_short_part_of_the_campaign_is_found_by_the_finer_shape():
    def hours_off(table, force):
        return force - 1.5 * table["elapsed_h"].between(70.0, 84.0).to_numpy()

    four = (50.0, 60.0, 70.0, 80.0)
    bins = make_bins(bins=4, setup=0.005, temperatures=four, run_channels=WEEK, effect=hours_off)
    rows = make_rows(bins, has_aging=True)
    found = search(ScoreTests(fit_declared(rows)), find_channels(rows), np.random.default_rng(0))
    assert found[0].channels == ("elapsed_h",)
    finer = next(c for c in found if c.columns.shape[1] > 6)
    assert finer.channels == ("elapsed_h",)
    assert finer.p_value < 0.001
    assert finer.chi2 > 1.5 * max(c.chi2 for c in found if c.columns.shape[1] == 1 and not c.temporary)


@pytest.mark.parametrize("more", [0.0, 0.04])
def test_a_change_of_one_week_is_found_where_each_file_is_a_piece_of_its_own(more):
    rng = np.random.default_rng(3)
    bins = make_bins(3, temperatures=(), days=(), speeds=tuple(np.geomspace(1, 100, 11)), bins=4, gain=0.0)
    files = bins["file"].unique()
    hours, scatter = (
        dict(zip(files, x, strict=True)) for x in (rng.uniform(0, 840, 33), rng.normal(0, 0.008, 33))
    )
    bins = bins.assign(
        elapsed_h=bins["file"].map(hours), specimen_id=bins["file"], run_id=bins["file"], repeat=1
    )
    week = bins["elapsed_h"].between(168.0, 336.0)
    force = bins["force_N"] * (1 + bins["file"].map(scatter)) * (1 + more * week)
    fitted = fit_declared(make_rows(bins.assign(force_N=force), has_aging=False))
    channels = {c.name: c for c in find_channels(fitted.rows)}
    found = search(ScoreTests(fitted), list(channels.values()), np.random.default_rng(0))
    significant = [c for c in found if c.p_value < 0.005]
    if not more:
        assert significant == []
        return
    named = propose(fitted, significant, channels, EFFECTS)[0]
    assert named.term.effect.id == "temporary_change"
    values, hours = named.fitted.model.values[-1], bins["elapsed_h"]
    assert values["A"] == pytest.approx(more, rel=0.25)
    assert hours[hours < 168].max() < values["t_1"] < hours[week].min()
    assert hours[week].max() < values["t_2"] < hours[hours > 336].min()


def test_a_change_that_begins_within_a_run_is_found_at_its_file():
    """Repeats agree to 0.1 %. At any place between runs the change leaves a scatter that hides it."""
    bins = make_bins(2, temperatures=(60.0,), days=(2.0, 8.0), repeats=3, bins=6, gain=0.001, noise_N=0.05)
    files = pd.factorize(bins["file"])[0]
    changed = (files >= 37) & (files < 61)  # 37 is the second repeat of a run
    bins["force_N"] *= np.where(changed, 1.07, 1.0)
    rows = make_rows(bins, has_aging=True)
    found = search(ScoreTests(fit_declared(rows)), find_channels(rows), np.random.default_rng(0))
    best = found[0]
    assert best.channels == ("elapsed_h",)
    assert best.temporary
    assert best.p_value < 1e-9
    hours, inside = rows.values("elapsed_h"), best.columns[:, 0] > 0
    assert hours[inside].min() == pytest.approx(bins["elapsed_h"][changed].min())
    assert hours[inside].max() == pytest.approx(bins["elapsed_h"][changed].max())


def test_a_step_in_time_is_found_in_a_few_files_that_repeat_well():
    """A spline of four columns does not follow a step, and what it leaves hides it in 20 files."""

    def recalibrated(table, force):
        return force * np.where(table["elapsed_h"] > 30.0, 0.982, 1.0)

    bins = make_bins(
        bins=8, temperatures=(60.0,), days=(8.0,), speeds=np.geomspace(1.0, 60.0, 10), repeats=1,
        gain=0.001, noise_N=0.03, run_channels=WEEK, effect=recalibrated,
    )  # fmt: skip
    rows = make_rows(bins, has_aging=True)
    found = search(ScoreTests(fit_declared(rows)), find_channels(rows), np.random.default_rng(0))
    assert found[0].channels == ("elapsed_h",)
    assert found[0].p_value < 1e-6
    assert min(c.p_value for c in found if c.columns.shape[1] > 1) > 0.005


def test_a_speed_effect_shows_where_sigma_2_could_take_it_up_only_below_zero():
    """Stribeck exponent 1 at four speeds: the rest lies along a negative sigma_2, which no fit may have."""

    def softer(table, force):
        speed = np.abs(table["speed_mm_s"].to_numpy())
        fall = np.exp(-speed / 15) - np.exp(-((speed / 15) ** 2))
        return force + 0.3 * 49.03 * fall - 0.02 * speed

    bins = make_bins(speeds=(1.0, 4.0, 12.0, 40.0), bins=4, repeats=2, gain=0.002, effect=softer)
    fitted = fit_declared(make_rows(bins, has_aging=True))
    assert fitted.at_limit.sum() == 3  # one sigma_2 per series, and the unaged rubber
    channels = find_channels(fitted.rows)
    found = search(ScoreTests(fitted), channels, np.random.default_rng(0))
    best = next(c for c in found if c.key == (("speed_mm_s",), "mu", "multiply"))
    assert best.p_value < 0.001
    terms = terms_of(best, {c.name: c for c in channels}, fitted, EFFECTS)
    assert any(term.effect.id == "log_rate" for term, _ in terms)


@pytest.mark.parametrize(("exponent", "drop"), [(3.0, 0.8), (0.7, 0.3)])
def test_a_stribeck_exponent_is_found_above_and_below_2(exponent, drop):
    """The shape vanishes at 2, so that a fit that starts below it does not reach an exponent above it."""

    def abrupt(table, force):
        ratio = np.abs(table["speed_mm_s"].to_numpy()) / TRUE["v_s"]
        return force + LOAD_N * drop * (np.exp(-(ratio**exponent)) - np.exp(-(ratio**2)))

    bins = make_bins(bins=2, speeds=tuple(np.geomspace(0.5, 200, 11)), effect=abrupt)
    fitted = fit_declared(make_rows(bins, has_aging=True))
    channels = {c.name: c for c in find_channels(fitted.rows)}
    found = search(ScoreTests(fitted), list(channels.values()), np.random.default_rng(0))
    named = propose(fitted, [c for c in found if c.p_value < 0.005], channels, EFFECTS)[0]
    assert named.term.effect.id == "stribeck_exponent"
    assert named.fitted.model.values[-1]["n"] == pytest.approx(exponent, rel=0.15)


def test_another_curve_of_one_of_two_rubbers_is_found_in_it():
    """The curves of two rubbers are fitted apart: a common shape of the speed would change both."""

    bins = with_another_curve()
    fitted = fit_declared(make_rows(bins, has_aging=True))
    channels = {c.name: c for c in find_channels(fitted.rows)}
    found = search(ScoreTests(fitted), list(channels.values()), np.random.default_rng(0))
    p_values = {c.category: c.p_value for c in found if c.category}
    assert p_values["A"] < 0.001 < 0.1 < p_values["B"]
    named = propose(fitted, [c for c in found if c.category == "A"], channels, EFFECTS)[0]
    assert named.term.channels == ("speed_mm_s", "lot")
    added = added_force(named)
    in_a = channels["lot"].values == "A"
    assert (added[~in_a] == 0.0).all()
    assert np.std(named.fitted.residual[in_a]) < 0.6 * np.std(fitted.residual[in_a])


def test_a_constant_force_without_noise_gives_no_alarm():
    bins = make_bins(days=(), temperatures=(), bins=4, speeds=(0.5, 2.0, 8.0, 30.0), gain=0.0, noise_N=0.0)
    fitted = fit_declared(make_rows(bins.assign(force_N=40.0), has_aging=True))
    found = search(ScoreTests(fitted), find_channels(fitted.rows), np.random.default_rng(0))
    assert min(c.p_value for c in found) == 1.0


@pytest.mark.parametrize("seed", [0, 2, 3])
def test_specimens_that_differ_in_dry_friction_alone_are_no_change_with_the_calendar(seed):
    """Their viscous force is the same, so that no factor on the whole force makes them equal."""
    rng, gains = np.random.default_rng(seed + 1000), {}

    def dry(table, force):
        gain = gains.setdefault(table["specimen_id"].iloc[0], rng.normal(1.0, 0.03))
        viscous = TRUE["sigma_2"] * table["speed_mm_s"].to_numpy()
        return (force - viscous) * gain + 6 * viscous

    settings = {"days": (1.0, 2.0, 4.0, 8.0, 16.0), "repeats": 2, "bins": 6}
    bins = make_bins(seed, noise_N=0.05, gain=0.004, effect=dry, **settings)
    rows = make_rows(bins, has_aging=True)
    fitted = fit_declared(rows)
    assert any(c.kind in ("mu_s", "sigma_2") and c.variance > 0 for c in fitted.scatter.components)
    channels = [c for c in searched(channels_of(rows, Config()), rows) if c.name in CALENDAR]
    found = search(ScoreTests(fitted), channels, np.random.default_rng(0))
    assert min(c.p_value for c in found) > 0.05


@pytest.mark.parametrize(("offset", "reference"), [(0.0, 22.0), (-40.0, -18.0)])
def test_the_reference_of_a_signed_channel_has_its_sign(offset, reference):
    cold = {"lab_temperature_C": lambda rng: offset + 22.0 + rng.uniform(-0.01, 0.01)}
    rows = make_rows(make_bins(2, bins=4, repeats=2, temperatures=(60.0,), run_channels=cold), has_aging=True)
    fitted, channels = fit_declared(rows), {c.name: c for c in find_channels(rows)}
    result = ScoreTestResult(9.0, 1, 40, -9.0)
    candidate = Candidate(("lab_temperature_C",), "mu", "multiply", "run", np.ones((1, 1)), result)
    found = {
        term.fixed[name]
        for term, _ in terms_of(candidate, channels, fitted, EFFECTS)
        for name in ("x_ref", "lab_temperature_C_ref")
        if name in term.fixed and term.effect.id != "smooth"
    }
    assert found == {reference}


def test_few_days_determine_what_the_declared_model_has_the_same_on_all_days():
    rows = make_rows(make_bins(2, bins=4, repeats=1, days=(4.0, 28.0)), has_aging=True)
    fitted = fit_declared(rows)
    days = next(c for c in find_channels(rows) if c.name == "aging_days")
    assert room_along(days, fitted) == 0
    assert room_along(days, fitted, ("force", "multiply")) == 0
    assert [room_along(days, fitted, t) for t in (("v_s", "multiply"), ("force", "add"))] == [2, 2]
