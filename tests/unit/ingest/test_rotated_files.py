"""The parts of a rotated file are one table, the oldest rows first; a note proposes the declaration that makes it."""

from __future__ import annotations

import gzip
import tomllib
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from sierra.config.output_tables import Output, part_of
from tests.projects import make, quick


def read_parts(folder: Path, parts: dict[str, bytes], file: str = "data.csv{rotation}", **keys: Any) -> Any:
    """Read the parts of one run; return the fault, or the rows."""
    from sierra.ingest.match_outputs import OutputMatcher
    from sierra.ingest.read import read
    from sierra.model import OutputFile
    from tests import readings, samples

    outputs = tuple(OutputFile(name, 0, "", 0, True, "") for name in parts)
    matcher = OutputMatcher({"t": Output(file=file, **keys)}, {})
    found = list(matcher.of(type("", (), {"outputs": outputs, "robots": {}})()))
    assert {one.path for _, _, one in found} == parts.keys()
    files = [readings.written(folder / name, 0, content) for name, content in parts.items()]
    (folder / "target").mkdir(exist_ok=True)
    reading = read(samples.database(2), files, found[0][1], folder / "target" / "table.parquet")
    if reading.faults:
        return reading.faults["e0"]
    import pyarrow.parquet as pq

    rows = pq.ParquetFile(folder / "target" / "table.parquet").read().to_pylist()
    assert list(reading.rows.values()) == list(reading.counted.values()) == [len(rows)]
    return [tuple(row[name] for name in row if name not in ("run", "execution")) for row in rows]


PARTS = {"data.csv": b"t,v\n4,40\n", "data.csv.1": b"t,v\n3,30\n", "data.csv.2.gz": gzip.compress(b"t,v\n1,10\n2,20\n")}


@pytest.mark.parametrize(
    ("parts", "keys"),
    [
        (PARTS, {}),
        ({"data.csv": b"4,40\n", "data.csv.1": b"3,30\n", "data.csv.2.gz": PARTS["data.csv.2.gz"]}, {}),
        ({"data.csv": b"3,30\n4,40", "data.csv-20240501": b"t,v\n1,10\n", "data.csv-20240502.gz": gzip.compress(b"2,20\n")},
         {}),
        ({f"data.csv.{n}": b"t,v\n%d,%d\n" % (4 - n, 40 - 10 * n) for n in range(1, 4)} | {"data.csv": b"t,v\n4,40\n"}, {}),
        ({"data.csv": b"# b\nt,v\ns,m\n4,40\n", "data.csv.10": b"# a\nt,v\ns,m\n1,10\n", "data.csv.9": b"# b\n2,20\n3,30\n",
          **{f"data.csv.{number}": b"" for number in range(1, 9)}}, {"comment": "#", "units_row": True}),
        ({"data.csv": b"3,30\n4,40\n", "data.csv.1": b"1,10\n2,20\n"}, {"header": False, "columns": ("t", "v")}),
    ],
)  # fmt: skip
def test_parts_are_one_table_in_the_order_of_their_age(tmp_path: Path, parts: dict[str, bytes], keys: dict[str, Any]) -> None:
    assert read_parts(tmp_path, parts, **keys) == [(1, 10), (2, 20), (3, 30), (4, 40)]


def test_parts_of_json_lines_are_joined(tmp_path: Path) -> None:
    parts = {"log.jsonl": b'{"v": 2}\n', "log.jsonl.1": b'{"v": 1}\n'}
    assert read_parts(tmp_path, parts, "log.jsonl{rotation}") == [(1,), (2,)]


def test_part_that_was_cut_is_a_fault(tmp_path: Path) -> None:
    said = read_parts(tmp_path, {"data.csv": b"2,3\n", "data.csv.1": b"t,v\n1,2"})
    assert said == "data.csv: its part data.csv.1 does not end with a line feed"
    said = read_parts(tmp_path, {"data.csv": b"2,3,4\n", "data.csv.1": b"t,v\n1,2\n"})
    assert said == "data.csv: line 3: too many fields (3, not 2): '2,3,4' (lines are counted from the oldest part on)"


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (("data.csv", "data.csv.1", "data.csv.1.gz"), "data.csv: its parts data.csv.1 and data.csv.1.gz are the same part"),
        (("data.csv", "data.csv.gz"), "its parts data.csv and data.csv.gz are the same part; keep one of them"),
        (("data.csv", "data.csv-20240501", "data.csv.2024-05-01"), "are the same part"),
        (("data.csv", "data.csv.1", "data.csv.3"), "data.csv: its part 2 is missing, but there is 3"),
        (("data.csv.2",), "data.csv.2: its part 1 is missing, but there is 2"),
        (("data.csv", "data.csv.0", "data.csv.1"), ""),
        (("data.csv.1", "data.csv.2"), ""),
    ],
)
def test_parts_that_are_there_twice_or_missing_are_a_fault(tmp_path: Path, names: tuple[str, ...], message: str) -> None:
    content = dict.fromkeys(names, b"t,v\n1,1\n")
    said = read_parts(tmp_path, {name: gzip.compress(one) if "gz" in name else one for name, one in content.items()})
    assert message in said if message else len(said) == len(names)


