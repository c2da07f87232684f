"""Container images made by hand: layers, archives of all formats, and SIFs."""

from __future__ import annotations

import gzip
import hashlib
import io
import json
import re
import struct
import tarfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from sierra.containers.images.image import machine

Member = tuple[str, str | bytes] | tarfile.TarInfo
"""A path and the content of the file; a folder ends with a slash; `->` in the path makes a link, `=>` a hard link."""


def layer(*members: Member) -> bytes:
    """Return a tar archive of these members."""
    out = io.BytesIO()
    with tarfile.open(fileobj=out, mode="w", format=tarfile.PAX_FORMAT) as tar:
        for member in members:
            header, content = (member, b"") if isinstance(member, tarfile.TarInfo) else _member(*member)
            tar.addfile(header, io.BytesIO(content))
    return out.getvalue()


def _member(path: str, what: str | bytes) -> tuple[tarfile.TarInfo, bytes]:
    for arrow, kind in ((" -> ", tarfile.SYMTYPE), (" => ", tarfile.LNKTYPE)):
        if arrow in path:
            header = tarfile.TarInfo(path.partition(arrow)[0])
            header.type, header.linkname = kind, path.partition(arrow)[2]
            return header, b""
    header = tarfile.TarInfo(path)
    if path.endswith("/"):
        header.type, header.mode = tarfile.DIRTYPE, 0o755
        return header, b""
    content = what.encode() if isinstance(what, str) else what
    header.size, header.mode = len(content), 0o755 if re.search(r"bin/|\.so|ld-linux", path) else 0o644
    return header, content


def device(path: str) -> tarfile.TarInfo:
    header = tarfile.TarInfo(path)
    header.type, header.devmajor, header.devminor = tarfile.CHRTYPE, 1, 3
    return header


def config(layers: Iterable[bytes], **more: Any) -> bytes:
    """Return an OCI configuration of these layers."""
    diff_ids = ["sha256:" + sha256(one) for one in layers]
    made = {"architecture": machine(), "os": "linux", "rootfs": {"type": "layers", "diff_ids": diff_ids}, **more}
    return json.dumps(made).encode()


def sha256(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def docker_archive(
    path: Path, layers: Sequence[bytes], configuration: bytes | None = None, *, tag: str = "", **changed: bytes | None
) -> Path:
    """Write a docker-archive; `changed` replaces or omits its files: `config`, `manifest`, `layer0`, …"""
    configuration = config(layers) if configuration is None else configuration
    names = [f"{sha256(one)}.tar" for one in layers]
    manifest = [{"Config": f"{sha256(configuration)}.json", "RepoTags": [tag] if tag else None, "Layers": names}]
    files = {
        **{f"layer{place}": (name, one) for place, (name, one) in enumerate(zip(names, layers, strict=True))},
        "config": (f"{sha256(configuration)}.json", configuration),
        "manifest": ("manifest.json", json.dumps(manifest).encode()),
    }
    return _written(path, files, changed)


def oci_archive(
    path: Path,
    layers: Sequence[bytes],
    configuration: bytes | None = None,
    *,
    pack: Callable[[bytes], bytes] = lambda one: gzip.compress(one, mtime=0),
    said: Mapping[str, Any] | None = None,
    **changed: bytes | None,
) -> Path:
    """Write an oci-archive with compressed layers; `said` changes the manifest's description of its first layer."""
    configuration = config(layers) if configuration is None else configuration
    packed = [pack(one) for one in layers]
    described = [_descriptor("layer.v1.tar+gzip", one) for one in packed]
    described[:1] = [{**one, **(said or {})} for one in described[:1]]
    manifest = json.dumps(
        {"schemaVersion": 2, "config": _descriptor("config.v1+json", configuration), "layers": described}
    ).encode()
    index = json.dumps({"schemaVersion": 2, "manifests": [_descriptor("manifest.v1+json", manifest)]}).encode()
    files = {
        **{f"layer{place}": (f"blobs/sha256/{sha256(one)}", one) for place, one in enumerate(packed)},
        "config": (f"blobs/sha256/{sha256(configuration)}", configuration),
        "manifest": (f"blobs/sha256/{sha256(manifest)}", manifest),
        "index": ("index.json", index),
        "layout": ("oci-layout", b'{"imageLayoutVersion": "1.0.0"}'),
    }
    return _written(path, files, changed)


def _descriptor(kind: str, data: bytes) -> dict[str, Any]:
    return {"mediaType": f"application/vnd.oci.image.{kind}", "digest": f"sha256:{sha256(data)}", "size": len(data)}


def _written(path: Path, files: Mapping[str, tuple[str, bytes]], changed: Mapping[str, bytes | None]) -> Path:
    assert changed.keys() <= files.keys()
    kept = {name: changed.get(part, content) for part, (name, content) in files.items()}
    path.write_bytes(layer(*((name, content) for name, content in kept.items() if content is not None)))
    return path


def sif(
    path: Path, system: bytes, *, architecture: bytes = b"02", kind: int = 1, partitions: int = 1, overlays: int = 0
) -> Path:
    """Write a SIF with a file system, in the layout of apptainer: header, descriptors, data."""
    offset = 4096
    header = struct.pack(
        "<32s10s3s3s16s8q", b"#!/usr/bin/env run-singularity\n", b"SIF_MAGIC\0", b"01", architecture, bytes(16),
        *(0, 0, 47, 48, 128, 585 * 48, offset, len(system)),
    )  # fmt: skip
    primary, overlay = (
        struct.pack(
            "<i?IIIqqqqqqq128s384s", 0x4004, True, 1, 1, 0, 32768, len(system), len(system), 0, 0, 0, 0, b"rootfs",
            struct.pack("<ii3s", kind, role, architecture),
        )
        for role in (2, 4)
    )  # fmt: skip
    path.write_bytes((header + primary * partitions + overlay * overlays).ljust(32768, b"\0") + system)
    return path
