"""Warnings about recorded tables: properties that are allowed but probably not intended."""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import PurePosixPath
from typing import NamedTuple

from sierra.errors import SierraError
from sierra.ingest import text_headers
from sierra.ingest.consistency import GOOD, many, parameters
from sierra.ingest.delimiters import delimiter_of
from sierra.ingest.event_tables import TableSize, is_uneven, of_events, short
from sierra.ingest.json_lists import in_words
from sierra.ingest.json_rows import DOT
from sierra.ingest.match_outputs import NOTED_AT_MOST
from sierra.ingest.messages import shown
from sierra.ingest.model import PLAIN, Shape
from sierra.ingest.recording_context import Context
from sierra.store import endings
from sierra.store.sql_names import differing_by_case, identifier, quote, stored_name, stored_names
from sierra.store.store import Snapshot, Store
from sierra.store.table_layout import Columns, TableLayout
from sierra.store.time_axis import names_time
from sierra.store.type_inference import AS_TEXT, DURATION
from sierra.store.union_files import TEXT
from sierra.store.views import tables_of
from sierra.util.hashing import short as digits
from sierra.util.lazy_definitions import dataclass
from sierra.util.text import counted, few, verb

COMMENT = "the first line is a comment; begin with the column names, without {mark!r} ({keys} leaves comments out)"
UNITS = "units are below its names ({keys} reads it)"
RULES = "it has lines that are no rows ({keys} leaves them out)"
HEADER = "its names are not in its first line ({keys} reads it)"
DECIMAL = "its numbers have a decimal comma ({keys} reads them)"
TEXTS = 4
"""The largest number of texts that a proposal for `na` lists."""
NOTED_DOUBTS = 3
LENGTHS = 8
"""The number of columns that the note on lists names."""
LISTS = """
SELECT coalesce(bool_and(lists), false), max(rows) FROM (
    SELECT bool_and(starts_with({column}, '[{{')) AS lists, count(*) AS rows FROM {table} GROUP BY execution
)
"""
SEVERAL = "are these several columns? (set delimiter = {delimiter} in [outputs.{output}])"


FACTORS: Mapping[str, tuple[str, float]] = {
    **{
        name: ("s", factor) for name, factor in (("s", 1), ("ms", 1e-3), ("us", 1e-6), ("µs", 1e-6), ("μs", 1e-6), ("ns", 1e-9))
    },
    **{name: ("s", factor) for name, factor in (("ps", 1e-12), ("fs", 1e-15), ("min", 60), ("h", 3600), ("d", 86_400))},
    **{name: ("m", factor) for name, factor in (("m", 1), ("mm", 1e-3), ("cm", 1e-2), ("km", 1e3), ("um", 1e-6), ("nm", 1e-9))},
    **{name: ("g", factor) for name, factor in (("g", 1), ("mg", 1e-3), ("kg", 1e3))},
    **{name: ("bps", factor) for name, factor in (("bps", 1), ("kbps", 1e3), ("Mbps", 1e6), ("Gbps", 1e9))},
    **{name: ("B", factor) for name, factor in (("B", 1), ("kB", 1e3), ("KB", 1e3), ("MB", 1e6), ("GB", 1e9))},
    **{name: ("B", factor) for name, factor in (("KiB", 2**10), ("MiB", 2**20), ("GiB", 2**30))},
    **{name: ("Hz", factor) for name, factor in (("Hz", 1), ("kHz", 1e3), ("MHz", 1e6), ("GHz", 1e9))},
    **{name: ("W", factor) for name, factor in (("W", 1), ("mW", 1e-3), ("kW", 1e3), ("MW", 1e6))},
    **{name: ("J", factor) for name, factor in (("J", 1), ("mJ", 1e-3), ("kJ", 1e3), ("MJ", 1e6))},
    **{name: ("V", factor) for name, factor in (("V", 1), ("mV", 1e-3), ("uV", 1e-6), ("kV", 1e3))},
}
"""Units that cells may have, each with the unit that it is converted to, and by which factor."""


class _Look(NamedTuple):
    """The form of some cells of a column."""

    look: str
    cells: int
    example: str
    texts: list[str]
    """A few of the different texts, if the form is `other` or `missing`."""


class _Form(NamedTuple):
    output: str
    table_layout: str
    executions: int


