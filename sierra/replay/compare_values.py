"""Comparison of values: verdicts from identical to different, and the first place where two outputs differ.

Values are compared, never texts: NaN equals NaN, a missing value equals a missing value, and 1 equals 1.0. Distances are
computed between doubles: absolute, relative to the recorded number, and in units in the last place of the greater one.
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterable, Mapping, Sequence
from datetime import UTC, datetime
from decimal import Decimal
from enum import StrEnum
from fractions import Fraction
from typing import TYPE_CHECKING

from sierra.config.output_tables import Tolerance
from sierra.replay.clock_columns import Clock, clock_of
from sierra.store.type_inference import BESIDE, MINUTE, SECOND, ZONE
from sierra.util.arrow_columns import values_of
from sierra.util.lazy_definitions import dataclass, field, regex, replace
from sierra.util.text import counted, few

if TYPE_CHECKING:
    import numpy as np
    import pyarrow as pa
    from numpy.typing import NDArray

    from sierra.store.sql_result import SqlValue

STEPS = 10
"""Number of parts of the rows for which the growth of a difference is reported."""
EXACT = Tolerance()
MANY_ULP = 1e6
"""Units in the last place from which on the number is not informative."""
NAMED = 4
"""Number of columns that a line names; others are only counted."""
LONGEST = 80
"""Maximum number of characters of a value in a line."""
EXACT_UP_TO = 2.0**52
"""Limit below which whole numbers are exact as doubles, and so are the distances between them."""
UNITS = {"s": 10**9, "ms": 10**6, "us": 10**3, "ns": 1}
"""The nanoseconds in the units of Arrow's times."""
TIME = regex(rf"(?P<second>{MINUTE}(?P<of>{SECOND})?)(?(of)(?:[.,](?P<fraction>[0-9]{{1,9}}))?)(?P<zone>(?:{ZONE})?)")
LARGEST_ULP = 2.0**971
"""Unit in the last place of the greatest double, for which numpy returns infinity."""


class Verdict(StrEnum):
    """Verdict of a comparison with the record; each one is weaker than the one before."""

    IDENTICAL = "identical"
    """Identical bytes."""
    EQUAL = "equal"
    """Equal values. Only parts that are declared volatile, or the notation of numbers, differ."""
    WITHIN = "within tolerance"
    EQUIVALENT = "equivalent"
    """Different values, but the declared metrics over all runs of the experiment are the same within their margins."""
    DIFFERENT = "different"
    FAILED = "failed"
    """The run was executed again without success."""

    @property
    def fine(self) -> bool:
        return self not in (Verdict.DIFFERENT, Verdict.FAILED)


def worst(verdicts: Iterable[Verdict]) -> Verdict:
    """Return the weakest of these verdicts; identical if there are none."""
    order = list(Verdict)
    return max(verdicts, key=order.index, default=Verdict.IDENTICAL)


@dataclass(frozen=True, slots=True)
class DifferentColumn:
    """One column in which two tables differ."""

    name: str
    rows: int
    """Number of rows that differ; `of` is the number of rows that both tables have."""
    of: int
    max_abs: float | None
    """Greatest distances; None if the column is not numeric."""
    max_rel: float | None
    max_ulp: float | None
    within: bool
    """True if the differences are within the tolerance."""
    clock: Clock


@dataclass(frozen=True, slots=True)
class Agreement:
    """Result of comparing one output: the verdict, and for tables the first difference and the greatest distances."""

    verdict: Verdict
    reason: str = ""
    """Explanation in one line; empty if the outputs are identical."""
    row: int | None = None
    """First row that differs, counted from 0."""
    column: str | None = None
    recorded_value: str | None = None
    replayed_value: str | None = None
    max_abs: float | None = None
    """Greatest absolute distance; `max_rel` is the greatest relative one, `max_ulp` the greatest in units in the last place."""
    max_rel: float | None = None
    max_ulp: float | None = None
    growth: tuple[tuple[object, float], ...] = ()
    """For each tenth of the rows: its last time (or row number, without a time), and its greatest absolute distance."""
    form: bool = False
    """True if the form differs instead of values: a missing or additional file, or other columns of a table."""
    output: str | None = None
    """The table; None for other files."""
    columns: tuple[DifferentColumn, ...] = ()
    """All columns that differ, except volatile ones."""
    same_columns: int = 0
    """Number of columns that do not differ."""


