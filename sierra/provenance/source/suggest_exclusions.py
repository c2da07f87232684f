"""Files of a project that are probably not code, and the `[source] paths` line that excludes them.

A change to any file of the source makes all runs new, and fails the runs that are executing. If all changed files have the
names of notes, figures or results, a message explains how to exclude them. Nothing is excluded automatically.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable

from sierra.util.lazy_definitions import regex

FOLDERS = regex(
    r"(results?|outputs?|out|logs?|figures?|figs?|plots?|papers?|thesis|docs?|notes|slides|videos?|data|datasets?)", re.I
)
"""Folders that are unlikely to contain code. Runs may read `data`, so only the user can exclude it."""
FILES = regex(
    r"(readme|licen[cs]e|copying|change(s|log)|history|news|authors|contribut(ing|ors)|citation|notes?|todo|logs?)(\.(txt|cff|html?))?"
    r"|nohup\.out|.*\.(md|rst|adoc|org|tex|bib|pdf|png|jpe?g|gif|svg|eps|mp4|webm|docx?|odt|pptx?|odp|log|ipynb)",
    re.I,
)
"""Files that are unlikely to be code."""
TOOLS = regex(r"\.(git.*|vscode|idea|editorconfig|pre-commit-config\.ya?ml)")
"""Files and folders that tools keep beside the code."""
OFTEN_READ = regex(r"data|datasets?", re.I)
MAX_NAMES = 12
"""Maximum number of names in a proposal."""
ONLY_SAID = "[source] paths selects the code; logs can be written outside the project"

OR_OUTSIDE = "or write them outside the project"


def is_hardly_code(name: str, *, is_folder: bool) -> bool:
    """Return True if a file or folder of the project has a name that is unusual for code."""
    return (FOLDERS if is_folder else FILES).fullmatch(name) is not None


def advice(changed: Iterable[bytes], source: Iterable[bytes]) -> str:
    """Return advice for the case that the changed files are not code; `source` contains all files of the source."""
    left_out = {_top(path) for path in changed}
    if not left_out or not all(is_hardly_code(name, is_folder=folder) for name, folder in left_out):
        return ONLY_SAID
    every = {_top(path) for path in source} - left_out
    code = sorted(name for name, folder in every if not _is_left_out(name, is_folder=folder))
    if not 0 < len(code) <= MAX_NAMES or not all(name.isprintable() and "\ufffd" not in name for name in code):
        return f"if these are not code, list the code: paths = [...] under [source] in sierra.toml, {OR_OUTSIDE}"
    line = f"paths = {json.dumps(code, ensure_ascii=False)}"
    return f"if these are not code, write {line} under [source] in sierra.toml, which makes all runs new once, {OR_OUTSIDE}"


def _top(path: bytes) -> tuple[str, bool]:
    """Return the first part of a path, and whether it is a folder."""
    name, slash, _ = path.partition(b"/")
    return name.decode("utf-8", "replace"), bool(slash)


def _is_left_out(name: str, *, is_folder: bool) -> bool:
    if TOOLS.fullmatch(name):
        return True
    return is_hardly_code(name, is_folder=is_folder) and not OFTEN_READ.fullmatch(name)
