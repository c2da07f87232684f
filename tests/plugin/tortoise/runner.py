"""The runner `niced`: runs execute on this machine as with `local`, but give way to other programs."""

from __future__ import annotations

import shutil
from dataclasses import replace
from typing import ClassVar

from pydantic import Field

from sierra.plugin import Job, Local, SessionPaths, Table, Work


class NicedOptions(Table):
    """The options of the runner."""

    niceness: int = Field(10, ge=0, le=19, description="how far runs give way; 19 is the most")


class Niced(Local):
    """The runner `niced`."""

    name = "niced"
    contract = 1
    Options: ClassVar[type[Table]] = NicedOptions

    def __init__(self, slots: int, options: NicedOptions) -> None:
        super().__init__(slots)
        self._niceness = options.niceness

    def submit(self, work: Work, session: SessionPaths) -> None:
        super().submit(replace(work, jobs=map(self._niced, work.jobs)), session)

    def _niced(self, job: Job) -> Job:
        """Return a job whose program, or the client of its container, is started by `nice`."""
        first = ("nice", "-n", str(self._niceness))
        if job.client is not None:
            return replace(job, client=replace(job.client, argv=(*first, *job.client.argv)))
        if shutil.which(job.argv[0], path=job.environment["PATH"]) is None:
            return job  # so that the worker reports that there is no such program
        return replace(job, argv=(*first, *job.argv))
