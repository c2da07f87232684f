"""Explanations of a scheduler's refusals: the settings of a cluster's table that they are about, and their values.

Schedulers report `PartitionConfig`, for example, but not what is wrong. The tables list the words of SLURM (`slurm_strerror`,
reasons of squeue) and PBS (`pbs_error`, comments of jobs) for requests that they refuse or that will never begin. These words
always come first in the message.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence

from sierra.config.cluster_table import ClusterTable
from sierra.util.lazy_definitions import dataclass

PLACE = ("partition", "account", "qos")
DIRECTIVES = ("directives",)
SIZE = ("cpus", "memory", "gpus", "constraint")


@dataclass(frozen=True, slots=True)
class Meaning:
    """The meaning of some words of a scheduler."""

    words: re.Pattern[str]
    means: str
    settings: tuple[str, ...]


def _meaning(words: str, means: str, *settings: str) -> Meaning:
    return Meaning(re.compile(words, re.IGNORECASE), means, settings)


SLURM = (
    _meaning(r"DependencyNeverSatisfied", "the preflight job failed"),
    _meaning(r"JobHeldAdmin", "an administrator holds the job"),
    _meaning(r"accounting/QOS policy", "the account or QOS allows less", *PLACE, *SIZE, "wall", "array_tasks"),
    _meaning(r"memory specification|MaxMemPerLimit", "no node has that much memory", "partition", "memory"),
    _meaning(r"PartitionTimeLimit|time limit is invalid", "the partition does not allow that much time", "partition", "wall"),
    _meaning(
        r"PartitionConfig|PartitionNodeLimit|(partition|node) configuration (is )?not available|more processors requested"
        r"|(cpu|node) count (specification|per node)",
        "no node of the partition can satisfy the whole request",
        *("partition", *SIZE, "wall"),
    ),
    _meaning(
        r"partition not available|invalid partition|PartitionDown|PartitionInactive",
        "this partition does not exist or is not available",
        "partition",
    ),
    _meaning(
        r"account|association|user'?s? group not permitted|can't use this partition", "not available to the account", *PLACE
    ),
    _meaning(r"(Assoc|QOS)\w*(Wall|Time)", "the account or QOS allows other times", *PLACE, "wall"),
    _meaning(r"(Assoc|QOS)\w*(Cpu|Node|Billing)", "the account or QOS allows another number of cores", *PLACE, "cpus"),
    _meaning(r"(Assoc|QOS)\w*Mem", "the account or QOS allows another size of memory", *PLACE, "memory"),
    _meaning(r"(Assoc|QOS)\w*(Gres|TRES)", "the account or QOS allows other resources", *PLACE, *SIZE),
    _meaning(r"qos", "this quality of service is not available to you", "qos", "account"),
    _meaning(r"BadConstraints|feature", "no node has these features", "constraint"),
    _meaning(r"generic resource|gres|gpu", "no node has these processors", "gpus", "partition"),
    _meaning(r"job array", "an array of this length is not allowed", "array_tasks"),
    _meaning(r"licen[sc]e|reservation|option|wckey|cluster", "caused by the directives", *DIRECTIVES),
)
PBS = (
    _meaning(
        r"unknown queue|queue .*(not enabled|not started)|no default queue",
        "the queue does not exist or is not available",
        "partition",
    ),
    _meaning(
        r"unauthori[sz]ed|not authori[sz]ed|access .*denied|no permission", "not available to you", "partition", "account"
    ),
    _meaning(r"account", "this account is not available to you", "account"),
    _meaning(r"walltime", "that much time is not allowed", "partition", "wall"),
    _meaning(r"-J value|array", "this array is not allowed", "array_tasks"),
    _meaning(
        r"resource limits|can never run|enough total nodes|feasible|cannot satisfy|too many|exceeds",
        "no node and no queue limit can satisfy the whole request",
        *("partition", *SIZE, "wall", "array_tasks"),
    ),
    _meaning(
        r"unknown resource|illegal attribute|option",
        "this resource or option does not exist here",
        "gpus",
        "constraint",
        *DIRECTIVES,
    ),
)


def about(words: str, meanings: Sequence[Meaning], table: ClusterTable, site: Callable[[], Sequence[str]]) -> str:
    """Return these words with their meaning, the requested settings and what the site offers, if known, in one line.

    The site is queried only if the words are about its nodes or about places in a queue.
    """
    known = next((meaning for meaning in meanings if meaning.words.search(words)), None)
    if known is None:
        return words
    if not known.settings:
        return f"{words}: {known.means}"
    requested = ", ".join(_requested(table, known.settings)) or "nothing, so the site's defaults apply"
    offered = () if known.settings == DIRECTIVES else site()
    offer = f"; the site has {'; '.join(offered)}" if offered else ""
    return f"{words}: {known.means}; requested: {requested}{offer}"


def _requested(table: ClusterTable, settings: Sequence[str]) -> Iterator[str]:
    for name in settings:
        value = getattr(table, name)
        if value not in (None, ()):
            yield f"{name} = {_shown(name, value)}"


def _shown(name: str, value: float | str | tuple[str, ...]) -> str:
    match value:
        case int() if name == "memory":
            return f"{value / 1e9:.5g} GB"
        case int() | float():
            return f"{value:g}" if value < 1e6 else str(value)
        case tuple():
            return ", ".join(value)
        case _:
            return repr(value)
