"""OCI images in files: archives of `podman save` and `docker save` (docker-archive, oci-archive), and OCI layouts as folders.

An archive may come from anyone, so nothing in it is trusted: the configuration's digest is the image's id, the configuration
names the digest of each layer's files, and every byte that is used is hashed when it is read. Nothing is unpacked here, so a
name in an archive is never used as a path of this machine.

Formats: https://github.com/opencontainers/image-spec (image-layout.md, manifest.md, config.md), and the format that docker
calls "Image JSON": `manifest.json` with the names of a configuration and of the layers, from the lowest.
"""

from __future__ import annotations

import contextlib
import gzip
import json
import re
import tarfile
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO, Protocol, cast

from sierra.containers.images.image import Image, Kind, machine
from sierra.containers.images.streams import ForwardStream, Hashed, members
from sierra.errors import Damaged, Missing
from sierra.util.hashing import sha256

MANIFEST, LAYOUT, INDEX = "manifest.json", "oci-layout", "index.json"
DOCUMENT = 8 << 20
"""The greatest size in bytes of a manifest or a configuration; the specification requires readers to accept 4 MiB."""
MOST_MEMBERS = 10_000
MOST_LAYERS = 512
LEAST_BOUND = 256 << 20
EXPANSION = 200
"""The greatest ratio of a layer's unpacked size to its size. LEAST_BOUND bytes are always allowed. Gzip can reach 1032."""
DIGEST = re.compile(r"sha256:([0-9a-f]{64})")
HEX = re.compile(r"(?:^|/)([0-9a-f]{64})(?:\.json)?$")
COMPRESSED = {b"\x28\xb5\x2f\xfd": "zstd", b"BZh": "bzip2", b"\xfd7zXZ": "xz"}
DEPTH = 4


class Files(Protocol):
    """The files of an archive, by name."""

    def size(self, name: str) -> int | None:
        """Return the size of a file in bytes, or None if there is no such file."""
        ...

    def open(self, name: str) -> contextlib.AbstractContextManager[BinaryIO]: ...


@dataclass(frozen=True, slots=True)
class Blob:
    """A layer as it is stored in an archive."""

    name: str
    size: int
    sha256: str = ""
    """The SHA-256 of its stored bytes; empty if the archive does not name it."""


@dataclass(frozen=True, slots=True)
class Archive:
    """One image in a file or a folder: its configuration, already checked, and its layers, checked when they are read."""

    path: Path
    form: str
    """The form: docker-archive, oci-archive or oci."""
    id: str
    manifest: str
    """The manifest's digest in this form; empty for a docker-archive, which has none."""
    document: bytes
    """The configuration, byte for byte."""
    config: Mapping[str, Any]
    tags: tuple[str, ...]
    """The tags that the image had at its origin."""
    diff_ids: tuple[str, ...]
    blobs: tuple[Blob, ...]
    files: Files

    @contextlib.contextmanager
    def layer(self, place: int) -> Iterator[ForwardStream]:
        """Yield a layer's files as a tar. Raises Damaged at the end if they differ from those that the configuration names."""
        blob, what = self.blobs[place], f"{self.path}: layer {place + 1} of {len(self.blobs)}"
        with self.files.open(blob.name) as stored:
            packed = Hashed(stored)
            most = max(LEAST_BOUND, EXPANSION * blob.size)
            stream = ForwardStream(_unpacked(packed, what), most, what)
            yield stream
            found = stream.digest()
            if blob.sha256 and packed.digest() != blob.sha256:
                raise Damaged(f"{what} does not match its manifest: its SHA-256 should begin with {blob.sha256[:12]}")
        if f"sha256:{found}" != self.diff_ids[place]:
            wanted = self.diff_ids[place][7:19]
            raise Damaged(f"{what} does not match the configuration: its files have SHA-256 {found[:12]}…, not {wanted}…")

    def check(self) -> list[int]:
        """Read the whole image, and return the sizes of its layers' tars.

        Raises Damaged if it differs from its configuration.
        """
        sizes = []
        for place in range(len(self.blobs)):
            with self.layer(place) as stream:
                stream.digest()
                sizes.append(stream.tell())
        return sizes

    def write(self, out: BinaryIO) -> None:
        """Write the image as a docker-archive without tags, and nothing else from this archive. Checks all data that it reads.

        The manifest is written last, so that an archive that is cut short because of damage is not a valid image.
        """
        sizes = self.check()
        names = [f"{digest[7:]}.tar" for digest in self.diff_ids]
        manifest = [{"Config": f"{self.id[7:]}.json", "RepoTags": None, "Layers": names}]
        with tarfile.open(fileobj=out, mode="w|", format=tarfile.USTAR_FORMAT) as tar:
            for place, name in enumerate(names):
                if name not in names[:place]:
                    with self.layer(place) as stream:
                        tar.addfile(_header(name, sizes[place]), cast("BinaryIO", stream))
            for name, content in ((f"{self.id[7:]}.json", self.document), (MANIFEST, json.dumps(manifest).encode())):
                tar.addfile(_header(name, len(content)), BytesIO(content))

    def image(self, name: str, *, file: str = "", sha256: str = "") -> Image:
        """Return this image under the name that a project gives it."""
        return image_of(name, self.id, self.config, file=file, sha256=sha256)


