"""A file becomes one table: two outputs that claim it are an error before anything runs, or fail the run that wrote it."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests import projects
from tests.projects import quick, sql

WRITES = "for name in ('a-1.csv', 'a-2.csv'):\n    open(name, 'w').write('v\\n1\\n')\n"
GLOB = '[outputs.all]\nfile = "a-*.csv"\n'


@pytest.mark.parametrize("second", ["net.graphml", "./net.graphml"])
def test_same_file_in_two_outputs_is_refused_before_anything_runs(tmp_path: Path, second: str) -> None:
    outputs = [
        f'[outputs.{rows}]\nfile = "{file}"\nformat = "graphml"\nrows = "{rows}"\n'
        for rows, file in (("nodes", "net.graphml"), ("edges", second))
    ]
    projects.make(tmp_path, projects.CONFIG + "".join(outputs))
    ended = quick(tmp_path, "run", "population_size=1")
    assert (ended.returncode, len(ended.stderr.splitlines())) == (2, 1)
    assert "'nodes' and 'edges' have the same file 'net.graphml'; a file becomes one table" in ended.stderr
    assert not (tmp_path / ".sierra").exists()


@pytest.mark.integration
def test_file_of_two_patterns_fails_the_run(tmp_path: Path) -> None:
    config = projects.CONFIG + GLOB + '[outputs.numbered]\nfile = "a-{n}.csv"\n'
    projects.make(tmp_path, config, simulator=projects.SIMULATOR + WRITES)
    assert quick(tmp_path, "run", "population_size=1", "--no-figures").returncode == 1
    assert sql(tmp_path, "SELECT DISTINCT reason FROM executions") == [
        {
            "reason": "a-1.csv: belongs to the outputs 'all' (a-*.csv) and 'numbered' (a-{n}.csv); "
            "a file becomes one table: change file in one of them"
        }
    ]


@pytest.mark.integration
def test_named_file_belongs_to_its_output_whatever_patterns_it_matches(tmp_path: Path) -> None:
    config = (
        projects.CONFIG
        + GLOB
        + '[outputs.one]\nfile = "a-1.csv"\n[outputs.rest]\nfile = "*.txt"\nformat = "file"\nrequired = false\n'
    )
    projects.make(tmp_path, config, simulator=projects.SIMULATOR + WRITES)
    assert quick(tmp_path, "run", "population_size=1", "--no-figures").returncode == 0
    found = sql(tmp_path, "SELECT DISTINCT output, path FROM artifacts WHERE kind = 'table' AND output <> 'swarm' ORDER BY ALL")
    assert found == [{"output": "all", "path": "a-2.csv"}, {"output": "one", "path": "a-1.csv"}]
