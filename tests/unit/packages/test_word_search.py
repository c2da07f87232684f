"""Words are found in every spelling and encoding, and not inside other words."""

from __future__ import annotations

import io

import pytest

from sierra.packages.anonymity import word_search
from sierra.packages.anonymity.identifying_words import Word
from sierra.packages.anonymity.word_search import Search


def found(words: str | list[str], content: bytes, *accepted: str) -> list[tuple[str, int, int]]:
    listed = [words] if isinstance(words, str) else words
    search = Search([Word(text, "name") for text in listed], accepted)
    return [(one.text, one.offset, one.line) for one in search.stream(io.BytesIO(content))]


@pytest.mark.parametrize(
    "content",
    [
        *("by jane doe", "JANE DOE", "jane_doe", "JaneDoe", "doe, jane", "Jane%20Doe", "jane-doe@x", "Doe Jane"),
    ],
)
def test_a_name_is_found_however_it_is_written(content: str) -> None:
    assert len(found("Jane Doe", content.encode())) == 1
    assert len(found("Jane Doe", content.encode("utf-16-le"))) == 1
    assert len(found("Jane Doe", content.encode("utf-16-be"))) == 1


@pytest.mark.parametrize(
    "content",
    [
        "José Müller",
        "JOSÉ MÜLLER",
        "Jose Muller",
        "jose mueller",
        r"Jos\u00e9 M\u00fcller",
        "Jos&#233; M&#252;ller",
        "Jose\u0301 Mu\u0308ller",
    ],
)
def test_letters_with_accents_are_found_in_all_their_forms(content: str) -> None:
    assert len(found("José Müller", content.encode())) == 1
    for encoding in ("utf-16-le", "utf-16-be", "utf-32-le", "utf-32-be"):
        assert len(found("José Müller", content.encode(encoding))) == 1
    if "\u0301" not in content:
        assert len(found("José Müller", content.encode("latin-1"))) == 1


def test_short_words_count_only_where_no_letters_are_beside_them() -> None:
    assert found("doe", b"he does it\nshe\n doe_1 DOE: undoe") == [("doe", 16, 3), ("DOE", 22, 3)]
    assert len(found("jane", b"/home/jane/x jane2 janes")) == 2
    assert found("n1", b"n12 an1 n1x n1_ (n1)") == [("n1", 12, 1), ("n1", 17, 1)]
    assert len(found("janelab", b"MYJANELABS")) == 1


def test_tiny_words_count_only_as_whole_words_and_numbers() -> None:
    assert found("ed", b"3ed4 a5ed ed7 bed edit") == []
    assert found("vm", "évm vmé".encode()) == []
    assert [one[1] for one in found("vm", b"vm on vm_1, host-vm.")] == [0, 6, 17]
    assert [one[1] for one in found("vm", "\xe9 vm ".encode("latin-1"))] == [2]
    assert len(found("jane", "éjane jane2".encode())) == 2


def test_tiny_words_in_arrays_of_numbers_are_not_found() -> None:
    numbers = b"".join(number.to_bytes(4, "little") for number in (7, 118, 109, 9))
    assert found("vm", numbers) == found("vm", numbers[::2]) == []
    assert len(found("vm", "the host vm is up".encode("utf-16-le"))) == 1
    assert len(found("vm", "vm".encode("utf-16"))) == 1


def test_tiny_words_in_binary_data_need_readable_text_around_them() -> None:
    assert found("vm", b"\0\1vm\2\0" * 9) == []
    assert [one[0] for one in found("vm", b"\0\0host vm is up\0")] == ["vm"]
    assert [one[0] for one in found("jane", b"\0\1jane\2\0")] == ["jane"]


def test_the_longest_word_at_a_place_is_reported_once() -> None:
    assert [one[0] for one in found(["jane", "/home/jane", "/home/jane/study"], b"cd /home/jane/study && ls ~jane")] == [
        "/home/jane/study",
        "jane",
    ]


def test_a_word_is_accepted_only_within_the_accepted_text() -> None:
    content = b"see github.com/janelab/tools\nand janelab"
    assert found("janelab", content, "GitHub.com/JaneLab/tools") == [("janelab", 33, 2)]
    assert found("janelab", content, "janelab") == []
    assert found("janelab", content, "lab") == found("janelab", content, "") == found("janelab", content)


def test_offsets_and_lines_are_right_across_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    content = b"\n".join(b"x" * (number % 7) + b"secret-host" * (number % 3 == 0) for number in range(200))
    whole = found("secret-host", content)
    assert len(whole) == 67
    assert all(content[offset : offset + 11] == b"secret-host" for _, offset, _ in whole)
    assert all(content[:offset].count(b"\n") + 1 == line for _, offset, line in whole)
    for size in (1, 7, 64, 1000):
        monkeypatch.setattr(word_search, "CHUNK", size)
        assert found("secret-host", content) == whole
