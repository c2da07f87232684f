"""Files that change while a batch executes fail the runs that use them, and no others."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from sierra.api import Project
from sierra.execution.plan import context
from sierra.ingest.changed_files import Doubt, by_siblings
from tests import projects
from tests.conftest import PRINTS, Simulated, held
from tests.waiting import until

CHANGED = "code or programs have changed since the runs began: "
Change = Callable[[Path], object]


def waiting(count: int, script: str = PRINTS) -> str:
    """Return a simulator as `held` does, whose runs wait for the content of a file that is always there.

    The observation of a run that looks for a file which is made meanwhile is not complete.
    """
    return held(count, script).replace('[ -e "${0%/*}/../gate" ]', '[ -s "${0%/*}/../go" ]')


def append(file: Path) -> None:
    with file.open("a") as log:
        log.write("more\n")


def replace(file: Path) -> None:
    other = file.with_name("..other")
    other.write_text("another content\n")
    other.replace(file)


@pytest.fixture
def observing(simulate: Callable[..., Simulated], require: Callable[..., str]) -> Callable[..., Simulated]:
    """Return a function that makes a project with a script and an old log."""
    require("strace")

    def make(script: str, *, git: bool = False, observe: str = "first") -> Simulated:
        project = simulate(script)
        project.folder.with_name("go").touch()
        toml = project.folder / "sierra.toml"
        toml.write_text(f'observe = "{observe}"\n' + toml.read_text() if observe != "first" else toml.read_text())
        (project.folder / "maps").mkdir()
        (project.folder / "maps" / "one.map").write_text("wall\n")
        if git:
            projects.commit(project.folder)
        (project.folder / "maps" / "log.txt").write_text("before\n")
        return project

    return make


def execute(project: Simulated, change: Change, *words: str, file: str = "maps/log.txt") -> tuple[int, str]:
    """Execute a batch, and change a file while its second run waits."""
    asking = project.start("run", "size=1,2", "--runs", "4", "-j", "1", "--no-figures", *words)
    project.until_executed(2, asking)
    change(project.folder / file)
    project.folder.with_name("go").write_text("go")
    ended = project.end_of(asking)
    return ended.returncode, ended.stdout + ended.stderr


def counts(project: Simulated) -> dict[str, int]:
    rows = project.sql("SELECT status, count(DISTINCT run) AS runs FROM executions GROUP BY status")
    return {row["status"]: row["runs"] for row in rows}


@pytest.mark.integration
@pytest.mark.parametrize("git", [False, pytest.param(True, marks=pytest.mark.nightly)])
@pytest.mark.parametrize(
    ("script", "change"),
    [
        (PRINTS, append),
        (PRINTS, Path.unlink),
        ('ls "${0%/*}/maps" > /dev/null; ' + PRINTS, append),
        ('cat "${0%/*}/maps/one.map" > /dev/null; ' + PRINTS, append),
    ],
    ids=["append", "unlink", "names", "other file read"],
)
def test_a_log_that_no_observed_run_uses_fails_nothing(
    observing: Callable[..., Simulated], script: str, change: Change, git: bool
) -> None:
    project = observing(waiting(1, script), git=git)
    code, said = execute(project, change)
    assert (code, counts(project)) == (0, {"ok": 8}), said
    [row] = project.sql("SELECT count(*) AS observed FROM observations")
    assert 2 <= row["observed"] < 8


@pytest.mark.integration
@pytest.mark.parametrize("git", [False, pytest.param(True, marks=pytest.mark.nightly)])
@pytest.mark.parametrize(
    ("script", "change"),
    [
        ('cat "${0%/*}/maps/log.txt" > /dev/null; ', append),
        ('[ -e "${0%/*}/maps/log.txt" ]; ', append),
        ('ls -l "${0%/*}/maps" > /dev/null; ', append),
        ('cat "${0%/*}"/maps/* > /dev/null; ', replace),
        ('ls "${0%/*}/maps" > /dev/null; ', Path.unlink),
        ('ls "${0%/*}/maps" > /dev/null; ', replace),
        ('[ -e "${0%/*}/maps/log.txt" ]; ', Path.unlink),
    ],
    ids=[
        "read",
        "tested",
        "listed with sizes",
        "all of the folder",
        "listed and removed",
        "listed and replaced",
        "tested and removed",
    ],
)
def test_runs_that_may_have_used_a_changed_file_fail(
    observing: Callable[..., Simulated], script: str, change: Change, git: bool
) -> None:
    project = observing(waiting(1, script + PRINTS), git=git)
    code, said = execute(project, change)
    assert (code, CHANGED + "maps/log.txt (" in said) == (1, True)
    rows = project.sql("SELECT DISTINCT reason FROM executions WHERE status = 'failed'")
    assert [row["reason"].startswith(CHANGED) for row in rows] == [True]
    assert counts(project)["failed"] >= 6  # the first run ended before the change; two may have seen the same names


@pytest.mark.integration
@pytest.mark.parametrize("observe", ["none", "all"])
def test_only_runs_that_are_not_observed_at_all_fail_for_a_log(observing: Callable[..., Simulated], observe: str) -> None:
    project = observing(waiting(1), observe=observe)
    code, said = execute(project, append)
    assert code == (1 if observe == "none" else 0), said
    advice = "maps/log.txt ([source] paths selects the code; logs can be written outside the project)"
    assert (advice in said) == (observe == "none")


@pytest.mark.integration
def test_only_the_experiment_fails_that_uses_the_file(observing: Callable[..., Simulated]) -> None:
    project = observing(waiting(1, 'case "$(cat "$1")" in *size=\\"2\\"*) cat "${0%/*}/maps/log.txt";; esac; ' + PRINTS))
    code, said = execute(project, append)
    rows = project.sql(
        "SELECT ordinal, status, count(*) AS runs FROM executions JOIN batch_runs USING (batch, run) GROUP BY ALL"
    )
    assert (code, {(row["ordinal"], row["status"]): row["runs"] for row in rows}) == (1, {(0, "ok"): 4, (1, "failed"): 4}), said


@pytest.mark.integration
def test_an_unobserved_run_waits_for_the_observed_one_of_its_experiment(observing: Callable[..., Simulated]) -> None:
    project, asking = start_held_by_the_first(observing)
    time.sleep(3)  # longer than a write of results waits at first
    assert project.sql("SELECT count(*) AS recorded FROM executions") == [{"recorded": 0}]
    project.folder.with_name("go").write_text("go")
    ended = project.end_of(asking)
    assert (ended.returncode, counts(project)) == (0, {"ok": 3}), ended.stdout


@pytest.mark.integration
def test_waiting_runs_of_a_session_that_dies_never_count(observing: Callable[..., Simulated]) -> None:
    project, asking = start_held_by_the_first(observing)
    until(lambda: any(project.folder.glob(".sierra/work/*/doubt")), "the change is noticed")
    asking.kill()
    asking.communicate()
    project.folder.with_name("go").write_text("go")

    def is_recorded() -> bool:
        assert projects.quick(project.folder, "gc", "--yes").returncode == 0
        return bool(project.sql("SELECT execution FROM executions"))

    until(is_recorded, "the session is recorded")
    rows = project.sql(
        "SELECT DISTINCT status, reason FROM executions WHERE execution NOT IN (SELECT execution FROM observations)"
    )
    assert [(row["status"], row["reason"].startswith(CHANGED)) for row in rows] == [("failed", True)]


def start_held_by_the_first(observing: Callable[..., Simulated]) -> tuple[Simulated, Any]:
    """Return a project of which the first run, which is observed, waits; the others have ended, and a log has changed."""
    project = observing("")
    seeds = [run.seed for run in Project(project.folder).plan("size=1", runs=3).batch.runs]
    script = (project.folder / "sim.sh").read_text()
    waits = f'grep -q \'seed="{seeds[0]}"\' "$1" && until [ -s "${{0%/*}}/../go" ]; do sleep 0.02; done\n'
    ended = f'echo x >> "{project.folder.parent}/ended"\n'
    (project.folder / "sim.sh").write_text(script + waits + PRINTS + "\n" + ended)
    asking = project.start("run", "size=1", "--runs", "3", "-j", "2", "--no-figures")
    log = project.folder.parent / "ended"
    until(lambda: (log.exists() and len(log.read_text()) == 4) or asking.poll() is not None, "the others end")
    append(project.folder / "maps" / "log.txt")
    return project, asking


@pytest.mark.integration
def test_observed_runs_stand_for_others_of_their_experiment(observing: Callable[..., Simulated]) -> None:
    project = observing('ls "${0%/*}/maps" > /dev/null; cat "${0%/*}/maps/one.map" > /dev/null; ' + PRINTS)
    assert project.quick("run", "size=1", "--runs", "3", "-j", "1", "--no-figures").returncode == 0
    opened = Project(project.folder)
    plan = opened.plan("size=1", runs=3)
    [session] = opened.store.values(str, "SELECT DISTINCT session FROM executions")
    runs = [run.id for run in plan.batch.runs]

    def judged(*files: str, session: str = session, absent: frozenset[str] = frozenset()) -> set[bool | None]:
        names = frozenset(f"{{project}}/{file}" for file in files)
        found = by_siblings(opened.store, context(plan, session), runs, Doubt("changed", names, names & absent))
        return {found.get(run) for run in runs}

    assert judged("unused.txt") == judged("maps/log.txt") == judged("it's; a name\n\\xff") == {True}
    assert judged("maps/one.map") == judged("sim.sh") == judged("unused.txt", "sim.sh") == {False}
    assert judged("maps/gone") == {False}  # the listed folder did not have it
    absent = frozenset(["{project}/maps/log.txt", "{project}/unused.txt"])
    assert judged("maps/log.txt", absent=absent) == {False}  # another run may have listed the folder without it
    assert judged("unused.txt", absent=absent) == {True}  # no run has listed this folder
    assert judged("unused.txt", session="another") == {None}