@dataclass(frozen=True, slots=True)
class Rules:
    """Rules for the comparison of two tables."""

    tolerance: Mapping[str, Tolerance] = field(default_factory=dict)
    """Tolerances by column; `*` stands for all other columns."""
    volatile: Sequence[str] = ()
    """Columns that are not compared."""
    time: str = ""
    """Time column that locates a difference; without one, row numbers locate it."""
    ordered: bool = True
    """True if the order of rows is significant."""

    def of(self, column: str) -> Tolerance:
        return self.tolerance.get(column, self.tolerance.get("*", EXACT))

    def compares(self, column: str) -> bool:
        """Return whether a column is compared. Texts beside numbers are not if the numbers may differ."""
        own = column.removeprefix(BESIDE)
        return own not in self.volatile and (own == column or self.of(own) == EXACT)


def of_tables(recorded: pa.Table, replayed: pa.Table, rules: Rules | None = None) -> Agreement:
    """Compare two pyarrow tables, row by row. If the order of rows is not significant, sort both by all columns, numbers last.

    If only one table has a column, or their numbers of rows differ, the common part is compared as well.
    """
    rules = rules or Rules()
    old, new = ([name for name in table.column_names if rules.compares(name)] for table in (recorded, replayed))
    both = [name for name in old if name in new]
    answer = _of_columns(recorded, replayed, both, rules)
    if set(old) == set(new):
        return answer
    same = {Verdict.EQUAL: "the same", Verdict.DIFFERENT: answer.reason}.get(
        answer.verdict, f"{answer.verdict}, {answer.reason}"
    )
    rest = f"; {counted(len(both), 'column')} in both: {same}" if both else ""
    return replace(answer, verdict=Verdict.DIFFERENT, reason=f"{other_columns(old, new)}{rest}", form=True)


def other_columns(was: Sequence[str], now: Sequence[str]) -> str:
    """Return a line with the columns that only one of two tables has; it names the first few."""
    lost, more = ([name for name in a if name not in b] for a, b in ((was, now), (now, was)))
    sides = [
        f"{what} {few([_cut(repr(name)) for name in names], NAMED)}"
        for names, what in ((lost, "missing"), (more, "new"))
        if names
    ]
    return f"different columns: {', '.join(sides)}" if sides else "the same columns in another order"


def _of_columns(recorded: pa.Table, replayed: pa.Table, columns: list[str], rules: Rules) -> Agreement:
    """Compare these columns of two tables."""
    unlike = _volatile(recorded, replayed, rules)
    recorded, replayed = _plain(recorded.select(columns)), _plain(replayed.select(columns))
    answer = _of_rows(recorded, replayed, rules, unlike)
    if rules.ordered or answer.verdict.fine:
        return answer
    answer = _of_rows(_sorted(recorded), _sorted(replayed), rules, unlike)
    equal = answer.verdict is Verdict.EQUAL
    return replace(answer, reason="the same rows in another order" if equal else f"after sorting the rows: {answer.reason}")


def _volatile(recorded: pa.Table, found: pa.Table, rules: Rules) -> list[str]:
    """Return the volatile columns in which two tables differ."""
    names = [name for name in (*recorded.column_names, *found.column_names) if name in rules.volatile]
    return [name for name in dict.fromkeys(names) if not _alike(recorded, found, name)]


