"""The claims of a received project with the packed batches of their queries, found without planning these.

Planning a query reads files that `sierra.toml` names, and starts the Python of its command with its variables. For a received
project, the batch of a query is the packed one that was requested with the same criteria, runs, controller, scenario and
target. If none or several are, nothing can be told about the claim.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace

from sierra.config.claim_table import Claim
from sierra.config.project_file import LoadedProject
from sierra.errors import NotFound, SierraError
from sierra.execution import resolve_query, targets
from sierra.query import grammar, query_request
from sierra.query.query_request import QueryRequest
from sierra.store.row_types import BatchRow
from sierra.store.store import Store
from sierra.util.hashing import short
from sierra.util.text import few, one_line


def with_batches(project: LoadedProject, store: Store) -> tuple[LoadedProject, Mapping[str, str]]:
    """Return the project, whose claims name batches instead of queries; and the reason for each claim without batches."""
    claims: dict[str, Claim] = {}
    unknown: dict[str, str] = {}
    for name, claim in project.config.claims.items():
        try:
            words = tuple(_words(project, store, claim))
        except SierraError as error:
            unknown[name], words = one_line(error), ("0" * 64,)  # no batch has this id
        claims[name] = claim.model_copy(update={"query": (), "batches": words})
    return replace(project, config=project.config.model_copy(update={"claims": claims})), unknown


def _words(project: LoadedProject, store: Store, claim: Claim) -> Iterator[str]:
    """Yield the batches of a claim as it could name them: `LABEL=ID`, or the id alone."""
    if claim.query:
        given = {name: getattr(claim, name) for name in ("runs", "controller", "scenario", "target")}
        yield _batch(project, store, query_request.request(claim.query, **given))
    for word in claim.batches:
        label, _, rest = word.rpartition("=")
        if rest in project.config.queries:
            yield f"{label or rest}={_batch(project, store, query_request.request([rest]))}"
        else:
            store.resolve(rest)
            yield word


def _batch(project: LoadedProject, store: Store, request: QueryRequest) -> str:
    """Return the packed batch of a request. Raises NotFound unless there is exactly one, QueryError."""
    project = project.for_target(request.target)
    query = resolve_query.resolve(project, request)
    text = " ".join(map(grammar.text, query.criteria))
    rows = store.select(BatchRow, "SELECT * FROM batches WHERE query = $q ORDER BY lamport", q=text)
    wanted = {name: getattr(query, name) or getattr(project.config, name) for name in ("controller", "scenario")}
    found = [
        row.batch
        for row in rows
        if row.runs == row.experiments * query.runs
        and not row.overrides
        and all(name in row.axes or getattr(row, name) == value for name, value in wanted.items())
        and targets.recorded(store, row.batch) == project.config.target
    ]
    if len(found) != 1:
        several = f"several batches of its query: {few([short(one) for one in found], 3)}" if found else "no batch of its query"
        raise NotFound(f"the package has {several}: {text}, {query.runs} runs")
    return found[0]
