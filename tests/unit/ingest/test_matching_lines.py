"""Lines that match `lines` are rows: none is lost, cut or guessed, and those in no table are counted."""

from __future__ import annotations

import gzip
import re
import time
import tomllib
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from sierra.config import project_file
from sierra.errors import ConfigError
from sierra.ingest.matching_lines import UnmatchedLines
from sierra.ingest.rewriting import OriginalFile
from tests import projects
from tests.readings import read_file, read_files, written

STEP = r"step=(?P<step>\d+) score=(?P<score>\S+)"
TWO = [{"step": 1, "score": 0.5}, {"step": 2, "score": 1.5}]
TEXT = b"begin\nstep=1 score=0.5\n\n[info] step=2 score=1.5 (fine)\nend\n"
GOOD: list[tuple[str, bytes, dict[str, Any], list[dict[str, Any]]]] = [
    ("anywhere in lines", TEXT, {"lines": STEP}, TWO),
    ("only at the beginning", TEXT, {"lines": "^" + STEP}, TWO[:1]),
    ("line ends of Windows", TEXT.replace(b"\n", b"\r\n"), {"lines": STEP + r"(?: \(fine\))?$"}, TWO),
    ("no line feed at the end", TEXT.removesuffix(b"end\n")[:-1], {"lines": STEP}, TWO),
    ("other text without a line feed at the end", TEXT[:-1], {"lines": STEP}, TWO),
    ("a byte order mark", b"\xef\xbb\xbf" + TEXT[6:], {"lines": "^" + STEP}, TWO[:1]),
    ("other lines that are not UTF-8 or have NUL", b"\xff\x00\n" + TEXT + b"\x1b[1m\n", {"lines": STEP}, TWO),
    ("ASCII and other letters", "ü step=1 score=0.5 ü\nstep=2 score=1.5\n".encode(), {"lines": STEP}, TWO),
    ("decimal commas", b"v=0,5\nv=1\n", {"lines": "v=(?P<v>[0-9,]+)", "decimal": ","}, [{"v": 0.5}, {"v": 1.0}]),
    ("two that only one place can be", b"v=1v=2\nv=3v=\n", {"lines": r"^v=(?P<v>\d)"}, [{"v": 1}, {"v": 3}]),
    ("missing values", b"v=NA\nv=2\n", {"lines": r"v=(?P<v>\w+)", "na": ("NA",)}, [{"v": None}, {"v": 2}]),
    ("groups that are not in a match", b"a=1\na=2 b=3\n", {"lines": r"a=(?P<a>\d+)(?: b=(?P<b>\d+))?"},
     [{"a": 1, "b": None}, {"a": 2, "b": 3}]),
    ("empty groups", b"a=;\na=1;\n", {"lines": r"a=(?P<a>\d*);"}, [{"a": None}, {"a": 1}]),
    ("texts of CSV", b'say a "b", c\n', {"lines": "say (?P<text>.+)"}, [{"text": 'a "b", c'}]),
    ("parts of versions", b"v1.25.3\n", {"lines": r"v(?P<major>\d+)\.(?P<minor>\d+)[.\d]*"}, [{"major": 1, "minor": 25}]),
    ("groups for all parts", b"a=0.53 b=-2e7\n", {"lines": r"a=(?P<a>\d+)\.(?P<b>\d+) b=(?P<sign>-)(?P<c>\d)e(?P<d>\d)"},
     [{"a": 0, "b": 53, "sign": "-", "c": 2, "d": 7}]),
    ("signs within words and ranges", b"x-12 a=1-2 f(3)-4 2026-11-30\n",
     {"lines": r"x-(?P<a>\d+) a=1-(?P<b>\d) f\(3\)-(?P<c>\d) (?P<year>\d+)-(?P<month>\d+)"},
     [{"a": 12, "b": 2, "c": 4, "year": 2026, "month": 11}]),
    ("dots that are no points", b"1..10 done.5 end 7.\n", {"lines": r"(?P<a>\d)\.\.(?P<b>\d+) done\.(?P<c>\d) end (?P<d>\d)"},
     [{"a": 1, "b": 10, "c": 5, "d": 7}]),
    ("no matching line", b"begin\n", {"lines": STEP}, []),
    ("an empty file", b"", {"lines": STEP}, []),
]  # fmt: skip


