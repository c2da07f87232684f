"""The source: which files here are the code that runs are made from.

All files of a project count: rather too much than stale. What is written is therefore a comment that names the files and
folders found, without those whose names say that they are something else (results, figures, notes); it counts once
somebody takes the `#` away, chooses it when asked (which happens only where there is such a folder), or says `--source`.
"""

from __future__ import annotations

import os
import shlex
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from sierra.errors import UsageError
from sierra.provenance.source.narrowing import is_hardly_code
from sierra.setup.init import folder
from sierra.setup.init.answers import Ask, Question, settled
from sierra.store.layout import CONFIG

ALL = "."
"""The answer that all of the folder is source."""


def found(root: Path, template: str) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """What is here beside the template, and what of it hardly is code."""
    names = [name for name in folder.listed(root) if name not in (template, CONFIG)]
    left_out = tuple(name for name in names if is_hardly_code(name, is_folder=(root / name).is_dir()))
    return tuple(name for name in names if name not in left_out), left_out


def choose(root: Path, template: str, given: Sequence[str], ask: Ask | None) -> tuple[str, ...]:
    """The paths that count; none is all of the folder. Raises UsageError for what is not in it."""
    proposed, left_out = found(root, template)
    if not given and not (proposed and any((root / name).is_dir() for name in left_out)):
        return ()
    question = Question(
        f"source: the code that results depend on; {ALL} is all of this folder, new files too."
        f" {', '.join(left_out)} may be no code",
        (ALL, shlex.join(proposed)),
        ALL,
    )
    return settled(shlex.join(given) if given else None, question, ask, partial(_check, root))


def _check(root: Path, text: str) -> tuple[str, ...]:
    """`text` is words, as a shell splits them."""
    try:
        paths = [os.path.normpath(path) for path in shlex.split(text)]
    except ValueError as error:
        raise UsageError(f"source {text!r}: {error}") from error
    for path in paths:
        if path.startswith((os.pardir, os.sep)) or not (root / path).exists():
            raise UsageError(f"source: there is no {path!r} in {root}; name files and folders of it, as in: src sim.py")
    return () if ALL in paths else tuple(paths)
