"""The link `burrow`: a folder of this machine as home folder of a host, whose commands are processes of this machine."""

from __future__ import annotations

import os
from pathlib import Path
from typing import ClassVar

from pydantic import Field

from sierra.plugin import Commands, LinkOptions, ProcessStream, Table, Unreachable


class BurrowOptions(LinkOptions):
    """The options of the link."""

    burrows: str = Field("/tmp", description="folder with the home folders of all hosts")


class Burrow(Commands):
    """The link `burrow`."""

    contract = 1
    Options: ClassVar[type[Table]] = BurrowOptions

    def __init__(self, host: str, options: BurrowOptions) -> None:
        super().__init__(host, options)
        self._home = Path(options.burrows, host)

    def _start(self, line: str) -> ProcessStream:
        if not self._home.is_dir():
            raise Unreachable(f"{self.name}: there is no burrow {self._home}")
        return ProcessStream(["sh", "-c", f"cd\n{line}"], {**os.environ, "HOME": str(self._home)})

    def _disconnect(self) -> None:
        """There is no connection."""
