"""The section about the environment: code, hosts, members of runs, image, programs, variables."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from typing import NamedTuple

from sierra.config import extensions
from sierra.deliverables.report.batch_state import BatchState
from sierra.deliverables.report.parts import Place, Section, badge, details, facts, filled_table, note, sql, table
from sierra.util.hashing import short
from sierra.util.html_elements import Markup, Node, element, joined
from sierra.util.text import few, size

HOSTS = """
SELECT e.host, n.os, n.kernel, n.machine, n.cpu, n.cores, n.memory, n.python, n.sierra, count(*) AS executions
FROM effective f JOIN executions e USING (execution) LEFT JOIN environments n USING (environment)
WHERE f.batch = $b GROUP BY ALL ORDER BY executions DESC, e.host, n.kernel, n.cpu, n.cores, n.memory, n.python, n.sierra
"""
"""The hosts of the executions that count."""
ATTEMPTS = """
SELECT scheduler, count(DISTINCT node) AS nodes, count(*) AS attempts, state, sum(interrupted_runs)::BIGINT AS cut,
       coalesce(error, '') AS error
FROM attempts WHERE batch = $b GROUP BY ALL ORDER BY scheduler, attempts DESC, state, error
"""
SHOWN = 200
"""The largest number of programs or hosts that are listed."""


class _Host(NamedTuple):
    host: str
    os: str | None
    kernel: str | None
    machine: str | None
    cpu: str | None
    cores: int | None
    memory: int | None
    python: str | None
    sierra: str | None
    executions: int


class _Attempts(NamedTuple):
    scheduler: str | None
    nodes: int
    attempts: int
    state: str
    cut: int
    error: str


def section(state: BatchState, headings: Place) -> Section:
    """Return the section about what was around the executions that count."""
    return Section("environment", "Environment", joined(_lines(state, headings)))


def _lines(state: BatchState, headings: Place) -> Iterator[Markup]:
    yield element(headings.inner, "Code")
    yield facts(_code(state))
    yield from _variables(json.loads(state.shown.spec.variables))
    yield element(headings.inner, "Hosts")
    yield from _hosts(state)
    yield from _cluster(state, headings)
    for lines in extensions.called("member_lines", state, headings):
        yield from lines
    yield from _image(state, headings)
    yield from _programs(state)


def _code(state: BatchState) -> dict[str, Node]:
    spec, source = state.shown.spec, state.shown.source
    known: dict[str, Node] = {"platform": spec.platform, "command": element("code", " ".join(spec.command))}
    if source is None:
        return {**known, "source": "none declared"}
    known |= {"commit": source.commit and element("code", source.commit), "described as": source.described}
    known |= {"branch": source.branch, "remote": source.remote, "tree": element("code", source.tree)}
    if source.dirty is not None:
        text = "differed from the commit; SIERRA keeps the exact files" if source.dirty else "as in the commit"
        known["working tree"] = joined(
            (badge("dirty" if source.dirty else "clean", "unclear" if source.dirty else "good"), " ", text)
        )
    if source.vcs == "none":
        known["version control"] = "none; SIERRA keeps the files"
    return known


def _variables(variables: Mapping[str, str]) -> Iterator[Markup]:
    if variables:
        lines = "\n".join(f"{name}={value}" for name, value in variables.items())
        yield details(
            f"Declared environment variables ({len(variables)})",
            element("pre", lines, tabindex=0, role="group", aria_label="Environment variables", dir="auto"),
        )


def _hosts(state: BatchState) -> Iterator[Markup]:
    hosts = state.store.select(_Host, HOSTS, b=state.id)
    if not hosts:
        yield note("No execution counts yet.")
        return
    rows = [
        (
            host.host,
            host.os or "",
            host.kernel or "",
            " ".join(filter(None, (host.cpu, f"({host.machine})" if host.machine else ""))),
            f"{host.cores}" if host.cores else "",
            size(host.memory) if host.memory else "",
            " / ".join(filter(None, (host.python, host.sierra))),
            host.executions,
        )
        for host in hosts[:SHOWN]
    ]
    headers = ("host", "system", "kernel", "processor", "cores", "memory", "Python / SIERRA", "runs")
    yield table(headers, rows, "Hosts of the executions that count", numbers=(4, 5, 7))
    if len(hosts) > SHOWN:
        yield note(f"The first {SHOWN} of {len(hosts)} are listed.")
    yield sql(HOSTS, state.id)


def _cluster(state: BatchState, headings: Place) -> Iterator[Markup]:
    attempts = state.store.select(_Attempts, ATTEMPTS, b=state.id)
    if attempts:
        yield element(headings.inner, "Cluster")
        rows = [
            (attempt.scheduler or "", attempt.nodes, attempt.attempts, attempt.state, attempt.cut, attempt.error)
            for attempt in attempts[:SHOWN]
        ]
        headers = ("scheduler", "nodes", "array tasks", "ended", "runs cut off", "error")
        yield filled_table(headers, rows, "Attempts at array tasks, also those whose runs do not count", (1, 2, 4))
        yield sql(ATTEMPTS, state.id)


def _image(state: BatchState, headings: Place) -> Iterator[Markup]:
    image = state.shown.image
    if image is None:
        return
    yield element(headings.inner, "Container")
    isolations = [
        f"{isolation.row.version or isolation.row.engine}, network {isolation.row.network}"
        for isolation in state.shown.isolations
        if isolation.row
    ]
    known: dict[str, Node] = {**image.facts(state.shown.spec.host_access)}
    known |= {"id": element("code", image.image), "isolation": few(list(dict.fromkeys(isolations)), 4)}
    yield facts(known)


def _programs(state: BatchState) -> Iterator[Markup]:
    programs = state.shown.programs
    if not programs:
        return
    rows = [
        (program.name, program.kind, program.short_version[:120], short(program.sha256 or "")) for program in programs[:SHOWN]
    ]
    more = note(f"The first {SHOWN} of {len(programs):,} are listed.") if len(programs) > SHOWN else None
    inner = table(("name", "kind", "version", "SHA-256"), rows, "Programs and libraries outside of the source and the image")
    yield details("Programs and libraries", inner, more)
