"""Arithmetic expressions in the values of changes: `{population_size * 2}`.

A text is literal except for `{expression}`; `{{` and `}}` are literal braces. An expression may contain numbers, the given
names, `+ - * / // % **`, parentheses, the functions in FUNCTIONS, and `pi` (unless it is a given name). It has the same meaning
as in Python, with two differences. A division of whole numbers with a whole result is whole (`{8 / 2}` is `4`, `{7 / 2}` is
`3.5`). No intermediate value may be infinite, not a number, complex, or a whole number of more than MAX_BITS bits. A result
that is not 0, but too close to 0 for a float, is refused; within `1 + exp(-1000)` it is 0. Whole numbers are written with all
their digits, others as Python's `repr`. A single name may also stand for a text: `{scenario}`.

Python's `eval` is not used: the syntax tree is walked, and everything that is not listed here is refused.
"""

from __future__ import annotations

import ast
import difflib
import math
import operator
import re
import warnings
from collections.abc import Callable, Iterable, Mapping
from functools import lru_cache

from sierra.errors import ConfigError
from sierra.model import Value
from sierra.util.float_range import TOO_LARGE, TOO_SMALL, out_of_range
from sierra.util.lazy_definitions import dataclass, regex

MAX_LENGTH = 200
"""Maximum number of characters of one expression; this limits its nesting depth."""
MAX_BITS = 1024
"""Maximum number of bits of a whole number; this is about the size of the largest float."""
_PLAIN = 1 << 62

Number = int | float

_PIECE = regex(r"\{\{|\}\}|\{([^{}]*)\}|[{}]")
CHOSEN = ("controller", "scenario")
"""Names that have a value only if the user chooses one."""
_CONSTANTS: Mapping[str, Number] = {"pi": math.pi}


@dataclass(frozen=True, slots=True)
class _Expression:
    text: str
    tree: ast.expr


def fill(text: str, values: Mapping[str, Value]) -> str:
    """Return `text` with each `{expression}` replaced by its value. Raises ConfigError for one without a finite value."""
    if "{" not in text and "}" not in text:
        return text
    return "".join([piece if isinstance(piece, str) else _text(piece, values) for piece in _parse(text)])


def names(text: str) -> frozenset[str]:
    """Return the names in a text's expressions, without functions and `pi`. Raises ConfigError like `fill`."""
    trees = (piece.tree for piece in _parse(text) if not isinstance(piece, str))
    return frozenset(name for tree in trees for name in _names(tree)) - _CONSTANTS.keys()


def number(expression: str, values: Mapping[str, Value]) -> Number:
    """Return the value of one expression without braces. Raises ConfigError if it has no finite value.

    A value that is too close to 0 for a float is 0, as a prediction needs it; `fill` refuses it.
    """
    result = _number(_single(expression), values)
    return 0.0 if isinstance(result, _Vanished) else result


def names_in(expression: str) -> frozenset[str]:
    """Return the names in one expression without braces, without functions and `pi`. Raises ConfigError if it is none."""
    return frozenset(_names(_single(expression).tree)) - _CONSTANTS.keys()


@lru_cache(maxsize=256)
def _single(expression: str) -> _Expression:
    return _Expression(expression, _tree(expression, expression))


@lru_cache(maxsize=4096)
def _parse(text: str) -> tuple[str | _Expression, ...]:
    """Return the literal parts and the expressions of a text, in order."""
    pieces: list[str | _Expression] = []
    end = 0
    for match in _PIECE.finditer(text):
        pieces.append(text[end : match.start()])
        pieces.append(_piece(match, text))
        end = match.end()
    pieces.append(text[end:])
    return tuple(piece for piece in pieces if piece != "")


def _piece(match: re.Match[str], text: str) -> str | _Expression:
    found = match.group()
    if found in ("{{", "}}"):
        return found[0]
    if match[1] is None:
        raise ConfigError(f"{text!r} has an unmatched brace; write {found * 2} for a literal {found}")
    return _Expression(found, _tree(match[1], found))


