"""The store: immutable segments of records, queried with SQL.

The data are files that are only ever added (see `sierra.store.segments`). DuckDB reads them through views that are created
anew for each snapshot. So any number of processes can write at the same time, and none waits for another. There is no
catalogue that could disagree with the files.
"""

from __future__ import annotations

import contextlib
import copy
import re
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, TypeVar

from sierra.errors import Damaged, Missing, NotFound, SqlError
from sierra.store import index_files
from sierra.store.connections import Connection, Rows
from sierra.store.derived_tables import DerivedTables, Rules
from sierra.store.duckdb_file_io import check_folder, plain, read_parquet
from sierra.store.duckdb_messages import check_shortage, explain
from sierra.store.index_files import IndexFile
from sierra.store.index_reader import Index, attach, facts_of
from sierra.store.layout import StorePaths
from sierra.store.listing import Listing
from sierra.store.read_lock import Shared
from sierra.store.row_mapper import R, V, typed, values
from sierra.store.segments import FORMAT, FORMATS, Segment, Writer, disk_errors, names_in, on_disk
from sierra.store.sql_names import identifier, stored_names, unnested
from sierra.store.sql_result import Answer, RawRow, SqlValue
from sierra.store.statement import check_describes, checked, kinds
from sierra.store.table_layout import TableLayout
from sierra.store.type_inference import DURATION
from sierra.store.verified_files import verify
from sierra.store.views import KEPT_OBJECTS, Views, lists_tables, recording, tables_of
from sierra.util.fs import is_gone, write_whole
from sierra.util.lazy_definitions import regex
from sierra.util.regular_files import open_regular
from sierra.util.shortage import shortage

if TYPE_CHECKING:
    import duckdb
    import pyarrow as pa

    from sierra.model import Value

FORMAT_BYTES = 100
"""The limit on the bytes that are read from the file `format`."""
CACHEDIR = (
    "Signature: 8a477f597d28d172789f06886806bc55\n"
    "# This folder was made by SIERRA and holds recorded experiments: do not delete it as if it were a cache.\n"
)
NOTE = "sierra:note"
"""The key, in the metadata of a result's schema, of notes for the reader of the result."""
GITIGNORE = b"*\n"
UNFINISHED = (".format.", "..gitignore.", ".CACHEDIR.TAG.")
"""The name prefixes of unfinished files while a store is created."""
PREFIX = regex(r"[0-9a-f]{4,64}")
KINDS = {int: "BIGINT", float: "DOUBLE"}
"""The SQL types of the numbers in temporary tables."""


Converted = TypeVar("Converted")


PLAIN = regex(r"(?i)\s*select\b[^;]*\Z")
"""A statement that can only be one SELECT, so that SIERRA's own ones are not parsed twice."""
DESCRIBES = regex(r"(?i)\s*(describe|summarize)\b")
DURATIONS = f"""
SELECT DISTINCT table_layout FROM all_artifacts WHERE kind = 'table' AND lower(output) = lower($output)
    AND contains(table_layout, '"{DURATION}"') AND execution IN ({{executions}}) ORDER BY table_layout
"""


class ResolvedId(NamedTuple):
    """The meaning of an id; `kind` is batch, experiment, run, execution, study or claim."""

    kind: str
    id: str
    batch: str | None
    """A batch to which it belongs; of a study, that of its last look, None before the first; of a registered claim, None."""


MANY = 300
"""The number of segments that are in no index from which a process that only reads builds one."""
_built: set[Path] = set()
"""The stores for which this process has built an index in order to read it."""


