"""Anonymous packages, for double-blind review.

The records are rewritten (`sierra.packages.anonymity.redact_store`), `[package]` names no authors, and the project's own files
for citations are left out. The source, inputs, outputs and logs cannot be rewritten, because ids of runs and hashes of outputs
follow from them: all members are searched for words that identify, and one that is found stops the command.
"""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from sierra.config.package_table import Author, Package
from sierra.config.project_file import LoadedProject
from sierra.errors import ConfigError, Identifying
from sierra.packages.anonymity.content_search import ContentSearch
from sierra.packages.anonymity.identifying_words import words
from sierra.packages.anonymity.redact_store import rewrite
from sierra.packages.anonymity.word_search import Search
from sierra.packages.layout import PROJECT, SIERRA, STORED
from sierra.packages.subject import Member, PartResult, Subject
from sierra.provenance.source.manifest import read as read_manifest
from sierra.store.layout import PYPROJECT
from sierra.store.store import Store
from sierra.util.lazy_definitions import dataclass, field, regex, replace
from sierra.util.text import counted, few

DATE = "2000-01-01"
"""The date of packages without one in `[package]`: that of the newest record would show when runs were executed."""
NOBODY = Author(name="Anonymous", affiliation="Anonymous")
SUBMODULES = "SELECT DISTINCT submodules FROM sources WHERE submodules IS NOT NULL ORDER BY ALL"
COMMITS = "the recorded commits of submodules are packed with their ids, authors, dates and messages: {}"
"""A note: the tree of the source has the ids of these commits, and only the commits prove what the submodules had."""
HEADER = regex(r"\s*\[")
NAMES = """
SELECT sha256, 'output ' || path || ' of run ' || run[:10] FROM all_artifacts WHERE kind <> 'log'
UNION ALL SELECT sha256, path || ' of run ' || run[:10] FROM all_artifacts WHERE kind = 'log'
UNION ALL SELECT unnest([input] || other_inputs), 'input of run ' || run[:10] FROM batch_runs
UNION ALL SELECT sha256, 'file ' || name || ' beside the inputs' FROM shared_files
UNION ALL SELECT log, 'log of build ' || build[:10] FROM builds
UNION ALL SELECT files, 'list of the files of image ' || image FROM images WHERE files IS NOT NULL
UNION ALL SELECT files, 'list of the files of the source' FROM sources
"""
"""SQL: the SHA-256 of objects, and their descriptions."""


@dataclass(slots=True)
class Anonymity:
    """The search of one package."""

    project: LoadedProject
    """With the original `[package]`."""
    accepted: Sequence[str]
    """Texts in which words are accepted."""
    searched: tuple[str, ...] = ()
    """The words that were searched, each with its kind."""
    general: tuple[str, ...] = ()
    """Words that were not searched, because they show nothing."""
    search: Search = field(init=False)

    def subject(self, subject: Subject) -> Subject:
        """Return the subject without names in `[package]`; first collect the identifying words from its records."""
        identifying, general = words(self.project, subject.store)
        self.searched = tuple(f"{word.text} ({word.kind})" for word in identifying)
        self.general = tuple(general)
        self.search = Search(identifying, self.accepted)
        package = anonymous(self.project.config.package)
        declared = self.project.declared
        project = replace(
            self.project,
            config=self.project.config.model_copy(update={"package": package}),
            declared=declared and declared.model_copy(update={"package": package}),
        )
        return replace(subject, project=project, date=package.date or DATE, redacted=True)

    def check(self, subject: Subject, members: Mapping[str, Member]) -> tuple[str, ...]:
        """Return a note for each file that could not be searched. Raises Identifying if a member has one of the words.

        The store is searched last, without the objects whose content other members have: a word in them is reported once.
        """
        search = ContentSearch(self.search, _Names(subject.store).of)
        stored_last = sorted(members.items(), key=lambda item: (item[0].startswith(STORED), item[0]))
        for name, member in stored_last:
            if name.startswith(SIERRA):  # what SIERRA itself is made of shows nothing of who packs
                continue
            search.name(name, name)
            if not name.startswith(STORED):
                search.skip_object(member.sha256())
            with member.open() as content:
                search.file(content, name)
        if hits := search.hits:
            places = tuple(map(str, hits))
            what = f"{counted(len(places), 'place')} in the package would show who made it, as {places[0]}"
            raise Identifying(f"{what}; change them and run the batch again, or accept a text with --allow TEXT", places)
        return tuple(f"not all of it can be searched for names: {line}" for line in search.unread)


def members(subject: Subject, packed: Mapping[str, Member]) -> PartResult:
    """Rewrite the subject's records, and return the project's file without authors; nothing if the package is not anonymous."""
    if not subject.redacted:
        return PartResult(())
    submodules = sorted({path for text in subject.store.values(str, SUBMODULES) for path in json.loads(text)})
    rewrite(subject.store, subject.folder / "redacted", subject.date)
    notes = (COMMITS.format(few(submodules, 5)),) if submodules else ()
    name = PROJECT + subject.project.file.name
    return PartResult([Member(name, anonymous_file(subject.project).encode(), "file that SIERRA reads")], notes)


