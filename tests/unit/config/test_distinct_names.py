"""Names that differ only in upper and lower case are refused, because SQL and some file systems take them for the same."""

from __future__ import annotations

import tomllib
from pathlib import Path

import pytest

import sierra
from sierra.config import extensions
from sierra.config.project_file import model_of, parse
from sierra.errors import ConfigError, QueryError
from tests import stores
from tests.projects import quick
from tests.tiers import of_extension

NAMED = {
    "variables": '{ set = "/a" }',
    "per_run": "[1, 2]",
    "controllers": '{ changes = [{ set = "/c", value = "1" }] }',
    "scenarios": '{ changes = [{ set = "/c", value = "1" }] }',
    "templates": '"{name}.json"',
    "services": '{ command = "sleep 1", ready = { file = "x" } }',
    "outputs": '{ file = "{name}.csv" }',
    "equivalence": '{ table = "t", column = "c", margin = 1.0 }',
    "queries": '{ criteria = "a=1" }',
    "tables": '{ sql = "SELECT 1" }',
    "figures": '{ table = "t", column = "c", kind = "summary" }',
    "figure_defaults": "{}",
    "paper_tables": '{ sql = "SELECT 1" }',
    "models": '{ expression = "1", column = "c" }',
    "comparisons": '{ column = "c" }',
    "claims": '{ says = "s", paper = "p", query = "q", sql = "SELECT true AS holds" }',
    "numbers": '{ query = "a=1", sql = "SELECT 1" }',
    "targets": "{ runner = 'local' }",
    "runners": '{ scheduler = "slurm" }',
}
if "videos" in extensions.added("tables"):
    NAMED["videos"] = '{ kind = "poses", table = "t", column = ["x", "y"] }'


@pytest.mark.parametrize("table", NAMED)
def test_names_that_differ_by_case_are_refused(table: str) -> None:
    lines = (f"{name} = {NAMED[table].replace('{name}', file)}" for name, file in (("ab", "1"), ("aB", "2")))
    with pytest.raises(ConfigError) as raised:
        parse(tomllib.loads("\n".join((f"[{table}]", *lines))), "sierra.toml")
    both = f"{table}.ab and {table}.aB"
    assert (
        str(raised.value)
        == f"sierra.toml: {both}: these names differ only in upper and lower case, which SQL ignores; rename one"
    )


def test_all_tables_by_name_are_checked() -> None:
    options = {"platforms", "links", "template_formats", "engines", "readers", "statistics", "criteria", "comparison_methods"}
    named = {name for name, field in model_of(NAMED).model_fields.items() if "Mapping[" in str(field.annotation)}
    assert named == NAMED.keys() | options


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (
            "[robots]\ncount = 2\n[robots.groups]\nab = { places = [1] }\naB = { places = [2] }\n",
            "robots.groups: ab and aB: these names differ only",
        ),
        *of_extension(
            "trials",
            ('[trials.commands]\nab = "true"\naB = "true"\n', "trials.commands: ab and aB: these names differ only"),
        ),
        (
            '[figures.ab]\ntable = "t"\ncolumn = "c"\nkind = "summary"\n[paper_tables.aB]\nsql = "SELECT 1"\n',
            "[figures.ab] and [paper_tables.aB] would have files of the same name; rename one",
        ),
        (
            '[variables]\nab = "/a"\n[targets.x.outputs.o]\nfile = "o.csv"\n[targets.x.outputs.O]\nfile = "p.csv"\n',
            "outputs.o and outputs.O: these names differ only",
        ),
    ],
)
def test_names_in_other_tables_are_checked_too(text: str, said: str) -> None:
    with pytest.raises(ConfigError) as raised:
        parse(tomllib.loads(text), "sierra.toml")
    assert said in str(raised.value)


def test_variables_are_no_controllers_in_other_letters(recorded: Path, tmp_path: Path) -> None:
    root = stores.copy(recorded, tmp_path / "project")
    with (root / "sierra.toml").open("a") as file:
        file.write('Scenario = "//noise"\n')
    with pytest.raises(ConfigError, match="variable 'Scenario': a scenario is written 'scenario'"):
        sierra.open(root).plan("noise=1")


def test_an_axis_must_differ_from_recorded_ones(recorded: Path, tmp_path: Path) -> None:
    root = stores.copy(recorded, tmp_path / "project")
    path = root / "sierra.toml"
    path.write_text(path.read_text().replace("noise =", "Noise ="))
    with pytest.raises(QueryError, match="'Noise' and the recorded variable 'noise' differ only in upper and lower case"):
        sierra.open(root).run("Noise=0.7", figures=False)
    assert quick(root, "sql", "SELECT DISTINCT noise FROM runs ORDER BY ALL", "--format", "csv").stdout.startswith(
        "noise\n0.5\n"
    )
