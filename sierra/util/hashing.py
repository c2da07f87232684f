"""Content identity: canonical JSON (RFC 8785), SHA-256, Merkle hashes.

A pre-image is a JSON object that states the kind of record and the version of its format; `digest` hashes its RFC 8785 form. A
pre-image must not contain a time, a host, a user or an absolute path. Golden hashes in `tests/unit/test_identity.py` pin every
format.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path

from sierra.util.json_types import JsonView
from sierra.util.regular_files import open_regular

FIRST_CHUNK = 1 << 16
"""Number of bytes that are read first. Most files are small, and a large buffer takes longer than their content."""
CHUNK = 1 << 20


def canonical(value: JsonView) -> bytes:
    """Return the canonical form of `value` by RFC 8785."""
    import rfc8785

    return rfc8785.dumps(value)


def canonical_plain(value: Mapping[str, JsonView]) -> bytes:
    """Return the bytes of `canonical` faster, for a flat object with ASCII keys and no floats: only its keys are sorted."""
    from pydantic_core import to_json  # slow to load, and commands that only read need no hash

    return to_json(dict(sorted(value.items())))


def sha256(data: bytes) -> str:
    """Return the SHA-256 of bytes as 64 hexadecimal digits."""
    import hashlib  # takes 4 ms to load, and `sierra --help` hashes nothing

    return hashlib.sha256(data).hexdigest()


def sha256_file(path: Path) -> str:
    """Return the SHA-256 of a file's content as 64 hexadecimal digits, without loading the whole file into memory."""
    import hashlib

    digest, size = hashlib.sha256(), FIRST_CHUNK
    with open_regular(path, buffering=0) as file:
        while content := file.read(size):
            digest.update(content)
            size = CHUNK
    return digest.hexdigest()


def sealed(data: bytes) -> bytes:
    """Return the data with its SHA-256 and a line feed in front, so that `unsealed` can check it."""
    return sha256(data).encode() + b"\n" + data


def unsealed(data: bytes) -> bytes | None:
    """Return the data that `sealed` was given, or None if the SHA-256 does not match."""
    seal, _, content = data.partition(b"\n")
    return content if sha256(content).encode() == seal else None


def digest(kind: str, fields: Mapping[str, JsonView], *, version: int = 1) -> str:
    """Return the id of a record: the SHA-256 of its canonical pre-image. `kind` and `version` name the record's format."""
    return sha256(canonical({"sierra": kind, "format": version, **fields}))


def digest_plain(kind: str, fields: Mapping[str, str]) -> str:
    """Return the same id as `digest`, but much faster, for fields that are all strings."""
    return sha256(canonical_plain({"sierra": kind, "format": 1, **fields}))


def merkle(kind: str, members: Iterable[str], fields: Mapping[str, JsonView] | None = None) -> str:
    """Return the id of a collection: a digest over its members' ids, in their order."""
    if not fields:
        return sha256(canonical_plain({"sierra": kind, "format": 1, "members": list(members)}))
    return digest(kind, {"members": list(members), **fields})


def short(identity: str) -> str:
    """Return the first ten digits of an id, for display."""
    return identity[:10]
