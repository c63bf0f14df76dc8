import re
import warnings
from xml.etree import ElementTree

import numpy as np
import numpy.testing as npt
import pandas as pd
import pytest
from drawing_helpers import panel_figure
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from report.made_campaigns import Made, aging_campaign, torque_campaign
from report.made_tables import DROP, empty, shape_points, shapes, table

from sealfit.config import Config
from sealfit.report.drawing import AFTER, Key, Panel, Plot, compose, draw, inline, is_logarithmic, value_ticks
from sealfit.report.figures import draw_all
from sealfit.report.figures.aging import (
    draw_aging,
    draw_master_curve,
    draw_trace,
    envelope,
    example_runs,
    traces_mean,
)
from sealfit.report.figures.residual import (
    channel_order,
    draw_channel,
    draw_errors,
    draw_levels,
    draw_shape,
    finding,
    residual_channels,
    run_means,
)
from sealfit.report.figures.speed import curve_lines, force_speed, run_points
from sealfit.units import Units

NO_POINTS = pd.DataFrame()
TORQUE = Units(
    {"force": ("torque", "mN m"), "displacement": ("angle", "turn"), "speed": ("rotational speed", "rpm")}
)


@pytest.fixture
def ax():
    return Figure().add_subplot()


@pytest.fixture(scope="module")
def made():
    return aging_campaign()


@pytest.fixture(scope="module")
def twelve_series():
    """A campaign of the paper's series, with two days, speeds and bins of each."""
    return aging_campaign(
        temperatures=(20, 40, 60, 80), compressions=(80, 90, 100), days=(4, 16), speeds=(1, 10),
        bins_per_file=2, trace_points=50,
    )  # fmt: skip


# ---------------------------------------------------------------- force against speed
def test_run_means_average_files_and_take_the_direction_out():
    steady = pd.DataFrame(
        {
            "condition": "c",
            "run_id": ["r+", "r+", "r-", "r-"],
            "direction": [1, 1, -1, -1],
            "file": ["a", "b", "a", "b"],
            "speed_mm_s": [5.0, 5.0, -5.0, -5.0],
            "force_N": [10.0, 12.0, -20.0, -20.0],
            "used": [True, True, True, True],
        }
    )
    points = run_points(steady).set_index("run_id")
    assert points.loc["r+", "force"] == 11.0
    npt.assert_allclose(points.loc["r+", "sd"], np.sqrt(2.0))
    assert points.loc["r-", ["speed", "force", "sd"]].tolist() == [5.0, 20.0, 0.0]


def test_what_was_left_out_of_the_fit_is_not_drawn(made):
    steady = made.tables["steady"].assign(used=made.tables["steady"]["repeat"] != 3)
    assert (run_points(steady)["n"] == 2).all()


def test_every_series_has_a_panel_with_its_days_and_the_unaged(made):
    plot = force_speed(made.tables, made.config)
    assert [panel.title for panel in plot.panels] == ["60 °C · 80 %", "60 °C · 100 %"]
    assert [key.label for key in plot.legend[:4]] == ["unaged", "1 d", "4 d", "16 d"]
    assert all("4 conditions" in panel.alt for panel in plot.panels)


def test_all_panels_share_one_scale(twelve_series):
    plot = force_speed(twelve_series.tables, Config())
    assert len(plot.panels) == 12
    assert len({panel_figure(panel).axes[0].get_ylim() for panel in plot.panels}) == 1


def test_torque_rig_shows_true_units_and_no_slot_names():
    made = torque_campaign()
    plot = force_speed(made.tables, made.config)
    (panel,) = plot.panels
    axes = panel_figure(panel).axes[0]
    assert axes.get_ylabel() == "torque (mN m)"
    assert axes.get_xlabel() == "rotational speed (rpm)"
    assert [key.label for key in plot.legend[:4]] == [
        "2 bar",
        "8 bar",
        "run means, forward",
        "run means, backward",
    ]


