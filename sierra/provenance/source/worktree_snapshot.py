"""Snapshots of a repository's working tree as a git tree: the current files, tracked or untracked, but not ignored ones.

Nothing of the user's is changed. Git works on SIERRA's own index, `<git dir>/sierra/<key>.index`, which starts with the files
of the user's index. It is kept, so that the next time git reads only files whose times or sizes have changed. Each snapshot
works on a copy of it, and renames the copy into its place at the end. Two snapshots at the same time do not wait for each
other; the last one wins. An index has files as git converted them when it read them. Therefore the settings and attributes of
that time are kept beside it, and if others apply to a file now, all files are read again. If git cannot read the index, it is
discarded and starts from the user's index again, or from the commit's files if the user's index is damaged too.

*The files on disk are recorded*, because they are what executes. An index can tell git not to check a file
(assume-unchanged, skip-worktree); these marks are removed. A file that a sparse checkout leaves out is not in the tree, and
neither is a submodule that is not initialised, but they do not make the tree dirty. *The content is what git would commit*:
clean filters and line endings apply as the repository defines them, so that a clean checkout gives the commit's tree on every
machine. Therefore a file that is still a pointer of git-lfs is an error: it would be recorded as if it were its data.

One `git status` reports how commit, index and files differ, and which files are untracked. Then git gets the exact list of
files to read. Git writes one object file per file, which takes 3 to 8 s for 50,000 small files. They are written to one pack
through `git fast-import` instead (0.6 s). When git reads them again for the index, it finds them all there (0.3 s). The total
is 1.6 s, or 0.3 s if nothing has changed. (On two cores: `make bench`. Git's own option for writing a pack,
core.bigFileThreshold, compares each file with all others. Git's untracked cache would save another 0.03 s, but it is not safe
on all file systems.)
"""

from __future__ import annotations

import contextlib
import os
import shutil
import stat
import time
from collections.abc import Iterable, Iterator, Sequence, Set
from functools import cached_property
from hashlib import sha256
from pathlib import Path
from typing import NamedTuple
from uuid import uuid4

from sierra.errors import ConfigError, Missing
from sierra.provenance.source import converted, lfs, manifest
from sierra.provenance.source.git import Git
from sierra.provenance.source.manifest import Files, repositories, written
from sierra.provenance.source.selection import PathSelection, check_size
from sierra.util.fs import read_sealed, write_whole
from sierra.util.hashing import sealed
from sierra.util.lazy_definitions import dataclass, field
from sierra.util.regular_files import read_regular

MANY = 500
"""Minimum number of new files that are written as a pack."""
SMALL = 1 << 16
ABANDONED_S = 3600
TICK_NS = 2_000_000_000
"""The coarsest clock of a file system."""
RULES = ".rules"
"""The suffix of the file with the rules by which the files of an index were converted."""
CHECKSUM = 20
"""The length of the checksum of an index in front of the rules, so that they are never those of another index."""
IGNORE_IT = "list it in .gitignore"
STATUS = (
    *("-c", "core.sparseCheckout=false", "status", "--porcelain=v2", "--branch", "-z"),
    *("--untracked-files=all", "--ignore-submodules=none", "--no-renames", "--no-ahead-behind", "--"),
)


@dataclass(frozen=True, slots=True)
class WorktreeState:
    """The state of a working tree at one time."""

    tree: str
    files: dict[bytes, bytes]
    commit: str | None
    branch: str | None
    changed: tuple[bytes, ...]
    """Paths that differ from the commit; empty if there is no commit."""
    absent: tuple[bytes, ...]
    """Paths of the commit that are missing because of a sparse checkout or a submodule that is not initialised."""
    submodules: dict[str, str]
    """The commit that is checked out in each nested repository, at any depth, by path."""
    converted: dict[bytes, str]
    """See `sierra.provenance.source.converted`: the SHA-256 of files that git would restore with other bytes."""
    since: int
    """A time before the files were read, by the clock of the repository's file system, in nanoseconds."""


