"""The source: the code that runs are made from, as one tree with one id.

The id is git's hash of the tree, written as an SWHID (`swh:1:dir:…`). In a git repository, git computes it from the
current files. Changed and untracked files are included, ignored files are not. Outside git, this package computes the same
hash, so that a project has the same id in every location. The user's index, files, branches and stash are not changed (see
`worktree`). The ref `refs/sierra/<tree>` protects the tree from being pruned.

`[source] dirty` decides about uncommitted changes. "record" includes them in the source, "refuse" raises an error, and with
"ignore" the source is the commit's tree. A result must not be ascribed to code that did not produce it. Therefore, with
"ignore", runs use a checkout of that tree if the working tree differs from it: `Source.checkout`.
"""

from __future__ import annotations

import json
import os
from collections.abc import Container, Iterable, Iterator, Mapping, Sequence
from pathlib import Path

from sierra.errors import ConfigError
from sierra.provenance.source import origin, plain_tree, worktree_snapshot
from sierra.provenance.source.git import Git, in_repository
from sierra.provenance.source.manifest import LINK, Files, listed, read, tree_hash, written
from sierra.provenance.source.plain_tree import LEFT_OUT, ListedFile
from sierra.provenance.source.selection import PathSelection, inside, shown
from sierra.store.row_types import SourceRow
from sierra.util.hashing import digest
from sierra.util.lazy_definitions import dataclass, field

SWHID = "swh:1:dir:"
LARGE = 50_000_000
"""Size limit in bytes if `[source] max_untracked` is not set."""
CACHES = LEFT_OUT | {".DS_Store", ".eggs", ".idea", ".ipynb_checkpoints", ".nox", ".tox", ".vscode"}
"""Files and folders of tools; no run needs them."""
CACHE_SUFFIXES, VENV = (".egg-info", ".pyc"), "pyvenv.cfg"
RECORDED = ("tree", "vcs", "commit", "branch", "dirty", "remote", "described", "folder", "submodules")


@dataclass(frozen=True, slots=True)
class Source:
    """The state of the code at one time."""

    tree: str
    vcs: str
    commit: str | None
    branch: str | None
    dirty: bool | None
    remote: str | None
    manifest: bytes
    """One line per file: mode, blob hash, path."""
    described: str | None = None
    folder: str | None = None
    """The project's folder, relative to the root of the repository."""
    submodules: str | None = None
    """JSON object: the path and the commit of each nested repository."""
    checkout: bool = False
    """True if the working tree differs from this source, so that runs need a checkout of it."""
    notes: tuple[str, ...] = ()
    """Messages for the user, one line each."""
    converted: Mapping[str, str] = field(default_factory=dict)
    """The SHA-256 of files whose bytes on disk git would not restore, by path: see `sierra.provenance.source.converted`."""
    listed: Mapping[bytes, ListedFile] = field(default_factory=dict, compare=False)
    """Outside git: the files when they were listed, by path."""
    since: int | None = field(default=None, compare=False)
    """In git: a time before the files were read, by the file system's clock, in nanoseconds."""

    @property
    def id(self) -> str:
        return digest("source", {name: getattr(self, name) for name in RECORDED})

    def row(self, files: str) -> SourceRow:
        """Return the record of this source; `files` is the SHA-256 under which the manifest is stored."""
        return SourceRow(source=self.id, files=files, **{name: getattr(self, name) for name in RECORDED})


def capture(
    root: Path,
    *,
    paths: Sequence[str],
    without: Iterable[str],
    code: Sequence[str] = (),
    prose: bool = True,
    dirty: str = "record",
    git: bool = True,
    large: int = LARGE,
    memory: Path | None = None,
) -> Source:
    """Return the source of the project `root`: all files or those in `paths` and `code`, except those in `without`.

    Without `prose`, files that describe the project to people are left out too (see `sierra.provenance.source.prose`).
    `dirty` and `git` have the meaning of `[source] dirty` and `[source] git`. An untracked file may have `large` bytes. The
    file `memory` caches the hashes of files outside git. Raises ConfigError for a path that does not exist, a file that is too
    large, or changes that are refused. Raises Missing if git is needed and fails.
    """
    for path in paths:
        if not (root / path).exists():
            raise ConfigError(f"[source] paths: {path!r} does not exist in {root}")
        if inside(path).startswith((b"..", b"/")):
            raise ConfigError(f"[source] paths: {path!r} is outside {root}; use files and folders in it")
    chosen = PathSelection([*paths, *code] if paths else (), without, prose=prose)
    used = git and _in_git(root)
    if not git and dirty != "record":
        raise ConfigError(
            f'[source] dirty = "{dirty}" compares with a commit of git, which git = false does not use; remove one'
        )
    source, files = _git(root, chosen, dirty, large) if used else _outside(root, chosen, dirty, large, memory)
    for path in paths:
        if not any(map(PathSelection([path]), files)):
            reason = "it is empty, or ignored by git" if used else "it is empty, or has only files of tools"
            raise ConfigError(f"[source] paths: {path!r} contains no source files: {reason}")
    return source


