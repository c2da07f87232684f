"""Recorded executions are evaluated again when [outputs] or [success] change, without executing runs."""

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
from tests import projects, stores
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
    """A project whose simulator logs each execution to a file outside the project."""

    def __init__(self, root: Path, config: str = WIDE, simulator: str = SIMULATOR) -> None:
        self.log = root.with_name("executed")
        self.root = projects.make(root, projects.CONFIG + config, simulator=simulator.replace("{log!r}", repr(str(self.log))))

    @property
    def executed(self) -> int:
        return len(self.log.read_text().split())

    def declare(self, config: str) -> None:
        """Replace the declared outputs."""
        (self.root / "sierra.toml").write_text(projects.CONFIG + config)

    def ask(self, code: int = 0, *words: str) -> dict[str, Any]:
        ended = quick(self.root, "run", *(words or ASK), "--json")
        assert ended.returncode == code, ended.stdout + ended.stderr
        answer: dict[str, Any] = json.loads(ended.stdout)
        return answer

    def said(self, *words: str) -> str:
        """Return the plain-text output and messages of a command."""
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
def test_newly_declared_outputs_are_read_without_executing_runs(tmp_path: Path) -> None:
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


@pytest.mark.nightly
@pytest.mark.integration
def test_changed_delimiter_reads_the_recorded_bytes_again(project: Counted) -> None:
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


@pytest.mark.nightly
@pytest.mark.integration
def test_headerless_columns_are_read_from_the_recorded_bytes(project: Counted) -> None:
    project.declare(WIDE + 'header = false\ncolumns = ["x", "y"]\ndelimiter = ";"\n')
    assert project.ask()["reevaluated"] == RUNS
    assert project.value("SELECT count(*) FROM wide WHERE x = 'a' AND y = 'b'") == RUNS
    assert project.executed == RUNS


@pytest.mark.nightly
@pytest.mark.integration
def test_returning_to_earlier_rules_evaluates_nothing_again(project: Counted) -> None:
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


@pytest.mark.nightly
def test_runs_that_fail_by_new_rules_are_executed_only_when_the_query_is_repeated(project: Counted) -> None:
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
def test_failed_runs_become_successful_by_new_rules_without_execution(tmp_path: Path) -> None:
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


@pytest.mark.nightly
@pytest.mark.integration
def test_runs_that_failed_a_reevaluation_are_evaluated_again_by_newer_rules(project: Counted) -> None:
    project.declare(WIDE + "min_rows = 5\n")
    assert project.ask(1)["failed"] == RUNS
    project.declare(WIDE + "min_rows = 1\n")
    answer = project.ask()
    assert (answer["executed"], answer["failed"], answer["reevaluated"]) == (0, 0, RUNS)
    assert project.executed == RUNS
    project.is_sound()


@pytest.mark.nightly
@pytest.mark.integration
def test_failures_with_another_cause_than_the_rules_are_executed_again(tmp_path: Path) -> None:
    failing = SIMULATOR + "sys.exit(3)\n"
    project = Counted(tmp_path / "project", "", failing)
    assert project.ask(1)["failed"] == RUNS
    project.declare(SWARM)
    assert f"{RUNS} runs: failed: exit status 3" in project.said("run", *ASK, "--dry-run", "--explain")
    assert project.ask(1)["executed"] == RUNS  # they fail by these rules too
    project.declare(SWARM + "[outputs.wide]\nfile = 'wide.csv'\nformat = 'file'\n[success]\nexit_status = [0, 3]\n")
    assert project.ask()["reevaluated"] == RUNS
    assert project.executed == 2 * RUNS


