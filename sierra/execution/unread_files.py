"""The files of runs that became no table: why, and what to declare in `sierra.toml` to make tables of them."""

from __future__ import annotations

import contextlib
import io
import json
import re
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path, PurePosixPath

from sierra.config.output_tables import (
    FILE_FORMAT,
    ROTATED_FORMATS,
    ROTATION,
    Key,
    Keys,
    Output,
    Proposal,
    archive_of,
    newest_of,
    of_extensions,
)
from sierra.config.plugin_registry import READERS
from sierra.ingest import json_lists, printed_lines, text_headers, xml_lists
from sierra.ingest.base import UnreadableError
from sierra.ingest.json_lists import in_words
from sierra.ingest.match_outputs import AUTOMATIC_AT_MOST, automatic_format, table_name, unnamed_format
from sierra.ingest.open_names import OF_ROBOT
from sierra.store.layout import RUN_STDOUT
from sierra.util.lazy_definitions import dataclass, field, regex
from sierra.util.text import numbered

NUMBER = regex("[0-9]+")
NAMED: Mapping[str, str] = {
    "json": 'format = "json"',
    "xml": 'format = "xml", rows = "//ELEMENT"',
    **dict.fromkeys(("dat", "txt", "out"), 'format = "csv" and, for columns between blanks, delimiter = "blanks"'),
}
"""The keys that make tables of files with these endings, which no reader takes by itself."""
TEXTS = ("dat", "txt", "out", "xvg", "log", "thermo", "prn")
"""The endings of texts that may be tables."""
SEARCHED: Mapping[str, Callable[[bytes], Keys | None]] = {"json": json_lists.keys_of, "xml": xml_lists.keys_of}
"""The endings of documents that are searched for lists of rows."""
COMPRESSED = ("gz", "zst")
UNNAMABLE = "file in [outputs.NAME] cannot name it, because of the braces, or of * ? [, in its name; give it another name"
MOST_EXPANDED = 1 << 28
"""The largest number of bytes to which an archive may expand that is searched for tables."""


@dataclass(frozen=True, slots=True)
class Alike:
    """Files whose names differ only in numbers: the first name, their number in all runs and in one, and the number of runs."""

    path: str
    files: int
    most: int
    runs: int
    varying: Collection[int] = ()
    """The places of the numbers that differ; the first place is 1."""
    content: Callable[[], bytes | None] = lambda: None
    """The bytes of the first file, or None if it is too large or not there."""
    in_archive: bool = False


@dataclass(frozen=True, slots=True)
class UnreadFiles:
    """Files of a batch that became no table: an example, their number in all runs, and the reason."""

    path: str
    files: int
    why: str
    noted: bool
    """True if `sierra run` prints a note about such files in each session."""
    name: str = ""
    """The name of the table that `keys` make."""
    keys: Keys = field(default_factory=dict)
    """The keys of `[outputs.NAME]` that make a table of them; empty if somebody has to choose."""


def unread_files(
    kinds: Iterable[Alike], outputs: Mapping[str, Output], tables: Iterable[str], runs: int
) -> tuple[UnreadFiles, ...]:
    """Return why files became no table; `outputs` are declared, `tables` exist, and there are so many `runs`."""
    known = {name.lower() for name in tables}
    taken = {*known, *(name.lower() for name in outputs)}
    unread: list[UnreadFiles] = []
    for alike in kinds:
        if any(output.rotated and output.matches(alike.path) for output in outputs.values()):
            continue  # an older part of a table
        in_archive = [
            proposal
            for member in _members(alike, outputs)
            for proposal in _all(member, outputs, known, taken, runs)
            if proposal.keys
        ]
        unread += in_archive or _all(alike, outputs, known, taken, runs)
    return tuple(unread)


