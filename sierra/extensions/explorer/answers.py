"""Answers to the questions of the explorer's page: lists, rows of SQL, charts, reports, and lines of `sierra.toml`.

Each answer comes from the newest state of the store, and from `sierra.toml` as it is then. Questions are answered one after the
other, each within a time limit.
"""

from __future__ import annotations

import copy
import math
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, closing, contextmanager
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from sierra.config import current_project
from sierra.config.deliverable_tables import Comparison, Figure
from sierra.config.plugin_registry import FIGURES
from sierra.config.project_file import LoadedProject
from sierra.config.validate import options, valid_name
from sierra.deliverables import default_figures
from sierra.deliverables.gallery import Gallery
from sierra.deliverables.html.tables import exact
from sierra.deliverables.record import origin_of
from sierra.errors import NotFound, UsageError
from sierra.extensions.explorer import declarations, recorded_files, run_details
from sierra.extensions.explorer.checked_files import Hashes
from sierra.extensions.explorer.limit import AGAIN_S, Limit
from sierra.extensions.explorer.run_details import BatchList
from sierra.extensions.explorer.run_table import ConditionError, RunTable, Wanted
from sierra.extensions.explorer.snapshots import Kept, Opened, T
from sierra.extensions.explorer.tickets import ServedFile, Tickets
from sierra.store.batch_data import BatchData
from sierra.store.derived_tables import Limits, Rules
from sierra.store.read_lock import Shared
from sierra.store.schema import TABLE_NAMES
from sierra.store.store import Snapshot, Store
from sierra.util.hashing import digest, short
from sierra.util.json_types import JsonView

if TYPE_CHECKING:
    from sierra.deliverables.figures.drawing import Drawing
    from sierra.deliverables.report.make import ReportSource
    from sierra.store.sql_result import Answer, SqlValue

ROWS = 1000
"""The largest number of rows of an answer."""
LETTERS = 10_000
"""The largest number of letters of a value."""
LETTERS_IN_ALL = 12_000_000
"""The largest number of letters of an answer."""
WALL_S = 30.0
"""The time limit of an answer, in s."""
LONG_WALL_S = 600.0
"""The time limit of reports and comparisons, in s."""
MEMORY = 2_000_000_000
SETTINGS = (f"SET memory_limit = '{MEMORY}B'", "SET max_temp_directory_size = '0B'")
"""Limits on all statements: a statement from the page must not fill the memory or the disk."""
LIMITS = Limits(math.inf, MEMORY, 0, "or use a command such as sierra figures, which has the limits of [sql]")
"""The same limits on derived tables."""
COLUMNS = """
SELECT table_name, column_name, data_type FROM information_schema.columns WHERE table_schema = 'main'
ORDER BY table_name, ordinal_position
"""
STOPPED = "stopped"


