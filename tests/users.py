"""Users without privileges, functions that are called as such a user, and their settings for containers."""

from __future__ import annotations

import contextlib
import os
import pwd
import shutil
import subprocess
import tempfile
import traceback
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

IDS = "100000-165535"
STORAGE = '[storage]\ndriver = "overlay"\n[storage.options.overlay]\nignore_chown_errors = "true"\n'
"""Without it, users without /dev/fuse get copies of whole images, and users without a range of ids no image."""


@dataclass(frozen=True, slots=True)
class User:
    """A user without privileges, and their home."""

    name: str
    home: Path


@contextlib.contextmanager
def a_user(name: str, *, ids: bool) -> Iterator[User]:
    """Yield a new user, with or without a range of ids; remove the user and their processes at the end. Needs root."""
    home = Path(tempfile.mkdtemp(prefix=f"{name}-"))
    _system("useradd", "--no-create-home", "--home-dir", str(home), "--shell", "/bin/sh", name)
    try:
        _system("usermod", f"--{'add' if ids else 'del'}-subuids", IDS, f"--{'add' if ids else 'del'}-subgids", IDS, name)
        settings = home / ".config" / "containers"
        settings.mkdir(parents=True)
        (settings / "storage.conf").write_text(STORAGE)
        entry = pwd.getpwnam(name)
        for path in (home, *home.rglob("*")):
            os.chown(path, entry.pw_uid, entry.pw_gid)
        yield User(name, home)
    finally:
        _end_all_of(pwd.getpwnam(name).pw_uid)
        _system("userdel", "--force", name)
        shutil.rmtree(home, ignore_errors=True)


def _system(*command: str) -> None:
    subprocess.run(command, check=True, capture_output=True)


def _end_all_of(user: int) -> None:
    for process in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            if process.stat().st_uid == user:
                os.kill(int(process.name), 9)


def called_as(user: User | None, function: Callable[[], None]) -> None:
    """Call a function as a user, in a separate process, with only PATH of this environment.

    Raise AssertionError with the error. None stands for the user who runs the tests, in this process.
    """
    if user is None:
        function()
        return
    ear, mouth = os.pipe()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # about forking with threads: the child needs only its own
        child = os.fork()
    if child == 0:
        os.close(ear)
        _become(user, function, mouth)
    os.close(mouth)
    with os.fdopen(ear, encoding="utf-8", errors="replace") as said:
        complaint = said.read()
    os.waitpid(child, 0)
    assert not complaint, complaint


def _become(user: User, function: Callable[[], None], mouth: int) -> None:
    """Become that user until the end, and report errors through a pipe."""
    try:
        os.set_inheritable(mouth, False)
        entry = pwd.getpwnam(user.name)
        os.initgroups(user.name, entry.pw_gid)
        os.setgid(entry.pw_gid)
        os.setuid(entry.pw_uid)
        path = os.environ["PATH"]
        os.environ.clear()
        os.environ.update(PATH=path, HOME=str(user.home), USER=user.name, LANG="C.UTF-8")
        os.chdir(user.home)
        function()
    except BaseException as error:
        text = str(error) if isinstance(error, AssertionError) else traceback.format_exc()
        os.write(mouth, (text or "AssertionError").encode())
    finally:
        os._exit(0)
