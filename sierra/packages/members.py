"""The names and hashes of a package's members, as `manifest-sha256.txt` lists them.

    <SHA-256, 64 digits>  <name>

There is a line for each member except the manifest itself, in the order of the names, as `sha256sum -c` reads it. The
identity of a package is the hash of this list, and not that of the file, whose bytes depend on the version of zlib.

A package may come from anybody. A name is accepted only if it means the same place on all systems: a relative path with `/`,
without `.`, `..`, `.git`, backslashes, colons, control characters and surrogates. No two names may be equal if case and Unicode
normalization are ignored, and no name may lead through another one.
"""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Iterable, Iterator, Mapping
from pathlib import PurePosixPath

from sierra.errors import Damaged
from sierra.util.hashing import digest

MANIFEST = "manifest-sha256.txt"
MOST = 1_000_000
"""The largest number of members."""
LONGEST = 1024
"""The largest number of bytes of a name in UTF-8."""
LINE = re.compile(r"([0-9a-f]{64})  (\S.*)")
DEVICE = re.compile(r"(con|prn|aux|nul|com[0-9]|lpt[0-9])(\..*)?", re.IGNORECASE)
"""Names that are devices on Windows, in any folder."""
FORBIDDEN = frozenset('\\:*?"<>|')
"""Characters that some file systems don't allow, or take for separators."""


def package_id(hashes: Mapping[str, str]) -> str:
    """Return the identity of a package from the SHA-256 of its members by name, without the manifest."""
    return digest("package", {"members": [[name, hashes[name]] for name in sorted(hashes)]})


def written(hashes: Mapping[str, str]) -> bytes:
    """Return the content of the manifest."""
    return "".join(f"{hashes[name]}  {name}\n" for name in sorted(hashes)).encode()


def read(content: bytes) -> dict[str, str]:
    """Return the SHA-256 of each member by name. Raises Damaged unless the content is what `written` writes."""
    try:
        lines = content.decode().splitlines()
    except UnicodeDecodeError as error:
        raise Damaged(f"{MANIFEST} is not UTF-8 text") from error
    found: dict[str, str] = {}
    for number, line in enumerate(lines, 1):
        parts = LINE.fullmatch(line)
        if parts is None:
            raise Damaged(f"{MANIFEST}, line {number}: {line[:80]!r} is not a SHA-256 and a name")
        found[parts[2]] = parts[1]
    check_names([*found, MANIFEST])
    if written(found) != content:
        raise Damaged(f"{MANIFEST} is not in the form that SIERRA writes: names in order, each once")
    return found


def check_names(names: Iterable[str]) -> None:
    """Raise Damaged unless all names are safe and different."""
    seen: dict[str, str] = {}
    folders: dict[str, str] = {}
    for count, name in enumerate(names, 1):
        if count > MOST:
            raise Damaged(f"the package has more than {MOST:,} members")
        if problem := unsafe(name):
            raise Damaged(f"the package has a member {name[:100]!r}, but {problem}")
        same = _folded(name)
        if same in seen:
            other = seen[same]
            raise Damaged(f"the package has two members with one name on some systems: {other[:100]!r} and {name[:100]!r}")
        seen[same] = name
        for folder in _folders(same):
            folders.setdefault(folder, name)
    for same in seen.keys() & folders.keys():
        raise Damaged(f"the package has the member {seen[same][:100]!r}, which is a folder of {folders[same][:100]!r}")


def unsafe(name: str) -> str:
    """Return the reason why a name is not safe on all systems; "" if it is."""
    parts = name.split("/")
    if not name.isprintable() or FORBIDDEN.intersection(name):
        return 'names have only printable characters, without \\ : * ? " < > |'
    if name.startswith("/") or ".." in parts:
        return "names must stay inside the package"
    if any(part in ("", ".") or part[-1] in ". " or part[0] == " " for part in parts):
        return "a part of the name is empty, or begins or ends with a blank or a dot"
    if any(map(DEVICE.fullmatch, parts)):
        return "that is a device on Windows"
    if any(part.casefold() == ".git" for part in parts):
        return "git would execute what such a folder says"
    if len(name.encode()) > LONGEST:
        return f"names have at most {LONGEST} bytes"
    return "" if PurePosixPath(name).as_posix() == name else "that is not the shortest form of the path"


def _folded(name: str) -> str:
    return unicodedata.normalize("NFC", unicodedata.normalize("NFD", name).casefold())


def _folders(name: str) -> Iterator[str]:
    for place, character in enumerate(name):
        if character == "/":
            yield name[:place]