@dataclass(slots=True)
class Status:
    """The output of `git status` for files of the source; `recorded` has the commit's entries of the files that differ."""

    commit: str | None = None
    branch: str | None = None
    recorded: dict[bytes, bytes | None] = field(default_factory=dict)
    stale: list[bytes] = field(default_factory=list)
    """Files whose current state is not in the index."""
    inner: set[bytes] = field(default_factory=set)
    """Nested repositories that have changes of their own."""
    conflicts: set[bytes] = field(default_factory=set)


def record(git: Git, chosen: PathSelection, large: int) -> WorktreeState:
    """Write the working tree of the project as a git tree, and protect it from being pruned.

    Raises ConfigError for an untracked file of more than `large` bytes, and Missing if git fails.
    """
    with _index(git, chosen) as index:
        state = _write_tree(git, index, chosen, large)
        if not state.agrees():
            index.start_from_commit()
            state = _write_tree(git, index, chosen, large)
        if not state.agrees():
            raise Missing(f"git in {git.root} writes another tree than its index lists; try another version of git")
    status, tree, files, submodules, lossy = state
    if not _is_protected(git, tree):
        git("update-ref", f"refs/sierra/{tree}", tree)
    recorded = {**dict.fromkeys(status.stale), **status.recorded} if status.commit else {}
    doubtful = status.inner | status.conflicts
    differing = {path for path, what in recorded.items() if files.get(path) != what or path in doubtful}
    return _state(status, tree, files, differing, _absent(git, status, differing), submodules, lossy, index.since)


class _Written(NamedTuple):
    """A tree that git wrote from an index, and what the index listed."""

    status: Status
    tree: str
    files: dict[bytes, bytes]
    submodules: dict[str, str]
    converted: dict[bytes, str]

    def agrees(self) -> bool:
        """Return True if the tree has exactly the listed files. Git has been seen to write others from a damaged index."""
        return manifest.tree_hash(self.files) == self.tree


def _write_tree(git: Git, index: _Index, chosen: PathSelection, large: int) -> _Written:
    root = git.root
    status, files = _read_all(root, index, chosen, large)
    rules = converted.rules(git, files, index.path)
    if not index.was_read_by(rules, files, status):
        index.start_from_users()
        status, files = _read_all(root, index, chosen, large)
        rules = converted.rules(git, files, index.path)
        index.was_read_by(rules, files, status)
    lfs.check(git, index.path, files)
    for path, _ in repositories(files):
        lfs.check_all(Git(root / os.fsdecode(path)))
    submodules = dict(_submodules(root, files))
    lossy = converted.find(git, files, index.path, rules)
    inner = {
        path: record(Git(root / os.fsdecode(path)), PathSelection(), large) for path in sorted(status.inner & files.keys())
    }
    for path, snapshot in inner.items():
        files[path] = b"160000 " + snapshot.tree.encode()
        submodules |= {f"{os.fsdecode(path)}/{below}": commit for below, commit in snapshot.submodules.items()}
        lossy |= {path + b"/" + below: digest for below, digest in snapshot.converted.items()}
    lossy |= _converted_in_submodules(root, submodules, inner.keys())
    tree = manifest.tree_hash(files)
    if not _is_protected(git, tree):
        tree = write(git, files) if inner else index.write_tree()
    return _Written(status, tree, files, submodules, lossy)


def _is_protected(git: Git, tree: str) -> bool:
    """Return whether an earlier snapshot has written this tree, and protects it still; if in doubt, it is written again."""
    ref = git.common_folder / "refs" / "sierra" / tree
    return read_regular(ref) == f"{tree}\n".encode() if ref.is_file() else False


def _read_all(root: Path, index: _Index, chosen: PathSelection, large: int) -> tuple[Status, dict[bytes, bytes]]:
    """Read the stale files into the index until it has exactly the files of the source; return the status and the files."""
    status = index.status()
    files = index.update(status, large)
    while unfit := [*chosen.others(files), *_hollow(root, files), *index.ignored(files)]:
        index.remove(unfit)
        status = index.status()
        files = index.update(status, large)
    return status, files


