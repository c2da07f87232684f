"""The plan of a reproduction package: the batches and runs that can be executed without SIERRA.

`plan.json` has an object for each batch. `obstacle` is the reason why it cannot be executed here, or empty. Otherwise:

    jobs          the file with its runs; `of`: the number of all its runs, also of those that failed
    project       the folder with the code; `programs`: its executable files; `files`: further files, from other members
    beside        files that lie beside the inputs of all runs
    needs         programs of the machine; `requires`: Python packages, if runs are executed by this Python
    image         the container image, or null
    clients       for each container engine, the command that starts a container as SIERRA does: see `Client` and the marks
    environment   the variables that its runs share; `limits`, `success`: their largest limits, and exit statuses
    by_value      the outputs whose bytes may differ, with the reason
    patterns      the patterns of outputs whose names may differ, except those in `named`

Each line of `jobs` is a run: `argv`, `environment` (the variables that differ from the shared ones; null removes one), `files`
(inputs), `folders` (marks in inputs, see `sierra.worker.job`), `limits` (those that differ from the largest ones), `seconds`
(its recorded duration), `ended` (its recorded exit status, negative for a signal, if it was no success), and `outputs` (the
SHA-256 of each file). An input is a text in which each character stands for a byte, or an object with the lines that differ
from the same input of the line before. PROJECT_MARK and PYTHON_MARK stand for paths of this machine, ARCH_MARK for its
processor, and NUL for the folder of the run.
"""

from __future__ import annotations

import fnmatch
import json
import re
from functools import cached_property
from pathlib import Path
from typing import Any, Iterator, Mapping, NamedTuple, Sequence

from sierra.worker.layout import LOGS
from sierra.worker.reproduce import Stop, clean

FORMAT = "sierra execution 2"
MOST_GPUS = 1024
EXECUTION = "execution"
PLAN = "plan.json"
PROJECT_MARK = "/@sierra-project@"
PYTHON_MARK = "@sierra-python@"
ARCH_MARK = "@sierra-arch@"
STDOUT = LOGS[0]  # the standard output of a run, in its folder and among its recorded outputs
HASH = re.compile("[0-9a-f]{64}")


def missing(reason: str) -> Stop:
    return Stop(reason, 3)


def is_safe(name: object) -> bool:
    """Check that a name is a relative path that stays inside its folder."""
    return isinstance(name, str) and name != "" and not name.startswith("/") and not {"", ".", ".."} & set(name.split("/"))


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
    limits: dict[str, Any]

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
            list_of(given["stop"]),
            list(map(list_of, given["ways"])),
        )


class Batch:
    """A batch that can be executed, from its object in the plan. Raises Stop if that is not valid."""

    def __init__(self, package: Path, plan: Mapping[str, Any]) -> None:
        self.package = package
        try:
            self.id, self.project, self.jobs = (text_of(plan[key]) for key in ("batch", "project", "jobs"))
            self.of = int(plan["of"])
            self.environment, self.by_value = (texts_of(plan[key]) for key in ("environment", "by_value"))
            self.patterns, self.named = (list_of(plan.get(key, ())) for key in ("patterns", "named"))
            self.programs, self.notes, self.requires = (list_of(plan[key]) for key in ("programs", "notes", "requires"))
            self.needs = [(text_of(need["name"]), text_of(need["version"])) for need in plan["needs"]]
            self.files, self.beside = (
                {name: member_of(file) for name, file in plan[key].items()} for key in ("files", "beside")
            )
            self.limits = limits_of(plan["limits"])
            self.success = [int(status) for status in plan["success"]]
            self.image = None if plan["image"] is None else texts_of(plan["image"])
            self.clients = {text_of(name): Client.read(client) for name, client in plan["clients"].items()}
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
        matching = (number for number, pattern in enumerate(self.patterns) if fnmatch.fnmatchcase(path, pattern))
        return None if path in self.named else next(matching, None)

    def runs(self) -> Iterator[Run]:
        """Yield the runs that are to be executed. Raises Stop for a line that is not valid."""
        return (run for run in self._all_runs() if self.only is None or run.run in self.only)

    def _all_runs(self) -> Iterator[Run]:
        before: dict[str, str] = {}
        with (self.package / self.jobs).open(encoding="utf-8", newline="\n") as file:
            for number, line in enumerate(file, 1):
                try:
                    run, before = read_run(line, before)
                except (KeyError, TypeError, ValueError, IndexError, AttributeError, ArithmeticError, RecursionError) as error:
                    raise Stop(f"{self.jobs}, line {number} is not a run: {clean(repr(error))}", 1) from None
                yield run


