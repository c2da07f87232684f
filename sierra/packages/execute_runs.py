"""The program in a package that executes its runs again and compares the bytes of their outputs, without SIERRA.

It is one file that needs only the standard library (Python 3.8 or newer). `reproduce.py` starts it in an extracted package,
after it has verified all files:

    execute_runs.py PACKAGE WORK [--id ID] [--runs N | --seconds S] [--engine NAME] [--yes]

It reaches level 2 of 3: `worker.pyz`, which lies beside it, executes runs on this machine or in containers without network, in
a new folder of WORK. Then the SHA-256 of each output is compared with the recorded one. Nothing is executed before a question
is answered. Values and claims are not evaluated. If the bytes of an output may differ legitimately (a clock, a tolerance),
different bytes are not comparable at this level. The exit status is 0 if all outputs are identical, 1 if an output differs or a
run fails, 2 for wrong arguments, 3 if something that is needed is missing, if nothing was executed, or if outputs are not
comparable, and 130 after Ctrl-C.

`plan.json` has an object for each batch. `obstacle` is the reason why it cannot be executed here, or empty. Otherwise:

    jobs          the file with its runs; `of`: the number of all its runs, also of those that failed
    project       the folder with the code; `programs`: its executable files; `files`: further files, from other members
    beside        files that lie beside the inputs of all runs
    needs         programs of the machine; `requires`: Python packages, if runs are executed by this Python
    image         the container image, or null
    clients       for each container engine, the command that starts a container as SIERRA does: see `Client` and the marks
    environment   the variables that its runs share; `limits`, `success`: their limits and exit statuses
    by_value      the outputs whose bytes may differ, with the reason
    patterns      the patterns of outputs whose names may differ, except those in `named`

Each line of `jobs` is a run: `argv`, `environment` (the variables that differ from the shared ones; null removes one), `files`
(inputs), `folders` (marks in inputs, see `sierra.worker.job`), `seconds` (its recorded duration), `ended` (its recorded exit
status, negative for a signal, if it was no success), and `outputs` (the SHA-256 of each file). An input is a text in which each
character stands for a byte, or an object with the lines that differ from the same input of the line before. PROJECT_MARK and
PYTHON_MARK stand for paths of this machine, ARCH_MARK for its processor, and NUL for the folder of the run.
"""

from __future__ import annotations

import argparse
import base64
import contextlib
import fnmatch
import hashlib
import itertools
import json
import os
import re
import resource
import shlex
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from functools import cached_property
from pathlib import Path
from typing import Any, Callable, Iterable, Iterator, Mapping, NamedTuple, Sequence

FORMAT = "sierra execution 2"
PLAN = "plan.json"
PROJECT_MARK = "/@sierra-project@"
PYTHON_MARK = "@sierra-python@"
ARCH_MARK = "@sierra-arch@"
CONDUCTED = "\2"  # as in `sierra.worker.job`: the second word is a plan in JSON
STORE = ".sierra"
HASH = re.compile("[0-9a-f]{64}")
STDOUT = "stdout"  # the standard output of a run, in its folder and among its recorded outputs
IMAGES = "environment/images"  # the folder in a package that may have images, by id
ENGINES = ("podman", "apptainer")
HOST = "host"
INSIDE = "/run/sierra"  # in containers, as in sierra.containers.engines.base
IN_RUN = INSIDE + "/run"
IN_PROJECT = INSIDE + "/project"
# Marks in clients. Words of their own: options of the way to start containers here, and the run's command
WAY, COMMAND = "@sierra-way@", "@sierra-command@"
# In a word that is repeated for each variable of the run: its name and value
VARIABLE, VALUE = "sierra_variable", "@sierra-value@"
# In other words: the image, the folder with the project, and the folder of this program
IMAGE, SOURCE, HERE = "@sierra-image@", "@sierra-source@", "@sierra-here@"
MOST = re.compile("(--ulimit=(?:nofile|nproc)=)([0-9]+):[0-9]+")
POLL_S = 0.1
SHELL = 128  # what a shell adds to the number of the signal that has ended a program
SHOWN = 20  # runs that are printed
REPORTED = 10000  # runs that the report lists
REPORT = "reproduction.md"
WIDTH = 200  # characters of a text that are printed
IDENTICAL, DIFFERENT, FAILED, NOT_COMPARABLE = "identical", "different", "failed", "not comparable"


class Stop(Exception):
    """The reason why the program ends, in one line, and its exit status."""

    def __init__(self, reason: str, status: int) -> None:
        super().__init__(reason)
        self.status = status


def missing(reason: str) -> Stop:
    return Stop(reason, 3)


def clean(text: object) -> str:
    """Return a text that a package may have made, for the terminal: not a long line, without control characters."""
    line = str(text)
    return printable(line if len(line) <= WIDTH else line[:WIDTH] + "...")


def printable(text: str) -> str:
    """Return a text for the terminal: one line without control characters."""
    return "".join(one if one.isprintable() else "?" for one in text)


def is_safe(name: object) -> bool:
    """Check that a name is a relative path that stays inside its folder."""
    return isinstance(name, str) and name != "" and not name.startswith("/") and not {"", ".", ".."} & set(name.split("/"))


# Inputs as differences


