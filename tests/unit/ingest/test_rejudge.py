"""What is recorded is judged anew where [outputs] or [success] change, and nothing is executed for that."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import time
from pathlib import Path
from typing import Any

import pytest

from sierra.store.store import Store
from tests import projects
from tests.projects import SIERRA, quick, start
from tests.waiting import until

SIMULATOR = (
    projects.SIMULATOR
    + """
with open({log!r}, "a") as log:
    print(seed, file=log)
with open("wide.csv", "w") as file:
    print("a;b", file=file)
    for tick in range(3 + (seed % 2)):
        print(tick, count + tick / 2, sep=";", file=file)
print("done", count)
"""
)
SWARM = '[outputs.swarm]\nfile = "swarm.csv"\n'
WIDE = '[outputs.wide]\nfile = "wide.csv"\nmismatch = "ragged"\n'
ASK = ("population_size=1,2", "--runs", "3", "--no-figures")
RUNS = 6


class Counted:
    """A project whose simulator says outside of it each time that it is executed."""

    def __init__(self, root: Path, config: str = WIDE, simulator: str = SIMULATOR) -> None:
        self.log = root.with_name("executed")
        self.root = projects.make(root, projects.CONFIG + config, simulator=simulator.replace("{log!r}", repr(str(self.log))))

    @property
    def executed(self) -> int:
        return len(self.log.read_text().split())

    def declare(self, config: str) -> None:
        """Write down other outputs than before."""
        (self.root / "sierra.toml").write_text(projects.CONFIG + config)

    def ask(self, code: int = 0, *words: str) -> dict[str, Any]:
        ended = quick(self.root, "run", *(words or ASK), "--json")
        assert ended.returncode == code, ended.stdout + ended.stderr
        answer: dict[str, Any] = json.loads(ended.stdout)
        return answer

    def said(self, *words: str) -> str:
        """What is printed for people."""
        ended = quick(self.root, *words)
        return ended.stdout + ended.stderr

    def rows(self, text: str) -> list[dict[str, Any]]:
        return Store(self.root / ".sierra").rows(text)

    def value(self, text: str) -> Any:
        [[value]] = [list(row.values()) for row in self.rows(text)]
        return value

    def is_sound(self) -> None:
        ended = quick(self.root, "fsck")
        assert ended.returncode == 0, ended.stdout


@pytest.fixture
def project(tmp_path: Path) -> Counted:
    made = Counted(tmp_path / "project")
    assert made.ask()["executed"] == RUNS
    assert made.executed == RUNS
    return made


@pytest.mark.integration
def test_outputs_that_are_declared_for_the_first_time_execute_nothing(tmp_path: Path) -> None:
    project = Counted(tmp_path / "project", "")
    simulator = project.root / "sim.py"
    simulator.write_text(simulator.read_text().replace("3 + (seed % 2)", "3"))
    project.ask()
    project.declare('[outputs.positions]\nfile = "swarm.csv"\ntime = "tick"\nunits = { coverage = "m" }\n')
    answer = project.ask()
    assert (answer["executed"], answer["reused"], answer["reevaluated"], answer["failed"]) == (0, RUNS, RUNS, 0)
    assert project.executed == RUNS
    assert project.value("SELECT count(*) FROM positions") == RUNS * 5
    assert project.value("SELECT count(*) FROM executions") == RUNS
    assert project.value("SELECT count(*) FROM positions SEMI JOIN executions USING (execution)") == RUNS * 5
    assert project.value("SELECT count(DISTINCT path) FROM artifacts WHERE kind = 'table' AND output = 'positions'") == 1
    assert project.value("SELECT count(*) FROM artifacts WHERE path = 'swarm.csv'") == RUNS
    stats = json.loads(quick(project.root, "stats", "positions", "coverage", "--json").stdout)
    assert stats
    project.is_sound()


@pytest.mark.integration
def test_a_delimiter_reads_the_same_bytes_again(project: Counted) -> None:
    project.declare(WIDE + 'delimiter = ","\n')
    assert project.ask()["reevaluated"] == RUNS
    assert "a;b" in [row["column_name"] for row in project.rows("DESCRIBE wide")]
    project.declare(WIDE + 'delimiter = ";"\n')
    assert project.ask()["reevaluated"] == RUNS
    columns = [row["column_name"] for row in project.rows("DESCRIBE wide")]
    assert "a;b" not in columns
    assert {"a", "b"} <= set(columns)
    assert project.value("SELECT max(b) FROM wide WHERE population_size = 2") >= 3.0
    assert project.executed == RUNS
    project.is_sound()


@pytest.mark.integration
def test_columns_of_a_file_without_a_header_are_read_from_the_same_bytes(project: Counted) -> None:
    project.declare(WIDE + 'header = false\ncolumns = ["x", "y"]\ndelimiter = ";"\n')
    assert project.ask()["reevaluated"] == RUNS
    assert project.value("SELECT count(*) FROM wide WHERE x = 'a' AND y = 'b'") == RUNS
    assert project.executed == RUNS


@pytest.mark.integration
def test_going_back_to_earlier_rules_judges_nothing(project: Counted) -> None:
    before = project.rows("SELECT * FROM wide ORDER BY ALL")
    project.declare(WIDE + 'delimiter = ","\n')
    project.ask()
    assert project.rows("SELECT * FROM wide ORDER BY ALL") != before
    project.declare(WIDE)
    answer = project.ask()
    assert (answer["executed"], answer["reevaluated"], answer["reused"]) == (0, 0, RUNS)
    assert project.rows("SELECT * FROM wide ORDER BY ALL") == before
    assert project.executed == RUNS
    project.is_sound()


@pytest.mark.integration
def test_what_fails_by_the_new_rules_is_reported_and_executed_only_when_asked_again(project: Counted) -> None:
    project.declare(WIDE + "min_rows = 4\n")
    short = project.value("SELECT count(*) FROM (SELECT run FROM wide GROUP BY run HAVING count(*) = 3)")
    assert 0 < short < RUNS
    answer = project.ask(1)
    assert (answer["executed"], answer["failed"], answer["reevaluated"]) == (0, short, RUNS)
    assert "min_rows asks for 4" in answer["failures"][0]["reason"]
    assert project.executed == RUNS
    assert project.value("SELECT count(DISTINCT run) FROM wide") == RUNS - short
    assert project.value("SELECT count(*) FROM runs WHERE status = 'failed'") == short
    project.is_sound()
    assert project.ask(1)["executed"] == short
    assert project.executed == RUNS + short
    project.declare(WIDE)
    assert project.ask()["executed"] == 0


@pytest.mark.integration
def test_what_failed_by_other_rules_is_good_by_the_new_ones(tmp_path: Path) -> None:
    project = Counted(tmp_path / "project", SWARM + '[outputs.missing]\nfile = "missing.csv"\n')
    assert project.ask(1)["failed"] == RUNS
    project.declare(
        SWARM
        + '[outputs.missing]\nfile = "missing.csv"\nrequired = false\n[outputs.wide]\nfile = "wide.csv"\nformat = "file"\n'
    )
    answer = project.ask()
    assert (answer["executed"], answer["reevaluated"], answer["reused"]) == (0, RUNS, RUNS)
    assert project.executed == RUNS
    assert project.value("SELECT count(*) FROM swarm") == RUNS * 5
    project.is_sound()


@pytest.mark.integration
def test_what_failed_by_rules_that_judged_anew_is_judged_anew_once_more(project: Counted) -> None:
    project.declare(WIDE + "min_rows = 5\n")
    assert project.ask(1)["failed"] == RUNS
    project.declare(WIDE + "min_rows = 1\n")
    answer = project.ask()
    assert (answer["executed"], answer["failed"], answer["reevaluated"]) == (0, 0, RUNS)
    assert project.executed == RUNS
    project.is_sound()


@pytest.mark.integration
def test_a_failure_that_rules_do_not_explain_is_executed_again(tmp_path: Path) -> None:
    failing = SIMULATOR + "sys.exit(3)\n"
    project = Counted(tmp_path / "project", "", failing)
    assert project.ask(1)["failed"] == RUNS
    project.declare(SWARM)
    assert f"{RUNS} runs: failed: exit status 3" in project.said("run", *ASK, "--dry-run", "--explain")
    assert project.ask(1)["executed"] == RUNS  # by these rules they fail too
    project.declare(SWARM + "[outputs.wide]\nfile = 'wide.csv'\nformat = 'file'\n[success]\nexit_status = [0, 3]\n")
    assert project.ask()["reevaluated"] == RUNS
    assert project.executed == 2 * RUNS


@pytest.mark.integration
def test_a_marker_in_the_log_is_looked_for_in_what_is_recorded(project: Counted) -> None:
    project.declare(WIDE + '[success]\nmarker = "stdout"\ncontains = "done 1"\n')
    answer = project.ask(1)
    assert (answer["executed"], answer["failed"], answer["reevaluated"]) == (0, RUNS // 2, RUNS)
    assert project.executed == RUNS


@pytest.mark.integration
def test_a_log_that_was_cut_cannot_be_judged(tmp_path: Path) -> None:
    project = Counted(tmp_path / "project", "", SIMULATOR + "print('x' * 3_000_000)\n")
    project.ask(0, "population_size=1", "--runs", "1", "--no-figures")
    project.declare('[success]\nmarker = "stdout"\ncontains = "done"\n')
    told = project.said("run", "population_size=1", "--runs", "1", "--no-figures")
    assert "of its stdout only the beginning and the end are in the store" in told
    assert project.executed == 2


@pytest.mark.integration
def test_what_may_differ_between_siblings_executes_nothing(tmp_path: Path) -> None:
    project = Counted(tmp_path / "project", WIDE.replace("ragged", "strict"))
    odd = project.ask(1)["failed"]
    assert 0 < odd < RUNS
    project.declare(WIDE)
    answer = project.ask()
    assert (answer["executed"], answer["reevaluated"], answer["failed"]) == (0, odd, 0)
    project.declare(WIDE.replace("ragged", "strict"))
    answer = project.ask(1)
    assert (answer["executed"], answer["failed"]) == (0, odd)
    assert project.executed == RUNS
    project.is_sound()


@pytest.mark.integration
def test_what_is_asked_says_what_is_judged_and_what_executes(project: Counted) -> None:
    project.declare(WIDE + 'delimiter = ";"\n')
    assert f"{RUNS} runs: [outputs] or [success] have changed: judged anew from the record" in project.said(
        "run", *ASK, "--dry-run", "--explain"
    )
    assert f"0 of {RUNS} runs would execute, {RUNS} would be judged anew" in project.said("run", *ASK, "--dry-run")
    batch = project.value("SELECT batch FROM batches")
    assert "judged anew from the record" in project.said("why", batch)
    assert f"{RUNS} runs: 0 executed, {RUNS} reused ({RUNS} judged anew" in project.said("run", *ASK)
    told = project.said("why", batch)
    assert f"{RUNS} runs judged anew by other rules, not executed" in told


@pytest.mark.integration
def test_without_the_bytes_the_runs_execute_and_it_is_said_why(tmp_path: Path) -> None:
    project = Counted(tmp_path / "project", "[store]\nraw = false\n" + WIDE)
    project.ask()
    assert project.value("SELECT count(*) FROM artifacts a JOIN objects USING (sha256) WHERE a.kind = 'table'") == 0
    project.declare(WIDE + 'delimiter = ";"\n')
    assert "the bytes of 'swarm.csv' are not in the store" in project.said("run", *ASK, "--dry-run", "--explain")
    told = project.said("run", *ASK)
    assert f"executing {RUNS} runs again, which cannot be judged by the changed rules: the bytes of" in told
    assert project.executed == 2 * RUNS


@pytest.mark.integration
def test_rules_that_read_tables_as_before_need_no_bytes(tmp_path: Path) -> None:
    project = Counted(tmp_path / "project", "[store]\nraw = false\n" + WIDE)
    project.ask()
    rows = {name: project.rows(f"SELECT * EXCLUDE (row) FROM {name} ORDER BY run, row") for name in ("swarm", "wide")}
    project.declare(SWARM + 'units = { coverage = "m" }\n' + WIDE)
    assert project.ask()["reevaluated"] == RUNS, "what is declared for the first time is read as it was"
    project.declare(WIDE + "min_rows = 4\n")
    assert f"0 of {RUNS} runs would execute, {RUNS} would be judged anew" in project.said("run", *ASK, "--dry-run")
    short = project.value("SELECT count(*) FROM (SELECT run FROM wide GROUP BY run HAVING count(*) = 3)")
    answer = project.ask(1)
    assert (answer["executed"], answer["reevaluated"], answer["failed"]) == (0, RUNS, short)
    project.declare(WIDE + "required = false\n[success]\nexit_status = [0, 3]\n")
    answer = project.ask()
    assert (answer["executed"], answer["reevaluated"], answer["failed"]) == (0, RUNS, 0)
    assert project.executed == RUNS
    for name, found in rows.items():
        assert project.rows(f"SELECT * EXCLUDE (row) FROM {name} ORDER BY run, row") == found
    artifacts = "SELECT * EXCLUDE (execution) FROM all_artifacts WHERE kind = 'table' GROUP BY ALL HAVING count(*) < 4"
    assert project.rows(artifacts) == []
    project.is_sound()


@pytest.mark.integration
def test_rows_that_are_not_as_many_as_were_recorded_are_not_copied(project: Counted, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        "sierra.store.rejudged_rows.ROWS", "SELECT o.* REPLACE (m.made AS execution) FROM {files} o, made m LIMIT 5"
    )
    project.declare(WIDE + "min_rows = 1\n")
    ended = quick(project.root, "run", *ASK)
    assert ended.returncode == 1
    assert "rows where" in ended.stderr


@pytest.mark.integration
def test_bytes_that_are_dropped_are_said_to_be_and_runs_execute_where_they_are_needed(project: Counted) -> None:
    rows = project.rows("SELECT * EXCLUDE (row) FROM swarm ORDER BY run, row")
    told = project.said("gc", "--raw", "--dry-run")
    assert "files that became tables: their bytes, not their rows" in told
    assert "may execute their runs again" in told
    assert quick(project.root, "gc", "--yes").returncode == 0
    kept = "SELECT count(*) FROM all_artifacts a JOIN objects USING (sha256) WHERE a.kind = 'table'"
    assert project.value(kept) == 2 * RUNS
    assert quick(project.root, "gc", "--raw", "--yes").returncode == 0
    assert project.value(kept) == 0
    assert project.value("SELECT count(*) FROM artifacts a JOIN objects USING (sha256) WHERE a.kind = 'log'") == RUNS
    assert project.rows("SELECT * EXCLUDE (row) FROM swarm ORDER BY run, row") == rows
    project.is_sound()
    project.declare(WIDE + 'time = "a"\nunits = { b = "m" }\n')
    assert project.ask()["executed"] == 0
    project.declare(WIDE + 'delimiter = ";"\n')
    assert "sierra gc --raw" in project.said("run", *ASK, "--dry-run", "--explain")
    assert project.ask()["executed"] == RUNS
    assert project.executed == 2 * RUNS
    project.is_sound()


@pytest.mark.integration
def test_bytes_of_a_table_that_are_needed_as_those_of_a_file_are_not_dropped(project: Counted) -> None:
    project.declare('[outputs.swarm]\nfile = "swarm.csv"\nformat = "file"\n' + WIDE)
    assert project.ask()["reevaluated"] == RUNS
    assert quick(project.root, "gc", "--raw", "--yes").returncode == 0
    kept = "SELECT count(*) FROM artifacts a JOIN objects USING (sha256) WHERE a.path = {!r}"
    assert project.value(kept.format("swarm.csv")) == RUNS
    assert project.value(kept.format("wide.csv")) == 0
    project.is_sound()


@pytest.mark.integration
def test_two_sessions_that_judge_at_once_leave_each_row_once(project: Counted) -> None:
    project.declare(WIDE + 'delimiter = ";"\n')
    both = [start(project.root, "run", *ASK, stderr=subprocess.STDOUT) for _ in range(2)]
    assert [process.wait(200) for process in both] == [0, 0]
    for process in both:
        process.communicate()
    assert project.executed == RUNS
    assert project.value("SELECT count(*) FROM swarm") == RUNS * 5
    assert project.value("SELECT count(DISTINCT run) FROM effective") == RUNS
    project.is_sound()


@pytest.mark.integration
def test_a_session_that_is_killed_while_it_judges_costs_nothing(project: Counted) -> None:
    project.declare(WIDE + 'delimiter = ";"\n')
    before = {path.name for path in (project.root / ".sierra" / "segments").iterdir()}
    killed = 0
    for number in range(8):
        asking = subprocess.Popen(
            [str(SIERRA), "run", *ASK], cwd=project.root, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        until(lambda asking=asking: asking.poll() is not None or any(project.root.glob(".sierra/work/*/anew")), "it judges")
        time.sleep(0.03 * number)
        if asking.poll() is None:
            os.kill(asking.pid, signal.SIGKILL)
            killed += 1
        asking.wait()
    assert killed
    assert before <= {path.name for path in (project.root / ".sierra" / "segments").iterdir()}
    assert project.ask()["executed"] == 0
    assert project.executed == RUNS
    assert project.value("SELECT count(*) FROM swarm") == RUNS * 5
    assert not any(project.root.glob(".sierra/work/*/anew"))
    project.is_sound()


@pytest.mark.integration
def test_a_replay_compares_with_what_counts(project: Counted) -> None:
    project.declare(WIDE + 'delimiter = ";"\n')
    project.ask()
    ended = quick(project.root, "replay", project.value("SELECT batch FROM batches"), "--json")
    assert ended.returncode == 0, ended.stderr
    assert json.loads(ended.stdout)["verdict"] == "identical"
    assert project.value("SELECT count(*) FROM verdicts v SEMI JOIN executions e ON e.execution = v.recorded") > 0
    project.is_sound()


@pytest.mark.integration
def test_removing_an_execution_removes_its_judgements(project: Counted) -> None:
    project.declare(WIDE + 'delimiter = ";"\n')
    project.ask()
    execution = project.value("SELECT min(execution) FROM executions")
    assert quick(project.root, "rm", execution, "--yes").returncode == 0
    assert project.value("SELECT count(*) FROM judgements") == RUNS - 1
    assert project.value("SELECT count(*) FROM swarm") == (RUNS - 1) * 5
    project.is_sound()
    assert project.ask()["executed"] == 1
    assert quick(project.root, "rm", project.value("SELECT batch FROM batches"), "--yes").returncode == 0
    for table in ("judgements", "executions", "all_artifacts", "ingest_rules", "objects"):
        assert project.value(f"SELECT count(*) FROM {table}") == 0
    project.is_sound()


@pytest.mark.integration
def test_merging_segments_changes_no_row(project: Counted) -> None:
    for config in (WIDE + 'delimiter = ";"\n', WIDE + "min_rows = 1\n", WIDE + "min_rows = 2\n", WIDE + "min_rows = 3\n"):
        project.declare(config)
        project.ask()
    tables = {
        "swarm": "SELECT * EXCLUDE (row) FROM swarm ORDER BY run, row",
        "wide": "SELECT * EXCLUDE (row) FROM wide ORDER BY run, row",
        "judged": "SELECT * FROM all_judgements ORDER BY ALL",
    }
    rows = {name: project.rows(text) for name, text in tables.items()}
    assert quick(project.root, "gc", "--yes").returncode == 0
    assert rows == {name: project.rows(text) for name, text in tables.items()}
    project.declare(WIDE)
    assert project.ask()["executed"] == 0
    project.is_sound()


@pytest.mark.integration
def test_a_byte_that_is_flipped_in_the_kept_files_is_noticed(project: Counted) -> None:
    path = next(project.root.glob(".sierra/segments/*/output.swarm.parquet")).with_name("objects.parquet")
    content = bytearray(path.read_bytes())
    content[len(content) // 3] ^= 1
    path.write_bytes(content)
    ended = quick(project.root, "fsck")
    assert ended.returncode == 1
    assert "objects.parquet" in ended.stdout
