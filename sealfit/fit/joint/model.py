"""The declared model in one joint fit: Eq. 14 with Eq. 15, and the effects added to it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import pandas as pd

from sealfit.effects.contract import CHANNEL, LAG, QUANTITIES_OF, SAMPLES, SECOND, Effect, width_of
from sealfit.fit.joint.declared import QUANTITIES, Declared
from sealfit.fit.joint.rows import ALONG, Rows
from sealfit.fit.joint.tangent import BlockLayout, Tangent, blocks_of

# Gauss-Legendre nodes on [-1, 1] and weights that sum to 1: two for smooth shapes, four for narrow ones.
TWO_NODES, FOUR_NODES = (
    tuple((float(x), float(w) / 2) for x, w in zip(*np.polynomial.legendre.leggauss(k), strict=True))
    for k in (2, 4)
)


@dataclass(frozen=True)
class Term:
    """An effect bound to the channels it reads and the quantity it acts on, with fixed reference values.

    In `fixed`, `shift` is the origin of the channel in each pass; `held` are parameters, with intervals, that
    were estimated from the raw samples. `smoothness` is the weight of the roughness penalty of a free shape.
    """

    effect: Effect
    channels: tuple[str, ...]
    acts_on: str
    operation: str
    fixed: Mapping[str, object] = field(default_factory=dict)
    smoothness: float | None = None

    @property
    def target(self) -> tuple[str, str]:
        """What it acts on, and the operation."""
        return self.acts_on, self.operation

    @cached_property
    def shape_key(self) -> tuple:
        """All that the shape depends on besides the rows and its parameters."""
        return (self.effect.id, self.channels, self.follows, _hashable(self.fixed))

    @property
    def follows(self) -> bool:
        """Whether it changes what the bristles follow, and not the measured force.

        The phase of a ripple whose origin differs between passes contains the lag.
        """
        return self.acts_on != "force" and "shift" not in self.fixed

    def inputs(self, rows: Rows) -> dict[str, np.ndarray]:
        """Return the inputs of the effect's shape: channels of the rows, shape (n,), and fixed values."""
        given = {}
        for name, channel in zip(self.effect.reads, self.channels, strict=True):
            if self.follows and channel in ALONG and self.effect.periodic:
                given[name] = rows.values(channel)
                given[LAG] = given[name] - rows.followed(channel)
            elif self.follows and channel in ALONG:
                given[name] = rows.followed(channel)
            else:
                given[name] = rows.unsigned(channel) if name in (CHANNEL, SECOND) else rows.values(channel)
        shift = self.fixed.get("shift")
        if shift is not None:  # NaN where the origin of a pass is unknown
            first = self.effect.reads[0]
            given[first] = given[first] + passes(rows.table).map(shift).to_numpy(float)
        return {**given, **self.fixed}

    def nodes(self, rows: Rows) -> list[tuple[float, dict[str, np.ndarray]]]:
        """Return (weight, inputs) at the quadrature nodes of each row, a mean over the samples of a bin.

        The mean of a sine has a closed form; another nonlinear shape along the stroke is averaged over a
        uniform distribution with the variance of the samples; others are evaluated at the mean.
        """
        return rows.cache.once(("nodes", self.shape_key), lambda: self._nodes(rows))

    def _nodes(self, rows: Rows) -> list[tuple[float, dict[str, np.ndarray]]]:
        inputs = self.inputs(rows)
        along = [(n, c) for n, c in zip(self.effect.reads, self.channels, strict=True) if c in ALONG]
        if not self.effect.nonlinear or not along:
            return [(1.0, inputs)]
        if self.effect.periodic:
            widths = {width_of(name): rows.bin_width(channel) for name, channel in along}
            return [(1.0, {**inputs, SAMPLES: rows.samples, **widths})]
        spread = np.sqrt(1 - 1 / np.maximum(rows.samples, 1.0) ** 2)
        return [
            (weight, {**inputs, **{n: inputs[n] + 0.5 * node * spread * rows.bin_width(c) for n, c in along}})
            for node, weight in (FOUR_NODES if self.effect.narrow else TWO_NODES)
        ]

    def key(self) -> tuple:
        """Return the identity of the effect: two terms with the same key are one effect."""
        return (self.effect.id, self.channels, *self.target)


