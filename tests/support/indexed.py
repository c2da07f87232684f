"""A plugin of pytest that builds an index before each snapshot: so all tests read one. See tests/nightly/test_indexed.py."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

from sierra.store import index_builder
from sierra.store.store import Snapshot, Store


@pytest.fixture(autouse=True, scope="session")
def _always_indexed() -> Iterator[None]:
    snapshot = Store.snapshot

    def indexed(self: Store, *arguments: Any, **more: Any) -> Snapshot:
        index_builder.keep_up(self.paths, 1)
        return snapshot(self, *arguments, **more)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Store, "snapshot", indexed)
        yield
