"""Derived tables (`[tables.NAME]`): SQL sees them like outputs, and nothing that they must not do is possible."""

from __future__ import annotations

from pathlib import Path

import pytest

import sierra
from sierra.cli import complete
from sierra.errors import SierraError
from tests import projects, stores

TABLES = {
    "ends": "SELECT run, max(coverage) AS most, max(coverage) > 5 AS good FROM swarm GROUP BY run",
    "halves": "SELECT run, tick, most / 2 AS half FROM swarm JOIN Ends USING (run)",
    "ordered": "SELECT tick, number FROM swarm ORDER BY tick DESC, number, run; -- the last first",
    "numbers": "WITH RECURSIVE n AS (SELECT 1 AS i UNION ALL SELECT i + 1 FROM n WHERE i < 3) FROM n",
    "shadow": "WITH swarm AS (SELECT run, tick FROM swarm WHERE tick = 0) FROM swarm",
    "empty": "SELECT run FROM swarm WHERE tick < 0",
}
WRONG = {
    "SELEC 1": 'syntax error at or near "SELEC" (line 1, column 1)',
    "SELECT run,\n  tick FROM swarm WHERE ) 1": "(line 2, column 25)",
    "SELECT 1; SELECT 2": "use one statement",
    "COPY swarm TO 'x.csv'": "COPY statements are not allowed; use SELECT",
    "INSERT INTO swarm VALUES (1)": "INSERT statements are not allowed",
    "ATTACH 'x.db'": "ATTACH statements are not allowed",
    "INSTALL httpfs": "not allowed",
    "SET threads = 8": "SET statements are not allowed",
    "FROM read_csv('/etc/passwd')": "read_csv() is not allowed",
    "FROM read_text('/etc/passwd')": "read_text() is not allowed",
    "FROM glob('/*')": "glob() is not allowed",
    "FROM '/etc/passwd.csv'": "there is no table",
    "FROM read_parquet('https://example.org/x.parquet')": "read_parquet() is not allowed",
    "FROM query('SELECT random()')": "query() is not allowed",
    "FROM enable_logging()": "enable_logging() is not allowed",
    "FROM duckdb_settings()": "duckdb_settings() is not allowed",
    "FROM information_schema.tables": "without a schema",
    "SELECT now() AS t": "now() gives another value each time",
    "SELECT *, current_timestamp AS t FROM swarm": "gives another value each time",
    "SELECT *, localtime AS t FROM swarm": "gives another value each time",
    "SELECT today() AS t": "today() gives another value each time",
    "SELECT ago(INTERVAL 1 day) AS t": "gives another value each time",
    "SELECT age(started) AS t FROM executions": "age() gives another value each time",
    "SELECT run FROM swarm WHERE (SELECT random()) < 2": "random() gives another value each time",
    "SELECT list_transform([1], lambda x: uuid()) AS t": "uuid() gives another value each time",
    "FROM swarm USING SAMPLE 5": "a sample without a seed",
    "FROM (FROM swarm) TABLESAMPLE 50%": "a sample without a seed",
    "FROM swrm": "there is no table 'swrm'; did you mean 'swarm'?",
    "SELECT covrage FROM swarm": '"coverage"',
    "FROM x": "x → x: a table cannot be made from itself",
    "FROM other": "cannot be made from itself",
    "SELECT error('no') FROM swarm": "no",
}
ALLOWED = [
    "SELECT age(ended, started) AS t FROM executions",
    "FROM swarm USING SAMPLE reservoir(5 ROWS) REPEATABLE (1)",
    "SELECT unnest(range(3)) AS i",
    "FROM swarm, range(2) AS r(i)",
    "PIVOT swarm ON tick IN (0, 1) USING max(coverage) GROUP BY run",
    "SELECT run, arg_max(coverage, tick) AS c, user AS u FROM swarm GROUP BY ALL",
]
ENDLESS = [
    "SELECT count(*) AS n FROM range(1000000000000000) a, range(1000000000000) b",
    "WITH RECURSIVE n AS (SELECT 1 AS i UNION ALL SELECT i FROM n) FROM n",
    "FROM range(1000000000000000)",
]


