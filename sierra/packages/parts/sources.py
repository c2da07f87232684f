"""The part of a package with the recorded sources, dirty ones too: as folders for people, and in the store for SIERRA.

The source of the newest batch is in `project/`, sources of other batches are in `source/<tree>/`. The store of a package has
all files of all sources, so that neither git nor the repository is needed to restore them.

A folder lacks symbolic links and files whose names mean something else on other systems; a note says so. Submodules are folders
too; their commits and trees are in the store, where they prove the files. Data that git-lfs manages are packed if they have the
SHA-256 of the recorded pointer. A package of files whose line endings git changes is refused, because they need git.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

from sierra.errors import Missing
from sierra.packages.layout import PROJECT, SOURCE
from sierra.packages.members import unsafe
from sierra.packages.subject import Member, PartResult, Subject
from sierra.provenance import source
from sierra.provenance.source.git import Git, in_repository
from sierra.provenance.source.manifest import LINK, REPOSITORY, Files, is_blob, parts, read, tree_hash, written
from sierra.provenance.source.stored_repositories import nested, pointed
from sierra.provenance.source.worktree_snapshot import of_tree
from sierra.store.objects import Objects
from sierra.store.row_types import BlobRow
from sierra.util.hashing import sha256
from sierra.util.regular_files import read_regular

PathOrBytes = Path | bytes
"""A content in a file or in memory."""
PROGRAM = "100755"
"""Git's mode of programs."""
TREES = """
SELECT DISTINCT ON (tree) s.tree, s.commit, s.files, s.vcs FROM sources s
JOIN (SELECT p.source AS tree, max(b.lamport) AS lamport FROM batches b JOIN specs p USING (spec) GROUP BY ALL) u USING (tree)
ORDER BY u.lamport DESC, s.source
"""


class Tree(NamedTuple):
    """A recorded source: its tree (an SWHID), its commit, the SHA-256 of its list of files, and git or none."""

    tree: str
    commit: str | None
    files: str
    vcs: str


def folders(subject: Subject) -> dict[str, Tree]:
    """Return the sources of the packed batches, that of the newest batch first, by their folders in the package."""
    trees = subject.store.select(Tree, TREES)
    return {f"{SOURCE}{_digits(tree)[:12]}/" if number else PROJECT: tree for number, tree in enumerate(trees)}


def _digits(tree: Tree) -> str:
    return tree.tree.rpartition(":")[2]


def members(subject: Subject, packed: Mapping[str, Member]) -> PartResult:
    """Write the sources' files to the subject's store, and return them as folders.

    Raises Missing for a file that is gone.
    """
    collected: list[Member] = []
    notes: list[str] = []
    problems: list[str] = []
    contents: dict[str, PathOrBytes] = {}
    for name, tree in folders(subject).items():
        folder = _Folder(subject, tree, name)
        collected += folder.members()
        notes += folder.notes
        problems += folder.problems
        contents.update(folder.contents if tree.vcs == "git" else {})
    if not problems:
        _keep(subject, contents)
    return PartResult(collected, notes=tuple(notes), problems=tuple(problems))


class _Folder:
    """A restored source."""

    def __init__(self, subject: Subject, tree: Tree, name: str) -> None:
        self._subject = subject
        manifest = subject.store.object(tree.files)
        self._files = read(manifest)
        self._root = subject.folder / "source" / _digits(tree)
        self._name = name
        self.notes: list[str] = []
        self.problems: list[str] = []
        self.contents: dict[str, PathOrBytes] = {}
        """The files by git's hash; see `sierra.provenance.source.stored_repositories` for others."""
        root, git = subject.project.root, subject.project.config.source.git or tree.vcs == "git"
        source.restore(tree.tree, manifest, root, self._root, subject.store.blob, commit=tree.commit, use_git=git)

    def members(self) -> Iterator[Member]:
        """Yield the files of the folder, and collect contents, notes and problems."""
        yield from self._below(self._files, Path())

    def _below(self, files: Files, folder: Path) -> Iterator[Member]:
        """Yield the files of a repository in a folder of the source."""
        repository = _Repository(self._subject, self._subject.project.root / folder)
        for path, what in sorted(files.items()):
            file = folder / os.fsdecode(path)
            mode, blob = parts(what)
            if mode == REPOSITORY:
                below, objects = _Repository(self._subject, self._subject.project.root / file).nested(blob)
                self.contents.update(objects)
                yield from self._below(below, file)
            elif mode == LINK:
                self.notes.append(f"{self._name}{file} is a symbolic link; it is in the store only")
                self.contents[blob] = self._root / file
            elif reason := self._unproved(repository, file, blob):
                self.problems.append(reason)
            elif reason := unsafe(self._name + file.as_posix()):
                self.notes.append(f"{self._name}{file.as_posix()!a} is in the store only: {reason}")
            else:
                name = self._name + file.as_posix()
                yield Member(name, self._root / file, "source of the runs", executable=mode == PROGRAM)

    def _unproved(self, repository: _Repository, file: Path, blob: str) -> str:
        """Add a file to the contents; return the reason if the recorded hash does not prove it, else ""."""
        content = read_regular(self._root / file)
        if is_blob(content, blob):
            self.contents[blob] = self._root / file
            return ""
        pointer = repository.blob(blob)
        if pointed(pointer) != sha256(content):
            return f"git changes {file} when it checks it out (line endings, or another filter)"
        self.contents.update({blob: pointer, pointed(pointer): self._root / file})
        return ""


class _Repository:
    """The repository in a folder of the project; its objects come from the store if git does not have them."""

    def __init__(self, subject: Subject, folder: Path) -> None:
        self._store = subject.store
        self._git = (
            Git(folder) if (folder / ".git").exists() or (folder == subject.project.root and in_repository(folder)) else None
        )

    def blob(self, blob: str) -> bytes:
        """Return a file as git keeps it; nothing if neither git nor the store has it."""
        found = self._store.blob(blob)
        return self._git("cat-file", "blob", blob, optional=True) if found is None and self._git is not None else found or b""

    def nested(self, thing: str) -> tuple[Files, dict[str, PathOrBytes]]:
        """Return the files of a commit or a tree, and what proves them. Raises Missing if neither git nor the store has it."""
        if (files := nested(thing, self._store.blob)) is not None:
            return files, {sha: content for sha in (thing,) if (content := self._store.blob(sha)) is not None}
        if self._git is None:
            raise Missing(f"the submodule with {thing[:12]} is not checked out; run git submodule update --init")
        files = of_tree(self._git, thing)
        commit = self._git("cat-file", "commit", thing, optional=True)
        objects: dict[str, PathOrBytes] = {thing: commit} if commit else {}
        return files, objects | {tree_hash(files): written(files)}


def _keep(subject: Subject, contents: Mapping[str, PathOrBytes]) -> None:
    """Add files to the store, by git's hash."""
    writer = subject.store.writer(subject.folder / "blobs", subject.batches[-1])
    objects = Objects(writer.path("objects"))
    writer.records(BlobRow(blob, objects.add(_content(path))) for blob, path in sorted(contents.items()))
    objects.close()
    if contents:
        subject.store.publish(writer)


def _content(path: PathOrBytes) -> bytes:
    if isinstance(path, bytes):
        return path
    return os.fsencode(path.readlink()) if path.is_symlink() else read_regular(path)
