"""What only comparing strokes shows: a wrong sign, a dead sensor, a repeat that disagrees with its run."""

import math
from collections.abc import Collection

import numpy as np
import pandas as pd
from scipy.special import stdtr

from sealfit.config import Config
from sealfit.errors import KEPT, NOTED, STROKE_OUT, ConfigError, Fault
from sealfit.ingest.quality import FINE, MEASURE_AGAIN
from sealfit.ingest.scatter import RepeatCodes, ScatterFit, fit_scatter, repeat_means
from sealfit.units import conversion

# Share of the repeats that the search takes out at most. Beyond it the bulk is not known.
MAX_OUTLIERS = 0.1
# Steps in a row without a convincing outlier after which the search ends: so many equal ones mask each other.
UNCONVINCING = 10
# Share of its variance below which a residual is that of a run's only repeat.
ALONE = 1e-9


def outlying_repeats(means: pd.DataFrame, level: float) -> pd.DataFrame:
    """Return the repeats that disagree with their runs beyond the pooled scatter.

    They are rows of `means` (`scatter.repeat_means`) with `run_mean_N` (the run's mean without it), `t`, `p`
    (adjusted over the campaign) and `alone` (true where two repeats disagree and which of them is wrong
    cannot be known: both are returned). `level` is the chance that any repeat at all is flagged in a campaign
    without outliers.

    This is the generalized extreme studentized deviate procedure (Rosner 1983, Technometrics 25(2), 165-172,
    doi:10.1080/00401706.1983.10487848), on residuals within runs: the most extreme repeat is taken out,
    scatter and pattern are estimated without it, and so on. The outliers are those up to the last one beyond
    its limit: Sidak's for the repeats left, on Student's t with the pooled degrees of freedom.
    """
    layout = RepeatCodes.of(means)
    force = means["force_N"].to_numpy(float)
    tiny = 1e-6 * float(np.max(np.abs(force), initial=0.0)) + 1e-300  # repeats that agree to the last digit
    kept = np.ones(len(means), bool)
    found, unconvincing = [], 0
    fit = fit_scatter(layout, force, kept)
    while unconvincing < UNCONVINCING and len(found) < max(1, int(MAX_OUTLIERS * len(means))):
        tests = int((kept & (fit.share > ALONE)).sum())
        if fit.scatter.df < 4 or not tests:
            break
        furthest = int(np.argmax(np.where(kept & (fit.share > ALONE), np.abs(fit.t), -1.0)))
        rows = np.flatnonzero(kept & (layout.run == layout.run[furthest]))
        if len(rows) != 2:  # with its only peer: which of the two is wrong cannot be known
            rows = np.array([furthest])
        kept[rows] = False
        apart = fit_scatter(layout, force, kept)
        t, p, mean_N = _judged(fit, apart, rows, tests, tiny)
        found.append(means.iloc[rows].assign(run_mean_N=mean_N, t=t, p=p, alone=len(rows) == 2))
        unconvincing = unconvincing + 1 if p >= level and abs(t) < 3.0 else 0
        fit = apart
    last = max((number for number, one in enumerate(found, start=1) if one["p"].iloc[0] < level), default=0)
    return pd.concat([means.iloc[:0].assign(run_mean_N=0.0, t=0.0, p=0.0, alone=False), *found[:last]])


def _judged(
    fit: ScatterFit, apart: ScatterFit, rows: np.ndarray, tests: int, tiny: float
) -> tuple[float, float, float]:
    """Return t and p of the rows taken out, by the scatter of the rest, `apart`, and their run's mean."""
    worst = rows[np.argmax(np.abs(fit.t[rows]))]
    force = float(fit.mean[worst])
    sd = max(float(apart.scatter.sd_N(force)), tiny) * np.sqrt(fit.share[worst])
    t = float(fit.residual[worst] / sd)
    p_one = 2.0 * stdtr(apart.df_at(force), -abs(t))
    p = -np.expm1((tests - (len(rows) - 1)) * np.log1p(-min(p_one, 1.0 - 1e-16)))
    return t, float(p), float(apart.mean[worst]) if len(rows) == 1 else force


AGAINST = -0.5  # share of its peers' force by which a force against its motion is of the wrong sign
# What is the same to the last digit only in copies of a stroke.
SAMPLES = ["n", "force_N", "force_sd_N", "displacement_from_mm", "displacement_to_mm"]
NOTHING = 1e-24  # a smaller force was not measured; the square of its square would be 0


