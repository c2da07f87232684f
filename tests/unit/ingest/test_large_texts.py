"""Large files whose first rows do not tell the types of their columns are recorded as if all rows had been looked at."""

from __future__ import annotations

from pathlib import Path

import pytest

from sierra.ingest import text_table_reader
from tests.readings import read_file, read_files

ROWS = 5_000
GREAT = 2**53 + 1


def content(value: str, ending: str) -> bytes:
    """Return a file with one value in all rows but the last."""
    lines = ["t,v", *(f"{number},{value}" for number in range(ROWS)), f"{ROWS},{ending}"]
    return "\n".join([*lines, ""]).encode()


@pytest.mark.parametrize("format_name", ["t.csv", "t.jsonl"])
@pytest.mark.parametrize(
    ("value", "ending"),
    [
        ("0", "0.5"),
        ("0", str(GREAT)),
        ("0.5", str(GREAT)),
        ("nan", str(GREAT)),
        ("nan", "1"),
        ("nan", "9" * 30),
        ("1", "nan"),
        ("1", ""),
        ("", "1"),
        ("1", "true"),
        ("true", "false"),
        ("true", "1"),
        ("1", "late text"),
        ("0.5", "1_000"),
        ("0.5", "1e999"),
        ("0.5", "1.#INF"),
        ("text", "1"),
        ("1", "9" * 30),
    ],
)
def test_the_last_row_counts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, value: str, ending: str, format_name: str
) -> None:
    text = content(value, ending) if format_name == "t.csv" else as_json(value, ending)
    read = [read_file(tmp_path, format_name, text)]
    monkeypatch.setattr(text_table_reader, "LARGE", 1000)
    read.append(read_file(tmp_path, format_name, text))
    (whole, rows), (quick, same) = read
    assert repr(rows) == repr(same)
    assert (whole.faults, whole.hints, whole.shape, list(whole.columns.values()), list(whole.rows.values())) == (
        quick.faults,
        quick.hints,
        quick.shape,
        list(quick.columns.values()),
        list(quick.rows.values()),
    )


def as_json(value: str, ending: str) -> bytes:
    def written(text: str) -> str:
        plain = text in ("true", "false") or text.replace(".", "", 1).isdigit()
        return text if plain else "null" if not text else f'"{text}"'

    lines = [
        *(f'{{"t": {number}, "v": {written(value)}}}' for number in range(ROWS)),
        f'{{"t": {ROWS}, "v": {written(ending)}}}',
    ]
    return "\n".join([*lines, ""]).encode()


@pytest.mark.parametrize("others", [1, 4])
@pytest.mark.parametrize("large", [1000, 1 << 30])
def test_whole_numbers_are_exact_beside_fractions_of_files_with_other_kinds(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, others: int, large: int
) -> None:
    def text(v: str, w: str) -> bytes:
        return ("t,v,w\n" + "".join(f"{number},{v},{w}\n" for number in range(ROWS))).encode()

    monkeypatch.setattr(text_table_reader, "LARGE", large)
    paths = [tmp_path / f"{number}" / "t.csv" for number in range(1 + others)]
    _, rows = read_files(tmp_path, paths, [text("0.5", "hello"), *[text(str(GREAT), "1")] * others])
    assert {row["v"] for row in rows} == {0.5, GREAT}


def test_one_of_several_files_differs_late(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    paths = [tmp_path / f"{number}" / "t.csv" for number in range(5)]
    contents = [content("0", "0.5" if number == 2 else "1") for number in range(5)]
    _, rows = read_files(tmp_path, paths, contents)
    monkeypatch.setattr(text_table_reader, "LARGE", 1000)
    _, same = read_files(tmp_path, paths, contents)
    assert repr(rows) == repr(same)
    assert sorted(row["v"] for row in rows)[-5:] == [0.5, 1, 1, 1, 1]
