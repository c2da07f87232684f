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
import io
import json
import tarfile
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import BinaryIO, Protocol, cast

from sierra.containers.images.image import Image, Kind, machine
from sierra.containers.images.streams import PIECE, ForwardStream, Hashed, Readable, members
from sierra.errors import Damaged, Missing
from sierra.util.hashing import sha256
from sierra.util.json_types import Json, JsonView, as_object, as_texts
from sierra.util.lazy_definitions import dataclass, regex
from sierra.util.regular_files import open_regular

MANIFEST, LAYOUT, INDEX = "manifest.json", "oci-layout", "index.json"
MAX_DOCUMENT = 8 << 20
"""The greatest size in bytes of a manifest or a configuration; the specification requires readers to accept 4 MiB."""
MAX_MEMBERS = 10_000
MAX_LAYERS = 512
MIN_BOUND = 256 << 20
MAX_EXPANSION = 200
"""The greatest ratio of a layer's unpacked size to its size. MIN_BOUND bytes are always allowed. Gzip can reach 1032."""
DIGEST = regex(r"sha256:([0-9a-f]{64})")
HEX = regex(r"(?:^|/)([0-9a-f]{64})(?:\.json)?$")
COMPRESSED = {b"\x28\xb5\x2f\xfd": "zstd", b"BZh": "bzip2", b"\xfd7zXZ": "xz"}
DEPTH = 4


class Files(Protocol):
    """The files of an archive, by name."""

    def size(self, name: str) -> int | None:
        """Return the size of a file in bytes, or None if there is no such file."""

    def open(self, name: str) -> contextlib.AbstractContextManager[Readable]: ...


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
    manifest: str
    """The manifest's digest in this form; empty for a docker-archive, which has none."""
    document: bytes
    """The configuration, byte for byte."""
    config: Mapping[str, JsonView]
    tags: tuple[str, ...]
    """The tags that the image had at its origin."""
    blobs: tuple[Blob, ...]
    files: Files

    @property
    def id(self) -> str:
        return f"sha256:{sha256(self.document)}"

    @property
    def diff_ids(self) -> tuple[str, ...]:
        return diff_ids(self.config)

    @contextlib.contextmanager
    def layer(self, number: int) -> Iterator[ForwardStream]:
        """Yield a layer's files as a tar. Raises Damaged at the end if they differ from those that the configuration names."""
        blob, what = self.blobs[number], f"{self.path}: layer {number + 1} of {len(self.blobs)}"
        with self.files.open(blob.name) as stored:
            packed = Hashed(stored)
            most = max(MIN_BOUND, MAX_EXPANSION * blob.size)
            stream = ForwardStream(_unpacked(packed, what), most, what)
            yield stream
            digest = stream.digest()
            if blob.sha256 and packed.digest() != blob.sha256:
                raise Damaged(f"{what} does not match its manifest: its SHA-256 should begin with {blob.sha256[:12]}")
        if f"sha256:{digest}" != self.diff_ids[number]:
            wanted = self.diff_ids[number][7:19]
            raise Damaged(f"{what} does not match the configuration: its files have SHA-256 {digest[:12]}…, not {wanted}…")

    def check(self) -> list[int]:
        """Read the whole image, and return the sizes of its layers' tars. Raises Damaged if the configuration differs."""
        sizes = []
        for number in range(len(self.blobs)):
            with self.layer(number) as stream:
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
            for number, name in enumerate(names):
                if name not in names[:number]:
                    with self.layer(number) as stream:
                        tar.addfile(_header(name, sizes[number]), cast("BinaryIO", stream))
            for name, content in ((f"{self.id[7:]}.json", self.document), (MANIFEST, json.dumps(manifest).encode())):
                tar.addfile(_header(name, len(content)), io.BytesIO(content))

    def image(self, name: str, *, file: str = "", sha256: str = "") -> Image:
        """Return this image under the name that a project gives it."""
        return image_of(name, self.id, self.config, file=file, sha256=sha256)


def image_of(name: str, identity: str, config: Mapping[str, JsonView], *, file: str = "", sha256: str = "") -> Image:
    """Return the image that a configuration describes."""
    architecture = str(config.get("architecture") or "")
    return Image(name, identity, Kind.OCI, architecture, diff_ids(config), variables(config), file, sha256)


def diff_ids(config: Mapping[str, JsonView]) -> tuple[str, ...]:
    return as_texts(as_object(config.get("rootfs")).get("diff_ids"))


def variables(config: Mapping[str, JsonView]) -> dict[str, str]:
    """Return the variables that a configuration sets. Of several values, the last one is used, as engines do."""
    pairs = (one.partition("=") for one in as_texts(as_object(config.get("config")).get("Env")))
    return {name: value for name, _, value in pairs if name}


def labels(config: Mapping[str, JsonView]) -> dict[str, str]:
    found = as_object(as_object(config.get("config")).get("Labels"))
    return {name: str(value) for name, value in found.items()}


def is_archive(path: Path) -> bool:
    """Return whether a file is a tar or a folder is an OCI layout. Either may be damaged."""
    if path.is_dir():
        return (path / LAYOUT).is_file() or (path / INDEX).is_file()
    with open_regular(path) as file:
        return file.read(265)[257:262] == b"ustar"