def image_of(name: str, identity: str, config: Mapping[str, Any], *, file: str = "", sha256: str = "") -> Image:
    """Return the image that a configuration describes."""
    architecture = config.get("architecture") or ""
    return Image(name, identity, Kind.OCI, architecture, diff_ids(config), variables(config), file, sha256)


def diff_ids(config: Mapping[str, Any]) -> tuple[str, ...]:
    return tuple(_inner(config, "rootfs").get("diff_ids") or ())


def variables(config: Mapping[str, Any]) -> dict[str, str]:
    """Return the variables that a configuration sets. Of several values, the last one is used, as engines do."""
    pairs = (one.partition("=") for one in _inner(config, "config").get("Env") or ())
    return {name: value for name, _, value in pairs if name}


def labels(config: Mapping[str, Any]) -> dict[str, str]:
    return {str(name): str(value) for name, value in (_inner(config, "config").get("Labels") or {}).items()}


def _inner(config: Mapping[str, Any], name: str) -> dict[str, Any]:
    found = config.get(name)
    return found if isinstance(found, dict) else {}


def is_archive(path: Path) -> bool:
    """Return whether a file is a tar or a folder is an OCI layout. Either may be damaged."""
    if path.is_dir():
        return (path / LAYOUT).is_file() or (path / INDEX).is_file()
    with path.open("rb") as file:
        return file.read(265)[257:262] == b"ustar"


def read(path: Path) -> Archive:
    """Return the image in an archive or an OCI layout, without reading its layers.

    Raises Damaged if it is not an image or contains several, Missing if it cannot be read.
    """
    try:
        files: Files = _Folder(path) if path.is_dir() else _Tar(path)
        if files.size(LAYOUT) is not None or (files.size(INDEX) is not None and files.size(MANIFEST) is None):
            return _oci(path, files)
        return _docker(path, files)
    except OSError as error:
        raise Missing(f"{path} cannot be read: {error.strerror or error}") from error


# ---------------------------------------------------------------- docker-archive


def _docker(path: Path, files: Files) -> Archive:
    entry = _only(path, _json(path, files, MANIFEST), lambda one: ", ".join(map(str, one.get("RepoTags") or ["untagged"])))
    name, layers = entry.get("Config"), entry.get("Layers")
    if not isinstance(name, str) or not isinstance(layers, list) or not all(isinstance(one, str) for one in layers):
        raise Damaged(f"{path}: {MANIFEST} names no configuration, or no layers")
    said = HEX.search(name)
    content = _document(path, files, name)
    if said and sha256(content) != said[1]:
        raise Damaged(f"{path}: the configuration {name} does not match the hash in its name")
    config = _parsed(path, name, content)
    blobs = tuple(Blob(one, _size(path, files, one, f"layer {place + 1}")) for place, one in enumerate(layers))
    tags = entry.get("RepoTags")
    called = tuple(one for one in tags if isinstance(one, str)) if isinstance(tags, list) else ()
    return _archive(path, "docker-archive", "", content, config, blobs, files, called)


def _only(path: Path, listed: Any, called: Any) -> dict[str, Any]:
    """Return the only image of a list. Raises Damaged if the list has none or several."""
    if not isinstance(listed, list) or not listed or not all(isinstance(one, dict) for one in listed):
        raise Damaged(f"{path} contains no image")
    if len(listed) > 1:
        names = "; ".join(map(called, listed[:3]))
        raise Damaged(f"{path} contains {len(listed)} images ({names}{'; …' * (len(listed) > 3)}); save only one")
    return cast("dict[str, Any]", listed[0])


# ---------------------------------------------------------------- OCI layouts


def _oci(path: Path, files: Files) -> Archive:
    form = "oci" if path.is_dir() else "oci-archive"
    digest, manifest = _manifest(path, files, _json(path, files, INDEX), DEPTH)
    config_blob = _descriptor(path, files, manifest.get("config"), "the configuration")
    content = _checked(path, files, config_blob, "the configuration")
    config = _parsed(path, config_blob.name, content)
    listed = manifest.get("layers")
    if not isinstance(listed, list):
        raise Damaged(f"{path}: its manifest names no layers")
    blobs = tuple(_descriptor(path, files, one, f"layer {place + 1}") for place, one in enumerate(listed))
    return _archive(path, form, digest, content, config, blobs, files, ())


