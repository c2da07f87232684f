"""The preview of a plan as it is handed out: the JSON of `sierra run --dry-run --json`, published as `plan.schema.json`."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field

from sierra.design.query.query_request import QueryRequest
from sierra.execution.cluster_status import ClusterSession
from sierra.runners.cluster.resource_estimate import Estimate


class PlanPreview(BaseModel):
    """A plan: the batch and the runs that a query would execute. `sierra run FILE.json` accepts a file with this content."""

    model_config = ConfigDict(frozen=True, title="plan.json")

    request: QueryRequest = Field(description="the query, without settings that have their default")
    batch: str = Field(description="id of the batch that the query expands to")
    query: str = Field(description="the criteria, in full")
    target: str | None = Field(None, description="target that the batch is for; missing if there is none")
    experiments: int = Field(description="number of experiments")
    selected: int | None = Field(None, description="with --only: number of these experiments that it selects")
    runs: int = Field(description="number of different runs; with --only, of the selected experiments")
    to_execute: int = Field(description="number of runs that would execute")
    reused: int = Field(description="number of runs with a recorded execution that would be reused, or evaluated again")
    to_reevaluate: int = Field(
        description="number of these that would be evaluated again, because [outputs] or [success] have changed"
    )
    given_up: int = Field(0, description="number of runs that failed twice in the same way; only --retry executes them again")
    on_clusters: int = Field(description="number of runs that a cluster executes now; they would be followed")
    clusters: tuple[ClusterSession, ...] = Field(description="the sessions on clusters with these runs")
    reasons: dict[str, int] = Field(description="number of runs by the reason why they would execute or be reused")
    notes: tuple[str, ...] = Field(description="messages about the plan")
    new_because: tuple[str, ...] = Field(description="with --explain: why runs are new, one line each")
    other_programs: tuple[str, ...] | None = Field(
        None, description="with --explain: the programs that differ from those of the last execution, if runs execute for that"
    )
    build: str | None = Field(None, description="with [build]: whether the products would be built first, and why")
    proposal: Estimate | None = Field(description="what would be submitted to a cluster; null for a runner without one")

    def as_dict(self) -> dict[str, object]:
        """Return the fields for JSON. Keys without a value are left out where the schema does not require them."""
        optional = ("other_programs", "build", "selected", "target")
        names = [name for name in type(self).model_fields if name not in optional or getattr(self, name) is not None]
        request = self.request.model_dump(mode="json", exclude_defaults=True)
        return {name: getattr(self, name) for name in names} | {"request": request}
