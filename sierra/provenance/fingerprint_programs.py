"""Fingerprints of programs outside the source and outside an image: a run is only reused if they are the same.

The fingerprint of a program is the SHA-256 of its file, under its role: the word of the command that names it, the interpreter
of a script, or the name by which a program needs a library. The file's own name and location do not count. In a script of a
virtual environment, the environment's path does not count, so that it may be moved, or made again elsewhere. Every word of a
command that names a program is included (as in `nice -n 5 simulator`), except a name behind an option, which is its value
(`simulator --fast true`). If the program only
starts others (STARTERS), a name behind an option counts too (`mpirun --oversubscribe simulator`). Included as well is the
interpreter that a script names in its first line. A program includes the libraries that the loader loads for it in the runs'
own environment (`sierra.provenance.libraries`). A Python interpreter includes its installed distributions (`pythons`), and a
script of a package the compiled program of the same name. Files that the command, a variable or the template names are
included too (`referenced_files`). Files that a program opens by itself, such as plug-ins, are included if a variable names
their folder by `{project}/…`.
"""

from __future__ import annotations

import os
import shutil
import types
from collections.abc import Iterable, Iterator, Mapping, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

from sierra.errors import Missing
from sierra.model import IN_PROJECT
from sierra.provenance import libraries, pythons
from sierra.provenance.dependency_model import (
    INSTALLED,
    NOTHING,
    Kind,
    Program,
    Programs,
    by_likelihood,
    called,
    roles,
    versions,
)
from sierra.provenance.hash_cache import HashCache
from sierra.util import processors
from sierra.util.hashing import sha256, short
from sierra.util.regular_files import open_regular
from sierra.util.text import few

SHOWN = 5
STARTERS = frozenset(
    (
        *(
            "chrt",
            "env",
            "flatpak-spawn",
            "ionice",
            "mpiexec",
            "mpirun",
            "nice",
            "nohup",
            "numactl",
            "orterun",
            "perf",
            "prlimit",
        ),
        *("prun", "runuser", "setarch", "setpriv", "setsid", "srun", "stdbuf", "strace", "sudo", "taskset", "time", "timeout"),
        *("unshare", "valgrind", "xargs", "xvfb-run", "bash", "dash", "sh"),
    )
)
"""Programs that only start another one, which their words name."""


def find(
    argv: Sequence[str],
    variables: Mapping[str, str],
    root: Path,
    more: Programs = NOTHING,
    *,
    project: Path | None = None,
    around: Iterable[Sequence[str]] = (),
    named: Mapping[str, str] = types.MappingProxyType({}),
) -> Programs:
    """Return the programs that a command, and the commands `around` it, start, with what they load, and `more`.

    `variables` are those of the runs, with PATH. The code lies in `root`, which may be another folder than the `project`.
    `named` has the names of programs for words that this machine has filled in.
    Raises Missing if the first word is not a program, lacks a library, or imports code from the project that differs from
    `root`.
    """
    commands = (argv, *around)
    words = {word for command in commands for word in command}
    scripts = {Path(word).parent for word in words if Path(word).is_relative_to(root) and Path(word).is_file()}
    finding = _Finding(root, variables, project or root, scripts, named)
    for command in commands:
        finding.command(command)
    return finding.with_files(more)


def of_project(found: Programs, roots: Sequence[Path]) -> Programs:
    """Return the programs, with those below one of `roots` named `{project}/…`; libraries are located by their files."""
    return replace(found, all=tuple(_of_project(one, roots) for one in found.all))


def _of_project(one: Program, roots: Sequence[Path]) -> Program:
    there = Path(one.path if one.kind == Kind.LIBRARY else one.name)
    for place in (place for root in roots for place in (root, root.resolve())):
        if there.is_relative_to(place):
            return replace(one, name=f"{{project}}/{there.relative_to(place)}")
    return one


