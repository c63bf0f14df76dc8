"""Safe expressions of a rig config: `(force_raw - pressure_bar * 1e5 * pi * (0.0257 / 2) ** 2)`.

A config is a text file that people pass around, so an expression is never run as Python: it is parsed into a tree,
every node of the tree is checked against a short list, and only numbers and arrays are ever computed with.
"""

from __future__ import annotations

import ast
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from sealfit.errors import ConfigError

MAX_CHARACTERS = 1000  # nobody writes a longer one by hand; keeps the parser's memory bounded
MAX_DEPTH = 60  # nesting; keeps the walk far below Python's recursion limit

CONSTANTS = {"pi": np.pi}
FUNCTIONS = {  # name: (function, fewest arguments, most arguments)
    "abs": (np.abs, 1, 1),
    "sqrt": (np.sqrt, 1, 1),
    "min": (lambda *values: _fold(np.minimum, values), 2, 20),
    "max": (lambda *values: _fold(np.maximum, values), 2, 20),
}
_BINARY = {
    ast.Add: np.add,
    ast.Sub: np.subtract,
    ast.Mult: np.multiply,
    ast.Div: np.divide,
    ast.Pow: np.power,
}
_UNARY = {ast.USub: np.negative, ast.UAdd: np.positive}
_COMPARE = {
    ast.Lt: np.less,
    ast.LtE: np.less_equal,
    ast.Gt: np.greater,
    ast.GtE: np.greater_equal,
    ast.Eq: np.equal,
    ast.NotEq: np.not_equal,
}
_ALLOWED = "Allowed are numbers, column names, + - * / **, parentheses, pi, abs, min, max, sqrt"


@dataclass(frozen=True, slots=True)
class Expression:
    """A checked expression: its text, its tree, and the names (columns, parts, constants) it reads."""

    text: str
    tree: ast.expr
    names: frozenset[str]


@lru_cache(maxsize=256)
def parse(text: str, *, condition: bool = False) -> Expression:
    """Return the checked expression in `text`.

    Parameters
    ----------
    text : str
        For example `"-torque_pct * 9.84 / 100"`; with `condition`, `"load_N > 4.9 and time_s < 60"`.
    condition : bool
        True for a row filter: comparisons joined by `and`, `or`, `not` are then required; otherwise they are refused.

    Raises
    ------
    ConfigError
        If the text is no expression, or holds a piece that is not allowed; the message names that piece.

    Examples
    --------
    >>> sorted(parse("(a + 2) * pi").names)
    ['a']
    >>> parse("open('x')")
    Traceback (most recent call last):
    ...
    sealfit.errors.ConfigError: in "open('x')": function 'open' is not allowed. Allowed are numbers, column names, \
+ - * / **, parentheses, pi, abs, min, max, sqrt.
    """
    if len(text) > MAX_CHARACTERS:
        raise ConfigError(f"an expression of {len(text)} characters.", fix=f"Keep it below {MAX_CHARACTERS}.")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # "1if": a remark of Python's about text that is refused below anyway
            tree = ast.parse(text.strip(), mode="eval").body
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
        reason = getattr(error, "msg", None) or "it is nested too deeply"
        raise ConfigError(f"{text!r} is not an expression: {reason}.", fix=_fix(condition)) from error
    names: set[str] = set()
    (_check_condition if condition else _check_number)(tree, text, names, 0)
    return Expression(text, tree, frozenset(names))


def evaluate(expression: Expression, values: Mapping[str, object]) -> np.ndarray:
    """Return the expression's value: an array of shape (n,), or of shape () if only constants are read.

    Arithmetic is in double precision; what is undefined (0/0, the root of a negative number) gives NaN and what is too
    large gives infinity, without a warning: the rows concerned are reported where cells are checked.

    Raises
    ------
    ConfigError
        If a name is not in `values`, or stands for text.
    """
    for name in sorted(expression.names):
        if name not in values:
            known = ", ".join(sorted(values)) or "none"
            raise ConfigError(
                f"in {expression.text!r}: there is no column '{name}'.", column=name, fix=f"Known: {known}."
            )
        if np.asarray(values[name]).dtype.kind not in "fiub":
            raise ConfigError(
                f"in {expression.text!r}: '{name}' is text, not a number.", column=name, fix="Map it to numbers first."
            )
    with np.errstate(all="ignore"):
        return np.asarray(_value(expression.tree, values))


def _fix(condition: bool) -> str:
    return _ALLOWED + (", and comparisons joined by and, or, not." if condition else ".")


def _refuse(text: str, piece: str, condition: bool = False) -> ConfigError:
    return ConfigError(f'in "{text}": {piece} is not allowed.', fix=_fix(condition))


def _fold(function, values):
    result = values[0]
    for value in values[1:]:
        result = function(result, value)
    return result


def _check_depth(text: str, depth: int) -> None:
    if depth > MAX_DEPTH:
        raise _refuse(text, f"nesting deeper than {MAX_DEPTH}")


