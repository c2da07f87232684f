"""The section that lists batches, with the numbers of their runs."""

from __future__ import annotations

from collections.abc import Collection, Sequence

from sierra.deliverables.html.elements import Markup, Node, element, joined
from sierra.deliverables.report.parts import Section, filled_table, note
from sierra.execution.list_batches import ListedBatch
from sierra.util.hashing import short

MOST = 1000
"""The largest number of batches that are listed: a page with more becomes slow."""


def section(listed: Sequence[ListedBatch], shown: Collection[str], remedy: str = "") -> Section:
    """Return the list of batches in this order. Those in `shown` have a part of their own in the page.

    `remedy` says how to see the others if none has.
    """
    headers = ("batch", "query", "controller", "scenario", "experiments", "runs", "failed", "not executed", "first submitted")
    rows = [_row(one, one.batch in shown) for one in listed[:MOST]]
    inner: list[Node] = [filled_table(headers, rows, numbers=(4, 5, 6, 7, 8))]
    if len(listed) > MOST:
        inner.append(note(f"The first {MOST:,} of {len(listed):,} batches are listed; sierra ls lists all."))
    if not shown:
        inner.append(note(f"These are too many batches for one page; {remedy}"))
    return Section("batches", "Batches", joined(inner))


def _row(one: ListedBatch, shown: bool) -> tuple[Node, ...]:
    identity: Markup = element("code", short(one.batch))
    return (
        element("a", identity, href=f"#b{short(one.batch)}") if shown else identity,
        one.query,
        one.controller,
        one.scenario,
        f"{one.experiments:,}",
        f"{one.runs:,}",
        "?" if one.failed is None else f"{one.failed:,}",
        "?" if one.missing is None else f"{one.missing:,}",
        f"{one.created:%Y-%m-%d %H:%M}",
    )
