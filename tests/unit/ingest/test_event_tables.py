"""Tables of events have another number of rows in each run; they are kept, and a run that was cut short is still found."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from sierra.design.seeds import seed
from sierra.ingest.event_tables import is_uneven
from tests import projects
from tests.projects import quick, sql

TRAFFIC = """
import random
random.seed(seed)
vehicles = 60 + seed % 61
lines = [f'<tripinfo id="v{n}" arrival="{random.uniform(0, 99):.2f}"/>' for n in range(vehicles)]
crashes = [f"{t:.1f},v{n}" for n, t in enumerate(sorted(random.uniform(0, 99) for _ in range(random.randint(1, 30))))]
kept, end = (WHEN_CUT) if CHOSEN else (lines, "</tripinfos>\\n")
open("tripinfo.xml", "w").write("<tripinfos>\\n" + "\\n".join(kept) + "\\n" + end)
open("collisions.csv", "w").write("\\n".join(["moment,vehicle", *crashes]) + "\\n")
"""
TRIPS = '[outputs.trips]\nfile = "tripinfo.xml"\nformat = "xml"\nrows = "//tripinfo"\n'
QUERY = ("run", "population_size=1,2", "--runs", "4", "--no-figures", "--json")


def project(folder: Path, cut: str = "", config: str = TRIPS) -> Path:
    """Make a project; `cut` is what the second run of the first experiment writes of its trips: its lines and its end."""
    chosen = f"count == 1 and seed == {seed(0, 1)}" if cut else "False"
    traffic = TRAFFIC.replace("CHOSEN", chosen).replace("WHEN_CUT", cut or "None")
    return projects.make(folder, projects.CONFIG + config, simulator=projects.SIMULATOR + traffic)


def run(folder: Path) -> tuple[dict[str, Any], list[str]]:
    ended = quick(folder, *QUERY)
    assert "Traceback" not in ended.stderr
    summary: dict[str, Any] = json.loads(ended.stdout)
    return summary, summary["notes"]


@pytest.mark.integration
def test_trips_and_collisions_are_kept_and_the_proposed_lines_silence_the_note(tmp_path: Path) -> None:
    project(tmp_path)
    summary, notes = run(tmp_path)
    assert (summary["failed"], summary["executed"]) == (0, 8), summary["failures"]
    proposals = [note for note in notes if "if these are events, set " in note]
    assert [note.partition("if these are events, set ")[2] for note in proposals] == [
        'file = "collisions.csv", mismatch = "ragged" in [outputs.collisions]',
        'mismatch = "ragged" in [outputs.trips]',
    ]
    assert all("so the numbers were not compared" in note for note in proposals)
    config = (tmp_path / "sierra.toml").read_text() + 'mismatch = "ragged"\n'
    (tmp_path / "sierra.toml").write_text(config + '[outputs.collisions]\nfile = "collisions.csv"\nmismatch = "ragged"\n')
    summary, notes = run(tmp_path)
    assert (summary["failed"], summary["executed"]) == (0, 0)
    assert not [note for note in notes if "events" in note]


@pytest.mark.integration
@pytest.mark.parametrize(
    ("cut", "reason"),
    [
        ("lines[:9], ''", "tripinfo.xml: line 10: is truncated or not XML"),
        ("lines[:9], '<tripinfo id='", "tripinfo.xml: line 11: is truncated or not XML"),
    ],
)
def test_file_that_is_cut_short_next_to_them_fails_its_run_only(tmp_path: Path, cut: str, reason: str) -> None:
    summary, _ = run(project(tmp_path, cut))
    assert summary["failed"] == 1
    [failure] = summary["failures"]
    assert failure["reason"].startswith(reason[: len("tripinfo.xml: line ")])
    assert "is truncated or not XML" in failure["reason"]


@pytest.mark.integration
@pytest.mark.parametrize("declared", ["", 'mismatch = "ragged"\n'])
def test_valid_file_with_far_fewer_rows_than_the_others_is_doubted(tmp_path: Path, declared: str) -> None:
    root = project(tmp_path, "lines[:9], '</tripinfos>\\n'", config=TRIPS + declared)
    summary, notes = run(root)
    assert summary["failed"] == 0
    doubts = [note for note in notes if note.endswith("was the run cut short?")]
    assert len(doubts) == 1
    [row] = sql(root, "SELECT run FROM trips GROUP BY run HAVING count(*) = 9")
    assert doubts[0].startswith(f"output 'trips' of run {row['run'][:10]} has 9 rows, the other runs of its experiment have ")


SERIES = """
import random
random.seed(seed)
with open("swarm.csv", "w") as file:
    print("HEADER", file=file)
    for tick in range(random.randint(5, 60)):
        print(ROW, file=file)
"""


@pytest.mark.integration
@pytest.mark.parametrize(
    ("header", "row"),
    [
        ("tick,coverage", 'f"{tick},{random.random()}"'),
        ("tick,robot,x", 'f"{tick // 4},{tick % 4},{random.random()}"'),
        ("name,moment,x", 'f"n{tick},{tick * 0.5},{random.random()}"'),
    ],
)
def test_series_that_end_at_different_times_are_not_taken_as_events(tmp_path: Path, header: str, row: str) -> None:
    simulator = projects.SIMULATOR + SERIES.replace("HEADER", header).replace("ROW", row)
    projects.make(tmp_path, projects.CONFIG, simulator=simulator)
    summary, notes = run(tmp_path)
    assert summary["failed"] >= 4
    assert not [note for note in notes if "not compared" in note]
    assert all('mismatch = "ragged" in [outputs.swarm]' in failure["reason"] for failure in summary["failures"])


@pytest.mark.parametrize(
    ("sizes", "uneven"),
    [
        ({0: [5, 5, 3]}, False),
        ({0: [5, 4, 3]}, True),
        ({0: [5, 3], 1: [4, 4], 2: [4, 4]}, False),
        ({0: [5, 3], 1: [7, 2], 2: [8, 4]}, True),
        ({0: [5, 5, 3, 3]}, False),
        ({0: [0, 0, 1, 0], 1: [3, 5, 9, 4]}, True),
        ({0: [50, 50, 50], 1: [50, 50, 50], 2: [50, 40, 30]}, False),
        ({0: [7]}, False),
        ({}, False),
    ],
)
def test_numbers_of_rows_are_uneven_only_if_most_runs_of_most_experiments_differ(
    sizes: dict[int, list[int]], uneven: bool
) -> None:
    assert is_uneven(sizes) is uneven