def _alike(recorded: pa.Table, found: pa.Table, name: str) -> bool:
    """Check whether two tables have the same column of that name."""
    if name not in recorded.column_names or name not in found.column_names or recorded.num_rows != found.num_rows:
        return False
    old, new = (_plain(table.select([name])).column(0) for table in (recorded, found))
    return not _differ(old, new).any()


def _plain(table: pa.Table) -> pa.Table:
    """Return the table with nested and similar columns as texts, because Arrow cannot compare or sort them."""
    import pyarrow as pa

    kinds = (pa.types.is_nested, pa.types.is_interval, pa.types.is_dictionary, pa.types.is_null)
    for index, column in enumerate(table.schema):
        if any(kind(column.type) for kind in kinds):
            texts = [None if value is None else repr(value) for value in values_of(table.column(index))]
            table = table.set_column(index, column.name, pa.array(texts, pa.string()))
    return table


def _of_rows(recorded: pa.Table, found: pa.Table, rules: Rules, unlike: Sequence[str] = ()) -> Agreement:
    """Compare tables with the same columns; `unlike` are volatile columns that differ."""
    time = recorded.column(rules.time) if rules.time in recorded.column_names else None
    distances = [_Distance(name, recorded.column(name), found.column(name), time) for name in recorded.column_names]
    differing = [distance for distance in distances if distance.first_row is not None]
    answer = _verdict(recorded.num_rows, found.num_rows, distances, rules, unlike)
    columns = tuple(distance.difference(rules.of(distance.name)) for distance in differing)
    return replace(answer, columns=columns, same_columns=len(distances) - len(differing))


def _verdict(was: int, now: int, distances: Sequence[_Distance], rules: Rules, unlike: Sequence[str]) -> Agreement:
    """Return the verdict on tables with these numbers of rows and the same columns."""
    differing = [column for column in distances if column.first_row is not None]
    if was != now:
        return _other_length(was, now, differing)
    if not differing:
        return Agreement(Verdict.EQUAL, _equal(distances, unlike))
    beyond = [column for column in differing if not column.keeps_to(rules.of(column.name))]
    if not beyond:
        far = max(differing, key=lambda column: column.rel)
        return far.agreement(Verdict.WITHIN, f"differences of at most {far.far()} in {far.called()}")
    first = min(beyond, key=lambda column: column.first_row or 0)
    return first.agreement(Verdict.DIFFERENT, _in_a_line(first, beyond))


def _equal(distances: Sequence[_Distance], unlike: Sequence[str]) -> str:
    """Return the reason why two tables with different bytes are equal."""
    digits = " (fractions: the 17 digits that a double holds)" * any(column.fractions for column in distances)
    if not unlike:
        return f"the same values{digits}, but different bytes"
    every = " (which are all columns)" * (not distances)
    named = few([_cut(repr(name)) for name in unlike], NAMED)
    rest = f"; all other values are the same{digits}" if digits else ""
    return f"only volatile columns{every} differ: {named}{rest}"


def _other_length(was: int, now: int, differing: Sequence[_Distance]) -> Agreement:
    """Return the result for tables with different numbers of rows, with a comparison of the rows that both have."""
    why = f"{was} rows were recorded, {now} found"
    first = min(differing, key=lambda column: column.first_row or 0, default=None)
    if first is None:
        return Agreement(Verdict.DIFFERENT, f"{why}; the first {min(was, now)} are the same" if min(was, now) else why)
    return first.agreement(Verdict.DIFFERENT, f"{why}; {_in_a_line(first, differing)}")


def _in_a_line(first: _Distance, differing: Sequence[_Distance]) -> str:
    """Return a line with the first difference, the greatest distance in its column, and the columns and rows that differ."""
    parts = [first.where(), *([text] if (text := first.how_far()) else [])]
    if len(differing) > 1:
        ordered = [first, *(column for column in differing if column is not first)]
        named = few([f"{column.called()} in {column.rows()}" for column in ordered], NAMED)
        parts.append(f"{len(differing)} columns differ: {named}")
    else:
        parts.append(f"in {first.rows()}")
    return "; ".join(parts)