def declared(tables: dict[str, str], rest: str = "") -> str:
    return projects.CONFIG + "".join(f"[tables.{name}]\nsql = '''{sql}'''\n" for name, sql in tables.items()) + rest


@pytest.fixture(scope="module")
def root(recorded: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return stores.copy(recorded, tmp_path_factory.mktemp("derived") / "project")


def opened(root: Path, tables: dict[str, str], rest: str = "") -> sierra.Project:
    (root / "sierra.toml").write_text(declared(tables, rest))
    return sierra.open(root)


@pytest.mark.integration
def test_a_derived_table_is_a_table_in_sql(root: Path) -> None:
    project = opened(root, TABLES)
    batch = project.batches[0].batch
    rows = project.sql("SELECT most, good FROM ends ORDER BY most", within=batch).to_pylist()
    assert (
        rows
        == project.sql(
            "SELECT max(coverage) AS most, max(coverage) > 5 AS good FROM swarm GROUP BY run ORDER BY most", within=batch
        ).to_pylist()
    )
    assert len(rows) == 4
    assert project.sql("SELECT count(*) AS n FROM ends").to_pylist()[0]["n"] > 4
    assert project.sql("SELECT DISTINCT half * 2 = most AS same FROM halves JOIN ends USING (run)").to_pylist() == [
        {"same": True}
    ]
    assert project.frame("numbers").i.tolist() == [1, 2, 3]
    assert project.sql("SELECT count(*) AS n FROM shadow", within=batch).to_pylist() == [{"n": 4}]


@pytest.mark.integration
def test_rows_are_in_the_order_of_the_statement_or_else_sorted(root: Path) -> None:
    project = opened(root, TABLES)
    ordered = project.sql("FROM ordered", within=project.batches[0].batch).to_pylist()
    assert [row["tick"] for row in ordered] == sorted((row["tick"] for row in ordered), reverse=True)
    runs = project.sql("FROM ends").column("run").to_pylist()
    assert runs == sorted(runs)


@pytest.mark.integration
def test_all_derived_tables_are_listed_and_those_that_cannot_be_made_are_named(root: Path) -> None:
    opened(root, {**TABLES, "wrong": "FROM swrm", "endless": ENDLESS[0]})
    listed = projects.quick(root, "sql", "SHOW TABLES")
    assert listed.returncode == 0, listed.stderr
    assert {*TABLES, "endless", "swarm"} <= set(listed.stdout.split())
    assert listed.stderr.count("\n") == 1
    assert "[tables.wrong]: there is no table 'swrm'" in listed.stderr
    described = projects.quick(root, "sql", "DESCRIBE ends", "--format", "csv")
    assert "most,DOUBLE" in described.stdout


@pytest.mark.parametrize("sql", WRONG)
def test_what_a_derived_table_must_not_do_is_one_line(root: Path, sql: str) -> None:
    opened(root, {"x": sql, "other": "FROM x", "fine": "SELECT 1 AS one"})
    done = projects.quick(root, "sql", "FROM x")
    assert (done.returncode, done.stderr.count("\n"), done.stdout) == (2, 1, ""), done.stderr
    assert "[tables." in done.stderr
    assert WRONG[sql] in done.stderr
    assert projects.quick(root, "sql", "FROM fine").returncode == 0


@pytest.mark.parametrize("sql", ALLOWED)
def test_what_is_the_same_each_time_is_allowed(root: Path, sql: str) -> None:
    project = opened(root, {"x": sql})
    assert project.sql("FROM x").equals(project.sql("FROM x"))


@pytest.mark.parametrize("sql", ENDLESS)
def test_a_statement_that_never_ends_is_ended(root: Path, sql: str) -> None:
    opened(root, {"x": sql, "fine": "SELECT 1 AS one"}, "[sql]\nwall = 0.2\n")
    done = projects.quick(root, "sql", "FROM x")
    assert (done.returncode, done.stderr.count("\n")) == (1, 1)
    assert "[tables.x]: the statement did not end within 0.2 s" in done.stderr


def test_the_limits_hold_without_derived_tables(root: Path) -> None:
    figure = f"[figures.x]\nkind = 'bar'\nsql = '{ENDLESS[0]}'\nx = 'n'\n"
    opened(root, {}, f"{figure}[sql]\nwall = 0.2\n")
    done = projects.quick(root, "figures", "x")
    assert done.returncode == 1
    assert "did not end within 0.2 s" in done.stderr


def test_a_statement_that_needs_too_much_memory_is_ended(root: Path) -> None:
    project = opened(root, {"x": "SELECT list(range) AS l FROM range(1000000000)"}, '[sql]\nmemory = "100 MB"\n')
    with pytest.raises(SierraError, match=r"out of memory: the statements of a command have 0\.1 GB"):
        project.sql("FROM x")
    threads, limit = "current_setting('threads')", "current_setting('memory_limit')"
    after, fresh = (one.sql(f"SELECT {threads}, {limit}").to_pylist() for one in (project, sierra.open(root)))
    assert after == fresh


def test_a_statement_in_a_file_is_read_and_is_no_source_of_runs(root: Path) -> None:
    before = sierra.open(root).plan("population_size=1,2").batch.id
    (root / "ends.sql").write_text(TABLES["ends"])
    (root / "sierra.toml").write_text(projects.CONFIG + '[tables.ends]\nfile = "ends.sql"\n[tables.none]\nfile = "no.sql"\n')
    project = sierra.open(root)
    assert project.sql("FROM ends").num_rows > 4
    assert project.plan("population_size=1,2").batch.id == before
    done = projects.quick(root, "sql", "FROM none")
    assert (done.returncode, done.stderr) == (
        2,
        "sierra: [tables.none]: cannot read no.sql: No such file or directory\n",
    )
    (root / "ends.sql").unlink()


@pytest.mark.parametrize(
    ("rest", "expected"),
    [
        ("[tables.runs]\nsql = 'SELECT 1'\n", "tables.runs: SIERRA's own table has this name"),
        ("[tables.Swarm]\nsql = 'SELECT 1'\n[outputs.swarm]\nfile = 'swarm.csv'\n", "tables.Swarm: an output has this name"),
        ("[tables.x]\nsql = 'SELECT 1'\n[tables.X]\nsql = 'SELECT 1'\n", "tables.x and tables.X: these names differ only"),
        ("[tables.x]\nfile = '../x.sql'\n", "within the project"),
        ("[tables.x]\n", 'give either "sql" or "file"'),
        ("[tables.x]\nsql = 'SELECT 1'\n[sql]\nwall = 0\n", "sql.wall"),
    ],
)
def test_wrong_declarations_are_one_line(root: Path, rest: str, expected: str) -> None:
    (root / "sierra.toml").write_text(projects.CONFIG + rest)
    done = projects.quick(root, "sql", "FROM swarmm")
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert expected in done.stderr


def test_a_name_that_an_output_has_is_refused(root: Path) -> None:
    opened(root, {"Notes": "SELECT 1 AS one", "x": "FROM swarm"})
    expected = "[tables.Notes]: runs have written an output 'notes'; use another name"
    listed, asked = (projects.quick(root, "sql", text) for text in ("SHOW TABLES", "FROM notes"))
    assert (listed.returncode, asked.returncode) == (0, 2)
    assert expected in listed.stderr
    assert expected in asked.stderr
    assert projects.quick(root, "sql", "FROM swarm").returncode == 0


def test_sql_of_users_cannot_call_functions_that_act(root: Path) -> None:
    for function in ("enable_logging", "enable_profiling", "checkpoint", "query"):
        done = projects.quick(root, "sql", f"FROM {function}('SELECT 1')")
        assert (done.returncode, done.stderr.count("\n")) == (2, 1)
        assert f"{function}() is not allowed" in done.stderr


def test_names_of_derived_tables_are_completed(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    opened(root, {"ends": TABLES["ends"]})
    monkeypatch.chdir(root)
    assert complete.tables("") == ["ends", "notes", "swarm"]