def changes(before: str | None, text: str) -> str | dict[str, str]:
    """Return the lines, by number, in which a text differs from another one; the text if it has more or fewer lines."""
    old, new = (before or "").split("\n"), text.split("\n")
    if before is None or len(old) != len(new):
        return text
    return {str(number): line for number, (was, line) in enumerate(zip(old, new)) if was != line}


def changed(before: str | None, given: str | dict[str, str]) -> str:
    """Return the text that `changes` has described. Raises ValueError, KeyError or IndexError for another description."""
    if isinstance(given, str):
        return given
    if before is None:
        raise ValueError("there is no line before")
    lines = before.split("\n")
    for number, line in given.items():
        lines[int(number)] = line
    return "\n".join(lines)


# The plan


class Run(NamedTuple):
    """A line of a file with jobs."""

    run: str
    experiment: int
    number: int
    seconds: float
    argv: list[str]
    environment: dict[str, str]
    files: dict[str, bytes]
    folders: dict[str, str]
    outputs: dict[str, str]
    ended: int | None

    def called(self) -> str:
        return f"run {self.number} of experiment {self.experiment} ({clean(self.run)[:10]})"


class Client(NamedTuple):
    """The command that starts a container, with marks."""

    argv: list[str]
    environment: dict[str, str]
    inherits: str
    """A pattern of the names of this program's variables that the command also gets."""
    stop: list[str]
    ways: list[list[str]]
    """Options before any command of the engine, to try one after the other until a container starts."""

    @classmethod
    def read(cls, given: Mapping[str, Any]) -> Client:
        return cls(
            words_of(given["argv"]),
            texts_of(given["environment"]),
            re.compile(text_of(given["inherits"])).pattern,
            [text_of(word) for word in given["stop"]],
            [[text_of(word) for word in way] for way in given["ways"]],
        )


class Batch:
    """A batch that can be executed, from its object in the plan. Raises Stop if that is not valid."""

    def __init__(self, package: Path, plan: Mapping[str, Any]) -> None:
        self.package = package
        try:
            self.id = text_of(plan["batch"])
            self.of = int(plan["of"])
            self.project = text_of(plan["project"])
            self.jobs = text_of(plan["jobs"])
            self.environment = texts_of(plan["environment"])
            self.by_value = texts_of(plan["by_value"])
            self.patterns = [text_of(one) for one in plan.get("patterns", ())]
            self.named = {text_of(one) for one in plan.get("named", ())}
            self.programs = [text_of(one) for one in plan["programs"]]
            self.notes = [text_of(one) for one in plan["notes"]]
            self.requires = [text_of(one) for one in plan["requires"]]
            self.needs = [(text_of(one["name"]), text_of(one["version"])) for one in plan["needs"]]
            self.files, self.beside = (
                {name: self.taken(one) for name, one in plan[key].items()} for key in ("files", "beside")
            )
            self.limits = {text_of(name): limit_of(name, limit) for name, limit in plan["limits"].items()}
            self.success = [int(status) for status in plan["success"]]
            self.image = None if plan["image"] is None else texts_of(plan["image"])
            self.clients = {text_of(name): Client.read(one) for name, one in plan["clients"].items()}
        except (KeyError, TypeError, ValueError, AttributeError, re.error) as error:
            raise Stop(f"{PLAN}: a batch is not described as it should be: {clean(repr(error))}", 1) from None
        if not HASH.fullmatch(self.id):
            raise Stop(f"{PLAN}: {clean(repr(self.id))} is not the id of a batch", 1)
        for name in (self.project, self.jobs, *self.files, *self.beside):
            if not is_safe(name):
                raise Stop(f"{PLAN}: the name {clean(repr(name))} leads outside", 1)
        self.only: set[str] | None = None
        """The runs to execute; None for all."""

    @cached_property
    def has_stdout(self) -> bool:
        """True if standard output is an output of a run."""
        return any(STDOUT in run.outputs for run in self._all_runs())

    def pattern_of(self, path: str) -> int | None:
        """Return the number of the pattern to which an output belongs; None if its name is fixed."""
        matching = (place for place, pattern in enumerate(self.patterns) if fnmatch.fnmatchcase(path, pattern))
        return None if path in self.named else next(matching, None)

    def taken(self, plan: Mapping[str, Any]) -> tuple[str, bool]:
        """Return the name of a member, and True if it is a program."""
        if not is_safe(plan["member"]):
            raise ValueError(f"a member has the name {plan['member']!r}")
        return plan["member"], plan["program"] is True

    def runs(self) -> Iterator[Run]:
        """Yield the runs that are to be executed. Raises Stop for a line that is not valid."""
        return (run for run in self._all_runs() if self.only is None or run.run in self.only)

    def _all_runs(self) -> Iterator[Run]:
        before: dict[str, str] = {}
        with (self.package / self.jobs).open(encoding="utf-8", newline="\n") as file:
            for number, line in enumerate(file, 1):
                try:
                    found, before = read_run(line, before)
                except (KeyError, TypeError, ValueError, IndexError, AttributeError, ArithmeticError, RecursionError) as error:
                    raise Stop(f"{self.jobs}, line {number} is not a run: {clean(repr(error))}", 1) from None
                yield found


