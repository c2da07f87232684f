"""The part `source/history.bundle` of a package: the history of the recorded commits, as a bundle that git can clone.

The pack in it has all objects that the commits reach. All that decides about its bytes is set: one thread, no deltas of the
repository's own packs, no settings of the user. So the same git writes the same bytes for the same history; another version of
git or zlib may not. Compare two bundles by `git bundle list-heads` and by their objects.

The format is that of gitformat-bundle(5): a signature, capabilities, references, an empty line, and a pack. There is no bundle
of a repository without all objects (a shallow or a partial clone).
"""

from __future__ import annotations

import itertools
import shutil
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from sierra.errors import Missing
from sierra.packages.layout import HISTORY
from sierra.packages.parts.checks import secret_problems
from sierra.packages.parts.secret_shapes import kinds
from sierra.packages.parts.sources import folders
from sierra.packages.subject import Member, PartResult, Subject
from sierra.provenance.source.git import Git, in_repository
from sierra.util.text import counted

COMMITS = "SELECT DISTINCT commit FROM sources WHERE commit IS NOT NULL ORDER BY commit"
SETTINGS = (
    *("-c", "core.bigFileThreshold=512m"),
    *("-c", "pack.windowMemory=0"),
    *("-c", "pack.packSizeLimit=0"),
    *("-c", "pack.useSparse=false"),
)
PACK = (
    *("pack-objects", "--quiet", "--revs", "--delta-base-offset", "--threads=1", "--window=10", "--depth=50"),
    *("--compression=6", "--no-reuse-delta", "--no-reuse-object"),
)
SHA1 = 40
"""The number of digits of a commit in a repository that uses SHA-1."""
DIGITS = 12
"""The number of digits of a commit in the name of its branch."""
READ = 32 << 20
"""The number of bytes of objects that are read at a time."""
LARGEST = 100 << 20
"""The largest number of bytes of an object in which secrets are sought."""


def members(subject: Subject, packed: Mapping[str, Member]) -> PartResult:
    """Return the bundle with the history of all recorded commits; nothing outside git.

    Each commit is a branch `recorded-<12 digits>`; HEAD is that of the newest batch.
    """
    commits = [] if subject.redacted else _commits(subject)
    if not commits or not subject.project.config.package.history:
        return PartResult(())
    root = subject.project.root
    if not in_repository(root):
        return PartResult((), facts=("the project is not in git, so the history of its commits is not packed",))
    if reason := _incomplete(root, commits):
        return PartResult((), notes=(f"the history of the commits is not packed: {reason}",))
    git = Git(root)
    try:
        objects = dict(_objects(git, commits))
        problems = tuple(secret_problems(subject, _secrets(git, objects)))
        bundle = _bundle(git, commits, subject.folder)
    except Missing as error:
        return PartResult((), notes=(f"the history of the commits is not packed: {error}",))
    fact = f"{HISTORY} has the history of {counted(len(commits), 'commit')}: {counted(len(objects), 'object')}, of all folders"
    return PartResult([Member(HISTORY, bundle, "history of the source, for git clone")], facts=(fact,), problems=problems)


def _commits(subject: Subject) -> list[str]:
    """Return the recorded commits, that of the newest batch first."""
    newest = [tree.commit for tree in folders(subject).values() if tree.commit is not None]
    return list(dict.fromkeys([*newest, *subject.store.values(str, COMMITS)]))


def _incomplete(root: Path, commits: Sequence[str]) -> str:
    """Return the reason why a repository cannot have the whole history; "" if there is none."""
    git = Git(root)
    if lost := [commit for commit in commits if not git.has(commit)]:
        return f"the repository does not have commit {lost[0][:DIGITS]}"
    if git("rev-parse", "--is-shallow-repository").strip() == b"true":
        return "the repository is a shallow clone; run git fetch --unshallow"
    if git("config", "--get-regexp", r"^(remote\..*\.promisor|extensions\.partialclone)$", optional=True):
        return "the repository is a partial clone"
    return ""


def _objects(git: Git, commits: Sequence[str]) -> Iterator[tuple[str, str]]:
    """Yield all objects that the commits reach: git's hash, and a path, or "" for commits and root folders."""
    for line in git("rev-list", "--objects", *commits, "--").decode("utf-8", "replace").splitlines():
        digits, _, path = line.partition(" ")
        yield digits, path


def _secrets(git: Git, objects: Mapping[str, str]) -> Iterator[tuple[str, str]]:
    """Yield secrets in files and messages of the history."""
    listing = git("cat-file", "--batch-check", "--buffer", given="".join(f"{sha}\n" for sha in objects).encode()).decode()
    sizes = [(sha, int(size)) for sha, kind, size in map(str.split, listing.splitlines()) if kind != "tree"]
    for group in _groups([(sha, size) for sha, size in sizes if size <= LARGEST]):
        content = git("cat-file", "--batch", "--buffer", given="".join(f"{sha}\n" for sha, _ in group).encode())
        at = 0
        for sha, size in group:
            at = content.index(b"\n", at) + 1
            for kind in sorted(kinds([content[at : at + size]])):
                yield (
                    objects[sha] or f"commit {sha[:DIGITS]}",
                    f"{kind} in the history, which [package] history = false leaves out",
                )
            at += size + 1


def _groups(sizes: Sequence[tuple[str, int]]) -> Iterator[list[tuple[str, int]]]:
    """Yield objects in groups of about READ bytes."""
    before = itertools.accumulate((size for _, size in sizes), initial=0)
    for _, group in itertools.groupby(zip(sizes, before, strict=False), lambda pair: pair[1] // READ):
        yield [one for one, _ in group]


def _bundle(git: Git, commits: Sequence[str], folder: Path) -> Path:
    """Write the bundle to a folder; return its path."""
    given = "".join(f"{commit}\n" for commit in commits).encode()
    digits = git(*SETTINGS, *PACK, str(folder / "history"), given=given).decode().strip()
    lines = ["# v2 git bundle"] if len(commits[0]) == SHA1 else ["# v3 git bundle", "@object-format=sha256"]
    lines += [f"{commit} refs/heads/recorded-{commit[:DIGITS]}" for commit in commits]
    path = folder / "history.bundle"
    with path.open("wb") as bundle, (folder / f"history-{digits}.pack").open("rb") as pack:
        bundle.write("\n".join([*lines, f"{commits[0]} HEAD", "", ""]).encode())
        shutil.copyfileobj(pack, bundle)
    return path
