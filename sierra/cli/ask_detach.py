"""Detaching from cluster jobs: the question to the user, and how to reattach."""

from __future__ import annotations

import signal
import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING

from sierra.util.text import counted, few

if TYPE_CHECKING:
    from sierra.execution.cluster_status import ClusterSession


def wants_detach() -> bool:
    """Return whether to detach instead of cancelling: the answer on a terminal, or true without a terminal."""
    if not (sys.stdin.isatty() and sys.stderr.isatty()):
        return True
    before = {number: signal.signal(number, signal.default_int_handler) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        print("detach or cancel? [D/c] ", end="", file=sys.stderr, flush=True)
        return not sys.stdin.readline().strip().lower().startswith("c")
    except KeyboardInterrupt:
        print(file=sys.stderr)
        return True
    except OSError:  # the terminal is gone
        return True
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def lines(left: Sequence[ClusterSession], batch: str) -> list[str]:
    """Return a line for each session that continues on a cluster, and one with the commands to attach or cancel."""
    from sierra.util.hashing import short

    texts = [
        f"session {one.session}: {counted(one.array_tasks, 'array task')} in {named(one.jobs)} on {one.runner}" for one in left
    ]
    return [*texts, f"sierra attach {short(batch)} waits for it, sierra cancel {short(batch)} cancels it"]


def named(jobs: Sequence[str]) -> str:
    """Return a phrase that names jobs by their ids."""

    match jobs:
        case []:
            return "a job that was not found yet"
        case [job]:
            return f"job {job}"
        case _:
            return f"jobs {few(jobs, 5)}"
