"""What is wrong with a stroke by itself, with its fix; and the table of all that was found in a campaign.

Every rule is scaled by the trace itself (its noise, its resolution, its sampling). Single samples and the
commanded speed are judged in `trace_checks.py`, and what needs other traces in `repeat_checks.py`.
"""

import hashlib
from collections.abc import Collection, Mapping, Sequence

import numpy as np
import pandas as pd
from scipy.special import bdtrc

from sealfit.config import Config, Quality
from sealfit.errors import KEPT, NOTED, STROKE_OUT, ConfigError, Fault
from sealfit.ingest.cells import Trace
from sealfit.ingest.strokes import Stroke
from sealfit.ingest.trace_checks import resolution, with_unit
from sealfit.tables import CALENDAR, HISTORY, QUALITY, STEADY
from sealfit.units import Conversion, conversion

LEAST_DIFFERENT = 10  # forces at the beginning of a stroke that tell it from others
LOAD_TOLERANCE = 0.1  # dead weights are better than that, and a wrong plate is worse
# Of a load: standard deviation over mean, along a trace, and the share of it below which that of the force
# shows that the two are swapped. In 25 files the force varies 66 times as much as the load or more.
VARIES, STEADIER = 0.05, 0.2
# Seals on a full film of oil slide at about 0.01, soft dry rubber at up to about 4. Dry rubber at 0.6 to 1 is
# above with its load in kg (mu 9.81 times too large), and below with its load in g (102 times too small).
MU_RANGE = (0.01, 5.0)
# A load in kg makes the ratio 40 at most (of soft rubber), a force in mN 100 or more unless mu is below 0.1.
IN_MN = 100.0
_HEAVIER = (
    'Is the load in kg or lb? Give the unit in the rig config: load_N = {unit = "kgf"} '
    "under [files.runs_columns] (kg is a mass; its weight is kgf, or 9.80665 times the kg in N)."
)
_LIGHTER = (
    'Is the load in g, or the force in kg or kN? Give the unit in the rig config: load_N = {unit = "gf"} '
    'under [files.runs_columns], or force_N = {name = "..", unit = "kgf"} under [trace.columns].'
)
FINE = 0.3  # share of equal neighbours below which noise is plainly larger than the sensor's steps
# Above this share (noise of a third of a step) a reading that rests on a step cannot be told from a dead one.
COARSE = 0.6
FEW_LEVELS, NEXT_LEVELS = 5, 30
BY_CHANCE = 1e-4  # that so many samples lie at the extreme; few strokes come so far that it is asked
# Share of the force that may be missing where a stroke ends: more, and it was never steady.
STILL_RISING = 0.01
# Least size of a jump of the displacement: in usual steps, and as a share of the way of the stroke.
JUMP, SMALLEST_JUMP = 20.0, 0.02
MEASURE_AGAIN = "Check the cable and the logger, and measure again."


def stroke_faults(stroke: Stroke, trace: Trace, settings: Quality) -> list[Fault]:
    """Return what is wrong with one stroke of a trace by itself: short, gappy, saturated, stuck."""
    whole, steady = slice(stroke.start, stroke.stop), stroke.rows
    drive = "Drive at a constant speed"
    if not stroke.settles and (jump := _jump(trace, whole)):
        drive = f"{jump}. Otherwise drive at a constant speed"
    if stroke.short is not None:
        reason, samples = stroke.short, float(len(stroke.rows))
        fix = "Slide further or sample faster; or set strokes.min_samples and min_steady_share in the config."
        if not stroke.settles:
            reason, fix = f"the speed never settles: {reason}", f"{drive}. {fix}"
        return [Fault("too_short", f"{reason}.", value=samples, fix=fix, **STROKE_OUT)]
    found = []
    if not stroke.settles:
        reason = "the speed never settles: where it is highest it still changes by more than the tolerance. "
        reason += "Its steady force is a mean over these speeds; bins have a speed each."
        fix = f"{drive}; lower strokes.speed_tolerance where steps of the speed are smaller."
        speed = float(stroke.speed_mm_s)
        found = [Fault("no_plateau", reason, column="speed_mm_s", value=speed, fix=fix, **KEPT)]
    found += _gaps(trace.columns["time_s"][whole], trace.line[whole], trace.number[whole], settings)
    force_N, line = trace.columns["force_N"][steady], trace.line[steady]
    return found + (_saturated(force_N, line, settings) or _stuck(force_N, line, settings))