def _hashable(value: object) -> object:
    """Return fixed values in a form that can be a key of a dictionary."""
    if isinstance(value, Mapping):
        return tuple(sorted((name, _hashable(own)) for name, own in value.items()))
    return tuple(value) if isinstance(value, (list, np.ndarray)) else value


def passes(table: pd.DataFrame) -> pd.Series:
    """Return the name of each row's pass: its record and direction."""
    record = table.get("record", table["file"])
    return record + np.where(table["speed_mm_s"] >= 0, "+", "-") if len(table) else record


def mean_derivatives(
    term: Term, values: Mapping[str, float], rows: Rows, *, only_linear: bool = False
) -> list[np.ndarray]:
    """Return the derivatives of a term's shape, averaged over each row's bin, each of shape (n,)."""
    nodes = term.nodes(rows)
    parts = [term_derivatives(term, values, inputs, only_linear=only_linear) for _, inputs in nodes]
    return [_mean(term, [weight for weight, _ in nodes], part) for part in zip(*parts, strict=True)]


def _mean(term: Term, weights: Sequence[float], shapes: Sequence[np.ndarray]) -> np.ndarray:
    """Return the weighted sum of shapes, shape (n,), with 0 where the origin of the pass is unknown."""
    mean = sum(weight * shape for weight, shape in zip(weights, shapes, strict=True))
    return np.nan_to_num(mean) if "shift" in term.fixed else mean


def term_derivatives(
    term: Term, values: Mapping[str, float], inputs: Mapping[str, np.ndarray], *, only_linear: bool = False
) -> list[np.ndarray]:
    """Return the shape's derivatives with respect to parameters, or to amplitudes only, shape (n,) each."""
    result = []
    zero = {name: 0.0 for name in term.effect.linear}
    constant = () if only_linear else term.fixed.get("held", ())
    for p in term.effect.parameters:
        if p.name in constant:
            result.append(np.zeros_like(inputs[term.effect.reads[0]], dtype=float))
        elif p.linear:
            result.append(term.effect.shape(inputs, **{**values, **zero, p.name: 1.0}))
        elif not only_linear:
            step = 1e-5 * max(abs(values[p.name]), 1e-3)
            # The shape may end at the bounds.
            ends = np.clip([values[p.name] - step, values[p.name] + step], *p.bounds)
            down, up = (term.effect.shape(inputs, **{**values, p.name: float(end)}) for end in ends)
            result.append((up - down) / (ends[1] - ends[0]))
    return result


def shape_of(term: Term, values: Mapping[str, float], rows: Rows) -> np.ndarray:
    """Return the term's shape at the rows, shape (n,); the last one is cached."""
    if not term.effect.nonlinear:
        return np.array([values[p.name] for p in term.effect.parameters]) @ derivatives_of(term, values, rows)

    def make() -> np.ndarray:
        nodes = term.nodes(rows)
        return _mean(term, [w for w, _ in nodes], [term.effect.shape(own, **values) for _, own in nodes])

    return rows.cache.once(("shape", term.shape_key), make, at=tuple(values.values()))


def derivatives_of(term: Term, values: Mapping[str, float], rows: Rows) -> np.ndarray:
    """Return a shape's derivatives with respect to its parameters, (parameters, n); the last are cached."""
    linear = not term.effect.nonlinear
    return rows.cache.once(
        ("derivatives", term.shape_key),
        lambda: np.stack(mean_derivatives(term, values, rows, only_linear=linear)),
        at=() if linear else tuple(values.values()),
    )