def _tree(source: str, shown: str) -> ast.expr:
    source = " ".join(source.split())
    if not source:
        raise ConfigError(f"{shown!r} contains no expression; write {{{{ and }}}} for literal braces")
    if len(source) > MAX_LENGTH:
        raise ConfigError(f"{shown[:40] + '…'!r} is longer than {MAX_LENGTH} characters")
    if source.isidentifier():  # so that a variable may have the name `lambda`
        return ast.Name(source)
    try:
        with warnings.catch_warnings(action="ignore"):  # Python's own warnings about unusual literals
            tree = ast.parse(source, mode="eval").body
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
        raise ConfigError(
            f"{shown!r} is not an expression; write one such as {{n * 2}}, or {{{{ and }}}} for braces"
        ) from error
    _allow(tree, shown)
    for node in ast.walk(tree):
        literal = ast.get_source_segment(source, node) if isinstance(node, ast.Constant) else None
        if literal and isinstance(node, ast.Constant) and isinstance(node.value, float) and out_of_range(literal) == TOO_SMALL:
            raise ConfigError(f"{shown!r} has no value: {literal} is too close to 0")
    return tree


def _allow(node: ast.expr, shown: str) -> None:
    """Raise ConfigError for any syntax that this module's docstring does not list."""
    match node:
        case ast.Name():
            return
        case ast.Constant(value=int() | float()) if not isinstance(node.value, bool):
            return
        case ast.UnaryOp(op=ast.USub() | ast.UAdd()):
            _allow(node.operand, shown)
        case ast.BinOp() if type(node.op) in _OPERATORS:
            _allow(node.left, shown)
            _allow(node.right, shown)
        case ast.Call(func=ast.Name(id=name), keywords=[]):
            if name not in FUNCTIONS:
                raise ConfigError(f"unknown function {name!r} in {shown!r}{_nearest(name, FUNCTIONS)}")
            for argument in node.args:
                _allow(argument, shown)
        case _:
            allowed = f"numbers, names, + - * / // % ** and {', '.join(FUNCTIONS)}"
            raise ConfigError(f"{ast.unparse(node)!r} is not allowed in {shown!r}; allowed: {allowed}")


def _names(tree: ast.expr) -> Iterable[str]:
    functions = {node.func for node in ast.walk(tree) if isinstance(node, ast.Call)}
    return (node.id for node in ast.walk(tree) if isinstance(node, ast.Name) and node not in functions)


def _text(expression: _Expression, values: Mapping[str, Value]) -> str:
    tree = expression.tree
    known = values.get(tree.id) if isinstance(tree, ast.Name) else None
    if isinstance(known, str):
        return known
    if type(known) is int and -_PLAIN < known < _PLAIN:  # usually a seed; this fast path matters for 100,000 runs
        return repr(known)
    result = _number(expression, values)
    if isinstance(result, _Vanished):
        raise ConfigError(f"{expression.text!r} has no value: {TOO_SMALL}")
    return repr(result)


def _number(expression: _Expression, values: Mapping[str, Value]) -> Number:
    try:
        return _value(expression.tree, values)
    except ArithmeticError as error:
        reason = "division by zero" if isinstance(error, ZeroDivisionError) else TOO_LARGE
        raise ConfigError(f"{expression.text!r} has no value: {reason}") from error
    except (ValueError, TypeError) as error:
        raise ConfigError(f"{expression.text!r} has no value: {error}") from error
    except LookupError as error:
        name = str(error.args[0])
        if name in CHOSEN:
            right = f'write --{name} NAME, or {name} = "NAME" in sierra.toml'
            raise ConfigError(f"{expression.text!r} has no value: no {name} is chosen; {right}") from None
        raise ConfigError(f"unknown name {name!r} in {expression.text!r}{_nearest(name, values)}") from None


