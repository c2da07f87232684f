"""The first minute: copying the example, and a first `sierra.toml` from what a folder shows.

Each thing to say (template, command, seed, variables, source) goes one way: what an option gives, what somebody answers
at a prompt, and what was found are checked by the same function, which raises in one line what is wrong.

*Source.* All files of a project count as the code that its runs are made from: rather too much than stale. What is
written is therefore a comment that names the files and folders found, without those whose names say that they hold
something else (results, figures, papers); it counts once somebody takes the `#` away, chooses it when asked (which
happens only where there is such a folder), or says `--source`.

*Places.* Runs start in a folder of their own. `sierra.jobs` finds a word of the command that is a file of the project;
here, what it leaves as it is gets `{project}/`: absolute paths into the project, its folders, `--option=file`.
"""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
import tomllib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from importlib import resources
from pathlib import Path
from typing import Protocol, TypeVar

from sierra import config, inputs, jobs, platforms, query
from sierra.design import GROUPED
from sierra.errors import ConfigError, Missing, QueryError, SierraError, TemplateError, UsageError
from sierra.inputs import Template
from sierra.model import Change, Set
from sierra.paths import CONFIG, PYPROJECT, STORE
from sierra.platforms import Platform
from sierra.provenance.source import LEFT_OUT

T = TypeVar("T")

NONE = "-"
"""The answer that refuses what was found."""
ALL = "."
"""The answer that all of the folder is source."""
SHOWN = 12
"""Variables, and paths of the source, that are offered at most."""

TEMPLATES = (".xml", ".argos", ".world", ".sdf", ".launch")
NO_TEMPLATES = ("package.xml", "pom.xml", "build.xml")
INTERPRETERS = {".py": "python3", ".sh": "bash", ".jl": "julia", ".R": "Rscript", ".lua": "lua", ".pl": "perl", ".rb": "ruby"}
NO_SCRIPT = re.compile(r"(setup|conftest|test_.*|.*_test)\.py$")
BUILT = ("build", "bin", "target/release")
MAGIC = (b"#!", b"\x7fELF", b"\xcf\xfa\xed\xfe", b"\xca\xfe\xba\xbe")
"""How programs begin: scripts, and those of Linux and macOS. Where all files have the right to be executed, it tells them."""
TO_BUILD = ("Makefile", "makefile", "CMakeLists.txt", "Cargo.toml", "meson.build")
SHELL = re.compile(r"[0-9]?[<>]|&&|\|\|?$|;$|&$")

NO_CODE = re.compile(
    r"(results?|outputs?|out|logs?|figures?|figs?|plots?|papers?|thesis|docs?|notes|slides|videos?|data|datasets?)", re.I
)
"""Folders that hardly hold code. Runs may read `data`, so that none is left out unless somebody says so."""

NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")
NUMBER = re.compile(r"[+-]?\d+(\.\d+)?")
CROWDS = frozenset(
    ["population", "robots", "agents", "swarm", "individuals", "vehicles", "drones", "boids", "ants", "particles"]
)
COUNTS = frozenset(["quantity", "count", "number", "num", "n", "amount", "total", "of", "size", "model"])
GENERIC = frozenset(["value", "val", "default", "data"])
SELDOM = frozenset(["id", "name", "version", "port", "threads"])


@dataclass(frozen=True, slots=True)
class Options:
    """What is said beforehand; None, or empty, is what has to be found out."""

    template: str | None = None
    command: str | None = None
    seed: str | None = None
    variables: tuple[str, ...] = ()
    source: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Question:
    """What to ask. `default` is what Enter takes; None is that there has to be an answer."""

    text: str
    choices: tuple[str, ...] = ()
    default: str | None = None


class Ask(Protocol):
    """Asks somebody until the answer passes the check; says what is wrong with others."""

    def __call__(self, question: Question, check: Callable[[str], T]) -> T: ...


@dataclass(frozen=True, slots=True)
class Command:
    """A command as it will be written, the variables it needs, and what is doubtful about it."""

    text: str
    environment: Mapping[str, str]
    doubts: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Guess:
    """What a first `sierra.toml` will say, and what it mentions in comments."""

    template: str
    platform: str
    command: Command | None
    seed: str | None
    variables: Mapping[str, str]
    source: tuple[str, ...]
    other_variables: Mapping[str, str]
    proposed_source: tuple[str, ...]
    left_out: tuple[str, ...]
    next: str | None
    """The query to ask first."""
    notes: tuple[str, ...]