# ---------------------------------------------------------------- joint
# .. math::
#     F = \Big[N (\mu_c + (\mu_s - \mu_c) e^{-(v/v_s)^2})(1 + h_\mu)\,\mathrm{sgn}\,v
#     + \sigma_2 v\Big](1 + h_F) + f, \quad \mu = \mu_0 - a \ln(1 + t/b)
#
# for both mu_s and mu_c. mu_0 is shared by the series of a rubber, v_s and sigma_2 by the days of a series.
# Effects on a parameter are applied first, then factors on mu, then factors on the force, then added forces.
# Every quantity of a row depends on at most one fitted number. Wu et al. 2020, Polymers 12(1) 102,
# doi:10.3390/polym12010102, Eqs. 14 and 15.

# Quantities whose logarithm is fitted.
LOGARITHMIC = ("b_s", "b_c", "v_s")

# A tangent of up to so many declared numbers (two or three series) is dense; blocks save no time there.
DENSE_NUMBERS = 24


@dataclass(frozen=True)
class Model:
    """Declared model plus terms, with fitted numbers: `theta`, (k,), of the model and `values` per term."""

    declared: Declared
    theta: np.ndarray
    terms: tuple[Term, ...] = ()
    values: tuple[Mapping[str, float], ...] = ()

    @property
    def size(self) -> int:
        """How many numbers are fitted."""
        return self.theta.size + sum(len(t.effect.parameters) for t in self.terms)

    @property
    def nonlinear(self) -> np.ndarray:
        """Mask of the nonlinear parameters, v_s and b included, in the order of `vector`, shape (size,)."""
        declared = [p.quantity in LOGARITHMIC for p in self.declared.parameters]
        added = [not p.linear for t in self.terms for p in t.effect.parameters]
        return np.array(declared + added, dtype=bool)

    def term_slice(self, number: int) -> slice:
        """Return the slice of a term's parameters in `vector`."""
        first = self.theta.size + sum(len(t.effect.parameters) for t in self.terms[:number])
        return slice(first, first + len(self.terms[number].effect.parameters))

    def vector(self) -> np.ndarray:
        """Return all fitted numbers, declared ones first, shape (size,)."""
        tail = [v[p.name] for t, v in zip(self.terms, self.values, strict=True) for p in t.effect.parameters]
        return np.concatenate([self.theta, tail])

    def at(self, vector: np.ndarray) -> Model:
        """Return the model with other fitted numbers, shape (size,)."""
        values = []
        for number, term in enumerate(self.terms):
            own = zip(term.effect.parameters, vector[self.term_slice(number)].tolist(), strict=True)
            values.append({p.name: x for p, x in own})
        return replace(self, theta=vector[: self.theta.size], values=tuple(values))

    def geometric_means(self) -> dict[str, float]:
        """Return the mean over series of each declared quantity whose logarithm is fitted."""
        quantities = [p.quantity for p in self.declared.parameters]
        means = pd.Series(self.theta, quantities).groupby(level=0).mean()
        return {name: float(np.exp(means[name])) for name in LOGARITHMIC if name in means}

    def with_term(self, term: Term, values: Mapping[str, float]) -> Model:
        """Return the model with one more term."""
        return replace(self, terms=(*self.terms, term), values=(*self.values, dict(values)))

    def without_term(self, number: int) -> Model:
        """Return the model without one of its terms."""
        terms, values = (own[:number] + own[number + 1 :] for own in (self.terms, self.values))
        return replace(self, terms=terms, values=values)


def evaluate(model: Model, rows: Rows, *, jacobian: bool = True) -> tuple[np.ndarray, Tangent | None]:
    """Return the model's force, shape (n,), and its tangent, of shape (n, model.size), at every row."""
    state = _ForceParts(model, rows)
    if not jacobian:
        return state.force, None
    slopes, layout = state.slopes(), _layout(model, rows)
    values = np.zeros((rows.force.size, layout.index.shape[1]))
    for quantity in QUANTITIES:
        number = model.declared.index[quantity][rows.condition]
        has = np.flatnonzero(number >= 0)
        if has.size:
            base = state.base[quantity] if quantity in LOGARITHMIC else 1.0
            place = layout.places[layout.block[has], number[has]]
            values[has, place] = (slopes[quantity] * state.through.get(quantity, 1.0) * base)[has]
    column = layout.index.shape[1] - (model.size - model.theta.size)
    for term, numbers, shape in zip(model.terms, model.values, state.shapes, strict=True):
        slope = state.term_slope(slopes, term.acts_on, term.operation, shape)
        for derivative in derivatives_of(term, numbers, rows):
            values[:, column] = slope * derivative
            column += 1
    return state.force, Tangent(layout, values)


