"""The content of a folder: whether a project can begin there, its template, and possible simulators."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from pathlib import Path

from sierra.config import extensions, find_project
from sierra.errors import Missing, TemplateError, UsageError
from sierra.provenance.source.plain_tree import LEFT_OUT
from sierra.provenance.source.suggest_exclusions import is_hardly_code
from sierra.setup.init.answers import NONE, Ask, Question, checked_answer
from sierra.store.layout import CONFIG, PYPROJECT
from sierra.templates.base import Template, read
from sierra.util.lazy_definitions import regex
from sierra.util.regular_files import open_regular

TEMPLATES = tuple(dict.fromkeys((".xml", *extensions.every("inputs"), *extensions.starts())))
STARTS = (*extensions.starts(), ".world")
STARTING = ("omnetpp.ini",)
"""The endings and names of files with which simulators start; they name the other files."""
DATA = (".json", ".yaml", ".yml", ".toml", ".ini", ".properties")
"""The endings of data files, which are templates only if there is none of the others."""
TEXTS = (".txt", ".in", ".tmpl", ".tpl", ".template")
"""The endings of texts, which are templates if they have placeholders."""
NETLOGO = (".nlogo", ".nlogox")
"""The endings of models of NetLogo. The template is a setup file of BehaviorSpace, which has the experiment of a model."""
EXPERIMENT = regex(rb"<experiment\b[^>]*?\bname=[\"']([\w .-]+)[\"']")
PLACEHOLDER = regex(rb"\{\{[A-Za-z_]\w*\}\}")
OF_TOOLS = regex(
    r"(package|package-lock|composer|tsconfig|compile_commands|CMakePresets|CMakeUserPresets|vcpkg|launch|settings)\.json"
    r"|(pyproject|sierra|Cargo|rust-toolchain|Pipfile|poetry|uv|ruff|taplo|rustfmt)\.toml"
    r"|(tox|pytest|mypy|setup|desktop)\.ini|(gradle|log4j|sonar-project)[\w-]*\.properties"
    r"|(docker-)?compose[\w.-]*\.ya?ml|(mkdocs|environment|_config|codecov|conda|meta|action|pnpm-lock|readthedocs)\.ya?ml"
    r"|(requirements|constraints|LICENSE|README|AUTHORS|COPYING|CMakeLists|NOTES|notes)[\w.-]*\.(txt|in)"
)
"""Data files and texts of other tools, which are no templates."""
INTERPRETERS = {".py": "python3", ".sh": "bash", ".jl": "julia", ".R": "Rscript", ".lua": "lua", ".pl": "perl", ".rb": "ruby"}
OTHERS = regex(r"(package|pom|build)\.xml|(setup|conftest|test_.*|.*_test)\.py|.*\.(so|dylib)")
"""Files that are neither template nor simulator."""
PLACES = ("build", "bin", "target/release", "src", "scripts")
MAGIC = (b"#!", b"\x7fELF", b"\xcf\xfa\xed\xfe", b"\xca\xfe\xba\xbe")
"""The first bytes of programs: scripts, and executables of Linux and macOS.

