"""Claims that one SQL statement decides: it yields one row, whose first column says whether the claim holds."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping

from sierra.config.claim_table import Claim
from sierra.deliverables.claims.model import ClaimResult, Verdict
from sierra.errors import SierraError
from sierra.store.batch_data import BatchData
from sierra.store.several_batches import joined
from sierra.store.sql_result import SqlValue
from sierra.store.store import Store
from sierra.util.arrow_columns import rows_of
from sierra.util.lazy_definitions import regex
from sierra.util.text import DIGITS, digits_apart, few, short_number

SHOWN = 8
"""The largest number of columns in the text."""
ENDS = regex(r"\boutcomes?\b|_accepted\b", re.IGNORECASE)
"""Names in a statement that is about accepted ends."""


def find(store: Store, name: str, claim: Claim, batches: Mapping[str, str]) -> ClaimResult:
    """Return what the statement of a claim says about batches, by label. Raises SierraError for one that decides nothing."""
    n = _runs(store, claim, batches)
    if isinstance(n, ClaimResult):
        return n
    origin = f"[claims.{name}] sql"
    answer = joined(store, batches, claim.sql, origin, find_undefined=True)
    if answer.table.num_rows != 1:
        raise SierraError(f"{origin}: it has {answer.table.num_rows} rows; a claim needs one")
    first, *others = answer.table.column_names
    row: dict[str, SqlValue] = dict(zip(answer.table.column_names, rows_of(answer.table)[0].values(), strict=True))
    if (kind := str(answer.table.schema.field(0).type)) != "bool":
        raise SierraError(f"{origin}: its first column {first!r} is {kind}, not true or false; write a condition, as in x > 1")
    numbers = {other: row[other] for other in others}
    digits = digits_apart(numbers.values())
    texts = [f"{other} = {_shown(value, digits)}" for other, value in numbers.items()]
    text = few(texts, SHOWN) or f"{first} = {_shown(row[first])}"
    if row[first] is None:
        return ClaimResult(Verdict.cannot_tell, f"the statement yields NULL; {text}", n, numbers=numbers)
    undefined = [other for other, value in numbers.items() if isinstance(value, float) and math.isnan(value)]
    if undefined or answer.undefined:
        where = (
            f"{undefined[0]} is NaN" if undefined else f"{answer.undefined[0]} has NaN, which SQL takes for the largest number"
        )
        return ClaimResult(Verdict.cannot_tell, f"{where}; use isfinite() in the statement", n, numbers=numbers)
    value = next((v for v in numbers.values() if isinstance(v, int | float) and not isinstance(v, bool)), None)
    return ClaimResult(Verdict.holds if row[first] else Verdict.does_not_hold, text, n, value, numbers=numbers)


def _runs(store: Store, claim: Claim, batches: Mapping[str, str]) -> int | ClaimResult:
    """Return the number of runs that count; if too many are lost, what that means.

    Runs with accepted ends count if the statement names their outcomes or their tables.
    """
    counts: list[tuple[int, int]] = []
    reasons: list[str | None] = []
    for batch in batches.values():
        with BatchData(store, batch) as frame:
            counts += frame.counts().values()
            if ENDS.search(claim.sql):
                counts += ((runs, 0) for ends in frame.accepted().values() for runs in ends.values())
            reasons.append(frame.failure())
    n, planned = (sum(part) for part in zip(*counts, strict=True))
    if not n and (reason := next(filter(None, reasons), None)):
        return ClaimResult(Verdict.cannot_tell, reason, 0)
    return lost(claim, n, planned) or n


def lost(claim: Claim, n: int, planned: int) -> ClaimResult | None:
    """Return what it means that only n of the planned runs have a value; None if the claim allows that, and n is not 0."""
    if n and planned - n <= claim.allowed(planned):
        return None
    why = "failed, were cut off, are missing or have no finite value"
    more = f"; the claim allows {claim.allowed(planned)} (lost)" if n else ""
    return ClaimResult(Verdict.cannot_tell, f"{planned - n} of {planned} runs {why}{more}", n)


def _shown(value: SqlValue, digits: int = DIGITS) -> str:
    return (
        short_number(value, digits)
        if isinstance(value, float)
        else str(value).lower()
        if isinstance(value, bool)
        else str(value)
    )
