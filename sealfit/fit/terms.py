"""Effects bound to channels: their shapes at the rows, averaged over each row's bin, and the derivatives of these."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
import pandas as pd

from sealfit.effects.contract import CHANNEL, SECOND, Effect
from sealfit.effects.free import SAMPLES, width_of
from sealfit.fit.rows import ALONG, Rows

WAVES = ("ripple", "sinusoid", "sinusoid_harmonics")  # whose mean over a bin is known
FINE = ("bump",)  # that may be as fine as a bin
FEW, MANY = (
    tuple((float(place), float(weight) / 2) for place, weight in zip(*np.polynomial.legendre.leggauss(k), strict=True))
    for k in (2, 4)
)


@dataclass(frozen=True)
class Term:
    """An effect bound to the channels it reads and the quantity it acts on, with fixed reference values.

    In `fixed`, `shift` holds each pass's own origin, and `held` the 95 % interval of each parameter that comes from the
    raw samples and that no fit to bins moves. `smoothness` is the weight on how much a free shape bends (`prior.py`),
    None where nothing holds its amplitudes.
    """

    effect: Effect
    channels: tuple[str, ...]
    acts_on: str
    operation: str
    fixed: Mapping[str, object] = field(default_factory=dict)
    smoothness: float | None = None

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

        A row is the mean over the samples of a bin. Of a wave that is known; another shape that bends within the bin is
        averaged by Gauss-Legendre quadrature along it (over an even spread with the variance of n samples), more
        closely where it may be as fine as the bin. The rest is taken in the middle.
        """
        inputs = self.inputs(rows)
        along = [(n, c) for n, c in zip(self.effect.reads, self.channels, strict=True) if c in ALONG]
        if not self.effect.nonlinear or not along:
            return [(1.0, inputs)]
        key = ("nodes", self.key(), id(self.fixed))
        if key not in rows.cache:
            if self.effect.id in WAVES:
                widths = {width_of(name): rows.bin_width(channel) for name, channel in along}
                found = [(1.0, {**inputs, SAMPLES: rows.samples, **widths})]
            else:
                spread = np.sqrt(1 - 1 / np.maximum(rows.samples, 1.0) ** 2)
                found = [
                    (weight, {**inputs, **{n: inputs[n] + 0.5 * place * spread * rows.bin_width(c) for n, c in along}})
                    for place, weight in (MANY if self.effect.id in FINE else FEW)
                ]
            rows.cache[key] = (self.fixed, found)
        return rows.cache[key][1]

    def key(self) -> tuple:
        """Return what makes two terms the same effect."""
        return (self.effect.id, self.channels, self.acts_on, self.operation)


def passes(table: pd.DataFrame) -> pd.Series:
    """Return the name of each row's pass: its file and the direction in it, as play in a drive shifts one against the
    other."""
    return table["file"] + np.where(table["speed_mm_s"] >= 0, "+", "-") if len(table) else table["file"]


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
            ends = np.clip([values[p.name] - step, values[p.name] + step], *p.bounds)  # beyond, a form need not exist
            down, up = (term.effect.shape(inputs, **{**values, p.name: float(end)}) for end in ends)
            result.append((up - down) / (ends[1] - ends[0]))
    return result


def _linear_columns(term: Term, inputs: Mapping[str, np.ndarray]) -> np.ndarray:
    """Return the shape's columns of an effect that is linear in all its parameters, shape (n, parameters)."""
    names = [p.name for p in term.effect.parameters]
    zero = dict.fromkeys(names, 0.0)
    return np.column_stack([np.asarray(term.effect.shape(inputs, **{**zero, name: 1.0})) for name in names])


def shape_of(term: Term, values: Mapping[str, float], rows: Rows) -> np.ndarray:
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


def derivatives_of(term: Term, values: Mapping[str, float], rows: Rows) -> list[np.ndarray] | np.ndarray:
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
