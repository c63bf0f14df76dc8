"""Every column of every table, once: name, meaning and type; `sealfit.units` has the true unit of a slot."""

from __future__ import annotations

from dataclasses import dataclass, replace

import pyarrow as pa

FLOAT, INT, TEXT, BOOL = pa.float64(), pa.int64(), pa.string(), pa.bool_()


@dataclass(frozen=True, slots=True)
class Column:
    """One column: its name, meaning and type; `unit` where it has one that its name does not tell."""

    name: str
    meaning: str
    dtype: pa.DataType | None = FLOAT  # None: as the values are
    unit: str = ""


@dataclass(frozen=True, slots=True)
class Schema:
    """One table: its fixed columns and, if `open_`, the condition columns and channels the campaign adds."""

    name: str
    columns: tuple[Column, ...]
    open_: bool = False

    def names(self) -> list[str]:
        """Return the fixed column names in order."""
        return [column.name for column in self.columns]


def table(name: str, *columns: Column, open_: bool = False) -> Schema:
    """Return the schema of a table."""
    return Schema(name, columns, open_)


# ---------------------------------------------------------------- keys that several tables share
FILE = Column("file", "trace file, relative to the campaign folder", TEXT)
RUN = Column("run_id", "run: one condition at one speed and direction", TEXT)
REPEAT = Column("repeat", "number of the repeat within its run", INT)
STROKE = Column(
    "stroke", "stroke within the file, from 1; each steady speed of a motion and each turn is one", INT
)
DIRECTION = Column("direction", "+1 where displacement rises, -1 where it falls", INT)
SPECIMEN = Column("specimen_id", "piece of rubber; one per condition where not given", TEXT)
CONDITION = Column("condition", "condition: the condition columns in words; 'unaged' for day 0", TEXT)
SERIES = Column("series", "aging series: the condition without days; 'unaged' for day 0", TEXT)
RUBBER = Column("rubber", "rubber, from the config's rubber columns; 'rubber' if there is one", TEXT)
SPEED = Column("speed_mm_s", "measured sliding speed, signed")
SPEED_SET = Column(
    "speed_set_mm_s",
    "commanded speed, magnitude; that of the run where a stroke has several; null if not given",
)
LOAD = Column("load_N", "normal load; null if not given")
FORCE = Column("force_N", "friction force, with the sign of the motion where it opposes it")
PRESLIDING = Column("presliding_N", "what is left of the pre-sliding rise, taken out of force_N")
DISPLACEMENT = Column("displacement_mm", "displacement in the rig's own coordinate")
DISTANCE = Column("distance_mm", "distance slid since the start of the motion")
TIME = Column("time_s", "time in the file; from the start of the motion in a file of several strokes")
RUN_ORDER = Column("run_order", "place of the file in the order of started_at; null if not given")
ELAPSED = Column("elapsed_h", "time since the campaign's first file; null if not given")
USE = Column(
    "specimen_use",
    "place of the file among those of its specimen, in the order of started_at; null if fewer than two "
    "specimens are named",
)
CALENDAR = ("run_order", "elapsed_h")  # when a file was recorded, from started_at
HISTORY = (*CALENDAR, "specimen_use")  # what was recorded before it

_CONDITION = (CONDITION, SERIES, RUBBER)
_SETTINGS = (SPEED, SPEED_SET, LOAD)
_WHEN = (RUN_ORDER, ELAPSED, USE)
KEYS = (FILE, RUN, REPEAT, STROKE, DIRECTION, SPECIMEN, *_CONDITION)

