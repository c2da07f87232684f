"""How far two executions of one run agree: verdicts, from identical to different, and where they part.

Values are compared, never texts: NaN agrees with NaN, a missing value with a missing value, 1 with 1.0. A distance is taken
between doubles: absolute, relative to the recorded number, and in units in the last place of the greater one.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Any

from sierra.config import Tolerance

STEPS = 10
"""Parts of the rows for which the growth of a difference is told."""
EXACT = Tolerance()
MANY_ULP = 1e6
"""From which on units in the last place tell nobody anything."""
LARGEST_ULP = 2.0**971
"""That of the greatest double, for which numpy says infinity."""


class Verdict(StrEnum):
    """How far something agrees with its record; each is weaker than the one before."""

    IDENTICAL = "identical"
    """The same bytes."""
    EQUAL = "equal"
    """The same values; what was declared volatile, or how numbers are written, differs."""
    WITHIN = "within tolerance"
    EQUIVALENT = "equivalent"
    """Other values; but over the runs of a whole experiment, the declared metrics are the same within their margins."""
    DIFFERENT = "different"
    FAILED = "failed"
    """It did not execute to a good end."""

    @property
    def fine(self) -> bool:
        return self not in (Verdict.DIFFERENT, Verdict.FAILED)


def worst(verdicts: Iterable[Verdict]) -> Verdict:
    """The weakest of these; identical where there are none."""
    order = list(Verdict)
    return max(verdicts, key=order.index, default=Verdict.IDENTICAL)


@dataclass(frozen=True, slots=True)
class Agreement:
    """What came of comparing one output: the verdict, and for tables where they part and how far they are apart at worst."""

    verdict: Verdict
    why: str = ""
    """In a line; empty where they are identical."""
    row: int | None = None
    """The first row, from 0, in which they differ."""
    column: str | None = None
    recorded: str | None = None
    found: str | None = None
    abs: float | None = None
    """The greatest distance."""
    rel: float | None = None
    ulp: float | None = None
    growth: tuple[tuple[Any, float], ...] = ()
    """For each tenth of the rows: its last time (or row, without a time), and the greatest absolute distance in it."""
    form: bool = False
    """Whether not values differ, but what there is: a file, or the columns of a table."""


@dataclass(frozen=True, slots=True)
class Rules:
    """By what two tables are compared."""

    tolerance: Mapping[str, Tolerance] = field(default_factory=dict)
    """By column; `*` stands for those that are not named."""
    volatile: Sequence[str] = ()
    """Columns that are not compared."""
    time: str = ""
    """The column in whose terms it is said where tables part; the row's number without."""
    ordered: bool = True
    """Whether the order of rows means anything."""

    def of(self, column: str) -> Tolerance:
        return self.tolerance.get(column, self.tolerance.get("*", EXACT))


def of_tables(recorded: Any, found: Any, rules: Rules | None = None) -> Agreement:
    """Compare two pyarrow tables, row by row; where their order means nothing, each sorted by all columns, numbers last."""
    rules = rules or Rules()
    columns = [name for name in recorded.column_names if name not in rules.volatile]
    others = [name for name in found.column_names if name not in rules.volatile]
    if set(columns) != set(others):
        return Agreement(Verdict.DIFFERENT, f"columns were {', '.join(columns)} and are {', '.join(others)}", form=True)
    recorded, found = _plain(recorded.select(columns)), _plain(found.select(columns))
    answer = _of_rows(recorded, found, rules)
    if rules.ordered or answer.verdict.fine:
        return answer
    answer = _of_rows(_sorted(recorded), _sorted(found), rules)
    equal = answer.verdict is Verdict.EQUAL
    return replace(answer, why="the same rows in another order" if equal else f"rows sorted: {answer.why}")


def _plain(table: Any) -> Any:
    """The table, with columns of lists, structures and the like, which Arrow compares and sorts not, as texts."""
    import pyarrow as pa

    kinds = (pa.types.is_nested, pa.types.is_interval, pa.types.is_dictionary, pa.types.is_null)
    for place, column in enumerate(table.schema):
        if any(kind(column.type) for kind in kinds):
            texts = [None if value is None else repr(value) for value in table.column(place).to_pylist()]
            table = table.set_column(place, column.name, pa.array(texts, pa.string()))
    return table


def _of_rows(recorded: Any, found: Any, rules: Rules) -> Agreement:
    time = recorded.column(rules.time) if rules.time in recorded.column_names else None
    distances = [_Distance(name, recorded.column(name), found.column(name), time) for name in recorded.column_names]
    parted = [one for one in distances if one.first is not None]
    if recorded.num_rows != found.num_rows:
        why = f"{recorded.num_rows} rows were recorded, {found.num_rows} found"
        first = min(parted, key=lambda one: one.first or 0, default=None)
        return Agreement(Verdict.DIFFERENT, why) if first is None else first.told(Verdict.DIFFERENT, f"{why}; {first.where()}")
    if not parted:
        only = "only what is declared volatile (which is every column) differs"
        return Agreement(Verdict.EQUAL, "the same values, written in other bytes" if distances else only)
    beyond = [one for one in parted if not one.keeps_to(rules.of(one.name))]
    if not beyond:
        far = max(parted, key=lambda one: one.rel)
        return far.told(Verdict.WITHIN, f"at most {far.far()} in {far.name!r}")
    first = min(beyond, key=lambda one: one.first or 0)
    return first.told(Verdict.DIFFERENT, f"{first.where()}; {first.how_far()}")


def _sorted(table: Any) -> Any:
    """The rows in the order of their values: texts and whole numbers first, which tell rows apart though others waver."""
    import pyarrow as pa

    names = sorted(table.column_names, key=lambda name: pa.types.is_floating(table.column(name).type))
    return table.sort_by([(name, "ascending") for name in names]) if names else table


