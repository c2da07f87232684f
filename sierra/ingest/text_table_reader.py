"""Formats whose fields are texts: the texts of a column decide its type."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from sierra.ingest.messages import shown
from sierra.ingest.model import AtFaultError, Found, Group, Reading, Shape, Siblings, Written
from sierra.ingest.shipped_reader_base import FILE, TableReader, these
from sierra.store.connections import Database
from sierra.store.duckdb_file_io import read_parquet
from sierra.store.duckdb_messages import first_line
from sierra.store.sql_names import identifier, quote, stored_names
from sierra.store.type_inference import (
    AS_TEXT,
    EMPTY,
    EXACT_TEXT,
    LOGICAL,
    NAN,
    TIME_KINDS,
    WHOLE,
    as_read,
    as_stored,
    bit,
    common,
    is_time,
    is_whole,
    kind_of,
    narrowest,
    odd,
    right_kind,
    sibling_kind,
    text_beside,
    time_text,
)

Target = tuple[Path, list[Written], dict[str, dict[str, str]]]
"""A Parquet file that was written, its source files, and the kinds of their columns."""
LARGE = 1 << 20
"""The size in bytes from which only the first rows of a file are used to infer the types of its columns."""
ROWS = 2000
"""The number of these rows. If others do not fit, `_write` fails; so it does for numbers that the type would round."""
AT_ONCE = 50
"""The number of columns that a statement tests side by side; DuckDB's planning cost grows with its square."""


