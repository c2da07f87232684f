"""Devices that a scheduler has allotted to a job of a cluster.

In an environment (and in a client's argv), the character \\1 followed by a name from DEVICES stands for the value of the
worker's variable of that name, or for nothing if there is none. If a list of several devices can be divided among the slots,
each slot gets its own part.
"""

from __future__ import annotations

import os
from typing import Mapping

from sierra.worker.job import Job

ALLOTTED = "\1"
ROCR = "ROCR_VISIBLE_DEVICES"
BELOW_ROCR = ("CUDA_VISIBLE_DEVICES", "HIP_VISIBLE_DEVICES", "GPU_DEVICE_ORDINAL")  # for AMD, indices into ROCR's list
DEVICES = (*BELOW_ROCR, ROCR, "NVIDIA_VISIBLE_DEVICES", "ZE_AFFINITY_MASK")


def with_own_devices(job: Job, slot: int, slots: int) -> Job:
    """Return the job with the devices of its slot, if it requests any."""
    if not any(job["environment"].get(name) == ALLOTTED + name for name in DEVICES):
        return job
    given = devices(slot, slots)
    filled: Job = {**job, "environment": with_devices(job["environment"], given)}
    if "client" in job:
        client = job["client"]
        argv = [word for word in (with_device(word, given) for word in client["argv"]) if word is not None]
        filled["client"] = {**client, "argv": argv, "environment": with_devices(client["environment"], given)}
    return filled


def with_devices(variables: Mapping[str, str], given: dict[str, str]) -> dict[str, str]:
    filled = {name: with_device(value, given) for name, value in variables.items()}
    return {name: value for name, value in filled.items() if value is not None}


def with_device(text: str, given: dict[str, str]) -> str | None:
    """Return the text with the value of the variable that it ends with; None if there is no such variable."""
    head, mark, name = text.partition(ALLOTTED)
    if not mark or name not in DEVICES:
        return text
    return head + given[name] if name in given else None


def devices(slot: int, slots: int) -> dict[str, str]:
    """Return the devices that a slot may use, from the scheduler's variables: its part of them, or all."""
    whole = {name: os.environ[name] for name in DEVICES if name in os.environ}
    parts = {name: part_of(value.split(","), slot, slots) for name, value in whole.items()}
    if parts != whole and ROCR in parts and os.path.exists("/dev/kfd"):
        return {name: value for name, value in parts.items() if name not in BELOW_ROCR}
    return parts


def part_of(values: list[str], slot: int, slots: int) -> str:
    """Return a slot's part of the devices if they can be divided equally among the slots, or the slots among them; else all."""
    if len(values) % slots == 0:
        each = len(values) // slots
        values = values[slot * each : (slot + 1) * each]
    elif slots % len(values) == 0:
        values = [values[slot % len(values)]]
    return ",".join(values)
