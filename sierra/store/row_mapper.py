"""Rows of statements as instances of classes, checked against what DuckDB returned.

A row class is a NamedTuple. Its fields are the columns of a statement, in the statement's order. Types and NULLs are
checked, so that a row has what its class says, whatever is in the store's files.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from functools import cache, reduce
from operator import itemgetter, or_
from typing import Any, NamedTuple, TypeVar, get_args, get_origin

from sierra.errors import Damaged
from sierra.store.sql_result import INTEGER, NUMBER, Answer

R = TypeVar("R", bound=NamedTuple)
V = TypeVar("V", str, int, float, bool, bytes)

SQL_TYPES = {
    "str": "VARCHAR|JSON",
    "int": INTEGER,
    "float": NUMBER,
    "bool": "BOOLEAN",
    "datetime": "TIMESTAMP WITH TIME ZONE",
    "date": "DATE",
    "bytes": "BLOB",
    "list[str]": r"VARCHAR\[\]",
    "list[int]": rf"({INTEGER})\[\]",
}
"""Regular expressions of DuckDB's types, by the annotation of a field; fields with other annotations take any type."""
OPTIONAL = " | None"
EMPTY = r'|"NULL"|"NULL"\[\]'
"""The types of columns that hold nothing but NULL."""


def typed(kind: type[R], answer: Answer) -> list[R]:
    """Return the rows of a result as instances of `kind`.

    Raises TypeError if the statement has other columns, and Damaged for a NULL that `kind` does not allow, also within a list.
    """
    fields = _fields(kind)
    check_columns(kind.__name__, fields, answer)
    rows = answer.rows()
    for index, (name, annotation) in enumerate(fields):
        column = list(map(itemgetter(index), rows))
        lacks = not annotation.endswith(OPTIONAL) and None in column
        if lacks or (annotation.startswith("list[") and any(value is not None and None in value for value in column)):
            raise Damaged(f"the store cannot be read: a record has no {name!r}; sierra fsck checks the store")
    return list(map(kind._make, rows))


def of_fields(kind: type[R], fields: Mapping[str, object]) -> R:
    """Return an instance of a row class from its fields by name. Raises TypeError if these are not exactly its fields."""
    if fields.keys() != set(kind._fields):
        raise TypeError(f"{kind.__name__} has the fields {kind._fields}, but these are {(*fields,)}")
    return kind._make(fields[name] for name in kind._fields)


def values(kind: type[V], answer: Answer) -> list[V]:
    """Return the values of a result with one column. Raises as `typed` does."""
    check_columns("values", [(answer.columns[0], kind.__name__)], answer)
    rows = answer.rows()
    found = [row[0] for row in rows if isinstance(row[0], kind)]
    if len(found) < len(rows):
        raise Damaged(f"the store cannot be read: a record has no {answer.columns[0]!r}; sierra fsck checks the store")
    return found


def check_columns(name: str, fields: Sequence[tuple[str, str]], answer: Answer) -> None:
    """Raise TypeError if a result has not these columns with these types."""
    if [field for field, _ in fields] != answer.columns:
        raise TypeError(f"{name} has the fields {[field for field, _ in fields]}, but the result has {answer.columns}")
    for (field, annotation), found in zip(fields, answer.types, strict=True):
        wanted = SQL_TYPES.get(annotation.removesuffix(OPTIONAL))
        if wanted is not None and not re.fullmatch(wanted + EMPTY, found):
            raise TypeError(f"{name}.{field} is annotated {annotation}, but the result has {found}")


@cache
def _fields(kind: type[NamedTuple]) -> list[tuple[str, str]]:
    """Return the fields of a row class with their annotations as text."""
    return [(name, _text(annotation)) for name, annotation in kind.__annotations__.items()]


def without_facts(annotation: Any) -> Any:
    """Return a type without what `Annotated` says about it, or about types within it."""
    if hasattr(annotation, "__metadata__"):
        return without_facts(annotation.__origin__)
    inner = get_args(annotation)
    plain = tuple(map(without_facts, inner))
    if plain == inner:
        return annotation
    return list.__class_getitem__(plain) if get_origin(annotation) is list else reduce(or_, plain)


def _text(annotation: object) -> str:
    """Return an annotation as it is written; NamedTuple keeps it as a reference if its module postpones evaluation."""
    annotation = without_facts(annotation)
    if isinstance(annotation, type) and not hasattr(annotation, "__args__"):
        return annotation.__name__
    return str(getattr(annotation, "__forward_arg__", annotation))
