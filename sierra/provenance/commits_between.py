"""The history of a repository, for people: the commits between two commits, and one commit as its repository has it now.

GitPython lists the commits between two others. It is imported for this alone (`sierra diff`), because the import takes as
long as a short command. A repository may come from a stranger: git runs with the settings of
`sierra.provenance.source.git`, checks no signatures, and fetches no objects that the repository lacks, so that it executes no
program that the repository's configuration names. Commits are given by their full hash.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from contextlib import suppress
from datetime import datetime
from functools import partial
from pathlib import Path

from sierra.errors import Missing
from sierra.provenance.source import origin
from sierra.provenance.source.git import ALWAYS, OFFLINE, Git, environment, foreign, in_repository
from sierra.util.lazy_definitions import dataclass, regex

SHOWN = 20
"""Maximum number of commits that are listed."""
BRANCHES = 6
"""Maximum number of branches and tags that are listed."""
HASH = regex(r"[0-9a-f]{40}([0-9a-f]{24})?")
Ask = Callable[..., str]
"""Runs git with arguments, and returns its output; an empty text if git fails."""
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
    """The commits that only one of two histories has."""

    on: int = 0
    """Number of commits that the later one has and the earlier one does not have."""
    back: int = 0
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
    ask = partial(_by_git, root)
    if missing := tuple(commit for commit in dict.fromkeys((before, after)) if not _has(ask, commit)):
        return Commits(missing=missing)
    base = ask("merge-base", before, after).strip() or None
    on, back = (
        int(ask("rev-list", "--count", span, "--").strip() or 0) for span in (f"{before}..{after}", f"{after}..{before}")
    )
    return Commits(on, back, base=base)


def listed(root: Path, before: str, after: str) -> tuple[Commit, ...]:
    """Return the commits that `after` has and `before` does not have: at most `SHOWN`, newest first."""
    return _log(partial(_by_gitpython, root), f"{before}..{after}")


def known(root: Path, commit: str) -> Known | None:
    """Return what the repository of the project in `root` knows about a commit; None if it does not have it."""
    ask = partial(_by_git, root)
    if not _has(ask, commit):
        return None
    [recorded] = _log(ask, commit, most=1)
    described = ask("describe", "--always", "--tags", f"--abbrev={origin.DIGITS}", commit).strip()
    where = ("refs/heads", "refs/remotes", "refs/tags")
    names = ask("for-each-ref", f"--contains={commit}", f"--count={BRANCHES}", "--format=%(refname:short)", *where)
    branch = ask("symbolic-ref", "--quiet", "--short", "HEAD").strip()
    return Known(recorded, described, tuple(names.splitlines()), origin.remote(Git(root), branch))


def _has(ask: Ask, commit: str) -> bool:
    return bool(HASH.fullmatch(commit) and ask("rev-parse", "--verify", "--quiet", f"{commit}^{{commit}}").strip())


def _log(ask: Ask, span: str, *, most: int = SHOWN) -> tuple[Commit, ...]:
    text = ask("log", "--no-color", "--no-show-signature", ENCODING, f"--max-count={most}", FORMAT, span, "--")
    fields = (line.split("\0", 3) for line in text.split("\n") if line)
    return tuple(Commit(name, datetime.fromisoformat(date), author, subject) for name, date, author, subject in fields)


def _by_git(root: Path, *arguments: str) -> str:
    """Return git's output; an empty text if git fails, or if there is no git or no repository."""
    if not in_repository(root):
        return ""
    with suppress(Missing):
        return Git(root)(*arguments, optional=True, offline=True).decode("utf-8", "replace")
    return ""


def _by_gitpython(root: Path, *arguments: str) -> str:
    """Return the same as `_by_git`."""
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
