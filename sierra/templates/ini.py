"""INI and properties templates: lines `key = value`, in INI below sections such as `[swarm]`.

There is no standard. SIERRA reads what programs read alike: `=` or `:` after a key, comments on lines of their own, values with
or without quotes. All values are texts. A value that programs read in different ways cannot be set: it continues on the next
line, may contain a comment, or has escapes. White space at the end of a line of properties, which Java reads, is replaced too.

Refused: sections and keys that occur twice, in INI keys before the first section, in properties sections, carriage returns that
are not part of a line end, and other lines.
"""

from __future__ import annotations

import re
from typing import ClassVar

from sierra.templates.notation import Kind, Node, Notation, Unfit, failure
from sierra.templates.tree import TreeTemplate
from sierra.util.lazy_definitions import regex

_LINE = regex(r"[^\n]*\n?")
_HEADER = regex(r"\s*\[([^\]\n]*)\]\s*(?:[#;].*)?")
_SIGN = regex("[=:]")
_COMMENT = regex(r"(?:^|\s)[#;]")
_LONE_RETURN = regex(r"\r(?!\n)")
_REFERENCE = regex(r"%[%(]")
"""A `%` that Python's configparser replaces."""
_BLANKS = " \t\f\r\n"
_KEY = regex(r"[\w.*\[\]-]+")


class IniNotation:
    """The notation of INI, or that of properties, which have no sections; see `sierra.templates.notation.Notation`."""

    def __init__(self, *, sections: bool) -> None:
        self.name = "INI" if sections else "properties"
        self._sections = sections

    def scan(self, text: str, name: str) -> Node:
        return _Reader(text, name, self.name, sections=self._sections).document()

    def text(self, node: Node, text: str) -> str:
        if node.style.endswith(":") and "=" in text:
            raise Unfit(f"cannot become {text!r} behind a colon; programs would read it in different ways")
        return self._written(text, node.style.rstrip(":"))

    def number(self, node: Node, text: str) -> str:
        return text

    def key(self, node: Node, key: str) -> str:
        if not _KEY.fullmatch(key) or key.startswith("["):
            raise Unfit(f"cannot get the key {key!r}; use letters, digits and _ . * -")
        return key

    def added(self, text: str, node: Node, key: str | None, new: Node, at: int | None) -> str:
        line_end = "\r\n" if "\r\n" in text else "\n"
        name = self.key(node, key or "")
        if self._sections and node.style == "document":
            if new.kind is not Kind.MAPPING:
                raise Unfit("has sections; add keys to one of them")
            lines = [f"[{name}]", *(self._line(child.key or "", child, " = ") for child in new.children)]
            start = len(text)
        else:
            last = node.children[-1] if node.children else None
            sign = text[last.keys[0][1] : last.entries[0][1]] if last else " = "
            match = re.match(r"[ \t]*[=:][ \t]*", sign)
            lines = [self._line(name, new, match[0] if match else " = ")]
            start = max((child.entries[0][1] for child in node.children), default=node.end)
        before = line_end if start and text[start - 1] != "\n" else ""
        return f"{text[:start]}{before}{line_end.join(lines)}{line_end}{text[start:]}"

    def removed(self, text: str, parent: Node, node: Node) -> str:
        start, end = node.entries[0]
        return text[:start] + text[end:]

    def _line(self, key: str, new: Node, sign: str) -> str:
        """Return a line with a key and its value, which is a text from now on."""
        if new.kind in (Kind.MAPPING, Kind.LIST, Kind.NULL):
            raise Unfit(f"cannot contain a {new.kind}; {self.name} has texts only")
        new.kind = Kind.UNTYPED
        return f"{self.key(new, key)}{sign}{self._written(new.value, '')}"

    def _written(self, text: str, quote: str) -> str:
        """Return a text as a value, if all programs read it alike."""
        plain = text.isprintable() and not _COMMENT.search(text) and "\\" not in text
        plain = plain and (not _REFERENCE.search(text) if self._sections else text.isascii())
        delimited = quote not in text if quote else text == text.strip() and text[:1] not in ("'", '"')
        if not plain or not delimited:
            raise Unfit(f"cannot become {text!r}; programs would read it in different ways")
        return text


class IniTemplate(TreeTemplate):
    """The template format `ini`."""

    notation: ClassVar[Notation] = IniNotation(sections=True)


class PropertiesTemplate(TreeTemplate):
    """The template format `properties`."""

    notation: ClassVar[Notation] = IniNotation(sections=False)