def _layout(model: Model, rows: Rows) -> BlockLayout:
    """Return the layout of the tangent: declared numbers of a specimen's conditions, then all terms'."""
    declared = model.declared

    def make() -> BlockLayout:
        size = model.theta.size
        index, block = rows.cache.once(("blocks",), lambda: _blocks(declared, rows), at=declared)
        added = np.arange(size, model.size)
        index = np.column_stack([np.where(index == size, model.size, index), np.tile(added, (len(index), 1))])
        return BlockLayout(model.size, index, block)

    return rows.cache.once(("layout", model.size), make, at=declared)


def _blocks(declared: Declared, rows: Rows) -> tuple[np.ndarray, np.ndarray]:
    """Return the declared numbers of each block, and the block of each row."""
    size, used = len(declared.parameters), np.stack(list(declared.index.values()), axis=1)
    of_condition = [frozenset(numbers[numbers >= 0].tolist()) for numbers in used]
    specimen = rows.codes("specimen")
    touched: dict[int, frozenset[int]] = {}
    for number, condition in np.unique(np.column_stack([specimen, rows.condition]), axis=0).tolist():
        touched[number] = touched.get(number, frozenset()) | of_condition[condition]
    sets = [frozenset(range(size))] * len(touched) if size <= DENSE_NUMBERS else list(touched.values())
    index, block = blocks_of(sets, size)
    return index, block[specimen]


def loads_of(model: Model, rows: Rows, friction: np.ndarray | None = None) -> np.ndarray:
    """Return the change of the force per unit of each kind of random effect, shape (n, kinds).

    That of a gain is `friction`, by default the model's; that of v_s is per unit of its logarithm.
    """
    state = _ForceParts(model, rows)
    slopes, friction = state.slopes(), state.friction if friction is None else friction
    curved, viscous = ((model.declared.index[name] >= 0)[rows.condition] for name in ("v_s", "sigma_2"))
    mu_s, v_s = slopes["mu_s"] * curved, slopes["v_s"] * state.now["v_s"] * curved
    return np.column_stack([np.ones_like(friction), friction, mu_s, v_s, slopes["sigma_2"] * viscous])


def term_slope(model: Model, rows: Rows, acts_on: str, operation: str) -> np.ndarray:
    """Return the force's derivative with respect to the shape of a term not yet in the model, shape (n,)."""
    state = _ForceParts(model, rows)
    return state.term_slope(state.slopes(), acts_on, operation)


