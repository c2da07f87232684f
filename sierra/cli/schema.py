"""`sierra schema`: the keys of `sierra.toml`, and the meaning of the store's tables."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from sierra.cli.output import note, print_json, table


def schema(
    name: Annotated[str | None, typer.Argument(metavar="TABLE", help="A table of the store (default: all).")] = None,
    toml: Annotated[bool, typer.Option("--toml", help="Print all keys of sierra.toml instead, as commented TOML.")] = False,
    write: Annotated[
        Path | None, typer.Option("--write", metavar="FOLDER", help="Write the schema files to this folder, as in schemas/.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the tables as JSON; with --toml, the JSON Schema.")] = False,
) -> None:
    """Describe the tables of the store, or the keys of sierra.toml.

    \b
    Examples:
      sierra schema
      sierra schema executions
      sierra schema --toml
      sierra schema --toml --json > sierra.toml.schema.json
    """
    from sierra.errors import NotFound
    from sierra.setup import published_schemas

    if write is not None:
        published_schemas.write(write)
        return
    if toml:
        print(published_schemas.toml_schema(note) if as_json else published_schemas.toml(note), end="")
        return
    tables = published_schemas.tables()
    if name is not None and name not in tables:
        raise NotFound(f"unknown table {name!r}; the store's own tables are {', '.join(tables)} (sierra sql 'SHOW TABLES')")
    chosen = [tables[name]] if name else list(tables.values())
    if as_json:
        print_json(chosen)
        return
    for one in chosen:
        print(f"{one.name}: {one.meaning}")
        table(("column", "type", "unit", "meaning"), [(c.name, c.type, c.unit, c.meaning) for c in one.columns])
        print()
