"""What engines can do here, found out by starting something."""

from __future__ import annotations

from sierra.engines import Abilities


def podman() -> Abilities:
    return Abilities("podman", enforced=frozenset(("memory", "cpus", "pids")))
