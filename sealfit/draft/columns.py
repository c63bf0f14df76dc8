"""Which column of the trace files is time, displacement, force and load: by name, unit and behaviour."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from sealfit.config import Strokes
from sealfit.draft.dialect import Dialect
from sealfit.draft.vocabulary import column_role, name_and_unit
from sealfit.ingest.quality import shared_variance
from sealfit.ingest.strokes import Stroke, find_strokes, several_speeds, turning_rows
from sealfit.units import Unit, conversion, unit_of

SMOOTHED = 7  # samples, as `strokes.smooth_samples`
MOVING = 0.3  # of the highest smoothed speed: slower samples belong to rests, ramps and turns
STROKE = 0.2  # of the range: a smaller way back is no turn

DIMENSION = {
    "time": ("time",),
    "displacement": ("length", "angle"),
    "force": ("force", "torque"),
    "load": ("force",),
    "speed": ("speed", "rotation"),
}
MOST = 0.75  # share of the files in which a column called time must rise
FOLLOWS = 0.95  # correlation with the force from which a column is no load
COPY = 0.9999  # correlation of two columns that are the same signal in two units
BY_BEHAVIOUR = 0.5  # how well a column must behave to be taken without a name or a unit


def rises(values: np.ndarray) -> bool:
    """Whether a column rises from row to row, as time and counters do."""
    return len(values) > 2 and bool((np.diff(values) > 0).mean() > 0.99)


def is_counter(values: np.ndarray) -> bool:
    """Whether a column counts rows: whole numbers one apart."""
    return rises(values) and bool((np.diff(values) == 1.0).all())


def stroke_count(values: np.ndarray) -> int:
    """Return how many strokes a displacement has: it turns where it comes back by a fifth of its range."""
    smooth = smoothed(values)
    return max(len(turning_rows(smooth, STROKE * float(np.ptp(smooth)))) - 1, 1)


def smoothed(values: np.ndarray) -> np.ndarray:
    """Return a running mean over seven samples, shorter at the ends."""
    width = min(SMOOTHED, len(values))
    kernel = np.ones(width)
    return np.convolve(values, kernel, "same") / np.convolve(np.ones(len(values)), kernel, "same")


def velocity(time: np.ndarray, displacement: np.ndarray) -> np.ndarray:
    """Return the smoothed speed; 0 where the clock stands."""
    with np.errstate(all="ignore"):
        return smoothed(np.nan_to_num(np.gradient(displacement, time), posinf=0.0, neginf=0.0))


def mean_speed(speed: np.ndarray) -> float:
    """Return the mean magnitude of speeds where there is motion; slow ones are steps of their resolution."""
    size = smoothed(np.abs(speed))
    return float(np.mean(size[size >= MOVING * np.quantile(size, 0.95)]))


class Follows(NamedTuple):
    """How a column follows the motion."""

    sign: int  # of the column where the displacement rises
    strength: float  # 0 to 1
    both_ways: bool  # whether the file moves in both directions


def follows(values: np.ndarray, speed: np.ndarray) -> Follows:
    """Return how a column follows the direction of the motion.

    With strokes both ways its means forward and backward are compared, so an offset does not matter; with one
    direction the mean while moving is compared with zero, and its strength with the first sample.
    """
    fast = np.quantile(np.abs(speed), 0.95) * MOVING
    forward, backward = values[speed > fast], values[speed < -fast]
    least = 0.05 * len(values)
    if both_ways := len(forward) > least and len(backward) > least:
        difference = level = float(np.mean(forward) - np.mean(backward))
        scatter = float(0.5 * (np.std(forward) + np.std(backward)))
    else:
        moving, way = (forward, 1) if len(forward) >= len(backward) else (backward, -1)
        if len(moving) == 0:
            return Follows(0, 0.0, False)
        level, difference = float(np.mean(moving)) * way, float(np.mean(moving) - values[0])
        scatter = float(np.std(moving))
    total = abs(difference) + 2.0 * scatter
    return Follows(int(np.sign(level)), abs(difference) / total if total else 0.0, both_ways)


def moving_strokes(time: np.ndarray, displacement: np.ndarray) -> list[Stroke]:
    """Return the strokes of a motion with a steady speed; rows at which the clock stands are left out."""
    rows = np.diff(np.maximum.accumulate(time), prepend=-np.inf) > 0
    found = find_strokes(time[rows], displacement[rows], np.zeros(np.count_nonzero(rows)), Strokes())
    return [stroke for stroke in found if np.isfinite(stroke.speed_mm_s) and stroke.speed_mm_s != 0]


# ---------------------------------------------------------------- roles


@dataclass(frozen=True)
class TraceColumn:
    """A column of the trace files."""

    position: int  # from 1
    label: str  # what the files call it, "" if nothing
    role: str  # what its name says
    sure: int  # of the role: 3 for a word, 1 for a letter, 0 for nothing
    unit: Unit | None
    values: tuple[np.ndarray, ...]  # what each of some files holds in it
    by_name: bool  # whether a config can name it by its label
    unknown: str = ""  # a unit that is not known here
    copy_of: int | None = None  # position of another column that is the same signal

    @property
    def place(self) -> str:
        """The column in words: "column 4 'Weg [mm]'"."""
        unit = f" [{self.unit.name}]" if self.unit is not None and self.unit.name not in self.label else ""
        label = f" '{self.label}'" if self.label else ""
        return f"column {self.position}{label}{unit}"

    @property
    def key(self) -> str | int:
        """How a config names it: by name, or by position where the name is missing or stands twice."""
        return self.label if self.by_name else self.position

    @property
    def dimension(self) -> str:
        """What its unit measures; "" without a unit."""
        return "" if self.unit is None else self.unit.dimension

    def in_unit_of(self, role: str) -> bool:
        """Whether its unit is one of that role."""
        return self.dimension in DIMENSION[role]

    def may_be(self, role: str) -> bool:
        """Whether its unit and its name leave it free to be that."""
        if self.dimension not in ("", "none", "share", *DIMENSION[role]):
            return False
        return not self.sure or self.role == role or (self.sure == 1 and self.unit is not None)


@dataclass(frozen=True)
class Roles:
    """The columns by what they hold; None where none was found. `others` are all the rest."""

    time: TraceColumn | None
    displacement: TraceColumn | None
    force: TraceColumn | None
    load: TraceColumn | None
    speed: TraceColumn | None
    others: tuple[TraceColumn, ...]
    sign: int = 1
    both_ways: bool = False
    signs_differ: bool = False
    signed_files: int = 0
    strength: float = 0.0  # how well the force follows, of the best file that moves both ways
    coefficient: TraceColumn | None = None  # of friction, beside a load: where there is no force

    def dimension(self, role: str) -> str:
        """Return what the unit of a role's column measures; "" where there is no column or no unit."""
        column = getattr(self, role)
        return "" if column is None else column.dimension