def _manifest(path: Path, files: Files, index: Any, depth: int) -> tuple[str, dict[str, Any]]:
    """Return the digest and content of the only manifest in an index, or of the only one for this machine's architecture."""
    listed = index.get("manifests") if isinstance(index, dict) else None
    if isinstance(listed, list) and len(listed) > 1:
        mine = [one for one in listed if isinstance(one, dict) and _inner(one, "platform").get("architecture") == machine()]
        listed = mine or listed
    entry = _only(path, listed, lambda one: str(one.get("digest"))[:19])
    blob = _descriptor(path, files, entry, "the manifest")
    found = _parsed(path, blob.name, _checked(path, files, blob, "the manifest"))
    if "manifests" in found and "config" not in found and depth:
        return _manifest(path, files, found, depth - 1)
    return f"sha256:{blob.sha256}", found


def _descriptor(path: Path, files: Files, said: Any, what: str) -> Blob:
    """Return a blob that a document names by digest and size. Checks that it exists with that size, but does not read it."""
    digest = DIGEST.fullmatch(str(said.get("digest"))) if isinstance(said, dict) else None
    if digest is None:
        raise Damaged(f"{path}: {what} is not identified by a SHA-256")
    name = f"blobs/sha256/{digest[1]}"
    size = _size(path, files, name, what)
    if size != said.get("size"):
        raise Damaged(f"{path}: {what} has {size} bytes, but should have {said.get('size')}")
    return Blob(name, size, digest[1])


# ---------------------------------------------------------------- both formats


def _archive(
    path: Path,
    form: str,
    manifest: str,
    content: bytes,
    config: dict[str, Any],
    blobs: Sequence[Blob],
    files: Files,
    tags: tuple[str, ...],
) -> Archive:
    """Return the archive. Raises Damaged if the configuration is invalid, or does not match the list of layers."""
    _check_config(path, config)
    found = diff_ids(config)
    if len(found) != len(blobs):
        raise Damaged(f"{path}: the configuration names {len(found)} layers, the manifest {len(blobs)}")
    if len(blobs) > MOST_LAYERS:
        raise Damaged(f"{path} has {len(blobs)} layers; at most {MOST_LAYERS} are read")
    return Archive(path, form, f"sha256:{sha256(content)}", manifest, content, config, tags, found, tuple(blobs), files)


def _header(name: str, size: int) -> tarfile.TarInfo:
    header = tarfile.TarInfo(name)
    header.size = size
    return header


def _check_config(path: Path, config: Mapping[str, Any]) -> None:
    listed = _inner(config, "rootfs").get("diff_ids")
    sets = _inner(config, "config").get("Env") or []
    shaped = (
        isinstance(listed, list | None)
        and all(isinstance(one, str) and DIGEST.fullmatch(one) for one in listed or ())
        and isinstance(config.get("architecture", ""), str)
        and isinstance(sets, list)
        and all(isinstance(one, str) and "\0" not in one for one in sets)
        and isinstance(_inner(config, "config").get("Labels") or {}, dict)
    )
    if not shaped:
        raise Damaged(f"{path}: the configuration is not a valid OCI image configuration")


def _size(path: Path, files: Files, name: str, what: str) -> int:
    size = files.size(name)
    if size is None:
        raise Damaged(f"{path}: {what} is missing ({name[:80]!r})")
    return size


def _checked(path: Path, files: Files, blob: Blob, what: str) -> bytes:
    content = _document(path, files, blob.name)
    if sha256(content) != blob.sha256:
        raise Damaged(f"{path}: {what} does not match its digest: its SHA-256 should begin with {blob.sha256[:12]}")
    return content


def _document(path: Path, files: Files, name: str) -> bytes:
    size = _size(path, files, name, "a document")
    if size > DOCUMENT:
        raise Damaged(f"{path}: {name[:80]!r} has {size} bytes; at most {DOCUMENT} are allowed")
    with files.open(name) as file:
        return file.read(DOCUMENT)


def _json(path: Path, files: Files, name: str) -> Any:
    if files.size(name) is None:
        raise Damaged(f"{path} is not an image: it contains neither {MANIFEST} nor {LAYOUT}")
    return _parse(path, name, _document(path, files, name))


def _parsed(path: Path, name: str, content: bytes) -> dict[str, Any]:
    found = _parse(path, name, content)
    if not isinstance(found, dict):
        raise Damaged(f"{path}: {name} is not a JSON object")
    return found


def _parse(path: Path, name: str, content: bytes) -> Any:
    try:
        return json.loads(content)
    except (ValueError, RecursionError) as error:
        raise Damaged(f"{path}: {name} is not JSON: {error}") from error


# ---------------------------------------------------------------- bytes


