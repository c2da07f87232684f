"""The wheel, installed with only its dependencies, runs the demo."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

EXTRAS = {"fabric", "mujoco", "pandas", "paramiko", "pytest", "seaborn"}
PIP = ("-m", "pip", "--disable-pip-version-check", "--quiet")


def run(*argv: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(argv, cwd=cwd, capture_output=True, text=True, check=False)


@pytest.fixture
def bare(tmp_path: Path, require: Callable[..., str]) -> Path:
    """Return a virtual environment with the wheel and its dependencies."""
    source = Path(__file__).parents[2]
    built = run(sys.executable, "-m", "build", "--no-isolation", "--wheel", "--outdir", str(tmp_path / "dist"), cwd=source)
    assert built.returncode == 0, built.stderr
    [wheel] = (tmp_path / "dist").glob("*.whl")
    run(sys.executable, "-m", "venv", "venv", cwd=tmp_path)
    python = str(tmp_path / "venv" / "bin" / "python")
    require(
        "an index of Python packages", there=run(python, *PIP, "download", "--no-deps", "typer", cwd=tmp_path).returncode == 0
    )
    installed = run(python, *PIP, "install", "--only-binary", ":all:", str(wheel), cwd=tmp_path)
    assert installed.returncode == 0, installed.stderr
    return tmp_path / "venv" / "bin"


def test_the_demo_runs_from_the_wheel_after_its_requirement_is_installed(bare: Path, tmp_path: Path) -> None:
    python, program = str(bare / "python"), str(bare / "sierra")
    listed = json.loads(run(python, "-m", "pip", "list", "--format", "json", cwd=tmp_path).stdout)
    assert not EXTRAS & {one["name"].lower() for one in listed}
    made = run(program, "init", "--example", "swarm", "demo", cwd=tmp_path)
    assert "first: pip install 'mujoco>=4,<4.1'\n" in made.stdout
    demo = tmp_path / "demo"
    assert run(program, "run", "population_size=1", "-n", cwd=demo).returncode == 0
    refused = run(program, "run", "population_size=1", "--runs", "2", cwd=demo)
    assert refused.returncode == 3
    assert "not installed (mujoco>=4,<4.1): pip install 'mujoco>=4,<4.1'" in refused.stderr
    assert json.loads(run(program, "sql", "--json", "SELECT count(*) AS n FROM executions", cwd=demo).stdout or "[]") in (
        [],
        [{"n": 0}],
    )
    assert run(program, "doctor", cwd=demo).returncode == 3
    frame = run(python, "-c", "import sierra; sierra.open('.').frame('SELECT 1')", cwd=demo)
    assert "sierra-experiments[figures]" in frame.stderr
    assert run(python, *PIP, "install", "--only-binary", ":all:", "mujoco>=4,<4.1", cwd=tmp_path).returncode == 0
    ran = run(program, "run", "population_size=1", "--runs", "2", "--json", cwd=demo)
    answer = json.loads(ran.stdout)
    assert (ran.returncode, answer["executed"], answer["failed"]) == (0, 2, 0)
    assert any(figure.endswith(".png") for figure in answer["figures"])
    assert run(program, "fsck", cwd=demo).returncode == 0