def test_a_campaign_that_only_goes_backward_has_a_legend_of_what_is_drawn():
    made = torque_campaign()
    tables = {name: made.tables[name] for name in ("steady", "curves", "residuals_after")}
    tables["steady"] = tables["steady"][tables["steady"]["direction"] < 0]
    tables["curves"] = tables["curves"][tables["curves"]["speed_mm_s"] < 0]
    marks = {key.label: key.mark for key in force_speed(tables, made.config).legend}
    assert (marks["run means"], marks["model"]) == ("left", "dashed")


def test_a_quantity_has_the_colour_of_the_legend_in_a_series_without_the_others(made):
    curves = made.tables["aging_curves"]
    first, *_ = sorted(curves["series"].unique())
    curves = curves[(curves["series"] != first) | (curves["quantity"] == "mu_c")]
    plot = draw_all({**made.tables, "aging_curves": curves}, made.closure, made.config)["aging"]
    colours = {key.label: key.colour for key in plot.legend}
    own = curves[curves["series"] == first]["value"].to_numpy()
    drawn = [line for panel in plot.panels for line in panel_figure(panel).axes[0].lines]
    (line,) = [line for line in drawn if np.array_equal(line.get_ydata(), own)]
    assert line.get_color() == colours["mu_c"]
    assert sum("µ_c starts" in panel.alt or "μ_c starts" in panel.alt for panel in plot.panels) == 1


def test_bands_of_backward_motion_are_not_upside_down():
    made = torque_campaign()
    curves = curve_lines(made.tables)
    assert (curves["lo"] < curves["after"]).all()
    assert (curves["after"] < curves["hi"]).all()
    assert (curves["after"] > 0).all()


def test_many_conditions_of_one_kind_get_panels_of_their_own():
    rows = pd.DataFrame({"batch": np.repeat([f"b{k}" for k in range(14)], 2)})
    rows = rows.assign(
        condition="batch=" + rows["batch"], series="batch=" + rows["batch"], rubber="rubber", direction=1,
        run_id=rows["batch"], file=[f"{k}.csv" for k in range(28)], speed_mm_s=5.0, force_N=10.0,
        load_N=1.0, used=True,
    )  # fmt: skip
    tables = {"steady": rows} | {name: empty(name) for name in ("curves", "residuals_after")}
    plot = force_speed(tables, Config(condition=["batch"]))
    assert [panel.title for panel in plot.panels][:3] == ["b0", "b1", "b10"]
    assert len(plot.panels) == 12
    assert plot.note.startswith("12 of 14 panels are drawn, selected evenly.")


# ---------------------------------------------------------------- aging and traces
def test_aging_draws_points_bars_and_law(ax):
    points = pd.DataFrame({"quantity": "mu_s", "aging_days": [0.0, 4.0], "value": [0.9, 0.8],
                           "lo95": [0.88, 0.79], "hi95": [0.92, np.nan]})  # fmt: skip
    curves = pd.DataFrame(
        {"quantity": "mu_s", "aging_days": [0.0, 4.0], "value": [0.9, 0.8], "lo95": 0.7, "hi95": 1.0}
    )
    draw_aging(ax, points, curves, curves.iloc[:0], ["mu_s"], Units())
    npt.assert_array_equal(ax.lines[0].get_ydata(), [0.9, 0.8])
    (bars,) = ax.containers
    points, _, (lines,) = bars
    npt.assert_array_equal(points.get_ydata(), [0.9, 0.8])
    npt.assert_allclose([line[:, 1] for line in lines.get_segments()], [[0.88, 0.92], [0.79, 0.8]])
    assert ax.get_xlabel() == "aging time (d)"


def test_unaged_rubber_starts_every_series(made):
    plot = draw_all(made.tables, made.closure, made.config)["aging"]
    for panel in plot.panels:
        points = [bars.lines[0] for bars in panel_figure(panel).axes[0].containers]
        assert [min(line.get_xdata()) for line in points] == [0.0, 0.0]
        assert [len(line.get_xdata()) for line in points] == [4, 4]  # a point a day, and nothing else