@pytest.mark.nightly
@pytest.mark.integration
def test_success_markers_are_searched_in_the_recorded_log(project: Counted) -> None:
    project.declare(WIDE + '[success]\nmarker = "stdout"\ncontains = "done 1"\n')
    answer = project.ask(1)
    assert (answer["executed"], answer["failed"], answer["reevaluated"]) == (0, RUNS // 2, RUNS)
    assert project.executed == RUNS


@pytest.mark.nightly
@pytest.mark.integration
def test_truncated_logs_cannot_be_evaluated_again_so_their_runs_are_executed(tmp_path: Path) -> None:
    project = Counted(tmp_path / "project", "", SIMULATOR + "print('x' * 3_000_000)\n")
    project.ask(0, "population_size=1", "--runs", "1", "--no-figures")
    project.declare('[success]\nmarker = "stdout"\ncontains = "done"\n')
    told = project.said("run", "population_size=1", "--runs", "1", "--no-figures")
    assert "the store has only the beginning and the end of stdout" in told
    assert project.executed == 2


@pytest.mark.nightly
@pytest.mark.integration
def test_changed_mismatch_rule_evaluates_again_without_executing_runs(tmp_path: Path) -> None:
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


@pytest.mark.nightly
@pytest.mark.integration
def test_dry_run_why_and_run_report_how_many_runs_are_evaluated_again(project: Counted) -> None:
    project.declare(WIDE + 'delimiter = ";"\n')
    assert f"{RUNS} runs: [outputs] or [success] have changed: evaluated again from the record" in project.said(
        "run", *ASK, "--dry-run", "--explain"
    )
    assert f"0 of {RUNS} runs would execute, {RUNS} would be evaluated again" in project.said("run", *ASK, "--dry-run")
    batch = project.value("SELECT batch FROM batches")
    assert "evaluated again from the record" in project.said("why", batch)
    assert f"{RUNS} runs: 0 executed, {RUNS} reused ({RUNS} evaluated again" in project.said("run", *ASK)
    told = project.said("why", batch)
    assert f"{RUNS} runs evaluated again by other rules, not executed" in told


@pytest.mark.nightly
@pytest.mark.integration
def test_runs_are_executed_again_with_the_reason_if_their_raw_files_are_not_stored(tmp_path: Path) -> None:
    project = Counted(tmp_path / "project", "[store]\nraw = false\n" + WIDE)
    project.ask()
    assert project.value("SELECT count(*) FROM artifacts a JOIN objects USING (sha256) WHERE a.kind = 'table'") == 0
    project.declare(WIDE + 'delimiter = ";"\n')
    assert "the bytes of 'swarm.csv' are not in the store" in project.said("run", *ASK, "--dry-run", "--explain")
    told = project.said("run", *ASK)
    assert f"executing {RUNS} runs again; their records cannot be evaluated by the changed rules: the bytes of" in told
    assert project.executed == 2 * RUNS


@pytest.mark.nightly
@pytest.mark.integration
def test_rules_that_do_not_change_parsing_need_no_raw_files(tmp_path: Path) -> None:
    project = Counted(tmp_path / "project", "[store]\nraw = false\n" + WIDE)
    project.ask()
    rows = {name: project.rows(f"SELECT * EXCLUDE (row) FROM {name} ORDER BY run, row") for name in ("swarm", "wide")}
    project.declare(SWARM + 'units = { coverage = "m" }\n' + WIDE)
    assert project.ask()["reevaluated"] == RUNS, "what is declared for the first time is read as it was"
    project.declare(WIDE + "min_rows = 4\n")
    assert f"0 of {RUNS} runs would execute, {RUNS} would be evaluated again" in project.said("run", *ASK, "--dry-run")
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


@pytest.mark.nightly
@pytest.mark.integration
def test_reevaluation_fails_if_the_number_of_copied_rows_differs_from_the_record(
    project: Counted, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        "sierra.store.copy_rejudged_rows.ROWS", "SELECT o.* REPLACE (m.made AS execution) FROM {files} o, made m LIMIT 5"
    )
    project.declare(WIDE + "min_rows = 1\n")
    ended = quick(project.root, "run", *ASK)
    assert ended.returncode == 1
    assert "were recorded; see sierra fsck" in ended.stderr


@pytest.mark.nightly
@pytest.mark.integration
def test_gc_raw_reports_dropped_files_and_runs_that_need_them_are_executed_again(project: Counted) -> None:
    rows = project.rows("SELECT * EXCLUDE (row) FROM swarm ORDER BY run, row")
    told = project.said("gc", "--raw", "--dry-run")
    assert "files that became tables: their bytes, not their rows" in told
    assert "may then execute their runs again" in told
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


@pytest.mark.nightly
@pytest.mark.integration
def test_gc_raw_keeps_raw_files_that_are_declared_as_files(project: Counted) -> None:
    project.declare('[outputs.swarm]\nfile = "swarm.csv"\nformat = "file"\n' + WIDE)
    assert project.ask()["reevaluated"] == RUNS
    assert quick(project.root, "gc", "--raw", "--yes").returncode == 0
    kept = "SELECT count(*) FROM artifacts a JOIN objects USING (sha256) WHERE a.path = {!r}"
    assert project.value(kept.format("swarm.csv")) == RUNS
    assert project.value(kept.format("wide.csv")) == 0
    project.is_sound()


@pytest.mark.integration
def test_two_sessions_that_evaluate_again_at_once_do_not_duplicate_rows(project: Counted) -> None:
    project.declare(WIDE + 'delimiter = ";"\n')
    both = [start(project.root, "run", *ASK, stderr=subprocess.STDOUT) for _ in range(2)]
    assert [process.wait(200) for process in both] == [0, 0]
    for process in both:
        process.communicate()
    assert project.executed == RUNS
    assert project.value("SELECT count(*) FROM swarm") == RUNS * 5
    assert project.value("SELECT count(DISTINCT run) FROM effective") == RUNS
    project.is_sound()


@pytest.mark.nightly
@pytest.mark.integration
def test_killed_reevaluation_loses_nothing_and_executes_nothing_again(project: Counted) -> None:
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


@pytest.mark.nightly
@pytest.mark.integration
def test_replay_compares_with_the_effective_execution_after_reevaluation(project: Counted) -> None:
    project.declare(WIDE + 'delimiter = ";"\n')
    project.ask()
    ended = quick(project.root, "replay", project.value("SELECT batch FROM batches"), "--json")
    assert ended.returncode == 0, ended.stderr
    assert json.loads(ended.stdout)["verdict"] == "identical"
    assert project.value("SELECT count(*) FROM verdicts v SEMI JOIN executions e ON e.execution = v.recorded") > 0
    project.is_sound()


@pytest.mark.integration
def test_show_lists_the_later_judgements_of_an_execution(project: Counted) -> None:
    project.declare(WIDE + 'delimiter = ";"\n')
    project.ask()
    execution = project.value("SELECT min(execution) FROM executions")
    shown = json.loads(quick(project.root, "show", execution, "--json").stdout)
    assert [(row["status"], "judged_at" in row, "reason" in row) for row in shown["judgements"]] == [("ok", True, False)]
    assert "\njudgements:\n" in quick(project.root, "show", execution).stdout


@pytest.mark.nightly
@pytest.mark.integration
def test_removing_an_execution_removes_its_judgements_and_rows(project: Counted) -> None:
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


@pytest.mark.nightly
@pytest.mark.integration
def test_gc_changes_no_rows_or_judgements_of_reevaluated_executions(project: Counted) -> None:
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
def test_fsck_notices_a_flipped_bit_in_the_stored_raw_files(project: Counted) -> None:
    path = stores.files(project.root, "output.swarm")[0].with_name("objects.parquet")
    content = bytearray(path.read_bytes())
    content[len(content) // 3] ^= 1
    path.write_bytes(content)
    ended = quick(project.root, "fsck")
    assert ended.returncode == 1
    assert "objects.parquet" in ended.stdout
