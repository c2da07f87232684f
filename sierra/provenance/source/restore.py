"""Restoring a recorded source into a folder.

If a git repository has all files of the source, git writes them, with its line endings and filters for them. Any clone that
has the commit has the files, not only the repository where the source was recorded; from the files and the manifest, git
builds the tree again. Files that git does not have may be in the store, which keeps the files of projects outside git.
A manifest may come from an untrusted place, so no path in it may leave the folder.
"""

from __future__ import annotations

import os
from collections.abc import Container
from functools import partial
from pathlib import Path

from sierra.errors import Damaged, Missing
from sierra.provenance.source import lfs
from sierra.provenance.source.git import Git, in_repository
from sierra.provenance.source.manifest import (
    LINK,
    REPOSITORY,
    Files,
    is_blob,
    of_ls_tree,
    parts,
    read,
    repositories,
    tree_of,
    written,
)
from sierra.provenance.source.selection import shown
from sierra.provenance.source.stored_repositories import ReadBlob, data, nested
from sierra.provenance.source.worktree_snapshot import of_tree
from sierra.util.lazy_definitions import regex
from sierra.util.scratch import scratch

UNFINISHED = ".sierra-source-"
"""The beginning of the names of folders into which git writes."""
HASH = regex("[0-9a-f]{40}|[0-9a-f]{64}")
FETCH = "run sierra source fetch (after sierra source push has been run where the source was recorded)"


def restore(
    tree: str, manifest: bytes, root: Path, target: Path, content: ReadBlob, *, commit: str | None = None, use_git: bool = True
) -> None:
    """Write the files of a recorded source into `target`, a folder that is created.

    With `use_git`, the files come from the git repository around `root` if it has all of them. Otherwise they come from
    `content`, which returns a file for git's hash of it. Raises Damaged if the manifest is of another tree, and Missing if
    neither has a file; the message names the `commit` to fetch if it is given.
    """
    files = read(manifest)
    _check(files)
    if tree_of(manifest) not in (None, tree.rpartition(":")[2]):
        raise Damaged(f"the file list of the recorded source does not match {tree}: other code would be restored")
    target.mkdir(parents=True)
    git = Git(root) if use_git and in_repository(root) else None
    lacking = _lacking(git, tree.rpartition(":")[2], files)
    if git is not None and not lacking:
        _checkout(git, files, target, commit)
        return
    try:
        _write_files(files, target, partial(_file, content, git, lacking), content)
    except _Lacking as lost:
        missing = f"the source's file {shown([lost.path])!r} is neither in git at {root} nor in the store"
        raise Missing(f"{missing}; {_remedy(git, commit)}") from None


class _Lacking(Exception):
    """A file that neither git nor the store has."""

    def __init__(self, path: bytes) -> None:
        super().__init__()
        self.path = path


def _file(content: ReadBlob, git: Git | None, lacking: Container[str], blob: str) -> bytes | None:
    """Return a file from the store, else from git; None if neither has it."""
    found = content(blob)
    return git("cat-file", "blob", blob) if found is None and git is not None and blob not in lacking else found


def _write_files(files: Files, target: Path, file: ReadBlob, content: ReadBlob) -> None:
    for path, what in sorted(files.items(), key=lambda item: parts(item[1])[0] == REPOSITORY):
        mode, blob = parts(what)
        below = nested(blob, content) if mode == REPOSITORY else None
        if below is not None:
            _check(below)
            (target / os.fsdecode(path)).mkdir(parents=True)
            _write_files(below, target / os.fsdecode(path), content, content)
            continue
        stored = None if mode == REPOSITORY else file(blob)
        if stored is None or not is_blob(stored, blob):
            raise _Lacking(path)
        _write(target / os.fsdecode(path), mode, stored if mode == LINK else data(stored, content))


def is_available(root: Path, tree: str, manifest: bytes) -> bool:
    """Return True if git has the files of a recorded source, except submodules that are not checked out. Raises Damaged."""
    files = read(manifest)
    _check(files)
    if not in_repository(root) or _lacking(Git(root), tree.rpartition(":")[2], files):
        return False
    nested = ((root / os.fsdecode(path), thing) for path, thing in repositories(files))
    return all(not (folder / ".git").exists() or Git(folder).has(thing) for folder, thing in nested)


