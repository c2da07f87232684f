"""`sierra run BATCH` executes missing and failed runs of a batch with the recorded code, inputs and ingest rules."""

from __future__ import annotations

import json
import venv
from pathlib import Path

import pytest

import sierra
from tests import projects

FAILING = (
    projects.SIMULATOR
    + """
import os
if count == 2 and not os.path.exists(sys.argv[2]):
    sys.exit(7)
"""
)


@pytest.fixture(params=["git", pytest.param("none", marks=pytest.mark.nightly)])
def half(request: pytest.FixtureRequest, tmp_path: Path) -> tuple[Path, str]:
    """A project with a batch of which two of four runs have failed; they succeed once `mended` exists."""
    config = 'observe = "none"\n' + projects.CONFIG.replace("{input}", f"{{input}} {tmp_path}/mended")  # which comes into being
    root = projects.make(tmp_path / "project", config, simulator=FAILING)
    if request.param == "git":
        projects.commit(root)
    batch: str = sierra.open(root).run("population_size=1,2", figures=False).batch
    (tmp_path / "mended").mkdir()  # a file would count as an input of the runs
    return root, batch


def state(root: Path, batch: str) -> tuple[int, int]:
    [row] = [row for row in sierra.open(root).batches if row.batch == batch]
    return row.failed, row.missing


@pytest.mark.integration
def test_failed_runs_of_a_batch_are_executed_with_the_recorded_code_and_inputs(half: tuple[Path, str]) -> None:
    root, batch = half
    assert state(root, batch) == (2, 0)
    for name in ("sim.py", "arena.xml"):
        (root / name).write_text("nothing that works")
    (root / "sierra.toml").write_text((root / "sierra.toml").read_text().replace("runs = 2", "runs = 9"))
    ended = projects.quick(root, "run", batch[:10], "--json", "--no-figures")
    said = json.loads(ended.stdout)
    assert (ended.returncode, said["batch"], said["executed"], said["reexecuted"], said["reused"]) == (0, batch, 2, 2, 2)
    assert state(root, batch) == (0, 0)
    rows = sierra.open(root).sql("SELECT population_size, avg(coverage) AS c FROM swarm WHERE tick = 4 GROUP BY 1 ORDER BY 1")
    assert rows.column("population_size").to_pylist() == [1, 2]
    assert (root / "sim.py").read_text() == "nothing that works"
    assert not list(root.glob(".sierra/work/*/source"))


@pytest.mark.nightly
def test_dry_run_counts_the_runs_to_execute_and_a_complete_batch_executes_none(half: tuple[Path, str]) -> None:
    root, batch = half
    told = json.loads(projects.quick(root, "run", batch[:8], "-n", "--json").stdout)
    assert (told["batch"], told["to_execute"]) == (batch, 2)
    assert sierra.open(root).run(batch, figures=False).executed == 2
    assert sierra.open(root).run(batch, figures=False).executed == 0


@pytest.mark.integration
def test_runs_of_a_recorded_batch_are_evaluated_by_the_recorded_rules(half: tuple[Path, str]) -> None:
    root, batch = half
    (root / "sierra.toml").write_text((root / "sierra.toml").read_text() + '[outputs.never]\nfile = "never.csv"\n')
    summary = sierra.open(root).run(batch, figures=False)
    assert (summary.executed, summary.failed) == (2, 0)


@pytest.mark.integration
def test_runs_unknown_ids_and_changed_options_are_refused_for_a_recorded_batch(half: tuple[Path, str]) -> None:
    root, batch = half
    [row] = sierra.open(root).sql("SELECT run FROM runs LIMIT 1").to_pylist()
    for words, said in (
        ((row["run"],), f"is a run; missing runs can only be executed for a whole batch: sierra run {batch[:10]}"),
        ((batch, "--runs", "3"), "is executed as it was recorded"),
        (("0123456789",), "no batch, experiment, run, execution or study begins with"),
    ):
        ended = projects.quick(root, "run", *words)
        assert (ended.returncode, said in ended.stderr, ended.stderr.count("\n")) == (2, True, 1)


@pytest.mark.nightly
def test_named_query_takes_precedence_over_a_batch_id(tmp_path: Path) -> None:
    config = projects.CONFIG + '[queries]\ncafe = { criteria = "population_size=1" }\n'
    root = projects.make(tmp_path / "project", config)
    project = sierra.open(root)
    project.run("population_size=1,2", figures=False)
    assert project.run("cafe", figures=False).runs == 2


@pytest.mark.nightly
def test_uncommitted_changes_are_neither_counted_nor_executed_if_ignored(tmp_path: Path) -> None:
    root = projects.commit(projects.make(tmp_path / "project", projects.CONFIG + '[source]\ndirty = "ignore"\n'))
    committed = sierra.open(root).run("population_size=1", figures=False).batch
    other = projects.SIMULATOR.replace("count * tick", "count * tick + 1000")
    (root / "sim.py").write_text(other)
    project = sierra.open(root)
    again = project.run("population_size=1", figures=False)
    assert (again.batch, again.executed) == (committed, 0)
    more = project.run("population_size=2", figures=False)
    assert (more.executed, more.failed) == (2, 0)
    [found] = project.sql("SELECT max(coverage) AS most FROM swarm").to_pylist()
    assert found["most"] < 1000
    assert project.replay(more.batch).verdict == "identical"
    assert (root / "sim.py").read_text() == other


@pytest.mark.integration
@pytest.mark.parametrize("link", ["path", "editable"])
def test_code_installed_from_the_project_is_refused_if_it_differs_from_the_record(tmp_path: Path, link: str) -> None:
    venv.create(tmp_path / "env", symlinks=True)
    [installed] = (tmp_path / "env").glob("lib/python3*/site-packages")
    simulator = "from swarm.model import f\n" + projects.SIMULATOR.replace("count * tick", "f(count * tick)")
    config = projects.CONFIG.replace("python3", str(tmp_path / "env" / "bin" / "python"))
    root = projects.make(tmp_path / "p", config, simulator=simulator)
    model = root / "src" / "swarm" / "model.py"
    model.parent.mkdir(parents=True)
    model.write_text("def f(x): return x\n")
    (installed / "swarm.pth").write_text(f"{root}/src\n")
    if link == "editable":
        info = installed / "swarm-1.dist-info"
        info.mkdir()
        (info / "direct_url.json").write_text(json.dumps({"url": root.as_uri(), "dir_info": {"editable": True}}))
    projects.commit(root)
    batch = sierra.open(root).run("population_size=1", figures=False).batch
    assert sierra.open(root).replay(batch).notes == ()
    assert "4 executed" not in projects.quick(root, "run", batch).stdout
    model.write_text("def f(x): return x + 1000\n")
    projects.commit(root, "second")
    for words in (("replay", batch), ("run", batch)):
        ended = projects.quick(root, *words)
        assert (ended.returncode, ended.stderr.count("\n")) == (3, 1)
        assert "where model.py differs from the recorded file" in ended.stderr
    (root / "sierra.toml").write_text(config + '[source]\ndirty = "ignore"\n')
    model.write_text("def f(x): return x + 2000\n")
    assert projects.quick(root, "run", "population_size=1").returncode == 3
