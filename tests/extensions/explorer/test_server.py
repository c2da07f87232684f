"""The explorer's server answers its own page only, from the newest state of the store, and changes nothing unless allowed."""

from __future__ import annotations

import json
import re
import socket
import stat
import threading
import time
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

import sierra
from sierra.config import project_file
from sierra.config.project_file import LoadedProject
from sierra.deliverables.report.make import ReportSource
from sierra.errors import Missing, UsageError
from sierra.extensions.explorer import explorer
from sierra.extensions.explorer.answers import ROWS, Answers
from sierra.extensions.explorer.server import LONGEST, Server
from tests import projects, stores
from tests.extensions.explorer.page import Page, served
from tests.support.characters import LETTERS, MIXED
from tests.waiting import PATIENCE_S, until

FOR_EVER = "SELECT sum(a.range * b.range) FROM range(100000000) a, range(100000000) b WHERE (a.range + b.range) % 7 = 1"
SWARM = {"table": "swarm", "column": "coverage", "kind": "timeseries"}


@pytest.fixture(scope="module")
def page(recorded: Path) -> Iterator[Page]:
    with served(explorer(sierra.open(recorded))) as page:
        yield page


@pytest.fixture(scope="module")
def batch(recorded: Path) -> str:
    return sierra.open(recorded).batches[0].batch


def test_the_page_has_no_data_and_loads_nothing_from_elsewhere(page: Page) -> None:
    status, body, headers = page.send("GET", "/", X_Sierra_Token="", Origin="")
    assert status == 200
    assert headers["Cache-Control"] == "no-store"
    [policy] = re.findall(r'<meta http-equiv="Content-Security-Policy" content="([^"]*)">', body.decode())
    assert re.sub(r"sha256-[\w+/]{43}=", "HASH", policy) == (
        "default-src 'none'; script-src 'HASH'; style-src 'HASH'; img-src data: 'self'; base-uri 'none'; form-action 'none'; "
        "frame-src 'self'; media-src 'self'; connect-src 'self'"
    )
    assert headers["Content-Security-Policy"] == "frame-ancestors 'self'"
    assert b"population_size" not in body
    assert page.token.encode() not in body


@pytest.mark.integration
def test_batches_and_tables_are_listed(page: Page, recorded: Path, batch: str) -> None:
    assert page.ask("overview")["state"] == page.ask("state")
    found = page.ask("batches")
    assert [one["batch"] for one in found["batches"]] == [one.batch for one in reversed(sierra.open(recorded).batches)]
    assert (found["all"], found["found"]) == (3, 3)
    assert found["batches"][-1]["query"] == "population_size=1,2"
    assert [one["query"] for one in page.ask("batches", words="SIZE=1,2 complete")["batches"]] == ["population_size=1,2"]
    assert page.ask("batches", words="no such batch") == {"all": 3, "found": 0, "batches": []}
    assert [one["query"] for one in page.ask("batches", first=2)["batches"]] == ["population_size=1,2"]
    tables = page.ask("tables", batch=batch)
    assert set(tables["of_runs"]) == {"swarm", "notes"}
    assert ["coverage", "DOUBLE"] in tables["of_runs"]["swarm"]
    assert {"runs", "executions", "batches"} <= set(tables["of_store"])
    chosen = page.ask("batch", batch=batch)
    assert chosen["variables"] == ["population_size"]
    assert ["coverage"] in [keys["column"] for keys in chosen["figures"].values()]


def test_a_statement_has_the_answer_of_sierra_sql(page: Page, recorded: Path, batch: str) -> None:
    statement = "SELECT run, max(coverage) AS highest, DATE '2026-11-23' AS day FROM swarm GROUP BY run ORDER BY run"
    found = page.ask("query", statement=statement, batch=batch)
    table = sierra.open(recorded).sql(statement, within=batch)
    assert found["columns"] == ["run", "highest", "day"]
    assert found["numeric"] == ["highest"]
    assert found["rows"] == [[row["run"], row["highest"], "2026-11-23"] for row in table.to_pylist()]
    assert found["more"] is False


