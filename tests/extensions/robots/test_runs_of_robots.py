"""A query in a simulator and on pretended robots, side by side: comparison, replay, packages, changed rules, removal."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
from scipy import stats

import sierra
from sierra.extensions.trials import mark_trial
from tests import projects, robots
from tests.support.robot_fleet import Fleet

pytestmark = pytest.mark.integration
PACKAGE = """
[package]
title = "Robots"
license = "MIT"
authors = [{ name = "Ada Lovelace" }]
"""


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Path, str, str]]:
    """Yield a project with a batch for each target, and the ids of the batches."""
    with pytest.MonkeyPatch.context() as monkeypatch:
        robots.register(monkeypatch)
        root = robots.project(tmp_path_factory.mktemp("robots") / "p", PACKAGE)
        done = projects.quick(root, "run", "population_size=1,3", "--runs", "6", "--target", "sim,robots", "--json")
        assert done.returncode == 0, done.stderr
        sim, fleet = (str(one.batch) for one in sierra.open(root).batches)
        yield root, sim, fleet


@pytest.fixture
def copied(made: tuple[Path, str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[Path, str]:
    """Return a copy of the project, and the batch on robots."""
    robots.register(monkeypatch)
    return shutil.copytree(made[0], tmp_path / "p", symlinks=True), made[2]


def test_the_gap_between_simulator_and_robots_is_that_of_their_means(made: tuple[Path, str, str]) -> None:
    root, sim, fleet = made
    ended = projects.quick(root, "compare", f"sim={sim}", f"robots={fleet}", "--column", "coverage", "--no-figure", "--json")
    assert ended.returncode == 0, ended.stderr
    assert "the value of a run is the mean of its robots at each time" in ended.stderr
    pairs = json.loads(ended.stdout)["pairs"]
    # the simulator writes tick * (n + 1) / 2 + seed % 10, and robot p writes tick * p + seed % 10: their means are the same
    assert [(pair["difference"], pair["n_first"], pair["n_second"]) for pair in pairs] == [(0, 6, 6), (0, 6, 6)]
    assert [(pair["low"], pair["high"]) for pair in pairs] == [(0, 0), (0, 0)]


@pytest.fixture(scope="module")
def noisy(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Path, str, str]]:
    """Yield a project whose robots never measure the same twice, and its batches in the simulator and on robots."""
    with pytest.MonkeyPatch.context() as monkeypatch:
        robots.register(monkeypatch)
        root = robots.project(tmp_path_factory.mktemp("noisy") / "p")
        noise = "random.SystemRandom().gauss(0.3, 0.01)"
        (root / "robot.py").write_text("import random\n" + robots.ROBOT.replace("+ x +", f"+ {noise} +"))
        done = projects.quick(root, "run", "population_size=2", "--runs", "6", "--target", "sim,robots", "--no-figures")
        assert done.returncode == 0, done.stderr
        sim, fleet = (str(one.batch) for one in sierra.open(root).batches)
        yield root, sim, fleet


@pytest.mark.parametrize("paired", ["yes", "no"])
@pytest.mark.each_case
def test_the_interval_of_the_gap_has_the_differences_that_the_test_does_not_reject(
    noisy: tuple[Path, str, str], paired: str
) -> None:
    root, sim, fleet = noisy
    words = ("--column", "coverage", "--paired", paired, "--no-figure", "--json")
    ended = projects.quick(root, "compare", f"sim={sim}", f"robots={fleet}", *words)
    assert ended.returncode == 0, ended.stderr
    [pair] = json.loads(ended.stdout)["pairs"]
    last = "SELECT avg(coverage) AS value FROM swarm JOIN batch_runs USING (run) WHERE tick = 3 AND batch = '{}' GROUP BY seed"
    simulated, measured = (
        [row["value"] for row in projects.sql(root, f"{last.format(one)} ORDER BY seed")] for one in (sim, fleet)
    )

    def p_of(difference: float) -> float:
        shifted = [value - difference for value in measured]
        test = stats.wilcoxon if paired == "yes" else stats.mannwhitneyu
        return float(test(shifted, simulated, method="exact").pvalue)

    assert pair["low"] < pair["difference"] < pair["high"]
    for end, outwards in ((pair["low"], -1e-9), (pair["high"], 1e-9)):
        assert p_of(end + outwards) <= 0.05 < p_of(end - outwards)


def test_a_replay_on_robots_judges_a_metric_over_all_runs(
    noisy: tuple[Path, str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    root, _, fleet = noisy
    config = (root / "sierra.toml").read_text()
    metric = '\n[equivalence.coverage]\ntable = "swarm"\ncolumn = "coverage"\nmargin = '
    for margin, code, verdict in (("0.5", 0, "equivalent"), ("1e-6", 1, "different")):
        (root / "sierra.toml").write_text(config + metric + margin + "\n")
        ended = projects.quick(root, "replay", fleet, "--on", "pretend", "--json")
        said = json.loads(ended.stdout)
        assert (ended.returncode, said["verdict"], said["counts"]) == (code, verdict, {"different": 6})
        [[judged]] = [one["metrics"] for one in said["experiments"]]
        assert (judged["n"], judged["equivalent"]) == (6, verdict == "equivalent")


def test_a_report_has_each_robot_with_its_clock(made: tuple[Path, str, str]) -> None:
    root, _, fleet = made
    assert projects.quick(root, "report", fleet, "--to", "../report.html").returncode == 0
    page = " ".join(re.sub("<[^>]*>", " ", (root.parent / "report.html").read_text()).split())
    headers = "robot group runs clock moved by at most [ms] lowest battery [%]"
    assert f"Robots of the executions that count {headers} tb3-01 robot 12 0.01 88.5 tb3-02 robot 6 0.02 88.5" in page


def test_a_replay_says_what_cannot_be_replayed(made: tuple[Path, str, str]) -> None:
    root, _, fleet = made
    refused = projects.quick(root, "replay", fleet, "--runs", "1")
    assert refused.returncode == 2
    assert "was executed on robots, and runner 'local' cannot execute it again; use --on robots" in refused.stderr
    again = projects.quick(root, "replay", fleet, "--runs", "1", "--on", "pretend")
    assert again.returncode == 0, again.stderr
    assert "the robots (tb3-01, tb3-02, tb3-03) and their operator" in again.stderr
    assert "[equivalence] in sierra.toml says which metrics" in again.stderr


def test_a_replay_needs_a_fleet_that_fits_the_recorded_runs(copied: tuple[Path, str]) -> None:
    root, fleet = copied
    config = (root / "sierra.toml").read_text()
    for group, said in (
        ("lead", "tb2: no place is of the group 'lead'"),
        ("base", "a run needs 3 robots of the group 'robot', but the fleet has 1; runs of 1 robot are possible"),
    ):
        own = f'fleet = {{ tb1 = {{ host = "tb1.invalid" }}, tb2 = {{ host = "tb2.invalid", group = "{group}" }} }}\n'
        (root / "sierra.toml").write_text(f"{config}[runners.robots]\nstop = []\n{own}")
        refused = projects.quick(root, "replay", fleet, "--on", "robots")
        assert (refused.returncode, said in refused.stderr) == (2, True), refused.stderr


@pytest.mark.nightly
def test_packages_keep_robots_and_anonymous_ones_hide_them(copied: tuple[Path, str], tmp_path: Path) -> None:
    root, fleet = copied
    project = sierra.open(root)
    run = projects.sql(root, f"SELECT run FROM effective WHERE batch = '{fleet}' ORDER BY ordinal LIMIT 1")[0]["run"]
    mark_trial(project, run, note="fine", operator="Grace Hopper")
    for name, more in (("plain", {}), ("anonymous", {"anonymous": True})):
        project.packages.pack(fleet, report=False, path=tmp_path / f"{name}.zip", **more)
        other = robots.project(tmp_path / name)
        sierra.open(other).packages.import_records(tmp_path / f"{name}.zip")
        assert projects.quick(other, "fsck").returncode == 0
        assert projects.sql(other, "SELECT count(DISTINCT run) AS runs FROM swarm") == [{"runs": 12}]
        [trial] = projects.sql(other, "SELECT operator, note FROM trials")
        names = {row["robot"] for row in projects.sql(other, "SELECT DISTINCT robot FROM robots")}
        clocks = projects.sql(other, "SELECT count(*) AS n FROM robot_clocks")[0]["n"]
        if name == "plain":
            assert (trial["operator"], names, clocks) == ("Grace Hopper", {"tb3-01", "tb3-02", "tb3-03"}, 24)
        else:
            assert (trial["operator"], names, clocks) == ("redacted", {"robot-1", "robot-2", "robot-3"}, 0)
        assert trial["note"] == "fine"


@pytest.mark.nightly
def test_changed_rules_are_applied_to_recorded_files_of_each_robot(copied: tuple[Path, str]) -> None:
    root, _ = copied
    config = (root / "sierra.toml").read_text()
    for rows, counts in ((3, (0, 0)), (5, (0, 12))):
        (root / "sierra.toml").write_text(config.replace('time = "tick"', f'time = "tick"\nmin_rows = {rows}'))
        summary = sierra.open(root).run("population_size=1,3", runs=6, target="robots", figures=False)
        assert (summary.executed, summary.failed) == counts, rows
    assert projects.sql(root, "SELECT DISTINCT reason FROM executions WHERE status = 'failed'") == [
        {"reason": "1/swarm.csv: 4 rows; [outputs.swarm] min_rows asks for 5"}
    ]


@pytest.mark.nightly
def test_removing_a_batch_removes_its_robots_and_marks(copied: tuple[Path, str]) -> None:
    root, fleet = copied
    run = projects.sql(root, f"SELECT run FROM effective WHERE batch = '{fleet}' LIMIT 1")[0]["run"]
    mark_trial(sierra.open(root), run, valid=False, reason="fell over")
    assert projects.quick(root, "rm", fleet, "--yes").returncode == 0
    assert projects.sql(root, "SELECT (SELECT count(*) FROM robots) AS robots, (SELECT count(*) FROM trials) AS trials") == [
        {"robots": 0, "trials": 0}
    ]
    assert projects.quick(root, "fsck").returncode == 0


@pytest.mark.nightly
def test_files_with_a_column_robot_get_the_place_under_another_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    robots.register(monkeypatch)
    root = robots.project(tmp_path / "p")
    text = robots.ROBOT.replace("tick,coverage", "robot,tick,coverage").replace("print(tick, ", 'print(f"tb{place}", tick, ')
    (root / "robot.py").write_text(text)
    project = sierra.open(root)
    assert project.run("population_size=2", runs=1, target="robots", figures=False).failed == 1
    [row] = projects.sql(root, "SELECT reason FROM executions")
    assert row["reason"].endswith('the robot that wrote it; declare it with file = "{place}/swarm.csv"')
    config = (root / "sierra.toml").read_text()
    (root / "sierra.toml").write_text(config.replace('file = "swarm.csv"', 'file = "{place}/swarm.csv"'))
    summary = sierra.open(root).run("population_size=2", runs=1, target="robots", figures=False)
    assert (summary.executed, summary.failed) == (0, 0), "the recorded files are read by the new rules"
    assert projects.sql(root, "SELECT DISTINCT place, robot FROM swarm ORDER BY place") == [
        {"place": 1, "robot": "tb1"},
        {"place": 2, "robot": "tb2"},
    ]
    [mean] = json.loads(projects.quick(root, "stats", "swarm", "coverage", "--target", "robots", "--json").stdout)
    assert mean["n"] == 1


def test_a_query_in_a_simulator_and_on_robots_with_sshd(fleet: Fleet, tmp_path: Path) -> None:
    robot_tables = "".join(f'{name} = {{ host = "{name}" }}\n' for name in fleet.names)
    options = f'stop = []\ndisk_min = 1000000\nlink_options = {{ ssh_config = "{fleet.ssh_config}" }}\n'
    options += 'setup = "export CMAKE_PREFIX_PATH=/home/robot/ws"\n'
    more = f"[runners.robots]\n{options}[runners.robots.fleet]\n{robot_tables}"
    root = robots.project(tmp_path / "p", more, robots.CONFIG.replace('"pretend"', '"robots"'))
    done = projects.quick(root, "run", "population_size=3", "--runs", "2", "--target", "sim,robots", "--no-figures")
    assert done.returncode == 0, done.stderr
    assert projects.sql(
        root, "SELECT robot, count(*) AS rows FROM swarm WHERE robot IS NOT NULL GROUP BY ALL ORDER BY ALL"
    ) == [{"robot": robot, "rows": 8} for robot in (1, 2, 3)]
    found = projects.sql(root, "SELECT robot, host, status FROM robots JOIN robot_clocks USING (execution, place) ORDER BY ALL")
    assert found == [{"robot": name, "host": name, "status": "ok"} for name in fleet.names for _ in range(2)]
    used = projects.sql(root, "SELECT path FROM files_read WHERE use = 'executed' AND path LIKE '{robot %'")
    names = {f"{{robot {name}}}" for name in fleet.names}
    assert {row["path"].partition("/")[0] for row in used} <= names, "a program that ends at once may not be seen"
    assert used
    package_counts = "SELECT min(length(packages)) AS least FROM robots JOIN environments USING (environment)"
    assert projects.sql(root, package_counts)[0]["least"] > 1000

    workspace = fleet.robots["rb2"].home / "ws"
    workspace.mkdir()
    (workspace / "controller.py").write_text("turn('left')")
    later = projects.quick(root, "run", "population_size=3", "--runs", "3", "--target", "robots", "--no-figures")
    assert "rb2 was not the same in all runs of this batch: workspaces./home/robot/ws changed" in later.stderr
    assert "rb1" not in later.stderr

    refused = projects.quick(root, "run", "population_size=4", "--target", "robots", "--no-figures")
    assert (refused.returncode, refused.stdout) == (2, "")
    assert "but the fleet has 3; runs of 1 to 3 robots are possible" in refused.stderr
    [batch] = projects.sql(root, "SELECT batch FROM sessions WHERE target = 'robots' LIMIT 1")
    again = projects.quick(root, "replay", batch["batch"], "--runs", "1", "--on", "robots")
    assert again.returncode == 0, again.stderr
    assert projects.quick(root, "fsck").returncode == 0
