"""`sierra outputs`: show how a batch's outputs were read, or declare them."""

from __future__ import annotations

import json
from typing import Annotated

import typer

from sierra.cli import complete
from sierra.cli.arguments import AsJson, TargetName
from sierra.cli.output import print_json


def outputs(
    query: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[HASH|QUERY]",
            show_default=False,
            autocompletion=complete.batches,
            help="Batch id or prefix, or the criteria of a query (default: the last batch).",
        ),
    ] = None,
    target: TargetName = None,
    write: Annotated[
        bool, typer.Option("--write", help="Write the tables that are not declared into sierra.toml; leave all else as it is.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Show how a batch's outputs were read, or declare them.

    Shows each table with its columns, their types in SQL, the time axis and the number of rows of a run. Shows also the files
    that became no table, why, and what to declare to make tables of them. With --write, the tables become [outputs.NAME] in
    sierra.toml, or those of the batch's target, and they stay the same. Files in subfolders, and too many files of a kind, are
    declared too, and become tables with the next sierra run. Nothing is executed again.

    \b
    Examples:
      sierra outputs
      sierra outputs 9e1c
      sierra outputs population_size.Log8
      sierra outputs --target robots
      sierra outputs --write
    """
    from sierra.cli.open_project import project
    from sierra.cli.render_outputs import lines, unread_lines
    from sierra.config.output_tables import ROTATION, Output

    opened = project()
    if write:
        taken = opened.records.outputs(*(query or ()), target=target)
        written = opened.records.declare_outputs(*(query or ()), target=target)
        if as_json:
            print_json(written)
        else:
            before = f"targets.{taken.target}." if taken.target in opened.targets else ""
            names = ", ".join(f"[{before}outputs.{name}]" for name in written)
            every = not taken.all_failed and all(table.declared or table.name in written for table in taken.tables)
            nothing = "all tables are declared; nothing was changed" if every else "nothing was changed"
            print(f"{opened.file}: added {names}" if written else f"{opened.file}: {nothing}")
            files = [Output(file=str(keys["file"]), format="csv") for keys in written.values()]
            parts = [file for file in files if file.file.endswith(ROTATION)]
            added = [kind for kind in taken.unread if kind.name in written or any(new.matches(kind.path) for new in parts)]
            joined = {table.name for table in taken.tables if any(file.matches(table.file) for file in files)}
            if added or any(table.keys for table in taken.tables if table.name in written) or joined - written.keys():
                print("the next sierra run reads the files of new tables again; it executes nothing again for that")
            for table in taken.tables:
                if not table.declared and table.name not in {*written, *joined}:
                    print(f"not declared any more: [outputs.{table.name}] file = {json.dumps(table.file)} had other keys too")
            for line in unread_lines(taken.runs, [kind for kind in taken.unread if kind not in added]):
                print(line)
        return
    taken = opened.records.outputs(*(query or ()), target=target)
    if as_json:
        print_json(taken)
    else:
        print("\n".join(lines(taken)))
