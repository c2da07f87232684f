"""The code of a batch in a folder of its own, ready to execute: as it was recorded, or as it was committed.

The user's files are never touched. What runs need of the project, and the source does not hold (git ignores what was built,
say), is copied as it is now: programs, the libraries that they load, files that the command or a variable names. Its
fingerprint tells whether it is still what it was. Of a virtual environment, where a program is its Python, all is linked.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from sierra.errors import Missing
from sierra.execution import commands
from sierra.model import Recipe
from sierra.provenance import programs, referenced_files, source
from sierra.provenance.program import NOTHING, Kind, Programs
from sierra.store.layout import FIGURES, STORE
from sierra.util.fs import inside

INSIDE = "{project}/"
VENV = "pyvenv.cfg"
"""Says that a folder is a virtual environment."""


def programs_in(recipe: Recipe, manifest: bytes, root: Path, data: Programs = NOTHING, project: Path | None = None) -> Programs:
    """The programs that a recipe's command starts where the code lies in `root`, and the files that they need.

    `data` are those that nothing in the recipe names; `project` is where the user has the project. Raises Missing.
    """
    command, variables = recipe.command, recipe.environment
    if recipe.image is not None:
        return _beside_image(recipe, manifest, root, data)
    files = referenced_files.files((*command, *variables.values()), root, source.paths(manifest), data, project or root)
    words, declared = commands.fill(command, root, project=project), commands.declared(variables, root, project)
    found = programs.find(words, declared, root, files, project=project)
    return programs.of_project(found, (root, project or root))


def _beside_image(recipe: Recipe, manifest: bytes, root: Path, data: Programs) -> Programs:
    """The files of the project, and those mounted, that count where the programs are the image's."""
    words = [word for word in (*recipe.command, *recipe.environment.values()) if "{project}" in word]
    files = referenced_files.files(words, root, source.paths(manifest), data)
    kept = {one.path for one in data.all}
    return replace(files, all=tuple(one for one in files.all if one.path in kept or one.name.startswith(INSIDE)))


@dataclass(frozen=True, slots=True)
class Checkout:
    """What is to be put into a folder."""

    project: Path
    recipe: Recipe
    manifest: bytes
    used: tuple[tuple[str, str], ...]
    """The programs, libraries and files that were recorded, by name (`{project}/path`, or where they are) and kind."""
    content: Callable[[str], bytes | None]
    """A file that git does not have, by git's hash."""
    mounted: Programs = NOTHING
    """Files that are mounted into the containers of runs, as they are now."""
    commit: str | None = None
    """The commit that was checked out, to be named where something is missing."""

    def make(self, root: Path) -> None:
        """Write it into `root`, which is made. Raises Missing for what is nowhere any more."""
        if self.recipe.source is None:
            root.mkdir(parents=True)
        else:
            source.restore(self.recipe.source, self.manifest, self.project, root, self.content, commit=self.commit)
        for name, _ in self.used:
            path = Path(name.removeprefix(INSIDE))
            if name.startswith(INSIDE) and not path.is_absolute() and ".." not in path.parts:
                _bring(self.project / path, root, path)

    def left_out(self) -> str:
        """What git ignores of the project and nobody has named, so that it is not in there: in a few words, or empty."""
        brought = (name.removeprefix(INSIDE) for name, _ in self.used if name.startswith(INSIDE))
        return source.ignored(self.project, (STORE, FIGURES, *brought))

    def programs_in(self, root: Path) -> Programs:
        """The programs that its command starts where it was made in `root`, and the files that it needed, as they are now."""
        contained = self.recipe.image is not None
        kept = (name for name, kind in self.used if kind == Kind.FILE and (not contained or name.startswith(INSIDE)))
        files = referenced_files.again(kept, root)
        files = replace(files, all=(*files.all, *self.mounted.all))
        return programs_in(self.recipe, self.manifest, root, files, self.project)

    def programs(self) -> Programs:
        """The same, found in a folder that is gone again."""
        with tempfile.TemporaryDirectory(prefix="sierra-") as folder:
            self.make(root := Path(folder, "code"))
            return self.programs_in(root)


def _leads_out(link: Path, root: Path) -> bool:
    """Return whether a restored link leads out of the folder that it was restored to."""
    try:
        return not link.resolve().is_relative_to(root.resolve())
    except (OSError, RuntimeError):  # a link to itself
        return True


def _bring(there: Path, root: Path, name: Path) -> None:
    """Copy what was not restored, or only as a link that leads out of the project. Nothing is written outside `root`."""
    here = root / name
    if here.exists() and not here.is_symlink():
        return
    if not there.is_file():
        raise Missing(f"{there} is not there; runs need it, and the recorded source does not hold it: build or fetch it again")
    if len(name.parts) > 2 and (there.parent.parent / VENV).is_file():
        there, name = there.parent.parent, name.parent.parent
    for folder in reversed(name.parents):
        if (root / folder).is_symlink() and _leads_out(root / folder, root):
            (root / folder).unlink()
    here = inside(root, str(name), link=True)
    here.parent.mkdir(parents=True, exist_ok=True)
    here.unlink(missing_ok=True)
    if there.is_dir():
        here.symlink_to(there)
    else:
        shutil.copy2(there, here)