def copy_example(name: str, folder: Path) -> list[str]:
    """Copy a bundled example; the files' names. Raises UsageError where there is none, or the folder is not empty."""
    examples = resources.files("sierra") / "examples"
    known = sorted(entry.name for entry in examples.iterdir() if entry.is_dir() and not entry.name.startswith("_"))
    if name not in known:
        raise UsageError(f"no example {name!r}; there is {', '.join(known)}")
    if folder.exists() and any(folder.iterdir()):
        raise UsageError(f"{folder} is not empty; name a new folder")
    folder.mkdir(parents=True, exist_ok=True)
    names = []
    with resources.as_file(examples / name) as source:
        for file in sorted(source.iterdir()):
            if file.is_file():
                shutil.copyfile(file, folder / file.name)
                names.append(file.name)
    return names


def find_out(folder: Path, said: Options, ask: Ask | None = None) -> Guess:
    """What is said, and for the rest what the folder shows; what is doubtful is asked, where there is somebody to `ask`.

    Raises UsageError for what is said wrongly, and where there is a `sierra.toml` already; Missing where nobody can be
    asked what the folder does not show.
    """
    _check_folder(folder)
    template, read = _template(folder, said.template, ask)
    platform = "argos" if _matches(read, "/argos-configuration") else "command"
    command = _command(folder, template, platform, said.command, ask)
    driven = _platform(template, platform, command.text if command else None)
    numbers = _numbers(read)
    seed = _seed(read, driven, numbers, said.seed, ask)
    set_by_run = (*driven.seed_changes(), *([Set(seed, "{seed}")] if seed else []))
    found = _named({path: value for path, value in numbers.items() if not _is_overwritten(path, seed)}, platform)
    variables = _variables(read, set_by_run, found, said.variables, ask, first=not driven.criteria())
    proposed, left_out = _code(folder, template)
    return Guess(
        template=template,
        platform=platform,
        command=command,
        seed=seed,
        variables=variables,
        source=_source(folder, proposed, left_out, said.source, ask),
        other_variables={name: path for name, path in found.items() if path not in variables.values()},
        proposed_source=proposed,
        left_out=left_out,
        next=_first_query(driven, read, variables),
        notes=tuple(_notes(folder, driven, command, seed, numbers)),
    )


def write(folder: Path, guess: Guess) -> Path:
    """Write `sierra.toml`, never over one that is there; its path."""
    text = "\n".join(_lines(guess)) + "\n"
    path = folder / CONFIG
    config.parse(tomllib.loads(text), str(path))
    with path.open("xb") as file:
        try:
            file.write(text.encode())
            file.flush()
        except OSError:  # a full disk
            path.unlink()
            raise
    return path


# Folder and template


def _check_folder(folder: Path) -> None:
    path = folder / CONFIG
    if os.path.lexists(path):
        raise UsageError(f"{path} is there already, and is never written over; change it with an editor, or remove it first")
    if not folder.is_dir():
        raise Missing(f"{folder} is no folder; make it, and put template and simulator there")
    if not os.access(folder, os.W_OK | os.X_OK):
        raise Missing(f"{folder} may not be written to; get the right to, or name another folder")
    pyproject = folder / PYPROJECT
    if pyproject.is_file() and _has_table(pyproject):
        raise UsageError(f"{pyproject} has [tool.sierra] already, which {CONFIG} would hide; change it with an editor")


def _has_table(pyproject: Path) -> bool:
    try:
        return "sierra" in tomllib.loads(pyproject.read_text()).get("tool", {})
    except ValueError:
        return False


def check_template(folder: Path, text: str) -> tuple[str, Template]:
    """The template's path from the folder, and its content; `text` may be a path from here, as the shell completes it.

    Raises Missing, TemplateError.
    """
    path = folder / text
    if not path.exists() and Path(text).is_file():
        path = Path(text)
    name = os.path.relpath(path, folder)
    if not _is_utf8(name):
        raise UsageError(f"the name of the template {os.fsencode(name)!r} is not UTF-8; rename it")
    return name, inputs.read(folder / name)