def test_thinned_traces_keep_every_peak():
    x = np.linspace(0, 40, 5000)
    force = np.sin(x)
    force[1234] = 9.0
    thin = envelope(pd.DataFrame({"displacement_mm": x, "force_N": force}))
    assert len(thin) <= 702
    assert thin["force_N"].max() == 9.0
    assert thin["force_N"].min() == force.min()
    assert thin["displacement_mm"].is_monotonic_increasing


def test_trace_shades_its_steady_window(ax):
    x = np.linspace(0, 40, 81)
    trace = pd.DataFrame({"displacement_mm": x, "direction": -1, "force_N": -1.0, "force_se_N": np.nan})
    trace = trace.assign(n=np.where(x < 10, 2, 3), steady=((x >= 5) & (x <= 12)) | ((x >= 20) & (x <= 30)))
    draw_trace(ax, trace, pd.DataFrame(columns=["file", "stroke"]), TORQUE)
    npt.assert_array_equal(ax.lines[0].get_ydata(), 1.0)  # in the direction of motion
    drawn = ax.lines[1].get_ydata()
    npt.assert_array_equal(np.isnan(drawn), x < 10)  # where every repeat is there
    windows = [path.get_extents() for path in ax.collections[-1].get_paths()]
    assert [(window.x0, window.x1) for window in windows] == [(5.0, 12.0), (20.0, 30.0)]
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("angle (turn)", "torque (mN m)")


def test_single_repeats_lie_behind_their_mean(made):
    (panel, *_), runs = (plot := traces_mean(made.tables, made.config)).panels, made.tables["traces_mean"]
    repeats = made.tables["traces"][made.tables["traces"]["run_id"] == runs["run_id"].iloc[0]]
    lines = panel_figure(panel).axes[0].lines
    single, mean = lines[:3], lines[-1]
    for line, (_, own) in zip(single, repeats.groupby("file"), strict=True):
        npt.assert_array_equal(line.get_ydata(), own["force_N"])
        assert line.get_zorder() < mean.get_zorder()
        assert line.get_linewidth() < mean.get_linewidth()
    assert "single repeats, up to 6" in [key.label for key in plot.legend]


def test_scaled_days_are_plain_numbers(ax):
    known = {"kind": "value", "quantity": "mu_s", "temperature_C": 60.0, "compression_ratio_pct": 80.0}
    rows = pd.DataFrame({**known, "scaled_days": [0.0, 1.0, 30.0], "value": [0.9, 0.8, 0.7], "lo95": np.nan})
    rows = rows.assign(hi95=np.nan, aging_days=[0.0, 1.0, 30.0])
    draw_master_curve(ax, rows, rows.iloc[:0], {60.0: "#0072B2"}, Units())
    ax.figure.draw_without_rendering()
    assert [tick.get_text() for tick in ax.get_xticklabels()] == ["0", "1", "10"]


def test_a_master_curve_is_called_by_its_quantity(made):
    titles = [
        panel.title for panel in draw_all(made.tables, made.closure, made.config)["master_curve"].panels
    ]
    assert titles == ["Static friction coefficient", "Coulomb friction coefficient"]


def test_a_master_curve_without_unaged_rubber_is_as_wide_as_its_figure(made):
    curve = made.tables["master_curve"]
    tables = {**made.tables, "master_curve": curve[(curve["kind"] == "law") | (curve["scaled_days"] > 0)]}
    draw(draw_all(tables, made.closure, made.config)["master_curve"])  # a collapsed layout is a warning


# ---------------------------------------------------------------- the loop
def test_errors_stand_beside_the_noise_floor(ax, made):
    draw_errors(ax, made.closure, TORQUE)
    lines = {tuple(np.atleast_1d(line.get_xdata())) for line in ax.lines}
    for key in ("rmse_N", "rmse_runs_N", "heldout_rmse_N"):
        assert (made.closure["before"][key],) in lines
        assert (made.closure["after"][key],) in lines
    assert (0.262, 0.262) in lines
    assert ax.get_xlabel() == "rms error (mN m)"


