"""Further lines of `#SBATCH` and `#PBS` that a project may not add: SIERRA says them itself, or nothing would work with them.

Of two of a kind, schedulers take the one or the other, and neither says so. What a setting of `[runners.…]` is for is refused
in favour of that; so is what would have jobs not be found again, print elsewhere, or wait for ever.
"""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator, Mapping

CPUS = "use cpus = N: so many runs execute at a time"
MEMORY = 'use memory = "8 GB"'
WALL = "use wall = SECONDS"
PARTITION = 'use partition = "…"'
ACCOUNT = 'use account = "…"'
ONE_NODE = "an element is one task on one node; elements = N says how many there are, cpus = N how many cores each has"
NAMED = "SIERRA finds its jobs again by the name that it gives them"
LOGS = "what elements print is shown where it matters, and removed with the session"
WAITS = "SIERRA has elements wait itself, for one small task that tries the nodes out"
FOLLOWED = "SIERRA follows its jobs itself; --detach leaves them"
ALONE = 'nothing of your shell goes along; variables of runs stand in [environment], modules = ["…"] are loaded on the node'
SUBMITTED = "SIERRA reads what the command answers, and hands over one script"
FOLDER = 'jobs begin in the session\'s folder; scratch = "…" says where runs execute'

SLURM: Mapping[str, str] = {
    "cpus-per-task": CPUS,
    "cpus-per-gpu": CPUS,
    "mem": MEMORY,
    "mem-per-cpu": MEMORY,
    "time": WALL,
    "partition": PARTITION,
    "account": ACCOUNT,
    "qos": 'use qos = "…"',
    "constraint": 'use constraint = "…"',
    "array": "elements = N says how many elements there are",
    "nodes": ONE_NODE,
    "ntasks": ONE_NODE,
    "ntasks-per-core": ONE_NODE,
    "ntasks-per-gpu": ONE_NODE,
    "ntasks-per-node": ONE_NODE,
    "ntasks-per-socket": ONE_NODE,
    "job-name": NAMED,
    "comment": "SIERRA says there which session a job is of",
    "clusters": "SIERRA finds its jobs only on the cluster that SLURM_CONF names",
    "output": LOGS,
    "error": LOGS,
    "open-mode": LOGS,
    "dependency": WAITS,
    "kill-on-invalid-dep": WAITS,
    "wait": FOLLOWED,
    "export": ALONE,
    "export-file": ALONE,
    "get-user-env": ALONE,
    "chdir": FOLDER,
    "parsable": SUBMITTED,
    "quiet": SUBMITTED,
    "test-only": SUBMITTED,
    "wrap": SUBMITTED,
    "help": SUBMITTED,
    "usage": SUBMITTED,
    "version": SUBMITTED,
}
"""By sbatch's long options, why, or what instead."""
SHORT = {
    **{"c": "cpus-per-task", "t": "time", "p": "partition", "A": "account", "q": "qos", "C": "constraint", "a": "array"},
    **{"N": "nodes", "n": "ntasks", "J": "job-name", "M": "clusters", "o": "output", "e": "error", "d": "dependency"},
    **{"W": "wait", "D": "chdir", "Q": "quiet", "h": "help", "u": "usage", "V": "version"},
}
FLAGS = "HIOQVWhksuv"
"""Short options of sbatch that take no value: others may follow in the same word."""

PBS: Mapping[str, str] = {
    "q": PARTITION,
    "A": ACCOUNT,
    "J": "elements = N says how many elements there are",
    "t": "elements = N says how many elements there are",
    "N": NAMED,
    "o": LOGS,
    "e": LOGS,
    "j": LOGS,
    "k": LOGS,
    "V": ALONE,
    "v": ALONE,
    "S": "SIERRA's script is one of sh",
    "C": SUBMITTED,
    "f": SUBMITTED,
    "I": SUBMITTED,
    "X": SUBMITTED,
    "z": SUBMITTED,
}
"""By qsub's options."""
RESOURCES: Mapping[str, str] = {
    "select": 'use cpus, memory and gpus; constraint = "…" is added to select',
    "nodes": 'use cpus, memory and gpus; constraint = "…" is added to it',
    "ncpus": CPUS,
    "procs": CPUS,
    "mem": MEMORY,
    "pmem": MEMORY,
    "walltime": WALL,
    "ngpus": "use gpus = N",
}
"""What stands after `-l`."""
ATTRIBUTES: Mapping[str, str] = {"depend": WAITS, "block": FOLLOWED, "interactive": SUBMITTED}
"""What stands after `-W`."""


def complaint(scheduler: str, line: str) -> str | None:
    """Why a line can't be added for that scheduler, and what would be right; None where it can, or nobody knows."""
    if scheduler not in ("slurm", "pbs"):
        return None
    if not line.lstrip().startswith("-"):
        return f"should be as it stands after #{'SBATCH' if scheduler == 'slurm' else 'PBS'}, as in {_example(scheduler)}"
    found = _slurm(line) if scheduler == "slurm" else _pbs(line)
    return next(found, None)


def _example(scheduler: str) -> str:
    return "--mail-type=FAIL" if scheduler == "slurm" else "-l place=excl"


def _slurm(line: str) -> Iterator[str]:
    for word in _words(line):
        if word.startswith("--"):
            begin = word[2:].partition("=")[0]
            yield from (why for name, why in SLURM.items() if begin and name.startswith(begin))  # sbatch takes beginnings too
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
    except ValueError:  # an open quote: the scheduler's to judge
        return line.split()