class _ForceParts:
    """The parts of a model's force at the rows; each array has shape (n,)."""

    def __init__(self, model: Model, rows: Rows) -> None:
        self.rows = rows
        self.shapes = [shape_of(t, v, rows) for t, v in zip(model.terms, model.values, strict=True)]
        effects = [(t.acts_on, t.operation, own) for t, own in zip(model.terms, self.shapes, strict=True)]
        self.base = base = _declared_values(model, rows)
        # Quantities changed by the effects on them, and the products of the factors of these effects.
        self.now, self.through = now, through = dict(base), {}
        for target, quantities in QUANTITIES_OF.items():
            for quantity in quantities:
                _change(quantity, [(o, shape) for t, o, shape in effects if t == target], now, through)
        for quantity in LOGARITHMIC:  # v_s and b stay positive
            now[quantity] = np.maximum(now[quantity], 1e-3 * base[quantity])
        for end in "sc":
            mu = f"mu_{end}"
            now[mu] = now[f"mu_0{end}"] - now[f"a_{end}"] * np.log1p(rows.days / now[f"b_{end}"])
            _change(mu, [(o, shape) for t, o, shape in effects if t == mu], now, through)
        speed = rows.pace
        self.ratio = speed / now["v_s"]
        has_stribeck = (model.declared.index["v_s"] >= 0)[rows.condition]
        self.decay = np.where(has_stribeck, np.exp(-(self.ratio**2)), 0.0)  # share of mu_s in mu
        self.mu = now["mu_c"] + (now["mu_s"] - now["mu_c"]) * self.decay  # without the effects on mu
        self.on_mu, mu_added = _factor_and_sum(effects, "mu", speed)
        self.on_force, added = _factor_and_sum(effects, "force", speed)
        dry = rows.load * (self.mu * self.on_mu + mu_added) * np.sign(speed)
        self.friction = (dry + now["sigma_2"] * speed) * self.on_force  # force without added forces
        self.force = self.friction + added

    def slopes(self) -> dict[str, np.ndarray]:
        """Return the force's derivative with respect to every quantity."""
        now, speed, days = self.now, self.rows.pace, self.rows.days
        drive = self.rows.load * np.sign(speed) * self.on_mu * self.on_force  # of mu before its factor
        found = {
            "mu_s": drive * self.decay,
            "mu_c": drive * (1 - self.decay),
            "v_s": drive * (now["mu_s"] - now["mu_c"]) * self.decay * 2 * self.ratio**2 / now["v_s"],
            "sigma_2": speed * self.on_force,
        }
        for end in "sc":
            b = now[f"b_{end}"]
            to_mu = found[f"mu_{end}"] * self.through.get(f"mu_{end}", 1.0)
            found[f"mu_0{end}"] = to_mu
            found[f"a_{end}"] = -to_mu * np.log1p(days / b)
            found[f"b_{end}"] = to_mu * now[f"a_{end}"] * days / (b * (b + days))
        return found

    def term_slope(
        self, slopes: Mapping[str, np.ndarray], acts_on: str, operation: str, shape: np.ndarray | None = None
    ) -> np.ndarray:
        """Return dF/dh for a term's shape h, (n,); `shape` is h if its factor is already in the state."""
        own = 1.0 if shape is None or operation == "add" else 1 + shape
        own = np.where(np.abs(own) < 1e-9, 1e-9, own)
        if acts_on == "force":
            return np.ones_like(self.force) if operation == "add" else self.friction / own
        if acts_on == "mu":
            drive = self.rows.load * np.sign(self.rows.pace) * self.on_force
            return drive if operation == "add" else drive * self.mu * self.on_mu / own
        total = 0.0
        for quantity in QUANTITIES_OF.get(acts_on, (acts_on,)):
            slope = slopes[quantity]
            total = total + (slope if operation == "add" else slope * self.now[quantity] / own)
        return total


def _declared_values(model: Model, rows: Rows) -> dict[str, np.ndarray]:
    """Return every quantity of the declared model at the rows; one not fitted is 0, or 1 for v_s and b."""
    found = {}
    for quantity in QUANTITIES:
        number = model.declared.index[quantity]
        fitted = np.where(number >= 0, model.theta[np.maximum(number, 0)], 0.0)
        found[quantity] = (np.exp(fitted) if quantity in LOGARITHMIC else fitted)[rows.condition]
    return found


def _change(quantity: str, effects: list[tuple[str, np.ndarray]], now: dict, through: dict) -> None:
    """Apply effects, each an operation and a shape, to a quantity in `now`; record factors in `through`."""
    for operation, shape in effects:
        if operation == "multiply":
            now[quantity] = now[quantity] * (1 + shape)
            through[quantity] = through.get(quantity, 1.0) * (1 + shape)
        else:
            now[quantity] = now[quantity] + shape


def _factor_and_sum(
    effects: list[tuple[str, str, np.ndarray]], target: str, like: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the product of the factors on a target and the sum of the added terms, shape of `like` each."""
    factor, added = np.ones_like(like), np.zeros_like(like)
    for acts_on, operation, shape in effects:
        if acts_on == target and operation == "multiply":
            factor = factor * (1 + shape)
        elif acts_on == target:
            added = added + shape
    return factor, added
