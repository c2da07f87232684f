"""Names that a run has made, removed or moved, and where the content behind each of them comes from."""

from __future__ import annotations

import os
import re
import stat
from typing import Iterable, Iterator, Mapping

BOTH, EMPTIED, ALONE = range(3)
"""Uses of a file that a run has written: opened for writing and reading, the same and emptied, or only read."""
LOCK_BYTES = 64
LOCK = re.compile(rb"(?:.*[/._-])?lo?ck(?:file)?|.*/server-[0-9]+\.xkm", re.I | re.S)
"""Names of locks, and of files that only the X server reads that has locked the display of this number."""
DOTS = re.compile(rb"/(?:\.?/)+|/\.$")
MADE = b""
"""The origin of a file whose content the run has made."""
MOST_MOVES = 10_000_000  # names to look through for renamed folders in which the run has made files


class ChangedNames:
    """The names that a run has changed; all of them are real paths.

    Content that the run moves is followed by `origins`: for each name that the run has given to something, where its content
    comes from. That is MADE if the run has made it, or else the name under which it was there before.
    """

    def __init__(self, own_folders: Iterable[bytes], reasons: dict[str, None]) -> None:
        """`reasons`: here it is noted why not everything is known."""
        self._reasons = reasons
        self._own_folders = tuple(folder + b"/" for folder in own_folders)
        self.written: set[bytes] = set()
        self.removed: set[bytes] = set()
        self.reread: dict[bytes, int] = {}
        """Names under which the run has written content, and that it has used again: the surest of BOTH, EMPTIED and ALONE."""
        self.reread_new: dict[bytes, int] = {}
        """The same for names that it has made itself, or a folder above them."""
        self.origins: dict[bytes, bytes] = {}
        self._moved_old = False
        """True if the run has moved anything that existed before."""
        self._content: set[bytes] = set()
        """Names under which the run has written content, also if it has removed them since."""
        self._links: set[bytes] = set()
        """Links to its own files that it has made outside its folder."""
        self._new: set[bytes] = set()
        """Names that certainly did not exist before the run."""
        self._absent: set[bytes] = set()
        """Names that the run has removed."""
        self._holders: set[bytes] = set()
        """All folders above the names that the run has made."""
        self._real_folders: dict[bytes, bytes] = {}
        self._moves = 0

    def real(self, path: bytes) -> bytes:
        """Return a path with the links in its folder followed, but not a link that it names itself."""
        folder, _, name = path.rpartition(b"/")
        self.use_links(folder)
        real = self._real_folders.get(folder)
        if real is None:
            real = self._real_folders[folder] = os.path.realpath(folder or b"/").rstrip(b"/")
        return real + b"/" + name

    def origin(self, real: bytes) -> bytes | None:
        """Return where the content of a real path comes from; None if it has always been there."""
        origin = self.origins.get(real)
        if origin is None and self._moved_old:
            for folder in with_folders(real):
                if origin := self.origins.get(folder):
                    return origin + real[len(folder) :]
            return None
        return origin

    def is_own(self, path: bytes) -> bool:
        """Return whether the run has made or removed a name, or a folder above it."""
        if not self._new and not self._absent and not self.origins:
            return False
        real = self.real(path)
        if real in self.origins or real in self.written:
            return True
        folders = list(with_folders(real))
        return not (self._new.isdisjoint(folders) and self._absent.isdisjoint(folders))

    def is_new(self, real: bytes) -> bool:
        """Return whether the run has certainly made a name itself, or a folder above it."""
        return not self._new.isdisjoint(with_folders(real))

    def is_in_own_folder(self, path: bytes) -> bool:
        return (path + b"/").startswith(self._own_folders)

    def use(self, real: bytes, use: int = ALONE) -> None:
        """A file is read, or moved, that the run may have written itself: note it then."""
        if real in self._content:
            names = self.reread_new if self.is_new(real) else self.reread
            names[real] = max(use, names.get(real, use))

    def use_links(self, path: bytes) -> None:
        """A path is followed: note those links in it that lead to the run's own files, because the run has made them."""
        if self._links:
            for name in self._links.intersection(with_folders(path)):
                self.use(name)

    def write(self, real: bytes, *, created: bool = True, new: bool = False, content: bool = True) -> None:
        """Record that a file is opened to change its content, is created or emptied (`created`), or is `new`."""
        self.written.add(real)
        if content:
            self._content.add(real)
        self._links.discard(real)
        new = new and real not in self.removed  # another run may make room for itself in the same way
        self.removed.discard(real)
        self._absent.discard(real)
        if created:
            self._set_origin(real, MADE)
        if new:
            self._new.add(real)

    def _set_origin(self, real: bytes, origin: bytes) -> None:
        self.origins[real] = origin
        self._moved_old = self._moved_old or origin != MADE
        for folder in with_folders(real.rpartition(b"/")[0]):
            if folder in self._holders:
                break
            self._holders.add(folder)

    def make(self, path: bytes) -> bytes:
        """A folder, a link or a node is made, which may be on the way to other names; return its real path."""
        self._real_folders.clear()
        real = self.real(path)
        self.write(real, new=True)
        return real

    def note_link(self, real: bytes, target: bytes) -> None:
        """A link was made: keep it if others may replace it, and it leads to what is the run's own."""
        if self.is_in_own_folder(target) or self.is_own(target):
            self._links.add(real)

    def remove(self, real: bytes) -> None:
        self.origins.pop(real, None)
        self._links.discard(real)
        self.written.discard(real)
        self._absent.add(real)
        if self.is_new(real):
            self._new.discard(real)
        else:
            self.removed.add(real)

    def link(self, source: bytes, target: bytes, origin: bytes | None) -> None:
        """A file gets a second name; `origin` is that of its content."""
        self.write(target, new=True)
        self._take(source, target)
        self._set_origin(target, source if origin is None else origin)

    def _take(self, source: bytes, target: bytes) -> None:
        """A name is given to something that has another one: a run that takes it into its own folder uses it."""
        if self.is_in_own_folder(target):
            self.use(source)

    def rename(self, source: bytes, target: bytes, *, new: bool) -> None:
        """Something gets another name, which is `new` if nothing had it."""
        origin = self.origin(source)
        if source in self._holders:
            self._move_folder(source + b"/", target + b"/")
        self._take(source, target)
        is_link = source in self._links
        self.remove(source)
        self._new.discard(target)
        self.write(target, new=new)
        if is_link:
            self._links.add(target)
        self._set_origin(target, source if origin is None else origin)

    def _move_folder(self, old: bytes, new: bytes) -> None:
        """Give new names to all that the run has made in a folder that it renames."""
        self._moves += len(self.written) + len(self._new) + len(self._absent) + len(self.origins)
        if self._moves > MOST_MOVES:
            self._reasons["it renamed too many folders"] = None
            return
        self._real_folders.clear()
        for names in (self.written, self._new, self._absent, self._content, self._links):
            for name in [name for name in names if name.startswith(old)]:
                names.discard(name)
                names.add(new + name[len(old) :])
        for name in [name for name in self.origins if name.startswith(old)]:
            self._set_origin(new + name[len(old) :], self.origins.pop(name))


