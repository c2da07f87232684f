"""Checkout: the code of a batch in a folder of its own, ready to execute, as it was recorded or committed.

The user's files are never changed. Runs may need project files that the source does not contain, for example build results
that git ignores. These are copied as they are now: programs, the libraries that they load, and files that the command or a
variable names. Their fingerprint shows whether they have changed. A virtual environment is linked as a whole if a program
is its Python.
"""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Callable, Container, Iterable, Mapping
from collections.abc import Set as AbstractSet
from pathlib import Path, PurePosixPath

from sierra.errors import Missing
from sierra.execution import commands
from sierra.model import IN_PROJECT, RunSpec
from sierra.provenance import fingerprint_programs as programs
from sierra.provenance import referenced_files, source
from sierra.provenance.dependency_model import NOTHING, Kind, Program, Programs
from sierra.provenance.hash_cache import VENV
from sierra.store.layout import FIGURES, STORE
from sierra.util.fs import inside, unescaped
from sierra.util.hashing import sha256_file
from sierra.util.lazy_definitions import dataclass, field, replace


def programs_in(
    spec: RunSpec,
    manifest: bytes,
    root: Path,
    data: Programs = NOTHING,
    project: Path | None = None,
    *,
    products: AbstractSet[str] = frozenset(),
) -> Programs:
    """Return the programs that a spec's command starts, with the code in `root`, and the files that they need.

    `data` are the files that nothing in the spec names. `project` is the user's project folder. `products` are the names of the
    products of a build: of the other files in their folders, only those count that a word names itself. Raises Missing.
    """
    variables = spec.environment
    if spec.image is not None or spec.robots is not None:  # the programs are in the image, or on the robots
        return _without_leftovers(_beside_image(spec, manifest, root, data), spec, data, products)
    files = _named(spec, manifest, root, data, project)
    words, *around = (commands.fill(argv, root, project=project) for argv in (spec.command, *spec.around.commands))
    declared = commands.declared(variables, root, project)
    used = programs.find(words, declared, root, files, project=project, around=around, named=commands.named_programs(spec))
    return _without_leftovers(programs.of_project(used, (root, project or root)), spec, data, products)


def _without_leftovers(used: Programs, spec: RunSpec, data: Programs, produced: AbstractSet[str]) -> Programs:
    """Return the programs without the files that a build leaves beside its products, for example a compiler's caches.

    A variable may name the whole folder (`LIBRARIES={project}/build`), but such files differ after each build.
    """
    folders = {folder for name in produced if (folder := PurePosixPath(name).parent).parts}
    if not folders:
        return used
    kept = {program.path for program in data.all}
    words = commands.on_hosts((*spec.words, *spec.environment.values()), spec)

    def counts(program: Program) -> bool:
        name = program.name.removeprefix(IN_PROJECT)
        if program.kind is not Kind.FILE or name == program.name or name in produced or program.path in kept:
            return True
        return folders.isdisjoint(PurePosixPath(name).parents) or any(program.name in word for word in words)

    return replace(used, all=tuple(program for program in used.all if counts(program)))


def _named(spec: RunSpec, manifest: bytes, root: Path, data: Programs, project: Path | None) -> Programs:
    """Return the files outside the source that the command and the variables of a spec name, and `data`."""
    paths = [spec.environment[name] for name in referenced_files.LIBRARY_PATHS if name in spec.environment]
    others = (value for name, value in spec.environment.items() if name not in referenced_files.LIBRARY_PATHS)
    words, searched = (commands.on_hosts(texts, spec) for texts in ((*spec.words, *others), paths))
    if spec.image is not None or spec.robots is not None:  # what has another place is not this machine's
        words, searched = (tuple(word for word in some if "{project}" in word) for some in (words, searched))
    return referenced_files.files(words, root, source.paths(manifest), data, project, searched=searched)


def _beside_image(spec: RunSpec, manifest: bytes, root: Path, data: Programs) -> Programs:
    """Return the project files and mounted files that belong to the fingerprint when the image provides the programs."""
    files = _named(spec, manifest, root, data, None)
    kept = {one.path for one in data.all}
    return replace(files, all=tuple(one for one in files.all if one.path in kept or one.name.startswith(IN_PROJECT)))


