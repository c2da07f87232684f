"""The history of a repository, for people: the commits between two commits, and one commit as its repository has it now.

GitPython runs git. It is imported when history is read, which no run needs. A repository may come from a stranger: git runs
with the settings of `sierra.provenance.source.git`, checks no signatures, and fetches no objects that the repository lacks,
so that it executes no program that the repository's configuration names. Commits are given by their full hash.
"""

from __future__ import annotations

import os
import re
import shutil
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from sierra.provenance.source import origin
from sierra.provenance.source.git import ALWAYS, Git, environment, foreign, in_repository

SHOWN = 20
"""Maximum number of commits that are listed."""
BRANCHES = 6
"""Maximum number of branches and tags that are listed."""
HASH = re.compile(r"[0-9a-f]{40}([0-9a-f]{24})?")
OFFLINE = {"GIT_ALLOW_PROTOCOL": "none", "GIT_NO_LAZY_FETCH": "1"}
"""Variables that forbid git to fetch what a partial clone lacks, which may start any program."""
FORMAT = "--format=%H%x00%aI%x00%an%x00%s"
ENCODING = "--encoding=UTF-8"


@dataclass(frozen=True, slots=True)
class Commit:
    """One commit: its hash, the author's date and name, and the subject."""

    id: str
    date: datetime
    author: str
    subject: str

    def __str__(self) -> str:
        return f"{self.id[:10]} {self.date:%Y-%m-%d} {self.author}: {self.subject}"


@dataclass(frozen=True, slots=True)
class Commits:
    """The commits that only one of two histories has: their numbers, and up to `SHOWN` of each, newest first."""

    on: int = 0
    """Number of commits that the later one has and the earlier one does not have."""
    back: int = 0
    log_on: tuple[Commit, ...] = ()
    log_back: tuple[Commit, ...] = ()
    missing: tuple[str, ...] = ()
    """The given commits that the repository does not have."""
    base: str | None = None
    """The last commit that both histories have; None if they share none, or if a commit is missing."""


@dataclass(frozen=True, slots=True)
class Known:
    """One commit as its repository has it now, with names that it got after it was recorded."""

    commit: Commit
    described: str
    """The output of `git describe --always --tags`: the nearest tag before it."""
    branches: tuple[str, ...]
    """Branches and tags that contain it, those of remotes included; at most `BRANCHES`."""
    remote: str | None
    """The address of the default remote, without credentials."""


def between(root: Path, before: str, after: str) -> Commits:
    """Return the commits between two commits, as far as the repository of the project in `root` has them."""
    if missing := tuple(commit for commit in dict.fromkeys((before, after)) if not _has(root, commit)):
        return Commits(missing=missing)
    on, back = f"{before}..{after}", f"{after}..{before}"
    base = _line(root, "merge-base", before, after) or None
    return Commits(_count(root, on), _count(root, back), _log(root, on), _log(root, back), base=base)


def known(root: Path, commit: str) -> Known | None:
    """Return what the repository of the project in `root` knows about a commit; None if it does not have it."""
    if not _has(root, commit):
        return None
    [found] = _log(root, commit, most=1)
    described = _line(root, "describe", "--always", "--tags", f"--abbrev={origin.DIGITS}", commit)
    where = ("refs/heads", "refs/remotes", "refs/tags")
    names = _text(root, "for-each-ref", f"--contains={commit}", f"--count={BRANCHES}", "--format=%(refname:short)", *where)
    branch = _line(root, "symbolic-ref", "--quiet", "--short", "HEAD")
    return Known(found, described, tuple(names.splitlines()), origin.remote(Git(root), branch))


def _has(root: Path, commit: str) -> bool:
    return bool(HASH.fullmatch(commit) and _line(root, "rev-parse", "--verify", "--quiet", f"{commit}^{{commit}}"))


def _count(root: Path, span: str) -> int:
    return int(_line(root, "rev-list", "--count", span, "--") or 0)


def _log(root: Path, span: str, *, most: int = SHOWN) -> tuple[Commit, ...]:
    text = _text(root, "log", "--no-color", "--no-show-signature", ENCODING, f"--max-count={most}", FORMAT, span, "--")
    fields = (line.split("\0", 3) for line in text.split("\n") if line)
    return tuple(Commit(name, datetime.fromisoformat(date), author, subject) for name, date, author, subject in fields)


def _line(root: Path, *arguments: str) -> str:
    return _text(root, *arguments).strip()


def _text(root: Path, *arguments: str) -> str:
    """Return git's output; an empty text if git fails, or if there is no git or no repository."""
    program = shutil.which("git")
    if program is None or not in_repository(root):
        return ""
    import git

    variables = environment() | OFFLINE
    dropped = [name for name in foreign() if name not in variables]
    # GitPython adds variables to those of this process, and cannot drop any
    without = ("env", *(word for name in dropped for word in ("-u", name))) if dropped else ()
    try:
        out = git.Git(os.fspath(root)).execute([*without, program, *ALWAYS, *arguments], env=variables, stdout_as_string=False)
    except git.GitCommandError:
        return ""
    return out.decode("utf-8", "replace")
