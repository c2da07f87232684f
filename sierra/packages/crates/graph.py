"""Entities of an RO-Crate: objects of JSON-LD that refer to one another by `@id`.

Identifiers that are not addresses: `#name` is an entity of this crate, `pkg:…` a program, as a Package URL (purl-spec) writes
its name, version and hash.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from datetime import UTC, datetime
from typing import Any
from urllib.parse import quote

Entity = Mapping[str, Any]
CONTEXT = ("https://w3id.org/ro/crate/1.1/context", "https://w3id.org/ro/terms/workflow-run/context")


class Graph:
    """The entities of a crate, by id, in the order in which they were added."""

    def __init__(self) -> None:
        self._entities: dict[str, Entity] = {}

    def add(self, entity: Entity) -> Entity:
        """Add an entity unless there is one with its id, and return a reference to it."""
        self._entities.setdefault(entity["@id"], entity)
        return ref(entity["@id"])

    def written(self) -> bytes:
        """Return the content of the crate's file. It depends only on the entities and their order."""
        graph = [{name: value for key, entry in node.items() for name, value in _present(key, entry)} for node in self.all()]
        return (
            json.dumps({"@context": CONTEXT, "@graph": graph}, indent=1, ensure_ascii=False, allow_nan=False) + "\n"
        ).encode()

    def all(self) -> Iterable[Entity]:
        """Return the entities."""
        return self._entities.values()


def ref(identifier: str) -> Entity:
    """Return a reference to the entity with this id."""
    return {"@id": identifier}


def local(*words: object) -> str:
    """Return the id of an entity that only this crate knows, from words with any characters."""
    return "#" + "-".join(quote(str(word), safe="") for word in words)


def purl(kind: str, name: str, version: str = "", sha256: str = "") -> str:
    """Return the Package URL of a program."""
    at = f"@{quote(version, safe='')}" if version else ""
    return f"pkg:{kind}/{quote(name, safe='')}{at}" + (f"?checksum=sha256:{sha256}" if sha256 else "")


def moment(time: datetime | None) -> str | None:
    """Return a time in ISO 8601, in UTC, in milliseconds: the validator of crates accepts no finer ones."""
    return None if time is None else time.astimezone(UTC).isoformat(timespec="milliseconds")


def _present(key: str, value: object) -> Iterable[tuple[str, object]]:
    """Yield a property if it has a value. The specification recommends the value itself where a list would have one."""
    if isinstance(value, list | tuple):
        value = value[0] if len(value) == 1 else list(value)
    if value not in (None, "", []):
        yield key, value