def contents(source: Source, root: Path, known: Container[str]) -> Iterator[tuple[str, bytes]]:
    """Yield git's hash and the content of each file outside git that is not `known`. Raises Missing for a changed file."""
    return plain_tree.contents(source.manifest, root, known, source.listed)


def ignored(root: Path, without: Iterable[str]) -> str:
    """Return one line with the first paths that git ignores in a project, and how many more there are.

    They are not part of the source, so a checkout of the source lacks them. A folder that git ignores completely is one path,
    with a slash at its end. The paths in `without`, caches and virtual environments are left out.
    """
    if not _in_git(root):
        return ""
    listing = Git(root)("ls-files", "--others", "--ignored", "--exclude-standard", "--directory", "-z", "--", ".").split(b"\0")
    never = PathSelection(without=without).never
    return shown([path for path in listing if path and not never(path) and not _is_cache(root, os.fsdecode(path))])


def _is_cache(root: Path, path: str) -> bool:
    parts = Path(path).parts
    return not CACHES.isdisjoint(parts) or parts[-1].endswith(CACHE_SUFFIXES) or (root / path / VENV).is_file()


def _in_git(root: Path) -> bool:
    """Return True if a repository contains the project and does not ignore the project's folder."""
    return in_repository(root) and not Git(root)("check-ignore", ".", optional=True).strip()


def _outside(root: Path, chosen: PathSelection, dirty: str, large: int, memory: Path | None) -> tuple[Source, Files]:
    if dirty != "record":
        raise ConfigError(f'[source] dirty = "{dirty}": there is no commit to compare with, {root} is not in git; use "record"')
    entries, listed_files = plain_tree.entries(root, chosen, large, memory)
    links = [entry.path for entry in entries if entry.mode == LINK]
    files = {entry.path: entry.blob.encode() for entry in entries}
    manifest = listed(entries)
    tree = SWHID + tree_hash(read(manifest))
    notes = tuple(_leading_out(root, links))
    return Source(tree, "none", None, None, None, None, manifest, notes=notes, listed=listed_files), files


def _git(root: Path, chosen: PathSelection, dirty: str, large: int) -> tuple[Source, Files]:
    git = Git(root)
    now = worktree_snapshot.describe_commit(git, chosen) if dirty == "ignore" else worktree_snapshot.record(git, chosen, large)
    if dirty == "refuse":
        _refuse(root, now)
    differs = bool(now.changed) and dirty != "ignore"
    lossy = now.converted if dirty != "ignore" else {}  # the commit's files are executed then
    source = Source(
        tree=SWHID + now.tree,
        vcs="git",
        commit=now.commit,
        branch=now.branch,
        dirty=differs or now.commit is None,
        remote=origin.remote(git, now.branch),
        manifest=written(now.files),
        described=origin.describe(git, now.commit, dirty=differs),
        folder=git.prefix.decode("utf-8", "replace").rstrip("/") or ".",
        submodules=json.dumps(now.submodules, sort_keys=True) if now.submodules else None,
        checkout=dirty == "ignore" and bool(now.changed or now.absent or now.converted),
        notes=(*_enclosing(root), *(_notes(root, now) if dirty != "ignore" else ())),
        converted={path.decode("utf-8", "backslashreplace"): sha256 for path, sha256 in lossy.items()},
        since=now.since,
    )
    return source, now.files


def _refuse(root: Path, now: worktree_snapshot.WorktreeState) -> None:
    if now.commit is None:
        raise ConfigError(f'[source] dirty = "refuse": the repository of {root} has no commit yet; commit something first')
    if now.changed:
        raise ConfigError(
            f'[source] dirty = "refuse": {shown(now.changed)}: changed since commit {now.commit[:12]}; '
            "commit (git commit) or stash (git stash -u) the changes, or list files that are not code in .gitignore"
        )


def _notes(root: Path, now: worktree_snapshot.WorktreeState) -> Iterator[str]:
    yield from _leading_out(root, [path for path, what in now.files.items() if what[:6] == b"120000"])
    hollow = [path for path in now.absent if (root / os.fsdecode(path)).is_dir()]
    if hollow:
        remedy = "fetch them with git submodule update --init"
        yield f"{shown(hollow)}: submodules that are not checked out are not part of the source; {remedy}"
    if now.converted:
        yield (
            f"{shown(sorted(now.converted))}: git would restore other bytes than those on disk (line endings, or a filter); "
            "runs are reused only while these bytes stay the same"
        )


def _enclosing(root: Path) -> Iterator[str]:
    """Yield a note if the project's repository is that of a whole machine or of a home folder."""
    top = next(folder for folder in (root, *root.parents) if (folder / ".git").exists())
    if top != root and top.resolve() in (Path(top.anchor), Path.home().resolve()):
        yield (
            f"the git repository of this project is {top}; run git init in {root}, or set git = false under [source] to "
            "identify the code without git"
        )


def _leading_out(root: Path, links: Sequence[bytes]) -> Iterator[str]:
    here = root.resolve()
    out = [path for path in sorted(links) if not (root / os.fsdecode(path)).resolve().is_relative_to(here)]
    if out:
        yield f"{shown(out)}: links out of the project; their targets are recorded only if the command names them"
