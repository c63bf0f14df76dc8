r"""The one declared model, everywhere: Eq. 14 with Eq. 15 in one joint fit, and the effects added to it.

.. math::
    F = \Big[N (\mu_c + (\mu_s - \mu_c) e^{-(v/v_s)^2})(1 + h_\mu)\,\mathrm{sgn}\,v + \sigma_2 v\Big](1 + h_F) + f,
    \quad \mu = \mu_0 - a \ln(1 + t/b)

for mu_s and mu_c alike; mu_0 is shared by a rubber's series, v_s and sigma_2 by a series' days. Effects change a
parameter first, then act as a factor on mu, then as a factor on the whole force, then as an added force.

Every quantity of a row depends on one fitted number at most, so the tangent is a scatter of row derivatives. v_s and b
are fitted as logarithms. Wu et al. 2020, Polymers 12(1) 102, doi:10.3390/polym12010102, Eqs. 14 and 15.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import pandas as pd

from sealfit.effects.contract import CHANNEL, SECOND, Effect
from sealfit.fit.rows import ALONG, Rows

QUANTITIES = ("mu_0s", "a_s", "b_s", "mu_0c", "a_c", "b_c", "v_s", "sigma_2")
LOGARITHMIC = ("b_s", "b_c", "v_s")
SPEEDS_FOR_STRIBECK = 4  # mu_s, mu_c, v_s and sigma_2 are four numbers
SPEEDS_FOR_VISCOUS = 2
DAYS_FOR_LAW = 3  # mu_0, a and b are three numbers
FINE = ("ripple", "sinusoid", "bump")  # effects that may be as fine as a bin
GAUSS = tuple(zip(*(part.tolist() for part in np.polynomial.legendre.leggauss(4)), strict=True))
GAUSS = tuple((place, weight / 2) for place, weight in GAUSS)
SAME_SPEED = 1.25  # measured speeds within 25 % are one setting: rigs without speed control wander that much


@dataclass(frozen=True, slots=True)
class JointParameter:
    """One fitted number of the declared model: which quantity, and of which rubber, series or condition."""

    quantity: str
    owner: str


@dataclass(frozen=True)
class Declared:
    """Which fitted number each condition uses for each quantity; -1 where the quantity is absent."""

    parameters: tuple[JointParameter, ...]
    index: Mapping[str, np.ndarray]  # quantity -> (conditions,) number of the parameter
    conditions: tuple[str, ...]
    has_load: bool
    stribeck: Mapping[str, str]  # series -> "full" | "viscous" | "constant"
    law: Mapping[str, bool]  # series -> whether Eq. 15 is fitted across its days


@dataclass(frozen=True)
class Term:
    """An effect bound to the channels it reads and the quantity it acts on, with fixed reference values.

    In `fixed`, `shift` holds each pass's own origin, and `held` the 95 % interval of each parameter that comes from the
    raw samples and that no fit to bins moves.
    """

    effect: Effect
    channels: tuple[str, ...]
    acts_on: str
    operation: str
    fixed: Mapping[str, object] = field(default_factory=dict)

    def inputs(self, rows: Rows) -> dict[str, np.ndarray]:
        """Return what the effect's shape reads, from the rows' channels."""
        key = (self.key(), id(self.fixed))
        if key in rows.cache:
            return rows.cache[key][1]
        given = {}
        for name, channel in zip(self.effect.reads, self.channels, strict=True):
            values = rows.values(channel)
            if name in (CHANNEL, SECOND) and channel == "speed_mm_s":
                values = np.abs(values)  # a form of the speed is one of its size
            given[name] = values
        shift = self.fixed.get("shift")
        if shift is not None:  # each pass has its own origin, NaN where that is unknown
            given[self.effect.reads[0]] = given[self.effect.reads[0]] + passes(rows.table).map(shift).to_numpy(float)
        rows.cache[key] = (self.fixed, {**given, **self.fixed})  # holding `fixed` keeps its id its own
        return rows.cache[key][1]

    def nodes(self, rows: Rows) -> list[tuple[float, dict[str, np.ndarray]]]:
        """Return (weight, inputs) at the points of each row where the shape is averaged.

        A row is the mean over a bin, and the mean of a short wave is smaller than its value in the middle: what may be
        as fine as the bins is averaged by Gauss-Legendre quadrature along the bin, the rest taken in the middle.
        """
        inputs = self.inputs(rows)
        if self.effect.id not in FINE or not set(self.channels) & set(ALONG):
            return [(1.0, inputs)]
        key = ("nodes", self.key(), id(self.fixed))
        if key not in rows.cache:
            found = []
            for place, weight in GAUSS:
                moved = dict(inputs)
                for name, channel in zip(self.effect.reads, self.channels, strict=True):
                    if channel in ALONG:
                        moved[name] = inputs[name] + 0.5 * place * rows.bin_width(channel)
                found.append((weight, moved))
            rows.cache[key] = (self.fixed, found)
        return rows.cache[key][1]

    def key(self) -> tuple:
        """Return what makes two terms the same effect."""
        return (self.effect.id, self.channels, self.acts_on, self.operation)


@dataclass(frozen=True)
class Model:
    """Declared model plus terms, with the fitted numbers: `theta` (declared) and `values` per term."""

    declared: Declared
    theta: np.ndarray
    terms: tuple[Term, ...] = ()
    values: tuple[Mapping[str, float], ...] = ()

    @property
    def size(self) -> int:
        """Number of fitted numbers."""
        return self.theta.size + sum(len(t.effect.parameters) for t in self.terms)

    def place(self, number: int) -> slice:
        """Return where a term's numbers stand in `vector`."""
        first = self.theta.size + sum(len(t.effect.parameters) for t in self.terms[:number])
        return slice(first, first + len(self.terms[number].effect.parameters))

    def vector(self) -> np.ndarray:
        """Return all fitted numbers, declared ones first, shape (size,)."""
        tail = [v[p.name] for t, v in zip(self.terms, self.values, strict=True) for p in t.effect.parameters]
        return np.r_[self.theta, tail]

    def at(self, vector: np.ndarray) -> Model:
        """Return the model with other fitted numbers."""
        theta, rest, values = vector[: self.theta.size], list(vector[self.theta.size :]), []
        for term in self.terms:
            count = len(term.effect.parameters)
            values.append({p.name: float(x) for p, x in zip(term.effect.parameters, rest[:count], strict=True)})
            rest = rest[count:]
        return replace(self, theta=theta, values=tuple(values))

    def with_term(self, term: Term, values: Mapping[str, float]) -> Model:
        """Return the model with one more term."""
        return replace(self, terms=(*self.terms, term), values=(*self.values, dict(values)))

    def without_term(self, number: int) -> Model:
        """Return the model without one of its terms."""
        keep = [k for k in range(len(self.terms)) if k != number]
        return replace(self, terms=tuple(self.terms[k] for k in keep), values=tuple(self.values[k] for k in keep))


