"""Differences of the environment of executions: programs, machines, and the rules that evaluated them.

If a side's runs were executed with several of them, the values of all are compared.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import chain
from pathlib import Path

from sierra.containers import container_setup
from sierra.execution.row_queries import used_distributions
from sierra.explain.diff.load_sides import ComparedRuns
from sierra.explain.diff.model import ARROW, Compared, Difference, changed, shown
from sierra.provenance.dependency_model import INSTALLED, Identified, by_likelihood, mentioned, roles, versions
from sierra.store.row_types import EnvironmentRow, IsolationRow, ProgramRow
from sierra.store.store import Snapshot
from sierra.util.hashing import short

Facts = Mapping[str, Compared]
USED = "SELECT DISTINCT e.{what} AS id FROM {table} t JOIN all_judgements e ON e.judgement = t.execution"


def programs(snapshot: Snapshot, before: ComparedRuns, after: ComparedRuns, root: Path) -> Iterator[Difference]:
    """Yield differences of programs by name; their paths are not compared.

    Versions that the command or its scripts in `root` name come first, then those that executions were observed to use.
    """
    words = mentioned((*before.spec.command, *after.spec.command), root)
    was, now = (_used(snapshot, side, "programs") for side in (before, after))
    yield from other_programs(snapshot, was, now, words)


def other_programs(
    snapshot: Snapshot, before: Sequence[str], after: Sequence[str], words: frozenset[str] = frozenset()
) -> Iterator[Difference]:
    """Yield differences of two groups of program sets, by the ids of the sets."""
    rows = [snapshot.select(ProgramRow, PROGRAMS, i=list(ids)) for ids in (before, after)]
    role = roles(*_sets(chain(*rows)).values())
    old, new = (_by_role(side, role) for side in rows)
    used = used_distributions(snapshot, (*before, *after))
    names = dict.fromkeys((*old, *new))
    for name in sorted(names, key=lambda name: (name[1].endswith(INSTALLED), KINDS.get(name[0], len(KINDS)))):
        was, now = old.get(name, []), new.get(name, [])
        if {row.sha256 for row in was} != {row.sha256 for row in now}:
            line = f"{name[1]}: {_which(was)} {ARROW} {_which(now)}"
            yield Difference("programs", name[1], line, list(was), list(now), tuple(_versions(was, now, words, used)))


PROGRAMS = "SELECT programs, name, kind, version, path, sha256 FROM programs WHERE list_contains($i, programs)"
KINDS = {"program": 0, "file": 1, "distributions": 2, "library": 3}
"""Order of kinds; distributions of a Python come after all of them."""


def _sets(rows: Iterable[ProgramRow]) -> dict[str, list[Identified]]:
    """Return the programs of each set by its id."""
    found: dict[str, list[Identified]] = {}
    for row in rows:
        found.setdefault(row.programs, []).append(_identified(row))
    return found


def _by_role(rows: Iterable[ProgramRow], role: Mapping[Identified, str]) -> dict[tuple[str, str], list[ProgramRow]]:
    """Return the rows of programs by kind and role, independent of their paths unless names are ambiguous."""
    found: dict[tuple[str, str], list[ProgramRow]] = {}
    for row in rows:
        found.setdefault((row.kind, role[_identified(row)]), []).append(row)
    return found


def _identified(row: ProgramRow) -> Identified:
    return row.name, row.path, row.sha256


def _which(rows: Sequence[ProgramRow]) -> str:
    return " and ".join(dict.fromkeys(map(_version, rows))) or "not present"


def _version(row: ProgramRow) -> str:
    version, digest = row.version or "", short(row.sha256 or "")
    return f"{shown(version)} ({digest})" if version and "\n" not in version else digest


def _versions(
    was: Sequence[ProgramRow], now: Sequence[ProgramRow], words: frozenset[str], used: Sequence[str]
) -> Iterator[str]:
    """Yield the differing versions of a list of versions, such as distributions, and the paths if they differ."""
    if len(was) == len(now) == 1:
        listed = [rows[0].version or "" for rows in (was, now)]
        if any("\n" in text for text in listed):
            old, new = map(versions, listed)
            for name in by_likelihood(old.keys() | new.keys(), words, used):
                if old.get(name) != new.get(name):
                    yield f"{name} {old.get(name) or 'not present'} {ARROW} {new.get(name) or 'not present'}"
        if was[0].path != now[0].path:
            yield f"{was[0].path} {ARROW} {now[0].path}"


def environments(snapshot: Snapshot, before: ComparedRuns, after: ComparedRuns) -> Iterator[Difference]:
    """Yield differences of the machines by column, and of the runner, which is unknown for a killed session."""
    old, new = (
        _facts([row._asdict() for row in _environments(snapshot, side)], _runners(snapshot, side)) for side in (before, after)
    )
    for name in (name for name in old if name in new):
        yield from changed("environment", name, old[name], new[name])


def _facts(rows: Sequence[Facts], runners: Sequence[str] = ()) -> dict[str, Compared]:
    """Return the value of each column, and the runner; a list of values if there are several."""
    columns = {name: [row[name] for row in rows] for name in (rows[0] if rows else ()) if name != "environment"}
    return {name: _common(values) for name, values in (*columns.items(), *([("runner", runners)] if runners else []))}


def _common(values: Sequence[Compared]) -> Compared:
    different = list(dict.fromkeys("\n".join(map(str, value)) if isinstance(value, list) else value for value in values))
    return different[0] if len(different) == 1 else sorted(different, key=str)


def _environments(snapshot: Snapshot, side: ComparedRuns) -> list[EnvironmentRow]:
    statement = "SELECT * FROM environments WHERE list_contains($i, environment)"
    return snapshot.select(EnvironmentRow, statement, i=_used(snapshot, side, "environment"))


def _runners(snapshot: Snapshot, side: ComparedRuns) -> list[str]:
    statement = (
        f"WITH used AS (SELECT DISTINCT e.session FROM {side.table} t JOIN all_judgements e ON e.judgement = t.execution) "  # noqa: S608
        "SELECT DISTINCT s.runner FROM sessions s JOIN used USING (session) UNION "
        "SELECT DISTINCT r.runner FROM replays r JOIN used ON used.session = r.replay"
    )
    return snapshot.values(str, statement)


ISOLATION = {
    "engine": "engine",
    "version": "engine version",
    "mode": "one container per",
    "rootless": "rootless engine",
    "user": "user on the host",
    "network": "network of the container",
    "limits_enforced": "limits enforced",
    "limits_watched": "limits monitored by SIERRA",
    "limits_ignored": "limits ignored",
}
"""Compared columns of an isolation, and their names in a line. Devices and mounts are compared as host access."""
NOT_CONTAINED = "none (on the host)"


def isolations(snapshot: Snapshot, before: ComparedRuns, after: ComparedRuns) -> Iterator[Difference]:
    """Yield differences of the isolation. An execution without a container has the engine `none`."""
    statement = "SELECT * FROM isolations WHERE list_contains($i, isolation)"
    old, new = (
        _facts([_isolation(row) for row in snapshot.select(IsolationRow, statement, i=_used(snapshot, side, "isolation"))])
        for side in (before, after)
    )
    if bool(old) != bool(new):
        was, now = (facts.get("version", NOT_CONTAINED) for facts in (old, new))
        yield from changed("isolation", "engine", was, now, called="isolated by")
        return
    for name, words in ISOLATION.items():
        yield from changed("isolation", name, old.get(name), new.get(name), called=words)


def _isolation(row: IsolationRow) -> Facts:
    limits = container_setup.limits(row._asdict())
    return {name: json.dumps(limits[name]) if name in limits else getattr(row, name) for name in ISOLATION}


def executed(snapshot: Snapshot, side: ComparedRuns) -> bool:
    """Check whether any of a side's runs was executed."""
    return bool(snapshot.run(f"SELECT 1 FROM {side.table} WHERE execution IS NOT NULL LIMIT 1"))  # noqa: S608 - our own names


