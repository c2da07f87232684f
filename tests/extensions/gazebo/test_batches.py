"""Batches of Gazebo with a stand-in for gzserver, which has its messages and its bad habits: see `gzserver`."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests import projects
from tests.extensions.gazebo.stand_in import STAND_IN
from tests.projects import values
from tests.waiting import until

pytestmark = pytest.mark.integration

CROWD = (
    '<population name="crowd"><model_count>8</model_count><box><size>4 4 1</size></box>'
    '<model name="ant"><link name="body"/></model></population>'
)


@pytest.fixture
def demo(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the example of Gazebo; `gzserver` is the stand-in."""
    monkeypatch.setenv("PATH", str(STAND_IN.parent), prepend=":")
    assert projects.quick(tmp_path, "init", "--example", "gazebo", "demo").returncode == 0
    configure(tmp_path / "demo", "length = 30.0", "length = 3.0")
    return tmp_path / "demo"


def configure(root: Path, before: str, after: str, file: str = "sierra.toml") -> None:
    text = (root / file).read_text()
    assert before in text
    (root / file).write_text(text.replace(before, after))


def test_the_example_goes_from_a_query_to_figures_and_its_replay_is_identical(demo: Path) -> None:
    done = projects.quick(demo, "run", "population_size=1,8", "--runs", "2", "--jobs", "3")
    assert done.returncode == 0, done.stderr
    assert len(list((demo / "figures").glob("*/*.png"))) == 1
    assert values(demo, "SELECT count(*) AS n FROM poses GROUP BY run") == {4, 32}
    assert len(values(demo, "SELECT sum(x) AS s FROM poses WHERE time = 3 GROUP BY run")) == 4
    batch = str(projects.sql(demo, "SELECT batch FROM batches")[0]["batch"])
    replayed = projects.quick(demo, "replay", batch[:10])
    assert (replayed.returncode, "identical (4 runs: 4 identical)" in replayed.stdout) == (0, True), replayed.stderr


@pytest.mark.parametrize("faults", ["", "deaf,aborts"])
def test_a_population_is_complete_before_the_first_step(demo: Path, faults: str) -> None:
    text = (demo / "arena.world").read_text()
    (demo / "arena.world").write_text(text.partition('    <model name="robot">')[0] + CROWD + "</world></sdf>")
    configure(demo, 'robot = "robot"\n', "")
    settings = (demo / "sierra.toml").read_text()
    kept = [line for line in settings.splitlines() if not line.startswith(("start_area", "variables"))]
    variables = f'environment.set = {{ STAND_IN = "{faults}", GAZEBO_DRIVER_PATIENCE = "{6 if faults else 300}" }}\n'
    (demo / "sierra.toml").write_text(variables + "\n".join(kept))
    summary, _ = projects.run(demo, "population_size=1,8", "--runs", "2", "--no-figures")
    assert (summary["executed"], summary["failed"]) == (4, 0)
    counts = "SELECT population_size AS p, count(DISTINCT model) AS n FROM poses WHERE time = 0 GROUP BY ALL ORDER BY p"
    assert [(row["p"], row["n"]) for row in projects.sql(demo, counts)] == [(1, 1), (8, 8)]


def test_a_run_over_its_time_limit_leaves_no_gzserver(demo: Path) -> None:
    limits = '[limits]\nwall = 3\ngrace = 0.5\n[environment.set]\nSTAND_IN = "hangs,deaf"\n'
    with (demo / "sierra.toml").open("a") as file:
        file.write(limits)
    done = projects.quick(demo, "run", "population_size=1", "--runs", "1", "--no-figures")
    assert (done.returncode, values(demo, "SELECT status FROM executions")) == (1, {"timeout"}), done.stderr

    def gzservers() -> list[bytes]:
        commands = [path.read_bytes() for path in Path("/proc").glob("[0-9]*/cmdline") if path.exists()]
        return [words for words in commands if str(demo).encode() in words and b"gzserver" in words]

    until(lambda: not gzservers(), "no gzserver is left")


@pytest.mark.nightly
def test_a_missing_gzserver_is_named(demo: Path) -> None:
    with (demo / "sierra.toml").open("a") as file:
        file.write('server = "gzserver-of-nobody"\n')
    done = projects.quick(demo, "run", "population_size=1", "--runs", "1", "--no-figures")
    assert (done.returncode, "gzserver-of-nobody is not installed, or not in PATH" in done.stdout + done.stderr) == (1, True)