def passes(table: pd.DataFrame) -> pd.Series:
    """Return the name of each row's pass: its file and the direction in it, as play in a drive shifts one against the
    other."""
    return table["file"] + np.where(table["speed_mm_s"] >= 0, "+", "-") if len(table) else table["file"]


def declare(rows: Rows) -> Declared:
    """Return the declared model that these conditions and speeds can carry.

    A series needs four speeds in one direction for Eq. 14, two for the viscous term; Eq. 15 needs three days, the
    unaged day included. What cannot be fitted is left out, not guessed. Speeds are counted within one direction, as an
    offset between directions would otherwise pass for a Stribeck curve.
    """
    conditions = rows.conditions
    names = tuple(conditions["condition"])
    aging = rows.has_aging
    series_of = _fit_series(conditions, aging)
    stribeck = {s: _speed_form(rows, series_of == s) for s in dict.fromkeys(series_of)}
    law = {}
    for s in stribeck:
        own = conditions[series_of == s]
        shared = conditions[(conditions["aging_days"] == 0) & conditions["rubber"].isin(own["rubber"])]
        days = set(own["aging_days"]) | set(shared["aging_days"])
        law[s] = bool(aging and len(days) >= DAYS_FOR_LAW and (own["aging_days"] > 0).any())
    law_rubbers = {conditions["rubber"].iloc[c] for c in range(len(names)) if law[series_of[c]]}
    parameters: dict[JointParameter, int] = {}
    index = {quantity: np.full(len(names), -1) for quantity in QUANTITIES}

    def use(c: int, quantity: str, owner: str) -> None:
        index[quantity][c] = parameters.setdefault(JointParameter(quantity, owner), len(parameters))

    for c, name in enumerate(names):
        series, rubber = series_of[c], conditions["rubber"].iloc[c]
        unaged = aging and conditions["aging_days"].iloc[c] == 0 and rubber in law_rubbers
        for end in "sc":
            if end == "s" and stribeck[series] != "full":
                continue
            if law[series]:
                for quantity, owner in ((f"mu_0{end}", rubber), (f"a_{end}", series), (f"b_{end}", series)):
                    use(c, quantity, owner)
            else:
                use(c, f"mu_0{end}", rubber if unaged else name)
        if stribeck[series] == "full":
            use(c, "v_s", series)
        if stribeck[series] != "constant":
            use(c, "sigma_2", series)
    return Declared(tuple(parameters), index, names, rows.has_load, stribeck, law)


