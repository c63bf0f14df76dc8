"""Which column of the trace files is time, displacement, force and load: by name, unit and behaviour."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from sealfit.config import Strokes
from sealfit.draft.dialect import Dialect
from sealfit.draft.vocabulary import column_role, name_and_unit
from sealfit.ingest.strokes import Stroke, find_strokes, turning_rows
from sealfit.units import Unit, unit_of

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
COPY = 0.9999  # correlation of two columns that are the same signal in two units
BY_BEHAVIOUR = 0.5  # how well a column must behave to be taken without a name or a unit


# ---------------------------------------------------------------- behaviour
# Time rises evenly, displacement fills its range, force follows the motion.


def rises(values: np.ndarray) -> bool:
    """Whether a column rises from row to row, as time and counters do."""
    return len(values) > 2 and bool((np.diff(values) > 0).mean() > 0.99)


def evenness(values: np.ndarray) -> float:
    """Return how even the steps of a rising column are: 1 where all are the same."""
    steps = np.diff(values)
    middle = np.median(steps)
    return float(np.mean(np.abs(steps - middle) <= 0.2 * abs(middle))) if middle else 0.0


def is_counter(values: np.ndarray) -> bool:
    """Whether a column counts rows: whole numbers one apart."""
    return rises(values) and bool((np.diff(values) == 1.0).all())


def spread(values: np.ndarray) -> float:
    """Return how a column fills its range: 0.9 if every tenth has as many samples, 0 for a constant."""
    low, high = np.min(values), np.max(values)
    if high <= low:
        return 0.0
    counts, _ = np.histogram(values, bins=10, range=(low, high))
    return float(1.0 - counts.max() / counts.sum())


def smoothness(values: np.ndarray) -> float:
    """Return the share of a column's path that its strokes explain: 1 for a displacement, less with noise."""
    path = float(np.abs(np.diff(values)).sum())
    return float((stroke_count(values) * np.ptp(values)) / path) if path else 0.0


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


@dataclass(frozen=True, slots=True)
class Follows:
    """How a column follows the motion: `sign` is that of the column where the displacement rises.

    `strength` is 0 to 1; `both_ways` whether the file moves in both directions.
    """

    sign: int
    strength: float
    both_ways: bool


def follows(values: np.ndarray, speed: np.ndarray) -> Follows:
    """Return how a column follows the direction of the motion.

    With strokes both ways its means forward and backward are compared, so an offset does not matter; with one
    direction the mean while moving is compared with zero, and its strength with the first samples at rest.
    """
    fast = np.quantile(np.abs(speed), 0.95) * MOVING
    forward, backward = values[speed > fast], values[speed < -fast]
    least = 0.05 * len(values)
    if len(forward) > least and len(backward) > least:
        apart = float(np.mean(forward) - np.mean(backward))
        scatter = float(0.5 * (np.std(forward) + np.std(backward)))
        return Follows(int(np.sign(apart)), _share(apart, scatter), True)
    moving, way = (forward, 1) if len(forward) >= len(backward) else (backward, -1)
    if len(moving) == 0:
        return Follows(0, 0.0, False)
    mean = float(np.mean(moving))
    rest = float(values[0])
    return Follows(int(np.sign(mean)) * way, _share(mean - rest, float(np.std(moving))), False)


def _share(difference: float, scatter: float) -> float:
    total = abs(difference) + 2.0 * scatter
    return abs(difference) / total if total else 0.0


def moving_strokes(time: np.ndarray, displacement: np.ndarray) -> list[Stroke]:
    """Return the strokes of a motion with a steady speed; rows at which the clock stands are left out."""
    rows = np.diff(np.maximum.accumulate(time), prepend=-np.inf) > 0
    found = find_strokes(time[rows], displacement[rows], np.zeros(np.count_nonzero(rows)), Strokes())
    return [stroke for stroke in found if np.isfinite(stroke.speed_mm_s) and stroke.speed_mm_s != 0]


# ---------------------------------------------------------------- roles


@dataclass(frozen=True)
class TraceColumn:
    """A column of the trace files, and what each of some files holds in it.

    `position` counts from 1; `label` is what the files call it, "" if nothing; `role` is what its name says,
    with `sure` 3 for a word, 1 for a letter, 0 for nothing. `unknown` is a unit that is not known here,
    `copy_of` the position of another column that is the same signal.
    """

    position: int
    label: str
    role: str
    sure: int
    unit: Unit | None
    values: tuple[np.ndarray, ...]
    by_name: bool
    unknown: str = ""
    copy_of: int | None = None

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

    def in_unit_of(self, role: str) -> bool:
        """Whether its unit is one of that role."""
        return self.unit is not None and self.unit.dimension in DIMENSION[role]

    def may_be(self, role: str) -> bool:
        """Whether its unit and its name leave it free to be that."""
        if self.unit is not None and self.unit.dimension not in ("none", "share", *DIMENSION[role]):
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
        return column.unit.dimension if column is not None and column.unit is not None else ""


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
        values = tuple(table[:, i] for table in tables)
        found.append(
            TraceColumn(i + 1, label, role, sure, unit, values, by_name, said if unit is None else "")
        )
    return _copies_marked(found)


def _copies_marked(columns: list[TraceColumn]) -> list[TraceColumn]:
    """Return the columns, the earlier of two with the same signal marked: loggers write the raw one first."""
    marked = []
    for i, column in enumerate(columns):
        later = next((other for other in columns[i + 1 :] if _same_signal(column, other)), None)
        marked.append(replace(column, copy_of=later.position) if later else column)
    return marked


def _same_signal(one: TraceColumn, other: TraceColumn) -> bool:
    a, b = one.values[0], other.values[0]
    if rises(a) or rises(b) or np.ptp(a) == 0 or np.ptp(b) == 0:
        return False
    return abs(float(np.corrcoef(a, b)[0, 1])) > COPY


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
    load = _load(rest) if force is not None or coefficient is not None else None
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
    if not all(rises(values) for values in column.values):
        return 0.0
    even = float(np.median([evenness(values) for values in column.values]))
    return 0.3 * even if all(is_counter(values) for values in column.values) else max(even, 0.3)


def _as_displacement(column: TraceColumn) -> float:
    return float(np.median([spread(v) * smoothness(v) for v in column.values]))


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


def _load(rest: Sequence[TraceColumn]) -> TraceColumn | None:
    """Return the column of the normal load: one that is called so, or a second force that hardly varies."""
    named = [c for c in rest if c.role == "load" and c.may_be("load")]
    if named:
        return named[0]
    forces = [c for c in rest if c.in_unit_of("load") and c.role in ("force", "")]
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