def _converted_in_submodules(root: Path, submodules: Iterable[str], known: Iterable[bytes]) -> dict[bytes, str]:
    """Return the converted files of nested repositories, except of those that are `known` or in one that is."""
    converted_files = {}
    for name in submodules:
        path = os.fsencode(name)
        if (root / name / ".git").exists() and not any(path == outer or path.startswith(outer + b"/") for outer in known):
            inside = Git(root / name)
            listed = manifest.read(inside("ls-files", "--stage", "-z"))
            files = {below: what[:-2] for below, what in listed.items()}
            converted_files.update({path + b"/" + below: digest for below, digest in converted.find(inside, files).items()})
    return converted_files


def describe_commit(git: Git, chosen: PathSelection) -> WorktreeState:
    """Return the tree of the commit that is checked out, and the paths that differ from it.

    No file of the working tree is written to git. Raises ConfigError if there is no commit.
    """
    root = git.root
    with _index(git, chosen) as index:
        status = index.status()
        if not index.was_read_by(converted.rules(git, files := index.files(), index.path), files, status):
            index.start_from_users()
            status = index.status()
        if status.commit is None:
            raise ConfigError(f'[source] dirty = "ignore": the repository of {root} has no commit yet; commit something first')
        files = {path: what for path, what in of_tree(git, status.commit).items() if chosen(path)}
        lossy = converted.find(git, files, index.path)
    tree = write(git, files)
    git("update-ref", f"refs/sierra/{tree}", tree)
    differing = status.recorded.keys() | set(status.stale)
    absent = _absent(git, status, differing) | set(_hollow(root, files))
    submodules = dict(_submodules(root, files))
    lossy |= _converted_in_submodules(root, submodules, ())
    return _state(status, tree, files, differing, absent, submodules, lossy, index.since)


def _state(
    status: Status,
    tree: str,
    files: dict[bytes, bytes],
    differing: Set[bytes],
    absent: Set[bytes],
    submodules: dict[str, str],
    lossy: dict[bytes, str],
    since: int,
) -> WorktreeState:
    changed, lacking = tuple(sorted(differing - absent)), tuple(sorted(absent))
    return WorktreeState(tree, files, status.commit, status.branch, changed, lacking, submodules, lossy, since)


def write(git: Git, files: dict[bytes, bytes]) -> str:
    """Write the tree of these files, whose contents the repository has, and return its hash."""
    with _scratch(git) as (path, _):
        _add_listed(git, path, written(files))
        return git("write-tree", "--missing-ok", index=path).decode().strip()


def _add_listed(git: Git, index: Path, listing: bytes) -> None:
    """Add files to an index, which is made if there is none; `listing` is as git writes it, with paths from the top."""
    git("update-index", "-z", "--index-info", index=index, given=listing, at_top=True)


def of_tree(git: Git, tree: str) -> dict[bytes, bytes]:
    """Return the files of a tree or a commit that lie below the project."""
    return manifest.of_ls_tree(git("ls-tree", "-r", "-z", tree))


