"""The runner `collected`: it executes nothing, but reports runs that another system has executed.

It copies what a run has left, so that the folder stays as it is, and reports the hashes of the copies. The file `observed.json`
of each copy says that nobody has observed which files the run used.
"""

from __future__ import annotations

import contextlib
import errno
import itertools
import json
import os
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import BinaryIO, ClassVar

from sierra.config.extensions import given
from sierra.config.field_types import Table
from sierra.config.plugin_registry import NoOptions
from sierra.errors import ConfigError
from sierra.execution.write_inputs import COMMAND, ENDED, SCRIPT
from sierra.extensions.collect.folder import Ended, Refused, files_left, logs_left, read_ended
from sierra.model import Job, OutputFile, Result
from sierra.provenance import environment
from sierra.runners.base import Look, Work
from sierra.store.layout import RUN_OUTPUT, SessionPaths
from sierra.store.row_types import EnvironmentRow, IsolationRow
from sierra.store.segments import disk_errors
from sierra.util.fs import inside
from sierra.util.hashing import digest
from sierra.util.json_types import RecordValue
from sierra.util.lazy_definitions import dataclass, field
from sierra.util.shortage import PASSING
from sierra.worker.layout import OBSERVED
from sierra.worker.outputs import MOST_NAMED, described, list_files, written_elsewhere

NAME = "collected"
"""The name of the runner, and the method of the observations of its executions."""
UNOBSERVED = "another system executed it, and nobody observed which files it used"
UNKNOWN = "unknown"
LOOK_S = 0.5
"""The seconds after which a look reports what it has copied."""
CHUNK = 1 << 20
ALL_MEET = PASSING | {errno.EROFS}
"""Errors of the system that have nothing to do with the run that is copied."""


@dataclass(frozen=True, slots=True)
class EndedRun:
    """A run that has ended, and whose inputs and command are those of the plan."""

    folder: str
    """Its folder, relative to that of the batch."""
    record: Ended
    execution: str
    """The id of the execution, which is the same whenever it is collected."""


@dataclass(frozen=True, slots=True)
class Source:
    """The folder from which runs are collected."""

    folder: Path
    beside: frozenset[str]
    """The names of the files that lie beside the inputs of all runs."""
    statuses: frozenset[int]
    """The exit statuses that have a meaning in `[success]`."""
    image: str | None
    """The id of the image for which the commands are; None without an image."""
    around: Mapping[str, RecordValue]
    """The environment of this process."""
    runs: dict[str, EndedRun] = field(default_factory=dict)
    """The runs to collect, by id. Each is taken out when it is collected: nothing can execute it once more."""
    refused: dict[str, str] = field(default_factory=dict)
    """The folders of those that could not be collected, each with the reason."""


class Collected:
    """The runner `collected`. It gets its folder from `sierra collect`."""

    name = NAME
    stays = False
    remote = False
    Options: ClassVar[type[Table]] = NoOptions

    def __init__(self, slots: int, options: Table | None = None) -> None:
        """Make a runner. Neither argument has an effect."""
        self._jobs: Iterator[Job] = iter(())
        self._alive = False

    def submit(self, work: Work, session: SessionPaths) -> None:
        source = next(iter(given(Source)), None)
        if source is None:
            raise ConfigError(f"runner {NAME!r} records what another system has executed: use sierra collect FOLDER")
        self._source, self._session = source, session
        self._jobs, self._alive = iter(work.jobs), True
        self._numbers = itertools.count(1)
        session.runs.mkdir(parents=True, exist_ok=True)

    def resume(self, session: SessionPaths, recorded: Mapping[str, str | None]) -> None:
        raise NotImplementedError("collected runs ended before this process began")

    def leave(self) -> None:
        raise NotImplementedError("collecting ends with this process")

    def look(self) -> Look:
        results: list[Result] = []
        rows: list[tuple[str, Mapping[str, RecordValue]]] = []
        left_out: list[str] = []
        until = time.monotonic() + LOOK_S
        while self._alive and time.monotonic() < until:
            job = next(self._jobs, None)
            if job is None:
                self._alive = False
            elif (run := self._source.runs.pop(job.run, None)) is None:
                left_out.append(job.run)
            else:
                try:
                    results.append(self._collected(job, run, rows))
                except Refused as error:
                    left_out.append(job.run)
                    self._source.refused[run.folder] = str(error)
        return Look(tuple(results), 0, alive=self._alive, rows=tuple(rows), left_out=tuple(left_out))

    def stop(self) -> None:
        self._alive = False

    def close(self) -> None:
        self._alive = False

    def _collected(self, job: Job, run: EndedRun, rows: list[tuple[str, Mapping[str, RecordValue]]]) -> Result:
        """Copy a run and return its result; add its further rows. Raises Refused if it changes meanwhile."""
        source, record = self._source, run.record
        directory = self._session.runs / str(next(self._numbers))
        with disk_errors(self._session.root):
            directory.mkdir()
            others = _copy_run(source.folder, run.folder, directory)
            (directory / OBSERVED).write_text(json.dumps(_OBSERVED))
        if read_ended(source.folder, run.folder) != record:
            raise Refused("it was executed again while it was collected; collect it again")
        row = environment_of(record, source.around)
        rows.append(("environments", row))
        isolation = isolation_of(source.image) if source.image is not None else None
        rows += [("isolations", isolation._asdict())] if isolation else []
        exit_code, signal = record.outcome(source.statuses)
        return Result(
            job.run,
            run.execution,
            str(directory),
            record.started,
            record.ended,
            exit_code=exit_code,
            signal=signal,
            stopped=None,
            user_s=None,
            system_s=None,
            max_rss_bytes=None,
            host=record.facts["host"] or UNKNOWN,
            slot=0,
            outputs=_described(directory),
            environment=str(row["environment"]),
            observed=True,
            elsewhere=tuple(_elsewhere(source.folder / run.folder, {*(name for name, _ in job.files), *source.beside})),
            left_out=tuple(others[:MOST_NAMED]),
            isolation=isolation and isolation.isolation,
        )