def _jump(trace: Trace, rows: slice) -> str:
    """Return where the displacement of a stroke jumps within a usual step of the time, or ""."""
    steps, times = (np.abs(np.diff(trace.columns[name][rows])) for name in ("displacement_mm", "time_s"))
    if not steps.any():
        return ""
    usual = np.median(steps[steps > 0])  # a coarse encoder stands still in most samples
    steps = np.where(times < 2 * np.median(times), steps, 0.0)
    most = int(steps.argmax())
    if steps[most] < JUMP * usual or steps[most] < SMALLEST_JUMP * steps.sum():
        return ""
    line = trace.line[rows][most + 1]
    return f"The displacement jumps by {steps[most]:.3g} at line {line}: look for slip of the encoder"


def rising_faults(left_N: float, force_N: float, unit: str) -> list[Fault]:
    """Return that a stroke ends before its friction is steady, if it does.

    `left_N` is what is left of the pre-sliding rise in the end, `force_N` the mean force without it.
    """
    if not abs(left_N) > STILL_RISING * abs(force_N):
        return []
    reason = f"the stroke ends before its friction is steady: {abs(left_N):.3g} of {abs(force_N):.4g} {unit} "
    reason += "are still to come. Its steady force is extrapolated by the bristle model."
    fix = "Slide further at this speed: five times the rise's length to 63 %, better eleven times."
    return [Fault("never_steady", reason, column="force_N", value=abs(left_N), fix=fix, **NOTED)]


def _gaps(time_s: np.ndarray, line: np.ndarray, number: np.ndarray, settings: Quality) -> list[Fault]:
    """Return gaps in time; rows that the config's `keep` filtered out, which `number` counts, are none."""
    rows, lengths = np.diff(number), np.diff(time_s)
    steps = lengths / rows
    usual = float(np.median(steps))
    gaps = steps > settings.max_gap_factor * usual
    if not gaps.any():
        return []
    hidden = float(((steps - usual) * rows)[gaps].sum() / (time_s[-1] - time_s[0]))
    widest, count = int(np.argmax(lengths * gaps)), int(gaps.sum())
    reason = f"{count} gap{'s' if count > 1 else ''} in time, {hidden:.1%} of the stroke; "
    reason += f"the longest, after this line, is {lengths[widest]:.3g} where {usual:.3g} is usual."
    place = {"line": int(line[widest]), "column": "time_s", "value": hidden}
    fix = "Look for lost packets or a full buffer in the logger."
    done = STROKE_OUT if hidden > settings.max_gap_share else KEPT
    return [Fault("gaps", reason, fix=fix, **place, **done)]


