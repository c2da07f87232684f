"""Choice of the runs that are observed: the first of a session, the first of each experiment, and a sample of the others.

The sample is a part (`SAMPLED`) of the runs, chosen by hashes of the batch's id and the run's: on every machine, and whenever
the batch is executed, it is the same. Apart from the first run of a session, a worker leaves out runs whose observation would
take more time than the budget allows.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace

from sierra.config.project_file import Project
from sierra.model import Helps, Job, Run
from sierra.util.hashing import sha256

SAMPLED = 0.1
"""The expected part of the runs that are in the sample: more would show little more, and each observation is recorded."""


def choose(
    jobs: Iterable[tuple[Run, Job]],
    batch: str,
    config: Project,
    folders: Mapping[str, str],
    helps: Helps | None,
    begun: set[int],
) -> Iterator[Job]:
    """Yield the jobs; those of runs that are to be observed have the folders that names of files refer to.

    `begun`: the experiments of which the session has executed runs before; those of the jobs are added.
    """
    if config.observe == "all":
        yield from (replace(job, observe=folders, helps=helps) for _, job in jobs)
        return
    for run, job in jobs:
        if not begun:
            yield replace(job, observe=folders, helps=helps)
        elif config.observe_budget and (run.experiment not in begun or is_sampled(batch, run.id)):
            yield replace(job, observe=folders, helps=helps, budget=config.observe_budget)
        else:
            yield job
        begun.add(run.experiment)


def is_sampled(batch: str, run: str) -> bool:
    """Return whether a run is in the sample of its batch."""
    return int(sha256(f"observe {batch} {run}".encode())[:16], 16) < SAMPLED * 2**64
