"""The reader of GraphML: `rows` is `nodes` or `edges`, and each of them becomes a row.

The columns are the attributes of the element (`id`, `source`, `target`, …) and its values. The `key` elements of the file
declare the names, types and defaults of values.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from sierra.ingest.base import UnreadableError
from sierra.ingest.columnar import Columnar, column_of
from sierra.ingest.rewriting import Source
from sierra.ingest.xml_rows import count_tags, parse, pattern

if TYPE_CHECKING:
    import pyarrow as pa

ELEMENT = {"nodes": "node", "edges": "edge"}


class GraphMl(Columnar):
    """The reader of GraphML."""

    def table(self, source: Source) -> pa.Table:
        import pyarrow as pa

        graph = _Graph(ELEMENT[self.shape.form.rows])
        for _ in parse(source, graph):
            pass
        names = dict.fromkeys(name for row in graph.rows for name in row)
        return pa.table({name: column_of(name, [row.get(name) for row in graph.rows]) for name in names})

    def count(self, source: Source, written: int) -> int:
        return count_tags(source.content(), pattern(f"//{ELEMENT[self.shape.form.rows]}"))


@dataclass(frozen=True, slots=True)
class _Key:
    """The declaration of a value."""

    name: str
    type: str
    whose: str

    def value(self, text: str, line: int) -> object:
        """Return a value from its text. Raises UnreadableError."""
        try:
            return TYPES[self.type](text)
        except (ValueError, LookupError) as error:
            raise UnreadableError(f"line {line}: {self.name!r} is no {self.type}: {text[:80]!r}") from error


@dataclass(slots=True)
class _Graph:
    """The rows of a file, filled by a parser's events."""

    element: str
    rows: list[dict[str, object]] = field(default_factory=list)
    _open: list[dict[str, object]] = field(default_factory=list)
    """The nodes or edges that have begun; a node may contain a graph."""
    _keys: dict[str, _Key] = field(default_factory=dict)
    _defaults: dict[str, object] = field(default_factory=dict)
    _key: _Key | None = None
    """The key of the value or default that is being read."""
    _line: int = 0
    _text: list[str] = field(default_factory=list)

    def start(self, name: str, attributes: Mapping[str, str], line: int) -> None:
        self._text.clear()
        self._line = line
        match name:
            case "key":
                self._declare(attributes, line)
            case "hyperedge":
                raise UnreadableError(f"line {line}: has a hyperedge, which is not an edge between two nodes")
            case "node" | "edge":
                row: dict[str, object] = {**attributes, **self._default_values(name)}
                self._open.append(row)
                if name == self.element:
                    self.rows.append(row)
            case "data" if self._open:
                self._key = self._known(attributes.get("key", ""), line)

    def text(self, text: str) -> None:
        self._text.append(text)

    def end(self, name: str) -> None:
        text = "".join(self._text)
        match name:
            case "node" | "edge":
                self._open.pop()
            case "default" if self._key is not None:
                self._defaults[self._key.name + "/" + self._key.whose] = self._key.value(text, self._line)
            case "data" if self._key is not None and self._open:
                self._open[-1][self._key.name] = self._key.value(text, self._line)
                self._key = None
            case "key":
                self._key = None

    def _declare(self, attributes: Mapping[str, str], line: int) -> None:
        key = _Key(
            attributes.get("attr.name", attributes.get("id", "")),
            attributes.get("attr.type", "string"),
            attributes.get("for", "all"),
        )
        if key.name in ("id", "source", "target"):
            raise UnreadableError(f"line {line}: a value has the name of the attribute {key.name!r}")
        self._keys[attributes.get("id", "")] = self._key = key

    def _default_values(self, element: str) -> dict[str, object]:
        return {
            name: value
            for name, whose, value in ((*key.rpartition("/")[::2], value) for key, value in self._defaults.items())
            if whose in (element, "all")
        }

    def _known(self, key: str, line: int) -> _Key:
        if key not in self._keys:
            raise UnreadableError(f"line {line}: the key {key!r} is not declared")
        return self._keys[key]


def _flag(text: str) -> bool:
    return {"true": True, "1": True, "false": False, "0": False}[text.strip().lower()]


TYPES: Mapping[str, Callable[[str], object]] = {
    "boolean": _flag,
    "int": int,
    "long": int,
    "float": float,
    "double": float,
    "string": str,
}
"""The function that reads texts of a type, by the type."""
