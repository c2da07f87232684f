"""An image's files, all layers together: who of them wins, as one tar and as a list.

Each layer is a tar of what it changes: files, links and folders replace those of the layers below; `.wh.NAME` takes NAME of
the layers below away, and `.wh..wh..opq` all that they have in its folder (image-spec, layer.md). Where that leaves a choice,
it is as in an overlay file system, which is how podman and docker have layers: each is unpacked by itself, so that links are
followed, and hard links made, within one layer only; and a folder on the way to a file takes the place of a link that a lower
layer has there. Devices and pipes are left out: an engine brings its own. (One that unpacks the
layers itself would make them, so that what a stranger gives may have no device.)

The tree is only in memory, so no name in a layer ever is a path of this machine: absolute names are from the image's root, and
what leads out of it is refused. Two passes over the layers: `merge` reads and hashes all files and knows the winners;
`Rootfs.write` streams them, folders first, in an order that follows from the image alone.
"""

from __future__ import annotations

import hashlib
import posixpath
import tarfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from operator import itemgetter
from typing import BinaryIO, Literal, cast

from sierra.containers.images.oci import Archive
from sierra.containers.images.streams import content, members
from sierra.errors import Damaged

MOST_FILES = 1_000_000
WHITEOUT, OPAQUE, AUFS = ".wh.", ".wh..wh..opq", ".wh..wh."
DEPTH = 256
"""Folders within folders, at most."""
LINKS = 40
"""Links followed one after the other, as the kernel has it."""

MOUNTED_ON = {
    "dev": 0o755,
    "etc": 0o755,
    "proc": 0o755,
    "run": 0o755,
    "sys": 0o755,
    "tmp": 0o1777,
    "var": 0o755,
    "var/tmp": 0o1777,
}

Type = Literal["file", "link", "folder", "device"]
Wanted = Callable[[str], int]
"""How many bytes of the file of a path are to be kept, from its beginning."""


@dataclass(frozen=True, slots=True)
class Entry:
    """One path of an image."""

    path: str
    """From the image's root, without a slash before it."""
    type: Type
    mode: int
    size: int = 0
    sha256: str = ""
    target: str = ""
    """What a symbolic link says."""


@dataclass(slots=True)
class _Node:
    type: Type
    mode: int
    layer: int
    """The layer that put it there, under this name."""
    source: tuple[int, int] = (-1, -1)
    """Where a file's bytes are: its layer, and its place in that; hard links have it in common."""
    size: int = 0
    sha256: str = ""
    target: str = ""
    kept: bytes = b""
    children: dict[str, _Node] = field(default_factory=dict)

    def entry(self, path: str) -> Entry:
        return Entry(path, self.type, self.mode, self.size, self.sha256, self.target)


@dataclass(frozen=True, slots=True)
class Rootfs:
    """The files that an image comes to."""

    archive: Archive
    entries: tuple[Entry, ...]
    """By path; the root itself is not among them."""
    kept: dict[str, bytes]
    """The beginnings of files that were wanted, by path."""
    sources: dict[tuple[int, int], tuple[str, ...]]
    """The paths of each file, by where its bytes are."""

    def write(self, out: BinaryIO) -> None:
        """All as one tar: the same bytes for the same image, in whatever form it is kept. Times are 0, all belongs to root."""
        with tarfile.open(fileobj=out, mode="w|", format=tarfile.GNU_FORMAT, encoding="utf-8", errors="surrogateescape") as tar:
            for entry in (*_of("folder", self.entries), *_of("link", self.entries), *self._mounted_on()):
                tar.addfile(_header(entry))
            by_path = {entry.path: entry for entry in _of("file", self.entries)}
            for place in range(len(self.archive.blobs)):
                self._write_layer(tar, place, by_path)

    def _mounted_on(self) -> Iterator[Entry]:
        """The folders that an image lacks and an engine mounts on: podman makes them, apptainer can't."""
        there = {entry.path for entry in self.entries}
        others = {entry.path for entry in self.entries if entry.type != "folder"}
        for path, mode in MOUNTED_ON.items():
            if path not in there and posixpath.dirname(path) not in others:
                yield Entry(path, "folder", mode)

    def _write_layer(self, tar: tarfile.TarFile, place: int, by_path: dict[str, Entry]) -> None:
        with self.archive.layer(place) as stream:
            what = f"{self.archive.path}: layer {place + 1}"
            for ordinal, (member, layer) in enumerate(members(stream, what)):
                first, *others = self.sources.get((place, ordinal), ("",))
                if not first:
                    continue
                header = _header(by_path[first])
                tar.addfile(header, cast("BinaryIO", _Pieces(content(layer, member, what))))
                for path in others:
                    tar.addfile(_header(by_path[path], first))
                tar.members = []  # type: ignore[attr-defined]  # else it remembers all headers