def _sorted(table: pa.Table) -> pa.Table:
    """Return the rows sorted by their values.

    Texts and whole numbers are the first keys, because they identify rows even if floating-point values vary.
    """
    import pyarrow as pa

    names = sorted(table.column_names, key=lambda name: pa.types.is_floating(table.column(name).type))
    return table.sort_by([(name, "ascending") for name in names]) if names else table


def of_texts(recorded: bytes, replayed: bytes, volatile: Sequence[str] = ()) -> Agreement:
    """Compare two files line by line, without lines that match one of the regular expressions `volatile`."""
    patterns = [re.compile(pattern.encode()) for pattern in volatile]
    ours, theirs = (
        [line for line in content.split(b"\n") if not any(pattern.search(line) for pattern in patterns)]
        for content in (recorded, replayed)
    )
    if ours == theirs:
        every = " (which are all lines)" * (not ours)
        return Agreement(Verdict.EQUAL, f"only volatile lines{every} differ")
    if not all(map(_is_text, (recorded, replayed))):
        return Agreement(Verdict.DIFFERENT, _of_bytes(recorded, replayed))
    both = zip(ours, theirs, strict=False)
    differing = [row for row, (old, new) in enumerate(both) if old != new]
    row = differing[0] if differing else min(len(ours), len(theirs))
    was, now = (_cut(repr(lines[row].decode(errors="replace"))) if row < len(lines) else "nothing" for lines in (ours, theirs))
    count = len(differing) + abs(len(ours) - len(theirs))
    more = f"; {count} of {max(len(ours), len(theirs))} lines differ" if count > 1 else ""
    return Agreement(
        Verdict.DIFFERENT, f"line {row + 1} was {was} and is {now}{more}", row=row, recorded_value=was, replayed_value=now
    )


def _is_text(content: bytes) -> bool:
    """Check whether content is text: UTF-8 without the character NUL."""
    try:
        return b"\0" not in content and content.decode() is not None
    except UnicodeDecodeError:
        return False


def _of_bytes(recorded: bytes, replayed: bytes) -> str:
    """Return a line that describes the difference of two binary files."""
    import numpy as np

    shorter = min(len(recorded), len(replayed))
    places = np.flatnonzero(np.frombuffer(recorded, np.uint8, shorter) != np.frombuffer(replayed, np.uint8, shorter))
    first = int(places[0]) if len(places) else shorter
    sizes = f"{len(recorded)} bytes were recorded, {len(replayed)} found; " if len(recorded) != len(replayed) else ""
    return f"{sizes}binary: {len(places)} of {counted(shorter, 'byte')} differ, the first at offset {first}"