def _all(
    one: Alike, outputs: Mapping[str, Output], tables: Collection[str], taken: set[str], runs: int
) -> Sequence[UnreadFiles]:
    """Return the tables that files make, or why they make none; add the names of the tables to `taken`."""
    found = _proposed(one, outputs, taken, runs) or [_unread(one, outputs, tables, _free(one.path, taken), runs)]
    if any(made.keys and not _is_named(str(made.keys["file"]), one.path) for made in found):
        found = [UnreadFiles(one.path, one.files, UNNAMABLE, False)]
    taken |= {made.name.lower() for made in found if made.keys}
    return found


def _is_named(file: str, path: str) -> bool:
    """Return whether `file` in `[outputs.NAME]` would name a path."""
    try:
        return Output(file=file, format="csv").names(path)
    except ValueError:
        return False


def _members(kind: Alike, outputs: Mapping[str, Output]) -> Iterator[Alike]:
    """Yield the files in an undeclared archive, those whose names differ only in numbers together; none if it is damaged."""
    declared = any(output.matches(kind.path) for output in outputs.values())
    content = None if declared or not archive_of(f"{kind.path}/*") else kind.content()
    if content is None:
        return
    from sierra.ingest.archives import OF_MACOS, members

    alike: dict[str, dict[str, bytes | None]] = {}
    with contextlib.suppress(UnreadableError):
        for member in members(io.BytesIO(content), kind.path, MOST_EXPANDED):
            if OF_MACOS.search(member.name):
                continue
            some = alike.setdefault(NUMBER.sub("0", member.name), {})
            some[member.name] = None
            if len(some) == 1 and member.size <= most_searched(member.name):
                with contextlib.suppress(UnreadableError):  # a link
                    some[member.name] = b"".join(member.content)
        before = len(NUMBER.findall(kind.path))
        for some in alike.values():
            first, varying = next(iter(some)), {*kind.varying, *(before + position for position in _varying(some))}
            counts = kind.files * len(some), kind.most * len(some), kind.runs
            yield Alike(f"{kind.path}/{first}", *counts, varying, partial(some.get, first), in_archive=True)


def of_run(
    paths: Iterable[str], outputs: Mapping[str, Output], tables: Iterable[str], folder: Path | None
) -> tuple[UnreadFiles, ...]:
    """Return why files of a single run became no table; they are in `folder`."""
    alike: dict[str, list[str]] = {}
    for path in sorted(paths):
        alike.setdefault(NUMBER.sub("0", path), []).append(path)
    kinds = [
        Alike(some[0], len(some), len(some), 1, _varying(some), partial(read_small, folder and folder / some[0]))
        for some in alike.values()
    ]
    return unread_files(kinds, outputs, tables, 1)


def printed(log: Path, outputs: Mapping[str, Output]) -> tuple[UnreadFiles, ...]:
    """Return the tables that the standard output of a run makes, if it is not declared."""
    if any(output.is_stdout for output in outputs.values()):
        return ()
    content = read_small(log)
    return tuple(
        UnreadFiles(RUN_STDOUT, 1, f"a table only if it is declared: [outputs.{name}] {in_words(keys)}", False, name, keys)
        for name, keys in (printed_lines.keys_of(content) if content else {}).items()
    )


def read_small(path: Path | None) -> bytes | None:
    """Return the content of a file that a run wrote; None if it is too large to be searched for tables, or not there."""
    try:
        usable = (
            path is not None and not path.is_symlink() and path.is_file() and path.stat().st_size <= most_searched(path.name)
        )
        return path.read_bytes() if path is not None and usable else None
    except OSError:
        return None


def most_searched(path: str) -> int:
    """Return the largest number of bytes of a file of this name that is searched for its tables."""
    return _of_ending(_ending(path)).most_searched


def _of_ending(ending: str) -> type[Output]:
    """Return the class of the outputs of files with this ending."""
    return next((output for output in of_extensions().values() if ending in output.endings), Output)


def _varying(paths: Iterable[str]) -> set[int]:
    columns = zip(*(NUMBER.findall(path) for path in paths), strict=True)
    return {place for place, numbers in enumerate(columns, 1) if len(set(numbers)) > 1}