def _check(files: Files) -> None:
    """Raise Damaged for a path, mode or hash that git does not allow, or a path below a file or a link."""
    for path, what in files.items():
        steps = path.split(b"/")
        above = (b"/".join(steps[:end]) for end in range(1, len(steps)))
        if any(step.lower() in (b"", b".", b"..", b".git") for step in steps) or any(folder in files for folder in above):
            raise Damaged(f"the recorded source has a file {shown([path])!r}, which is not allowed in a source")
        mode, blob = parts(what)
        if mode not in ("100644", "100755", LINK, REPOSITORY):
            raise Damaged(f"the recorded source has a file {shown([path])!r} of the unknown mode {mode}")
        if not HASH.fullmatch(blob):
            raise Damaged(f"the recorded source has a file {shown([path])!r} whose hash {blob!r} is not a git hash")


def _remedy(git: Git | None, commit: str | None) -> str:
    """Return advice on how to get a source that git does not have."""
    if git is None:
        return f"clone the repository that contains {f'commit {commit[:12]}' if commit else 'it'}, and replay there"
    if commit and not git.has(commit):
        return f"fetch commit {commit[:12]} (git fetch); if files had uncommitted changes, also {FETCH}"
    return f"the source was never committed: {FETCH}"


def _lacking(git: Git | None, tree: str, files: Files) -> set[str]:
    """Return the hashes of files that the repository does not have."""
    blobs = {blob for mode, blob in map(parts, files.values()) if mode != REPOSITORY}
    if git is None:
        return blobs
    if git.has(tree):
        return set()
    lines = git("cat-file", "--batch-check", given="".join(f"{blob}\n" for blob in blobs).encode()).decode().splitlines()
    return {line.split(" ")[0] for line in lines if line.endswith("missing")}


def _write(file: Path, mode: str, content: bytes) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    if mode == LINK:
        file.symlink_to(os.fsdecode(content))
    else:
        file.write_bytes(content)
        file.chmod(0o755 if mode == "100755" else 0o644)


def _checkout(git: Git, files: Files, target: Path, commit: str | None) -> None:
    """Let git write the files, and those of nested repositories, by the attributes of the whole repository."""
    prefix = git.prefix
    with scratch(target.parent, UNFINISHED) as folder:
        index, into = folder / "index", folder / "files"
        into.mkdir()
        lines = written({prefix + path: what for path, what in files.items()}) + _attributes(git, commit or "HEAD")
        git("update-index", "-z", "--index-info", index=index, given=lines, at_top=True)
        git("checkout-index", "--all", index=index, into=into)
        written_to = into / os.fsdecode(prefix)
        if written_to.is_dir():
            written_to.replace(target)
    lfs.check_restored(git, target, files)
    for path, thing in repositories(files):
        _checkout_inside(git.root, path, thing, target)


def _checkout_inside(root: Path, path: bytes, thing: str, target: Path) -> None:
    inside, remedy = root / os.fsdecode(path), "run git submodule update --init"
    if is_checked_out := (inside / ".git").exists():
        remedy += f" to get its commits; if files in it had uncommitted changes, {FETCH}"
    if not is_checked_out or not Git(inside).has(thing):
        raise Missing(f"the submodule {shown([path])!r} does not have {thing[:12]}; {remedy}")
    below = of_tree(Git(inside), thing)
    _check(below)
    _checkout(Git(inside), below, target / os.fsdecode(path), None)


def _attributes(git: Git, commit: str) -> bytes:
    """Return index lines for the .gitattributes files in folders above the project."""
    folders = git.prefix.split(b"/")[:-1]
    names = [b"/".join((*folders[:depth], lfs.ATTRIBUTES.encode())) for depth in range(len(folders))]
    if not names:
        return b""
    return written(of_ls_tree(git("ls-tree", "-z", commit, "--", *map(os.fsdecode, names), at_top=True, optional=True)))