They identify programs where all files have the permission to be executed.
"""
STARTED = (b"__main__", b"sys.argv", b"argparse")
"""Words in a Python file that show that it is a program, not only a module that others import."""


def check(root: Path) -> None:
    """Raise UsageError if there is a project already, Missing if none can be made."""
    path, pyproject = root / CONFIG, root / PYPROJECT
    if os.path.lexists(path):
        raise UsageError(f"{path} exists already and is never overwritten; change it with an editor, or remove it first")
    if not root.is_dir():
        raise Missing(f"{root} is not a folder; create it, and put the template and the simulator there")
    if not os.access(root, os.W_OK | os.X_OK):
        raise Missing(f"{root} is not writable; change its permissions, or use another folder")
    if pyproject.is_file() and find_project.settings(pyproject) is not None:
        raise UsageError(f"{pyproject} has [tool.sierra] already, which {CONFIG} would hide; change that table with an editor")


def warnings(root: Path) -> Iterator[str]:
    above = [parent / CONFIG for parent in root.resolve().parents if (parent / CONFIG).is_file()]
    if above:
        yield f"this folder was in the project of {above[0]}; from now on it is a separate project"


def template(
    root: Path, given: str | None, format: str | None, ask: Ask | None, main: Callable[[Path, Sequence[str]], str | None]
) -> tuple[str, Template] | None:
    """Return the template's path relative to the folder, and its content, read as `format` or by its ending; None for none.

    `main` returns the one of several files that names the others. Raises Missing, TemplateError, ConfigError.
    """
    files = templates(root)
    default = _default_template(root, files, main)
    endings = ", ".join((*TEMPLATES, *DATA))
    what = f"several files could be the template ({', '.join(files)})" if files else f"no {endings} file found"
    if not files and (models := _files(root, [""], NETLOGO)):
        what += f"; for the NetLogo model {models[0]}, export a BehaviorSpace experiment as XML (sierra init --example netlogo)"
    without = "" if files else ", or the arguments of a program that reads none, as in --command './sim --robots 4 --seed 1'"
    missing = f"{root}: {what}; give the template with --template FILE{without}"
    text = f"template: the file from which the inputs of all runs are generated ({NONE} if the program reads only arguments)"
    question = Question(text, tuple(files), default if files else NONE if ask else None, missing)
    return checked_answer(given, question, ask, partial(_check_template, root, format))


def _default_template(root: Path, found: Sequence[str], main: Callable[[Path, Sequence[str]], str | None]) -> str | None:
    """Return the template among several files: the only one, the one with which a simulator starts, or that names others."""
    starting = [name for name in found if name.endswith(STARTS) or Path(name).name in STARTING]
    named = [name for name in found if Path(name).stem == "template"]
    return next((names[0] for names in (found, starting, named) if len(names) == 1), None) or main(root, found)


def templates(root: Path) -> list[str]:
    """Return the files that may be the template, as paths relative to the folder."""
    below = [name for name in listed(root) if not is_hardly_code(name, is_folder=True)]
    return next((some for some in _possible(root, below) if some), [])


def _possible(root: Path, below: Sequence[str]) -> Iterator[list[str]]:
    """Yield the files that may be the template, the most likely group first."""
    for endings in (TEMPLATES, DATA, TEXTS):
        for places in ([""], below):
            files = _files(root, places, endings)
            if endings is TEMPLATES:
                yield files
            else:
                likely = [name for name in files if not OF_TOOLS.fullmatch(Path(name).name)]
                yield [name for name in likely if endings is DATA or PLACEHOLDER.search(_beginning(root / name, 1 << 20))]


def simulators(root: Path) -> dict[str, list[str]]:
    """Return possible simulators, each with the words that start it: in the folder, or else in folders with usual names."""
    here, below = ([(name, _words(root / name, name)) for name in _files(root, places)] for places in ([""], PLACES))
    return {name: words for name, words in here if words} or {name: words for name, words in below if words}


def of_netlogo(root: Path, template: str | None) -> dict[str, list[str]]:
    """Return the program that executes the only model of NetLogo, if the template is a setup file with one experiment.

    Raises Missing if there is no such program.
    """
    models, program = _files(root, [""], NETLOGO), "netlogo-headless.sh"
    names = EXPERIMENT.findall(_beginning(root / template, 1 << 20)) if template and len(models) == 1 else []
    if len(names) != 1:
        return {}
    started = f"./{program}" if (root / program).is_file() else program
    if started == program and shutil.which(program) is None:
        raise Missing(f"{program} of NetLogo is not in the PATH; add its folder to PATH, or give the command with --command")
    table = f"{{output}}/{Path(models[0]).stem}.csv"
    reads = ("--model", models[0], "--setup-file", "{input}", "--experiment", names[0].decode())
    return {program: [started, *reads, "--table", table, "--threads", "1"]}


def is_started(file: Path) -> bool:
    return file.suffix != ".py" or any(word in _beginning(file, 1 << 20) for word in STARTED)


def listed(folder: Path) -> list[str]:
    """Return the names that may be part of a project: not hidden, and possible on one line of TOML."""
    names = sorted(entry.name for entry in folder.iterdir())
    return [name for name in names if not name.startswith(".") and name.isprintable() and name not in LEFT_OUT]


def _files(root: Path, places: Iterable[str], endings: str | tuple[str, ...] = "") -> list[str]:
    """Return the files in these folders, as paths relative to `root`."""
    folders = [root / place for place in places if (root / place).is_dir()]
    named = [folder / name for folder in folders for name in listed(folder) if name.endswith(endings)]
    return [str(file.relative_to(root)) for file in named if file.is_file() and not OTHERS.fullmatch(file.name)]


def _check_template(root: Path, format: str | None, text: str) -> tuple[str, Template] | None:
    """Read the template at `text`: a path relative to the folder, or to the working directory, as a shell completes it."""
    if text == NONE:
        return None
    path = root / text if (root / text).exists() or not Path(text).is_file() else Path(text)
    try:
        return os.path.relpath(path, root), read(path, format=format)
    except TemplateError as error:  # there is no sierra.toml yet that could have the key
        raise TemplateError(str(error).replace("set template_format to one of", "use --format with one of")) from error


def _words(file: Path, name: str) -> list[str]:
    """Return the words that start a file; an empty list if it is neither a script nor a program."""
    if file.suffix != ".py" and os.access(file, os.X_OK) and _beginning(file, 4).startswith(MAGIC):
        return [f"./{name}"]
    return [INTERPRETERS[file.suffix], name] if file.suffix in INTERPRETERS else []


def _beginning(file: Path, size: int) -> bytes:
    with open_regular(file) as stream:
        return stream.read(size)
