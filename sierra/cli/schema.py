"""`sierra schema`: the keys of `sierra.toml`, and the meaning of the store's tables."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sierra.cli.output import note, print_json, table

if TYPE_CHECKING:
    from sierra.setup.key_tables import KeyTable
    from sierra.store.schema import Table

CONFIG = "sierra.toml"


def schema(
    name: Annotated[
        str | None,
        typer.Argument(
            metavar="NAME",
            help="A table of the store, a table or key of sierra.toml, or sierra.toml for all keys (default: the store).",
        ),
    ] = None,
    write: Annotated[
        Path | None, typer.Option("--write", metavar="FOLDER", help="Write the schema files to this folder, as in schemas/.")
    ] = None,
    as_json: Annotated[
        bool,
        typer.Option("--json", help="Print JSON: of a table of the store if there is one; for sierra.toml, its JSON Schema."),
    ] = False,
) -> None:
    """Describe the tables of the store, or the keys of sierra.toml.

    Keys of installed plug-ins are included.

    \b
    Examples:
      sierra schema
      sierra schema executions
      sierra schema outputs
      sierra schema sierra.toml --json > sierra.toml.schema.json
    """
    from sierra.config.project_file import KEYS
    from sierra.errors import NotFound
    from sierra.setup import published_schemas

    if write is not None:
        published_schemas.write(write)
        return
    if name == CONFIG and as_json:
        print(published_schemas.toml_schema(note), end="")
        return
    tables = published_schemas.tables()
    chosen = [described for described in tables.values() if name in (None, described.name)]
    both = name in KEYS and not as_json
    keys = _keys(name) if name and (both or not chosen) else []
    if not chosen and not keys:
        raise NotFound(f"unknown name {name!r}; tables of the store are {', '.join(tables)} (sierra sql 'SHOW TABLES')")
    if as_json:
        print_json(chosen or keys)
        return
    for described in chosen:
        _print_columns(described)
    for of_keys in keys:
        _print_keys(of_keys)


def _keys(name: str) -> list[KeyTable]:
    """Return the tables of `sierra.toml` with a name, and those within them; else those that have a key of this name."""
    from dataclasses import replace

    from sierra.setup.key_tables import key_tables

    every = list(key_tables(note))
    if name == CONFIG:
        return every
    named = [of_keys for of_keys in every if of_keys.name == name or of_keys.name.startswith(f"{name}.")]
    having = [replace(of_keys, keys=tuple(key for key in of_keys.keys if key.name == name)) for of_keys in every]
    return named or [of_keys for of_keys in having if of_keys.keys]


def _print_columns(described: Table) -> None:
    print(f"{described.name}: {described.meaning}")
    table(("column", "type", "unit", "meaning"), [(c.name, c.type, c.unit, c.meaning) for c in described.columns])
    print()


def _print_keys(of_keys: KeyTable) -> None:
    name, kind = of_keys.name, f', kind = "{of_keys.kind}"' if of_keys.kind else ""
    title = of_keys.header or (f"keys of a {name}" if name and not kind else name) or "top level of sierra.toml"
    print(" ".join((f"{title}{kind}:", *of_keys.sentences)).replace("`", ""))
    rows = [tuple(text.replace("`", "") for text in (key.name, key.type, key.default, key.meaning)) for key in of_keys.keys]
    table(("key", "type", "default", "meaning"), rows)
    print()