def with_folders(path: bytes) -> Iterator[bytes]:
    """Yield a path and all folders above it but the root."""
    while len(path) > 1:
        yield path
        path = path.rpartition(b"/")[0]


def clean(path: bytes) -> bytes:
    """Return an absolute path without `.`, `..`, and doubled or final slashes; links are followed only before a `..`."""
    if b"/." not in path and b"//" not in path and not path.endswith(b"/"):
        return path
    path = DOTS.sub(b"/", path)
    if b"/../" in path or path.endswith(b"/.."):
        head, _, tail = path.rpartition(b"/..")
        path = os.path.realpath(head + b"/..") + tail
    return b"/" + path.strip(b"/")


def without_locks(uses: Mapping[bytes, int], *, new: bool = False) -> tuple[str, ...]:
    """Return the names of files that a run wrote and read (`reread`, or `new`: `reread_new`), sorted, without locks."""
    return tuple(sorted(os.fsdecode(path) for path, use in uses.items() if not is_lock(path, use, new=new)))


def is_lock(path: bytes, use: int, *, new: bool = False) -> bool:
    """Return whether a file that a run wrote and read has no content for others: a lock, or neither a file nor a link.

    A file is a lock if it has the name of one, and is small or gone. One that is gone was a lock if the run made its name, or
    did not read it for itself. Those of other names are locks if they were opened once for both and nobody has written to them.
    """
    named = LOCK.fullmatch(path) is not None
    try:
        status = os.lstat(path)
    except OSError:
        return named and (new or use < ALONE)
    if not stat.S_ISREG(status.st_mode):
        return named or not stat.S_ISLNK(status.st_mode)
    return status.st_size <= LOCK_BYTES if named else status.st_size == 0 and use == BOTH
