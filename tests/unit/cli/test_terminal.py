"""On a terminal: completion of names and ids from the project and its store, tables that fit, and short ids."""

from __future__ import annotations

import io
import json
import os
import subprocess
import sys
import sysconfig
from pathlib import Path

import pytest

import sierra
from tests import projects

CONFIG = (
    projects.CONFIG
    + """
[controllers.random_walk]
changes = [{ set = "//swarm/@controller", value = "random_walk" }]
[figures.mine]
kind = "summary"
table = "swarm"
column = "coverage"
[queries.scalability]
criteria = "population_size=1,2"
"""
)
LONG = "population_size=1,2,3,4,5,6,7,8,9,10,11,12,13,14,15,16,17,18,19,20,21,22,23,24,25,26,27,28"


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = projects.make(tmp_path_factory.mktemp("terminal") / "project", CONFIG)
    assert projects.quick(root, "run", "population_size=1", "--no-figures").returncode == 0
    return root


@pytest.fixture
def terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    """Standard output is a terminal of 80 columns."""

    class Terminal(io.TextIOWrapper):
        def isatty(self) -> bool:
            return True

    monkeypatch.setattr("io.TextIOWrapper", Terminal)
    monkeypatch.setenv("COLUMNS", "80")


def completed(root: Path, words: str, program: tuple[str, ...] = (str(projects.SIERRA),)) -> list[str]:
    """Return what bash offers after these words, the last of which may be incomplete."""
    place = str(len(words.split()) - (not words.endswith(" ")))
    typed = {"_SIERRA_COMPLETE": "complete_bash", "COMP_WORDS": words, "COMP_CWORD": place}
    ended = subprocess.run(
        program, cwd=root, capture_output=True, text=True, check=False, env={**os.environ, **typed}, timeout=100
    )
    assert ended.stderr == ""
    return ended.stdout.split()


@pytest.mark.integration
@pytest.mark.parametrize(
    ("words", "found"),
    [
        ("sierra run pop", ["population_size."]),
        ("sierra run sc", ["scalability"]),
        ("sierra run x --controller ", ["random_walk"]),
        ("sierra run x --on l", ["lab", "local"]),
        ("sierra figures 1234 m", ["mine"]),
        ("sierra stats s", ["swarm"]),
        ("sierra stats swarm co", ["coverage"]),
        ("sierra stats absent ", []),
    ],
)
def test_names_from_the_project_are_completed(root: Path, words: str, found: list[str]) -> None:
    assert completed(root, words) == found


@pytest.mark.integration
@pytest.mark.parametrize("kind", ["run", "experiment", "execution"])
def test_ids_are_completed_after_4_digits(root: Path, kind: str) -> None:
    table = {"run": "batch_runs", "experiment": "experiments", "execution": "executions"}[kind]
    [row, *_] = sierra.open(root).sql(f"SELECT {kind} FROM {table} ORDER BY 1").to_pylist()
    assert row[kind][:10] in completed(root, f"sierra show {row[kind][:4]}")


@pytest.mark.nightly
def test_batch_and_session_ids_are_completed_without_a_prefix(root: Path) -> None:
    [batch] = sierra.open(root).batches
    [log] = (root / ".sierra" / "logs").iterdir()
    assert completed(root, "sierra show ") == [batch.batch[:10], log.stem]
    assert completed(root, "sierra sql -b ") == [batch.batch[:10]]
    assert completed(root, f"sierra show {log.stem[:5]}") == [log.stem]


@pytest.mark.integration
@pytest.mark.parametrize("words", ["sierra show zz", "sierra show ", "sierra stats nope ", "sierra run pop", "sierra run zz"])
def test_completion_of_names_and_batches_loads_no_database(root: Path, words: str) -> None:
    program = (
        "import sys, sierra.cli.main as m\n"
        "try: m.main()\n"
        "except SystemExit: pass\n"
        "print(*sorted({'duckdb', 'pyarrow', 'numpy', 'git'} & sys.modules.keys()))\n"
    )
    offered = completed(root, words, (sys.executable, "-c", f"import sys; sys.argv = ['sierra']\n{program}"))
    assert not {"duckdb", "pyarrow", "numpy", "git"} & set(offered)


@pytest.mark.parametrize(("stream", "code"), [("<&-", 0), (">&-", 0), ("2>&-", 0), (">/dev/full", 3)])
def test_a_closed_or_full_stream_ends_in_no_fault(root: Path, stream: str, code: int) -> None:
    program = Path(sysconfig.get_path("scripts"), "sierra")
    ended = subprocess.run(
        ["sh", "-c", f'exec "$0" ls {stream}', program], cwd=root, capture_output=True, text=True, check=False
    )
    assert ended.returncode == code
    assert ended.stderr == ("sierra: No space left on device\n" if code else "")
    assert ("complete" in ended.stdout) == (stream in ("<&-", "2>&-"))


@pytest.mark.integration
def test_tables_fit_the_terminal_unless_long_is_given(root: Path, terminal: None) -> None:
    ran = projects.quick(root, "run", LONG, "--runs", "1", "-n", "--json")
    assert ran.returncode == 0
    project = sierra.open(root)
    project.run(LONG, runs=1, figures=False)
    shown = projects.quick(root, "ls").stdout
    assert max(map(len, shown.splitlines())) <= 80
    assert "…" in shown
    assert "complete" in shown
    assert LONG in projects.quick(root, "ls", "--long").stdout
    statement = "SELECT query, run FROM sessions JOIN batch_runs USING (batch) ORDER BY lamport DESC LIMIT 1"
    assert max(map(len, projects.quick(root, "sql", statement).stdout.splitlines())) <= 80
    assert LONG in projects.quick(root, "sql", "--long", statement).stdout


@pytest.mark.integration
def test_ids_are_short_unless_long_or_json_is_given(root: Path) -> None:
    batch = sierra.open(root).batches[0].batch
    shown = json.loads(projects.quick(root, "show", batch, "--json").stdout)
    assert len(shown["spec"]["spec"]) == 64
    short, long = projects.quick(root, "show", batch).stdout, projects.quick(root, "show", batch, "--long").stdout
    assert batch in short
    assert shown["spec"]["spec"][:10] in short
    assert shown["spec"]["spec"] not in short
    assert shown["spec"]["spec"] in long
    assert batch in projects.quick(root, "ls", "--long").stdout
    assert batch not in projects.quick(root, "ls").stdout


def test_piped_output_is_never_truncated(root: Path) -> None:
    statement = "SELECT repeat('x', 500) AS text, run FROM batch_runs LIMIT 1"
    answer = projects.quick(root, "sql", statement).stdout
    assert "x" * 500 in answer
    assert len(answer.split()[-1]) == 64
