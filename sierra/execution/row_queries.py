"""Rows of the store that several readers need: the programs of an execution, and records that must be there."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from sierra.errors import Damaged
from sierra.model import Value
from sierra.provenance.dependency_model import Kind, Program
from sierra.store.row_mapper import R
from sierra.store.store import Snapshot
from sierra.util.hashing import short


class RecordedProgram(NamedTuple):
    """A program, library or file of a recorded set of programs."""

    name: str
    kind: str
    version: str | None
    path: str
    sha256: str

    @property
    def short_version(self) -> str:
        """The version in one line; of several distributions, their number."""
        lines = (self.version or "").splitlines()
        return f"{len(lines)} distributions" if len(lines) > 1 else "".join(lines)

    def program(self) -> Program:
        kind = next((one for one in Kind if one == self.kind), Kind.PROGRAM)
        return Program(self.name, self.path, self.sha256, kind, self.version)


PROGRAMS = """
SELECT name, kind, version, path, sha256 FROM programs WHERE list_contains($p, programs)
ORDER BY list_position(['program', 'file', 'distributions', 'library'], kind), name, path
"""


def programs(snapshot: Snapshot, ids: Sequence[str]) -> list[RecordedProgram]:
    """Return the programs of some sets: programs first, then files, installed distributions and libraries."""
    return snapshot.select(RecordedProgram, PROGRAMS, p=list(ids))


USED = """
WITH last AS (
    SELECT distributions FROM observations JOIN executions e USING (execution)
    WHERE list_contains($p, e.programs) AND distributions IS NOT NULL ORDER BY e.lamport DESC LIMIT 1
)
SELECT unnest(distributions) FROM last
"""


def used_distributions(snapshot: Snapshot, programs: Sequence[str]) -> list[str]:
    """Return the names of the Python distributions that the last observed execution with some sets of programs used.

    Those of which it used most come first. None if no such execution was observed.
    """
    return [line.partition("==")[0] for line in snapshot.values(str, USED, p=list(programs))]


def required_row(kind: type[R], snapshot: Snapshot, statement: str, **parameters: str) -> R:
    """Return the first row of a statement's result. Raises Damaged if there is none."""
    rows = snapshot.select(kind, statement, **parameters)
    if not rows:
        table = statement.split(" FROM ")[1].split()[0]
        raise Damaged(f"the store's table {table} has no row for {', '.join(map(short, parameters.values()))}")
    return rows[0]


def axis_values(axes: Sequence[str], cell: Mapping[str, Value | None]) -> dict[str, Value]:
    """Return the values of the axes of a recorded experiment."""
    return {axis: value for axis in axes if (value := cell[axis]) is not None}
