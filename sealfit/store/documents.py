"""The shape of closure.json and model.json, checked when they are read.

OUT may come from somebody else: a document whose checksum is right may still lack a key, or hold a text in
place of a number, a number that is not finite, or a matrix of another size. Keys that are not listed here are
ignored.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from datetime import datetime
from typing import Annotated, Literal

from pydantic import AfterValidator, ConfigDict, Field, StrictBool, StrictInt, TypeAdapter

from sealfit.config import Config


def _utf8(text: str) -> str:
    text.encode()  # UnicodeEncodeError, a ValueError, for half of a surrogate pair
    return text


Text = Annotated[str, Field(strict=True), AfterValidator(_utf8)]
INTEGER = 16  # digits from which an integer is read as a number like others
LARGEST = 1e100  # its square is finite; a loop writes no number that is nearly so large
Number = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=-LARGEST, le=LARGEST)]
Maybe = Number | None  # None where it is not known
Place = Annotated[int, Field(strict=True, ge=-1)]  # in a list; -1 for none
Names = list[Text]
Matrix = list[list[Number]]
Operation = Literal["add", "multiply"]


def _require(*agree: bool) -> None:
    """Raise ValueError, as a wrong type does, unless all of these hold."""
    if not all(agree):
        raise ValueError("sizes or names do not agree")


def _is_square(matrix: Matrix, size: int) -> bool:
    return len(matrix) == size and all(len(row) == size for row in matrix)


def _are_below(places: Iterable[int], count: int, least: int = 0) -> bool:
    return all(least <= place < count for place in places)


# ---------------------------------------------------------------- closure.json


@dataclass(frozen=True, slots=True)
class FitQuality:
    """How the error compares with the scatter of repeats."""

    state: Literal["within_scatter", "above_scatter", "unknown"]
    ratio: Maybe
    p_value: Maybe

    def __post_init__(self) -> None:
        _require(self.state == "unknown" or None not in (self.ratio, self.p_value))


@dataclass(frozen=True, slots=True)
class Detectable:
    """The smallest effect of a variable that would have been found."""

    variable: Text
    level: Text
    smallest_N: Maybe
    smallest_pct: Maybe
    files_needed: StrictInt | None
    cannot_tell: StrictBool

    def __post_init__(self) -> None:
        _require((self.smallest_N is None) == (self.smallest_pct is None))


@dataclass(frozen=True, slots=True)
class Refused:
    """A significant effect that was not accepted."""

    id: Text
    channels: Names
    acts_on: Text
    label: Text
    p_value: Number
    reason: Text
    weak: StrictBool


@dataclass(frozen=True, slots=True)
class SlotUnits:
    """The unit of every slot."""

    force_N: Text
    displacement_mm: Text
    speed_mm_s: Text
    load_N: Text
    time_s: Text


@dataclass(frozen=True, slots=True)
class Errors:
    """The errors of one model."""

    rmse_N: Maybe
    rmse_runs_N: Maybe
    heldout_rmse_N: Maybe
    heldout_extrapolated_rmse_N: Maybe
    max_abs_N: Maybe
    mean_abs_pct: Maybe
    lack_of_fit_p: Maybe


@dataclass(frozen=True, slots=True)
class ParameterOfEffect:
    """One parameter of an effect with its interval."""

    name: Text
    value: Maybe
    ci95: tuple[Maybe, Maybe]
    unit: Text | None


@dataclass(frozen=True, slots=True)
class Alternative:
    """A rival of an effect."""

    id: Text
    channels: Names
    acts_on: Text
    heldout_rmse_N: Maybe


@dataclass(frozen=True, slots=True)
class EffectFound:
    """An effect of the model after, or a candidate."""

    id: Text
    label: Text
    level: Text
    channels: Names
    acts_on: Text
    operation: Operation
    reference: Text
    form: Text
    named: StrictBool
    candidate: StrictBool
    parameters: list[ParameterOfEffect]
    p_value: Number
    heldout_gain_N: Maybe
    heldout_rmse_N: Maybe
    alternatives: list[Alternative]


@dataclass(frozen=True, slots=True)
class ScatterOfLevel:
    """The scatter of one level."""

    level: Text
    sd_rel: Maybe
    sd_N: Maybe
    df: Maybe


@dataclass(frozen=True, slots=True)
class Left:
    """What is left of the residual."""

    rmse_N: Maybe
    level: Text | None
    channel: Text | None
    p_value: Maybe
    significant: StrictBool

    def __post_init__(self) -> None:
        _require(self.channel is None or self.p_value is not None)


@dataclass(frozen=True, slots=True)
class OutlierFile:
    """A file that the loop left out."""

    file: Text
    deviation_pct: Number
    p_value: Number


@dataclass(frozen=True, slots=True)
class NextRun:
    """A run to make next."""

    why: Text
    conditions: dict[Text, StrictBool | Number | Text]


@dataclass(frozen=True, slots=True)
class IncompleteChannel:
    """A channel that some files lack."""

    channel: Text
    files_without: StrictInt
    files: StrictInt
    searched: StrictBool


@dataclass(frozen=True, slots=True)
class Closure:
    """What the loop found."""

    schema: Literal[1]
    verdict: Literal["closed", "nothing_missing", "unexplained", "cannot_tell"]
    fit_quality: FitQuality
    sensitivity: list[Detectable]
    refused: list[Refused]
    units: SlotUnits
    noise_floor_N: Maybe
    before: Errors
    after: Errors
    heldout_unit: Text
    effects: list[EffectFound]
    scatter: list[ScatterOfLevel]
    left: Left
    outlier_files: list[OutlierFile]
    next_runs: list[NextRun]
    incomplete_channels: list[IncompleteChannel]


# ---------------------------------------------------------------- model.json


@dataclass(frozen=True, slots=True)
class Conditions:
    """The conditions of the campaign, each list one column."""

    condition: Names
    series: Names
    rubber: Names
    aging_days: list[Annotated[Number, Field(ge=0)]]

    def __post_init__(self) -> None:
        columns = (self.condition, self.series, self.rubber, self.aging_days)
        _require(len(self.condition) > 0, len({len(column) for column in columns}) == 1)


@dataclass(frozen=True, slots=True)
class Numbers:
    """The number of the fitted parameter that each condition uses, for each quantity; -1 for none."""

    mu_0s: list[Place]
    a_s: list[Place]
    b_s: list[Place]
    mu_0c: list[Place]
    a_c: list[Place]
    b_c: list[Place]
    v_s: list[Place]
    sigma_2: list[Place]


@dataclass(frozen=True, slots=True)
class DeclaredModel:
    """Parameters of the declared model, and which of them every condition uses."""

    parameters: list[tuple[Text, Text]]  # quantity and owner
    index: Numbers
    stribeck: dict[Text, Literal["full", "interpolated", "viscous", "constant"]]  # by series
    law: dict[Text, StrictBool]  # by series


Fixed = Number | Text | list[Number] | Names | dict[Text, tuple[Number, Number]] | None


@dataclass(frozen=True, slots=True)
class TermOfModel:
    """An effect in a model, with its fitted values."""

    id: Text
    channels: Annotated[Names, Field(min_length=1)]
    acts_on: Literal["force", "mu", "mu_s", "mu_c", "v_s", "sigma_2", "mu_0", "a", "b"]
    operation: Operation
    fixed: dict[Text, Fixed]
    values: dict[Text, Number]
    smoothness: Maybe

    def __post_init__(self) -> None:
        for name, value in self.fixed.items():
            kind = str if name == "categories" else float | int
            if name in ("categories", "means") or name.endswith("knots"):
                _require(isinstance(value, list) and all(isinstance(own, kind) for own in value))
            elif name.endswith("_ref"):
                _require(isinstance(value, kind))
            else:  # `shift` is written without the origins of passes
                _require(isinstance(value, dict), name != "shift" or value == {})


@dataclass(frozen=True, slots=True)
class FittedModel:
    """The fitted numbers of the declared model, and the effects."""

    theta: list[Number]
    terms: list[TermOfModel]


@dataclass(frozen=True, slots=True)
class GroupCovariance:
    """A covariance from whole groups: for each, the numbers of its parameters and their information."""

    covariance: Matrix
    information: list[tuple[list[Annotated[int, Field(strict=True, ge=0)]], Matrix]]


@dataclass(frozen=True, slots=True)
class ComponentOfScatter:
    """The variance of one level."""

    __pydantic_config__ = ConfigDict(extra="forbid")
    level: Literal["stroke", "file", "run", "specimen"]
    kind: Literal["offset", "gain"]
    variance: Annotated[Number, Field(ge=0)]


@dataclass(frozen=True, slots=True)
class ScatterOfModel:
    """The noise of a row, and the variance of every level."""

    s0: Number
    g: Number
    components: list[ComponentOfScatter]


@dataclass(frozen=True, slots=True)
class Model:
    """The models before and after, with all that a prediction needs."""

    schema: Literal[1]
    config: Config
    conditions: Conditions
    has_load: StrictBool
    has_aging: StrictBool
    declared: DeclaredModel
    before: FittedModel
    after: FittedModel
    covariance: Matrix
    sandwiches: list[GroupCovariance]
    df: Annotated[Number, Field(ge=0)]
    scatter: ScatterOfModel
    ranges: dict[Text, Names | tuple[Number, Number]]
    speeds_mm_s: dict[Text, list[Annotated[Number, Field(gt=0)]]]
    first_started_at: Text | None

    def __post_init__(self) -> None:
        declared, conditions = len(self.declared.parameters), len(self.conditions.condition)
        index = asdict(self.declared.index).values()
        fitted = declared + sum(len(term.values) for term in self.after.terms)
        blocks = [block for own in self.sandwiches for block in own.information]
        _require(
            self.has_aging == self.config.aging,
            len(self.before.theta) == len(self.after.theta) == declared,
            all(len(own) == conditions and _are_below(own, declared, -1) for own in index),
            set(self.conditions.series) <= self.speeds_mm_s.keys(),
            all(
                _is_square(own, fitted) for own in (self.covariance, *(s.covariance for s in self.sandwiches))
            ),
            all(_are_below(own, fitted) and _is_square(block, len(own)) for own, block in blocks),
        )
        if self.first_started_at is not None:
            datetime.fromisoformat(self.first_started_at)


_DOCUMENTS = {"closure": TypeAdapter(Closure), "model": TypeAdapter(Model)}


def read_document(name: str, text: str) -> dict:
    """Return the content of closure.json or model.json.

    Parameters
    ----------
    name : str
        "closure" or "model".
    text : str
        The text of the file.

    Raises
    ------
    ValueError
        If the text is no JSON, or the document is none that a loop writes.
    """
    document = json.loads(text, parse_int=lambda digits: (int if len(digits) < INTEGER else float)(digits))
    _DOCUMENTS[name].validate_python(document)
    return document