class Answers:
    """The answers about one project or package."""

    def __init__(self, source: Callable[[], ReportSource], store: Store, *, writes: bool = False, wall: float = WALL_S) -> None:
        """`source` reads the project again. With `writes`, charts may be written to `sierra.toml`. `wall`: time limit, in s."""
        self._source = source
        self._opened = Opened()
        self._unlimited = copy.copy(store)
        """The store without limits on memory, for reports."""
        self._unlimited.opened = self._opened.add
        self._store = self._unlimited.confined()
        self._store.settings = (*store.settings, *SETTINGS)
        self._store.rules = lambda: _within_limits(store.rules())
        self._writes = writes
        self._wall = wall
        self._one = threading.Lock()
        """Held while a question is answered."""
        self._limit: Limit | None = None
        self._part = ""
        """The part of a report that is made now, in words."""
        self._snapshots, self._frames, self._tables = Kept[Snapshot](), Kept[BatchData](), Kept[RunTable]()
        self._batches: BatchList | None = None
        self.tickets, self._hashes = Tickets(), Hashes()

    def overview(self) -> JsonView:
        """Return the facts about the project, and the choices of forms."""
        project = self._project()
        return {
            "project": project.root.name,
            "writes": self._writes,
            "package": self._source().received is not None,
            "kinds": list(FIGURES.names()),
            "state": self.state(),
        }

    def batches(self, words: str = "", first: int = 0, *, again: bool = False) -> JsonView:
        """Return a part of the list of batches: those that contain all words, from the one at the place `first` on.

        `again`: also read what is not recorded yet, such as the state of clusters.
        """
        with self._one, self._limited():
            state = self.state()
            if again or self._batches is None or self._batches.state != state:
                self._batches = run_details.read(self._store, state)
            return self._batches.part(words, max(0, first))

    def columns(self) -> JsonView:
        """Return the columns of the table of runs. The first answer for a state of the store computes the table."""
        with self._run_table(LONG_WALL_S) as table:
            return table.choices

    def runs(
        self, where: str = "", order: str = "", columns: Sequence[str] = (), first: int = 0, *, descending: bool = False
    ) -> JsonView:
        """Return a window of the table of runs: the rows that meet a condition, sorted by a column, from `first` on.

        With them, return the numbers of all such runs by status, and of those that are being executed now.
        """
        from sierra.deliverables.report.batch_state import claimed

        wanted = Wanted(where, order, descending, columns)
        problem: ConditionError | None = None
        window: Mapping[str, Any] = {}
        with self._run_table() as table:
            try:
                table.order(wanted)
                window = table.window(wanted, max(0, first), _rows)
            except ConditionError as error:  # the table stays open
                problem = error
            counts, state = table.counts, self.state()
        if problem:
            raise problem
        executing = claimed(self._store) if "missing" in counts else set()
        mine: JsonView = [str(row[0]) for row in window["rows"] if row[0] in executing]
        total = sum(counts.values())
        return {
            **window,
            "total": total,
            "counts": counts,
            "first": max(0, first),
            "state": state,
            "executing": len(executing),
            "mine": mine,
        }

    def run(self, run: str) -> JsonView:
        """Return what is recorded about a run, with its files."""
        with self._one, self._limited():
            return bounded(run_details.record(self._store, run))

    def file(self, run: str, path: str) -> JsonView:
        """Return the beginning of a recorded file of a run as text."""
        with self._one, self._limited():
            return run_details.file(self._store, run, path)

    def why(self, run: str) -> JsonView:
        """Return the lines that explain why a run was executed or not."""
        project = self._project()
        with self._one, self._limited(LONG_WALL_S):
            return bounded(run_details.reasons(project, self._store, run))

    def curves(self, runs: Sequence[str], column: str) -> JsonView:
        """Return an output's column of several runs over time, as a section of a page."""
        run_details.check(runs)
        with self._run_table() as table:
            time, rows = table.curves(runs, column)
            names = table.names(runs)
            return {"section": run_details.curves(rows, {run: names.get(run, "") for run in runs}, column, time)}

    def differ(self, runs: Sequence[str]) -> JsonView:
        """Return the lines that say how each run differs from the first one."""
        project = self._project()
        with self._one, self._limited(LONG_WALL_S):
            return bounded(run_details.differences(project, self._store, runs))

    @contextmanager
    def _run_table(self, wall: float | None = None) -> Iterator[RunTable]:
        """Yield the table of runs in the newest state of the store."""
        project = self._project()
        with self._reading(self._tables, wall) as key:
            yield self._tables.opened(key, lambda: self._open_table(project))

    def _open_table(self, project: LoadedProject) -> RunTable:
        with ExitStack() as opening:
            table = RunTable(opening.enter_context(self._store.snapshot(theirs=True)), project)
            opening.pop_all()
        return table

    def state(self) -> str:
        """Return a hash that changes whenever something is recorded or removed. Raises Missing if the store is gone."""
        folder = Store(self._store.paths.root).paths.segments
        names = sorted(path.name for path in folder.iterdir()) if folder.is_dir() else []
        return digest("state", {"segments": names})

    def tables(self, batch: str | None = None) -> JsonView:
        """Return the columns of each table, with their types; outputs and derived tables come before the store's own."""
        found: tuple[dict[str, list[JsonView]], ...] = ({}, {})
        with self._snapshot(batch) as snapshot:
            for table, column, kind in snapshot.ask(COLUMNS, {}, lambda answer: answer.rows(), theirs=True):
                found[str(table) in TABLE_NAMES].setdefault(str(table), []).append([str(column), str(kind)])
        of_runs, of_store = found
        return {"of_runs": of_runs, "of_store": of_store}

    def batch(self, batch: str) -> JsonView:
        """Return a batch with its variables, its videos, and its figures: those that are declared, or else the default ones."""
        source = self._source()
        project = source.project
        with self._frame(batch) as frame:
            gallery = Gallery(project, self._store, frame)
            figures, notes = default_figures.wanted(gallery, None)
            return {
                **self._facts(frame.batch),
                "variables": [axis.name for axis in frame.axes()],
                "figures": {name: _keys(figure) for name, figure in figures.items()},
                "notes": [*notes, *gallery.notes],
                "videos": recorded_files.videos(source, self._store, frame.batch, self.tickets, self._hashes),
            }

    def _facts(self, batch: str) -> dict[str, JsonView]:
        """Return what the list says about one batch, and how many of its runs are being executed."""
        from sierra.deliverables.report.batch_state import executing

        state = self.state()
        if self._batches is None or self._batches.state != state:
            self._batches = run_details.read(self._store, state)
        listed = next((listed for listed in self._batches.batches if listed.batch == batch), None)
        if listed is None:
            raise NotFound(f"batch {short(batch)} has been removed")
        return {"facts": run_details.as_data(listed), "executing": executing(self._store, batch) if listed.missing else 0}

    def query(self, statement: str, batch: str | None = None) -> JsonView:
        """Return the first rows of a statement, which can only read the store."""
        with self._snapshot(batch) as snapshot:
            return snapshot.ask(statement, {}, _rows, theirs=True)

    def chart(self, batch: str, name: str, keys: Mapping[str, JsonView], others: Sequence[str] = ()) -> JsonView:
        """Return a figure as a section of a page, with the lines of `sierra.toml` that declare it.

        With `others`, the figure shows these batches too. A name that `sierra.toml` cannot have is replaced by one like it.
        """
        from sierra.deliverables.figures import interactive
        from sierra.deliverables.figures.drawing import explored
        from sierra.deliverables.html import section

        project, figure, name = self._project(), options(Figure, dict(keys), "chart"), valid_name(name)
        with self._drawing(project, batch, name, figure, others) as (drawn, command):
            drawing, svg = explored(drawn)
        origin = origin_of(drawing.batch, drawing.data, *[id for id in drawing.together.values() if id != drawing.batch])
        content = interactive.content(drawing, svg, origin)
        return {"section": section(content), "command": command, **self._declared(project, "figures", name, keys)}

    @contextmanager
    def _drawing(
        self, project: LoadedProject, batch: str, name: str, figure: Figure, others: Sequence[str]
    ) -> Iterator[tuple[Drawing, str]]:
        """Yield the drawing of one batch or of several, and the command that draws it once it is declared."""
        from sierra.extensions.explorer import together

        if not others:
            with self._frame(batch, figure.sql) as frame:
                only = {figure.table} if figure.table or figure.sql else None
                drawing = Gallery(project, self._store, frame, only=only).drawing(name, figure)
                yield drawing, f"sierra figures {short(frame.batch)} {name}"
            return
        with ExitStack() as opened:
            opened.enter_context(self._one)
            opened.enter_context(self._limited())
            batches = [self._store.batch_id(prefix) for prefix in (batch, *others)]
            groups = together.labelled(project, self._store, batches)
            frames = {label: opened.enter_context(BatchData(self._store, prefix)) for label, prefix in groups.items()}
            drawing = together.drawing(project, self._store, name, figure, frames)
            yield drawing, together.command("figures", groups, name)

    def compare(self, batches: Sequence[str], name: str, keys: Mapping[str, JsonView]) -> JsonView:
        """Return the comparison of batches as a section of a page, with the lines of `sierra.toml` that declare it."""
        from sierra.extensions.explorer import together

        project, name = self._project(), valid_name(name)
        options(Comparison, dict(keys), "comparison")
        with self._one, self._limited(LONG_WALL_S):
            groups = together.labelled(project, self._store, [self._store.batch_id(prefix) for prefix in batches])
            section = together.compared(project, self._store, name, groups, keys)
        declared = together.declared(groups, keys)
        command = f"sierra compare {name}"
        return {"section": section, "command": command, **self._declared(project, "comparisons", name, declared)}

    def report(self, batch: str) -> JsonView:
        """Return the address of the report of a batch, the page that `sierra report` writes, and notes on what it lacks."""
        from sierra.deliverables.report import make, recorded

        source = self._source()
        with self._one:
            try:
                with self._limited(LONG_WALL_S):
                    report = make.of_batches(replace(source, store=self._unlimited), [self._store.batch_id(batch)], self._tell)
            finally:
                self._part = ""
        address = self.tickets.issue(ServedFile("text/html; charset=utf-8", recorded.named(report)))
        return {"address": address, "notes": list(report.notes)}

    def progress(self) -> str:
        """Return the part of a report that is made now, in words; "" if none is."""
        return self._part

    def _tell(self, part: str) -> None:
        self._part = part

    def write(self, name: str, keys: Mapping[str, JsonView], file: str, kind: declarations.Kind = "figures") -> JsonView:
        """Append a figure or a comparison to `sierra.toml`, which must still have the hash `file`. Return the figures there."""
        if not self._writes:
            raise UsageError("this explorer changes no files; start it with: sierra explore --write")
        with self._one:
            found = declarations.append(self._project(), kind, name, keys, file)
        return {"figures": list(found.config.figures)}

    def stop(self) -> JsonView:
        """End the answer that is computed now."""
        if limit := self._limit:
            limit.stop(STOPPED)
        return None

    def close(self) -> None:
        """End the answer that is computed now, and close what is open."""
        while not self._one.acquire(timeout=AGAIN_S):  # several questions may wait for their turn
            self.stop()
        try:
            self._snapshots.close()
            self._frames.close()
            self._tables.close()
        finally:
            self._one.release()

    def plugins(self) -> AbstractContextManager[None]:
        """Return the context in which a question is answered: the names of plug-ins in files of the project count."""
        return current_project.within(object(), lambda: self._project().declared_plugins())

    def _project(self) -> LoadedProject:
        return self._source().project

    def _declared(
        self, project: LoadedProject, kind: declarations.Kind, name: str, keys: Mapping[str, JsonView]
    ) -> dict[str, JsonView]:
        """Return the lines that declare this, and what `write` needs to append them."""
        return {
            "toml": declarations.lines(project.file, kind, name, keys),
            "file": declarations.hash_of(project),
            "kind": kind,
            "name": name,
            "keys": dict(keys),
        }

    @contextmanager
    def _snapshot(self, batch: str | None) -> Iterator[Snapshot]:
        with self._reading(self._snapshots) as key:
            within = self._id(batch, key[0]) if batch else None
            yield self._snapshots.opened((*key, within), lambda: self._open(within))

    def _open(self, within: str | None) -> Snapshot:
        """Return a snapshot that many statements will use."""
        with ExitStack() as opening:
            snapshot = opening.enter_context(self._store.snapshot(within, theirs=True))
            snapshot.settle()
            opening.pop_all()
        return snapshot

    @contextmanager
    def _frame(self, batch: str, sql: str = "") -> Iterator[BatchData]:
        """Yield the data of a batch. `sql`: the statement of a figure, which is added to the frame as a table."""
        with self._reading(self._frames) as key:
            whole = self._id(batch, key[0])
            yield self._frames.opened((*key, whole, sql), lambda: BatchData(self._store, whole))

    @contextmanager
    def _reading(self, kept: Kept[T], wall: float | None = None) -> Iterator[tuple[object, ...]]:
        """Protect the segments of the store while a question is answered from what is kept, within the time limit.

        Yield what all answers depend on.
        """
        with self._one, closing(Shared(self._store.paths.reading)), kept, self._limited(wall):
            yield self.state(), self._store.rules()

    def _id(self, batch: str, state: object) -> str:
        """Return the id of a batch from a prefix; quickly, if the list of batches in this state of the store has it."""
        listed = self._batches.batches if self._batches and self._batches.state == state else ()
        return batch if any(one.batch == batch for one in listed) else self._store.batch_id(batch)

    @contextmanager
    def _limited(self, wall: float | None = None) -> Iterator[Limit]:
        """End what is within after the time limit, or at `stop`. Raises SierraError then."""
        self._limit = limit = Limit(self._opened.interrupt, wall or self._wall)
        try:
            with limit:
                yield limit
        finally:
            self._limit = None


