"""The batches that decide claims: those of their queries, as the project is now, or those that they name.

Instead, the batches can be chosen among given ones: older ones, or those of another store. Then a claim's query is that of a
batch if the criteria, the number of runs, the controller, the scenario, the changes and the target are the same, whatever the
code was. Nothing of the project is read or started for that, so that it may be a received one.
"""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence

from sierra.config.claim_table import Claim
from sierra.config.project_file import LoadedProject
from sierra.deliverables import comparison
from sierra.design.query import grammar, query_request
from sierra.design.query.query_request import QueryRequest
from sierra.errors import NotFound, UsageError
from sierra.execution import resolve_plan, resolve_query, targets
from sierra.store.store import Store
from sierra.util.hashing import short
from sierra.util.lazy_definitions import dataclass, field
from sierra.util.text import counted, few

SHOWN = 3
RECORDED = "SELECT batch FROM batches WHERE batch = $b"
SAME_QUERY = """
SELECT batch FROM batches
WHERE query = $query AND overrides = $overrides::VARCHAR[] AND controller IS NOT DISTINCT FROM $controller
  AND scenario IS NOT DISTINCT FROM $scenario AND runs = experiments * $runs AND batch IN $among
ORDER BY lamport, batch
"""


@dataclass(frozen=True, slots=True)
class BatchesOfClaims:
    """The batches of a project's claims. The same query is resolved once only, because that reads the whole source."""

    project: LoadedProject
    store: Store
    among: Sequence[str] | None = None
    """The ids of the batches that may decide; None: those of the project as it is now, and those that claims name."""
    _resolved: dict[QueryRequest, str] = field(default_factory=dict)

    def of(self, name: str, claim: Claim) -> Mapping[str, str]:
        """Return the ids of a claim's batches by label, in order. Raises NotFound, which names a query that has to be run."""
        if claim.query:
            request = query_request.request(
                claim.query, runs=claim.runs, controller=claim.controller, scenario=claim.scenario, target=claim.target
            )
            named = [("", self._of_query(name, request))]
        else:
            named = [self._labelled(name, word) for word in claim.batches]
        ids = [batch for _, batch in named]
        if len(set(ids)) < len(ids):
            raise UsageError(f"[claims.{name}] batches: two of them are the same batch")
        proposed = comparison.labels(self.project, self.store, ids)
        labels = [label or other for (label, _), other in zip(named, proposed, strict=True)]
        if len(set(labels)) < len(labels):
            raise UsageError(f"[claims.{name}] batches: two have the same label; give them different ones: LABEL=HASH")
        return dict(zip(labels, ids, strict=True))

    def _labelled(self, name: str, word: str) -> tuple[str, str]:
        """Return the label ("" for none) and the batch of a word: `LABEL=PREFIX`, `PREFIX`, or a query's name instead."""
        label, _, rest = word.rpartition("=")
        if rest in self.project.config.queries:
            return label or rest, self._of_query(name, query_request.request([rest]))
        found = self.store.resolve(rest)
        if self.among is not None and found.id not in self.among:
            raise NotFound(f"[claims.{name}] batches: {rest!r} is none of the given batches")
        if found.kind != "batch":
            raise NotFound(f"[claims.{name}] batches: {rest!r} is the id of another kind ({found.kind})")
        return label, found.id

    def _of_query(self, name: str, request: QueryRequest) -> str:
        if self.among is not None:
            return self._of_same_query(name, request, self.among)
        if request not in self._resolved:
            self._resolved[request] = resolve_plan.plan(self.project, request).batch.id
        batch = self._resolved[request]
        if not self.store.values(str, RECORDED, b=batch):
            raise NotFound(f"[claims.{name}] its query has not been run with this project as it is; run: {command(request)}")
        return batch

    def _of_same_query(self, name: str, request: QueryRequest, among: Sequence[str]) -> str:
        """Return that of the given batches which has the query of a request. Raises NotFound unless there is exactly one."""
        project = self.project.for_target(request.target)
        query = resolve_query.resolve(project, request)
        axes = {criterion.name for criterion in query.criteria}
        text = " ".join(map(grammar.text, query.criteria))
        same = self.store.values(
            str,
            SAME_QUERY,
            query=text,
            overrides=[f"{one.path}={one.value}" for one in query.sets],
            controller=None if "controller" in axes else query.controller or project.config.controller,
            scenario=None if "scenario" in axes else query.scenario or project.config.scenario,
            runs=query.runs,
            among=list(among),
        )
        found = [batch for batch in same if targets.recorded(self.store, batch) == project.config.target]
        if len(found) != 1:
            shown = few([short(one) for one in found], SHOWN)
            which = f"several of the given batches ({shown}) have" if found else "none of the given batches has"
            raise NotFound(f"[claims.{name}] {which} its query: {text}, {counted(query.runs, 'run')} for each experiment")
        return found[0]


def command(request: QueryRequest) -> str:
    """Return the command that runs a query."""
    options = {name: getattr(request, name) for name in ("runs", "controller", "scenario", "target")}
    given = (word for name, value in options.items() if value is not None for word in (f"--{name}", str(value)))
    return shlex.join(["sierra", "run", *request.criteria, *given])
