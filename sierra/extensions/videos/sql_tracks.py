"""Tracks from the rows of outputs and derived tables: matrices, poses and networks.

A statement reads the rows of some consecutive times, so that memory does not grow with the number of frames.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from sierra.config.output_tables import Output
from sierra.errors import NotFound, UsageError
from sierra.extensions.videos.table import Video
from sierra.store.batch_data import BatchData, ChosenRun, OutputTable
from sierra.store.sql_names import identifier, quote
from sierra.util.arrow_columns import numpy_of
from sierra.util.lazy_definitions import regex
from sierra.util.text import like

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt
    import pyarrow as pa

    from sierra.extensions.videos.tracks import Floats, State

MOST_CELLS = 10_000
"""The largest number of rows, and of columns, that a matrix with `fill` has."""
GLOB = regex(r"[*?[]")
"""A character that makes the name of a file a pattern."""
AT_ONCE = 200_000
"""The number of rows that one statement reads, unless a single time has more."""
Columns = Mapping[str, "npt.NDArray[np.generic]"]


@dataclass(frozen=True)
class TrackSource:
    """One output of a batch, as a source of tracks. Several threads may use it; they read one after the other."""

    frame: BatchData
    output: OutputTable
    time: str
    """The time column."""
    per_second: Mapping[int, float] = field(default_factory=dict)
    """By position of the experiment: the number by which its times are divided."""
    lock: threading.Lock = field(default_factory=threading.Lock)

    def sql(self, statement: str) -> pa.Table:
        with self.lock:
            return self.frame.sql(statement)

    def relation(self, run: ChosenRun) -> str:
        with self.lock:
            return self.frame.rows_of_run(self.output.name, run, self.time)

    def check(self, columns: Sequence[str], *, numeric: bool) -> None:
        """Raise NotFound for a column that does not exist, or that is not numeric but should be."""
        known = self.output.columns if numeric else self.output.all_columns
        for column in columns:
            if column not in known:
                what = "numeric column" if numeric else "column"
                raise NotFound(f"output {self.output.name!r} has no {what} {column!r}; {like(column, known)}")

    def shown(self, columns: Sequence[str], runs: Sequence[ChosenRun]) -> str:
        """Return the statement, for `sierra sql`, whose rows a video of these runs shows."""
        names = ", ".join(dict.fromkeys(map(identifier, ("run", self.time, *columns))))
        ids = ", ".join(dict.fromkeys(quote(run.run) for run in runs))
        derived = self.frame.statements(self.output.name)
        statement = (
            f"SELECT {names} FROM {identifier(self.output.name)} WHERE run IN ({ids}) ORDER BY run, {identifier(self.time)}"
        )
        return f"{derived}\n\n{statement}" if derived else statement


def shown_files(output: Output, batch: str, runs: Sequence[ChosenRun]) -> str:
    """Return the statement, for `sierra sql`, whose rows are the files that a video of these runs of a batch shows."""
    ids = ", ".join(dict.fromkeys(quote(run.run) for run in runs))
    effective = f"SELECT execution FROM effective WHERE batch = {quote(batch)} AND run IN ({ids})"
    files = f"execution IN ({effective}) AND {_belongs(output)}"
    return f"SELECT run, path, sha256 FROM artifacts WHERE {files} ORDER BY run, path"


def _belongs(output: Output) -> str:
    """Return the condition that the files of an output meet, and no others: see `Output.matches`."""
    if output.ticks or output.rotated:
        return f"regexp_full_match(path, {quote(output.numbered.pattern)})"
    file = quote(output.file.removeprefix("./"))
    return f"(path = {file} OR path GLOB {file})" if GLOB.search(output.file) else f"path = {file}"


class Rows:
    """The rows of one run by time. `columns` are SQL expressions by name."""

    def __init__(self, source: TrackSource, run: ChosenRun, columns: Mapping[str, str]) -> None:
        self.source, self.run, self._columns = source, run, columns
        self.relation = source.relation(run)
        counted = source.sql(f'SELECT "# t" AS t, count(*) AS rows FROM {self.relation} GROUP BY ALL ORDER BY ALL')
        t, counts = numpy_of(counted.column("t")), numpy_of(counted.column("rows"))
        import numpy as np

        good = np.isfinite(t.astype(np.float64))
        self.timeless = int(counts[~good].sum())
        """The number of rows without a finite time, which belong to no frame."""
        self._raw: Floats = t[good].astype(np.float64)
        self.counts: npt.NDArray[np.int64] = counts[good]
        """The number of rows at each time."""
        self.times: Floats = self._raw / source.per_second.get(run.experiment, 1.0)

    def each(self) -> Iterator[Columns]:
        """Yield the columns of the rows at each time."""
        import numpy as np

        selected = ", ".join(f"{expression} AS {name}" for name, expression in self._columns.items())
        for begin, end in self._windows():
            low, high = self._raw[begin].item(), self._raw[end - 1].item()
            table = self.source.sql(
                f'SELECT {selected} FROM {self.relation} WHERE "# t" BETWEEN {low!r}::DOUBLE AND {high!r}::DOUBLE '
                'ORDER BY "# t", "# file", "# row"'
            )
            columns = {name: numpy_of(table.column(name)) for name in self._columns}
            ends = np.cumsum(self.counts[begin:end])
            for first, last in zip([0, *ends[:-1].tolist()], ends.tolist(), strict=True):
                yield {name: column[first:last] for name, column in columns.items()}

    def _windows(self) -> Iterator[tuple[int, int]]:
        """Yield ranges of times that have at most `AT_ONCE` rows together, or are a single time."""
        begin, rows = 0, 0
        for place, count in enumerate(self.counts.tolist()):
            if place > begin and rows + count > AT_ONCE:
                yield begin, place
                begin, rows = place, 0
            rows += count
        if begin < len(self.counts):
            yield begin, len(self.counts)

    def at(self, place: int) -> str:
        """Return a time for messages, with its run."""
        return f"run {self.run.number} of experiment {self.run.experiment} at {self.source.time} {self._raw[place]:g}"


class Matrices:
    """Matrices whose cells are rows: number of the row, number of the column, value."""

    def __init__(self, source: TrackSource, video: Video, runs: Sequence[ChosenRun]) -> None:
        source.check(video.columns, numeric=True)
        self.columns = video.columns
        i, j, value = (f"{identifier(name)}::DOUBLE" for name in video.columns)
        self.rows = [Rows(source, run, {"i": i, "j": j, "value": value}) for run in runs]
        places = [self._places(source, one) for one in (i, j)]
        if video.fill is not None:
            places = [completed(found, name) for found, name in zip(places, video.columns, strict=False)]
        self.up, self.across = places
        self.tracks = [_Matrix(rows, self, video.fill) for rows in self.rows]

    @property
    def shape(self) -> tuple[int, int]:
        return len(self.up), len(self.across)

    def _places(self, source: TrackSource, expression: str) -> Floats:
        """Return the numbers of the rows, or of the columns, in any frame."""
        import numpy as np

        found = [
            numpy_of(source.sql(f"SELECT DISTINCT {expression} AS place FROM {rows.relation}").column("place"))
            for rows in self.rows
        ]
        every = np.unique(np.concatenate(found).astype(np.float64))
        return every[np.isfinite(every)]


def completed(numbers: Floats, name: str) -> Floats:
    """Return ascending numbers of rows or columns with those between them that lack, if they are whole.

    The distance of all is the greatest common divisor of the distances, so that rows without any value are not cut out of a
    picture. Raises UsageError if there are too many.
    """
    import numpy as np

    if len(numbers) < 3 or not (numbers == np.round(numbers)).all() or np.abs(numbers).max() > 2**53:
        return numbers
    step = int(np.gcd.reduce(np.diff(numbers).astype(np.int64)))
    count = int(numbers[-1] - numbers[0]) // step + 1
    if count > MOST_CELLS:
        span = f"from {numbers[0]:g} to {numbers[-1]:g}"
        raise UsageError(f"{name}: {count} numbers {span} are too many cells; at most {MOST_CELLS} are possible")
    every: Floats = numbers[0] + np.arange(count) * float(step)
    return every


class _Matrix:
    def __init__(self, rows: Rows, grid: Matrices, fill: float | None) -> None:
        self._rows, self._grid, self._fill = rows, grid, fill
        self.times = rows.times

    def states(self) -> Iterator[State]:
        import numpy as np

        high, wide = self._grid.shape
        last: tuple[Columns, npt.NDArray[np.intp]] | None = None
        for index, columns in enumerate(self._rows.each()):
            same = last is not None and all(np.array_equal(columns[name], last[0][name]) for name in ("i", "j"))
            cells = last[1] if same and last is not None else self._cells(columns, index)
            last = columns, cells
            values = np.full(high * wide, np.nan if self._fill is None else self._fill)
            values[cells] = columns["value"]
            yield (values.reshape(high, wide),)

    def _cells(self, columns: Columns, index: int) -> npt.NDArray[np.intp]:
        """Return the place of each row in the matrix. Raises UsageError unless each cell has exactly one row."""
        import numpy as np

        i, j = (columns[name].astype(np.float64) for name in ("i", "j"))
        where = f"output {self._rows.source.output.name!r}, {self._rows.at(index)}"
        if not (np.isfinite(i).all() and np.isfinite(j).all()):
            raise UsageError(f"{where}: a row has no number of its row or column in the matrix")
        high, wide = self._grid.shape
        cells: npt.NDArray[np.intp] = np.searchsorted(self._grid.up, i) * wide + np.searchsorted(self._grid.across, j)
        counts = np.bincount(cells, minlength=high * wide)
        if counts.max(initial=0) > 1:
            cell = int(counts.argmax())
            up, across = self._grid.up[cell // wide], self._grid.across[cell % wide]
            named = f"{self._grid.columns[0]} {up:g}, {self._grid.columns[1]} {across:g}"
            raise UsageError(f"{where}: {counts[cell]} rows for the cell {named}; make one by sql")
        if self._fill is None and (lacking := int((counts == 0).sum())):
            raise UsageError(
                f"{where}: {lacking} of {high} × {wide} cells have no row (set fill to their value if runs leave cells out)"
            )
        return cells


class Grids:
    """Matrices whose rows are the rows of a table at one time."""

    def __init__(self, source: TrackSource, video: Video, runs: Sequence[ChosenRun]) -> None:
        import numpy as np

        numeric = tuple(name for name in source.output.columns if name != source.time)
        source.check(video.columns, numeric=True)
        self.columns = video.columns or numeric
        if not self.columns:
            raise NotFound(f"output {source.output.name!r} has no numeric column beside {source.time!r}")
        expressions = {f"c{index}": f"{identifier(name)}::DOUBLE" for index, name in enumerate(self.columns)}
        self.rows = [Rows(source, run, expressions) for run in runs]
        high = next((int(rows.counts[0]) for rows in self.rows if len(rows.counts)), 0)
        for rows in self.rows:
            if len(wrong := np.flatnonzero(rows.counts != high)):
                raise UsageError(
                    f"output {source.output.name!r}, {rows.at(int(wrong[0]))}: a matrix of {rows.counts[wrong[0]]} rows, "
                    f"but the first one has {high}; all matrices of a video need the same shape"
                )
        self.up, self.across = np.arange(float(high)), np.arange(float(len(self.columns)))
        self.tracks = [Stacked(rows) for rows in self.rows]

    @property
    def shape(self) -> tuple[int, int]:
        return len(self.up), len(self.across)


class Stacked:
    """The rows of a run: each time has one array, with a column for each column of the rows."""

    def __init__(self, rows: Rows) -> None:
        self._rows, self.times = rows, rows.times

    def states(self) -> Iterator[State]:
        import numpy as np

        for columns in self._rows.each():
            yield (np.column_stack([column.astype(np.float64) for column in columns.values()]),)
