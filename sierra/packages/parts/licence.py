"""The part of a package with the text of its licence: the file of the project, or of the repository that contains it.

`[package] license` names the licence; its text is what grants the rights. Recorded sources lack such files, because no run
needs them.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

from sierra.packages.subject import Member, PartResult, Subject
from sierra.util.lazy_definitions import regex

TEXT = regex(r"(?:LICEN[CS]E|COPYING|UNLICENSE)(?:[-.][A-Za-z0-9.+-]+)?", re.IGNORECASE)
"""Names of licence files, as hosts of repositories recognize them."""


def members(subject: Subject, packed: Mapping[str, Member]) -> PartResult:
    """Return the licence files of the project, else a fact that there are none."""
    for folder in _folders(subject.project.root):
        if files := sorted(path for path in folder.iterdir() if TEXT.fullmatch(path.name) and path.is_file()):
            if subject.redacted:
                return PartResult((), facts=(f"{files[0].name} is not packed, because it names who holds the rights",))
            return PartResult([Member(path.name, path, "licence") for path in files])
    name = subject.project.config.package.license
    return PartResult((), facts=(f"the project has no file with the text of its licence, {name}: add it as LICENSE",))


def _folders(root: Path) -> list[Path]:
    """Return the project's folder, and those above it up to the root of its repository."""
    above = [root, *root.parents]
    top = next((number for number, folder in enumerate(above) if (folder / ".git").exists()), 0)
    return above[: top + 1]
