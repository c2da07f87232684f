"""Scripts of Lua controllers in ARGoS, which lie beside the input of each run.

ARGoS opens the path in `script` from the folder in which `argos3` was started. People start it in the project's folder; a run
starts it in its folder `output`. The files that `files` names have the same paths in the folder above as in the project.
Therefore `walk.lua` becomes `../walk.lua`. ARGoS searches modules that a script requires in the folder of the script.
"""

from __future__ import annotations

import posixpath
from collections.abc import Iterable, Iterator
from fnmatch import fnmatchcase

from sierra.design.platforms.base import Reader
from sierra.errors import TemplateError
from sierra.model import FOLDER, Change, Set

SCRIPTS = "/argos-configuration/controllers/lua_controller/params/@script"
WHY = "platform argos: the script of a Lua controller"
ABOVE = "../"


def changes(template: Reader) -> Iterator[Change]:
    """Yield the changes by which runs find the scripts of a template."""
    for number, script in enumerate(template.find(SCRIPTS), 1):
        if _is_relative(script) and not script.startswith(ABOVE):
            yield Set(f"({SCRIPTS})[{number}]", ABOVE + posixpath.normpath(script), expect=1, why=WHY)


def check(document: Reader, files: Iterable[str]) -> None:
    """Check that runs find all scripts; `files` are files, folders and globs. Raises TemplateError."""
    named = [posixpath.normpath(one) for one in files]
    for script in filter(_is_relative, document.find(SCRIPTS)):
        path = posixpath.normpath(script.removeprefix(ABOVE))
        if not any(_is_below(path, one) for one in named):
            what = f"the script {path!r} of a Lua controller is not beside the inputs of runs"
            raise TemplateError(f'{what}; add it: files = ["{path}"]')
        if not script.startswith(ABOVE):
            raise TemplateError(f"runs do not find the script {script!r} of a Lua controller; set it to {ABOVE + path!r}")


def _is_relative(script: str) -> bool:
    """Return whether a script is named by a path that is neither absolute nor in `{project}` or `{output}`."""
    return bool(script) and not script.startswith(("/", "{", FOLDER))


def _is_below(path: str, name: str) -> bool:
    return fnmatchcase(path, name) or name == "." or path.startswith(f"{name}/")
