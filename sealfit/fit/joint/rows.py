"""The rows to which the joint model is fitted: the `bins` table as sorted arrays, with nested groups."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from dataclasses import dataclass, field, replace
from functools import wraps

import numpy as np
import pandas as pd
from scipy.sparse import csr_array

from sealfit.ingest.quality import LEAST_KNOWN, NO_VALUE
from sealfit.tables import BINS


@dataclass(frozen=True, slots=True)
class Groups:
    """Nested groups of sorted rows: per level, the first row of every group and each row's group number."""

    starts: dict[str, np.ndarray]
    codes: dict[str, np.ndarray]
    _summing: dict[str, csr_array] = field(default_factory=dict, init=False, compare=False, repr=False)

    @classmethod
    def of(cls, codes: dict[str, np.ndarray]) -> Groups:
        """Return the groups of `codes`: per level the group of each row, contiguous, finest level first."""
        starts, numbers = {}, {}
        for level, code in codes.items():
            first = np.r_[True, code[1:] != code[:-1]][: code.size]  # no rows: no groups
            starts[level], numbers[level] = np.flatnonzero(first), np.cumsum(first) - 1
        return cls(starts, numbers)

    def sums(self, values: np.ndarray, level: str) -> np.ndarray:
        """Return the sum of `values`, shape (n,) or (n, k), over each group of a level."""
        if level not in self._summing:  # making one takes ten times as long as a sum, and reduceat as well
            n, start = values.shape[0], self.starts[level]
            entries = (np.ones(n), np.arange(n), np.r_[start, n])
            self._summing[level] = csr_array(entries, shape=(start.size, n))
        return self._summing[level] @ values

    def means(self, values: np.ndarray, level: str) -> np.ndarray:
        """Return the mean of `values`, shape (n,) or (n, k), in each group of a level."""
        count = np.diff(np.r_[self.starts[level], values.shape[0]]).astype(float)
        return self.sums(values, level) / (count if values.ndim == 1 else count[:, None])

    def at(self, level: str) -> Groups:
        """Return the groups of a table with one row per group of `level`."""
        first, levels = self.starts[level], list(self.codes)
        levels = levels[levels.index(level) :]
        starts = {name: np.searchsorted(first, self.starts[name]) for name in levels}
        return Groups(starts, {name: self.codes[name][first] for name in levels})

    def repeated(self, count: int) -> Groups:
        """Return the groups of a table that repeats each row `count` times."""
        return Groups(
            {level: count * start for level, start in self.starts.items()},
            {level: np.repeat(code, count) for level, code in self.codes.items()},
        )


# ---------------------------------------------------------------- rows
# How a run of a file with both directions, or with several steady speeds in a stroke, ends.
SPEED_AND_SIGN = r"( at \d[\d.e+-]*?)?[+-]?$"
# Grouping levels, finest first. A row of `bins` is a mean of samples of a stroke.
LEVELS = ("stroke", "file", "run", "specimen")
# Column of the set-up of each row, if repeats are set-ups. No channel of a campaign begins with `_`.
SET_UP = "_set_up"
# Level of the runs in a campaign with set-ups, each of which is part of several set-ups.
CELL = "cell"
# Channels that increase along a stroke, so that they vary within a bin.
ALONG = ("displacement_mm", "distance_mm", "time_s")
# Derived channel if loads differ: load times |speed|, the power of friction over its coefficient.
POWER = "power"

# Measured speeds of a run are one setting if the largest exceeds the smallest by less than this share.
SAME_SPEED_OF_RUN = 0.05

# Ratio of the largest to the smallest load up to which it is one setting.
SAME_LOAD = 1.05
NOT_CHANNELS = {
    "file", "record", "run_id", "bin", "stroke_id", "n", "force_N", "force_sd_N", "presliding_N", "rise_mm",
    "speed_bin_mm_s", "specimen_id", "condition", "series", "rubber", "speed_set_mm_s", SET_UP,
}  # fmt: skip


class Cache(dict):
    """Derived values that are computed once."""

    def once(self, key: Hashable, make: Callable, at: object = None):
        """Return the value of a key; `make` computes it at first, and again if `at` has changed since."""
        if key not in self or self[key][0] != at:
            self[key] = (at, make())
        return self[key][1]


