"""Safe expressions of rig configs and SPECs: `(force_raw - pressure_bar * 1e5 * pi * (0.0257 / 2) ** 2)`.

People pass these files around, so an expression is never run as Python: every node of its tree is checked
against a short list, and only numbers and arrays are ever computed with.
"""

import ast
import math
import warnings
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime
from functools import lru_cache, reduce

import numpy as np

from sealfit.errors import ConfigError, nearest

MAX_CHARACTERS = 1000  # nobody writes a longer expression by hand, and the parser's memory is bounded
MAX_DEPTH = 60  # of nesting: keeps the walk far below Python's recursion limit
_OF_ONE = ("abs", "sqrt", "exp", "log", "sin", "cos", "tanh", "sign")
FUNCTIONS = {  # name: (function, fewest arguments, most arguments)
    **{name: (getattr(np, name), 1, 1) for name in _OF_ONE},
    "min": (lambda *values: reduce(np.minimum, values), 2, 20),
    "max": (lambda *values: reduce(np.maximum, values), 2, 20),
    "where": (np.where, 3, 3),
}
_OPERATORS = {
    ast.Add: np.add,
    ast.Sub: np.subtract,
    ast.Mult: np.multiply,
    ast.Div: np.divide,
    ast.Pow: np.power,
    ast.USub: np.negative,
    ast.UAdd: np.positive,
    ast.And: np.logical_and,
    ast.Or: np.logical_or,
    ast.Not: np.logical_not,
    ast.Lt: np.less,
    ast.LtE: np.less_equal,
    ast.Gt: np.greater,
    ast.GtE: np.greater_equal,
    ast.Eq: np.equal,
    ast.NotEq: np.not_equal,
}
_FIX = (
    "Allowed are numbers, column names, pi, + - * / **, parentheses, comparisons, and, or, not, "
    f"a category as in batch == 'B', days of a column of dates, and {', '.join(FUNCTIONS)}."
)
GERMAN = "%d.%m.%Y"
Values = Mapping[str, object]
Computed = Callable[[Values], np.ndarray]


@dataclass(frozen=True, slots=True)
class Expression:
    """A checked expression: its text, the columns it reads, what computes it, and the columns of numbers."""

    text: str
    names: frozenset[str]
    compute: Computed
    numbers: Collection[str]


@lru_cache(maxsize=256)
def parse(text: str, *, condition: bool = False) -> Expression:
    """Return the checked expression in `text`.

    Parameters
    ----------
    text : str
        For example `"-torque_pct * 9.84 / 100"`; with `condition`, `"load_N > 4.9 and time_s < 60"`.
    condition : bool
        Whether it must be a condition; a comparison in a number counts 1 where it holds and 0 where it does
        not.

    Raises
    ------
    ConfigError
        If the text is no expression, or holds a piece that is not allowed; the message names that piece.

    Examples
    --------
    >>> sorted(parse("(a + 2) * pi").names)
    ['a']
    >>> evaluate(parse("where(batch == 'B', 2, 1) * (x > 0)"), {"batch": ["A", "B"], "x": 1.0})
    array([1., 2.])
    """
    if len(text) > MAX_CHARACTERS:
        raise ConfigError(f"an expression of {len(text)} characters.", fix=f"Keep it below {MAX_CHARACTERS}.")
    try:
        with warnings.catch_warnings():
            # "1if": a remark of Python's about text that is refused below anyway.
            warnings.simplefilter("ignore")
            tree = ast.parse(text.strip(), mode="eval").body
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
        reason = getattr(error, "msg", None) or "it is nested too deeply"
        raise ConfigError(f"{text!r} is not an expression: {reason}.", fix=_FIX) from error
    checked = _Checked(text)
    compute, names = checked.number(tree, 0), frozenset(checked.numbers | checked.labels)
    if not condition:
        return Expression(text, names, compute, checked.numbers)
    checked.require_conditions([tree])
    return Expression(text, names, lambda values: compute(values) != 0.0, checked.numbers)


def require_columns(expression: Expression, known: Collection[str]) -> None:
    """Raise ConfigError if an expression reads a column that is not known."""
    for name in sorted(expression.names):
        if name not in known:
            fix = f"Did you mean '{close}'? " if (close := nearest(name, known)) else ""
            fix += f"Known: {', '.join(sorted(known)) or 'none'}."
            raise ConfigError(f"in {expression.text!r}: there is no column '{name}'.", column=name, fix=fix)


def read_by(compute: Mapping[str, str]) -> set[str]:
    """Return the columns that any of a config's expressions reads."""
    return set().union(*(parse(text).names for text in compute.values()))


def evaluate(expression: Expression, values: Values) -> np.ndarray:
    """Return the expression's value: an array of shape (n,), or of shape () if only constants are read.

    What is undefined (0/0, the root of a negative number) is NaN and what is too large infinity, without a
    warning; the text "" is NaN. ConfigError if a name is not in `values`, or stands for text where a number
    is wanted.
    """
    require_columns(expression, values)
    with np.errstate(all="ignore"):
        return np.asarray(expression.compute(values))