def judged(strokes: pd.DataFrame) -> tuple[pd.DataFrame, list[Fault]]:
    """Return the strokes with `used` false where a comparison with others rules them out, and findings."""
    faults: list[Fault] = []
    for rule in (constant_strokes, copied_strokes, reversed_strokes):
        if strokes["used"].any():
            keep, found = rule(strokes)
            strokes = strokes.assign(used=strokes["used"].to_numpy(bool) & keep)
            faults += found
    return strokes, faults


def reversed_strokes(strokes: pd.DataFrame) -> tuple[np.ndarray, list[Fault]]:
    """Return which strokes to keep, shape (n,), and findings on force signs that contradict the motion.

    Friction opposes the motion, so force times direction is positive. Where it is negative against the peers
    of a stroke (the others of its run, else those of its direction), a sensor or a sign was turned round, and
    the stroke is left out. Where most are negative, it is an offset or the sign convention: said, and kept.
    """
    keep = np.ones(len(strokes), bool)
    force = (strokes["force_N"] * strokes["direction"]).to_numpy(float)
    used = strokes["used"].to_numpy(bool) & np.isfinite(force)
    against = used & (force < 0.0)
    found = []
    of_run, of_way = strokes.groupby(["direction", "run"]).indices, strokes.groupby("direction").indices
    sorted_force = {key: np.sort(force[rows[used[rows]]]) for key, rows in (*of_run.items(), *of_way.items())}
    for i in np.flatnonzero(against):
        row = strokes.iloc[i]
        peers = sorted_force[row["direction"], row["run"]]
        usual = _median_without(peers if len(peers) > 2 else sorted_force[row["direction"]], force[i])
        wrong = usual > 0.0 and force[i] < AGAINST * usual
        keep[i] = not wrong
        found.append(_against(row, force[i], bool(wrong)))
    return keep, found


