"""Files whose names a pattern leaves open are compared by order, or by the numbers that the pattern names."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from sierra.config.output_tables import Output
from sierra.replay.pair_files import pair
from sierra.store.row_types import ArtifactRow
from tests.projects import quick

DECLARED = {
    "log": Output(file="log_*.csv"),
    "floor": Output(file="floor-{tick}.csv"),
    "last": Output(file="log_last.csv"),
    "rotated": Output(file="data.csv{rotation}"),
}


def artifacts(*paths: str) -> dict[str, ArtifactRow]:
    return {path: ArtifactRow("e", "r", path, "table", None, 1, path, 1, None, 1) for path in paths}


def paired(recorded: list[str], found: list[str]) -> tuple[dict[str, str], set[str]]:
    pairs = pair(artifacts(*recorded), artifacts(*found), DECLARED)
    return {key: row.path for key, row in pairs.found.items()}, set(pairs.unpaired)


def test_files_of_a_pattern_are_paired_by_order() -> None:
    found = paired(["log_9.csv", "log_10.csv", "log_last.csv", "x.csv"], ["log_10.csv", "log_11.csv", "log_last.csv", "y.csv"])
    assert found[0] == {"log_9.csv": "log_10.csv", "log_10.csv": "log_11.csv", "log_last.csv": "log_last.csv", "y.csv": "y.csv"}


def test_older_parts_of_a_rotated_file_are_paired_by_order() -> None:
    found, unpaired = paired(["data.csv", "data.csv-20240501.gz"], ["data.csv", "data.csv-20240502.gz"])
    assert (found["data.csv-20240501.gz"], unpaired) == ("data.csv-20240502.gz", set())
    found, unpaired = paired(["data.csv", "data.csv.1"], ["data.csv", "data.csv.1", "data.csv.2"])
    assert (found["data.csv.1"], unpaired) == ("data.csv.1", {"data.csv", "data.csv.1", "data.csv.2"})


def test_numbers_with_a_name_in_the_pattern_pair_files() -> None:
    found, _ = paired(["floor-1.csv", "floor-2.csv"], ["floor-002.csv", "floor-3.csv"])
    assert found == {"floor-2.csv": "floor-002.csv", "floor-3.csv": "floor-3.csv"}


def test_if_the_number_of_files_changes_those_with_the_same_name_are_paired_first() -> None:
    found, unpaired = paired(["log_a.csv", "log_b.csv", "log_c.csv"], ["log_a.csv", "log_c.csv"])
    assert found == {"log_a.csv": "log_a.csv", "log_c.csv": "log_c.csv"}
    assert unpaired == {"log_a.csv", "log_b.csv", "log_c.csv"}
    assert paired(["log_1.csv"], ["log_2.csv", "log_3.csv"])[0] == {"log_1.csv": "log_2.csv", "log_3.csv": "log_3.csv"}


CLOCK = """
import datetime, json, sys
given = json.load(open(sys.argv[1]))
for number in range(int(open(COUNTER).read())):
    name = datetime.datetime.now().strftime("log_%Y-%m-%d_%H-%M-%S-%f")
    open(name + ".csv", "w").write(f"t,v\\n0,{given['n'] + number}\\n")
    open(name + ".png", "w").write(f"picture {number}")
"""
CONFIG = """
template = "t.json"
command = "python3 sim.py {input}"
seed = "/seed"
runs = 1
[variables]
n = "/n"
[outputs.log]
file = "log_*.csv"
[outputs.pictures]
file = "log_*.png"
format = "file"
"""


@pytest.mark.integration
def test_a_replay_of_files_named_by_the_clock_is_equal_and_another_number_of_files_differs(tmp_path: Path) -> None:
    root, counter = tmp_path / "project", tmp_path / "count"
    root.mkdir()
    counter.write_text("2")
    (root / "sim.py").write_text(CLOCK.replace("COUNTER", repr(str(counter))))
    (root / "t.json").write_text(json.dumps({"n": 1, "seed": 1}))
    (root / "sierra.toml").write_text(CONFIG)
    batch = quick(root, "run", "n=1,2", "--no-figures").stdout.split()[1].rstrip(":")
    done = quick(root, "replay", batch)
    assert (done.returncode, f"batch {batch}: equal" in done.stdout) == (0, True), done.stdout
    assert done.stdout.count("the same bytes, now named 'log_") == 8
    counter.write_text("3")
    done = quick(root, "replay", batch)
    assert done.returncode == 1
    assert "2 of the files 'log_*.csv' were recorded, 3 found" in done.stdout