# ---------------------------------------------------------------- ingest
INPUTS = table(
    "inputs",
    FILE,
    Column("size", "size of the file", INT, unit="byte"),
    Column("mtime_ns", "time of last change", INT, unit="ns"),
    Column("sha256", "hash of the content", TEXT),
    Column("rows", "data rows read", INT),
    Column("strokes", "strokes found", INT),
    Column("status", "used | left out | not matched", TEXT),
)
RUNS = table(
    "runs",
    *KEYS,
    *_SETTINGS,
    *_WHEN,
    Column("started_at", "start of the file, ISO 8601, as given where it is; null if not given", TEXT),
    Column("used", "false where the stroke was left out; quality says why", BOOL),
    open_=True,
)
QUALITY = table(
    "quality",
    FILE,
    Column("stroke", "stroke, null for the whole file", INT),
    Column("line", "line in the file, null if not one line", INT),
    Column("column", "column concerned, null if none", TEXT),
    Column("check", "name of the rule", TEXT),
    Column("value", "what was found", TEXT),
    Column("severity", "info | warning | error", TEXT),
    Column("action", "kept | row left out | stroke left out | file left out", TEXT),
    Column("reason", "in a sentence", TEXT),
    Column("fix", "what to do about it", TEXT),
)
TRACES = table(
    "traces",
    FILE,
    CONDITION,
    STROKE,
    TIME,
    DISPLACEMENT,
    FORCE,
    Column("presliding_N", "in the steady window, what is left in force_N of the pre-sliding rise"),
    Column("steady", "true inside the steady window", BOOL),
    open_=True,  # channels measured along the trace
)
TRACES_MEAN = table(
    "traces_mean",
    RUN,
    DIRECTION,
    CONDITION,
    DISPLACEMENT,
    Column("force_N", "mean force of the repeats at this displacement"),
    Column("force_se_N", "standard error of that mean, from the repeats; null for one repeat"),
    Column("n", "strokes averaged", INT),
    Column("steady", "true where every stroke averaged is in its steady window", BOOL),
)
STEADY = table(
    "steady",
    *KEYS,
    *_SETTINGS,
    Column("force_N", "friction force: mean over the steady window, without presliding_N"),
    PRESLIDING,
    Column("force_sd_N", "standard deviation of the samples in the window"),
    Column("force_se_N", "standard error of the mean, autocorrelation counted in"),
    Column("n", "samples in the window", INT),
    DISPLACEMENT,
    Column("displacement_from_mm", "start of the steady window"),
    Column("displacement_to_mm", "end of the steady window"),
    DISTANCE,
    TIME,
    *_WHEN,
    Column("outlier", "true where this repeat disagrees with its run beyond pooled scatter", BOOL),
    Column("used", "false where the config leaves an outlier out of the fits", BOOL),
    open_=True,
)
BINS = table(
    "bins",
    *KEYS,
    Column("bin", "number of the bin along its stroke, from 0", INT),
    SPEED,
    Column("speed_bin_mm_s", "sliding speed in the bin; the stroke's where no difference is seen"),
    SPEED_SET,
    LOAD,
    Column("force_N", "friction force: mean in the bin, without presliding_N"),
    PRESLIDING,
    Column("rise_mm", "length over which the stroke's pre-sliding rise comes up by 63 %; 0 without one"),
    Column("force_sd_N", "standard deviation of the samples in the bin"),
    Column("n", "samples in the bin", INT),
    DISPLACEMENT,
    DISTANCE,
    TIME,
    *_WHEN,
    open_=True,
)

# ---------------------------------------------------------------- fits (long: one row per parameter)
# The fits before the loop are without effects. If the loop added effects or left out files, the tables with
# the suffix `_after` have the fits without these; otherwise they are empty. Column `model` is "before" or
# "after".
MODEL = Column("model", "before: without effects | after: at the reference of the loop's effects", TEXT)
_FIT = (
    MODEL,
    Column("quantity", "what was fitted, e.g. steady, mu_s, mu_c, statistics", TEXT),
    Column("parameter", "parameter or statistic, in the field's symbol", TEXT),
    Column("value", "estimate"),
    Column("se", "standard error (type A)"),
    Column("lo95", "lower end of the 95 % interval (type A)"),
    Column("hi95", "upper end of the 95 % interval (type A)"),
    Column("u_sys", "standard uncertainty from the sensor's accuracy (type B)"),
    Column("unit", "unit of value, se, lo95, hi95 and u_sys", TEXT),
    Column("identified", "false where these data do not determine it", BOOL),
    Column("reason", "why it is not determined, or a remark such as mu_s < mu_c", TEXT),
)
STEADY_FIT = table("steady_fit", *_CONDITION, *_FIT, open_=True)
AGING_FIT = table("aging_fit", SERIES, RUBBER, *_FIT, open_=True)
_OTHER = Column("other", "the other parameter; the parameter itself for a variance", TEXT)
_COVARIANCE = (
    Column("value", "covariance of the two estimates (type A)"),
    Column("unit", "unit of value", TEXT),
    Column("identified", "false where these data do not determine one of the two", BOOL),
)
_PARAMETER = Column("parameter", "parameter, in the field's symbol", TEXT)
STEADY_COVARIANCE = table(
    "steady_covariance", *_CONDITION, MODEL, _PARAMETER, _OTHER, *_COVARIANCE, open_=True
)
AGING_COVARIANCE = table(
    "aging_covariance",
    SERIES,
    RUBBER,
    MODEL,
    Column("quantity", "what the law is of: mu_s, mu_c, F_s or F_c", TEXT),
    replace(_PARAMETER, meaning="mu_0, a or ln b"),
    _OTHER,
    *_COVARIANCE,
    open_=True,
)
STEADY_SHIFT = table(
    "steady_shift",
    *_CONDITION,
    MODEL,
    Column("source", "sensor: it reads one standard uncertainty too high | 1, 2, ...: of the effects", TEXT),
    _PARAMETER,
    Column("value", "change of the parameter, common to all conditions in sign"),
    Column("unit", "unit of value", TEXT),
    Column("identified", "false where these data do not determine the parameter", BOOL),
    open_=True,
)
DYNAMIC_FIT = table("dynamic_fit", *_CONDITION, DIRECTION, SPEED_SET, *_FIT, open_=True)

