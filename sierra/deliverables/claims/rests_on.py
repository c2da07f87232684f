"""The batches that decide claims: those of their queries, as the project is now, or those that they name.

Instead, the batches can be chosen among given ones: older ones, or those of another store. Then a claim's query is that of a
batch by `sierra.execution.batches_of_queries`, whatever the code was.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from sierra.config.claim_table import Claim
from sierra.config.project_file import LoadedProject, Project
from sierra.deliverables import comparison
from sierra.design.query import query_request
from sierra.design.query.query_request import QueryRequest
from sierra.errors import NotFound, UsageError
from sierra.execution.batches_of_queries import BatchesOfQueries, command, described
from sierra.store.store import Store
from sierra.util.hashing import short
from sierra.util.text import counted, few

SHOWN = 3


class BatchesOfClaims:
    """The batches of a project's claims."""

    def __init__(self, project: LoadedProject, store: Store, among: Sequence[str] | None = None) -> None:
        """`among`: the ids of the batches that may decide; None: those of the present project, and those that claims name."""
        self._project = project
        self._store = store
        self._among = among
        self._queries = BatchesOfQueries(project, store)

    def of(self, name: str, claim: Claim) -> Mapping[str, str]:
        """Return the ids of a claim's batches by label, in order. Raises NotFound, which names a query that has to be run."""
        if claim.query:
            named = [("", self._of_query(name, request_of(claim)))]
        else:
            named = [self._labelled(name, word) for word in claim.batches]
        ids = [batch for _, batch in named]
        if len(set(ids)) < len(ids):
            raise UsageError(f"[claims.{name}] batches: two of them are the same batch")
        try:
            return comparison.labelled(self._project, self._store, named)
        except UsageError as error:
            raise UsageError(f"[claims.{name}] batches: {error}") from error

    def _labelled(self, name: str, word: str) -> tuple[str, str]:
        """Return the label ("" for none) and the batch of a word: `LABEL=PREFIX`, `PREFIX`, or a query's name instead."""
        label, _, rest = word.rpartition("=")
        if rest in self._project.config.queries:
            return label or rest, self._of_query(name, query_request.request([rest]))
        resolved = self._store.resolve(rest)
        if self._among is not None and resolved.id not in self._among:
            raise NotFound(f"[claims.{name}] batches: {rest!r} is none of the given batches")
        if resolved.kind != "batch":
            raise NotFound(f"[claims.{name}] batches: {rest!r} is the id of another kind ({resolved.kind})")
        return label, resolved.id

    def _of_query(self, name: str, request: QueryRequest) -> str:
        if self._among is not None:
            return self._of_same_query(name, request, self._among)
        batch = self._queries.now(request)
        if batch is None:
            raise NotFound(f"[claims.{name}] its query has not been run with this project as it is; run: {command(request)}")
        return batch

    def _of_same_query(self, name: str, request: QueryRequest, among: Sequence[str]) -> str:
        """Return that of the given batches which has the query of a request. Raises NotFound unless there is exactly one."""
        batches = [batch for batch in self._queries.same(request) if batch in among]
        if len(batches) != 1:
            text, runs = described(self._project, request)
            shown = few([short(batch) for batch in batches], SHOWN)
            which = f"several of the given batches ({shown}) have" if batches else "none of the given batches has"
            raise NotFound(f"[claims.{name}] {which} its query: {text}, {counted(runs, 'run')} for each experiment")
        return batches[0]


def request_of(claim: Claim) -> QueryRequest:
    """Return the query of a claim, with its own options."""
    return query_request.request(
        claim.query, runs=claim.runs, controller=claim.controller, scenario=claim.scenario, target=claim.target
    )


def requests(claim: Claim, config: Project) -> list[QueryRequest]:
    """Return the queries that a claim rests on: its own, and those that its batches name."""
    if claim.query:
        return [request_of(claim)]
    names = (word.rpartition("=")[2] for word in claim.batches)
    return [query_request.request([name]) for name in names if name in config.queries]
