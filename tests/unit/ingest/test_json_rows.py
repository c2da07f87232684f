"""JSON documents and nested JSON lines become tables; what is not understood is an error with its place."""

from __future__ import annotations

import gzip
import json
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.readings import read_file

TWO = [{"t": 1, "v": 0.5}, {"t": 2, "v": None}]
POSES = b'[{"t": 1, "pose": {"x": 0.5, "at": {"z": 3}}}, {"t": 2, "pose": null}]'
FLAT = [{"t": 1, "pose.x": 0.5, "pose.at.z": 3}, {"t": 2, "pose.x": None, "pose.at.z": None}]
ROBOTS = '[{"t": 1, "robots": [{"id": "a"}, {"id": "b"}]}, {"t": 2, "robots": []}, {"t": 3}]'
EACH = [{"t": 1, "robots.id": "a"}, {"t": 1, "robots.id": "b"}, {"t": 2, "robots.id": None}, {"t": 3, "robots.id": None}]
GOOD: list[tuple[str, str, str | bytes, dict[str, Any], list[dict[str, Any]]]] = [
    ("a list of objects", "json", '[\n {"t": 1, "v": 0.5},\n {"t": 2}\n]\n', {}, TWO),
    ("an object of columns", "json", '{"t": [1, 2], "v": [0.5, null]}', {}, TWO),
    ("one object", "json", '{"t": 1, "v": 0.5}', {}, TWO[:1]),
    ("one object with a list", "json", '{"t": 1, "v": [1, 2]}', {}, [{"t": 1, "v": "[1,2]"}]),
    ("an empty list", "json", "[]", {}, []),
    ("empty columns", "json", '{"t": [], "v": []}', {}, []),
    ("nested objects as columns", "json", POSES, {}, FLAT),
    ("nested objects as they are", "json", '[{"pose": {"x": 1}}]', {"flatten": False}, [{"pose": '{"x":1}'}]),
    ("a part of a document", "json", '{"a": {"b/c": [{"t": 1}]}}', {"rows": "a.b/c"}, [{"t": 1}]),
    ("columns in a part", "json", '{"a": {"t": [1, 2]}}', {"rows": "a"}, [{"t": 1}, {"t": 2}]),
    ("a list in each object", "json", ROBOTS, {"unnest": "robots"}, EACH),
    ("a list in one object", "json", '{"t": 1, "xs": [5, 6]}', {"unnest": "xs"}, [{"t": 1, "xs": 5}, {"t": 1, "xs": 6}]),
    ("a list deeper down", "json", '{"a": [{"b": {"xs": [1]}}, {"b": {}}]}', {"rows": "a", "unnest": "b.xs"},
     [{"b.xs": 1}, {}]),
    ("keys in another order", "json", '[{"v": 0.5, "t": 1}, {"t": 2}]', {}, TWO),
    ("all kinds", "json", '[{"a": true, "b": "x\\u00e4", "c": 12345678901234567890}]', {},
     [{"a": True, "b": "xä", "c": 12345678901234567890}]),
    ("nested lines", "jsonl", '{"t": 1, "pose": {"x": 1}}\n\n{"t": 2}\n', {"flatten": True},
     [{"t": 1, "pose.x": 1}, {"t": 2, "pose.x": None}]),
    ("a list in each line", "jsonl", '{"t": 1, "xs": [1, 2]}\n{"t": 2}\n', {"unnest": "xs"},
     [{"t": 1, "xs": 1}, {"t": 1, "xs": 2}, {"t": 2, "xs": None}]),
]  # fmt: skip


