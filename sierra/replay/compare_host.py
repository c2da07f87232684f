"""Differences between this machine and the record of runs, before anything executes: programs, files and facts.

If runs were recorded in an image, its programs are compared with the same things that are recorded without an image (see
`sierra.provenance.fingerprint_programs`): programs, the libraries that they load, and the distributions of a Python. Everything
that the image does not have as the same file at the same path is reported.

Also: members of replayed runs, which are robots: who may execute them again, and which other processors they had.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

from sierra.config.project_file import LoadedProject
from sierra.containers.images.image_contents import Contents
from sierra.errors import Missing, UsageError
from sierra.execution import commands
from sierra.execution.members import check_places
from sierra.execution.observation import plan_files
from sierra.execution.observation.current_files import Current
from sierra.execution.plan import session_step
from sierra.model import RunSpec
from sierra.provenance import environment, fingerprint_programs
from sierra.provenance.dependency_model import Kind, Program, Programs, mentioned
from sierra.replay import same_files
from sierra.replay.find_record import Record
from sierra.replay.same_files import UsedFiles
from sierra.runners.base import Runner, RunsMembers
from sierra.store.row_types import EnvironmentRow
from sierra.store.store import Store
from sierra.templates.base import Files
from sierra.util.hashing import short
from sierra.util.text import few

PROCESSORS = """
SELECT DISTINCT was.place, was.machine, now.machine AS found
FROM robots was JOIN executions e USING (execution) JOIN executions f USING (run)
JOIN robots now ON now.execution = f.execution AND now.place = was.place
WHERE list_contains($recorded, e.execution) AND list_contains($made, f.execution) AND was.machine <> now.machine
ORDER BY ALL
"""
"""SQL: the places whose robots had another processor."""


def check_fleet(runner: Runner, name: str, of: str, inputs: Iterable[Files], groups: Collection[str]) -> None:
    """Raise UsageError if a runner cannot execute runs on robots again, ConfigError if its fleet does not fit them.

    `of` is the id of what is replayed, and `groups` are the groups of places that the project declares.
    """
    if not isinstance(runner, RunsMembers):
        raise UsageError(
            f"{short(of)} was executed on robots, and runner {name!r} cannot execute it again; use --on robots (a replay "
            "needs robots, but not the same ones)"
        )
    check_places(runner, inputs, groups)


def check_attended(of: str, project: LoadedProject) -> None:
    """Raise Missing if robots would move without a person, although an extension executes their runs one by one."""
    if step := session_step(project):
        raise Missing(
            f"{short(of)} has {step.runs} ([trials]), and a replay asks nobody before the robots move: use --yes if they "
            "may start at once, one run after the other"
        )


class _Processor(NamedTuple):
    place: int
    machine: str
    found: str


def other_processors(store: Store, recorded: Collection[str], made: Collection[str]) -> list[str]:
    """Return a note on each place whose robot had another processor in the executions `made` than in the recorded ones."""
    rows = store.select(_Processor, PROCESSORS, recorded=list(recorded), made=list(made))
    return [f"different processor at place {row.place}: was {row.machine}, is now {row.found}" for row in rows]


SHOWN = 3
ARITHMETIC = ("machine", "cpu_flags", "gpus", "libc", "container")
"""Facts about a machine that may change the results of the same programs."""


def other_programs(record: Record, now: Programs, root: Path) -> Iterator[str]:
    """Yield a line for each program that differs from the record; the code is in `root`."""
    of = record.of
    if now.id != of.fingerprint:
        words = mentioned(of.spec.words, root)
        built = {f"{{project}}/{program.name}" for program in of.build.products} if of.build else set()
        recorded = Programs(tuple(program.program() for program in of.programs if program.name not in built))
        now = Programs(tuple(program for program in now.all if program.name not in built))
        yield from (
            f"different programs: {line}" for line in fingerprint_programs.differences(recorded, now, words, record.used)
        )


def used_files(store: Store, record: Record, now: Programs, root: Path, search: str) -> UsedFiles:
    """Compare the files that the recorded executions used with those now; programs and products are compared elsewhere."""
    built = [str(root / one.name) for one in record.of.build.products] if record.of.build else []
    known = [one.path for one in now.all if one.kind != Kind.DISTRIBUTIONS] + built
    named = plan_files.folders(root, now, search)
    declared = "PATH" in record.of.spec.environment
    current = Current(named, search, declared, now.all[0].path if now.all else "", is_source_only=True)
    return same_files.compare(store, [str(one.execution) for one in record.runs], current, known)


def other_machine(store: Store, record: Record, around: EnvironmentRow) -> Iterator[str]:
    """Yield a line for each difference of the machine that may change arithmetic."""
    for row in store.select(EnvironmentRow, "SELECT * FROM environments WHERE environment = $e", e=record.environment):
        for name, was, found in environment.differing(row._asdict(), around._asdict()):
            if name in ARITHMETIC:
                old, new = (", ".join(one) or "none" if isinstance(one, list) else one or "none" for one in (was, found))
                yield f"different machine: {name} {'that differ: ' if isinstance(was, list) else ''}was {old}, is now {new}"


def unlike_image(spec: RunSpec, inside: Contents, root: Path) -> Iterator[str]:
    """Yield a line with those of this machine's programs that differ from the image's, if any; the code is in `root`.

    Raises Missing for a program that is not on this machine.
    """
    words, variables = commands.on_host(spec, inside.image, root)
    programs = fingerprint_programs.find(words, variables, root)
    other = [line for program in programs.all if (line := _other(program, inside, root))]
    if other:
        yield f"not executed in a container, and with other programs than in image {inside.image.name}: {few(other, SHOWN)}"


def _other(program: Program, inside: Contents, root: Path) -> str | None:
    """Return the difference between one program or file here and in the image; None if they are the same."""
    if program.kind == Kind.DISTRIBUTIONS:
        lines = set((program.version or "").splitlines())
        lacking = sorted(lines - set(inside.packages.get("python", ())))
        return f"{program.name}: {lacking[0]} is not in the image" if lacking else None
    if Path(program.path).is_relative_to(root):
        return None
    there = inside.sha256(program.path)
    if there == program.sha256:
        return None
    return f"{program.path} is {short(program.sha256)} here, {short(there) if there else 'nothing'} in the image"
