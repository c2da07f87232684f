"""The explorer's table of runs, and the details and comparisons of runs, as far as the server can tell."""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

import sierra
from sierra.cli import diff, why
from sierra.deliverables.report.make import ReportSource
from sierra.extensions.explorer import explorer, run_details
from sierra.extensions.explorer.answers import Answers
from sierra.extensions.explorer.run_table import WINDOW
from sierra.extensions.explorer.server import Server
from tests import large_stores, projects, stores
from tests.extensions.explorer.page import Page, served
from tests.support.reported import ATTACK
from tests.waiting import PATIENCE_S, until

ENDLESS = "list_sum(list_transform(range(100000 + number), lambda x: list_sum(range(100000 + x)))) > 0"
SLOW = projects.SIMULATOR + "import pathlib, time\nwhile seed % 2 and not pathlib.Path('GO').exists():\n    time.sleep(0.05)\n"
FAILING = projects.SIMULATOR + "import sys\nprint(seed, file=sys.stderr)\nsys.exit(count == 2)\n"
MEMBERS = "SELECT b.batch, experiment, run FROM batch_runs JOIN experiments USING (batch, ordinal) JOIN batches b USING (batch)"


@pytest.fixture(scope="module")
def page(recorded: Path) -> Iterator[Page]:
    with served(explorer(sierra.open(recorded))) as page:
        yield page


@pytest.fixture(scope="module")
def run(page: Page) -> str:
    return str(page.ask("runs")["rows"][0][0])


def test_all_runs_of_all_batches_are_listed_the_newest_batch_first(page: Page, recorded: Path) -> None:
    found = page.ask("runs", columns=["batch", "experiment", "status"])
    project = sierra.open(recorded)
    expected = {(row["run"], row["batch"], row["experiment"], "ok") for row in project.store.rows(MEMBERS)}
    assert {tuple(row) for row in found["rows"]} == expected
    assert (found["total"], found["counts"], found["executing"]) == (len(found["rows"]), {"ok": len(found["rows"])}, 0)
    assert list(dict.fromkeys(row[1] for row in found["rows"])) == [one.batch for one in reversed(project.batches)]


def test_the_columns_are_those_of_runs_variables_and_outputs(page: Page) -> None:
    found = page.ask("columns")
    assert found["variables"] == ["population_size", "noise"]
    assert {"run", "batch", "experiment", "number", "seed", "status", "outcome", "reason", "wall_s"} <= set(found["own"])
    assert found["outputs"]["swarm"] == ["tick", "coverage"]
    assert found["curve"] == "swarm.coverage"


def test_final_values_are_those_of_the_last_time(page: Page, recorded: Path) -> None:
    found = page.ask("runs", columns=["swarm.coverage"])
    last = sierra.open(recorded).store.rows("SELECT run, arg_max(coverage, tick) AS last FROM swarm GROUP BY run")
    assert dict(found["rows"]) == {row["run"]: row["last"] for row in last}


LAST = (
    projects.SIMULATOR
    + """with open("last.csv", "w") as file:
    file.write("tick,missing,there\\n1,5,5\\n2,,6\\n")
with open("twice.csv", "w") as file:
    file.write("tick,value\\n1,5\\n2,6\\n2,7\\n")
"""
)
ODD = (
    projects.SIMULATOR
    + """for name, text in {
    "a": "coverage,seconds\\n1,0.5\\n2,0.9\\n3,0.1\\n",
    "c": "when,value\\n00:00:10,1\\n00:00:30,3\\n00:00:20,2\\n",
    "e": "value,t\\n5,true\\n",
    "g": "time,value\\n1,5\\n3,7\\n2,6\\n",
}.items():
    with open(name + ".csv", "w") as file:
        file.write(text)
"""
)
ODD_OUTPUTS = "".join(
    f'[outputs.{name}]\nfile = "{name}.csv"\ntime_order = "any"\n{time}'
    for name, time in {"a": "", "c": 'time = "when"\n', "e": "", "g": ""}.items()
)


@pytest.mark.integration
def test_a_final_value_is_that_of_statistics_or_missing(tmp_path: Path) -> None:
    root = projects.make(tmp_path / "project", projects.CONFIG + ODD_OUTPUTS, simulator=ODD)
    stores.ask(root, "population_size=1", runs=1)
    expected = {"a.coverage": 3, "c.value": None, "e.value": 5, "g.value": 7}
    with served(explorer(sierra.open(root))) as page:
        found = page.ask("runs", columns=list(expected))
        assert dict(zip(found["columns"], found["rows"][0][1:], strict=True)) == expected
    for column, value in expected.items():
        answer = projects.quick(root, "stats", *column.split("."), "--measure", "final", "--json")
        [row] = json.loads(answer.stdout)
        assert value in (None, row["mean"]), column


