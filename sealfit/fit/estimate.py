r"""One estimator for "before" and "after": generalised least squares with scatter at every level.

The weights come from the variance components (`mixed.py`), which are estimated from the residual with the degrees of
freedom of the model taken out; model and scatter are fitted in turn until neither moves. v_s and b carry a weak
Gaussian prior on their logarithm (SD 3, a factor of 20) about the global search's value: it holds a number that the
data do not determine, and is far weaker than any data that do.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.optimize import nnls

from sealfit.fit.joint import LOGARITHMIC, SAME_SPEED, JointParameter, Model, declare, evaluate
from sealfit.fit.mixed import Component, Scatter, reml, whiten
from sealfit.fit.rows import LEVELS, Rows

PRIOR_SD = 3.0
LEAST_NOISE = 1e-6  # of the force: below what any sensor resolves; keeps noise-free data from weights without end
MAX_STEPS = 60
STRIBECK_GRID = 24  # points of log v_s tried when an effect has come in
CREEPING = 1e-2  # several such steps in a row go along a valley in which the data hold nothing
SETTLED = 1e-4  # of the whitened sum of squares: the estimates then lie within a hundredth of a standard error
TURNS = 3  # of model and scatter; the third moves no estimate by a tenth of its standard error


@dataclass(frozen=True)
class Fitted:
    """A model fitted to rows: force and tangent at the optimum, scatter, and the whitened residual and tangent."""

    model: Model
    scatter: Scatter
    rows: Rows
    force: np.ndarray  # (n,)
    jacobian: np.ndarray  # (n, p)
    white_residual: np.ndarray  # (n,)
    white_jacobian: np.ndarray  # (n, p)
    deviance: float  # whitened sum of squares + log det: twice the negative log likelihood, constants left out

    @property
    def residual(self) -> np.ndarray:
        """Measured minus model, shape (n,)."""
        return self.rows.force - self.force

    @cached_property
    def basis(self) -> np.ndarray:
        """Orthonormal basis of the whitened tangent space, shape (n, rank)."""
        scale = np.maximum(np.linalg.norm(self.white_jacobian, axis=0), 1e-300)
        q, r = np.linalg.qr(self.white_jacobian / scale)
        return q[:, np.abs(np.diag(r)) > 1e-8]

    @cached_property
    def _widened(self) -> dict[str, np.ndarray]:
        return {}

    def unit_residual(self, level: str) -> np.ndarray:
        """Return the whitened residual widened by (I - H_gg)^(-1/2) in each group of a level, shape (n,).

        H_gg is the group's block of the projection on the tangent space: what the fit took out of the group
        (the CR2 correction of Bell & McCaffrey 2002, Survey Methodology 28(2), 169-181).
        """
        if level not in self._widened:
            starts = self.rows.groups.starts[level]
            code = self.rows.codes(level)
            gram = (
                np.add.reduceat(self.basis[:, :, None] * self.basis[:, None, :], starts, axis=0)
                if (self.basis.size * self.basis.shape[1] < 3e7)
                else np.stack([part.T @ part for part in np.split(self.basis, starts[1:])])
            )
            size, axes = np.linalg.eigh(gram)
            size = np.clip(size, 0.0, 0.98)  # a group that the fit owns whole has nothing left to widen
            grow = np.where(size > 1e-12, (1 / np.sqrt(1 - size) - 1) / np.maximum(size, 1e-12), 0.0)
            inner = np.add.reduceat(self.basis * self.white_residual[:, None], starts, axis=0)
            rotated = np.einsum("gji,gj->gi", axes, inner) * grow
            back = np.einsum("gij,gj->gi", axes, rotated)
            self._widened[level] = self.white_residual + (self.basis * back[code]).sum(axis=1)
        return self._widened[level]

    @cached_property
    def covariance(self) -> np.ndarray:
        """Covariance of all fitted numbers (v_s and b as logarithms), shape (p, p)."""
        return covariance_of(self.white_jacobian, prior_precision(self.model))


def covariance_of(white_jacobian: np.ndarray, precision: np.ndarray) -> np.ndarray:
    """Return the covariance of parameters from a whitened tangent, shape (n, p), and a diagonal prior precision."""
    normal = white_jacobian.T @ white_jacobian + np.diag(precision)
    scale = 1.0 / np.sqrt(np.maximum(np.diag(normal), 1e-300))
    return scale[:, None] * np.linalg.pinv(normal * np.outer(scale, scale), rcond=1e-12, hermitian=True) * scale


def prior_precision(model: Model) -> np.ndarray:
    """Return the prior's precision per fitted number: 1/3^2 on log v_s and log b, none elsewhere, shape (p,)."""
    own = [1.0 / PRIOR_SD**2 if p.quantity in LOGARITHMIC else 0.0 for p in model.declared.parameters]
    return np.r_[own, np.zeros(model.size - len(own))]


