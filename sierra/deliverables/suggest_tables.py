"""Derived tables that a note proposes, for data of which there is no default figure."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence

from sierra.store.samples import Frame, OutputTable, names_time
from sierra.store.sql_names import identifier, quote, row_name
from sierra.util.text import few

SHOWN = 5
"""The largest number of columns that a note names."""
RESERVED = "SELECT 1 FROM duckdb_keywords() WHERE keyword_name = lower($name) AND keyword_category = 'reserved'"


def notes(frame: Frame, output: OutputTable, time: str) -> Sequence[str]:
    """Return a note on the columns of an output that are no numbers, apart from its time; none if there is no such column."""
    others = {column: kind for column, kind in output.others.items() if column != time}
    if not others:
        return []
    called = few([repr(column) for column in others], SHOWN)
    which = f"no figure of {called} of output {output.name!r}: no {'number' if len(others) == 1 else 'numbers'}"
    if (example := _example(frame, output.name, others)) is None:
        return [which]
    column, expression, name = example
    table = _name(frame, output.name)
    sql = f"SELECT run, {expression} AS {name} FROM {table} GROUP BY run"  # noqa: S608 - the user may write it
    key = re.sub(r"\W", "_", f"{output.name}_{column}")
    return [f"{which}; a derived table has one, for example: [tables.{key}] sql = {_toml(sql)}"]


def of_single_rows(frame: Frame, output: OutputTable, time: str) -> str:
    """Return a proposal for an output with several rows per run and time, which makes one row of them.

    It is their mean if another column tells them apart at all times, as the number of a robot does. Otherwise it is the last
    one: a model that writes the values before and after an event never had their mean.
    """
    if not time:
        return ""
    measured = [one for one in output.columns if one != time and not frame.numbers_rows(output.name, one, time)]
    of_members = len(measured) < len(output.columns) - 1 and not frame.has_single_rows(output.name, time)
    table, at = (_name(frame, one) for one in (output.name, time))
    if of_members and measured:
        name = _name(frame, measured[0])
        sql = f"SELECT run, {at}, avg({name}) AS {name} FROM {table} GROUP BY run, {at}"  # noqa: S608 - the user may write it
        return f"; or make one row of them, for example: [tables.{output.name}_mean] sql = {_toml(sql)}"
    row = row_name((*frame.axis_names, *output.all_columns))
    sql = f"SELECT * FROM {table} QUALIFY {row} = max({row}) OVER (PARTITION BY run, {at})"  # noqa: S608
    declared = "" if names_time(time) else f", time = {json.dumps(time, ensure_ascii=False)}"
    return f"; or take the last row of each time, for example: [tables.{output.name}_last] sql = {_toml(sql)}{declared}"


def _example(frame: Frame, table: str, others: Mapping[str, str]) -> tuple[str, str, str] | None:
    """Return a column, an SQL expression that makes a number of it for each run, and a name of this number."""
    for column, kind in others.items():
        name = _name(frame, column)
        if kind == "VARCHAR" and frame.has_words(table, column):
            value = frame.most_frequent(table, column)
            if value is not None and len(value) < 40:
                return column, f"avg(({name} = {quote(value)})::INT)", "rate"
        if kind == "VARCHAR" and frame.has_flags(table, column):
            return column, f"avg((lower(trim({name})) IN ('true', '1'))::INT)", "rate"
        if kind.endswith("[]"):
            return column, f"avg(len({name}))", "length"
        if kind.startswith(("DATE", "TIMESTAMP")):
            return column, f"max(epoch({name}))", "seconds"
        if field := re.match(r'STRUCT\(("(?:[^"]|"")*"|\w+) (?:DOUBLE|FLOAT|U?\w*INT\w*|DECIMAL|BOOLEAN)', kind):
            return column, f"avg({name}.{field[1]})", "mean"
    return None


def _name(frame: Frame, name: str) -> str:
    """Return a name as SQL, without quotes if it needs none."""
    plain = re.fullmatch(r"[A-Za-z_]\w*", name) and not frame.sql(RESERVED, name=name).num_rows
    return name if plain else identifier(name)


def _toml(text: str) -> str:
    """Return a text as a TOML string."""
    return f'"{text}"' if not re.search(r'["\\\n]', text) else f"'''{text}'''"
