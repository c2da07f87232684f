"""`sierra` as a process that sends a signal to itself at a step of a run on robots:

    python -m tests.support.killed_driver SIGKILL|SIGINT STEP SIERRA_WORDS…

A step is a call that a driver makes, by its name in NAMES and its number among equal ones, as in `arm 2`: one robot may be
armed then, and the next one is not. Several robots are served at once, so which robot it is depends on chance.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections import Counter
from collections.abc import Callable
from typing import Any

NAMES = ("run", "push", "channel", "hello", "check", "arm", "clock", "at", "pull", "done", "journal", "publish")
"""Commands and copies over a link, requests to agents, and what is written on this machine."""


def main(name: str, step: str, words: list[str]) -> None:
    from sierra.cli.main import program
    from sierra.extensions.hosts.fabric import Fabric
    from sierra.extensions.robots.agent_link import AgentLink
    from sierra.store.store import Store
    from sierra.worker.journal import Journal

    counts: Counter[str] = Counter()
    lock = threading.Lock()

    def reach(call: str) -> None:
        with lock:
            counts[call] += 1
            if f"{call} {counts[call]}" == step:
                os.kill(os.getpid(), signal.Signals[name])

    def watch(owner: type, method: str, call: Callable[..., str]) -> None:
        original = getattr(owner, method)

        def watched(*arguments: Any, **more: Any) -> Any:
            reach(call(*arguments))
            return original(*arguments, **more)

        setattr(owner, method, watched)

    for owner, method in ((Fabric, "run"), (Fabric, "push"), (Fabric, "channel"), (AgentLink, "pull")):
        watch(owner, method, lambda *_, method=method: method)
    watch(AgentLink, "ask", lambda _, do, *more: do)
    watch(Journal, "write", lambda *_: "journal")
    watch(Store, "publish", lambda *_: "publish")
    sys.argv = ["sierra", *words]
    program()


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], sys.argv[3:])