def _copy_run(root: Path, run: str, directory: Path) -> list[str]:
    """Copy the outputs and logs of a run; return the other entries of its folder for outputs. Raises Refused.

    Raises OSError only for errors that another run would meet too.
    """
    outputs, others = directory / RUN_OUTPUT, []
    try:
        outputs.mkdir()
        for name, file in files_left(root, run):
            if file is None:
                others.append(name)
                continue
            copy = inside(outputs, name)
            copy.parent.mkdir(parents=True, exist_ok=True)
            _copy(file, copy)
        for log, file in logs_left(root, run):
            _copy(file, directory / log)
    except OSError as error:
        if error.errno in ALL_MEET:
            raise
        raise Refused(f"its files cannot be copied: {error.strerror}") from error
    return others


def _copy(file: BinaryIO, target: Path) -> None:
    """Copy a file. Raises Refused if it changes meanwhile."""
    before, copied = os.fstat(file.fileno()), 0
    with target.open("xb") as copy:
        while copied <= before.st_size and (chunk := file.read(CHUNK)):
            copied += copy.write(chunk)
    after = os.fstat(file.fileno())
    if copied != before.st_size or (after.st_mtime_ns, after.st_ctime_ns) != (before.st_mtime_ns, before.st_ctime_ns):
        raise Refused(f"{target.name} changed while it was read; collect it again")


def _described(directory: Path) -> tuple[OutputFile, ...]:
    files, _ = list_files(f"{directory}/{RUN_OUTPUT}")
    return tuple(OutputFile(**file) for file in described(files, lambda: None))


def _elsewhere(folder: Path, own: set[str]) -> list[str]:
    """Return the files with content that a run has left beside its inputs."""
    with contextlib.suppress(OSError, RecursionError):
        names = written_elsewhere(str(folder), own | {COMMAND, SCRIPT, ENDED})
        return [f"{{run}}/{name}" for name in itertools.islice(names, MOST_NAMED)]
    return []


_OBSERVED = {
    "method": NAME,
    "reason": UNOBSERVED,
    "notes": [],
    "distributions": [],
    "files": [],
    "listings": {},
    "channels": [],
    "written": [],
}


def environment_of(record: Ended, around: Mapping[str, RecordValue]) -> dict[str, RecordValue]:
    """Return the row of `environments` of a machine of which only a run's record tells anything."""
    facts = record.facts
    row: dict[str, RecordValue] = dict.fromkeys(EnvironmentRow._fields)
    row |= {"cpu_flags": [UNKNOWN], "gpus": [UNKNOWN], "modules": [], "container": UNKNOWN}
    row |= dict.fromkeys(("limits", "variables"), "{}") | dict.fromkeys(("python", "distributions"), "")
    row |= {"host": facts["host"], "os": facts["system"] or None, "kernel": facts["release"], "machine": facts["machine"]}
    row |= {"cores": record.cores, "sierra": around["sierra"]}
    known = {name: value for name, value in row.items() if name != "environment"}
    return {**row, "environment": environment.identity(known)}  # type: ignore[arg-type]


def isolation_of(image: str) -> IsolationRow:
    """Return the row of `isolations` of runs of an image. Nobody knows whether the other system used it."""
    row = IsolationRow("", NAME, None, None, UNKNOWN, image, None, UNKNOWN, [], None, "{}", "{}", [])
    fields = row._asdict()
    del fields["isolation"]
    return row._replace(isolation=digest("isolation", fields))


def execution_of(run: str, record: Ended, programs: str, rules: str | None = None) -> str:
    """Return the id of an execution: the same for the same record of its end and the same programs.

    `rules`: it is recorded once more, because what is recorded of it cannot be evaluated by these rules.
    """
    by_rules = {} if rules is None else {"rules": rules}
    return digest("collected execution", {"run": run, "ended": record.sha256, "programs": programs, **by_rules})
