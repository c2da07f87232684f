"""`sierra show --recover`: write what can be read of bags that were cut off."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sierra.cli.lazy_commands import Beside
from sierra.cli.output import note, readable
from sierra.util.text import counted

if TYPE_CHECKING:
    from sierra.api import Project
    from sierra.store.export_recorded_files import Outcome


def recovered(
    recover: Annotated[
        bool,
        typer.Option(
            "--recover",
            help="With --to: also write what can be read of bags that were cut off, as BAG.OUTPUT.partial.parquet.",
        ),
    ] = False,
) -> Beside | None:
    return Beside("--recover", _recover) if recover else None


def _recover(opened: Project, outcomes: Sequence[Outcome], folder: Path) -> None:
    """Write what can be read of bags that were cut off, and print a note on each table."""
    from sierra.extensions.ros.output import BagOutput
    from sierra.extensions.ros.recovery import recover
    from sierra.ingest.base import check_package, with_files
    from sierra.store.recorded_files import OUTPUT_FOLDER

    check_package(BagOutput)
    outputs = with_files(opened.config.outputs, opened.root)
    for outcome in outcomes:
        name = outcome.file.path.removeprefix(OUTPUT_FOLDER)
        for table in recover(folder / outcome.path, name, outputs) if outcome.file.kind != "log" else ():
            what = f"{counted(table.rows, 'message')} written" if table.rows else "nothing was written"
            note(f"{readable(str(table.path))}: {what}; {table.reason}")