def cached(method: Callable) -> Callable:
    """Return a method that is computed once for each choice of its arguments, and kept in `self.cache`."""

    @wraps(method)
    def once(self, *arguments):
        return self.cache.once((method.__name__, *arguments), lambda: method(self, *arguments))

    return once


@dataclass(frozen=True)
class Lag:
    """How far behind its steady value friction follows a slow change along a stroke.

    At constant speed a bristle follows dz/dx = 1 - z / z_ss (Eq. 2 divided by v). If z_ss changes slowly
    along x, z is that of x - z_ss: the friction force times `compliance`, 1 / sigma_0. `speed_factor` turns
    displacement per time into the unit of the speed.
    """

    compliance: float = 0.0
    speed_factor: float = 1.0

    def behind(self, channel: str, force: np.ndarray, speed: np.ndarray) -> np.ndarray:
        """Return the lag in a channel of `ALONG` at forces and signed speeds, shape (n,)."""
        z_ss = self.compliance * np.abs(force)
        if channel == "displacement_mm":
            return np.sign(speed) * z_ss
        return z_ss if channel == "distance_mm" else z_ss * self.speed_factor / np.abs(speed)


@dataclass(frozen=True)
class Rows:
    """Sorted rows of `bins` as arrays; `order` gives each row's place in the original table.

    A file with strokes in both directions belongs to two runs; its group is the run without sign.
    """

    table: pd.DataFrame
    order: np.ndarray
    groups: Groups
    force: np.ndarray  # (n,) measured
    speed: np.ndarray  # (n,) signed, of the stroke
    pace: np.ndarray  # (n,) signed, of the bin if measured to differ: the speed in the model's force
    load: np.ndarray  # (n,) 1 if unknown
    days: np.ndarray  # (n,) aging time in days, 0 without aging
    condition: np.ndarray  # (n,) number in `conditions`
    conditions: pd.DataFrame  # (c,) condition, series, rubber, aging_days
    has_load: bool
    has_aging: bool
    weight: np.ndarray  # (n,) sums to 1; all files have equal weight
    lag: Lag = Lag()
    filled: dict[str, np.ndarray] = field(default_factory=dict)  # channels that some files lack
    cache: Cache = field(default_factory=Cache, init=False, compare=False, repr=False)

    @property
    def channels(self) -> list[str]:
        """Names of the columns on which a residual may depend."""
        return [name for name in self.table.columns if name not in NOT_CHANNELS]

    @cached
    def values(self, channel: str) -> np.ndarray:
        """Return a channel, shape (n,): floats, or strings if it is categorical; missing values filled in."""
        if channel in self.filled:
            return self.filled[channel]
        column = self.table[channel]
        if pd.api.types.is_numeric_dtype(column):
            return column.to_numpy(dtype=float, na_value=np.nan)
        return column.astype(object).where(column.notna(), NO_VALUE).to_numpy().astype(str)

    @cached
    def followed(self, channel: str) -> np.ndarray:
        """Return a channel of `ALONG` where the steady friction is that of each row, shape (n,)."""
        force = self.groups.means(np.abs(self.force), "stroke")[self.codes("stroke")]
        return self.values(channel) - self.lag.behind(channel, force, self.speed)

    def unsigned(self, channel: str) -> np.ndarray:
        """Return a channel as the forms of effects read it: the speed without its sign, shape (n,)."""
        values = self.values(channel)
        return np.abs(values) if channel == "speed_mm_s" else values

    @cached
    def bin_width(self, channel: str) -> np.ndarray:
        """Return the width of each row's bin in a channel, shape (n,): samples times the step between them.

        The step is the difference of neighbouring bin means over half the sum of their numbers of samples.
        """
        samples, inside = self.samples, np.diff(self.codes("stroke")) == 0
        step = np.where(inside, np.diff(self.values(channel)) / ((samples[1:] + samples[:-1]) / 2), 0.0)
        left, right = np.r_[0.0, step], np.r_[step, 0.0]
        return samples * np.where(left == 0, right, np.where(right == 0, left, (left + right) / 2))

    @property
    def samples(self) -> np.ndarray:
        """Number of samples in each row's mean, shape (n,); 1e9 if unknown."""
        return self.table["n"].to_numpy(dtype=float) if "n" in self.table else np.full(self.force.size, 1e9)

    def codes(self, level: str) -> np.ndarray:
        """Return each row's group number at a level."""
        return self.groups.codes[level]

    def level_name(self, level: str) -> str:
        """Return the name of a level in the results: the groups of level "run" may be set-ups."""
        return "set_up" if level == "run" and SET_UP in self.table else level

    @cached
    def cells(self) -> np.ndarray | None:
        """Return each row's number of its run where runs lie across set-ups, shape (n,); None elsewhere."""
        if SET_UP not in self.table:
            return None
        found = pd.factorize(nesting_run(self.table, self.table["record"]))[0]
        several = self.table[SET_UP].groupby(found).nunique().max() > 1
        return found if several else None

    @cached
    def sparse(self, most: int) -> Rows:
        """Return about `most` or fewer rows of each stroke, evenly spread, for effects on whole strokes."""
        code = self.codes("stroke")
        for channel in (name for name in ALONG if name in self.table):
            self.bin_width(channel)  # from all bins, not from the ones that remain
        place = np.arange(code.size) - self.groups.starts["stroke"][code]
        step = -(-np.bincount(code) // most)[code]  # rounded up
        return self.subset(place % step == step // 2)

    def points(self, table: pd.DataFrame, condition: np.ndarray) -> Rows:
        """Return points at the conditions of these rows, for a prediction; arguments as `point_rows`."""
        table = table.reset_index(drop=True)
        own = {name: getattr(self, name) for name in ("has_load", "has_aging", "lag")}
        return point_rows(table, condition, self.conditions, **own)

    def subset(self, mask: np.ndarray) -> Rows:
        """Return the rows where `mask`, shape (n,), is true; conditions keep the numbers that models need."""
        arrays = ("order", "force", "speed", "pace", "load", "days", "condition")
        part = replace(
            self,
            table=self.table[mask].reset_index(drop=True),
            groups=Groups.of({level: code[mask] for level, code in self.groups.codes.items()}),
            weight=self.weight[mask] / self.weight[mask].sum(),
            filled={name: values[mask] for name, values in self.filled.items()},
            **{name: getattr(self, name)[mask] for name in arrays},
        )
        for key, (at, values) in self.cache.items():
            if key[0] in ("values", "bin_width"):  # widths are those of all bins
                part.cache[key] = (at, values[mask])
        return part


def make_rows(
    bins: pd.DataFrame, *, has_aging: bool, speed_factor: float = 1.0, campaign: Rows | None = None
) -> Rows:
    """Return table `bins` as sorted arrays with nested groups.

    `has_aging` is whether conditions have `aging_days`, `speed_factor` turns displacement per time into the
    unit of the speed. Conditions and lag are those of the `campaign` if these rows are a part of it.
    """
    table = bins.reset_index(drop=True).assign(record=records(bins).to_numpy())
    run = nesting_run(table, table["record"])
    unit = table.get(SET_UP, run)
    # A run on several specimens is of the first: groups are nested.
    keys = [table["record"], unit, table["specimen_id"].groupby(unit).transform("min")]
    codes = [table["stroke"].to_numpy(), *(pd.factorize(key, sort=True)[0] for key in keys)]
    order = np.lexsort(codes)
    table = table.iloc[order].reset_index(drop=True)
    stroke, file, *_ = codes = [code[order] for code in codes]
    codes[0] = file * (int(stroke.max()) + 1) + stroke
    groups = Groups.of(dict(zip(LEVELS, codes, strict=True)))
    has_load = "load_N" in table and bool(table["load_N"].notna().all())
    if has_load and POWER not in table and not one_load(table["load_N"]):
        table[POWER] = sliding_power(table["load_N"], table["speed_mm_s"])
    days = table["aging_days"].to_numpy(dtype=float) if has_aging else np.zeros(len(table))
    condition, names = pd.factorize(table["condition"], sort=True)
    if campaign is None:
        first = table.drop_duplicates("condition").set_index("condition").loc[names]
        conditions = first[["series", "rubber"]].reset_index()
        conditions["aging_days"] = first["aging_days"].to_numpy(dtype=float) if has_aging else 0.0
    else:
        conditions = campaign.conditions
        condition = pd.Index(conditions["condition"]).get_indexer(names)[condition]
    files = groups.codes["file"]
    per_file = np.bincount(files)[files]
    measured = table["speed_mm_s"].to_numpy(dtype=float)
    speed = set_speeds(measured, pd.factorize(run.iloc[order])[0])
    pace = table["speed_bin_mm_s"].to_numpy(dtype=float) if "speed_bin_mm_s" in table else measured
    load = table["load_N"].to_numpy(dtype=float) if has_load else np.ones(len(table))
    return Rows(
        table=table,
        order=order,
        groups=groups,
        force=table["force_N"].to_numpy(dtype=float),
        speed=speed,
        pace=pace * speed / measured,
        load=load,
        days=days,
        condition=condition,
        conditions=conditions,
        has_load=has_load,
        has_aging=has_aging,
        weight=1.0 / per_file / (files.max() + 1),
        lag=Lag(compliance_of(table, groups), speed_factor) if campaign is None else campaign.lag,
        filled=fill_missing(table, groups),
    )


def compliance_of(table: pd.DataFrame, groups: Groups) -> float:
    """Return the median over strokes of the length of the rise over the friction force, 1 / sigma_0.

    Single rises are too noisy. It is 0 if fewer than half of the strokes begin with a rise.
    """
    if "rise_mm" not in table:
        return 0.0
    force = groups.means(np.abs(table["force_N"].to_numpy(dtype=float)), "stroke")
    rise = table["rise_mm"].to_numpy(dtype=float)[groups.starts["stroke"]]
    return float(np.nan_to_num(np.median(rise / np.maximum(force, 1e-300))))


def set_speeds(speed: np.ndarray, run: np.ndarray) -> np.ndarray:
    """Return signed speeds of rows, shape (n,), with all strokes of one setting of a run at their mean.

    `run`, shape (n,), is the number of each row's run. Measured speeds of one setting differ by the noise of
    the position, and the force does not follow it. If the forces of these strokes are more alike than the
    runs, the slope of the Stribeck curve would be fitted to that noise and be too small (regression dilution:
    Fuller 1987, *Measurement Error Models*, section 1.1, doi:10.1002/9780470316665).
    """
    size = np.abs(speed)
    order = np.lexsort((size, run))
    ascending = size[order]
    apart = (np.diff(run[order]) != 0) | (np.diff(ascending) > SAME_SPEED_OF_RUN * ascending[:-1])
    setting = np.empty(speed.size, dtype=int)
    setting[order] = np.cumsum(np.r_[False, apart][: speed.size])
    own = pd.Series(size).groupby(setting)
    same = own.transform("max") <= (1 + SAME_SPEED_OF_RUN) * own.transform("min")
    return np.sign(speed) * np.where(same, own.transform("mean"), size)


def fill_missing(table: pd.DataFrame, groups: Groups) -> dict[str, np.ndarray]:
    """Return the campaign's own numeric channels that a few files lack, with missing values filled in.

    A missing value becomes the mean of its stroke, file, run or specimen, the first of these that has values,
    else of all files. Channels that too many files lack are left out.
    """
    found, files = {}, groups.starts["file"].size
    for name in open_columns(table):
        if not pd.api.types.is_numeric_dtype(table[name]):
            continue
        column = pd.Series(table[name].to_numpy(dtype=float, na_value=np.nan))
        per_file = column.groupby(groups.codes["file"]).mean()
        if not column.isna().any() or per_file.notna().sum() < LEAST_KNOWN * files:
            continue
        values = column
        for level in LEVELS:
            known = column.groupby(groups.codes[level])
            low, high = known.transform("min"), known.transform("max")
            values = values.fillna(low.where(low == high, known.transform("mean")))
        found[name] = values.fillna(per_file.mean()).to_numpy()
    return found


def one_load(load_N: np.ndarray | pd.Series) -> bool:
    """Return whether loads, shape (n,), are one setting but for the noise of its sensor."""
    return bool(np.abs(load_N).max() <= SAME_LOAD * np.abs(load_N).min())


def sliding_power(load: np.ndarray | pd.Series, speed: np.ndarray | pd.Series) -> np.ndarray | pd.Series:
    """Return the derived channel `POWER` in N mm/s, shape of the load (N) and the signed speed (mm/s)."""
    return load * np.abs(speed)


def thin(bins: pd.DataFrame, most: int) -> pd.DataFrame:
    """Return `bins` with neighbouring bins of a stroke merged, so that about `most` or fewer rows remain."""
    merged = int(np.ceil(len(bins) / most))
    return bins if merged <= 1 else merge(bins, merged)


def merge(bins: pd.DataFrame, together: int | np.ndarray) -> pd.DataFrame:
    """Return table `bins` with neighbouring bins of a stroke merged into means over all their samples.

    `together`, the number of bins per row, may have the shape (n,) and then is constant within a stroke.
    """
    place = bins.groupby(["file", "stroke"], sort=False).cumcount() // together
    keys = [bins["file"], bins["stroke"], place.rename("place")]
    numeric = [c for c in bins.columns if pd.api.types.is_float_dtype(bins[c])]
    first = [c for c in bins.columns if c not in numeric and c not in ("file", "stroke", "n")]
    grouped = bins.groupby(keys, sort=False)
    samples = bins[numeric].notna().mul(bins["n"], axis=0).groupby(keys, sort=False).sum()
    means = bins[numeric].mul(bins["n"], axis=0).groupby(keys, sort=False).sum() / samples  # 0 / 0: not known
    table = pd.concat([means, grouped[first].first(), grouped["n"].sum()], axis=1)
    return table.reset_index(level="place", drop=True).reset_index()[list(bins.columns)]


def records(table: pd.DataFrame) -> pd.Series:
    """Return each row's record: its file, or the first of the files of one repeat with different strokes."""
    strokes = table.drop_duplicates(["file", "stroke"])
    repeat = [strokes["specimen_id"], _unsigned(strokes["run_id"]), strokes["repeat"]]
    again = pd.concat([*repeat, strokes["stroke"]], axis=1).duplicated(keep=False)
    file = strokes["file"].astype(str)
    first = file.groupby(repeat, dropna=False, sort=False).transform("first")
    whole = again.groupby(repeat, dropna=False, sort=False).transform("any")
    return table["file"].astype(str).map(dict(zip(file, file.where(whole, first), strict=True)))


def nesting_run(table: pd.DataFrame, record: pd.Series) -> pd.Series:
    """Return each row's run, without speed and sign if the record has several speeds or both directions."""
    both = table.groupby(record)["run_id"].transform("nunique") > 1
    return table["run_id"].where(~both, _unsigned(table["run_id"]))


def _unsigned(run: pd.Series) -> pd.Series:
    return run.str.replace(SPEED_AND_SIGN, "", n=1, regex=True)


def open_columns(table: pd.DataFrame) -> list[str]:
    """Return the channels that the campaign added to `bins`."""
    fixed = {*BINS.names(), "record", SET_UP}
    return [name for name in table.columns if name not in fixed]


def point_rows(
    table: pd.DataFrame,
    condition: np.ndarray,
    conditions: pd.DataFrame,
    *,
    has_load: bool,
    has_aging: bool,
    lag: Lag,
) -> Rows:
    """Return the points of a prediction as `Rows`, one group per point.

    `table`, shape (n, ...), has `speed_mm_s` and all channels that the model reads. The force is 0: friction
    has no lag until `force` is replaced.
    """
    n = len(table)
    every = np.arange(n)
    days = conditions["aging_days"].to_numpy(dtype=float)[condition] if has_aging else np.zeros(n)
    speed = table["speed_mm_s"].to_numpy(dtype=float)
    return Rows(
        table=table,
        order=every,
        groups=Groups.of({level: every for level in LEVELS}),
        force=np.zeros(n),
        speed=speed,
        pace=speed,
        load=table["load_N"].to_numpy(dtype=float) if has_load else np.ones(n),
        days=days,
        condition=np.asarray(condition),
        conditions=conditions,
        has_load=has_load,
        has_aging=has_aging,
        lag=lag,
        weight=np.full(n, 1.0 / max(n, 1)),
    )