def columns_of(dialect: Dialect, tables: Sequence[np.ndarray]) -> list[TraceColumn]:
    """Return the columns that hold numbers.

    `tables` are the numbers of some files, each of shape (rows, width), nan where there are none.
    """
    found = []
    for i in dialect.numbers:
        label = dialect.names[i] if i < len(dialect.names) else ""
        base, unit = name_and_unit(label)
        said = dialect.units[i].strip("[]() ") if i < len(dialect.units) else ""
        below = unit_of(said)
        if below not in (None, unit) and (unit is None or below.name != "1"):  # Druck A is not in amperes
            base, unit = label, below
        role, sure = column_role(base)
        symbol = unit is not below and unit is not None and re.search(r"\s[A-Za-z]{1,2}$", label)
        if symbol and unit.dimension in ("time", "length") and unit.dimension not in DIMENSION.get(role, ()):
            unit = None  # Weg s, Kraft Ft: letters for the quantity
        if role == "torque":
            role = "force"
        by_name = bool(label) and dialect.names.count(label) == 1 and dialect.names_are_cells
        values, unknown = tuple(table[:, i] for table in tables), said if unit is None else ""
        found.append(TraceColumn(i + 1, label, role, sure, unit, values, by_name, unknown))
    for i, column in enumerate(found):  # of two with the same signal loggers write the raw one first
        if later := next((other for other in found[i + 1 :] if _same_signal(column, other)), None):
            found[i] = replace(column, copy_of=later.position)
    return found