def _value(node: ast.expr, values: Mapping[str, Value]) -> Number:
    """Return the value of an allowed tree. Raises LookupError for a name, ArithmeticError, ValueError, TypeError."""
    match node:
        case ast.Name():
            return _bounded(_named(node.id, values))
        case ast.Constant(value=int() | float() as number):
            return _bounded(number)
        case ast.UnaryOp(op=op):
            inner = _value(node.operand, values)
            return inner if isinstance(inner, _Vanished) else -inner if isinstance(op, ast.USub) else inner
        case ast.BinOp(op=op):
            left, right = _value(node.left, values), _value(node.right, values)
            result = _bounded(_OPERATORS[type(op)](left, right))
            return _Vanished() if result == 0 and _vanishes(op, left, right) else result
        case ast.Call(func=ast.Name(id=name)):
            arguments = [_value(argument, values) for argument in node.args]
            result = _bounded(FUNCTIONS[name](*arguments))
            vanished = name == "exp" or (name in _KEEPING and any(isinstance(value, _Vanished) for value in arguments))
            return _Vanished() if result == 0 and vanished else result
    raise TypeError(f"{ast.unparse(node)!r} is not allowed")


class _Vanished(float):
    """A 0 in place of a number that is too close to 0 for a float."""


_KEEPING = ("abs", "min", "max", "sin", "sqrt")
"""Functions whose result is 0 only if an argument is."""


def _vanishes(op: ast.operator, left: Number, right: Number) -> bool:
    """Return True if the result 0 of an operation stands for a number that is not 0."""
    lost = isinstance(left, _Vanished) or isinstance(right, _Vanished)
    match op:
        case ast.Mult():
            return all(value or isinstance(value, _Vanished) for value in (left, right))
        case ast.Div() | ast.Pow():
            return bool(left) or isinstance(left, _Vanished)
    return lost and isinstance(op, ast.Add | ast.Sub)


def _named(name: str, values: Mapping[str, Value]) -> Number:
    value = values[name] if name in values else _CONSTANTS[name]
    if isinstance(value, str):
        raise TypeError(f"{name!r} is the text {value!r}, not a number")
    return value


def _bounded(value: Number | complex) -> Number:
    if type(value) is int:
        if value.bit_length() > MAX_BITS:
            raise OverflowError
        return value
    if isinstance(value, complex):
        raise ValueError("it is a complex number")
    if not math.isfinite(value):
        raise OverflowError
    return float(value)


def _divide(left: Number, right: Number) -> Number:
    if isinstance(left, int) and isinstance(right, int) and left % right == 0:
        return left // right
    return left / right


def _power(base: Number, exponent: Number) -> Number | complex:
    """Return a power; a result that would be too large is refused before it is calculated."""
    whole = isinstance(base, int) and isinstance(exponent, int)
    if whole and exponent * (int(abs(base)).bit_length() - 1) > MAX_BITS:
        raise OverflowError
    return base**exponent


def _round(value: Number, digits: Number | None = None) -> Number:
    """Return a rounded number, like Python's `round`: whole if `digits` is missing.

    More digits than a float can have are refused, because rounding would take for ever.
    """
    if digits is not None and (not isinstance(digits, int) or abs(digits) > 400):
        raise ValueError(f"cannot round to {digits!r} digits")
    return round(value, digits)


def _extreme(choose: Callable[..., Number]) -> Callable[..., Number]:
    def extreme(*of: Number) -> Number:
        if not of:
            raise TypeError("min() and max() need a number")
        return choose(of)

    return extreme


FUNCTIONS: Mapping[str, Callable[..., Number]] = {
    "min": _extreme(min),
    "max": _extreme(max),
    "round": _round,
    "floor": math.floor,
    "ceil": math.ceil,
    "sqrt": math.sqrt,
    "abs": abs,
    "log": math.log,
    "exp": math.exp,
    "sin": math.sin,
    "cos": math.cos,
}
"""The functions of expressions; `log(x, base)` and `round(x, digits)` work as in Python."""

_OPERATORS: Mapping[type[ast.operator], Callable[[Number, Number], Number | complex]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: _divide,
    ast.FloorDiv: operator.floordiv,
    ast.Mod: operator.mod,
    ast.Pow: _power,
}


def _nearest(name: str, known: Iterable[str]) -> str:
    known = sorted(known)
    close = difflib.get_close_matches(name, known, 1)
    hint = f"; did you mean {close[0]!r}?" if close else ";"
    return f"{hint} known are {', '.join(known)}" if known else "; no names are available here"
