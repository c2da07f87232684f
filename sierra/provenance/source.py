"""The code that runs are made from, as one tree with one id.

The id is that of the tree as git hashes it, written as an SWHID (`swh:1:dir:…`): in a git repository git makes
it, of the files as they are now (changed and untracked ones too, ignored ones not); outside, the same hash is
made here, so that a project has one id wherever it lies. The user's index, files, branches and stash are not
touched: git works on a copy of the index, and the tree is kept from being pruned by a ref, `refs/sierra/<tree>`.
"""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import stat
import subprocess
import tempfile
from collections.abc import Callable, Container, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sierra.errors import ConfigError, Missing
from sierra.hashing import digest

LEFT_OUT = frozenset(
    (".git", ".hg", ".svn", "__pycache__", ".venv", "venv", "node_modules", ".mypy_cache", ".pytest_cache", ".ruff_cache")
)
"""Folders that are never code, in a project outside git."""

KEPT = 64 << 20

SWHID = "swh:1:dir:"


@dataclass(frozen=True, slots=True)
class Entry:
    """One file of a tree: git's mode and blob hash, and its path from the project's root."""

    mode: str
    blob: str
    path: bytes


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
    """A line for each file: mode, blob hash, path."""

    @property
    def id(self) -> str:
        return digest("source", {name: getattr(self, name) for name in ("tree", "vcs", "commit", "branch", "dirty", "remote")})

    def row(self, files: str) -> dict[str, Any]:
        """Its record; `files` is the SHA-256 under which the manifest is kept."""
        names = ("tree", "vcs", "commit", "branch", "dirty", "remote")
        return {"source": self.id, "files": files, **{name: getattr(self, name) for name in names}}


def capture(root: Path, *, paths: Sequence[str], without: Iterable[str]) -> Source:
    """The code in the project `root`: all of it or what `paths` names, without some files and folders.

    Raises ConfigError for a path that is not there, Missing where git is needed and cannot tell.
    """
    for path in paths:
        if not (root / path).exists():
            raise ConfigError(f"[source] paths: there is no {path!r} in {root}")
    wanted = _Chosen([_inside(path) for path in paths], [_inside(path) for path in without])
    source, entries = _git(root, wanted) if _in_git(root) else _outside(root, wanted)
    for path in paths:
        if not any(_Chosen([_inside(path)], [])(entry.path) for entry in entries):
            raise ConfigError(f"[source] paths: nothing in {path!r} counts: it is outside {root}, empty, or ignored by git")
    return source


def _inside(path: str) -> bytes:
    return os.fsencode(os.path.normpath(path))


def _in_git(root: Path) -> bool:
    """Whether a repository holds the project; one that ignores the project's folder does not."""
    return any((folder / ".git").exists() for folder in (root, *root.parents)) and not _Git(root).ignores_it()


def _outside(root: Path, wanted: _Chosen) -> tuple[Source, list[Entry]]:
    try:
        entries = list(_walk(root, wanted))
    except OSError as error:
        raise Missing(f"cannot read {os.fsdecode(error.filename or root)}: {error.strerror}") from error
    return Source(SWHID + tree_hash(entries), "none", None, None, None, None, _manifest(entries)), entries


def changed(before: bytes, after: bytes) -> list[str]:
    """The paths in which two manifests differ."""
    old, new = _read_manifest(before), _read_manifest(after)
    differing = {path for path in old.keys() | new.keys() if old.get(path) != new.get(path)}
    return [path.decode("utf-8", "replace") for path in sorted(differing)]


def contents(source: Source, root: Path, known: Container[str]) -> Iterator[tuple[str, bytes]]:
    """The files of a source outside git, each as git's hash, which is not `known`, and its content.

    Those over `KEPT` bytes are left out: they are in the source's id, and whoever replays needs them in their place.
    Raises Missing for one that has changed meanwhile.
    """
    for path, what in _read_manifest(source.manifest).items():
        mode, blob = what.decode().split(" ")
        file = root / os.fsdecode(path)
        if blob in known:
            continue
        try:
            if mode != "120000" and file.stat().st_size > KEPT:
                continue
            content = os.fsencode(file.readlink()) if mode == "120000" else file.read_bytes()
        except OSError as error:
            raise Missing(f"cannot read {file}: {error.strerror}") from error
        if _git_hash(b"blob", content) != blob:
            raise Missing(f"{file} has changed while it was being recorded; ask again")
        yield blob, content