@pytest.mark.integration
@pytest.mark.parametrize("chosen", [True, False])
def test_all_rows_of_outputs_are_those_of_sierra_sql(page: Page, recorded: Path, batch: str, chosen: bool) -> None:
    within = {"batch": batch} if chosen else {}
    for name in ("swarm", "notes", "runs"):
        statement = f"SELECT * FROM {name} ORDER BY ALL"
        found = page.ask("query", statement=statement, **within)
        table = sierra.open(recorded).sql(statement, within=batch if chosen else None)
        assert found["columns"] == table.column_names
        assert found["rows"] == [[*row.values()] for row in table.to_pylist()]


def test_a_billion_rows_are_cut_and_long_texts_too(page: Page) -> None:
    found = page.ask("query", statement="SELECT range, repeat('x', 20000) AS long FROM range(1000000000)")
    assert len(found["rows"]) == ROWS
    assert found["more"] is True
    assert found["rows"][-1][1].endswith("x… (20,000 letters)")


@pytest.mark.integration
def test_many_long_columns_are_cut(page: Page) -> None:
    columns = ", ".join(f"repeat('x', 9999) || range AS c{place}" for place in range(30))
    statement = f"SELECT {columns} FROM range(1000)"
    status, body, _ = page.send("POST", "/ask/query", json.dumps({"statement": statement}).encode())
    found = json.loads(body)
    assert (status, len(found["rows"]), found["more"]) == (200, 39, True)
    assert len(body) < 13_000_000
    assert "12,000,000 letters" in found["notes"]


def test_nan_and_infinity_are_no_empty_cells(page: Page) -> None:
    found = page.ask(
        "query", statement="SELECT 'nan'::DOUBLE, NULL::DOUBLE, '-inf'::FLOAT, 1.5::DOUBLE, 'infinity'::TIMESTAMPTZ"
    )
    assert found["rows"] == [["nan", None, "-inf", 1.5, "infinity"]]


def test_a_fault_in_an_answer_is_no_fault_of_the_question(page: Page, monkeypatch: pytest.MonkeyPatch) -> None:
    def faulty(_: Answers) -> None:
        raise ValueError("a fault")

    monkeypatch.setattr(Answers, "overview", faulty)
    status, body, _ = page.send("POST", "/ask/overview", b"{}")
    assert (status, json.loads(body)) == (500, {"error": "a fault in SIERRA itself: ValueError: a fault"})


def test_a_chart_is_the_figure_that_its_lines_of_sierra_toml_declare(page: Page, recorded: Path, batch: str) -> None:
    found = page.ask("chart", batch=batch, name="mine", keys=SWARM | {"title": "A <b>title</b>"})
    assert tomllib.loads(found["toml"]) == {"figures": {"mine": SWARM | {"title": "A <b>title</b>"}}}
    assert "A &lt;b&gt;title&lt;/b&gt;" in found["section"]
    (stats,) = (
        sierra.open(recorded)
        .sql("SELECT avg(coverage) AS mean FROM swarm WHERE population_size = 2 AND tick = 3", within=batch)
        .to_pylist()
    )
    assert repr(stats["mean"]) in found["section"]
    own = page.ask(
        "chart", batch=batch, name="own", keys={"sql": "SELECT run, tick, coverage FROM swarm", "column": "coverage"}
    )
    assert "SELECT run, tick, coverage FROM swarm" in own["section"]


def test_a_chart_whose_name_sierra_toml_cannot_have_gets_another_one(page: Page, batch: str) -> None:
    found = page.ask("chart", batch=batch, name="חום am Ende", keys=SWARM)
    assert tomllib.loads(found["toml"]) == {"figures": {"am_Ende": SWARM}}
    assert found["name"] == "am_Ende"
    assert found["command"].split()[-1] == "am_Ende"


def test_lines_to_copy_have_no_characters_that_deceive(page: Page, batch: str) -> None:
    keys = SWARM | {"title": "a \u202eb\u2066 \x01\x85\U000e0001 'c' \"d\"\n", "where": f"true -- \u202e {MIXED}"}
    toml = page.ask("chart", batch=batch, name="\u202emine", keys=keys)["toml"]
    assert tomllib.loads(toml) == {"figures": {"mine": keys}}
    assert LETTERS in toml
    assert toml.replace("\n", "").replace(LETTERS, "").isprintable()