@dataclass(frozen=True, slots=True)
class _Table:
    """Tables of one output with the same columns, and the number of executions that have one."""

    output: str
    columns: Columns
    executions: int


class TableWarnings:
    """The warnings about the tables of one session; `shapes` are the tables."""

    def __init__(self, store: Store, context: Context, shapes: Mapping[str, Shape]) -> None:
        self._store = store
        self._context = context
        self._shapes = shapes
        self._paths: Mapping[str, str] = {}
        """The paths of the files of tables, each of one run."""
        self._headers: dict[str, Mapping[str, object]] = {}
        """The keys that read tables whose names are not in their first line, by output."""
        self._contents: dict[str, bytes] = {}

    def all(self) -> list[str]:
        """Return the warnings, one line each.

        This queries the store, so call it once, after everything is recorded and `find_inconsistent` has checked it.
        """
        with self._store.snapshot() as snapshot:
            snapshot.views.make(tables_of(EXECUTED))
            snapshot.run(f"CREATE OR REPLACE TEMP TABLE executed AS {EXECUTED} FROM good", parameters(self._context))
            empty = list(self._empty(snapshot.values(str, EMPTY)))
            if not self._shapes:
                return empty
            rows = snapshot.select(_Form, GOOD + FORMS, **parameters(self._context))
            sizes = snapshot.select(TableSize, SIZES)
        self._paths = {row.output: TableLayout.load(row.table_layout).file or "" for row in rows}
        forms = [_Table(row.output, TableLayout.load(row.table_layout).columns, row.executions) for row in rows]
        columns = [*self._alone(forms), *self._by_case(forms), *self._renamed(forms), *self._of_kinds(forms)]
        return [*empty, *self._lengths(), *self._nans(), *self._bare(), *columns, *self._events(sizes)]

    def _events(self, rows: Sequence[TableSize]) -> Iterator[str]:
        """Yield a proposal for each strict table whose row counts differ so much that it is probably a table of events.

        Also yield doubts about runs that have far fewer rows than the others.
        """
        rows = [row for row in rows if row.output in self._shapes]
        sizes: dict[str, dict[int, list[int]]] = {}
        for row in rows:
            sizes.setdefault(row.output, {}).setdefault(row.ordinal, []).append(row.rows)
        strict = {name: by_experiment for name, by_experiment in sizes.items() if self._is_strict(name)}
        events = of_events(self._store, self._context.batch, strict)
        for name, by_experiment in strict.items():
            if is_uneven(by_experiment):
                path = min(row.path for row in rows if row.output == name)
                yield self._proposal(
                    name, path, [size for group in by_experiment.values() for size in group], events=name in events
                )
        doubtful = [doubt for doubt in short(rows) if doubt[0].output in events or not self._is_strict(doubt[0].output)]
        for row, least, most in doubtful[:NOTED_DOUBTS]:
            theirs = f"{least} to {most}" if least < most else str(most)
            whose = f"output {row.output!r} of run {digits(row.run)} has {counted(row.rows, 'row')}"
            yield f"{whose}, the other runs of its experiment have {theirs}: was the run cut short?"
        if len(doubtful) > NOTED_DOUBTS:
            more = len(doubtful) - NOTED_DOUBTS
            yield f"{counted(more, 'more run')} {verb(more, 'has', 'have')} less than half of the rows of the others"

    def _empty(self, names: Iterable[str]) -> Iterator[str]:
        """Yield a warning for each of these tables, which have no row in any run."""
        for name in names:
            declared = self._context.outputs.get(name)
            path = f", rows = {json.dumps(declared.rows, ensure_ascii=False)}" if declared and declared.rows else ""
            cure = f"min_rows = 1 in [outputs.{name}] makes such runs fail"
            yield f"output {name!r} has no row in any run{path}: is this right? ({cure})"

    def _lengths(self) -> Iterator[str]:
        """Yield a note for each table that has only the number of the items of lists."""
        for name, shape in self._shapes.items():
            if shape.lengths:
                columns = few(list(map(repr, shape.lengths)), LENGTHS)
                yield f"output {name!r} has the number of items of lists in {columns}; the items are only in its files"

    def _nans(self) -> Iterator[str]:
        """Yield a note for each table in which nan is a missing value among whole numbers that DOUBLE cannot hold."""
        for name, shape in self._shapes.items():
            if shape.nans:
                columns = few(list(map(repr, shape.nans)), LENGTHS)
                yield f"output {name!r} has nan beside very large whole numbers in {columns}; there, nan is NULL"

    def _bare(self) -> Iterator[str]:
        """Yield a note for each table that has no row for some of the elements around its rows."""
        for name, shape in self._shapes.items():
            if shape.bare:
                rows = json.dumps(shape.form.rows, ensure_ascii=False)
                message = f"output {name!r} has no row for {counted(shape.bare, 'element')} without {rows} within"
                yield f"{message}; another output of this file, with the path of these elements as rows, has them"

    def _is_strict(self, output: str) -> bool:
        declared = self._context.outputs.get(output)
        return declared is None or declared.mismatch == "strict"

    def _proposal(self, output: str, path: str, sizes: Sequence[int], *, events: bool) -> str:
        """Return the note on a table whose row counts differ; `events`: these were not compared."""
        file = "" if output in self._context.outputs else f"file = {json.dumps(path, ensure_ascii=False)}, "
        message = f"output {output!r} has {min(sizes)} to {max(sizes)} rows, a different number in most runs"
        if ended := endings.left_running(self._store, self._context.batch):
            declare = f'set {file}mismatch = "ragged" in [outputs.{output}]'
            return f"{ended}; so {message}: let the command wait for them, and only if these are events, {declare}"
        if events:
            message += ", so the numbers were not compared"
        return f'{message}; if these are events, set {file}mismatch = "ragged" in [outputs.{output}]'

    def _alone(self, forms: Sequence[_Table]) -> Iterator[str]:
        """Yield warnings about columns that only one run of the batch has, which is possible with one run per experiment."""
        sets: dict[str, Counter[tuple[str, ...]]] = {}
        for row in forms:
            sets.setdefault(row.output, Counter())[tuple(row.columns)] += row.executions
        for name, counts in sets.items():
            declared = self._context.outputs.get(name)
            alone = sum(number == 1 for number in counts.values())
            if name in self._shapes and len(counts) > 1 and alone and (declared is None or declared.mismatch == "strict"):
                whose = "one run has columns" if alone == 1 else f"{alone} runs each have columns"
                yield f"output {name!r}: {whose} that no other run has; no other run of the experiment can confirm them"

    def _by_case(self, forms: Sequence[_Table]) -> Iterator[str]:
        """Yield warnings about columns whose names differ only in upper and lower case."""
        names: dict[str, dict[str, None]] = {}
        named: dict[str, dict[str, str]] = {}
        for row in forms:
            columns = list(row.columns)
            names.setdefault(row.output, {}).update(dict.fromkeys(columns))
            named.setdefault(row.output, {}).update(zip(columns, stored_names(columns), strict=True))
        for output, all_names in names.items():
            for several in differing_by_case(all_names) if output in self._shapes else ():
                alike = sorted(several, key=str.swapcase)
                message = f"columns {_words(alike)} of output {output!r} differ only in upper and lower case, which SQL ignores"
                called = [named[output][name] for name in alike]
                if len(set(map(str.lower, called))) == len(called):
                    yield f"{message}: they are {_words(called)} in SQL"
                else:
                    yield f"{message}: they are one column, because no run has all of them; give one another name"

    def _renamed(self, forms: Sequence[_Table]) -> Iterator[str]:
        """Yield warnings about columns that have another name in SQL, because an axis has their name but other values."""
        columns: dict[str, set[str]] = {}
        for row in forms:
            columns.setdefault(row.output, set()).update(map(str.lower, row.columns))
        with self._store.snapshot(self._context.batch) as snapshot:
            axes = {axis.lower(): axis for axis in snapshot.views.axes()}
            for name in (name for name in self._shapes if not axes.keys().isdisjoint(columns.get(name, ()))):
                for axis, column, called in _hidden(snapshot, name, axes):
                    message = f"column {column!r} of output {name!r} is named {called!r} in SQL"
                    yield f"{message}, because {axis!r} is the independent variable, which has other values"

    def _of_kinds(self, forms: Sequence[_Table]) -> Iterator[str]:
        """Yield warnings about columns of different kinds in different runs, and about texts that are probably numbers."""
        kinds: dict[tuple[str, str], Counter[str]] = {}
        for row in forms:
            for name, kind in row.columns.items():
                if kind != "empty" and row.output in self._shapes:
                    kinds.setdefault((row.output, name), Counter())[kind] += row.executions
        for (output, name), counts in kinds.items():
            stored = {"text" if kind.endswith(AS_TEXT) else kind for kind in counts}
            if len(stored) > 1:
                held = ", ".join(f"{many(kind)} in {count}" for kind, count in sorted(counts.items()))
                seen = f"numbers in {name!r} and other values in {name + TEXT!r}"
                if "number" not in stored:
                    seen = f"all values as {self._type(output, name)}"
                elif stored == {"number", DURATION}:
                    seen = "all of them as numbers, of which only the durations are in ns"
                yield f"column {name!r} of output {output!r} has {held} runs; SQL shows {seen}"
        yield from self._texts(kinds)

    def _type(self, output: str, name: str) -> str:
        """Return the type in SQL of the values of a column in this batch."""
        with self._store.snapshot(self._context.batch) as snapshot:
            column = _in_sql(snapshot, output, name)
            kinds = {row[0]: str(row[1]) for row in snapshot.run(f"DESCRIBE {identifier(output)}")}
        return kinds.get(column or "", "VARCHAR").replace("VARCHAR", "text")

    def _texts(self, kinds: Mapping[tuple[str, str], Counter[str]]) -> Iterator[str]:
        """Yield warnings about columns that are text in all runs, but were probably not intended as text."""
        texts = [key for key, counts in kinds.items() if all(kind == "text" or kind.endswith(AS_TEXT) for kind in counts)]
        for output, name in texts[:NOTED_AT_MOST]:
            if message := (
                self._as_header(output)
                or self._as_one_column(kinds, output, name)
                or self._as_list(output, name)
                or self._numeric(output, name)
            ):
                runs = kinds[output, name].total()
                yield f"column {name!r} of output {output!r} is text in {counted(runs, 'run')}, so it has no figure: {message}"

    def _as_header(self, output: str) -> str | None:
        """Return the keys that read a table whose names are not in its first line, judged by the file of one run."""
        shape = self._shapes[output]
        if shape.format != "csv" or shape.form != PLAIN:
            return None
        if output not in self._headers:
            self._headers[output] = text_headers.keys_of(self._content(output)) or {}
        keys = self._headers[output]
        if not keys or not (keys.keys() - {"delimiter"} or self._content(output).lstrip().startswith((b"#", b"%"))):
            return None
        if keys.keys() == {"delimiter"}:
            return SEVERAL.format(delimiter=json.dumps(keys["delimiter"]), output=output)
        declared = output in self._context.outputs
        named = f"[outputs.{output}] {in_words(keys if declared else {'file': self._paths[output], **keys})}"
        if keys.keys() == {"decimal"}:
            return DECIMAL.format(keys=named)
        mark = keys.get("comment")
        if isinstance(mark, str) and self._content(output).lstrip().startswith(mark.encode()):
            return COMMENT.format(mark=mark, keys=named)
        if keys.keys() <= {"comment", "delimiter"}:
            return RULES.format(keys=named)
        return (UNITS if keys.get("units_row") else HEADER).format(keys=named)

    def _content(self, output: str) -> bytes:
        """Return the content of the file of one run; nothing if the store does not have it."""
        if output not in self._contents:
            rows = self._store.values(str, EXAMPLE, output=output, **parameters(self._context))
            try:
                self._contents[output] = self._store.object(rows[0]) if rows else b""
            except SierraError:
                self._contents[output] = b""
        return self._contents[output]

    def _as_one_column(self, kinds: Iterable[tuple[str, str]], output: str, name: str) -> str | None:
        """Return advice for a table that has one column because its delimiter or its header was not recognized."""
        if self._shapes[output].format != "csv" or [key for key in kinds if key[0] == output] != [(output, name)]:
            return None
        if self._shapes[output].delimiter and (other := delimiter_of(name)) in name:
            return SEVERAL.format(delimiter=json.dumps(other), output=output)
        return SEVERAL.format(delimiter='" "', output=output) if len(name.split()) > 1 else None

    def _as_list(self, output: str, name: str) -> str | None:
        """Return advice for a column whose values are lists of objects in JSON."""
        if self._shapes[output].format not in ("json", "jsonl"):
            return None
        with self._store.snapshot(self._context.batch) as snapshot:
            column = _in_sql(snapshot, output, name)
            if column is None:
                return None
            statement = LISTS.format(column=identifier(column), table=identifier(output))
            [(lists, most)] = snapshot.run(statement)
        if not lists:
            return None
        declared = self._context.outputs.get(output)
        keys: dict[str, str | bool] = {} if declared else {"file": self._paths[output]}
        if self._shapes[output].format == "json" and most == 1:
            keys["rows"] = DOT.join(filter(None, (declared.rows if declared else "", name)))
        else:
            keys |= {"unnest": name} | ({"flatten": True} if self._shapes[output].format == "jsonl" else {})
        return f"it is a list of objects ([outputs.{output}] {in_words(keys)} makes a row of each)"

    def _numeric(self, output: str, name: str) -> str | None:
        """Return advice for a column of texts that mostly look like numbers, judged by the first rows.

        A value or key is proposed only if it fits all cells.
        """
        with self._store.snapshot(self._context.batch) as snapshot:
            column = _in_sql(snapshot, output, name)
            if column is None:
                return None
            rows = [
                _Look(*row)
                for row in snapshot.run(
                    LOOKS.format(column=identifier(column), table=identifier(output), number=NUMBER, missing=MISSING)
                )
            ]
            names = [row[0] for row in snapshot.run(f"DESCRIBE {identifier(output)}")]
        looks = [look for look in rows if look.look not in ("number", "point")]
        if any(look.look in ("comma", "thousands?") for look in looks):
            looks += [look for look in rows if look.look == "point"]
        numbers = sum(
            look.cells for look in rows if look.look in ("number", "point", "comma", "thousands?", "grouped", "wrapped")
        )
        units = [look for look in looks if look.look.startswith("unit ")]
        united = sum(look.cells for look in units if _unit(look) in FACTORS) or max((look.cells for look in units), default=0)
        if 2 * (numbers + united) <= sum(look.cells for look in rows if look.look != "missing"):
            return None
        return "most of its values look like numbers; " + _instead(output, name, column, looks, len(rows) > len(looks), names)