def rules(snapshot: Snapshot, before: ComparedRuns, after: ComparedRuns) -> Iterator[Difference]:
    """Yield differences of the declarations of outputs and success."""
    yield from other_rules(snapshot, *(_used(snapshot, side, "ingest_rules") for side in (before, after)))


def other_rules(snapshot: Snapshot, before: Sequence[str], after: Sequence[str]) -> Iterator[Difference]:
    """Yield differences of two groups of rules, by their ids."""
    if set(before) == set(after):
        return
    declared = [_declared(snapshot, ids) for ids in (before, after)]
    if all(len(texts) == 1 for texts in declared):
        yield from changed("rules", "declared", declared[0][0], declared[1][0], called="[outputs] and [success]")
    else:
        yield Difference("rules", "declared", "[outputs] and [success] differ", before, after)


def _declared(snapshot: Snapshot, ids: Sequence[str]) -> list[str]:
    return snapshot.values(str, "SELECT declared FROM ingest_rules WHERE list_contains($i, ingest_rules)", i=list(ids))


def known(snapshot: Snapshot, side: ComparedRuns, what: str) -> bool:
    """Check whether the store has the `what` of a side's executions, or of its last session."""
    return bool(_used(snapshot, side, what))


def _used(snapshot: Snapshot, side: ComparedRuns, what: str) -> list[str]:
    """Return the ids of `what` that a side's executions used; for a batch without executions, that of the last session."""
    found = [row[0] for row in snapshot.run(USED.format(what=what, table=side.table)) if row[0]]
    known = None if side.is_one or what == "isolation" else side.session and getattr(side.session, what)
    return found or ([known] if known else [])