@pytest.mark.parametrize(
    ("change", "status"),
    [
        ({"X_Sierra_Token": ""}, 403),
        ({"X_Sierra_Token": "x" * 43}, 403),
        ({"X_Sierra_Token": "\xff"}, 403),
        ({"Origin": "http://evil.example"}, 403),
        ({"Origin": "null"}, 403),
        ({"Host": "evil.example"}, 403),
        ({"Host": ""}, 403),
        ({"Content_Length": str(LONGEST + 1)}, 413),
        ({"Content_Length": "-1"}, 413),
        ({"Content_Length": "1e3"}, 413),
    ],
)
def test_a_request_that_is_not_of_the_page_is_refused(page: Page, change: dict[str, str], status: int) -> None:
    found, body, _ = page.send("POST", "/ask/overview", b"" if "Content_Length" in change else b"{}", **change)
    assert found == status
    assert list(json.loads(body)) == ["error"]
    assert page.ask("state")


def test_the_page_is_not_sent_under_another_name(page: Page) -> None:
    assert page.send("GET", "/", Host="evil.example")[0] == 403
    assert page.send("GET", "/sierra.toml")[0] == 404
    assert page.send("PUT", "/", b"")[0] == 501
    assert page.send("POST", "/ask/_load", b"{}")[0] == 404


NONSENSE = [b"", b"[]", b"{", b'{"batch": 1}', b'{"more": ""}', b"[" * 100_000, b"\xff", b'{"batch": "\\u0000"}']


@pytest.mark.parametrize("body", NONSENSE)
def test_nonsense_is_answered_in_one_line(page: Page, body: bytes) -> None:
    status, answer, _ = page.send("POST", "/ask/batch", body)
    assert status == 400
    assert "\n" not in json.loads(answer)["error"]


@pytest.mark.parametrize(
    "statement",
    [
        "DROP TABLE runs",
        "COPY runs TO '/tmp/sierra-explorer.csv'",
        "SELECT * FROM read_csv('/etc/passwd')",
        "SELECT * FROM read_text('/proc/self/environ')",
        "SELECT * FROM glob('/*')",
        "ATTACH '/tmp/other.duckdb'",
        "INSTALL httpfs",
        "SET enable_external_access = true",
        "SELECT 1; SELECT 2",
        "SELEC 1",
        "",
    ],
)
def test_a_statement_can_only_read_the_store(page: Page, statement: str) -> None:
    assert page.error("query", statement=statement)
    assert page.ask("query", statement="SELECT 1")["rows"] == [[1]]


def test_an_unknown_batch_or_key_is_named(page: Page, batch: str) -> None:
    assert "0123456789" in page.error("batch", batch="0123456789")
    assert "colour" in page.error("chart", batch=batch, name="mine", keys=SWARM | {"colour": "red"})
    assert "no numeric column 'speed'" in page.error("chart", batch=batch, name="mine", keys=SWARM | {"column": "speed"})


def test_an_answer_that_takes_too_long_is_ended_and_the_next_one_comes(recorded: Path) -> None:
    project = sierra.open(recorded)
    answers = Answers(lambda: ReportSource(project.loaded, project.store), project.store, wall=0.2)
    with served(Server(answers, "project")) as page:
        assert page.error("query", statement=FOR_EVER).startswith("no answer within 0.2 s")
        answers._wall = 60.0  # opening the store again may take longer on a busy machine
        assert page.ask("query", statement="SELECT 1")["rows"] == [[1]]


def stopped(page: Page, question: str, **content: Any) -> str:
    """Return the error of a question that is stopped again and again until it ends."""
    said: list[str] = []
    asking = threading.Thread(target=lambda: said.append(page.error(question, **content)))
    asking.start()
    while asking.is_alive():
        page.ask("stop")
        asking.join(0.05)
    return "".join(said)


def test_an_answer_can_be_stopped(page: Page) -> None:
    assert stopped(page, "query", statement=FOR_EVER) == "stopped"


