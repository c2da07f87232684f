"""Folders on hosts that are named by their content: the programs that execute runs, the code, and files beside inputs."""

from __future__ import annotations

import hashlib
import os
import secrets
import tempfile
from pathlib import Path

from sierra.errors import Missing
from sierra.runners.links.base import Link, Overdue, Unreachable
from sierra.util import worker_zip
from sierra.worker import program

LENGTH = 24
"""The number of characters of a hash in a folder's name."""


def has_python(link: Link, python: str) -> bool:
    """Return whether a host has Python 3.8 or newer as the command `python`."""
    return link.run((python, "-c", "import sys; sys.exit(sys.version_info < (3, 8))")).status == 0


def content_name(folder: Path) -> str:
    """Return a name for the content of a folder, or of a file: paths, bytes, and which files may be executed."""
    content = hashlib.sha256()
    top = folder.parent if folder.is_file() else folder
    for path in [folder] if folder.is_file() else sorted(folder.rglob("*")):
        name = os.fsencode(path.relative_to(top))
        if path.is_symlink():
            content.update(b"link %s\0%s\0" % (name, os.fsencode(path.readlink())))
        elif path.is_file():
            executable = b"x" if os.access(path, os.X_OK) else b"-"
            content.update(b"file %s\0%s %s\0" % (name, executable, hashlib.sha256(path.read_bytes()).digest()))
        else:
            content.update(b"folder %s\0" % name)
    return content.hexdigest()[:LENGTH]


def _push(link: Link, folder: Path, target: str) -> None:
    """Copy a folder, once more if somebody else has copied it at the same time. Raises Missing, Unreachable."""
    try:
        link.push(folder, target)
    except (Unreachable, Overdue):
        raise
    except Missing:
        link.push(folder, target)


def push_content(link: Link, folder: Path, root: str, kind: str, name: str | None = None) -> str:
    """Copy a folder, or one with only a file, to `root`/`kind`/NAME on a host, unless it is there; return that path.

    `name` is that of its content, if it is known. No program can change the copy, as far as permissions stop it. A copy that
    was changed nevertheless is replaced. Raises Missing, Unreachable.
    """
    target = f"{root}/{kind}/{name or content_name(folder)}"
    try:
        _push(link, folder, target)
    except (Unreachable, Overdue):
        raise
    except Missing:
        if link.run(("test", "-d", target)).status != 0:
            raise
        # runs may still use it
        link.run(("sh", "-c", 'chmod u+w "$1" && mv "$1" "$2"', "sh", target, f"{target}.changed-{secrets.token_hex(4)}"))
        link.push(folder, target)
    link.run(("chmod", "-R", "a-w", target))
    return target


def push_programs(link: Link, root: str, programs: Path) -> str:
    """Copy the programs that execute runs, and those of an extension in the folder `programs`; return their folder there."""
    with tempfile.TemporaryDirectory(prefix="sierra-") as folder:
        Path(folder, program.NAME).write_bytes(worker_zip.packed(programs))
        return push_content(link, Path(folder), root, "programs")