class _Finding:
    """The search for the programs of one command; each path is visited once."""

    def __init__(
        self, root: Path, variables: Mapping[str, str], project: Path, scripts: AbstractSet[Path], named: Mapping[str, str]
    ) -> None:
        """`scripts` are folders of scripts; Python searches them first when it imports."""
        self._scripts = scripts
        self._named = named
        self._root = root
        self._project = project
        self._variables = dict(variables)
        self._digests = HashCache()
        self._programs: dict[str, Program] = {}
        self._libraries: dict[str, Program] = {}
        self._installed: dict[str, list[Program]] = {}
        self._notes: list[str] = []

    def command(self, argv: Sequence[str]) -> None:
        """Add the programs that a command starts. Raises Missing if the first word is not a program."""
        search, declared = self._variables["PATH"], self._variables
        first = shutil.which(argv[0], path=search)
        if first is None:
            if Path(argv[0]).is_file():
                raise Missing(f"{argv[0]} is not executable; put its interpreter before it (python3 …), or run chmod +x")
            raise Missing(
                f"the program {argv[0]!r} was not found; install it, or correct the command of the project in {self._root}"
            )
        self.start(self._named.get(argv[0], argv[0]), first, needed=True)
        starts = Path(argv[0]).name in STARTERS
        for before, word in pairwise(argv):
            if Path(argv[0]).name == "env" and "=" in word:
                self._variables = {**self._variables, **dict([word.split("=", 1)])}
            elif not starts and before.startswith("-") and os.sep not in word:
                continue  # the value of an option
            elif word in processors.NAMES:
                continue  # a value of `{arch}`; `setarch` is installed under such names too
            elif word and not word.startswith("-") and (path := shutil.which(word, path=search)):
                self.start(self._named.get(word, word), path)
                starts = starts and Path(word).name in STARTERS
        self._variables = declared  # those that `env` has set were only for this command

    def with_files(self, more: Programs) -> Programs:
        self._digests.save()
        installed = (one for ones in self._installed.values() for one in ones)
        libs = (self._libraries[path] for path in sorted(self._libraries))
        known = {**self._programs, **self._libraries}
        files = (one for one in more.all if one.path not in known)
        return Programs((*self._programs.values(), *installed, *libs, *files), (*dict.fromkeys(self._notes), *more.notes))

    def start(self, name: str, path: str, *, needed: bool = False) -> None:
        """Add a program and everything that it needs. If it is `needed`, a missing library is an error."""
        if path in self._programs:
            return
        self._programs[path] = Program(name, path, self._digests.counted(path))
        self._load(name, path, needed=needed)
        for packaged in pythons.programs_of_script(Path(path)):
            self.start(f"{called(name)}: program", str(packaged), needed=needed)
        if pythons.is_python(path):
            self._python(name, path, needed=needed)
        for word in _interpreter(Path(path)):
            interpreter = shutil.which(word, path=self._variables["PATH"])
            if interpreter is not None:
                self.start(pythons.name_in_environment(word), interpreter, needed=needed)

    def _load(self, name: str, path: str, *, needed: bool) -> None:
        loaded = libraries.loaded(path, self._variables)
        if loaded.lacking and needed:
            raise Missing(
                f"{called(name)} needs {loaded.lacking[0]}, which was not found; install it, or add its folder to "
                "LD_LIBRARY_PATH in [environment]"
            )
        if loaded.doubt:
            self._notes.append(f"the libraries of {path} are not recorded: {loaded.doubt}")
        for library, there in loaded.paths.items():
            if there not in self._libraries:
                self._libraries[there] = Program(library, there, self._digests.of(there), Kind.LIBRARY)

    def _python(self, name: str, path: str, *, needed: bool) -> None:
        """Add the interpreter behind a path, if that is another file, and the packages that it can import."""
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
        packages = pythons.distributions(interpreter.installed)
        lines = "\n".join(package.line for package in packages)
        where = os.pathsep.join(map(str, interpreter.installed))
        if interpreter.installed:
            yield Program(f"{name}{INSTALLED}", where, sha256(lines.encode()), Kind.DISTRIBUTIONS, lines)
        if self._project != self._root:
            imported = pythons.imported(interpreter, packages, self._project)
            pythons.check(name, imported, self._root, self._project, self._scripts)
        for package in pythons.contents(interpreter, packages, (self._root, self._project), self._digests):
            yield Program(f"{name}: {package.name}", package.origin, package.digest, Kind.DISTRIBUTIONS, package.version)


