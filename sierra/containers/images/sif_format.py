"""The Singularity Image Format, as apptainer and singularity-ce write it: a header, descriptors, and data.

Layout (https://github.com/sylabs/sif, pkg/sif/sif.go), all little-endian and without padding. The header has 32 bytes that make
the file a script, the magic `SIF_MAGIC\\0`, a version (3 bytes), an architecture (3), a UUID (16), then eight 64-bit numbers:
time of creation, time of modification, number of free descriptors, number of all descriptors, offset and size of the
descriptors, offset and size of the data. A descriptor has 585 bytes: type (32 bits), a flag for being used (8), its id, its
group, the id that it is linked to (32 each), the data's offset, size and size with padding (64 each), two times, user and group
(64 each), a name (128 bytes), and data that depends on its type (384): for a partition its file system, its role (32 each) and
its architecture (3 bytes).

The environment variables and labels may also be in files of its file system. Apptainer writes the variables of an OCI image as
shell code, one `export NAME="${NAME:-"value"}"` or `export NAME="value"` per line. Only lines of that form are read, and only
if a shell would expand nothing in the value; other lines are ignored.
"""

from __future__ import annotations

import hashlib
import json
import struct
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import BinaryIO

from sierra.containers.images.streams import PIECE
from sierra.errors import Damaged, Missing
from sierra.util.json_types import as_object
from sierra.util.lazy_definitions import dataclass, regex
from sierra.util.regular_files import open_regular

LAUNCH, MAGIC = 32, b"SIF_MAGIC\0"
HEADER = struct.Struct("<32s10s3s3s16s8q")
DESCRIPTOR = struct.Struct("<i?IIIqqqqqqq128s384s")
MAX_DESCRIPTORS = 4096
"""The greatest number of descriptors; apptainer reserves space for 48."""
DEFFILE, LABELS, PARTITION, SIGNATURE, JSON = 0x4001, 0x4003, 0x4004, 0x4005, 0x4006
SQUASHFS, PRIMARY, OVERLAY = 1, 2, 4
FILE_SYSTEMS = {1: "squashfs", 2: "ext3", 3: "an archive", 4: "raw", 5: "an encrypted squashfs"}
ARCHITECTURES = (
    *("386", "amd64", "arm", "arm64", "ppc64", "ppc64le", "mips", "mipsle", "mips64", "mips64le", "s390x", "riscv64"),
)
"""The names of architectures 01, 02, and so on."""
MAX_TEXT = 4 << 20
ENVIRONMENT_FILE, LABELS_FILE = ".singularity.d/env/10-docker2singularity.sh", ".singularity.d/labels.json"
EXPORT = regex(r'export ([A-Za-z_]\w*)="(?:\$\{\1:-"?)?([^"$`\\]*)"?\}?"')
WANTED = 1 << 20


@dataclass(frozen=True, slots=True)
class Sif:
    """The parts of a SIF that SIERRA uses: the location of its file system, and its metadata."""

    path: Path
    architecture: str
    offset: int
    size: int
    signed: bool
    recipe: str
    """The definition file from which it was built."""
    labels: dict[str, str]

    def digest(self) -> str:
        """Return the SHA-256 of the file system, without the metadata elsewhere in the file."""
        digest, left = hashlib.sha256(), self.size
        with open_regular(self.path) as file:
            file.seek(self.offset)
            while left and (piece := file.read(min(left, PIECE))):
                digest.update(piece)
                left -= len(piece)
        return digest.hexdigest()


def is_sif(path: Path) -> bool:
    with open_regular(path) as file:
        file.seek(LAUNCH)
        return file.read(len(MAGIC)) == MAGIC


def read(path: Path) -> Sif:
    """Return a SIF's header and descriptors. Raises Damaged if it cannot run here, Missing if it is unreadable."""
    try:
        with open_regular(path) as file:
            return _read(path, file, path.stat().st_size)
    except OSError as error:
        raise Missing(f"{path} cannot be read: {error.strerror or error}") from error


@dataclass(frozen=True, slots=True)
class _Object:
    type: int
    offset: int
    size: int
    extra: bytes

    @property
    def role(self) -> int | None:
        """Return the role of a partition, or None for any other object."""
        return struct.unpack_from("<ii", self.extra)[1] if self.type == PARTITION else None


def _read(path: Path, file: BinaryIO, length: int) -> Sif:
    objects = list(_objects(path, file, length))
    systems = [descriptor for descriptor in objects if descriptor.role == PRIMARY]
    if len(systems) != 1:
        raise Damaged(f"{path} has {len(systems)} primary file systems; a SIF that can run has exactly one")
    if any(descriptor.role == OVERLAY for descriptor in objects):
        raise Damaged(f"{path} has an overlay, whose files are not part of the image's id; remove it with apptainer sif del")
    [system] = systems
    kind = struct.unpack_from("<i", system.extra)[0]
    if kind != SQUASHFS:
        raise Damaged(f"{path}: its file system is {FILE_SYSTEMS.get(kind, 'unknown')}; only squashfs can run")
    architecture = {b"%02d" % number: name for number, name in enumerate(ARCHITECTURES, 1)}.get(system.extra[8:10], "")
    recipe = next((_text(file, descriptor) for descriptor in objects if descriptor.type == DEFFILE), "")
    signed = any(descriptor.type == SIGNATURE for descriptor in objects)
    labels = next((_parsed_labels(_text(file, descriptor)) for descriptor in objects if descriptor.type == LABELS), {})
    return Sif(path, architecture, system.offset, system.size, signed, recipe, labels)


def _objects(path: Path, file: BinaryIO, length: int) -> Iterator[_Object]:
    header = file.read(HEADER.size)
    if len(header) < HEADER.size or header[LAUNCH : LAUNCH + len(MAGIC)] != MAGIC:
        raise Damaged(f"{path} is not a SIF")
    total, offset = HEADER.unpack(header)[8:10]
    if not 0 <= total <= MAX_DESCRIPTORS or not 0 <= offset <= length - total * DESCRIPTOR.size:
        raise Damaged(f"{path}: its header has {total} descriptors at byte {offset}, which is impossible")
    file.seek(offset)
    table = file.read(total * DESCRIPTOR.size)
    for fields in DESCRIPTOR.iter_unpack(table):
        kind, used, start, size, extra = fields[0], fields[1], fields[5], fields[6], fields[13]
        if not used:
            continue
        if start < 0 or size < 0 or start + size > length:
            raise Damaged(f"{path} is truncated: its header has {size} bytes from byte {start} on, which are missing")
        yield _Object(kind, start, size, extra)


def _text(file: BinaryIO, one: _Object) -> str:
    file.seek(one.offset)
    return file.read(min(one.size, MAX_TEXT)).decode("utf-8", "replace")


def wanted(path: str) -> int:
    """Return the number of bytes of a file in the file system that `variables` and `labels` need."""
    return WANTED if path in (ENVIRONMENT_FILE, LABELS_FILE) else 0


def variables(kept: Mapping[str, bytes]) -> dict[str, str]:
    lines = kept.get(ENVIRONMENT_FILE, b"").decode("utf-8", "replace").splitlines()
    return {match[1]: match[2] for line in lines if (match := EXPORT.fullmatch(line.strip()))}


def labels(kept: Mapping[str, bytes]) -> dict[str, str]:
    return _parsed_labels(kept.get(LABELS_FILE, b"{}"))


def _parsed_labels(text: str | bytes) -> dict[str, str]:
    try:
        return {name: str(value) for name, value in as_object(json.loads(text)).items()}
    except (ValueError, RecursionError):
        return {}