STEADY_AFTER = table(
    "steady_after",
    *(
        replace(c, meaning=f"{c.meaning}, less `effects_N`") if c.name == "force_N" else c
        for c in STEADY.columns
    ),
    Column("effects_N", "mean force of the subtracted effects over the steady window"),
    Column("effects_start_N", "force of these effects at the start of the stroke"),
    # Channels, and effects_u1_N, ...: directions in which the effects are uncertain, one standard error each.
    open_=True,
)

# ---------------------------------------------------------------- the loop
_ESTIMATE = (
    Column("value", "estimate"),
    Column("lo95", "lower end of the 95 % interval"),
    Column("hi95", "upper end of the 95 % interval"),
    Column("unit", "unit of value, lo95 and hi95", TEXT),
)
EFFECTS = table(
    "effects",
    Column("round", "round of the loop in which it was added", INT),
    Column("id", "name in the catalogue, or smooth, levels, ...", TEXT),
    Column("label", "in words", TEXT),
    Column("channels", "channels it reads, separated by spaces", TEXT),
    Column("acts_on", "force, mu or a parameter of the declared model", TEXT),
    Column("operation", "add | multiply", TEXT),
    Column("form", "equation", TEXT),
    Column("named", "false where no closed form fits as well as the free shape", BOOL),
    Column("parameter", "parameter, in the field's symbol", TEXT),
    *_ESTIMATE,
    Column("p_value", "adjusted over the whole search"),
)
_RESIDUALS = (
    *BINS.columns,
    Column("model_N", "force of the model, fitted to all rows"),
    Column("residual_N", "measured minus model"),
    Column("heldout_model_N", "force of the model fitted without this row's unit"),
    Column("heldout_residual_N", "measured minus held-out model"),
    Column("weight", "weight in the errors: each file weighs the same"),
)
RESIDUALS_BEFORE = table("residuals_before", *_RESIDUALS, open_=True)
RESIDUALS_AFTER = table("residuals_after", *_RESIDUALS, open_=True)

