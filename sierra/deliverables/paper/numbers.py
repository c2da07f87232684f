"""The numbers in the text of a paper: `numbers.tex`, with a macro for each of `[numbers.NAME]`.

    \\newcommand{\\sierrabest}{0.45}

A number that cannot be computed is an error: no macro is empty. Further macros have the numbers of runs, of runs without a
successful execution and of different seeds in all batches of the paper, the version of SIERRA, and the id of the package that
`[paper]` names.
"""

from __future__ import annotations

from collections.abc import Container, Mapping, Sequence
from decimal import Decimal
from typing import NamedTuple

from sierra.config.number_table import NumberInText
from sierra.config.project_file import LoadedProject, Project
from sierra.deliverables import comparison, paper_tables
from sierra.deliverables.claims import evaluate
from sierra.deliverables.claims.evaluate import Evaluated
from sierra.deliverables.comparison import Compared
from sierra.deliverables.run_statistics import output_and_columns, statistics
from sierra.design.query import condition
from sierra.errors import NotFound, SierraError, UsageError
from sierra.execution.batches_of_queries import BatchesOfQueries
from sierra.stats.comparison.model import Pair
from sierra.stats.comparison.wording import p_value
from sierra.stats.rounding import rounded
from sierra.store.several_batches import joined
from sierra.store.store import Store
from sierra.util.arrow_columns import values_of
from sierra.util.lazy_definitions import dataclass
from sierra.util.text import like
from sierra.util.version import __version__

BUILT_IN = ("runs", "failedruns", "seeds", "version", "package")
"""The macros that each paper has; the last one only if `[paper]` names a package."""
COUNTS = """
SELECT count(*) AS runs, count(*) FILTER (NOT succeeded) AS failed, count(DISTINCT seed) AS seeds FROM (
    SELECT b.run, any_value(b.seed) AS seed, bool_or(e.run IS NOT NULL) AS succeeded
    FROM batch_runs b LEFT JOIN effective e USING (batch, run) WHERE list_contains($batches, b.batch) GROUP BY b.run
)
"""


@dataclass(frozen=True, slots=True)
class Computed:
    """One number, before it is printed."""

    estimate: float | str | None
    low: float | None = None
    high: float | None = None
    p: float | None = None
    verdict: str = ""
    registered: str = ""
    origin: str = ""
    """The source of the number, in one line."""
    batches: tuple[str, ...] = ()
    """The batches of a claim, whose query may be bound to nothing else."""


class _Counts(NamedTuple):
    runs: int
    failed: int
    seeds: int


def check(config: Project, compared: Container[str]) -> None:
    """Check the names that numbers have and use; `compared` are the comparisons that are bound to queries.

    Raises UsageError for the name of a macro that each paper has, and NotFound for an unknown claim or comparison.
    """
    for name, number in config.numbers.items():
        if name in BUILT_IN:
            raise UsageError(f"[numbers.{name}] is the name of a macro that each paper has; choose another one")
        if number.claim and number.claim not in config.claims:
            known = like(number.claim, list(config.claims))
            raise NotFound(f"number {name}: sierra.toml has no [claims.{number.claim}]; {known}")
        if number.comparison and number.comparison not in compared:
            known = like(number.comparison, list(config.comparisons), "there are")
            raise NotFound(f"number {name}: no comparison {number.comparison!r} is bound to queries; {known}")


def claims_of(queries: BatchesOfQueries, among: Sequence[str] | None = None) -> dict[str, Evaluated]:
    """Return the evaluations of the claims whose numbers are printed, by their names; `among` is as in `evaluate`."""
    names = dict.fromkeys(number.claim for number in queries.project.config.numbers.values() if number.claim)
    if not names:
        return {}
    return {claim.name: claim for claim in evaluate.evaluate(queries.project, queries.store, list(names), among=among)}


def computed(
    queries: BatchesOfQueries, number: NumberInText, compared: Mapping[str, Compared], claims: Mapping[str, Evaluated]
) -> Computed:
    """Return one number. Raises SierraError for one that cannot be computed."""
    if number.claim:
        return _of_claim(claims[number.claim])
    if number.comparison:
        return _of_comparison(compared[number.comparison], number.groups)
    batches = comparison.of_queries(queries, number.query)
    if number.sql:
        return _of_sql(queries.store, number.sql, batches)
    [batch] = batches.values()
    return _of_statistic(queries.project, queries.store, number, batch)


def _of_claim(evaluation: Evaluated) -> Computed:
    if not evaluation.batches:
        raise SierraError(evaluation.text)
    return Computed(
        evaluation.value,
        evaluation.low,
        evaluation.high,
        evaluation.p,
        evaluation.verdict.value,
        evaluation.registered.value,
        f"claim {evaluation.name}",
        evaluation.batches,
    )


def _of_comparison(compared: Compared, groups: Sequence[str]) -> Computed:
    groups = [compared.group(word) for word in groups]
    chosen = [pair for pair in compared.pairs if not groups or {pair.first, pair.second} == {*groups}]
    if len(chosen) != 1:
        known = "; ".join(dict.fromkeys(f"{pair.first}, {pair.second}" for pair in compared.pairs)) or "none"
        many = "several pairs" if len(chosen) > 1 else "no pair"
        hint = "choose one by groups, and one experiment by `experiments` of the comparison"
        raise UsageError(
            f"comparison {compared.name} has {many} of {', '.join(groups) or 'groups'}; {hint}; its groups: {known}"
        )
    [pair] = chosen
    difference, low, high = _directed(pair, groups)
    origin = f"comparison {compared.name}: {' and '.join(groups) or f'{pair.first} and {pair.second}'}"
    return Computed(difference, low, high, pair.p_adjusted, origin=origin)


