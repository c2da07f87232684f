"""The only module through which DuckDB reads and writes files; nothing is inferred from a path, a name or a sample.

By default, DuckDB infers columns from folder names (`v=7`), treats names as patterns (`robot[0].csv` reads `robot0.csv`),
infers compression from suffixes, and infers types from samples. Every function here names each such feature and turns it
off. No other module may call a table function that reads files; a test checks this.

The characters of a pattern cannot be escaped everywhere (DuckDB 2.0 fails for folders, and if it may read only one folder).
Therefore DuckDB never gets a path with such a character: `steady` names the same file through an open folder, `Aliases`
through a symbolic link.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import TracebackType

from sierra.errors import Missing
from sierra.store.sql_names import quote
from sierra.store.verified_files import verify
from sierra.util.lazy_definitions import regex

ODD = regex(r"^~|[*?\[\\\udc80-\udcff]")
"""The parts of a path that DuckDB does not take literally: patterns, the home folder, bytes that are not UTF-8, and a backslash
in the path of an attached file.
"""
OPEN = "/proc/{}/fd"
"""The folder of the open files of a process, by its id."""
UNNAMED = "cannot be read under this name here; rename files or folders with one of the characters ~ * ? [ \\ in their names"
UNGUESSED = "hive_partitioning = false, hive_types_autocast = false"
TABLE = "sierra_table"
"""The key, in the metadata of an output's Parquet file, of the name of its table."""

_open: dict[str, int] = {}
"""The folders that `steady` holds open, by path: one for each store whose path has special characters."""


def read_parquet(
    files: Sequence[str],
    *,
    union: bool = False,
    filename: bool = False,
    rows: bool = False,
    schema: Mapping[str, str] | None = None,
    check: bool = True,
) -> str:
    """Return the relation of these files' rows. Raises Damaged if a file of a segment is not the recorded one.

    `union`: match the columns of each file by name; otherwise all files must have the columns of the first. `filename`: add the
    path of a row's file. `rows`: add that, and the row's number in the file. `schema`: the names and types of the columns; a
    column that a file does not have is NULL. `check`: verify the files; without it, the caller does so.
    """
    if check:
        verify(files)
    options = f"union_by_name = {_sql(union)}, filename = {_sql(filename or rows)}, file_row_number = {_sql(rows)}"
    if schema is not None:
        columns = (f"{quote(n)}: {{name: {quote(n)}, type: {quote(t)}, default_value: NULL}}" for n, t in schema.items())
        options += f", schema = MAP {{{', '.join(columns)}}}"
    scan = f"read_parquet([{_listed(files)}], {UNGUESSED}, {options})"
    named = "filename"
    for folder in {_odd_folder(file) for file in files if ODD.search(file)} if filename or rows else ():
        named = f"replace({named}, {quote(steady(folder + '/'))}, {quote(folder + '/')})"
    return scan if named == "filename" else f"(SELECT * REPLACE ({named} AS filename) FROM {scan})"


def parquet_given(file: str) -> str:
    """Return the relation of the rows of $files, whose columns may differ. The column named by `file` has the path."""
    return f"read_parquet($files, {UNGUESSED}, union_by_name = true, filename = {quote(file)}, file_row_number = false)"


def parquet_schema(files: Sequence[str] = ()) -> str:
    """Return the relation of the column descriptions in the footers of these files, or of $files."""
    return f"parquet_schema({f'[{_listed(files)}]' if files else '$files'})"


def arrow_schemas() -> str:
    """Return the relation of the Arrow schemas, in base64, that the footers of $files have."""
    return "(SELECT file_name, value FROM parquet_kv_metadata($files) WHERE key = 'ARROW:schema')"


def parquet_metadata(file: str) -> str:
    """Return the relation of the row group descriptions in a file's footer."""
    return f"parquet_metadata({quote(steady(file))})"


def csv_given(columns: Mapping[str, str], file: str, *, delimiter: str, header: bool, longest: int | None = None) -> str:
    """Return the relation of the rows of $files, whose columns have these types. The column named by `file` has the path.

    `longest`: the length of the longest line in bytes, if DuckDB's own limit is too low.
    """
    typed = ", ".join(f"{name}: {quote(kind)}" for name, kind in columns.items())
    limit = "" if longest is None else f", max_line_size = {longest}"
    return (
        f"read_csv($files, {UNGUESSED}, union_by_name = false, filename = {quote(file)}, columns = {{{typed}}}, "
        f"auto_detect = false, header = {_sql(header)}, delim = {quote(delimiter)}, quote = '\"', escape = '\"', "
        "nullstr = '', comment = '', skip = 0, decimal_separator = '.', thousands = '', encoding = 'utf-8', "
        "compression = 'none', ignore_errors = false, store_rejects = false, null_padding = false, "
        f"normalize_names = false, strict_mode = true{limit})"
    )