class _Index:
    """SIERRA's own index while a snapshot works on it."""

    def __init__(self, git: Git, chosen: PathSelection, path: Path, kept: Path, since: int) -> None:
        self.path = path
        self.since = since
        """A time before git read any file, by the file system's clock, in nanoseconds."""
        self._git = git
        self._chosen = chosen
        self._kept = kept
        self._read_by: bytes | None = None
        """The rules by which the files of a kept index were converted; empty if they are unknown, None for a new index."""
        self._rules = b""

    def status(self) -> Status:
        """Return how commit, index and files differ, based on the most recent index that git can read."""
        if self.path.exists():
            return self._status()
        for copy in (self._copy_kept, self._copy_users):
            with contextlib.suppress(Missing, FileNotFoundError):
                copy()
                return self._status()
            self.path.unlink(missing_ok=True)
        self.start_from_commit()
        return self._status()

    def start_from_users(self) -> None:
        """Discard the kept index, so that the next status reads all files again."""
        self._kept.unlink(missing_ok=True)
        self.path.unlink(missing_ok=True)

    def start_from_commit(self) -> None:
        """Replace the index by one with the commit's files; an empty one if there is no commit."""
        self._read_by = None
        self.path.unlink(missing_ok=True)
        self._git("read-tree", "--empty" if self._git.head() is None else "HEAD", index=self.path, at_top=True)

    def _copy_kept(self) -> None:
        shutil.copy2(self._kept, self.path)  # with its time: git uses it to decide which files to read again
        self._read_by = b""
        known = read_sealed(self._kept.with_suffix(RULES))
        with contextlib.suppress(OSError):  # of a damaged index, which git itself refuses
            if known.startswith(_checksum(self.path)):
                self._read_by = known[CHECKSUM:]

    def _copy_users(self) -> None:
        """Start with the files of the user's index, but without its times and marks.

        Git reads all files again, by its present rules. The user's index may have files that were read by earlier ones.
        """
        if not self._git.index.exists():
            raise FileNotFoundError(self._git.index)
        self._read_by = None
        lines = self._git("ls-files", "--stage", "-z", at_top=True).split(b"\0")[:-1]
        marked = self._git("ls-files", "-t", "-z", "--", ":(glob)**/.gitattributes", at_top=True).split(b"\0")
        gone = {line[2:] for line in marked if line[:1] == b"H" and _lstat(self._git.top, line[2:]) is None}
        kept = [line + b"\0" for line in lines if line.partition(b"\t")[2] not in gone]  # git would apply those of the index
        _add_listed(self._git, self.path, b"".join(kept))
        self._git("update-index", "-q", "--refresh", index=self.path, optional=True)

    def was_read_by(self, rules: converted.Rules, files: Files, status: Status) -> bool:
        """Return True if the files, except the stale ones, were converted by these rules, and remember the rules."""
        before = self._read_by
        if before and rules.are(before):
            self._rules = before
            return True
        self._rules = rules.kept()
        return before is None or (before != b"" and not rules.differ(before, files, set(status.stale)))

    def keep(self) -> None:
        """Keep the index, and the rules by which its files were converted, for the next time."""
        with contextlib.suppress(OSError):
            rules = _checksum(self.path) + self._rules
            self.path.replace(self._kept)
            write_whole(self._kept.with_suffix(RULES), sealed(rules))

    def _status(self) -> Status:
        output = self._git(*STATUS, *self._chosen.pathspecs(), index=self.path)
        return _read_status(output.split(b"\0"), self._git.prefix, self._chosen)

    def update(self, status: Status, large: int) -> dict[bytes, bytes]:
        """Read the stale files into the index, and return all files in the index."""
        sizes, inner, gone = self._kinds(status.stale)
        self._refuse_large(sizes, large)
        self.remove(gone)
        if len(sizes) >= MANY:
            _write_pack(self._git, [path for path, size in sizes.items() if size <= SMALL])
        self._update_index("--add", list(sizes), "--remove", "--replace")
        self._add_repositories(inner)
        return self.files()

    def files(self) -> dict[bytes, bytes]:
        """Return all files in the index."""
        listing = self._git("ls-files", "--stage", "-z", index=self.path)
        return {path: what[:-2] for path, what in manifest.read(listing).items()}

    def _kinds(self, paths: Iterable[bytes]) -> tuple[dict[bytes, int], list[bytes], list[bytes]]:
        """Return the files with their sizes, the nested repositories, and all paths that are missing or of another kind."""
        sizes: dict[bytes, int] = {}
        inner: list[bytes] = []
        gone: list[bytes] = []
        for path in paths:
            status = _lstat(self._git.root, path)
            kind = stat.S_IFMT(status.st_mode) if status else None
            if status and kind in (stat.S_IFREG, stat.S_IFLNK):
                sizes[path] = status.st_size
            else:
                (inner if kind == stat.S_IFDIR else gone).append(path)
        return sizes, inner, gone

    def _refuse_large(self, sizes: dict[bytes, int], large: int) -> None:
        """Raise ConfigError for a large file that the user does not track (see `tracked`); drop those that are ignored now."""
        huge = [path for path, size in sizes.items() if size > large and path not in self.tracked]
        for path in self.ignored(huge):
            del sizes[path]
        for path in huge:
            if path in sizes:
                check_size(path, sizes[path], large, IGNORE_IT)

    @cached_property
    def tracked(self) -> set[bytes]:
        """The files of the user's index, or of the commit if the index cannot be read."""
        listing = self._git("ls-files", "-z", optional=True)
        if not listing and (commit := self._git.head()):
            return set(of_tree(self._git, commit))
        return set(listing.split(b"\0"))

    def ignored(self, files: Iterable[bytes]) -> list[bytes]:
        """Return the untracked files among these that git ignores now, although an earlier index contains them."""
        untracked = [path for path in files if path not in self.tracked]
        if not untracked:
            return []
        output = self._git("check-ignore", "--no-index", "--stdin", "-z", given=b"\0".join(untracked) + b"\0", none=1)
        return output.split(b"\0")[:-1]

    def _add_repositories(self, paths: Sequence[bytes]) -> None:
        lines = []
        for path in paths:
            inside = Git(self._git.root / os.fsdecode(path))
            commit = inside.head()
            if commit is None:
                raise Missing(f"{inside.root} is a repository without a commit inside another; commit there, or ignore it here")
            lines.append(b"160000 %s\t%s%s\0" % (commit.encode(), self._git.prefix, path))
        if lines:
            _add_listed(self._git, self.path, b"".join(lines))

    def remove(self, paths: Sequence[bytes]) -> None:
        self._update_index("--force-remove", paths)

    def write_tree(self) -> str:
        prefix = os.fsdecode(self._git.prefix)
        if prefix and not self._git("ls-files", "-z", index=self.path):
            return write(self._git, {})
        options = [f"--prefix={prefix}"] if prefix else []
        return self._git("write-tree", "--missing-ok", *options, index=self.path).decode().strip()

    def _update_index(self, what: str, paths: Sequence[bytes], *more: str) -> None:
        if paths:
            given = b"".join([path + b"\0" for path in paths])
            self._git(
                "-c", "core.sparseCheckout=false", "update-index", what, *more, "-z", "--stdin",
                index=self.path, given=given,
            )  # fmt: skip


