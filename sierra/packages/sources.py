"""The part of a package with the recorded sources, dirty ones too: as folders for people, and in the store for SIERRA.

The source of the newest batch is in `project/`, sources of other batches are in `source/<tree>/`. The store of a package has
all files of all sources, so that neither git nor the repository is needed to restore them.

A folder lacks symbolic links and files whose names mean something else on other systems; a note says so. Files that git changes
when it checks them out (Git LFS, line endings), and submodules, need git: a package of them is refused.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

from sierra.packages.layout import PROJECT, SOURCE
from sierra.packages.members import unsafe
from sierra.packages.subject import Made, Member, Subject
from sierra.provenance import source
from sierra.provenance.source.manifest import LINK, is_blob, parts, read, repositories
from sierra.store.objects import Objects
from sierra.store.row_types import BlobRow

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


def members(subject: Subject, found: Mapping[str, Member]) -> Made:
    """Write the sources' files to the subject's store, and return them as folders.

    Raises Missing for a file that is gone.
    """
    made: list[Member] = []
    notes: list[str] = []
    problems: list[str] = []
    contents: dict[str, Path] = {}
    for name, tree in folders(subject).items():
        folder = _Folder(subject, tree, name)
        made += folder.members()
        notes += folder.notes
        problems += folder.problems
        contents.update(folder.contents if tree.vcs == "git" else {})
    if not problems:
        _keep(subject, contents)
    return Made(made, notes=tuple(notes), problems=tuple(problems))


class _Folder:
    """A restored source."""

    def __init__(self, subject: Subject, tree: Tree, name: str) -> None:
        manifest = subject.store.object(tree.files)
        self._files = read(manifest)
        self._root = subject.folder / "source" / _digits(tree)
        self._name = name
        self.notes: list[str] = []
        self.problems = [
            f"{os.fsdecode(path)} is a submodule, and packages cannot contain submodules"
            for path, _ in repositories(self._files)
        ]
        self.contents: dict[str, Path] = {}
        """The files by git's hash."""
        if not self.problems:
            source.restore(tree.tree, manifest, subject.project.root, self._root, subject.store.blob, commit=tree.commit)

    def members(self) -> Iterator[Member]:
        """Yield the files of the folder, and collect contents, notes and problems."""
        for path, what in sorted(self._files.items()) if not self.problems else ():
            name = os.fsdecode(path)
            mode, blob = parts(what)
            if mode == LINK:
                self.notes.append(f"{self._name}{name} is a symbolic link; it is in the store only")
                self.contents[blob] = self._root / name
            elif not is_blob((self._root / name).read_bytes(), blob):
                self.problems.append(f"git changes {name} when it checks it out (Git LFS or line endings)")
            else:
                self.contents[blob] = self._root / name
                if reason := unsafe(self._name + name):
                    self.notes.append(f"{self._name}{name!a} is in the store only: {reason}")
                else:
                    yield Member(self._name + name, self._root / name, "source of the runs", executable=mode == PROGRAM)


def _keep(subject: Subject, contents: Mapping[str, Path]) -> None:
    """Add files to the store, by git's hash."""
    writer = subject.store.writer(subject.folder / "blobs", subject.batches[-1])
    objects = Objects(writer.path("objects"))
    writer.records(BlobRow(blob, objects.add(_content(path))) for blob, path in sorted(contents.items()))
    objects.close()
    if contents:
        subject.store.publish(writer)


def _content(path: Path) -> bytes:
    return os.fsencode(path.readlink()) if path.is_symlink() else path.read_bytes()
