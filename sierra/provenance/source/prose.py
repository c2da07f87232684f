"""Files that describe a project to people. No run needs them, so they are no source unless `[source] paths` names them."""

from __future__ import annotations

import re

from sierra.util.lazy_definitions import regex

ANYWHERE = regex(rb"(?:.*/)?(?:README[^/]*|[^/]+\.md)", re.IGNORECASE | re.DOTALL)
TOP = regex(
    rb"(?:LICEN[CS]E|COPYING|CITATION|CHANGELOG|CONTRIBUTING|AUTHORS)(?:\.(?:txt|cff|rst|bib))?|codemeta\.json|"
    rb"\.zenodo\.json|docs(?:/.*)?",
    re.IGNORECASE | re.DOTALL,
)
"""Names that count as prose in the project's own folder only."""


def is_prose(path: bytes) -> bool:
    """Return True if a path, relative to the project's folder, has a name of prose."""
    return ANYWHERE.fullmatch(path) is not None or TOP.fullmatch(path) is not None
