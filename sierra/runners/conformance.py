"""What every scheduler must hold to, as functions that a plug-in's author calls from tests of their own.

    from sierra.runners import conformance

    def test_it_is_a_scheduler(tmp_path):
        conformance.check(MyScheduler(ClusterTable()), tmp_path)

`folder` is an empty one that nodes share. It is a real cluster that is held to it: small jobs are submitted, found again and
cancelled. Each claim is one function of a `Trial`, and can be called alone. What does not hold raises AssertionError with one
line, whether Python runs with `-O` or not.
"""

from __future__ import annotations

import os
import secrets
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from sierra.runners.schedulers import NAME_LENGTH, Request, Scheduler, State, Task

PATIENCE_S = 60.0
POLL_S = 0.1
ODD = "a'; echo foo"
"""The name of the folder that jobs are submitted in."""
WORDS = ("", "a b", " c ", "'f'", '"g"', "$HOME", "`h`", "i\\j", "*", "-k", "ü", "--", "a=b,c=d", "#l", "%A", "{}")
CANARY = "SIERRA_NOBODY_GIVES_THIS_TO_A_JOB"
UNTIL_TOLD = 'touch "begun-$1"; while ! test -e go; do sleep 0.1; done; touch "done-$1"'


@dataclass
class Trial:
    """A scheduler that is held to the contract, and a folder for what it executes."""

    scheduler: Scheduler
    root: Path
    made: list[str] = field(default_factory=list)

    def request(self, script: str, *elements: int, words: tuple[str, ...] = (), after: str = "") -> Request:
        """One for a script of a shell, in a folder of its own, where it begins; its last argument is the element."""
        name = f"sierra-{secrets.token_hex(8)}"[:NAME_LENGTH]
        self.made.append(name)
        folder = self.root / name / ODD
        (folder / "logs").mkdir(parents=True)
        command = ("sh", "-c", script, "sh", *words)
        return Request(name, "sierra's trial of a scheduler", elements or (0,), folder, folder / "logs", command, after)

    def submit(self, script: str, *elements: int, words: tuple[str, ...] = ()) -> tuple[Request, str]:
        request = self.request(script, *elements, words=words)
        return request, self.scheduler.submit(request)

    def seen(self, request: Request) -> tuple[Task, ...]:
        found = self.scheduler.look(request.name)
        if found is None:
            raise AssertionError("it can't be reached")
        return found

    def until(self, request: Request, condition: Callable[[tuple[Task, ...]], bool], otherwise: str) -> None:
        give_up = time.monotonic() + PATIENCE_S
        while not condition(seen := self.seen(request)):
            _holds(time.monotonic() < give_up, f"{otherwise}; seen are {seen}")
            time.sleep(POLL_S)

    def until_ended(self, request: Request) -> None:
        self.until(request, lambda seen: all(task.state == State.ENDED for task in seen), "it does not end")

    def run(self, script: str, *elements: int, words: tuple[str, ...] = ()) -> tuple[Request, str]:
        request, job = self.submit(script, *elements, words=words)
        self.until_ended(request)
        return request, job


def check(scheduler: Scheduler, folder: Path) -> None:
    """All claims."""
    trial = Trial(scheduler, folder)
    try:
        for claim in CLAIMS:
            claim(trial)
    finally:
        for name in trial.made:
            scheduler.cancel(name)


def says_its_version(trial: Trial) -> None:
    """In one line, and the same when asked again."""
    version = trial.scheduler.version()
    _holds(len(version.splitlines()) == 1, f"{version!r} is not one line")
    _holds(trial.scheduler.version() == version, "another version when asked again")


def knows_what_is_allowed(trial: Trial) -> None:
    """What bounds there are is more than nothing."""
    bounds = trial.scheduler.bounds()
    for name, bound in (("array", bounds.array), ("jobs", bounds.jobs), ("wall_s", bounds.wall_s)):
        _holds(bound is None or bound > 0, f"{name} is {bound}")


def says_what_it_hands_over(trial: Trial) -> None:
    """A script says its command, is the same when asked again, and has nothing of the environment."""
    os.environ[CANARY] = "a secret canary"
    try:
        request = trial.request("true", words=("a-word",))
        script = trial.scheduler.script(request)
        _holds(script == trial.scheduler.script(request), "another script when asked again")
    finally:
        del os.environ[CANARY]
    _holds(script.startswith("#!"), "a script does not begin with its interpreter")
    _holds("a-word" in script, "a script does not say its command")
    _holds("a secret canary" not in script, "a script has what was in the environment")


def executes_each_element_once(trial: Trial) -> None:
    """One, some, and some with gaps; each has its index as its last argument."""
    for elements in ((0,), (4,), (0, 1, 2), (1, 2, 5)):
        request, _ = trial.run('for last; do :; done; echo "$#" >> "ran-$last"', *elements, words=("first",))
        ran = {path.name: path.read_text() for path in request.folder.glob("ran-*")}
        _holds(ran == {f"ran-{each}": "2\n" for each in elements}, f"of the elements {elements}, executed were {ran}")


