"""The part of a package with the files that SIERRA reads: `sierra.toml`, `sierra.lock`, baselines, templates, statements."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from sierra.packages.layout import PROJECT
from sierra.packages.subject import Member, PartResult, Subject
from sierra.store.layout import BASELINES, LOCK


def members(subject: Subject, found: Mapping[str, Member]) -> PartResult:
    """Return the files of the project that are not part of its source."""
    return PartResult(_members(subject))


def _members(subject: Subject) -> Iterator[Member]:
    root = subject.project.root
    config = subject.project.config
    tables = (table.file for table in config.tables.values())
    named = [subject.project.file.name, LOCK, BASELINES, *config.template_paths, *tables]
    for name in dict.fromkeys(str(name) for name in named if name):
        if (root / name).is_file():
            yield Member(PROJECT + name, root / name, "file that SIERRA reads")