class Store:
    """A store. It is cheap to create and holds no open files; any number of instances may be used at the same time."""

    def __init__(self, root: Path, rules: Callable[[], Rules] = Rules) -> None:
        """Open the store in the folder `root`. Raises Missing if there is none, Damaged if its format is not readable.

        `rules` returns the project's derived tables; it is called only for statements that may use one.
        """
        check_folder(root)
        self.paths = StorePaths(root)
        self.rules = rules
        self.published: list[tuple[Path, Path]] = []
        """The segments that this process has published, each with the folder in which it was written."""
        self._confined = False
        self.settings: tuple[str, ...] = ()
        """Statements that set up each snapshot's connection."""
        self.opened: Callable[[Snapshot], None] = _ignored
        """Called with each snapshot that is opened, by whoever may have to interrupt its statements."""
        self._beneath: Path | None = None
        """The folder of another store's segments, which are read too."""
        self._indexed = True
        self._replays: tuple[str, ...] = ()
        try:
            with open_regular(self.paths.format) as file:
                format_line = file.read(FORMAT_BYTES).decode("utf-8", "backslashreplace")
        except OSError as error:
            if (lack := shortage(error)) is not None:
                raise Missing(f"{self.paths.format} cannot be read: {lack}") from error
            if is_gone(str(self.paths.format)) and not any(on_disk(self.paths.segments)):
                raise Missing(f"no store in {root}: nothing has been run here yet (sierra run creates one)") from error
            reason = error.strerror or error
            raise Damaged(f"{self.paths.format}: cannot be read: {reason}; sierra fsck --repair writes it again") from error
        if format_line not in FORMATS:
            problem = f"this is {format_line.strip()[:40]!r}, but this SIERRA reads {FORMAT.strip()!r}"
            other = f"read it with the SIERRA that made it, or move {root} away and run the command again"
            remedy = other if re.fullmatch(r"sierra store \d+\n", format_line) else "sierra fsck --repair writes it again"
            raise Damaged(f"{self.paths.format}: {problem}; {remedy}")

    @classmethod
    def create(cls, root: Path) -> Store:
        """Return the store in `root`; create it if there is none. Any number of processes may do so at the same time."""
        check_folder(root)
        paths = StorePaths(root)
        if not paths.format.exists():
            with disk_errors(root):
                check_free(root)
                paths.segments.mkdir(parents=True, exist_ok=True)
                if not paths.work.is_symlink():
                    paths.work.mkdir(exist_ok=True)
                write_whole(paths.gitignore, GITIGNORE)
                write_whole(paths.cachedir_tag, CACHEDIR.encode())
                write_whole(paths.format, FORMAT.encode())
        return cls(root)

    def segments(self) -> list[Segment]:
        """Return all segments that are not ignored."""
        shared = Shared(self.paths.reading)
        try:
            return Listing(self._folders).segments
        finally:
            shared.close()

    def names(self) -> set[str]:
        """Return the names of all segments, ignored or not: another name is there when something has been recorded."""
        return {name for folder in self._folders for name in names_in(folder)}

    @property
    def _folders(self) -> list[Path]:
        return [folder for folder in (self._beneath, self.paths.segments) if folder is not None]

    def writer(self, folder: Path, batch: str) -> Writer:
        """Return a writer for a segment in `folder`, which must be in this store's file system."""
        return Writer(folder, batch)

    def publish(self, writer: Writer) -> bool:
        """Add a written segment to the store as a whole. Return False if it was empty."""
        try:
            return writer.publish(self.paths.segments)
        finally:
            if writer.published:
                self.published.append((writer.folder, writer.published))

    def replayed(self, replays: Iterable[str]) -> Store:
        """Return this store, to be read as if the executions of these replays were the only ones of their runs.

        So each statistic uses the values of the replays. Runs that failed in a replay have none. Nothing is written.
        """
        other = copy.copy(self)
        other._replays = tuple(replays)
        return other

    def confined(self) -> Store:
        """Return this store, for which a process with a limit on its memory executes statements that are not SIERRA's own."""
        other = copy.copy(self)
        other._confined = True
        return other

    def unindexed(self) -> Store:
        """Return this store, to be read without an index: for whoever checks or changes the segments themselves."""
        other = copy.copy(self)
        other._indexed = False
        return other

    @contextlib.contextmanager
    def overlay(self, folder: Path | None = None) -> Iterator[Store]:
        """Yield a temporary store that contains this store's current segments. New segments go only into the temporary store.

        It is created in `folder` or the system's temporary folder, and removed at the end.
        """
        with disk_errors(folder or Path(tempfile.gettempdir())):
            if folder is not None:
                folder.mkdir(parents=True, exist_ok=True)
            temporary = tempfile.TemporaryDirectory(prefix="sierra-beside-", dir=folder, ignore_cleanup_errors=True)
        shared = Shared(self.paths.reading)  # held until the end, so that nobody removes segments
        try:
            with temporary as root:
                other = Store.create(Path(root, "store"))
                other.rules = self.rules
                other._beneath = self.paths.segments
                yield other
        finally:
            shared.close()

    def sql(self, text: str, *, within: str | None = None, **parameters: object) -> pa.Table:
        """Return the result of one statement as an Arrow table. It can read only this store and write nothing.

        `$name` in the statement takes its value from the keyword `name`. `within` is a batch's id; it limits members, runs and
        outputs to that batch. Raises SqlError.
        """
        with self.snapshot(within, theirs=True) as snapshot:
            return snapshot.sql(text, **parameters)

    def snapshot(self, within: str | None = None, *, theirs: bool = False) -> Snapshot:
        """Open a connection whose statements all see the same state of the store, or of one batch in it.

        `theirs`: not all statements are SIERRA's own, so a confined store lets another process execute them.
        """
        shared = Shared(self.paths.reading)
        try:
            memory = self.memory if theirs else None
            usable = self._indexed and self._beneath is None and not self._replays
            snapshot = Snapshot(
                *(self.paths.root, None, within, shared),
                beneath=self._beneath,
                rules=self.rules,
                replays=self._replays,
                memory=memory,
                indexed=usable,
                fresh=theirs,
            )
            self.opened(snapshot)
            snapshot.set_up(self.settings)
            return snapshot
        except BaseException:
            shared.close()
            raise

    @property
    def memory(self) -> int | None:
        """The limit on the memory of the process for statements that are not SIERRA's own, in bytes; None for this process."""
        return self.rules().limits.memory if self._confined else None

    def rows(self, text: str, **parameters: object) -> list[dict[str, SqlValue]]:
        """Return the result of one statement as a list of rows by column."""
        with self.snapshot() as snapshot:
            return snapshot.rows(text, **parameters)

    def select(self, kind: type[R], text: str, **parameters: object) -> list[R]:
        """Return the rows of one statement as instances of a row class (see `sierra.store.row_mapper`)."""
        with self.snapshot() as snapshot:
            return snapshot.select(kind, text, **parameters)

    def values(self, kind: type[V], text: str, **parameters: object) -> list[V]:
        """Return the values of a statement with one column, none of them NULL."""
        with self.snapshot() as snapshot:
            return snapshot.values(kind, text, **parameters)

    def outputs(self) -> list[str]:
        """Return the names of all tables that runs wrote."""
        with self.snapshot() as snapshot:
            return snapshot.views.outputs

    def resolve(self, prefix: str) -> ResolvedId:
        """Return the object whose id begins with `prefix` (at least 4 digits); for a study, the batch of its last look.

        Raises NotFound for none or several, and for a study without a look.
        """
        resolved = self.identify(prefix)
        if resolved.kind == "claim":
            raise NotFound(f"claim {resolved.id[:10]} is only registered; sierra show {resolved.id[:10]} shows it")
        if resolved.kind != "study":
            return resolved
        if resolved.batch is None:
            raise NotFound(f"study {resolved.id[:10]} has no look yet; repeat its command to continue it")
        return ResolvedId("batch", resolved.batch, resolved.batch)

    def batch_id(self, prefix: str) -> str:
        """Return the id of the batch that begins with `prefix`, as `resolve` does. Raises NotFound."""
        found = self.resolve(prefix)
        if found.kind != "batch":
            raise NotFound(f"{prefix!r} is the id of another kind ({found.kind}); a batch is required here")
        return found.id

    def identify(self, prefix: str) -> ResolvedId:
        """Return the object whose id begins with `prefix`, as `resolve` does, but a study as a study."""
        text = prefix.lower()
        if not PREFIX.fullmatch(text):
            raise NotFound(f"{prefix!r} is not an id: use 4 to 64 hexadecimal digits, as shown by `sierra ls`")
        with self.snapshot() as snapshot:
            objects = snapshot.select(
                ResolvedId,
                "SELECT 'batch' AS kind, batch AS id, batch FROM batches WHERE starts_with(batch, $p) UNION "
                "SELECT 'experiment', experiment, max(batch) FROM experiments WHERE starts_with(experiment, $p) GROUP BY ALL "
                "UNION SELECT 'run', run, max(batch) FROM batch_runs WHERE starts_with(run, $p) GROUP BY ALL "
                "UNION SELECT 'execution', execution, batch FROM executions WHERE starts_with(execution, $p) "
                "UNION SELECT 'study', study, arg_max(l.batch, l.number) FROM studies LEFT JOIN looks l USING (study) "
                "WHERE starts_with(study, $p) GROUP BY ALL "
                "UNION SELECT 'claim', claim, NULL FROM registered_claims WHERE starts_with(claim, $p) GROUP BY ALL "
                "ORDER BY 1, 2 LIMIT 20",
                p=text,
            )
        if not objects:
            raise NotFound(f"no batch, experiment, run, execution or study begins with {prefix!r}; sierra ls lists the batches")
        if len(objects) > 1:
            shown = ", ".join(f"{match.id[:16]} ({match.kind})" for match in objects[:6])
            raise NotFound(f"{prefix!r} is ambiguous: {shown}{', …' if len(objects) > 6 else ''}")
        return objects[0]

    def object(self, digest: str) -> bytes:
        """Return the content of a recorded file by its SHA-256. Raises NotFound or Damaged."""
        from sierra.util.hashing import sha256

        with self.snapshot() as snapshot:
            source = snapshot.views.contents([digest])
            rows = snapshot.run(
                f"SELECT DISTINCT ON (part) content FROM {source} WHERE sha256 = $d ORDER BY part", {"d": digest}
            )
        if not rows:
            raise NotFound(f"no recorded file has the SHA-256 {digest}")
        content = b"".join(row[0] for row in rows)
        if sha256(content) != digest:
            raise Damaged(f"the recorded file {digest} differs from the record")
        return content

    def kept(self, digest: str) -> bytes | None:
        """Return the content of a recorded file by its SHA-256; None if the store does not keep it. Raises Damaged."""
        try:
            return self.object(digest)
        except NotFound:
            return None

    def blob(self, blob: str) -> bytes | None:
        """Return the content of a source file by its git hash; None if only git has it. Raises NotFound or Damaged."""
        found = self.values(str, "SELECT sha256 FROM blobs WHERE blob = $b LIMIT 1", b=blob)
        return self.object(found[0]) if found else None


