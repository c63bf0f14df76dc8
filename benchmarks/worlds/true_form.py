"""What somebody who knows the truth could see in a world: z of every effect, and the error of the true form.

The rows are bin means of the plateaus. The declared quantities and the effects are linearised at the truth:
the force is integrated again with each quantity moved by a little, and without each effect. So y = X d + e, y
the measured force less the true mean, X the derivatives by every declared quantity (of every series) and
sigma_0 and each effect's own noise-free part; d = 0 is the truth, and an effect's amplitude is 1 + d.

z of an effect: weighted least squares within the groups above its unit of evidence (groups are demeaned, so
that their scatter has no part): an effect inside files within files, one between repeats within runs, one
between runs within specimens, one between specimens as it is. The covariance is robust for clusters (CR1) of
that unit; for an effect inside files of runs where there are twelve, else of files; for an effect between
repeats that are mounted anew of these set-ups. The t value has as many degrees of freedom as clusters beyond
the rank of their means, and is given as the normal z of the same p, at the true amplitude and at the measured
one; the smaller counts. So z is conservative: what demeaning takes away is not used.

z by specimens: the same with specimens as the clusters, and one degree of freedom less than specimens. Nobody
who does not know whether specimens differ in their slope along a channel can claim more from them than this.

p by units: the two-sided p of z by the units that may scatter without any effect: specimens where the effect
varies inside strokes, with the speed or with the direction, else the clusters of z. A tester who knows the
form and the quantity, but not where to look, must hold it against as many tests as the campaign has
candidates (`candidates`): every quantity along every variable, and friction and force along every pair. The
effect can be told where p by units times their number is at most 0.005.

The true form's error at new points: d of the same generalised least squares, and the derivatives at the
points.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd
from scipy import stats
from scipy.linalg import cho_factor, cho_solve

from worlds.campaign import measured_N, noise_sd_N
from worlds.effects import Effect
from worlds.law import QUANTITIES
from worlds.motion import Batch, force_at, groups, integrate
from worlds.world import World

BINS = 60  # of a stroke: two of the shortest ripple's period
NUDGE = 1e-3
CLEAR = 8.0
SECOND_ORDER = 1e-3  # of the force: what linearising leaves, at scatter of some percent
VAGUE = 2.0  # relative standard deviation of what is known of a declared quantity beforehand: next to nothing
LEAST_RUNS = 12  # with fewer, files are the clusters of an effect inside files
MOST_ROWS = 1200  # of a specimen whose scatter is taken as one block: more are cut between files, for time
WRONG_GAIN = 0.15  # of files that went wrong, about
TOLD = 0.005  # family error of a search
QUANTITIES_TRIED = (
    7  # force added and by a factor, mu, mu_s, mu_c, v_s, sigma_2; a and b where rubber is aged
)
TRIED_OF_PAIRS = 2
GAIN = ("mu_0s", "mu_0c", "a_s", "a_c", "sigma_2")  # quantities that a gain of the whole friction multiplies
UNIT = {"repeat": "file", "run": "run_id", "set_up": "set_up", "specimen": "specimen_id"}
LEVELS = ("stroke", "file", "run_id", "specimen_id")  # nesting, fine to coarse
CLAIM_LEVEL = {
    "sample": "trace",
    "stroke": "stroke",
    "file": "repeat",
    "run_id": "run",
    "specimen_id": "condition",
}


@dataclass
class Rows:
    """Bin means: every channel, `y` measured less true mean, `mean` the true mean force, and columns X."""

    table: pd.DataFrame
    columns: np.ndarray  # (n, k) nuisance first, then effects
    names: list[tuple]  # ("quantity", series) or ("effect", number)
    variance: np.ndarray  # of a bin's noise
    fit: tuple[np.ndarray, np.ndarray] | None = None  # `fitted`, once asked for

    @property
    def effects(self) -> list[int]:
        """Places of the effects among the columns."""
        return [k for k, name in enumerate(self.names) if name[0] == "effect"]


def make_rows(world: World) -> Rows:
    """Return the bin means of a world with everything the true form needs."""
    tables, columns, variances = [], [], []
    names = column_names(world)
    for group in groups(world):
        truth = integrate(world, group)
        seen = measured_N(world, integrate(world, group, scattered=True))
        forces = [f for _, f in _moved(world, group, truth)]
        table, variance = _binned(world, truth, [seen, truth.force_N, *forces])
        found = _columns(world, table, [f"_f{k}" for k in range(2, 2 + len(forces))], "_f1", names)
        tables.append(table)
        columns.append(found)
        variances.append(variance)
    table = pd.concat(tables, ignore_index=True)
    table["y"], table["mean"] = table["_f0"] - table["_f1"], table["_f1"]
    return Rows(table, np.concatenate(columns), names, np.concatenate(variances))


def column_names(world: World) -> list[tuple]:
    """Names of the columns: each declared quantity of each series present, sigma_0, then the effects."""
    present = sorted(world.files["series"].unique())
    aging = world.days.size > 0
    names: list[tuple] = []
    for quantity in QUANTITIES:
        if quantity[:2] in ("a_", "b_") and not aging:
            continue
        shared = aging and quantity.startswith("mu_0")
        names += [(quantity, None)] if shared else [(quantity, k) for k in present]
    return [*names, ("sigma_0", None), *(("effect", k) for k in range(len(world.effects)))]


def _moved(world: World, group: np.ndarray, truth: Batch):
    """Yield the mean force with each declared quantity moved, and without each effect."""
    for quantity in (*QUANTITIES, "sigma_0"):
        yield quantity, integrate(world, group, nudge={quantity: NUDGE}).force_N
    for k in range(len(world.effects)):
        yield k, integrate(world, group, without={k}).force_N


def _columns(
    world: World, table: pd.DataFrame, moved: list[str], truth: str, names: list[tuple]
) -> np.ndarray:
    """Return X from the table's moved forces: derivatives by relative changes, and each effect's own part."""
    order = [*QUANTITIES, "sigma_0", *range(len(world.effects))]
    by = dict(zip(order, moved, strict=True))
    series = table["series"].to_numpy()
    found = []
    for name, owner in names:
        if name == "effect":
            found.append((table[truth] - table[by[owner]]).to_numpy())
            continue
        change = ((table[by[name]] - table[truth]) / NUDGE).to_numpy()
        found.append(change if owner is None else np.where(series == owner, change, 0.0))
    return np.column_stack(found)


def _binned(world: World, truth: Batch, forces: list[np.ndarray]) -> tuple[pd.DataFrame, np.ndarray]:
    """Return the plateau's bin means of channels and forces, and the variance of a mean's noise.

    The means of forces are `_f0`, `_f1` and so on.
    """
    n, _samples = truth.force_N.shape
    flat = truth.plateau
    share = np.clip(truth.channels["distance_mm"] / world.rig["stroke_mm"], 0, 1 - 1e-9)
    key = ((np.arange(n)[:, None] * 64 + truth.channels["stroke"]) * BINS + np.floor(share * BINS)).astype(
        int
    )[flat]
    order = np.unique(key, return_inverse=True)[1]
    count = np.bincount(order)

    def mean(x: np.ndarray) -> np.ndarray:
        return np.bincount(order, x[flat]) / count

    row = np.round(mean(np.broadcast_to(truth.files[:, None].astype(float), flat.shape))).astype(int)
    table = world.files.iloc[row].reset_index(drop=True)
    table = table[[name for name in table if not name.startswith("_")]]
    table = table.rename(columns={"speed_mm_s": "speed_set_mm_s"}).drop(columns="direction")
    along = {name: mean(values) for name, values in truth.channels.items() if name not in world.files.columns}
    along |= {"direction": mean(truth.channels["direction"]), "speed_mm_s": mean(np.abs(truth.speed_mm_s))}
    table = table.assign(**along, **{f"_f{k}": mean(force) for k, force in enumerate(forces)})
    table["aging_days"] = table["aging_days"].fillna(0.0)
    colour = 1 + 2 * world.noise["samples"] * (world.noise["kind"] == "coloured")
    noise = mean(noise_sd_N(world, truth.force_N, truth.speed_mm_s) ** 2)
    step = world.noise["step_rel"] * world.rig["mean_N"]
    dithered = np.where(np.sqrt(noise) > 0.5 * step, count, 1)  # without noise a whole bin is rounded alike
    return table, noise * np.minimum(colour / count, 1.0) + step**2 / 12 / dithered


def codes(rows: Rows) -> dict[str, np.ndarray]:
    """Return the unit of each nesting level that every row belongs to."""
    t = rows.table
    way = t["direction"].astype(int).astype(str)
    keys = {
        "stroke": t["file"] + t["stroke"].astype(str),
        "file": t["file"],
        "run_id": t["run_id"] + way,
        "set_up": t["specimen_id"] + t["repeat"].astype(str),
        "specimen_id": t["specimen_id"],
    }
    return {name: pd.factorize(key)[0] for name, key in keys.items()}


def unit_of(values: np.ndarray, units: dict[str, np.ndarray]) -> str:
    """Return the coarsest nesting level within each of whose groups values are constant, else "sample"."""
    values = pd.factorize(values)[0] if values.dtype.kind not in "fi" else values.astype(float)
    size = max(float(np.nanmax(np.abs(values))), 1e-300)
    for level in reversed(LEVELS):
        grouped = pd.Series(values).groupby(units[level])
        if float((grouped.max() - grouped.min()).max()) <= 1e-9 * size:
            return level
    return "sample"


def z_values(rows: Rows, world: World) -> list[dict]:
    """Return each effect's unit, z at the true amplitude and as measured, and how much of it is its own."""
    units = codes(rows)
    found = []
    if not rows.effects:
        return found
    d, covariance = fitted(world, rows)
    for place in rows.effects:
        number = rows.names[place][1]
        effect = world.effects[number]
        names = [n for n in (*effect.variables, *effect.place) if n in rows.table]
        each = [unit_of(_setting(rows, n), units) for n in names]
        order = ("sample", *LEVELS)
        unit = min(each, key=order.index) if each else "specimen_id"
        own = _z(rows, units, unit, place, world)
        se = float(np.sqrt(covariance[place, place]))
        whole = {"z": (1 + float(d[place])) / se, "z_expected": 1 / se}
        both = {name: min(own[name], value, key=abs) for name, value in whole.items()}
        p = p_units(own | both, scatters=unit == "sample" or bool({"speed_mm_s", "direction"} & set(names)))
        told = p * candidates(world) <= TOLD
        found.append({"unit": unit, "level": CLAIM_LEVEL[unit], **own, **both, "p_units": p, "told": told})
    return found


