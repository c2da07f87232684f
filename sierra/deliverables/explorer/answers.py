"""Answers to the questions of the explorer's page: lists, rows of SQL, charts, and the lines of `sierra.toml` that draw them.

Each answer comes from the newest state of the store, and from `sierra.toml` as it is then. Questions are answered one after the
other, each within a time limit.
"""

from __future__ import annotations

import copy
import threading
import tomllib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from datetime import UTC
from pathlib import Path
from typing import TYPE_CHECKING

from sierra.config import project_file
from sierra.config.deliverable_tables import Figure
from sierra.config.find_project import ProjectFolder
from sierra.config.plugin_registry import FIGURES
from sierra.config.project_file import LoadedProject
from sierra.config.validate import options
from sierra.deliverables.gallery import Gallery
from sierra.deliverables.html.tables import exact
from sierra.deliverables.record import origin_of
from sierra.errors import SierraError, UsageError
from sierra.execution import list_batches
from sierra.store.layout import PYPROJECT
from sierra.store.samples import Frame
from sierra.store.schema import TABLE_NAMES
from sierra.store.store import Snapshot, Store
from sierra.util.fs import write_whole
from sierra.util.hashing import digest, sha256
from sierra.util.json_types import JsonView

if TYPE_CHECKING:
    from sierra.execution.list_batches import ListedBatch
    from sierra.store.sql_result import Answer, SqlValue

ROWS = 1000
"""The largest number of rows of an answer."""
LETTERS = 10_000
"""The largest number of letters of a value."""
WALL_S = 30.0
AGAIN_S = 0.1
MEMORY = "SET memory_limit = '2GB'"
COLUMNS = "SELECT table_name, column_name, data_type FROM information_schema.columns ORDER BY table_name, ordinal_position"
STOPPED = "stopped"


class Answers:
    """The answers about one project."""

    def __init__(self, load: Callable[[], LoadedProject], store: Store, *, writes: bool = False, wall: float = WALL_S) -> None:
        """`load` reads the project again. With `writes`, charts may be written to `sierra.toml`. `wall`: time limit, in s."""
        self._load = load
        self._store = copy.copy(store)
        self._store.settings = (*store.settings, MEMORY)
        self._writes = writes
        self._wall = wall
        self._one = threading.Lock()
        """Held while a question is answered."""
        self._limit: _Limit | None = None

    def overview(self) -> JsonView:
        """Return the batches, the newest first, and the choices of forms."""
        state = self.state()
        listed = list_batches.batches(self._store)
        project = self._load()
        return {
            "project": project.root.name,
            "writes": self._writes,
            "kinds": list(FIGURES.names()),
            "batches": [_batch(one) for one in reversed(listed)],
            "state": state,
        }

    def state(self) -> str:
        """Return a hash that changes whenever something is recorded or removed."""
        folder = self._store.paths.segments
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
        """Return the variables of a batch and its figures: those that are declared, or else the default ones."""
        with self._frame(batch) as frame:
            gallery = Gallery(self._load(), self._store, frame)
            figures, notes = gallery.wanted(None)
            keys = {name: _keys(figure) for name, figure in figures.items()}
            return {"variables": [axis.name for axis in frame.axes()], "figures": keys, "notes": [*notes, *gallery.notes]}

    def query(self, statement: str, batch: str | None = None) -> JsonView:
        """Return the first rows of a statement, which can only read the store."""
        with self._snapshot(batch) as snapshot:
            return snapshot.ask(statement, {}, _rows, theirs=True)

    def chart(self, batch: str, name: str, keys: Mapping[str, JsonView]) -> JsonView:
        """Return a figure as a section of a page, with the lines of `sierra.toml` that declare it."""
        from sierra.deliverables.figures import interactive
        from sierra.deliverables.figures.drawing import explorable
        from sierra.deliverables.html import section

        project, figure = self._load(), options(Figure, dict(keys), "chart")
        with self._frame(batch) as frame:
            only = {figure.table} if figure.table or figure.sql else None
            drawing, svg = explorable(Gallery(project, self._store, frame, only=only).drawing(name, figure))
        origin = origin_of(drawing.batch, drawing.data)
        content = interactive.content(drawing, b"" if drawing.charts else svg, origin)
        return {"section": section(content), "toml": lines(project.file, name, keys), "file": _hash(project.file)}

    def write(self, name: str, keys: Mapping[str, JsonView], file: str) -> JsonView:
        """Append a figure to `sierra.toml`, which must still have the hash `file`. Return the figures that it declares then."""
        if not self._writes:
            raise UsageError("this explorer changes no files; start it with: sierra explore --write")
        project = self._load()
        project.check_written()
        with self._one:
            if _hash(project.file) != file:
                raise UsageError(f"{project.file.name} has changed since the chart was drawn; draw the chart again")
            if name in project.config.figures:
                raise UsageError(f"{project.file.name} has a figure {name!r} already; choose another name")
            before = project.file.read_bytes()
            after = before.rstrip() + b"\n\n" + lines(project.file, name, keys).encode()
            found = _declared(project, after)
            write_whole(project.file, after)
        return {"figures": list(found.config.figures)}

    def stop(self) -> JsonView:
        """End the answer that is computed now."""
        if limit := self._limit:
            limit.stop(STOPPED)
        return None

    @contextmanager
    def _snapshot(self, batch: str | None) -> Iterator[Snapshot]:
        within = self._store.batch_id(batch) if batch else None
        with self._one, self._store.snapshot(within) as snapshot, self._limited(snapshot.interrupt):
            yield snapshot

    @contextmanager
    def _frame(self, batch: str) -> Iterator[Frame]:
        with self._one, Frame(self._store, self._store.batch_id(batch)) as frame, self._limited(frame.interrupt):
            yield frame

    @contextmanager
    def _limited(self, interrupt: Callable[[], None]) -> Iterator[None]:
        """Call `interrupt` after the time limit, or at `stop`. Raises SierraError if this ended what is within."""
        self._limit = limit = _Limit(interrupt, self._wall)
        try:
            with limit:
                yield
        finally:
            self._limit = None


