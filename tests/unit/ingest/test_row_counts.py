"""Rows are counted in the files themselves; a parser that reads fewer rows is an error."""

from __future__ import annotations

import csv
import io
import itertools
import random
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from sierra.ingest.model import Reading, Shape, Written
from sierra.ingest.read import read
from sierra.worker import outputs
from sierra.worker.outputs import describe
from tests import samples
from tests.tiers import at_night

CORES = 2
MANY = (1, 3, 2 * CORES, 2 * CORES + 1, 40)
THREADS = (1, 2, 8)
GOOD = b"tick,v\n" + b"1,0.5\n" * 100
OPEN_QUOTE = b"tick,v\n" + b"1,0.5\n" * 50 + b'1,"0.5\n' + b"1,0.5\n" * 49
BAD = {
    "an open quote": OPEN_QUOTE,
    "a quote that closes within a field": OPEN_QUOTE.replace(b"0.5\n1,0.5\n1", b'0.5\n1,0.5"x\n1', 1),
    "a quote within a field": GOOD.replace(b"0.5", b'0"5', 1),
    "a line cut short": GOOD.replace(b"1,0.5", b"1", 1),
    "another line end": GOOD.replace(b"\n", b"\r\n", 7),
}


def written(path: Path, number: int = 0, *, counts: bool = True) -> Written:
    """Return the description of a file as a worker makes it; without `counts`, as an older worker made it."""
    seen = describe(str(path), "out" + path.suffix)
    facts = [seen[name] for name in ("path", "head", "lines", "ended", "bytes")]
    more = [seen.get(name) for name in ("quotes", "blank", "alike")] if counts else []
    return Written(str(path), f"r{number}", f"e{number}", *facts, *more)


def read_files(
    folder: Path,
    files: Sequence[Path],
    *,
    threads: int = 1,
    shape: Shape | None = None,
    counts: bool = True,
    kind: Any = "csv",
) -> tuple[Reading, dict[str, list[Any]]]:
    """Read files as recording does; return the reading, and the rows by execution in order."""
    target = folder / "target" / "table.parquet"
    target.parent.mkdir(exist_ok=True)
    for old in target.parent.iterdir():
        old.unlink()
    described = [written(path, number, counts=counts) for number, path in enumerate(files)]
    reading = read(samples.database(threads), described, shape or Shape(kind), target)
    rows: dict[str, list[Any]] = {}
    for path in sorted(target.parent.iterdir()):
        for row in pq.ParquetFile(path).read().to_pylist():
            del row["run"]
            rows.setdefault(row.pop("execution"), []).append({name: str(value) for name, value in row.items()})
    return reading, rows


def make(folder: Path, contents: Sequence[bytes], names: Sequence[str] | None = None) -> list[Path]:
    paths = [folder / (names[number] if names else f"{number}.csv") for number in range(len(contents))]
    for path, content in zip(paths, contents, strict=True):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
    return paths