def test_errors_that_are_all_zero_are_drawn(ax):
    none = dict.fromkeys(("rmse_N", "rmse_runs_N", "heldout_rmse_N", "max_abs_N"), 0.0)
    draw_errors(ax, {"before": none, "after": none, "noise_floor_N": 0.0}, TORQUE)
    assert ax.get_xlim() == (0.0, 1.0)


def test_run_means_weigh_files_alike():
    rows = pd.DataFrame({"run_id": "r", "file": ["a", "a", "a", "b"], "residual_N": [1.0, 1.0, 1.0, 3.0]})
    assert run_means(rows, "residual_N").tolist() == [2.0]


def test_levels_are_drawn_as_variance(ax):
    sds = {"before": 3.0, "after": 1.0}
    rows = [
        {"stage": stage, "level": "run", "sd_N": sd, "share": 1.0, "df": 9.0} for stage, sd in sds.items()
    ]
    draw_levels(ax, table("levels", rows), TORQUE)
    assert [bar.get_width() for bar in ax.patches] == [9.0, 1.0]
    assert {text.get_text() for text in ax.texts} == {"3.0", "1.0"}
    assert ax.get_xlabel() == "variance ((mN m)²)"


def test_channels_have_95_percent_bars(ax):
    mean = {"before_N": 1.0, "before_half_N": 0.5, "after_N": 0.0, "after_half_N": 0.5}
    mean |= {"channel": "batch", "n": 9, "along_motion": False, "before_run": "r", "after_run": "r"}
    rows = table("channels", [{"label": name, **mean} for name in "ab"])
    draw_channel(ax, rows, "batch", TORQUE)
    ends = ax.containers[0].lines[2][0].get_segments()[0][:, 1]
    npt.assert_allclose(ends, [0.5, 1.5])
    assert [tick.get_text() for tick in ax.get_xticklabels()] == ["a", "b"]
    assert ax.get_ylabel() == "residual (mN m)"


def test_means_that_are_all_missing_have_a_scale(made):
    channels = made.tables["channels"].assign(before_N=np.nan, after_N=np.nan)
    plot = residual_channels({**made.tables, "channels": channels}, made.config)
    assert np.isfinite(plot.panels[0].limits["ylim"]).all()


def test_the_strongest_channel_comes_first(made):
    assert channel_order(made.tables)[0] == "time_s"


@pytest.mark.parametrize("commanded", [True, False])
def test_an_effect_of_the_direction_is_shown_over_the_signed_speed(made, commanded):
    tables = dict(made.tables)
    for stage, size in (("before", -0.1), ("after", 0.0)):  # viscous friction that is larger backward
        rows = tables[f"residuals_{stage}"]
        speed = rows["speed_mm_s"].astype(float) * np.where(rows["repeat"] == 1, -1, 1)
        measured = speed * np.where(rows["repeat"] == 2, 1.04 if commanded else 1.0, 1.0)
        made_N = {"speed_mm_s": measured, "residual_N": size * speed.abs()}
        rows = rows if commanded else rows.drop(columns="speed_set_mm_s")
        tables[f"residuals_{stage}"] = rows.assign(**made_N)
    known = {
        "channel": "direction",
        "before_N": 1.0,
        "before_half_N": 0.1,
        "after_N": 0.0,
        "after_half_N": 0.1,
    }
    tables["channels"] = table("channels", [{**known, "x": sign, "n": 9} for sign in (-1.0, 1.0)])
    effect = {**made.closure["effects"][0], "channels": ["direction"]}
    plot = finding(tables, {**made.closure, "effects": [effect]}, made.config)
    drawn = panel_figure(plot.panels[0]).axes[0].containers
    before, after = (np.array(one.lines[0].get_xydata(), float) for one in drawn)
    magnitudes = np.unique(made.tables["residuals_before"]["speed_mm_s"])
    speeds = np.sort([*magnitudes, *-magnitudes])
    npt.assert_allclose(before[:, 0], speeds, atol=0.01 * np.ptp(speeds))
    npt.assert_allclose(before[:, 1], -0.1 * np.abs(speeds))
    npt.assert_array_equal(after[:, 1], 0.0)
    assert plot.panels[0].title == "Sliding speed, negative backward"


