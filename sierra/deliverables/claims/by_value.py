"""Claims about a value: it holds if the whole 95 % interval lies within the margin around the expected value.

It does not hold if the whole interval lies outside. If the interval has a part on either side, or does not exist, nothing can
be told. The intervals of several claims are not corrected for each other.
"""

from __future__ import annotations

from collections.abc import Mapping

from sierra.config.claim_table import Claim, ClaimedValue, distance
from sierra.config.project_file import LoadedProject
from sierra.config.statistic_names import CENSORED
from sierra.deliverables import paper_tables
from sierra.deliverables.claims.by_sql import lost
from sierra.deliverables.claims.model import ClaimResult, Verdict
from sierra.deliverables.run_statistics import statistics, values_of_runs
from sierra.errors import UsageError
from sierra.stats.words import named
from sierra.store.store import Store
from sierra.util.text import digits_apart, short_number


def find(project: LoadedProject, store: Store, claim: Claim, value: ClaimedValue, batches: Mapping[str, str]) -> ClaimResult:
    """Return what the runs of a batch say about a value. Raises SierraError for a value that cannot be computed."""
    (batch,) = batches.values()
    runs = values_of_runs(project, store, batch, value.table, value.column, value.measure, value.threshold, value.where)
    chosen = runs.among(value.experiments)
    if len(chosen.cells) != 1:
        raise UsageError(
            f"experiments = {value.experiments!r} are {len(chosen.cells)}, but a value is that of one; "
            f'select one by {", ".join(runs.axes)}, as in experiments = "{runs.axes[0]}=…"'
        )
    [(ordinal, planned)] = chosen.planned.items()
    counted = [run for run in chosen.values[ordinal] if run.reached or value.statistic in CENSORED]
    if (too_many := lost(claim, len(counted), planned)) is not None:
        return too_many
    computed = statistics(
        project,
        store,
        batch,
        runs.output,
        runs.column,
        runs.measure,
        runs.threshold,
        chosen=(value.statistic,),
        among=lambda _: {ordinal},
        where=value.where,
    )
    each = {} if value.statistic in CENSORED else {str(run.seed): run.value + runs.offset for run in counted}
    notes = tuple(filter(None, "; ".join(computed.notes).split("; ")))
    estimates, _ = paper_tables.estimates_of(computed, value.statistic, {ordinal})
    estimate, low, high, n = estimates[ordinal]
    unit = f" {runs.unit}" if runs.unit not in ("", "1") else ""
    margin = distance(value.margin, value.expected)
    expected = f"expected {value.expected:.6g} ± {margin:.6g}{unit}"
    what = f"{named(value.statistic)} of {runs.column}"
    if estimate is None or low is None or high is None:
        known = f"{what} = {estimate:.6g}{unit}, but " if estimate is not None else ""
        return ClaimResult(
            Verdict.cannot_tell,
            f"{known}{n} runs are too few for its interval; {expected}",
            n,
            estimate,
            runs=each,
            notes=notes,
        )
    digits = digits_apart([estimate, low, high, value.expected])
    known, least, most = (short_number(number, digits) for number in (estimate, low, high))
    expected = f"expected {short_number(value.expected, digits)} ± {short_number(margin)}{unit}"
    text = f"{what} = {known}{unit}, 95 % CI [{least}, {most}], {expected}"
    verdict = decide(low, high, value.expected - margin, value.expected + margin)
    return ClaimResult(verdict, text, n, estimate, low, high, runs=each, notes=notes)


def decide(low: float, high: float, least: float, most: float) -> Verdict:
    """Return the verdict on an interval: within the limits, outside of them, or neither."""
    if least <= low and high <= most:
        return Verdict.holds
    return Verdict.does_not_hold if high < least or low > most else Verdict.cannot_tell