def read(path: Path) -> Archive:
    """Return the only image in an archive or an OCI layout, without reading its layers. Raises Damaged, Missing."""
    try:
        files: Files = _Folder(path) if path.is_dir() else _Tar(path)
        if files.size(LAYOUT) is not None or (files.size(INDEX) is not None and files.size(MANIFEST) is None):
            return _oci(path, files)
        return _docker(path, files)
    except OSError as error:
        raise Missing(f"{path} cannot be read: {error.strerror or error}") from error


# ---------------------------------------------------------------- docker-archive


def _docker(path: Path, files: Files) -> Archive:
    index = _json(path, files, MANIFEST)
    entry = _only(path, index, lambda item: ", ".join(as_texts(item.get("RepoTags"))) or "untagged")
    name, listed = entry.get("Config"), entry.get("Layers")
    layers = as_texts(listed)
    if not isinstance(name, str) or not isinstance(listed, list) or len(layers) != len(listed):
        raise Damaged(f"{path}: {MANIFEST} names no configuration, or no layers")
    digest = HEX.search(name)
    content = _document(path, files, name)
    if digest and sha256(content) != digest[1]:
        raise Damaged(f"{path}: the configuration {name} does not match the hash in its name")
    config = _parsed(path, name, content)
    blobs = tuple(Blob(layer, _size(path, files, layer, f"layer {number + 1}")) for number, layer in enumerate(layers))
    tags = as_texts(entry.get("RepoTags"))
    return _checked(Archive(path, "docker-archive", "", content, config, tags, blobs, files))


def _only(path: Path, listed: JsonView, name: Callable[[Mapping[str, JsonView]], str]) -> Mapping[str, JsonView]:
    """Return the only image of a list. Raises Damaged if the list has none or several."""
    images = [item for item in listed if isinstance(item, dict)] if isinstance(listed, list) else []
    if not images or not isinstance(listed, list) or len(images) != len(listed):
        raise Damaged(f"{path} contains no image")
    if len(images) > 1:
        names = "; ".join(map(name, images[:3]))
        raise Damaged(f"{path} contains {len(images)} images ({names}{'; …' * (len(images) > 3)}); save only one")
    return images[0]


# ---------------------------------------------------------------- OCI layouts


def _oci(path: Path, files: Files) -> Archive:
    form = "oci" if path.is_dir() else "oci-archive"
    digest, manifest = _manifest(path, files, _json(path, files, INDEX), DEPTH)
    content, config, _ = _referenced(path, files, manifest.get("config"), "the configuration")
    listed = manifest.get("layers")
    if not isinstance(listed, list):
        raise Damaged(f"{path}: its manifest names no layers")
    blobs = tuple(_descriptor(path, files, item, f"layer {number + 1}") for number, item in enumerate(listed))
    return _checked(Archive(path, form, digest, content, config, (), blobs, files))


def _manifest(path: Path, files: Files, index: JsonView, depth: int) -> tuple[str, Mapping[str, JsonView]]:
    """Return the digest and content of the only manifest in an index, or of the only one for this machine's architecture.

    It may be in another index that this one names; `depth` is the largest number of these, one in another.
    """
    listed = as_object(index).get("manifests")
    if isinstance(listed, list) and len(listed) > 1:
        platforms = [as_object(as_object(item).get("platform")) for item in listed]
        mine = [item for item, platform in zip(listed, platforms, strict=True) if platform.get("architecture") == machine()]
        listed = mine or listed
    entry = _only(path, listed, lambda item: str(item.get("digest"))[:19])
    _, manifest, digest = _referenced(path, files, entry, "the manifest")
    is_index = "manifests" in manifest and "config" not in manifest
    if is_index and depth:
        return _manifest(path, files, manifest, depth - 1)
    return f"sha256:{digest}", manifest


def _descriptor(path: Path, files: Files, value: JsonView, what: str) -> Blob:
    """Return a blob that a document names by digest and size. Checks that it exists with that size, but does not read it."""
    fields = as_object(value)
    digest = DIGEST.fullmatch(str(fields.get("digest")))
    if digest is None:
        raise Damaged(f"{path}: {what} is not identified by a SHA-256")
    name = f"blobs/sha256/{digest[1]}"
    size = _size(path, files, name, what)
    if size != fields.get("size"):
        raise Damaged(f"{path}: {what} has {size} bytes, but should have {fields.get('size')}")
    return Blob(name, size, digest[1])


def _referenced(path: Path, files: Files, value: JsonView, what: str) -> tuple[bytes, Mapping[str, JsonView], str]:
    """Return the document that another document names: its bytes, its content and its SHA-256."""
    blob = _descriptor(path, files, value, what)
    content = _document(path, files, blob.name)
    if sha256(content) != blob.sha256:
        raise Damaged(f"{path}: {what} does not match its digest: its SHA-256 should begin with {blob.sha256[:12]}")
    return content, _parsed(path, blob.name, content), blob.sha256


# ---------------------------------------------------------------- both formats


