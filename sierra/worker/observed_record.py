"""The record of an observed run: the files that it used with their contents, and graphics processors, as JSON.

Also: contents of the files that a run has used, as they are after it; those that have changed meanwhile are unusable.
"""

from __future__ import annotations

import functools
import hashlib
import os
import re
import stat
import time
from typing import Any, Callable, Mapping, NamedTuple, Sequence

from sierra.worker.file_names import Names
from sierra.worker.file_trace import REREAD, Trace, nothing
from sierra.worker.files import entries_of
from sierra.worker.python_files import DISTRIBUTIONS, PYTHON_CACHE, Environments, content_of, sha256_of

IN_FUTURE = "its times are in the future, so that a clock is or was wrong"
FUTURE_NS = 24 * 3600 * 10**9
CHANGED = "it was changed after the run had opened it"


class File(NamedTuple):
    """The content of a file after the run, and values that differ if it is changed (inode, size, times in ns)."""

    sha256: str
    size: int
    state: tuple[int, ...]


class Contents(NamedTuple):
    """The contents that a run has read, by paths; and the paths with unknown contents, with the reason."""

    files: Mapping[str, File]
    folders: Mapping[str, str]
    """For each listed folder the SHA-256 of its names: sorted, each before a NUL, without `__pycache__` and the run's own, and
    without those that `is_listed` leaves out."""
    unusable: Mapping[str, str]
    listings: Mapping[str, Sequence[str]] = {}
    """The names behind each of these SHA-256."""
    kinds: Mapping[str, str] = {}
    """For each found path the SHA-256 of what `sha256_of_kind` returns."""


Hashed = Callable[[], str]
Cache = Callable[[str, os.stat_result, Hashed], str]
"""Returns the SHA-256 of a file with this path and status: one that it knows, or what the function returns that it is given."""


def contents(
    trace: Trace,
    began: int,
    cache: Cache = lambda path, status, hashed: hashed(),
    check_stop: Callable[[], None] = nothing,
    is_listed: Callable[[str], bool] = lambda path: True,
) -> Contents:
    """Return the content of all that a run executed, read or listed: of a trace that `Names.inputs` has returned.

    `is_listed` tells which paths count in a listed folder: `Names.is_listed`.

    `began` is `Observation.began`. A file is unusable if it was changed since then, or while it is hashed, because the run may
    have read something else; and so is a link or a folder. A time in the future counts as changed if it is the ctime, which
    programs cannot set. If it is more than a day in the future, a clock is wrong: the file is unusable, but has its content.
    Also unusable: a path that is missing now or exists now, unlike in the run. Devices have no content.
    """
    reader = Reader(began, cache, check_stop)
    for path in sorted({*trace.executed, *trace.read}):
        reader.try_to(reader.read, path)
    own = set(trace.written)
    for path in trace.listed:
        reader.try_to(functools.partial(reader.list, own, is_listed), path)
    for path, real in trace.links.items():
        reader.try_to(functools.partial(reader.follow, real), path)
    for path in trace.found:
        if not os.path.lexists(path) and path not in trace.removed:
            reader.unusable[path] = "it was removed after the run had found it"
    for path in trace.missed:
        if os.path.exists(path) and path not in own:
            reader.unusable[path] = "it was made after the run had looked for it"
    kinds = {path: sha256_of_kind(path) for path in (*trace.found, *trace.refused)}
    return Contents(reader.files, reader.folders, reader.unusable, reader.listings, kinds)


def sha256_of_kind(path: str) -> str:
    """Return the SHA-256 of what a program sees of a path without opening it: a folder, or a file with its size and rights.

    Times are not among it, because they differ between machines.
    """
    try:
        status = os.stat(path)
    except OSError as error:
        kind = "error %s" % error.errno
    else:
        is_file = stat.S_ISREG(status.st_mode)
        kind = "file %d %d" % (status.st_size, bool(status.st_mode & 0o111)) if is_file else "%o" % stat.S_IFMT(status.st_mode)
        kind += "" if os.access(path, os.R_OK) else " unreadable"
    return hashlib.sha256(kind.encode()).hexdigest()


