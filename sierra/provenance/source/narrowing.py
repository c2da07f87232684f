"""What of a project hardly is code, and the line for `[source] paths` that leaves it out.

A change of any file of the source makes all runs new, and fails those that execute. Where all that changed has the name of
notes, figures or results, somebody is told how to say that it is no code; nothing is left out without being told.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable

FOLDERS = re.compile(
    r"(results?|outputs?|out|logs?|figures?|figs?|plots?|papers?|thesis|docs?|notes|slides|videos?|data|datasets?)", re.I
)
"""Folders that hardly hold code. Runs may read `data`, so that none is left out unless somebody says so."""
FILES = re.compile(
    r"(readme|licen[cs]e|copying|change(s|log)|history|news|authors|contribut(ing|ors)|citation|notes?|todo)(\.(txt|cff|html?))?"
    r"|nohup\.out|.*\.(md|rst|adoc|org|tex|bib|pdf|png|jpe?g|gif|svg|eps|mp4|webm|docx?|odt|pptx?|odp|log|ipynb)",
    re.I,
)
"""Files that hardly are code."""
TOOLS = re.compile(r"\.(git.*|vscode|idea|editorconfig|pre-commit-config\.ya?ml)")
"""What tools keep beside the code."""
READ = re.compile(r"data|datasets?", re.I)
MOST = 12
"""Names that a proposal may have."""
ONLY_SAID = "[source] paths says what is code"


def is_hardly_code(name: str, *, is_folder: bool) -> bool:
    """Return whether something in the project's folder has a name that code hardly has."""
    return (FOLDERS if is_folder else FILES).fullmatch(name) is not None


def advice(changed: Iterable[bytes], source: Iterable[bytes]) -> str:
    """Return what to write where these files of the source, or beside it, are no code; `source` is all of its files."""
    left_out = {_top(path) for path in changed}
    if not left_out or not all(is_hardly_code(name, is_folder=folder) for name, folder in left_out):
        return ONLY_SAID
    every = {_top(path) for path in source} - left_out
    code = sorted(name for name, folder in every if not _is_left_out(name, is_folder=folder))
    if not 0 < len(code) <= MOST or not all(name.isprintable() and "\ufffd" not in name for name in code):
        return "where these are no code, say what is: paths = [...] under [source] in sierra.toml"
    line = f"paths = {json.dumps(code, ensure_ascii=False)}"
    return f"where these are no code, write {line} under [source] in sierra.toml, which makes all runs new once"


def _top(path: bytes) -> tuple[str, bool]:
    """Return the first part of a path, and whether it is a folder."""
    name, slash, _ = path.partition(b"/")
    return name.decode("utf-8", "replace"), bool(slash)


def _is_left_out(name: str, *, is_folder: bool) -> bool:
    if TOOLS.fullmatch(name):
        return True
    return is_hardly_code(name, is_folder=is_folder) and not READ.fullmatch(name)
