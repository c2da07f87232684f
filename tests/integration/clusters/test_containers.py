"""Runs in containers on nodes of a real SLURM: same results as locally, from the same image, checked on the node."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

import sierra
from tests import containers, projects
from tests.clusters import Slurm
from tests.tiers import needs_extension

pytestmark = pytest.mark.real
CLUSTER = "\n[runners.slurm]\narray_tasks = 2\nattempts = 1\n"


@pytest.fixture
def project(tmp_path: Path, slurm: Slurm, require: Callable[..., str]) -> Path:
    require("busybox-static, as /bin/busybox", there=containers.BUSYBOX.exists())
    require("mksquashfs")
    require("apptainer")
    folder = containers.make(tmp_path / "project", containers.busybox(tmp_path), 'engine = "apptainer"')
    with (folder / "sierra.toml").open("a") as file:
        file.write(CLUSTER)
    return folder


RENDERS = """
if [ -n "$2" ]; then mkdir "$2"; for tick in 0 1 2; do printf 'P1 1 1 %s' $((tick % 2)) > "$2/$tick.pbm"; done; fi
"""
CAPTURED = """
SELECT frames, verdict, engine, attempt IS NOT NULL AS on_node, count(*) AS n
FROM captures JOIN executions e USING (execution) JOIN isolations i USING (isolation) GROUP BY ALL
"""


def test_a_batch_in_apptainer_on_nodes_replays_identically_here(project: Path) -> None:
    there = projects.quick(project, "run", "population_size=1,2", "--on", "slurm")
    assert there.returncode == 0, there.stderr
    store = sierra.open(project)
    nodes = "SELECT count(*) AS n FROM executions e JOIN attempts a USING (attempt) JOIN isolations i USING (isolation)"
    assert store.sql(f"{nodes} WHERE e.status = 'ok' AND i.engine = 'apptainer' AND e.host = a.node").to_pylist() == [{"n": 4}]
    [batch] = store.batches
    assert str(store.replay(batch.batch).verdict) == "identical"


@needs_extension("videos")
def test_frames_of_runs_are_captured_on_nodes_in_the_same_image(project: Path) -> None:
    from sierra.extensions.videos import capture

    with (project / "sim.sh").open("a") as simulator:
        simulator.write(RENDERS)
    projects.run(project, "population_size=1,2", "--on", "slurm")
    with (project / "sierra.toml").open("a") as file:
        file.write('[capture]\narguments = "{output}/frames"\nfiles = "frames/{tick}.pbm"\n')
    assert capture(sierra.open(project), runner="slurm").verdict == "identical"
    frames = {"frames": 3, "verdict": "identical", "engine": "apptainer", "on_node": True, "n": 2}
    assert sierra.open(project).sql(CAPTURED).to_pylist() == [frames]


@pytest.mark.nightly
def test_runs_of_a_slot_can_share_a_container_on_nodes(project: Path, tmp_path: Path) -> None:
    python = containers.python(tmp_path)
    config = project / "sierra.toml"
    config.write_text(
        config.read_text().replace("busybox.tar", python.name).replace("[container]", '[container]\nisolation = "worker"')
    )
    assert projects.quick(project, "image", "pin").returncode == 0
    done = projects.quick(project, "run", "population_size=1,2", "--on", "slurm")
    assert done.returncode == 0, done.stderr
    modes = "SELECT DISTINCT mode FROM executions JOIN isolations USING (isolation)"
    assert sierra.open(project).sql(modes).to_pylist() == [{"mode": "worker"}]


def test_an_image_that_differs_on_the_node_is_never_executed(project: Path, slurm: Slurm, tmp_path: Path) -> None:
    held = tmp_path / "python"
    change = f'echo x >> "$(ls {project}/.sierra/images/*/rootfs.sqfs)"'
    held.write_text(f'#!/bin/sh\ncase "$*" in *--probe*) ;; *) {change} ;; esac\nexec python3 "$@"\n')
    held.chmod(0o755)
    with (project / "sierra.toml").open("a") as file:
        file.write(f'python = "{held}"\n')
    done = projects.quick(project, "run", "population_size=1,2", "--on", "slurm")
    assert done.returncode == 3, done.stderr
    assert "the image: " in done.stderr
    assert "differs from the one on the submitting host" in done.stderr
    assert sierra.open(project).sql("SELECT * FROM executions").to_pylist() == []