class Text(TableReader):
    """The base class of readers of formats whose fields are texts: the texts of a column decide its type."""

    as_written = True
    """True if the text of a number with a decimal point is as in the file; False if a parser made it."""
    times = False
    """True if dates with a time are times; JSON has texts of its own."""

    def __init__(self, connection: Database, shape: Shape, target: Path, siblings: Siblings) -> None:
        super().__init__(connection, shape, target, siblings)
        self._with_nan: set[tuple[str, str]] = set()
        """The columns, each with the path of a file in which they have nan that is recorded as missing."""
        self._untimed: set[str] = set()
        """The paths of files with times that are texts, as an earlier version recorded them."""

    def read(self, files: Sequence[Written]) -> Reading:
        timed = [file for file in files if self.times]
        reading = super().read(files)
        return replace(reading, timed={(file.execution, file.name) for file in timed if file.path not in self._untimed})

    def relation(self, names: Sequence[str], types: Mapping[str, str]) -> str:
        """Return a relation on $files with the columns c0, c1, … and the file. Columns are VARCHAR or as in `types`."""
        raise NotImplementedError

    def text(self, cell: str) -> str:
        """Return the SQL expression for a cell's text, in a column of texts."""
        return cell

    def first_fault(self, file: Written, names: Sequence[str], types: Mapping[str, str]) -> str | None:
        """Return the first faulty line of a file, found by a slow search; None if there is none."""
        raise NotImplementedError

    def contradictions(self, files: Sequence[Written], found: Found) -> Iterable[tuple[Written, str]]:
        """Return files that contradict themselves, each with an error message; `found`: their types by column and path."""
        return ()

    def read_part(self, files: Sequence[Written]) -> None:
        written = self._quickly_written(files, ROWS) if any(file.bytes > LARGE for file in files) else None
        written = written or self._quickly_written(files) or self._slowly_written(files)
        for target, some, kinds in written:
            self.done(target, some, kinds)

    def _quickly_written(self, files: Sequence[Written], rows: int | None = None) -> list[Target] | None:
        """Write files with the types of a few of them, inferred from so many rows; return None if they do not fit."""
        with suppress(self.error):
            if targets := self._exactly(files, self._quickly_seen(files, self.part.names, rows)):
                return targets
        self.forget_hints(files)
        return None

    def _slowly_written(self, files: Sequence[Written]) -> list[Target]:
        """Write the valid files among these, some of which are faulty; return the same as `_write`."""
        names = self.part.names

        def explain(file: Written, error: Exception) -> str:
            return self.first_fault(file, names, _texts(names)) or first_line(error)

        self.halve(files, self._try, explain)
        files = self.sound(files)
        try:
            return (self._exactly(files, self._seen(files, names), by_text=True) or []) if files else []
        except self.error as error:
            for file in files:  # an error that a file shows alone may be hidden among many
                self.halve([file], self._try, explain)
            sound = self.sound(files)
            if len(sound) == len(files):
                raise self.unwritten(error) from error
            return self._slowly_written(sound)

    def _exactly(self, files: Sequence[Written], assumed: Found, *, by_text: bool = False) -> list[Target] | None:
        """Call `_write` until no number is rounded; return None if a text that is not a number was written as one.

        Whole numbers that DOUBLE cannot hold are kept separate from other files' fractions.
        """
        apart: frozenset[str] = frozenset()
        while True:
            targets, misread, rounded = self._write(files, assumed, apart, by_text=by_text)
            if not misread and not rounded:
                return targets
            _delete(targets)
            if misread:
                return None
            assumed = {**assumed, **{name: {**assumed[name], **kinds} for name, kinds in rounded.items()}}
            apart |= rounded.keys()

    def _write(
        self, files: Sequence[Written], assumed: Found, apart: frozenset[str], *, by_text: bool
    ) -> tuple[list[Target], bool, Found]:
        """Write the files with the types that were found, a target for each kind of values, up to the first wrong target.

        Return the targets, whether the last one is misread (see `_misread`), and the numbers that it rounds (see `_rounded`).
        `by_text`: also read numbers that DuckDB does not parse; this is slower.
        """
        if faults := list(self.contradictions(files, assumed)):
            raise AtFaultError(faults)
        kept = self._kept(files, assumed)
        targets: list[Target] = []
        try:
            paths = self.targets()
            usual = next(paths)
            for group in alike(files, kept, apart):
                # executions that will hardly be effective go where SQL does not look for types (see `Views._holding`)
                hinted = any((file.execution, file.name) in self.hints for file in group)
                path = next(paths) if hinted or targets else usual
                types = {name: common(kept[name].get(file.path) for file in group) for name in self.part.names}
                targets.append((path, group, kinds_of(group, types, assumed, kept)))
                nan = self._write_group(path, group, types, by_text=by_text)
                if not by_text and self._misread(path, group, types):
                    return targets, True, {}
                if rounded := self._rounded(path, group, types, assumed, apart):
                    return targets, False, rounded
                self.nans |= nan
        except (self.error, AtFaultError):
            _delete(targets)
            raise
        return targets, False, {}

    def _write_group(self, path: Path, files: Sequence[Written], types: Mapping[str, str], *, by_text: bool) -> set[str]:
        """Write files whose columns have the same types; return the columns in which nan becomes a missing value."""
        names = self.part.names
        of_files = {file.path for file in files}
        nan = {name for name, file in self._with_nan if file in of_files and is_whole(types[name])}
        columns = {name: self._typed(f"t.c{i}", types[name], by_text, name in nan) for i, name in enumerate(names)}
        for i, (name, stored) in enumerate(zip(names, stored_names(names), strict=True)):
            if types[name] == EXACT_TEXT:
                columns[text_beside(stored)] = f"trim({self.text(f't.c{i}')})"
        self.write(path, files, self.relation(names, _texts(names) if by_text else types), columns)
        return nan

    def _kept(self, files: Sequence[Written], assumed: Found) -> dict[str, Mapping[str, str | None]]:
        """Return the type in which each file's columns are kept: text among siblings that have text."""
        doubtful = [
            name
            for name, seen in assumed.items()
            if name in self.siblings.mixed or len({sibling_kind(kind) for kind in seen.values() if kind}) > 1
        ]
        doubtful = [name for name in doubtful if any(kind not in (None, "VARCHAR") for kind in assumed[name].values())]
        kept = dict(assumed)
        if not doubtful:
            return kept
        groups, votes = self.siblings.ask([file.run for file in files])
        for name in doubtful:
            seen = assumed[name]
            counts: dict[Group, Counter[str]] = {}
            for file in files:
                if kind := seen.get(file.path):
                    group = groups.get(file.run)
                    counts.setdefault(group, Counter(votes.get((group, name), {})))[sibling_kind(kind)] += 1
            right = {group: right_kind(kinds) for group, kinds in counts.items()}
            kept[name] = {
                file.path: "VARCHAR" if kind and right[groups.get(file.run)] == "text" else kind
                for file in files
                for kind in (seen.get(file.path),)
            }
            for file in files:
                if seen.get(file.path) in ("VARCHAR", "BOOLEAN") and right[groups.get(file.run)] == "number":
                    self._hint(file, name)
        return kept

    def _hint(self, file: Written, name: str) -> None:
        """Note the place where a file has text, if most of its siblings have numbers."""
        types = _texts(self.part.names) | {name: "DOUBLE"}
        if fault := self.first_fault(file, self.part.names, types):
            self.hints.setdefault((file.execution, file.name), {})[name] = f"{shown(file.name)}: {fault}"

    def _misread(self, target: Path, files: Sequence[Written], types: Mapping[str, str]) -> bool:
        """Check if a text that is not a number was written as one; search only if there is a sign of it."""
        names = self.part.names
        doubles = [name for name in names if as_stored(types[name]) == "DOUBLE"]
        if not doubles or not files:
            return False
        stored = dict(zip(names, stored_names(names), strict=True))
        written = read_parquet([str(target)])
        if not self._any("isinf({})", (identifier(stored[name]) for name in doubles), written, {}):
            files = [file for file in files if self.has_underscores(file)]
            if not files:
                return False
        cells = (f"c{i}" for i, name in enumerate(names) if as_stored(types[name]) == "DOUBLE")
        return self._any(odd("{}"), cells, self.relation(names, _texts(names)), these(files))

    def _rounded(
        self, target: Path, files: Sequence[Written], types: Mapping[str, str], assumed: Found, apart: Collection[str]
    ) -> Found:
        """Return the types by column and file for columns of large numbers that were written as DOUBLE.

        These are columns in which a file has only whole numbers although its type was assumed to be DOUBLE, because of other
        files or of its first rows, or in which a file has both. `assumed`: the types of columns that were assumed.
        """
        stored = dict(zip(self.part.names, stored_names(self.part.names), strict=True))
        doubles = [name for name, kind in types.items() if kind == "DOUBLE"]
        great = f"isfinite({{}}) AND abs({{}}) >= {2**53}"

        def any_great(names: Sequence[str]) -> bool:
            return self._any(great, (identifier(stored[name]) for name in names), read_parquet([str(target)]), {})

        if not doubles or not any_great(doubles):
            return {}
        seen = self._seen(files, self.part.names, [name for name in doubles if any_great([name])])
        return {
            n: kinds
            for n, kinds in seen.items()
            if EXACT_TEXT in kinds.values() or any(map(is_whole, filter(None, kinds.values())))
            if n not in apart or not kinds.items() <= assumed[n].items()
        }

    def _any(self, condition: str, cells: Iterable[str], relation: str, given: Mapping[str, list[str]]) -> bool:
        """Check if a condition holds for any of these cells in any row."""
        cells = list(cells)
        either = " OR ".join(condition.replace("{}", cell) for cell in cells)
        if len(cells) > AT_ONCE:
            relation, either = f"(SELECT unnest([{', '.join(cells)}]) AS cell FROM {relation})", condition.replace("{}", "cell")
        return bool(self.sql.execute(f"SELECT 1 FROM {relation} WHERE {either} LIMIT 1", given).fetchall())

    def has_underscores(self, file: Written) -> bool:
        """Check if a file may have an underscore within a number."""
        return False

    def _typed(self, cell: str, kind: str, by_text: bool, nan: bool = False) -> str:
        """Return the SQL expression of a cell in its column's type. A value that does not fit is an error; none is rounded.

        `nan`: in a column of whole numbers, nan is NULL.
        """
        match kind:
            case "VARCHAR":
                return self.text(cell)
            case _ if as_stored(kind) == "DOUBLE":
                text = as_read(cell) if by_text or kind == EXACT_TEXT else cell
                return f"CAST({text} AS DOUBLE)"  # also checked by `_misread`
            case "BOOLEAN":
                sound = f"regexp_full_match({cell}, {quote(LOGICAL)})"
                value = f"CAST(trim({cell}) AS BOOLEAN)"
            case _ if kind in TIME_KINDS:
                sound = is_time(cell, kind)
                value = f"CAST({time_text(cell)} AS {kind})"
            case _:
                sound = f"regexp_full_match({cell}, {quote(WHOLE)})"
                value = f"CAST({cell} AS {kind})"
        missing = f"{cell} IS NULL" + f" OR isnan(TRY_CAST({as_read(cell)} AS DOUBLE))" * nan
        return f"CASE WHEN {missing} THEN NULL WHEN {sound} THEN {value} ELSE error('not {kind}') END"

    def _try(self, files: Sequence[Written]) -> None:
        """Parse all cells of the files. Raises DuckDB's error for files that it cannot parse."""
        relation = self.relation(self.part.names, _texts(self.part.names))
        self.fetch(f"SELECT count(COLUMNS(*)) FROM {relation}", files)

    def _quickly_seen(
        self, files: Sequence[Written], names: Sequence[str], rows: int | None = None
    ) -> dict[str, dict[str, str | None]]:
        """Return each column's type by file, inferred from a few files if they leave no doubt, else from each file.

        `rows`: the number of rows of each of these few files that are used; None: all.
        """
        sample = [files[index] for index in sorted({0, len(files) // 2, len(files) - 1})]
        if rows is None:
            inferred = self._seen(sample, names)
            if len(sample) == len(files):
                return inferred
        else:
            parts = [self._seen([file], names, rows=rows) for file in sample]
            inferred = {name: {path: kind for part in parts for path, kind in part[name].items()} for name in names}
        doubtful = []
        alike: dict[str, dict[str, str | None]] = {}
        for name in names:
            kinds = {kind for kind in inferred[name].values() if kind}
            exact = EXACT_TEXT in kinds or any((name, file.path) in self._with_nan for file in sample)
            if len(set(map(kind_of, kinds))) != 1 or "VARCHAR" in kinds or exact or name in self.siblings.mixed:
                doubtful.append(name)
            else:
                kind = common(kinds)
                inferred[name] = alike.get(kind) or alike.setdefault(kind, {file.path: kind for file in files})
        return inferred | (self._seen(files, names, doubtful) if doubtful else {})

    def _seen(
        self, files: Sequence[Written], names: Sequence[str], wanted: Sequence[str] | None = None, rows: int | None = None
    ) -> dict[str, dict[str, str | None]]:
        """Return the narrowest type that holds all values, by column and file; None if a column has no values.

        `rows`: the number of rows that count; None: all.
        """
        wanted = names if wanted is None else wanted
        relation = self.relation(names, _texts(names))
        relation = relation if rows is None else f"(FROM {relation} LIMIT {rows})"
        places = {name: index for index, name in enumerate(names)}
        types: dict[str, dict[str, str | None]] = {name: {} for name in wanted}
        cells = ", ".join(f"c{places[name]}" for name in wanted)
        each = f"(SELECT {identifier(FILE)}, unnest([{cells}]) AS cell, unnest(range({len(wanted)})) AS place FROM {relation})"
        bits = bit("cell", as_written=self.as_written, times=self.times)
        for path, index, seen in self.fetch(
            f"SELECT {identifier(FILE)}, place, bit_or({bits}) FROM {each} GROUP BY 1, 2", files
        ):
            types[wanted[index]][path] = self._type(wanted[index], path, seen or 0)
        return types

    def _type(self, name: str, path: str, bits: int) -> str | None:
        """Return the narrowest type of a file's column, and note if nan is a missing value in it."""
        kind = narrowest(bits)
        if bits & NAN and kind is not None and is_whole(kind):
            self._with_nan.add((name, path))
        if kind in TIME_KINDS and name in self.siblings.texts_without("times"):
            self._untimed.add(path)
            return "VARCHAR"
        return kind


def _texts(names: Sequence[str]) -> dict[str, str]:
    """Return the type of texts for each column."""
    return dict.fromkeys(names, "VARCHAR")


def _delete(targets: Iterable[Target]) -> None:
    for path, _, _ in targets:
        path.unlink(missing_ok=True)


def alike(files: Sequence[Written], kept: Found, apart: Collection[str] = ()) -> list[list[Written]]:
    """Return the files grouped by the kinds of their columns; a column without values joins the most frequent kind.

    Files with texts beside their numbers are separate.

    `apart`: the columns in which whole numbers and decimals are kept separate from others, because DOUBLE cannot hold them.
    """

    def sort(name: str, kind: str) -> str:
        if name in apart and (is_whole(kind) or kind.startswith("DECIMAL")):
            return "whole" if is_whole(kind) else kind
        return kind if kind == EXACT_TEXT else kind_of(kind)

    kinds = {name: {path: sort(name, kind) for path, kind in seen.items() if kind} for name, seen in kept.items()}
    mixed = {name: Counter(seen.values()) for name, seen in kinds.items() if len(set(seen.values())) > 1}
    most = {name: counts.most_common(1)[0][0] for name, counts in mixed.items()}
    sorts: dict[tuple[str, ...], list[Written]] = {}
    for file in files:
        sorts.setdefault(tuple(kinds[name].get(file.path, most[name]) for name in mixed), []).append(file)
    return sorted(sorts.values(), key=lambda some: -len(some))


def kinds_of(files: Sequence[Written], types: Mapping[str, str], assumed: Found, kept: Found) -> dict[str, dict[str, str]]:
    """Return the kind of each column in each file, marked if it is kept as text."""
    by_file = {}
    same: dict[tuple[str, ...], dict[str, str]] = {}
    for file in files:
        mine = {}
        for name in types:
            kind = assumed[name].get(file.path)
            as_text = kind not in (None, "VARCHAR") and kept[name].get(file.path) == "VARCHAR"
            mine[name] = sibling_kind(kind or EMPTY) + AS_TEXT * as_text
        by_file[file.path] = same.setdefault(tuple(mine.values()), mine)
    return by_file
