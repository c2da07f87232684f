"""`sierra why` explains executions from the record, and predicts from the current project what a repeated query executes."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import sierra
from sierra.design import seeds
from tests import projects, stores

Install = Callable[[int], None]


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return projects.make(tmp_path / "project")


def ask(root: Path, *query: str, **more: Any) -> str:
    return stores.ask(root, *(query or ("population_size=1,2",)), **more)


def why(root: Path, prefix: str) -> dict[str, Any]:
    ended = projects.quick(root, "why", prefix, "--json")
    assert (ended.returncode, ended.stderr) == (0, "")
    said: dict[str, Any] = json.loads(ended.stdout)
    return said


def causes(said: dict[str, Any]) -> list[str]:
    return [cause["reason"] for event in said["history"] for cause in event["causes"]]


def a_run(root: Path) -> str:
    run: str = sierra.open(root).sql("SELECT run FROM batch_runs ORDER BY ordinal, number LIMIT 1").column(0)[0].as_py()
    return run


@pytest.fixture
def outside(tmp_path: Path) -> tuple[Path, Install]:
    """A project whose simulator is outside of it, and a function that installs the simulator."""
    program = tmp_path / "sim"
    root = projects.make(tmp_path / "project", projects.CONFIG.replace("python3 sim.py", str(program)))

    def install(value: int) -> None:
        program.write_text(f"#!/bin/sh\nprintf 'tick,v\\n0,{value}\\n' > out.csv\n")
        program.chmod(0o755)

    install(1)
    return root, install


@pytest.mark.integration
def test_first_batch_is_new_and_its_executions_are_effective(root: Path) -> None:
    batch = ask(root)
    said = why(root, batch)
    [event] = said["history"]
    assert (event["kind"], event["executed"], event["reused"], event["ended"]) == ("session", 4, 0, True)
    assert causes(said) == ["new"]
    assert said["new_because"] == {batch: ["no batch with these variables was recorded before"]}
    assert [(one["runs"], one["is_effective"]) for one in said["effective"]] == [(4, True)]
    assert said["next_run"] == ["4 runs: reused"]


@pytest.mark.integration
def test_changed_file_is_the_reason_for_new_runs(root: Path) -> None:
    before = ask(root)
    (root / "sim.py").write_text(projects.SIMULATOR + "# more\n")
    after = ask(root)
    for thing in (
        after,
        sierra.open(root).sql("SELECT run FROM batch_runs WHERE batch = $b LIMIT 1", b=after).column(0)[0].as_py(),
    ):
        [told] = why(root, thing)["new_because"].values()
        assert told[0] == f"compared with batch {before[:10]} (population_size=1,2):"
        assert "sim.py (+1 −0)" in told[1]
    again = why(root, before)["next_run"]
    assert again[:2] == [f"different runs (batch {after[:10]}), because:", "source: 1 file differs: sim.py"]
    assert again[2].startswith(f"(sierra run {before[:10]} ")


@pytest.mark.nightly
def test_grown_batch_shows_which_sessions_executed_its_runs(root: Path) -> None:
    small = ask(root)
    large = ask(root, runs=3)
    said = why(root, large)
    assert [(event["batch"], event["executed"], event["reused"]) for event in said["history"]] == [(small, 4, 0), (large, 2, 4)]
    assert "runs per experiment: 2 → 3" in said["new_because"][large]
    assert [(one["runs"], one["is_effective"]) for one in said["effective"]] == [(6, True)]


@pytest.mark.integration
def test_earlier_failure_is_the_reason_for_another_execution(root: Path, tmp_path: Path) -> None:
    flag = tmp_path / "fail"
    flag.touch()
    (root / "sim.py").write_text(
        f"import pathlib, sys\nif pathlib.Path({str(flag)!r}).exists(): sys.exit(3)\n{projects.SIMULATOR}"
    )
    batch = ask(root)
    said = why(root, batch)
    assert [(one["runs"], one["reason"]) for one in said["effective"]] == [
        (4, "no execution succeeded; the last one: exit status 3")
    ]
    assert said["next_run"] == ["4 runs: failed: exit status 3"]
    flag.unlink()
    ask(root)
    said = why(root, a_run(root))
    assert causes(said) == ["new", "the last execution failed: exit status 3"]
    assert [(event["executed"], event["failed"]) for event in said["history"]] == [(1, 1), (1, 0)]


@pytest.mark.integration
def test_changed_program_is_the_reason_for_another_execution(outside: tuple[Path, Install]) -> None:
    root, install = outside
    small = ask(root, "population_size=1", runs=1)
    install(2)
    again = why(root, small)["next_run"]
    assert again[0] == "1 run: executed with other programs or files"
    assert again[1].startswith("sim: ")
    ask(root, "population_size=1", runs=1)
    said = why(root, a_run(root))
    assert causes(said)[0] == "new"
    assert causes(said)[1].startswith("executed with other programs or files before: sim: ")
    execution = said["history"][1]["causes"][0]["execution"]
    assert [one["execution"] for one in said["effective"]] == [execution]
    assert causes(why(root, execution)) == causes(said)[1:]


@pytest.mark.integration
def test_successful_execution_with_older_programs_is_stale(outside: tuple[Path, Install]) -> None:
    root, install = outside
    batch = ask(root, "population_size=1", runs=1)
    install(2)
    (root.parent / "sim").write_text("#!/bin/sh\nexit 1\n")
    ask(root, "population_size=1", runs=1)
    [standing] = why(root, batch)["effective"]
    assert not standing["is_effective"]
    assert standing["reason"].startswith("stale: the last successful execution differs from the batch's last session: sim: ")


@pytest.mark.nightly
def test_changed_ingest_rules_are_reported_as_a_reevaluation(root: Path) -> None:
    batch = ask(root, "population_size=1")
    (root / "sierra.toml").write_text(projects.CONFIG + '[success]\nmarker = "swarm.csv"\ncontains = "coverage"\n')
    assert ask(root, "population_size=1") == batch
    said = why(root, batch)
    assert causes(said) == ["new"]
    assert [event["reevaluated"] for event in said["history"]] == [0, 2]
    assert said["history"][1]["other_rules"].startswith("[outputs] and [success]: ")


@pytest.mark.integration
def test_changed_ingest_rules_are_the_reason_for_another_execution_without_raw_files(root: Path) -> None:
    (root / "sierra.toml").write_text(projects.CONFIG + "[store]\nraw = false\n")
    batch = ask(root, "population_size=1")
    (root / "sierra.toml").write_text(projects.CONFIG + '[success]\nmarker = "swarm.csv"\ncontains = "coverage"\n')
    assert ask(root, "population_size=1") == batch
    assert causes(why(root, batch))[1].startswith("evaluated by other rules before: [outputs] and [success]: ")


@pytest.mark.nightly
def test_later_finding_is_the_reason_for_another_execution(root: Path) -> None:
    few = [seeds.seed(0, number, "") for number in range(2)]
    text = f"'1e5' if seed in {few} else '3ab'"
    (root / "sim.py").write_text(projects.SIMULATOR.replace("count * tick + noise * (seed % 100)", text))
    ask(root, "population_size=1", runs=2)
    ask(root, "population_size=1", runs=8)
    ask(root, "population_size=1", runs=8)
    assert any("a problem was found in the last execution" in cause for cause in causes(why(root, a_run(root))))


@pytest.mark.integration
def test_replay_is_in_the_history_but_is_not_the_effective_execution(root: Path) -> None:
    batch = ask(root)
    sierra.open(root).replay(batch)
    said = why(root, batch)
    assert [event["kind"] for event in said["history"]] == ["session", "replay"]
    assert causes(said)[1] == f"a replay of batch {batch[:10]}: identical"
    counts = said["effective"][0]["execution"]
    rows = sierra.open(root).sql("SELECT purpose FROM executions WHERE execution = $e", e=counts).to_pylist()
    assert rows == [{"purpose": "run"}]


@pytest.mark.integration
def test_experiment_is_explained_by_its_own_runs_only(root: Path) -> None:
    ask(root)
    [experiment, *_] = sierra.open(root).sql("SELECT experiment FROM experiments").column(0).to_pylist()
    said = why(root, experiment)
    assert (said["runs"], said["history"][0]["executed"], said["next_run"]) == (2, 2, ["2 runs: reused"])


def test_query_that_cannot_be_repeated_is_reported_with_the_reason(root: Path) -> None:
    batch = ask(root)
    (root / "arena.xml").unlink()
    [line] = why(root, batch)["next_run"]
    assert line.startswith("the query cannot be repeated as it is: ")
    assert "arena.xml" in line


@pytest.mark.nightly
def test_prediction_repeats_the_set_options_of_the_batch(root: Path) -> None:
    batch = ask(root, sets=[("//random[@seed]/following-sibling::noise", "0.5")])
    assert why(root, batch)["next_run"] == ["4 runs: reused"]


@pytest.mark.integration
def test_why_prints_plain_text_and_refuses_unknown_ids(root: Path) -> None:
    batch = ask(root)
    said = projects.quick(root, "why", batch).stdout
    assert "submitted (batch" in said
    assert "4 runs executed, 0 reused" in said
    assert "if the query is repeated now:\n  4 runs: reused" in said
    ended = projects.quick(root, "why", "ffff")
    assert (ended.returncode, ended.stdout, ended.stderr.count("\n")) == (2, "", 1)