@dataclass(frozen=True, slots=True)
class Checkout:
    """Content of a folder with the code of a batch."""

    project: Path
    spec: RunSpec
    manifest: bytes
    used: tuple[tuple[str, str], ...]
    """Recorded programs, libraries and files: name (`{project}/path`, or an absolute path) and kind."""
    content: Callable[[str], bytes | None]
    """Function that returns the content of a file that git does not have, by git's hash."""
    mounted: Programs = NOTHING
    """Files that are mounted into the containers of runs, in their current state."""
    commit: str | None = None
    """The commit that was checked out; error messages name it if something is missing."""
    built: Mapping[str, str] = field(default_factory=dict)
    """The SHA-256 of each product that a recorded build made from this source, by its name in the project."""
    recorded: Mapping[str, str] = field(default_factory=dict)
    """The recorded SHA-256 of used files, by name."""
    observed: Mapping[str, str] = field(default_factory=dict)
    """The recorded SHA-256 of the project's files that executions were observed to use, by name."""
    kept: Callable[[str], bytes | None] = lambda _: None
    """Function that returns the content of a file that the store keeps, by its SHA-256."""
    use_git: bool = True
    """False if the project sets `git = false` under `[source]`."""

    def make(self, root: Path) -> None:
        """Create `root` and write the code into it.

        Raises Missing if a file no longer exists anywhere, or if a product in the project is not the recorded one.
        """
        self.restore(root)
        self.bring(root, (name for name, _ in self.used))
        self.supply(root)

    def restore(self, root: Path) -> None:
        """Create `root` and write the source into it. Raises Missing if a file no longer exists anywhere."""
        if self.spec.source is None:
            root.mkdir(parents=True)
        else:
            source.restore(
                self.spec.source,
                self.manifest,
                self.project,
                root,
                self.content,
                commit=self.commit,
                use_git=self.use_git,
            )

    def bring(self, root: Path, names: Iterable[str]) -> None:
        """Copy these files of the project into `root`, unless they exist there: the names are those of programs.

        If the store keeps the recorded file, that is written instead of the project's file, which may have changed. A file of
        the source that git has restored with other bytes is replaced, if the store or the project has the recorded ones.

        Raises Missing if a file does not exist, or if a product in the project is not the recorded one.
        """
        held = source.paths(self.manifest)
        for name in names:
            path = self._path(name)
            if path.as_posix() in self.built and not (root / path).exists():
                self._check_product(path)
            if not name.startswith(IN_PROJECT) or path.is_absolute() or ".." in path.parts:
                continue
            digest = self.recorded.get(name)
            if digest is not None and _is_converted(root, path, digest, held):
                self._replace(root, path, digest)
            elif path.as_posix() in self.built or not self._put_back(root, path, digest):
                _copy_in(self.project / path, root, path)

    def supply(self, root: Path) -> None:
        """Write the other files that runs were observed to use into `root`.

        A file that exists there stays. One of which nobody has the recorded content any more is left out.
        """
        held = source.paths(self.manifest)
        for name, digest in self.observed.items():
            path = self._path(name)
            original = self.project / path
            if not name.startswith(IN_PROJECT) or path.is_absolute() or ".." in path.parts:
                continue
            if (root / path).exists():
                if _is_converted(root, path, digest, held):
                    self._replace(root, path, digest)
            elif not self._put_back(root, path, digest) and original.is_file() and sha256_file(original) == digest:
                _copy_in(original, root, path)

    def _path(self, name: str) -> Path:
        """Return the path of a file of the project, relative to it; escapes stand for bytes that are not UTF-8."""
        path = name.removeprefix(IN_PROJECT)
        return Path(path if (self.project / path).exists() else unescaped(path))

    def _replace(self, root: Path, path: Path, digest: str) -> None:
        """Replace a file by one with the recorded bytes, from the store or the project; leave it if neither has these."""
        original = self.project / path
        content = self.kept(digest)
        if content is None and original.is_file() and sha256_file(original) == digest:
            content = original.read_bytes()
        if content is not None:
            copy = inside(root, str(path))
            copy.chmod(copy.stat().st_mode | 0o200)
            copy.write_bytes(content)

    def _put_back(self, root: Path, path: Path, digest: str | None) -> bool:
        """Write a kept file into `root`. Return False if it is there already, or not kept."""
        copy = root / path
        if digest is None or (copy.exists() and not (copy.is_symlink() and _leads_out(copy, root))):
            return False
        content = self.kept(digest)
        if content is None:
            return False
        copy = _make_room(root, path)
        copy.write_bytes(content)
        copy.chmod(0o755)
        return True

    def _check_product(self, name: Path) -> None:
        """Raise Missing if a product in the project is not the one that was built from this source."""
        file = self.project / name
        if not file.is_file() or sha256_file(file) != self.built[name.as_posix()]:
            raise Missing(
                f"{file} is not the product that was built from the recorded source; check that source out and repeat the "
                "query, or use sierra replay, which builds it again"
            )

    def left_out(self) -> str:
        """Return a short text about the project files that git ignores and nothing names, so that the checkout lacks them.

        The text is empty if there are none.
        """
        brought = (name.removeprefix(IN_PROJECT) for name, _ in self.used if name.startswith(IN_PROJECT))
        return source.ignored(self.project, (STORE, FIGURES, *brought)) if self.use_git else ""

    def programs_in(self, root: Path) -> Programs:
        """Return the programs that the command starts in the checkout `root`, and the files that it needed, as they are now."""
        contained = self.spec.image is not None
        kept = (name for name, kind in self.used if kind == Kind.FILE and (not contained or name.startswith(IN_PROJECT)))
        files = referenced_files.existing(kept, root)
        files = replace(files, all=(*files.all, *self.mounted.all))
        return programs_in(self.spec, self.manifest, root, files, self.project, products=self.built.keys())

    def programs(self) -> Programs:
        """Return `programs_in` for a temporary checkout, which is removed again."""
        with tempfile.TemporaryDirectory(prefix="sierra-") as folder:
            self.make(root := Path(folder, "code"))
            return self.programs_in(root)