class _Checked:
    """Builds what computes an expression, node by node, and refuses what is not on the list."""

    def __init__(self, text: str) -> None:
        self.text, self.numbers, self.labels = text, set(), set()

    def number(self, node: ast.expr, depth: int) -> Computed:
        """Return what computes a number; a condition gives 1 or 0."""
        if depth > MAX_DEPTH:
            raise self.refusal(f"nesting deeper than {MAX_DEPTH}")
        match node:
            case ast.Constant(value=float() as known):
                return lambda values: np.float64(known)
            case ast.Constant(value=int() as known) if not isinstance(known, bool) and abs(known) < 2**1023:
                return lambda values: np.float64(known)  # never a Python int: 9**9**9 is infinity at once
            case ast.Name(id="pi"):
                return lambda values: np.float64(np.pi)
            case ast.Name(id=name) if not name.startswith("__"):
                self.numbers.add(name)
                return lambda values: _as_number(values[name], name, self.text)
            case ast.Call(func=ast.Name(id="days"), args=[ast.Name(id=name)], keywords=[]):
                self.numbers.add(name)
                return lambda values: np.vectorize(_day, otypes=[float])(values[name])
            case ast.Compare(
                left=ast.Name(id=name),
                ops=[ast.Eq() | ast.NotEq() as op],
                comparators=[ast.Constant(value=str() as label)],
            ) if not name.startswith("__"):
                self.labels.add(name)
                compared = _OPERATORS[type(op)]
                return lambda values: compared(_as_text(values[name]), label).astype(float)
        function, parts = self.operation(node)
        inner = [self.number(part, depth + 1) for part in parts]
        return lambda values: np.asarray(function(*(part(values) for part in inner)), float)

    def operation(self, node: ast.expr) -> tuple[Callable, list[ast.expr]]:
        """Return the function that a node computes, and its arguments."""
        match node:
            case ast.UnaryOp(op=op, operand=part) if type(op) in _OPERATORS:
                if isinstance(op, ast.Not):
                    self.require_conditions([part])
                return _OPERATORS[type(op)], [part]
            case ast.BinOp(left=left, op=op, right=right) if type(op) in _OPERATORS:
                return _OPERATORS[type(op)], [left, right]
            case ast.BoolOp(op=op, values=parts):
                self.require_conditions(parts)
                return lambda *values: reduce(_OPERATORS[type(op)], values), parts
            case ast.Compare(left=left, ops=ops, comparators=sides) if set(map(type, ops)) <= set(_OPERATORS):
                return lambda *values: _compared(ops, values), [left, *sides]
            case ast.Call(func=ast.Name(id=name), args=arguments, keywords=[]) if name in FUNCTIONS:
                function, fewest, most = FUNCTIONS[name]
                if fewest <= len(arguments) <= most:
                    return function, arguments
                wanted = str(fewest) if fewest == most else f"{fewest} to {most}"
                reason = f'in "{self.text}": {name} takes {wanted} values, {len(arguments)} given.'
                raise ConfigError(reason, fix=_FIX)
        raise self.refusal(f"'{ast.unparse(node)}'")

    def require_conditions(self, nodes: Sequence[ast.expr]) -> None:
        """Raise ConfigError for a number where a condition is wanted."""
        for node in nodes:
            negated = isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not)
            if not (negated or isinstance(node, ast.Compare | ast.BoolOp)):
                reason = f"in \"{self.text}\": '{ast.unparse(node)}' compares nothing."
                raise ConfigError(reason, fix="Write for example load_N > 4.9.")

    def refusal(self, piece: str) -> ConfigError:
        """Return the error that names what is not allowed."""
        return ConfigError(f'in "{self.text}": {piece} is not allowed.', fix=_FIX)


def _as_number(value: object, name: str, text: str) -> np.ndarray:
    array = np.asarray(np.nan if isinstance(value, str) and value == "" else value)
    if array.dtype.kind not in "fiub":
        fix = f"Compare it: {name} == 'B'. The day of a date is days({name}). Or map a part of file names to "
        fix += "numbers under [files.values]; run_id, specimen_id and started_at stay text."
        raise ConfigError(f"in {text!r}: '{name}' is text, not a number.", column=name, fix=fix)
    return array.astype(float, copy=False)


def _as_text(value: object) -> np.ndarray:
    array = np.asarray(value)
    return np.char.mod("%.12g", array) if array.dtype.kind in "fiu" else array.astype(str)


def _day(date: object) -> float:
    """Return the number of the day of a date, ISO 8601 or as 17.04.2025, without its time; NaN for others.

    >>> _day("2025-04-17 08:07") - _day("10.04.2025")
    7.0
    """
    with suppress(ValueError):
        return float(datetime.fromisoformat(str(date)).toordinal())
    with suppress(ValueError):
        return float(datetime.strptime(str(date).partition(" ")[0], GERMAN).toordinal())
    return math.nan


def _compared(ops: Sequence[ast.cmpop], sides: Sequence[np.ndarray]) -> np.ndarray:
    tests = [_OPERATORS[type(op)](a, b) for op, a, b in zip(ops, sides, sides[1:], strict=False)]
    return reduce(np.logical_and, tests)
