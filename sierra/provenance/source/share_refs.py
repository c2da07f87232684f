"""Sharing recorded sources between clones: git keeps each under `refs/sierra/`, which a normal push or fetch does not transfer.

Each repository shares its own sources: the project's repository and each submodule. Changes in a submodule are stored there.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Literal

from sierra.errors import Missing, UsageError
from sierra.provenance.source import origin
from sierra.provenance.source.git import Git, in_repository
from sierra.provenance.source.manifest import read, repositories
from sierra.provenance.source.origin import without_credentials
from sierra.util.lazy_definitions import dataclass

REFS = "refs/sierra/"
ALL = f"{REFS}*:{REFS}*"
ALONE = ("--quiet", "--recurse-submodules=no")
Direction = Literal["push", "fetch"]


@dataclass(frozen=True, slots=True)
class Shared:
    """The sources that one repository has shared."""

    repository: str
    """The path from the top of the project's repository, which is `.`."""
    remote: str
    """The name or the address of the remote, without credentials."""
    sources: int
    """Number of sources that were pushed, or that exist after a fetch."""
    new: int
    """Number of these sources that the other side did not have."""


def share(root: Path, direction: Direction, remote: str | None = None) -> list[Shared]:
    """Push all recorded sources of a project to a remote, or fetch all that it has, including those of submodules.

    `remote` is a name or an address. By default, it is the remote that the branch follows, else `origin`, else the only one. A
    submodule uses its own remote of that name, or its own default. A submodule without a remote is skipped, unless it has
    something to push. Raises UsageError if there is no remote, and Missing if git fails.
    """
    if not in_repository(root):
        raise UsageError(f"{root} is not in a git repository; the sources of its runs are in the store itself")
    top = Git(Git(root).top)
    chosen = []
    for path, git in _all(top, "."):
        is_given = remote is not None and (path == "." or remote in origin.remotes(git))
        chosen.append((path, git, remote if is_given else origin.default_remote(git)))
    for path, git, default in chosen:
        if default is None and (path == "." or (direction == "push" and _own(git))):
            raise UsageError(f"{git.root} has no default remote; add one there (git remote add origin ADDRESS)")
    return [_shared(git, path, direction, default) for path, git, default in chosen if default is not None]


def _all(git: Git, path: str) -> Iterator[tuple[str, Git]]:
    """Yield a repository and the repositories in it that are checked out."""
    yield path, git
    for name, _ in repositories(read(git("ls-files", "--stage", "-z"))):
        inner = git.root / os.fsdecode(name)
        if (inner / ".git").exists():
            yield from _all(Git(inner), os.path.normpath(f"{path}/{os.fsdecode(name)}"))


def _shared(git: Git, path: str, direction: Direction, remote: str) -> Shared:
    there = set(git("ls-remote", "--refs", "--", remote, f"{REFS}*", network=True).split(b"\n")) - {b""}
    before = _own(git)
    if direction == "push" and before:
        git("push", *ALONE, "--", remote, ALL, network=True)
    elif direction == "fetch" and there:
        git("fetch", *ALONE, "--no-tags", "--no-write-fetch-head", "--", remote, ALL, network=True)
    after, theirs = _own(git), {line.partition(b"\t")[2] for line in there}
    if direction == "fetch" and not theirs <= after:
        raise Missing(f"{git.root}: git did not fetch all sources that {without_credentials(remote)} has; try again")
    sources, new = (before, before - theirs) if direction == "push" else (after, after - before)
    return Shared(path, without_credentials(remote), len(sources), len(new))


def _own(git: Git) -> set[bytes]:
    """Return the refs of the sources that a repository has."""
    return set(git("for-each-ref", "--format=%(refname)", REFS).split(b"\n")) - {b""}