@pytest.mark.parametrize(("content", "keys", "rows"), [case[1:] for case in GOOD], ids=[case[0] for case in GOOD])
def test_lines_that_match_are_rows(tmp_path: Path, content: bytes, keys: dict[str, Any], rows: list[Any]) -> None:
    for name, stored in (("log.txt", content), ("log.json", content), ("log.gz", gzip.compress(content))):
        reading, found = read_file(tmp_path, name, stored, **keys)
        assert not reading.faults
        assert found == rows
        assert list(reading.counted.values()) == [len(rows)]


BAD: list[tuple[str, bytes, str, str]] = [
    ("not UTF-8", b"x\nstep=1 score=\xff\n", STEP, "line 2: is not UTF-8: 'step=1 score=\ufffd'"),
    ("NUL", b"step=1 score=2\x00\n", STEP, r"line 1: the column 'score' has control characters: '2\x00'"),
    ("colours", b"\nscore=\x1b[1m2\x1b[0m\n", r"score=(?P<score>\S+)", "line 2: the column 'score' has control characters"),
    ("two matches", b"v=1\nv=1 v=2\n", r"v=(?P<v>\d+)", "line 2: lines matches several times in it, but it is one row"),
    ("part of a number", b"v=1\nv=0.53\n", r"v=(?P<v>\d+)", "line 2: the column 'v' would be '0', but the number goes on"),
    ("number without its exponent", b"v=1.5e-7\n", r"v=(?P<v>[.\d]+)", "would be '1.5', but the number goes on: 'v=1.5e-7'"),
    ("end of a number", b"took 12.5 ms\n", r"(?P<took>\d+) ms$", "would be '5', but the number begins earlier: 'took 12.5 ms'"),
    ("number of which two parts match", b"0.53\n", r"(?P<v>\d+)", "would be '0', but the number goes on"),
    ("number without its sign", b"energy: -12.5 J\n", r"(?P<energy>\d+\.\d+) J", "would be '12.5', but the number begins"),
    ("sign of Unicode", "v: \u22125\n".encode(), r"(?P<v>\d)", "would be '5', but the number begins earlier"),
    ("not the last group", b"a=0.5 b=7\n", r"a=(?P<a>\d+).*b=(?P<b>\d+)", "would be '0', but the number goes on"),
    ("decimal comma", b"comma=3,14\n", r"comma=(?P<comma>\d+)", "would be '3', but the number goes on"),
    ("thousands", b"x 1,234\n", r"x (?P<thousand>\d+)", "would be '1', but the number goes on"),
    ("hexadecimal number", b"hex=0x1F\n", r"hex=(?P<h>\d+)", "would be '0', but the number goes on"),
    ("number with _", b"v=1_000\n", r"v=(?P<v>\d+)", "would be '1', but the number goes on"),
    ("exponent", b"v=1.5e-7\n", r"e(?P<v>-?\d+)", "would be '-7', but the number begins earlier"),
    ("fraction", b"v= .75\n", r"(?P<v>\d+)", "would be '75', but the number begins earlier"),
]  # fmt: skip


@pytest.mark.parametrize(("content", "lines", "fault"), [case[1:] for case in BAD], ids=[case[0] for case in BAD])
def test_line_in_doubt_is_an_error_with_its_number(tmp_path: Path, content: bytes, lines: str, fault: str) -> None:
    reading, found = read_file(tmp_path, "log.txt", content, lines=lines)
    assert (found, fault in reading.faults["e0"]) == ([], True), reading.faults


def test_last_line_is_truncated_if_siblings_end_with_a_line_feed(tmp_path: Path) -> None:
    paths = [tmp_path / str(place) / "log.txt" for place in range(3)]
    reading, _ = read_files(tmp_path, paths, [TEXT, TEXT, TEXT[:40]], lines=STEP)
    assert reading.faults == {"e2": "log.txt: line 4: the last line is truncated (it does not end with a line feed)"}