def _words(names: Iterable[str]) -> str:
    return " and ".join(map(repr, names))


def _in_sql(snapshot: Snapshot, output: str, name: str) -> str | None:
    """Return the name in SQL of a column of a table; None if it has none."""
    snapshot.views.make((output,))
    named = {row[0].lower(): row[0] for row in snapshot.run(f"DESCRIBE {identifier(output)}")}
    if (own := stored_name(name, named.values())) != name:
        return own
    return next((named[n] for n in (name.lower() + "_", name.lower()) if n in named), None)


def _unit(look: _Look) -> str:
    return look.look.partition(" ")[2]


def _instead(output: str, name: str, column: str, looks: Sequence[_Look], plain: bool, names: Sequence[str]) -> str:
    """Return what to write instead of the cells that prevent a column from being numeric; `plain`: others are numbers."""
    units = [look for look in looks if look.look.startswith("unit ")]
    missing = [look for look in looks if look.look in ("other", "missing")]
    if units:
        return _of_units(output, name, column, units, plain=plain or len(units) < len(looks), names=names)
    forms = [look for look in looks if look not in missing]
    if any(look.look == "flag" for look in forms):
        return f"it has {_examples(forms)} beside numbers; write the same words everywhere, or only 0 and 1"
    kinds = {look.look for look in forms if look.look != "thousands?"}
    if forms and (missing or len(kinds) > 1 or "point" in kinds):
        return f"it has {_examples([*forms, *missing])}; write all of them as plain numbers"
    if forms:
        first = next((look for look in forms if look.look in ("comma", "grouped")), forms[0])  # they say what the comma is
        return _in_form(output, first)
    return _of_missing(output, missing) if missing else "some further down do not"