def fit_declared(rows: Rows) -> Fitted:
    """Return the declared model fitted to `rows`: "before"."""
    return fit(start_model(rows), rows)


def fit(
    model: Model,
    rows: Rows,
    scatter: Scatter | None = None,
    *,
    turns: int = TURNS,
    loading: np.ndarray | None = None,
) -> Fitted:
    """Return the model fitted to `rows`, physics and effects together.

    Parameters
    ----------
    model : Model
        Where to start; a global search has set v_s and b.
    rows : Rows
        What to fit to.
    scatter : Scatter, optional
        Scatter to start from; with `turns=0` it is kept.
    turns : int
        How often scatter is estimated anew and the model refitted.
    loading : ndarray, shape (n,), optional
        Force that gains and noise load on, where `turns` is 0: fits to be compared must share it.
    """
    centre = model.vector()
    if scatter is None:
        scatter = Scatter(s0=max(float(np.std(rows.force)) * 0.01, 1e-12), g=0.0)
        model = _descend(model, rows, scatter, centre)
    if turns and model.terms:
        model = _search_stribeck(model, rows, scatter)
    for turn in range(turns):
        force, jacobian = evaluate(model, rows)
        scatter = estimate_scatter(rows, force, jacobian, scatter if turn else None)
        model = _descend(model, rows, scatter, centre)
    if not turns:
        model = _descend(model, rows, scatter, centre, loading)
        return fitted_at(model, rows, scatter, loading)
    return fitted_at(model, rows, scatter)


def fitted_at(model: Model, rows: Rows, scatter: Scatter, loading: np.ndarray | None = None) -> Fitted:
    """Return the `Fitted` of a model as it stands, nothing refitted."""
    force, jacobian = evaluate(model, rows)
    load = force if loading is None else loading
    white, logdet = whiten(
        np.column_stack([rows.force - force, jacobian]), scatter.noise_sd(load), load, rows.groups, scatter.components
    )
    residual = white[:, 0]
    return Fitted(model, scatter, rows, force, jacobian, residual, white[:, 1:], float(residual @ residual) + logdet)


def _search_stribeck(model: Model, rows: Rows, scatter: Scatter) -> Model:
    """Return the model with each v_s at the best point of a grid, everything linear solved anew at each.

    What an effect explains may have stood in v_s before, and the way out of there can lead over a hill.
    """
    slowest, fastest = stribeck_range(np.abs(rows.groups.means(rows.speed, "stroke")))
    held = prior_precision(model) > 0
    for k, parameter in enumerate(model.declared.parameters):
        if parameter.quantity != "v_s":
            continue
        best, chosen = np.inf, model.vector()
        for value in (model.theta[k], *np.linspace(np.log(slowest), np.log(fastest), STRIBECK_GRID)):
            vector = model.vector()
            vector[k] = value
            force, jacobian = evaluate(model.at(vector), rows)
            columns = np.column_stack([rows.force - force, jacobian[:, ~held]])
            white, _ = whiten(columns, scatter.noise_sd(rows.force), rows.force, rows.groups, scatter.components)
            step, *_ = np.linalg.lstsq(white[:, 1:].T @ white[:, 1:], white[:, 1:].T @ white[:, 0], rcond=1e-10)
            cost = float(white[:, 0] @ white[:, 0] - step @ (white[:, 1:].T @ white[:, 0]))
            if cost < best - 1e-9:
                vector[~held] += step
                best, chosen = cost, vector
        model = model.at(chosen)
    return model


