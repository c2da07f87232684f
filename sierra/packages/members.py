"""The names and hashes of a package's members, as `manifest-sha256.txt` lists them.

    <SHA-256, 64 digits>  <name>

There is a line for each member except the manifest itself, in the order of the names, as `sha256sum -c` reads it. The
identity of a package is the hash of this list, and not that of the file, whose bytes depend on the version of zlib.

A package may come from anybody. A name is accepted only if it means the same place on all systems: a relative path with `/`,
without `.`, `..`, `.git`, backslashes, colons, control characters and surrogates. No two names may be equal if case and Unicode
normalization are ignored, and no name may lead through another one. `sierra.worker.reproduce`, which also checks packages
where SIERRA is not installed, has these checks.
"""

from __future__ import annotations

from collections.abc import Mapping

from sierra.util.hashing import digest
from sierra.worker import reproduce

MANIFEST = reproduce.MANIFEST
unsafe = reproduce.name_problem
"""The function that returns why a name is not safe on all systems; "" if it is."""


def package_id(hashes: Mapping[str, str]) -> str:
    """Return the identity of a package from the SHA-256 of its members by name, without the manifest."""
    return digest("package", {"members": [[name, hashes[name]] for name in sorted(hashes)]})


def written(hashes: Mapping[str, str]) -> bytes:
    """Return the content of the manifest."""
    return "".join(f"{hashes[name]}  {name}\n" for name in sorted(hashes)).encode()
