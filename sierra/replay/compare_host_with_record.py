"""Differences between the programs, files and machine of the record and those here, before anything executes."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from sierra.execution.observation import plan_files
from sierra.execution.observation.current_files import Current
from sierra.provenance import environment, fingerprint_programs
from sierra.provenance.dependency_model import Kind, Programs, mentioned
from sierra.replay import same_files
from sierra.replay.find_record import Record
from sierra.replay.same_files import UsedFiles
from sierra.store.row_types import EnvironmentRow
from sierra.store.store import Store

ARITHMETIC = ("machine", "cpu_flags", "gpus", "libc", "container")
"""Facts about a machine that may change the results of the same programs."""


def other_programs(record: Record, now: Programs, root: Path) -> Iterator[str]:
    """Yield a line for each program that differs from the record; the code is in `root`."""
    of = record.of
    if now.id != of.fingerprint:
        words = mentioned(of.spec.words, root)
        built = {f"{{project}}/{one.name}" for one in of.build.products} if of.build else set()
        recorded = Programs(tuple(one.program() for one in of.programs if one.name not in built))
        now = Programs(tuple(one for one in now.all if one.name not in built))
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
