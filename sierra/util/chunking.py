"""Groups of consecutive items, limited by their total weight."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import TypeVar

T = TypeVar("T")


def by_weight(
    items: Iterable[T], weight: Callable[[T], int], limit: int, fits: Callable[[list[T], T], bool] = lambda group, item: True
) -> Iterator[list[T]]:
    """Yield groups of items whose total weight is at most `limit`, unless one item alone is heavier.

    An item that does not fit into the current group begins a new one.
    """
    group: list[T] = []
    total = 0
    for item in items:
        more = weight(item)
        if group and (total + more > limit or not fits(group, item)):
            yield group
            group, total = [], 0
        group.append(item)
        total += more
    if group:
        yield group