def _in_form(output: str, look: _Look) -> str:
    """Return what to write instead of a number in another form."""
    example = look.example
    match look.look:
        case "comma":
            message = f"write {example.replace(',', '.')!r} instead of {example!r}, with a decimal point"
            return f'{message} ([outputs.{output}] decimal = "," reads decimal commas)'
        case "thousands?":
            whole, decimal = example.replace(",", ""), example.replace(",", ".")
            message = f"{example!r} can be {whole}, with a separator of thousands, or {decimal}, with a decimal comma; write"
            return f'{message} {whole!r} or {decimal!r} ([outputs.{output}] decimal = "," reads decimal commas)'
        case "wrapped":
            return f"write the number alone instead of {example!r} (in Python, .item() of a tensor or an array)"
    return f"write {example!r} without separators between digits"


def _of_units(output: str, name: str, column: str, looks: Sequence[_Look], *, plain: bool, names: Sequence[str]) -> str:
    """Return what to do with numbers that have units; `plain`: other cells have none."""
    first, units, called = looks[0], [_unit(look) for look in looks], _plain(column)

    def converted(number: str) -> str:
        table, at = _plain(output), next((f"{_plain(other)}, " for other in names if names_time(other)), "")
        key, sql = re.sub(r"\W", "_", f"{output}_{column}"), f"SELECT run, {at}{number} AS {called} FROM {table}"
        return f"for example: [tables.{key}] sql = {json.dumps(sql, ensure_ascii=False)}"

    if len(units) == 1 and not plain:
        key = json.dumps(name, ensure_ascii=False)
        declared = f"[outputs.{output}] units = {{ {key} = {json.dumps(units[0], ensure_ascii=False)} }}"
        conversion = converted(f"replace({called}, {quote(units[0])}, '')::DOUBLE")
        return f"write {first.example!r} without {units[0]!r} ({declared} declares the unit), or convert it, {conversion}"
    mixed = f"some have the unit {' or '.join(map(repr, units[:TEXTS]))}" + " and some have none" * plain
    known = {FACTORS[unit][0] for unit in units if unit in FACTORS}
    if plain or len(known) != 1 or not all(unit in FACTORS for unit in units):
        return f"{mixed}; write all in the same unit, without its name"
    [base] = known
    cell = f"trim({called})"
    number = f"regexp_extract({cell}, '^[-+0-9.eE]+')::DOUBLE"
    cases = " ".join(f"WHEN {quote(unit)} THEN {FACTORS[unit][1]:.15g}" for unit in units)
    factor = f"CASE regexp_extract({cell}, '[^-+0-9.eE ]+$') {cases} END"
    return f"{mixed}; write all in the same unit, or convert them to {base!r}, {converted(f'{number} * {factor}')}"


