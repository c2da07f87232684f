"""A package: a zip with fixed times, names in order and a manifest, or its extracted folder; it is read without trust.

Zip, because every system opens it, and single members can be read. Members whose content is compressed already are stored as
they are. The manifest comes last, when all hashes are known.

A package may come from anybody: see `Opened` for the checks.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import zipfile
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import IO, Protocol

from sierra.errors import Damaged, Missing, UsageError
from sierra.packages import members
from sierra.packages.layout import SIERRA
from sierra.packages.members import MANIFEST
from sierra.store.segments import disk_errors
from sierra.util.fs import inside, unfinished_beside
from sierra.util.hashing import CHUNK
from sierra.util.regular_files import open_regular
from sierra.worker import reproduce

MADE = (1980, 1, 1, 0, 0, 0)
"""The time of all members: the earliest that zip can express."""
STORED = (
    ".parquet",
    ".sif",
    ".sqfs",
    ".zst",
    ".gz",
    ".xz",
    ".bz2",
    ".zip",
    ".whl",
    ".png",
    ".jpg",
    ".pdf",
    ".mp4",
    ".webm",
    ".bundle",
)
"""Endings of files that are compressed already."""
LEVEL = 6
LARGEST_PLAIN = zipfile.ZIP64_LIMIT - (1 << 20)
"""The largest number of bytes of a member in the plain form of zip, of which versions of Python write the same bytes.

