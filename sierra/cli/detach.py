"""What goes on on a cluster without this process: whether it is to, and how a user gets back to it."""

from __future__ import annotations

import signal
import sys
from collections.abc import Sequence
from typing import Any


def asked() -> bool:
    """Whether it is left to itself, by an answer on a terminal; where there is none, it is."""
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


def lines(left: Sequence[Any], batch: str) -> list[str]:
    """What goes on, a line each (`left`: as `sierra.execution.status.Standing` has it), and how to get back to it."""
    from sierra.util.hashing import short
    from sierra.util.text import counted

    told = [f"session {one.session}: {counted(one.elements, 'element')} in {named(one.jobs)} on {one.runner}" for one in left]
    return [*told, f"sierra attach {short(batch)} goes on with it, sierra cancel {short(batch)} ends it"]


def named(jobs: Sequence[str]) -> str:
    """Jobs by their ids."""
    from sierra.util.text import few

    match jobs:
        case []:
            return "a job that is still to be found"
        case [job]:
            return f"job {job}"
        case _:
            return f"jobs {few(jobs, 5)}"