def _plain(name: str) -> str:
    """Return a name as SQL, without quotes if it needs none."""
    return name if re.fullmatch(r"[A-Za-z_]\w*", name) else identifier(name)


def _of_missing(output: str, looks: Sequence[_Look]) -> str:
    """Return what to write instead of texts among numbers."""
    cells, texts = sum(look.cells for look in looks), [text for look in looks for text in look.texts]
    first = next((look for look in looks if look.look == "missing"), looks[0])
    such = counted(cells, "such cell")
    if any(re.search("[0-9]", text) for text in texts):
        return f"write {first.example!r} as a plain number, or leave the cell empty ({such})"
    message = f"leave cells without a number empty instead of writing {first.example!r} ({such})"
    if len(texts) > TEXTS:
        return message
    return f"{message}, or set na = {json.dumps(texts, ensure_ascii=False)} in [outputs.{output}]"


def _examples(looks: Sequence[_Look]) -> str:
    return " and ".join(repr(one.example) for one in looks[:TEXTS])


EXAMPLE = (
    GOOD
    + """
SELECT a.sha256 FROM all_artifacts a JOIN good g USING (execution)
WHERE a.kind = 'table' AND a.output = $output AND a.member IS NULL
ORDER BY a.path, a.sha256 LIMIT 1
"""
)