def objects_given(file: str) -> str:
    """Return the relation of the lines of $files, each as JSON. The column named by `file` has the path."""
    return (
        f"read_ndjson_objects($files, {UNGUESSED}, union_by_name = false, filename = {quote(file)}, "
        "format = 'newline_delimited', compression = 'none', ignore_errors = false)"
    )


def copy(rows: str, target: Path, table: str | None = None) -> str:
    """Return the statement that writes the rows of a query, in their order, to one Parquet file.

    `table`: the name of an output's table, which is kept in the file's metadata as `TABLE`.
    """
    options = "FORMAT parquet, COMPRESSION zstd, PER_THREAD_OUTPUT false, PRESERVE_ORDER true, USE_TMP_FILE false"
    options += f", KV_METADATA {{{TABLE}: {quote(table)}}}" if table is not None else ""
    return f"COPY ({rows}) TO {quote(steady(str(target)))} ({options})"


def steady(path: str) -> str:
    """Return a path of the same file that DuckDB takes literally. Raises Missing if there is none."""
    if not ODD.search(path):
        return path
    folder = _odd_folder(path)
    return f"{_open_files()}/{_descriptor(folder)}{path[len(folder) :]}"


def check_folder(path: Path) -> None:
    """Check that DuckDB can read and write files in a folder by their paths. Raises Missing."""
    try:
        str(path).encode()
    except UnicodeEncodeError as error:
        shown = os.fsencode(path).decode("utf-8", "backslashreplace")
        raise Missing(f"{shown}: a store cannot be in a folder whose name is not UTF-8; rename the folder") from error
    if ODD.search(str(path)) and not Path(_open_files()).is_dir():
        raise Missing(f"{path}: {UNNAMED}")


def _open_files() -> str:
    """Return the folder of this process's open files by number, on Linux; the process that executes statements reads it too."""
    return OPEN.format(os.getpid())


def _odd_folder(path: str) -> str:
    """Return the path of the last folder with a special name. Raises Missing if the file's own name is special."""
    *_, last = ODD.finditer(path)
    end = path.find("/", last.end())
    if end < 0 or not Path(_open_files()).is_dir():
        raise Missing(f"{path}: {UNNAMED}")
    return path[:end]


def _descriptor(folder: str) -> int:
    """Return the descriptor of a folder; the folder is opened once and stays open."""
    found = _open.get(folder)
    try:
        if found is None or not os.path.samestat(os.fstat(found), Path(folder).stat()):
            _open[folder] = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    except OSError as error:
        raise Missing(f"{folder}: {error.strerror}") from error
    return _open[folder]


def plain(text: str) -> str:
    """Return a text, such as a DuckDB error, with the real paths of folders."""
    for folder, descriptor in _open.items():
        text = text.replace(f"{_open_files()}/{descriptor}/", f"{folder}/")
    return text


class Aliases:
    """A context manager for temporary links to files with special names."""

    def __init__(self) -> None:
        self._folder: tempfile.TemporaryDirectory[str] | None = None
        self._count = 0

    def __enter__(self) -> Aliases:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        if self._folder is not None:
            self._folder.cleanup()

    def of(self, path: str) -> str:
        """Return a path of a file that DuckDB takes literally, usually its own. Raises Missing if no link can be created."""
        if not ODD.search(path):
            return path
        try:
            self._folder = self._folder or tempfile.TemporaryDirectory(prefix="sierra-")
            alias = Path(self._folder.name, str(self._count))
            alias.symlink_to(Path(path).absolute())
        except OSError as error:
            raise Missing(f"cannot write to {tempfile.gettempdir()}: {error.strerror}") from error
        self._count += 1
        return steady(str(alias))


def _listed(files: Sequence[str]) -> str:
    return ", ".join(quote(steady(file)) for file in files)


def _sql(value: bool) -> str:
    return str(value).lower()
