"""Products are built in the image of the runs, by every engine, and a replay builds them there again."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests import containers, projects
from tests.projects import quick
from tests.waiting import until

pytestmark = pytest.mark.real
BUILD = """\
[build]
command = "./compile.sh"
produces = ["build/sim"]
in = "code"
"""
COMPILER = """\
#!/bin/sh
cd .. && mkdir -p build && { cat sim.sh; echo "# $(pwd) $HOME"; } > build/sim && chmod +x build/sim
"""
RUN = ("run", "population_size=1,2", "--no-figures")
ENGINES = ("podman", "apptainer")


@pytest.fixture(scope="module")
def busybox(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return containers.busybox(tmp_path_factory.mktemp("busybox")) if containers.BUSYBOX.exists() else Path("/nowhere")


@pytest.fixture(params=ENGINES)
def root(request: pytest.FixtureRequest, tmp_path: Path, busybox: Path, require: Callable[..., str]) -> Path:
    """Return a project in git whose runs use an image, and whose program is built there."""
    require("busybox-static, as /bin/busybox", there=containers.BUSYBOX.exists())
    require(request.param)
    more = (f'engine = "{request.param}"', BUILD)
    folder = containers.make(tmp_path / "project", busybox, *more, command="sh build/sim {input}")
    (folder / "code").mkdir()
    (folder / "code/compile.sh").write_text(COMPILER)
    (folder / "code/compile.sh").chmod(0o755)
    (folder / ".gitignore").write_text("build/\nbegun\n")
    return projects.commit(folder)


def says(folder: Path, *words: str, code: int = 0) -> str:
    done = quick(folder, *words)
    assert done.returncode == code, done.stdout + done.stderr
    return done.stdout + done.stderr


def rows(folder: Path, statement: str) -> list[dict[str, Any]]:
    answer: list[dict[str, Any]] = json.loads(says(folder, "sql", "--json", statement))
    return answer


@pytest.mark.each_case
def test_products_are_built_in_the_image_and_again_by_a_replay(root: Path) -> None:
    assert "4 executed" in says(root, *RUN)
    assert (root / "build/sim").read_text().splitlines()[-1] == "# /run/sierra/project /run/sierra/run/home"
    [build] = rows(root, "SELECT b.engine, b.image = m.image AS same FROM builds b, images m")
    assert build["same"]
    assert build["engine"] in ENGINES
    assert "0 executed, 4 reused" in says(root, *RUN)
    [batch] = rows(root, "FROM batches")
    (root / "build/sim").unlink()
    told = says(root, "replay", batch["batch"])
    assert "identical (4 runs: 4 identical; built from source: build/sim)" in told
    assert "differ" not in told
    assert containers.left(root) == []


def test_a_failed_build_in_a_container_says_why(root: Path) -> None:
    (root / "code/compile.sh").write_text("#!/bin/sh\necho no such thing: error 7\nexit 7\n")
    assert "the build failed, so nothing was executed: exit status 7 of " in says(root, *RUN, code=1)
    (root / "code/compile.sh").write_text("#!/bin/nosuchshell\n")
    assert "the build failed" in says(root, *RUN, code=1)
    assert rows(root, "FROM executions") == []


def test_the_container_of_a_killed_session_is_ended_before_the_next_build(root: Path) -> None:
    (root / "code/compile.sh").write_text("#!/bin/sh\necho > ../begun; sleep 87654\n")
    session = projects.start(root, *RUN)
    until((root / "begun").exists)
    session.kill()
    session.communicate()
    (root / "code/compile.sh").write_text(COMPILER)
    assert "4 executed" in says(root, *RUN)
    until(lambda: not list(containers.sleepers("87654")))
    assert containers.left(root) == []


@pytest.mark.nightly
def test_a_time_limit_ends_the_container(root: Path) -> None:
    (root / "code/compile.sh").write_text("#!/bin/sh\nsleep 76543\n")
    with (root / "sierra.toml").open("a") as file:
        file.write("wall = 2\n")
    assert "it was ended after 2 s, the time limit in [build] wall" in says(root, *RUN, code=1)
    until(lambda: not list(containers.sleepers("76543")))
    assert containers.left(root) == []


@pytest.mark.nightly
def test_runs_in_an_image_can_be_replayed_on_the_host_with_a_program_that_is_built_there(root: Path) -> None:
    says(root, *RUN)
    [batch] = rows(root, "FROM batches")
    (root / "build/sim").unlink()
    told = says(root, "replay", batch["batch"], "--engine", "none")
    assert "built from source: build/sim)" in told
    assert "products built from the recorded source differ from the record" in told
    subprocess.run(["git", "diff", "--exit-code"], cwd=root, check=True)
