"""`sierra collect` records what another system has executed: only what fits the plan, never twice, never as observed."""

from __future__ import annotations

import csv
import json
import os
import shutil
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from sierra.containers import container_setup
from sierra.extensions.collect import runner
from sierra.extensions.collect.runner import isolation_of
from tests.projects import CONFIG, make, quick, run, sql, start, values
from tests.waiting import until

QUERY = ("population_size=1,2", "--runs", "2")
LIMITED = CONFIG + "[limits]\noutput = 1000000\n"


@pytest.fixture(scope="module")
def before(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with a project and the inputs of four runs, which have not been executed."""
    folder = tmp_path_factory.mktemp("collected")
    project = make(folder / "project", LIMITED)
    written = quick(project, "run", *QUERY, "--inputs", "../inputs")
    assert written.returncode == 0, written.stderr
    return folder


@pytest.fixture
def project(before: Path, tmp_path: Path) -> Path:
    """Return a project in another place than the one that wrote its inputs."""
    shutil.copytree(before / "inputs", tmp_path / "inputs")
    return shutil.copytree(before / "project", tmp_path / "project")


def rows(project: Path) -> dict[str, dict[str, str]]:
    """Return the rows of the manifest by folder."""
    with (project.parent / "inputs" / "manifest.csv").open(encoding="utf-8", newline="") as file:
        return {row["folder"]: row for row in csv.DictReader(file)}


def end(project: Path, *folders: str, **changes: Any) -> None:
    """Let runs end as another system would have executed them, by default successfully."""
    known = rows(project)
    for name in folders or known:
        folder = project.parent / "inputs" / name
        (folder / "output" / "swarm.csv").write_text(f"tick,coverage\n0,{known[name]['seed']}\n")
        (folder / "stdout").write_text("done\n")
        (folder / "stderr").write_text("it was hot\n")
        now = time.time()
        record = {"format": 1, "run": known[name]["run"], "status": 0, "started": now - 2, "ended": now, "host": "node1"}
        (folder / "ended.json").write_text(json.dumps({**record, "system": "Linux", "machine": "riscv64", **changes}))


def collect(project: Path, *words: str, code: int = 0) -> dict[str, Any]:
    """Collect the runs without figures; return the answer."""
    done = quick(project, "collect", "../inputs", "--no-figures", "--json", *words)
    assert done.returncode == code, done.stderr
    answer: dict[str, Any] = json.loads(done.stdout)
    return answer


def test_runs_that_have_ended_are_recorded_with_what_is_known_of_the_machine(project: Path) -> None:
    end(project, "runs/0/0", "runs/1/1")
    answer = collect(project)
    assert answer["collected"] == {
        "runs": 4,
        "ended": 2,
        "known": 0,
        "failed": 0,
        "waiting": ["runs/0/1", "runs/1/0"],
        "refused": {},
    }
    [row] = sql(
        project,
        "SELECT DISTINCT status, method, o.reason, e.host, v.os, v.machine, v.cores, v.container, v.python, s.runner "
        "FROM executions e JOIN observations o USING (execution) JOIN sessions s USING (session) "
        "JOIN environments v ON v.environment = e.environment",
    )
    assert row == {
        "status": "ok",
        "method": "collected",
        "reason": "another system executed it, and nobody observed which files it used",
        "host": "node1",
        "os": "Linux",
        "machine": "riscv64",
        "cores": 0,
        "container": "unknown",
        "python": "",
        "runner": "collected",
    }
    seeds = {int(row["seed"]) for name, row in rows(project).items() if name in ("runs/0/0", "runs/1/1")}
    assert values(project, "SELECT coverage FROM swarm") == seeds
    assert values(project, "SELECT path FROM artifacts WHERE kind = 'log'") == {"stdout", "stderr"}


def test_collecting_leaves_the_folder_as_it_is(project: Path) -> None:
    end(project)
    folder = project.parent / "inputs"
    before = {path: path.stat().st_mtime_ns for path in folder.rglob("*")}
    collect(project)
    assert {path: path.stat().st_mtime_ns for path in folder.rglob("*")} == before


@pytest.mark.integration
def test_nothing_is_recorded_twice(project: Path) -> None:
    end(project, "runs/0/0")
    end(project, "runs/0/1", status=3)
    assert collect(project, code=1)["executed"] == 2
    end(project, "runs/1/0")
    answer = collect(project, code=1)
    assert (answer["executed"], answer["collected"]["known"], answer["collected"]["failed"]) == (1, 2, 1)
    assert sql(project, "SELECT count(*) AS n, count(DISTINCT execution) AS d FROM executions") == [{"n": 3, "d": 3}]


@pytest.mark.integration
def test_a_failed_run_that_was_executed_again_is_recorded_again(project: Path) -> None:
    for _ in range(3):
        end(project, status=3)
        collect(project, code=1)
    end(project)
    answer = collect(project)
    assert (answer["executed"], answer["failed"], answer["missing"]) == (4, 0, 0)
    assert values(project, "SELECT count(*) FROM executions") == {16}


@pytest.mark.parametrize(("status", "reason"), [(3, "exit status 3"), (139, "ended by signal 11 (SIGSEGV)")])
def test_a_failure_is_a_result(status: int, reason: str, project: Path) -> None:
    end(project, "runs/0/0", status=status)
    answer = collect(project, code=1)
    assert (answer["failed"], answer["collected"]["failed"]) == (1, 1)
    [failure] = answer["failures"]
    assert (failure["reason"], failure["log"]) == (reason, "it was hot")


@pytest.mark.parametrize("name", ["input.xml", "command.json", "command.sh"])
def test_a_run_with_another_input_or_command_is_refused_and_others_are_recorded(name: str, project: Path) -> None:
    end(project, "runs/0/0", "runs/0/1")
    file = project.parent / "inputs" / "runs/0/0" / name
    file.write_bytes(file.read_bytes() + b" ")
    answer = collect(project, code=1)
    assert answer["collected"]["refused"] == {"runs/0/0": f"{name} is not as sierra run --inputs wrote it"}
    assert values(project, "SELECT run FROM executions") == {rows(project)["runs/0/1"]["run"]}
    file.unlink()
    assert collect(project, code=1)["collected"]["refused"] == {"runs/0/0": f"{name} cannot be read: No such file or directory"}


def test_a_record_of_another_run_is_refused(project: Path) -> None:
    end(project, "runs/0/0")
    folder = project.parent / "inputs" / "runs"
    shutil.copy(folder / "0/0/ended.json", folder / "0/1/ended.json")
    mine, other = (rows(project)[f"runs/0/{number}"]["run"][:10] for number in (1, 0))
    reason = f"ended.json is of run {other!r}, and this is the folder of run {mine}"
    assert collect(project, code=1)["collected"]["refused"] == {"runs/0/1": reason}


def test_a_half_written_record_is_refused(project: Path) -> None:
    end(project)
    file = project.parent / "inputs/runs/0/0/ended.json"
    file.write_bytes(file.read_bytes()[:40])
    answer = collect(project, code=1)
    assert answer["collected"]["refused"] == {"runs/0/0": "ended.json is not JSON: it is damaged or incomplete"}
    assert answer["executed"] == 3


def test_outputs_beyond_the_limit_are_refused(project: Path) -> None:
    end(project)
    with (project.parent / "inputs/runs/0/0/output/large").open("wb") as file:
        file.truncate(1 << 40)
    refused = collect(project, code=1)["collected"]["refused"]
    assert refused == {"runs/0/0": "its outputs have 1.1 TB, more than output in [limits] allows"}


def test_a_link_among_the_outputs_is_reported_and_not_read(project: Path) -> None:
    end(project)
    (project.parent / "secret").write_text("secret")
    (project.parent / "inputs/runs/0/0/output/link").symlink_to(project.parent / "secret")
    answer = collect(project)
    assert any("link" in note for note in answer["notes"])
    assert values(project, "SELECT DISTINCT path FROM artifacts WHERE kind <> 'log'") == {"swarm.csv"}


def test_files_that_a_run_has_left_beside_its_input_are_reported(project: Path) -> None:
    end(project)
    (project.parent / "inputs/runs/0/0/lost.csv").write_text("a\n1\n")
    assert any("lost.csv" in note for note in collect(project)["notes"])


def test_nothing_is_recorded_before_a_run_has_ended(project: Path) -> None:
    assert collect(project)["collected"]["ended"] == 0
    done = quick(project, "collect", "../inputs")
    assert done.stdout == ("collected from ../inputs: 0 of 4 runs\n4 runs not ended: runs/0/0, runs/0/1, runs/1/0, runs/1/1\n")
    assert not (project / ".sierra").exists()


def test_a_folder_of_another_project_is_refused(project: Path) -> None:
    end(project)
    (project / "sim.py").write_text("print()\n")
    done = quick(project, "collect", "../inputs")
    assert (done.returncode, done.stdout) == (2, "")
    assert "the query is batch" in done.stderr
    assert "use the code and sierra.toml with which the folder was written" in done.stderr
    assert done.stderr.count("\n") == 1
    assert not (project / ".sierra").exists()


@pytest.mark.integration
def test_a_recorded_batch_is_collected_after_the_code_has_changed(project: Path) -> None:
    end(project, "runs/0/0")
    collect(project)
    end(project)
    (project / "sim.py").write_text("print()\n")
    (project / "arena.xml").write_text("<arena/>")
    answer = collect(project)
    assert (answer["executed"], answer["missing"]) == (3, 0)


@pytest.mark.parametrize(
    ("data", "code", "reason"),
    [
        (None, 3, "cannot be read: No such file or directory; name a folder that sierra run --inputs wrote"),
        (b"{", 2, "not JSON"),
        (b'{"request": {"criteria": ["population_size=1"]}}', 2, "has no id of a batch"),
        (b'{"request": {"criteria": ["no_such_variable=1"]}, "batch": "' + b"a" * 64 + b'"}', 2, "no_such_variable"),
        (b" " * (2 << 20), 2, "larger than"),
    ],
)
def test_a_folder_without_a_request_is_refused(data: bytes | None, code: int, reason: str, project: Path) -> None:
    request = project.parent / "inputs" / "batch.json"
    request.unlink()
    if data is not None:
        request.write_bytes(data)
    done = quick(project, "collect", "../inputs")
    assert (done.returncode, done.stderr.count("\n")) == (code, 1)
    assert reason in done.stderr


@pytest.mark.integration
def test_the_query_is_executed_here_when_it_is_requested(project: Path) -> None:
    """Statistics use either collected executions or those of this machine, as the last session of the batch says."""
    end(project)
    collect(project)
    seeds = {int(row["seed"]) for row in rows(project).values()}
    used = "SELECT coverage FROM swarm WHERE execution IN (SELECT execution FROM effective)"
    assert values(project, used) == seeds
    assert run(project, *QUERY)[0]["executed"] == 4
    assert values(project, used) != seeds
    assert run(project, *QUERY)[0]["executed"] == 0
    assert collect(project)["executed"] == 0
    assert values(project, used) == seeds


@pytest.mark.integration
def test_trusted_executions_are_reused(project: Path) -> None:
    end(project)
    assert collect(project, "--trust")["executed"] == 4
    assert run(project, *QUERY)[0]["executed"] == 0
    assert values(project, "SELECT DISTINCT method FROM observations") == {"collected"}


@pytest.mark.integration
def test_executions_of_this_machine_are_reused_with_trust(project: Path) -> None:
    run(project, *QUERY)
    end(project)
    answer = collect(project, "--trust")
    assert (answer["executed"], answer["reused"]) == (0, 4)


@pytest.mark.integration
def test_claims_are_not_registered_after_the_runs_were_executed(project: Path) -> None:
    config = project / "sierra.toml"
    query = '[queries.all]\ncriteria = "population_size=1,2"\nruns = 2\n'
    claim = '[claims.large]\nsays = "It is large."\npaper = "Fig. 1"\nquery = "all"\nsql = "SELECT true AS holds"\n'
    config.write_text(config.read_text() + query + claim)
    end(project)
    done = quick(project, "collect", "../inputs", "--no-figures")
    assert done.returncode == 0, done.stderr
    assert "exploratory" in quick(project, "claims").stdout


def test_the_runner_works_only_for_the_command(project: Path) -> None:
    done = quick(project, "run", *QUERY, "--on", "collected")
    assert done.returncode == 2
    assert "runner 'collected' records what another system has executed: use sierra collect FOLDER" in done.stderr


def test_supervised_trials_are_not_collected(project: Path) -> None:
    config = project / "sierra.toml"
    config.write_text(config.read_text() + "[trials]\nsupervised = true\n")
    end(project)
    done = quick(project, "collect", "../inputs")
    assert (done.returncode, done.stderr) == (
        2,
        "sierra: supervised trials cannot be collected; execute them with sierra run\n",
    )


@pytest.mark.integration
@pytest.mark.parametrize("words", [("show",), ("fsck",), ("report",), ("why",)])
def test_other_commands_take_collected_executions(words: tuple[str, ...], project: Path) -> None:
    end(project, "runs/0/0", "runs/0/1", "runs/1/0")
    end(project, "runs/1/1", status=1)
    collect(project, code=1)
    target = sql(project, "SELECT execution FROM executions LIMIT 1")[0]["execution"] if words == ("why",) else ""
    done = quick(project, *words, *filter(None, [target]))
    assert done.returncode == 0, done.stderr


def meanwhile(monkeypatch: pytest.MonkeyPatch, name: str, act: Callable[[], object]) -> None:
    """Let something happen before the run in this folder is copied."""
    copy = runner._copy_run

    def acting(root: Path, run: str, directory: Path) -> list[str]:
        if run == name:
            act()
        return copy(root, run, directory)

    monkeypatch.setattr(runner, "_copy_run", acting)


@pytest.mark.integration
def test_a_run_that_changes_while_it_is_collected_is_refused_and_others_are_recorded(
    project: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    end(project)
    meanwhile(monkeypatch, "runs/0/1", lambda: end(project, "runs/0/1"))
    answer = collect(project, code=1)
    assert answer["collected"]["refused"] == {"runs/0/1": "it was executed again while it was collected; collect it again"}
    assert (answer["executed"], answer["missing"], answer["collected"]["ended"]) == (3, 1, 3)
    monkeypatch.undo()
    collect(project)
    assert sql(project, "SELECT count(*) AS n, count(DISTINCT execution) AS d FROM executions") == [{"n": 4, "d": 4}]


@pytest.mark.integration
@pytest.mark.parametrize("words", [(), ("--trust",)])
def test_an_edit_of_the_code_while_runs_are_copied_fails_none(
    words: tuple[str, ...], project: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    end(project)
    code = project / "sim.py"
    meanwhile(monkeypatch, "runs/0/1", lambda: code.write_text(code.read_text() + "# edited\n"))
    answer = collect(project, *words)
    assert (answer["executed"], answer["failed"], answer["collected"]["failed"]) == (4, 0, 0)


def deep(run: Path) -> None:
    """Make folders among the outputs whose path is longer than the system allows at once."""
    folder = os.open(run / "output", os.O_DIRECTORY)
    for _ in range(30):
        os.mkdir("d" * 200, dir_fd=folder)
        outer, folder = folder, os.open("d" * 200, os.O_DIRECTORY, dir_fd=folder)
        os.close(outer)
    os.close(os.open("file", os.O_WRONLY | os.O_CREAT, dir_fd=folder))
    os.close(folder)


def replaced(run: Path, name: str, make: Callable[[Path], object]) -> None:
    (run / name).unlink()
    make(run / name)


@pytest.mark.integration
@pytest.mark.parametrize(
    ("spoil", "reason"),
    [
        pytest.param(
            lambda run: replaced(run, "stdout", lambda log: log.symlink_to("/etc/hostname")),
            "stdout cannot be read: Too many levels of symbolic links",
            id="link",
        ),
        pytest.param(
            lambda run: replaced(run, "stdout", os.mkfifo), "stdout cannot be read: it is not a regular file", id="pipe"
        ),
        pytest.param(
            lambda run: replaced(run, "stderr", Path.mkdir), "stderr cannot be read: it is not a regular file", id="folder"
        ),
        pytest.param(deep, "its files cannot be copied: File name too long", id="depth"),
    ],
)
def test_a_run_with_an_odd_log_or_a_long_path_is_refused_and_others_are_recorded(
    spoil: Callable[[Path], None], reason: str, project: Path
) -> None:
    end(project)
    spoil(project.parent / "inputs/runs/0/0")
    answer = collect(project, code=1)
    assert (answer["executed"], answer["collected"]["refused"]) == (3, {"runs/0/0": reason})


@pytest.mark.integration
def test_changed_rules_evaluate_what_is_recorded_and_record_nothing_twice(project: Path) -> None:
    end(project, "runs/0/0", "runs/0/1")
    collect(project)
    config = project / "sierra.toml"
    before = config.read_text()
    config.write_text(f"{before}[success]\nmarker = 'never printed'\n")
    for _ in range(2):
        answer = collect(project, code=1)
        assert (answer["executed"], answer["collected"]["failed"], answer["collected"]["known"]) == (0, 2, 2)
    config.write_text(before)
    assert collect(project)["collected"]["failed"] == 0
    assert sql(project, "SELECT count(*) AS n, count(DISTINCT execution) AS d FROM executions") == [{"n": 2, "d": 2}]


@pytest.mark.integration
def test_runs_that_changed_rules_cannot_evaluate_are_recorded_once_more(project: Path) -> None:
    config = project / "sierra.toml"
    config.write_text(f"{config.read_text()}[store]\nraw = false\n")
    end(project, "runs/0/0")
    collect(project)
    config.write_text(config.read_text() + "[outputs.swarm]\nfile = 'swarm.csv'\nrequired = true\ntime = 'tick'\n")
    answers = [collect(project), collect(project)]
    assert [(answer["executed"], answer["collected"]["failed"]) for answer in answers] == [(1, 0), (0, 0)]


@pytest.mark.integration
def test_of_a_run_that_the_batch_has_twice_the_first_folder_that_is_right_counts(tmp_path: Path) -> None:
    same = "label = 'one'\nchanges = [{ set = '//swarm/@count', value = 1 }]\n"
    project = make(tmp_path / "project", f"{CONFIG}[scenarios.a]\n{same}[scenarios.b]\n{same}")
    written = quick(project, "run", "scenario=a,b", "--runs", "1", "--inputs", "../inputs")
    assert written.returncode == 0, written.stderr
    assert list(rows(project)) == ["runs/0/0", "runs/1/0"]
    end(project)
    (project.parent / "inputs/runs/0/0/input.xml").write_text("<other/>")
    answer = collect(project, code=1)["collected"]
    assert (answer["runs"], answer["ended"], list(answer["refused"])) == (2, 1, ["runs/0/0"])
    shutil.copy(tmp_path / "inputs/runs/1/0/input.xml", tmp_path / "inputs/runs/0/0")
    answer = collect(project)["collected"]
    assert (answer["runs"], answer["ended"], answer["refused"]) == (2, 2, {})
    assert sql(project, "SELECT count(*) AS n FROM executions") == [{"n": 1}]


WAITS = """import pathlib, sys, time
while not (pathlib.Path(__file__).parent.parent / "go").exists():
    time.sleep(0.01)
sys.exit(3)
"""


@pytest.fixture
def executing(tmp_path: Path) -> Iterator[Path]:
    """Yield a project of which a session executes the only run, until there is a file `go`; it has also ended elsewhere."""
    project = make(tmp_path / "project", simulator=WAITS)
    query = ("population_size=1", "--runs", "1")
    assert quick(project, "run", *query, "--inputs", "../inputs").returncode == 0
    end(project)
    session = start(project, "run", *query, "--no-figures")
    try:
        until(lambda: list(project.glob(".sierra/work/*/context.json")))
        yield project
    finally:
        (tmp_path / "go").touch()
        session.communicate()


@pytest.mark.integration
def test_runs_that_another_session_executes_are_not_collected(executing: Path) -> None:
    done = quick(executing, "collect", "../inputs")
    assert (done.returncode, done.stdout) == (3, "")
    assert "executes 1 run of this folder; collect when it has ended\n" in done.stderr


@pytest.mark.integration
def test_a_run_that_another_session_has_executed_meanwhile_is_named(executing: Path) -> None:
    """With --trust, that session executes the same programs, so that its executions count, and collecting waits for it."""
    collecting = start(executing, "collect", "../inputs", "--trust", "--no-figures", "--json")
    until(lambda: len(list(executing.glob(".sierra/work/*/claims.json"))) == 2)
    (executing.parent / "go").touch()
    out, err = collecting.communicate()
    answer = json.loads(out)["collected"]
    assert collecting.returncode == 1, err
    assert (answer["ended"], list(answer["refused"])) == (0, ["runs/0/0"])
    assert collect(executing, "--trust")["executed"] == 1


def test_the_folder_may_be_a_link(project: Path) -> None:
    end(project)
    (project.parent / "linked").symlink_to(project.parent / "inputs")
    done = quick(project, "collect", "../linked", "--no-figures")
    assert (done.returncode, "collected from ../linked: 4 of 4 runs" in done.stdout) == (0, True)


def test_it_is_unknown_whether_an_image_was_used() -> None:
    row = isolation_of("sha256:" + "a" * 64)
    assert (row.engine, row.network, row.rootless, row.version) == ("collected", "unknown", None, None)
    assert row.isolation == isolation_of(row.image).isolation != isolation_of("sha256:" + "b" * 64).isolation
    assert container_setup.limits(row._asdict())["limits_enforced"] == {}
