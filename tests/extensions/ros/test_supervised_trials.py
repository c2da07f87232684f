"""Supervised trials with lost robots, bags and a killed driver, and all that happens to their records afterwards."""

from __future__ import annotations

import shutil
from functools import partial
from pathlib import Path

import pytest

import sierra
from sierra.extensions.trials import mark_trial
from tests import projects
from tests.extensions.ros.supervised_robots import (
    MESSAGES,
    TICKS,
    copy_without_store,
    have_written,
    leftovers,
    make,
    rows,
    wait,
)
from tests.support.robot_fleet import Fleet
from tests.terminals import Terminal
from tests.waiting import until

pytestmark = pytest.mark.integration
RUN = ("run", "noise=1,2", "--target", "robots", "--no-figures")
GO, JUDGE, REASON, NOTE = "Enter: go, s: skip, a: abort > ", "i: no > ", "or text) > ", "none) > "


def supervise(root: Path) -> Terminal:
    return Terminal(root, str(projects.SIERRA), *RUN, "--operator", "Ann")


def judge(terminal: Terminal, prompt: str, reason: str | None = None) -> None:
    """Answer that a trial is valid, or that it is not, for a reason by its number."""
    terminal.answer(prompt, "i" if reason else "")
    if reason:
        terminal.answer(REASON, reason)
    terminal.answer(NOTE)


@pytest.mark.nightly
def test_a_session_with_lost_robots_and_a_killed_driver_is_recorded_once(fleet: Fleet, tmp_path: Path) -> None:
    root, (first, second, _) = make(fleet, tmp_path / "p"), fleet.names
    quick = partial(projects.quick, root)
    with supervise(root) as terminal:
        terminal.expect(GO)
        fleet.power_cut(second)
        terminal.expect(f"not ready: {second}: ")
        until(lambda: not list(fleet.robots[first].home.glob(".cache/*/runs/*")), "the other one is disarmed")
        fleet.boot(second)
        terminal.answer("Enter: try again, s: skip, a: abort > ")
        terminal.answer(GO)
        terminal.expect(JUDGE)
        [batch] = [one.batch for one in sierra.open(root).batches]
        refused = quick("rm", batch, "--yes")
        assert refused.returncode == 3
        assert "is being executed (session " in refused.stderr
        assert quick("gc", "--yes").returncode == 0, "compaction does not disturb a session"
        terminal.type("i\n")
        terminal.answer(REASON, "1")
        terminal.answer(NOTE)
        wait(fleet)
        terminal.answer(GO)
        until(partial(have_written, fleet), "both robots execute")
        fleet.power_cut(second)
        terminal.expect(f"failed: {second} was lost: ")
        fleet.boot(second)
        wait(fleet, waiting=False)
        judge(terminal, "repeat it > ", reason="2")
        terminal.answer(GO)
        judge(terminal, JUDGE)
        wait(fleet)
        terminal.answer(GO)
        until(partial(have_written, fleet), "both robots execute")
        terminal.process.kill()
        terminal.process.wait()
    wait(fleet, waiting=False)
    with supervise(root) as terminal:
        terminal.answer(GO)
        judge(terminal, JUDGE)
        assert terminal.end() == 0, terminal.shown
    assert leftovers(fleet) == []
    assert_recorded_once(root)
    before = rows(root)
    for change in (("gc", "--yes"), ("gc", "--raw", "--yes")):
        assert quick(*change).returncode == 0
        assert rows(root) == before
    packed = quick("package", batch, "--no-report", "-o", "../p.zip")
    assert packed.returncode == 0, packed.stderr
    other = copy_without_store(root, tmp_path / "other")
    assert projects.quick(other, "import", "../p.zip").returncode == 0
    assert rows(other) == before
    assert [projects.quick(folder, "fsck").returncode for folder in (root, other)] == [0, 0]


def assert_recorded_once(root: Path) -> None:
    """Assert that each trial is recorded once, and that only the two valid ones count."""
    trials = "SELECT valid, t.reason, status FROM trials t JOIN executions USING (execution) ORDER BY position"
    assert [tuple(row.values()) for row in projects.sql(root, trials)] == [
        (False, "fell over", "invalid"),
        (False, "lost", "failed"),
        (True, None, "ok"),
        (True, None, "ok"),
    ]
    [counts] = projects.sql(
        root,
        "SELECT (SELECT count(*) FROM executions) AS executions, (SELECT count(*) FROM effective) AS effective, "
        "(SELECT count(*) FROM robots) AS robots, (SELECT count(*) FROM robot_clocks) AS clocks",
    )
    assert counts == {"executions": 4, "effective": 2, "robots": 8, "clocks": 8}
    for table, of_robots in (("swarm", dict.fromkeys((1, 2), TICKS)), ("odom", MESSAGES)):
        found = projects.sql(root, f"SELECT robot, count(*) AS n FROM {table} GROUP BY ALL ORDER BY ALL")
        assert found == [{"robot": robot, "n": 2 * count} for robot, count in of_robots.items()], table
    [state] = projects.sql(root, "SELECT count(DISTINCT run) AS runs, count(DISTINCT execution) AS executions FROM swarm")
    assert state == {"runs": 2, "executions": 2}