def _template(folder: Path, given: str | None, ask: Ask | None) -> tuple[str, Template]:
    found = _templates(folder)
    default = found[0] if len(found) == 1 else "template.xml" if "template.xml" in found else None
    what = f"several could be the template ({_some(found)})" if found else f"no {', '.join(TEMPLATES)} file"
    question = Question("template: the XML file that every run's input is made from", tuple(found), default)
    missing = f"{folder}: {what}; say which with --template FILE"
    return _settled(given, question, ask, partial(check_template, folder), missing)


def _templates(folder: Path) -> list[str]:
    """What could be the template: here, or, where nothing is, in the folders here."""
    for places in ([folder], _folders(folder)):
        files = [file for place in places for file in _files(place)]
        fit = [file for file in files if file.suffix in TEMPLATES and file.name not in NO_TEMPLATES]
        if found := [str(file.relative_to(folder)) for file in fit if _is_utf8(str(file))]:
            return found
    return []


# Command


def check_command(folder: Path, template: str, platform: str, text: str) -> Command:
    """A command that can be started from anywhere. Raises UsageError for what can never be right."""
    try:
        words = shlex.split(text)
    except ValueError as error:
        raise UsageError(f"command {text!r}: {error}") from error
    if not words:
        raise UsageError("a command is not empty; write it as in: python3 sim.py {input}")
    for word in words:
        if Path(word).suffix in INTERPRETERS and "{" not in word and not (folder / word).exists():
            raise UsageError(f"command: there is no {word} in {folder}; write a path from there")
    root = folder.resolve()
    placed = [_placed(word, root) for word in words]
    text = text if placed == words else _joined(placed)
    argv = jobs.command(_platform(template, platform, text), root)
    return Command(text, dict(_environment(words, folder)), tuple(_doubts(argv, root)))


def _command(folder: Path, template: str, platform: str, given: str | None, ask: Ask | None) -> Command | None:
    if platform != "command" and given is None:
        return None
    scripts, programs = _simulators(folder, template)
    sure = _sure(folder, scripts, programs)
    found = tuple(_started(folder, name) for name in (*programs, *scripts))
    unbuilt = "; build it first, or" if any((folder / name).exists() for name in TO_BUILD) else ";"
    what = f"several could be the simulator: {_some((*programs, *scripts))};" if found else f"no program{unbuilt}"
    question = Question(
        "command: how the simulator is started, without a shell\n"
        "({input} is the generated file; there are also {output}, {seed}, {project}, {python})",
        found,
        _started(folder, sure) if sure else None,
    )
    missing = f"{folder}: {what} say how it is started with --command 'python3 sim.py {{input}}'"
    return _settled(given, question, ask, partial(check_command, folder, template, platform), missing)


def _platform(template: str, platform: str, command: str | None) -> Platform:
    table = {"template": template, "platform": platform} | ({"command": command} if command is not None else {})
    return platforms.find(platform, config.parse(table, "--command"))


def _simulators(folder: Path, template: str) -> tuple[list[str], list[str]]:
    """What could be the simulator: scripts that an interpreter starts, and programs; where none is here, those below."""
    for places in ([folder], [folder / name for name in (*BUILT, "src", "scripts")]):
        paths = [file.relative_to(folder) for place in places for file in _files(place) if not NO_SCRIPT.match(file.name)]
        files = [str(path) for path in paths if str(path) != template and _is_utf8(str(path))]
        programs = [name for name in files if _is_program(folder / name)]
        scripts = [name for name in files if Path(name).suffix in INTERPRETERS and name not in programs]
        if programs or scripts:
            return scripts, programs
    return [], []


def _sure(folder: Path, scripts: Sequence[str], programs: Sequence[str]) -> str | None:
    """The only one that can be the simulator, if there is such a one: of scripts, the one that does something."""
    if programs:
        return programs[0] if len(programs) == 1 and not scripts else None
    likely = [script for script in scripts if _starts(folder / script)] or scripts
    return likely[0] if len(likely) == 1 else None


def _is_program(file: Path) -> bool:
    if not os.access(file, os.X_OK) or file.suffix in (".py", ".so", ".dylib") or not os.access(file, os.R_OK):
        return False
    with file.open("rb") as stream:
        return stream.read(4).startswith(MAGIC)


def _starts(script: Path) -> bool:
    """Whether a script does something when it is started, unlike a module that others import."""
    if script.suffix != ".py" or not os.access(script, os.R_OK):
        return False
    with script.open("rb") as stream:
        content = stream.read(1 << 20)
    return b"__main__" in content or b"sys.argv" in content or b"argparse" in content