def anonymous_file(project: LoadedProject) -> str:
    """Return the text of a project's file without authors. Raises ConfigError as `without_authors` does."""
    package = anonymous(project.config.package)
    return without_authors(project.file.read_text("utf-8"), package, in_tool=project.file.name == PYPROJECT)


def anonymous(package: Package) -> Package:
    """Return a description without authors, and without addresses and identifiers by which they can be found."""
    return package.model_copy(update={"authors": (NOBODY,), "doi": "", "repository": "", "related": ()})


def without_authors(text: str, package: Package, *, in_tool: bool) -> str:
    """Return the text of a project's file with this `[package]` instead of its own. All else stays as it is.

    `in_tool`: the tables of the file begin with `tool.sierra`. Raises ConfigError if `[package]` is no table of its own.
    """
    prefix = "tool.sierra." if in_tool else ""
    lines = text.splitlines(keepends=True)
    wanted = _without(tomllib.loads(text), in_tool=in_tool)
    while (begin := _begin(lines, prefix)) is not None:
        lines = _cut(lines, begin)
    changed = "".join(lines).rstrip("\n") + "\n\n" + _table(package, prefix)
    content = _loaded(changed)
    if content is None or _without(content, in_tool=in_tool) != wanted:
        raise ConfigError(
            f"[{prefix}package] must be a table of its own for an anonymous package: a line [{prefix}package], then its keys"
        )
    return changed


def _begin(lines: Sequence[str], prefix: str) -> int | None:
    """Return the place of the first header of `[package]`, or of a table in it."""
    header = re.compile(rf"\s*\[\[?\s*{re.escape(prefix)}package\s*[.\]]")
    return next((index for index, line in enumerate(lines) if header.match(line)), None)


def _cut(lines: Sequence[str], begin: int) -> list[str]:
    """Return the lines without the table that begins there, which ends before the first header with complete TOML before it."""
    ends = (index for index in range(begin + 1, len(lines) + 1) if index == len(lines) or HEADER.match(lines[index]))
    end = next((index for index in ends if _loaded("".join(lines[begin:index]))), len(lines))
    return [*lines[:begin], *lines[end:]]


def _loaded(text: str) -> dict[str, Any] | None:
    """Return the content of TOML; None if it is not TOML."""
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError:
        return None


def _without(whole: dict[str, Any], *, in_tool: bool) -> dict[str, Any]:
    if not in_tool:
        return {name: value for name, value in whole.items() if name != "package"}
    tool = whole.get("tool", {})
    return {**whole, "tool": {**tool, "sierra": _without(tool.get("sierra", {}), in_tool=False)}}


def _table(package: Package, prefix: str) -> str:
    """Return `[package]` as TOML. JSON's texts, numbers and lists of them are TOML too."""
    values = package.model_dump(mode="json", exclude_defaults=True)
    tables = [(f"[[{prefix}package.{name}]]", row) for name, rows in values.items() if _is_table(rows) for row in rows]
    plain = {name: value for name, value in values.items() if not _is_table(value)}
    return "\n".join("\n".join([header, *_lines(keys), ""]) for header, keys in [(f"[{prefix}package]", plain), *tables])


def _is_table(value: object) -> bool:
    return isinstance(value, list) and any(isinstance(one, dict) for one in value)


def _lines(keys: Mapping[str, Any]) -> Iterator[str]:
    for name, value in keys.items():
        text = json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
        yield f"{name} = {text}"


class _Names:
    """Descriptions of the objects of a store, looked up when the first one is asked for."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self._known: dict[str, str] | None = None

    def of(self, digest: str) -> str:
        """Return the description of an object from its SHA-256."""
        if self._known is None:
            self._known = dict(self._pairs())
        return self._known.get(digest, f"object {digest[:10]}")

    def _pairs(self) -> Iterator[tuple[str, str]]:
        with self._store.snapshot() as snapshot:
            snapshot.views.make(("all_artifacts", "batch_runs", "shared_files", "builds", "images", "sources", "blobs"))
            yield from snapshot.run(NAMES)
            blobs: dict[str, str] = dict(snapshot.run("SELECT blob, sha256 FROM blobs"))
            lists = snapshot.values(str, "SELECT DISTINCT files FROM sources ORDER BY ALL")
        for files in lists:
            for path, what in read_manifest(self._store.object(files)).items():
                sha256 = blobs.get(what.partition(b" ")[2].decode("ascii", "replace"))
                if sha256 is not None:
                    yield sha256, f"source {path.decode('utf-8', 'backslashreplace')}"