def read_run(line: str, before: Mapping[str, str]) -> tuple[Run, dict[str, str]]:
    """Return the run of a line, and its inputs as texts; `before`: those of the line before. Raises ValueError and others."""
    given = json.loads(line)
    texts = {name: changed(before.get(name), one) for name, one in given["files"].items()}
    if not all(map(is_safe, texts)) or not texts:
        raise ValueError("an input is outside the folder of the run")
    found = Run(
        text_of(given["run"]),
        int(given["experiment"]),
        int(given["number"]),
        float(given["seconds"]),
        words_of(given["argv"]),
        {text_of(name): one for name, one in given["environment"].items() if one is None or text_of(one) == one},
        {name: text.encode("latin-1") for name, text in texts.items()},
        texts_of(given.get("folders", {})),
        texts_of(given["outputs"]),
        None if given.get("ended") is None else int(given["ended"]),
    )
    return found, texts


def words_of(value: Any) -> list[str]:
    if not isinstance(value, list) or not value:
        raise TypeError(f"{value!r} is not a command")
    return [text_of(word) for word in value]


def text_of(value: Any) -> str:
    if not isinstance(value, str):
        raise TypeError(f"{value!r} is not a text")
    return value


def limit_of(name: str, value: Any) -> Any:
    """Return a limit of runs: a number, or what the marker is that may end them."""
    if name not in ("marker", "contains"):
        return float(value)
    if name == "marker" and not is_safe(text_of(value)):
        raise ValueError(f"the marker {value!r} leads outside")
    return text_of(value)


def texts_of(value: Any) -> dict[str, str]:
    return {text_of(name): text_of(one) for name, one in value.items()}


def read_plan(package: Path) -> tuple[list[Batch], list[str]]:
    """Return the batches that can be executed, and a line for each other one. Raises Stop if there is no valid plan."""
    path = package / "execution" / PLAN
    try:
        plan = json.loads(path.read_bytes())
        if plan["format"] != FORMAT:
            raise Stop(f"{PLAN} has the format {clean(repr(plan['format']))}, but this program reads {FORMAT!r}", 3)
        plans = [(one, text_of(one["batch"]), text_of(one["obstacle"])) for one in plan["batches"]]
    except OSError as error:
        raise missing(f"{path}: {error.strerror or error}") from None
    except (KeyError, TypeError, ValueError, RecursionError) as error:
        raise Stop(f"{PLAN} is not valid: {clean(repr(error))}", 1) from None
    obstacles = [f"batch {clean(batch)[:10]} needs level 3: {clean(reason)}" for _, batch, reason in plans if reason]
    return [Batch(package, one) for one, _, reason in plans if not reason], obstacles


def choose(batches: Sequence[Batch], runs: int | None, seconds: float | None) -> tuple[int, float]:
    """Choose the runs to execute; return their number, and how long they took before.

    `runs`: at most so many of each experiment. `seconds`: for so long at most, but at least one run. All experiments then get
    their first run before any gets its second one.
    """
    ranked = []
    for place, batch in enumerate(batches):
        ranks: dict[int, int] = {}
        for experiment, _, run, took_s in sorted((one.experiment, one.number, one.run, one.seconds) for one in batch.runs()):
            ranks[experiment] = rank = ranks.get(experiment, -1) + 1
            ranked.append((rank, place, experiment, run, took_s))
    ranked.sort()
    chosen: list[tuple[int, int, int, str, float]] = []
    took = 0.0
    for one in ranked:
        if (runs is not None and one[0] >= runs) or (seconds is not None and chosen and took + one[-1] > seconds):
            break
        chosen.append(one)
        took += one[-1]
    if len(chosen) < len(ranked):
        for place, batch in enumerate(batches):
            batch.only = {one[3] for one in chosen if one[1] == place}
    return len(chosen), took


# This machine and the containers


def filled(value: Any, marks: Mapping[str, str]) -> Any:
    """Return a value of JSON in which texts take the place of the marks."""
    if isinstance(value, str):
        for mark, text in marks.items():
            value = value.replace(mark, text)
        return value
    if isinstance(value, list):
        return [filled(one, marks) for one in value]
    if isinstance(value, dict):
        return {name: filled(one, marks) for name, one in value.items()}
    return value


def arch() -> str:
    """Return the name of this machine's processor, as Linux calls it."""
    return {"arm64": "aarch64", "amd64": "x86_64"}.get(os.uname().machine, os.uname().machine)


def command(argv: Sequence[str], marks: Mapping[str, str]) -> list[str]:
    """Return a command with the paths of this machine. The conductor itself replaces NUL in a plan for it."""
    if argv[0] == CONDUCTED and len(argv) > 1:
        plan = {mark: text for mark, text in marks.items() if mark != "\0"}
        return [CONDUCTED, json.dumps(filled(json.loads(argv[1]), plan)), *argv[2:]]
    return [filled(word, marks) for word in argv]


class Host:
    """Execution on this machine, without isolation."""

    name = HOST
    error = re.compile("(?!)")

    def __init__(self, batch: Batch) -> None:
        self.batch = batch

    def lacks(self) -> Iterator[str]:
        """Yield a line for each thing that is missing on this machine, with the remedy."""
        first = next(self.batch.runs(), None)
        words = " ".join(first.argv) if first else ""
        uses_own = PYTHON_MARK in words
        search = self.batch.environment.get("PATH")
        for name, version in self.batch.needs:
            there = shutil.which(name, path=search) or any(map(os.path.exists, re.findall(f"/[^ ]*/{re.escape(name)}", words)))
            if not there and not (uses_own and name.startswith("python")):
                yield f"{clean(name)} is not installed (recorded: {clean(version) or 'unknown version'})"
        if uses_own:
            yield from lacking_packages(self.batch.requires)

    def place(self) -> str:
        image = self.batch.image
        return "on this machine, without isolation" + (", although they were recorded in a container" if image else "")

    def job(self, run: Run, project: Path) -> dict[str, Any]:
        marks = {PROJECT_MARK: str(project), PYTHON_MARK: sys.executable, ARCH_MARK: arch()}
        environment = {name: filled(text, marks) for name, text in variables(self.batch, run).items()}
        environment.setdefault("PATH", os.environ.get("PATH", os.defpath))
        return {"argv": command(run.argv, marks), "environment": environment, "folders": filled(run.folders, marks)}