def merge(archive: Archive, wanted: Wanted = lambda path: 0, *, foreign: bool = False) -> Rootfs:
    """Read all layers, and see which files win. Raises Damaged for what is not as the archive says, or leads out of it.

    `foreign`: it is a stranger's, and an engine will unpack it; raises Damaged for a device in any of its layers.
    """
    root, count = _Node("folder", 0o755, 0), 0
    for place in range(len(archive.blobs)):
        what = f"{archive.path}: layer {place + 1}"
        with archive.layer(place) as stream:
            for ordinal, (member, tar) in enumerate(members(stream, what)):
                if foreign and (member.ischr() or member.isblk()):
                    raise Damaged(f"{what}: {member.name!r} is a device, which no image needs; build it again without")
                _apply(root, member, tar, (place, ordinal), wanted, what)
                count += 1
                if count > MOST_FILES:
                    raise Damaged(f"{archive.path} has more than {MOST_FILES} files")
    nodes = {path: node for path, node in sorted(_walk(root, ""), key=itemgetter(0)) if node.type != "device"}
    sources: dict[tuple[int, int], list[str]] = {}
    for path, node in nodes.items():
        if node.type == "file":
            sources.setdefault(node.source, []).append(path)
    entries = tuple(node.entry(path) for path, node in nodes.items())
    kept = {path: node.kept for path, node in nodes.items() if node.type == "file" and wanted(path)}
    return Rootfs(archive, entries, kept, {source: tuple(paths) for source, paths in sources.items()})


# ---------------------------------------------------------------- one layer upon those below


def _apply(
    root: _Node, member: tarfile.TarInfo, tar: tarfile.TarFile, source: tuple[int, int], wanted: Wanted, what: str
) -> None:
    path, layer = _inside(member.name, what), source[0]
    if not path:
        root.mode = member.mode & 0o7777
        return
    folder, name = posixpath.split(path)
    parent = _folder(root, folder, layer, what)
    if name.startswith(WHITEOUT):
        _take_away(parent, name, layer)
        return
    node = _node(root, member, tar, source, wanted, what)
    before = parent.children.get(name)
    if before is not None and before.type == node.type == "folder":
        node.children = before.children
    parent.children[name] = node


def _node(
    root: _Node, member: tarfile.TarInfo, tar: tarfile.TarFile, source: tuple[int, int], wanted: Wanted, what: str
) -> _Node:
    """What a member puts into the tree."""
    mode, layer = member.mode & 0o7777, source[0]
    if member.isdir():
        return _Node("folder", mode, layer)
    if member.issym():
        return _Node("link", 0o777, layer, target=member.linkname)
    if member.islnk():
        return _linked(root, member, layer, what)
    if not member.isreg():
        return _Node("device", mode, layer)
    digest, size, most = hashlib.sha256(), 0, wanted(_inside(member.name, what))
    kept = bytearray()
    for piece in content(tar, member, what):
        digest.update(piece)
        size += len(piece)
        kept += piece[: max(0, most - len(kept))]
    return _Node("file", mode, layer, source, size, digest.hexdigest(), kept=bytes(kept))


def _linked(root: _Node, member: tarfile.TarInfo, layer: int, what: str) -> _Node:
    """A hard link: the file that its target is."""
    folder, name = posixpath.split(_inside(member.linkname, what))
    target = _folder(root, folder, layer, what).children.get(name)
    if target is None or target.layer != layer or target.type == "folder":
        raise Damaged(f"{what}: {member.name!r} is a hard link to {member.linkname!r}, which is no file of the same layer")
    return replace(target)


