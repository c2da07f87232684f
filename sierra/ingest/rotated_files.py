"""Rotated files: the parts of one file, such as `data.csv`, `data.csv.1` and `data.csv.2.gz`, as one table, oldest rows first.

The parts of each run are joined before they are read. The header of the oldest part counts; another part may repeat it. Each
part but the newest must end with a line feed. The lines of the joined file are counted a second time, in the parts.
"""

from __future__ import annotations

import gzip
from collections.abc import Iterable, Sequence
from pathlib import Path

from sierra.config.output_tables import NUMBERED, part_of
from sierra.ingest.base import UnreadableError
from sierra.ingest.independent_row_count import described
from sierra.ingest.messages import shown
from sierra.ingest.model import Shape, Written
from sierra.ingest.rewriting import OriginalFile, is_compressed

BOM = b"\xef\xbb\xbf"


def by_age(files: Iterable[Written], base: str) -> list[Written]:
    """Return the parts of a file, the oldest first: the highest number, or the first date; the file itself is the newest."""
    return sorted(files, key=lambda file: part_of(base, file.name) or ())


def join(files: Sequence[Written], shape: Shape, target: Path) -> Written:
    """Write the parts of one run, which are sorted by age, into one file; return it under the name of the newest part.

    Raises UnreadableError.
    """
    _check_parts(files, shape.rotated)
    if len(files) == 1:
        return files[0]
    whole, lines = bytearray(), 0
    head: Sequence[bytes] = ()
    for place, file in enumerate(files):
        content = OriginalFile(file).content()
        content = content.removeprefix(BOM) if place else content
        if content and not content.endswith(b"\n") and place < len(files) - 1:
            raise UnreadableError(f"its part {shown(file.name)} does not end with a line feed")
        count = content.count(b"\n")
        own, until = _head(content, shape)
        if not place:
            head = own
        elif head and own == head:
            content = content.split(b"\n", until)[-1]
            count -= until
        lines += count
        whole += content
    if whole.count(b"\n") != lines:
        raise UnreadableError("its parts have other lines than the joined file")
    newest = files[-1]
    if is_compressed(newest.name):
        import pyarrow as pa

        packed = (
            gzip.compress(whole) if newest.name.lower().endswith(".gz") else pa.compress(bytes(whole), "zstd", asbytes=True)
        )
        target.write_bytes(packed)
    else:
        target.write_bytes(whole)
    return described(newest, target)


def _check_parts(files: Sequence[Written], base: str) -> None:
    """Raise UnreadableError if two files are the same part, such as `data.csv.1` and `data.csv.1.gz`, or if one is missing."""
    names: dict[tuple[int, int, str] | None, str] = {}
    for file in files:
        first = names.setdefault(part_of(base, file.name), file.name)
        if first != file.name:
            raise UnreadableError(f"its parts {shown(first)} and {shown(file.name)} are the same part; keep one of them")
    numbers = sorted(-place[1] for place in names if place and place[0] == NUMBERED)
    absent = next((number for number in range(1, max(numbers, default=0)) if number not in numbers), None)
    if absent is not None:
        raise UnreadableError(f"its part {absent} is missing, but there is {numbers[-1]}")


def _head(content: bytes, shape: Shape) -> tuple[Sequence[bytes], int]:
    """Return the header of a part without comments, and the number of lines until its end; nothing if it has none."""
    if shape.format != "csv" or not shape.header or shape.form.lines:
        return (), 0
    form = shape.form
    marks = tuple(comment.encode() for comment in form.comments)
    found: list[bytes] = []
    for number, line in enumerate(content.removeprefix(BOM).split(b"\n")[:-1], 1):
        if number > form.skip and line.strip() and not line.lstrip(b" \t").startswith(marks):
            found.append(line)
        if len(found) == form.header_lines + form.units_row:
            return found, number
    return (), 0
