"""Declarations of services, `before` and `after`: what is refused before anything runs, and what is part of the identity."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from tests import projects

SERVICE = '[services.echo]\ncommand = "python3 server.py {port}"\nready = { port = "{port}" }\n'
COMMAND = 'command = "python3 sim.py {input}"\n'


def make(folder: Path, more: str = "", before: str = "") -> Path:
    """Make a project with these lines at the beginning and at the end of its `sierra.toml`."""
    projects.make(folder, before + projects.CONFIG + more)
    (folder / "server.py").touch()
    return folder


def batch(folder: Path) -> str:
    """Return the id of the batch that the query would execute."""
    done = projects.quick(folder, "run", "population_size=1", "--dry-run", "--json")
    assert done.returncode == 0, done.stderr
    return str(json.loads(done.stdout)["batch"])


@pytest.mark.parametrize(
    ("before", "more", "message"),
    [
        ('before = ["mesh"]\n', "", "before.0 should be a list"),
        ("before = [[]]\n", "", "before.0 should not be empty"),
        ('before = "sh {inputs}"\n', "", "before: unknown placeholder {inputs} in '{inputs}'; known are {input}, "),
        ('after = "sh {arguments}"\n', "", "after: unknown placeholder {arguments}"),
        ('after = "sh {ports}"\n', "", "after: unknown placeholder {ports}"),
        (
            'after = "sh {services.echo.port}"\n',
            "",
            "after: {services.echo.port} names no service; there is no [services.NAME]",
        ),
        ('after = "sh {services.eco.port}"\n', SERVICE, "{services.eco.port} names no service; known are echo"),
        ('after = "sh {services.echo.host}"\n', SERVICE, "after: unknown placeholder {services.echo.host}"),
        ("", SERVICE + "timout = 3\n", "unknown key 'services.echo.timout'; did you mean 'timeout'?"),
        ("", SERVICE + SERVICE, "services"),
        ("", SERVICE.replace("ready =", "timeout = 0\nready ="), "services.echo.timeout"),
        (
            "",
            SERVICE.replace(" {port}", ""),
            "[services.echo]: nothing tells the service its port; write {port} in its command",
        ),
        ("", SERVICE.replace('port = "{port}"', ""), "needs exactly one of file, port, output, command, not none"),
        (
            "",
            SERVICE.replace('"{port}" }', '5000, file = "x" }'),
            "needs exactly one of file, port, output, command, not file and",
        ),
        ("", SERVICE.replace('port = "{port}"', 'output = "("'), "is not a regular expression"),
        ("", SERVICE.replace('"{port}" }', '"some" }'), "services.echo.ready.port"),
        (
            "",
            SERVICE.replace('{port}"\n', '{port} {seed}"\nscope = "batch"\n', 1),
            'scope = "batch" excludes the input, the seed and values',
        ),
        ('before = "sh {noise}"\n', "", "before uses {noise}; add noise=… to the query"),
        ("before = \"sh -c 'echo {population_size}'\"\n", "", "before: sh would execute a value of 'population_size'"),
        ('after = "sh {input.a}"\n', "", "after: {input.a} in '{input.a}' is no template"),
        ("", SERVICE + 'scope = "all"\n', "services.echo.scope"),
        ("", SERVICE.replace("ready", "# ready"), "'services.echo.ready' is missing"),
    ],
)
def test_a_wrong_declaration_is_refused_in_one_line(tmp_path: Path, before: str, more: str, message: str) -> None:
    done = projects.quick(make(tmp_path / "project", more, before), "run", "population_size=1", "--no-figures")
    assert done.returncode == 2, done.stderr
    [line] = done.stderr.splitlines()
    assert message in line


@pytest.mark.parametrize(
    ("before", "more"),
    [
        ('before = "no-such-program {input}"\n', ""),
        ('after = [["true"], ["no-such-program"]]\n', ""),
        ("", '[services.a]\ncommand = "no-such-program"\nready = { output = "x" }\n'),
        ("", '[services.a]\ncommand = "sleep 9"\nready = { command = "no-such-program" }\n'),
    ],
)
def test_a_program_that_is_missing_is_noticed_before_anything_runs(tmp_path: Path, before: str, more: str) -> None:
    root = make(tmp_path / "project", more, before)
    done = projects.quick(root, "run", "population_size=1", "--no-figures")
    assert done.returncode == 3, done.stderr
    assert "the program 'no-such-program' was not found" in done.stderr
    assert not list((root / ".sierra").glob("segments/*"))


@pytest.mark.integration
def test_what_is_executed_around_the_command_is_part_of_the_identity_but_no_limit(tmp_path: Path) -> None:
    root = make(tmp_path / "project")
    plain = batch(root)
    made = {plain}
    for before, more in (
        ('before = "true"\n', ""),
        ('after = "true"\n', ""),
        ('before = "true 1"\n', ""),
        ("", SERVICE),
        ("", SERVICE.replace('port = "{port}"', 'output = "x"')),
        ("", SERVICE + 'scope = "batch"\n'),
    ):
        make(root, more, before)
        made.add(batch(root))
    assert len(made) == 7
    make(root, SERVICE)
    id_before = batch(root)
    make(root, SERVICE + "timeout = 99\n")
    assert batch(root) == id_before
    make(root)
    assert batch(root) == plain


def test_a_command_in_one_line_means_the_same_as_its_words(tmp_path: Path) -> None:
    root = make(tmp_path / "project", before="before = \"true 'a b'\"\n")
    written = batch(root)
    make(root, before='before = [["true", "a b"]]\n')
    assert batch(root) == written


@pytest.mark.integration
def test_the_explanation_names_what_changed_around_the_command(tmp_path: Path) -> None:
    root = make(tmp_path / "project", before='after = "true"\n')
    projects.run(root, "population_size=1")
    make(root, before='after = "true again"\n')
    done = projects.quick(root, "run", "population_size=1", "--dry-run", "--explain")
    assert "after: true → true again" in done.stdout
    projects.run(root, "population_size=1")
    first, second = (row["batch"] for row in projects.sql(root, "SELECT batch FROM batches ORDER BY lamport"))
    assert "after: true → true again" in projects.quick(root, "diff", first, second).stdout
    assert re.search("(?m)^  after +true again$", projects.quick(root, "show", second).stdout)


@pytest.mark.nightly
def test_a_variable_may_be_used_by_a_command_around_the_run_only(tmp_path: Path) -> None:
    folder = make(tmp_path / "project", before='after = "touch made-{speed}"\n')
    config = folder / "sierra.toml"
    config.write_text(config.read_text().replace("[variables]\n", "[variables]\nspeed = {}\n"))
    done = projects.quick(folder, "run", "speed=2,3", "--runs", "1", "--no-figures")
    assert done.returncode == 0, done.stderr
    files = projects.sql(folder, "SELECT path FROM artifacts WHERE path LIKE 'made%' ORDER BY path")
    assert [one["path"] for one in files] == ["made-2", "made-3"]