def _directed(pair: Pair, groups: Sequence[str]) -> tuple[float | None, float | None, float | None]:
    """Return the difference and its interval: the second of the groups minus the first."""
    ends = pair.difference, pair.low, pair.high
    if not groups or pair.first == groups[0]:
        return ends
    difference, low, high = (None if end is None else -end for end in ends)
    return difference, high, low


def _of_sql(store: Store, statement: str, batches: Mapping[str, str]) -> Computed:
    table = joined(store, batches, statement, "sql").table
    if (table.num_rows, table.num_columns) != (1, 1):
        raise UsageError(f"sql: a number is one row and one column, but there are {table.num_rows} and {table.num_columns}")
    [value] = values_of(table.column(0))
    if isinstance(value, Decimal):
        value = float(value)
    if isinstance(value, bool):
        value = str(value).lower()
    return Computed(value if isinstance(value, int | float) or value is None else str(value), origin="sql/numbers.sql")


def _of_statistic(project: LoadedProject, store: Store, number: NumberInText, batch: str) -> Computed:
    output, [column] = output_and_columns(project, store, batch, number.table, (number.column,) if number.column else ())
    measure = number.measure or "auto"
    summary = statistics(project, store, batch, output, column, measure, number.threshold, chosen=(number.statistic,))
    chosen = condition.among(number.experiments, summary.axes, summary.cells, summary.labelled)
    if len(chosen) != 1:
        hint = (
            f'select one by {", ".join(summary.axes)}, as in experiments = "{summary.axes[0]}=…"'
            if summary.axes
            else "there is one"
        )
        raise UsageError(f"experiments = {number.experiments!r} are {len(chosen)}, but a number is that of one; {hint}")
    estimates, _ = paper_tables.estimates_of(summary, number.statistic, chosen)
    estimate, low, high, n = estimates[min(chosen)]
    origin = f"{number.statistic} of {column}, n = {n}, query {number.query[0]}"
    return Computed(estimate, low, high, origin=origin)


def text(number: NumberInText, computed_number: Computed, *, siunitx: bool) -> str:
    """Return a number for LaTeX. Raises SierraError if it has no such part."""
    match number.value:
        case "verdict":
            return paper_tables.escaped(computed_number.verdict)
        case "registered":
            return paper_tables.escaped(computed_number.registered)
        case "p":
            if computed_number.p is None:
                raise SierraError("it has no p value")
            return f"${p_value(computed_number.p)}$"
        case "interval":
            if computed_number.low is None and computed_number.high is None:
                raise SierraError("it has no interval")
            return f"[{', '.join(_number(end, siunitx=siunitx) for end in _ends(number, computed_number))}]{_unit(number.unit)}"
    if computed_number.estimate is None or computed_number.estimate != computed_number.estimate:
        raise SierraError("it has no value" + '; value = "verdict" prints the verdict' * bool(number.claim))
    if isinstance(computed_number.estimate, str):
        return paper_tables.escaped(computed_number.estimate) + _unit(number.unit)
    shown = _printed(number, computed_number.estimate, computed_number)
    if siunitx and number.unit:
        return rf"\qty{{{_plain(shown)}}}{{{number.unit}}}"
    return _number(shown, siunitx=siunitx) + _unit(number.unit)


def _printed(number: NumberInText, value: float, computed_number: Computed) -> str:
    """Return a number with the digits of its format, or else of its interval."""
    if number.format:
        return format(value, number.format)
    if isinstance(value, int):
        return str(value)
    parts = rounded(float(value), computed_number.low, computed_number.high)
    return f"{parts.value}e{parts.exponent}" if parts.exponent else parts.value


def _ends(number: NumberInText, computed_number: Computed) -> tuple[str, str]:
    if computed_number.low is None or computed_number.high is None:
        raise SierraError("its interval has only one end")
    if number.format:
        return format(computed_number.low, number.format), format(computed_number.high, number.format)
    center = (
        computed_number.estimate
        if isinstance(computed_number.estimate, int | float)
        else (computed_number.low + computed_number.high) / 2
    )
    digits = rounded(float(center), computed_number.low, computed_number.high)
    places = len(digits.value.partition(".")[2])
    scale = 10.0**-digits.exponent
    low, high = (
        f"{end * scale:.{places}f}" + (f"e{digits.exponent}" if digits.exponent else "")
        for end in (computed_number.low, computed_number.high)
    )
    return low, high


def _number(shown: str, *, siunitx: bool) -> str:
    """Return a number for LaTeX, in mathematical mode if it has a sign or a power."""
    plain = _plain(shown)
    if siunitx:
        return rf"\qty{{{plain[:-1]}}}{{\percent}}" if plain.endswith("%") else rf"\num{{{plain}}}"
    value, _, exponent = plain.partition("e")
    if exponent:
        return rf"${value} \times 10^{{{int(exponent)}}}$"
    return f"${plain}$" if plain.startswith("-") else paper_tables.escaped(plain)


def _plain(shown: str) -> str:
    return shown.replace("−", "-")


def _unit(unit: str) -> str:
    return f"~{paper_tables.escaped(unit)}" if unit else ""


def built_in(store: Store, batches: Sequence[str]) -> dict[str, str]:
    """Return the macros that each paper has, without the prefix."""
    [counts] = store.select(_Counts, COUNTS, batches=list(batches))
    return {
        "runs": str(counts.runs),
        "failedruns": str(counts.failed),
        "seeds": str(counts.seeds),
        "version": paper_tables.escaped(__version__),
    }
