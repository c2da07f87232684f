"""The records of registered claims: their ids, and the segments that they are in.

A registration belongs to no batch. So the names of its segments begin with zeros instead of a batch's id.
"""

from __future__ import annotations

import json
from collections.abc import Mapping

from sierra.store.row_types import RegisteredClaimRow
from sierra.util.hashing import digest
from sierra.util.json_types import JsonView

NO_BATCH = "0" * 64
"""Instead of the id of a batch, for segments that belong to none."""


def claim_id(form: Mapping[str, JsonView]) -> str:
    """Return the id of a claim's normal form."""
    return digest("claim", form)


def row_id(row: RegisteredClaimRow) -> str:
    """Return the id that follows from a registration's columns. Raises ValueError for a text that is not JSON."""
    return claim_id(json.loads(row.text))
