"""Templates of keys, lists and values with the same data in each format, and helpers to change them."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from hypothesis import strategies as st

from sierra.config.plugin_registry import TEMPLATES
from sierra.model import Change, Value
from sierra.templates.base import Template

JSON = """\
{
  "swarm": {"count": 8, "name": "blue", "speed": 0.5, "on": true, "nothing": null},
  "robots": [
    {"name": "r1", "x": 1},
    {"name": "r2", "x": 2}
  ],
  "my key/2": 5, "empty": []
}
"""
YAML = """\
# a swarm
swarm:   # the robots
    count: 8  # robots
    name: blue
    speed: 0.5
    "on": true
robots:
  - {name: r1, x: 1}
  -  name: 'r2'
     x: 2   # the last
my key/2: 5

empty: []
"""
TOML = """\
# a swarm
"my key/2" = 5
empty = []

[swarm]   # the robots
  count = 8  # robots
  name = "blue"
  speed = 0.5
  on = true

[[robots]]
name = "r1"
x = 1

# the other
[[robots]]
name = 'r2'
x = 0x2   # the last
"""
SAMPLES = {"json": JSON, "yaml": YAML, "toml": TOML}
TEXT_PLACES = ["/swarm/name", "/robots/item[2]/name", "/swarm/count", "//robots/item[2]/x"]


SCALARS = st.one_of(
    st.integers(-(10**20), 10**20),
    st.floats(allow_nan=False, allow_infinity=False),
    st.text(max_size=8),
    st.booleans(),
    st.none(),
)
DATA = st.recursive(
    SCALARS, lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=6), inner, max_size=4), max_leaves=12
)


def leaves(data: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[tuple[Any, ...], Any]]:
    """Yield the single values of a document in order, with their kind."""
    if isinstance(data, dict | list):
        for key, value in data.items() if isinstance(data, dict) else enumerate(data):
            yield from leaves(value, (*path, key))
    else:
        yield path, (type(data).__name__, data)


def make(format: str, data: str | bytes, name: str = "template") -> Template:
    template: Template = TEMPLATES.make(format, {}, data.encode() if isinstance(data, str) else data, name)
    return template


def rendered(template: Template, *changes: Change, **values: Value) -> str:
    made = template.changed(changes, values).render()
    assert isinstance(made, bytes)
    return made.decode()


def only_line(before: str, after: str) -> list[tuple[str, str]]:
    """Return the lines that differ; the number of lines is the same."""
    pairs = zip(before.splitlines(keepends=True), after.splitlines(keepends=True), strict=True)
    return [(one.strip(), other.strip()) for one, other in pairs if one != other]
