"""Rows of the table `specs`, written from run specifications and read back."""

from __future__ import annotations

import json

from sierra.model import Around, Batch, RunSpec
from sierra.store.row_types import SpecRow


def of_batch(batch: Batch) -> SpecRow:
    """Return the row for the specification that all runs of a batch share."""
    spec = batch.spec
    return SpecRow(
        spec=batch.spec_id,
        platform=spec.platform,
        command=list(spec.command),
        variables=json.dumps(dict(spec.environment), sort_keys=True),
        source=spec.source,
        image=spec.image,
        host_access=list(spec.host_access),
        files=list(batch.experiments[0].runs[0].names),
        named_inputs=list(spec.named_inputs) or None,
        shared_files=spec.shared_files,
        around=json.dumps(spec.around.preimage()) if spec.around else None,
        robots=None if spec.robots is None else json.dumps(spec.robots),
    )


def run_spec(row: SpecRow) -> RunSpec:
    """Return the specification that a row describes. Raises ValueError, TypeError or KeyError if its JSON is damaged."""
    robots = None if row.robots is None else json.loads(row.robots)
    return RunSpec(
        platform=row.platform,
        command=tuple(row.command),
        environment=json.loads(row.variables),
        source=row.source,
        image=row.image,
        host_access=tuple(row.host_access or ()),
        named_inputs=tuple(row.named_inputs or ()),
        shared_files=row.shared_files,
        around=Around.of(json.loads(row.around)) if row.around else Around(),
        robots=None if robots is None else {group: tuple(argv) for group, argv in robots.items()},
    )