def lacking_packages(requires: Iterable[str]) -> Iterator[str]:
    """Yield a line for each Python package that is not installed for this Python. Versions are not compared."""
    from importlib import metadata

    for requirement in requires:
        name = re.split(r"[^A-Za-z0-9._-]", requirement)[0]
        try:
            metadata.version(name)
        except (metadata.PackageNotFoundError, ValueError):
            yield f"{sys.executable} has no package {clean(requirement)}; install it, or use another Python"


def variables(batch: Batch, run: Run) -> dict[str, str]:
    """Return the variables of a run, with marks."""
    every: dict[str, Any] = {**batch.environment, **run.environment}
    return {name: text for name, text in every.items() if text is not None}


class Container:
    """Execution in containers without network, one for each run: the part that engines share."""

    name = ""
    forms: tuple[str, ...] = ()
    """Endings of the image files in a package that this engine reads."""
    error = re.compile("(?!)")
    """The exit status and the last line of a container that the engine cannot start."""

    def __init__(self, batch: Batch) -> None:
        self.batch = batch
        self.image: dict[str, str] = batch.image or {}
        self.reference = ""
        """The engine's name of the image, once it is known."""

    def lacks(self) -> Iterator[str]:
        """Yield a line for each thing that is missing on this machine, with the remedy."""
        if not self.image:
            yield "the runs were recorded without a container image; use --engine host"
        elif self.name not in self.batch.clients:
            yield f"the package does not say how {self.name} starts a container"
        elif not shutil.which(self.name):
            yield f"{self.name} is not installed; install it, for example with apt-get install {self.name}"
        else:
            yield from self.without_image()

    def without_image(self) -> Iterator[str]:
        raise NotImplementedError

    def packed(self) -> Path | None:
        """Return the file of the image in the package; None if there is none."""
        name = self.image.get("id", "").replace(":", "-")
        paths = (self.batch.package / IMAGES / (name + form) for form in self.forms)
        return next((path for path in paths if is_safe(name) and path.is_file()), None)

    def place(self) -> str:
        return f"in {self.name} containers without network, image {clean(self.image.get('id', ''))}"

    def job(self, run: Run, project: Path) -> dict[str, Any]:
        marks = {PROJECT_MARK: IN_PROJECT, PYTHON_MARK: "python3", ARCH_MARK: arch(), "\0": IN_RUN}
        environment = {name: filled(text, marks) for name, text in variables(self.batch, run).items()}
        environment["TMPDIR"] = "/tmp"  # noqa: S108 - the container's own
        argv = command(run.argv, marks)
        job = {"argv": argv, "environment": environment, "folders": filled(run.folders, marks)}
        inside = argv[1:] if argv[0] == CONDUCTED else argv
        return {**job, "client": self.client(inside, environment, project), "shared": False}

    def client(self, argv: list[str], environment: Mapping[str, str], project: Path) -> dict[str, Any]:
        """Return the engine's command for a container, as SIERRA would start it. Raises Stop for an unusual folder."""
        recorded = self.batch.clients[self.name]
        own = {IMAGE: self.reference, SOURCE: str(project), HERE: str(Path(__file__).parent)}
        for folder in own.values():
            if '"' in folder or "\n" in folder:
                raise missing(f"{folder!r} cannot be mounted; use a folder whose path has neither quotes nor line feeds")

        def words(word: str) -> Iterable[str]:
            if word == WAY:
                return self.way()
            if word == COMMAND:
                return argv
            if VARIABLE in word:
                return (word.replace(VARIABLE, name).replace(VALUE, text) for name, text in environment.items())
            return [MOST.sub(allowed, str(filled(word, own)))]

        given = self.inherited()
        for name, text in recorded.environment.items():
            every = environment if VARIABLE in name else {"": ""}
            given.update({name.replace(VARIABLE, one): text.replace(VALUE, value) for one, value in every.items()})
        argv = list(itertools.chain.from_iterable(map(words, recorded.argv)))
        return {"argv": argv, "environment": given, "stop": recorded.stop}

    def inherited(self) -> dict[str, str]:
        """Return the variables of this program that the engine also gets."""
        pattern = self.batch.clients[self.name].inherits
        return {name: text for name, text in os.environ.items() if re.fullmatch(pattern, name)}

    def called(self, *words: str) -> subprocess.CompletedProcess[str]:
        """Execute a command of the engine, which may fail; its output is text."""
        return subprocess.run(
            [self.name, *words],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            env=self.inherited(),
            encoding="utf-8",
            errors="replace",
            check=False,
        )

    def way(self) -> Sequence[str]:
        """Return the options with which the engine starts containers here."""
        raise NotImplementedError


