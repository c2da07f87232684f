"""The needs of a package, measured: the time and memory that its runs took, and the machines that they ran on."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field

from sierra.store.store import Store


class _Part(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class Measured(_Part):
    """The needs of a batch, as its successful executions were measured, one after the other."""

    seconds: float = Field(ge=0, description="sum of the durations of all runs, in seconds")
    shortest: float = Field(ge=0, description="the same for the shortest run of each experiment")
    longest: float = Field(ge=0, description="duration of the longest run, in seconds")
    memory: int | None = Field(ge=0, description="largest resident memory of a run, in bytes; null if it was not measured")
    measured: int = Field(ge=0, description="number of runs that were measured")


class Machine(_Part):
    """A kind of machine that runs were executed on."""

    os: str | None = Field(description="operating system")
    architecture: str | None = Field(description="architecture, such as x86_64")
    cpu: str | None = Field(description="name of the processor")
    cores: int | None = Field(description="number of its cores")
    memory: int | None = Field(description="memory in bytes")
    gpus: tuple[str, ...] = Field(description="names of its graphics processors")
    image: str | None = Field(description="digest of the container image; null outside containers")


BATCHES = """
SELECT batch, sum(took) / 1e6 AS seconds, sum(took) FILTER (place = 1) / 1e6 AS shortest, max(took) / 1e6 AS longest,
       max(memory) AS memory, count(*) AS measured
FROM (SELECT f.batch, (e.wall_s * 1e6)::BIGINT AS took, e.max_rss_bytes AS memory,
             row_number() OVER (PARTITION BY f.batch, f.ordinal ORDER BY e.wall_s, f.run) AS place
      FROM effective f JOIN executions e USING (execution) WHERE e.wall_s IS NOT NULL)
GROUP BY batch
"""
"""SQL: the needs by batch. Whole microseconds have the same sum in any order."""
MACHINES = """
SELECT DISTINCT n.os, n.machine AS architecture, n.cpu, n.cores, n.memory, n.gpus, i.image
FROM effective f JOIN executions e USING (execution) JOIN environments n ON n.environment = e.environment
     LEFT JOIN isolations i ON i.isolation = e.isolation
ORDER BY ALL
"""


def of_batches(store: Store) -> dict[str, Measured]:
    """Return the needs by batch; a batch of which no run was measured is left out."""
    return {str(row.pop("batch")): Measured.model_validate(row) for row in store.rows(BATCHES)}


def machines(store: Store) -> tuple[Machine, ...]:
    """Return the different machines of the successful executions."""
    return tuple(Machine.model_validate(row) for row in store.rows(MACHINES))
