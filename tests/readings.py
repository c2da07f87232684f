"""Output files that are read as recording reads them, for tests of readers."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq

from sierra.config.output_tables import Output
from sierra.ingest.match_outputs import OutputMatcher
from sierra.ingest.model import Reading, Shape, Written
from sierra.ingest.read import read
from sierra.model import OutputFile
from sierra.worker.outputs import describe
from tests import samples


def shape_of(path: Path, keys: dict[str, Any]) -> Shape:
    """Return how a file of this name is read that is declared with these keys."""
    output = Output.model_validate({"file": path.name, **keys})
    file = OutputFile(path.name, 0, "", 0, True, "")
    result = type("", (), {"outputs": (file,)})()
    [(_, shape, _)] = OutputMatcher({"t": output}, {}).of(result)
    return shape


def read_file(folder: Path, name: str, content: bytes, **keys: Any) -> tuple[Reading, list[dict[str, Any]]]:
    """Read one file as recording does; return the reading and its rows."""
    return read_files(folder, [folder / name], [content], **keys)


def read_files(
    folder: Path, paths: Sequence[Path], contents: Sequence[bytes], **keys: Any
) -> tuple[Reading, list[dict[str, Any]]]:
    """Read files of several runs together, as recording does; return the reading and its rows, by written file."""
    target = folder / "target" / "table.parquet"
    target.parent.mkdir(parents=True, exist_ok=True)
    for old in target.parent.iterdir():
        old.unlink()
    files = [written(path, place, content) for place, (path, content) in enumerate(zip(paths, contents, strict=True))]
    reading = read(samples.database(2), files, shape_of(paths[0], keys), target)
    assert [path.read_bytes() for path in paths] == list(contents)
    rows = [row for part in sorted(target.parent.iterdir()) for row in pq.ParquetFile(part).read().to_pylist()]
    return reading, [{name: row[name] for name in row if name not in ("run", "execution", "file")} for row in rows]


def written(path: Path, place: int, content: bytes) -> Written:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content)
    seen = OutputFile(**describe(str(path), path.name))
    facts = (seen.path, seen.head, seen.lines, seen.ended, seen.bytes, seen.quotes, seen.blank, seen.alike)
    return Written(str(path), f"r{place}", f"e{place}", *facts)