def lost(names: Sequence[str]) -> Iterator[str]:
    """Yield a warning about entries of the output folder that are not files."""
    if names:
        others = f" and {counted(len(names) - 1, 'other')} are" if len(names) > 1 else " is"
        yield f"{shown(names[0])!r}{others} not recorded: only files are recorded, and links are not followed"


def as_files(kept: Mapping[str, Mapping[str, None]]) -> Iterator[str]:
    """Yield warnings about files that look like tables but are recorded as files."""
    for why, files in kept.items():
        first = PurePosixPath(next(iter(files)))
        message = why.replace("{glob}", str(first.with_name("*" + first.suffix))).replace("{file}", str(first))
        others = f"{len(files) - 1} or more others" if len(files) == NOTED_AT_MOST else counted(len(files) - 1, "other")
        these = f"{str(first)!r} and {others} are" if len(files) > 1 else f"{str(first)!r} is"
        yield f"{these} kept as {'files' if len(files) > 1 else 'a file'}: {message}"


EXECUTED = GOOD.replace("e.status = 'ok'", "e.status IN ('ok', 'mismatch')")
"""The executions of a batch, including those that differ from their siblings."""
SIZES = """
WITH sizes AS (
    SELECT g.ordinal, a.output, g.run, min(a.path) AS path, sum(a.rows)::BIGINT AS rows
    FROM executed g JOIN all_artifacts a ON a.execution = g.execution AND a.kind = 'table' GROUP BY ALL
)
SELECT * FROM sizes SEMI JOIN (
    SELECT output FROM (SELECT output, ordinal FROM sizes GROUP BY ALL HAVING min(rows) < max(rows))
) USING (output) ORDER BY output, ordinal, run
"""
"""The number of rows of each run, for outputs in which it differs within an experiment."""
EMPTY = """
SELECT a.output FROM executed g JOIN all_artifacts a ON a.execution = g.execution AND a.kind = 'table'
GROUP BY a.output HAVING max(a.rows) = 0 ORDER BY a.output
"""
FORMS = """
SELECT a.output, a.table_layout, count(DISTINCT a.execution) AS executions
FROM all_artifacts a WHERE a.kind = 'table' AND a.execution IN (SELECT execution FROM good)
GROUP BY ALL ORDER BY ALL
"""
NUMBER = r"[-+]?([0-9]+[.]?[0-9]*|[.][0-9]+)([eE][-+]?[0-9]+)?"
MISSING = "n[./]?a[.]?|#n/a|null|none|nil|missing|undefined|-+|[?]"
"""Texts that stand for a missing number; such cells do not show the kind of a column."""
LOOKS = """
WITH cells AS (
    SELECT trim(cell) AS cell FROM (SELECT {column}::VARCHAR AS cell FROM {table} LIMIT 200000) WHERE cell IS NOT NULL
), looking AS (
    SELECT cell, CASE
        WHEN TRY_CAST(cell AS DOUBLE) IS NOT NULL AND NOT contains(cell, '_') THEN
            CASE WHEN contains(cell, '.') THEN 'point' ELSE 'number' END
        WHEN regexp_full_match(cell, '[-+]?[1-9][0-9]{{0,2}},[0-9]{{3}}') THEN 'thousands?'
        WHEN regexp_full_match(cell, '[-+]?[0-9]+,[0-9]+([eE][-+]?[0-9]+)?') THEN 'comma'
        WHEN regexp_full_match(cell, '[-+]?[0-9]{{1,3}}([ '',._][0-9]{{3}})+([.,][0-9]+)?') THEN 'grouped'
        WHEN regexp_full_match(lower(cell), '{missing}') THEN 'missing'
        WHEN regexp_full_match(lower(cell), 'true|false|yes|no') THEN 'flag'
        WHEN regexp_full_match(cell, '[A-Za-z_][A-Za-z0-9_.]*[(] *[[]?{number}[]]? *(,.*)?[)]|[[]{number}[]]') THEN 'wrapped'
        WHEN regexp_full_match(cell, '{number} *[^-+0-9eE.,;:_# ][^0-9]*') THEN
            'unit ' || regexp_extract(cell, '^{number} *(.*)$', 3)
        ELSE 'other' END AS look
    FROM cells
)
SELECT look, count(*), min(cell), list_slice(list(DISTINCT cell ORDER BY cell) FILTER (look IN ('other', 'missing')), 1, 6)
FROM looking GROUP BY look ORDER BY count(*) DESC, look LIMIT 1000
"""
"""The appearances of cells, each with the number of cells and an example."""


def _hidden(snapshot: Snapshot, name: str, axes: Mapping[str, str]) -> Iterator[tuple[str, str, str]]:
    """Yield the columns that an axis with other values hides in SQL: axis, column, and the column's name in SQL."""
    snapshot.views.make((name,))
    for column, called in snapshot.views.sql_names.get(name.lower(), {}).items():
        axis = axes.get(column.lower())
        if axis is not None and snapshot.run(
            UNLIKE.format(axis=identifier(axis), column=identifier(called), table=identifier(name))
        ):
            yield axis, column, called


UNLIKE = """
SELECT 1 FROM {table}
WHERE {column} IS NOT NULL AND {column}::VARCHAR IS DISTINCT FROM {axis}::VARCHAR
    AND coalesce(TRY_CAST({column} AS DOUBLE) <> TRY_CAST({axis} AS DOUBLE), true)
LIMIT 1
"""