def _same_signal(one: TraceColumn, other: TraceColumn) -> bool:
    a, b = one.values[0], other.values[0]
    return not rises(a) and not rises(b) and shared_variance(a, b) > COPY**2


def _follows(column: TraceColumn, force: TraceColumn) -> bool:
    """Whether a column is the force in another unit or filtered: no load sensor follows it so closely."""
    both = zip(column.values, force.values, strict=True)
    return all(shared_variance(a, b) > FOLLOWS**2 for a, b in both)


def find_roles(columns: Sequence[TraceColumn]) -> Roles:
    """Return which column is what."""
    time = _best(columns, "time", _as_time)
    counters = [c for c in columns if c.role != "displacement" and all(map(is_counter, c.values))]
    rest = [column for column in columns if column is not time and column not in counters]
    speed_named = [c for c in rest if c.role == "speed" or c.in_unit_of("speed")]
    speed = speed_named[0] if speed_named else None
    rest = [column for column in rest if column not in speed_named]
    displacement = _best(rest, "displacement", _as_displacement)
    rest = [column for column in rest if column is not displacement]
    velocities = _velocities(time, displacement, speed)
    force = _best(rest, "force", lambda column: _as_force(column, velocities)) if velocities else None
    rest = [column for column in rest if column is not force]
    coefficient = next((c for c in rest if c.role == "coefficient"), None) if force is None else None
    load = _load(rest, force) if force is not None or coefficient is not None else None
    coefficient = coefficient if load is not None else None
    taken = (time, displacement, force, load, speed)
    others = tuple(column for column in columns if column not in (*taken, coefficient))
    found = Roles(*taken, others, coefficient=coefficient)
    return _with_sign(found, velocities) if force is not None else found


def _best(columns: Sequence[TraceColumn], role: str, behaves) -> TraceColumn | None:
    """Return the column with the most points: name and unit up to 5, behaviour up to 3; a copy comes last."""
    points = {}
    for column in columns:
        if not column.may_be(role):
            continue
        behaviour = behaves(column)
        named = column.sure if column.role == role else 0
        unit = 2.0 if column.in_unit_of(role) else 0.0
        if behaviour <= 0 or (not named and not unit and behaviour < BY_BEHAVIOUR):
            continue
        points[column.position] = named + unit + 3.0 * behaviour - (0.5 if column.copy_of else 0.0)
    return max((c for c in columns if c.position in points), key=lambda c: points[c.position], default=None)


def _as_time(column: TraceColumn) -> float:
    """Return the share of steps that are like the median one: 1 for a clock, little for a count of rows.

    A column called time may stand for several rows: the clock of the logger is coarse. In a few files it may
    run back.
    """
    rising = [values for values in column.values if rises(values)]
    if len(rising) < (MOST if column.role == "time" else 1.0) * len(column.values):
        stands = all((np.diff(values) >= 0).mean() > 0.99 and np.ptp(values) > 0 for values in column.values)
        return 0.3 if stands and column.role == "time" else 0.0
    steps = map(np.diff, rising)
    even = float(np.median([np.mean(np.abs(s - np.median(s)) <= 0.2 * np.median(s)) for s in steps]))
    return 0.3 * even if all(map(is_counter, column.values)) else max(even, 0.3)


