"""Ends that `[success] accept` names are results; other failures are repeated by replays, and not for ever by `sierra run`."""

from __future__ import annotations

import json
import subprocess
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from sierra.store.several_batches import joined
from sierra.store.store import Store
from tests.conftest import Simulated

pytestmark = pytest.mark.integration
SIMULATOR = """
size=$(sed -n 's/.*size="\\([0-9]*\\)".*/\\1/p' "$1")
printf 't,v\\n1,1\\n2,4\\n' > swarm.csv
if [ "$size" = 2 ]; then exit 3; fi
if [ "$size" = 3 ]; then printf '3,' >> swarm.csv; kill -ABRT $$; fi
if [ "$size" = 4 ]; then exit 134; fi
"""
ACCEPT = '[success]\naccept = ["exit 3", "signal ABRT"]\n'
Simulate = Callable[..., Simulated]


def declare(project: Simulated, text: str) -> None:
    """Replace what follows the tables that every project here has."""
    file = project.folder / "sierra.toml"
    file.write_text(file.read_text().partition("[success]")[0] + text)


def ask(project: Simulated, *words: str, code: int = 0) -> dict[str, Any]:
    runs = () if "--runs" in words else ("--runs", "1")
    done = project.quick("run", *words, *runs, "--no-figures", "--json")
    assert done.returncode == code, done.stdout + done.stderr
    answer: dict[str, Any] = json.loads(done.stdout)
    return answer


@pytest.fixture
def crashing(simulate: Simulate) -> Simulated:
    project = simulate(SIMULATOR)
    declare(project, ACCEPT)
    return project


def test_an_accepted_end_is_a_result_and_no_success(crashing: Simulated) -> None:
    answer = ask(crashing, "size=1,2,3,4", "--runs", "2")
    counts = [(one["succeeded"], one["accepted"], one["failed"]) for one in answer["counts"]]
    assert counts == [(2, 0, 0), (0, 2, 0), (0, 2, 0), (0, 2, 0)]
    assert answer["outcomes"] == {"exit 3": 2, "signal ABRT": 4}
    found = crashing.sql("SELECT size, status, outcome, count(*) AS n FROM runs GROUP BY ALL ORDER BY size")
    assert [tuple(row.values()) for row in found] == [
        (1, "ok", "success", 2),
        (2, "accepted", "exit 3", 2),
        (3, "accepted", "signal ABRT", 2),
        (4, "accepted", "signal ABRT", 2),
    ]
    assert ask(crashing, "size=1,2,3,4", "--runs", "2")["executed"] == 0
    assert crashing.executed().total() == 8
    assert crashing.quick("fsck").returncode == 0


def test_rows_of_accepted_ends_are_in_a_table_of_their_own(crashing: Simulated) -> None:
    ask(crashing, "size=1,2,3,4", "--runs", "2")
    assert crashing.sql("SELECT DISTINCT size FROM swarm") == [{"size": 1}]
    # the last line of size=3 is cut off: its file is kept, and no row of it counts
    assert crashing.sql("SELECT size, count(*) AS n FROM swarm_accepted GROUP BY size ORDER BY size") == [
        {"size": 2, "n": 4},
        {"size": 4, "n": 4},
    ]
    said = crashing.quick("stats", "swarm", "v", "--json")
    assert "6 of 8 runs missing (2 with exit 3, 4 with signal ABRT)" in said.stderr