def _is_converted(root: Path, path: Path, digest: str, held: Container[bytes]) -> bool:
    """Check whether a restored file of the source, or of a nested repository, has other bytes than the recorded ones."""
    copy = root / path
    if copy.is_symlink() or not copy.is_file() or not any(os.fsencode(one) in held for one in (path, *path.parents)):
        return False
    return sha256_file(copy) != digest


def _leads_out(link: Path, root: Path) -> bool:
    """Check whether a restored link leads out of the folder that it was restored to."""
    try:
        return not link.resolve().is_relative_to(root.resolve())
    except (OSError, RuntimeError):  # a link to itself
        return True


def _copy_in(original: Path, root: Path, name: Path) -> None:
    """Copy one project file that was not restored, or that was restored as a link that leads out of the project.

    Writes nothing outside `root`. For a program in a folder of a virtual environment, links the whole environment.
    Raises Missing if the file does not exist.
    """
    copy = root / name
    if copy.exists() and not (copy.is_symlink() and _leads_out(copy, root)):
        return
    if not original.is_file():
        raise Missing(
            f"{original} does not exist; runs need it, and the recorded source does not contain it: build or fetch it again"
        )
    if len(name.parts) > 2 and (original.parent.parent / VENV).is_file():
        original, name = original.parent.parent, name.parent.parent
    copy = _make_room(root, name)
    if original.is_dir():
        copy.symlink_to(original)
    else:
        shutil.copy2(original, copy)


def _make_room(root: Path, name: Path) -> Path:
    """Return the place of a file in `root`, with its folders and without what is there; links that lead out are removed."""
    for folder in reversed(name.parents):
        if (root / folder).is_symlink() and _leads_out(root / folder, root):
            (root / folder).unlink()
    copy = inside(root, str(name), link=True)
    copy.parent.mkdir(parents=True, exist_ok=True)
    copy.unlink(missing_ok=True)
    return copy