class _Unzipped:
    """A gzip stream whose errors are raised as Damaged."""

    def __init__(self, packed: BinaryIO, what: str) -> None:
        self._stream = gzip.GzipFile(fileobj=packed)
        self._what = what

    def read(self, size: int = -1) -> bytes:
        try:
            return self._stream.read(size)
        except (zlib.error, EOFError, gzip.BadGzipFile) as error:
            raise Damaged(f"{self._what} is truncated or damaged: {error}") from error


class _Begun:
    """A stream whose beginning was already read."""

    def __init__(self, beginning: bytes, rest: Hashed) -> None:
        self._beginning, self._rest = beginning, rest

    def read(self, size: int = -1) -> bytes:
        if not self._beginning:
            return self._rest.read(size)
        end = len(self._beginning) if size < 0 else size
        part, self._beginning = self._beginning[:end], self._beginning[end:]
        return part


def _unpacked(packed: Hashed, what: str) -> BinaryIO:
    """Return a layer as a tar stream, compressed or not. Raises Damaged for any compression other than gzip."""
    beginning = packed.read(6)
    for magic, called in COMPRESSED.items():
        if beginning.startswith(magic):
            raise Damaged(f"{what} is compressed by {called}, which is not supported; save it with gzip, or uncompressed")
    begun = cast("BinaryIO", _Begun(beginning, packed))
    return cast("BinaryIO", _Unzipped(begun, what)) if beginning.startswith(b"\x1f\x8b") else begun


class _Folder:
    """An OCI layout as a folder. Symbolic links in it are not followed."""

    def __init__(self, root: Path) -> None:
        self._root = root

    def size(self, name: str) -> int | None:
        path = self._root / name
        inside = not any(parent.is_symlink() for parent in (path, *path.parents) if parent.is_relative_to(self._root))
        return path.stat().st_size if inside and path.is_file() else None

    def open(self, name: str) -> contextlib.AbstractContextManager[BinaryIO]:
        return (self._root / name).open("rb")


class _Tar:
    """The files of a tar, by name. Links in it can only lead to other files of the tar."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._places: dict[str, tuple[int, int]] = {}
        links: dict[str, str] = {}
        with path.open("rb") as file:
            if file.read(2) == b"\x1f\x8b":
                raise Damaged(f"{path} is compressed as a whole; gunzip it first")
            file.seek(0)
            for member in _headers(file, path):
                if member.isreg():
                    self._places[_clean(member.name)] = member.offset_data, member.size
                elif member.islnk() or member.issym():
                    links[_clean(member.name)] = _target(member)
        for name in links:
            if (place := self._places.get(_follow(links, name))) is not None:
                self._places.setdefault(name, place)

    def size(self, name: str) -> int | None:
        place = self._places.get(name)
        return None if place is None else place[1]

    @contextlib.contextmanager
    def open(self, name: str) -> Iterator[BinaryIO]:
        offset, size = self._places[name]
        with self._path.open("rb") as file:
            file.seek(offset)
            yield cast("BinaryIO", _Part(file, size))


def _headers(file: BinaryIO, path: Path) -> Iterator[tarfile.TarInfo]:
    """Yield all members of a tar, without reading their contents."""
    for count, (member, _) in enumerate(members(cast("ForwardStream", _Seeking(file, str(path))), str(path))):
        if count >= MOST_MEMBERS:
            raise Damaged(f"{path} has more than {MOST_MEMBERS} files; an image's archive has a few for each layer")
        if member.issparse():
            raise Damaged(f"{path}: {member.name!r} is a sparse file, which image archives do not contain")
        yield member


class _Seeking(ForwardStream):
    """A file whose contents are skipped instead of read."""

    def __init__(self, file: BinaryIO, what: str) -> None:
        super().__init__(file, 1 << 62, what)
        self._file = file

    def seek(self, place: int) -> int:
        if place < self._place:
            raise Damaged(f"{self._what} has a header that points back")
        self._place = self._file.seek(place)
        return self._place


class _Part:
    """The next `size` bytes of a file, from its current position."""

    def __init__(self, file: BinaryIO, size: int) -> None:
        self._file, self._left = file, size

    def read(self, size: int = -1) -> bytes:
        data = self._file.read(self._left if size < 0 else min(size, self._left))
        self._left -= len(data)
        return data


def _clean(name: str) -> str:
    return name.removeprefix("./")


def _target(member: tarfile.TarInfo) -> str:
    """Return the target of a link in an archive. It is always a name in the archive, whatever the link contains."""
    if member.islnk():
        return _clean(member.linkname)
    parts = _clean(member.name).split("/")[:-1]
    for part in member.linkname.split("/"):
        if part == "..":
            parts = parts[:-1]
        elif part not in ("", "."):
            parts.append(part)
    return "/".join(parts)


def _follow(links: Mapping[str, str], name: str) -> str:
    for _ in range(DEPTH):
        if name not in links:
            break
        name = links[name]
    return name