def p_units(z: dict, *, scatters: bool) -> float:
    """Return the p of an effect by the units whose slopes may differ without it.

    `scatters` says which these are: specimens, or runs.
    """
    size = min(abs(z["z"]), abs(z["z_specimens"])) if scatters else abs(z["z"])
    return float(2 * stats.norm.sf(size))


def candidates(world: World) -> int:
    """Count a campaign's tests of an unknown effect: quantities along variables, and pairs of these."""
    variables = len(world.ranges) + (world.rig["directions"] != "one") + ("batch" in world.files)
    quantities = QUANTITIES_TRIED + 2 * (np.count_nonzero(world.days > 0) > 0)
    return variables * quantities + TRIED_OF_PAIRS * variables * (variables - 1) // 2


def _setting(rows: Rows, name: str) -> np.ndarray:
    """Return a channel, the speed as it was set: true speeds differ a little from file to file."""
    return rows.table["speed_set_mm_s" if name == "speed_mm_s" else name].to_numpy()


BELOW = {"sample": (), "stroke": (), "file": ("repeat",), "run_id": ("repeat", "run"),
         "specimen_id": ("repeat", "run", "specimen")}  # fmt: skip
ABOVE = {"sample": "file", "stroke": "file", "file": "run_id", "run_id": "specimen_id", "specimen_id": None}