def test_without_accepted_ends_their_table_is_empty(crashing: Simulated) -> None:
    file = crashing.folder / "sierra.toml"
    join = "SELECT run, size, v FROM swarm UNION ALL SELECT run, size, v FROM swarm_accepted"
    file.write_text(file.read_text() + f'[tables.every]\nsql = "{join}"\n')

    def rows(*words: str) -> list[dict[str, Any]]:
        done = crashing.quick("sql", "--json", *words)
        assert done.returncode == 0, done.stderr
        return list(json.loads(done.stdout))

    def without() -> None:
        batch = next(row["batch"] for row in crashing.sql("SELECT query, batch FROM batches") if row["query"] == "size=1")
        assert rows("SELECT size, count(*) AS n FROM every GROUP BY size", "--batch", batch) == [{"size": 1, "n": 4}]
        assert rows("SELECT v, size FROM swarm_accepted", "--batch", batch) == []
        table = joined(Store(crashing.folder / ".sierra"), {"a": batch, "b": batch}, "FROM swarm_accepted", "it").table
        assert (table.num_rows, {"batch", "run", "size", "v"} <= {*table.column_names}) == (0, True)
        found = crashing.quick("stats", "every", "v", "--batch", batch, "--json")
        assert found.returncode == 0, found.stderr

    ask(crashing, "size=1", "--runs", "2")
    without()
    assert "every" in crashing.quick("sql", "SHOW TABLES").stdout
    done = crashing.quick("sql", "FROM swam_accepted")
    assert (done.returncode, "swam_accepted" in done.stderr) == (2, True)
    ask(crashing, "size=2")
    without()
    assert rows("SELECT size, count(*) AS n FROM every GROUP BY size ORDER BY size") == [
        {"size": 1, "n": 4},
        {"size": 2, "n": 2},
    ]


def test_a_table_of_accepted_ends_is_used_only_where_it_is_named(crashing: Simulated) -> None:
    file = crashing.folder / "sierra.toml"
    file.write_text(file.read_text() + '[figures.f]\nkind = "summary"\ncolumn = "v"\n')
    for query in ("size=2", "size=1,2"):
        ask(crashing, query, "--runs", "2")
    batches = {row["query"]: row["batch"] for row in crashing.sql("SELECT query, batch FROM batches")}
    only = crashing.quick("figures", batches["size=2"], "f")
    assert only.returncode == 2
    assert "swarm_accepted has the rows of accepted ends, and must be named" in only.stderr
    assert crashing.quick("figures", batches["size=1,2"], "f").returncode == 0
    [caption] = crashing.folder.glob("figures/*/f.txt")
    assert "n = 2; 2 of 4 runs missing (2 with exit 3)" in caption.read_text()


def test_claims_by_sql_lose_accepted_ends_unless_they_name_them(crashing: Simulated) -> None:
    file = crashing.folder / "sierra.toml"
    claim = '[claims.{name}]\nsays = "x"\npaper = "1"\nquery = "size=1,2"\nruns = 2\nsql = "{sql}"\n'
    plain = claim.format(name="plain", sql="SELECT avg(v) > 0 FROM swarm")
    rate = claim.format(name="rate", sql="SELECT count(*) FILTER (outcome = 'exit 3') = 2 FROM runs")
    file.write_text(file.read_text() + plain + rate)
    ask(crashing, "size=1,2", "--runs", "2")
    found = {one["name"]: one for one in json.loads(crashing.quick("claims", "--json").stdout)}
    assert {name: one["verdict"] for name, one in found.items()} == {"plain": "can't tell", "rate": "holds"}
    assert (found["plain"]["n"], found["rate"]["n"]) == (2, 4)


def test_a_last_line_without_an_end_makes_no_row(simulate: Simulate) -> None:
    project = simulate("printf 't,v\\n1,123\\n2,12' > swarm.csv; exit 3")
    declare(project, ACCEPT)
    ask(project, "size=1")
    assert project.sql("SELECT kind, rows FROM artifacts WHERE path = 'swarm.csv'") == [{"kind": "file", "rows": None}]


def test_accepted_ends_do_not_execute_what_comes_after(simulate: Simulate, tmp_path: Path) -> None:
    project = simulate(SIMULATOR)
    declare(project, ACCEPT)
    file = project.folder / "sierra.toml"
    file.write_text(f"after = [['sh', '-c', 'echo >> {tmp_path}/later']]\n" + file.read_text())
    assert ask(project, "size=1,2")["outcomes"] == {"exit 3": 1}
    assert (tmp_path / "later").read_text() == "\n"
    batch = project.sql("SELECT batch FROM batches")[0]["batch"]
    assert json.loads(project.quick("replay", batch, "--json").stdout)["counts"] == {"identical": 2}


def test_outcomes_of_a_target_that_alone_accepts_an_end(simulate: Simulate) -> None:
    project = simulate(SIMULATOR)
    file = project.folder / "sierra.toml"
    file.write_text(file.read_text() + '[targets.sim.success]\naccept = ["exit 3"]\n')
    assert ask(project, "size=1,2", "--target", "sim")["outcomes"] == {"exit 3": 1}
    assert project.quick("stats", "outcomes", "exit 3").returncode == 0


