"""The folder of a run: FOLDER/<number>/ with the input files, `home`, `tmp`, `output` and the logs.

A job with the key `used` lets a short run reuse a folder, because making and removing folders may take longer than the run. If
a run has left little, and has changed only outputs and logs in its folder, its `end` has the key `spare`. A sender that does
not need that folder any more may give its number as `used` in a later job (otherwise `used` is null); the worker then makes the
changed parts of the folder again. A folder is spare only if no process that its run has started is alive. If that is unknown (a
Python without ctypes, no /proc), no folder is spare.
"""

from __future__ import annotations

import base64
import errno
import os
import re
import stat

from sierra.worker.files import CHUNK, folders_of, remove, size_of_file
from sierra.worker.job import Job
from sierra.worker.layout import FOLDERS, LOGS
from sierra.worker.shared_files import shared_files

SAFE = re.compile(r"[A-Za-z0-9/._+@~-]+(?: [A-Za-z0-9/._+@~-]+)*")  # a path that means the same in each format of inputs


class RunFolder:
    """A run's folder in the state in which it was made, so that changes by the run can be found."""

    def __init__(self, folder: str, files: list[str]) -> None:
        self.folder = folder
        self.files = files
        self.inputs = [*folders_of(files), *files]
        self.states: dict[str, tuple[object, ...]] = {}
        self.record_state("", *FOLDERS, *LOGS, *self.inputs)

    def record_state(self, *names: str) -> None:
        self.states.update((name, state_of(os.path.join(self.folder, name))) for name in names)

    def changed(self, *names: str) -> list[str]:
        return [name for name in names if state_of(os.path.join(self.folder, name)) != self.states[name]]

    def is_reusable(self) -> bool:
        """Return whether the run has changed only outputs and logs, and the logs are short."""
        try:
            sizes = [size_of_file(os.path.join(self.folder, name)) for name in LOGS]
            return sum(sizes) <= CHUNK and not self.changed("", "home", "tmp", *self.inputs)
        except OSError:
            return False

    def clear(self) -> bool:
        """Make the changed parts of the folder again. Return False if that fails."""
        try:
            for name in self.changed("output", *LOGS):
                path = os.path.join(self.folder, name)
                if name in LOGS:
                    os.unlink(path)
                    make_log(path)
                else:
                    remove(path)
                    os.mkdir(path)
                self.record_state(name)
        except OSError:
            return False
        return True

    def reuse(self, job: Job, folder: str) -> None:
        """Turn the folder into that of another run."""
        os.rename(self.folder, folder)
        self.folder = folder
        for name in job["files"]:
            with open(os.path.join(folder, name), "wb") as file:
                file.write(content_of(job, name, folder))
        self.record_state("", *self.inputs)


def state_of(path: str) -> tuple[object, ...]:
    """Return values of a folder or a file that differ after it was changed (ctime may not, within one tick of the clock)."""
    status = os.lstat(path)
    inside = sorted(os.listdir(path)) if stat.S_ISDIR(status.st_mode) else status.st_size
    values = (status.st_ino, status.st_mode, status.st_nlink, status.st_uid, status.st_gid, status.st_ctime_ns)
    return (*values, inside, attributes_of(path))


def attributes_of(path: str) -> list[str]:
    """Return the names of its extended attributes, which include access control lists."""
    try:
        return os.listxattr(path, follow_symlinks=False) if hasattr(os, "listxattr") else []
    except OSError:  # a file system without extended attributes
        return []


def prepare(job: Job, folder: str, used: RunFolder | None = None) -> RunFolder | None:
    """Make the run's folder with its input files, or reuse a spare one. If that fails, the worker cannot continue."""
    if used is not None:
        if used.files == list(job["files"]) and used.clear():
            used.reuse(job, folder)
            return used
        remove(used.folder)
    os.mkdir(folder)
    for name in (*FOLDERS, *folders_of(job["files"])):
        os.mkdir(os.path.join(folder, name))
    for name in job["files"]:
        with open(os.path.join(folder, name), "xb") as file:
            file.write(content_of(job, name, folder))
    if "beside" in job:
        shared_files(job["beside"]).place(folder)
    for name in LOGS:
        make_log(os.path.join(folder, name))
    return RunFolder(folder, list(job["files"])) if "used" in job and "beside" not in job else None


def content_of(job: Job, name: str, folder: str) -> bytes:
    """Return the content of an input file, with the paths of folders in the place of their marks."""
    content = base64.b64decode(job["files"][name])
    for mark, text in job.get("folders", {}).items():
        path = text.replace("\0", folder)
        if mark.encode() in content and not SAFE.fullmatch(path):
            raise OSError(errno.EINVAL, "an input would contain this path, which some formats would read in another way", path)
        content = content.replace(mark.encode(), path.encode())
    return content


def inputs_of(job: Job) -> list[str]:
    """Return the names of all files that a run gets in its folder."""
    return [*job["files"], *shared_files(job["beside"]).names] if "beside" in job else list(job["files"])


def make_log(path: str) -> None:
    os.close(os.open(path, os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o666))