def _started(folder: Path, name: str) -> str:
    words = [f"./{name}"] if _is_program(folder / name) else [INTERPRETERS[Path(name).suffix], name]
    return _joined([*words, "{input}"])


def _placed(word: str, root: Path) -> str:
    """A word that names what lies in the project, so that it is found from where runs start."""
    option, equals, name = word.rpartition("=")
    path = root / name
    if "{" in word or "\0" in word or not name.strip("./") or not path.exists():
        return word
    inside = os.path.relpath(path, root)
    plain = not equals and path.is_file() and path.resolve().is_relative_to(root) and not name.startswith("/")
    if plain or inside.startswith("..") or not (path.is_file() or "/" in name):
        return word
    return f"{option}{equals}{{project}}" + (f"/{inside}" if inside != "." else "")


def _environment(words: Sequence[str], folder: Path) -> Iterator[tuple[str, str]]:
    """Where `python3 -m module` finds a module of the project."""
    if not Path(words[0]).name.startswith(("python", "{python")) or "-m" not in words[:-1]:
        return
    module = words[words.index("-m") + 1].partition(".")[0]
    for place, path in ((folder, "{project}"), (folder / "src", "{project}/src")):
        if (place / module).is_dir() or (place / f"{module}.py").is_file():
            yield "PYTHONPATH", path
            return


def _doubts(argv: Sequence[str], root: Path) -> Iterator[str]:
    """What is allowed, and yet hardly meant. `argv` is as a run's identity holds it."""
    program = jobs.fill(argv, root)[0]
    if "{" not in program and shutil.which(program) is None:
        there = Path(program).is_file()
        yield (
            f"{program} is no program; name its interpreter (python3 ...), or make it one with chmod +x"
            if there
            else f"the program {program!r} is not there yet; build or install it before it is to run"
        )
    for word in argv:
        if SHELL.match(word):
            yield (
                f"no shell reads the command, so that {word!r} is given to the program; stdout and stderr are kept anyway,"
                " and sh -c '...' is a shell"
            )
        if (root / word).is_dir() and not word.startswith(("/", ".")):
            yield f"{word!r} is a folder here, but runs start in a folder of their own; write {{project}}/{word} if it is meant"
    if not any("{input}" in word or "{run}" in word for word in argv):
        yield "the command does not name {input}, the generated file; unless it finds that itself, all experiments are the same"


def _joined(words: Iterable[str]) -> str:
    """A line that splits into these words, with quotes only where they are needed."""
    return " ".join(word if re.fullmatch(r"[\w@%+=:,./{}-]+", word) else shlex.quote(word) for word in words)


# Seed and variables


def check_seed(template: Template, text: str) -> str | None:
    """The path that gets the seed; None where there is to be none. Raises TemplateError."""
    if text in ("", NONE):
        return None
    template.changed((Set(text, "0", why="seed"),), {})
    return text


def check_variable(template: Template, per_run: Sequence[Change], known: Iterable[str], text: str) -> tuple[str, str]:
    """Name and path of NAME=XPATH. `per_run` is what each run sets after all variables.

    Raises UsageError for another form, a name that is taken, a path that matches nothing, or only the seed.
    """
    name, equals, path = (part.strip() for part in text.partition("="))
    if not equals or not name or not path or name[0] in "/@":
        raise UsageError(f'{text!r}: write a variable as NAME=XPATH, as in "population_size=//swarm/@count"')
    _check_name(name, known)
    why = f"variable {name!r}"
    one, two = (template.changed((Set(path, value, why=why), *per_run), {"seed": 0}).render() for value in ("1", "2"))
    if one == two:
        raise UsageError(f"{why}: {path} is where the seed goes; vary something else, or use montecarlo.C20 for other seeds")
    return name, path


def _check_name(name: str, known: Iterable[str]) -> None:
    """Raises UsageError for a name that queries or the store cannot have."""
    if not NAME.fullmatch(name):
        raise UsageError(f"variable {name!r}: that is not a name of letters, digits and _; write it as in my_name")
    if name in GROUPED:
        raise UsageError(f"variable {name!r}: a query means something else by it; take another name, as in my_{name}")
    if name.lower() in {other.lower() for other in known}:
        raise UsageError(f"variable {name!r}: there is one of that name already; take another name")
    try:
        query.parse_all([f"{name}=1"])
    except QueryError as error:
        raise UsageError(f"variable {name!r}: {str(error).rpartition(': ')[2]}") from error