def _within_limits(rules: Rules) -> Rules:
    return replace(rules, limits=rules.limits.within(LIMITS))


def _keys(figure: Figure) -> JsonView:
    keys: JsonView = figure.model_dump(mode="json", exclude_unset=True, by_alias=True)
    return keys


def _rows(answer: Answer) -> dict[str, Any]:
    numeric, notes = answer.numeric, answer.notes
    first = answer.first(ROWS + 1)
    columns, rows = first.columns, first.rows()
    shown = [*_few([_value(value) for value in row] for row in rows[:ROWS])]
    cut = len(shown) < min(len(rows), ROWS)
    why = [f"the answer ends where it would have more than {LETTERS_IN_ALL:,} letters: choose fewer columns"] if cut else []
    return {
        "columns": columns,
        "numeric": numeric,
        "rows": shown,
        "more": len(shown) < len(rows),
        "notes": "; ".join(filter(None, (notes, *why))),
    }


def _few(rows: Iterable[list[JsonView]]) -> Iterator[list[JsonView]]:
    """Yield rows as long as all of them together do not have too many letters."""
    left = LETTERS_IN_ALL
    for row in rows:
        left -= sum(len(str(value)) for value in row)
        if left < 0:
            return
        yield row


def _value(value: SqlValue) -> JsonView:
    """Return a value that JSON can hold; other types become texts, and long texts are cut."""
    if value is None or isinstance(value, bool | int | float):
        return exact(value)
    text = value if isinstance(value, str) else str(value)
    return text if len(text) <= LETTERS else f"{text[:LETTERS]}… ({len(text):,} letters)"


def bounded(value: JsonView) -> JsonView:
    """Return a value with long texts and long lists cut, and with whole numbers that scripts can hold."""
    match value:
        case Mapping():
            return {name: bounded(part) for name, part in value.items()}
        case str():
            return _value(value)
        case Sequence():
            return [bounded(part) for part in value[:ROWS]]
        case _:
            return exact(value)