def _descend(
    model: Model, rows: Rows, scatter: Scatter, centre: np.ndarray, loading: np.ndarray | None = None
) -> Model:
    """Return the model at the least whitened sum of squares, by Levenberg-Marquardt with the scatter held fixed."""
    precision = prior_precision(model)
    low, high = _bounds(model, rows)
    vector = np.clip(model.vector(), low, high)
    model = model.at(vector)
    force, jacobian = evaluate(model, rows)
    loading = force if loading is None else loading  # held, so that the criterion does not move under the search
    sd = scatter.noise_sd(loading)

    def white_of(columns: np.ndarray) -> np.ndarray:
        return whiten(columns, sd, loading, rows.groups, scatter.components)[0]

    def cost_of(residual: np.ndarray, at: np.ndarray) -> float:
        return float(residual @ residual + precision @ (at - centre) ** 2)

    residual = white_of((rows.force - force)[:, None])[:, 0]
    cost = cost_of(residual, vector)
    damping, crept = 1e-4, 0
    for _ in range(MAX_STEPS):
        white = white_of(jacobian)
        gradient = white.T @ residual - precision * (vector - centre)
        normal = white.T @ white + np.diag(precision)
        blocked = ((vector <= low) & (gradient < 0)) | ((vector >= high) & (gradient > 0))
        free = ~blocked & (np.diag(normal) > 0)
        scale = np.sqrt(np.diag(normal)[free])
        scaled = normal[np.ix_(free, free)] / np.outer(scale, scale)
        for _ in range(12):
            move = np.zeros_like(vector)
            move[free] = (
                np.linalg.solve(scaled + (damping + 1e-12) * np.eye(scale.size), gradient[free] / scale) / scale
            )
            trial = np.clip(vector + move, low, high)
            trial_model = model.at(trial)
            trial_force, _none = evaluate(trial_model, rows, jacobian=False)
            trial_residual = white_of((rows.force - trial_force)[:, None])[:, 0]
            trial_cost = cost_of(trial_residual, trial)
            if np.isfinite(trial_cost) and trial_cost <= cost:
                break
            damping = max(damping, 1e-6) * 8
        else:
            return model
        gain = cost - trial_cost
        vector, model, residual, cost = trial, trial_model, trial_residual, trial_cost
        damping /= 10
        crept = crept + 1 if gain < CREEPING else 0
        if crept > 3 or (gain < SETTLED and damping < 1e-3):  # a step under heavy damping gains little anywhere
            return model
        _, jacobian = evaluate(model, rows)
    return model


def _bounds(model: Model, rows: Rows) -> tuple[np.ndarray, np.ndarray]:
    slowest, fastest = stribeck_range(np.abs(rows.groups.means(rows.speed, "stroke")))
    days = rows.days[rows.days > 0]
    first, last = (days.min(), days.max()) if days.size else (1.0, 1.0)
    limits = {
        "v_s": (np.log(slowest), np.log(fastest)),
        "b_s": (np.log(first / 1000), np.log(last * 30)),
        "b_c": (np.log(first / 1000), np.log(last * 30)),
    }
    low = [limits.get(p.quantity, (-np.inf, np.inf))[0] for p in model.declared.parameters]
    high = [limits.get(p.quantity, (-np.inf, np.inf))[1] for p in model.declared.parameters]
    for term in model.terms:
        low += [p.bounds[0] for p in term.effect.parameters]
        high += [p.bounds[1] for p in term.effect.parameters]
    return np.array(low, dtype=float), np.array(high, dtype=float)


def stribeck_range(speeds: np.ndarray) -> tuple[float, float]:
    """Return where v_s is looked for: from half the second slowest speed to the fastest.

    Below that range only the slowest speed would see mu_s, which could then be any size; above it the exponential is a
    parabola that sigma_2 and mu_c make as well (v_s needs two speeds below about 2 v_s).
    """
    positive = np.sort(speeds[speeds > 0])
    above = positive[positive > SAME_SPEED * positive[0]]
    second = above[0] if above.size else positive[0]
    return float(second / 2), float(positive[-1])


