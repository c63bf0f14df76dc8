"""What an effect declares, and the one pure function it holds.

An effect is data plus a function: the search, the fit, the tables, the plots and the report read the description, so a
new effect is one definition in the file of its family. The users' own effects follow the same contract.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from sealfit.errors import ParameterError

CHANNEL = "x"
"""In `Effect.reads`: any one numeric channel; `shape` finds it in `inputs["x"]`."""

SECOND = "z"
"""In `Effect.reads` after CHANNEL: any second channel, for the effects of a pair."""

READS_ANY = ((CHANNEL,), (CHANNEL, "direction"), (CHANNEL, SECOND))
"""What `Effect.reads` may be where it holds CHANNEL."""

AMPLITUDE = (-1e9, 1e9)
"""Bounds of an amplitude that carries units: a free sign, and no size that a rig's numbers could reach."""

Target = Literal["force", "mu", "mu_s", "mu_c", "v_s", "sigma_2", "mu_0", "a", "b"]
Operation = Literal["add", "multiply"]
TARGETS = ("force", "mu", "mu_s", "mu_c", "v_s", "sigma_2", "mu_0", "a", "b")
ANYWHERE: tuple[tuple[Target, Operation], ...] = (
    ("mu", "multiply"),
    ("force", "add"),
    ("force", "multiply"),
    ("mu_s", "multiply"),
    ("mu_c", "multiply"),
    ("v_s", "multiply"),
    ("sigma_2", "add"),
    ("sigma_2", "multiply"),
    ("a", "multiply"),
    ("b", "multiply"),
    ("mu_0", "multiply"),
    ("mu", "add"),
    ("mu_s", "add"),
    ("mu_c", "add"),
)
"""Where a closed or free form of a channel may act, likeliest first."""


@dataclass(frozen=True, slots=True)
class Parameter:
    """One parameter of an effect.

    In `unit`, `{x}` and `{z}` stand for the units of the channels read and `{y}` for that of what the effect gives: the
    force's unit for a force that is added, none for a factor, the parameter's own unit for the change of a parameter;
    `fill_unit` puts them in. A name that is a word of Python carries an underscore; `symbol` is what people read.

    `linear` marks an amplitude: the shape is proportional to it, or to the vector of all linear ones. `search` says
    where to look for one that is not linear: numbers, or "inside" (quantiles of the channel), "between" (halfway from
    one of its values to the next, for a jump), "span" (logarithmic, from a fraction of the channel's span to a few
    spans), "ratio" (logarithmic, over the channel's own magnitudes).
    """

    name: str
    unit: str
    start: float
    bounds: tuple[float, float]
    meaning: str
    linear: bool = False
    search: tuple[float, ...] | Literal["inside", "between", "span", "ratio"] = ()

    def __post_init__(self) -> None:
        low, high = self.bounds
        if not low <= self.start <= high:
            raise ParameterError(f"{self.name}: start {self.start} lies outside its bounds {self.bounds}.")
        if not self.meaning:
            raise ParameterError(f"{self.name}: say what it means.")

    @property
    def symbol(self) -> str:
        """Return the name as equations and tables print it: `lambda` for `lambda_`."""
        return self.name.rstrip("_")


@dataclass(frozen=True, slots=True)
class Effect:
    """One physical effect, or one closed form of any channel.

    `shape(inputs, **values)` is a pure function of arrays: `inputs` maps each name in `reads` to an array, shape (n,),
    and it returns the added force, the factor minus one, or the change of the parameter, shape (n,). It is zero where
    all amplitudes are zero, and NaN (without a warning) where the form says nothing, such as the logarithm of zero.

    `reference` is the state in which the shape is zero, in words: there the after-model's mu_0, a and b hold. `{x}`,
    `{z}` and `{load_N}` stand for channels, `{x_ref}` and the like for fixed reference values, `{x_0}` for a parameter.

    `inputs` also holds `<name>_ref`, a fixed reference per channel (its mean over the campaign), so `x_ref` for
    CHANNEL. A shape asks for it by `reference`.
    """

    id: str
    label: str  # in words; {x} stands for the channel
    equation: str  # LaTeX
    form: str  # the same in plain text, as closure.json prints it
    reads: tuple[str, ...]
    acts_on: tuple[tuple[Target, Operation], ...]  # the pairs it may take, likeliest first
    parameters: tuple[Parameter, ...]
    shape: Callable[..., np.ndarray]
    source: str
    worked: tuple[Mapping[str, float], Mapping[str, float], float]  # inputs, values, result: by hand
    physical: bool = True  # false for a closed form that names no mechanism
    reference: str = ""  # where the shape is zero, in words
    periodic: bool = False  # sought in the spectrum; its mean over a bin is known
    narrow: bool = False  # may be as fine as a bin, over which its mean is computed at many places
    along_calendar: bool = True  # false for a form that follows whatever was tested when

    def __post_init__(self) -> None:
        for target, operation in self.acts_on:
            if target not in TARGETS or operation not in ("add", "multiply"):
                raise ParameterError(f"effect {self.id}: cannot act on {target} by {operation}.")
        if not any(p.linear for p in self.parameters):
            raise ParameterError(f"effect {self.id}: mark at least one parameter as linear (its amplitude).")

    @property
    def linear(self) -> tuple[str, ...]:
        """Names of the amplitudes."""
        return tuple(p.name for p in self.parameters if p.linear)

    @property
    def nonlinear(self) -> tuple[Parameter, ...]:
        """Parameters that are searched for."""
        return tuple(p for p in self.parameters if not p.linear)

    def start(self) -> dict[str, float]:
        """Return the start value of every parameter."""
        return {p.name: p.start for p in self.parameters}