def test_a_factor_is_drawn_in_percent(ax, made):
    draw_shape(ax, shapes(), NO_POINTS, made.closure["effects"][0], Units())
    assert ax.get_ylabel() == r"change of $\mu$ (%)"
    npt.assert_allclose(ax.lines[-1].get_ydata()[-1], -100 * DROP, rtol=1e-6)


def test_a_shape_along_repeats_has_ticks_at_repeats_only(ax, made):
    rows, points = shapes(), shape_points().iloc[:3].assign(x=[1.0, 2.0, 3.0])
    draw_shape(ax, rows.assign(x=np.linspace(1, 3, len(rows))), points, made.closure["effects"][0], Units())
    assert [tick.get_text() for tick in ax.get_xticklabels()] == ["1", "2", "3"]


def test_partial_residuals_lie_behind_an_effect(ax, made):
    points = shape_points()
    draw_shape(ax, shapes(), points, made.closure["effects"][0], Units())
    drawn = ax.containers[0]
    npt.assert_allclose(drawn.lines[0].get_xydata(), np.stack([points["x"], 100 * points["value"]], axis=1))
    npt.assert_allclose(np.ptp(drawn.lines[2][0].get_segments()[0][:, 1]), 2 * 1.959964 * 0.05)
    assert drawn.lines[0].get_zorder() < min(
        line.get_zorder() for line in ax.lines if line.get_color() == AFTER
    )
    legend = draw_all(made.tables, made.closure, made.config)["effect_shapes"].legend
    assert "partial residual" in legend[-1].label


def test_an_added_force_has_its_unit(ax, made):
    rows = shapes().assign(unit="mN m")
    draw_shape(
        ax, rows, NO_POINTS, {**made.closure["effects"][0], "acts_on": "force", "operation": "add"}, TORQUE
    )
    assert ax.get_ylabel() == "added torque (mN m)"


def test_directions_are_two_and_named(ax, made):
    x = np.linspace(-1, 1, 5)
    rows = (
        shapes()
        .head(5)
        .assign(channel="direction", x=x, value=0.1 * x, lo95=0.1 * x - 0.02, hi95=0.1 * x + 0.02)
    )
    draw_shape(ax, rows, NO_POINTS, made.closure["effects"][0], Units())
    assert [tick.get_text() for tick in ax.get_xticklabels()] == ["backward", "forward"]
    npt.assert_allclose(ax.containers[0].lines[0].get_ydata(), [-10.0, 10.0])


@pytest.mark.parametrize(
    ("values", "logarithmic"),
    [
        ([0.5, 1, 2, 5, 10, 20, 50], True),
        ([0.4, 60, 100, 130, 160, 200], False),
        ([1, 2, 5], False),
        ([-1, 1, 99], False),
    ],
)
def test_an_axis_is_logarithmic_where_the_values_are(values, logarithmic):
    assert is_logarithmic(np.array(values, float), 20.0) is logarithmic


def test_ticks_stand_at_the_values_where_they_fit(ax):
    value_ticks(ax, np.array([20.0, 60.0, 80.0]))
    assert [tick.get_text() for tick in ax.get_xticklabels()] == ["20", "60", "80"]