def _fit_series(conditions, aging: bool) -> np.ndarray:
    """Return the series whose v_s and sigma_2 a condition uses: a lone series takes its unaged rubber in."""
    series = conditions["series"].to_numpy(dtype=object).copy()
    if aging:
        for rubber in conditions["rubber"].unique():
            own = (conditions["rubber"] == rubber).to_numpy()
            aged = own & (conditions["aging_days"] > 0).to_numpy()
            if len(set(series[aged])) == 1:
                series[own] = series[aged][0]
    return series


def _speed_form(rows: Rows, of_condition: np.ndarray) -> str:
    mask = of_condition[rows.condition]
    most = 0
    for sign in (1.0, -1.0):
        chosen = mask & (np.sign(rows.speed) == sign)
        if chosen.any():
            most = max(most, speed_levels(rows, chosen))
    if most >= SPEEDS_FOR_STRIBECK:
        return "full"
    return "viscous" if most >= SPEEDS_FOR_VISCOUS else "constant"


def speed_levels(rows: Rows, mask: np.ndarray) -> int:
    """Return how many speeds were set: commanded ones, or measured ones that differ by more than 25 %."""
    commanded = rows.table.loc[mask, "speed_set_mm_s"]
    if commanded.notna().all():
        return commanded.abs().round(9).nunique()
    stroke = rows.codes("stroke")[mask]
    total = np.bincount(stroke, np.abs(rows.speed[mask]))
    count = np.bincount(stroke)
    return levels_of(np.sort(total[count > 0] / count[count > 0]))


def levels_of(speeds: np.ndarray) -> int:
    """Return the number of clusters of sorted positive speeds, each within 25 % of its slowest."""
    count, base = 0, 0.0
    for speed in speeds:
        if count == 0 or speed > SAME_SPEED * base:
            count, base = count + 1, speed
    return count


def evaluate(model: Model, rows: Rows, *, jacobian: bool = True) -> tuple[np.ndarray, np.ndarray | None]:
    """Return the model's force, shape (n,), and its tangent, shape (n, model.size), at every row."""
    state = _state(model, rows, slopes=jacobian)
    if not jacobian:
        return state["force"], None
    slopes = state["slopes"]
    n = rows.force.size
    tangent = np.zeros((n, model.size))
    for quantity in QUANTITIES:
        number = model.declared.index[quantity][rows.condition]
        has = np.flatnonzero(number >= 0)
        if has.size:
            base = state["base"][quantity] if quantity in LOGARITHMIC else 1.0
            tangent[has, number[has]] = (slopes[quantity] * state["through"].get(quantity, 1.0) * base)[has]
    column = model.theta.size
    for term, values, slope in zip(model.terms, model.values, state["term_slopes"], strict=True):
        for derivative in _derivatives(term, values, rows):
            tangent[:, column] = slope * derivative
            column += 1
    return state["force"], tangent


def friction_of(model: Model, rows: Rows) -> np.ndarray:
    """Return the model's force less what is added to it, shape (n,): what rubber, load and gains scale."""
    return _state(model, rows, slopes=False)["friction"]


def term_slope(model: Model, rows: Rows, acts_on: str, operation: str) -> np.ndarray:
    """Return the force's derivative with respect to the shape of a term that is not there yet, shape (n,)."""
    state = _state(model, rows)
    return _slope_of(acts_on, operation, state)


def mean_derivatives(
    term: Term, values: Mapping[str, float], rows: Rows, *, only_linear: bool = False
) -> list[np.ndarray]:
    """Return the derivatives of a term's shape, averaged over each row's bin, each of shape (n,)."""
    parts = [
        (weight, term_derivatives(term, values, inputs, only_linear=only_linear)) for weight, inputs in term.nodes(rows)
    ]
    return [_known(term, sum(weight * part[k] for weight, part in parts)) for k in range(len(parts[0][1]))]