def reference(inputs: Mapping[str, object], name: str, default: float) -> float:
    """Return the fixed reference value of a channel, or `default` where the caller gives none.

    Parameters
    ----------
    inputs : mapping
        What the shape was given.
    name : str
        Channel as in `Effect.reads`.
    default : float
        1 where the channel is divided by it (one unit of the channel), 0 where it is subtracted.
    """
    return float(inputs.get(f"{name}_ref", default))


def positive(values) -> np.ndarray:
    """Return `values` where they are positive and NaN elsewhere: there a form of their logarithm or power says nothing.

    Examples
    --------
    >>> positive([2.0, 0.0, -1.0])
    array([ 2., nan, nan])
    """
    values = np.asarray(values, dtype=float)
    return np.where(values > 0, values, np.nan)


def not_negative(values) -> np.ndarray:
    """Return `values` where they are not negative and NaN elsewhere: there a form that starts at 0 says nothing.

    Examples
    --------
    >>> not_negative([2.0, 0.0, -1.0])
    array([ 2.,  0., nan])
    """
    values = np.asarray(values, dtype=float)
    return np.where(values >= 0, values, np.nan)


def deviation(inputs: Mapping[str, object], name: str) -> np.ndarray:
    """Return a channel less its reference value, shape (n,)."""
    return np.asarray(inputs[name], dtype=float) - reference(inputs, name, 0.0)


def log_ratio(inputs: Mapping[str, object], name: str) -> np.ndarray:
    """Return the logarithm of a channel over its reference value, shape (n,); NaN where the channel is not positive."""
    return np.log(positive(inputs[name]) / reference(inputs, name, 1.0))


def log_ratio_from_zero(inputs: Mapping[str, object], name: str) -> np.ndarray:
    """Return ln((1 + z) / (1 + z_ref)) of a channel that starts at zero, shape (n,); NaN where it is negative."""
    return np.log1p(not_negative(inputs[name])) - np.log1p(max(reference(inputs, name, 0.0), 0.0))


def fill_unit(unit: str, x: str, y: str, z: str = "") -> str:
    """Return a parameter's unit with those of the channels and of what the effect gives put in.

    Parameters
    ----------
    unit : str
        `Parameter.unit`.
    x, y, z : str
        Unit of the channel, of what the effect gives, and of the second channel; empty for none.

    Examples
    --------
    >>> fill_unit("{y}/{x}", "mm/s", "N"), fill_unit("{y}/{x}^2", "mm", ""), fill_unit("{y}/{x}", "", "N")
    ('N/(mm/s)', '1/mm^2', 'N')
    >>> fill_unit("{y}/({x} {z})", "mm/s", "", "d"), fill_unit("{y}/({x} {z})", "", "N", "d")
    ('1/((mm/s) d)', 'N/d')
    """
    known = {"{x}": x, "{y}": y, "{z}": z}
    top, slash, bottom = unit.partition("/")
    if not slash:
        return known.get(unit, unit)
    top = known.get(top, top)
    base, hat, power = bottom.partition("^")
    if base.startswith("("):
        factors = [factor for factor in (known.get(name, name) for name in base[1:-1].split()) if factor]
        base = " ".join(f"({f})" if len(factors) > 1 and any(c in f for c in "/ *·") else f for f in factors)
    else:
        base = known.get(base, base)
    if not base:
        return top
    if any(sign in base for sign in "/ *·"):
        base = f"({base})"
    return f"{top or 1}/{base}{hat}{power}"
