"""Runs that write no file and end well are good, but `sierra run` and `sierra try` say so, with what they printed."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.projects import CONFIG, make, quick

SILENT = "import sys\nprint('reading')\nprint('no robots', 'nothing to do', '', sep='\\n', file=sys.stderr)\n"
SAID = "note: {} wrote no file; {} said on stderr: no robots / nothing to do\n"
QUERY = ("run", "population_size=1,2", "--no-figures")


@pytest.mark.integration
def test_a_batch_says_once_that_its_runs_wrote_no_file(tmp_path: Path) -> None:
    project = make(tmp_path / "project", simulator=SILENT)
    done = quick(project, *QUERY)
    assert done.returncode == 0
    assert done.stderr.count("wrote no file") == 1
    assert SAID.format("4 runs", "their programs") in done.stderr
    assert "wrote no file" not in quick(project, *QUERY).stderr  # nothing was executed


@pytest.mark.nightly
def test_a_try_says_that_the_run_wrote_no_file(tmp_path: Path) -> None:
    project = make(tmp_path / "project", simulator=SILENT)
    done = quick(project, "try")
    assert done.returncode == 0
    assert SAID.format("1 run", "its program") in done.stderr


@pytest.mark.nightly
def test_a_silent_program_is_named_as_silent(tmp_path: Path) -> None:
    project = make(tmp_path / "project", simulator="pass\n")
    found = json.loads(quick(project, "try", "--json").stdout)
    assert (found["status"], found["notes"]) == ("ok", ["1 run wrote no file; its program said nothing on stderr"])


@pytest.mark.integration
@pytest.mark.parametrize(
    ("simulator", "more"),
    [
        (SILENT + "open('a.bin', 'w')\n", ""),
        (SILENT, '[outputs.swarm]\nfile = "swarm.csv"\nrequired = false\n'),
    ],
)
def test_nothing_is_said_about_runs_that_wrote_a_file_or_whose_outputs_are_declared(
    tmp_path: Path, simulator: str, more: str
) -> None:
    project = make(tmp_path / "project", CONFIG + more, simulator=simulator)
    done = quick(project, "try")
    assert done.returncode == 0
    assert "wrote no file" not in done.stderr