def _ignored(_: Snapshot) -> None:
    """Do nothing."""


def check_free(root: Path) -> None:
    """Raise Missing if a folder has no store but holds files that are not part of a store."""
    paths = StorePaths(root)
    held = sorted(path.name for path in root.iterdir()) if root.is_dir() else []
    strange = [name for name in held if name not in paths.NAMES and not name.startswith(UNFINISHED)]
    if paths.gitignore.is_file() and paths.gitignore.read_bytes() not in (b"", GITIGNORE):
        strange.append(paths.gitignore.name)
    if strange and not paths.format.exists():
        raise Missing(
            f"{root} contains other files ({strange[0]!r}) and no store; move them away, and sierra run creates a store there"
        )


class Snapshot:
    """A context manager for one connection to one state of the store."""

    def __init__(
        self,
        root: Path,
        segments: Sequence[Segment] | None = None,
        within: str | None = None,
        shared: Shared | None = None,
        *,
        beneath: Path | None = None,
        rules: Callable[[], Rules] = Rules,
        replays: Sequence[str] = (),
        memory: int | None = None,
        indexed: bool = False,
        fresh: bool = False,
    ) -> None:
        """`segments`: those to read; by default, the current ones. `shared`: the lock that protects them from removal until the
        snapshot is closed.

        `beneath`: the folder of segments that belong to another store. `rules` returns the derived tables. `replays`: those
        that count, see `Store.replayed`. `memory`: see `Store.memory`. `indexed`: use an index, if there is one. `fresh`: with
        no view that an earlier snapshot has made, because users' statements could list it.
        """
        self._paths = StorePaths(root)
        self._shared = shared
        self._reading: Rows | None = None
        self._settled = False
        self._has_tables = False
        self._given = segments, within, replays, memory, rules
        self._fresh = fresh
        self._folders = [*([beneath] if beneath else []), self._paths.segments]
        self._open(index_files.best(self._paths) if indexed else None)
        if indexed and len(self.listing.rest) >= MANY and self._paths.root not in _built:
            self._build_index()

    def _build_index(self) -> None:
        """Build an index and use it, once in a process: whoever records builds one before so many segments are in none."""
        from sierra.store import index_builder

        _built.add(self._paths.root)
        index_builder.keep_up(self._paths)
        self._opened.close()
        self._open(index_files.best(self._paths))

    def _open(self, file: IndexFile | None) -> None:
        """Open a connection with an index, or without one; also without one that cannot be used."""
        import duckdb

        segments, within, replays, memory, rules = self._given
        self._index: Index | None = None
        self._attached = file
        folders = self._folders[::-1]
        facts = None
        if file is not None:
            try:
                self._opened = Connection(*folders, memory=memory, attached=attach(file))
                facts = facts_of(file, lambda statement: self._opened.cursor.execute(statement).fetchall())
            except duckdb.Error as error:  # not an IOException: it is no fault of the index if locks or /proc do not work
                if not isinstance(error, duckdb.IOException | duckdb.InterruptException | duckdb.OutOfMemoryException):
                    index_files.remove(file.path)
        if facts is None:
            self._opened = Connection(*folders, memory=memory)
        try:
            self.listing = Listing(self._folders, facts, segments)
        except BaseException:
            self._opened.close()
            raise
        if self.listing.facts is not None:
            self._index = Index(self.run, self.listing, self.listing.facts)
        elif facts is not None:  # it cannot tell which of its segments are current
            self._attached = None
            self._opened.close()
            self._opened = Connection(*folders, memory=memory)
        try:
            self.views = self._views(within, replays)
        except Damaged:
            self._opened.close()
            if self._index is None:
                raise
            self._open(None)
            return
        self.derived = DerivedTables(lambda: self.connection, self.views, rules, self.views.outputs)

    def _views(self, within: str | None, replays: Sequence[str]) -> Views:
        """Return the views of these segments, with those of earlier snapshots unless users' statements could list them."""
        rest = self._opened.rest if not self._fresh and self._given[0] is None else None
        views = Views(lambda: self.connection, self.listing, within, replays, self._index, rest)
        self._opened.take_over(views.inherit if rest else lambda kept: False)
        if rest is None:
            self._opened.rest.clear(self._opened.cursor.execute)
        return views

    @property
    def segments(self) -> Sequence[Segment]:
        """All segments that are not ignored. With an index, each of them is looked at only now."""
        return self.listing.segments

    @property
    def connection(self) -> duckdb.DuckDBPyConnection:
        """The connection, free for a statement: rows that are still being read are kept in memory."""
        if self._reading is not None:
            self._reading.finish()
            self._reading = None
        return self._opened.cursor

    def __enter__(self) -> Snapshot:
        return self

    def __exit__(self, kind: type[BaseException] | None = None, *_: object) -> None:
        if kind is Damaged and self._attached is not None:  # no file of a segment, which is a DamagedFile
            index_files.remove(self._attached.path)
        if kind is None and not self._settled:
            self._opened.keep(self.views, drop=self._fresh)
        else:
            self._opened.close()
        self.unlock()

    def set_up(self, settings: Sequence[str]) -> None:
        """Execute statements that set up the connection, for all statements to come."""
        self.derived.settings = tuple(settings)
        for setting in settings:
            self.run(setting)

    def settle(self) -> None:
        """Compute once what each statement on an output needs: worth it for a snapshot that answers many statements."""
        self._settled = True
        self.views.settle()

    def unlock(self) -> None:
        """Free the lock that protects the segments from removal. Whoever uses the snapshot afterwards must hold it."""
        if self._shared is not None:
            self._shared.close()

    def verify(self) -> None:
        """Raise Damaged if a file that statements have read has been damaged since."""
        self.views.verify()

    def interrupt(self) -> None:
        """End the statement that another thread executes on this snapshot, if there is one; it raises SqlError there."""
        import duckdb

        with contextlib.suppress(duckdb.ConnectionException):  # it has been closed
            self._opened.cursor.interrupt()

    def sql(self, text: str, **parameters: object) -> pa.Table:
        """Return the result of one statement that only reads, as an Arrow table. Raises SqlError."""

        def table(answer: Answer) -> pa.Table:
            made = answer.arrow()
            return made.replace_schema_metadata({NOTE: answer.notes}) if answer.notes else made

        return self.ask(text, parameters, table, theirs=True)

    def select(self, kind: type[R], text: str, **parameters: object) -> list[R]:
        """Return the rows of one statement that only reads as instances of a row class. Raises SqlError."""
        return self.ask(text, parameters, partial(typed, kind))

    def values(self, kind: type[V], text: str, **parameters: object) -> list[V]:
        """Return the values of a statement that only reads and has one column, none of them NULL. Raises SqlError."""
        return self.ask(text, parameters, partial(values, kind))

    def rows(self, text: str, **parameters: object) -> list[dict[str, SqlValue]]:
        """Return the result of one statement that only reads, as rows by column. Raises SqlError."""
        return self.ask(text, parameters, lambda found: [dict(zip(found.columns, row, strict=True)) for row in found.rows()])

    def ask(
        self, text: str, parameters: Mapping[str, object], convert: Callable[[Answer], Converted], *, theirs: bool = False
    ) -> Converted:
        """Return the converted result of one statement that only reads. Raises SqlError.

        `theirs`: the statement is not SIERRA's own; it may use derived tables, and functions that act are refused.
        """
        import duckdb

        with self.errors():
            read = self._only_reads(text, parameters, theirs=theirs)
            if theirs and lists_tables(text):  # also those of the index
                self._leave_index()
            try:
                return self._asked(read, text, parameters, convert, theirs=theirs)
            except (Damaged, duckdb.Error) as error:
                broken = (Damaged, duckdb.Error, duckdb.InternalException, duckdb.FatalException)
                # a message about a name proposes others, also tables of the index
                of_names = (duckdb.IOException, duckdb.BinderException, duckdb.CatalogException)
                left = self._attached
                if (type(error) not in broken and not isinstance(error, of_names)) or not self._leave_index():
                    raise
                answer = self._asked(read, text, parameters, convert, theirs=theirs)
                if left is not None and type(error) in broken:
                    index_files.remove(left.path)
                return answer

    def _asked(
        self, read: str, text: str, parameters: Mapping[str, object], convert: Callable[[Answer], Converted], *, theirs: bool
    ) -> Converted:
        import duckdb

        tables = tables_of(text)
        self.views.make(tables)
        notes = self._derive(read, tables) if theirs else []
        try:
            answer = self._answer(text, parameters)
        except duckdb.CatalogException:  # a table name that `tables_of` does not recognize: main.runs
            self.views.make()
            answer = self._answer(text, parameters)
        if answer is None:
            raise SqlError("the statement returns no rows; use SELECT, DESCRIBE, SUMMARIZE or SHOW TABLES")
        # a list of all tables does not need notes on columns
        told = notes if tables is None else self.views.notes
        if theirs and DESCRIBES.match(read):
            told = [*told, *self._units(tables or ())]
        return convert(Answer(answer, "; ".join(told)))

    def _leave_index(self) -> bool:
        """Go on with a new connection, without the index. Return False if there is none, or if that would lose tables."""
        if self._index is None or self._has_tables:
            return False
        settings = self.derived.settings
        self._opened.close()
        self._open(None)
        self.set_up(settings)
        if self._settled:
            self.views.settle()
        return True

    def durations(self, output: str, executions: str = "SELECT judgement FROM all_judgements") -> list[str]:
        """Return the columns of an output that have durations, in nanoseconds; `executions` is a query for those that count."""
        layouts = self.values(str, DURATIONS.format(executions=executions), output=output)
        columns = [TableLayout.load(one).columns for one in layouts]
        stored = (zip(stored_names(list(one)), one.values(), strict=True) for one in columns)
        return list(dict.fromkeys(name for one in stored for name, kind in one if kind == DURATION))

    def _units(self, tables: Iterable[str]) -> Iterator[str]:
        """Yield a note for each of these tables that has columns of durations."""
        for table in sorted(set(tables) & {name.lower() for name in self.views.outputs}):
            if columns := self.durations(table):
                yield f"durations of {table} are in ns: {', '.join(map(repr, columns))}"

    @contextlib.contextmanager
    def errors(self) -> Iterator[None]:
        """Raise DuckDB's errors as Damaged if they are about the store's files, else as SqlError for the statement.

        If something is lacking, such as open files or memory, nothing is known about the files: raise Missing.

        DuckDB's errors about statements have classes of their own. Some about damaged files have none, and name no file.
        """
        import duckdb

        try:
            yield
        except duckdb.Error as error:
            of_files = f"{self._paths.segments}/" in plain(str(error)) and not isinstance(error, duckdb.PermissionException)
            if of_files or isinstance(error, duckdb.IOException) or type(error) is duckdb.Error:
                check_shortage(error)
            if of_files:
                raise Damaged(f"the store cannot be read: {explain(error)}") from error
            if type(error) is duckdb.Error:
                raise Damaged(f"the store cannot be read: {explain(error)}; sierra fsck names damaged files") from error
            raise SqlError(explain(error)) from error

    def _answer(self, text: str, parameters: Mapping[str, object]) -> duckdb.DuckDBPyRelation | None:
        return self.connection.sql(text, params=parameters) if parameters else self.connection.sql(text)

    def _derive(self, text: str, tables: set[str] | None) -> list[str]:
        """Make the derived tables that a statement uses; if it may list tables, return notes on those that cannot be made."""
        check_describes(self.connection, text)
        if "parquet" in text.lower():  # it may read files by their paths
            verify(path for segment in self.segments for path in segment.files.values())
        for name in self.derived.used_by(text):
            self.derived.make(name)
        return self.derived.list() if tables is None else []

    def _only_reads(self, text: str, parameters: Mapping[str, object], *, theirs: bool) -> str:
        """Return the statement without EXPLAIN, after checking that it only reads. Raises SqlError."""
        text = re.sub(r"(?is)^\s*explain\s+(analyze\s+)?", "", text)
        if theirs or not PLAIN.match(text):
            named = kinds(self.connection, text)
            if len(named) != 1:
                raise SqlError(f"use one statement at a time; this is {len(named)}")
            if named != ["SELECT"]:
                raise SqlError(f"the store is read-only here; {named[0]} statements are not allowed")
        for value in parameters.values():
            if isinstance(value, str):
                checked(value)
        return text

    def recording(self, judgements: str, batches: Iterable[str] | None = None) -> list[Segment]:
        """Return the segments that contain first or later judgements; `judgements` is a query for these.

        `batches`: the first 12 digits of the batches that have recorded them, if they are known.
        """
        wanted = None if batches is None else set(batches)
        rest = [segment for segment in self.listing.rest if wanted is None or segment.batch in wanted]
        indexed = self._index.recording(judgements) if self._index else []
        return self.listing.named([*(one.name for one in recording(self.run, rest, judgements)), *indexed])

    def holding(self, digests: Iterable[str]) -> list[Segment]:
        """Return the segments that may contain recorded files with these SHA-256s."""
        indexed = self._index.holding(digests) if self._index else []
        rest = (segment.name for segment in self.listing.rest if "objects" in segment.files)
        return self.listing.named([*rest, *indexed])

    def kept_sizes(self, digests: Iterable[str]) -> dict[str, int]:
        """Return those of these SHA-256s whose contents the store keeps, with the sizes in bytes."""
        if not self.holds("objects"):
            return {}
        self.add_table("asked_contents", sha256=sorted(set(digests)))
        self.views.make((KEPT_OBJECTS,))
        kept = f"{identifier(KEPT_OBJECTS)} SEMI JOIN asked_contents USING (sha256)"
        return dict(self.run(f"SELECT sha256, any_value(size) FROM {kept} GROUP BY sha256"))

    def highest_indexed(self, tables: Iterable[str], column: str) -> int:
        """Return the highest value of a column of whole numbers in the indexed rows of these tables; 0 without an index."""
        return self._index.highest(tables, column) if self._index else 0

    def each(self, statement: str, parameters: Mapping[str, object]) -> Iterator[RawRow]:
        """Yield the rows of one of SIERRA's own statements, with a few thousand rows in memory at a time."""
        with self.errors():
            self._reading = rows = Rows(self.connection.execute(statement, parameters))
            yield from rows

    def cells(self, batch: str) -> dict[int, dict[str, Value | None]]:
        """Return the recorded id and the original axis values of each experiment of a batch, by its position.

        The table `experiments` can differ: there a column has one type for all batches.
        """
        own = self.listing.of_batches([batch[:12]])
        files = [segment.files["experiments"] for segment in own if "experiments" in segment.files]
        if not files:
            return {}
        rows = self.connection.sql(
            f"SELECT DISTINCT ON (ordinal) * FROM {read_parquet(files, union=True)} WHERE batch = $b ORDER BY ordinal",
            params={"b": batch},
        )
        names = rows.columns
        return {row["ordinal"]: row for row in (dict(zip(names, values, strict=True)) for values in rows.fetchall())}

    def holds(self, table: str) -> bool:
        """Check whether the store has any record of a table; much faster than a query."""
        return self.views.holds(table)

    def add_table(self, name: str, **columns: Iterable[str | int | float | None]) -> None:
        """Make a temporary table on this connection from columns of texts, of whole numbers or of fractions."""
        values = {column: list(given) for column, given in columns.items()}
        kinds = {column: KINDS.get(type(given[0]), "VARCHAR") if given else "VARCHAR" for column, given in values.items()}
        self._has_tables = True
        self.connection.execute(f"CREATE OR REPLACE TEMP TABLE {identifier(name)} AS {unnested(kinds)}", [*values.values()])

    def run(self, statement: str, parameters: Mapping[str, object] | None = None) -> list[RawRow]:
        """Execute one of SIERRA's own statements, which may create temporary tables, and return its rows."""
        self._opened.note(statement)
        self._has_tables |= statement.lstrip()[:6].upper() == "CREATE"
        with self.errors():
            return self.connection.execute(statement, parameters or {}).fetchall()
