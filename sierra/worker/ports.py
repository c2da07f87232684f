"""Marks of free ports in argv, environment and input files.

A mark begins with PORT_MARK, and stands for a port that the worker chooses before the run begins, and holds until it has ended
(see `conductor.Ports`). The `end` of the run has these `ports`, in the order of the marks. The worker in a shared container
gets jobs without marks.
"""

from __future__ import annotations

import base64
import re
from typing import Mapping, cast

from sierra.worker.job import Job, Program

PORT_MARK = "730461892355147"  # the beginning of the marks of ports, which are numbers, so that inputs with types may have them
PORT_MARKS = re.compile(PORT_MARK + "[0-9]{2}")


def marks_in(job: Job) -> list[str]:
    """Return the marks of ports in a job: in its words, variables and input files."""
    client = job.get("client", job)
    texts = [*job["argv"], *job["environment"].values(), *client["argv"], *client["environment"].values()]
    found = {mark for text in texts if PORT_MARK in text for mark in PORT_MARKS.findall(text)}
    if "folders" in job:  # else no input has a mark
        contents = (base64.b64decode(content) for content in job["files"].values())
        found.update(mark for content in contents for mark in PORT_MARKS.findall(content.decode("latin-1")))
    return sorted(found)


def with_ports(job: Job, ports: Mapping[str, int]) -> Job:
    """Return the job with ports in the place of their marks."""

    def filled(text: str) -> str:
        return PORT_MARKS.sub(lambda mark: str(ports[mark.group()]), text) if PORT_MARK in text else text

    def program(definition: Program) -> Mapping[str, object]:
        environment = {name: filled(value) for name, value in definition["environment"].items()}
        return {**definition, "argv": [filled(word) for word in definition["argv"]], "environment": environment}

    done = cast("Job", {**program(job), "own_ports": list(ports.values())})
    if "client" in job:
        done["client"] = cast("Program", program(job["client"]))
    if "folders" in job:
        done["folders"] = {**job["folders"], **{mark: str(port) for mark, port in ports.items()}}
    return done