# ---------------------------------------------------------------- values of the report's plots of the loop
LEVELS = table(
    "levels",
    Column("stage", "before | after", TEXT),
    Column("level", "sample | stroke | file | run | set_up | specimen", TEXT),
    Column("channel", "null for the whole level; else a channel that varies at it", TEXT),
    Column(
        "sd_N", "standard deviation of the residual at this level, or of the part that the channel explains"
    ),
    Column("share", "share of the residual's variance"),
    Column("df", "degrees of freedom"),
    Column("p_value", "p-value of the channel, adjusted over the search; null for a level"),
)
CHANNELS = table(
    "channels",
    Column("channel", "channel", TEXT),
    Column("x", "middle of the group of channel values; null for a category"),
    Column("label", "the category, or null", TEXT),
    Column("n", "bins in the group", INT),
    Column("along_motion", "whether residuals count in the direction of motion, not of the axis", BOOL),
    Column("before_N", "mean residual before"),
    Column("before_half_N", "half the width of its 95 % interval, from whole units; null for one unit"),
    Column("before_run", "run with the largest mean residual in the group", TEXT),
    Column("after_N", "mean residual after"),
    Column("after_half_N", "half the width of its 95 % interval, from whole units; null for one unit"),
    Column("after_run", "run with the largest mean residual in the group", TEXT),
)
SHAPES = table(
    "shapes",
    Column("effect", "row in closure.json's effects, from 0", INT),
    Column("id", "effect", TEXT),
    Column("channel", "channel drawn along", TEXT),
    Column("category", "category of the effect's other channel in which it is drawn, or null", TEXT),
    Column("x", "channel value; null for a category"),
    Column("label", "the category, or null", TEXT),
    Column("value", "added force, factor minus one, or change of the parameter"),
    Column("lo95", "lower end of the 95 % band"),
    Column("hi95", "upper end of the 95 % band"),
    Column("free", "the free smooth shape at x, null where none was fitted"),
    Column("unit", "unit of value, lo95, hi95 and free", TEXT),
)
SHAPE_POINTS = table(
    "shape_points",
    Column("effect", "row in closure.json's effects, from 0", INT),
    Column("channel", "channel drawn along", TEXT),
    Column("x", "middle of the group of channel values; null for a category"),
    Column("label", "the category, or null", TEXT),
    Column("value", "partial residual: shape plus mean residual, in the shape's unit; null without one"),
    Column("se", "its standard error, from whole files, or from the strokes of a single one"),
    Column("unit", "unit of value and se", TEXT),
)
CURVES = table(
    "curves",
    CONDITION,
    SERIES,
    SPEED,
    LOAD,
    Column("force_before_N", "declared model"),
    Column("force_after_N", "model with its effects, other channels at their means"),
    Column("force_after_lo95_N", "lower end of the mean's 95 % interval"),
    Column("force_after_hi95_N", "upper end of the mean's 95 % interval"),
    open_=True,
)
AGING_LAWS = table(
    "aging_laws",
    RUBBER,
    MODEL,
    Column("quantity", "mu_s, mu_c, F_s or F_c", TEXT),
    Column("law", "log | stretched | power | induction, for all series; or separate laws", TEXT),
    Column("way", "what temperature and compression change: rate | loss; empty where neither varies", TEXT),
    Column("form", "equation", TEXT),
    Column("rank", "1: lowest BIC", INT),
    Column("rival", "true where it is not distinguishable from the best law with these data", BOOL),
    Column("criterion", "BIC minus that of the best law"),
    Column("scatter_rel", "relative scatter between specimens about the law"),
    Column("lack_of_fit_p", "of the law against replicates; null without them"),
    Column(
        "heldout_series",
        "RMS error on held-out series (50 of them, if there are more), in the quantity's unit",
    ),
    Column("heldout_last_day", "RMS error on the held-out last days of these series"),
    Column("parameter", "parameter; null for separate laws", TEXT),
    *_ESTIMATE,
    Column("identified", "false where these data do not determine it", BOOL),
)
PROPERTY_VALUES = table(
    "property_values",
    *_CONDITION,
    Column("aging_days", "aging time"),
    Column("quantity", "property: the column's name", TEXT),
    Column("value", "value of one specimen"),
    Column("unit", "unit of value", TEXT),
    Column("batch", "batch of the specimen; null if none is named", TEXT),
    Column("line", "line in the table of values", INT),
    open_=True,
)
MASTER_CURVE = table(
    "master_curve",
    RUBBER,
    Column("quantity", "mu_s, mu_c, F_s or F_c", TEXT),
    Column("kind", "value | law", TEXT),
    Column("scaled_days", "aging time, by the rate where temperature and compression change that"),
    Column("value", "value of a condition, brought to the reference where that changes the loss; or law"),
    Column("lo95", "lower end of the law's 95 % band"),
    Column("hi95", "upper end of the law's 95 % band"),
    Column("temperature_C", "aging temperature; null for unaged rubber and for the law"),
    Column("compression_ratio_pct", "height while aging; null for unaged rubber and for the law"),
    Column("aging_days", "aging time; null for the law"),
)
DYNAMIC_CURVES = table(
    "dynamic_curves",
    CONDITION,
    SPEED_SET,
    DIRECTION,
    Column("distance_mm", "distance slid since the platform began to move"),
    Column("force_N", "mean force of the starts, in the direction of motion"),
    Column("force_se_N", "standard error of that mean, from the starts; null for one start"),
    Column("n", "starts averaged", INT),
    Column("model_N", "mean of the fitted dynamic model over the same samples; null without a fit"),
)
AGING_CURVES = table(
    "aging_curves",
    SERIES,
    Column("quantity", "mu_s or mu_c", TEXT),
    Column("aging_days", "aging time"),
    Column("value", "the law's value"),
    Column("lo95", "lower end of its 95 % interval"),
    Column("hi95", "upper end of its 95 % interval"),
)

_FITS = {
    "fit-steady": (STEADY_FIT, STEADY_COVARIANCE, STEADY_SHIFT),
    "fit-aging": (AGING_FIT, AGING_COVARIANCE, AGING_CURVES, AGING_LAWS, MASTER_CURVE),
    "fit-dynamic": (DYNAMIC_FIT, DYNAMIC_CURVES),
}
_FITTED = [fitted for made in _FITS.values() for fitted in made]
BESIDE = (STEADY_COVARIANCE, STEADY_SHIFT, AGING_COVARIANCE)  # of the parameters of a fit
FITTED = tuple(fitted for fitted in _FITTED if fitted not in BESIDE)
LOOP = (EFFECTS, RESIDUALS_BEFORE, RESIDUALS_AFTER, LEVELS, CHANNELS, SHAPES, SHAPE_POINTS, CURVES)
AFTER = (STEADY_AFTER, *(replace(fitted, name=f"{fitted.name}_after") for fitted in _FITTED))
MADE = {  # by the step that makes them
    "ingest": (INPUTS, RUNS, QUALITY, TRACES, TRACES_MEAN, STEADY, BINS),
    **_FITS,
    "close-loop": (*LOOP, *AFTER),
}
SCHEMAS = {schema.name: schema for made in (*MADE.values(), (PROPERTY_VALUES,)) for schema in made}