# ---------------------------------------------------------------- where to start
def start_model(rows: Rows) -> Model:
    """Return the declared model with v_s and b from a global search and the rest from exact least squares."""
    declared = declare(rows)
    theta = np.zeros(len(declared.parameters))
    number = {p: k for k, p in enumerate(declared.parameters)}
    speeds = np.abs(rows.groups.means(rows.speed, "stroke"))
    at = rows.groups.starts["stroke"]
    condition = rows.condition[at]
    load = rows.groups.means(rows.load, "stroke")
    size = rows.groups.means(rows.force * np.sign(rows.speed), "stroke")
    series = sorted({p.owner for p in declared.parameters if p.quantity in ("v_s", "sigma_2")})
    level = np.zeros((len(declared.conditions), 2))  # mu_s, mu_c of each condition
    chosen = np.zeros(len(declared.conditions), dtype=bool)
    for name in series:
        k = number.get(JointParameter("sigma_2", name), number.get(JointParameter("v_s", name)))
        uses = (declared.index["sigma_2"] == k) | (declared.index["v_s"] == k)
        mine = uses[condition]
        full = JointParameter("v_s", name) in number
        values, sigma_2, v_s = _per_condition(speeds[mine], load[mine], size[mine], condition[mine], full)
        for c, pair in values.items():
            level[c], chosen[c] = pair, True
        theta[k if not full else number[JointParameter("sigma_2", name)]] = sigma_2
        if full:
            theta[number[JointParameter("v_s", name)]] = np.log(v_s)
    for c in np.flatnonzero(~chosen):
        mine = condition == c
        level[c] = np.mean(size[mine] / load[mine])
    days = rows.conditions["aging_days"].to_numpy()
    for column, end in ((0, "s"), (1, "c")):
        index_0, index_a, index_b = (
            declared.index[f"{q}_{end}" if q != "mu_0" else f"mu_0{end}"] for q in ("mu_0", "a", "b")
        )
        for k in np.unique(index_0[(index_0 >= 0)]):
            mine = index_0 == k
            unaged = mine & (days == days[mine].min())
            theta[k] = level[unaged, column].mean()
        for k in np.unique(index_a[index_a >= 0]):
            mine = index_a == k
            mu_0 = theta[index_0[mine][0]]
            drop = mu_0 - level[mine, column]
            grid = np.geomspace(days[days > 0].min() / 100, days.max() * 3, 60)
            log = np.log1p(days[mine][:, None] / grid)
            a = (log * drop[:, None]).sum(0) / np.maximum((log**2).sum(0), 1e-300)
            best = int(np.argmin(((drop[:, None] - a * log) ** 2).sum(0)))
            theta[k] = a[best]
            theta[index_b[mine][0]] = np.log(grid[best])
    return Model(declared, theta)


def _per_condition(speed, load, size, condition, full: bool):
    """Return {condition: (mu_s, mu_c)}, sigma_2 and v_s of one series by a grid over v_s, the rest exact."""
    own = np.unique(condition)
    inside = (condition[:, None] == own[None, :]).astype(float) * load[:, None]
    grid = np.geomspace(*stribeck_range(speed), 80) if full else np.array([1.0])
    best, answer = np.inf, None
    for v_s in grid:
        decay = np.exp(-((speed / v_s) ** 2)) if full else np.zeros_like(speed)
        parts = [inside * (1 - decay)[:, None], speed[:, None]]
        if full:
            parts.insert(0, inside * decay[:, None])
        columns = np.column_stack(parts)
        solution, *_ = np.linalg.lstsq(columns, size, rcond=1e-10)
        cost = float(((size - columns @ solution) ** 2).sum())
        if cost < best:
            best, answer = cost, (solution, v_s)
    solution, v_s = answer
    mu_s = solution[: own.size]
    mu_c = solution[own.size : 2 * own.size] if full else solution[: own.size]
    return {int(c): (s, k) for c, s, k in zip(own, mu_s, mu_c, strict=True)}, float(solution[-1]), float(v_s)


# ---------------------------------------------------------------- scatter
def estimate_scatter(rows: Rows, force: np.ndarray, jacobian: np.ndarray, start: Scatter | None = None) -> Scatter:
    """Return row noise and variance components of the residual at a model, its degrees of freedom taken out.

    Parameters
    ----------
    rows, force, jacobian
        The rows, the model's force there, shape (n,), and its tangent, shape (n, p).
    start : Scatter, optional
        An earlier estimate, to start from.
    """
    residual = rows.force - force
    s0, g, inflation = row_noise(rows, residual, force)
    groups, level = rows.groups, "stroke"
    means = groups.means(np.column_stack([residual, force, jacobian]), level)
    noise = groups.means(s0**2 + (g * force) ** 2, level)
    count = np.diff(np.r_[groups.starts[level], residual.size])
    small = groups.at(level)
    kinds = usable_components(rows)
    known = {} if start is None else {(c.level, c.kind): c.variance for c in start.components}
    components = reml(
        means[:, 0],
        means[:, 2:],
        noise * inflation / count,
        means[:, 1],
        small,
        kinds,
        [known.get(kind, 0.0) for kind in kinds] if known else None,
    )
    inflated = np.sqrt(inflation)
    return Scatter(s0 * inflated, g * inflated, tuple(replace(c, df=_df(rows, c)) for c in components))