def restore(tree: str, manifest: bytes, root: Path, target: Path, content: Callable[[str], bytes | None]) -> None:
    """Write the files of a recorded source into `target`, a folder that is made.

    They come from the git repository that `root` lies in, where it has the tree, else from `content`, which gives a file
    by git's hash of it. Raises Missing where neither has it.
    """
    target.mkdir(parents=True)
    plain = tree.removeprefix(SWHID)
    if any((folder / ".git").exists() for folder in (root, *root.parents)) and _Git(root).has(plain):
        _checkout(root, plain, manifest, target)
        return
    for path, what in _read_manifest(manifest).items():
        mode, blob = what.decode().split(" ")
        file = target / os.fsdecode(path)
        found = None if mode == "160000" else content(blob)
        if found is None or _git_hash(b"blob", found) != blob:
            raise Missing(f"the source's file {os.fsdecode(path)!r} is neither in git at {root} nor in the store")
        file.parent.mkdir(parents=True, exist_ok=True)
        if mode == "120000":
            file.symlink_to(os.fsdecode(found))
        else:
            file.write_bytes(found)
            file.chmod(0o755 if mode == "100755" else 0o644)


def _checkout(root: Path, tree: str, manifest: bytes, target: Path) -> None:
    """Let git write a tree, and those of the repositories inside it."""
    git = _Git(root)
    with tempfile.TemporaryDirectory(prefix="sierra-") as scratch:
        index = Path(scratch, "index")
        git("read-tree", tree, index=index, at_top=True)
        git("checkout-index", "--all", f"--prefix={target}/", index=index, at_top=True)
    for path, what in _read_manifest(manifest).items():
        mode, blob = what.decode().split(" ")
        if mode == "160000":
            inside = root / os.fsdecode(path)
            if not (inside / ".git").exists() or not _Git(inside).has(blob):
                raise Missing(f"the submodule {os.fsdecode(path)!r} does not have {blob[:12]}; fetch it (git submodule update)")
            _checkout(
                inside,
                blob,
                _Git(inside)("ls-tree", "-r", "-z", "--format=%(objectmode) %(objectname)%x09%(path)", blob),
                target / os.fsdecode(path),
            )


def paths(manifest: bytes) -> set[bytes]:
    """The paths in a manifest."""
    return set(_read_manifest(manifest))


def is_there(root: Path, tree: str) -> bool:
    """Whether the git repository that `root` lies in has a recorded tree."""
    held = any((folder / ".git").exists() for folder in (root, *root.parents))
    return held and _Git(root).has(tree.removeprefix(SWHID))


def blobs(manifest: bytes) -> set[str]:
    """Git's hashes of the files in a manifest."""
    return {what.decode("ascii", "replace").partition(" ")[2] for what in _read_manifest(manifest).values()}


def tree_of(manifest: bytes) -> str | None:
    """The id of the tree that a list of files gives; None where it cannot be told: by hashes that are no SHA-1."""
    entries = []
    for path, what in _read_manifest(manifest).items():
        mode, _, blob = what.decode("ascii", "replace").partition(" ")
        if len(blob) != 40:
            return None
        entries.append(Entry(mode, blob, path))
    return SWHID + tree_hash(entries)


def tree_hash(entries: Sequence[Entry]) -> str:
    """The hash that git gives to a tree with these files."""
    below: dict[bytes, list[Entry]] = {}
    items: list[tuple[bytes, str, bytes, str]] = []
    for entry in entries:
        name, slash, rest = entry.path.partition(b"/")
        if slash:
            below.setdefault(name, []).append(Entry(entry.mode, entry.blob, rest))
        else:
            items.append((name, entry.mode, name, entry.blob))
    items += [(name + b"/", "40000", name, tree_hash(inside)) for name, inside in below.items()]
    content = b"".join(mode.encode() + b" " + name + b"\0" + bytes.fromhex(blob) for _, mode, name, blob in sorted(items))
    return _git_hash(b"tree", content)


