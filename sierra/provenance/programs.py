"""Programs outside the source and outside an image, by fingerprint: a run is only reused where they are the same.

The fingerprint of a program is the SHA-256 of its file. Every word of a command that names a program counts (as in
`nice -n 5 simulator`), and the interpreter that a script names in its first line. With a program count the libraries that
the loader gives it in the runs' own environment (`sierra.provenance.libraries`), with a Python interpreter what it has
installed (`pythons`), and files that the command, a variable or the template names (`named`). What a program itself opens
while it runs, plug-ins say, counts where a variable names its folder by `{project}/…`.
"""

from __future__ import annotations

import os
import shutil
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import replace
from pathlib import Path
from typing import Any

from sierra.errors import Missing
from sierra.provenance import libraries, pythons
from sierra.provenance.hash_cache import HashCache
from sierra.provenance.program import INSTALLED, NOTHING, Kind, Program, Programs, by_likelihood, called, versions
from sierra.util.hashing import sha256, short
from sierra.util.text import few

SHOWN = 5


def find(
    argv: Sequence[str],
    variables: Mapping[str, str],
    root: Path,
    more: Programs = NOTHING,
    *,
    project: Path | None = None,
) -> Programs:
    """The programs that a command starts, with what they load, and `more`; `variables` are those of its runs, with PATH.

    The code lies in `root`, which may be another folder than the `project`. Raises Missing where the first word is no program,
    lacks a library, or imports from the project what is other code than in `root`.
    """
    search = variables["PATH"]
    first = shutil.which(argv[0], path=search)
    if first is None:
        if Path(argv[0]).is_file():
            raise Missing(f"{argv[0]} is no program; name its interpreter (python3 …), or make it one with chmod +x")
        raise Missing(f"the program {argv[0]!r} is not there; install it, or mend the command of the project in {root}")
    scripts = {Path(word).parent for word in argv if Path(word).is_relative_to(root) and Path(word).is_file()}
    finding = _Finding(root, variables, project or root, scripts)
    finding.start(argv[0], first, needed=True)
    for word in argv[1:]:
        if Path(argv[0]).name == "env" and "=" in word:
            finding.set(*word.split("=", 1))
        elif word and not word.startswith("-") and (path := shutil.which(word, path=search)):
            finding.start(word, path)
    return finding.found(more)


def of_project(found: Programs, roots: Sequence[Path]) -> Programs:
    """The same, where what lies in the project is named by `{project}/…`, in whichever of `roots` that is.

    A program is where the command calls it by its path, a library always.
    """
    return replace(found, all=tuple(_of_project(one, roots) for one in found.all))


def _of_project(one: Program, roots: Sequence[Path]) -> Program:
    there = Path(one.path if one.kind == Kind.LIBRARY else one.name)
    for place in (place for root in roots for place in (root, root.resolve())):
        if there.is_relative_to(place):
            return replace(one, name=f"{{project}}/{there.relative_to(place)}")
    return one


class _Finding:
    """The programs of one command, as they are found: each path once."""

    def __init__(self, root: Path, variables: Mapping[str, str], project: Path, scripts: AbstractSet[Path]) -> None:
        """`scripts`: folders of scripts; Python imports from there before all else."""
        self._scripts = scripts
        self._root = root
        self._project = project
        self._variables = dict(variables)
        self._digests = HashCache()
        self._programs: dict[str, Program] = {}
        self._libraries: dict[str, Program] = {}
        self._installed: dict[str, list[Program]] = {}
        self._notes: list[str] = []

    def set(self, name: str, value: str) -> None:
        """What `env` sets for the programs after it."""
        self._variables[name] = value

    def found(self, more: Programs) -> Programs:
        self._digests.save()
        installed = (one for ones in self._installed.values() for one in ones)
        libs = (self._libraries[path] for path in sorted(self._libraries))
        known = {**self._programs, **self._libraries}
        files = (one for one in more.all if one.path not in known)
        return Programs((*self._programs.values(), *installed, *libs, *files), (*dict.fromkeys(self._notes), *more.notes))

    def start(self, name: str, path: str, *, needed: bool = False) -> None:
        """A program, and all that it needs; where it is `needed` itself, what that lacks is an error."""
        if path in self._programs:
            return
        self._programs[path] = Program(name, path, self._digests.of(path))
        self._load(name, path, needed=needed)
        if pythons.is_python(path):
            self._python(name, path, needed=needed)
        for word in _interpreter(Path(path)):
            interpreter = shutil.which(word, path=self._variables["PATH"])
            if interpreter is not None:
                self.start(word, interpreter, needed=needed)

    def _load(self, name: str, path: str, *, needed: bool) -> None:
        loaded = libraries.loaded(path, self._variables)
        if loaded.lacking and needed:
            raise Missing(
                f"{called(name)} needs {loaded.lacking[0]}, which is not found; install it, or name its folder in "
                "LD_LIBRARY_PATH in [environment]"
            )
        if loaded.doubt:
            self._notes.append(f"the libraries of {path} are not recorded: {loaded.doubt}")
        for library, there in loaded.paths.items():
            if there not in self._libraries:
                self._libraries[there] = Program(library, there, self._digests.of(there), Kind.LIBRARY)

    def _python(self, name: str, path: str, *, needed: bool) -> None:
        """The interpreter that is meant, where it is another file than is called, and what it sees."""
        interpreter = pythons.ask(path, self._variables, self._root, self._project)
        real = os.path.realpath(interpreter.executable)
        if real not in self._programs:
            sha = self._digests.of(real)
            same = sha == self._programs[path].sha256
            self._programs[real] = Program(name if same else f"{called(name)}: interpreter", real, sha)
            self._load(name, real, needed=needed)
        if interpreter.executable not in self._installed:
            self._installed[interpreter.executable] = list(self._seen(called(name), interpreter))

    def _seen(self, name: str, interpreter: pythons.Interpreter) -> Iterator[Program]:
        found = pythons.distributions(interpreter.installed)
        lines = "\n".join(one.line for one in found)
        where = os.pathsep.join(map(str, interpreter.installed))
        if interpreter.installed:
            yield Program(f"{name}{INSTALLED}", where, sha256(lines.encode()), Kind.DISTRIBUTIONS, lines)
        if self._project != self._root:
            pythons.check(name, pythons.imported(interpreter, found, self._project), self._root, self._project, self._scripts)
        for one in pythons.contents(interpreter, found, (self._root, self._project), self._digests):
            yield Program(f"{name}: {one.name}", one.origin, one.digest, Kind.DISTRIBUTIONS, one.version)


