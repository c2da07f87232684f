"""The reader of GraphML: `rows` is `nodes`, `edges` or `graph`, and each node, each edge, or each of both becomes a row.

The columns are the attributes of the element (`id`, `source`, `target`, …) and its values. In a `graph`, a node is a row whose
`source` is its id and that has no `target`, as figures of kind `network` read it; ids of edges are left out. The `key` elements
of the file declare the names, types and defaults of values.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

from sierra.extensions.formats.columnar import Columnar, column_of
from sierra.ingest.base import UnreadableError
from sierra.ingest.missing_values import MissingValues
from sierra.ingest.rewriting import OriginalFile
from sierra.ingest.xml_rows import count_tags, parse, pattern
from sierra.store.type_inference import as_float
from sierra.util.lazy_definitions import dataclass, field

if TYPE_CHECKING:
    import pyarrow as pa

ELEMENTS = {"nodes": ("node",), "edges": ("edge",), "graph": ("node", "edge")}


class GraphMl(Columnar):
    """The reader of GraphML."""

    def table(self, source: OriginalFile) -> pa.Table:
        import pyarrow as pa

        graph = _Graph(ELEMENTS[self.shape.form.rows], MissingValues(self.shape.form.na))
        for _ in parse(source.pieces(), graph):
            pass
        names = dict.fromkeys(name for row in graph.rows for name in row)
        if len(graph.elements) > 1:
            for row in graph.rows:
                row.setdefault("source", row.pop("id", None))
            # a graph without edges has the same columns as others
            names = dict.fromkeys(["source", "target", *graph.declared(), *names])
            del names["id"]
        return pa.table({name: column_of(name, [row.get(name) for row in graph.rows]) for name in names})

    def count(self, source: OriginalFile, written: int) -> int:
        content = source.content()
        return sum(count_tags(content, pattern(f"//{element}"))[0] for element in ELEMENTS[self.shape.form.rows])


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

    elements: tuple[str, ...]
    missing: MissingValues
    rows: list[dict[str, object]] = field(default_factory=list)
    _open: list[dict[str, object]] = field(default_factory=list)
    """The nodes or edges that have begun; a node may contain a graph."""
    _keys: dict[str, _Key] = field(default_factory=dict)
    _defaults: dict[str, object] = field(default_factory=dict)
    _key: _Key | None = None
    """The key of the value or default that is being read."""
    _line: int = 0
    _text: list[str] = field(default_factory=list)

    def declared(self) -> list[str]:
        """Return the names of the values of nodes and edges that the file declares."""
        return [key.name for key in self._keys.values() if key.whose in (*self.elements, "all")]

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
                if name in self.elements:
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
                self._defaults[self._key.name + "/" + self._key.whose] = self._value(self._key, text)
            case "data" if self._key is not None and self._open:
                self._open[-1][self._key.name] = self._value(self._key, text)
                self._key = None
            case "key":
                self._key = None

    def _value(self, key: _Key, text: str) -> object:
        return None if self.missing.has(text) else key.value(text, self._line)

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


def _number(text: str) -> float:
    number = as_float(text)
    return float(text) if number is None else number


TYPES: Mapping[str, Callable[[str], object]] = {
    "boolean": _flag,
    "int": int,
    "long": int,
    "float": _number,
    "double": _number,
    "string": str,
}
"""The function that reads texts of a type, by the type."""