@contextlib.contextmanager
def _index(git: Git, chosen: PathSelection) -> Iterator[_Index]:
    """Yield an index to work on; it is kept for the next time unless something fails."""
    key = sha256(b"\0".join((git.prefix, *chosen.only))).hexdigest()[:16]
    with _scratch(git) as (path, now):
        kept = path.with_name(f"{key}.index")
        index = _Index(git, chosen, path, kept, now - TICK_NS)
        yield index
        index.keep()


def _checksum(index: Path) -> bytes:
    """Return the checksum at the end of an index: its last 20 bytes, also of a longer one."""
    with index.open("rb") as file:
        file.seek(-CHECKSUM, os.SEEK_END)
        return file.read()


@contextlib.contextmanager
def _scratch(git: Git) -> Iterator[tuple[Path, int]]:
    """Yield a path for a temporary index and the file system's time; remove the index afterwards, and of killed processes."""
    folder = git.folder / "sierra"
    try:
        folder.mkdir(exist_ok=True)
        for old in folder.glob("*.tmp*"):
            with contextlib.suppress(FileNotFoundError):  # another process has removed its own
                if old.stat().st_mtime < time.time() - ABANDONED_S:
                    old.unlink()
        path = folder / f"{uuid4().hex}.tmp"
        path.touch()
        now = path.stat().st_mtime_ns
        path.unlink()
    except FileNotFoundError:
        raise Missing(f"the repository {git.folder} no longer exists; run the command again") from None
    except OSError as error:
        raise Missing(
            f"cannot write to {folder}: {error.strerror}; SIERRA stores the source in the repository, so make it writable"
        ) from error
    try:
        yield path, now
    finally:
        for left in (path, path.with_name(path.name + ".lock")):
            with contextlib.suppress(OSError):
                left.unlink()


