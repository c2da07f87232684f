"""A process of its own executes somebody else's statements: with the same values, and within limits that hold."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import duckdb
import pytest

from sierra.errors import SierraError, SqlError
from sierra.store import statement_process, statement_worker
from sierra.store.connections import connect
from sierra.store.derived_tables import Definition, Limits, Rules
from sierra.store.several_batches import joined
from sierra.store.statement_process import Remote
from sierra.store.store import Snapshot, Store
from tests.unit.store.test_hostile_statements import STATEMENTS
from tests.waiting import until

MEMORY = 300_000_000
ENDLESS = "SELECT levenshtein(repeat('a', 1000000), repeat('b', 1000000))"
"""A statement that takes hours in one function, which DuckDB cannot interrupt."""
VALUES = """
SELECT 1::HUGEINT, '12345678-1234-1234-1234-123456789012'::UUID, '101'::BIT, TIME '10:00:00', '10:00:00+02'::TIMETZ,
    INTERVAL 3 days, 'a'::ENUM('a', 'b'), 1.25::DECIMAL(10,2), '\\x00'::BLOB, '{"a": 1}'::JSON, [1, NULL], {'a': 1, 'b': 'x'},
    MAP {'k': 1}, TIMESTAMP_NS '2020-01-01 00:00:00.123456789', 18446744073709551615::UBIGINT, union_value(k := 1), NULL,
    [1, 2]::INTEGER[2], DATE 'infinity', '24:00:00'::TIME, 1.5::FLOAT, [{'a': [1::HUGEINT]}], $text