def places(count: int) -> list[int]:
    """Return every place if there are few, else the ends and the middle."""
    return list(range(count)) if count < 10 else [0, count // 2, count - 1]


CASES = [(fault, threads, count) for fault in BAD for threads in THREADS for count in MANY]
QUICK = {(fault, threads, count) for fault, threads, count in CASES if count == 3 and threads == 1}


@pytest.mark.parametrize(
    ("fault", "threads", "count"),
    [pytest.param(*case, marks=() if case in QUICK else pytest.mark.nightly) for case in CASES],
)
def test_bad_file_gets_the_same_fault_among_many_files_as_alone(tmp_path: Path, fault: str, threads: int, count: int) -> None:
    alone, nothing = read_files(tmp_path, make(tmp_path, [BAD[fault]]))
    assert (list(alone.faults), alone.rows, nothing) == (["e0"], {}, {})
    for place in places(count):
        paths = make(tmp_path, [BAD[fault] if number == place else GOOD for number in range(count)])
        reading, rows = read_files(tmp_path, paths, threads=threads)
        assert reading.faults == {f"e{place}": alone.faults["e0"]}
        assert {name: len(some) for name, some in rows.items()} == {f"e{n}": 100 for n in range(count) if n != place}
        assert dict(reading.counted) == dict(reading.rows)


@pytest.mark.parametrize("threads", THREADS)
@pytest.mark.parametrize("count", MANY)
def test_many_files_give_the_same_rows_as_each_file_alone(tmp_path: Path, threads: int, count: int) -> None:
    contents = [
        b"tick,v\n" + b"".join(b"%d,%d\n" % (row, row * number) for row in range(number % 7)) for number in range(count)
    ]
    paths = make(tmp_path, contents)
    reading, rows = read_files(tmp_path, paths, threads=threads)
    assert not reading.faults
    for number, content in enumerate(contents):
        expected = [dict(zip(("tick", "v"), line.split(","), strict=True)) for line in content.decode().splitlines()[1:]]
        assert rows.get(f"e{number}", []) == expected


NAMES = ["it's.csv", "new\nline.csv", "ü ü.csv", "per%20cent.csv", "a#b.csv", "semi;colon.csv", "back\\slash.csv"]


@pytest.mark.parametrize("bad", range(len(NAMES)))
def test_unusual_file_names_lose_no_rows(tmp_path: Path, bad: int) -> None:
    contents = [OPEN_QUOTE if number == bad else GOOD for number in range(len(NAMES))]
    reading, rows = read_files(tmp_path, make(tmp_path / "runs", contents, NAMES))
    assert list(reading.faults) == [f"e{bad}"]
    assert {len(some) for some in rows.values()} == {100}
    assert len(rows) == len(NAMES) - 1


def test_odd_number_of_quotes_is_a_fault_with_its_line_number(tmp_path: Path) -> None:
    reading, _ = read_files(tmp_path, make(tmp_path, [b'a,b\n1,2\n3,5"\n4,5\n', OPEN_QUOTE]))
    assert reading.faults == {
        "e0": "out.csv: line 3: an odd number of quotes: '3,5\"' "
        "(put fields that contain quotes in quotes, and double the quotes inside)",
        "e1": "out.csv: line 52: quotes are not closed or not valid in CSV (unexpected end of data)",
    }


@pytest.mark.parametrize(
    ("text", "rows", "shape"),
    [
        ("a,b\n1,2\n\n3,4\n", 2, Shape("csv")),
        ("a,b\n\n\n", 0, Shape("csv")),
        ("a\n1\n\n3\n\n", 3, Shape("csv")),
        ("a\r\n1\r\n\r\n3\r\n", 3, Shape("csv")),
        ("\ufeffa,b\n1,2\n", 1, Shape("csv")),
        ("\ufeff1,2\n3,4\n", 2, Shape("csv", header=False)),
        ("\n1,2\n3,4\n", 2, Shape("csv", header=False, names=("a", "b"))),
        ("1\n\n3\n", 3, Shape("csv", header=False)),
        ("", 0, Shape("csv", header=False)),
        ("a\r1\r2\r", 2, Shape("csv", files=9)),
        ('a,b\n1,"x\ny"\n2,"z"\n', 2, Shape("csv")),
        ('a,b\n1, "x, y" , 3\n'.replace(" , 3", " "), 1, Shape("csv")),
        ("a b\n1 2\n3 4\n", 2, Shape("csv", delimiter=" ")),
        ("a,b\n1,2\n3,4", 2, Shape("csv", files=9)),
    ],
)
@pytest.mark.parametrize("counts", [True, False])
def test_rows_of_valid_csv_files_are_counted_correctly(
    tmp_path: Path, text: str, rows: int, shape: Shape, counts: bool
) -> None:
    reading, found = read_files(tmp_path, make(tmp_path, [text.encode()]), shape=shape, counts=counts)
    assert not reading.faults
    assert (list(reading.rows.values()), list(reading.counted.values())) == ([rows], [rows])
    assert len(found.get("e0", [])) == rows


def test_empty_first_line_without_header_is_a_fault_instead_of_lost_rows(tmp_path: Path) -> None:
    reading, _ = read_files(tmp_path, make(tmp_path, [b"\n1,2\n3,4\n"]), shape=Shape("csv", header=False))
    assert reading.faults == {
        "e0": "out.csv: line 1: is empty, but 2 rows follow; name the columns (set columns = [...] in [outputs.…])"
    }


def test_rows_of_json_lines_and_parquet_files_are_counted(tmp_path: Path) -> None:
    lines = tmp_path / "a.jsonl"
    lines.write_bytes(b'{"a":1}\n\n  \n{"a":2}')
    reading, _ = read_files(tmp_path, [lines], kind="jsonl")
    assert (reading.faults, list(reading.counted.values())) == ({}, [2])
    table = tmp_path / "a.parquet"
    pq.write_table(pa.table({"a": range(5)}), table, row_group_size=2)
    reading, _ = read_files(tmp_path, [table], kind="parquet")
    assert (reading.faults, list(reading.counted.values())) == ({}, [5])


@pytest.mark.parametrize("kind", ["csv", "jsonl", "parquet"])
def test_fault_is_reported_if_the_parser_reads_fewer_rows_than_the_file_has(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    """A filter simulates a parser that silently skips a row."""
    from sierra.ingest.csv import Csv
    from sierra.ingest.jsonl import Jsonl
    from sierra.ingest.parquet import Parquet

    paths = [tmp_path / f"{number}.{kind}" for number in range(3)]
    for number, path in enumerate(paths):
        values = [number * 10 + row for row in range(4)]
        match kind:
            case "csv":
                path.write_text("a\n" + "".join(f"{value}\n" for value in values))
            case "jsonl":
                path.write_text("".join(f'{{"a":{value}}}\n' for value in values))
            case _:
                pq.write_table(pa.table({"a": values}), path)
    reader = {"csv": Csv, "jsonl": Jsonl, "parquet": Parquet}[kind]
    write = reader.write

    def losing(self: Any, target: Path, files: Sequence[Written], source: str, columns: Any) -> None:
        [cell] = columns.values()
        write(self, target, files, f"(SELECT * FROM {source} t WHERE {cell}::VARCHAR <> '12')", columns)

    monkeypatch.setattr(reader, "write", losing)
    reading, rows = read_files(tmp_path, paths, kind=kind)
    assert list(reading.faults) == ["e1"]
    assert "it contains 4 rows, but 3 were read" in reading.faults["e1"]
    assert {name: len(some) for name, some in rows.items()} == {"e0": 4, "e2": 4}


# ---------------------------------------------------------------- generated and mutated files, against Python's csv


CELLS = ("1", "0.5", "x", "", '"q"', '"a,b"', '"a""b"', '"l\nm"', ' "z"', '"z" ', 'a"b', "'", " ", "é", "#c", '""')
NOISE = (b'"', b"\n", b"\r", b",", b"\r\n", b" ", b"\\", b"\0", b"")


def generated(numbers: random.Random) -> bytes:
    """Return a CSV of one to three columns, mostly numbers, with a few bytes changed."""
    width, end = numbers.randint(1, 3), numbers.choice(["\n", "\n", "\r\n"])
    odd = numbers.random() < 0.5
    lines = [
        ",".join(numbers.choice(CELLS if odd and numbers.random() < 0.2 else CELLS[:3]) for _ in range(width))
        for _ in range(numbers.randint(0, 6))
    ]
    head = ",".join("abc"[:width])
    content = bytearray("".join(line + end for line in (head, *lines)).encode())
    for _ in range(numbers.choice((0, 0, 1, 1, 2))):
        at = numbers.randint(min(2 * width + 1, len(content)), len(content))
        content[at : at + numbers.randint(0, 1)] = numbers.choice(NOISE)
    return bytes(content)


def records(content: bytes) -> list[list[str]] | None:
    """Return the records below the header as Python's csv reads them in the supported dialect; None if it refuses."""
    text = content.decode("utf-8-sig", "surrogateescape")
    for padded in ('" ,', '" \n', '" \r'):
        text = text.replace(padded, '"' + padded[-1])
    try:
        found = list(csv.reader(io.StringIO(text, newline=""), strict=True, skipinitialspace=True))
    except csv.Error:
        return None
    while found and not found[-1]:  # blank lines at the end
        found.pop()
    return [record for record in found[1:] if record or len(found[0]) == 1]


def is_plain(content: bytes) -> bool:
    """Return True for a plain CSV: no quotes, one kind of line end, the same number of fields in each line."""
    lines = content.decode(errors="replace").split("\n")
    odd = any(character in content for character in b'"\r\\\0')
    return not odd and lines[-1] == "" and all(line.count(",") == lines[0].count(",") for line in lines[1:-1] if line)


def check_generated(folder: Path, seed: int) -> None:
    numbers = random.Random(seed)
    contents = [generated(numbers) for _ in range(numbers.choice((1, 2, 3, 5, 9)))]
    reading, rows = read_files(folder, make(folder, contents), threads=numbers.choice(THREADS))
    for number, content in enumerate(contents):
        expected, name = records(content), f"e{number}"
        if name not in reading.faults:
            assert expected is not None, (seed, content)
            assert len(rows.get(name, [])) == len(expected), (seed, content)
        else:
            assert name not in rows, (seed, content)
        if is_plain(content):
            assert name not in reading.faults, (seed, content, reading.faults)


@pytest.mark.integration
def test_generated_files_have_as_many_rows_as_python_csv_reads(tmp_path: Path) -> None:
    for seed in range(40):
        check_generated(tmp_path, seed)


@pytest.mark.nightly
@pytest.mark.parametrize("block", [0, 1, *at_night(range(2, 8))])
def test_thousands_of_generated_files_have_as_many_rows_as_python_csv_reads(tmp_path: Path, block: int) -> None:
    for seed in range(1000 + 150 * block, 1150 + 150 * block):
        check_generated(tmp_path, seed)


# ---------------------------------------------------------------- counts of the worker


PIECES = st.lists(st.sampled_from([b"\n", b"\r\n", b"\r", b"x", b'"', b"\n\n"]), max_size=12).map(b"".join)


@pytest.mark.integration
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=300)
@given(content=PIECES, size=st.integers(1, 5))
def test_worker_counts_do_not_depend_on_the_chunk_size(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, content: bytes, size: int
) -> None:
    path = tmp_path / "x"
    path.write_bytes(content)
    monkeypatch.setattr(outputs, "CHUNK", size)
    seen = describe(str(path), "x")
    lines = content.split(b"\n")[:-1]
    returns = content.count(b"\r")
    assert (seen["bytes"], seen["lines"], seen["quotes"]) == (len(content), len(lines), content.count(b'"'))
    assert seen["blank"] == sum(line in (b"", b"\r") for line in lines)
    assert seen["alike"] == (not returns or returns == content.count(b"\r\n") == len(lines))
    assert seen["ended"] == (content == b"" or content.endswith(b"\n"))


def test_worker_counts_fewer_properties_of_binary_files(tmp_path: Path) -> None:
    path = tmp_path / "x"
    path.write_bytes(b"\x89PNG\0\n\n")
    assert describe(str(path), "x").keys() == {"path", "sha256", "bytes", "lines", "ended", "head"}
    path.write_bytes(b"\x89PNG\n\n")
    assert {"quotes", "blank", "alike"} <= describe(str(path), "x").keys()


def test_worker_counts_consecutive_blank_lines(tmp_path: Path) -> None:
    path = tmp_path / "x"
    for before, ends in itertools.product((b"", b"a\n"), (b"\n", b"\r\n")):
        path.write_bytes(before.replace(b"\n", ends) + 5 * ends)
        assert describe(str(path), "x")["blank"] == 5
