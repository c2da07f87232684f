"""Real accounting: the limits of a slurmdbd are obeyed."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator

import pytest

from tests import clusters, slurmdbd
from tests.conftest import Simulated
from tests.slurmdbd import Accounted
from tests.waiting import until

pytestmark = pytest.mark.real

ASKED = ("run", "size=1", "--runs", "30", "--on", "slurm", "--no-figures")


@pytest.fixture(scope="module")
def cluster() -> Iterator[Accounted]:
    with clusters.folder() as folder, Accounted(folder) as started:
        yield started


@pytest.fixture
def project(
    require: Callable[..., str],
    request: pytest.FixtureRequest,
    simulate: Callable[..., Simulated],
    monkeypatch: pytest.MonkeyPatch,
) -> Callable[[str], Simulated]:
    """Return a function that makes a project for that cluster."""
    slurmdbd.needed(require)
    cluster: Accounted = request.getfixturevalue("cluster")
    for name, value in cluster.environment.items():
        monkeypatch.setenv(name, value)

    def make(table: str) -> Simulated:
        made = simulate()
        config = made.folder / "sierra.toml"
        config.write_text(config.read_text() + f"[runners.slurm]\n{table}\n")
        return made

    return make


def test_limits_of_the_default_qos_are_obeyed(project: Callable[[str], Simulated]) -> None:
    asked = project("array_tasks = 30")
    told = asked.ask(*ASKED, "-n", "--explain").stdout
    assert re.search(
        r"^array_tasks +4 +the number of jobs that the site allows \(MaxSubmitJobsPerUser of QOS small\)$", told, re.MULTILINE
    )
    assert re.search(r"^longest wall +1200 +the site's limit: MaxWall of QOS small$", told, re.MULTILINE)
    done = asked.ask(*ASKED)
    assert done.returncode == 0, done.stderr
    assert "tried again" not in done.stderr
    assert asked.sql("SELECT count(*) AS n FROM executions WHERE status = 'ok'") == [{"n": 30}]
    account, qos = ("allocation->>'SLURM_JOB_" + name for name in ("ACCOUNT'", "QOS'"))
    used = asked.sql(f"SELECT DISTINCT {account} AS account, {qos} AS qos FROM attempts")
    assert used == [{"account": "physics", "qos": "small"}]


@pytest.mark.nightly
def test_successful_tasks_are_completed_in_the_accounting(
    project: Callable[[str], Simulated], request: pytest.FixtureRequest
) -> None:
    cluster: Accounted = request.getfixturevalue("cluster")
    asked = project("array_tasks = 4")
    for runs in ("10", "20", "30"):
        done = asked.ask("run", "size=1", "--runs", runs, "--on", "slurm", "--no-figures")
        assert done.returncode == 0, done.stderr
    jobs = ",".join(row["job"] for row in asked.sql("SELECT DISTINCT split_part(job, '_', 1) AS job FROM attempts"))

    def told() -> list[str]:
        return cluster.command("sacct", "-X", "-n", "-P", "-j", jobs, "--format=State").splitlines()

    until(lambda: len(told()) == 12 and not {"PENDING", "RUNNING"} & set(told()), "accounting knows of all tasks")
    assert set(told()) == {"COMPLETED"}


@pytest.mark.nightly
def test_another_qos_has_other_limits(project: Callable[[str], Simulated]) -> None:
    told = project('array_tasks = 30\nqos = "normal"').ask(*ASKED, "-n", "--explain").stdout
    assert re.search(r"^array_tasks +30 +set in sierra.toml$", told, re.MULTILINE)
    assert re.search(r"^longest wall +3600 +the site's limit: MaxTime of partition debug$", told, re.MULTILINE)


@pytest.mark.nightly
def test_array_tasks_are_submitted_gradually_if_the_site_accepts_fewer(
    project: Callable[[str], Simulated], request: pytest.FixtureRequest
) -> None:
    cluster: Accounted = request.getfixturevalue("cluster")
    held = cluster.command("sbatch", "--parsable", "--hold", "--array=0-2", "--output=/dev/null", "--wrap=true")
    asked = project("array_tasks = 4")
    process = asked.start(*ASKED)
    asked.until_executed(1, process)
    cluster.command("scancel", held)
    done = asked.end_of(process, 100)
    assert done.returncode == 0, done.stderr
    assert asked.sql("SELECT count(*) AS n FROM executions WHERE status = 'ok'") == [{"n": 30}]


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("table", "words"),
    [
        ('account = "chemistry"', "account 'chemistry' is not yours on this cluster; you have "),
        ('qos = "high"', "QOS 'high' is not open to account 'physics'; it has "),
        ("wall = 1800", "more than the site allows, 1200 s (MaxWall of QOS small)"),
    ],
)
def test_a_foreign_account_or_qos_is_refused_in_one_line(project: Callable[[str], Simulated], table: str, words: str) -> None:
    asked = project(table)
    done = asked.ask(*ASKED)
    assert done.returncode == 2
    [line] = [line for line in done.stderr.splitlines() if line.startswith("sierra:")]
    assert words in line
    assert asked.executed().total() == 0
    assert asked.work() == []