class _Chosen:
    """Which paths count."""

    def __init__(self, only: Sequence[bytes], without: Sequence[bytes]) -> None:
        self._only = [path for path in only if path != b"."]
        self._without = without

    def never(self, path: bytes) -> bool:
        """Whether a file, or all of a folder, is left out."""
        return any(path == left or path.startswith(left + b"/") for left in self._without)

    def pathspecs(self) -> list[str]:
        """What git is told to leave out: patterns, since it stops where a path that is named plainly is ignored."""
        patterns = ["\\" + re.sub(r"(?<!^)[\\*?\[]", r"\\\g<0>", os.fsdecode(path)) for path in self._without]
        return [f":(exclude,glob){pattern}{below}" for pattern in patterns for below in ("", "/**")]

    def __call__(self, path: bytes) -> bool:
        if self.never(path):
            return False
        return not self._only or any(path == kept or path.startswith(kept + b"/") for kept in self._only)


def _walk(root: Path, wanted: _Chosen) -> Iterator[Entry]:
    pending = [(os.fsencode(root), b"")]
    while pending:
        folder, prefix = pending.pop()
        with os.scandir(folder) as entries:
            for entry in entries:
                path = prefix + entry.name
                if wanted.never(path):
                    continue
                if entry.is_dir(follow_symlinks=False):
                    if os.fsdecode(entry.name) not in LEFT_OUT:
                        pending.append((entry.path, path + b"/"))
                elif not entry.name.endswith(b".pyc") and wanted(path):
                    yield from _entry(entry, path)


def _entry(entry: os.DirEntry[bytes], path: bytes) -> Iterator[Entry]:
    status = entry.stat(follow_symlinks=False)
    if stat.S_ISLNK(status.st_mode):
        yield Entry("120000", _git_hash(b"blob", os.readlink(entry.path)), path)  # noqa: PTH115 - bytes
    elif stat.S_ISREG(status.st_mode):
        mode = "100755" if status.st_mode & 0o100 else "100644"
        yield Entry(mode, _git_hash(b"blob", Path(os.fsdecode(entry.path)).read_bytes()), path)


def _git_hash(kind: bytes, content: bytes) -> str:
    return hashlib.sha1(kind + b" " + str(len(content)).encode() + b"\0" + content, usedforsecurity=False).hexdigest()


def _manifest(entries: Iterable[Entry]) -> bytes:
    ordered = sorted(entries, key=lambda entry: entry.path)
    return b"".join(b"%s %s\t%s\0" % (e.mode.encode(), e.blob.encode(), e.path) for e in ordered)


def _read_manifest(manifest: bytes) -> dict[bytes, bytes]:
    lines = (line.partition(b"\t") for line in manifest.split(b"\0") if line)
    return {path: what for what, _, path in lines}


def _git(root: Path, wanted: _Chosen) -> tuple[Source, list[Entry]]:
    git = _Git(root)
    state = git("status", "--porcelain=v2", "--branch", "-z", "--untracked-files=normal", "--", ".").split(b"\0")
    commit, branch, dirty = _state(state, git.prefix(), wanted)
    with tempfile.TemporaryDirectory(prefix="sierra-") as scratch:
        index = Path(scratch, "index")
        own = root / os.fsdecode(git("rev-parse", "--git-path", "index").strip())
        if own.exists():
            shutil.copy2(own, index)
        git("add", "--all", "--", ".", *wanted.pathspecs(), index=index)
        listed = git("ls-files", "--stage", "-z", index=index)
        entries = [_with_changes(root, entry) for entry in _staged(listed) if wanted(entry.path)]
        second = Path(scratch, "chosen")
        lines = b"".join(b"%s %s\t%s\0" % (e.mode.encode(), e.blob.encode(), e.path) for e in entries)
        git("update-index", "-z", "--index-info", index=second, given=lines, at_top=True)
        tree = git("write-tree", index=second).decode().strip()
    git("update-ref", f"refs/sierra/{tree}", tree)
    remote = _without_credentials(git("config", "--get", "remote.origin.url", optional=True).decode().strip())
    return Source(SWHID + tree, "git", commit, branch, dirty, remote or None, _manifest(entries)), entries