def of_texts(recorded: bytes, found: bytes, volatile: Sequence[str] = ()) -> Agreement:
    """Compare two files line by line, without lines in which one of the regular expressions `volatile` is found."""
    patterns = [re.compile(pattern.encode()) for pattern in volatile]
    ours, theirs = (
        [line for line in content.split(b"\n") if not any(pattern.search(line) for pattern in patterns)]
        for content in (recorded, found)
    )
    if ours == theirs:
        every = " (which is every line)" * (not ours)
        return Agreement(Verdict.EQUAL, f"only what is declared volatile{every} differs")
    both = zip(ours, theirs, strict=False)
    row = next((row for row, (one, other) in enumerate(both) if one != other), min(len(ours), len(theirs)))
    was, now = (_shown(lines[row]) if row < len(lines) else "nothing" for lines in (ours, theirs))
    return Agreement(Verdict.DIFFERENT, f"line {row + 1} was {was} and is {now}", row=row, recorded=was, found=now)


class _Distance:
    """How far one column of two tables is apart, in the rows that both have."""

    def __init__(self, name: str, recorded: Any, found: Any, time: Any = None) -> None:
        import numpy as np

        rows = min(len(recorded), len(found))
        self.name = name
        self._time = time
        self._recorded, self._found = recorded.slice(0, rows), found.slice(0, rows)
        self.numeric = _is_number(recorded.type) and _is_number(found.type)
        self._apart = _differ(self._recorded, self._found)
        places = np.flatnonzero(self._apart)
        self.first: int | None = int(places[0]) if len(places) else None
        self.growth: tuple[tuple[Any, float], ...] = ()
        self.abs = self.rel = self.ulp = float("inf")
        if self.numeric:
            self._measure(np)

    def _measure(self, np: Any) -> None:
        old, new = (_doubles(column) for column in (self._recorded, self._found))
        with np.errstate(all="ignore"):
            apart = np.where(self._apart, np.abs(new - old), 0.0)
            apart = np.where(np.isnan(apart) | (self._apart & (apart == 0)), np.inf, apart)
            relative = np.where(apart == 0, 0.0, apart / np.abs(old))
            last_place = np.fmin(np.spacing(np.maximum(np.abs(old), np.abs(new))), LARGEST_ULP)
            units = np.where(apart == 0, 0.0, apart / last_place)
        self._all = {"abs": apart, "rel": np.nan_to_num(relative, nan=np.inf), "ulp": np.nan_to_num(units, nan=np.inf)}
        self.abs, self.rel, self.ulp = (float(values.max(initial=0.0)) for values in self._all.values())
        if self.first is not None:
            parts = np.array_split(np.arange(len(apart)), min(STEPS, len(apart)))
            self.growth = tuple((self._when(int(part[-1])), float(apart[part].max())) for part in parts)

    def keeps_to(self, tolerance: Tolerance) -> bool:
        if not self.numeric:
            return False
        fine = ~self._apart
        for kind, distances in self._all.items():
            if allowed := getattr(tolerance, kind):
                fine |= distances <= allowed
        return bool(fine.all())

    def _when(self, row: int) -> Any:
        return row if self._time is None else self._time[row].as_py()

    def where(self) -> str:
        was, now = self._values()
        at = "" if self._time is None else f" (at {self._when(self.first or 0)})"
        return f"row {self.first}{at}: {self.name!r} was {was} and is {now}"

    def how_far(self) -> str:
        if not self.numeric:
            return "texts differ"
        return f"at worst {self.far()}"

    def far(self) -> str:
        ulp = f", {self.ulp:.3g} ulp" if self.ulp < MANY_ULP else ""
        return f"{self.abs:.3g} apart (relative {self.rel:.3g}{ulp})"

    def told(self, verdict: Verdict, why: str) -> Agreement:
        was, now = self._values()
        if not self.numeric:
            return Agreement(verdict, why, self.first, self.name, was, now)
        return Agreement(verdict, why, self.first, self.name, was, now, self.abs, self.rel, self.ulp, self.growth)

    def _values(self) -> tuple[str, str]:
        place = self.first or 0
        return repr(self._recorded[place].as_py()), repr(self._found[place].as_py())


def _is_number(kind: Any) -> bool:
    import pyarrow as pa

    return bool(pa.types.is_integer(kind) or pa.types.is_floating(kind) or pa.types.is_decimal(kind))


def _doubles(column: Any) -> Any:
    import pyarrow as pa

    return column.cast(pa.float64(), safe=False).fill_null(float("nan")).to_numpy()


def _differ(recorded: Any, found: Any) -> Any:
    """Where two columns differ, as a numpy array of truth values."""
    import numpy as np
    import pyarrow as pa
    import pyarrow.compute as pc

    if recorded.type != found.type:
        flags = [pa.types.is_boolean(column.type) for column in (recorded, found)]
        pairs = zip(recorded.to_pylist(), found.to_pylist(), strict=True)  # Python compares numbers exactly, 2**53 + 1 too
        return np.array([one != other or (any(flags) and one is not None) for one, other in pairs], dtype=bool)
    same = pc.fill_null(pc.equal(recorded, found), False)
    same = pc.or_(same, pc.and_(pc.is_null(recorded), pc.is_null(found)))
    if pa.types.is_floating(recorded.type):
        neither = pc.and_(pc.fill_null(pc.is_nan(recorded), False), pc.fill_null(pc.is_nan(found), False))
        same = pc.or_(same, neither)
    return ~np.asarray(same.to_numpy())


def _shown(line: bytes) -> str:
    text = repr(line.decode("utf-8", "replace"))
    return text if len(text) <= 80 else text[:77] + "..."
