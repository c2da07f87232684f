"""The inputs and commands of a batch as files, for sites that start programs in their own way.

DIR/manifest.csv                a row for each run: run, experiment, number, seed, folder, and the values of the variables
DIR/batch.json                  the request and the batch's id, as `sierra run FILE.json` accepts them; and `PLACES`
DIR/execute.sh                  executes runs by a POSIX shell, and leaves `ended.json` in the folder of each
DIR/runs/<experiment>/<number>/ a run: its input files, `command.json`, the same as `command.sh`, and the empty folder `output`

A run on robots has a folder for each place (`robot2`), which has that robot's input files, `command.json` and `output`.
`execute.sh` cannot execute it. It cannot execute a run with ports, a checkpoint or programs around its command either: such
runs have no `command.sh`.

A command is to be started in the folder `output`, as SIERRA does, and its paths of the run are relative to that folder, also in
input files: `{input}` is `../input.xml`, `{output}` is `.`, and `{run}` is `..`. All is written beside DIR first and then
renamed, so that an incomplete folder never has this name.
"""

from __future__ import annotations

import csv
import json
import os
import shlex
import shutil
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import NotRequired, TypedDict

from sierra.containers.engines.base import HERE, PROJECT
from sierra.containers.images.image import Image, here
from sierra.design.query.condition import Selection
from sierra.design.query.query_request import KEY
from sierra.errors import Missing, UsageError
from sierra.execution.commands import CommandBuilder
from sierra.execution.plan import Plan
from sierra.model import Batch, Job, Run
from sierra.store.layout import RUN_OUTPUT
from sierra.store.row_types import SharedFileRow
from sierra.store.segments import disk_errors
from sierra.templates.base import OF_WORKER
from sierra.util import processors
from sierra.util.fs import inside
from sierra.util.hashing import sha256_file
from sierra.util.lazy_definitions import dataclass, regex
from sierra.util.scratch import scratch
from sierra.worker.job import CONDUCTED
from sierra.worker.layout import CHECKPOINT

MANIFEST, REQUEST, RUNS, COMMAND = "manifest.csv", "batch.json", "runs", "command.json"
EXECUTE, SCRIPT, ENDED = "execute.sh", "command.sh", "ended.json"
PLACES = ("project", "python", "arch")
"""The texts of the machine that writes a folder that commands may name; `REQUEST` has them."""
UNFINISHED = ".sierra-inputs-"
"""The beginning of the names of folders with unfinished inputs."""
COLUMNS = ("run", "experiment", "number", "seed", "folder")
OWN = ("SIERRA_RUN_ID", "SIERRA_SEED", "SIERRA_ROBOT", "SIERRA_ROBOTS")
"""The variables of a run that are not declared but mean the same everywhere."""
_OF_RUN = regex(rf"{HERE}(/{RUN_OUTPUT}(?![\w.-]))?")


class _Command(TypedDict):
    """The content of `command.json`."""

    argv: list[str]
    line: str
    folder: str
    environment: dict[str, str]
    image: NotRequired[str]
    image_id: NotRequired[str]


@dataclass(frozen=True, slots=True)
class WrittenInputs:
    """The folder that was written."""

    folder: Path
    batch: str
    experiments: int
    runs: int
    notes: tuple[str, ...] = ()


def check_target(folder: Path) -> None:
    """Raise UsageError if a folder is not empty, or is no folder."""
    if os.path.lexists(folder) and (not folder.is_dir() or any(folder.iterdir())):
        raise UsageError(f"{folder} is not empty; use a new folder")
    if not folder.parent.is_dir():
        raise UsageError(f"{folder.parent} does not exist; create it first")


def write(plan: Plan, folder: Path, selection: Selection | None = None) -> WrittenInputs:
    """Write the inputs and commands of a plan's runs into a new folder. Raises UsageError, and Missing if the disk is full."""
    folder = Path.cwd() / folder
    check_target(folder)
    ordinals = (
        frozenset(experiment.ordinal for experiment in plan.batch.experiments) if selection is None else selection.experiments
    )
    with disk_errors(folder), scratch(folder.parent, UNFINISHED) as scratch_folder:
        unfinished = scratch_folder / folder.name
        unfinished.mkdir()
        count = _write_all(plan, unfinished, ordinals)
        os.sync()
        unfinished.rename(folder)
    return WrittenInputs(folder, plan.batch.id, len(ordinals), count, (*plan.notes, *_notes(plan, folder)))


