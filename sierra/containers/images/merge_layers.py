"""The file system of an image, merged from its layers, as one tar and as a list.

Each layer is a tar of its changes: its files, links and folders replace those of the layers below. `.wh.NAME` removes the NAME
of the layers below, and `.wh..wh..opq` removes everything that they have in its folder (image-spec, layer.md). Where the
specification leaves a choice, the result is that of an overlay file system, which podman and docker use: each layer is unpacked
by itself, so that links are followed, and hard links made, only within one layer; and a folder on the way to a file replaces a
link of a lower layer. Devices and pipes are left out, because an engine provides its own. (An engine that unpacks the layers
itself would create them, so an image from a stranger must not contain a device.)

The tree exists only in memory, so a name in a layer is never used as a path of this machine. Absolute names start at the
image's root, and names that lead out of it are refused. There are two passes over the layers: `merge` reads and hashes all
files and finds the files that remain; `Rootfs.write` streams them, folders first, in an order that depends on the image alone.
"""

from __future__ import annotations

import hashlib
import io
import json
import posixpath
import tarfile
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict
from operator import itemgetter
from typing import BinaryIO, Literal

from sierra.containers.images.oci import Archive
from sierra.containers.images.streams import PIECE, content, members
from sierra.errors import Damaged
from sierra.util.lazy_definitions import dataclass, field, replace

MAX_FILES = 1_000_000
WHITEOUT, OPAQUE, AUFS = ".wh.", ".wh..wh..opq", ".wh..wh."
DEPTH = 256
"""The greatest depth of nested folders."""
LINKS = 40
"""The greatest number of links that are followed one after the other, as in the kernel."""

MOUNTED_ON = ("dev", "etc", "proc", "run", "sys", "tmp", "var", "var/tmp")

Type = Literal["file", "link", "folder", "device"]
Wanted = Callable[[str], int]
"""A function from a path to the number of bytes to keep from the beginning of its file."""


@dataclass(frozen=True, slots=True)
class Entry:
    """One path of an image."""

    path: str
    """The path from the image's root, without a leading slash."""
    type: Type
    mode: int
    size: int = 0
    sha256: str = ""
    target: str = ""
    """The target of a symbolic link."""


def listing(entries: Iterable[Entry]) -> bytes:
    """Return entries as lines of JSON, without fields that have their default values."""
    lines = ({name: value for name, value in asdict(entry).items() if value not in ("", 0)} for entry in entries)
    return "".join(json.dumps({"mode": 0, **line}) + "\n" for line in lines).encode()


def listed(lines: Iterable[bytes]) -> dict[str, Entry]:
    """Return the entries in lines of a listing, by path."""
    return {entry.path: entry for entry in (Entry(**json.loads(line)) for line in lines)}


@dataclass(slots=True)
class _Node:
    type: Type
    mode: int
    layer: int
    """The layer that put it there, under this name."""
    source: tuple[int, int] = (-1, -1)
    """The location of a file's bytes: the number of its layer, and its position there. Hard links share it."""
    size: int = 0
    sha256: str = ""
    target: str = ""
    kept: bytes = b""
    children: dict[str, _Node] = field(default_factory=dict)

    def entry(self, path: str) -> Entry:
        return Entry(path, self.type, self.mode, self.size, self.sha256, self.target)


@dataclass(frozen=True, slots=True)
class Rootfs:
    """The merged file system of an image."""

    archive: Archive
    entries: tuple[Entry, ...]
    """The entries in the order of their paths, without the root itself."""
    kept: dict[str, bytes]
    """The beginnings of the wanted files, by path."""
    sources: dict[tuple[int, int], tuple[str, ...]]
    """The paths of each file, by the location of its bytes."""

    def write(self, out: BinaryIO) -> None:
        """Write all entries as one tar, with times 0 and owner root; its bytes do not depend on how the image is stored."""
        with tarfile.open(fileobj=out, mode="w|", format=tarfile.GNU_FORMAT, encoding="utf-8", errors="surrogateescape") as tar:
            for entry in (*_of("folder", self.entries), *_of("link", self.entries), *self._mounted_on()):
                tar.addfile(_header(entry))
            by_path = {entry.path: entry for entry in _of("file", self.entries)}
            for number in range(len(self.archive.blobs)):
                self._write_layer(tar, number, by_path)

    def _mounted_on(self) -> Iterator[Entry]:
        """Yield the mount points that the image lacks: podman creates them, apptainer cannot."""
        there = {entry.path for entry in self.entries}
        others = {entry.path for entry in self.entries if entry.type != "folder"}
        for path in MOUNTED_ON:
            if path not in there and posixpath.dirname(path) not in others:
                yield Entry(path, "folder", 0o1777 if path.endswith("tmp") else 0o755)

    def _write_layer(self, tar: tarfile.TarFile, number: int, by_path: dict[str, Entry]) -> None:
        with self.archive.layer(number) as stream:
            what = f"{self.archive.path}: layer {number + 1}"
            for ordinal, (member, layer) in enumerate(members(stream, what)):
                first, *others = self.sources.get((number, ordinal), ("",))
                if not first:
                    continue
                header = _header(by_path[first])
                pieces = _Pieces(content(layer, member, what))
                tar.addfile(header, io.BufferedReader(pieces, max(1, min(PIECE, header.size))))
                for path in others:
                    tar.addfile(_header(by_path[path], first))
                tar.members = []  # type: ignore[attr-defined]  # else it keeps all headers


