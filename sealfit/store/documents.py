"""The shape of closure.json and model.json, checked when they are read.

OUT may come from somebody else: a document whose checksum is right may still lack a key, or hold a text in
place of a number, or a matrix of another size. Keys that are not listed here are ignored.
"""

import json
from collections.abc import Callable, Iterable
from dataclasses import asdict, make_dataclass
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


def record(agrees: Callable | None = None, **fields: object) -> type:
    """Return the type of an object with these keys; ValueError, as for a wrong type, unless it `agrees`."""

    def require(own) -> None:
        if agrees is not None and not agrees(own):
            raise ValueError("sizes or names do not agree")

    return make_dataclass("Record", fields.items(), namespace={"__post_init__": require})


def _is_square(matrix: Matrix, size: int) -> bool:
    return len(matrix) == size and all(len(row) == size for row in matrix)


def _are_below(places: Iterable[int], count: int, least: int = 0) -> bool:
    return all(least <= place < count for place in places)


# ---------------------------------------------------------------- closure.json

ERRORS = record(
    **dict.fromkeys(("rmse_N", "rmse_runs_N", "heldout_rmse_N", "heldout_extrapolated_rmse_N"), Maybe),
    **dict.fromkeys(("max_abs_N", "mean_abs_pct", "lack_of_fit_p"), Maybe),
)
EFFECT = record(
    **dict.fromkeys(("id", "label", "level", "acts_on", "reference", "form"), Text),
    channels=Names,
    operation=Operation,
    **dict.fromkeys(("named", "candidate"), StrictBool),
    parameters=list[record(name=Text, value=Maybe, ci95=tuple[Maybe, Maybe], unit=Text | None)],
    p_value=Number,
    **dict.fromkeys(("heldout_gain_N", "heldout_rmse_N"), Maybe),
    alternatives=list[record(id=Text, channels=Names, acts_on=Text, heldout_rmse_N=Maybe)],
)
FIT_QUALITY = record(
    lambda own: own.state == "unknown" or None not in (own.ratio, own.p_value),
    state=Literal["within_scatter", "above_scatter", "unknown"],
    **dict.fromkeys(("ratio", "p_value"), Maybe),
)
DETECTABLE = record(
    lambda own: (own.smallest_N is None) == (own.smallest_pct is None),
    **dict.fromkeys(("variable", "level", "acts_on"), Text),
    **dict.fromkeys(("smallest_N", "smallest_pct"), Maybe),
    files_needed=StrictInt | None,
    cannot_tell=StrictBool,
)
LEFT = record(
    lambda own: own.channel is None or own.p_value is not None,
    **dict.fromkeys(("rmse_N", "p_value"), Maybe),
    **dict.fromkeys(("level", "channel"), Text | None),
    significant=StrictBool,
)
REFUSED = record(
    **dict.fromkeys(("id", "acts_on", "label", "reason"), Text),
    channels=Names,
    p_value=Number,
    weak=StrictBool,
)
INCOMPLETE = record(channel=Text, files_without=StrictInt, files=StrictInt, searched=StrictBool)
CLOSURE = record(
    schema=Literal[1],
    verdict=Literal["closed", "nothing_missing", "unexplained", "cannot_tell"],
    fit_quality=FIT_QUALITY,
    sensitivity=list[DETECTABLE],
    refused=list[REFUSED],
    units=record(**dict.fromkeys(("force_N", "displacement_mm", "speed_mm_s", "load_N", "time_s"), Text)),
    noise_floor_N=Maybe,
    **dict.fromkeys(("before", "after"), ERRORS),
    heldout_unit=Text,
    effects=list[EFFECT],
    scatter=list[record(level=Text, sd_rel=Maybe, sd_N=Maybe, df=Maybe)],
    left=LEFT,
    outlier_files=list[record(file=Text, deviation_pct=Number, p_value=Number)],
    next_runs=list[record(why=Text, conditions=dict[Text, StrictBool | Number | Text])],
    incomplete_channels=list[INCOMPLETE],
)


# ---------------------------------------------------------------- model.json


def _is_fixed(name: str, value: object) -> bool:
    """Return whether what is fixed in an effect is of the kind that its name says."""
    if name == "category":
        return isinstance(value, str)
    kind = str if name == "categories" else float | int
    if name in ("categories", "means") or name.endswith("knots"):
        return isinstance(value, list) and all(isinstance(own, kind) for own in value)
    if name.endswith("_ref"):
        return isinstance(value, kind)
    return isinstance(value, dict) and (name != "shift" or value == {})  # `shift` has no origins of passes


