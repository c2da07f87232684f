"""The conformance suite for readers: each shipped format passes it, and readers that break a claim do not."""

from __future__ import annotations

import gzip
import io
import sqlite3
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from sierra.config import extensions
from sierra.config.plugin_registry import READERS
from sierra.ingest.model import PLAIN, Form
from sierra.testing import readers as conformance
from tests.tiers import of_extension

TABLES: list[dict[str, list[Any]]] = [{"t": [1, 2, 3], "v": [0.5, 1.5, -2.25]}, {"t": [4], "v": [12345.5]}]


def lines(table: dict[str, list[Any]], between: str = ",") -> bytes:
    rows = zip(*table.values(), strict=True)
    return "".join(f"{between.join(map(str, row))}\n" for row in ([*table], *rows)).encode()


def objects(table: dict[str, list[Any]]) -> list[str]:
    return [f'{{"t": {t}, "v": {v}}}' for t, v in zip(table["t"], table["v"], strict=True)]


def arrow(table: dict[str, list[Any]]) -> bytes:
    stream, content = io.BytesIO(), pa.table(table)
    with pa.ipc.new_file(stream, content.schema) as writer:
        writer.write_table(content)
    return stream.getvalue()


def parquet(table: dict[str, list[Any]]) -> bytes:
    stream = io.BytesIO()
    pq.write_table(pa.table(table), stream)
    return stream.getvalue()


def npz(table: dict[str, list[Any]]) -> bytes:
    stream = io.BytesIO()
    np.savez(stream, **{name: np.array(values) for name, values in table.items()})
    return stream.getvalue()


def sqlite(table: dict[str, list[Any]]) -> bytes:
    database = sqlite3.connect(":memory:")
    database.execute("CREATE TABLE s (t, v)")
    database.executemany("INSERT INTO s VALUES (?, ?)", zip(*table.values(), strict=True))
    database.commit()
    return bytes(database.serialize())


def graph(table: dict[str, list[Any]]) -> bytes:
    keys = '<key id="t" for="node" attr.name="t" attr.type="int"/><key id="v" for="node" attr.name="v" attr.type="double"/>'
    rows = zip(table["t"], table["v"], strict=True)
    nodes = "".join(f'<node id="n{t}"><data key="t">{t}</data><data key="v">{v}</data></node>\n' for t, v in rows)
    return f'<graphml xmlns="http://graphml.graphdrawing.org/xmlns">{keys}<graph>\n{nodes}</graph></graphml>\n'.encode()


def xml(table: dict[str, list[Any]]) -> bytes:
    rows = (f'<s t="{t}" v="{v}"/>\n' for t, v in zip(table["t"], table["v"], strict=True))
    return f"<r>\n{''.join(rows)}</r>\n".encode()


MADE: dict[str, tuple[Any, Form]] = {
    "csv": (lines, PLAIN),
    "parquet": (parquet, PLAIN),
    "jsonl": (lambda table: "".join(f"{row}\n" for row in objects(table)).encode(), PLAIN),
    "json": (lambda table: f"[{','.join(objects(table))}]".encode(), PLAIN),
    "xml": (xml, Form(rows="//s")),
}
OF_FORMATS: dict[str, tuple[Any, Form]] = {
    "graphml": (graph, Form(rows="nodes")),
    "npy": (npz, PLAIN),
    "arrow": (arrow, PLAIN),
    "sqlite": (sqlite, Form(rows="s")),
}
"""Formats of the extension of this name."""
EXTRA = {"hdf5", "netcdf", "bag"}
"""Formats that `test_hdf5_and_netcdf` and `test_bags` check."""


def columns(kind: str, table: dict[str, list[Any]]) -> dict[str, list[Any]]:
    """Return a table as the format has it: some add the place or the name of a row."""
    added = {"npy": {"i": list(range(len(table["t"])))}, "graphml": {"id": [f"n{t}" for t in table["t"]]}}
    return {**added.get(kind, {}), **table}


def test_every_shipped_format_is_checked() -> None:
    assert {*MADE, *OF_FORMATS, *EXTRA} == {*READERS.shipped, *extensions.every("readers")}


@pytest.mark.integration
@pytest.mark.parametrize("kind", [*MADE, *of_extension("formats", *OF_FORMATS)])
def test_shipped_reader_passes_the_suite(tmp_path: Path, kind: str) -> None:
    make, form = (MADE | OF_FORMATS)[kind]
    tables = {make(table): columns(kind, table) for table in TABLES}
    damaged = [] if kind in ("csv", "jsonl") else [next(iter(tables))[:-9]]
    conformance.check(kind, tables, [*damaged, gzip.compress(b"x")], tmp_path, form=form)


@pytest.mark.integration
@pytest.mark.parametrize("form", [Form(comment="#"), Form(na=("NA",))])
def test_reader_of_text_as_found_passes_the_suite(tmp_path: Path, form: Form) -> None:
    conformance.check("csv", {lines(table): table for table in TABLES}, [b"t,v\n1\n"], tmp_path, form=form)


def test_reader_that_reads_other_rows_fails_the_suite(tmp_path: Path) -> None:
    wrong = {**TABLES[0], "v": [0.5, 1.5, 9.0]}
    with pytest.raises(AssertionError, match="became"):
        conformance.check("csv", {lines(TABLES[0]): wrong}, [], tmp_path)


def test_reader_that_accepts_a_damaged_file_fails_the_suite(tmp_path: Path) -> None:
    with pytest.raises(AssertionError, match="a damaged file is accepted"):
        conformance.check("csv", {lines(TABLES[0]): TABLES[0]}, [lines(TABLES[1])], tmp_path)
