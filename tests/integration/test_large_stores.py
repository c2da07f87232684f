"""Copies of a batch look as if they had been executed."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import pyarrow.parquet as pq
import pytest

import sierra
from sierra.store import segments
from tests import large_stores, projects, stores

COUNT = 20


def contents(root: Path) -> Counter[tuple[tuple[str, ...], ...]]:
    """Return how many batches have segments with these files, each with its columns and its number of rows."""
    found: dict[str, list[tuple[str, ...]]] = {}
    for segment in segments.on_disk(root / ".sierra" / "segments"):
        files = ((name, pq.ParquetFile(path)) for name, path in segment.files.items())
        texts = (f"{name} {file.schema_arrow.remove_metadata()} {file.metadata.num_rows}" for name, file in files)
        found.setdefault(segment.batch, []).append((*sorted(texts), *(Path(mark).name for mark in segment.marks)))
    return Counter(tuple(sorted(one)) for one in found.values())


@pytest.mark.integration
@pytest.mark.nightly
def test_copies_have_the_same_files_columns_and_numbers_of_rows_as_batches_that_were_executed(tmp_path: Path) -> None:
    executed = projects.make(tmp_path / "executed")
    project = sierra.open(executed)
    for query in ("population_size=9", "population_size=1,2"):
        batch = project.run(query, figures=False).batch
    copied = stores.copy(executed, tmp_path / "copied")
    large_stores.multiply(copied, batch, COUNT)
    for number in range(COUNT):
        project.run(f"population_size={10 + number},{100 + number}", figures=False)
    assert contents(copied) == contents(executed)
    counts = "SELECT count(*), count(DISTINCT run), sum(executions), count(DISTINCT status) FROM runs"
    assert sierra.open(copied).sql(counts).to_pylist() == project.sql(counts).to_pylist()
    for root in (executed, copied):
        assert sierra.open(root).maintenance.fsck().findings == ()