"""
pytestmark = pytest.mark.integration


@pytest.fixture
def confined() -> Iterator[Remote]:
    made = connect(MEMORY)
    assert isinstance(made, Remote)
    yield made
    made.close()


@pytest.fixture(scope="module")
def snapshot(recorded: Path) -> Iterator[Snapshot]:
    store = Store(recorded / ".sierra", lambda: Rules(limits=Limits(memory=MEMORY))).confined()
    with store.snapshot(theirs=True) as snapshot:
        yield snapshot


def process(connection: Remote) -> int:
    running = connection._process._running
    assert running is not None
    return running.pid


def kill(connection: Remote) -> None:
    """End the process, which executes nothing, and wait until it has ended."""
    number = process(connection)
    os.kill(number, signal.SIGKILL)
    os.waitid(os.P_PID, number, os.WEXITED | os.WNOWAIT)


@contextmanager
def signalled(connection: Remote, number: signal.Signals) -> Iterator[None]:
    """Send a signal to the process while it executes a statement."""

    def end() -> None:
        until(lambda: connection._process._answering is not None, lambda: "nothing is executed", 30)
        os.kill(process(connection), number)

    thread = threading.Thread(target=end)
    thread.start()
    yield
    thread.join()


def test_values_are_those_of_a_connection_in_this_process(confined: Remote) -> None:
    here = connect()
    parameters = {"text": "ä"}
    assert confined.execute(VALUES, parameters).fetchall() == here.execute(VALUES, parameters).fetchall()
    theirs, own = confined.sql(VALUES, params=parameters), here.sql(VALUES, params=parameters)
    assert theirs is not None
    assert theirs.types == [str(kind) for kind in own.types]
    assert theirs.fetchall() == own.fetchall()
    assert theirs.to_arrow_table().equals(own.to_arrow_table())
    assert theirs.limit(0).to_arrow_table().schema == own.limit(0).to_arrow_table().schema
    many = "SELECT range AS n, range::VARCHAR AS text FROM range(300000)"
    table = confined.sql(many)
    assert table is not None
    assert table.to_arrow_table().equals(here.sql(many).to_arrow_table())
    here.close()


def test_rows_that_are_still_read_do_not_disturb_another_statement(confined: Remote) -> None:
    rows = confined.execute("SELECT range FROM range(250000)")
    first = rows.fetchmany(1)
    assert confined.execute("SELECT 42").fetchall() == [(42,)]
    assert len(first) + len(rows.fetchall()) == 250_000


def test_another_process_has_the_views_and_tables_of_the_one_that_was_ended(confined: Remote) -> None:
    cursor = confined.cursor()
    cursor.execute("CREATE TEMP TABLE kept AS SELECT range AS n FROM range(3)")
    cursor.execute("CREATE VIEW shown AS SELECT 7 AS seven")
    before = process(confined)
    with signalled(confined, signal.SIGKILL), pytest.raises(duckdb.OutOfMemoryException):
        cursor.execute(ENDLESS)
    assert cursor.execute("SELECT * FROM kept, shown").fetchall() == [(0, 7), (1, 7), (2, 7)]
    assert process(confined) != before
    cursor.close()


def test_a_process_that_cannot_be_made_again_is_not_left_half_made(confined: Remote) -> None:
    cursor = confined.cursor()
    cursor.execute("CREATE TEMP TABLE kept AS SELECT 1 AS n")
    running = confined._process
    kept = running._kept
    on, request, _ = kept[-1]
    running._kept = [(on, {**request, "text": "FROM lost"}, None) if one is kept[-2] else one for one in kept]
    kill(confined)
    for _ in range(2):
        with pytest.raises(duckdb.InvalidInputException):
            cursor.execute("SELECT 1")
        assert running._running is None
    running._kept = kept
    assert cursor.execute("FROM kept").fetchall() == [(1,)]
    cursor.close()


def test_only_settings_that_something_was_made_with_are_kept(confined: Remote) -> None:
    before = len(confined._process._kept)
    for count in (1, 2, 1):
        for text in (f"SET threads = {count}", "SET TimeZone = 'UTC'", "RESET threads", "RESET TimeZone"):
            confined.execute(text)
    assert len(confined._process._kept) == before + 2
    confined.execute("SET threads = 1")
    confined.execute("CREATE TABLE kept AS SELECT 1 AS n")
    confined.execute("RESET threads")
    assert len(confined._process._kept) == before + 4


def test_threads_are_reset_to_those_of_the_process(confined: Remote) -> None:
    first = confined.execute("SELECT current_setting('threads')").fetchall()
    for text in ("SET threads = 1", "RESET threads", "SET threads = 1000"):
        confined.execute(text)
    assert confined.execute("SELECT current_setting('threads')").fetchall() == first


@pytest.mark.parametrize("kind", ["IOException", "InterruptException", "OutOfMemoryException", "InvalidInputException"])
def test_an_error_within_an_answer_has_its_class(kind: str) -> None:
    begins = {name: start for start, name in statement_worker.WRAPPED.items()}
    error = OSError(f"{begins.get(kind, 'Conversion Error:')} within the answer")  # pyarrow's
    assert statement_worker.kind_of(error) == kind


def test_another_signal_is_named(confined: Remote) -> None:
    with signalled(confined, signal.SIGTERM), pytest.raises(duckdb.InternalException, match="was ended by signal 15"):
        confined.execute(ENDLESS)


def test_a_connection_that_is_closed_before_its_cursors_disturbs_no_other(confined: Remote) -> None:
    other = connect(MEMORY)
    other.cursor().cursor().execute("CREATE TEMP TABLE kept AS SELECT 1 AS n")
    other.close()
    kill(confined)
    assert confined.execute("SELECT 1").fetchall() == [(1,)]
    other.close()


@pytest.mark.parametrize(
    "statement",
    ["SELECT repeat('x', 2000000000)", "SELECT list_sum(range(1000000000))", "SELECT list(range) FROM range(900000000)"],
)
@pytest.mark.each_case
def test_no_statement_takes_more_memory_than_the_limit(confined: Remote, statement: str) -> None:
    with pytest.raises(duckdb.Error, match="Memory"):
        confined.execute(statement).fetchall()
    assert confined.execute("SELECT 1").fetchall() == [(1,)]
    status = Path(f"/proc/{process(confined)}/status").read_text()
    assert int(status.split("VmHWM:")[1].split()[0]) * 1024 < MEMORY + 1_000_000_000


@pytest.mark.parametrize(
    "statement",
    ["SELECT true FROM range(2000000)", "SELECT list(true) FROM range(2000000)", "SELECT {'a': [true]} FROM range(600000)"],
)
@pytest.mark.each_case
def test_no_answer_becomes_more_objects_than_the_limit(confined: Remote, statement: str) -> None:
    with pytest.raises(duckdb.OutOfMemoryException, match="the answer has rows of more"):
        confined.execute(statement).fetchall()
    relation = confined.sql(statement)
    assert relation is not None
    with pytest.raises(duckdb.OutOfMemoryException):
        relation.fetchall()
    with pytest.raises(duckdb.OutOfMemoryException):
        relation.to_few_rows()
    assert relation.to_arrow_table().num_rows in (1, 600_000, 2_000_000)


def test_tables_of_several_batches_have_a_limit(recorded: Path) -> None:
    limits = Limits(memory=MEMORY)
    large = Definition(
        "large", "SELECT min(run) AS run, i, repeat('x', 1000) FROM runs, range(50000) AS t(i) GROUP BY i", "large"
    )
    store = Store(recorded / ".sierra", lambda: Rules({"large": large}, limits)).confined()
    [batch, *_] = [row["batch"] for row in store.rows("SELECT DISTINCT batch FROM experiments")]
    with pytest.raises(SierraError, match=r"^own: out of memory: the tables of several batches .* or raise memory in \[sql\]$"):
        joined(store, {"a": str(batch), "b": str(batch)}, "SELECT count(*) AS n FROM large", "own")
    large = Definition("large", "SELECT run, i FROM runs, range(2000) AS t(i)", "large")
    store = Store(recorded / ".sierra", lambda: Rules({"large": large}, limits)).confined()
    found = joined(store, {"a": str(batch), "b": str(batch)}, "SELECT batch, count(*) > 0 AS some FROM large GROUP BY 1", "own")
    assert found.table.to_pylist() == [{"batch": "a", "some": True}, {"batch": "b", "some": True}]


def test_a_process_that_was_killed_between_statements_is_replaced(confined: Remote) -> None:
    confined.execute("CREATE TEMP VIEW v AS SELECT 5 AS a")
    cursor = confined.cursor()
    for connection in (confined, cursor):
        before = process(confined)
        kill(confined)
        assert connection.execute("SELECT a FROM (SELECT 5 AS a)").fetchall() == [(5,)]
        assert process(confined) != before
    assert confined.execute("FROM v").fetchall() == [(5,)]
    cursor.close()


FORKED = """
import os, signal, sys
from sierra.store.connections import connect
made = connect(300_000_000)
print(made._process._running.pid, flush=True)
if os.fork() == 0:
    signal.pause()