def _read_status(lines: Sequence[bytes], prefix: bytes, chosen: PathSelection) -> Status:
    """Parse the output of `git status --porcelain=v2 --branch -z`, as specified in its manual."""
    status = Status()
    for line in lines:
        kind = line[:2]
        if line.startswith(b"# branch.oid ") and not line.endswith(b"(initial)"):
            status.commit = line.split(b" ")[2].decode()
        elif line.startswith(b"# branch.head ") and not line.endswith(b"(detached)"):
            status.branch = line.split(b" ", 2)[2].decode("utf-8", "replace")
        elif kind in (b"1 ", b"u ", b"? "):
            fields = line.split(b" ", {b"1 ": 8, b"u ": 10, b"? ": 1}[kind])
            path = fields[-1].removeprefix(prefix).rstrip(b"/")
            if chosen(path):
                _note(status, kind, fields, path)
    return status


def _note(status: Status, kind: bytes, fields: Sequence[bytes], path: bytes) -> None:
    if kind == b"u ":
        status.conflicts.add(path)
    if kind == b"1 ":
        status.recorded[path] = None if fields[3] == b"000000" else b"%s %s" % (fields[3], fields[6])
        if fields[2][:1] == b"S" and fields[2][2:] != b"..":
            status.inner.add(path)
    if kind != b"1 " or fields[1][1:] != b".":
        status.stale.append(path)


def _absent(git: Git, status: Status, differing: set[bytes]) -> set[bytes]:
    """Return the paths among them that are only not checked out."""
    recorded = {path: what for path in differing if (what := status.recorded.get(path))}
    absent = set(_hollow(git.root, recorded))
    lost = {path for path in recorded if _lstat(git.root, path) is None}
    if lost and git("config", "--get", "core.sparseCheckout", optional=True).strip() == b"true":
        marked = git("ls-files", "-t", "-z", optional=True).split(b"\0")
        absent |= {line[2:] for line in marked if line[:1] == b"S"} & lost
    return absent


def _hollow(root: Path, files: Files) -> list[bytes]:
    """Return the submodules that are not checked out."""
    return [path for path, _ in repositories(files) if not (root / os.fsdecode(path) / ".git").exists()]


def _submodules(root: Path, files: dict[bytes, bytes]) -> Iterator[tuple[str, str]]:
    for path, commit in repositories(files):
        name = os.fsdecode(path)
        yield name.encode("utf-8", "replace").decode(), commit
        if (root / name / ".gitmodules").is_file() and (inside := Git(root / name)).has(commit):
            yield from ((f"{name}/{below}", at) for below, at in _submodules(root / name, of_tree(inside, commit)))


def _write_pack(git: Git, paths: Iterable[bytes]) -> None:
    """Write small files to one pack, unchanged. This only saves time, so errors are ignored."""
    with contextlib.suppress(OSError), git.pipe("-c", "core.compression=1", "fast-import", "--quiet", "--depth=0") as importer:
        assert importer.stdin is not None  # noqa: S101 - it is a pipe
        for path in paths:
            with contextlib.suppress(FileNotFoundError, PermissionError):
                whole = os.path.join(os.fsencode(git.root), path)  # noqa: PTH118 - bytes
                content = os.fsencode(os.readlink(whole)) if os.path.islink(whole) else _content(whole)  # noqa: PTH114, PTH115
                importer.stdin.write(b"blob\ndata %d\n%b\n" % (len(content), content))


def _content(path: bytes) -> bytes:
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_NOFOLLOW)
    try:
        return os.read(descriptor, SMALL + 1)
    finally:
        os.close(descriptor)


def _lstat(root: Path, path: bytes) -> os.stat_result | None:
    try:
        return os.lstat(os.path.join(os.fsencode(root), path))  # noqa: PTH118 - bytes
    except OSError:
        return None