def _check_condition(node: ast.expr, text: str, names: set[str], depth: int) -> None:
    _check_depth(text, depth)
    match node:
        case ast.BoolOp(values=parts):
            for part in parts:
                _check_condition(part, text, names, depth + 1)
        case ast.UnaryOp(op=ast.Not(), operand=part):
            _check_condition(part, text, names, depth + 1)
        case ast.Compare(left=left, ops=ops, comparators=rights):
            for op in ops:
                if type(op) not in _COMPARE:
                    raise _refuse(text, f"comparison '{_WORDS.get(type(op), type(op).__name__)}'", True)
            for part in (left, *rights):
                _check_number(part, text, names, depth + 1)
        case _:
            _check_number(node, text, names, depth + 1)  # refuses with its own words what is not even a number
            raise ConfigError(
                f"in \"{text}\": '{ast.unparse(node)}' compares nothing.", fix="Write for example load_N > 4.9."
            )


_WORDS = {ast.Is: "is", ast.IsNot: "is not", ast.In: "in", ast.NotIn: "not in"}
_OPERATORS = {
    ast.FloorDiv: "//",
    ast.Mod: "%",
    ast.MatMult: "@",
    ast.BitAnd: "&",
    ast.BitOr: "|",
    ast.BitXor: "^",
    ast.LShift: "<<",
    ast.RShift: ">>",
    ast.Invert: "~",
    ast.Not: "not",
}
_PIECES = {
    ast.Attribute: "a dot (attribute)",
    ast.Subscript: "an index in brackets",
    ast.Lambda: "lambda",
    ast.IfExp: "if ... else",
    ast.NamedExpr: "an assignment",
    ast.BoolOp: "and/or outside a row filter",
    ast.Compare: "a comparison outside a row filter",
    ast.JoinedStr: "text",
    ast.Starred: "a star",
}


def _check_number(node: ast.expr, text: str, names: set[str], depth: int) -> None:
    _check_depth(text, depth)
    match node:
        case ast.Constant(value=value):
            if isinstance(value, bool) or not isinstance(value, int | float):
                raise _refuse(text, f"the value {value!r}")
            try:
                float(value)
            except OverflowError as error:
                raise _refuse(text, "so large a number") from error
        case ast.Name(id=name):
            if name.startswith("__"):
                raise _refuse(text, f"name '{name}'")
            if name not in CONSTANTS:
                names.add(name)
        case ast.UnaryOp(op=op, operand=part):
            if type(op) not in _UNARY:
                raise _refuse(text, f"'{_OPERATORS.get(type(op), type(op).__name__)}'")
            _check_number(part, text, names, depth + 1)
        case ast.BinOp(left=left, op=op, right=right):
            if type(op) not in _BINARY:
                raise _refuse(text, f"'{_OPERATORS.get(type(op), type(op).__name__)}'")
            _check_number(left, text, names, depth + 1)
            _check_number(right, text, names, depth + 1)
        case ast.Call(func=function, args=arguments, keywords=keywords):
            if not isinstance(function, ast.Name) or function.id not in FUNCTIONS:
                raise _refuse(text, f"function '{ast.unparse(function)}'")
            if keywords:
                raise _refuse(text, f"the named argument '{keywords[0].arg}'")
            _, fewest, most = FUNCTIONS[function.id]
            if not fewest <= len(arguments) <= most:
                wanted = str(fewest) if fewest == most else f"{fewest} to {most}"
                raise ConfigError(f'in "{text}": {function.id} takes {wanted} values, {len(arguments)} given.')
            for part in arguments:
                _check_number(part, text, names, depth + 1)
        case _:
            raise _refuse(text, _PIECES.get(type(node), f"'{ast.unparse(node)}' ({type(node).__name__})"))


def _value(node: ast.expr, values: Mapping[str, object]):
    match node:
        case ast.Constant(value=value):
            return np.float64(value)  # never a Python int: 9**9**9 is then infinity at once, not hours of digits
        case ast.Name(id=name):
            return np.float64(CONSTANTS[name]) if name in CONSTANTS else np.asarray(values[name], dtype=float)
        case ast.UnaryOp(op=ast.Not(), operand=part):
            return np.logical_not(_value(part, values))
        case ast.UnaryOp(op=op, operand=part):
            return _UNARY[type(op)](_value(part, values))
        case ast.BinOp(left=left, op=op, right=right):
            return _BINARY[type(op)](_value(left, values), _value(right, values))
        case ast.Call(func=ast.Name(id=name), args=arguments):
            return FUNCTIONS[name][0](*(_value(part, values) for part in arguments))
        case ast.BoolOp(op=op, values=parts):
            join = np.logical_and if isinstance(op, ast.And) else np.logical_or
            return _fold(join, [_value(part, values) for part in parts])
        case ast.Compare(left=left, ops=ops, comparators=rights):
            sides = [_value(part, values) for part in (left, *rights)]
            tests = [_COMPARE[type(op)](a, b) for op, a, b in zip(ops, sides, sides[1:], strict=False)]
            return _fold(np.logical_and, tests)
    raise ConfigError(f"'{type(node).__name__}' is not allowed.")  # unreachable after `parse`; refuse all the same
