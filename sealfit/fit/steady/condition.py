"""The model of one condition: the parameters of Eq. 14 that its speeds determine, and their fit."""

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import pandas as pd
from scipy.special import fdtrc

from sealfit.fit.least_squares import project
from sealfit.fit.steady import stribeck
from sealfit.fit.steady.stribeck import NAMES, StribeckFit, free_parameters, linearised
from sealfit.fit.steady.uncertainty import (
    POOLING_P,
    SpecimenPart,
    shifts_of,
    specimen_part,
    speed_levels,
)
from sealfit.ingest.strokes import speed_clusters
from sealfit.physics import stribeck_force

# Number of speed levels within one direction that each model needs.
FULL, VISCOUS, CONSTANT = 4, 2, 1
# Level of the test for a Stribeck curve.
SIGNIFICANT = 0.05
# Smallest chi-square that is divided by: exact forces leave none.
TINY = 1e-300
# Specimens that differ by a factor of all friction.
FRICTION = "friction"
# Parameters of each model.
COLUMNS = {FULL: NAMES, VISCOUS: ("mu_c", "sigma_2"), CONSTANT: ("mu_c",)}


@dataclass
class Condition:
    """One condition: its run means, and, once it is fitted, its model and estimates."""

    name: str
    runs: pd.DataFrame
    levels: dict[int, np.ndarray]
    has_load: bool
    left_out: int  # runs without load in a campaign with loads
    model: int  # FULL, VISCOUS or CONSTANT
    flat_p: float = np.nan
    values: np.ndarray | None = None  # (p,) in the order of COLUMNS[model]
    low: np.ndarray | None = None
    high: np.ndarray | None = None
    chi2: float = np.nan
    grid: np.ndarray | None = None
    specimens: dict[str, SpecimenPart] = field(default_factory=dict)  # by the name of what differs

    @cached_property
    def arrays(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """|v|, N (1 without load), F sgn v and weight of each run, shape (n,).

        With too few speeds for a Stribeck curve the weights are equal, with the same variance of the mean.
        """
        load = self.runs["load"].to_numpy(float) if self.has_load else np.ones(len(self.runs))
        speed, force, weight = (self.runs[name].to_numpy(float) for name in ("speed", "force", "weight"))
        if self.few_speeds:
            weight = np.full(len(weight), 1 / np.mean(1 / weight))
        return speed, load, force, weight

    @property
    def shifts(self) -> np.ndarray:
        """Change of F sgn v per run along principal directions of the effects' uncertainty, shape (n, k)."""
        return self.runs[shifts_of(self.runs)].to_numpy(float)

    @property
    def names(self) -> tuple[str, ...]:
        """Parameters of the model fitted."""
        return COLUMNS[self.model]

    @property
    def df(self) -> int:
        """Runs minus parameters; a parameter at its bound counts too, which makes intervals wider."""
        return max(len(self.runs) - len(self.names), 0)

    @property
    def chi2_within(self) -> float:
        """Chi-square of the runs without what differences between specimens explain."""
        return max(self.chi2 - sum(part.explained for part in self.specimens.values()), 0.0)

    @property
    def df_within(self) -> int:
        """Degrees of freedom of `chi2_within`."""
        return self.df - sum(part.df for part in self.specimens.values())

    def jacobian(self) -> np.ndarray:
        """Derivative of F sgn v with respect to the parameters, shape (n, p)."""
        speed, load, _, _ = self.arrays
        return stribeck.tangent(speed, load, self.values) if self.model == FULL else self.columns()

    def model_force(self) -> np.ndarray:
        """F sgn v of the fitted model at every run, shape (n,)."""
        speed, load, _, _ = self.arrays
        if self.model != FULL:
            return self.columns() @ self.values
        mu_s, mu_c, v_s, sigma_2 = self.values
        return stribeck_force(speed, load, mu_s=mu_s, mu_c=mu_c, v_s=v_s, sigma_2=sigma_2)

    @property
    def speeds(self) -> int:
        """Number of speed levels within one direction."""
        return max(len(values) for values in self.levels.values())

    @property
    def few_speeds(self) -> bool:
        """Whether the speeds are too few for a Stribeck curve."""
        return self.speeds < FULL

    def by_specimen(self, differs: str) -> np.ndarray:
        """Return the change of F sgn v per relative change of a specimen's number, shape (n, specimens).

        `differs` is the number: `FRICTION`, all friction, or the name of a parameter.
        """
        if differs == FRICTION:
            change = self.model_force()
        elif differs in self.names:
            place = self.names.index(differs)
            change = self.jacobian()[:, place] * self.values[place]
        else:
            change = np.zeros(len(self.runs))
        code, names = pd.factorize(self.runs["specimen"])
        return np.where(code[:, None] == np.arange(len(names)), change[:, None], 0.0)

    def run_levels(self) -> np.ndarray:
        """Direction and speed level of every run, shape (n, 2)."""
        direction, speed = self.runs["direction"].to_numpy(int), self.arrays[0]
        levels = [self.levels.get(way, self.levels[max(self.levels)]) for way in direction]
        nearest = [own[np.argmin(np.abs(np.log(own / v)))] for own, v in zip(levels, speed, strict=True)]
        return np.column_stack([direction, nearest])

    def columns(self) -> np.ndarray:
        """Columns of the model without Stribeck curve, shape (n, p)."""
        speed, load, _, _ = self.arrays
        return np.stack([load, speed], axis=1) if self.model == VISCOUS else load[:, None]


def make_condition(name: str, runs: pd.DataFrame) -> Condition:
    """Return a condition with the fullest model that its speeds determine; `runs` are means with `weight`."""
    loaded = runs["load"].notna().to_numpy()
    has_load = bool(loaded.any())
    kept = runs[loaded] if has_load and not loaded.all() else runs
    levels = speed_levels(kept)
    most = max(len(values) for values in levels.values())
    model = FULL if most >= FULL else VISCOUS if most >= VISCOUS else CONSTANT
    return Condition(str(name), kept.reset_index(drop=True), levels, has_load, len(runs) - len(kept), model)


def scatter_of_runs(conditions: list[Condition]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return chi-square of run means, its degrees of freedom, and whether it is scatter, (conditions,) each.

    Conditions with too few speeds for a Stribeck curve also show how the force changes from speed to speed.
    Where several have the same speeds, the model of each is multiplied by one factor per speed and direction,
    common to all. Where too few have, chi-square is no scatter, unless no other condition shows any.
    """
    chi2, df = np.array([(c.chi2_within, c.df_within) for c in conditions], float).T
    few = [k for k, c in enumerate(conditions) if c.model == VISCOUS and c.few_speeds and c.values[0] > 0]
    scatter = np.ones(len(conditions), dtype=bool)
    if not few:
        return chi2, df, scatter
    cells = {k: conditions[k].run_levels() for k in few}
    slowest = [part[0] for part in speed_clusters(np.unique(np.concatenate(list(cells.values()))[:, 1]))]
    groups: dict[frozenset, list[int]] = {}
    for k, cell in cells.items():
        cell[:, 1] = np.searchsorted(slowest, cell[:, 1], side="right")
        groups.setdefault(frozenset(map(tuple, cell)), []).append(k)
    for same, group in groups.items():
        own = [conditions[k] for k in group]
        free = np.array([len(c.runs) - np.count_nonzero(c.values) for c in own], float)
        spare = free.sum() - (len(same) - 1)
        if spare <= 0:
            scatter[group] = False
            continue
        model = np.concatenate([c.model_force() for c in own])
        force, weight = (np.concatenate([c.arrays[k] for c in own]) for k in (2, 3))
        _, cell = np.unique(np.concatenate([cells[k] for k in group]), axis=0, return_inverse=True)
        factor = np.bincount(cell, weight * model * force) / np.bincount(cell, weight * model**2)
        left = weight * (force - factor[cell] * model) ** 2
        total = np.bincount(np.repeat(np.arange(len(own)), [len(c.runs) for c in own]), left)
        explained, between = np.array([(c.chi2 - c.chi2_within, c.df - c.df_within) for c in own]).T
        chi2[group] = np.maximum(total - explained, 0.0)
        df[group] = free * spare / free.sum() - between
    return chi2, df, scatter if df[scatter].any() else np.ones_like(scatter)


def find_specimens(conditions: list[Condition]) -> None:
    """Set what differences between specimens explain: of all friction, and of v_s and sigma_2 if they differ.

    Specimens with one run each cannot be distinguished from runs: they explain nothing.
    """
    for differs in (FRICTION, "v_s", "sigma_2"):
        parts = [_specimen_part(c, differs) for c in conditions]
        found = [(c, part) for c, part in zip(conditions, parts, strict=True) if 0 < part.df < c.df_within]
        explained, df = (sum(getattr(part, name) for _, part in found) for name in ("explained", "df"))
        rest = max(sum(c.chi2_within for c, _ in found) - explained, TINY)
        rest_df = sum(c.df_within for c, _ in found) - df
        if df and (differs == FRICTION or fdtrc(df, rest_df, explained / df * rest_df / rest) <= POOLING_P):
            for condition, part in found:
                condition.specimens[differs] = part


def _specimen_part(condition: Condition, differs: str) -> SpecimenPart:
    """Return what specimens explain beyond the model and what they are known to explain.

    With few speeds the model of the condition has one factor per speed, direction and load.
    """
    if condition.few_speeds:
        load = condition.arrays[1]
        loads = [part[0] for part in speed_clusters(np.unique(load))]  # loads that differ by more than 25 %
        cells = np.column_stack([condition.run_levels(), np.searchsorted(loads, load, side="right")])
        _, cell = np.unique(cells, axis=0, return_inverse=True)
        model = np.eye(cell.max() + 1)[cell] * condition.model_force()[:, None]
    else:
        model = condition.jacobian()[:, free_parameters(condition.names, condition.values)]
    model = np.hstack([model, *map(condition.by_specimen, condition.specimens)])
    root = np.sqrt(condition.arrays[3])
    residual = root * (condition.arrays[2] - condition.model_force())
    return specimen_part(root[:, None] * model, root[:, None] * condition.by_specimen(differs), residual)


@dataclass(frozen=True)
class SpecimenScatter:
    """The relative variances of what differs between specimens."""

    variances: dict[str, float]
    df: int  # 0 if unknown
    single: bool  # whether each condition has one specimen

    @property
    def sd_pct(self) -> float:
        """Standard deviation of the friction of specimens in %; NaN if unknown."""
        return 100 * float(np.sqrt(self.variances.get(FRICTION, np.nan)))

    @property
    def remark(self) -> str:
        """What the intervals contain of it."""
        if self.single:
            return "one per condition; the intervals hold for those tested."
        if not self.df:
            return ""
        others = " and of ".join(name for name in self.variances if name != FRICTION)
        others = others and f" and that of {others}"
        return f"scatter of friction; the intervals contain it{others} ({self.df} degrees of freedom)."

    def variance_of(self, condition: Condition) -> np.ndarray:
        """Return the variance that the scatter of specimens gives to the parameters, shape (p,)."""
        own = [np.sqrt(value) * condition.by_specimen(name) for name, value in self.variances.items()]
        if not own:
            return np.zeros(len(condition.names))
        jacobian, weight, moved = condition.jacobian(), condition.arrays[3], np.hstack(own)
        # The interval of a parameter at its limit is that of a free one.
        fixed, free = (
            linearised(jacobian, weight, values, condition.names, moved)[1]
            for values in (condition.values, np.ones(len(condition.names)))
        )
        changes = np.where(condition.values[:, None] == 0.0, free, fixed)
        return (changes**2).sum(axis=1)


def specimen_scatter(conditions: list[Condition], unit: np.ndarray) -> SpecimenScatter:
    """Return the scatter of specimens, pooled over conditions.

    `unit`, shape (conditions,), are the factors on the variances stated by the weights. With few speeds it is
    what one factor per speed, direction and load leaves, if known: the model has no Stribeck curve. Henderson
    1953, Biometrics 9(2), 226-252, doi:10.2307/3001853, method 3.
    """
    variances, df = {}, 0
    for differs in dict.fromkeys(name for c in conditions for name in c.specimens):
        found = [(c, value) for c, value in zip(conditions, unit, strict=True) if differs in c.specimens]
        by_cell = [c.specimens[differs] for c, _ in found if c.few_speeds]
        rest_df = sum(part.rest_df for part in by_cell)
        rest = sum(part.rest for part in by_cell) / rest_df if rest_df else np.nan
        parts = [(c.specimens[differs], rest if c.few_speeds and rest_df else u) for c, u in found]
        excess = sum(part.explained - part.df * value for part, value in parts)
        variances[differs] = max(excess / sum(part.expected for part, _ in parts), 0.0)
        df = df or sum(part.df for part, _ in parts)
    single = all(c.runs["specimen"].nunique() == 1 for c in conditions)
    return SpecimenScatter(variances, df, single)


def stacked(conditions: list[Condition]) -> tuple[np.ndarray, ...]:
    """Arrays of several conditions padded to one length; padding has weight 0."""
    longest = max(len(c.runs) for c in conditions)
    filled = [np.ones((len(conditions), longest)) for _ in range(3)] + [np.zeros((len(conditions), longest))]
    for k, condition in enumerate(conditions):
        for target, values in zip(filled, condition.arrays, strict=True):
            target[k, : len(values)] = values
    return tuple(filled)


def solve(conditions: list[Condition]) -> None:
    """Fit every condition's model, those with a Stribeck curve all at once."""
    full = [c for c in conditions if c.model == FULL]
    if full:
        fit = stribeck.solve_stribeck(*stacked(full))
        for condition, values, rss, grid in zip(full, fit.values, fit.rss, fit.grid, strict=True):
            condition.values, condition.chi2, condition.grid = values, float(rss), grid
    for condition in conditions:
        if condition.model != FULL:
            _solve_linear(condition)


def _solve_linear(condition: Condition) -> None:
    _, _, force, weight = condition.arrays
    root = np.sqrt(weight)
    nonnegative = [True] * len(condition.names)
    condition.values, chi2 = project(condition.columns() * root[:, None], force * root, nonnegative)
    condition.chi2 = float(chi2)


def drop_flat_curve(condition: Condition, unit: float, df: float) -> None:
    """Drop mu_s and v_s from the model unless a test rejects mu_s = mu_c."""
    speed, _, _, weight = condition.arrays
    full, chi2 = condition.values, condition.chi2
    condition.model = VISCOUS
    _solve_linear(condition)
    if np.isfinite(unit) and unit > 0:
        columns = condition.columns()[:, : 2 if condition.values[1] > 0 else 1]
        gain = (condition.chi2 - chi2) / unit
        condition.flat_p = stribeck.flat_p_value(speed, columns, weight, condition.grid, gain, df)
    if not condition.flat_p >= SIGNIFICANT:
        condition.model, condition.values, condition.chi2 = FULL, full, chi2


def bound(conditions: list[Condition], rise: np.ndarray) -> None:
    """Set the ends of the intervals; `rise`, shape (conditions,), is that of chi-square at the ends."""
    full = [k for k, c in enumerate(conditions) if c.model == FULL and np.isfinite(rise[k])]
    if full:
        arrays = stacked([conditions[k] for k in full])
        values, chi2 = (np.array([getattr(conditions[k], name) for k in full]) for name in ("values", "chi2"))
        fit = StribeckFit(values, chi2, stribeck.search_grid(arrays[0], arrays[3]))
        lows, highs = stribeck.stribeck_intervals(*arrays, fit, rise[full])
        for k, low, high in zip(full, lows, highs, strict=True):
            conditions[k].low, conditions[k].high = low, high
    for condition, allowed in zip(conditions, rise, strict=True):
        if condition.model != FULL and np.isfinite(allowed):
            _, _, force, weight = condition.arrays
            root = np.sqrt(weight)
            columns = (condition.columns() * root[:, None])[None, None]
            limit, nonnegative = np.array([condition.chi2 + allowed]), [True] * len(condition.names)
            y = (force * root)[None, None]
            low, high = stribeck.constrained_ends(columns, y, limit, nonnegative)
            condition.low, condition.high = low[0, 0], high[0, 0]


def judge(condition: Condition) -> dict[str, tuple[bool, str]]:
    """Return per parameter whether the data determine it, and a remark."""
    verdict = _judge_form(condition)
    if condition.low is None and condition.model != FULL:
        why_not = "no repeats and no spare run: no interval."
        verdict = {name: (known, why or why_not) for name, (known, why) in verdict.items()}
    zero = {name for name, value in zip(condition.names, condition.values, strict=True) if value == 0.0}
    if "sigma_2" in zero:
        at_zero = "at its physical limit 0: this Stribeck curve leaves no rise; faster speeds would show one."
        # A Stribeck curve that falls may hide a rise; few speeds do not show it.
        verdict["sigma_2"] = verdict["v_s"] if condition.few_speeds else (verdict["sigma_2"][0], at_zero)
    for name in zero & {"mu_s", "mu_c"}:
        verdict[name] = (False, "at its physical limit 0: these runs show no friction that it could be.")
    against = int((condition.runs["force"] < 0).sum())
    if against:
        remark = f"{against} runs have a force along the motion: check the sign of force or displacement."
        verdict["mu_c"] = (verdict["mu_c"][0], f"{verdict['mu_c'][1]} {remark}".strip())
    return verdict


def _judge_form(condition: Condition) -> dict[str, tuple[bool, str]]:
    """Return the same from the form of the model alone."""
    verdict = dict.fromkeys(NAMES, (True, ""))
    if condition.model == CONSTANT:
        lone = "one speed only in each direction: these runs determine the sliding coefficient at that speed."
        verdict |= {name: (False, lone) for name in ("mu_s", "v_s", "sigma_2")}
        verdict["mu_c"] = (True, "the sliding coefficient at the one speed tested, sigma_2 v included.")
    elif condition.model == VISCOUS and condition.few_speeds:
        few = f"{condition.speeds} speeds in one direction: "
        few += "the Stribeck curve needs four, two of them below about 2 v_s."
        verdict |= {name: (False, few) for name in ("mu_s", "v_s")}
        viscous = condition.values[condition.names.index("sigma_2")] > 0.0
        meaning = "of a straight line through" if viscous else "the mean coefficient over"
        verdict["mu_c"] = (True, f"{meaning} these speeds, which are too few for a Stribeck curve.")
    elif condition.model == VISCOUS:
        flat = f"mu_s = mu_c is not rejected (p = {condition.flat_p:.2g}): no Stribeck curve is seen"
        verdict["mu_s"] = (False, f"{flat}, mu_s is mu_c.")
        verdict["v_s"] = (False, f"{flat}, so v_s has no meaning.")
        verdict["mu_c"] = (True, "of the fit without Stribeck curve; mu_s = mu_c is not rejected.")
    elif condition.low is None:
        unknown = "as many parameters as runs and no repeats: nothing shows how far to trust it."
        verdict |= {name: (False, unknown) for name in NAMES}
    else:
        verdict |= _judge_curve(condition)
    return verdict


def _judge_curve(condition: Condition) -> dict[str, tuple[bool, str]]:
    mu_s, mu_c, v_s, _ = condition.values
    low, high = condition.low, condition.high
    below = max(int((values < 2 * v_s).sum()) for values in condition.levels.values())
    verdict = {"mu_s": (True, "mu_s < mu_c: friction rises from rest.") if mu_s < mu_c else (True, "")}
    if low[2] == 0.0:
        verdict["v_s"] = (False, f"any v_s up to {high[2]:.3g} fits: slower speeds are needed.")
        verdict["mu_s"] = (False, "v_s may lie below the slowest speed, and mu_s then may be anything.")
    elif np.isinf(high[2]):
        verdict["v_s"] = (False, f"any v_s from {low[2]:.3g} up fits: faster speeds are needed.")
    elif below < 2:
        few = "no speed lies" if below == 0 else "one speed lies"
        verdict["v_s"] = (False, f"{few} below 2 v_s = {2 * v_s:.3g} in one direction: two are needed.")
    if low[1] == 0.0:
        verdict["mu_c"] = (False, "no speed is fast enough to see mu_c without mu_s: it may be zero.")
    return verdict