def _sizes_agree(model) -> bool:
    """Return whether the parts of a model have the sizes that its parameters and conditions need."""
    if model.first_started_at is not None:
        datetime.fromisoformat(model.first_started_at)
    declared, conditions = len(model.declared.parameters), len(model.conditions.condition)
    index = asdict(model.declared.index).values()
    fitted = declared + sum(len(term.values) for term in model.after.terms)
    covariances = [model.covariance, *(own.covariance for own in model.sandwiches)]
    blocks = [block for own in model.sandwiches for block in own.information]
    return (
        model.has_aging == model.config.aging
        and all(len(own.theta) == declared for own in (model.before, model.after, *model.unconfirmed))
        and all(len(own) == conditions and _are_below(own, declared, -1) for own in index)
        and set(model.conditions.series) <= model.speeds_mm_s.keys()
        and all(_is_square(own, fitted) for own in covariances)
        and all(_are_below(own, fitted) and _is_square(block, len(own)) for own, block in blocks)
        and all(own.effect < len(model.after.terms) for own in model.jumps)
        and all(own.parameter in model.after.terms[own.effect].values for own in model.jumps)
        and all(_adds_one_term(own, model) for own in model.unconfirmed)
    )


def _adds_one_term(own, model) -> bool:
    """Return whether a model has the terms of that after the loop, and one more of known channels."""
    *terms, last = [term.channels for term in own.terms]
    known = {*model.ranges, "direction", "speed_mm_s", *model.config.condition, *model.config.rubber}
    return terms == [term.channels for term in model.after.terms] and known.issuperset(last)


CONDITIONS = record(
    lambda own: len(own.condition) > 0 and len({len(column) for column in asdict(own).values()}) == 1,
    **dict.fromkeys(("condition", "series", "rubber"), Names),
    aging_days=list[Annotated[Number, Field(ge=0)]],
)
QUANTITIES = ("mu_0s", "a_s", "b_s", "mu_0c", "a_c", "b_c", "v_s", "sigma_2")
DECLARED = record(
    parameters=list[tuple[Text, Text]],  # quantity and owner
    # The number of the fitted parameter that each condition uses, for each quantity.
    index=record(**dict.fromkeys(QUANTITIES, list[Place])),
    stribeck=dict[Text, Literal["full", "interpolated", "viscous", "constant"]],  # by series
    law=dict[Text, StrictBool],  # by series
)
TERM = record(
    lambda own: all(_is_fixed(*fixed) for fixed in own.fixed.items()),
    id=Text,
    channels=Annotated[Names, Field(min_length=1)],
    acts_on=Literal["force", "mu", "mu_s", "mu_c", "v_s", "sigma_2", "mu_0", "a", "b"],
    operation=Operation,
    fixed=dict[Text, Number | Text | list[Number] | Names | dict[Text, tuple[Number, Number]] | None],
    values=dict[Text, Number],
    smoothness=Maybe,
)
FITTED = record(theta=list[Number], terms=list[TERM])
UNCONFIRMED = record(label=Text, theta=list[Number], terms=Annotated[list[TERM], Field(min_length=1)])
INFORMATION = list[tuple[list[Annotated[int, Field(strict=True, ge=0)]], Matrix]]
GROUPED = record(covariance=Matrix, information=INFORMATION)  # from whole groups: numbers of its parameters
COMPONENT = record(
    level=Literal["stroke", "file", "run", "specimen"],
    kind=Literal["offset", "gain", "mu_s", "v_s", "sigma_2"],
    variance=Annotated[Number, Field(ge=0)],
)
COMPONENT.__pydantic_config__ = ConfigDict(extra="forbid")
# An effect of the model after the loop that jumps between two tested values of its variable.
JUMP = record(effect=Annotated[int, Field(strict=True, ge=0)], parameter=Text, low=Number, high=Number)
MODEL = record(
    _sizes_agree,
    schema=Literal[1],
    config=Config,
    conditions=CONDITIONS,
    **dict.fromkeys(("has_load", "has_aging"), StrictBool),
    compliance=Annotated[Number, Field(ge=0)],
    declared=DECLARED,
    **dict.fromkeys(("before", "after"), FITTED),
    covariance=Matrix,
    sandwiches=list[GROUPED],
    jumps=list[JUMP],
    unconfirmed=list[UNCONFIRMED],
    df=Annotated[Number, Field(ge=0)],
    scatter=record(s0=Number, g=Number, of_specimens=StrictBool, components=list[COMPONENT]),
    ranges=dict[Text, Names | tuple[Number, Number]],
    speeds_mm_s=dict[Text, list[Annotated[Number, Field(gt=0)]]],
    first_started_at=Text | None,
)


_DOCUMENTS = {"closure": TypeAdapter(CLOSURE), "model": TypeAdapter(MODEL)}


def read_document(name: str, text: str) -> dict:
    """Return closure.json ("closure") or model.json from its text; ValueError if no loop writes such."""
    document = json.loads(text, parse_int=lambda digits: (int if len(digits) < INTEGER else float)(digits))
    _DOCUMENTS[name].validate_python(document)
    return document