def usable_components(rows: Rows) -> list[tuple[str, str]]:
    """Return the (level, kind) of random effects that these groups can tell apart, finest level first."""
    counts = {level: rows.groups.starts[level].size for level in LEVELS}
    used, finer = [], None
    for level in LEVELS:
        if finer is None:
            if counts[level] > counts["file"] or level != "stroke":
                used.append(level)
                finer = level
        elif counts[level] < counts[finer] and counts[level] > 2:
            used.append(level)
            finer = level
    if used and used[-1] == "specimen" and not _specimens_free(rows):
        used.pop()
    both = rows.speed.min() < 0 < rows.speed.max() or np.ptp(np.abs(rows.force)) > 0.2 * np.abs(rows.force).max()
    kinds = {level: ("offset", "gain") if both else ("offset",) for level in used}
    if both and "specimen" in kinds:
        kinds["specimen"] = ("gain",)  # a piece of rubber has a friction of its own, not a zero of the sensor
    return [(level, kind) for level in used for kind in kinds[level]]


def _specimens_free(rows: Rows) -> bool:
    """Whether specimens scatter about something: replicate specimens of a condition, or a law across conditions."""
    specimens = rows.groups.starts["specimen"].size
    declared = declare(rows)
    levels = len([p for p in declared.parameters if p.quantity in ("mu_0c", "a_c", "b_c")])
    return specimens - levels >= 2


def _df(rows: Rows, component: Component) -> float:
    order = list(LEVELS)
    counts = [rows.groups.starts[level].size for level in order]
    at = order.index(component.level)
    above = [counts[k] for k in range(at + 1, len(order)) if counts[k] < counts[at]]
    return float(counts[at] - (above[0] if above else 1))


def row_noise(rows: Rows, residual: np.ndarray, force: np.ndarray) -> tuple[float, float, float]:
    """Return (s0, g, inflation): row noise sqrt(s0^2 + (gF)^2) inside strokes, and how correlation widens a mean.

    What the strokes have in common at a bin is not noise and is taken out first.
    """
    groups = rows.groups
    code, start = groups.codes["stroke"], groups.starts["stroke"]
    count = np.diff(np.r_[start, residual.size])
    inside = residual - groups.means(residual, "stroke")[code]
    place = np.arange(residual.size) - start[code]
    if start.size >= 8:
        pattern_n = np.bincount(place)
        sign = np.sign(rows.speed)
        for part in (np.ones_like(sign), sign):
            pattern = np.bincount(place, inside * part) / np.maximum(pattern_n, 1)
            inside = inside - np.where(pattern_n >= 5, pattern, 0.0)[place] * part
    size = np.abs(groups.means(force, "stroke"))
    long = count >= 3
    if not long.any():
        return max(float(np.std(residual)), 1e-9), 0.0, 1.0
    variance = np.add.reduceat(inside**2, start)[long] / (count[long] - 1)
    floor = (LEAST_NOISE * float(np.sqrt(np.mean(force**2)))) ** 2 + 1e-300
    columns = np.column_stack([np.ones(long.sum()), size[long] ** 2])
    weight = np.sqrt(count[long])
    guess = np.full(long.sum(), float(np.mean(variance)) + floor)
    for _ in range(4):
        scaled = columns / guess[:, None] * weight[:, None]
        norm = np.linalg.norm(scaled, axis=0) + 1e-300
        answer, _ = nnls(scaled / norm, (variance + floor) / guess * weight)
        answer = answer / norm
        guess = np.maximum(columns @ answer, floor)
    return float(np.sqrt(max(answer[0], floor))), float(np.sqrt(answer[1])), _inflation(inside, code, start, count)


def _inflation(inside: np.ndarray, code: np.ndarray, start: np.ndarray, count: np.ndarray) -> float:
    """Return 1 + 2 sum of autocorrelations over bins, cut at the first one that is not positive."""
    scale = np.sqrt(np.maximum(np.add.reduceat(inside**2, start) / count, 1e-300))[code]
    unit = inside / scale
    total, inflation = max(float((unit**2).mean()), 1e-300), 1.0
    for lag in range(1, max(2, int(count.min()) // 3)):
        same = code[lag:] == code[:-lag]
        rho = float((unit[lag:] * unit[:-lag])[same].mean()) / total
        if rho < 0.05:
            break
        inflation += 2 * rho
    return inflation