def _known(term: Term, shape: np.ndarray) -> np.ndarray:
    """Return a shape with zero where a pass's own origin is not known, shape (n,)."""
    return np.nan_to_num(shape) if "shift" in term.fixed else shape


def term_derivatives(
    term: Term, values: Mapping[str, float], inputs: Mapping[str, np.ndarray], *, only_linear: bool = False
) -> list[np.ndarray]:
    """Return the shape's derivative in each of the effect's parameters (or amplitudes alone), each of shape (n,)."""
    if not term.effect.nonlinear and not only_linear:
        return list(_linear_columns(term, inputs).T)
    result = []
    zero = {name: 0.0 for name in term.effect.linear}
    held = () if only_linear else term.fixed.get("held", ())
    for p in term.effect.parameters:
        if p.name in held:
            result.append(np.zeros_like(inputs[term.effect.reads[0]], dtype=float))
        elif p.linear:
            result.append(term.effect.shape(inputs, **{**values, **zero, p.name: 1.0}))
        elif not only_linear:
            step = 1e-5 * max(abs(values[p.name]), 1e-3)
            up = term.effect.shape(inputs, **{**values, p.name: values[p.name] + step})
            down = term.effect.shape(inputs, **{**values, p.name: values[p.name] - step})
            result.append((up - down) / (2 * step))
    return result


def _linear_columns(term: Term, inputs: Mapping[str, np.ndarray]) -> np.ndarray:
    """Return the shape's columns of an effect that is linear in all its parameters, shape (n, parameters)."""
    names = [p.name for p in term.effect.parameters]
    zero = dict.fromkeys(names, 0.0)
    return np.column_stack([np.asarray(term.effect.shape(inputs, **{**zero, name: 1.0})) for name in names])


def _shape(term: Term, values: Mapping[str, float], rows: Rows) -> np.ndarray:
    """Return the term's shape at the rows, shape (n,); what does not change is made once."""
    if not term.effect.nonlinear:
        return _columns_of(term, rows) @ np.array([values[p.name] for p in term.effect.parameters])
    return _kept(
        "shape",
        term,
        values,
        rows,
        lambda: _known(term, sum(weight * term.effect.shape(inputs, **values) for weight, inputs in term.nodes(rows))),
    )


def _derivatives(term: Term, values: Mapping[str, float], rows: Rows) -> list[np.ndarray] | np.ndarray:
    """Return the derivatives of a term's shape in each of its parameters; what does not change is made once."""
    if not term.effect.nonlinear:
        return _columns_of(term, rows).T
    return _kept("derivatives", term, values, rows, lambda: mean_derivatives(term, values, rows))


def _kept(what: str, term: Term, values: Mapping[str, float], rows: Rows, make: Callable):
    """Return what was made last for a term at the same values, or make it: a fit moves some terms and not others."""
    key = (what, term.key(), id(term.fixed))
    at = tuple(values.values())
    if key not in rows.cache or rows.cache[key][1] != at:
        rows.cache[key] = (term.fixed, at, make())  # holding `fixed` keeps its id its own
    return rows.cache[key][2]


def _columns_of(term: Term, rows: Rows) -> np.ndarray:
    key = ("columns", term.key(), id(term.fixed))
    if key not in rows.cache:
        rows.cache[key] = (term.fixed, _linear_columns(term, term.inputs(rows)))
    return rows.cache[key][1]


