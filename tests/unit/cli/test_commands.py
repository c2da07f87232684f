"""The command line as its users see it: output, formats, help, exit codes."""

from __future__ import annotations

import io
import json
import re
import subprocess
from pathlib import Path
from typing import Any

import pytest

from sierra.cli import progress
from tests.projects import CONFIG, SIERRA, make, quick, sierra

COMMANDS = (
    "init",
    "try",
    "run",
    "attach",
    "cancel",
    "replay",
    "ls",
    "show",
    "sql",
    "stats",
    "figures",
    "doctor",
    "schema",
)
RICH = """
[controllers.fast]
changes = [{ set = "//swarm/@controller", value = "fast" }]
[controllers.slow]
changes = [{ set = "//swarm/@controller", value = "slow" }]
[scenarios.wide]
changes = [{ set = "//arena/@size", value = "{population_size * 10}" }]
[scenarios.narrow]
changes = [{ set = "//arena/@size", value = "1" }]
[queries.scalability]
criteria = "population_size.Log2 scenario=wide,narrow"
controller = "fast"
runs = 1
"""
FIGURE = """
[figures.coverage]
kind = "heatmap"
column = "coverage"
"""


@pytest.fixture(scope="module")
def answered(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A project with the results of one query; tests only read it."""
    config = (
        'per_run = { size = [3, 5] }\nrun_changes = [{ set = "//arena/@size", value = "{size + run}" }]\n' + CONFIG + FIGURE
    )
    folder = make(tmp_path_factory.mktemp("answered") / "project", config)
    (folder / "deep").mkdir()
    ended = sierra(folder, "run", "population_size.Log2", "noise=0:1:2", "--json")
    assert ended.returncode == 0
    (folder.parent / "answer.json").write_text(ended.stdout)
    return folder


@pytest.fixture(scope="module")
def answer(answered: Path) -> dict[str, Any]:
    said: dict[str, Any] = json.loads((answered.parent / "answer.json").read_text())
    return said


# help


@pytest.mark.parametrize("command", COMMANDS)
def test_help_shows_examples_but_no_exit_codes_within_80_columns(tmp_path: Path, command: str) -> None:
    said = quick(tmp_path, command, "--help").stdout
    assert re.search(r"\n  Examples?:\n    sierra " + command, said)
    assert "Exit codes:" not in said
    assert "[[" not in said
    assert max(map(len, said.splitlines())) <= 80


def test_help_lists_all_commands_without_truncation(tmp_path: Path) -> None:
    said = quick(tmp_path, "--help").stdout
    assert all(f"\n  {command} " in said for command in COMMANDS)
    assert re.findall(r"^([A-Z]\w+):$", said.partition("--help ")[2], re.MULTILINE) == [
        "Run",
        "Look",
        "Deliver",
        "Share",
        "Keep",
    ]
    assert "..." not in said.partition("\nRun:")[2]
    assert said.count("Exit codes: 0 success;") == 1


@pytest.mark.integration
@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_completion_script_exists_for_each_shell(tmp_path: Path, shell: str) -> None:
    said = sierra(tmp_path, environment={"_SIERRA_COMPLETE": f"source_{shell}"})
    assert "_SIERRA_COMPLETE=complete_" in said.stdout
    assert said.returncode == 0


@pytest.mark.nightly
def test_completion_completes_a_command_name(tmp_path: Path) -> None:
    typed = {"_SIERRA_COMPLETE": "complete_bash", "COMP_WORDS": "sierra ru", "COMP_CWORD": "1"}
    assert sierra(tmp_path, environment=typed).stdout.split() == ["run"]


# run


@pytest.mark.integration
def test_run_prints_one_json_object(answer: dict[str, Any]) -> None:
    assert len(answer["batch"]) == 64
    assert {name: answer[name] for name in ("experiments", "runs", "executed", "reused", "failed")} == {
        "experiments": 4,
        "runs": 8,
        "executed": 8,
        "reused": 0,
        "failed": 0,
    }
    assert all(Path(path).is_file() for path in answer["figures"])
    assert {Path(path).suffix for path in answer["figures"]} == {".png", ".pdf", ".svg", ".txt", ".tex"}


@pytest.mark.integration
def test_repeated_query_from_a_subfolder_executes_nothing(answered: Path, answer: dict[str, Any]) -> None:
    ended = quick(answered / "deep", "run", "population_size.Log2", "noise=0:1:2", "--json", "--no-figures")
    again = json.loads(ended.stdout)
    assert (again["batch"], again["executed"], again["reused"]) == (answer["batch"], 0, 8)
    assert ended.stderr == ""


@pytest.mark.integration
def test_dry_run_reports_how_many_runs_would_execute(answered: Path) -> None:
    said = quick(answered, "run", "-n", "population_size.Log4", "noise=0:1:2")
    assert "4 of 12 runs would execute" in said.stdout
    told = json.loads(quick(answered, "run", "-n", "--explain", "--json", "population_size.Log4", "noise=0:1:2").stdout)
    assert (told["to_execute"], told["reused"]) == (4, 8)
    assert told["new_because"]


@pytest.mark.integration
def test_explain_with_json_prints_one_object(answered: Path) -> None:
    said = quick(answered, "run", "--explain", "--json", "--no-figures", "population_size.Log2", "noise=0:1:2")
    told = json.loads(said.stdout)
    assert (told["reused"], told["reasons"]) == (8, {"reused": 8})


@pytest.mark.nightly
def test_doubled_braces_in_commands_become_literal_braces(tmp_path: Path) -> None:
    folder = make(
        tmp_path / "p", simulator="import sys\nopen('said.csv', 'w').write('words\\n' + ' '.join(sys.argv[2:]) + '\\n')\n"
    )
    words = '["python3", "sim.py", "{input}", "{{output}}", "{\\"a\\":{\\"b\\":1}}"]'
    (folder / "sierra.toml").write_text(CONFIG.replace('"python3 sim.py {input}"', words))
    assert quick(folder, "run", "noise=1", "--runs", "1", "--no-figures").returncode == 0
    [said] = json.loads(quick(folder, "sql", "SELECT words FROM said", "--json").stdout)
    assert said["words"] == '{output} {"a":{"b":1}}'


@pytest.mark.integration
def test_named_queries_apply_their_controller_and_scenarios(tmp_path: Path) -> None:
    simulator = (
        "import sys, xml.etree.ElementTree as ET\n"
        "arena = ET.parse(sys.argv[1]).getroot()\n"
        "open('seen.csv', 'w').write('arena,controller\\n%s,%s\\n'"
        " % (arena.get('size'), arena.find('swarm').get('controller')))\n"
    )
    folder = make(tmp_path / "p", CONFIG + RICH, simulator=simulator)
    assert quick(folder, "run", "scalability", "--no-figures").returncode == 0
    rows = json.loads(
        quick(folder, "sql", "SELECT population_size, scenario, arena, controller FROM seen ORDER BY ALL", "--json").stdout
    )
    assert [tuple(row.values()) for row in rows] == [
        (1, "narrow", 1, "fast"),
        (1, "wide", 10, "fast"),
        (2, "narrow", 1, "fast"),
        (2, "wide", 20, "fast"),
    ]
    more = json.loads(quick(folder, "run", "scalability", "noise=1,2", "-n", "--json").stdout)
    assert (more["query"], more["experiments"]) == ("population_size.Log2 scenario=wide,narrow noise=1,2", 8)
    refused = quick(folder, "run", "scalability", "--scenario", "wide")
    assert (refused.returncode, refused.stdout) == (2, "")
    assert "leave out --scenario wide" in refused.stderr
    refused = quick(folder, "run", "controller=fast,quick")
    assert "unknown controller 'quick'; known are fast, slow" in refused.stderr


def test_set_changes_all_runs_and_is_part_of_the_batch(answered: Path, answer: dict[str, Any]) -> None:
    ask = ("run", "-n", "--json", "population_size.Log2", "noise=0:1:2")
    changed = json.loads(quick(answered, *ask, "--set", "//swarm[@controller='none']/@controller=a=b").stdout)
    assert changed["batch"] != answer["batch"]
    assert changed["to_execute"] == 8


def test_per_run_lists_give_each_run_its_own_value(answered: Path) -> None:
    text = (
        "SELECT DISTINCT number, regexp_extract(decode(content), 'size=.([0-9]+)', 1)::INT AS size "
        "FROM runs JOIN objects ON sha256 = input ORDER BY ALL"
    )
    assert quick(answered, "sql", text, "-f", "csv").stdout == "number,size\n0,3\n1,6\n"


def test_project_may_be_configured_in_pyproject_toml(tmp_path: Path) -> None:
    folder = make(tmp_path / "p")
    (folder / "sierra.toml").unlink()
    text = CONFIG.replace("[variables]", "[tool.sierra.variables]")
    (folder / "pyproject.toml").write_text("[tool.sierra]\n" + text)
    assert json.loads(quick(folder, "run", "-n", "--json", "montecarlo.C3").stdout)["runs"] == 6
    (folder / "pyproject.toml").write_text("[tool.sierra]\nrnus = 3\n" + text)
    refused = quick(folder, "run", "-n", "montecarlo.C3")
    assert "pyproject.toml [tool.sierra]: unknown key 'rnus'; did you mean 'runs'?" in refused.stderr


# read-only commands


@pytest.mark.integration
def test_read_only_commands_can_print_json(answered: Path, answer: dict[str, Any]) -> None:
    [listed] = json.loads(quick(answered, "ls", "--json").stdout)
    assert (listed["batch"], listed["failed"], listed["missing"]) == (answer["batch"], 0, 0)
    shown = json.loads(quick(answered, "show", answer["batch"][:8], "--json").stdout)
    assert len(shown["experiments"]) == 4
    run = json.loads(quick(answered, "sql", "FROM runs LIMIT 1", "--json").stdout)[0]["run"]
    assert json.loads(quick(answered, "show", run.upper(), "--json").stdout)["kind"] == "run"
    assert {check["name"] for check in json.loads(quick(answered, "doctor", "--json").stdout)} >= {"project", "template"}
    assert {table["name"] for table in json.loads(quick(answered, "schema", "--json").stdout)} >= {"runs", "executions"}
    assert json.loads(quick(answered, "schema", "sierra.toml", "--json").stdout)["type"] == "object"


@pytest.mark.integration
def test_ls_and_show_print_tables_by_default(answered: Path, answer: dict[str, Any]) -> None:
    listed = quick(answered, "ls").stdout
    assert answer["batch"][:10] in listed
    assert "complete" in listed
    assert "population_size" in quick(answered, "show", answer["batch"]).stdout


@pytest.mark.nightly
def test_ls_shows_how_batches_of_the_same_query_differ(tmp_path: Path) -> None:
    config = CONFIG + '[controllers.a]\n[[controllers.a.changes]]\nset = "//swarm/@controller"\nvalue = "a"\n'
    folder = make(tmp_path / "p", 'controller = "a"\n' + config + "[controllers.b]\n")
    for words in (
        ("controller=a,b",),
        ("noise=1",),
        ("noise=1", "--set", "//swarm/@count=2"),
        ("noise=1", "--runs", "1"),
    ):
        assert quick(folder, "run", *words, "--no-figures").returncode == 0
    template = folder / "arena.xml"
    template.write_text(template.read_text().replace('size="10"', 'size="20"'))
    assert quick(folder, "run", "noise=1", "--no-figures").returncode == 0
    toml = folder / "sierra.toml"
    toml.write_text('changes = [{ set = "//arena/@size", value = 30 }]\n' + toml.read_text())
    assert quick(folder, "run", "noise=1", "--no-figures").returncode == 0
    listed = json.loads(quick(folder, "ls", "--json").stdout)
    assert [row["controller"] for row in listed] == [None, "a", "a", "a", "a", "a"]
    assert [row["overrides"] for row in listed] == [[], [], ["//swarm/@count=2"], [], [], []]
    assert [row["changed"] for row in listed] == [[], [], [], ["runs"], ["runs", "template"], ["settings"]]
    header, *rows = quick(folder, "ls").stdout.splitlines()
    assert header.split("  ")[0] == "batch"
    assert "changed" in header
    assert "//swarm/@count=2" in rows[2]


@pytest.mark.parametrize(
    ("prefix", "said"),
    [
        ("abc", "'abc' is not an id: use 4 to 64 hexadecimal digits"),
        ("xyzw", "'xyzw' is not an id"),
        ("a'; b", "is not an id"),
        ("", "'' is not an id"),
        ("00000000000", "no batch, experiment, run, execution or study begins with '00000000000'"),
    ],
)
def test_invalid_or_unknown_ids_are_refused_in_one_line(answered: Path, prefix: str, said: str) -> None:
    for command in ("show", "figures"):
        ended = quick(answered, command, prefix)
        assert (ended.returncode, ended.stdout, ended.stderr.count("\n")) == (2, "", 1)
        assert said in ended.stderr


def test_unknown_figure_is_refused_with_a_list_of_known_figures(answered: Path, answer: dict[str, Any]) -> None:
    ended = quick(answered, "figures", answer["batch"], "nope")
    assert ended.returncode == 2
    assert "this batch has no figure 'nope'; its figures: " in ended.stderr


# sql


@pytest.mark.integration
def test_sql_prints_five_formats(answered: Path, tmp_path: Path) -> None:
    import pyarrow.parquet as pq

    ask = "SELECT count(*) AS n, 'a|b' AS t FROM runs"
    assert quick(answered, "sql", ask).stdout.split() == ["n", "t", "8", "a|b"]
    assert quick(answered, "sql", ask, "-f", "csv").stdout == "n,t\n8,a|b\n"
    assert quick(answered, "sql", ask, "-f", "markdown").stdout == "| n | t |\n| --- | --- |\n| 8 | a\\|b |\n"
    assert json.loads(quick(answered, "sql", ask, "--json").stdout) == [{"n": 8, "t": "a|b"}]
    assert quick(answered, "sql", ask, "-f", "parquet", "-o", str(tmp_path / "x")).returncode == 0
    assert pq.read_table(tmp_path / "x").to_pylist() == [{"n": 8, "t": "a|b"}]


def test_columns_with_equal_names_get_distinct_names(answered: Path) -> None:
    ask = "SELECT 6 AS n, 7 AS n, 8 AS n_1, 9 AS n"
    assert quick(answered, "sql", ask, "-f", "csv").stdout == "n,n_2,n_1,n_3\n6,7,8,9\n"
    assert quick(answered, "sql", ask).stdout.split() == ["n", "n_2", "n_1", "n_3", "6", "7", "8", "9"]


def test_json_output_contains_only_valid_json_numbers(answered: Path) -> None:
    said = quick(
        answered, "sql", "SELECT 1/0 AS i, 'nan'::DOUBLE AS n, sum(number) AS s, 1.5::DECIMAL(3,1) AS d FROM runs", "--json"
    )

    def refuse(word: str) -> None:
        raise AssertionError(word)

    assert json.loads(said.stdout, parse_constant=refuse) == [{"i": None, "n": None, "s": 4, "d": 1.5}]


@pytest.mark.parametrize(
    "statement",
    [
        "SELEC 1",
        "SELECT nope FROM runs",
        "SELECT 1; SELECT 2",
        ";",
        "",
        "DROP TABLE runs",
        "COPY (SELECT 1) TO 'stolen.csv'",
        "EXPLAIN ANALYZE COPY (SELECT 1) TO 'stolen.csv'",
        "ATTACH 'stolen.csv'",
        "SET enable_external_access = true",
        "SELECT * FROM read_text('/etc/passwd')",
        "FROM '/etc/passwd'",
        "FROM glob('/etc/*')",
        "SELECT $a",
    ],
)
def test_sql_refuses_statements_that_write_or_read_outside_the_store(answered: Path, statement: str) -> None:
    ended = quick(answered, "sql", statement)
    assert (ended.returncode, ended.stdout, ended.stderr.count("\n")) == (2, "", 1)
    assert not (answered / "stolen.csv").exists()


def test_sql_reads_statements_from_a_pipe(answered: Path) -> None:
    assert sierra(answered, "sql", "-", "-f", "csv", stdin="SELECT 1 AS a\n").stdout == "a\n1\n"
    assert sierra(answered, "sql", "-").returncode == 2
    ended = sierra(answered, "sql", stdin="SELECT 1 AS a;\nSELECT nope;\n\nSELECT\n2 AS b")
    assert (ended.stdout, ended.returncode) == ("a\n1\n", 2)
    assert '"nope"' in ended.stderr


@pytest.mark.integration
def test_closed_output_pipe_is_not_an_error(answered: Path) -> None:
    with subprocess.Popen(
        [SIERRA, "sql", "FROM range(1000000)", "-f", "csv"], cwd=answered, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    ) as asking:
        assert asking.stdout is not None
        assert asking.stderr is not None
        assert asking.stdout.readline() == b"range\n"
        asking.stdout.close()
        assert asking.stderr.read() == b""
    assert asking.returncode == 0


# doctor


@pytest.mark.nightly
def test_user_settings_apply_to_all_projects_and_can_be_overridden(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    file = tmp_path / "config" / "sierra" / "config.toml"
    file.parent.mkdir(parents=True)
    file.write_text("jobs = 1\nfigures = false\n")
    folder = make(tmp_path / "p")

    def slots(noise: int, *words: str) -> int:
        said = json.loads(quick(folder, "run", f"noise={noise}", "--runs", "1", "--json", *words).stdout)
        assert said["figures"] == []
        rows = quick(folder, "sql", f"SELECT slots FROM sessions WHERE query = 'noise={noise}'", "--json").stdout
        return int(json.loads(rows)[0]["slots"])

    assert slots(1) == 1
    monkeypatch.setenv("SIERRA_JOBS", "3")
    assert slots(2) == 3
    assert slots(3, "-j", "2") == 2
    monkeypatch.setenv("SIERRA_JOBS", "several")
    refused = quick(folder, "run", "noise=4")
    assert (refused.returncode, refused.stderr.count("\n")) == (2, 1)
    assert "SIERRA_JOBS='several': should be a valid integer" in refused.stderr
    file.write_text("job = 1\n")
    assert "unknown key 'job'; did you mean 'jobs'?" in quick(folder, "run", "noise=4").stderr


@pytest.mark.nightly
def test_doctor_works_outside_and_inside_a_project(tmp_path: Path) -> None:
    outside = {check["name"]: check["state"] for check in json.loads(quick(tmp_path, "doctor", "--json").stdout)}
    assert outside["project"] == "absent"
    folder = make(tmp_path / "p", CONFIG.replace("python3", "no-such-program"))
    ended = quick(folder, "doctor")
    assert ended.returncode == 3
    assert re.search(r"^missing +command: .*no-such-program", ended.stdout, re.MULTILINE)


def test_output_has_no_colour_without_a_terminal(answered: Path) -> None:
    for words in (["ls"], ["--help"], ["run", "population_size.Log2", "noise=0:1:2", "--no-figures"]):
        ended = sierra(answered, *words, environment={"FORCE_COLOR": "", "NO_COLOR": "1"})
        assert "\x1b" not in ended.stdout + ended.stderr


# completion of names of a project


@pytest.mark.parametrize(
    ("words", "found"),
    [
        ("sierra show ", "{batch}"),
        ("sierra sql -b ", "{batch}"),
        ("sierra run pop", "population_size."),
        ("sierra stats ", "swarm"),
    ],
)
def test_completion_offers_ids_variables_and_tables(answered: Path, answer: dict[str, Any], words: str, found: str) -> None:
    typed = {
        "_SIERRA_COMPLETE": "complete_bash",
        "COMP_WORDS": words,
        "COMP_CWORD": str(len(words.split()) - (not words.endswith(" "))),
    }
    assert found.format(batch=answer["batch"][:10]) in sierra(answered, environment=typed).stdout.split()


@pytest.mark.parametrize("words", ["sierra show ", "sierra run x", "sierra stats "])
def test_completion_is_silent_if_the_project_file_is_invalid(tmp_path: Path, words: str) -> None:
    (tmp_path / "sierra.toml").write_text("no TOML")
    typed = {"_SIERRA_COMPLETE": "complete_bash", "COMP_WORDS": words, "COMP_CWORD": "2"}
    said = sierra(tmp_path, environment=typed)
    assert (said.stdout.split(), said.stderr) == ([], "")


@pytest.mark.integration
def test_montecarlo_without_count_is_refused_with_a_working_example(answered: Path) -> None:
    said = quick(answered, "run", "montecarlo", "-n")
    assert said.returncode == 2
    assert "montecarlo.C20" in said.stderr
    assert quick(answered, "run", "montecarlo.C20", "-n").returncode == 0


def test_ids_are_short_and_tables_fit_on_a_terminal(
    answered: Path, answer: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    statement = ("sql", "SELECT run, execution FROM executions LIMIT 1")
    assert max(map(len, quick(answered, *statement).stdout.split())) == 64, "files and pipes get all of them"

    class Terminal(io.TextIOWrapper):
        def isatty(self) -> bool:
            return True

    monkeypatch.setattr("io.TextIOWrapper", Terminal)
    monkeypatch.setenv("COLUMNS", "80")
    assert max(map(len, quick(answered, *statement).stdout.split())) == 10
    assert '"run": "' in quick(answered, *statement, "--json").stdout
    said = quick(answered, "show", answer["batch"]).stdout
    table = said.partition("\nsessions:\n")[2].partition("\n\n")[0].splitlines()
    assert max(map(len, table)) <= 80
    assert "in --json)" in table[-1]
    spec = said.partition("\nspec:\n")[2].partition("\n\n")[0].splitlines()
    assert max(len(line) for line in spec if len(line.split()) > 2) <= 80
    assert any(line.startswith(" " * 13 + '"') for line in spec), "a long value goes on below its beginning"


# many runs


@pytest.mark.integration
@pytest.mark.parametrize("how", [("-n",), ("--json", "-n"), ()])
def test_very_many_runs_are_refused_without_yes(answered: Path, how: tuple[str, ...]) -> None:
    said = quick(answered, "run", "noise=0:1:500000", *how)
    assert said.returncode == 2
    assert "500000 experiments are 1000000 runs" in said.stderr
    assert "--yes" in said.stderr


@pytest.mark.integration
def test_planning_progress_is_reported_except_with_json(answered: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(progress, "FIRST_S", 0.0)
    monkeypatch.setattr(progress, "MANY", 5)
    said = quick(answered, "run", "noise=0:1:4", "-n", "--yes")
    assert said.returncode == 0
    assert "planning: 3 of 4 experiments" in said.stderr
    assert "planning" not in quick(answered, "run", "noise=0:1:4", "-n", "--json", "--yes").stderr
