"""The packages that are installed in an image, from the records of its package managers: Debian's, Alpine's, Python's.

Formats: deb-control(5) paragraphs in `var/lib/dpkg/status` (or one file each in `status.d`, as in distroless images),
`lib/apk/db/installed` (P: and V: lines), and `METADATA` of a Python distribution (PEP 566).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from sierra.util.lazy_definitions import regex

STATUS, STATUS_D, APK = "var/lib/dpkg/status", "var/lib/dpkg/status.d/", "lib/apk/db/installed"
METADATA = regex(r"(?:^|/)[^/]+\.(?:dist-info/METADATA|egg-info/PKG-INFO)$")
LISTS, HEAD = 64 << 20, 1 << 16
"""The greatest number of bytes that are read of a manager's list, and of one distribution's metadata."""


def wanted(path: str) -> int:
    """Return the number of bytes of a file that `packages` needs; 0 for a file that it does not need."""
    if path in (STATUS, APK):
        return LISTS
    return HEAD if METADATA.search(path) or (path.startswith(STATUS_D) and not path.endswith(".md5sums")) else 0


def packages(kept: Mapping[str, bytes]) -> dict[str, tuple[str, ...]]:
    """Return sorted lines `name==version` by package manager: dpkg, apk, python."""
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
    """Yield the name and version of each paragraph, except for packages that are marked as no longer installed."""
    for paragraph in text.split("\n\n"):
        fields: dict[str, str] = {}
        for line in paragraph.split("\n"):
            for key in (name, version, *([status] if status else [])):
                if line.startswith(key):
                    fields.setdefault(key, line.removeprefix(key).strip())
        gone = status in fields and "installed" not in fields[status].split()
        if name in fields and version in fields and not gone:
            yield f"{fields[name]}=={fields[version]}"
