"""The path of the elements in an XML document that probably are its rows."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence

from sierra.ingest.base import UnreadableError
from sierra.ingest.xml_rows import parse
from sierra.util.lazy_definitions import dataclass, field

DEEPEST = 64
"""The largest number of elements within each other of a document that is looked at."""


def keys_of(content: bytes) -> Mapping[str, str] | None:
    """Return `rows` for the elements that are repeated in a document; None if it has no such elements, or several lists."""
    rows = lists_of(content)
    return {"rows": rows[0]} if len(rows) == 1 else None


def lists_of(content: bytes) -> list[str]:
    """Return the paths of the elements that are repeated in a document, one for each list.

    If elements are repeated within repeated elements, the inner ones are the rows. Other inner elements are columns.
    """
    counted = _Counted()
    try:
        for _ in parse([content], counted):
            pass
    except UnreadableError:
        return []
    repeated = [path for path, most in counted.most.items() if most > 1]
    innermost = [_innermost(path, repeated) for path in _outermost(repeated)]
    names = Counter(path.rpartition("/")[2] for path in counted.most)
    rows = [(path, path.rpartition("/")[2]) for path in innermost if path and path in counted.filled]
    return [f"//{name}" if names[name] == 1 else path for path, name in rows]


def _innermost(path: str, repeated: Sequence[str]) -> str:
    """Return the elements that are repeated within all others; "" if there are several such lists within each other."""
    while within := _outermost(other for other in repeated if other.startswith(f"{path}/")):
        if len(within) > 1:
            return ""  # the rows of one list would have several values of the other
        [path] = within
    return path


@dataclass(slots=True)
class _Counted:
    """The elements of a document by their paths."""

    most: dict[str, int] = field(default_factory=dict)
    """The largest number of elements with a path within one element."""
    filled: set[str] = field(default_factory=set)
    """The paths of elements with attributes, texts, or such elements within them."""
    _within: list[Counter[str]] = field(default_factory=lambda: [Counter()])
    _paths: list[str] = field(default_factory=lambda: [""])

    def start(self, name: str, attributes: Mapping[str, str], line: int) -> None:
        if len(self._paths) > DEEPEST:
            raise UnreadableError(f"line {line}: more than {DEEPEST} elements within each other")
        path = f"{self._paths[-1]}/{name}"
        self._within[-1][path] += 1
        self.most[path] = max(self.most.get(path, 0), self._within[-1][path])
        self._paths.append(path)
        self._within.append(Counter())
        if attributes:
            self._fill()

    def text(self, text: str) -> None:
        if text.strip():
            self._fill()

    def end(self, name: str) -> None:
        self._paths.pop()
        self._within.pop()

    def _fill(self) -> None:
        for path in reversed(self._paths):
            if path in self.filled:
                break
            self.filled.add(path)


def _outermost(paths: Iterable[str]) -> list[str]:
    """Return the paths that are within no other of them."""
    known = dict.fromkeys(paths)
    return [path for path in known if not any(path.startswith(f"{other}/") for other in known)]
