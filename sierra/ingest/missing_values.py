"""Values that stand for a missing one, as `na` of `[outputs.NAME]` lists them: texts such as `NA`, and numbers such as -1.

A number matches each cell that has this number: -1, -1.0 and -1.00. In formats other than CSV, so does a text that is a number,
because their numbers have no text of their own. In a CSV, a text matches only the cells that are written in the same way.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from decimal import Decimal, InvalidOperation

from sierra.store.sql_names import quote
from sierra.store.type_inference import as_float, is_number, is_whole

Value = str | float


class MissingValues:
    """The values that stand for a missing one; without any, nothing does."""

    def __init__(self, na: Sequence[Value], *, as_written: bool = False) -> None:
        """`as_written`: texts match only texts that are the same, also if they are numbers."""
        self._texts = frozenset(value.strip() for value in na if isinstance(value, str))
        some = [value for value in na if not (as_written and isinstance(value, str))]
        self._numbers = tuple(number for value in some if (number := _number(str(value))) is not None)

    def __bool__(self) -> bool:
        return bool(self._texts or self._numbers)

    def has(self, cell: str) -> bool:
        """Check if the text of a cell stands for a missing value."""
        bare = cell.strip()
        if bare in self._texts:
            return True
        if not self._numbers or not bare:
            return False
        number = _number(bare)
        return number is not None and any(_same(number, missing) for missing in self._numbers)

    def has_value(self, value: object) -> bool:
        """Check if a value of JSON or the like stands for a missing one."""
        match value:
            case bool():
                return ("true" if value else "false") in self._texts
            case str() | int() | float() | Decimal():
                return self.has(str(value))
        return False

    def condition(self, column: str, kind: str) -> str:
        """Return the SQL condition that a value of a column of this type stands for a missing one; "" if none can.

        Values within lists stay.
        """
        if kind.endswith("]"):
            return ""
        if is_number(kind):
            return " OR ".join(self._number_conditions(column, kind))
        text = column if kind == "VARCHAR" else f"CAST({column} AS VARCHAR)"
        conditions = [f"trim({text}) IN ({', '.join(map(quote, sorted(self._texts)))})"] if self._texts else []
        if kind == "VARCHAR" and self._numbers:
            values = (f"TRY_CAST(trim({text}) AS DOUBLE) = {_double(number)}" for number in self._numbers)
            conditions += [f"(NOT contains({text}, '_') AND ({' OR '.join(values)}))"]
        return " OR ".join(conditions)

    def _number_conditions(self, column: str, kind: str) -> Iterator[str]:
        for number in self._numbers:
            if not number.is_finite():
                if kind in ("DOUBLE", "FLOAT"):
                    yield f"{column} = {_double(number)}"
            elif kind in ("DOUBLE", "FLOAT"):
                yield f"{column} = CAST({_double(number)} AS {kind})"
            elif not is_whole(kind):
                yield f"{column}::DOUBLE = {_double(number)}"
            elif number == number.to_integral_value():
                yield f"{column} = TRY_CAST({quote(str(int(number)))} AS {kind})"


def _number(text: str) -> Decimal | None:
    """Return the number that a text is, exactly; None if it is none."""
    if (special := as_float(text)) is None:
        return None
    if not math.isfinite(special):
        return Decimal(str(special))
    try:
        return Decimal(text.strip())
    except InvalidOperation:
        return None


def _same(first: Decimal, second: Decimal) -> bool:
    return first == second or (first.is_nan() and second.is_nan())


def _double(number: Decimal) -> str:
    return f"{quote(str(number).lower().replace('infinity', 'inf'))}::DOUBLE"
