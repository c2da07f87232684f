"""Values of a YAML file that is not a template: mappings, lists, and each scalar as the text that is written there.

Nothing is constructed and no tag has a meaning, so a file cannot execute anything. Merge keys (`<<`) are merged as YAML 1.1
says. Refused: more than LARGEST bytes, more than DEPTH levels, several documents, keys that occur twice or are not scalars, an
alias within its own anchor, and a document that its aliases expand to more than MOST values.
"""

from __future__ import annotations

import yaml

from sierra.errors import TemplateError
from sierra.templates.notation import DEPTH

LARGEST = 1_000_000
"""Maximum size of a file in bytes."""
MOST = 100_000
"""Maximum number of values after aliases are expanded."""

Plain = str | list["Plain"] | dict[str, "Plain"]


def values(content: bytes, name: str) -> Plain:
    """Return the values of a document; messages call it `name`. An empty document is an empty text. Raises TemplateError."""
    if len(content) > LARGEST:
        raise TemplateError(f"{name}: {len(content)} bytes are too many for settings; at most {LARGEST} are read")
    try:
        text = content.decode("utf-8-sig")
        _check_depth(text, name)
        nodes = list(yaml.compose_all(text, Loader=yaml.SafeLoader))
    except (UnicodeDecodeError, yaml.YAMLError) as error:
        raise TemplateError(f"{name}: not YAML: {' '.join(str(error).split())[:200]}") from error
    if len(nodes) > 1:
        raise TemplateError(f"{name}: {len(nodes)} documents; use one")
    return _Values(name).of(nodes[0], ()) if nodes and nodes[0] is not None else ""


def _check_depth(text: str, name: str) -> None:
    """Check the nesting by events, which do not recurse, before nodes are composed, which do."""
    depth = 0
    for event in yaml.parse(text, Loader=yaml.SafeLoader):
        if isinstance(event, yaml.CollectionStartEvent):
            depth += 1
        elif isinstance(event, yaml.CollectionEndEvent):
            depth -= 1
        if depth > DEPTH:
            raise TemplateError(f"{name}: more than {DEPTH} levels of lists and mappings")


class _Values:
    """Makes values from nodes, and counts them."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._count = 0

    def of(self, node: yaml.Node, within: tuple[int, ...]) -> Plain:
        self._count += 1
        if self._count > MOST:
            raise TemplateError(f"{self._name}: aliases expand it to more than {MOST} values")
        if id(node) in within:
            raise self._wrong(node, "an alias is within its own anchor")
        inside = (*within, id(node))
        if isinstance(node, yaml.MappingNode):
            return self._mapping(node, inside)
        if isinstance(node, yaml.SequenceNode):
            return [self.of(item, inside) for item in node.value]
        return str(node.value)

    def _mapping(self, node: yaml.MappingNode, within: tuple[int, ...]) -> dict[str, Plain]:
        own: dict[str, Plain] = {}
        merged: dict[str, Plain] = {}
        for key, value in node.value:
            if not isinstance(key, yaml.ScalarNode):
                raise self._wrong(key, "a key is not a single value")
            if key.value == "<<" and not key.style:
                merged |= self._merged(value, within)
            elif key.value in own:
                raise self._wrong(key, f"the key {key.value!r} occurs twice")
            else:
                own[key.value] = self.of(value, within)
        return {**merged, **own}

    def _merged(self, node: yaml.Node, within: tuple[int, ...]) -> dict[str, Plain]:
        value = self.of(node, within)
        parts = value if isinstance(value, list) else [value]
        merged: dict[str, Plain] = {}
        for part in reversed(parts):
            if not isinstance(part, dict):
                raise self._wrong(node, "<< needs a mapping")
            merged |= part
        return merged

    def _wrong(self, node: yaml.Node, what: str) -> TemplateError:
        return TemplateError(f"{self._name}: line {node.start_mark.line + 1}: {what}")
