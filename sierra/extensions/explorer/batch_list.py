"""The list of batches, of which the page shows a part: a project can have ten thousand."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC

from sierra.execution import list_batches
from sierra.execution.list_batches import ListedBatch
from sierra.store.store import Store
from sierra.util.json_types import JsonView
from sierra.util.lazy_definitions import dataclass

PAGE = 100
"""The largest number of batches that one answer lists."""


@dataclass(frozen=True, slots=True)
class BatchList:
    """All batches of one state of a store, the newest first."""

    state: str
    batches: Sequence[ListedBatch]
    texts: Sequence[str]
    """The text of each batch in which the words of a filter are looked for, in lower case."""

    def part(self, words: str, first: int) -> JsonView:
        """Return the batches that contain all words, from the one at the place `first` on, and their number."""
        wanted = words.lower().split()
        found = [one for one, text in zip(self.batches, self.texts, strict=True) if all(word in text for word in wanted)]
        return {"all": len(self.batches), "found": len(found), "batches": [as_data(one) for one in found[first : first + PAGE]]}


def read(store: Store, state: str) -> BatchList:
    """Return the batches that the store has now."""
    found = list_batches.batches(store)[::-1]
    return BatchList(state, found, [_text(one) for one in found])


def as_data(batch: ListedBatch) -> JsonView:
    """Return the facts about a batch that the page shows."""
    return {
        "batch": batch.batch,
        "query": batch.query,
        "requested": f"{(batch.submitted or batch.created).astimezone(UTC):%Y-%m-%d %H:%M} UTC",
        "groups": list(filter(None, (batch.controller, batch.scenario, *batch.targets))),
        "experiments": batch.experiments,
        "runs": batch.runs,
        "state": _state(batch),
        "package": batch.package,
    }


def _state(one: ListedBatch) -> str:
    counts = ((len(one.clusters) and "on a cluster", ""), (one.failed, "failed"), (one.missing, "missing"))
    parts = [f"{count} {word}".strip() for count, word in counts if count]
    return ", ".join(parts) or "complete"


def _text(one: ListedBatch) -> str:
    return " ".join(filter(None, (one.batch, one.query, one.controller, one.scenario, *one.targets, _state(one)))).lower()