They write other versions into a member in the form for large files. A member may become a little larger when it is compressed.
"""
REGULAR = 0o100644
CREATED = reproduce.Folder.created
"""The folder for the results of an evaluator."""


class MemberData(Protocol):
    """The content of a member, which can be read once."""

    @property
    def size(self) -> int:
        """The number of bytes."""

    def open(self) -> IO[bytes]:
        """Return a binary stream from the beginning of the content."""


def write(path: Path, contents: Mapping[str, MemberData], executable: Iterable[str] = (), scratch: Path | None = None) -> str:
    """Write a package with these members; return its id. The file appears complete or not at all.

    `executable`: the names of programs. `scratch`: a folder of the same file system for the unfinished file. Raises Damaged for
    names that are not safe, Missing if the disk is full, UsageError if the file exists.
    """
    with refusals(path):
        reproduce.check_names([*contents, MANIFEST])
    check_new(path)
    programs = frozenset(executable)
    unfinished = scratch / path.name if scratch else unfinished_beside(path)
    with disk_errors(path.parent):
        try:
            with zipfile.ZipFile(unfinished, "x", allowZip64=True) as file:
                hashes = {name: _add(file, name, contents[name], executable=name in programs) for name in sorted(contents)}
                file.writestr(info(MANIFEST, _method(MANIFEST)), members.written(hashes))
            _name(unfinished, path)
        finally:
            unfinished.unlink(missing_ok=True)
    return members.package_id(hashes)


def check_new(path: Path) -> None:
    """Raise UsageError if the file exists."""
    if path.is_symlink() or path.exists():
        raise UsageError(f"{path} exists already; remove it, or choose another name")


def _name(unfinished: Path, path: Path) -> None:
    """Give a complete file its name, unless a file of that name has appeared meanwhile."""
    check_new(path)
    unfinished.rename(path)


def _add(file: zipfile.ZipFile, name: str, content: MemberData, *, executable: bool) -> str:
    digest = hashlib.sha256()
    member_info, large = info(name, _method(name), executable=executable), content.size > LARGEST_PLAIN
    with content.open() as source, file.open(member_info, "w", force_zip64=large) as member:
        while block := source.read(CHUNK):
            digest.update(block)
            member.write(block)
    return digest.hexdigest()


def _method(name: str) -> int:
    compressed = name.endswith(STORED) and not name.startswith(SIERRA)
    return zipfile.ZIP_STORED if compressed else zipfile.ZIP_DEFLATED


def info(name: str, method: int, *, executable: bool = False) -> zipfile.ZipInfo:
    """Return the description of a member, which depends on no time and no system."""
    made = zipfile.ZipInfo(name, MADE)
    made.create_system = 3  # Unix, whatever the system is
    made.external_attr = (reproduce.EXECUTABLE if executable else REGULAR) << 16
    made.compress_type = method
    made._compresslevel = LEVEL  # type: ignore[attr-defined]  # the public argument exists for `writestr` only
    return made


@contextmanager
def refusals(path: Path) -> Iterator[None]:
    """Raise Missing or Damaged, with the path of the package, where `reproduce` refuses it."""
    try:
        yield
    except reproduce.Stop as refused:
        reason = reproduce.clean(refused)
        kind = Damaged if refused.status == 1 else Missing
        raise kind(reason if str(path) in reason else f"{path}: {reason}") from refused


class Opened:
    """A package that is read: nothing of it is executed. The checks are those of `reproduce`.

    When it is opened, the list of members is checked: safe names (see `sierra.packages.members`), regular files only, no member
    twice, exactly the members of the manifest, and, in a zip, methods that SIERRA writes and no password. The content of a
    member is checked when it is read: no more bytes than a zip says, and the SHA-256 of the manifest.
    """

    def __init__(self, path: Path, package: reproduce.Zip | _Folder) -> None:
        """Raises Missing if a file cannot be read, Damaged unless the members are those of the manifest."""
        self.path = path
        self._package = package
        with refusals(path):
            checked = reproduce.listed(package)
            for fault in checked.faults:
                raise reproduce.damaged(fault)
        self.hashes: Mapping[str, str] = checked.hashes
        """The SHA-256 of all members by name, as the manifest lists them."""

    def size(self, name: str) -> int:
        """Return the number of bytes of a member."""
        with refusals(self.path):
            return self._package.size(name)

    def _blocks(self, name: str) -> Iterator[bytes]:
        """Yield the content of a member, whatever the manifest says."""
        with refusals(self.path):
            yield from self._package.blocks(name)

    @property
    def id(self) -> str:
        """The identity of the package."""
        return members.package_id(self.hashes)

    def names(self, folder: str = "") -> list[str]:
        """Return the names of all members in a folder (`results/`), in order."""
        return [name for name in sorted(self.hashes) if name.startswith(folder)]

    def blocks(self, name: str) -> Iterator[bytes]:
        """Yield the content of a member. Raises Damaged at the end if it is not that of the manifest."""
        digest = hashlib.sha256()
        for block in self._blocks(name):
            digest.update(block)
            yield block
        if digest.hexdigest() != self.hashes[name]:
            raise Damaged(f"{self.path}: member {name!r} is not what {MANIFEST} says (SHA-256 {digest.hexdigest()[:10]})")

    def read(self, name: str, most: int = 64 << 20) -> bytes:
        """Return the checked content of a member. Raises Damaged if it is larger than `most` bytes, or not there."""
        if name not in self.hashes:
            raise Damaged(f"{self.path} has no member {name!r}")
        if self.size(name) > most:
            raise Damaged(f"{self.path}: member {name!r} has {self.size(name):,} bytes, but at most {most:,} are expected")
        return b"".join(self.blocks(name))

    def verify(self) -> None:
        """Read all members. Raises Damaged for the first one that is not what the manifest says."""
        for name in self.names():
            for _ in self.blocks(name):
                pass

    def extract(self, names: Iterable[str], folder: Path) -> list[Path]:
        """Write members below `folder`, which must be a new folder of the caller's; return the files.

        A file has its name only after its content has been checked. Raises Damaged, and Missing if there is too little space.
        """
        wanted = list(names)
        needed = sum(map(self.size, wanted))
        with disk_errors(folder):
            folder.mkdir(parents=True, exist_ok=True)
            free = shutil.disk_usage(folder).free
        if needed > free:
            raise Missing(f"{folder} has {free:,} bytes of free space, but {needed:,} are needed")
        return [self._extract(name, folder) for name in wanted]

    def _extract(self, name: str, folder: Path) -> Path:
        path = inside(folder, name)
        unfinished = unfinished_beside(path)
        with disk_errors(folder):
            path.parent.mkdir(parents=True, exist_ok=True)
            try:
                with unfinished.open("xb") as file:
                    file.writelines(self.blocks(name))
                if self._package.is_program(name):
                    mode = unfinished.stat().st_mode
                    unfinished.chmod(mode | (mode & 0o444) >> 2)  # whoever can read it can execute it
                _name(unfinished, path)
            finally:
                unfinished.unlink(missing_ok=True)
        return path


def identity(path: Path) -> str:
    """Return the id of a package, a zip or an extracted folder, after checking all members. Raises Missing, Damaged."""
    with Extracted(path) if path.is_dir() else Archive(path) as package:
        package.verify()
        return package.id


class Archive(Opened):
    """A context manager for a package in a zip."""

    def __init__(self, path: Path) -> None:
        """Raises Missing if the file cannot be read, Damaged if it is no package or not a safe one."""
        try:
            open_regular(path).close()
        except OSError as error:
            raise Missing(f"{path}: {error.strerror or error}") from error
        with refusals(path):
            package = reproduce.Zip(path)
        self._file = package.file
        super().__init__(path, package)

    def __enter__(self) -> Archive:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._file.close()


class Extracted(Opened):
    """A context manager for an extracted package, in which nothing is written. Links are not followed."""

    def __init__(self, path: Path, grows: str = CREATED) -> None:
        """`grows`: the folder whose files need not be listed. An evaluator works in the folder `reproduction`.

        Raises Missing if a file cannot be read, Damaged unless the files are regular and those of the manifest.
        """
        with refusals(path):
            package = _Folder(path, grows)
        super().__init__(path, package)

    def __enter__(self) -> Extracted:
        return self

    def __exit__(self, *_: object) -> None:
        return None


class _Folder(reproduce.Folder):
    """The files of an extracted package. One that has become a pipe or a device is refused instead of waited for."""

    def __init__(self, path: Path, created: str) -> None:
        self.created = created
        super().__init__(path)

    def size(self, name: str) -> int:
        try:
            return (self.path / name).stat().st_size
        except OSError as error:
            raise reproduce.missing(self.path / name, error) from error

    def blocks(self, name: str) -> Iterator[bytes]:
        try:
            with open_regular(self.path / name) as file:
                yield from reproduce.pieces(file)
        except OSError as error:
            raise reproduce.missing(self.path / name, error) from error

    def is_program(self, name: str) -> bool:
        return os.access(self.path / name, os.X_OK)
