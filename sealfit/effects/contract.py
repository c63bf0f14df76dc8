"""What an effect declares, and the one pure function it holds.

An effect is data plus a function: the search, the fit, the tables, the plots and the report read the description, so a
new effect is one new file and one name in the list. The users' own effects follow the same contract.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from sealfit.errors import ParameterError

CHANNEL = "x"
"""In `Effect.reads`: any one numeric channel; `shape` finds it in `inputs["x"]`."""

Target = Literal["force", "mu", "mu_s", "mu_c", "v_s", "sigma_2", "mu_0", "a", "b"]
Operation = Literal["add", "multiply"]
TARGETS = ("force", "mu", "mu_s", "mu_c", "v_s", "sigma_2", "mu_0", "a", "b")


@dataclass(frozen=True, slots=True)
class Parameter:
    """One parameter of an effect.

    In `unit`, `{x}` stands for the unit of the channel and `{y}` for that of what the effect gives: the force's unit for
    a force that is added, none for a factor, the parameter's own unit for the change of a parameter.

    `linear` marks an amplitude: the shape is proportional to it, or to the vector of all linear ones. `search` says
    where to look for one that is not linear: numbers, or "inside" (quantiles of the channel), "span" (logarithmic,
    from a fraction of the channel's span to a few spans), "ratio" (logarithmic, over the channel's own magnitudes).
    """

    name: str
    unit: str
    start: float
    bounds: tuple[float, float]
    meaning: str
    linear: bool = False
    search: tuple[float, ...] | Literal["inside", "span", "ratio"] = ()

    def __post_init__(self) -> None:
        low, high = self.bounds
        if not low <= self.start <= high:
            raise ParameterError(f"{self.name}: start {self.start} lies outside its bounds {self.bounds}.")
        if not self.meaning:
            raise ParameterError(f"{self.name}: say what it means.")


@dataclass(frozen=True, slots=True)
class Effect:
    """One physical effect, or one closed form of any channel.

    `shape(inputs, **values)` is a pure function of arrays: `inputs` maps each name in `reads` to an array, shape (n,),
    and it returns the added force, the factor minus one, or the change of the parameter, shape (n,).
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