@pytest.mark.parametrize("question", ["compare", "report", "chart"])
def test_work_in_python_is_stopped_inside(
    page: Page, recorded: Path, batch: str, monkeypatch: pytest.MonkeyPatch, question: str
) -> None:
    second = sierra.open(recorded).batches[1].batch
    asked: dict[str, Any] = {
        "compare": {"batches": [batch, second], "name": "x", "keys": {"table": "swarm", "column": "coverage"}},
        "report": {"batch": batch},
        "chart": {"batch": batch, "name": "x", "keys": SWARM},
    }
    for name in ("deliverables.comparison.compare", "deliverables.report.claims.find", "deliverables.figures.drawing.explored"):
        monkeypatch.setattr(f"sierra.{name}", lambda *_, **__: [time.sleep(0.01) for _ in iter(int, 1)])
    monkeypatch.setattr("sierra.extensions.explorer.limit.PATIENCE_S", 0.05)
    assert stopped(page, question, **asked[question]) == "stopped"
    assert page.ask("query", statement="SELECT 1")["rows"] == [[1]]


SLOW_OPENINGS = [
    ("query", "store.views.Views.settle", {"statement": "SELECT 1"}),
    ("tables", "store.store.Store.batch_id", {"batch": "0123"}),
    ("batch", "store.batch_data.BatchData._members", {"batch": "BATCH"}),
    ("batches", "execution.list_batches.batches", {}),
]


@pytest.mark.integration
@pytest.mark.parametrize(("question", "slow", "content"), SLOW_OPENINGS)
@pytest.mark.parametrize("by", ["stop", "time", "end"])
def test_opening_the_store_ends_like_an_answer(
    recorded: Path, batch: str, monkeypatch: pytest.MonkeyPatch, question: str, slow: str, content: dict[str, str], by: str
) -> None:
    begun, project = threading.Event(), sierra.open(recorded)

    def opening(*_: object) -> None:
        begun.set()
        for _ in range(1000):
            time.sleep(0.01)

    monkeypatch.setattr(f"sierra.{slow}", opening)
    monkeypatch.setattr("sierra.extensions.explorer.limit.PATIENCE_S", 0.05)
    asked = {name: value.replace("BATCH", batch) for name, value in content.items()}
    wall = 0.1 if by == "time" else 60
    server = Server(Answers(lambda: ReportSource(project.loaded, project.store), project.store, wall=wall), "project")
    said: list[str] = []
    with served(server) as page:
        asking = threading.Thread(target=lambda: said.append(page.error(question, **asked)))
        asking.start()
        assert by == "time" or begun.wait(60)
        if by == "stop":
            page.ask("stop")
        if by != "end":
            asking.join()
    asking.join()
    assert said == [
        "no answer within 0.1 s; ask for less, or use sierra sql, which has no time limit" if wall < 1 else "stopped"
    ]


def test_a_statement_within_a_comparison_or_a_report_is_stopped(recorded: Path, batch: str, tmp_path: Path) -> None:
    root = stores.copy(recorded, tmp_path / "project")
    with (root / "sierra.toml").open("a") as file:
        file.write(f'\n[tables.endless]\nsql = "SELECT run, ({FOR_EVER}) AS value FROM runs"\n')
        file.write('[figures.endless]\ntable = "endless"\ncolumn = "value"\n')
    second = sierra.open(root).batches[1].batch
    with served(explorer(sierra.open(root))) as page:
        compared = stopped(page, "compare", batches=[batch, second], name="x", keys={"table": "endless", "column": "value"})
        assert (compared, stopped(page, "report", batch=batch)) == ("stopped", "stopped")


