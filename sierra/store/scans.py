"""The one door through which DuckDB reads and writes files: nothing is inferred from a path, a name or a sample.

DuckDB takes columns from folder names (`v=7`), names for patterns (`robot[0].csv` reads `robot0.csv`), endings for
compression, and samples for types. Every function here names each such feature and turns it off; no other module may call
a table function that reads files, which a test checks.

A pattern's characters cannot be escaped everywhere (DuckDB 2.0 fails in folders, and where it may read one folder alone), so
DuckDB never gets a path that has one: `steady` names the same file through an open folder, `Aliases` through a link.
"""

from __future__ import annotations

import os
import re
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import TracebackType

from sierra.errors import Missing
from sierra.store.names import quote

ODD = re.compile(r"^~|[*?\[\udc80-\udcff]")
"""What DuckDB does not take literally in a path: patterns, the home folder, and bytes that are no UTF-8."""
OPEN = "/proc/self/fd"
"""Where Linux has a process's open files by number."""
UNNAMED = "cannot be read under this name here; rename what has one of the characters ~ * ? [ in its name"
UNGUESSED = "hive_partitioning = false, hive_types_autocast = false"

_open: dict[str, int] = {}
"""Open folders, by their path, as `steady` uses them: as many as there are stores in odd places."""


def read_parquet(
    files: Sequence[str],
    *,
    union: bool = False,
    filename: bool = False,
    rows: bool = False,
    schema: Mapping[str, str] | None = None,
) -> str:
    """Return the relation of these files' rows.

    `union`: columns are found by their names in each file; else all files have those of the first. `filename`: also the file
    that a row is from. `rows`: that, and the row's place in it. `schema`: the columns of these names and types, and NULL where
    a file does not have one.
    """
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
    """Return the relation of the rows of $files, whose columns may differ, with a column called `file` for the path."""
    return f"read_parquet($files, {UNGUESSED}, union_by_name = true, filename = {quote(file)}, file_row_number = false)"


def parquet_schema(files: Sequence[str] = ()) -> str:
    """Return the relation of what the footers of these files, else of $files, say of columns."""
    return f"parquet_schema({f'[{_listed(files)}]' if files else '$files'})"


def parquet_metadata(file: str) -> str:
    """Return the relation of what a file's footer says of its row groups."""
    return f"parquet_metadata({quote(steady(file))})"


def csv_given(columns: Mapping[str, str], file: str, *, delimiter: str, header: bool, longest: int | None = None) -> str:
    """Return the relation of the rows of $files, of columns with these types, with a column called `file` for the path.

    `longest`: the bytes of the longest line, where DuckDB's own limit is too low.
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
    """Return the relation of the lines of $files, each as JSON, with a column called `file` for the path."""
    return (
        f"read_ndjson_objects($files, {UNGUESSED}, union_by_name = false, filename = {quote(file)}, "
        "format = 'newline_delimited', compression = 'none', ignore_errors = false)"
    )


def copy(rows: str, target: Path) -> str:
    """Return the statement that writes the rows of a query, in their order, to one Parquet file."""
    options = "FORMAT parquet, COMPRESSION zstd, PER_THREAD_OUTPUT false, PRESERVE_ORDER true, USE_TMP_FILE false"
    return f"COPY ({rows}) TO {quote(steady(str(target)))} ({options})"


def steady(path: str) -> str:
    """Return a name of the same file that DuckDB takes literally. Raises Missing where there is none."""
    if not ODD.search(path):
        return path
    folder = _odd_folder(path)
    return f"{OPEN}/{_descriptor(folder)}{path[len(folder) :]}"


def check_folder(path: Path) -> None:
    """Check that files in a folder can be read and written by their names. Raises Missing."""
    try:
        str(path).encode()
    except UnicodeEncodeError as error:
        shown = os.fsencode(path).decode("utf-8", "backslashreplace")
        raise Missing(f"{shown}: no store can be in a folder whose name is no UTF-8; rename it") from error
    if ODD.search(str(path)) and not Path(OPEN).is_dir():
        raise Missing(f"{path}: {UNNAMED}")


def _odd_folder(path: str) -> str:
    """The beginning of a path up to its last odd name, which must be a folder's."""
    *_, last = ODD.finditer(path)
    end = path.find("/", last.end())
    if end < 0 or not Path(OPEN).is_dir():
        raise Missing(f"{path}: {UNNAMED}")
    return path[:end]


def _descriptor(folder: str) -> int:
    """The number of a folder that is open, and stays so."""
    found = _open.get(folder)
    try:
        if found is None or not os.path.samestat(os.fstat(found), Path(folder).stat()):
            _open[folder] = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    except OSError as error:
        raise Missing(f"{folder}: {error.strerror}") from error
    return _open[folder]


def plain(text: str) -> str:
    """Return a text, such as an error of DuckDB's, with folders called as they are."""
    for folder, descriptor in _open.items():
        text = text.replace(f"{OPEN}/{descriptor}/", f"{folder}/")
    return text


class Aliases:
    """Other names for files that have odd ones, as long as they are read; a context manager."""

    def __init__(self) -> None:
        self._folder: tempfile.TemporaryDirectory[str] | None = None
        self._count = 0

    def __enter__(self) -> Aliases:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        if self._folder is not None:
            self._folder.cleanup()

    def of(self, path: str) -> str:
        """Return a name of a file that DuckDB takes literally: mostly its own. Raises Missing where no link can be made."""
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
