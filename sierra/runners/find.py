"""Functions that find runners, and check their tables in `sierra.toml`."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from sierra.config import extensions
from sierra.config.cluster_table import ClusterTable
from sierra.config.plugin_registry import RUNNERS, SCHEDULERS, Tables
from sierra.errors import ConfigError
from sierra.runners import schedulers
from sierra.runners.base import Runner


def find(name: str, tables: Tables | None = None) -> Callable[[int], Runner]:
    """Return a factory that makes the named runner from a number of slots; `tables` are `[runners.…]` of the project.

    Raises ConfigError if there is no such runner, or if its table is invalid.
    """
    cluster = scheduler_of(name, tables)
    if cluster is None:
        check({name: (tables or {}).get(name, {})})
        return partial(RUNNERS.make, name, tables or {})
    return on_cluster(name, *cluster)


def check(tables: Tables) -> None:
    """Check all `[runners.…]` of a project. Raises ConfigError for an unknown runner or scheduler, or for invalid settings."""
    for name, table in tables.items():
        if scheduler_of(name, tables) is None:
            RUNNERS.options(name, table)


def on_cluster(name: str, scheduler: str, table: ClusterTable) -> Callable[[int], Runner]:
    """Return a factory that makes the runner of a cluster from a number of slots, which has no effect there."""
    from sierra.runners.cluster.runner import Cluster

    return partial(Cluster, table=table, name=name, scheduler=scheduler)


def scheduler_of(name: str, tables: Tables | None = None) -> tuple[str, ClusterTable] | None:
    """Return the scheduler of the named cluster, and the cluster's table; None if the name is another runner's.

    Raises ConfigError if there is no runner of that name, or if the cluster's table is invalid.
    """
    table = (tables or {}).get(name)
    requested = table.get("scheduler") if table is not None else None
    if requested is None and name in RUNNERS.names():
        return None
    scheduler = str(requested or name)
    if scheduler in SCHEDULERS.names():
        return scheduler, schedulers.table(scheduler, table or {}, name)
    if extensions.absent("schedulers", scheduler):
        raise ConfigError(f"[runners.{name}]: {SCHEDULERS.unknown(scheduler)}")
    if extensions.absent("runners", name):
        raise ConfigError(RUNNERS.unknown(name) if table is None else f"[runners.{name}]: {RUNNERS.unknown(name)}")
    if table is not None:
        raise ConfigError(f"[runners.{name}] needs a scheduler: {', '.join(SCHEDULERS.names())}")
    known = dict.fromkeys((*RUNNERS.names(), *SCHEDULERS.names(), *(tables or {})))
    raise ConfigError(f"unknown runner {name!r}; known are {', '.join(known)}")