@pytest.mark.integration
def test_the_part_of_a_report_that_is_made_is_told_with_its_number(
    page: Page, batch: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun, drawn = threading.Event(), threading.Event()

    def drawing(*_: object) -> None:
        begun.set()
        drawn.wait(60)
        raise UsageError("not drawn")

    monkeypatch.setattr("sierra.deliverables.report.results.explorable", drawing)
    making = threading.Thread(target=page.ask, args=("report",), kwargs={"batch": batch})
    making.start()
    assert begun.wait(60)
    part = page.ask("progress")
    drawn.set()
    making.join()
    assert re.fullmatch(r"figure 1 of [1-9][0-9]*: \w+", part)
    assert page.ask("progress") == ""


@pytest.fixture(params=["sierra.toml", "pyproject.toml"])
def own(request: pytest.FixtureRequest, recorded: Path, tmp_path: Path) -> Path:
    root = stores.copy(recorded, tmp_path / "project")
    if request.param == "pyproject.toml":
        lines = (root / "sierra.toml").read_text().replace("[variables]", "[tool.sierra.variables]")
        lines = lines.replace("\n[outputs", "\n[tool.sierra.outputs").replace("\n[variables.", "\n[tool.sierra.variables.")
        (root / "pyproject.toml").write_text(f"[tool.sierra]\n{lines}")
        (root / "sierra.toml").unlink()
    return root / str(request.param)


@pytest.mark.integration
def test_a_chart_is_written_to_the_project_and_drawn_from_there(own: Path, batch: str) -> None:
    before = own.read_text()
    with served(explorer(sierra.open(own.parent), write=True)) as page:
        assert page.ask("overview")["writes"] is True
        file = page.ask("chart", batch=batch, name="mine", keys=SWARM)["file"]
        assert page.ask("write", name="mine", keys=SWARM, file=file) == {"figures": ["mine"]}
        assert "has changed since this was drawn" in page.error("write", name="other", keys=SWARM, file=file)
        file = page.ask("chart", batch=batch, name="mine", keys=SWARM)["file"]
        assert "has a figure 'mine' already" in page.error("write", name="mine", keys=SWARM, file=file)
        assert "kind" in page.error("write", name="third", keys={"kind": "unknown"}, file=file)
        assert page.ask("batch", batch=batch)["figures"] == {"mine": SWARM | {"column": ["coverage"]}}
    assert own.read_text().startswith(before.rstrip())
    assert sierra.open(own.parent).config.figures["mine"].columns == ("coverage",)


def edited_after_reading(file: Path) -> Callable[[], ReportSource]:
    """Return a source that reads the project, and then adds a comment to its file, the first time only."""
    edits = iter(["\n# an edit while the chart is drawn\n"])

    def source() -> ReportSource:
        project = sierra.open(file.parent)
        found = ReportSource(project.loaded, project.store)
        with file.open("a") as stream:
            stream.write(next(edits, ""))
        return found

    return source


@pytest.mark.integration
def test_an_edit_during_the_drawing_is_noticed(own: Path, batch: str) -> None:
    answers = Answers(edited_after_reading(own), sierra.open(own.parent).store, writes=True)
    with served(Server(answers, "project")) as page:
        file = page.ask("chart", batch=batch, name="mine", keys=SWARM)["file"]
        assert "has changed since this was drawn" in page.error("write", name="mine", keys=SWARM, file=file)
        file = page.ask("chart", batch=batch, name="mine", keys=SWARM)["file"]
        page.ask("write", name="mine", keys=SWARM, file=file)
    assert "# an edit while the chart is drawn" in own.read_text()


@pytest.mark.integration
@pytest.mark.parametrize("writer", ["editor", "explorer"])
def test_an_edit_while_lines_are_appended_is_not_lost(
    own: Path, batch: str, monkeypatch: pytest.MonkeyPatch, writer: str
) -> None:
    project = sierra.open(own.parent)
    with served(explorer(project, write=True)) as page, served(explorer(project, write=True)) as other:
        file = page.ask("chart", batch=batch, name="mine", keys=SWARM)["file"]
        check = project_file.of_table

        def meanwhile(*about: Any) -> LoadedProject:
            """Change the file while the lines of `mine` are checked."""
            if "mine" in about[1].get("figures", {}):
                monkeypatch.setattr(project_file, "of_table", check)
                if writer == "explorer":
                    other.ask("write", name="other", keys=SWARM, file=file)
                else:
                    own.write_text(own.read_text() + "# other\n")
            return check(*about)

        monkeypatch.setattr(project_file, "of_table", meanwhile)
        assert "has changed" in page.error("write", name="mine", keys=SWARM, file=file)
    assert "other" in own.read_text()
    assert "mine" not in own.read_text()


@pytest.mark.integration
def test_a_link_and_the_mode_of_the_file_are_kept(own: Path, batch: str) -> None:
    target = own.rename(own.parent / "elsewhere.toml")
    target.chmod(0o600)
    own.symlink_to(target)
    with served(explorer(sierra.open(own.parent), write=True)) as page:
        file = page.ask("chart", batch=batch, name="mine", keys=SWARM)["file"]
        page.ask("write", name="mine", keys=SWARM, file=file)
    assert own.is_symlink()
    assert stat.S_IMODE(target.stat().st_mode) == 0o600
    assert "mine" in target.read_text()


def test_nothing_is_written_unless_the_user_allows_it(page: Page, recorded: Path, batch: str) -> None:
    before = (recorded / "sierra.toml").read_bytes()
    file = page.ask("chart", batch=batch, name="mine", keys=SWARM)["file"]
    assert "sierra explore --write" in page.error("write", name="mine", keys=SWARM, file=file)
    assert (recorded / "sierra.toml").read_bytes() == before


@pytest.mark.integration
def test_new_records_are_seen(tmp_path: Path) -> None:
    root = projects.make(tmp_path / "project")
    stores.ask(root, "population_size=1", runs=1)
    with served(explorer(sierra.open(root))) as page:
        before = page.ask("state")
        assert page.ask("batches")["all"] == 1
        stores.ask(root, "population_size=2", runs=1)
        assert page.ask("state") != before
        assert page.ask("batches")["all"] == 2


def test_a_port_that_is_taken_is_an_error_in_one_line(recorded: Path) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        with pytest.raises(Missing, match=r"cannot listen on port .* choose another one with --port"):
            explorer(sierra.open(recorded), port=taken.getsockname()[1])


def test_a_client_that_says_nothing_delays_no_other(page: Page) -> None:
    with socket.create_connection(("127.0.0.1", int(page.host.partition(":")[2]))) as silent:
        silent.sendall(b"POST /ask/overview HTTP/1.1\r\n")
        assert page.ask("query", statement="SELECT 1")["rows"] == [[1]]


@pytest.mark.integration
def test_a_statement_that_cannot_be_interrupted_ends_too(recorded: Path) -> None:
    project = sierra.open(recorded)
    answers = Answers(lambda: ReportSource(project.loaded, project.store), project.store, wall=2.0)
    with served(Server(answers, "project")) as page:
        began = time.monotonic()
        endless = "SELECT levenshtein(repeat('a', 1000000), repeat('b', 1000000))"
        assert page.error("query", statement=endless).startswith("no answer within 2 s")
        assert time.monotonic() - began < PATIENCE_S, "the statement takes hours"
        answers._wall = 60.0
        assert "Memory" in page.error("query", statement="SELECT list_sum(range(1000000000))")
        assert page.ask("query", statement="SELECT 1")["rows"] == [[1]]


def test_half_of_a_character_is_refused(page: Page) -> None:
    assert "no character of UTF-8" in page.error("query", statement="SELECT '\ud800'")


@pytest.mark.parametrize("length", ["9" * 5000, "99999999999", "٣", "-1", "1e3", ""])
def test_a_length_that_is_none_is_refused(page: Page, length: str) -> None:
    with socket.create_connection(page.host.split(":"), timeout=PATIENCE_S) as client:
        lines = [f"{name}: {value}" for name, value in page.headers.items()]
        given = "\r\n".join(["POST /ask/state HTTP/1.1", *lines, f"Content-Length: {length}", "", ""])
        client.sendall(given.encode())
        assert b" 413 " in client.recv(1000).splitlines()[0]


@pytest.mark.parametrize("begin", [b"G", b"GET / HTTP/1.1\r\nA: ", b"POST /ask/state HTTP/1.1\r\nContent-Length: 1000\r\n"])
def test_a_request_that_comes_too_slowly_as_a_whole_is_closed(
    page: Page, monkeypatch: pytest.MonkeyPatch, begin: bytes
) -> None:
    monkeypatch.setattr("sierra.extensions.explorer.server.SILENCE_S", 0.3)
    with socket.create_connection(page.host.split(":"), timeout=PATIENCE_S) as client:
        client.sendall(begin)
        client.setblocking(False)
        until(lambda: _is_closed(client))


def _is_closed(client: socket.socket) -> bool:
    """Send one more byte; return whether the other side has closed the connection."""
    try:
        client.send(b"x")
        return client.recv(1000) == b""
    except BlockingIOError:
        return False
    except ConnectionError:
        return True