OUTPUTS = """
[outputs.last]
file = "last.csv"
time = "tick"
[outputs.w]
file = "twice.csv"
time = "tick"
"""


@pytest.mark.integration
def test_a_final_value_is_that_of_one_row_or_missing(tmp_path: Path) -> None:
    root = projects.make(tmp_path / "project", projects.CONFIG + OUTPUTS, simulator=LAST)
    stores.ask(root, "population_size=1", runs=1)
    with served(explorer(sierra.open(root))) as page:
        found = page.ask("runs", columns=["last.missing", "last.there", "w.value", "swarm.tick"])
        assert [row[1:] for row in found["rows"]] == [[None, 6, None, 4]], "as in statistics, which refuse `w`"
        runs = [*(row[0] for row in found["rows"]), *another_run(page, root)]
        assert "as their mean" in page.ask("curves", runs=runs, column="w.value")["section"]
        assert "as their mean" not in page.ask("curves", runs=runs, column="last.there")["section"]


def another_run(page: Page, root: Path) -> list[str]:
    """Execute one run more; return its id."""
    known = {row[0] for row in page.ask("runs")["rows"]}
    stores.ask(root, "population_size=2", runs=1)
    return [row[0] for row in page.ask("runs")["rows"] if row[0] not in known]


@pytest.mark.parametrize("order", ["swarm.coverage", "wall_s", "batch", "noise", "started"])
@pytest.mark.parametrize("descending", [True, False])
def test_rows_are_sorted_by_any_column(page: Page, order: str, descending: bool) -> None:
    values = [row[1] for row in page.ask("runs", columns=[order], order=order, descending=descending)["rows"]]
    known = [value for value in values if value is not None]
    assert values == [*sorted(known, reverse=descending), *[None] * (len(values) - len(known))], "NULL is last"


@pytest.mark.parametrize(
    ("where", "check"),
    [
        ("population_size = 2", lambda size, coverage: size == 2),
        ('swarm.coverage > 12 OR "SWARM".coverage < 9', lambda size, coverage: coverage > 12 or coverage < 9),
        ("population_size IS NULL -- a comment", lambda size, coverage: size is None),
    ],
)
def test_a_condition_selects_rows(page: Page, where: str, check: Any) -> None:
    columns = ["population_size", "swarm.coverage", "batch"]
    every, found = page.ask("runs", columns=columns)["rows"], page.ask("runs", columns=columns, where=where)
    assert found["rows"] == [row for row in every if check(*row[1:3])]
    assert 0 < found["total"] == len(found["rows"]) < len(every)


def test_a_window_is_a_part_of_the_list(page: Page) -> None:
    every = page.ask("runs", order="wall_s")["rows"]
    assert page.ask("runs", order="wall_s", first=5)["rows"] == every[5:]
    assert page.ask("runs", order="wall_s", first=-3)["rows"] == every
    assert page.ask("runs", first=10**15)["rows"] == []


@pytest.mark.parametrize(
    "where",
    [
        "population_size >",
        "nothing = 1",
        "coverage > 1",
        "coverage > 1 AND swarm.tick > 0",
        "true) GROUP BY ALL --",
        "(SELECT count(*) FROM batches) > 1",
        "EXISTS (SELECT * FROM read_csv('/etc/passwd'))",
        "random() > 0.5",
        "true; DROP TABLE executions",
        "getenv('HOME') <> ''",
        "'\ud800' = run",
    ],
)
def test_a_condition_can_only_use_columns(page: Page, where: str) -> None:
    assert page.error("runs", where=where)
    assert page.ask("runs")["total"] > 0, "the table is still there"


@pytest.mark.parametrize("content", [{"columns": ["nothing"]}, {"order": "1; DROP"}, {"order": 'run" DESC --'}])
def test_an_unknown_column_is_named(page: Page, content: dict[str, Any]) -> None:
    assert "there is no column" in page.error("runs", **content)


def test_a_condition_that_takes_too_long_is_ended(recorded: Path) -> None:
    project = sierra.open(recorded)
    answers = Answers(lambda: ReportSource(project.loaded, project.store), project.store)
    with served(Server(answers, "project")) as page:
        page.ask("columns")
        answers._wall = 0.2
        assert page.error("runs", where=ENDLESS).startswith("no answer within 0.2 s")
        answers._wall = 60.0
        assert page.ask("runs")["total"] > 0
        assert "emory" in page.error("runs", where="len(repeat('x', 4000000000)) > number")
        assert page.ask("runs")["total"] > 0


def test_a_condition_is_stopped(recorded: Path) -> None:
    with served(explorer(sierra.open(recorded))) as page:
        page.ask("columns")
        said: list[str] = []
        asking = threading.Thread(target=lambda: said.append(page.error("runs", where=ENDLESS)))
        asking.start()
        while asking.is_alive():
            page.ask("stop")
            asking.join(0.05)
        assert said == ["stopped"]


