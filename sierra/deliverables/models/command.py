"""Models that are programs: a program gets a table of the experiments, and prints its predictions as CSV.

The program is executed on this machine, with the declared environment variables of runs, in a new folder that contains

    experiments.csv       a row for each experiment: `experiment` (its place), the variables, `input` (the first input file)
    inputs/PLACE/…        the input files of the first run of each experiment

No shell is used. A time limit ends the program with all processes of its group.
"""

from __future__ import annotations

import contextlib
import csv
import io
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from sierra.config.model_table import Model
from sierra.config.project_file import LoadedProject
from sierra.deliverables.models.predictions import Cells
from sierra.design import platforms
from sierra.design.run_values import Declared
from sierra.errors import SierraError, UsageError
from sierra.execution import commands
from sierra.provenance import referenced_files
from sierra.store.batch_data import BatchData
from sierra.store.store import Store
from sierra.util import bounded_program
from sierra.util.fs import inside
from sierra.util.hashing import digest, sha256
from sierra.util.json_types import JsonView
from sierra.util.text import one_line

EXPERIMENTS = "experiments.csv"
INPUTS = "inputs"
KNOWN = ("project", "python", "experiments")
MOST = 64 << 20
"""The largest number of bytes that a program may print."""
SHOWN = 200
"""The largest number of characters of its messages that are shown."""


def predict(
    model: Model, project: LoadedProject, store: Store, frame: BatchData, origin: str
) -> tuple[Mapping[str, Sequence[object]], Mapping[str, JsonView]]:
    """Return the table that a model's program prints, by column, and what it was made from, with hashes.

    `origin` names the model in messages. Raises SierraError, in one line, if the program cannot be started, fails, prints
    too much or no table, or does not end in time.
    """
    words = commands.checked(
        model.command, project.root, origin, KNOWN, contained=False, produced=(), declared=Declared(), project=None
    )
    named = referenced_files.files(words, project.root, (), project=project.root)
    inputs = frame.first_inputs()
    with _folder() as folder:
        table = _write_experiments(folder, frame.cells(), inputs, store)
        filled = commands.fill(words, project.root, {"experiments": EXPERIMENTS})
        printed = _printed(filled, _variables(project, folder), folder, model.wall)
        facts: dict[str, JsonView] = {
            "command": list(model.command),
            "files": {program_file.name: program_file.sha256 for program_file in named.all},
            "experiments": sha256(table),
            "inputs": digest("inputs of a model", {str(k): [list(file) for file in files] for k, files in inputs.items()}),
            "printed": sha256(printed),
        }
    return _parsed(printed), facts


@contextlib.contextmanager
def _folder() -> Iterator[Path]:
    with tempfile.TemporaryDirectory(prefix="sierra-model-", ignore_cleanup_errors=True) as folder:
        for name in (INPUTS, "home", "tmp"):
            Path(folder, name).mkdir()
        yield Path(folder)


def _write_experiments(folder: Path, cells: Cells, inputs: Mapping[int, Sequence[tuple[str, str]]], store: Store) -> bytes:
    """Write the table of the experiments, and their inputs; return the table."""
    names = list(next(iter(cells.values()), {}))
    text = io.StringIO()
    rows = csv.writer(text, lineterminator="\n")
    rows.writerow(["experiment", *names, "input"])
    known: dict[str, bytes] = {}
    for ordinal, cell in cells.items():
        own = folder / INPUTS / str(ordinal)
        for name, content in inputs.get(ordinal, ()):
            if content not in known:
                known[content] = store.object(content)
            path = inside(own, name)
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(known[content])
        first = next((f"{INPUTS}/{ordinal}/{name}" for name, _ in inputs.get(ordinal, ())), "")
        rows.writerow([ordinal, *(cell[name] for name in names), first])
    table = text.getvalue().encode()
    (folder / EXPERIMENTS).write_bytes(table)
    return table


def _variables(project: LoadedProject, folder: Path) -> dict[str, str]:
    """Return the environment of the program: that of runs, with folders of its own."""
    config = project.config
    with project.plugins():
        of_runs = commands.environment(platforms.find(config.platform, config), config)
    own = {"HOME": str(folder / "home"), "TMPDIR": str(folder / "tmp")}
    return {**commands.declared(of_runs, project.root), **own}


def _printed(argv: Sequence[str], variables: Mapping[str, str], folder: Path, wall: float) -> bytes:
    """Return what a program prints until its end. Raises SierraError if it fails."""
    try:
        ended = bounded_program.execute(argv, cwd=folder, env=variables, wall=wall, most=MOST)
    except OSError as error:
        raise SierraError(f"{argv[0]!r} cannot be started: {error.strerror}") from error
    if ended.status is None:
        much = len(ended.output) > MOST
        raise SierraError(f"it printed more than {MOST >> 20} MiB" if much else f"it did not end within {wall:g} s (wall)")
    if status := ended.status:
        why = f"was ended by signal {-status}" if status < 0 else f"ended with exit status {status}"
        raise SierraError(f"{Path(argv[0]).name} {why}{_last_line(ended.errors)}")
    if not ended.output.strip():
        raise SierraError(f"{Path(argv[0]).name} printed nothing; it should print a table as CSV")
    return ended.output


def _last_line(messages: bytes) -> str:
    """Return the last line of a program's messages, after a colon; "" if there is none."""
    lines = [line.strip() for line in messages.decode("utf-8", "replace").splitlines() if line.strip()]
    return f": {one_line(lines[-1][:SHOWN])}" if lines else ""


def _parsed(printed: bytes) -> dict[str, Sequence[object]]:
    """Return a table in CSV by column. Raises UsageError if it is none."""
    try:
        header, *rows = [row for row in csv.reader(io.StringIO(printed.decode("utf-8-sig")), strict=True) if row]
    except (UnicodeDecodeError, csv.Error, ValueError) as error:
        raise UsageError(f"it printed no CSV: {one_line(error)}") from error
    names = [name.strip() for name in header]
    if len(set(names)) < len(names):
        raise UsageError(f"it printed two columns of one name: {', '.join(map(one_line, names))}")
    for line, row in enumerate(rows, 2):
        if len(row) != len(names):
            raise UsageError(f"row {line} of its CSV has {len(row)} values, but the header has {len(names)}")
    columns = zip(*rows, strict=True) if rows else [()] * len(names)
    return {name: [value.strip() for value in column] for name, column in zip(names, columns, strict=True)}