def _unread(alike: Alike, outputs: Mapping[str, Output], tables: Collection[str], name: str, runs: int) -> UnreadFiles:
    declared = next((name for name, output in outputs.items() if output.matches(alike.path)), None)
    if declared is None and (newest := _newest(alike, outputs, tables)):
        message = f"older than {newest!r}, whose table has only the newest rows"
        return UnreadFiles(alike.path, alike.files, f'{message}; set file = "{newest}{ROTATION}"', True)
    if declared is not None:
        return UnreadFiles(alike.path, alike.files, *_declared(declared, outputs[declared], alike.content))
    file = pattern(alike)
    table = f"[outputs.{name}] file = {json.dumps(file, ensure_ascii=False)}"
    keys: Keys = {"file": file} | ({} if alike.runs == runs else {"required": False})
    if read := _text_keys(alike):
        only_named = read.keys() <= {"format", "delimiter"}
        what = "this ending is read only if its format is named" if only_named else "it is no plain CSV"
        why = f"{what}; declare {table}, {in_words(read)}"
        return UnreadFiles(alike.path, alike.files, why, False, name, {**keys, **read})
    if automatic_format(alike.path):
        noted = not alike.in_archive
        return UnreadFiles(alike.path, alike.files, f"{_not_automatic(alike, tables)}; declare {table}", noted, name, keys)
    ending = _ending(alike.path)
    if ending in COMPRESSED:
        inner = PurePosixPath(alike.path).stem
        if plain := automatic_format(inner):
            why = f'compressed; to make a table of it, declare {table}, format = "{plain}"'
            return UnreadFiles(alike.path, alike.files, why, False, name, {**keys, "format": plain})
        also = _named(_ending(inner))
        why = f"compressed; to make a table of it, declare {table}, {also}" if also else "no reader takes it"
    elif ending in READERS.added():
        why = f"the installed reader {ending!r} takes declared files only; declare {table}"
    elif ending in SEARCHED and (rows := _rows_of(alike, ending)) is not None:
        read = {"format": ending, **rows}
        why = f"this ending is read only if its format is named; declare {table}, {in_words(read)}"
        return UnreadFiles(alike.path, alike.files, why, False, name, {**keys, **read})
    elif named := _named(ending):
        why = f"this ending is read only if its format is named; declare {table}, {named}"
    else:
        why = f"no reader takes {'files without an ending' if not ending else f'.{ending} files'}"
    return UnreadFiles(alike.path, alike.files, why, False)


def _newest(one: Alike, outputs: Mapping[str, Output], tables: Collection[str]) -> str | None:
    """Return the newest part of a rotated file of which these are older ones, if it is a table; else None."""
    base = newest_of(one.path)
    if base is None:
        return None
    declared = next((output for output in outputs.values() if output.matches(base)), None)
    kind = declared.kind if declared else automatic_format(base)
    is_table = declared is not None or table_name(base).lower() in tables
    return base if kind in ROTATED_FORMATS and is_table else None


def _text_keys(one: Alike) -> Keys:
    """Return the keys that read a text table that needs some; nothing for other files."""
    is_csv = automatic_format(one.path) == "csv"
    if not is_csv and _ending(one.path) not in TEXTS:
        return {}
    content = one.content()
    keys = text_headers.keys_of(content) if content else None
    if keys is None or (is_csv and not keys):
        return {}
    return keys if is_csv else {"format": "csv", **keys}


def _proposed(alike: Alike, outputs: Mapping[str, Output], taken: Collection[str], runs: int) -> Sequence[UnreadFiles]:
    """Return the tables that a file makes whose format proposes them; nothing for other, declared, and unreadable files."""
    if any(output.matches(alike.path) for output in outputs.values()):
        return ()
    tables: list[UnreadFiles] = []
    lists = xml_lists.lists_of(content) if _ending(alike.path) == "xml" and (content := alike.content()) else ()
    proposals = [
        Proposal(rows, rows.rpartition("/")[2], {"format": "xml", "rows": rows}, {}) for rows in lists if len(lists) > 1
    ]
    for proposal in proposals or _of_ending(_ending(alike.path)).proposals(alike.content, alike.path):
        tables.append(_table(alike, proposal, {*taken, *(table.name.lower() for table in tables)}, runs))
    return tables