class _Distance:
    """Distances of one column of two tables, in the rows that both have."""

    def __init__(
        self, name: str, recorded: pa.ChunkedArray, replayed: pa.ChunkedArray, time: pa.ChunkedArray | None = None
    ) -> None:
        import numpy as np

        rows = min(len(recorded), len(replayed))
        self.name = name
        self._time = time
        self._recorded, self._found = recorded.slice(0, rows), replayed.slice(0, rows)
        self._kinds = {_number_kind(recorded), _number_kind(replayed)}
        self.numeric = "" not in self._kinds
        self.fractions = self.numeric and "float" in self._kinds
        self._apart = _differ(self._recorded, self._found)
        places = np.flatnonzero(self._apart)
        self.first_row: int | None = int(places[0]) if len(places) else None
        self.growth: tuple[tuple[object, float], ...] = ()
        self.abs = self.rel = self.ulp = float("inf")
        if self.numeric:
            self._measure()

    def _measure(self) -> None:
        import numpy as np

        old, new = (_doubles(column) for column in (self._recorded, self._found))
        with np.errstate(all="ignore"):
            apart = np.where(self._apart, np.abs(new - old), 0.0)
            apart = np.where(np.isnan(apart), np.inf, apart)
            self._exactly(apart, np.fmax(np.abs(old), np.abs(new)))
            relative = np.where(apart == 0, 0.0, apart / np.abs(old))
            last_place = np.fmin(np.spacing(np.maximum(np.abs(old), np.abs(new))), LARGEST_ULP)
            units = np.where(apart == 0, 0.0, apart / last_place)
            relative, units = (np.where(np.isnan(distances), np.inf, distances) for distances in (relative, units))
        self._all = {"abs": apart, "rel": relative, "ulp": units}
        self.abs, self.rel, self.ulp = (float(values.max(initial=0.0)) for values in self._all.values())
        if self.first_row is not None:
            parts = np.array_split(np.arange(len(apart)), min(STEPS, len(apart)))
            self.growth = tuple((self._when(int(part[-1])), float(apart[part].max())) for part in parts)

    def _exactly(self, apart: NDArray[np.float64], size: NDArray[np.float64]) -> None:
        """Compute exact distances for numbers that doubles cannot distinguish: large whole numbers, and decimals."""
        import numpy as np

        if self._kinds == {"float"}:
            return
        whole = self._kinds == {"whole"}
        for row in np.flatnonzero(self._apart & np.isfinite(apart) & ((size >= EXACT_UP_TO) | (not whole))):
            old, new = (Fraction(column[int(row)].as_py()) for column in (self._recorded, self._found))
            apart[row] = float(abs(new - old))

    def keeps_to(self, tolerance: Tolerance) -> bool:
        if not self.numeric:
            return False
        fine = ~self._apart
        for kind, distances in self._all.items():
            if allowed := getattr(tolerance, kind):
                fine |= distances <= allowed
        return bool(fine.all())

    def _when(self, row: int) -> object:
        return row if self._time is None else values_of(self._time.slice(row, 1))[0]

    def where(self) -> str:
        was, now = self._values()
        at = "" if self._time is None else f" (at {self._when(self.first_row or 0)})"
        return f"row {self.first_row}{at}: {self.called()} was {was} and is {now}"

    def called(self) -> str:
        """Return the column's name for a line."""
        return _cut(repr(self.name))

    def rows(self) -> str:
        """Return the number of rows that differ."""
        return f"{int(self._apart.sum())} of {counted(len(self._apart), 'row')}"

    def how_far(self) -> str:
        """Return the greatest distance as text; empty if the column is not numeric, or if the distance is not finite."""
        return f"largest difference {self.far()}" if self.numeric and self.abs < float("inf") else ""

    def far(self) -> str:
        return distances(self.abs, self.rel, self.ulp)

    def agreement(self, verdict: Verdict, why: str) -> Agreement:
        was, now = self._values()
        if not self.numeric:
            return Agreement(verdict, why, self.first_row, self.name, was, now)
        return Agreement(verdict, why, self.first_row, self.name, was, now, self.abs, self.rel, self.ulp, self.growth)

    def difference(self, tolerance: Tolerance) -> DifferentColumn:
        """Return the description of this column, which differs."""
        clock = clock_of(self.name, self._recorded, self._found, self.first_row or 0)
        far, rel, ulp = (self.abs, self.rel, self.ulp) if self.numeric else (None, None, None)
        rows, fine = int(self._apart.sum()), self.keeps_to(tolerance)
        return DifferentColumn(self.name, rows, len(self._apart), far, rel, ulp, fine, clock)

    def _values(self) -> tuple[str, str]:
        place = self.first_row or 0
        was, now = (values_of(column.slice(place, 1))[0] for column in (self._recorded, self._found))
        return _value(was), _value(now)


def distances(far: float, rel: float, ulp: float) -> str:
    """Return distances as text: absolute, relative, and in units in the last place if there are few."""
    known = [
        *([f"relative {rel:.3g}"] if rel < float("inf") else []),
        *([f"{ulp:.3g} ulp"] if ulp < MANY_ULP else []),
    ]
    return f"{far:.3g}" + (f" ({', '.join(known)})" if known else "")


