"""The versions that programs report; each is executed once, and its answer is cached while all programs are the same.

Asking for a version means executing the program, and a program may not know `--version`. So by default only installed
programs are asked. Scripts, and programs inside the project, are asked only if `[programs.versions]` names them. A program
gets ten seconds, two seconds of computing, an empty folder, no input, small files, and the environment of runs. Then it is
killed, with all processes that it has started. The answer is recorded, but it is not part of a fingerprint, because the file's
hash serves that purpose.
"""

from __future__ import annotations

import contextlib
import resource
import subprocess
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from sierra.config.execution_tables import ProgramsTable
from sierra.provenance.dependency_model import Kind, Program, Programs, roles
from sierra.store.layout import user_versions
from sierra.util import bounded_program
from sierra.util.cache import Cache
from sierra.util.hashing import digest
from sierra.util.lazy_definitions import regex
from sierra.util.regular_files import open_regular

TIMEOUT_S = 10.0
"""Seconds that a program may take. Simulators may need so long on a busy machine, and a missing answer is cached too."""
MAX_OUTPUT = 1 << 16
MAX_LENGTH = 200
MAX_ENTRIES = 1024
LIMITS = {resource.RLIMIT_FSIZE: 1 << 20, resource.RLIMIT_CPU: 2, resource.RLIMIT_CORE: 0}
COLOUR = regex(rb"\x1b\[[0-9;:]*m")
"""Select Graphic Rendition (ECMA-48, 8.3.117), the only control sequence that does not move the cursor."""
MARK = "SIERRA_VERSION_ASKED"


def with_versions(programs: Programs, table: ProgramsTable, variables: Mapping[str, str], root: Path) -> Programs:
    """Return the programs with the versions that they report; `variables` are those of the runs, with PATH."""
    cache = Cache(user_versions(), MAX_ENTRIES)
    identity = programs.id
    role = roles([used.identified for used in programs.all])

    def version(program: Program) -> str | None:
        words = _words(program, table, root)
        if not words or not Path(program.path).exists():
            return program.version
        name = role[program.identified]
        key = digest("version", {"colours": False, "programs": identity, "name": name, "words": list(words)})
        known = cache.get(key)
        if not isinstance(known, str):
            known = _version((program.path, *words), variables) or ""
            cache.put(key, known)
        return known or None

    answered = tuple(replace(program, version=version(program)) for program in programs.all)
    cache.save()
    return replace(programs, all=answered)


def _words(program: Program, table: ProgramsTable, root: Path) -> tuple[str, ...]:
    """Return the arguments that make a program print its version; none if the program must not be executed."""
    if program.kind is not Kind.PROGRAM:
        return ()
    if program.called in table.versions:
        return table.versions[program.called]
    path = Path(program.path)
    is_own = path.is_relative_to(root) or path.resolve().is_relative_to(root.resolve())
    return () if is_own or _is_script(path) else table.version


def _is_script(path: Path) -> bool:
    """Return whether a file is a script. A file that cannot be read counts as one, so that it is not executed."""
    try:
        with open_regular(path) as file:
            return file.read(2) == b"#!"
    except OSError:
        return True


def _version(argv: Sequence[str], variables: Mapping[str, str]) -> str | None:
    """Return the first line that a program prints, if it succeeds in time."""
    with tempfile.TemporaryDirectory(prefix="sierra-", ignore_cleanup_errors=True) as folder:
        try:
            ended = bounded_program.execute(
                argv,
                cwd=folder,
                env={**variables, "HOME": folder, "TMPDIR": folder},
                wall=TIMEOUT_S,
                most=MAX_OUTPUT,
                stderr=subprocess.STDOUT,
                limits=LIMITS,
                mark=MARK,
            )
        except (OSError, ValueError):
            return None
    return _first_line(ended.output) if ended.status == 0 else None


def _first_line(output: bytes) -> str | None:
    """Return the first line that is not empty, if it is text; without colour codes, which some programs write to a pipe too."""
    for line in COLOUR.sub(b"", output).splitlines():
        with contextlib.suppress(UnicodeDecodeError):
            text = line.decode().strip()
            if text and text.isprintable():
                return text[:MAX_LENGTH]
        if line.strip():
            return None
    return None