# ---------------------------------------------------------------- style
@pytest.mark.parametrize("label", ["<script>", 'a"quote', "a$b$c", "_hidden", "&amp;", "x" * 200])
def test_any_column_name_can_be_drawn(label):
    rows = [{"channel": label, "label": label, "n": 1, "before_N": 1.0, "after_N": 0.0}] * 2
    panel = Panel(label, "alt", lambda ax: draw_channel(ax, table("channels", rows), label, Units()))
    text = draw(Plot("p", label, (panel,), (Key(label, "#000000"),)))["svg"]
    ElementTree.fromstring(text)
    assert text.count("<svg") == 1
    assert "<script>" not in text


def test_letters_that_the_font_lacks_become_text():
    panel = Panel("温度", "alt", lambda ax: ax.plot([0, 1], [0, 1]))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert "温度" in draw(Plot("one", "", (panel,)))["svg"]


def test_the_same_tables_give_the_same_bytes(made):
    plot = draw_all(made.tables, made.closure, made.config)["variance_levels"]
    assert draw(plot) == draw(plot)


def test_a_drawing_holds_all_that_it_uses_and_is_an_element_of_the_page(made):
    drawn = draw(draw_all(made.tables, made.closure, made.config)["aging"])
    for svg in (drawn["svg"], inline(drawn["svg"], "aging", "what it shows")):
        element = ElementTree.fromstring(svg)
        names = [one.get("id") for one in element.iter() if one.get("id")]
        used = set(re.findall(r'(?:href="#|url\(#)([^")]+)', svg))
        assert used <= set(names)
        assert sum("axes" in name for name in names) == 2
    assert all(name.startswith("aging-") for name in names)
    assert element.get("aria-label") == "what it shows"
    assert "<style" not in svg
    assert drawn["png"].startswith(b"\x89PNG")


def test_markers_have_their_texts_as_titles(made):
    svg = draw(draw_all(made.tables, made.closure, made.config)["aging"])["svg"]
    titles = re.findall(r"<use [^>]*><title>([^<]*)</title></use>", svg)
    assert len(titles) == 2 * 2 * 4  # series, coefficients, days
    assert titles[0].startswith("μ_s 0.")


def test_a_power_of_ten_stands_clear_of_the_title():
    def draw_values(ax):
        ax.plot([0, 1], [0, 2e-5])

    figure = panel_figure(Panel("title", "alt", draw_values))
    figure.draw_without_rendering()
    (axes,) = figure.axes
    power, title = axes.yaxis.get_offset_text(), axes._left_title
    assert "10^{" in power.get_text()
    assert not power.get_window_extent().overlaps(title.get_window_extent())


def test_every_figure_has_a_white_edge(made):
    for one in (made, torque_campaign()):
        for name, plot in draw_all(one.tables, one.closure, one.config).items():
            white = white_of(compose(plot))
            assert edge(white).all(), name
            assert not white.all()


def white_of(figure):
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba()).min(axis=2) == 255


def edge(image):
    return np.concatenate([image[0], image[-1], image[:, 0], image[:, -1]])


@pytest.mark.parametrize("verdict", ["closed", "nothing_missing", "unexplained"])
def test_no_panel_is_empty(verdict):
    made: Made = aging_campaign(verdict=verdict, speeds=(1, 10), days=(4,))
    for name, plot in draw_all(made.tables, made.closure, made.config).items():
        for panel in plot.panels:
            assert panel_figure(panel).axes[0].has_data(), name
            assert len(panel.alt) > 20


def test_the_rows_of_the_example_runs_alone_give_the_same_traces(twelve_series):
    made = twelve_series
    whole, rows = traces_mean(made.tables, made.config), made.tables["traces_mean"]
    chosen = example_runs(rows[["run_id", "condition"]].drop_duplicates(), made.tables["runs"])
    assert len(chosen) == 6 < rows["run_id"].nunique()
    parts = pd.concat([rows[rows["run_id"] == run] for run in chosen["run_id"]])
    alone = traces_mean({**made.tables, "traces_mean": parts}, made.config)
    assert [panel.alt for panel in alone.panels] == [panel.alt for panel in whole.panels]
    assert alone.legend == whole.legend
