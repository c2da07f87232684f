"""Checkpoints: folders that outlive a run that was cut off, and that its next execution continues from.

FOLDER/               the checkpoint of one run; its name is the run's id and, after a dot, the programs that execute it
    mark              contains the name of FOLDER; locked while the run executes
    files/            the files that the run keeps; `{checkpoint}` stands for this folder

In a job, NUL and then `/` and CHECKPOINT stand for `files`, if the job has a `checkpoint` (FOLDER) that nobody else has locked.
The worker waits for the lock for the grace time of the run, because an earlier execution may be about to end. Otherwise they
stand for an empty folder in the run's own folder: for a replay, for a run that executes twice at once, and on a file system
without locks. Nothing is kept then, and the worker's journal says so, except for a replay. A run whose folder has files when it
begins has the key `resumed` in its `end`.

The program of a run inherits the lock, and so do the programs around it: no other execution gets the folder while they live.
Programs that they start inherit it unless they close it, as those that Python starts do. Processes in a container do not.
"""

from __future__ import annotations

import contextlib
import fcntl
import itertools
import json
import os
import time
from typing import Callable, Iterator, Mapping, cast

from sierra.worker.files import end_of, files_below, is_folder, remove, unlink, write_all
from sierra.worker.job import GRACE_S, Job, Program, is_conducted
from sierra.worker.layout import CHECKPOINT
from sierra.worker.processes import POLL_S

TEXT = "\0/" + CHECKPOINT
MARK, FILES = "mark", "files"
MOST_FILES = 10000
"""The number of files of a checkpoint whose times are looked at."""
BUSY = "another execution of the run still uses it"
UNLOCKED = "it cannot be locked there"
MOST_TRIES = 10
"""The most requests for a lock whose file another process removes meanwhile."""


@contextlib.contextmanager
def claimed(job: Job, is_stopping: Callable[[], bool] = lambda: False) -> Iterator[Job]:
    """Give a job its checkpoint until the run has ended, if it has one that nobody else uses. Raises OSError."""
    folder = job.get("checkpoint")
    if not folder:
        yield job
        return
    try:
        held = _awaited_lock(folder, job["limits"].get("grace_s", GRACE_S), is_stopping)
    except BlockingIOError:
        yield {**job, "unkept": BUSY}
        return
    if held is None:
        yield {**job, "unkept": UNLOCKED}
        return
    try:
        if os.fstat(held).st_size == 0:
            write_all(held, _mark_of(folder))
        os.set_inheritable(held, True)
        yield _placed(job, os.path.join(folder, FILES), held)
    finally:
        os.close(held)


def prepared(job: Job, folder: str) -> Job:
    """Make the folder that a job uses as its checkpoint, unless it exists; note whether it has files. Raises OSError."""
    path = job["claim"]["path"] if "claim" in job else os.path.join(folder, CHECKPOINT) if _is_used(job) else None
    if path is None:
        return job
    if not is_folder(path):
        unlink(path)  # a link that the run has put there
        os.makedirs(path, exist_ok=True)
    return cast("Job", {**job, "resumed": bool(os.listdir(path))})


def changed_since(folder: str, moment: float) -> bool:
    """Return whether a run has written to its checkpoint since then: a time in seconds since the epoch, of its file system."""
    files = os.path.join(folder, FILES)
    paths = itertools.islice(files_below(files), MOST_FILES)
    for path in (files, *(path for path, _ in paths)):
        with contextlib.suppress(OSError):  # removed meanwhile
            if os.lstat(path).st_mtime > moment:
                return True
    return False


def discard(folder: str) -> bool:
    """Remove a checkpoint. Return False if it still exists: a run uses it, or SIERRA has not made it."""
    if not os.path.lexists(folder):
        return True
    try:
        held = _lock(folder, create=False)
    except BlockingIOError:
        return False
    if held is None:
        return False
    try:
        if not is_marked(folder):
            return False
        remove(os.path.join(folder, FILES))
        if not os.path.lexists(os.path.join(folder, FILES)):
            unlink(os.path.join(folder, MARK))
            with contextlib.suppress(OSError):  # others have put files there
                os.rmdir(folder)
    finally:
        os.close(held)
    return not os.path.lexists(folder)


def is_marked(folder: str) -> bool:
    """Return whether SIERRA has made a checkpoint."""
    return is_folder(folder) and end_of(os.path.join(folder, MARK)) == _mark_of(folder)


def _mark_of(folder: str) -> bytes:
    return os.fsencode(os.path.basename(folder)) + b"\n"


def _awaited_lock(folder: str, seconds: float, is_stopping: Callable[[], bool]) -> int | None:
    """Return what `_lock` does. If another process has locked the checkpoint, try again for so many seconds."""
    give_up = time.monotonic() + seconds
    while not is_stopping() and time.monotonic() < give_up:
        with contextlib.suppress(BlockingIOError):
            return _lock(folder, create=True)
        time.sleep(POLL_S)
    return _lock(folder, create=True)


def _lock(folder: str, *, create: bool) -> int | None:
    """Return the locked file of a checkpoint; None if locks do not work. Raises BlockingIOError if another process has it."""
    mark = os.path.join(folder, MARK)
    for _ in range(MOST_TRIES):
        if create:
            os.makedirs(folder, exist_ok=True)
        if not is_folder(folder):
            return None
        try:
            held = os.open(mark, os.O_RDWR | os.O_NOFOLLOW | os.O_CLOEXEC | (os.O_CREAT if create else 0), 0o666)
        except FileNotFoundError:
            if create:
                continue  # another process has just removed the folder
            return None
        try:
            fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(held)
            raise
        except OSError:
            os.close(held)
            return None
        if _is_at(held, mark):
            return held
        os.close(held)
    return None


def _is_at(opened: int, path: str) -> bool:
    """Return whether an open file still has this path."""
    try:
        return os.path.samestat(os.fstat(opened), os.lstat(path))
    except OSError:
        return False


def _is_used(job: Job) -> bool:
    """Return whether the words, the variables or the input files of a job have the path of a checkpoint."""
    texts = (*job["argv"], *job["environment"].values(), *job.get("folders", {}).values())
    return any(CHECKPOINT in text for text in texts)


def _placed(job: Job, path: str, held: int) -> Job:
    """Return the job with the path of its checkpoint. In a container, the path stays, and is mounted."""

    def filled(program: Program) -> Mapping[str, object]:
        argv = [word.replace(TEXT, path) for word in program["argv"]]
        environment = {name: value.replace(TEXT, path) for name, value in program["environment"].items()}
        return {**program, "argv": argv, "environment": environment}

    if "client" in job:
        placed = cast("Job", {**job, "client": filled(job["client"])})
    else:
        placed = cast("Job", filled(job))
        if is_conducted(job):
            placed["argv"] = [job["argv"][0], job["argv"][1].replace(json.dumps(TEXT)[1:-1], json.dumps(path)[1:-1])]
        if "folders" in job:
            placed["folders"] = {mark: text.replace(TEXT, path) for mark, text in job["folders"].items()}
    placed["claim"] = {"path": path, "lock": held}
    return placed
