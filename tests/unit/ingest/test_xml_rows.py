"""Elements of XML become rows; what is cut short, hostile or not understood is an error with its line."""

from __future__ import annotations

import gzip
from pathlib import Path
from typing import Any

import pytest

from sierra.config.output_tables import Output
from tests.readings import read_file

HEAD = '<?xml version="1.0" encoding="UTF-8"?>\n<!-- <tripinfo id="no"/> -->\n'
TRIPS = (
    HEAD + '<tripinfos xmlns:xsi="http://www.w3.org/2001/XMLSchema-instance" xsi:noNamespaceSchemaLocation="x.xsd">\n'
    '  <tripinfo id="a&lt;" duration="1.50" vType="">\n    <emissions CO2_abs="7"/>\n  </tripinfo>\n'
    "  <!-- <tripinfo/> --><![CDATA[<tripinfo/>]]>\n"
    "  <tripinfo id='b>' duration=\"2\" rerouteNo='0'/>\n</tripinfos>\n"
)
TWO = [
    {"id": "a<", "duration": 1.5, "vType": None, "emissions.CO2_abs": 7, "rerouteNo": None},
    {"id": "b>", "duration": 2.0, "vType": None, "emissions.CO2_abs": None, "rerouteNo": 0},
]
QUEUE = '<q><data timestep="0.00"><lanes><lane id="x" n="1"/><lane id="y" n="2"/></lanes></data></q>'
LANES = [{"data.timestep": 0.0, "id": "x", "n": 1}, {"data.timestep": 0.0, "id": "y", "n": 2}]
GOOD: list[tuple[str, str, str, list[dict[str, Any]]]] = [
    ("attributes", TRIPS, "//tripinfo", TWO),
    ("a path from the root", TRIPS, "/tripinfos/tripinfo", TWO),
    ("any name", TRIPS, "/*/tripinfo", TWO),
    ("a path that selects nothing", TRIPS, "/tripinfo", []),
    ("elements around a row", QUEUE, "//lane", LANES),
    ("texts", "<r><a>\n 1\n</a><a><b>x</b></a></r>", "//a", [{"a": 1, "b": None}, {"a": None, "b": "x"}]),
    ("line feeds in texts", "<r><a><b>x\ny</b></a></r>", "//a", [{"b": "x\ny"}]),
    ("no rows", "<r/>", "//a", []),
    ("one empty column", '<r><a b=""/><a b="1"/></r>', "//a", [{"b": None}, {"b": 1}]),
]


@pytest.mark.parametrize(("content", "path", "rows"), [case[1:] for case in GOOD], ids=[case[0] for case in GOOD])
def test_elements_become_rows(tmp_path: Path, content: str, path: str, rows: list[Any]) -> None:
    data = content.encode()
    for name, stored in (("t.xml", data), ("t.xml.gz", gzip.compress(data))):
        reading, found = read_file(tmp_path, name, stored, format="xml", rows=path)
        assert not reading.faults
        assert found == rows
        assert list(reading.counted.values()) == [len(rows)]


ENTITY = '<!DOCTYPE r [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;">]><r><a b="&b;"/></r>'
BAD: list[tuple[str, bytes, str]] = [
    ("cut short", TRIPS.encode()[:-5], "line 9: is truncated or not XML"),
    ("cut in a row", TRIPS.encode()[:240], "line 5: is truncated or not XML"),
    ("empty", b"", "line 1: is truncated or not XML (no element found)"),
    ("entities", ENTITY.encode(), "has a document type declaration, which is refused"),
    ("an external document type", b'<!DOCTYPE r SYSTEM "file:///etc/passwd"><r/>', "has a document type declaration"),
    ("an undefined entity", b"<r><tripinfo a='&x;'/></r>", "line 1: is truncated or not XML (undefined entity)"),
    ("not UTF-8", b"<r><tripinfo a='\xff'/></r>", "line 1: is truncated or not XML"),
    ("UTF-16", "<r/>".encode("utf-16"), "is UTF-16"),
    ("an element occurs twice", b"<r>\n<tripinfo><s a='1'/><s a='2'/></tripinfo></r>", "line 2: the row has two values for"),
    ("a row within a row", b"<r><tripinfo>\n<tripinfo/></tripinfo></r>", "line 2: a row within the row of line 1"),
]  # fmt: skip


@pytest.mark.parametrize(("content", "fault"), [case[1:] for case in BAD], ids=[case[0] for case in BAD])
def test_file_that_is_not_understood_is_an_error(tmp_path: Path, content: bytes, fault: str) -> None:
    reading, rows = read_file(tmp_path, "t.xml", content, format="xml", rows="//tripinfo")
    assert rows == []
    assert reading.faults["e0"].startswith(f"t.xml: {fault}")
    assert "\n" not in reading.faults["e0"]


@pytest.mark.parametrize("path", ["", "tripinfo", "//a[@b]", "//a/@b", "/", "//a/", "a | b"])
def test_path_that_is_not_supported_is_an_error(path: str) -> None:
    with pytest.raises(ValueError, match="needs rows, a path of element names"):
        Output(file="t.xml", format="xml", rows=path)