def _numbers(template: Template) -> dict[str, str]:
    """The paths that select one number, with the number."""
    return {path: value.strip() for path, value in template.attributes() if NUMBER.fullmatch(value.strip())}


def _seed(template: Template, platform: Platform, numbers: Mapping[str, str], given: str | None, ask: Ask | None) -> str | None:
    if platform.seed_changes() and given is None:
        return None
    found = _seeds(numbers)
    question = Question(f"seed: an XPath of what gets each run's seed ({NONE} for none)", found, found[0] if found else "")
    return _settled(given, question, ask, partial(check_seed, template), "")


def _seeds(numbers: Iterable[str]) -> tuple[str, ...]:
    return tuple(path for path in numbers if any(word.endswith("seed") for word in _words(_called(path)[0])))


def _is_overwritten(path: str, seed: str | None) -> bool:
    return path == seed or bool(_seeds([path]))


def _variables(
    template: Template,
    per_run: Sequence[Change],
    found: Mapping[str, str],
    given: Sequence[str],
    ask: Ask | None,
    *,
    first: bool,
) -> dict[str, str]:
    """The variables by name: those given, or (with `first`) the likeliest one, and those that are answered."""
    chosen: dict[str, str] = {}
    for text in given:
        chosen |= [check_variable(template, per_run, chosen, text)]
    if given:
        return chosen
    chosen = dict(list(found.items())[:1]) if first else {}
    while ask is not None:
        others = tuple(f"{name}={path}" for name, path in found.items() if path not in chosen.values())[:SHOWN]
        question = Question(
            f"variables so far: {', '.join(f'{n}={p}' for n, p in chosen.items()) or 'none'}\n"
            f"another one as NAME=XPATH ({NONE}NAME leaves one out, Enter is enough)",
            others,
            "",
        )
        before = chosen
        chosen = ask(question, partial(_one_more, template, per_run, chosen))
        if chosen is before:
            break
    return chosen


def _one_more(template: Template, per_run: Sequence[Change], chosen: dict[str, str], text: str) -> dict[str, str]:
    """The variables after one answer; the same object where it is empty. A path has the name that was given last."""
    if not text:
        return chosen
    if text.startswith(NONE):
        name = text.removeprefix(NONE).strip()
        if name and name not in chosen:
            raise UsageError(f"there is no variable {name!r}; so far there is {', '.join(chosen) or 'none'}")
        return {other: path for other, path in chosen.items() if name and other != name}
    name, path = check_variable(template, per_run, chosen, text)
    return {other: place for other, place in chosen.items() if place != path} | {name: path}


def _named(numbers: Mapping[str, str], platform: str) -> dict[str, str]:
    """What could be varied, by name, the likeliest first: what counts robots, which is called population_size."""
    found: dict[str, str] = {}
    ranked = {path: rank for path, value in numbers.items() if (rank := _rank(path, value)) is not None}
    if ranked and platform == "command":
        found["population_size"] = min(ranked, key=lambda path: ranked[path])
    for path in numbers:
        short, element = _called(path)
        if path in found.values() or short.lower() in SELDOM:
            continue
        for name in (short, f"{element}_{short}"):
            cleaned = re.sub(r"\W", "_", name, flags=re.ASCII)
            if _is_free(cleaned, found):
                found[cleaned] = path
                break
        if len(found) > SHOWN:
            break
    return found


def _is_free(name: str, known: Iterable[str]) -> bool:
    try:
        _check_name(name, known)
    except UsageError:
        return False
    return True


def _rank(path: str, value: str) -> int | None:
    """How likely it is that a path selects a number of robots: 0 is likeliest."""
    short, element = _called(path)
    words, around = set(_words(short)), set(_words(element))
    if not value.isdigit() or not words <= CROWDS | COUNTS:
        return None
    if words & CROWDS:
        return 0
    if words & {"size", "of", "total", "model"} == words:
        return 2 if around & CROWDS else None
    return 1