class _Reader:
    def __init__(self, text: str, name: str, format: str, *, sections: bool) -> None:
        self._text = text
        self._name = name
        self._format = format
        self._sections = sections
        self._root = Node(Kind.MAPPING, 0, 0, style="document")
        self._last: Node | None = None
        """The key of the line before, which this line may continue."""
        self._indent = 0
        self._known: set[tuple[Node, str]] = set()
        """The sections (below the document) and keys that were read."""

    def document(self) -> Node:
        section = None if self._sections else self._root
        if alone := _LONE_RETURN.search(self._text):
            what = "a carriage return, which some programs read as the end of the line; end lines with \\n or \\r\\n"
            raise self._wrong(alone.start(), what)
        for match in _LINE.finditer(self._text):
            start, end = match.span()
            line = match[0].rstrip()
            if self._is_filler(line) or self._continues(line, start, end):
                continue
            if line.lstrip()[0] in "#!":
                if self._sections:  # some programs read a key, which an indented line continues
                    self._last, self._indent = Node(Kind.UNTYPED, start, end, entries=[(start, end)]), _indent(line)
                continue
            if header := _HEADER.fullmatch(line):
                section = self._section(header, start, end)
            else:
                self._pair(section, line, start, end)
            if section is not None and section is not self._root:
                section.end = end
                section.entries = [(section.entries[0][0], end)]
        if not self._root.children:
            raise failure(self._name, self._text, 0, f"not {self._format}: there are no keys")
        return self._root

    def _is_filler(self, line: str) -> bool:
        """Return True for a line without a key, even if it is indented: in properties, it may continue a value."""
        return not line or (self._sections and (line.lstrip()[0] in "#;" or line.startswith("include ")))

    def _continues(self, line: str, start: int, end: int) -> bool:
        """Note that a line continues the value before it."""
        last, indent = self._last, _indent(line)
        if last is None:
            return False
        if self._sections and indent <= self._indent:
            return False
        if not self._sections and not last.value.endswith("\\"):
            return False
        last.why = "continues on the next line, which not all programs read; write it on one line"
        last.value += f"\n{line.strip()}"
        last.end = start + len(line)
        last.entries = [(last.entries[0][0], end)]
        return True

    def _section(self, header: re.Match[str], start: int, end: int) -> Node:
        if not self._sections:
            raise self._wrong(start, "properties have no sections; set template_format to ini")
        name = header[1].strip()
        if (self._root, name) in self._known:
            raise self._wrong(start, f"the section [{name}] occurs twice")
        self._known.add((self._root, name))
        begin = start + header.start(1) + len(header[1]) - len(header[1].lstrip())
        section = Node(Kind.MAPPING, begin, end, key=name, keys=[(begin, begin + len(name))], entries=[(start, end)])
        self._root.children.append(section)
        self._last = None
        return section

    def _pair(self, section: Node | None, line: str, start: int, end: int) -> None:
        sign = _SIGN.search(line)
        key = line[: sign.start()].strip() if sign else ""
        if sign is None or not key or (self._sections and key[0] == "["):  # some programs read `[a]=1` as a section
            raise self._wrong(start, "neither a key with a value nor a section")
        if section is None:
            raise self._wrong(start, "a key before the first section; set template_format to properties if there are none")
        if (section, key) in self._known:
            raise self._wrong(start, f"the key {key!r} occurs twice")
        self._known.add((section, key))
        indent, written = _indent(line), line[sign.end() :]
        node = _value(written.strip(), start + len(line) - len(written.lstrip()))
        behind = self._text[start:end].rstrip("\r\n")[len(line) :]
        node.why = self._doubt(line, key, sign[0], written, behind if node.style else "") or node.why
        if written.strip() != written.strip(_BLANKS) or behind.strip(_BLANKS):
            node.why = "has unusual white space around it, which programs read in different ways; use usual blanks"
        if not self._sections:
            node.end += len(behind)
        node.style += ":" if sign[0] == ":" else ""
        node.key, node.keys, node.entries = key, [(start + indent, start + indent + len(key))], [(start, end)]
        section.children.append(node)
        self._last, self._indent = node, indent

    def _doubt(self, line: str, key: str, sign: str, written: str, behind_quotes: str) -> str:
        """Return why programs read a line in different ways; empty if they do not."""
        if not self._sections and "\\" in line:
            return "has an escape or continues on the next line; write it in the template without"
        if not self._sections and re.search(r"\s", key):
            return "has white space in its key, where some programs begin the value; write it without"
        if not self._sections and behind_quotes:
            return "has white space behind its quotes, which not all programs ignore; write it without"
        if self._sections and written.endswith("\\"):
            return "continues on the next line, which not all programs read; write it on one line"
        if sign == ":" and "=" in written:
            return "has : and =, which programs read in different ways; write it with = alone"
        return ""

    def _wrong(self, position: int, what: str) -> Exception:
        return failure(self._name, self._text, position, f"not {self._format}: {what}")


def _indent(line: str) -> int:
    return len(line) - len(line.lstrip())


def _value(written: str, offset: int) -> Node:
    """Return the value of a line; quotes around it are not part of it."""
    quote = written[0] if len(written) > 1 and written[0] == written[-1] and written[0] in "\"'" else ""
    inner = written[1:-1] if quote else written
    start = offset + len(quote)
    node = Node(Kind.UNTYPED, start, start + len(inner), inner, style=quote)
    if _COMMENT.search(inner) or (not quote and written[:1] in ("'", '"')):
        node.why = "may contain a comment or a part in quotes; write the comment on its own line"
    elif quote and (quote in inner or "\\" in inner):
        node.why = "has quotes or escapes within quotes; write it in the template without"
    return node