def begins_in_its_folder(trial: Trial) -> None:
    request, _ = trial.run("pwd -P > where")
    where = request.folder / "where"
    _holds(where.is_file(), f"it does not begin in {request.folder}")
    _holds(where.read_text().strip() == str(request.folder.resolve()), f"it begins in {where.read_text().strip()}")


def passes_words_as_they_are(trial: Trial) -> None:
    """No word of a command is evaluated, split or lost."""
    request, _ = trial.run('printf "<%s>" "$@" > words', words=WORDS)
    wanted, got = "".join(f"<{word}>" for word in (*WORDS, "0")), (request.folder / "words").read_text()
    _holds(got == wanted, f"{wanted!r} became {got!r}")


def gives_nothing_of_the_environment(trial: Trial) -> None:
    os.environ[CANARY] = "1"
    try:
        request, _ = trial.run("env > variables")
    finally:
        del os.environ[CANARY]
    _holds(CANARY not in (request.folder / "variables").read_text(), "a variable of the caller's is seen by jobs")


def keeps_logs_apart(trial: Trial) -> None:
    """What an element prints is in a file of its own, with what it complains of."""
    request, _ = trial.run('echo "printed by $1"; echo "complained by $1" >&2', 0, 1, 3)
    texts = sorted(path.read_text() for path in request.logs.iterdir())
    _holds(len(texts) == 3, f"3 elements have {len(texts)} logs")
    for text, element in zip(texts, (0, 1, 3), strict=True):
        said = f"printed by {element}" in text and f"complained by {element}" in text
        _holds(said and text.count("printed by") == 1, f"the log of element {element} is {text!r}")


def finds_jobs_by_name(trial: Trial) -> None:
    """As soon as they are submitted: all of that name, no others, and elements that have begun by their index."""
    first, job = trial.submit(UNTIL_TOLD, 0, 2)
    other, another = trial.submit(UNTIL_TOLD)
    _holds({task.job for task in trial.seen(first)} == {job}, f"job {job} is not found at once by its name {first.name}")
    _holds(
        {task.job for task in trial.seen(other)} == {another}, f"job {another} is not found at once by its name {other.name}"
    )
    trial.until(first, lambda seen: _running(seen) == {0, 2}, "elements 0 and 2 never run")
    for request in (first, other):
        (request.folder / "go").touch()
        trial.until_ended(request)


def knows_nothing_of_other_names(trial: Trial) -> None:
    _holds(trial.seen(trial.request("true")) == (), "a name that nobody has is found")


def may_be_looked_at_after_the_end(trial: Trial) -> None:
    """What has ended is not taken for alive, however it ended."""
    request, _ = trial.run('exit "$1"', 0, 3)
    _holds(not [task for task in trial.seen(request) if task.state != State.ENDED], "what has ended lives again")


def cancels_some(trial: Trial) -> None:
    """Only these elements end."""
    request, _ = trial.submit(UNTIL_TOLD, 0, 1, 3)
    trial.until(request, lambda seen: 1 in _running(seen), "element 1 never runs")
    trial.scheduler.cancel(request.name, [1, 77])
    trial.until(request, lambda seen: 1 not in _alive(seen), "element 1 does not end")
    (request.folder / "go").touch()
    trial.until_ended(request)
    ended = sorted(path.name for path in request.folder.glob("done-*"))
    _holds(ended == ["done-0", "done-3"], f"after element 1 was cancelled, there are {ended}")


def cancels_all(trial: Trial) -> None:
    """All of that name, of more than one job, and no others; more than once."""
    request, _ = trial.submit(UNTIL_TOLD, 0, 1)
    trial.scheduler.submit(request)
    other, _ = trial.submit(UNTIL_TOLD)
    trial.scheduler.cancel(request.name)
    trial.until_ended(request)
    trial.scheduler.cancel(request.name)
    (other.folder / "go").touch()
    trial.until_ended(other)
    _holds((other.folder / "done-0").exists(), "a job of another name was cancelled too")


def cancels_nothing_where_there_is_none(trial: Trial) -> None:
    name = trial.request("true").name
    trial.scheduler.cancel(name)
    trial.scheduler.cancel(name, [0, 1])


CLAIMS: tuple[Callable[[Trial], None], ...] = (
    says_its_version,
    knows_what_is_allowed,
    says_what_it_hands_over,
    executes_each_element_once,
    begins_in_its_folder,
    passes_words_as_they_are,
    gives_nothing_of_the_environment,
    keeps_logs_apart,
    finds_jobs_by_name,
    knows_nothing_of_other_names,
    may_be_looked_at_after_the_end,
    cancels_some,
    cancels_all,
    cancels_nothing_where_there_is_none,
)


def _running(seen: tuple[Task, ...]) -> set[int | None]:
    return {task.element for task in seen if task.state == State.RUNNING}


def _alive(seen: tuple[Task, ...]) -> set[int | None]:
    return {task.element for task in seen if task.state != State.ENDED}


def _holds(condition: bool, otherwise: str) -> None:
    if not condition:
        raise AssertionError(otherwise)