def _called(path: str) -> tuple[str, str]:
    """What people call what a path selects, and the element: `//param[@name='speed']/@value` is speed."""
    element, _, attribute = path.rpartition("/@") if "/@" in path else (path, "", "")
    named = re.search(r"\[(?:@\w+|local-name\(\))='(.+)'\]$", element)
    label = named[1] if named else re.split("[/:]", element)[-1]
    attribute = attribute.rpartition(":")[2]
    return (label if not attribute or attribute.lower() in GENERIC else attribute), label


def _words(name: str) -> list[str]:
    """`numRobots` and `num_robots` are num, robots."""
    return [word.lower() for word in re.findall(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])", name)]


def _first_query(platform: Platform, template: Template, variables: Mapping[str, str]) -> str | None:
    """A query that makes sense for the value that the template has now."""
    for name in platform.criteria():
        try:
            if name not in variables and platform.criterion(query.parse(f"{name}.Log8"), template):
                return f"{name}.Log8"
        except SierraError:
            continue
    return next((_around(name, template.find(path)[0].strip()) for name, path in variables.items()), None)


def _around(name: str, value: str) -> str:
    """A criterion with values around this one."""
    plain = re.fullmatch(r"(-?)0*(\d{1,6})(?:\.(\d{1,6}))?", value)
    if plain is None:
        return _or_word(name, value)
    sign, whole, places = plain[1], int(plain[2]), plain[3] or ""
    digits = int(f"{whole}{places}")
    if digits == 0:
        return f"{name}=0:1:5" if places else f"{name}=0,1,2"
    if not places and not sign and (name == "population_size" or whole <= 16):
        return f"{name}.Log8"
    half, same, twice = (_decimal(digits * times, len(places) + 1) for times in (5, 10, 20))
    return f"{name}={sign}{half},{sign}{same},{sign}{twice}"


def _decimal(digits: int, places: int) -> str:
    """Exactly `digits` / 10**`places`."""
    whole, rest = divmod(digits, 10**places)
    return f"{whole}" + (f".{rest:0{places}}".rstrip("0") if rest else "")


def _or_word(name: str, value: str) -> str:
    """A criterion of one value, as an example; VALUE where no query can name it."""
    if value.lower() in ("true", "false"):
        return f"{name}=true,false" if value.islower() else f"{name}=True,False"
    try:
        return query.text(query.parse(f"{name}={value}"))
    except QueryError:
        return f"{name}=VALUE"


# Source


def check_source(folder: Path, text: str) -> tuple[str, ...]:
    """Paths, as a shell splits them; none is all of the folder. Raises UsageError for what is not in the folder."""
    try:
        paths = [] if text == ALL else shlex.split(text)
    except ValueError as error:
        raise UsageError(f"source {text!r}: {error}") from error
    for path in paths:
        inside = os.path.normpath(path)
        if inside.startswith((os.pardir, os.sep)) or not (folder / path).exists():
            raise UsageError(f"source: there is no {path!r} in {folder}; name files and folders of it, as in: src sim.py")
    return tuple(os.path.normpath(path) for path in paths)


def _source(
    folder: Path, proposed: Sequence[str], left_out: Sequence[str], given: Sequence[str], ask: Ask | None
) -> tuple[str, ...]:
    if given:
        paths = check_source(folder, shlex.join(given))
        return () if ALL in paths else paths
    if not left_out or not proposed:
        return ()
    question = Question(
        f"source: the code that results depend on; {ALL} is all of this folder, new files too."
        f" {', '.join(left_out)} may be no code",
        (ALL, shlex.join(proposed)),
        ALL,
    )
    return _settled(None, question, ask, partial(check_source, folder), "")


def _code(folder: Path, template: str) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """What is here beside the template, and what of it hardly is code. Hidden files are not named."""
    own = {template, CONFIG, STORE, *LEFT_OUT}
    names = sorted(entry.name for entry in folder.iterdir() if not entry.name.startswith(".") and _is_utf8(entry.name))
    names = [name for name in names if name not in own and name.isprintable()]
    left_out = tuple(name for name in names if NO_CODE.fullmatch(name) and (folder / name).is_dir())
    return tuple(name for name in names if name not in left_out), left_out


# What is written, and said


