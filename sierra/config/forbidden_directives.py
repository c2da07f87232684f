"""Forbidden `#SBATCH` and `#PBS` lines: SIERRA writes them itself, or its jobs would not work with them.

If an option occurs twice, schedulers use one of the two, without a message. Options that have a setting in `[runners.…]` are
refused in favour of that setting. Options are also refused if jobs could not be found again, would write their logs elsewhere,
or would wait forever.
"""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator, Mapping

CPUS = "use cpus = N, which is also the number of runs at a time"
MEMORY = 'use memory = "8 GB"'
WALL = "use wall = SECONDS"
PARTITION = 'use partition = "…"'
ACCOUNT = 'use account = "…"'
ONE_NODE = "an array task runs on one node; array_tasks = N sets the number of array tasks, cpus = N the cores of each"
NAMED = "SIERRA finds its jobs by the name that it gives them"
LOGS = "SIERRA shows the output of array tasks if it matters, and removes it with the session"
WAITS = "SIERRA itself makes array tasks wait for one small task that tests the nodes"
FOLLOWED = "SIERRA waits for its jobs itself; use --detach to leave them"
ALONE = 'jobs get no variables of your shell; set variables of runs in [environment], and modules to load with modules = ["…"]'
SUBMITTED = "SIERRA reads the output of the submit command, and submits one script"
FOLDER = 'jobs start in the session\'s folder; scratch = "…" sets the folder where runs execute'

SLURM: Mapping[str, str] = {
    **dict.fromkeys(("cpus-per-task", "cpus-per-gpu"), CPUS),
    **dict.fromkeys(("mem", "mem-per-cpu"), MEMORY),
    "time": WALL,
    "partition": PARTITION,
    "account": ACCOUNT,
    "qos": 'use qos = "…"',
    "constraint": 'use constraint = "…"',
    "array": "use array_tasks = N",
    **dict.fromkeys(("nodes", "ntasks", "ntasks-per-core", "ntasks-per-gpu", "ntasks-per-node", "ntasks-per-socket"), ONE_NODE),
    "job-name": NAMED,
    "comment": "SIERRA writes the session of the job there",
    "clusters": "SIERRA finds its jobs only on the cluster that SLURM_CONF selects",
    **dict.fromkeys(("output", "error", "open-mode"), LOGS),
    **dict.fromkeys(("dependency", "kill-on-invalid-dep"), WAITS),
    "wait": FOLLOWED,
    **dict.fromkeys(("export", "export-file", "get-user-env"), ALONE),
    "chdir": FOLDER,
    **dict.fromkeys(("parsable", "quiet", "test-only", "wrap", "help", "usage", "version"), SUBMITTED),
}
"""The reason or the alternative for each long option of sbatch."""
SHORT = {
    **{"c": "cpus-per-task", "t": "time", "p": "partition", "A": "account", "q": "qos", "C": "constraint", "a": "array"},
    **{"N": "nodes", "n": "ntasks", "J": "job-name", "M": "clusters", "o": "output", "e": "error", "d": "dependency"},
    **{"W": "wait", "D": "chdir", "Q": "quiet", "h": "help", "u": "usage", "V": "version"},
}
FLAGS = "HIOQVWhksuv"
"""Short options of sbatch without a value; others may follow in the same word."""

PBS: Mapping[str, str] = {
    "q": PARTITION,
    "A": ACCOUNT,
    **dict.fromkeys(("J", "t"), "use array_tasks = N"),
    "N": NAMED,
    **dict.fromkeys(("o", "e", "j", "k"), LOGS),
    **dict.fromkeys(("V", "v"), ALONE),
    "S": "SIERRA's script is written for sh",
    **dict.fromkeys(("C", "f", "I", "X", "z"), SUBMITTED),
}
"""The reason or the alternative for each option of qsub."""
RESOURCES: Mapping[str, str] = {
    "select": 'use cpus, memory and gpus; constraint = "…" is added to select',
    "nodes": 'use cpus, memory and gpus; constraint = "…" is added to it',
    **dict.fromkeys(("ncpus", "procs"), CPUS),
    **dict.fromkeys(("mem", "pmem"), MEMORY),
    "walltime": WALL,
    "ngpus": "use gpus = N",
}
"""The reason or the alternative for each resource after `-l`."""
ATTRIBUTES: Mapping[str, str] = {"depend": WAITS, "block": FOLLOWED, "interactive": SUBMITTED}
"""The reason for each attribute after `-W`."""
CHECKED = ("slurm", "pbs")
"""The schedulers whose lines are checked here; others refuse lines themselves (see `sierra.runners.schedulers.base`)."""


def complaint(scheduler: str, line: str) -> str | None:
    """Return the reason why a line cannot be added for a scheduler of `CHECKED`, with an alternative; None if it can."""
    mark, example, found = ("SBATCH", "--mail-type=FAIL", _slurm) if scheduler == "slurm" else ("PBS", "-l place=excl", _pbs)
    if not line.lstrip().startswith("-"):
        return f"should be the text after #{mark}, such as {example}"
    return next(found(line), None)


def _slurm(line: str) -> Iterator[str]:
    for word in _words(line):
        if word.startswith("--"):
            begin = word[2:].partition("=")[0]
            yield from (why for name, why in SLURM.items() if begin and name.startswith(begin))  # sbatch accepts prefixes too
        elif word.startswith("-"):
            for letter in word[1:]:
                if letter in SHORT:
                    yield SLURM[SHORT[letter]]
                if letter not in FLAGS:
                    break


def _pbs(line: str) -> Iterator[str]:
    words = _words(line)
    for word, following in zip(words, [*words[1:], ""], strict=True):
        if not re.match(r"-\w", word):
            continue
        letter, value = word[1], word[2:] or following
        known = {"l": RESOURCES, "W": ATTRIBUTES}.get(letter, {})
        if letter in PBS:
            yield PBS[letter]
        yield from (known[name] for part in re.split("[,:]", value) if (name := part.partition("=")[0]) in known)


def _words(line: str) -> list[str]:
    try:
        return shlex.split(line, comments=True)
    except ValueError:  # an unclosed quote: left to the scheduler
        return line.split()
