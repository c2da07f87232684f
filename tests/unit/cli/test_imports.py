"""A command imports only the libraries that it needs."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from tests import projects

CALL = """
import json, sys
from sierra.cli.main import main
sys.argv = ["sierra", *sys.argv[1:]]
try:
    main()
except SystemExit:
    names = {name.partition(".")[0] for name in sys.modules}
    print(json.dumps(sorted(names)), file=sys.stderr)
"""
SOMETIMES = {"duckdb", "git", "logging", "lxml", "matplotlib", "numpy", "pyarrow", "pydantic", "scipy"}
NEVER = {"fabric", "invoke", "IPython", "pandas", "paramiko", "seaborn"}


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A project in git, with a batch."""
    root = projects.commit(projects.make(tmp_path_factory.mktemp("imports") / "project"))
    assert projects.quick(root, "run", "population_size=1", "--no-figures").returncode == 0
    return root


def imported(root: Path, *words: str) -> set[str]:
    ended = subprocess.run([sys.executable, "-c", CALL, *words], cwd=root, capture_output=True, text=True, check=True)
    return {str(name) for name in json.loads(ended.stderr.splitlines()[-1])} & (SOMETIMES | NEVER)


@pytest.mark.integration
def test_help_imports_only_the_command_line_library(root: Path) -> None:
    assert imported(root, "--help") == set()


@pytest.mark.parametrize("words", [("ls",), ("status",), ("sql", "SELECT 1")], ids=" ".join)
def test_commands_that_read_a_few_rows_import_only_duckdb(root: Path, words: tuple[str, ...]) -> None:
    assert imported(root, *words) <= {"duckdb", "logging"}


@pytest.mark.integration
def test_a_batch_without_outputs_imports_neither_numpy_nor_pyarrow(tmp_path: Path) -> None:
    root = projects.make(tmp_path / "project", projects.CONFIG.replace("python3 sim.py", "true"))
    for size in ("1", "2"):
        assert not imported(root, "run", f"population_size={size}", "--no-figures") & {"numpy", "pyarrow", "scipy"}
    [count] = json.loads(projects.quick(root, "sql", "--json", "SELECT count(*) AS n FROM effective").stdout)
    assert count["n"] > 1


@pytest.mark.integration
@pytest.mark.parametrize("words", [("run", "population_size=1", "--no-figures"), ("run", "population_size=1", "-n")])
def test_run_imports_neither_git_nor_plotting_libraries(root: Path, words: tuple[str, ...]) -> None:
    assert not imported(root, *words) & {"git", "matplotlib", "scipy", *NEVER}


@pytest.mark.integration
def test_default_figures_import_neither_pandas_nor_seaborn_nor_scipy(root: Path) -> None:
    found = imported(root, "figures")
    assert "matplotlib" in found
    assert "scipy" not in found
    assert not imported(root, "run", "population_size=1,2", "noise=0.1,0.2", "--runs", "1") & NEVER


@pytest.mark.integration
def test_only_diff_imports_gitpython(root: Path) -> None:
    first = json.loads(projects.quick(root, "ls", "--json").stdout)[0]["batch"]
    (root / "sim.py").write_text(projects.SIMULATOR + "\n# as before\n")
    projects.commit(root, "second")
    second = projects.run(root, "population_size=1", "--no-figures")[0]["batch"]
    for words in (("ls",), ("sql", "SELECT 1"), ("show", second), ("why", second), ("run", "population_size=1", "-n")):
        assert "git" not in imported(root, *words), words
    assert "commit" in projects.quick(root, "show", second).stdout
    assert "git" in imported(root, "diff", first, second)