def _z(rows: Rows, units: dict, unit: str, place: int, world: World) -> dict:
    mean = friction_N(rows, world)
    mean = np.sign(rows.table["direction"].to_numpy()) * np.maximum(np.abs(mean), 0.05 * world.rig["mean_N"])
    absorbed = ABOVE[unit]
    gains = sum(
        s["sd"] ** 2 for s in world.scatter if s["kind"] in ("gain", "level") and s["level"] in BELOW[unit]
    )
    weight = 1 / (rows.variance / mean**2 + gains + 1e-8)
    # Relative to the true friction: then a gain is a constant, and demeaning takes it away whole.
    y, x = rows.table["y"].to_numpy() / mean, rows.columns / mean[:, None]
    whole = float(weight @ x[:, place] ** 2)
    if absorbed is not None:
        y, x = _demeaned(y[:, None], weight, units[absorbed])[:, 0], _demeaned(x, weight, units[absorbed])
    root = np.sqrt(weight)
    others = [k for k in range(x.shape[1]) if k != place]
    own, rest, y = x[:, place] * root, x[:, others] * root[:, None], y * root
    prior = np.diag([1e-6 if rows.names[k][0] == "effect" else VAGUE**-2 for k in others])
    solve = np.linalg.inv(rest.T @ rest + prior)

    def less(column: np.ndarray) -> np.ndarray:
        return column - rest @ (solve @ (rest.T @ column))

    left = less(own)
    power = float(own @ left)
    of_files = "set_up" if world.rig["mounted_anew"] else "file"
    cluster = units[{"sample": "run_id", "stroke": "file", "file": of_files}.get(unit, unit)]
    if unit == "sample" and np.unique(cluster).size < LEAST_RUNS:
        cluster = units["file"]
    count = int(cluster.max()) + 1
    lost = 2.0
    if unit in ("file", "run_id", "specimen_id"):
        total = np.sqrt(np.bincount(cluster, weight))
        means = np.stack([np.bincount(cluster, root * c) / total for c in rest.T], axis=1)
        inner = means.T @ means
        lost = 1 + float(np.trace(np.linalg.solve(inner + prior, inner)))
        lost += 0 if absorbed is None else int(units[absorbed].max())
    found = {"share": power / max(whole, 1e-300), "clusters": count, "df": count - lost}
    if power <= 1e-9 * whole:
        return {"z": 0.0, "z_expected": 0.0, "z_specimens": 0.0, **found}
    amplitude = float(left @ y) / power

    def z_of(size: float, cluster: np.ndarray, df: float) -> float:
        if df < 1:
            return 0.0
        score = np.bincount(cluster, left * (less(y) - amplitude * left))
        se = np.sqrt(float(score @ score) * (int(cluster.max()) + 1) / df) / power
        return _normal_z(size / max(se, 1e-300), df)

    z = {"z": z_of(1 + amplitude, cluster, count - lost), "z_expected": z_of(1.0, cluster, count - lost)}
    specimen = units["specimen_id"]
    by_specimens = z["z"] if unit == "specimen_id" else z_of(1 + amplitude, specimen, float(specimen.max()))
    return z | {"z_specimens": by_specimens} | found