class Reader:
    """Reads files, folders and links after a run."""

    def __init__(self, began: int, cache: Cache, check_stop: Callable[[], None]) -> None:
        self._began = began
        self._cache, self._check_stop = cache, check_stop
        self._environments = Environments()
        self.files: dict[str, File] = {}
        self.folders: dict[str, str] = {}
        self.unusable: dict[str, str] = {}
        self.listings: dict[str, list[str]] = {}

    def try_to(self, read: Callable[[str], None], path: str) -> None:
        self._check_stop()
        try:
            read(path)
        except FileNotFoundError:
            self.unusable[path] = "it was removed after the run had read it"
        except (OSError, ValueError) as error:
            self.unusable[path] = "it cannot be read: %s" % (getattr(error, "strerror", None) or error)

    def read(self, path: str) -> None:
        """Add a file to `files` with its content, or to `unusable` with the reason; to both if only its times are wrong.

        A device is added to neither. Raises OSError.
        """
        status = os.stat(path)
        kind = stat.S_IFMT(status.st_mode)
        if kind in (stat.S_IFCHR, stat.S_IFBLK):
            return
        if kind != stat.S_IFREG:
            self.unusable[path] = "it is no regular file"
            return
        if self._changed(status):
            self.unusable[path] = CHANGED
            return
        if self._is_in_future(status):
            self.unusable[path] = IN_FUTURE  # and yet its content is recorded, for what depends on the bytes alone
        sha256 = self._cache(path, status, lambda: sha256_of(path, self._environments, self._check_stop))
        if key_of(os.stat(path)) != key_of(status):
            self.unusable[path] = CHANGED
            return
        self.files[path] = File(sha256, status.st_size, key_of(status))

    def list(self, own: set[str], is_listed: Callable[[str], bool], path: str) -> None:
        before = os.stat(path)
        if self._changed(before):
            self.unusable[path] = "it was changed after the run had listed it"
            return
        if self._is_in_future(before):
            self.unusable[path] = IN_FUTURE
        paths = ((name, os.path.join(path, name)) for name in os.listdir(path) if name != PYTHON_CACHE)
        kept = [name for name, entry in paths if entry not in own and is_listed(entry)]
        kept.sort(key=os.fsencode)
        if key_of(os.stat(path)) != key_of(before):
            self.unusable[path] = "it was changed after the run had listed it"
            return
        digest = hashlib.sha256(b"".join(os.fsencode(name) + b"\0" for name in kept)).hexdigest()
        self.folders[path] = digest
        self.listings[digest] = kept

    def follow(self, real: str, path: str) -> None:
        status = os.lstat(path)
        if os.path.realpath(path) != real or (stat.S_ISLNK(status.st_mode) and self._changed(status)):
            self.unusable[path] = "its link was changed after the run had followed it"
        elif self._is_in_future(status):
            self.unusable[path] = IN_FUTURE

    def _changed(self, status: os.stat_result) -> bool:
        """Return whether a file may have been changed in the run, by its times."""
        if self._is_in_future(status):
            return False
        return status.st_ctime_ns >= self._began or self._began <= status.st_mtime_ns <= time.time_ns()

    def _is_in_future(self, status: os.stat_result) -> bool:
        """Return whether the ctime of a file is more than a day after now, so that a clock is wrong, and times tell nothing."""
        return status.st_ctime_ns > time.time_ns() + FUTURE_NS


def key_of(status: os.stat_result) -> tuple[int, ...]:
    """Return values of a file that differ after it was changed."""
    return (status.st_ino, status.st_size, status.st_mtime_ns, status.st_ctime_ns)


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
    descriptions = ["driver " + line for line in lines_of(os.path.join(root, "proc/driver/nvidia/version")) if line]
    cards = os.path.join(root, "proc/driver/nvidia/gpus")
    for name in sorted(entries_of(cards)):
        descriptions += [line for line in lines_of(os.path.join(cards, name, "information")) if line.startswith("Model:")]
    devices = os.path.join(root, "sys/class/drm")
    for name in sorted(entries_of(devices)):
        if re.fullmatch(r"card\d+", name):
            device = os.path.join(devices, name, "device")
            ids = [line for key in ("vendor", "device") for line in lines_of(os.path.join(device, key))]
            driver = os.path.basename(os.path.realpath(os.path.join(device, "driver")))
            version = lines_of(os.path.join(device, "driver/module/version"))
            descriptions.append(" ".join((*ids, driver, *version)))
    return descriptions


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
    found_paths = {*trace.found, *trace.refused}
    files += [(names.name(path), "found", contents.kinds.get(path), None) for path in found_paths]
    seen = {*trace.executed, *trace.read, *found_paths, *trace.links}
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

    Files that the services have changed are their state, not inputs of the run; files that they only opened for writing are.
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
