"""What a user sees of a batch that is, or was, on a cluster: by every command that speaks of it."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.clusters import Slurm
from tests.conftest import Simulated
from tests.test_cluster_cli import QUERY, WAITS, Waiting


@pytest.fixture
def waiting(simulate: Callable[..., Simulated], tmp_path: Path, slurm: Slurm) -> Waiting:
    gate = tmp_path / "gate"
    project = simulate(WAITS.format(gate=gate))
    config = project.folder / "sierra.toml"
    config.write_text(config.read_text() + "[runners.slurm]\nelements = 3\ncpus = 2\n")
    return Waiting(project, gate, slurm)


# once it is recorded


@pytest.mark.parametrize("detached", [False, True])
def test_how_many_runs_went_at_a_time_is_what_was_asked_for_there(waiting: Waiting, detached: bool) -> None:
    waiting.open()
    words = ("run", *QUERY, "--on", "slurm", "--no-figures", "-j", "7")
    assert waiting.project.ask(*words, *["--detach"] * detached).returncode == 0
    if detached:
        assert waiting.project.ask("attach", waiting.batch(), "--no-figures").returncode == 0
    assert waiting.project.sql("SELECT runner, slots, executed FROM sessions") == [
        {"runner": "slurm", "slots": 6, "executed": 6}
    ]


def test_show_says_where_runs_were_executed_and_how_often_that_was_cut_off(waiting: Waiting) -> None:
    asking = waiting.follow()
    waiting.project.until_executed(6, asking)
    time.sleep(1)  # what began just before its element was asked to end is not told of
    [job] = {name.partition("_")[0] for name, state in waiting.slurm.states().items() if state == "RUNNING"}
    waiting.slurm.command("scontrol", "requeue", f"{job}_0")
    waiting.slurm.until_requeued()
    waiting.slurm.release_requeued()
    waiting.project.until_executed(8, asking)
    waiting.open()
    assert waiting.project.end_of(asking).returncode == 0
    shown = json.loads(waiting.project.ask("show", waiting.batch(), "--json").stdout)["attempts"]
    assert [(one["element"], one["state"]) for one in shown] == [(0, "cut off"), *((n, "finished") for n in range(3))]
    [execution] = waiting.project.sql(
        "SELECT run, execution FROM executions JOIN attempts a USING (attempt) WHERE a.element = 0 ORDER BY run LIMIT 1"
    )
    for one in execution.values():
        first, second = json.loads(waiting.project.ask("show", one[:12], "--json").stdout)["attempts"]
        assert (first["state"], first["cut"], first["executed"]) == ("cut off", 2, False)
        assert (second["state"], second["trouble"], second["executed"]) == ("finished", None, True)
        assert second["node"] in waiting.slurm.names
        assert second["job"] == first["job"] == f"{job}_0"
        text = waiting.project.ask("show", one[:12]).stdout
        assert "attempts:" in text
        assert "cut off" in text