def test_an_output_hides_the_table_of_outcomes(simulate: Simulate) -> None:
    project = simulate("printf 'a\\n7\\n' > outcomes.csv")
    declare(project, ACCEPT)
    ask(project, "size=1")
    assert project.quick("sql", "--json", "SELECT a FROM outcomes").stdout.split() == ["[", "{", '"a":', "7", "}", "]"]


def test_outcomes_have_rates(crashing: Simulated) -> None:
    ask(crashing, "size=1,2", "--runs", "4")
    done = crashing.quick("stats", "outcomes", "exit 3", "--format", "csv")
    head, *rows = (line.split(",") for line in done.stdout.splitlines())
    place = {name: number for number, name in enumerate(head)}
    assert [(row[place["size"]], row[place["n"]], float(row[place["mean"]])) for row in rows] == [("1", "4", 0), ("2", "4", 1)]
    assert {row[place["interval"]] for row in rows} == {"Wilson"}


def test_accepting_an_end_later_evaluates_the_record_again(simulate: Simulate) -> None:
    project = simulate(SIMULATOR)
    assert ask(project, "size=1,2", code=1)["failed"] == 1
    declare(project, ACCEPT)
    assert ask(project, "size=1,2", "--dry-run")["to_execute"] == 0
    answer = ask(project, "size=1,2")
    assert (answer["executed"], answer["outcomes"]) == (0, {"exit 3": 1})
    assert project.sql("SELECT count(*) AS n FROM swarm_accepted") == [{"n": 2}]
    declare(project, "[success]\nexit_status = [0, 3]\n")
    assert ask(project, "size=1,2")["counts"][1]["succeeded"] == 1
    assert project.sql("SELECT count(*) AS n FROM swarm WHERE size = 2") == [{"n": 2}]
    declare(project, ACCEPT)
    assert ask(project, "size=1,2")["counts"][1]["accepted"] == 1
    assert project.sql("SELECT count(*) AS n FROM swarm WHERE size = 2") == [{"n": 0}]
    assert project.executed().total() == 2
    assert project.quick("fsck").returncode == 0


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('accept = ["exit 300"]', "'exit 300' is no end of a program"),
        ('accept = ["signal FOO"]', "'signal FOO' is no end of a program"),
        ('accept = ["exit 3"]\nexit_status = [0, 3]', '"exit 3" is a success by exit_status'),
        ('accept = ["signal 6"]\nexit_status = [0, 134]', '"signal ABRT" is a success by exit_status'),
        ('accept = ["exit 3"]\n[outputs.x_accepted]\nfile = "x.csv"', "outputs.x_accepted: with accept in [success]"),
    ],
)
def test_wrong_ends_are_refused(simulate: Simulate, text: str, message: str) -> None:
    project = simulate(SIMULATOR)
    declare(project, f"[success]\n{text}\n")
    done = project.quick("run", "size=1", "--no-figures")
    assert (done.returncode, message in done.stderr) == (2, True), done.stderr


def test_a_file_with_the_name_of_such_a_table_is_refused(simulate: Simulate) -> None:
    project = simulate("printf 't,v\\n1,1\\n' > swarm_accepted.csv")
    declare(project, ACCEPT)
    failure = ask(project, "size=1", code=1)["failures"][0]
    assert "makes the table 'swarm_accepted', as rows of accepted ends do" in failure["reason"]


def test_a_run_that_failed_twice_in_the_same_way_needs_retry(simulate: Simulate) -> None:
    project = simulate("exit 7")
    for executions in (1, 2, 2):
        assert ask(project, "size=1", code=1)["failed"] == 1
        assert project.executed().total() == executions
    preview = project.quick("run", "size=1", "--runs", "1", "-n")
    assert "0 of 1 run would execute, 1 failed twice in the same way (--retry)" in preview.stdout
    said = project.quick("run", "size=1", "--runs", "1", "--no-figures")
    assert "1 run failed twice in the same way, and only --retry executes them again" in said.stderr
    ask(project, "size=1", "--retry", code=1)
    assert project.executed().total() == 3
    (project.folder / "sim.sh").write_text((project.folder / "sim.sh").read_text().replace("exit 7", "echo 1"))
    assert ask(project, "size=1")["executed"] == 1


