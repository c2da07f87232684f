"""The code of a batch in a folder of its own, ready to execute: as it was recorded, or as it was committed.

The user's files are never touched. What the command or a variable names of the project by `{project}/…`, and the source does
not hold (git ignores it, say), is copied as it is now: its fingerprint tells whether it is still what it was.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from sierra import jobs
from sierra.errors import Missing
from sierra.model import Recipe
from sierra.provenance import named, programs, source
from sierra.provenance.program import NOTHING, Programs

INSIDE = "{project}/"


def programs_in(recipe: Recipe, manifest: bytes, root: Path, data: Programs = NOTHING) -> Programs:
    """The programs that a recipe's command starts where the code lies in `root`, and the files that they need.

    `data` are those that nothing in the recipe names. Raises Missing.
    """
    command, variables = recipe.command, recipe.environment
    files = named.files((*command, *variables.values()), root, source.paths(manifest), data)
    return programs.find(jobs.fill(command, root), jobs.declared(variables, root), root, files)


@dataclass(frozen=True, slots=True)
class Checkout:
    """What is to be put into a folder."""

    project: Path
    recipe: Recipe
    manifest: bytes
    beside: tuple[str, ...]
    """Files that the source does not hold: `{project}/path`, or where they are."""
    content: Callable[[str], bytes | None]
    """A file that git does not have, by git's hash."""
    commit: str | None = None
    """The commit that was checked out, to be named where something is missing."""

    def make(self, root: Path) -> None:
        """Write it into `root`, which is made. Raises Missing for what is nowhere any more."""
        if self.recipe.source is None:
            root.mkdir(parents=True)
        else:
            source.restore(self.recipe.source, self.manifest, self.project, root, self.content, commit=self.commit)
        for name in self.beside:
            inside = Path(name.removeprefix(INSIDE))
            if name.startswith(INSIDE) and not inside.is_absolute() and ".." not in inside.parts:
                _copy(self.project / inside, root / inside, name)

    def programs_in(self, root: Path) -> Programs:
        """The programs that its command starts where it was made in `root`, and the files that it needed, as they are now."""
        return programs_in(self.recipe, self.manifest, root, named.again(self.beside, root))

    def programs(self) -> Programs:
        """The same, found in a folder that is gone again."""
        with tempfile.TemporaryDirectory(prefix="sierra-") as folder:
            self.make(root := Path(folder, "code"))
            return self.programs_in(root)


def _copy(there: Path, here: Path, name: str) -> None:
    if not there.is_file():
        raise Missing(f"{there} is not there; runs need {name}, and the recorded source does not hold it")
    here.parent.mkdir(parents=True, exist_ok=True)
    shutil.copy2(there, here)