def _interpreter(script: Path) -> list[str]:
    """Return the words of a script's first line, such as `#!/usr/bin/env python3`; none if the file is not a script."""
    with open_regular(script) as file:
        line = file.readline(256)
    return os.fsdecode(line[2:]).split() if line.startswith(b"#!") else []


def differences(
    before: Programs, now: Programs, words: frozenset[str] = frozenset(), used: Sequence[str] = ()
) -> Iterator[str]:
    """Yield one line for each difference to the recorded programs, and one line for all libraries.

    The most likely causes come first: programs, then files, then packages. Packages that `words` name come before others, then
    those that executions were observed to use (`used`). A program that has only another name is no difference, unless there is
    no other one.
    """
    role = roles(*([each.identified for each in programs.all] for programs in (before, now)))
    old, new = ({role[each.identified]: each for each in programs.all} for programs in (before, now))
    renamed = _renamed(old, new)
    names = (old.keys() | new.keys()) - renamed.keys() - set(renamed.values())
    pairs = [(name, old.get(name), new.get(name)) for name in sorted(names)]
    changed = [(name, was, program) for name, was, program in pairs if not (was and program and was.sha256 == program.sha256)]
    if not changed:
        yield from (f"{was} is named {name} now, with the same content" for was, name in renamed.items())
    loaded = []
    for name, was, program in sorted(changed, key=lambda pair: _is_list(pair[2] or pair[1])):
        either = program or was
        if either is None:
            continue
        if either.kind == Kind.LIBRARY:
            loaded.append(name)
        elif was and program and either.kind == Kind.DISTRIBUTIONS and was.version != program.version:
            yield f"{name}: {few(list(_versions(was.version, program.version, words, used)), SHOWN)}"
        else:
            yield f"{name}: {_described(was, program)} recorded, {_described(program, was)} found"
    if loaded:
        yield f"libraries that differ from the record: {few(loaded, SHOWN)}"


def _renamed(old: Mapping[str, Program], new: Mapping[str, Program]) -> dict[str, str]:
    """Return the names that only the old programs have, each with one that only the new ones have, of the same content."""
    came = {(new[name].kind, new[name].sha256): name for name in sorted(new.keys() - old.keys(), reverse=True)}
    keys = {name: (old[name].kind, old[name].sha256) for name in sorted(old.keys() - new.keys())}
    return {name: came.pop(key) for name, key in keys.items() if key in came}


def _described(program: Program | None, other: Program | None) -> str:
    """Return the version that a program reports, and the beginning of its SHA-256.

    A file of the source is only listed if git would restore other bytes than those on disk.
    """
    if program is None:
        is_source = other and other.kind == Kind.FILE and other.name.startswith(IN_PROJECT) and Path(other.path).is_file()
        return "git's bytes" if is_source else "not"
    digest = short(program.sha256)
    return digest if not program.version or "\n" in program.version else f"{program.version} ({digest})"


def _is_list(one: Program | None) -> bool:
    """Return True for the list of all distributions of a Python, many of which no program may need."""
    return one is not None and one.name.endswith(INSTALLED)


def _versions(before: str | None, now: str | None, words: frozenset[str], used: Sequence[str]) -> Iterator[str]:
    """Yield one line for each distribution that differs between two lists."""
    was, found = versions(before), versions(now)
    for name in by_likelihood(was.keys() | found.keys(), words, used):
        if was.get(name) != found.get(name):
            yield f"{name} {was.get(name, 'not')} recorded, {found.get(name, 'not')} found"
