"""The description of an effect, and its shape as one pure function; effects of users follow it, too."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from types import ModuleType
from typing import Literal, get_args

import numpy as np

from sealfit.errors import ParameterError

CHANNEL = "x"  # stands for any numeric channel in `Effect.reads`; its values are `inputs["x"]` of the shape
SECOND = "z"  # stands for any second channel in `Effect.reads`, after CHANNEL
READS_ANY = ((CHANNEL,), (CHANNEL, "direction"), (CHANNEL, SECOND))  # allowed `Effect.reads` with CHANNEL
AMPLITUDE = (-1e9, 1e9)  # bounds of an amplitude with units, far beyond the numbers of any rig
PHASE = (-4 * np.pi, 4 * np.pi)  # bounds in rad: a search can pass a full turn in each direction
PHASES = tuple(np.arange(4) * np.pi / 4)  # search grid: half a turn, as amplitudes have a sign

Target = Literal["force", "mu", "mu_s", "mu_c", "v_s", "sigma_2", "mu_0", "a", "b"]
Operation = Literal["add", "multiply"]
TARGETS = get_args(Target)
# Declared quantities that an effect on each target changes. Effects on mu_s and mu_c come after aging.
QUANTITIES_OF = {
    "mu_0": ("mu_0s", "mu_0c"),
    "a": ("a_s", "a_c"),
    "b": ("b_s", "b_c"),
    "v_s": ("v_s",),
    "sigma_2": ("sigma_2",),
}

# Targets of a closed form or free shape, most likely first.
ANYWHERE: tuple[tuple[Target, Operation], ...] = (
    ("mu", "multiply"), ("force", "add"), ("force", "multiply"), ("mu_s", "multiply"), ("mu_c", "multiply"),
    ("v_s", "multiply"), ("sigma_2", "add"), ("sigma_2", "multiply"), ("a", "multiply"), ("b", "multiply"),
    ("mu_0", "multiply"), ("mu", "add"), ("mu_s", "add"), ("mu_c", "add"),
)  # fmt: skip
ROOM = ANYWHERE[:5]  # targets of the climate of the room


@dataclass(frozen=True, slots=True)
class Parameter:
    """One parameter of an effect."""

    name: str  # ends in an underscore if it is a Python keyword
    # {x} and {z} stand for the units of the channels and {y} for that of the result: the unit of force for an
    # added force, none for a factor, that of the parameter for a change of it; see `fill_unit`.
    unit: str
    start: float
    bounds: tuple[float, float]
    meaning: str
    linear: bool = False  # an amplitude
    # Grid of a nonlinear parameter: numbers, or "inside" (quantiles of the channel), "between" (midpoints of
    # its neighbouring values, for a jump), "span" (logarithmic, from a fraction of the channel's range to a
    # few ranges), "ratio" (logarithmic, over its magnitudes).
    search: tuple[float, ...] | Literal["inside", "between", "span", "ratio"] = ()
    vanishes_at: float | None = None  # where the shape is zero for every amplitude: no descent crosses it

    def __post_init__(self) -> None:
        low, high = self.bounds
        if not low <= self.start <= high:
            raise ParameterError(f"{self.name}: start {self.start} lies outside its bounds {self.bounds}.")
        if not self.meaning:
            raise ParameterError(f"{self.name}: say what it means.")

    @property
    def symbol(self) -> str:
        """Name in equations and tables: `lambda` for `lambda_`."""
        return self.name.rstrip("_")


def amplitude(name: str, unit: str, start: float, meaning: str, bounds=AMPLITUDE) -> Parameter:
    """Return an amplitude: a parameter in which the shape is linear."""
    return Parameter(name, unit, start, bounds, meaning, linear=True)


def factors(*targets: Target) -> tuple[tuple[Target, Operation], ...]:
    """Return the `acts_on` of an effect that is a factor on each of some targets, most likely first."""
    return tuple((target, "multiply") for target in targets)


@dataclass(frozen=True, slots=True)
class Effect:
    """One physical effect, or one closed form of any channel.

    `shape(inputs, **values)` is a pure function. `inputs` maps each name in `reads` to an array, shape (n,),
    and `<name>_ref` to a fixed reference of the channel, its mean over the campaign. The shape is the added
    force, the factor minus one, or the change of the parameter, shape (n,). It is zero if all amplitudes are
    zero, and NaN (without a warning) where the form is not defined, such as the logarithm of zero.

    `reference` describes the state in which the shape is zero; mu_0, a and b of the after-model refer to it.
    `{x}`, `{z}` and `{load_N}` stand for channels, `{x_ref}` and the like for fixed reference values, `{x_0}`
    for a parameter.
    """

    id: str
    label: str  # name in reports; {x} stands for the channel
    equation: str  # in plain text: "h = A (1 - exp(-t / tau))"
    reads: tuple[str, ...]
    acts_on: tuple[tuple[Target, Operation], ...]  # allowed pairs, most likely first
    parameters: tuple[Parameter, ...]
    shape: Callable[..., np.ndarray]
    source: str
    # inputs, values and result of a check by hand; None for a free shape, which depends on the data
    worked: tuple[Mapping[str, float], Mapping[str, float], float] | None = None
    physical: bool = True  # false for a closed form that names no mechanism
    reference: str = ""  # state in which the shape is zero
    periodic: bool = False  # searched in the spectrum; its mean over a bin has a closed form
    narrow: bool = False  # may be as narrow as a bin; its mean over a bin needs more quadrature nodes
    along_calendar: bool = True  # false for a form that can imitate any order of tests
    # whether a campaign with these values of the first channel can show it; None: any can
    shown_by: Callable[[np.ndarray], bool] | None = None

    def __post_init__(self) -> None:
        for target, operation in self.acts_on:
            if target not in TARGETS or operation not in get_args(Operation):
                raise ParameterError(f"effect {self.id}: cannot act on {target} by {operation}.")
        if not any(p.linear for p in self.parameters):
            raise ParameterError(f"effect {self.id}: mark at least one parameter as linear (its amplitude).")

    @property
    def form(self) -> str:
        """Right side of the equation, as closure.json prints it."""
        return self.equation.removeprefix("h = ")

    @property
    def linear(self) -> tuple[str, ...]:
        """Names of the amplitudes."""
        return tuple(p.name for p in self.parameters if p.linear)

    @property
    def nonlinear(self) -> tuple[Parameter, ...]:
        """Nonlinear parameters, which are searched on a grid."""
        return tuple(p for p in self.parameters if not p.linear)

    def start(self) -> dict[str, float]:
        """Return the start value of every parameter."""
        return {p.name: p.start for p in self.parameters}


# A closed form is of any one channel and zero at its reference, unless it says otherwise.
closed_form = partial(Effect, reads=(CHANNEL,), acts_on=ANYWHERE, reference="{x} = {x_ref}", physical=False)


def effect(make: Callable[..., Effect] = Effect, **description) -> Callable:
    """Return a decorator that describes a shape: its attribute `effect` is the effect, whose id is its name.

    `description` has the other fields of `Effect`; `closed_form` may stand for `Effect`.
    """

    def describe(shape: Callable) -> Callable:
        shape.effect = make(id=shape.__name__, shape=shape, **description)
        return shape

    return describe


def effects_in(module: ModuleType) -> list[Effect]:
    """Return the effects at the top level of a module, in their order: described functions, and `Effect`."""
    values = (getattr(value, "effect", value) for value in vars(module).values())
    return [value for value in values if isinstance(value, Effect)]


def reference(inputs: Mapping[str, object], name: str, default: float) -> float:
    """Return the fixed reference value of a channel in the inputs of a shape, or `default` if it has none.

    The default is 1 for a reference that divides the channel, 0 for one that is subtracted.
    """
    return float(inputs.get(f"{name}_ref", default))


def positive(values) -> np.ndarray:
    """Return `values`, with NaN for those that are not positive, as their logarithm is not defined."""
    values = np.asarray(values, dtype=float)
    return np.where(values > 0, values, np.nan)


def not_negative(values) -> np.ndarray:
    """Return `values`, with NaN for negative ones, for forms that start at 0."""
    values = np.asarray(values, dtype=float)
    return np.where(values >= 0, values, np.nan)


def deviation(inputs: Mapping[str, object], name: str) -> np.ndarray:
    """Return a channel minus its reference value, shape (n,)."""
    return np.asarray(inputs[name], dtype=float) - reference(inputs, name, 0.0)


def log_ratio(inputs: Mapping[str, object], name: str) -> np.ndarray:
    """Return the logarithm of a channel over its reference, shape (n,); NaN where it is not positive."""
    return np.log(positive(inputs[name]) / positive(reference(inputs, name, 1.0)))


def log_ratio_from_zero(inputs: Mapping[str, object], name: str) -> np.ndarray:
    """Return ln((1 + z) / (1 + z_ref)) of a channel that starts at zero, (n,); NaN where it is negative."""
    return np.log1p(not_negative(inputs[name])) - np.log1p(max(reference(inputs, name, 0.0), 0.0))


def fill_unit(unit: str, x: str, y: str, z: str = "") -> str:
    """Return `Parameter.unit` with the units of the channels (x, z) and of the effect's result (y) inserted.

    Examples
    --------
    >>> fill_unit("{y}/{x}", "mm/s", "N"), fill_unit("{y}/{x}^2", "mm", ""), fill_unit("{y}/{x}", "", "N")
    ('N/(mm/s)', '1/mm^2', 'N')
    >>> fill_unit("{y}/({x} {z})", "mm/s", "", "d"), fill_unit("{y}/({x} {z})", "", "N", "d")
    ('1/((mm/s) d)', 'N/d')
    """
    known = {"{x}": x, "{y}": y, "{z}": z}
    top, slash, bottom = unit.partition("/")
    top = known.get(top, top)
    base, hat, power = bottom.partition("^")
    factors = [factor for factor in (known.get(name, name) for name in base.strip("()").split()) if factor]
    if not slash or not factors:
        return top
    base = _in_brackets(" ".join(map(_in_brackets, factors)) if len(factors) > 1 else factors[0])
    return f"{top or 1}/{base}{hat}{power}"


def _in_brackets(unit: str) -> str:
    return f"({unit})" if any(sign in unit for sign in "/ *·") else unit


SAMPLES = "samples"  # key of the inputs of an effect: number of samples in each row's mean
LAG = "lag"  # key of the inputs of an effect: signed length over which friction follows it in each row


def width_of(name: str) -> str:
    """Return the key of the inputs of an effect with the width of each row's bin in a channel."""
    return f"{name} width"


