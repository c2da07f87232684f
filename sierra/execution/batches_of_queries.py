"""The batches of queries: that of the project as it is now, and the last one that was requested.

A query is a text as for `sierra run`, or the name of one in `[queries]`. Batches have the same query if the criteria, the
number of runs, the controller, the scenario, the changes and the target are the same, whatever the code was. Nothing of the
project is read or started to find those, so that it may be a received one.
"""

from __future__ import annotations

import shlex

from sierra.config.project_file import LoadedProject, Project
from sierra.design.query import grammar, query_request
from sierra.design.query.query_request import QueryRequest
from sierra.errors import NotFound
from sierra.execution import resolve_query
from sierra.store.store import Store
from sierra.util.json_types import JsonView
from sierra.util.lazy_definitions import dataclass, field
from sierra.util.quoted_values import words

RECORDED = "SELECT batch FROM batches WHERE batch = $b"
SAME_QUERY = """
SELECT batch FROM batches LEFT JOIN (
    SELECT batch, max(lamport) FILTER (target IS NOT DISTINCT FROM $target) AS last, true AS requested
    FROM sessions GROUP BY batch
) USING (batch)
WHERE query = $query AND overrides = $overrides::VARCHAR[] AND controller IS NOT DISTINCT FROM $controller
  AND scenario IS NOT DISTINCT FROM $scenario AND runs = experiments * $runs
  AND (last IS NOT NULL OR (requested IS NULL AND $target IS NULL))
ORDER BY coalesce(last, lamport), batch
"""
"""The batches that were requested for this target, the last one last; one without any session has no target."""


@dataclass(frozen=True, slots=True)
class BatchesOfQueries:
    """The batches of queries of one project. Each query is resolved once only."""

    project: LoadedProject
    store: Store
    _now: dict[QueryRequest, str] = field(default_factory=dict)
    _same: dict[QueryRequest, list[str]] = field(default_factory=dict)

    def now(self, request: QueryRequest) -> str | None:
        """Return the batch that a query has with the project as it is now; None if it is not recorded.

        That reads the whole source, and raises the errors of planning.
        """
        from sierra.execution import resolve_plan  # loads all platforms

        if request not in self._now:
            self._now[request] = resolve_plan.plan(self.project, request).batch.id
        batch = self._now[request]
        return batch if self.store.values(str, RECORDED, b=batch) else None

    def same(self, request: QueryRequest) -> list[str]:
        """Return all recorded batches of a query; the last requested one comes last. Raises QueryError for an invalid query."""
        if request not in self._same:
            self._same[request] = self._find(request)
        return self._same[request]

    def last_of(self, word: str) -> list[str]:
        """Return the last batch of a query, alone, or nothing if it was not run. Raises QueryError for an invalid query."""
        return self.same(labelled(self.project.config, word)[1])[-1:]

    def last(self, word: str) -> str:
        """Return the last batch of a query, which is a text as for `sierra run`, or the name of one. Raises NotFound."""
        if found := self.last_of(word):
            return found[0]
        _, request = labelled(self.project.config, word)
        raise NotFound(f"the query {' '.join(request.criteria)!r} has not been run; run: {command(request)}")

    def _find(self, request: QueryRequest) -> list[str]:
        return self.store.values(str, SAME_QUERY, **identity(self.project, request))


def labelled(config: Project, word: str) -> tuple[str, QueryRequest]:
    """Return the label and the request of a word that names a query: `NAME`, `LABEL=NAME`, or criteria as for `sierra run`.

    The label of `NAME` is the name, and that of criteria is "". `VARIABLE=VALUE` is a criterion, whatever queries there are.
    """
    label, equals, name = word.partition("=")
    is_criterion = label in {*config.variables, "controller", "scenario"}
    if equals and name in config.queries and not is_criterion:
        return label, query_request.request([name])
    return word if word in config.queries else "", query_request.request(words(word))


def identity(project: LoadedProject, request: QueryRequest) -> dict[str, JsonView]:
    """Return the parts of a query that are the same in all batches of it. Raises QueryError for an invalid query."""
    project = project.for_target(resolve_query.target(project, request))
    query = resolve_query.resolve(project, request)
    axes = {criterion.name for criterion in query.criteria}
    return {
        "query": " ".join(map(grammar.text, query.criteria)),
        "overrides": [f"{change.path}={change.value}" for change in query.sets],
        "controller": None if "controller" in axes else query.controller or project.config.controller,
        "scenario": None if "scenario" in axes else query.scenario or project.config.scenario,
        "runs": query.runs,
        "target": project.config.target,
    }


def described(project: LoadedProject, request: QueryRequest) -> tuple[str, int]:
    """Return the criteria of a query as text, and its number of runs for each experiment."""
    query = resolve_query.resolve(project.for_target(resolve_query.target(project, request)), request)
    return " ".join(map(grammar.text, query.criteria)), query.runs


def command(request: QueryRequest) -> str:
    """Return the command that runs a query."""
    options = {name: getattr(request, name) for name in ("runs", "controller", "scenario", "target")}
    given = (word for name, value in options.items() if value is not None for word in (f"--{name}", str(value)))
    return shlex.join(["sierra", "run", *request.criteria, *given])
