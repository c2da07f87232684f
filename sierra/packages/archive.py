"""The file of a package: a zip with fixed times, names in order and a manifest, which is read without trust.

Zip, because every system opens it, and single members can be read. Members whose content is compressed already are stored as
they are. The manifest comes last, when all hashes are known.

A package may come from anybody: see `Archive` for the checks.
"""

from __future__ import annotations

import errno
import hashlib
import shutil
import stat
import zipfile
import zlib
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from types import TracebackType
from typing import IO, Protocol

from sierra.errors import Damaged, Missing, SierraError, UsageError
from sierra.packages import members
from sierra.packages.layout import SIERRA
from sierra.packages.members import MANIFEST
from sierra.store.segments import disk_errors
from sierra.util.fs import inside, unfinished_beside
from sierra.util.hashing import CHUNK
from sierra.util.regular_files import open_regular

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
METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
LEVEL = 6
LARGEST_PLAIN = zipfile.ZIP64_LIMIT - (1 << 20)
"""The largest number of bytes of a member in the plain form of zip, of which versions of Python write the same bytes.

They write other versions into a member in the form for large files. A member may become a little larger when it is compressed.
"""
LARGEST_MANIFEST = 256 << 20
"""The largest number of bytes of a manifest that is read."""
REGULAR = 0o100644
EXECUTABLE = 0o100755


class Content(Protocol):
    """The content of a member, which can be read once."""

    @property
    def size(self) -> int:
        """The number of bytes."""

    def open(self) -> IO[bytes]:
        """Return a binary stream from the beginning of the content."""


def write(path: Path, contents: Mapping[str, Content], executable: Iterable[str] = (), scratch: Path | None = None) -> str:
    """Write a package with these members; return its id. The file appears complete or not at all.

    `executable`: the names of programs. `scratch`: a folder of the same file system for the unfinished file. Raises Damaged for
    names that are not safe, Missing if the disk is full, UsageError if the file exists.
    """
    members.check_names([*contents, MANIFEST])
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


def _add(file: zipfile.ZipFile, name: str, content: Content, *, executable: bool) -> str:
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
    made.external_attr = (EXECUTABLE if executable else REGULAR) << 16
    made.compress_type = method
    made._compresslevel = LEVEL  # type: ignore[attr-defined]  # the public argument exists for `writestr` only
    return made


class Opened(ABC):
    """A package that is read. The content of a member is checked when it is read: it has the SHA-256 of the manifest."""

    path: Path
    hashes: Mapping[str, str]
    """The SHA-256 of all members by name, as the manifest lists them."""

    @abstractmethod
    def size(self, name: str) -> int:
        """Return the number of bytes of a member."""

    @abstractmethod
    def _blocks(self, name: str) -> Iterator[bytes]:
        """Yield the content of a member, whatever the manifest says."""

    @abstractmethod
    def _is_program(self, name: str) -> bool:
        """Return whether a member may be executed."""

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
                if self._is_program(name):
                    mode = unfinished.stat().st_mode
                    unfinished.chmod(mode | (mode & 0o444) >> 2)  # whoever can read it can execute it
                _name(unfinished, path)
            finally:
                unfinished.unlink(missing_ok=True)
        return path


class Archive(Opened):
    """A context manager for a package in a zip. Nothing of it is executed, and nothing is written.

    When it is opened, the list of members is checked: safe names (see `sierra.packages.members`), regular files only, no member
    twice, exactly the members of the manifest, methods that SIERRA writes, no password. The content of a member is checked when
    it is read: no more bytes than the list says, and the SHA-256 of the manifest.
    """

    def __init__(self, path: Path) -> None:
        """Raises Missing if the file cannot be read, Damaged if it is no package or not a safe one."""
        self.path = path
        try:
            open_regular(path).close()
            self._file = zipfile.ZipFile(path)
        except OSError as error:
            raise self._unreadable(error) from error
        except (zipfile.BadZipFile, ValueError, NotImplementedError, UnicodeDecodeError) as error:
            raise Damaged(f"{path} is no package, or not all of it: {_reason(error)}") from error
        try:
            self._members = self._checked()
            self.hashes = self._manifest()
        except BaseException:
            self._file.close()
            raise

    def __enter__(self) -> Archive:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._file.close()

    def _unreadable(self, error: OSError) -> SierraError:
        """Return the error to raise: a zip that names a place before its beginning gives EINVAL."""
        if error.errno == errno.EINVAL:
            return Damaged(f"{self.path} is no package, or not all of it: it names a place outside the file")
        return Missing(f"{self.path}: {error.strerror or error}")

    def _checked(self) -> dict[str, zipfile.ZipInfo]:
        infos = self._file.infolist()
        members.check_names(info.orig_filename for info in infos)
        for info in infos:
            if problem := _problem(info):
                raise Damaged(f"{self.path}: member {info.orig_filename[:100]!r} {problem}")
        return {info.orig_filename: info for info in infos}

    def _manifest(self) -> dict[str, str]:
        if MANIFEST not in self._members:
            raise Damaged(f"{self.path} is no package of SIERRA: it has no {MANIFEST}")
        if self._members[MANIFEST].file_size > LARGEST_MANIFEST:
            raise Damaged(f"{self.path}: {MANIFEST} is too large")
        hashes = members.read(b"".join(self._blocks(MANIFEST)))
        listed = set(hashes)
        present = set(self._members) - {MANIFEST}
        if extra := sorted(present - listed):
            raise Damaged(f"{self.path}: {MANIFEST} does not list the member {extra[0]!r}")
        if lost := sorted(listed - present):
            raise Damaged(f"{self.path}: the member {lost[0]!r} of {MANIFEST} is missing")
        return hashes

    def size(self, name: str) -> int:
        return self._members[name].file_size

    def _is_program(self, name: str) -> bool:
        return self._members[name].external_attr >> 16 == EXECUTABLE

    def _blocks(self, name: str) -> Iterator[bytes]:
        """Yield the content of a member, not more than its stated size."""
        left = self._members[name].file_size
        try:
            with self._file.open(self._members[name]) as member:
                while block := member.read(CHUNK):
                    left -= len(block)
                    if left < 0:
                        raise Damaged(f"{self.path}: member {name!r} is longer than it says")
                    yield block
        except (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError) as error:
            raise Damaged(f"{self.path}: member {name!r} is damaged: {_reason(error)}") from error
        except OSError as error:
            raise self._unreadable(error) from error
        if left:
            raise Damaged(f"{self.path}: member {name!r} is shorter than it says")


def _problem(info: zipfile.ZipInfo) -> str:
    """Return the reason why a member is not accepted; "" if it is."""
    kind = stat.S_IFMT(info.external_attr >> 16)  # 0: made on a system without kinds of files
    if info.is_dir() or kind not in (0, stat.S_IFREG):
        return "is no regular file: links, folders and devices are refused"
    if info.flag_bits & 0x1:
        return "needs a password"
    if info.compress_type not in METHODS:
        return "is compressed by a method that SIERRA does not write"
    if info.filename != info.orig_filename:
        return "has a name with a character that systems treat differently"
    return ""


def _reason(error: BaseException) -> str:
    return str(error).splitlines()[0][:120] if str(error) else type(error).__name__