def allowed(option: re.Match[str]) -> str:
    """Return an option for a limit that this user may set: some systems do not allow as many open files or processes."""
    hard = resource.getrlimit(resource.RLIMIT_NOFILE if "nofile" in option.group(1) else resource.RLIMIT_NPROC)[1]
    most = int(option.group(2)) if hard == resource.RLIM_INFINITY else min(int(option.group(2)), hard)
    return f"{option.group(1)}{most}:{most}"


class Podman(Container):
    """Containers of podman. The image must be in its storage under its recorded id, or comes from the package."""

    name = "podman"
    forms = (".tar",)
    error = re.compile(r"125 Error: (.*)")

    def without_image(self) -> Iterator[str]:
        if self.image.get("kind") != "oci":
            yield "podman cannot run the image, which is only a file system; use --engine apptainer"
            return
        self.reference = self.image.get("id", "")
        file = self.packed()
        if not self.is_there() and file:
            said = self.called("load", "--quiet", "--input", str(file)).stdout
            if not self.is_there():
                yield f"podman cannot load {file.name}, or it is another image: {last_line(said)}"
        elif not file and not self.is_there():
            name = clean(shlex.quote(self.image.get("name", "")))
            hint = "ask its authors for a package with it (--image oci)" if name == "''" else f"try: podman pull {name}"
            yield f"podman has no image {clean(self.reference)}; {hint}"

    def is_there(self) -> bool:
        return self.called("image", "exists", self.reference).returncode == 0

    def way(self) -> Sequence[str]:
        if not hasattr(self, "_way"):
            ways = self.batch.clients[self.name].ways
            self._way: Sequence[str] = next((one for one in ways if not self.is_refused(one)), ())
        return self._way

    def is_refused(self, options: Sequence[str]) -> bool:
        """Check whether a container fails before its program, which does not exist, is looked for."""
        words = ["run", "--rm", "--pull=never", "--network=none", "--entrypoint=", self.reference, "/@nothing@"]
        return re.search(r"cgroup|controller|limit|permission denied", self.called(*options, *words).stdout) is not None


class Apptainer(Container):
    """Containers of apptainer, from a SIF or squashfs in the package."""

    name = "apptainer"
    forms = (".sif", ".sqfs")
    error = re.compile(r"255 FATAL: +(.*)")

    def without_image(self) -> Iterator[str]:
        file = self.packed()
        if file is None:
            yield "the package has no image for apptainer; use podman, or ask its authors for one (--image sif)"
        else:
            self.reference = str(file)

    def way(self) -> Sequence[str]:
        return ["unshare", "--map-root-user", "--"] if os.geteuid() and shutil.which("unshare") else []


def last_line(output: str) -> str:
    return clean((output.strip().splitlines() or [""])[-1])


def place_of(batch: Batch, engine: str | None) -> Any:
    """Return the place of execution: as requested, else the first engine that has all it needs, or this machine."""
    kinds: dict[str, Any] = {HOST: Host, Podman.name: Podman, Apptainer.name: Apptainer}
    wanted = [engine] if engine else list(ENGINES) if batch.image else [HOST]
    reasons = []
    for name in wanted:
        place = kinds[name](batch)
        lacks = list(place.lacks())
        if not lacks:
            return place
        reasons += lacks
    hint = "; without a container: --engine host" if batch.image and not engine else ""
    raise missing(f"batch {clean(batch.id)[:10]} cannot be executed here: {'; '.join(reasons)}{hint}")


# Execution


class Outcome(NamedTuple):
    """The result of one run."""

    run: Run
    verdict: str
    reason: str


def judged(place: Any, run: Run, end: Mapping[str, Any], folder: Path) -> Outcome:
    """Compare the outputs of a run that has ended with the recorded ones. Raises Stop if it could not be executed."""
    batch: Batch = place.batch
    if end.get("error") and run.ended is None:
        raise missing(f"{run.called()}: {end['error']}")
    trouble, last = trouble_of(batch, run, end), log_tail(folder)
    refused = place.error.match(f"{end.get('exit_code')} {last}")
    if refused:
        raise missing(f"{place.name} cannot start containers here: {refused.group(1)}")
    if trouble:
        return Outcome(run, FAILED, f"{trouble}: {last}")
    found = renamed(digests_of(batch, end, folder), run.outputs, batch)
    lost, new = sorted(run.outputs.keys() - found.keys()), sorted(found.keys() - run.outputs.keys())
    unlike = sorted(path for path in run.outputs.keys() & found.keys() if run.outputs[path] != found[path])
    certain = [path for path in unlike if path not in batch.by_value]
    reasons = [f"{path} is missing" for path in lost] + [f"{path} is new" for path in new]
    reasons += [f"{path} differs" for path in certain]
    if reasons:
        return Outcome(run, DIFFERENT, ", ".join(reasons))
    loose = [f"{path} differs at the byte level ({batch.by_value[path]}); level 3 compares values" for path in unlike]
    return Outcome(run, NOT_COMPARABLE, ", ".join(loose)) if loose else Outcome(run, IDENTICAL, "")


def digests_of(batch: Batch, end: Mapping[str, Any], folder: Path) -> dict[str, str]:
    """Return the digests of the files that a run left, with what it printed if that is an output of any run."""
    digests = {one["path"]: one["sha256"] for one in end["outputs"]}
    printed = (folder / STDOUT).read_bytes() if (folder / STDOUT).is_file() else b""
    if printed and batch.has_stdout and STDOUT not in digests:
        digests[STDOUT] = hashlib.sha256(printed).hexdigest()
    return digests