def _write_all(plan: Plan, folder: Path, ordinals: frozenset[int]) -> int:
    """Write everything; return the number of runs."""
    places = own_places(plan)
    builder = command_builder(plan, places)
    axes = [axis.name for axis in plan.batch.axes]
    shutil.copyfile(Path(__file__).with_name(EXECUTE), folder / EXECUTE)
    count = 0
    with (folder / MANIFEST).open("w", encoding="utf-8", newline="") as file:
        manifest = csv.writer(file, lineterminator="\n")
        manifest.writerow([*COLUMNS, *(f"{name}_value" if name in COLUMNS else name for name in axes)])
        for run, files in plan.inputs.files(plan.batch, lambda run: run.experiment in ordinals):
            name = run_folder(plan.batch, run)
            _write_run(inside(folder, name), builder.job(run, files), plan)
            values = plan.batch.experiments[run.experiment].values
            manifest.writerow([run.id, run.experiment, run.number, run.seed, name, *(values[name] for name in axes)])
            count += 1
    request = {KEY: plan.request.model_dump(mode="json", exclude_defaults=True), "batch": plan.batch.id, **places}
    (folder / REQUEST).write_text(json.dumps(request, indent=2) + "\n", "utf-8")
    return count


def run_folder(batch: Batch, run: Run) -> str:
    """Return the path of a run's folder in the folder of its batch. The order of these paths is that of the runs."""
    experiments = batch.experiments
    widths = len(str(len(experiments) - 1)), len(str(max(len(experiment.runs) for experiment in experiments) - 1))
    return f"{RUNS}/{run.experiment:0{widths[0]}}/{run.number:0{widths[1]}}"


def _write_run(folder: Path, job: Job, plan: Plan) -> None:
    for part in (".", *(f"robot{member.place}" for member in job.members)):
        (folder / part / RUN_OUTPUT).mkdir(parents=True)
    for name, content in run_files(job, plan).items():
        path = inside(folder, name)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
    for row in plan.shared_files:
        _copy(plan.project.root / row.name, inside(folder, row.name), row)


def run_files(job: Job, plan: Plan) -> dict[str, bytes]:
    """Return the files in the folder of a run by their names, without those that lie beside the inputs of all runs."""
    files = {name: _filled(content, job.folders) for name, content in job.files}
    for name in files.keys() & {COMMAND, SCRIPT, ENDED, RUN_OUTPUT}:
        raise UsageError(f"an input file is called {name!r}, as a file that SIERRA writes beside it; use another name")
    if not job.members:
        command = _command(job.argv, job.environment, plan)
        files[COMMAND] = _as_json(command)
        if not _is_incomplete(job, command):
            files[SCRIPT] = _script(job.run, command)
    for member in job.members:
        placed = member.at(HERE, "{project}", "{arch}")
        folder = f"robot{member.place}"
        files |= {f"{folder}/{name}": _filled(content, placed.folders) for name, content in member.files}
        files[f"{folder}/{COMMAND}"] = _as_json(_command(placed.argv, placed.environment, plan))
    return files


def _command(words: Sequence[str], variables: Mapping[str, str], plan: Plan) -> _Command:
    argv = [_relative(word) for word in words]
    command: _Command = {
        "argv": argv,
        "line": shlex.join(argv),
        "folder": RUN_OUTPUT,
        "environment": _environment(plan, variables),
    }
    if plan.image:
        command["image"], command["image_id"] = plan.image.name, plan.image.id
    return command


def _as_json(command: _Command) -> bytes:
    return (json.dumps(command, indent=2) + "\n").encode()