def test_no_proposal_leaves_out_rows_above_a_later_header(tmp_path: Path) -> None:
    said = read_parts(tmp_path, {"data.csv": b"t,v\n3,3\n", "data.csv.1": b"1,1\n2,2\n"})
    assert "numbers instead of column names" in said
    assert "skip" not in said


@settings(deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=6)
@given(st.lists(st.integers(1, 9), min_size=1, max_size=4), st.booleans())
def test_joined_parts_are_the_whole_file(tmp_path: Path, sizes: list[int], repeated: bool) -> None:
    rows = iter(range(sum(sizes)))
    parts = {}
    for place, size in enumerate(sizes):
        age = len(sizes) - 1 - place
        head = "t,v\n" if repeated or not place else ""
        parts["data.csv" + f".{age}" * (age > 0)] = (head + "".join(f"{next(rows)},1\n" for _ in range(size))).encode()
    assert [row[0] for row in read_parts(tmp_path, parts)] == list(range(sum(sizes)))


@pytest.mark.parametrize(
    ("file", "message"),
    [
        ("{rotation}.csv", "must be the end"),
        ("*.csv{rotation}", "excludes other names in braces"),
        ("a-{n}.csv{rotation}", "excludes other names in braces"),
        ("a.parquet{rotation}", "needs one of the formats csv, jsonl"),
    ],
)
def test_rotation_that_cannot_be_read_is_refused(file: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Output(file=file)


def test_other_files_are_no_parts() -> None:
    for path in ("data.csv.bak", "data.csv.old.1", "data.csv2", "data.csv.1.txt", "xdata.csv.1", "data.csv.1234567"):
        assert part_of("data.csv", path) is None


SIMULATOR = """\
import gzip, sys
n = int(open(sys.argv[1]).read().split('<swarm count="')[1].split('"')[0])
head = "step,v\\n"
open("data.csv", "w").write(head + f"4,{n}\\n")
seed = open(sys.argv[1]).read().split('<random seed="')[1].split('"')[0]
open("data.csv.1", "w").write(head + f"2,{seed}\\n3,{n}\\n")
gzip.open("data.csv.2.gz", "wt").write(head + f"0,{n}\\n1,{n}\\n")
"""


@pytest.mark.integration
def test_note_proposes_the_pattern_that_makes_one_table(tmp_path: Path) -> None:
    folder = make(tmp_path / "project", simulator=SIMULATOR)
    done = quick(folder, "run", "population_size=1", "--no-figures")
    pattern = '([outputs.data] file = "data.csv{rotation}" makes one table of all parts, the oldest first)'
    note = f"'data.csv.1' and 1 other are kept as files: older than 'data.csv', whose table has only the newest rows {pattern}"
    assert note in " ".join(done.stderr.split())
    rows = ("sql", "SELECT step FROM data WHERE number = 0 ORDER BY row", "--format", "csv")
    assert quick(folder, *rows).stdout.split() == ["step", "4"]
    done = quick(folder, "outputs", "--write")
    assert done.stdout.split("added ")[1].splitlines() == [
        "[outputs.data]",
        "the next sierra run reads the files of new tables again; it executes nothing again for that",
    ]
    written = tomllib.loads((folder / "sierra.toml").read_text())["outputs"]
    assert written == {"data": {"file": "data.csv{rotation}"}}
    done = quick(folder, "run", "population_size=1", "--no-figures")
    assert (done.returncode, "kept as" in done.stderr, "seeds" in done.stderr) == (0, False, False), done.stderr
    assert quick(folder, *rows).stdout.split() == ["step", "0", "1", "2", "3", "4"]
    assert "data.csv.1" not in quick(folder, "outputs").stdout
    assert quick(folder, "run", "population_size=1", "--no-figures", "--runs", "3").returncode == 0
    batch = quick(folder, "sql", "SELECT batch FROM batches ORDER BY lamport DESC LIMIT 1", "--format", "csv").stdout.split()[1]
    done = quick(folder, "replay", batch)
    assert done.returncode == 0, done.stdout
    assert quick(folder, "fsck").returncode == 0


@pytest.mark.integration
def test_init_writes_the_pattern(tmp_path: Path) -> None:
    folder = make(tmp_path / "project", simulator=SIMULATOR)
    (folder / "sierra.toml").unlink()
    assert quick(folder, "init", "--yes").returncode == 0
    assert tomllib.loads((folder / "sierra.toml").read_text())["outputs"] == {"data": {"file": "data.csv{rotation}"}}