def _take_away(parent: _Node, name: str, layer: int) -> None:
    """What a whiteout says; it concerns the layers below alone."""
    if name == OPAQUE:
        parent.children = _newer(parent.children, layer)
    elif not name.startswith(AUFS):
        gone = name.removeprefix(WHITEOUT)
        if gone in parent.children:
            parent.children |= _newer({gone: parent.children.pop(gone)}, layer)


def _newer(children: dict[str, _Node], layer: int) -> dict[str, _Node]:
    """What this layer itself has put there, with the folders that lead to it."""
    found = {}
    for name, node in children.items():
        if node.type == "folder":
            node.children = _newer(node.children, layer)
        if node.layer == layer or node.children:
            found[name] = node
    return found


# ---------------------------------------------------------------- paths within an image


def _inside(name: str, what: str) -> str:
    """A member's name as a path from the image's root. Raises Damaged for one that leads out of it."""
    path = posixpath.normpath("./" + name)
    if path == ".." or path.startswith("../"):
        raise Damaged(f"{what}: {name!r} leads out of the image")
    return "" if path == "." else path


def _folder(root: _Node, path: str, layer: int, what: str) -> _Node:
    """The folder of a path, made where there is none; links of this layer are followed, what else is in the way gives way."""
    way, links = [root], 0
    parts = path.split("/")[::-1] if path else []
    while parts:
        part = parts.pop()
        if part in ("", ".", ".."):
            way = way[:-1] if part == ".." and len(way) > 1 else way
            continue
        node = way[-1].children.get(part)
        if node is not None and node.type == "link" and node.layer == layer:
            links += 1
            way = [root] if node.target.startswith("/") else way
            parts += node.target.split("/")[::-1]
        else:
            if node is None or node.type != "folder":
                node = way[-1].children[part] = _Node("folder", 0o755, layer)
            way.append(node)
        if links > LINKS or len(way) > DEPTH:
            raise Damaged(f"{what}: {path[:40]!r} leads through more than {LINKS} links or {DEPTH} folders")
    return way[-1]


class _Known:
    """What `resolve` needs to know of a path: a `_Node` and an `Entry` both are that."""

    type: Type
    target: str


def resolve(path: str, look: Callable[[str], object | None]) -> str | None:
    """The path that is meant where links are followed within an image; None where there is nothing. `""` is the root."""
    done: list[str] = []
    parts, links = [part for part in path.split("/") if part not in ("", ".")][::-1], 0
    while parts:
        part = parts.pop()
        if part == "..":
            done = done[:-1]
            continue
        found = cast("_Known | None", look("/".join((*done, part))))
        if found is None:
            return None
        if found.type != "link":
            done.append(part)
            continue
        links += 1
        if links > LINKS:
            return None
        if found.target.startswith("/"):
            done = []
        parts += [one for one in found.target.split("/") if one not in ("", ".")][::-1]
    return "/".join(done)


def _walk(node: _Node, path: str) -> Iterator[tuple[str, _Node]]:
    for name, child in node.children.items():
        inner = f"{path}/{name}" if path else name
        yield inner, child
        yield from _walk(child, inner)


# ---------------------------------------------------------------- the tar


def _of(kind: Type, entries: tuple[Entry, ...]) -> Iterator[Entry]:
    return (entry for entry in entries if entry.type == kind)


def _header(entry: Entry, link: str = "") -> tarfile.TarInfo:
    header = tarfile.TarInfo(entry.path)
    header.mode = entry.mode
    match entry.type:
        case "folder":
            header.type = tarfile.DIRTYPE
        case "link":
            header.type, header.linkname = tarfile.SYMTYPE, entry.target
        case "file" if link:
            header.type, header.linkname = tarfile.LNKTYPE, link
        case "file":
            header.size = entry.size
    return header


class _Pieces:
    """Pieces as a file, of which any number of bytes can be read."""

    def __init__(self, pieces: Iterator[bytes]) -> None:
        self._pieces, self._piece, self._place = pieces, b"", 0

    def read(self, size: int) -> bytes:
        parts = []
        while size and (self._place < len(self._piece) or self._next()):
            part = self._piece[self._place : self._place + size]
            self._place += len(part)
            size -= len(part)
            parts.append(part)
        return b"".join(parts)

    def _next(self) -> bool:
        self._piece, self._place = next(self._pieces, b""), 0
        return bool(self._piece)
