"""Choice of the runs that are observed: the first of a session, the first of each experiment, and a sample of the others.

The first run of an experiment is observed whatever it takes in the first `ALWAYS` experiments, in an order that the batch's id
decides. The worker observes those of further experiments, in the same order, as far as the observations of all of them take at
most `PART` of the runs' time. If n runs are to be executed, then the experiment in place p is observed if its observation takes
at most n · PART / p times the mean time of a run. So each worker can decide for itself, and for each run when it begins.

The sample is a part (`SAMPLED`) of the runs, chosen by hashes of the batch's id and the run's: on every machine, and whenever
the batch is executed, it is the same. A worker leaves out those whose observation would take more time than the budget allows.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import replace

from sierra.config.project_file import Project
from sierra.model import Helps, Job, Run
from sierra.util.hashing import sha256

SAMPLED = 0.1
"""The expected part of the runs that are in the sample: more would show little more, and each observation is recorded."""

ALWAYS = 10
"""The number of experiments of which one run is always observed."""
PART = 0.06
"""The part of the runs' time that observing one run of each experiment may take: with its recording and the sample, 0.1."""


def choose(
    jobs: Iterable[tuple[Run, Job]],
    batch: str,
    config: Project,
    folders: Mapping[str, str],
    helps: Helps | None,
    begun: set[int],
    affordable: Mapping[int, float],
) -> Iterator[Job]:
    """Yield the jobs; those of runs that are to be observed have the folders that names of files refer to.

    `begun`: the experiments of which the session has executed runs before; those of the jobs are added. `affordable`: see
    `affordable`.
    """
    if config.observe == "all":
        yield from (replace(job, observe=folders, helps=helps) for _, job in jobs)
        return
    for run, unnumbered in jobs:
        job = replace(unnumbered, experiment=run.experiment)
        if not begun:
            yield replace(job, observe=folders, helps=helps)
        elif run.experiment not in begun:
            yield replace(job, observe=folders, helps=helps, affordable=affordable.get(run.experiment))
        elif config.observe_budget and is_sampled(batch, run.id):
            yield replace(job, observe=folders, helps=helps, budget=config.observe_budget)
        else:
            yield job
        begun.add(run.experiment)


def affordable(batch: str, experiments: Collection[int], runs: int) -> dict[int, float]:
    """Return for experiments how many times the mean time of a run an observation may take; those always observed are left out.

    `experiments` and `runs` are those that a session executes.
    """
    if len(experiments) <= ALWAYS:
        return {}
    order = sorted(experiments, key=lambda ordinal: sha256(f"observe {batch} experiment {ordinal}".encode()))
    return {ordinal: PART * runs / place for place, ordinal in enumerate(order, 1) if place > ALWAYS}


def is_sampled(batch: str, run: str) -> bool:
    """Return whether a run is in the sample of its batch."""
    return int(sha256(f"observe {batch} {run}".encode())[:16], 16) < SAMPLED * 2**64