def _table(one: Alike, proposal: Proposal, taken: Collection[str], runs: int) -> UnreadFiles:
    if proposal.lacking:
        return UnreadFiles(one.path, one.files, f"{proposal.what}: {proposal.lacking}", False)
    name = _free(proposal.name, taken)
    keys: dict[str, Key] = {"file": pattern(one), **proposal.keys}
    declared = ", ".join(f"{key} = {json.dumps(value, ensure_ascii=False)}" for key, value in keys.items())
    keys |= {**proposal.usual, **({} if one.runs == runs else {"required": False})}
    return UnreadFiles(one.path, one.files, f"{proposal.what}; declare [outputs.{name}] {declared}", False, name, keys)


def _rows_of(one: Alike, ending: str) -> Keys | None:
    """Return the keys that read the list of objects, or of elements, in a document; None if there is none."""
    content = one.content()
    return None if content is None else SEARCHED[ending](content)


def _declared(name: str, output: Output, content: Callable[[], bytes | None]) -> tuple[str, bool]:
    """Return why files of a declared output became no table, and whether each session notes it."""
    ending = unnamed_format(output)
    if output.lines:
        return _of_lines(f"lines in [outputs.{name}]", output, content()), False
    if ending is None and output.kind != FILE_FORMAT:
        return f"declared, but it could not be read with the keys of [outputs.{name}]", False
    if ending is None:
        return f'kept as a file, as declared (format = "{FILE_FORMAT}")', False
    keys = _named(ending) or f"format = {json.dumps(ending)}"
    return f"declared without a format; set {keys} in [outputs.{name}]", True


def _of_lines(lines: str, output: Output, content: bytes | None) -> str:
    from sierra.ingest.matching_lines import has_match
    from sierra.ingest.rewriting import is_compressed

    if content is None or is_compressed(output.base):
        return f"no line matches {lines}, or they made no rows; see the reason of its run"
    made_none = f"it matches {lines}, but this made no rows; see the reason of its run"
    return made_none if has_match(content, [output.lines]) else f"no line matches {lines}"


def _not_automatic(one: Alike, tables: Collection[str]) -> str:
    if one.in_archive:
        return "in an archive"
    if "/" in one.path:
        return "in a subfolder"
    if one.most > AUTOMATIC_AT_MOST:
        return "too many such files in a run"
    if table_name(one.path).lower() not in tables:
        return "it could not be read (see the reason of its run), or a run has too many tables"
    return "another file makes the table of that name"


def _named(ending: str) -> str:
    """Return the keys that make a table of files with an ending, which no reader takes by itself; "" if none are known."""
    return NAMED.get(ending) or _of_ending(ending).endings.get(ending, "")


def _ending(path: str) -> str:
    return PurePosixPath(path).suffix.lower().removeprefix(".")


def pattern(alike: Alike) -> str:
    """Return the value of `file` for these files: a path, or a pattern if their names differ."""
    parts = re.split("([0-9]+)", alike.path)
    stars = [f"{{tick{number}}}" for number in range(1, len(alike.varying) + 1)]
    if len(alike.varying) == 1:
        before = "".join(parts[: 2 * min(alike.varying) - 1])
        head = (alike.content() or b"").partition(b"\n")[0].lower()
        stars = ["{robot}" if OF_ROBOT.search(before) else "{number}" if b"tick" in head else "{tick}"]
    if alike.most < 2:  # each run has one such file, with another number in its name
        stars = ["*"] * len(alike.varying)
    for position, star in zip(sorted(alike.varying), stars, strict=True):
        parts[2 * position - 1] = star
    return "".join(parts)


def _free(path: str, taken: Collection[str]) -> str:
    """Return a name for the table of a file that no other table has."""
    name = re.sub("_*[0-9]+$", "", table_name(path)) or table_name(path)
    return next(free for free in numbered(name) if free.lower() not in taken)