def _checked(archive: Archive) -> Archive:
    """Return the archive. Raises Damaged if the configuration is invalid, or does not match the list of layers."""
    path, layers = archive.path, len(archive.blobs)
    if not _is_valid(archive.config):
        raise Damaged(f"{path}: the configuration is not a valid OCI image configuration")
    if len(archive.diff_ids) != layers:
        raise Damaged(f"{path}: the configuration names {len(archive.diff_ids)} layers, the manifest {layers}")
    if layers > MAX_LAYERS:
        raise Damaged(f"{path} has {layers} layers; at most {MAX_LAYERS} are read")
    return archive


def _is_valid(config: Mapping[str, JsonView]) -> bool:
    """Check the types of all fields of a configuration that are used."""
    listed = as_object(config.get("rootfs")).get("diff_ids")
    settings = as_object(config.get("config"))
    variables = settings.get("Env") or []
    return (
        isinstance(listed, list | None)
        and all(isinstance(item, str) and DIGEST.fullmatch(item) for item in listed or ())
        and isinstance(config.get("architecture", ""), str)
        and isinstance(variables, list)
        and all(isinstance(item, str) and "\0" not in item for item in variables)
        and isinstance(settings.get("Labels") or {}, dict)
    )


def _header(name: str, size: int) -> tarfile.TarInfo:
    header = tarfile.TarInfo(name)
    header.size = size
    return header


def _size(path: Path, files: Files, name: str, what: str) -> int:
    size = files.size(name)
    if size is None:
        raise Damaged(f"{path}: {what} is missing ({name[:80]!r})")
    return size


def _document(path: Path, files: Files, name: str) -> bytes:
    size = _size(path, files, name, "a document")
    if size > MAX_DOCUMENT:
        raise Damaged(f"{path}: {name[:80]!r} has {size} bytes; at most {MAX_DOCUMENT} are allowed")
    with files.open(name) as file:
        return file.read(MAX_DOCUMENT)


def _json(path: Path, files: Files, name: str) -> Json:
    if files.size(name) is None:
        raise Damaged(f"{path} is not an image: it contains neither {MANIFEST} nor {LAYOUT}")
    return _parse(path, name, _document(path, files, name))


def _parsed(path: Path, name: str, content: bytes) -> Mapping[str, JsonView]:
    found = _parse(path, name, content)
    if not isinstance(found, dict):
        raise Damaged(f"{path}: {name} is not a JSON object")
    return found


def _parse(path: Path, name: str, content: bytes) -> Json:
    try:
        found: Json = json.loads(content)
    except (ValueError, RecursionError) as error:
        raise Damaged(f"{path}: {name} is not JSON: {error}") from error
    return found


# ---------------------------------------------------------------- bytes


def _unpacked(packed: Hashed, what: str) -> Readable:
    """Return a layer as a tar stream, compressed or not. Raises Damaged for any compression other than gzip."""
    stored = io.BufferedReader(packed, PIECE)
    beginning = stored.peek(6)
    for magic, name in COMPRESSED.items():
        if beginning.startswith(magic):
            raise Damaged(f"{what} is compressed by {name}, which is not supported; save it with gzip, or uncompressed")
    return gzip.GzipFile(fileobj=stored) if beginning.startswith(b"\x1f\x8b") else stored


class _Folder:
    """An OCI layout as a folder. Symbolic links in it are not followed."""

    def __init__(self, root: Path) -> None:
        self._root = root

    def size(self, name: str) -> int | None:
        path = self._root / name
        inside = not any(parent.is_symlink() for parent in (path, *path.parents) if parent.is_relative_to(self._root))
        return path.stat().st_size if inside and path.is_file() else None

    def open(self, name: str) -> contextlib.AbstractContextManager[BinaryIO]:
        return open_regular(self._root / name)


class _Tar:
    """The files of a tar, by name. Links in it can only lead to other files of the tar."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._places: dict[str, tuple[int, int]] = {}
        links: dict[str, str] = {}
        with open_regular(path) as file:
            if file.read(2) == b"\x1f\x8b":
                raise Damaged(f"{path} is compressed as a whole; gunzip it first")
            file.seek(0)
            for member in _headers(file, path):
                if member.isreg():
                    self._places[_clean(member.name)] = member.offset_data, member.size
                elif member.islnk() or member.issym():
                    links[_clean(member.name)] = _target(member)
        for name in links:
            if (span := self._places.get(_follow(links, name))) is not None:
                self._places.setdefault(name, span)

    def size(self, name: str) -> int | None:
        place = self._places.get(name)
        return None if place is None else place[1]

    @contextlib.contextmanager
    def open(self, name: str) -> Iterator[Readable]:
        offset, size = self._places[name]
        with open_regular(self._path) as file:
            file.seek(offset)
            yield _Part(file, size)


def _headers(file: BinaryIO, path: Path) -> Iterator[tarfile.TarInfo]:
    """Yield all members of a tar, without reading their contents."""
    for count, (member, _) in enumerate(members(_Seeking(file, str(path)), str(path))):
        if count >= MAX_MEMBERS:
            raise Damaged(f"{path} has more than {MAX_MEMBERS} files; an image's archive has a few for each layer")
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