print(os.getpid(), flush=True)
os.kill(os.getpid(), signal.SIGKILL)
"""


def test_the_process_ends_with_the_one_that_started_it_whatever_others_inherited() -> None:
    with subprocess.Popen([sys.executable, "-c", FORKED], stdout=subprocess.PIPE, start_new_session=True, text=True) as command:
        assert command.stdout is not None
        started = int(command.stdout.readline())
        command.stdout.readline()
        command.wait()
        try:
            until(lambda: not is_running(started))
        finally:
            os.killpg(command.pid, signal.SIGKILL)


def is_running(number: int) -> bool:
    try:
        return Path(f"/proc/{number}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


def computed_s(number: int) -> float:
    """Return the time for which the processor has worked for a process, in s."""
    user, system = Path(f"/proc/{number}/stat").read_text().rpartition(")")[2].split()[11:13]
    return (int(user) + int(system)) / os.sysconf("SC_CLK_TCK")


@contextmanager
def interrupting(confined: Remote) -> Iterator[None]:
    """Interrupt a statement that computes, again and again, until the end of the context."""
    ended = threading.Event()
    number = process(confined)
    began = computed_s(number)

    def interrupt() -> None:
        while not ended.wait(0.05):
            with suppress(FileNotFoundError):  # it has been ended
                if computed_s(number) - began > 0.3:  # before, it may not have reached its function yet
                    confined.interrupt()

    thread = threading.Thread(target=interrupt)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


def test_a_function_that_cannot_be_interrupted_is_ended(confined: Remote, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(statement_process, "PATIENCE_S", 0.1)
    confined.execute("SELECT 1")
    before = process(confined)
    with interrupting(confined), pytest.raises(duckdb.InterruptException):
        confined.execute(ENDLESS).fetchall()
    assert confined.execute("SELECT 1").fetchall() == [(1,)]
    assert process(confined) != before


def test_what_can_be_interrupted_keeps_its_process(confined: Remote) -> None:
    confined.execute("CREATE TEMP TABLE kept AS SELECT 1 AS n")
    before = process(confined)
    with interrupting(confined), pytest.raises(duckdb.InterruptException):
        confined.execute("SELECT sum(a.range * b.range) FROM range(100000000) a, range(100000000) b").fetchall()
    assert (confined.execute("FROM kept").fetchall(), process(confined)) == ([(1,)], before)


@pytest.mark.parametrize("statement", STATEMENTS)
@pytest.mark.each_case
def test_a_hostile_statement_is_refused_there_too(snapshot: Snapshot, statement: str) -> None:
    with pytest.raises(SqlError):
        snapshot.sql(statement)


def test_the_process_ends_with_the_one_that_it_works_for() -> None:
    program = (
        "import os\nfrom sierra.store.connections import connect\nmade = connect(300_000_000)\n"
        "made.execute('SELECT 1').fetchall()\nprint(made._process._running.pid, flush=True)\nos.kill(os.getpid(), 9)"
    )
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    of_child = Path("/proc", ended.stdout.strip())
    assert ended.stdout.strip().isdecimal(), ended.stderr
    until(lambda: not of_child.exists())