def _normal_z(t: float, df: int) -> float:
    """Return the normal z of the same two-sided p as a t value; 37 where the p is no number any more."""
    p = 2 * stats.t.sf(abs(t), df)
    return float(np.sign(t) * (np.sqrt(stats.chi2.isf(min(1.0, p), 1)) if p > 1e-300 else 37.0))


def friction_N(rows: Rows, world: World) -> np.ndarray:
    """Return the true mean force less what effects add to it: what gains multiply."""
    added = [k for k in rows.effects if _adds_force(world.effects[rows.names[k][1]])]
    return rows.table["mean"].to_numpy() - rows.columns[:, added].sum(axis=1)


def _adds_force(effect: Effect) -> bool:
    return (effect.acts_on, effect.operation) == ("force", "add")


def _demeaned(x: np.ndarray, weight: np.ndarray, group: np.ndarray) -> np.ndarray:
    total = np.bincount(group, weight)
    return x - np.stack([(np.bincount(group, weight * c) / total)[group] for c in x.T], axis=1)


def error_at(world: World, rows: Rows, points: pd.DataFrame) -> np.ndarray:
    """Return the error of the fitted true form at points, N."""
    moved = {"_f1": force_at(world, points)}
    order = [*QUANTITIES, "sigma_0", *range(len(world.effects))]
    for k, name in enumerate(order):
        more = {"without": {name}} if isinstance(name, int) else {"nudge": {name: NUDGE}}
        moved[f"_f{k + 2}"] = force_at(world, points, **more)
    table = points[["series"]].assign(**moved)
    at = _columns(world, table, [f"_f{k + 2}" for k in range(len(order))], "_f1", rows.names)
    return at @ fitted(world, rows)[0]


