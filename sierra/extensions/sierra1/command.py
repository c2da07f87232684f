"""`sierra init --from-sierra1`: make a project from one of SIERRA 1.x."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from sierra.cli.init import FromElsewhere, there
from sierra.cli.output import print_json
from sierra.util.text import one_line


def converted(
    from_sierra1: Annotated[
        Path | None,
        typer.Option(
            "--from-sierra1", metavar="DIR", help="Convert a project of SIERRA 1.x (ARGoS); nothing of it is executed."
        ),
    ] = None,
) -> FromElsewhere | None:
    return None if from_sierra1 is None else FromElsewhere("--from-sierra1", partial(_convert, from_sierra1))


def _convert(old: Path, folder: Path, template: str | None, as_json: bool) -> None:
    """Convert a project of SIERRA 1.x and print what was carried over, and what was not."""
    from sierra.extensions.sierra1 import convert

    path, draft = convert.write(old, folder, template)
    command = f"{there(folder)}sierra run {draft.next} -n"
    if as_json:
        kinds = {"controllers": draft.controllers, "scenarios": draft.scenarios, "variables": draft.variables}
        kept = {kind: list(names) for kind, names in (kinds | {"figures": draft.figures}).items()}
        written = [str(path), *([str(folder / draft.template)] if draft.copied else [])]
        print_json({"written": written, "template": draft.template, **kept, "left_out": list(draft.left_out), "next": command})
        return
    print(f"wrote {path}" + (f" and {folder / draft.template}" if draft.copied else ""))
    print(f"  template {one_line(draft.template)}")
    for kind in ("controllers", "scenarios", "variables", "figures"):
        if names := getattr(draft, kind):
            print(f"  {kind}: {one_line(', '.join(names))}")
    if draft.left_out:
        print("not carried over (also at the end of the file):")
        for line in draft.left_out:
            print(f"  {line}")
    print(f"next: {command}    (this only shows the runs; without -n they execute)")