def test_a_raised_limit_executes_again(simulate: Simulate) -> None:
    project = simulate("sleep 1.5")
    file = project.folder / "sierra.toml"
    text = file.read_text()
    file.write_text(text.replace("[limits]\n", "[limits]\nwall = 0.2\n"))
    for _ in range(2):
        ask(project, "size=1", code=1)
    file.write_text(text.replace("[limits]\n", "[limits]\nwall = 60\n"))
    assert ask(project, "size=1")["executed"] == 1


def test_other_failures_are_tried_again(simulate: Simulate, tmp_path: Path) -> None:
    project = simulate(f'exit "$(wc -l < "{tmp_path}/executed")"')  # another exit status each time
    for executions in (1, 2, 3):
        ask(project, "size=1", code=1)
        assert project.executed().total() == executions


def test_a_replay_repeats_failures_and_compares_their_ends(crashing: Simulated) -> None:
    declare(crashing, '[success]\naccept = ["exit 3"]\n')
    batch = ask(crashing, "size=1,2,3", "--runs", "2", code=1)["batch"]
    done = crashing.quick("replay", batch, "--json")
    answer = json.loads(done.stdout)
    assert (done.returncode, answer["runs"], answer["of"], answer["counts"]) == (0, 6, 6, {"identical": 6})
    said = {one["reason"] for one in answer["outputs"] if one["path"] is None}
    assert said == {"it ended as before: exit 3", "it ended as before: ended by signal 6 (SIGABRT)"}


def test_a_failure_that_ends_otherwise_is_different(simulate: Simulate, tmp_path: Path) -> None:
    project = simulate(f"[ -e '{tmp_path}/later' ] && exit 6; exit 5")
    batch = ask(project, "size=1", code=1)["batch"]
    (tmp_path / "later").touch()
    done = project.quick("replay", batch, "--json")
    assert (done.returncode, json.loads(done.stdout)["counts"]) == (1, {"different": 1})
    assert "it ended with exit status 5 before, and with exit status 6 now" in done.stdout


def test_both_numbers_of_a_signal_are_one_end(simulate: Simulate, tmp_path: Path) -> None:
    project = simulate(f"printf 't,v\\n1,1\\n' > swarm.csv; [ -e '{tmp_path}/later' ] && exit 134; kill -ABRT $$")
    declare(project, ACCEPT)
    batch = ask(project, "size=1")["batch"]
    (tmp_path / "later").touch()
    assert json.loads(project.quick("replay", batch, "--json").stdout)["counts"] == {"identical": 1}


def test_evaluating_again_refuses_the_same_names(simulate: Simulate) -> None:
    project = simulate("printf 't,v\\n1,1\\n' > swarm_accepted.csv")
    ask(project, "size=1")
    declare(project, ACCEPT)
    failure = ask(project, "size=1", code=1)["failures"][0]
    assert "makes the table 'swarm_accepted', as rows of accepted ends do" in failure["reason"]


def test_an_evaluator_repeats_all_ends_without_sierra(simulate: Simulate, tmp_path: Path) -> None:
    project = simulate(SIMULATOR.replace("kill -ABRT $$", f"[ -e '{tmp_path}/later' ] && exit 6; kill -SEGV $$"))
    declare(project, '[success]\naccept = ["exit 3"]\n[package]\ntitle = "x"\nauthors = [{ name = "A B" }]\nlicense = "MIT"\n')
    batch = ask(project, "size=1,2,3", code=1)["batch"]
    done = project.quick("package", batch, "--yes", "-o", str(tmp_path / "x.zip"))
    assert done.returncode == 0, done.stderr
    with zipfile.ZipFile(tmp_path / "x.zip") as packed:
        packed.extractall(tmp_path / "x")
    program = next((tmp_path / "x").glob("**/reproduce.py"))

    def executed() -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [sys.executable, "-I", "-S", str(program), "--execute", "--yes"], capture_output=True, text=True, check=False
        )

    assert "LEVEL 2: 3 of 3 runs executed again: 3 identical" in executed().stdout
    (tmp_path / "later").touch()
    again = executed()
    assert again.returncode == 1
    assert "exit status 6, and not signal 11 as before" in again.stdout