def _with_changes(root: Path, entry: Entry) -> Entry:
    """A repository inside counts by its commit, as in git; where its files differ from that, by the tree that they are."""
    inside = root / os.fsdecode(entry.path)
    if entry.mode != "160000" or not (inside / ".git").exists():
        return entry
    source, _ = _git(inside, _Chosen([], []))
    return Entry(entry.mode, source.tree.removeprefix(SWHID), entry.path) if source.dirty else entry


def _staged(listed: bytes) -> Iterator[Entry]:
    for line in listed.split(b"\0"):
        if line:
            what, _, path = line.partition(b"\t")
            mode, blob, _ = what.decode().split(" ")
            yield Entry(mode, blob, path)


def _state(lines: Sequence[bytes], prefix: bytes, wanted: _Chosen) -> tuple[str | None, str | None, bool]:
    """Commit, branch, and whether a file that counts differs from the commit."""
    commit = branch = None
    dirty = False
    for line in lines:
        if line.startswith(b"# branch.oid ") and not line.endswith(b"(initial)"):
            commit = line.split(b" ")[2].decode()
        elif line.startswith(b"# branch.head ") and not line.endswith(b"(detached)"):
            branch = line.split(b" ", 2)[2].decode("utf-8", "replace")
        elif line[:2] in (b"1 ", b"2 ", b"u ", b"? "):
            fields = {b"1": 8, b"2": 9, b"u": 10, b"?": 1}[line[:1]]
            path = line.split(b" ", fields)[fields].removeprefix(prefix)
            dirty = dirty or wanted(path.rstrip(b"/"))
    return commit, branch, dirty


def _without_credentials(address: str) -> str:
    return re.sub(r"(?<=://)[^/]*@", "", address).partition("?")[0]


class _Git:
    """Git in one folder; never asks, never locks, says its errors in one line."""

    def __init__(self, root: Path) -> None:
        self._root = root
        self._program = shutil.which("git")
        if self._program is None:
            raise Missing(f"{root} is in a git repository, but git is not installed; install it")

    def prefix(self) -> bytes:
        """The project's folder as the repository sees it, with a slash at its end (or empty)."""
        return self("rev-parse", "--show-prefix").strip()

    def has(self, thing: str) -> bool:
        """Whether the repository has a tree or a commit."""
        return bool(self("rev-parse", "--verify", "--quiet", f"{thing}^{{tree}}", optional=True))

    def ignores_it(self) -> bool:
        """Whether the repository ignores this whole folder."""
        return bool(self("check-ignore", ".", optional=True).strip())

    def __call__(
        self, *arguments: str, index: Path | None = None, given: bytes = b"", optional: bool = False, at_top: bool = False
    ) -> bytes:
        environment = {
            name: value for name, value in os.environ.items() if not name.startswith("GIT_") or name == "GIT_CONFIG_GLOBAL"
        }
        environment |= {"GIT_OPTIONAL_LOCKS": "0", "GIT_TERMINAL_PROMPT": "0", "LC_ALL": "C"}
        if index is not None:
            environment["GIT_INDEX_FILE"] = str(index)
        cwd = self._top() if at_top else self._root
        done = subprocess.run(
            [str(self._program), *arguments], cwd=cwd, env=environment, input=given, capture_output=True, check=False
        )
        if done.returncode and not optional:
            complaint = done.stderr.decode("utf-8", "replace").strip().splitlines() or ["no reason given"]
            raise Missing(f"git {arguments[0]} in {self._root}: {complaint[0].removeprefix('fatal: ')}")
        return done.stdout

    def _top(self) -> Path:
        return Path(os.fsdecode(self("rev-parse", "--show-toplevel").rstrip(b"\n")))
