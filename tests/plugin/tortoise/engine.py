"""The engine `direct`: processes of a container are processes of the host, with the container's paths replaced.

It shows the protocol and isolates nothing: it reports that the network is not isolated, and that it enforces no limit.
"""

from __future__ import annotations

import getpass
import re
from collections.abc import Sequence
from collections.abc import Set as AbstractSet
from pathlib import Path
from typing import ClassVar

from pydantic import Field

from sierra.plugin import Capabilities, Client, ContainerSpec, Image, Mount, Process, Result, StorePaths, Table


class DirectOptions(Table):
    """The options of the engine."""

    niceness: int = Field(0, ge=0, le=19, description="how far processes give way to other programs")


class Direct:
    """The engine `direct`."""

    name = "direct"
    contract = 1
    Options: ClassVar[type[Table]] = DirectOptions

    def __init__(self, options: DirectOptions) -> None:
        self._options = options

    def probe(self) -> Capabilities:
        return Capabilities("direct 1", rootless=True, isolated=False, user=getpass.getuser())

    def prepare(self, image: Image, root: Path, store: StorePaths) -> str:
        return image.id

    def client(self, box: ContainerSpec, process: Process) -> Client:
        mounts = (*process.mounts, *box.mounts)
        begin = ("nice", "-n", str(self._options.niceness), "env", f"--chdir={_on_host(process.folder, mounts)}")
        environment = {name: _on_host(value, mounts) for name, value in process.environment.items()}
        return Client((*begin, *(_on_host(word, mounts) for word in process.argv)), environment)

    def sweep(self, sessions: Sequence[str]) -> None:
        """End nothing: SIERRA's worker ends the processes of a run itself."""

    def classify(self, result: Result, stderr: str, enforced: AbstractSet[str]) -> Result:
        return result


def _on_host(text: str, mounts: Sequence[Mount]) -> str:
    """Return a text with the paths of the container replaced by those of the host, the longest first."""
    sources = {mount.target: mount.source for mount in mounts}
    targets = "|".join(re.escape(target) for target in sorted(sources, key=len, reverse=True))
    return re.sub(f"(?<![^:=])({targets})(?=[/:]|$)", lambda found: sources[found[1]], text) if targets else text