class _Limit:
    """A context manager that interrupts what is within, again and again, once its time is over or `stop` was called."""

    def __init__(self, interrupt: Callable[[], None], wall: float) -> None:
        self._interrupt = interrupt
        self._wall = wall
        self._due, self._ended = threading.Event(), threading.Event()
        self._reason = ""
        self._watch = threading.Thread(target=self._wait, daemon=True)

    def __enter__(self) -> None:
        self._watch.start()

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: object) -> None:
        self._ended.set()
        self._due.set()
        self._watch.join()
        if self._reason and isinstance(error, SierraError):
            raise SierraError(self._reason) from error

    def stop(self, reason: str) -> None:
        self._reason = self._reason or reason
        self._due.set()

    def _wait(self) -> None:
        if not self._due.wait(self._wall):
            self.stop(f"no answer within {self._wall:g} s; ask for less, or use sierra sql, which has no time limit")
        while not self._ended.is_set():
            self._interrupt()
            self._ended.wait(AGAIN_S)


def lines(file: Path, name: str, keys: Mapping[str, JsonView]) -> str:
    """Return the lines that declare a figure in a project's file."""
    import tomlkit

    figure = tomlkit.table()
    for key, value in keys.items():
        figure.add(key, list(value) if isinstance(value, tuple) else value)
    inner = {"figures": {name: figure}}
    return tomlkit.dumps({"tool": {"sierra": inner}} if file.name == PYPROJECT else inner)


def _declared(project: LoadedProject, data: bytes) -> LoadedProject:
    """Return the project whose file has other content. Raises ConfigError if that is invalid."""
    try:
        table = tomllib.loads(data.decode())
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise UsageError(f"nothing can be appended to {project.file.name}: {error}") from error
    own = table["tool"]["sierra"] if project.file.name == PYPROJECT else table
    return project_file.of_table(ProjectFolder(project.root, project.file), own)


def _hash(file: Path) -> str:
    return sha256(file.read_bytes()) if file.is_file() else ""


def _keys(figure: Figure) -> JsonView:
    keys: JsonView = figure.model_dump(mode="json", exclude_unset=True, by_alias=True)
    return keys


def _batch(one: ListedBatch) -> JsonView:
    return {
        "batch": one.batch,
        "query": one.query,
        "requested": f"{(one.submitted or one.created).astimezone(UTC):%Y-%m-%d %H:%M} UTC",
        "targets": list(one.targets),
        "experiments": one.experiments,
        "runs": one.runs,
        "failed": one.failed,
        "missing": one.missing,
        "running": len(one.clusters),
        "package": one.package,
    }


def _rows(answer: Answer) -> JsonView:
    numeric, notes = answer.numeric, answer.notes
    found = answer.first(ROWS + 1)
    columns, rows = found.columns, found.rows()
    return {
        "columns": columns,
        "numeric": numeric,
        "rows": [[_value(value) for value in row] for row in rows[:ROWS]],
        "more": len(rows) > ROWS,
        "notes": notes,
    }


def _value(value: SqlValue) -> JsonView:
    """Return a value that JSON can hold; other types become texts, and long texts are cut."""
    if value is None or isinstance(value, bool | int | float):
        return exact(value)
    text = value if isinstance(value, str) else str(value)
    return text if len(text) <= LETTERS else f"{text[:LETTERS]}… ({len(text):,} letters)"