@pytest.fixture
def recorded(fleet: Fleet, tmp_path: Path) -> tuple[Path, str, str]:
    """Return a project with an invalid trial beside those that count, and its batches on robots and in the simulator."""
    root = make(fleet, tmp_path / "p")
    done = projects.quick(root, *RUN, "--yes", "--operator", "Ann")
    assert done.returncode == 0, done.stderr
    project = sierra.open(root)
    [marked] = projects.sql(root, "SELECT execution FROM effective ORDER BY ordinal LIMIT 1")
    mark_trial(project, marked["execution"], valid=False, reason="fell over")
    assert projects.quick(root, *RUN, "--yes", "--operator", "Ann").returncode == 0
    assert projects.quick(root, "run", "noise=1,2", "--target", "sim", "--no-figures").returncode == 0
    fleet_batch, sim = (next(one.batch for one in project.batches if one.targets == [name]) for name in ("robots", "sim"))
    return root, fleet_batch, sim


@pytest.mark.nightly
def test_replays_move_robots_only_if_a_person_agrees(recorded: tuple[Path, str, str], fleet: Fleet) -> None:
    root, batch, _ = recorded
    before = rows(root)
    replay = partial(projects.quick, root, "replay", batch, "--on", "robots")
    refused = replay()
    assert refused.returncode == 3
    assert "has supervised trials ([trials]), and a replay asks nobody before the robots move: use --yes" in refused.stderr
    fleet.power_cut(fleet.names[0])
    missing = replay("--yes")
    assert missing.returncode == 3
    assert missing.stderr.count("\n") < 4
    assert f"{fleet.names[0]}: not reachable" in missing.stderr
    assert rows(root) == before
    fleet.boot(fleet.names[0])
    again = replay("--yes")
    assert again.returncode == 0, again.stderr
    assert "cannot be replayed" in again.stderr
    now = rows(root)
    unchanged = ("trials", "all_trials", "effective", "swarm", "odom")
    assert {table: now[table] for table in unchanged} == {table: before[table] for table in unchanged}
    assert set(before["robots"]) < set(now["robots"])
    assert leftovers(fleet) == []
    assert projects.quick(root, "fsck").returncode == 0


@pytest.mark.nightly
def test_a_package_of_robots_is_read_and_compared_where_no_robots_are(
    recorded: tuple[Path, str, str], fleet: Fleet, tmp_path: Path
) -> None:
    root, batch, sim = recorded
    assert projects.quick(root, "package", batch, sim, "-o", "../p.zip").returncode == 0
    fleet.power_cut(fleet.names[0])
    opened = projects.quick(
        tmp_path, "open", "p.zip", "sql", "--format", "csv", "SELECT status, count(*) FROM executions GROUP BY 1"
    )
    assert sorted(opened.stdout.split()[1:]) == ["invalid,1", "ok,4"]
    report = projects.quick(tmp_path, "open", "p.zip", "report", "--to", "report.html")
    assert report.returncode == 0, report.stderr
    assert "invalid trial: fell over" in (tmp_path / "report.html").read_text()
    reproduced = projects.quick(tmp_path, "reproduce", "p.zip", "--yes", "--into", "reproduction")
    assert reproduced.returncode == 3
    assert "its runs take robots, and a package must not move these" in reproduced.stdout
    assert "identical (2 of 2 runs executed again)" in reproduced.stdout
    other = copy_without_store(root, tmp_path / "other")
    assert projects.quick(other, "import", "../p.zip").returncode == 0
    assert rows(other) == rows(root)
    compare = ("compare", f"sim={sim}", f"robots={batch}", "--column", "coverage", "--no-figure", "--json")
    assert projects.quick(other, *compare).stdout == projects.quick(root, *compare).stdout
    assert projects.quick(other, "rm", batch, "--yes").returncode == 0
    assert projects.quick(other, "import", "../p.zip").returncode == 0
    assert rows(other) == rows(root), "removed, and imported once more"


@pytest.mark.nightly
def test_no_damaged_or_lost_file_lets_an_invalid_trial_count(recorded: tuple[Path, str, str], tmp_path: Path) -> None:
    root, _, _ = recorded
    assert projects.quick(root, "gc", "--yes").returncode == 0
    good = {row["execution"] for row in projects.sql(root, "SELECT execution FROM effective")}
    files = sorted(path.relative_to(root) for path in root.glob(".sierra/segments/*/*"))
    assert len(files) > 30
    for number, file in enumerate(files):
        damaged = shutil.copytree(root, tmp_path / "damaged")
        if number % 2:
            (damaged / file).unlink()
        else:
            content = bytearray((damaged / file).read_bytes())
            content[len(content) // 2] ^= 0x20
            (damaged / file).write_bytes(content)
        assert projects.quick(damaged, "fsck").returncode == 1, file
        repaired = projects.quick(damaged, "fsck", "--repair")
        assert repaired.returncode in (0, 1), (file, repaired.stderr)
        counting = {row["execution"] for row in projects.sql(damaged, "SELECT execution FROM effective")}
        assert counting <= good, file
        [bad] = projects.sql(damaged, "SELECT count(*) AS n FROM executions WHERE status = 'ok' AND purpose = 'run'")
        assert bad["n"] <= len(good), file
        shutil.rmtree(damaged)