def _state(model: Model, rows: Rows, *, slopes: bool = True) -> dict:
    declared, theta = model.declared, model.theta
    base = {}
    for quantity in QUANTITIES:
        number = declared.index[quantity]
        start = 1.0 if quantity in LOGARITHMIC else 0.0
        fitted = np.where(number >= 0, theta[np.maximum(number, 0)], 0.0)
        value = np.where(number >= 0, np.exp(fitted), start) if quantity in LOGARITHMIC else fitted
        base[quantity] = value[rows.condition]
    shapes = [_shape(t, v, rows) for t, v in zip(model.terms, model.values, strict=True)]
    through: dict[str, np.ndarray] = {}
    now = dict(base)

    def change(target: str, quantities: Sequence[str]) -> None:
        for quantity in quantities:
            for term, shape in zip(model.terms, shapes, strict=True):
                if term.acts_on == target:
                    if term.operation == "multiply":
                        now[quantity] = now[quantity] * (1 + shape)
                        through[quantity] = through.get(quantity, 1.0) * (1 + shape)
                    else:
                        now[quantity] = now[quantity] + shape

    for target, quantities in (
        ("mu_0", ("mu_0s", "mu_0c")),
        ("a", ("a_s", "a_c")),
        ("b", ("b_s", "b_c")),
        ("v_s", ("v_s",)),
        ("sigma_2", ("sigma_2",)),
    ):
        change(target, quantities)
    for quantity in LOGARITHMIC:  # a change may not carry v_s or b to zero or below
        now[quantity] = np.maximum(now[quantity], 1e-3 * base[quantity])
    days = rows.days
    for end in "sc":
        now[f"mu_{end}"] = now[f"mu_0{end}"] - now[f"a_{end}"] * np.log1p(days / now[f"b_{end}"])
        change(f"mu_{end}", (f"mu_{end}",))
    speed, sign = rows.speed, np.sign(rows.speed)
    has_stribeck = (declared.index["v_s"] >= 0)[rows.condition]
    ratio = speed / now["v_s"]
    decay = np.where(has_stribeck, np.exp(-(ratio**2)), 0.0)
    mu = now["mu_c"] + (now["mu_s"] - now["mu_c"]) * decay
    on_mu, on_force, added, mu_added = np.ones_like(speed), np.ones_like(speed), np.zeros_like(speed), 0.0
    for term, shape in zip(model.terms, shapes, strict=True):
        if term.acts_on == "mu" and term.operation == "multiply":
            on_mu = on_mu * (1 + shape)
        elif term.acts_on == "mu":
            mu_added = mu_added + shape
        elif term.acts_on == "force" and term.operation == "multiply":
            on_force = on_force * (1 + shape)
        elif term.acts_on == "force":
            added = added + shape
    mu_total = mu * on_mu + mu_added
    friction = rows.load * mu_total * sign
    sliding = friction + now["sigma_2"] * speed
    force = sliding * on_force + added
    if not slopes:
        return {"force": force, "friction": sliding * on_force}
    drive = rows.load * sign * on_mu * on_force  # derivative with respect to mu before its factor
    log_s, log_c = np.log1p(days / now["b_s"]), np.log1p(days / now["b_c"])
    slope_of = {
        "mu_s": drive * decay,
        "mu_c": drive * (1 - decay),
        "v_s": drive * (now["mu_s"] - now["mu_c"]) * decay * 2 * ratio**2 / now["v_s"],
        "sigma_2": speed * on_force,
    }
    for end, log in (("s", log_s), ("c", log_c)):
        factor = through.get(f"mu_{end}", 1.0)
        slope_of[f"mu_0{end}"] = slope_of[f"mu_{end}"] * factor
        slope_of[f"a_{end}"] = -slope_of[f"mu_{end}"] * factor * log
        b = now[f"b_{end}"]
        slope_of[f"b_{end}"] = slope_of[f"mu_{end}"] * factor * now[f"a_{end}"] * days / (b * (b + days))
    state = {
        "base": base,
        "now": now,
        "through": through,
        "slopes": slope_of,
        "force": force,
        "gained": sliding * on_force,
        "on_mu": on_mu,
        "drive_mu": rows.load * sign * on_force,
        "mu": mu,
    }
    state["term_slopes"] = [
        _slope_of(t.acts_on, t.operation, state, s) for t, s in zip(model.terms, shapes, strict=True)
    ]
    return state


def _slope_of(acts_on: str, operation: str, state: Mapping, shape: np.ndarray | None = None) -> np.ndarray:
    """Return dF/dh for a term's shape h; `shape` is the term's own, so that its factor is not counted twice."""
    own = 1.0 if shape is None or operation == "add" else 1 + shape
    own = np.where(np.abs(own) < 1e-9, 1e-9, own)
    if acts_on == "force":
        return np.ones_like(state["force"]) if operation == "add" else state["gained"] / own
    if acts_on == "mu":
        return state["drive_mu"] if operation == "add" else state["drive_mu"] * state["mu"] * state["on_mu"] / own
    total = 0.0
    quantities = {"mu_0": ("mu_0s", "mu_0c"), "a": ("a_s", "a_c"), "b": ("b_s", "b_c")}.get(acts_on, (acts_on,))
    for quantity in quantities:
        slope = state["slopes"][quantity]
        total = total + (slope if operation == "add" else slope * state["now"][quantity] / own)
    return total