def _lines(guess: Guess) -> Iterator[str]:
    yield "# What SIERRA runs. All that can be said here: sierra schema --toml"
    yield f"template = {_quoted(guess.template)}  # every run's input is made from it"
    if guess.platform != "command":
        yield f"platform = {_quoted(guess.platform)}  # knows how it is started, and where the seed goes"
    if guess.command:
        yield f"command = {_quoted(guess.command.text)}"
        yield "# {input} is the generated file; runs write into their working directory, {output}"
    if guess.seed:
        yield f"seed = {_quoted(guess.seed)}  # an XPath: where each run's seed goes"
    elif guess.platform == "command":
        yield '# seed = "//@seed"  # an XPath: where each run\'s seed goes'
    yield "runs = 10  # per experiment"
    yield ""
    yield "[variables]  # what queries vary: a name, and an XPath of what gets the value"
    for name, path in guess.variables.items():
        yield f"{name} = {_quoted(path)}"
    if not guess.variables and not guess.other_variables:
        yield '# population_size = "//swarm/@count"'
    for name, path in list(guess.other_variables.items())[:SHOWN]:
        yield f"# {name} = {_quoted(path)}"
    yield ""
    if guess.command and guess.command.environment:
        yield "[environment]"
        pairs = ", ".join(f"{name} = {_quoted(value)}" for name, value in guess.command.environment.items())
        yield f"set = {{ {pairs} }}"
        yield ""
    yield from _source_lines(guess)


def _source_lines(guess: Guess) -> Iterator[str]:
    if guess.source:
        yield "[source]  # the code that results depend on; a change of anything else makes no new runs"
        yield f"paths = {_listed(guess.source)}"
        return
    proposed = guess.proposed_source if 0 < len(guess.proposed_source) <= SHOWN else ("src", "sim.py")
    yield "# The code that results depend on is all of this folder, also files that are new in it, unless this names it:"
    yield "# [source]"
    yield f"# paths = {_listed(proposed)}" + (f"  # not {', '.join(guess.left_out)}" if guess.left_out else "")


def _listed(paths: Iterable[str]) -> str:
    return f"[{', '.join(map(_quoted, paths))}]"


def _quoted(text: str) -> str:
    """A TOML string; a literal one where that reads better."""
    if "'" not in text and ('"' in text or "\\" in text) and text.isprintable():
        return f"'{text}'"
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")


def _notes(
    folder: Path, platform: Platform, command: Command | None, seed: str | None, numbers: Mapping[str, str]
) -> Iterator[str]:
    if command is None and shutil.which(platform.command()[0]) is None:
        yield f"the program {platform.command()[0]!r} is not there; install it before it is to run"
    yield from command.doubts if command else ()
    in_command = command is not None and "{seed}" in command.text
    if seed is None and not in_command and not platform.seed_changes():
        yield 'all runs of an experiment are the same until the seed goes somewhere: seed = "XPATH", or {seed} in the command'
    others = [path for path in _seeds(numbers) if path != seed] if seed else []
    if others:
        yield f"these stay as they are in the template, in all runs: {_some(others)}"
    above = next((parent / CONFIG for parent in folder.resolve().parents if (parent / CONFIG).is_file()), None)
    if above:
        yield f"this folder was in the project of {above}; from now on it is one of its own"


# Helpers of all


def _settled(given: str | None, question: Question, ask: Ask | None, check: Callable[[str], T], missing: str) -> T:
    """What is given, or answered, or found, checked. Raises Missing, in the words of `missing`, where there is none."""
    if given is not None:
        return check(given)
    if ask is not None:
        return ask(question, check)
    if question.default is None:
        raise Missing(missing)
    return check(question.default)


def _matches(template: Template, path: str) -> bool:
    try:
        return bool(template.find(path))
    except (TemplateError, ConfigError):
        return False


def _files(folder: Path) -> list[Path]:
    return sorted(path for path in folder.iterdir() if path.is_file()) if folder.is_dir() else []


def _folders(folder: Path) -> list[Path]:
    """The folders here that may hold what a project is made of."""
    names = sorted(path.name for path in folder.iterdir() if path.is_dir() and os.access(path, os.R_OK | os.X_OK))
    return [folder / name for name in names if name[0] != "." and name not in LEFT_OUT and not NO_CODE.fullmatch(name)]


def _is_utf8(text: str) -> bool:
    try:
        text.encode()
    except UnicodeEncodeError:
        return False
    return True


def _some(names: Sequence[str]) -> str:
    return ", ".join(names[:SHOWN]) + (", ..." if len(names) > SHOWN else "")
