"""Measure bags: 20,000 messages of odometry, from a bag in each format into a table, in CPU seconds."""

from __future__ import annotations

import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2]))

from sierra.ingest.model import Form, Shape
from sierra.ingest.read import read
from sierra.store.connections import connect
from sierra.testing.readers import written

MESSAGES = 20_000


def main() -> None:
    from tests.extensions.ros import bags

    with tempfile.TemporaryDirectory(prefix="sierra-bench-") as folder:
        for kind in bags.KINDS:
            path = bags.record(Path(folder, kind), kind, bags.odometry(2, MESSAGES // 2))
            shape = Shape("bag", form=Form(own=(("topics", ("/{robot}/odom",)),)))
            with connect() as connection:
                began = time.process_time()
                reading = read(connection, [written(path, 0)], shape, Path(folder, "table.parquet"))
                spent = time.process_time() - began
            assert list(reading.rows.values()) == [MESSAGES], reading.faults
            size = path.stat().st_size / 1e6
            print(f"{MESSAGES:,} messages of a {kind} of {size:.0f} MB, as a table {spent:8.2f} CPU s  (at most 2)", flush=True)


if __name__ == "__main__":
    main()
