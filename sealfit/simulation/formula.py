"""Safe formulas of channels, for effects that stand in no catalogue: `0.05 * tanh((humidity_pct - 50) / 10)`.

A SPEC is a text file that people pass around: a formula is parsed, every node is checked against a short list, and only
arrays are ever computed with. It allows more than the expressions of a rig config (functions, conditions, categories).
"""

from __future__ import annotations

import ast
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from sealfit.errors import ConfigError

MAX_CHARACTERS = 2000
MAX_DEPTH = 60  # keeps the walk far below Python's recursion limit

FUNCTIONS = {  # name: (function, number of arguments)
    "exp": (np.exp, 1),
    "log": (np.log, 1),
    "sin": (np.sin, 1),
    "cos": (np.cos, 1),
    "tanh": (np.tanh, 1),
    "sqrt": (np.sqrt, 1),
    "abs": (np.abs, 1),
    "sign": (np.sign, 1),
    "where": (np.where, 3),
    "minimum": (np.minimum, 2),
    "maximum": (np.maximum, 2),
}
_BINARY = {
    ast.Add: np.add,
    ast.Sub: np.subtract,
    ast.Mult: np.multiply,
    ast.Div: np.divide,
    ast.Pow: np.power,
}
_UNARY = {ast.USub: np.negative, ast.UAdd: np.positive, ast.Not: np.logical_not}
_COMPARE = {
    ast.Lt: np.less,
    ast.LtE: np.less_equal,
    ast.Gt: np.greater,
    ast.GtE: np.greater_equal,
    ast.Eq: np.equal,
    ast.NotEq: np.not_equal,
}
_FIX = (
    "Allowed are numbers, channel names, pi, + - * / **, comparisons, and, or, not, a category as in batch == 'B', and "
    + ", ".join(FUNCTIONS)
    + "."
)


@dataclass(frozen=True, slots=True)
class Formula:
    """A checked formula: its text, its tree and the channels it reads, in alphabetical order."""

    text: str
    tree: ast.expr
    channels: tuple[str, ...]


@lru_cache(maxsize=256)
def parse_formula(text: str) -> Formula:
    """Return the checked formula in `text`.

    Raises
    ------
    ConfigError
        If the text is no formula or holds a piece that is not allowed; the message names that piece.

    Examples
    --------
    >>> parse_formula("0.02 * sin(2 * pi * displacement_mm / 4) * (load_N > 20)").channels
    ('displacement_mm', 'load_N')
    """
    if len(text) > MAX_CHARACTERS:
        raise ConfigError(f"a formula of {len(text)} characters.", fix=f"Keep it below {MAX_CHARACTERS}.")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # "1if": a remark of Python's about text that is refused below anyway
            tree = ast.parse(text.strip(), mode="eval").body
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
        reason = getattr(error, "msg", None) or "it is nested too deeply"
        raise ConfigError(f"{text!r} is no formula: {reason}.", fix=_FIX) from error
    names: set[str] = set()
    _check(tree, text, names, 0)
    return Formula(text, tree, tuple(sorted(names)))


def evaluate_formula(formula: Formula, channels: Mapping[str, np.ndarray]) -> np.ndarray:
    """Return the formula's value as floats, broadcast over the channels it reads; NaN or infinity where undefined.

    Raises
    ------
    ConfigError
        If a channel is missing, or a category is computed with.
    """
    for name in formula.channels:
        if name not in channels:
            known = ", ".join(sorted(channels))
            raise ConfigError(f"formula {formula.text!r}: there is no channel '{name}'.", fix=f"Known: {known}.")
    with np.errstate(all="ignore"):
        try:
            return np.asarray(_value(formula.tree, channels), dtype=float)
        except (TypeError, ValueError) as error:  # numpy's UFuncTypeError is a TypeError
            raise ConfigError(
                f"formula {formula.text!r}: a category cannot be computed with.",
                fix="Compare it: where(batch == 'B', 0.05, 0).",
            ) from error


def _refuse(text: str, piece: str) -> ConfigError:
    return ConfigError(f"formula {text!r}: {piece} is not allowed.", fix=_FIX)


def _check(node: ast.expr, text: str, names: set[str], depth: int) -> None:
    if depth > MAX_DEPTH:
        raise _refuse(text, f"nesting deeper than {MAX_DEPTH}")
    match node:
        case ast.Constant(value=value) if isinstance(value, int | float) and not isinstance(value, bool):
            if isinstance(value, int) and abs(value) > 2**63:
                raise _refuse(text, "so large a number")
        case ast.Name(id=name) if not name.startswith("__"):
            if name != "pi":
                names.add(name)
        case ast.UnaryOp(op=op, operand=part) if type(op) in _UNARY:
            _check(part, text, names, depth + 1)
        case ast.BinOp(left=left, op=op, right=right) if type(op) in _BINARY:
            _check(left, text, names, depth + 1)
            _check(right, text, names, depth + 1)
        case ast.BoolOp(values=parts):
            for part in parts:
                _check(part, text, names, depth + 1)
        case ast.Compare(left=left, ops=[op], comparators=[right]) if type(op) in _COMPARE:
            category = isinstance(right, ast.Constant) and isinstance(right.value, str)
            if category and not (isinstance(left, ast.Name) and isinstance(op, ast.Eq | ast.NotEq)):
                raise _refuse(text, f"'{ast.unparse(node)}'")
            _check(left, text, names, depth + 1)
            if not category:
                _check(right, text, names, depth + 1)
        case ast.Call(func=ast.Name(id=name), args=arguments, keywords=[]) if name in FUNCTIONS:
            wanted = FUNCTIONS[name][1]
            if len(arguments) != wanted:
                raise ConfigError(f"formula {text!r}: {name} takes {wanted} values, {len(arguments)} given.")
            for part in arguments:
                _check(part, text, names, depth + 1)
        case _:
            raise _refuse(text, f"'{ast.unparse(node)}'")


def _value(node: ast.expr, channels: Mapping[str, np.ndarray]):
    match node:
        case ast.Constant(value=str() as value):
            return value
        case ast.Constant(value=value):
            return np.float64(value)  # never a Python int: 9**9**9 is then infinity at once
        case ast.Name(id="pi"):
            return np.float64(np.pi)
        case ast.Name(id=name):
            return np.asarray(channels[name])
        case ast.UnaryOp(op=op, operand=part):
            return _UNARY[type(op)](_number(part, channels))
        case ast.BinOp(left=left, op=op, right=right):
            return _BINARY[type(op)](_number(left, channels), _number(right, channels))
        case ast.BoolOp(op=op, values=parts):
            join = np.logical_and if isinstance(op, ast.And) else np.logical_or
            return join.reduce(np.broadcast_arrays(*(_value(part, channels) for part in parts)))
        case ast.Compare(left=left, ops=[op], comparators=[right]):
            if isinstance(right, ast.Constant) and isinstance(right.value, str):
                return _COMPARE[type(op)](np.asarray(channels[left.id]).astype(str), right.value)
            return _COMPARE[type(op)](_number(left, channels), _number(right, channels))
        case ast.Call(func=ast.Name(id="where"), args=[when, yes, no]):
            return np.where(_value(when, channels), _number(yes, channels), _number(no, channels))
        case ast.Call(func=ast.Name(id=name), args=arguments):
            return FUNCTIONS[name][0](*(_number(part, channels) for part in arguments))
    raise ConfigError(f"'{type(node).__name__}' is not allowed.")  # unreachable after `parse_formula`


def _number(node: ast.expr, channels: Mapping[str, np.ndarray]) -> np.ndarray:
    return np.asarray(_value(node, channels), dtype=float)