@pytest.mark.parametrize(("kind", "content", "keys", "rows"), [case[1:] for case in GOOD], ids=[case[0] for case in GOOD])
def test_objects_become_rows(tmp_path: Path, kind: str, content: str | bytes, keys: dict[str, Any], rows: list[Any]) -> None:
    data = content.encode() if isinstance(content, str) else content
    for name, stored in ((f"t.{kind}", data), (f"t.{kind}.gz", gzip.compress(data))):
        reading, found = read_file(tmp_path, name, stored, format=kind, **keys)
        assert not reading.faults
        assert found == [{name: row.get(name) for name in sorted(found[0], key=list(found[0]).index)} for row in rows]
        assert list(reading.counted.values()) == [len(rows)]


BAD: list[tuple[str, str, str, dict[str, Any], str]] = [
    ("cut short", "json", '[{"t": 1},\n{"t": 2}', {}, "line 2, column 9: is truncated or not JSON"),
    ("empty", "json", "", {}, "column 1: is truncated or not JSON"),
    ("two documents", "json", '{"t": 1}\n{"t": 2}', {}, "line 2, column 1: is truncated or not JSON"),
    ("a key twice", "json", '[{"t": 1, "t": 2}]', {}, "the key 't' occurs twice"),
    ("a list of numbers", "json", "[1, 2]", {}, "item 1: is not an object: 1"),
    ("a number", "json", "1", {}, "is not an object: 1"),
    ("columns of different lengths", "json", '{"t": [1], "v": [1, 2]}', {}, "the column 'v' has 2 values, but the first has 1"),
    ("no such part", "json", '{"a": []}', {"rows": "b"}, "has no 'b' (rows in"),
    ("a name twice", "json", '[{"a.b": 1, "a": {"b": 2}}]', {}, "row 1: two values are named 'a.b'"),
    ("nothing to unnest", "json", '[{"t": 1}, {"t": {"a": 1}}]', {"unnest": "t"}, "row 1: 't' is not a list"),
    ("a number that is too large", "json", '[{"t": 1e400}]', {}, "the number 1e400 is too large"),
    ("too deep", "json", "[" * 100_000, {}, "is nested too deeply"),
    ("a line cut short", "jsonl", '{"t": {"a": 1}}\n\n{"t": 2', {"flatten": True}, "line 3: column 8: is truncated"),
    ("a line that is no object", "jsonl", '{"t": 1}\n[1]\n', {"flatten": True}, "line 2: is not an object: [1]"),
]  # fmt: skip


@pytest.mark.parametrize(("kind", "content", "keys", "fault"), [case[1:] for case in BAD], ids=[case[0] for case in BAD])
def test_document_that_is_not_understood_is_an_error(
    tmp_path: Path, kind: str, content: str, keys: dict[str, Any], fault: str
) -> None:
    reading, rows = read_file(tmp_path, "t.json", content.encode(), format=kind, **keys)
    assert rows == []
    assert reading.faults["e0"].startswith(f"t.json: {fault}")
    assert "\n" not in reading.faults["e0"]


def test_document_is_kept_as_a_file_unless_its_format_is_named(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="not enough values"):
        read_file(tmp_path, "t.json", b"[]")


VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.text(max_size=3),
    lambda inner: st.lists(inner, max_size=2) | st.dictionaries(st.sampled_from(["a", "b", 'c"']), inner, max_size=2),
    max_leaves=4,
)


@pytest.mark.integration
@settings(deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=25)
@given(
    st.lists(st.dictionaries(st.sampled_from(["a", "x y", "b"]), VALUES, max_size=3), max_size=3), st.sampled_from(["", "a"])
)
def test_both_counts_of_any_document_agree(tmp_path: Path, objects: list[dict[str, Any]], unnest: str) -> None:
    reading, _ = read_file(tmp_path, "t.json", json.dumps(objects).encode(), format="json", unnest=unnest)
    lists = (one["a"] if isinstance(one.get("a"), list) else () for one in objects)
    wanted = sum(max(len(items), 1) for items in lists) if unnest else len(objects)
    if reading.faults:
        assert "not a list" in reading.faults["e0"]
    else:
        assert list(reading.counted.values()) == list(reading.rows.values()) == [wanted]