def distance(far: float) -> str:
    """Return a distance as text; one that is not finite is not written as a number."""
    return f"{far:.3g}" if far < float("inf") else "not finite"


def _value(value: SqlValue) -> str:
    """Return a cell's value for a line."""
    return "missing" if value is None else _cut(str(value) if isinstance(value, Decimal) else repr(value))


def _number_kind(column: pa.ChunkedArray) -> str:
    """Return whole, decimal or float for a column of numbers; empty for other columns."""
    import pyarrow as pa

    tests = {"whole": pa.types.is_integer, "decimal": pa.types.is_decimal, "float": pa.types.is_floating}
    return next((name for name, test in tests.items() if test(column.type)), "")


def _doubles(column: pa.ChunkedArray) -> NDArray[np.float64]:
    import pyarrow as pa

    values: NDArray[np.float64] = column.cast(pa.float64(), safe=False).fill_null(float("nan")).to_numpy()
    return values


def _differ(recorded: pa.ChunkedArray, again: pa.ChunkedArray) -> NDArray[np.bool_]:
    """Return where two columns differ, as a numpy array of bool."""
    import numpy as np
    import pyarrow as pa
    import pyarrow.compute as pc

    if recorded.type != again.type:
        flags = [pa.types.is_boolean(column.type) for column in (recorded, again)]
        if pa.types.is_timestamp(recorded.type) and pa.types.is_timestamp(again.type) and recorded.type.tz == again.type.tz:
            with contextlib.suppress(pa.ArrowInvalid):  # outside of the years 1677 to 2262
                recorded, again = (column.cast(pa.timestamp("ns", column.type.tz)) for column in (recorded, again))
        old, new = _as_times(recorded, again) or (values_of(recorded), values_of(again))
        pairs = zip(old, new, strict=True)  # Python compares numbers exactly, 2**53 + 1 too
        return np.array([ours != other or (any(flags) and ours is not None) for ours, other in pairs], dtype=bool)
    same = pc.fill_null(pc.equal(recorded, again), False)
    same = pc.or_(same, pc.and_(pc.is_null(recorded), pc.is_null(again)))
    if pa.types.is_floating(recorded.type):
        neither = pc.and_(pc.fill_null(pc.is_nan(recorded), False), pc.fill_null(pc.is_nan(again), False))
        same = pc.or_(same, neither)
    return ~np.asarray(same.to_numpy())


def _as_times(*columns: pa.ChunkedArray) -> list[list[int | str | None]] | None:
    """Return times in nanoseconds if one column has times, and the other texts, as an earlier version recorded times."""
    import pyarrow as pa

    zones = [column.type.tz is not None for column in columns if pa.types.is_timestamp(column.type)]
    if len(zones) != 1 or not any(pa.types.is_string(column.type) for column in columns):
        return None
    return [
        [None if value is None else value * UNITS[column.type.unit] for value in column.cast(pa.int64()).to_pylist()]
        if pa.types.is_timestamp(column.type)
        else [None if value is None else _nanoseconds(value, zones[0]) for value in column.to_pylist()]
        for column in columns
    ]


def _nanoseconds(text: str, zoned: bool) -> int | str:
    """Return the time that a text means, in nanoseconds since 1970; the text itself if it is no such time."""
    match = TIME.fullmatch(text.strip(" "))
    if match is None or bool(match["zone"]) != zoned:
        return text
    with contextlib.suppress(ValueError):
        since = datetime.fromisoformat(match["second"] + match["zone"]) - datetime(1970, 1, 1, tzinfo=UTC if zoned else None)
        return (since.days * 86_400 + since.seconds) * UNITS["s"] + int((match["fraction"] or "").ljust(9, "0"))
    return text


def _cut(text: str) -> str:
    return text if len(text) <= LONGEST else f"{text[: LONGEST - 3]}..."