def merge(archive: Archive, wanted: Wanted = lambda path: 0, *, foreign: bool = False) -> Rootfs:
    """Read all layers and merge them.

    Raises Damaged if a layer differs from the archive's description, or leads out of the image.

    `foreign`: the image comes from a stranger, and an engine will unpack it. Raises Damaged for a device in any of its layers.
    """
    root, count = _Node("folder", 0o755, 0), 0
    for number in range(len(archive.blobs)):
        what = f"{archive.path}: layer {number + 1}"
        with archive.layer(number) as stream:
            for ordinal, (member, tar) in enumerate(members(stream, what)):
                if foreign and (member.ischr() or member.isblk()):
                    raise Damaged(f"{what}: {member.name!r} is a device, which no image needs; build it again without")
                _apply(root, member, tar, (number, ordinal), wanted, what)
                count += 1
                if count > MAX_FILES:
                    raise Damaged(f"{archive.path} has more than {MAX_FILES} files")
    nodes = {path: node for path, node in sorted(_walk(root, ""), key=itemgetter(0)) if node.type != "device"}
    sources: dict[tuple[int, int], list[str]] = {}
    for path, node in nodes.items():
        if node.type == "file":
            sources.setdefault(node.source, []).append(path)
    entries = tuple(node.entry(path) for path, node in nodes.items())
    kept = {path: node.kept for path, node in nodes.items() if node.type == "file" and wanted(path)}
    return Rootfs(archive, entries, kept, {source: tuple(paths) for source, paths in sources.items()})


# ---------------------------------------------------------------- applying a layer to those below


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
    """Return the tree node for a member of a layer."""
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
    """Return a hard link's node, a copy of its target's node. Raises Damaged if the target is not a file of the same layer."""
    folder, name = posixpath.split(_inside(member.linkname, what))
    target = _folder(root, folder, layer, what).children.get(name)
    if target is None or target.layer != layer or target.type == "folder":
        raise Damaged(f"{what}: {member.name!r} is a hard link to {member.linkname!r}, which is not a file of the same layer")
    return replace(target)


def _take_away(parent: _Node, name: str, layer: int) -> None:
    """Apply a whiteout, which affects only the layers below."""
    if name == OPAQUE:
        parent.children = _newer(parent.children, layer)
    elif not name.startswith(AUFS):
        gone = name.removeprefix(WHITEOUT)
        if gone in parent.children:
            parent.children |= _newer({gone: parent.children.pop(gone)}, layer)


def _newer(children: dict[str, _Node], layer: int) -> dict[str, _Node]:
    """Return the nodes that this layer itself has added, with the folders that lead to them."""
    newer = {}
    for name, node in children.items():
        if node.type == "folder":
            node.children = _newer(node.children, layer)
        if node.layer == layer or node.children:
            newer[name] = node
    return newer


# ---------------------------------------------------------------- paths within an image


def _inside(name: str, what: str) -> str:
    """Return a member's name as a path from the image's root. Raises Damaged if it leads out of the image."""
    path = posixpath.normpath("./" + name)
    if path == ".." or path.startswith("../"):
        raise Damaged(f"{what}: {name!r} leads out of the image")
    return "" if path == "." else path


def _folder(root: _Node, path: str, layer: int, what: str) -> _Node:
    """Return a folder; create it, or replace what is in its way. Follows links of this layer. Raises Damaged."""
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


def resolve(path: str, look: Callable[[str], Entry | None]) -> str | None:
    """Return the path with all links followed within an image; None if nothing is there. The root is `""`."""
    done: list[str] = []
    parts, links = [part for part in path.split("/") if part not in ("", ".")][::-1], 0
    while parts:
        part = parts.pop()
        if part == "..":
            done = done[:-1]
            continue
        entry = look("/".join((*done, part)))
        if entry is None:
            return None
        if entry.type != "link":
            done.append(part)
            continue
        links += 1
        if links > LINKS:
            return None
        if entry.target.startswith("/"):
            done = []
        parts += [name for name in entry.target.split("/") if name not in ("", ".")][::-1]
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


class _Pieces(io.RawIOBase):
    """A file whose content comes in pieces."""

    def __init__(self, pieces: Iterator[bytes]) -> None:
        self._pieces, self._left = pieces, b""

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: memoryview) -> int:  # type: ignore[override]  # it is always called with this type
        self._left = self._left or next(self._pieces, b"")
        part, self._left = self._left[: len(buffer)], self._left[len(buffer) :]
        buffer[: len(part)] = part
        return len(part)