def _as_displacement(column: TraceColumn) -> float:
    """Return how a column fills its range, times the share of its path that its strokes explain."""
    found = []
    for values in column.values:
        counts, _ = np.histogram(values, bins=10)
        path, strokes = np.abs(np.diff(values)).sum(), stroke_count(values) * np.ptp(values)
        found.append((1.0 - counts.max() / counts.sum()) * (strokes / path) if path else 0.0)
    return float(np.median(found))


def _as_force(column: TraceColumn, velocities: Sequence[np.ndarray]) -> float:
    if all(np.ptp(values) == 0 for values in column.values):
        return 0.0
    found = [follows(v, speed).strength for v, speed in zip(column.values, velocities, strict=True)]
    return max(float(np.median(found)), 0.05)  # a named force may follow badly; it is still the force


def _velocities(
    time: TraceColumn | None, displacement: TraceColumn | None, speed: TraceColumn | None
) -> list[np.ndarray]:
    if displacement is not None:  # without a time its direction is known all the same
        times = time.values if time is not None else [np.arange(len(x)) for x in displacement.values]
        return [velocity(t, x) for t, x in zip(times, displacement.values, strict=True)]
    return [smoothed(values) for values in speed.values] if speed is not None else []


def _load(rest: Sequence[TraceColumn], force: TraceColumn | None) -> TraceColumn | None:
    """Return the column of the normal load: one that is called so, or a second force that hardly varies."""
    named = [c for c in rest if c.role == "load" and c.may_be("load")]
    if named:
        return named[0]
    forces = [c for c in rest if c.in_unit_of("load") and c.role in ("force", "")]
    forces = [c for c in forces if force is None or not _follows(c, force)]
    steady = [c for c in forces if all(abs(np.mean(v)) > 5.0 * np.std(v) > 0.0 for v in c.values)]
    return steady[0] if len(steady) == 1 else None


def _with_sign(roles: Roles, velocities: Sequence[np.ndarray]) -> Roles:
    found = [follows(v, speed) for v, speed in zip(roles.force.values, velocities, strict=True)]
    signs = [one.sign for one in found if one.sign]
    told = max((one.strength for one in found), default=0.0) > BY_BEHAVIOUR / 2
    sign = -1 if told and sum(signs) < 0 else 1
    agree = signs.count(sign)
    return replace(
        roles,
        sign=sign,
        both_ways=sum(one.both_ways for one in found) > 0.5 * len(found),
        signs_differ=agree < len(signs),
        signed_files=agree,
        strength=max((one.strength for one in found if one.both_ways), default=0.0),
    )


def measured_speeds(roles: Roles, units: Mapping[str, Unit], files: Sequence[str]) -> dict[str, float]:
    """Return the speed in mm/s of each file with strokes of one speed, negative where all go backward."""
    if roles.time is None or roles.dimension("displacement") == "angle":
        return {}
    if roles.displacement is None:
        values = () if roles.speed is None else roles.speed.values
        return dict(zip(files, map(mean_speed, values), strict=False))
    given = {"time": "s", "displacement": "mm"} | {role: unit.name for role, unit in units.items()}
    in_s, in_mm = conversion(given["time"], "s"), conversion(given["displacement"], "mm")
    speeds: dict[str, float] = {}
    for file, time, displacement in zip(files, roles.time.values, roles.displacement.values, strict=True):
        found = moving_strokes(in_s(time), in_mm(displacement))
        own = [stroke.speed_mm_s for stroke in found]
        if own and not several_speeds(own):
            speeds[file] = float(np.median(np.abs(own)) * (-1 if max(own) < 0 else 1))
    return speeds


def motion_words(roles: Roles) -> str:
    """Return what the motion is like, for the summary."""
    strokes = 1
    if roles.displacement is not None:
        strokes = int(np.median([stroke_count(values) for values in roles.displacement.values]))
    many = "one stroke" if strokes == 1 else f"about {strokes} strokes"
    return f"{many} in a file, {'both ways' if roles.both_ways else 'one way'}"