def mean_sine(inputs: Mapping, name: str, angle: np.ndarray, wavelength: float) -> np.ndarray:
    r"""Return the sine of the angles at the middle of each row, shape (n,), as the row measures it.

    The mean of n samples spread evenly over a width w reduces it by the Dirichlet kernel
    :math:`\sin(\pi w / \lambda) / (n \sin(\pi w / (n \lambda)))`. Friction that follows it over a length l,
    :math:`l\,dz/dx = \sin(2 \pi x / \lambda) - z`, is later by :math:`\arctan(2 \pi l / \lambda)` and smaller
    by :math:`1 / \sqrt{1 + (2 \pi l / \lambda)^2}`.

    Examples
    --------
    Two samples half a wave apart cancel; many over a whole wave, too.

    >>> given = {"x width": np.array([1.0, 2.0, 0.5]), "samples": np.array([2.0, 2.0, 1.0])}
    >>> [round(float(f), 12) for f in mean_sine(given, "x", np.pi / 2, 1.0)]
    [0.0, -1.0, 1.0]

    Over the length of a radian, it is an eighth of a turn later.

    >>> round(float(mean_sine({"lag": np.array(1.0)}, "x", np.pi / 4, 2 * np.pi)), 12)
    0.0
    """
    turn = 2 * np.pi / wavelength
    lag = turn * inputs.get(LAG, 0.0)
    sine = np.sin(angle - np.arctan(lag)) / np.hypot(1.0, lag)
    width = inputs.get(width_of(name))
    if width is None:
        return sine
    half, samples = turn * np.asarray(width, float) / 2, np.asarray(inputs[SAMPLES], float)
    each = np.sin(half / samples)
    equal = np.abs(each) < 1e-9  # samples whole wavelengths apart have equal values
    whole = np.cos(half) * np.cos(half / samples)
    return sine * np.where(equal, whole, np.sin(half) / np.where(equal, 1.0, samples * each))