def read_run(line: str, before: Mapping[str, str]) -> tuple[Run, dict[str, str]]:
    """Return the run of a line, and its inputs as texts; `before`: those of the line before. Raises ValueError and others."""
    given = json.loads(line)
    texts = {name: changed(before.get(name), text) for name, text in given["files"].items()}
    if not all(map(is_safe, texts)) or not texts:
        raise ValueError("an input is outside the folder of the run")
    run = Run(
        text_of(given["run"]),
        int(given["experiment"]),
        int(given["number"]),
        float(given["seconds"]),
        words_of(given["argv"]),
        {text_of(name): text for name, text in given["environment"].items() if text is None or text_of(text) == text},
        {name: text.encode("latin-1") for name, text in texts.items()},
        texts_of(given.get("folders", {})),
        texts_of(given["outputs"]),
        None if given.get("ended") is None else int(given["ended"]),
        limits_of(given.get("limits", {})),
    )
    return run, texts


def text_of(value: Any) -> str:
    if not isinstance(value, str):
        raise TypeError(f"{value!r} is not a text")
    return value


def list_of(value: Any) -> list[str]:
    return list(map(text_of, value))


def words_of(value: Any) -> list[str]:
    if not isinstance(value, list) or not value:
        raise TypeError(f"{value!r} is not a command")
    return list_of(value)


def texts_of(value: Any) -> dict[str, str]:
    return {text_of(name): text_of(text) for name, text in value.items()}


def limits_of(value: Any) -> dict[str, Any]:
    return {text_of(name): limit_of(name, limit) for name, limit in value.items()}


def limit_of(name: str, value: Any) -> Any:
    """Return a limit of runs: a number, or what the marker is that may end them."""
    if name == "gpus" and not 0 < float(value) <= MOST_GPUS:
        raise ValueError(f"{value!r} is no number of GPUs")
    if name == "cores":
        return int(value)
    if name not in ("marker", "contains"):
        return float(value)
    if name == "marker" and not is_safe(text_of(value)):
        raise ValueError(f"the marker {value!r} leads outside")
    return text_of(value)


def member_of(file: Mapping[str, Any]) -> tuple[str, bool]:
    """Return the name of the member that has a file, and True if it is a program."""
    if not is_safe(file["member"]):
        raise ValueError(f"a member has the name {file['member']!r}")
    return file["member"], file["program"] is True


def read_plan(package: Path) -> tuple[list[Batch], list[str]]:
    """Return the batches that can be executed, and a line for each other one. Raises Stop if there is no valid plan."""
    path = package / EXECUTION / PLAN
    try:
        plan = json.loads(path.read_bytes())
        if plan["format"] != FORMAT:
            raise Stop(f"{PLAN} has the format {clean(repr(plan['format']))}, but this program reads {FORMAT!r}", 3)
        plans = [(batch, text_of(batch["batch"]), text_of(batch["obstacle"])) for batch in plan["batches"]]
    except OSError as error:
        raise missing(f"{path}: {error.strerror or error}") from None
    except (KeyError, TypeError, ValueError, RecursionError) as error:
        raise Stop(f"{PLAN} is not valid: {clean(repr(error))}", 1) from None
    obstacles = [f"batch {clean(batch)[:10]} needs level 3: {clean(reason)}" for _, batch, reason in plans if reason]
    return [Batch(package, batch) for batch, _, reason in plans if not reason], obstacles


def choose(batches: Sequence[Batch], most: int | None, seconds: float | None) -> tuple[int, float]:
    """Set `Batch.only` to the runs to execute, unless these are all; return their number, and how long they took before.

    `most`: at most so many of each experiment. `seconds`: for so long at most, but at least one run. All experiments then get
    their first run before any gets its second one.
    """
    ranked = []
    for position, batch in enumerate(batches):
        ranks: dict[int, int] = {}
        for experiment, _, id, run_s in sorted((run.experiment, run.number, run.run, run.seconds) for run in batch.runs()):
            ranks[experiment] = rank = ranks.get(experiment, -1) + 1
            ranked.append((rank, position, experiment, id, run_s))
    ranked.sort()
    chosen: list[set[str]] = [set() for _ in batches]
    count, total_s = 0, 0.0
    for rank, position, _, id, run_s in ranked:
        if (most is not None and rank >= most) or (seconds is not None and count and total_s + run_s > seconds):
            break
        chosen[position].add(id)
        count += 1
        total_s += run_s
    if count < len(ranked):
        for batch, ids in zip(batches, chosen):
            batch.only = ids
    return count, total_s
