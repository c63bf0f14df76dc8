"""Every column of every table, once: name, unit, type and meaning.

A name such as `force_N` is a slot; `sealfit.units` says what unit it truly holds.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import pyarrow as pa

FLOAT, INT, TEXT, BOOL = pa.float64(), pa.int64(), pa.string(), pa.bool_()


@dataclass(frozen=True, slots=True)
class Column:
    """One column: its name, true unit at default (empty for ratios and labels), type and meaning."""

    name: str
    unit: str
    dtype: pa.DataType
    meaning: str


@dataclass(frozen=True, slots=True)
class Schema:
    """One table: its fixed columns and, if `open_`, the condition columns and channels the campaign adds."""

    name: str
    columns: tuple[Column, ...]
    open_: bool = False

    def names(self) -> list[str]:
        """Return the fixed column names in order."""
        return [column.name for column in self.columns]


# ---------------------------------------------------------------- keys that several tables share
FILE = Column("file", "", TEXT, "trace file, relative to the campaign folder")
RUN = Column("run_id", "", TEXT, "run: one condition at one speed and direction")
REPEAT = Column("repeat", "", INT, "number of the repeat within its run")
STROKE = Column(
    "stroke", "", INT, "stroke within the file, from 1; each steady speed of a motion and each turn is one"
)
DIRECTION = Column("direction", "", INT, "+1 where displacement rises, -1 where it falls")
SPECIMEN = Column("specimen_id", "", TEXT, "piece of rubber; one per condition where not given")
CONDITION = Column("condition", "", TEXT, "condition: the condition columns in words; 'unaged' for day 0")
SERIES = Column("series", "", TEXT, "aging series: the condition without days; 'unaged' for day 0")
RUBBER = Column("rubber", "", TEXT, "rubber, from the config's rubber columns; 'rubber' if there is one")
SPEED = Column("speed_mm_s", "mm/s", FLOAT, "measured sliding speed, signed")
SPEED_SET = Column(
    "speed_set_mm_s",
    "mm/s",
    FLOAT,
    "commanded speed, magnitude; that of the run where a stroke has several; null if not given",
)
LOAD = Column("load_N", "N", FLOAT, "normal load; null if not given")
FORCE = Column("force_N", "N", FLOAT, "friction force, with the sign of the motion where it opposes it")
PRESLIDING = Column("presliding_N", "N", FLOAT, "what is left of the pre-sliding rise, taken out of force_N")
DISPLACEMENT = Column("displacement_mm", "mm", FLOAT, "displacement in the rig's own coordinate")
DISTANCE = Column("distance_mm", "mm", FLOAT, "distance slid since the start of the motion")
TIME = Column(
    "time_s", "s", FLOAT, "time in the file; from the start of the motion in a file of several strokes"
)
RUN_ORDER = Column("run_order", "", FLOAT, "place of the file in the order of started_at; null if not given")
ELAPSED = Column("elapsed_h", "h", FLOAT, "time since the campaign's first file; null if not given")

KEYS = (FILE, RUN, REPEAT, STROKE, DIRECTION, SPECIMEN, CONDITION, SERIES, RUBBER)

# ---------------------------------------------------------------- ingest
INPUTS = Schema(
    "inputs",
    (
        FILE,
        Column("size", "byte", INT, "size of the file"),
        Column("mtime_ns", "ns", INT, "time of last change"),
        Column("sha256", "", TEXT, "hash of the content"),
        Column("rows", "", INT, "data rows read"),
        Column("strokes", "", INT, "strokes found"),
        Column("status", "", TEXT, "used | left out | not matched"),
    ),
)
RUNS = Schema(
    "runs",
    (
        *KEYS,
        SPEED,
        SPEED_SET,
        LOAD,
        RUN_ORDER,
        ELAPSED,
        Column(
            "started_at", "", TEXT, "start of the file, ISO 8601, as given where it is; null if not given"
        ),
        Column("used", "", BOOL, "false where the stroke was left out; quality says why"),
    ),
    open_=True,
)
QUALITY = Schema(
    "quality",
    (
        FILE,
        Column("stroke", "", INT, "stroke, null for the whole file"),
        Column("line", "", INT, "line in the file, null if not one line"),
        Column("column", "", TEXT, "column concerned, null if none"),
        Column("check", "", TEXT, "name of the rule"),
        Column("value", "", TEXT, "what was found"),
        Column("severity", "", TEXT, "info | warning | error"),
        Column("action", "", TEXT, "kept | row left out | stroke left out | file left out"),
        Column("reason", "", TEXT, "in a sentence"),
        Column("fix", "", TEXT, "what to do about it"),
    ),
)
TRACES = Schema(
    "traces",
    (
        FILE,
        CONDITION,
        STROKE,
        TIME,
        DISPLACEMENT,
        FORCE,
        Column(
            "presliding_N",
            "N",
            FLOAT,
            "in the steady window, what is left in force_N of the pre-sliding rise",
        ),
        Column("steady", "", BOOL, "true inside the steady window"),
    ),
    open_=True,  # channels measured along the trace
)
TRACES_MEAN = Schema(
    "traces_mean",
    (
        RUN,
        DIRECTION,
        CONDITION,
        DISPLACEMENT,
        Column("force_N", "N", FLOAT, "mean force of the repeats at this displacement"),
        Column(
            "force_se_N", "N", FLOAT, "standard error of that mean, from the repeats; null for one repeat"
        ),
        Column("n", "", INT, "strokes averaged"),
        Column("steady", "", BOOL, "true where every stroke averaged is in its steady window"),
    ),
)
STEADY = Schema(
    "steady",
    (
        *KEYS,
        SPEED,
        SPEED_SET,
        LOAD,
        Column("force_N", "N", FLOAT, "friction force: mean over the steady window, without presliding_N"),
        PRESLIDING,
        Column("force_sd_N", "N", FLOAT, "standard deviation of the samples in the window"),
        Column("force_se_N", "N", FLOAT, "standard error of the mean, autocorrelation counted in"),
        Column("n", "", INT, "samples in the window"),
        DISPLACEMENT,
        Column("displacement_from_mm", "mm", FLOAT, "start of the steady window"),
        Column("displacement_to_mm", "mm", FLOAT, "end of the steady window"),
        DISTANCE,
        TIME,
        RUN_ORDER,
        ELAPSED,
        Column("outlier", "", BOOL, "true where this repeat disagrees with its run beyond pooled scatter"),
        Column("used", "", BOOL, "false where the config leaves an outlier out of the fits"),
    ),
    open_=True,
)
BINS = Schema(
    "bins",
    (
        *KEYS,
        Column("bin", "", INT, "number of the bin along its stroke, from 0"),
        SPEED,
        Column(
            "speed_bin_mm_s",
            "mm/s",
            FLOAT,
            "sliding speed in the bin; the stroke's where no difference is seen",
        ),
        SPEED_SET,
        LOAD,
        Column("force_N", "N", FLOAT, "friction force: mean in the bin, without presliding_N"),
        PRESLIDING,
        Column("force_sd_N", "N", FLOAT, "standard deviation of the samples in the bin"),
        Column("n", "", INT, "samples in the bin"),
        DISPLACEMENT,
        DISTANCE,
        TIME,
        RUN_ORDER,
        ELAPSED,
    ),
    open_=True,
)

# ---------------------------------------------------------------- fits (long: one row per parameter)
# The fits before the loop are without effects. If the loop added effects, the tables with the suffix `_after`
# have the fits after their subtraction; otherwise these are empty. Column `model` is "before" or "after".
MODEL = Column("model", "", TEXT, "before: without effects | after: at the reference of the loop's effects")
_FIT = (
    MODEL,
    Column("quantity", "", TEXT, "what was fitted, e.g. steady, mu_s, mu_c, statistics"),
    Column("parameter", "", TEXT, "parameter or statistic, in the field's symbol"),
    Column("value", "", FLOAT, "estimate"),
    Column("se", "", FLOAT, "standard error (type A)"),
    Column("lo95", "", FLOAT, "lower end of the 95 % interval (type A)"),
    Column("hi95", "", FLOAT, "upper end of the 95 % interval (type A)"),
    Column("u_sys", "", FLOAT, "standard uncertainty from the sensor's accuracy (type B)"),
    Column("unit", "", TEXT, "unit of value, se, lo95, hi95 and u_sys"),
    Column("identified", "", BOOL, "false where these data do not determine it"),
    Column("reason", "", TEXT, "why it is not determined, or a remark such as mu_s < mu_c"),
)
STEADY_FIT = Schema("steady_fit", (CONDITION, SERIES, RUBBER, *_FIT), open_=True)
AGING_FIT = Schema("aging_fit", (SERIES, RUBBER, *_FIT), open_=True)
_OTHER = Column("other", "", TEXT, "the other parameter; the parameter itself for a variance")
_COVARIANCE = (
    Column("value", "", FLOAT, "covariance of the two estimates (type A)"),
    Column("unit", "", TEXT, "unit of value"),
    Column("identified", "", BOOL, "false where these data do not determine one of the two"),
)
_PARAMETER = Column("parameter", "", TEXT, "parameter, in the field's symbol")
STEADY_COVARIANCE = Schema(
    "steady_covariance", (CONDITION, SERIES, RUBBER, MODEL, _PARAMETER, _OTHER, *_COVARIANCE), open_=True
)
AGING_COVARIANCE = Schema(
    "aging_covariance",
    (
        SERIES,
        RUBBER,
        MODEL,
        Column("quantity", "", TEXT, "what the law is of: mu_s, mu_c, F_s or F_c"),
        replace(_PARAMETER, meaning="mu_0, a or ln b"),
        _OTHER,
        *_COVARIANCE,
    ),
    open_=True,
)
STEADY_SHIFT = Schema(
    "steady_shift",
    (
        CONDITION,
        SERIES,
        RUBBER,
        MODEL,
        Column(
            "source",
            "",
            TEXT,
            "sensor: it reads one standard uncertainty too high | 1, 2, ...: of the effects",
        ),
        _PARAMETER,
        Column("value", "", FLOAT, "change of the parameter, common to all conditions in sign"),
        Column("unit", "", TEXT, "unit of value"),
        Column("identified", "", BOOL, "false where these data do not determine the parameter"),
    ),
    open_=True,
)
DYNAMIC_FIT = Schema("dynamic_fit", (CONDITION, SERIES, RUBBER, DIRECTION, SPEED_SET, *_FIT), open_=True)

STEADY_AFTER = Schema(
    "steady_after",
    (
        *(
            replace(c, meaning=f"{c.meaning}, less `effects_N`") if c.name == "force_N" else c
            for c in STEADY.columns
        ),
        Column("effects_N", "N", FLOAT, "mean force of the subtracted effects over the steady window"),
        Column("effects_start_N", "N", FLOAT, "force of these effects at the start of the stroke"),
    ),
    # Channels, and effects_u1_N, ...: directions in which the effects are uncertain, one standard error each.
    open_=True,
)

# ---------------------------------------------------------------- the loop
EFFECTS = Schema(
    "effects",
    (
        Column("round", "", INT, "round of the loop in which it was added"),
        Column("id", "", TEXT, "name in the catalogue, or smooth, levels, ..."),
        Column("label", "", TEXT, "in words"),
        Column("channels", "", TEXT, "channels it reads, separated by spaces"),
        Column("acts_on", "", TEXT, "force, mu or a parameter of the declared model"),
        Column("operation", "", TEXT, "add | multiply"),
        Column("form", "", TEXT, "equation"),
        Column("named", "", BOOL, "false where no closed form fits as well as the free shape"),
        Column("parameter", "", TEXT, "parameter, in the field's symbol"),
        Column("value", "", FLOAT, "estimate"),
        Column("lo95", "", FLOAT, "lower end of the 95 % interval"),
        Column("hi95", "", FLOAT, "upper end of the 95 % interval"),
        Column("unit", "", TEXT, "unit of value, lo95 and hi95"),
        Column("p_value", "", FLOAT, "adjusted over the whole search"),
    ),
)
_RESIDUALS = (
    *BINS.columns,
    Column("model_N", "N", FLOAT, "force of the model, fitted to all rows"),
    Column("residual_N", "N", FLOAT, "measured minus model"),
    Column("heldout_model_N", "N", FLOAT, "force of the model fitted without this row's unit"),
    Column("heldout_residual_N", "N", FLOAT, "measured minus held-out model"),
    Column("weight", "", FLOAT, "weight in the errors: each file weighs the same"),
)
RESIDUALS_BEFORE = Schema("residuals_before", _RESIDUALS, open_=True)
RESIDUALS_AFTER = Schema("residuals_after", _RESIDUALS, open_=True)

# ---------------------------------------------------------------- values of the report's plots of the loop
LEVELS = Schema(
    "levels",
    (
        Column("stage", "", TEXT, "before | after"),
        Column("level", "", TEXT, "sample | stroke | file | run | specimen"),
        Column("channel", "", TEXT, "null for the whole level; else the channel tested at it"),
        Column(
            "sd_N",
            "N",
            FLOAT,
            "standard deviation of the residual at this level, or of the part that the channel explains",
        ),
        Column("share", "", FLOAT, "share of the residual's variance"),
        Column("df", "", FLOAT, "degrees of freedom"),
        Column("p_value", "", FLOAT, "p-value of the channel, adjusted over the search; null for a level"),
    ),
)
CHANNELS = Schema(
    "channels",
    (
        Column("channel", "", TEXT, "channel"),
        Column("x", "", FLOAT, "middle of the group of channel values; null for a category"),
        Column("label", "", TEXT, "the category, or null"),
        Column("n", "", INT, "bins rows in the group"),
        Column("before_N", "N", FLOAT, "mean residual before"),
        Column("before_se_N", "N", FLOAT, "its standard error, from whole units"),
        Column("before_run", "", TEXT, "run with the largest mean residual in the group"),
        Column("after_N", "N", FLOAT, "mean residual after"),
        Column("after_se_N", "N", FLOAT, "its standard error, from whole units"),
        Column("after_run", "", TEXT, "run with the largest mean residual in the group"),
    ),
)
SHAPES = Schema(
    "shapes",
    (
        Column("effect", "", INT, "row in closure.json's effects, from 0"),
        Column("id", "", TEXT, "effect"),
        Column("channel", "", TEXT, "channel drawn along"),
        Column("x", "", FLOAT, "channel value; null for a category"),
        Column("label", "", TEXT, "the category, or null"),
        Column("value", "", FLOAT, "added force, factor minus one, or change of the parameter"),
        Column("lo95", "", FLOAT, "lower end of the 95 % band"),
        Column("hi95", "", FLOAT, "upper end of the 95 % band"),
        Column("free", "", FLOAT, "the free smooth shape at x, null where none was fitted"),
        Column("unit", "", TEXT, "unit of value, lo95, hi95 and free"),
    ),
)
CURVES = Schema(
    "curves",
    (
        CONDITION,
        SERIES,
        SPEED,
        LOAD,
        Column("force_before_N", "N", FLOAT, "declared model"),
        Column("force_after_N", "N", FLOAT, "model with its effects, other channels at their means"),
        Column("force_after_lo95_N", "N", FLOAT, "lower end of the mean's 95 % interval"),
        Column("force_after_hi95_N", "N", FLOAT, "upper end of the mean's 95 % interval"),
    ),
    open_=True,
)
AGING_LAWS = Schema(
    "aging_laws",
    (
        RUBBER,
        MODEL,
        Column("quantity", "", TEXT, "mu_s, mu_c, F_s or F_c"),
        Column("law", "", TEXT, "log | stretched | power | induction, for all series; or separate laws"),
        Column(
            "way",
            "",
            TEXT,
            "what temperature and compression change: rate | loss; empty where neither varies",
        ),
        Column("form", "", TEXT, "equation"),
        Column("rank", "", INT, "1: lowest BIC"),
        Column("rival", "", BOOL, "true where it is not distinguishable from the best law with these data"),
        Column("criterion", "", FLOAT, "BIC minus that of the best law"),
        Column("scatter_rel", "", FLOAT, "relative scatter between specimens about the law"),
        Column("lack_of_fit_p", "", FLOAT, "of the law against replicates; null without them"),
        Column(
            "heldout_series",
            "",
            FLOAT,
            "RMS error on held-out series (50 of them, if there are more), in the quantity's unit",
        ),
        Column("heldout_last_day", "", FLOAT, "RMS error on the held-out last days of these series"),
        Column("parameter", "", TEXT, "parameter; null for separate laws"),
        Column("value", "", FLOAT, "estimate"),
        Column("lo95", "", FLOAT, "lower end of the 95 % interval"),
        Column("hi95", "", FLOAT, "upper end of the 95 % interval"),
        Column("unit", "", TEXT, "unit of value, lo95 and hi95"),
        Column("identified", "", BOOL, "false where these data do not determine it"),
    ),
)
PROPERTY_VALUES = Schema(
    "property_values",
    (
        CONDITION,
        SERIES,
        RUBBER,
        Column("aging_days", "d", FLOAT, "aging time"),
        Column("quantity", "", TEXT, "property: the column's name"),
        Column("value", "", FLOAT, "value of one specimen"),
        Column("unit", "", TEXT, "unit of value"),
        Column("batch", "", TEXT, "batch of the specimen; null if none is named"),
        Column("line", "", INT, "line in the table of values"),
    ),
    open_=True,
)
MASTER_CURVE = Schema(
    "master_curve",
    (
        RUBBER,
        Column("quantity", "", TEXT, "mu_s, mu_c, F_s or F_c"),
        Column("kind", "", TEXT, "value | law"),
        Column(
            "scaled_days", "d", FLOAT, "aging time, by the rate where temperature and compression change that"
        ),
        Column(
            "value",
            "",
            FLOAT,
            "value of a condition, brought to the reference where that changes the loss; or law",
        ),
        Column("lo95", "", FLOAT, "lower end of the law's 95 % band"),
        Column("hi95", "", FLOAT, "upper end of the law's 95 % band"),
        Column("temperature_C", "°C", FLOAT, "aging temperature; null for unaged rubber and for the law"),
        Column(
            "compression_ratio_pct", "%", FLOAT, "height while aging; null for unaged rubber and for the law"
        ),
        Column("aging_days", "d", FLOAT, "aging time; null for the law"),
    ),
)
DYNAMIC_CURVES = Schema(
    "dynamic_curves",
    (
        CONDITION,
        SPEED_SET,
        DIRECTION,
        Column("distance_mm", "mm", FLOAT, "distance slid since the platform began to move"),
        Column("force_N", "N", FLOAT, "mean force of the starts, in the direction of motion"),
        Column("force_se_N", "N", FLOAT, "standard error of that mean, from the starts; null for one start"),
        Column("n", "", INT, "starts averaged"),
        Column(
            "model_N",
            "N",
            FLOAT,
            "mean of the fitted dynamic model over the same samples; null without a fit",
        ),
    ),
)
AGING_CURVES = Schema(
    "aging_curves",
    (
        SERIES,
        Column("quantity", "", TEXT, "mu_s or mu_c"),
        Column("aging_days", "d", FLOAT, "aging time"),
        Column("value", "", FLOAT, "the law's value"),
        Column("lo95", "", FLOAT, "lower end of its 95 % interval"),
        Column("hi95", "", FLOAT, "upper end of its 95 % interval"),
    ),
)

_FITTED = (STEADY_FIT, AGING_FIT, AGING_CURVES, AGING_LAWS, MASTER_CURVE, DYNAMIC_FIT, DYNAMIC_CURVES)
_BESIDE = (STEADY_COVARIANCE, STEADY_SHIFT, AGING_COVARIANCE)  # of the parameters of a fit
AFTER = (STEADY_AFTER, *(replace(fitted, name=f"{fitted.name}_after") for fitted in _FITTED))
BESIDE_AFTER = tuple(replace(beside, name=f"{beside.name}_after") for beside in _BESIDE)

SCHEMAS = {
    schema.name: schema
    for schema in (
        INPUTS,
        RUNS,
        QUALITY,
        TRACES,
        TRACES_MEAN,
        STEADY,
        BINS,
        STEADY_FIT,
        AGING_FIT,
        EFFECTS,
        RESIDUALS_BEFORE,
        RESIDUALS_AFTER,
        LEVELS,
        CHANNELS,
        SHAPES,
        CURVES,
        AGING_CURVES,
        AGING_LAWS,
        PROPERTY_VALUES,
        MASTER_CURVE,
        DYNAMIC_FIT,
        DYNAMIC_CURVES,
        *_BESIDE,
        *AFTER,
        *BESIDE_AFTER,
    )
}