def test_details_are_those_of_the_commands(page: Page, recorded: Path, run: str) -> None:
    project = sierra.open(recorded)
    found = page.ask("run", run=run)
    shown = project.records.show(run).as_dict()
    assert (found["kind"], found["run"], found["status"], found["seed"]) == ("run", run, "ok", shown["seed"])
    assert [one["execution"] for one in found["executions"]] == [one.execution for one in project.records.show(run).executions]  # type: ignore[union-attr]
    listed = project.records.files(run).files  # type: ignore[union-attr]
    assert [(one["path"], one["kind"], one["bytes"]) for one in found["files"]] == [(f.path, f.kind, f.bytes) for f in listed]
    assert page.ask("why", run=run) == list(why.lines(project.records.why(run)))


def test_a_file_is_shown_as_text_and_its_path_opens_nothing(page: Page, run: str) -> None:
    found = page.ask("file", run=run, path="input/input.xml")
    assert "<arena" in found["text"]
    assert (found["shown"], found["command"]) == (found["bytes"], f"sierra show {run[:10]} input/input.xml")
    for path in ("/etc/passwd", "../../sierra.toml", "input/../../x", "*", ""):
        assert "no recorded file" in page.error("file", run=run, path=path)


def test_a_large_file_is_cut_or_refused(page: Page, run: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(run_details, "SHOWN", 10)
    found = page.ask("file", run=run, path="output/picture.bin")
    assert (found["shown"], found["bytes"], len(found["text"]) <= 40) == (10, 10_000, True)
    monkeypatch.setattr(run_details, "LARGEST", 100)
    assert "sierra show" in page.error("file", run=run, path="output/picture.bin")


@pytest.mark.parametrize("question", ["run", "why"])
def test_another_record_or_an_unknown_run_is_refused(page: Page, recorded: Path, question: str) -> None:
    assert page.error(question, run="0123456789")
    assert page.error(question, run="; DROP")
    if question == "run":
        assert "a run is required" in page.error(question, run=sierra.open(recorded).batches[0].batch)


def test_runs_are_compared_as_by_the_command(page: Page, recorded: Path) -> None:
    first, second, third = (row[0] for row in page.ask("runs", where="noise IS NULL", order="run")["rows"][:3])
    found = page.ask("differ", runs=[first, second, third])
    project = sierra.open(recorded)
    assert [one["run"] for one in found] == [second, third]
    assert found[0]["lines"] == list(diff.lines(project.records.diff(first, second)))


def test_curves_have_the_values_of_each_run(page: Page, recorded: Path) -> None:
    runs = [row[0] for row in page.ask("runs", where="noise IS NULL", order="run")["rows"]]
    first, second = list(dict.fromkeys(runs))[:2]
    section = page.ask("curves", runs=[second, first], column="swarm.coverage")["section"]
    data = json.loads(section.partition('type="application/json">')[2].partition("</script>")[0])
    rows = sierra.open(recorded).store.rows("SELECT run, tick, coverage FROM swarm ORDER BY tick")
    values = [[row[name] for run in (second, first) for row in rows if row["run"] == run] for name in ("tick", "coverage")]
    assert data["tables"][0]["columns"][1:] == values
    assert [one["name"][:10] for one in data["charts"][0]["series"]] == [second[:10], first[:10]]


@pytest.mark.parametrize(("question", "more"), [("curves", {"column": "swarm.coverage"}), ("differ", {})])
def test_only_a_few_runs_are_compared(page: Page, run: str, question: str, more: dict[str, str]) -> None:
    for runs in ([run], [run, run], [f"{number:064x}" for number in range(9)]):
        assert "choose 2 to 8 runs" in page.error(question, runs=runs, **more)
    others = ["0" * 64, "1" * 64]
    if question == "curves":
        assert "Runs without values" in page.ask(question, runs=others, **more)["section"]
        assert "no column" in page.error(question, runs=others, column="swarm.x; DROP")
        assert "no column of an output" in page.error(question, runs=others, column="status")
    else:
        assert page.error(question, runs=others)


QUESTIONS: dict[str, dict[str, Any]] = {
    "columns": {},
    "runs": {},
    "run": {"run": "0000"},
    "file": {"run": "0000", "path": "x"},
    "why": {"run": "0000"},
    "curves": {"runs": ["0000"], "column": "x"},
    "differ": {"runs": ["0000"]},
}


@pytest.mark.parametrize("question", QUESTIONS)
@pytest.mark.parametrize(
    "change",
    [{"X_Sierra_Token": ""}, {"X_Sierra_Token": "x" * 43}, {"Origin": "http://evil.example"}, {"Host": "evil.example"}],
    ids=str,
)
def test_each_question_is_answered_to_the_page_only(page: Page, question: str, change: dict[str, str]) -> None:
    status, body, headers = page.send("POST", f"/ask/{question}", json.dumps(QUESTIONS[question]).encode(), **change)
    assert (status, list(json.loads(body)), headers["Cache-Control"]) == (403, ["error"], "no-store")
    assert page.send("GET", f"/ask/{question}")[0] == 404


@pytest.mark.parametrize("question", QUESTIONS)
@pytest.mark.parametrize(
    "body", [b"", b"[]", b"{", b'{"more": ""}', b'{"runs": 1, "run": 1, "where": 1}', b"[" * 100_000, b"\xff"]
)
def test_nonsense_is_answered_in_one_line(page: Page, question: str, body: bytes) -> None:
    status, answer, _ = page.send("POST", f"/ask/{question}", body)
    assert status == 400
    assert "\n" not in json.loads(answer)["error"]


def test_nothing_is_changed_and_nobody_is_hindered(recorded: Path, run: str, page: Page) -> None:
    before = stores.state(recorded)
    page.ask("runs", columns=["swarm.coverage"], where="number = 0")
    page.ask("run", run=run)
    page.ask("why", run=run)
    assert stores.state(recorded) == before


@pytest.mark.integration
@pytest.mark.parametrize("name", ["place", "wall_s", "reason", "swarm"])
def test_a_variable_may_have_the_name_of_another_column(tmp_path: Path, name: str) -> None:
    root = projects.make(tmp_path / "project", projects.CONFIG.replace("population_size", name))
    stores.ask(root, f"{name}=1,2", runs=1)
    with served(explorer(sierra.open(root))) as page:
        shown = page.ask("columns")["default"]
        found = page.ask("runs", columns=shown, where=f"{name} = 2" if name != "swarm" else "runs.swarm = 2")
        assert [dict(zip(["run", *shown], row, strict=True))[name] for row in found["rows"]] == [2]


@pytest.mark.integration
def test_hostile_texts_stay_texts(tmp_path: Path) -> None:
    simulator = projects.SIMULATOR + f"import sys\nprint({ATTACK!r}, file=sys.stderr)\nsys.exit(3)\n"
    root = projects.make(tmp_path / "project", simulator=simulator)
    stores.ask(root, "population_size=1", runs=2)
    with served(explorer(sierra.open(root))) as page:
        found = page.ask("runs", columns=["status", "reason"])
        assert [row[1] for row in found["rows"]] == ["failed", "failed"]
        run = found["rows"][0][0]
        assert ATTACK.splitlines()[0] in page.ask("run", run=run)["executions"][0]["log_tail"]
        assert ATTACK in page.ask("file", run=run, path="stderr")["text"]


@pytest.mark.integration
def test_runs_appear_while_a_batch_executes(tmp_path: Path) -> None:
    root = projects.make(tmp_path / "project", simulator=SLOW.replace("GO", str(tmp_path / "go")))
    running = projects.start(root, "run", "population_size=1,2", "--runs", "4", "--no-figures", "-j2", stdout=None, stderr=None)
    try:
        until(lambda: any((root / ".sierra" / "segments").iterdir()), "the batch is recorded")
        with served(explorer(sierra.open(root))) as page:
            until(lambda: page.ask("runs", columns=["status"])["executing"] > 0, "runs are being executed")
            found = page.ask("runs", columns=["status"])
            assert found["total"] == 8
            assert set(found["mine"]) <= {row[0] for row in found["rows"] if row[1] == "missing"}
            (tmp_path / "go").touch()
            assert running.wait(PATIENCE_S) == 0
            done = page.ask("runs", columns=["status"])
            assert (done["counts"], done["executing"], done["mine"]) == ({"ok": 8}, 0, [])
            assert done["state"] != found["state"]
    finally:
        (tmp_path / "go").touch()
        running.wait(PATIENCE_S)


@pytest.mark.nightly
def test_a_million_runs_are_sorted_filtered_and_shown_in_windows(tmp_path: Path) -> None:
    root = projects.make(tmp_path / "project")
    large_stores.grow(root, stores.ask(root, "population_size=1", runs=1), 1_000_000)
    with served(explorer(sierra.open(root))) as page:
        page.ask("columns")
        whole = page.ask("runs", columns=["number"])
        assert (whole["total"], len(whole["rows"])) == (1_000_001, WINDOW)
        assert page.ask("runs", columns=["number"], order="number", first=500_001)["rows"][0][1] == 500_000
        last = page.ask("runs", columns=["number"], order="number", descending=True, where="number % 2 = 1", first=499_999)
        assert (last["total"], [row[1] for row in last["rows"]]) == (500_000, [1])
