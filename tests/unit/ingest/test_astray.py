"""Files that runs write, but not into their working directory, are named; a run whose outputs all are elsewhere has failed."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests import projects

Made = Callable[..., Path]


@pytest.fixture
def made(tmp_path: Path) -> Made:
    """Return a function that makes a project whose runs execute Python code; `place` is the folder of their input."""

    def make(code: str, settings: str = "", tables: str = "") -> Path:
        config = projects.CONFIG.replace("runs = 2", f"runs = 3\n{settings}") + tables
        simulator = f"import os, sys\nplace = os.path.dirname(os.path.abspath(sys.argv[1]))\n{code}\n"
        return projects.make(tmp_path / "project", config, simulator=simulator)

    return make


def run(root: Path, code: int, *words: str) -> tuple[dict[str, Any], str]:
    done = projects.quick(root, "run", "population_size=1", "-j", "1", "--no-figures", "--json", *words)
    assert done.returncode == code, done.stdout + done.stderr
    summary: dict[str, Any] = json.loads(done.stdout)
    return summary, projects.other_notes(done.stderr)


def sql(root: Path, statement: str) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = json.loads(projects.quick(root, "sql", "--format", "json", statement).stdout)
    return found


def reasons(root: Path) -> list[dict[str, Any]]:
    return sql(root, "SELECT status, reason, count(*) AS n FROM executions GROUP BY ALL ORDER BY n")


BESIDE = 'print("a,b\\n1,2", file=open(place + "/trips.csv", "w"))'
HOME = 'print("a,b\\n1,2", file=open(os.environ["HOME"] + "/trips.csv", "w"))'


@pytest.mark.integration
@pytest.mark.parametrize(
    ("code", "place", "cure"),
    [
        (BESIDE, "{run}/trips.csv", "call it output/trips.csv in the template, or pass {output} to the program"),
        (HOME, "{run}/home/trips.csv", 'set command = "env HOME={output} …"'),
    ],
)
def test_a_run_that_writes_only_beside_its_input_or_into_its_home_has_failed(
    made: Made, code: str, place: str, cure: str
) -> None:
    root = made(code, 'observe = "none"')
    summary, said = run(root, 1)
    assert summary["failed"] == 3
    reason = f"left no file in its working directory, but wrote {place}"
    assert reasons(root) == [{"status": "failed", "reason": reason, "n": 3}]
    assert f": {place} (only files in {{output}}, the working directory, are recorded; to keep such a file, {cure}" in said
    assert sql(root, "SELECT path, use, count(*) AS n FROM files_written GROUP BY ALL") == [
        {"path": place, "use": "written", "n": 3}
    ]


@pytest.mark.nightly
def test_what_the_note_says_keeps_the_file(made: Made) -> None:
    root = made('print("a,b\\n1,2", file=open(place + "/" + open(sys.argv[1]).read().split("<!--")[1].split()[0], "w"))')
    template = root / "arena.xml"
    template.write_text(projects.TEMPLATE.replace("an arena", "trips.csv"))
    assert "call it output/trips.csv in the template" in run(root, 1)[1]
    template.write_text(projects.TEMPLATE.replace("an arena", "output/trips.csv"))
    assert "runs wrote files" not in run(root, 0)[1]
    assert sql(root, "SELECT DISTINCT a, b FROM trips") == [{"a": 1, "b": 2}]


@pytest.mark.nightly
def test_an_environment_with_another_home_keeps_the_file(made: Made) -> None:
    root = made(HOME)
    config = root / "sierra.toml"
    config.write_text(config.read_text().replace("python3 sim.py", "env HOME={output} python3 {project}/sim.py"))
    assert run(root, 0)[1] == ""
    assert sql(root, "SELECT DISTINCT a, b FROM trips") == [{"a": 1, "b": 2}]


@pytest.mark.integration
def test_the_reason_of_a_missing_output_names_where_it_was_written(made: Made) -> None:
    root = made(BESIDE + '\nopen("log.txt", "w").write("x")', 'observe = "none"', '[outputs.trips]\nfile = "trips.csv"\n')
    run(root, 1)
    reason = "did not write 'trips.csv' (output 'trips') in its working directory, but {run}/trips.csv"
    assert reasons(root) == [{"status": "failed", "reason": reason, "n": 3}]


@pytest.mark.integration
def test_the_siblings_of_an_observed_run_that_wrote_elsewhere_have_failed_too(made: Made, require: Callable[..., str]) -> None:
    require("strace")
    root = made('open(os.path.dirname(sys.argv[0]) + "/trips.csv", "w").write("a,b\\n1,2\\n")', "observe_budget = 0")
    (root / ".gitignore").write_text("trips.csv\n")
    summary, said = run(root, 1)
    assert (summary["executed"], summary["failed"]) == (3, 3)
    own = "left no file in its working directory, but wrote {project}/trips.csv"
    others = f"left no file in its working directory; an observed run with the same command {own}"
    assert reasons(root) == [{"status": "failed", "reason": own, "n": 1}, {"status": "failed", "reason": others, "n": 2}]
    assert "runs wrote files into the project: {project}/trips.csv" in said
    assert "belongs to the source from now on" in said
    assert projects.quick(root, "fsck").returncode == 0


@pytest.mark.integration
def test_settings_caches_locks_and_temporary_files_are_no_outputs(made: Made) -> None:
    root = made(
        """print(1)
open(os.environ["HOME"] + "/.settings", "w").write("x")
os.mkdir(os.environ["HOME"] + "/.cache")
open(os.environ["HOME"] + "/.cache/x", "w").write("x")
open(place + "/lock", "w")
open(os.environ["TMPDIR"] + "/x", "w").write("x")
os.makedirs(os.environ["HOME"] + "/Desktop/.x")"""
    )
    assert run(root, 0)[1] == "note: 3 runs wrote no file; their programs said nothing on stderr\n"


@pytest.mark.nightly
def test_a_run_with_outputs_only_gets_a_note(made: Made) -> None:
    root = made(BESIDE + f"\n{BESIDE.replace('place + ', '').replace('/trips', 'table')}", 'observe = "none"')
    summary, said = run(root, 0)
    assert summary["executed"] == 3
    assert "runs wrote files beside their input: {run}/trips.csv" in said


@pytest.mark.integration
def test_declared_outputs_that_are_not_required_may_be_elsewhere(made: Made) -> None:
    root = made(BESIDE, 'observe = "none"', '[outputs.trips]\nfile = "trips.csv"\nrequired = false\n')
    run(root, 0)


@pytest.mark.nightly
def test_an_evaluation_by_changed_rules_gives_the_same_reason(made: Made) -> None:
    root = made(BESIDE, 'observe = "none"')
    run(root, 1, "--runs", "1")
    config = root / "sierra.toml"
    before = config.read_text()
    config.write_text(before + "[success]\nexit_status = [0, 7]\n")
    assert run(root, 1, "--runs", "1")[0]["executed"] == 1
    config.write_text(before + '[outputs.trips]\nfile = "trips.csv"\nrequired = false\n')
    assert run(root, 0, "--runs", "1")[0]["executed"] == 0
