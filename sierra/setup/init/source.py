"""The source: the files of the folder that are the code of runs.

By default all files of a project are source: unnecessary new runs are better than stale results. So `sierra init` writes
only a comment that names the files and folders found, without those whose names suggest something else (results, figures,
notes). The list takes effect if the user removes the `#`, chooses it when asked (only if there is such a folder), or gives
`--source`.
"""

from __future__ import annotations

import os
import shlex
from collections.abc import Collection, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from sierra.errors import UsageError
from sierra.provenance.source.suggest_exclusions import is_hardly_code
from sierra.setup.init import folder
from sierra.setup.init.answers import Ask, Question, checked_answer
from sierra.store.layout import CONFIG

if TYPE_CHECKING:
    from sierra.execution.trial import Trial

DATA = (".csv", ".tsv", ".log", ".out", ".dat", ".parquet", ".h5", ".npz", ".png", ".pdf", ".mp4", ".zip", ".gz")
"""The endings of files that are code only if runs read them."""
ALL = "."
"""The answer that the whole folder is source."""


def propose(root: Path, templates: Collection[str], tried: Trial | None = None) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the names, without the templates, of files that may be code, and those of files that probably are not.

    Names of files that a tried run wrote are those of outputs, and data that it did not read are not code.
    """
    names = [name for name in folder.listed(root) if name not in (*templates, CONFIG)]
    left_out = [name for name in names if is_hardly_code(name, is_folder=(root / name).is_dir())]
    if tried is not None:
        written = {file.path.partition("/")[0] for file in tried.files}
        read = {path.partition("/")[0] for path in tried.used.files} if tried.used and not tried.used.incomplete else set(names)
        left_out += [name for name in names if name in written or (name.endswith(DATA) and name not in read)]
    return tuple(name for name in names if name not in left_out), tuple(dict.fromkeys(left_out))


def choose(root: Path, templates: Collection[str], given: Sequence[str], ask: Ask | None) -> tuple[str, ...]:
    """Return the paths of the source; none means the whole folder. Raises UsageError for a path that is not in it."""
    code, left_out = propose(root, templates)
    if not given and not (code and any((root / name).is_dir() for name in left_out)):
        return ()
    question = Question(
        f"source: the code that results depend on; {ALL} is the whole folder, including new files."
        f" These may not be code: {', '.join(left_out)}",
        (ALL, shlex.join(code)),
        ALL,
    )
    return checked_answer(shlex.join(given) if given else None, question, ask, partial(_check, root))


def _check(root: Path, text: str) -> tuple[str, ...]:
    """Return the paths in `text`, which is split as a shell does. Raises UsageError for a path that is not in the folder."""
    try:
        paths = [os.path.normpath(path) for path in shlex.split(text)]
    except ValueError as error:
        raise UsageError(f"source {text!r}: {error}") from error
    for path in paths:
        if path.startswith((os.pardir, os.sep)) or not (root / path).exists():
            raise UsageError(f"source: there is no {path!r} in {root}; use files and folders in it, such as: src sim.py")
    return () if ALL in paths else tuple(paths)