def _median_without(ordered: np.ndarray, value: float) -> float:
    """Return the median of sorted values without one of them; nan without any others."""
    n = len(ordered) - 1
    if n == 0:
        return math.nan
    own = ordered.searchsorted(value)
    return float(np.mean([ordered[k + (k >= own)] for k in ((n - 1) // 2, n // 2)]))


def _against(row: pd.Series, force_N: float, wrong: bool) -> Fault:
    done, why = KEPT, ": an offset larger than the friction, or the sign convention."
    fix = "If the rig counts force the other way round, change its sign in the config: compute.force_N."
    if wrong:
        done, why = STROKE_OUT, ", unlike in the other strokes."
        fix = "Look for a turned sensor or a turned sign in this file."
    reason = f"the mean force has the direction of the motion{why}"
    return Fault("reversed", reason, **_place(row), column="force_N", value=float(force_N), fix=fix, **done)


def _place(row: pd.Series) -> dict[str, object]:
    """Return where a stroke is, as fields of `Fault`."""
    return {"file": row["file"], "stroke": int(row["stroke"]) if row["several"] else None}


def constant_strokes(strokes: pd.DataFrame) -> tuple[np.ndarray, list[Fault]]:
    """Return which strokes to keep, shape (n,), and findings on forces constant in the steady window.

    Where the other strokes show noise larger than the sensor's steps, the sensor is dead, or at the end of
    its range (`extreme`); else it is coarse, and they are kept. `equal` is the share of samples equal to the
    one before.
    """
    used = strokes["used"].to_numpy(bool)
    nothing = np.abs(strokes["force_N"].to_numpy(float)) < NOTHING
    constant = used & (nothing | (strokes["equal"].to_numpy(float) >= 1.0))
    others = strokes["equal"].to_numpy(float)[used & ~constant]
    noisy = bool(len(others) and np.median(others) < FINE)
    dead = constant & (noisy | nothing)
    return ~dead, [_constant(row, bool(dead[i])) for i, row in strokes[constant].iterrows()]


def _constant(row: pd.Series, dead: bool) -> Fault:
    check, reason = "coarse", "and other strokes show no noise either: its steps are larger than the noise."
    fix = "Use a finer range if the sensor has one."
    if dead:
        check, reason, fix = "stuck", "unlike in other strokes.", MEASURE_AGAIN
    if abs(row["force_N"]) < NOTHING:
        reason = "so it was not measured."
    if dead and row["extreme"]:
        check = "saturated"
        fix = f"The sensor may be at the end of its range: use a larger one. {fix}"
    value, done = float(row["force_N"]), STROKE_OUT if dead else NOTED
    reason = f"the force is {value:g} all along the steady window, {reason}"
    return Fault(check, reason, **_place(row), column="force_N", value=value, fix=fix, **done)


def copied_strokes(strokes: pd.DataFrame) -> tuple[np.ndarray, list[Fault]]:
    """Return which strokes to keep, shape (n,), and findings on files that hold the samples of another.

    Two measurements never have the same mean, scatter and positions to the last digit, or the same samples
    from their start on. The first of such files is kept.
    """
    own = strokes[strokes["used"].to_numpy(bool) & (strokes["force_sd_N"] > 0.0)]
    first = own.groupby(SAMPLES)["file"].transform("first")
    whole = own["file"] != first
    found = {i: _copied(own.loc[i], f"holds the samples of {first[i]}") for i in own.index[whole]}
    starts = own.loc[~whole, ["file", "begins", "begins_half"]].melt(id_vars="file", ignore_index=False)
    starts = starts.dropna(subset="value").sort_index(kind="stable")
    first = starts.groupby("value")["file"].transform("first")
    for i, file in first[starts["file"] != first].items():
        found.setdefault(i, _copied(own.loc[i], f"begins with the samples of {file}"))
    return ~strokes.index.isin(list(found)), [found[i] for i in sorted(found)]


def _copied(row: pd.Series, what: str) -> Fault:
    fix = "Export the right test, or take the file out of the campaign."
    return Fault("copy", f"{what}: a copy is no second measurement.", **_place(row), fix=fix, **STROKE_OUT)


# Largest mean friction over both directions, as a share of its size in one, at which a force is a magnitude.
MAGNITUDE = 0.05
# Smallest ratio of standard error to standard deviation of a force that swings a few times in a stroke. White
# noise has 0.1 in a hundred samples.
SWINGS = 0.25


def turned_sign(strokes: pd.DataFrame, config: Config) -> list[Fault]:
    """Return a fault if the friction of a whole campaign has the direction of the motion, or no one sign.

    With strokes in both directions, the mean over them is the friction: an offset of the sensor cancels out.
    """
    used = strokes[strokes["used"].to_numpy(bool)]
    against = used["force_N"] * used["direction"]
    ways = against.groupby(used["direction"] > 0).median()
    friction = float(ways.mean())
    if len(ways) == 2 and ways.min() < 0.0 and abs(friction) < MAGNITUDE * ways.max():
        reason = "the force has one sign and one size in both directions, as a magnitude has; "
        reason += "friction opposes the motion."
        fix = "Export the signed force. If a signed speed is recorded, give the force its sign: "
        fix += 'force_N = "force_N * sign(SPEED)" under [trace.compute].'
        return [Fault("turned_sign", reason, column="force_N", value=friction, fix=fix)]
    if len(ways) == 1 and _changes_sign(used).mean() > 0.5:
        reason = "the force changes its sign along the strokes, as if the displacement counted "
        reason += "the distance slid in both directions."
        fix = "Export the position of the rig, which goes back."
        return [Fault("turned_sign", reason, column="displacement_mm", value=friction, fix=fix)]
    if not friction < 0.0:
        return []
    count = int((against < 0.0).sum())
    reason = f"the mean force has the direction of the motion in {count} of {len(used)} strokes; "
    reason += "friction opposes it."
    computed = config.trace.compute.get("force_N")
    turned = "-force_N" if computed is None else f"-({computed})"
    fix = f'Change its sign in the config: force_N = "{turned}" under [trace.compute].'
    return [Fault("turned_sign", reason, column="force_N", value=friction, fix=fix)]


def _changes_sign(strokes: pd.DataFrame) -> pd.Series:
    """Return whether the force of each stroke scatters about 0 in a few long swings, unlike noise."""
    mean, sd, se = strokes["force_N"].abs(), strokes["force_sd_N"], strokes["force_se_N"]
    return (mean < np.minimum(sd, 2.0 * se)) & (se > SWINGS * sd)


# Of a column that was set: most values, the largest share by which files of one value differ, and the share
# of the runs whose repeats have several values from which on it is named.
MOST_SETTINGS, SAME_SETTING, MOST_RUNS = 6, 0.05, 0.8


def settings_within_runs(steady: pd.DataFrame, known: Collection[str]) -> list[Fault]:
    """Return the columns with a few set values that differ between the repeats of most runs.

    Such files are no repeats. `known` are columns that are no settings, or that make runs.
    """
    run = steady.groupby("file", sort=False)["run_id"].first()
    faults = []
    for name in steady.columns.drop([*known], errors="ignore"):
        if steady[name].dtype.kind not in "fi":
            continue
        ordered = steady.groupby("file", sort=False)[name].mean().dropna().sort_values()
        code = (ordered.diff() > SAME_SETTING * ordered.abs().max()).cumsum()
        settings = ordered.groupby(code)
        if not 2 <= settings.ngroups <= MOST_SETTINGS or settings.size().min() < 2:
            continue
        if (settings.max() - settings.min() > SAME_SETTING * ordered.abs().max()).any():
            continue
        own = run[code.index]
        repeated = own.groupby(own).transform("size") > 1
        counts = code[repeated].groupby(own[repeated]).nunique()
        if len(counts) and (counts > 1).mean() >= MOST_RUNS:
            values = ", ".join(f"{value:.4g}" for value in settings.mean())
            reason = f"differs between the repeats of {(counts > 1).sum()} of {len(counts)} runs: {values}."
            fix = "If it was set, put it into the config's condition, or give these files a run_id each."
            faults.append(Fault("setting_in_run", reason, column=name, fix=fix, **KEPT))
    return faults


# Units of force that an export may be in.
FORCE_UNITS = ("kgf", "lbf", "kN", "mN")
# Largest error of the ratio to the force of other specimens that shows a unit: friction of specimens differs.
SAME_RATIO = 0.2
ALIKE = 2.0  # Most by which the other specimens may differ from their median: else no ratio is surprising.
SPEED_STEP = 0.2  # Steps of the logarithm of the speed within which levels are compared.


def other_units(steady: pd.DataFrame, config: Config) -> list[Fault]:
    """Return that the force of some specimens is as if in another unit, by that of the rest at their speeds.

    It is the force over the load if all files have one. A specimen counts once in each condition.
    """
    rows = steady[steady["used"].to_numpy(bool) & (steady["force_N"].abs() > NOTHING)]
    known = "load_N" in rows and bool((rows["load_N"].abs() > 0).all())
    level = np.log(rows["force_N"].abs() / (rows["load_N"].abs() if known else 1.0))
    piece = pd.MultiIndex.from_frame(rows[["condition", "specimen_id"]].fillna("")).to_flat_index()
    measured = rows["speed_mm_s"].abs()
    commanded = rows.get("speed_set_mm_s", measured)
    speed = np.round(np.log(commanded.where(commanded > 0, measured)) / SPEED_STEP)
    levels = level.groupby([piece, speed.to_numpy()]).median().unstack()
    off = (levels - levels.median()).median(axis=1)
    faults, ours = [], config.units.unit("force")
    for unit in FORCE_UNITS:
        try:
            ratio = 1 / conversion(unit, ours).factor
        except ConfigError:  # a torque
            return []
        wrong = (off - math.log(ratio)).abs() < math.log1p(SAME_RATIO)
        if unit == ours or not 0 < wrong.sum() < len(off) / 2 or off[~wrong].abs().max() > math.log(ALIKE):
            continue
        files = rows["file"][piece.isin(off.index[wrong])].unique()
        times = math.exp(off[wrong].median())
        reason = f"the friction force is {times:.2g} times that of other specimens at the same speeds, "
        reason += f"in {len(files)} files, such as {files[0]}."
        fix = f"Is the force of these files in {unit}? Export them again in {ours}."
        faults.append(Fault("other_unit", reason, column="force_N", value=ratio, fix=fix, **KEPT))
    return faults


def outlying_files(steady: pd.DataFrame, config: Config) -> tuple[pd.DataFrame, list[Fault]]:
    """Return `steady` with `outlier` and `used`, and a finding per repeat that disagrees with its run.

    It is left out of the fits only where the config says so, and never where only two repeats disagree.
    """
    flagged = outlying_repeats(repeat_means(steady), config.quality.outlier_p)
    outlier, dropped, found = np.zeros(len(steady), bool), np.zeros(len(steady), bool), []
    unit = config.units.unit("force")
    near = np.flatnonzero(steady["run_id"].isin(flagged["run_id"]))
    places = steady.iloc[near].groupby(["run_id", "repeat"], sort=False).indices
    for row in flagged.itertuples(index=False):
        rows = near[places[row.run_id, row.repeat]]
        out = config.quality.drop_outliers and not row.alone
        outlier[rows] = True
        dropped[rows] |= out
        others = "its only other repeat gives" if row.alone else "the other repeats of its run give"
        reason = (
            f"repeat {row.repeat} of run {row.run_id} is {row.force_N:.4g} {unit}; "
            f"{others} {row.run_mean_N:.4g} {unit}, their common pattern removed: "
            f"{abs(row.t):.1f} SDs of the scatter pooled over runs (p = {row.p:.1g})."
        )
        fix = "Look into the notes of that test; quality.drop_outliers in the config leaves such repeats out."
        if row.alone:
            fix = "Look into the notes of both tests, and take the file of the wrong one out."
        place = {"file": row.file, "column": "force_N", "value": float(row.force_N), "severity": "warning"}
        action = "file left out" if out else "kept"
        found.append(Fault("outlier", reason, action=action, fix=fix, **place))
    return steady.assign(outlier=outlier, used=steady["used"].to_numpy(bool) & ~dropped), found
