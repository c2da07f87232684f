"""Identity is content: canonical JSON (RFC 8785), SHA-256, Merkle hashes.

A pre-image is a JSON object that begins, in meaning, with the kind of record and the version of its
format; `digest` hashes its RFC 8785 form. No time, host, user or absolute path may be in one.
The golden hashes of `tests/test_identity.py` pin every format.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import rfc8785
from pydantic_core import to_json

CHUNK = 1 << 20


def canonical(value: Any) -> bytes:
    """`value` (JSON types only) in the one form that RFC 8785 allows."""
    return rfc8785.dumps(value)


def canonical_plain(value: Mapping[str, Any]) -> bytes:
    """The same bytes as `canonical`, many times as fast, for an object with ASCII keys, and neither floats nor objects in it.

    (What is left of RFC 8785 is the order of keys.)
    """
    return to_json(dict(sorted(value.items())))


def sha256(data: bytes) -> str:
    """The SHA-256 of bytes, as 64 hexadecimal digits."""
    return hashlib.sha256(data).hexdigest()


def sha256_file(path: Path) -> str:
    """The SHA-256 of a file's content, read in pieces of 1 MiB."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def sealed(data: bytes) -> bytes:
    """Data that vouches for itself: after its SHA-256 and a line feed."""
    return sha256(data).encode() + b"\n" + data


def unsealed(data: bytes) -> bytes | None:
    """What was sealed; None where it is not that any more."""
    seal, _, content = data.partition(b"\n")
    return content if sha256(content).encode() == seal else None


def digest(kind: str, fields: Mapping[str, Any], *, version: int = 1) -> str:
    """The id of a record: the SHA-256 of its canonical pre-image.

    `kind` and `version` name the record's format; `fields` holds JSON types only.
    """
    return sha256(canonical({"sierra": kind, "format": version, **fields}))


def digest_plain(kind: str, fields: Mapping[str, str]) -> str:
    """The same id as `digest`, many times as fast, of texts alone."""
    return sha256(canonical_plain({"sierra": kind, "format": 1, **fields}))


def merkle(kind: str, members: Iterable[str], fields: Mapping[str, Any] | None = None) -> str:
    """The id of a collection: a digest over its members' ids, in their order."""
    if not fields:
        return sha256(canonical_plain({"sierra": kind, "format": 1, "members": list(members)}))
    return digest(kind, {"members": list(members), **fields})


def short(identity: str) -> str:
    """An id as it is shown to people: its first ten digits."""
    return identity[:10]