def beginnings(force_N: np.ndarray, displacement_mm: np.ndarray) -> dict[str, str | None]:
    """Return hashes of the first samples of a stroke, which a copy without its last rows has in common.

    They are of the largest power of two of its samples, and of half as many, so a copy of at least half of
    the rows has one in common; None with few different forces, which two measurements may share.
    """
    most, found = 1 << (len(force_N).bit_length() - 1) if len(force_N) else 0, {}
    for name, count in (("begins", most), ("begins_half", most // 2)):
        several = len(np.unique(force_N[:count])) >= LEAST_DIFFERENT
        first = np.stack([force_N[:count], displacement_mm[:count]]).astype(float)
        found[name] = hashlib.sha256(first.tobytes()).hexdigest()[:20] if several else None
    return found


def _saturated(force_N: np.ndarray, line: np.ndarray, settings: Quality) -> list[Fault]:
    """Clipping piles samples up at the extreme, while the samples below still show their noise."""
    size = np.abs(force_N)
    top = size == size.max()
    others = force_N[~top]
    share = float(top.mean())
    if share < settings.saturated_share or top.sum() < 5 or len(others) < 20:
        return []
    at_next_level = np.count_nonzero(np.abs(others) == np.abs(others).max())
    # Few levels altogether: the sensor is coarse, not at its end.
    coarse = len(np.unique(others)) < FEW_LEVELS or top.sum() <= 2 * at_next_level
    if coarse or not _shows_noise(force_N, ~top, FINE) or not _piled_up(size):
        return []
    value = float(force_N[np.argmax(size)])
    reason = f"{share:.0%} of the steady samples lie exactly at the extreme {value:g}: "
    reason += "the end of the sensor's range."
    fix = "Use a larger range and measure again."
    return [_broken("saturated", reason, line[np.argmax(top)], value, fix)]


def _piled_up(size_N: np.ndarray) -> bool:
    """Return whether more samples lie at the very extreme than chance puts there.

    Samples thin out towards their extreme: of those there and at the k levels next to it a share of no more
    than 1 / (k + 1) is expected there, and a binomial tail says how many more chance may make it.
    """
    away = np.rint((size_N.max() - size_N) / resolution(size_N))  # levels below the extreme
    levels = np.arange(NEXT_LEVELS + 1)
    near = np.searchsorted(np.sort(away), levels, side="right")
    return bool(bdtrc(near[0] - 1, near[1:], 1 / (levels[1:] + 1)).min() < BY_CHANCE)


def _shows_noise(force_N: np.ndarray, rows: np.ndarray, most_equal: float) -> bool:
    """Return whether neighbours in `rows` mostly differ, up and down like noise, not along a smooth curve."""
    change = np.diff(force_N)[rows[1:] & rows[:-1]]
    if len(change) < 10 or np.mean(change == 0.0) > most_equal:
        return False
    change = change[change != 0.0]
    return bool(np.mean(change[1:] * change[:-1] < 0.0) > 0.25)  # noise: 2/3; a smooth curve: next to nothing


def _stuck(force_N: np.ndarray, line: np.ndarray, settings: Quality) -> list[Fault]:
    place = stuck_samples(force_N, settings.stuck_samples)
    if place is None:
        return []
    first, count = place
    value = float(force_N[first])
    reason = f"{count} samples in a row are exactly {value:g} while the platform moves; "
    reason += "elsewhere they change."
    return [_broken("stuck", reason, line[first], value, MEASURE_AGAIN)]


def _broken(check: str, reason: str, line: int, value: float, fix: str) -> Fault:
    return Fault(check, reason, line=int(line), column="force_N", value=value, fix=fix, **STROKE_OUT)


def stuck_samples(force_N: np.ndarray, samples: int) -> tuple[int, int] | None:
    """Return place and length of a run of equal samples that this sensor would not show by itself, or None.

    The run must be `samples` long, five times as long as the long ones among the others, and longer than by
    chance (1e-6); and the sensor must show its noise, or a reading that rests on a coarse step would be
    called stuck. A stroke that is constant all along: see `repeat_checks.constant_strokes`.
    """
    edges = np.concatenate(([0], np.flatnonzero(np.diff(force_N) != 0.0) + 1, [len(force_N)]))
    lengths = np.diff(edges)
    longest = int(np.argmax(lengths))
    run, others = int(lengths[longest]), np.delete(lengths, longest)
    if run < samples or others.sum() < samples:
        return None
    ordered = np.sort(others)
    usual = float(ordered[np.searchsorted(np.cumsum(ordered), 0.9 * others.sum())])
    same = 1.0 - len(others) / others.sum()
    if run <= 5.0 * usual or len(force_N) * same**run > 1e-6:
        return None
    apart = np.ones(len(force_N), bool)
    apart[edges[longest] : edges[longest + 1]] = False
    return (int(edges[longest]), run) if _shows_noise(force_N, apart, COARSE) else None


def speed_column_faults(measured: float, column: float, config: Config) -> list[Fault]:
    """Return where a trace's own speed column contradicts its displacement over time; the latter is used."""
    if not abs(abs(column) - abs(measured)) > config.quality.speed_disagreement * abs(measured):
        return []
    unit = config.units.unit("speed")
    reason = f"the speed column says {column:.4g} {unit}, displacement over time {measured:.4g} {unit}."
    fix = "Check the units of both columns; displacement over time is used."
    return [Fault("speed_disagreement", reason, column="speed_mm_s", value=float(column), fix=fix, **KEPT)]


def load_checks(trace: Trace, rows: Sequence[Mapping[str, object]], config: Config) -> list[Fault]:
    """Return where the load measured in the strokes of use differs from the declared one, or is no load."""
    declared = trace.channels.get("load_N")
    loads = [row["load_N"] for row in rows if row["used"]] if "load_N" in trace.columns else []
    if not loads:
        return []
    found = swapped_faults(trace.columns["force_N"], trace.columns["load_N"], config)
    if isinstance(declared, int | float):
        found += load_faults(float(np.mean(loads)), declared, config.units.unit("load"))
    return found


def load_faults(measured: float, declared: float, unit: str) -> list[Fault]:
    """Return where the load measured along the trace differs from the declared one by more than a tenth."""
    if not abs(measured - declared) > LOAD_TOLERANCE * abs(declared):
        return []
    reason = f"measured {measured:.4g} {unit}, declared {declared:.4g} {unit}."
    fix = "The measured load is used; check runs.csv."
    return [Fault("load", reason, column="load_N", value=float(measured), fix=fix, **KEPT)]


def swapped_faults(force_N: np.ndarray, load_N: np.ndarray, config: Config) -> list[Fault]:
    """Return that the load varies along a trace, shape (n,), and the force does not, as if swapped."""
    with np.errstate(all="ignore"):  # no scatter of numbers beyond 1e154: inf or nan, and no finding
        of_force, of_load = (np.std(values) / np.mean(np.abs(values)) for values in (force_N, load_N))
    if not (VARIES < of_load < np.inf and of_force < STEADIER * of_load):
        return []
    force, load = (config.trace.their_columns.get(name, name) for name in ("force_N", "load_N"))
    reason = f"'{load}' varies by {100 * of_load:.2g} % along the trace, the force, '{force}', by "
    reason += f"{100 * of_force:.2g} % only."
    fix = "Are the two swapped under [trace.columns]? The load hardly varies, the friction force does."
    return [Fault("swapped_columns", reason, column="load_N", value=float(of_load), fix=fix, **KEPT)]


def improbable_loads(steady: pd.DataFrame, config: Config) -> list[Fault]:
    """Return that friction force over load is no coefficient of friction, in some files or in all.

    Rows of `steady` that are not used, and those without a load, are left out. Nothing is said where force
    and load are not of one dimension (a torque over a load).
    """
    if "load_N" not in steady:
        return []
    try:
        in_load_units = conversion(config.units.unit("force"), config.units.unit("load"))
    except ConfigError:
        return []
    rows = steady[steady["used"].to_numpy(bool) & (np.abs(steady["load_N"].to_numpy(float)) > 0)]
    ratio = in_load_units(rows["force_N"].abs()) / rows["load_N"].abs()
    mu = ratio.groupby(rows["file"].to_numpy(), sort=False).mean()
    faults, ours = [], config.units.unit("force")
    declared = config.conversions("trace").get("force_N", Conversion()).factor
    for wrong, fix in ((mu > MU_RANGE[1], _HEAVIER), (mu < MU_RANGE[0], _LIGHTER)):
        if wrong.any():
            middle = float(mu[wrong].median())
            if middle > IN_MN:
                fix = f"Is the force in mN? {with_unit('force_N', 'mN', config)}"
            if MU_RANGE[0] <= middle / declared <= MU_RANGE[1]:  # the numbers as they are
                own = f"Is the force in {ours}? {with_unit('force_N', ours, config)}"
                fix = own if middle > IN_MN else f"{own} {fix}"
            where = f"in {wrong.sum()} of {len(mu)} files"
            if wrong.sum() < len(mu) / 2:  # exceptions, not a unit of the campaign
                where += f", such as {wrong.idxmax()}"
                fix = "Look at what differs in these files: the range of the sensor, or the load in runs.csv."
            reason = f"the friction force is {middle:.2g} times the load {where}; "
            reason += f"coefficients of friction are {MU_RANGE[0]:g} to {MU_RANGE[1]:g}."
            faults.append(Fault("improbable_load", reason, column="load_N", value=middle, fix=fix, **KEPT))
    return faults


def computed_force(inputs: Collection[str]) -> list[Fault]:
    """Return that the columns from which the force is computed are not searched for effects, if there are."""
    if not inputs:
        return []
    reason = f"is computed from {', '.join(sorted(inputs))}: the search for effects leaves these columns out."
    fix = "To search one of them, list the others as drop_columns under [trace]."
    return [Fault("computed_force", reason, column="force_N", fix=fix, **KEPT)]


def quality_table(faults: Sequence[Fault], files: Sequence[str]) -> pd.DataFrame:
    """Return table `quality`: a row per finding, and one "ok" for every file of `files` without any.

    Findings of the campaign come first, then by file, stroke and line.
    """
    told = {fault.file for fault in faults}
    fine = [Fault("ok", "nothing found.", file=file, **NOTED) for file in files if file not in told]
    place = {file: i for i, file in enumerate(files)}
    rows = sorted([*faults, *fine], key=lambda one: (place.get(one.file, -1), one.stroke or 0, one.line or 0))
    cells = [fault.as_dict() for fault in rows]
    for row in cells:
        row["value"] = f"{row['value']:.6g}" if isinstance(row["value"], float) else row["value"]
    kinds = {name: "Int64" if name in ("stroke", "line") else "str" for name in QUALITY.names()}
    return pd.DataFrame({name: pd.array([row[name] for row in cells], kind) for name, kind in kinds.items()})


# Least squared correlation of means over strokes with the force from which a column seems to repeat it.
FOLLOWS_FORCE = 0.9999
LEAST_STROKES = 8  # Number of strokes from which that is said.


def forms_of_force(force: np.ndarray, load: np.ndarray) -> list[np.ndarray]:
    """Return the force, its size, and both over the load, shape (n,) each."""
    return [own / by for by in (1.0, load) for own in (force, np.abs(force))]


def shared_variance(one: np.ndarray, other: np.ndarray) -> float:
    """Return the squared correlation of two columns, shape (n,); 0 if one is constant."""
    if np.ptp(one) == 0 or np.ptp(other) == 0:
        return 0.0
    return float(np.corrcoef(one, other)[0, 1] ** 2)


def repeats_of_force(steady: pd.DataFrame) -> list[Fault]:
    """Return the columns of numbers that follow the force in all strokes; unused rows are left out."""
    used = steady[steady["used"].to_numpy(bool)]
    load = used.get("load_N", pd.Series(1.0, used.index)).to_numpy(float)
    load = load if np.isfinite(load).all() and load.all() else np.ones(len(used))
    forms, faults = forms_of_force(used["force_N"].to_numpy(float), load), []
    for name in used.columns.difference([*STEADY.names()]):
        if not pd.api.types.is_numeric_dtype(used[name]) or len(used) < LEAST_STROKES:
            continue
        values = used[name].to_numpy(float)
        share = max(shared_variance(values, form) for form in forms) if np.isfinite(values).all() else 0.0
        if share > FOLLOWS_FORCE:
            reason = f"it follows the force in all strokes (r = {np.sqrt(share):.6f}). "
            reason += "If it also follows the noise of the force, the search for effects leaves it out."
            fix = "If it is computed from the force, list it under loop.ignore_channels."
            faults.append(Fault("repeats_force", reason, column=name, fix=fix, **KEPT))
    return faults


LEAST_KNOWN = 0.8  # share of files with a value from which the search for effects still looks at a column
NO_VALUE = "(no value)"  # level of a category in files without one


def incomplete_columns(steady: pd.DataFrame, aged_only: Collection[str] = ()) -> list[Fault]:
    """Return, for every column that some files have no value of, how many, what that does, and the fix.

    Rows of `steady` that are not used are left out. Unaged rubber need not have the columns `aged_only`.
    """
    used = steady[steady["used"].to_numpy(bool)]
    aged = used["aging_days"] != 0 if aged_only else True
    files = used["file"].nunique()
    # Of missing start times it is said what that does to `HISTORY`.
    fixed = {*STEADY.names(), "started_at"} - set(HISTORY) - {"load_N"}
    faults = []
    for name in used.columns:
        if name in fixed:
            continue
        missing = used["file"][used[name].isna() & (aged if name in aged_only else True)].nunique()
        if 0 < missing < files:
            follows = _what_follows(name, used[name], missing / files)
            reason = f"{missing} of {files} files have no value: {follows}."
            from_columns = "started_at" if name in CALENDAR else "started_at and specimen_id"
            fix = f"Fill {from_columns}." if name in HISTORY else "Fill it for these files too."
            if NO_VALUE in follows:
                fix += " If it holds remarks, list it under loop.ignore_channels."
            about = {"column": name, "value": float(missing), "fix": fix, **KEPT}
            faults.append(Fault("incomplete_column", reason, **about))
    return faults


def _what_follows(name: str, column: pd.Series, share: float) -> str:
    if name == "load_N":
        return "the loop fits forces in place of coefficients"
    numeric = pd.api.types.is_numeric_dtype(column)
    if name in HISTORY or (numeric and share > 1 - LEAST_KNOWN):
        return "the search for effects leaves the column out"
    if numeric:
        return "the search for effects takes them at the mean of their run, else of all files"
    return f"they are a level of their own, {NO_VALUE}"