def renamed(found: Mapping[str, str], recorded: Mapping[str, str], batch: Batch) -> dict[str, str]:
    """Return the outputs that were found by the names of the recorded ones that they are compared with.

    Names that match a pattern may have the time of the run in them: such files are compared by the order of their names. If
    their number has changed, those with the same name are compared first.
    """
    names: dict[str, str] = {}
    for place in range(len(batch.patterns)):
        old, new = ([path for path in paths if batch.pattern_of(path) == place] for paths in (recorded, found))
        same = set(old) & set(new) if len(old) != len(new) else set()
        rest = (sorted((path for path in paths if path not in same), key=natural) for paths in (old, new))
        names.update({theirs: ours for ours, theirs in zip(*rest)})
    return {names.get(path, path): digest for path, digest in found.items()}


def natural(path: str) -> tuple[list[Any], str]:
    """Return a key that sorts names by the numbers in them."""
    parts = re.split(r"([0-9]+)", path)
    return [int(part) if place % 2 else part for place, part in enumerate(parts)], path


def trouble_of(batch: Batch, run: Run, end: Mapping[str, Any]) -> str:
    """Return why a run has failed; "" if it has not, or if it has ended with the same error as before."""
    if run.ended is not None:
        return "" if run.ended in both_numbers(end) else f"{ended_with(end)}, and not {status_words(run.ended)} as before"
    if end.get("stopped"):
        return f"stopped: {end['stopped']}"
    if end.get("after_marker") is not None:
        return ""
    if end.get("signal"):
        return "" if -end["signal"] in batch.success else f"ended by signal {end['signal']}"
    return "" if end.get("exit_code") in batch.success else f"exit status {end.get('exit_code')}"


def both_numbers(end: Mapping[str, Any]) -> Sequence[int]:
    """Return the exit statuses that an end can have: of a signal, also that of a shell or a container's engine."""
    if end.get("stopped") or end.get("after_marker") is not None:
        return ()
    if end.get("signal"):
        return (-end["signal"], SHELL + end["signal"])
    status = int(end.get("exit_code") or 0)
    return (status, SHELL - status) if status > SHELL else (status,)


def status_words(status: int) -> str:
    return f"signal {-status}" if status < 0 else f"exit status {status}"


def ended_with(end: Mapping[str, Any]) -> str:
    numbers = both_numbers(end)
    return status_words(numbers[0]) if numbers else f"stopped: {end.get('stopped') or 'after its marker'}"


def log_tail(folder: Path) -> str:
    """Return the last line of a run's standard error."""
    try:
        with (folder / "stderr").open("rb") as file:
            file.seek(max(0, os.fstat(file.fileno()).st_size - 4096))
            return last_line(file.read().decode("utf-8", "replace"))
    except OSError:
        return ""


class Execution:
    """The execution of a batch in a new folder."""

    def __init__(self, batch: Batch, place: Any, folder: Path, slots: int) -> None:
        self.batch = batch
        self.place = place
        self.folder = folder
        self.slots = slots
        self.pending: dict[str, Run] = {}
        self.trouble: BaseException | None = None
        self.session = hashlib.sha256(os.urandom(16)).hexdigest()

    def outcomes(self) -> Iterator[Outcome]:
        """Execute all runs, and yield the outcome of each. Raises Stop if the worker cannot continue."""
        prepare(self.batch, self.folder)
        runs = self.folder / "runs"
        runs.mkdir()
        worker = str(self.batch.package / "execution" / "worker.pyz")
        words = [sys.executable, "-I", "-S", worker, str(runs), str(self.slots), str(self.folder / "journal.jsonl")]
        environment = {**os.environ, "SIERRA_SESSION": self.session}
        with (self.folder / "worker.log").open("wb") as log:
            process = subprocess.Popen(words, stdin=subprocess.PIPE, stderr=log, env=environment, start_new_session=True)
        feeder = threading.Thread(target=self.feed, args=(process,), daemon=True)
        feeder.start()
        try:
            yield from self.ended(process, runs)
        except BaseException:
            process.terminate()
            raise
        finally:
            feeder.join()
            process.wait()
        if isinstance(self.trouble, Stop):
            raise self.trouble
        if self.trouble or process.returncode or self.pending:
            log_text = (self.folder / "worker.log").read_text("utf-8", "replace")
            raise missing(f"not all runs were executed: {clean(self.trouble or '') or last_line(log_text)}")

    def feed(self, process: subprocess.Popen[bytes]) -> None:
        """Send all jobs, and hold the pipe open until the worker has ended."""
        pipe = process.stdin
        assert pipe is not None  # noqa: S101 - it was requested
        try:
            for run in self.batch.runs():
                self.pending[run.run] = run
                pipe.write(json.dumps(self.job(run)).encode() + b"\n")
            pipe.write(b'{"end": true}\n')
            pipe.flush()
            process.wait()
        except BrokenPipeError:
            pass  # the worker's log has the reason
        except BaseException as error:
            self.trouble = error
        finally:
            with contextlib.suppress(OSError):
                pipe.close()

    def job(self, run: Run) -> dict[str, Any]:
        """Return the line of a run for the worker."""
        execution = hashlib.sha256((f"{self.session} {run.run}").encode()).hexdigest()
        job: dict[str, Any] = self.place.job(run, self.folder / "project")
        own = {"SIERRA_SESSION": self.session, "SIERRA_EXECUTION": execution}
        job["environment"].update(own)
        if "client" in job:
            job["client"]["environment"].update(own)
        job.update(run=run.run, execution=execution, limits=self.batch.limits)
        job["files"] = {name: base64.b64encode(content).decode() for name, content in run.files.items()}
        if not job["folders"]:
            del job["folders"]
        if self.batch.beside:
            job["beside"] = str(self.folder / "beside")
        return job

    def ended(self, process: subprocess.Popen[bytes], runs: Path) -> Iterator[Outcome]:
        """Yield the outcome of each run that has ended, until the worker has ended. Folders of identical runs are removed."""
        for event in events(self.folder / "journal.jsonl", lambda: process.poll() is None):
            run = self.pending.pop(str(event.get("run")), None) if event.get("event") == "end" else None
            if run is not None:
                folder = runs / Path(event["directory"]).name
                outcome = judged(self.place, run, event, folder)
                if outcome.verdict == IDENTICAL:
                    shutil.rmtree(str(folder), ignore_errors=True)
                yield outcome