def test_huge_line_and_nested_repetitions_take_linear_time(tmp_path: Path) -> None:
    content = b"a" * 3_000_000 + b"!\n" + b"a" * 3_000_000 + b"\n"
    began = time.monotonic()
    reading, found = read_file(tmp_path, "log.txt", content, lines="^(?P<text>(?:a+)+)$")
    assert not reading.faults
    assert [len(row["text"]) for row in found] == [3_000_000]
    assert time.monotonic() - began < 30


@settings(deadline=None, max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(st.text(alphabet="v=12 ,\"'\t\r#é", max_size=8), max_size=6))
def test_rows_are_those_of_pythons_engine(tmp_path: Path, lines: list[str]) -> None:
    pattern = r"^v=(?P<v>[^\r]*),(?P<w>[12]+)$"
    matches = (re.search(pattern.replace("$", r"\Z"), line.removesuffix("\r"), re.ASCII) for line in lines)
    expected = [int(match["w"]) for match in matches if match]
    reading, found = read_file(tmp_path, "log.txt", "".join(f"{line}\n" for line in lines).encode(), lines=pattern)
    assert not reading.faults
    assert [row["w"] for row in found] == expected


def test_lines_that_no_output_of_the_file_matches_are_counted_once(tmp_path: Path) -> None:
    unmatched = UnmatchedLines()
    assert list(unmatched.notes()) == []
    for place in range(2):
        unmatched.add(f"r{place}", OriginalFile(written(tmp_path / "log.txt", place, TEXT)), [STEP, "^(?P<word>begin)"])
    [note] = unmatched.notes()
    assert note == "2 lines of log.txt in 2 runs are in no table, because no lines of [outputs] match: 'end'"


REFUSED = [
    (r"lines = 'step=(\d+)'", r"has no named group; write each column as a group, such as 'step=(?P<step>\\d+)'"),
    (r"lines = '(?P<a>\d+) (\d+)'", "has a group without a name; write (?P<name>…) for a column, or else (?:…)"),
    (r"lines = '(?P<a>\d+'", "is not a regular expression: missing )"),
    (r"lines = '(?<a>\d+)'", "unknown extension ?<a at position 1; write a named group as (?P<name>…)"),
    (r"lines = '(?P<a>\d+)(?=x)'", "cannot be matched in linear time (invalid perl operator: (?=)"),
    (r"lines = '(?P<a>x)(?P=a)'", "cannot be matched in linear time"),
    (r"lines = '(?P<é>\d+)'", "the group 'é' is no name of a column; use letters, digits and _"),
    (r"lines = '(?P<a>\d+)(?P<A>\d+)'", "lines.a and lines.A: these names differ only in upper and lower case"),
    (r"lines = '(?P<sierra_whole>\d+)'", "SIERRA needs the name 'sierra_whole' itself; choose another one for the group"),
    (r"lines = '(?P<a>\d*)'", "also matches an empty line; write + instead of * where text must be"),
    ('lines = "(?P<a>x)\\n"', "has a line feed, but is searched in single lines"),
    *(
        (f"lines = '(?P<a>x)'\n{key}", f"lines and {key.split()[0]} exclude each other: lines makes the columns; remove")
        for key in ('format = "csv"', 'delimiter = ";"', "header = false", 'columns = ["a"]', "skip = 1", 'comment = "#"',
                    "header_lines = 2", "units_row = true", "widths = [3]")
    ),
    ("", 'file = "stdout" needs format, such as "csv", or lines, a regular expression for lines that are rows'),
]  # fmt: skip


@pytest.mark.parametrize(("keys", "message"), REFUSED)
def test_pattern_that_makes_no_sound_table_is_refused_in_one_line(keys: str, message: str) -> None:
    table = tomllib.loads(f'{projects.CONFIG}[outputs.a]\nfile = "stdout"\n{keys}\n')
    with pytest.raises(ConfigError) as refused:
        project_file.parse(table, "sierra.toml")
    assert message in str(refused.value)
    assert "\n" not in str(refused.value)
