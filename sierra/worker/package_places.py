"""The places in which the runs of a reproduction package can be executed: this machine, and containers without network."""

from __future__ import annotations

import itertools
import json
import os
import re
import resource
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any, Callable, Iterable, Iterator, Mapping, Sequence, Union

from sierra.worker.devices import CDI_MARK, requested
from sierra.worker.job import CONDUCTED
from sierra.worker.package_plan import ARCH_MARK, EXECUTION, PROJECT_MARK, PYTHON_MARK, Batch, Run, is_safe, missing
from sierra.worker.reproduce import ENGINES, HOST, clean

IMAGES = "environment/images"  # the folder in a package that may have images, by id
INSIDE = "/run/sierra"  # in containers, as in sierra.containers.engines.base
IN_RUN = INSIDE + "/run"
IN_PROJECT = INSIDE + "/project"
# Marks in clients. Words of their own: options of the way to start containers here, and the run's command
WAY, COMMAND = "@sierra-way@", "@sierra-command@"
# In a word that is repeated for each variable of the run: its name and value
VARIABLE, VALUE = "sierra_variable", "@sierra-value@"
# In other words: the image, the folder with the project, and the folder of the worker
IMAGE, SOURCE, HERE = "@sierra-image@", "@sierra-source@", "@sierra-here@"
MOST = re.compile("(--ulimit=(?:nofile|nproc)=)([0-9]+):[0-9]+")


def filled(value: Any, marks: Mapping[str, str]) -> Any:
    """Return a value of JSON in which texts take the place of the marks."""
    if isinstance(value, str):
        for mark, text in marks.items():
            value = value.replace(mark, text)
        return value
    if isinstance(value, list):
        return [filled(element, marks) for element in value]
    if isinstance(value, dict):
        return {name: filled(element, marks) for name, element in value.items()}
    return value


def arch() -> str:
    """Return the name of this machine's processor, as Linux calls it."""
    return {"arm64": "aarch64", "amd64": "x86_64"}.get(os.uname().machine, os.uname().machine)


def last_line(output: str) -> str:
    return clean((output.strip().splitlines() or [""])[-1])


def job_of(batch: Batch, run: Run, marks: dict[str, str]) -> dict[str, Any]:
    """Return the command, the environment and the folders of a run, with these texts in the place of the marks."""
    marks = {**marks, ARCH_MARK: arch()}
    environment: dict[str, Any] = {**batch.environment, **run.environment}
    if "gpus" in batch.limits:
        environment.update(requested(environment, batch.limits["gpus"]))
    return {
        "argv": command(run.argv, marks),
        "environment": {name: filled(text, marks) for name, text in environment.items() if text is not None},
        "folders": filled(run.folders, marks),
    }


def shown_command(run: Run) -> str:
    """Return the command of a run for the terminal, with names in the place of the marks."""
    words = json.loads(run.argv[1])["argv"] if run.argv[0] == CONDUCTED else run.argv
    marks = {PROJECT_MARK: "project", PYTHON_MARK: "python3", ARCH_MARK: arch(), "\0": "run"}
    return clean(" ".join(shlex.quote(filled(str(word), marks)) for word in words))


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

    def description(self) -> str:
        image = self.batch.image
        return "on this machine, without isolation" + (", although they were recorded in a container" if image else "")

    def job(self, run: Run, project: Path) -> dict[str, Any]:
        """Return the job of a run, whose project is in this folder."""
        job = job_of(self.batch, run, {PROJECT_MARK: str(project), PYTHON_MARK: sys.executable})
        job["environment"].setdefault("PATH", os.environ.get("PATH", os.defpath))
        return job


