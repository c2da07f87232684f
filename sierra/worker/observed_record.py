"""The record of an observed run: the files that it used with their contents, and graphics processors, as JSON."""

from __future__ import annotations

import hashlib
import os
import re
from typing import Any

from sierra.worker.file_contents import Contents
from sierra.worker.file_names import Names
from sierra.worker.file_trace import REREAD, Trace
from sierra.worker.files import entries_of
from sierra.worker.python_files import DISTRIBUTIONS, content_of

MOST_NAMED = 3  # files that were changed while a run read them
GPU = "{gpu}"
"""Stands among the files for the graphics processors with their drivers, if a run has used one. It is no path."""
GPU_DEVICE = re.compile(r"/dev/(?:nvidia|dri/|kfd)")
GPU_LIBRARY = re.compile(
    r".*/lib(?:cuda|cudart|cublas|cudnn|nvrtc|nvidia-\w+|amdhip64|hsa-runtime64|rocm\w*|OpenCL|ze_loader)(?![a-z])[^/]*\.so[^/]*"
)


def uses_gpu(trace: Trace) -> bool:
    """Return whether a run has opened a graphics processor, or loaded a library that computes on one."""
    used = (*trace.executed, *trace.read, *trace.written, *trace.links)
    return any(GPU_DEVICE.match(path) or GPU_LIBRARY.fullmatch(path) for path in used)


def graphics(root: str = "/") -> list[str]:
    """Return the graphics processors, each with its driver, as the kernel describes them below a folder."""
    found = ["driver " + line for line in lines_of(os.path.join(root, "proc/driver/nvidia/version")) if line]
    cards = os.path.join(root, "proc/driver/nvidia/gpus")
    for name in sorted(entries_of(cards)):
        found += [line for line in lines_of(os.path.join(cards, name, "information")) if line.startswith("Model:")]
    devices = os.path.join(root, "sys/class/drm")
    for name in sorted(entries_of(devices)):
        if re.fullmatch(r"card\d+", name):
            device = os.path.join(devices, name, "device")
            ids = [line for key in ("vendor", "device") for line in lines_of(os.path.join(device, key))]
            driver = os.path.basename(os.path.realpath(os.path.join(device, "driver")))
            version = lines_of(os.path.join(device, "driver/module/version"))
            found.append(" ".join((*ids, driver, *version)))
    return found


def graphics_sha256(root: str = "/") -> str:
    """Return a hash of the graphics processors and their drivers."""
    return hashlib.sha256("".join(line + "\n" for line in graphics(root)).encode("utf-8", "surrogateescape")).hexdigest()


def lines_of(path: str) -> list[str]:
    """Return the lines of a file, each with single blanks; none if it cannot be read."""
    return [" ".join(line.split()) for line in os.fsdecode(content_of(path)).splitlines()]


def as_record(trace: Trace, contents: Contents, names: Names, *, gpu: bool = False) -> dict[str, object]:
    """Return a trace and the contents of its files as JSON; `files` are name, use, SHA-256 and size (null if there is none).

    `gpu` is what `uses_gpu` says about the whole trace.
    A path that was missed and then found is not among the missed ones: the run has waited for it. A file that was opened for
    writing, too, but that has not changed is an input like others, and was not written.
    """
    files: list[tuple[str, str, str | None, int | None]] = []
    for use in ("executed", "read"):
        for path in getattr(trace, use):
            file = contents.files.get(path)
            files.append((names.name(path), use, file and file.sha256, file and file.size))
    found = {*trace.found, *trace.refused}
    files += [(names.name(path), "found", contents.kinds.get(path), None) for path in found]
    seen = {*trace.executed, *trace.read, *found, *trace.links}
    files += [(names.name(path), "missed", None, None) for path in trace.missed if path not in seen]
    files += [(names.name(path), "listed", contents.folders.get(path), None) for path in trace.listed]
    for path, real in trace.links.items():
        file = contents.files.get(real)
        named = hashlib.sha256(os.fsencode(names.name(real))).hexdigest()
        if file is not None and real not in trace.executed:  # a program may look beside its real path for libraries
            files.append((names.name(path), "linked", file.sha256, file.size))
        else:
            files.append((names.name(path), "link", named, None))
    files += [(GPU, "read", graphics_sha256(), None)] if gpu else []
    sizes = ((path, file.size) for path, file in contents.files.items())
    changed = ["%s: %s" % (names.name(path), reason) for path, reason in sorted(contents.unusable.items())]
    reasons = (*trace.reasons, *changed[:MOST_NAMED])
    return {
        "method": trace.way,
        "reason": "; ".join(reasons) or None,
        "disturbed": trace.disturbed,
        "notes": list(trace.notes),
        "distributions": DISTRIBUTIONS.used(sizes),
        "files": sorted(set(files), key=lambda file: file[:2]),
        "listings": contents.listings,
        "channels": trace.channels,
        "written": sorted(
            {
                (names.name(path), use)
                for use in ("written", "removed", *REREAD)
                for path in getattr(trace, use)
                if path not in contents.files
            }
        ),
    }


def with_services(trace: Trace, contents: Contents, shared: Trace, own: Contents) -> tuple[Trace, Contents]:
    """Return the trace and the contents of a run together with those of services that it shares with other runs.

    What the services have changed is their state, and no input of the run; what they have only opened for writing is one.
    """
    state = {path for path in (*shared.written, *shared.removed) if path not in own.files}
    used = ("executed", "read", "found", "missed", "refused", "listed")
    lists: dict[str, Any] = {
        name: tuple(sorted({*getattr(trace, name), *(set(getattr(shared, name)) - state)})) for name in used
    }
    links = {path: real for path, real in shared.links.items() if path not in state and real not in state}
    unusable = {path: reason for path, reason in own.unusable.items() if path not in state}
    both: list[Any] = [{**theirs, **ours} for theirs, ours in zip(own._replace(unusable=unusable), contents)]
    return trace._replace(**lists, links={**links, **trace.links}), Contents(*both)
