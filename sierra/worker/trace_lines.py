"""Calls in a log of strace: parsed into the call's name, its arguments and its result.

strace prints paths whole and escaped, whatever `-s` says. A call ends with `) = RESULT`, which a name may contain too.
"""

from __future__ import annotations

import re
from typing import NamedTuple

END = re.compile(rb"\) += ")
CALL = re.compile(rb'(\w+\((?:"(?:[^"\\]|\\.)*"|<(?:[^<>\\]|\\.)*>|[^"<])*?)\) += (?=-?\d|\?)(.*)', re.S)
RESULT = re.compile(rb"(-?\d+|\?)(?: <unavailable>)?(?:<((?:[^<>\\]|\\.)*)>(?:\(deleted\))?)?(?: (?:(E[A-Z0-9]+) )?\(.*\))?")
FILE = rb"(AT_FDCWD|-?\d+)(?:<((?:[^<>\\]|\\.)*)>(?:\(deleted\))?)?"
OPENED = re.compile(FILE)
ESCAPED = re.compile(rb"\\([0-7]{1,3}|x[0-9a-f]{2}|.)", re.S)
C_ESCAPES = {b"n": b"\n", b"t": b"\t", b"r": b"\r", b"v": b"\v", b"f": b"\f"}


class Damaged(Exception):
    """A line of a log is not what strace writes, or is not understood."""


class Call(NamedTuple):
    """A call that has returned."""

    name: bytes
    words: bytes
    """Its arguments."""
    number: int
    """The number that it returned; negative for an error."""
    path: bytes | None
    """The path of the descriptor that it returned."""
    error: bytes | None

    @property
    def flags(self) -> bytes:
        """The arguments behind the last name."""
        return self.words.rpartition(b'"')[2]


def parse(text: bytes) -> Call:
    """Return the call in a line, without the id of its process. Raises Damaged or ValueError if it is not a call."""
    pieces = END.split(text)
    if len(pieces) != 2:  # the same characters are in a name
        whole = CALL.fullmatch(text)
        pieces = list(whole.groups()) if whole else [b"", b""]
    name, opened, words = pieces[0].partition(b"(")
    match = RESULT.fullmatch(pieces[1])
    if match is None or not opened:
        raise Damaged
    value, path, error = match.groups()
    number = -1 if value == b"?" else int(value, 0)
    if number < 0 and not error:
        error = b"?" if value == b"?" else b"-"
    return Call(name, words, number, path, error)


def plain(text: bytes) -> bytes:
    """Return a path that strace has printed with escapes."""
    if b"\\" in text:
        text = without_escapes(text)
    if b"\0" in text:
        raise Damaged
    return text


def without_escapes(text: bytes) -> bytes:
    return ESCAPED.sub(unescaped, text)


def unescaped(match: re.Match[bytes]) -> bytes:
    code = match.group(1)
    if code[:1].isdigit():
        return bytes([int(code, 8) & 0xFF])
    if len(code) == 3:
        return bytes([int(code[1:], 16)])
    return C_ESCAPES.get(code, code)


def opened_path(call: Call) -> bytes:
    """Return the path of the descriptor that is a call's first argument; empty if it has none."""
    match = OPENED.match(call.words)
    return plain(match.group(2)) if match and match.group(2) else b""