def events(path: Path, is_growing: Callable[[], bool]) -> Iterator[dict[str, Any]]:
    """Yield the events of a journal, until it does not grow any more."""
    place, more = 0, True
    while more:
        more = is_growing()  # before reading: what it has written by now is read
        if path.exists():
            with path.open("rb") as file:
                file.seek(place)
                for line in file:
                    if line.endswith(b"\n"):
                        place += len(line)
                        yield json.loads(line)
        if more:
            time.sleep(POLL_S)


def prepare(batch: Batch, folder: Path) -> None:
    """Make the folder with a copy of the project, the files that runs need in it, and those beside their inputs."""
    project = folder / "project"
    shutil.copytree(str(batch.package / batch.project), str(project), ignore=without_store(batch.package / batch.project))
    for name in batch.programs:
        if is_safe(name) and (project / name).is_file():
            (project / name).chmod(0o755)
    for target, files in ((project, batch.files), (folder / "beside", batch.beside)):
        for name, (member, is_program) in files.items():
            (target / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(str(batch.package / member), str(target / name))
            (target / name).chmod(0o755 if is_program else 0o644)


def without_store(root: Path) -> Callable[[str, list[str]], list[str]]:
    """Return the function that leaves out the store when a project is copied."""
    return lambda folder, names: [STORE] if Path(folder) == root and STORE in names else []


def new_folder(work: Path) -> Path:
    """Make and return a folder for this execution. Raises Stop if nothing can be written there."""
    try:
        work.mkdir(parents=True, exist_ok=True)
        for number in itertools.count(1):
            with contextlib.suppress(FileExistsError):
                made = work / (f"level-2-{number}")
                made.mkdir()
                return made
    except OSError as error:
        raise missing(f"cannot write to {work} ({error.strerror}); name another folder by --work FOLDER") from None
    raise AssertionError


def cores() -> int:
    """Return the number of runs to execute at a time."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


# The command


def ask(lines: Iterable[str], yes: bool) -> None:
    """Print what would be executed, and ask. Raises Stop unless the answer is yes."""
    for line in lines:
        print(line)
    if yes:
        return
    if not sys.stdin.isatty():
        raise missing("nothing was executed: nobody can be asked here; give --yes to execute the runs")
    if input("Execute them? [y/N] ").strip().lower() not in ("y", "yes"):
        raise missing("nothing was executed")


def proposal(batches: Sequence[Batch], places: Sequence[Any], count: int, seconds: float, slots: int) -> Iterator[str]:
    """Yield the lines that say what would be executed."""
    estimate = max(seconds / slots, max((seconds / count if count else 0), 1))
    yield f"Level 2 executes {count} runs, {slots} at a time: about {duration(estimate)} by their recorded durations."
    for batch, place in zip(batches, places):
        first = next(batch.runs(), None)
        yield f"batch {clean(batch.id)[:10]}: {place.place()}"
        if first is not None:
            words = json.loads(first.argv[1])["argv"] if first.argv[0] == CONDUCTED else first.argv
            marks = {PROJECT_MARK: "project", PYTHON_MARK: "python3", ARCH_MARK: arch(), "\0": "run"}
            yield "  first command: " + clean(" ".join(shlex.quote(filled(str(word), marks)) for word in words))
        yield from (f"  note: {clean(note)}" for note in batch.notes)
    if any(place.name == HOST for place in places):
        yield "These are programs of the package. On this machine they can do everything that you can."
    else:
        yield "The containers isolate the runs. execution/ of the package, whose programs start them, is not isolated."


def duration(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 120 else f"{seconds / 60:.0f} min"


def execute(
    package: Path, identity: str, work: Path, runs: int | None, seconds: float | None, engine: str | None, yes: bool
) -> int:
    """Execute runs of a package and print the verdicts; return the exit status."""
    batches, obstacles = read_plan(package)
    for line in obstacles:
        print(line)
    if not batches:
        raise missing("no batch of the package can be executed without SIERRA")
    slots = cores()
    count, took = choose(batches, runs, None if seconds is None else seconds * slots)
    batches = [batch for batch in batches if batch.only is None or batch.only]
    places = [place_of(batch, engine) for batch in batches]
    of = sum(batch.of for batch in batches)
    ask(proposal(batches, places, count, took, slots), yes)
    folder = new_folder(work)
    began = time.time()
    counts = dict.fromkeys((IDENTICAL, DIFFERENT, FAILED, NOT_COMPARABLE), 0)
    unlike = 0
    faults: list[str] = []
    for batch, place in zip(batches, places):
        within = folder / batch.id[:12]
        within.mkdir()
        for outcome in Execution(batch, place, within, slots).outcomes():
            counts[outcome.verdict] += 1
            unlike += outcome.verdict != IDENTICAL
            if outcome.verdict != IDENTICAL and unlike <= REPORTED:
                faults.append(f"{outcome.verdict}: {outcome.run.called()}: {clean(outcome.reason)}")
                if unlike <= SHOWN:
                    print(faults[-1])
    verdict = verdict_of(counts, of)
    lines = (*(f"batch {clean(one.id)[:10]}: {where.place()}" for one, where in zip(batches, places)), *obstacles)
    print(verdict)
    try:
        write_report(work / REPORT, identity, verdict, lines, faults, unlike, began)
        print(f"The report is {work / REPORT}")
    except OSError as error:
        print(f"The report {work / REPORT} cannot be written: {error.strerror}")
    return concluded(counts, folder, obstacles)


def verdict_of(counts: Mapping[str, int], of: int) -> str:
    said = ", ".join(f"{count} {verdict}" for verdict, count in counts.items() if count)
    return f"LEVEL 2: {sum(counts.values())} of {of} runs executed again: {said or 'nothing'}"


def write_report(
    path: Path, package: str, verdict: str, lines: Sequence[str], faults: Sequence[str], unlike: int, began: float
) -> None:
    """Write the verdict, the package's id, the machine, the time and each difference as Markdown, to attach to a review."""
    system = os.uname()
    shown = [
        "# Reproduction without SIERRA",
        "",
        f"**{marked(verdict)}**",
        "",
        f"- package: `{package}`",
        f"- machine: {system.sysname} {system.release}, {arch()}, {cores()} cores, Python {sys.version.split()[0]}",
        f"- began: {time.strftime('%Y-%m-%d %H:%M:%S', time.gmtime(began))} UTC, and took {duration(time.time() - began)}",
        *(f"- {marked(line)}" for line in lines),
        "",
        "Level 2 of 3 compares the bytes of all outputs. It evaluates neither values within tolerances nor claims.",
    ]
    if faults:
        shown += ["", "## Differences", "", *(f"- {marked(fault)}" for fault in faults)]
    if unlike > len(faults):
        shown.append(f"- and {unlike - len(faults)} more")
    with tempfile.NamedTemporaryFile("w", encoding="utf-8", dir=str(path.parent), delete=False) as file:
        file.write("\n".join(shown) + "\n")
    Path(file.name).replace(path)  # never written through a link that came with the package


def marked(text: str) -> str:
    """Return a text without marks of Markdown and HTML."""
    return "".join("\\" + sign if sign in "\\`*_[]<>|#~" else sign for sign in text)


def concluded(counts: Mapping[str, int], folder: Path, obstacles: Sequence[str]) -> int:
    """Print what the verdict means; return the exit status."""
    total = sum(counts.values())
    if counts[IDENTICAL] < total:
        print(f"The folders of the other runs are in {folder}")
    else:
        shutil.rmtree(str(folder), ignore_errors=True)
    print("Level 2 of 3 reached: bytes were compared. Values and claims: can't tell; level 3 evaluates them.")
    if counts[DIFFERENT] or counts[FAILED]:
        return 1
    return 3 if counts[NOT_COMPARABLE] or obstacles or not total else 0


def parsed(arguments: Sequence[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="execute_runs.py", description="Execute the runs of a package, and compare bytes.")
    parser.add_argument("package", type=Path, metavar="PACKAGE", help="folder of an extracted package that was verified")
    parser.add_argument("work", type=Path, metavar="WORK", help="folder to write to")
    parser.add_argument("--id", default="unknown", help="id of the package, for the report")
    parser.add_argument("--runs", type=int, metavar="N", help="only the first N runs of each experiment")
    parser.add_argument("--seconds", type=float, metavar="S", help="only as many runs as fit into this time")
    parser.add_argument("--engine", choices=(HOST, *ENGINES), help="where runs are executed")
    parser.add_argument("--yes", action="store_true", help="execute without asking")
    return parser.parse_args(arguments)


def main(arguments: Sequence[str]) -> int:
    given = parsed(arguments)
    try:
        package, work = given.package.absolute(), given.work.absolute()
        status = execute(package, given.id, work, given.runs, given.seconds, given.engine, given.yes)
        sys.stdout.flush()
        return status
    except Stop as stop:
        reason, status = str(stop), stop.status
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        return 1
    except OSError as error:
        reason, status = f"{error.filename or 'a file'}: {error.strerror or error}", 3
    except (KeyboardInterrupt, EOFError):
        reason, status = "interrupted", 130
    print(f"reproduce.py: {printable(reason)}", file=sys.stderr)
    return status


if __name__ == "__main__":
    sys.stdout.reconfigure(line_buffering=True, errors="backslashreplace")  # type: ignore[union-attr]
    sys.exit(main(sys.argv[1:]))