def _is_incomplete(job: Job, command: _Command) -> bool:
    """Check whether a command needs ports, a checkpoint, or programs around it: whoever executes it must see to these."""
    variables = (job.environment[name] for name in command["environment"])
    texts = (*(text.encode("utf-8", "surrogateescape") for text in (*job.argv, *variables)), *(file for _, file in job.files))
    marks = (*OF_WORKER.values(), f"{HERE}/{CHECKPOINT}")
    return job.argv[:1] == (CONDUCTED,) or any(mark.encode() in text for mark in marks for text in texts)


def _script(run: str, command: _Command) -> bytes:
    """Return the script that executes the command of a run in its folder for outputs, with its declared variables.

    `env` would take a program for a variable whose name contains `=`.
    """
    variables = (f"{name}={value}" for name, value in command["environment"].items())
    through = ("sh", "-c", 'exec "$@"', "sh") if "=" in command["argv"][0] else ()
    line = shlex.join(["env", *variables, *through, *command["argv"]])
    return f"# run {run}\nexec {line}\n".encode("utf-8", "surrogateescape")


def _copy(source: Path, target: Path, row: SharedFileRow) -> None:
    """Copy a file that lies beside the inputs. Raises Missing if it has changed since the plan was made."""
    target.parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(source, target)
    if sha256_file(target) != row.sha256:
        raise Missing(f"files: {row.name} has changed meanwhile; run the command again")
    target.chmod(0o755 if row.executable else 0o644)


def own_places(plan: Plan) -> dict[str, str]:
    """Return the texts of this machine that commands may name, as `PLACES` lists them."""
    return {"project": str(plan.project.root), "python": sys.executable, "arch": processors.here()}


def command_builder(plan: Plan, places: Mapping[str, str]) -> CommandBuilder:
    """Return the builder of the commands of a plan, for a machine with these texts: see `own_places`."""
    root = Path(places["project"])
    code = Path(PROJECT) if plan.image else root
    python, arch = places["python"], places["arch"]
    return CommandBuilder(
        plan.batch.spec, code, plan.engine, plan.limits, "", root, image=_image(plan), python=python, arch=arch
    )


def _image(plan: Plan) -> Image | None:
    """Return the image of the runs; None for runs on robots in images for several processors, and without an image."""
    on_robots = plan.batch.spec.robots is not None
    return plan.image if isinstance(plan.image, Image) else None if on_robots else here(plan.image)


def _environment(plan: Plan, variables: Mapping[str, str]) -> dict[str, str]:
    """Return the declared variables of a run, with those of its image."""
    image = _image(plan)
    names = {*plan.batch.spec.environment, *(image.variables if image else ()), *OWN}
    return {name: _relative(value) for name, value in sorted(variables.items()) if name in names}


def _filled(content: bytes, folders: Mapping[str, str] | None) -> bytes:
    """Return the content of an input file with the paths of folders in the place of their marks, and `{port}` for ports."""
    for mark, path in (folders or {}).items():
        content = content.replace(mark.encode(), _relative(path).encode())
    return _with_names(content.decode("latin-1")).encode("latin-1")


def _relative(text: str) -> str:
    """Return a text in which paths of the run's folder are relative to its folder for outputs."""
    text = text.replace(f"{HERE}/{CHECKPOINT}", OF_WORKER["checkpoint"])
    return _with_names(_OF_RUN.sub(lambda found: "." if found[1] else "..", text))


def _with_names(text: str) -> str:
    """Return a text with `{port}` and `{checkpoint}` in the place of marks: whoever executes the run chooses these."""
    for name, mark in OF_WORKER.items():
        text = text.replace(mark, f"{{{name}}}")
    return text


def _notes(plan: Plan, folder: Path) -> Iterator[str]:
    root = plan.project.root.resolve()
    if folder.resolve().is_relative_to(root) and not plan.project.config.source.paths:
        yield f"{folder} is in the project: its files count as code, and make all runs new, unless git ignores them"
    if plan.checkout is not None:
        yield 'the ids are those of the commit (dirty = "ignore"), but the commands name the current files of the project'
    if plan.build is not None and plan.build.reason is not None:
        yield f"the products of [build] are not up to date ({plan.build.reason}); sierra run and sierra try build them"
    if plan.image is not None:
        yield f"commands are for the image {plan.image.name}, with the project at {PROJECT}; start the container yourself"