def lacking_packages(requires: Iterable[str]) -> Iterator[str]:
    """Yield a line for each Python package that is not installed for this Python. Versions are not compared."""
    from importlib import metadata

    for requirement in requires:
        name = re.split(r"[^A-Za-z0-9._-]", requirement)[0]
        try:
            metadata.version(name)
        except (metadata.PackageNotFoundError, ValueError):
            yield f"{sys.executable} has no package {clean(requirement)}; install it, or use another Python"


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
        if not self.image:
            yield "the runs were recorded without a container image; use --engine host"
        elif self.name not in self.batch.clients:
            yield f"the package does not say how {self.name} starts a container"
        elif not shutil.which(self.name):
            yield f"{self.name} is not installed; install it, for example with apt-get install {self.name}"
        else:
            yield from self.without_image()

    def without_image(self) -> Iterator[str]:
        """Yield the reason why the engine cannot use the image, if there is one."""
        raise NotImplementedError

    def packed(self) -> Path | None:
        """Return the file of the image in the package; None if there is none."""
        name = self.image.get("id", "").replace(":", "-")
        paths = (self.batch.package / IMAGES / (name + form) for form in self.forms)
        return next((path for path in paths if is_safe(name) and path.is_file()), None)

    def description(self) -> str:
        return f"in {self.name} containers without network, image {clean(self.image.get('id', ''))}"

    def job(self, run: Run, project: Path) -> dict[str, Any]:
        """Return the job of a run, whose project is in this folder of the host."""
        job = job_of(self.batch, run, {PROJECT_MARK: IN_PROJECT, PYTHON_MARK: "python3", "\0": IN_RUN})
        job["environment"]["TMPDIR"] = "/tmp"  # noqa: S108 - the container's own
        inside = job["argv"][1:] if job["argv"][0] == CONDUCTED else job["argv"]
        return {**job, "client": self.client(inside, job["environment"], project), "shared": False}

    def client(self, argv: list[str], environment: Mapping[str, str], project: Path) -> dict[str, Any]:
        """Return the engine's command for a container, as SIERRA would start it. Raises Stop for an unusual folder."""
        recorded = self.batch.clients[self.name]
        own = {IMAGE: self.reference, SOURCE: str(project), HERE: str(self.batch.package / EXECUTION)}
        for folder in own.values():
            if '"' in folder or "\n" in folder:
                raise missing(f"{folder!r} cannot be mounted; use a folder whose path has neither quotes nor line feeds")

        def words(word: str) -> Iterable[str]:
            if word == WAY:
                return self.way()
            if word == COMMAND:
                return argv
            if word.endswith(CDI_MARK) and "gpus" not in self.batch.limits:
                return ()  # this machine has no GPU
            if VARIABLE in word:
                return (word.replace(VARIABLE, name).replace(VALUE, text) for name, text in environment.items())
            return [MOST.sub(allowed, str(filled(word, own)))]

        given = self.inherited()
        for name, text in recorded.environment.items():
            every = environment if VARIABLE in name else {"": ""}
            given.update({name.replace(VARIABLE, variable): text.replace(VALUE, value) for variable, value in every.items()})
        return {
            "argv": list(itertools.chain.from_iterable(map(words, recorded.argv))),
            "environment": given,
            "stop": recorded.stop,
        }

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
            printed = self.called("load", "--quiet", "--input", str(file)).stdout
            if not self.is_there():
                yield f"podman cannot load {file.name}, or it is another image: {last_line(printed)}"
        elif not file and not self.is_there():
            name = clean(shlex.quote(self.image.get("name", "")))
            hint = "ask its authors for a package with it (--image oci)" if name == "''" else f"try: podman pull {name}"
            yield f"podman has no image {clean(self.reference)}; {hint}"

    def is_there(self) -> bool:
        return self.called("image", "exists", self.reference).returncode == 0

    def way(self) -> Sequence[str]:
        if not hasattr(self, "_way"):
            ways = self.batch.clients[self.name].ways
            self._way: Sequence[str] = next((options for options in ways if not self.is_refused(options)), ())
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


Place = Union[Host, Container]


def place_of(batch: Batch, engine: str | None) -> Place:
    """Return the place of execution: as requested, else the first engine that has all it needs, or this machine."""
    kinds: dict[str, Callable[[Batch], Place]] = {HOST: Host, Podman.name: Podman, Apptainer.name: Apptainer}
    names = [engine] if engine else list(ENGINES) if batch.image else [HOST]
    reasons: list[str] = []
    for executor in (kinds[name](batch) for name in names):
        lacks = list(executor.lacks())
        if not lacks:
            return executor
        reasons += lacks
    hint = "; without a container: --engine host" if batch.image and not engine else ""
    raise missing(f"batch {clean(batch.id)[:10]} cannot be executed here: {'; '.join(reasons)}{hint}")
