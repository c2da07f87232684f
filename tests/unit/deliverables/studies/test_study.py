"""`sierra run --until` looks at a growing batch by a schedule, records each decision, and continues where it was killed."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest

import sierra
from sierra.errors import NotFound, SierraError
from sierra.execution.observer import Observer
from sierra.stats import looks
from sierra.stats.student_t import quantile
from tests import projects, stores

pytestmark = pytest.mark.integration

QUERY = ("population_size=1,2",)
RULE = ("--until", "ci(coverage) < 2.5", "--max-runs", "9", "--runs", "4")


@pytest.fixture(scope="module")
def studied(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    """Return a project with a study that was reached at its third look, and its JSON; tests only read its store."""
    root = projects.make(tmp_path_factory.mktemp("studied") / "project")
    return root, until(root, *RULE)


def until(root: Path, *words: str, status: int = 0) -> dict[str, Any]:
    """Execute a study without figures; return its JSON."""
    done = projects.quick(root, "run", *QUERY, *words, "--no-figures", "--json")
    assert done.returncode == status, done.stderr
    found: dict[str, Any] = json.loads(done.stdout)
    return found


def refusal(root: Path, *words: str) -> str:
    done = projects.quick(root, "run", *QUERY, *words, "--no-figures")
    assert done.returncode == 2, done.stdout
    return done.stderr.splitlines()[-1]


def values(root: Path, batch: str) -> dict[int, list[float]]:
    """Return the final values of the runs of a batch, by experiment, from SQL."""
    rows = projects.sql(
        root,
        "SELECT m.ordinal, arg_max(s.coverage, s.tick) AS value FROM swarm s JOIN batch_runs m USING (run) "
        f"WHERE m.batch = '{batch}' GROUP BY m.ordinal, m.run",
    )
    return {ordinal: [row["value"] for row in rows if row["ordinal"] == ordinal] for ordinal in (0, 1)}


def test_each_look_has_more_runs_and_an_interval_that_is_corrected_for_all_looks(studied: tuple[Path, dict[str, Any]]) -> None:
    root, found = studied
    study = found["study"]
    assert study["schedule"] == [4, 6, 9]
    assert [(look["runs"], look["decision"]) for look in study["looks"]] == [(4, "continue"), (6, "continue"), (9, "reached")]
    assert study["level"] == pytest.approx(1 - 0.05 / 3)
    for look in study["looks"]:
        seen = values(root, look["batch"])
        for one in look["intervals"]:
            runs = seen[one["ordinal"]]
            assert (one["n"], one["method"], one["wanted"]) == (look["runs"], "t", 2.5)
            mean = sum(runs) / len(runs)
            sd = (sum((value - mean) ** 2 for value in runs) / (len(runs) - 1)) ** 0.5
            half = quantile(1 - 0.05 / 3 / 2, len(runs) - 1) * sd / len(runs) ** 0.5
            assert (one["value"], one["half_width"]) == (pytest.approx(mean), pytest.approx(half))
            assert one["holds"] == (half < 2.5)
    counts = projects.sql(root, "SELECT count(*) AS executed, count(DISTINCT run) AS runs FROM executions")
    assert counts == [{"executed": 18, "runs": 18}]


def test_the_same_words_continue_a_study_and_execute_nothing_twice(
    studied: tuple[Path, dict[str, Any]], tmp_path: Path
) -> None:
    """A study that was killed has a prefix of its segments; one that has ended stays as it was decided."""
    root = stores.copy(studied[0], tmp_path / "project")
    before = studied[1]["study"]
    assert until(root, *RULE)["study"] == before
    last = before["looks"][2]
    for segment in (root / ".sierra" / "segments").glob(f"{last['batch'][:12]}-*"):
        if (segment / "looks.parquet").exists():
            shutil.rmtree(segment)
    assert projects.quick(root, "show", before["study"]).stdout.splitlines()[-1].startswith("not finished")
    again = until(root, *RULE)
    assert again["batch"]["executed"] == 0
    assert [look["look"] for look in again["study"]["looks"]] == [look["look"] for look in before["looks"]]


def test_a_rule_that_is_not_reached_ends_with_1_and_an_estimate(studied: tuple[Path, dict[str, Any]], tmp_path: Path) -> None:
    root = stores.copy(studied[0], tmp_path / "project")
    found = until(root, "--until", "ci(coverage) < 1", "--max-runs", "4", "--runs", "4", status=1)["study"]
    widest = max(one["half_width"] for one in found["looks"][0]["intervals"])
    assert (found["decision"], found["needed"]) == ("not reached", looks.estimate(4, widest, 1))
    done = projects.quick(root, "show", found["study"][:12])
    assert f"about {found['needed']} runs per experiment would be needed" in done.stdout
    done = projects.quick(root, "run", *QUERY, "--until", "ci(coverage) < 1", "--max-runs", "4", "--runs", "4", "--no-figures")
    assert (done.returncode, "0 executed" in done.stdout) == (1, True)
    assert f"study {studied[1]['study']['study'][:10]} looked at the same runs" in done.stderr


@pytest.mark.nightly
def test_the_record_tells_its_study_and_is_replayed_checked_and_removed(
    studied: tuple[Path, dict[str, Any]], tmp_path: Path
) -> None:
    root = stores.copy(studied[0], tmp_path / "project")
    study = studied[1]["study"]
    shown = projects.quick(root, "show", study["study"][:8], "--json")
    assert json.loads(shown.stdout)["looks"] == study["looks"]
    assert json.loads(shown.stdout)["problem"] is None
    listed = projects.quick(root, "ls").stdout.splitlines()
    assert [f"{study['study'][:10]} look {number}" in line for number, line in enumerate(listed[1:], 1)] == [True] * 3
    replayed = projects.quick(root, "replay", study["study"][:8], "--runs", "1", "--json")
    assert json.loads(replayed.stdout)["target"] == study["looks"][-1]["batch"]
    assert projects.quick(root, "fsck").returncode == 0
    run = projects.sql(root, "SELECT run FROM runs WHERE number = 8 LIMIT 1")[0]["run"]
    projects.quick(root, "rm", run, "--yes")
    assert "look 3 saw coverage is" in json.loads(projects.quick(root, "show", study["study"], "--json").stdout)["problem"]
    assert "with its decisions" in projects.quick(root, "rm", study["study"], "--yes").stdout
    counts = "SELECT (FROM (SELECT count(*) FROM {})) AS n"
    assert [projects.sql(root, counts.format(table)) for table in ("studies", "looks", "look_intervals", "runs")] == [
        [{"n": 0}]
    ] * 4
    assert projects.quick(root, "fsck").returncode == 0


@pytest.mark.nightly
def test_equal_values_have_no_interval_to_believe(tmp_path: Path) -> None:
    """The interval of order statistics is an exception: it takes the spread of the runs for nothing."""
    root = projects.make(tmp_path / "project", template=projects.TEMPLATE.replace("<noise>0.1", "<noise>0"))
    found = until(root, "--until", "ci(coverage) < 1", "--max-runs", "9", "--runs", "9", status=1)["study"]
    assert "equal values show no width" in found["looks"][0]["reason"]
    assert (
        until(root, "--until", "ci(median(coverage)) < 1", "--max-runs", "9", "--runs", "9")["study"]["decision"] == "reached"
    )


FAILING = projects.SIMULATOR + "sys.exit(1 if count == 2 and seed % {} == 0 else 0)\n"


def test_failed_runs_do_not_count_and_an_experiment_without_a_run_stops_the_study(tmp_path: Path) -> None:
    root = projects.make(tmp_path / "some", simulator=FAILING.format(2))
    done = projects.quick(root, "run", *QUERY, "--until", "ci(coverage) < 99", "--max-runs", "6", "--runs", "6", "--no-figures")
    assert done.returncode == 1
    (look,) = sierra.open(root).records.show(projects.sql(root, "SELECT study FROM studies")[0]["study"]).as_dict()["looks"]  # type: ignore[misc]
    n = [one["n"] for one in look["intervals"]]
    assert (n[0], 0 < n[1] < 6, f"{6 - n[1]} failed run" in done.stderr) == (6, True, True)
    root = projects.make(tmp_path / "all", simulator=FAILING.format(1))
    found = until(root, *RULE, status=1)["study"]
    assert [(one["decision"], one["reason"]) for one in found["looks"]] == [
        ("stopped", "no run of population_size=2 succeeded")
    ]


def test_a_project_that_changes_between_looks_ends_the_study(studied: tuple[Path, dict[str, Any]], tmp_path: Path) -> None:
    root = stores.copy(studied[0], tmp_path / "project")

    class Editor(Observer):
        def notice(self, text: str) -> None:
            if text.startswith("look 1"):
                (root / "sim.py").write_text(projects.SIMULATOR + "# edited\n")

    project = sierra.open(root)
    plan = project.plan(*QUERY, runs=5)
    with pytest.raises(SierraError, match="the project has changed since the first look"):
        project.studies.run(plan, until="ci(coverage) < 0.1", max_runs=9, observer=Editor(), figures=False)


@pytest.mark.nightly
def test_what_cannot_be_a_study_is_refused_in_one_line(studied: tuple[Path, dict[str, Any]], tmp_path: Path) -> None:
    root = stores.copy(studied[0], tmp_path / "project")
    rule = ("--max-runs", "9", "--until")
    assert "no numeric column 'covrage'; did you mean 'coverage'?" in refusal(root, *rule, "ci(covrage) < 1", "--runs", "4")
    assert "no table 'swarn'; did you mean 'swarm'?" in refusal(root, *rule, "ci(swarn.coverage) < 1", "--runs", "4")
    assert "statistic 'range' has no interval" in refusal(root, *rule, "ci(range(coverage)) < 1", "--runs", "4")
    assert "unknown statistic 'nothing'" in refusal(root, *rule, "ci(nothing(coverage)) < 1", "--runs", "4")
    assert "below the 10 runs of the first look" in refusal(root, *rule, "ci(coverage) < 1")
    assert "belong together" in refusal(root, "--until", "ci(coverage) < 1")
    assert "leave out --detach" in refusal(root, *rule, "ci(coverage) < 1", "--detach")
    assert "leave out --only" in refusal(root, *rule, "ci(coverage) < 1", "--only", "population_size=1")
    assert projects.sql(root, "SELECT count(*) AS n FROM studies") == [{"n": 1}]
    with pytest.raises(NotFound, match="no batch, experiment, run, execution or study"):
        sierra.open(root).records.show("ffffffffffff")


@pytest.mark.nightly
def test_a_dry_run_shows_the_schedule_and_executes_nothing(tmp_path: Path) -> None:
    root = projects.make(tmp_path / "project")
    done = projects.quick(root, "run", *QUERY, *RULE, "--dry-run")
    assert "schedule: 3 looks at most, with 4, 6, 9 runs per experiment" in done.stdout
    assert "8 of 8 runs would execute" in done.stdout
    found = json.loads(projects.quick(root, "run", *QUERY, *RULE, "--dry-run", "--json").stdout)
    assert (found["study"]["schedule"], found["look"]["to_execute"]) == ([4, 6, 9], 8)
    assert not (root / ".sierra").exists()
