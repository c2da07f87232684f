"""Derived tables that a note proposes, for data of which there is no default figure."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence

from sierra.store.batch_data import BatchData, OutputTable
from sierra.store.sql_names import identifier, quote, row_name
from sierra.store.time_axis import names_time
from sierra.util.text import few

SHOWN = 5
"""The largest number of columns that a note names."""
RESERVED = "SELECT 1 FROM duckdb_keywords() WHERE keyword_name = lower($name) AND keyword_category = 'reserved'"


def notes(batch: BatchData, output: OutputTable, time: str) -> Sequence[str]:
    """Return a note on the columns of an output that are no numbers, apart from its time; none if there is no such column."""
    others = {column: kind for column, kind in output.others.items() if column != time}
    if not others:
        return []
    called = few([repr(column) for column in others], SHOWN)
    which = f"no figure of {called} of output {output.name!r}: no {'number' if len(others) == 1 else 'numbers'}"
    if (example := _example(batch, output.name, others)) is None:
        return [which]
    column, expression, name = example
    table = _name(batch, output.name)
    sql = f"SELECT run, {expression} AS {name} FROM {table} GROUP BY run"  # noqa: S608 - the user may write it
    key = re.sub(r"\W", "_", f"{output.name}_{column}")
    return [f"{which}; a derived table has one, for example: [tables.{key}] sql = {_toml(sql)}"]


def of_single_rows(batch: BatchData, output: OutputTable, time: str) -> str:
    """Return a proposal for an output with several rows per run and time, which makes one row of them.

    It is their mean if another column tells them apart at all times, as the number of a robot does. Otherwise it is the last
    one: a model that writes the values before and after an event never had their mean.
    """
    if not time:
        return ""
    measured = [column for column in output.columns if column != time and not _numbers_rows(batch, output.name, column, time)]
    of_members = len(measured) < len(output.columns) - 1 and not _has_single_rows(batch, output.name, time)
    table, at = (_name(batch, name) for name in (output.name, time))
    if of_members and measured:
        name = _name(batch, measured[0])
        sql = f"SELECT run, {at}, avg({name}) AS {name} FROM {table} GROUP BY run, {at}"  # noqa: S608 - the user may write it
        return f"; or make one row of them, for example: [tables.{output.name}_mean] sql = {_toml(sql)}"
    row = row_name((*batch.axis_names, *output.all_columns))
    sql = f"SELECT * FROM {table} QUALIFY {row} = max({row}) OVER (PARTITION BY run, {at})"  # noqa: S608
    declared = "" if names_time(time) else f", time = {json.dumps(time, ensure_ascii=False)}"
    return f"; or take the last row of each time, for example: [tables.{output.name}_last] sql = {_toml(sql)}{declared}"


def _example(batch: BatchData, table: str, others: Mapping[str, str]) -> tuple[str, str, str] | None:
    """Return a column, an SQL expression that makes a number of it for each run, and a name of this number."""
    for column, kind in others.items():
        name = _name(batch, column)
        if kind == "VARCHAR" and _has_words(batch, table, column):
            value = _most_frequent(batch, table, column)
            if value is not None and len(value) < 40:
                return column, f"avg(({name} = {quote(value)})::INT)", "rate"
        if kind == "VARCHAR" and _has_flags(batch, table, column):
            return column, f"avg((lower(trim({name})) IN ('true', '1'))::INT)", "rate"
        if kind.endswith("[]"):
            return column, f"avg(len({name}))", "length"
        if kind.startswith(("DATE", "TIMESTAMP")):
            return column, f"max(epoch({name}))", "seconds"
        if field := re.match(r'STRUCT\(("(?:[^"]|"")*"|\w+) (?:DOUBLE|FLOAT|U?\w*INT\w*|DECIMAL|BOOLEAN)', kind):
            return column, f"avg({name}.{field[1]})", "mean"
    return None


def _most_frequent(batch: BatchData, table: str, column: str) -> str | None:
    """Return the most frequent text in a column of an output, of several the first; None if there is none."""
    name = identifier(column)
    most = f"WHERE {name} IS NOT NULL GROUP BY ALL ORDER BY count(*) DESC, 1 LIMIT 1"
    return next((str(value) for (value,) in batch.run(f"SELECT {name} FROM {batch.rows(table)} {most}")), None)  # noqa: S608


def _has_words(batch: BatchData, table: str, column: str) -> bool:
    """Check if the texts of a column are words: neither true, false and the like, nor texts with a number at an end."""
    name = f"lower(trim({identifier(column)}))"
    number = f"regexp_matches({name}, '^[-+]?[.]?[0-9]|[(\\[] *[-+]?[.]?[0-9]|^(true|false)$')"
    return not _selects_rows(batch, table, f"WHERE {number}")


def _has_flags(batch: BatchData, table: str, column: str) -> bool:
    """Check if all texts of a column are true, false, 0 or 1."""
    return not _selects_rows(batch, table, f"WHERE lower(trim({identifier(column)})) NOT IN ('true', 'false', '0', '1')")


def _numbers_rows(batch: BatchData, table: str, column: str, time: str) -> bool:
    """Check if whole numbers in a column tell rows of one run and time apart, as the number of a robot does."""
    number, t = identifier(column), identifier(time)
    has_fractions = _selects_rows(batch, table, f"WHERE {number} <> floor({number})")
    return not has_fractions and not _selects_rows(batch, table, f"GROUP BY run, {t}, {number} HAVING count(*) > 1")


def _has_single_rows(batch: BatchData, table: str, time: str) -> bool:
    """Check if some run has a single row at some time."""
    return _selects_rows(batch, table, f"GROUP BY run, {identifier(time)} HAVING count(*) = 1")


def _selects_rows(batch: BatchData, table: str, clause: str) -> bool:
    """Return whether an output has rows, or groups of rows, that a clause in SQL selects."""
    return bool(batch.run(f"SELECT 1 FROM {batch.rows(table)} {clause} LIMIT 1"))  # noqa: S608 - own statements


def _name(batch: BatchData, name: str) -> str:
    """Return a name as SQL, without quotes if it needs none."""
    plain = re.fullmatch(r"[A-Za-z_]\w*", name) and not batch.sql(RESERVED, name=name).num_rows
    return name if plain else identifier(name)


def _toml(text: str) -> str:
    """Return a text as a TOML string."""
    return f'"{text}"' if not re.search(r'["\\\n]', text) else f"'''{text}'''"