def _interpreter(script: Path) -> list[str]:
    """The words of a script's first line, `#!/usr/bin/env python3`; none of a program that is no script."""
    with script.open("rb") as file:
        line = file.readline(256)
    return os.fsdecode(line[2:]).split() if line.startswith(b"#!") else []


def differing(
    before: Mapping[str, Mapping[str, Any]], now: Mapping[str, Program]
) -> Iterator[tuple[str, Mapping[str, Any] | None, Program | None]]:
    """What is other now, by name: the row that was recorded, and what is there; None where there is none."""
    for name in sorted(before.keys() | now.keys()):
        was, program = before.get(name), now.get(name)
        if was is None or program is None or was["sha256"] != program.sha256:
            yield name, was, program


def told(before: Iterable[Mapping[str, Any]], now: Programs, words: frozenset[str] = frozenset()) -> Iterator[str]:
    """Yield what is other now than in the rows of `programs` that are recorded, a line each, and one for all libraries.

    What results are likely to depend on stands first: programs, then files, then packages, those that `words` name before.
    """
    rows = list(before)
    several = {name for names in ([row["name"] for row in rows], [one.name for one in now.all]) for name in _ambiguous(names)}

    def key(name: str) -> str:
        return name if called(name) in several else called(name)

    then, here = {key(row["name"]): row for row in rows}, {key(program.name): program for program in now.all}
    loaded = []
    for name, was, program in sorted(differing(then, here), key=lambda one: _installed(one[1], one[2])):
        kind = program.kind if program else was and was["kind"]
        if kind == Kind.LIBRARY:
            loaded.append(name)
        elif was and program and kind == Kind.DISTRIBUTIONS and was["version"] != program.version:
            yield f"{name}: {few(list(_versions(was['version'], program.version, words)), SHOWN)}"
        else:
            yield f"{name}: {_said(was) if was else 'not'} recorded, {_said(program) if program else 'not'} found"
    if loaded:
        yield f"libraries other than recorded: {few(loaded, SHOWN)}"


def _ambiguous(names: Iterable[str]) -> set[str]:
    """What several of them are called, wherever they lie."""
    counted = Counter(called(name) for name in set(names))
    return {name for name, count in counted.items() if count > 1}


def _said(one: Program | Mapping[str, Any]) -> str:
    """What a program says of itself, and the beginning of its SHA-256."""
    version, digest = (one.version, one.sha256) if isinstance(one, Program) else (one["version"], one["sha256"])
    return short(digest) if not version or "\n" in version else f"{version} ({short(digest)})"


def _installed(was: Mapping[str, Any] | None, now: Program | None) -> bool:
    """Return whether it is all that a Python has installed, much of which no program may need."""
    return (now.name if now else was["name"] if was else "").endswith(INSTALLED)


def _versions(before: str | None, now: str | None, words: frozenset[str]) -> Iterator[str]:
    """The distributions that are others in two lists."""
    was, found = versions(before), versions(now)
    for name in by_likelihood(was.keys() | found.keys(), words):
        if was.get(name) != found.get(name):
            yield f"{name} {was.get(name, 'not')} recorded, {found.get(name, 'not')} found"
