"""What is installed in an image, by what its package managers wrote down: Debian's, Alpine's, Python's.

Formats: deb-control(5) paragraphs in `var/lib/dpkg/status` (or one each in `status.d`, as distroless images have them),
`lib/apk/db/installed` (P: and V: lines), and `METADATA` of a Python distribution (PEP 566).
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping

STATUS, STATUS_D, APK = "var/lib/dpkg/status", "var/lib/dpkg/status.d/", "lib/apk/db/installed"
METADATA = re.compile(r"(?:^|/)[^/]+\.(?:dist-info/METADATA|egg-info/PKG-INFO)$")
LISTS, HEAD = 64 << 20, 1 << 16
"""Bytes that are read of a manager's list, and of one distribution's metadata."""


def wanted(path: str) -> int:
    """How much of a file is needed for `packages`."""
    if path in (STATUS, APK):
        return LISTS
    return HEAD if METADATA.search(path) or (path.startswith(STATUS_D) and not path.endswith(".md5sums")) else 0


def packages(kept: Mapping[str, bytes]) -> dict[str, tuple[str, ...]]:
    """Lines `name==version`, sorted, by who manages them: dpkg, apk, python."""
    found: dict[str, set[str]] = {}
    for path, content in kept.items():
        for manager, line in _lines(path, content.decode("utf-8", "replace")):
            found.setdefault(manager, set()).add(line)
    return {manager: tuple(sorted(lines)) for manager, lines in sorted(found.items())}


def _lines(path: str, text: str) -> Iterator[tuple[str, str]]:
    if path == APK:
        yield from (("apk", line) for line in _paragraphs(text, "P:", "V:", None))
    elif path == STATUS or path.startswith(STATUS_D):
        yield from (("dpkg", line) for line in _paragraphs(text, "Package:", "Version:", "Status:"))
    else:
        header = text.replace("\r\n", "\n").split("\n\n", 1)[0]
        yield from (("python", line) for line in _paragraphs(header, "Name:", "Version:", None))


def _paragraphs(text: str, name: str, version: str, status: str | None) -> Iterator[str]:
    """Each paragraph's name and version, but of those that say that they are not installed any more."""
    for paragraph in text.split("\n\n"):
        fields: dict[str, str] = {}
        for line in paragraph.split("\n"):
            for key in (name, version, *([status] if status else [])):
                if line.startswith(key):
                    fields.setdefault(key, line.removeprefix(key).strip())
        gone = status in fields and "installed" not in fields[status].split()
        if name in fields and version in fields and not gone:
            yield f"{fields[name]}=={fields[version]}"