def fitted(world: World, rows: Rows) -> tuple[np.ndarray, np.ndarray]:
    """Return d of the true form and its covariance, by generalised least squares.

    Scatter correlates the rows of a unit.
    """
    if rows.fit is None:
        rows.fit = _fitted(world, rows)
    return rows.fit


def _fitted(world: World, rows: Rows) -> tuple[np.ndarray, np.ndarray]:
    table, units, mean = rows.table, codes(rows), friction_N(rows, world)
    along = (table["distance_mm"] / world.rig["stroke_mm"] - 0.5).to_numpy()
    moved = {q: sum(rows.columns[:, k] for k, n in enumerate(rows.names) if n[0] == q) for q in QUANTITIES}
    gain = sum(
        moved[q] for q in GAIN
    )  # not the force itself: a larger friction bends the bristles further first
    level = world.rig["mean_N"] * table["direction"].to_numpy()
    bases = {
        "gain": gain,
        "level": level,
        "slope": gain * along,
        "v_s": moved["v_s"],
        "sigma_2": moved["sigma_2"],
    }
    terms = [(s["sd"] ** 2, bases[s["kind"]], units[UNIT[s["level"]]]) for s in world.scatter]
    wrong = world.files["_wrong"].to_numpy()[world.files["file"].searchsorted(table["file"])]
    terms.append((WRONG_GAIN**2, np.where(wrong, gain, 0.0), units["file"]))
    inner = np.diag([1e-6 if name[0] == "effect" else VAGUE**-2 for name in rows.names])
    right = np.zeros(rows.columns.shape[1])
    for block in blocks(units["specimen_id"], units["file"]):
        x, y = rows.columns[block], table["y"].to_numpy()[block]
        v = np.diag(rows.variance[block] + (SECOND_ORDER * mean[block]) ** 2)
        for variance, base, unit in terms:
            v += variance * np.outer(base[block], base[block]) * (unit[block][:, None] == unit[block])
        solved = cho_solve(cho_factor(v), np.column_stack([x, y]))
        inner += x.T @ solved[:, :-1]
        right += x.T @ solved[:, -1]
    covariance = np.linalg.pinv(inner, rcond=1e-14, hermitian=True)
    return covariance @ right, covariance


def blocks(specimen: np.ndarray, file: np.ndarray) -> list[np.ndarray]:
    """Return each specimen's rows; of one with many, in parts of whole files, as if of several specimens."""
    found = []
    for s in range(int(specimen.max()) + 1):
        rows = np.flatnonzero(specimen == s)
        rows = rows[np.argsort(file[rows], kind="stable")]
        start = np.r_[0, np.flatnonzero(np.diff(file[rows])) + 1]
        part = np.arange(rows.size) // MOST_ROWS
        of_file = np.maximum.accumulate(np.where(np.isin(np.arange(rows.size), start), part, 0))
        found += [rows[of_file == k] for k in np.unique(of_file)]
    return found
