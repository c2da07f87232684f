"""Conformance suites for schedulers and runners, as functions that a plug-in's author calls in tests.

    from sierra.testing import runners as conformance

    def test_it_is_a_scheduler(tmp_path):
        conformance.check(MyScheduler(ClusterTable()), tmp_path)

    def test_it_is_a_runner(tmp_path):
        conformance.check_runner(lambda slots: MyRunner(slots, MyOptions()), tmp_path)

`folder` is an empty folder that nodes share. The suite needs a real cluster: it submits small jobs, finds them again and
cancels them. Each claim is one function of a `Trial` (for schedulers) or of an `Ordeal` (for runners), and can be called alone.
A broken claim raises AssertionError with one line, even if Python runs with `-O`.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import secrets
import signal
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from sierra.config.cluster_table import ClusterTable
from sierra.model import Job, Limits, Result
from sierra.provenance import environment
from sierra.runners.base import Look, Runner, Work
from sierra.runners.schedulers.base import NAME_LENGTH, Request, Scheduler, State, Task
from sierra.store.layout import RUN_OUTPUT, RUN_STDERR, RUN_STDOUT, SessionPaths
from sierra.testing.assertions import holds, is_one_line, says_what_its_options_are, variable, wait

PATIENCE_S = 60.0
POLL_S = 0.1
ODD = "a'; echo foo"
"""Name of the folder in which jobs are submitted."""
WORDS = ("", "a b", " c ", "'f'", '"g"', "$HOME", "`h`", "i\\j", "*", "-k", "ü", "--", "a=b,c=d", "#l", "%A", "{}")
CANARY = "SIERRA_NOBODY_GIVES_THIS_TO_A_JOB"
UNTIL_TOLD = 'touch "begun-$1"; while ! test -e go; do sleep 0.1; done; touch "done-$1"'


@dataclass
class Trial:
    """A scheduler to test, and a folder for the jobs."""

    scheduler: Scheduler
    root: Path
    names: list[str] = field(default_factory=list)

    def request(self, script: str, *elements: int, words: tuple[str, ...] = (), after: str = "") -> Request:
        """Return a request for a shell script that begins in a folder of its own. Its last argument is the element."""
        name = f"sierra-{secrets.token_hex(8)}"[:NAME_LENGTH]
        self.names.append(name)
        folder = self.root / name / ODD
        (folder / "logs").mkdir(parents=True)
        command = ("sh", "-c", script, "sh", *words)
        return Request(name, "SIERRA's test of a scheduler", elements or (0,), folder, folder / "logs", command, after)

    def submit(self, script: str, *elements: int, words: tuple[str, ...] = ()) -> tuple[Request, str]:
        request = self.request(script, *elements, words=words)
        return request, self.scheduler.submit(request)

    def seen(self, request: Request) -> tuple[Task, ...]:
        found = self.scheduler.look(request.name)
        if found is None:
            raise AssertionError("the scheduler cannot be reached")
        return found

    def until(self, request: Request, condition: Callable[[tuple[Task, ...]], bool], otherwise: str) -> None:
        wait(lambda: condition(self.seen(request)), lambda: f"{otherwise}; tasks: {self.seen(request)}", PATIENCE_S, POLL_S)

    def until_ended(self, request: Request) -> None:
        self.until(request, lambda seen: all(task.state == State.ENDED for task in seen), "the job does not end")

    def run(self, script: str, *elements: int, words: tuple[str, ...] = ()) -> tuple[Request, str]:
        request, job = self.submit(script, *elements, words=words)
        self.until_ended(request)
        return request, job


def check(scheduler: Scheduler, folder: Path) -> None:
    """Check all claims about schedulers."""
    trial = Trial(scheduler, folder)
    try:
        for claim in CLAIMS:
            claim(trial)
    finally:
        for name in trial.names:
            scheduler.cancel(name)


def refuses_lines_in_one_line(trial: Trial) -> None:
    """Check that its options are clusters' settings, and that the answer to any additional line is None or one line."""
    says_what_its_options_are(trial.scheduler, ClusterTable)
    for line in ("", "-x", "--an-option-of-no-scheduler=1", "words", "'unclosed"):
        reason = trial.scheduler.refuses(line)
        holds(reason is None or len(reason.splitlines()) == 1, f"refuses({line!r}) returned {reason!r}, not None or one line")


def says_its_version(trial: Trial) -> None:
    """Check that the version is one line, and is repeated."""
    version = trial.scheduler.version()
    is_one_line(version)
    holds(trial.scheduler.version() == version, "the version differs when it is requested again")


def knows_what_is_allowed(trial: Trial) -> None:
    """Check that known limits are greater than zero."""
    bounds = trial.scheduler.bounds()
    for name in ("array", "jobs", "wall_s", "running"):
        bound = getattr(bounds, name)
        holds(bound is None or bound > 0, f"{name} is {bound}")


def explains_in_a_line(trial: Trial) -> None:
    """Check that an explanation is one line that begins with the scheduler's own words."""
    for words in ("Invalid account", "what nobody has ever said"):
        explanation = trial.scheduler.explain(words)
        begins = explanation.startswith(words) and "\n" not in explanation
        holds(begins, f"explain({words!r}) must return one line that begins with these words")


def says_what_it_hands_over(trial: Trial) -> None:
    """Check that a script contains its command, is repeated, and contains nothing of the environment."""
    with variable(CANARY, "a secret canary"):
        request = trial.request("true", words=("a-word",))
        script = trial.scheduler.script(request)
        holds(script == trial.scheduler.script(request), "the script differs when it is requested again")
    holds(script.startswith("#!"), "a script does not begin with its interpreter")
    holds("a-word" in script, "a script does not contain its command")
    holds("a secret canary" not in script, "a script contains a value from the environment")


def executes_each_element_once(trial: Trial) -> None:
    """Check single elements, ranges, and elements with gaps. Each has its index as its last argument."""
    for elements in ((0,), (4,), (0, 1, 2), (1, 2, 5)):
        request, _ = trial.run('for last; do :; done; echo "$#" >> "ran-$last"', *elements, words=("first",))
        ran = {path.name: path.read_text() for path in request.folder.glob("ran-*")}
        holds(ran == {f"ran-{each}": "2\n" for each in elements}, f"submitted array tasks: {elements}; executed: {ran}")


def begins_in_its_folder(trial: Trial) -> None:
    request, _ = trial.run("pwd -P > where")
    where = request.folder / "where"
    holds(where.is_file(), f"the job does not begin in {request.folder}")
    holds(where.read_text().strip() == str(request.folder.resolve()), f"the job begins in {where.read_text().strip()}")


def passes_words_as_they_are(trial: Trial) -> None:
    """Check that no word of a command is evaluated, split or lost."""
    request, _ = trial.run('printf "<%s>" "$@" > words', words=WORDS)
    wanted, got = "".join(f"<{word}>" for word in (*WORDS, "0")), (request.folder / "words").read_text()
    holds(got == wanted, f"{wanted!r} became {got!r}")


def gives_nothing_of_the_environment(trial: Trial) -> None:
    with variable(CANARY):
        request, _ = trial.run("env > variables")
    holds(CANARY not in (request.folder / "variables").read_text(), "jobs see a variable of the caller")


def keeps_logs_apart(trial: Trial) -> None:
    """Check that each element's output and error output are in a file of its own."""
    request, _ = trial.run('echo "printed by $1"; echo "complained by $1" >&2', 0, 1, 3)
    texts = sorted(path.read_text() for path in request.logs.iterdir())
    holds(len(texts) == 3, f"3 array tasks have {len(texts)} logs")
    for text, element in zip(texts, (0, 1, 3), strict=True):
        said = f"printed by {element}" in text and f"complained by {element}" in text
        holds(said and text.count("printed by") == 1, f"the log of array task {element} is {text!r}")


def finds_jobs_by_name(trial: Trial) -> None:
    """Check that jobs are found as soon as they are submitted.

    All jobs of the name are found, and no others. Elements that have begun are found by their index.
    """
    first, job = trial.submit(UNTIL_TOLD, 0, 2)
    other, another = trial.submit(UNTIL_TOLD)
    for number, of in ((job, first), (another, other)):
        jobs = {task.job for task in trial.seen(of)}
        holds(jobs == {number}, f"job {number} is not found immediately by its name {of.name}")
    trial.until(first, lambda seen: _running(seen) == {0, 2}, "array tasks 0 and 2 never run")
    for request in (first, other):
        (request.folder / "go").touch()
        trial.until_ended(request)


def knows_nothing_of_other_names(trial: Trial) -> None:
    holds(trial.seen(trial.request("true")) == (), "jobs are found under a name that no job has")


def may_be_looked_at_after_the_end(trial: Trial) -> None:
    """Check that ended tasks are not reported as alive, however they ended, nor as cancelled."""
    request, _ = trial.run('exit "$1"', 0, 3)
    holds(not any(task.cancelled for task in trial.seen(request)), "a job that ended by itself is reported as cancelled")
    holds(not [task for task in trial.seen(request) if task.state != State.ENDED], "an ended job is reported as alive")


def cancels_some(trial: Trial) -> None:
    """Check that only the given elements are cancelled."""
    request, _ = trial.submit(UNTIL_TOLD, 0, 1, 3)
    trial.until(request, lambda seen: 1 in _running(seen), "array task 1 never runs")
    trial.scheduler.cancel(request.name, [1, 77])
    trial.until(request, lambda seen: 1 not in _alive(seen), "array task 1 does not end")
    (request.folder / "go").touch()
    trial.until_ended(request)
    ended = sorted(path.name for path in request.folder.glob("done-*"))
    holds(ended == ["done-0", "done-3"], f"after array task 1 was cancelled, the others left {ended}")
    cancelled = {task.element for task in trial.seen(request) if task.cancelled}
    holds(cancelled == {1} or (trial.scheduler.forgets and not cancelled), f"array tasks reported as cancelled: {cancelled}")


def cancels_all(trial: Trial) -> None:
    """Check that all jobs of a name are cancelled, and no others. Cancelling may be repeated."""
    request, _ = trial.submit(UNTIL_TOLD, 0, 1)
    trial.scheduler.submit(request)
    other, _ = trial.submit(UNTIL_TOLD)
    trial.scheduler.cancel(request.name)
    trial.until_ended(request)
    trial.scheduler.cancel(request.name)
    (other.folder / "go").touch()
    trial.until_ended(other)
    holds((other.folder / "done-0").exists(), "a job of another name was cancelled too")


def cancels_nothing_where_there_is_none(trial: Trial) -> None:
    name = trial.request("true").name
    trial.scheduler.cancel(name)
    trial.scheduler.cancel(name, [0, 1])


CLAIMS: tuple[Callable[[Trial], None], ...] = (
    refuses_lines_in_one_line,
    says_its_version,
    knows_what_is_allowed,
    explains_in_a_line,
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


AT_ONCE_S = 2.0
"""Seconds that a look may take if it has little to report."""
QUIET_S = 1.0
"""Seconds without new files after which a run is treated as ended."""
NOTHING = Limits(grace_s=1.0)
PATH = "/usr/local/bin:/usr/bin:/bin"
UNTIL_GO = 'touch "$0/begun-$1"; while ! test -e "$0/go"; do date +%N > "$0/beat-$1"; sleep 0.1; done; echo "$1" > ended'


@dataclass
class Ordeal:
    """A runner to test. `make` returns a new one with the given number of slots at each call."""

    make: Callable[[int], Runner]
    root: Path
    begun: list[Errand] = field(default_factory=list)

    def errand(self) -> Errand:
        """Make a session, and a folder that its runs can reach."""
        number = len(self.begun)
        session = SessionPaths(self.root / f"{number}-{ODD}" / "session" / secrets.token_hex(8))
        session.root.mkdir(parents=True)
        self.begun.append(Errand(self.make(2), session, session.root.parent.parent / "shared"))
        self.begun[-1].shared.mkdir()
        return self.begun[-1]

    def resumed(self, errand: Errand, recorded: Mapping[str, str | None]) -> Errand:
        """Return the same session, continued by another runner."""
        other = Errand(self.make(2), errand.session, errand.shared, errand.jobs)
        self.begun.append(other)
        other.runner.resume(errand.session, recorded)
        return other

    def close(self) -> None:
        """End everything that may still run."""
        for errand in self.begun:
            (errand.shared / "go").touch()
            with contextlib.suppress(Exception):
                if not errand.over:
                    errand.runner.stop()
                    errand.until_over()
            errand.runner.close()

    def executed(self, *scripts: str, limits: Limits = NOTHING) -> list[Result]:
        """Execute scripts, and return their results in the same order."""
        errand = self.errand()
        errand.execute([errand.script(text, limits=limits) for text in scripts])
        return [errand.results[job.execution] for job in errand.jobs]


@dataclass
class Errand:
    """Jobs of one session, and what a runner has reported about them."""

    runner: Runner
    session: SessionPaths
    shared: Path
    jobs: list[Job] = field(default_factory=list)
    reported: list[Result] = field(default_factory=list)
    rows: list[tuple[str, Mapping[str, object]]] = field(default_factory=list)
    over: bool = False

    @property
    def results(self) -> dict[str, Result]:
        return {result.execution: result for result in self.reported}

    def job(self, argv: Sequence[str], *, limits: Limits = NOTHING, files: Mapping[str, bytes] | None = None) -> Job:
        run, execution = secrets.token_hex(32), secrets.token_hex(32)
        ids = {"SIERRA_SESSION": self.session.root.name, "SIERRA_EXECUTION": execution}
        variables = {"PATH": PATH, "HOME": "\0/home", "SIERRA_RUN_DIR": "\0", **ids, "ODD": " ".join(WORDS)}
        return Job(run, execution, tuple(argv), variables, tuple((files or {"in.xml": b"<in/>"}).items()), limits)

    def script(self, text: str, *, limits: Limits = NOTHING) -> Job:
        """Return a job for a shell script. $0 is the shared folder, $1 a word of its own, and $2 its input file."""
        return self.job(("sh", "-c", text, str(self.shared), secrets.token_hex(4), "\0/in.xml"), limits=limits)

    def submit(self, jobs: Sequence[Job]) -> None:
        self.jobs = list(jobs)
        self.runner.submit(self.work(), self.session)

    def execute(self, jobs: Sequence[Job]) -> None:
        """Submit jobs, wait for the end of the session, and check that each job has one result."""
        self.submit(jobs)
        self.end()

    def end(self) -> None:
        self.until_over()
        self.each_is_reported_once()

    def work(self) -> Work:
        return Work(iter(self.jobs), len(self.jobs), batch="0" * 64, around=environment.capture("0"))

    def leave(self) -> None:
        """Drop the runner, like a process that ends."""
        self.runner.close()
        self.over = True

    def look(self) -> Look:
        look = self.runner.look()
        self.reported += look.results
        self.rows += look.rows
        self.over = not look.alive
        if look.wrong is not None:
            raise look.wrong
        return look

    def until(self, condition: Callable[[], bool], otherwise: str) -> None:
        """Look until a condition is true."""
        give_up = time.monotonic() + PATIENCE_S
        while not condition():
            holds(time.monotonic() < give_up, otherwise)
            self.look()
            time.sleep(POLL_S)

    def until_over(self) -> None:
        self.until(lambda: self.over, "the session does not end")

    def until_begun(self, count: int) -> None:
        self.until(lambda: self.has("begun-*") >= count, f"{count} runs do not begin")

    def has(self, pattern: str) -> int:
        return len(list(self.shared.glob(pattern)))

    def each_is_reported_once(self) -> None:
        wanted = sorted(job.execution for job in self.jobs)
        counts = f"{len(self.reported)} results of {len(self.results)} executions were reported"
        holds(sorted(result.execution for result in self.reported) == wanted, f"{len(wanted)} jobs, but {counts}")
        runs = {job.execution: job.run for job in self.jobs}
        holds(all(runs[one.execution] == one.run for one in self.reported), "a result has the run of another job")

    def at_rest(self) -> None:
        """Check that nothing keeps running."""
        give_up = time.monotonic() + PATIENCE_S
        beats = self._beats()
        while time.monotonic() < give_up:
            time.sleep(QUIET_S)
            before, beats = beats, self._beats()
            if before == beats:
                return
        raise AssertionError("runs that should have ended are still running")

    def _beats(self) -> list[tuple[str, int]]:
        return sorted((path.name, path.stat().st_mtime_ns) for path in self.shared.glob("beat-*"))


def check_runner(make: Callable[[int], Runner], folder: Path) -> None:
    """Check all claims. `make` makes a new runner with a number of slots, like a result of `sierra.runners.base.find`."""
    ordeal = Ordeal(make, folder)
    says_what_its_options_are(make(1))
    stays = make(1).stays
    try:
        for claim in (*RUNNER_CLAIMS, *(STAYING_CLAIMS if stays else LEAVING_CLAIMS)):
            claim(ordeal)
    finally:
        ordeal.close()


def executes_each_job_once(ordeal: Ordeal) -> None:
    """Check that each job has exactly one result, with host and times, even with more jobs than slots."""
    began = time.time()
    results = ordeal.executed(*['echo "$1" >> "$0/executed"; echo "$1" > own'] * 7)
    executed = (ordeal.begun[-1].shared / "executed").read_text().split()
    holds(sorted(executed) == sorted(job.argv[4] for job in ordeal.begun[-1].jobs), f"submitted jobs: 7; executed: {executed}")
    for result in results:
        holds(result.exit_code == 0 and result.error is None, f"a successful job has the result {result}")
        # a node's clock may differ by seconds
        holds(began - 5 < result.started <= result.ended < time.time() + 5, f"its times are {result.started}, {result.ended}")
        holds(bool(result.host), "a result has no host")
    cut = [row for table, row in ordeal.begun[-1].rows if table == "attempts" and row["state"] != "finished"]
    holds(not cut, f"everything was executed, but attempts are reported as cut off: {cut}")


def keeps_what_runs_leave(ordeal: Ordeal) -> None:
    """Check that output files are kept with their hashes, and that printed output is kept."""
    text = 'mkdir -p a/b; printf "x,y\\n1,2\\n" > a/b/t.csv; : > empty; head -c 3000000 /dev/zero > big; echo out; echo err >&2'
    for result in ordeal.executed(text, text):
        folder = Path(result.directory)
        contents = {file.path: (folder / RUN_OUTPUT / file.path).read_bytes() for file in result.outputs}
        written = {"a/b/t.csv": b"x,y\n1,2\n", "empty": b"", "big": bytes(3_000_000)}
        holds(contents == written, f"the reported outputs are {sorted(contents)}")
        for file in result.outputs:
            content = contents[file.path]
            described = (file.bytes, file.sha256) == (len(content), hashlib.sha256(content).hexdigest())
            holds(described, f"{file.path} differs from its reported size or hash")
        printed = (folder / RUN_STDOUT).read_bytes(), (folder / RUN_STDERR).read_bytes()
        holds(printed == (b"out\n", b"err\n"), f"the recorded printed output is {printed}")


def tells_how_each_ended(ordeal: Ordeal) -> None:
    """Check that a failed run has a result, and so has a run that cannot be started."""
    errand = ordeal.errand()
    errand.execute([errand.script("exit 3"), errand.script("kill -9 $$"), errand.job(("/nowhere/at all",)), errand.script(":")])
    failed, killed, absent, fine = (errand.results[job.execution] for job in errand.jobs)
    holds((failed.exit_code, failed.signal, failed.stopped) == (3, None, None), f"exit status 3 became {failed}")
    holds((killed.exit_code, killed.signal, killed.stopped) == (None, 9, None), f"a run that was killed became {killed}")
    holds(absent.error is not None and absent.exit_code is None, f"a missing program became {absent}")
    holds(fine.exit_code == 0 and fine.error is None, f"a successful run became {fine}")


def gives_what_the_job_has(ordeal: Ordeal) -> None:
    """Check that words (NUL is the run's folder) and input arrive unchanged, and that a job begins in its output folder."""
    errand = ordeal.errand()
    script = 'cat "$1/in.xml"; pwd -P; cd "$1/output" && pwd -P; shift; printf "<%s>" "$@"'
    content = bytes(range(256)) * 3
    errand.execute([errand.job(("sh", "-c", script, "sh", "\0", *WORDS), files={"in.xml": content, "other": b""})])
    printed = (Path(errand.reported[0].directory) / RUN_STDOUT).read_bytes()
    holds(printed.startswith(content), "its input file differs from the job's")
    here, output, words = printed[len(content) :].decode().split("\n", 2)
    holds(here == output, f"the run begins in {here}, but its output folder is {output}")
    wanted = "".join(f"<{word}>" for word in WORDS)
    holds(words == wanted, f"{wanted!r} became {words!r}")


def gives_exactly_the_jobs_environment(ordeal: Ordeal) -> None:
    """Check that a run's environment has nothing of the caller, the scheduler or the node."""
    errand = ordeal.errand()
    with variable(CANARY):
        errand.execute([errand.job(("env", "-0")) for _ in range(2)])
    for job in errand.jobs:
        printed = (Path(errand.results[job.execution].directory) / RUN_STDOUT).read_bytes().decode().split("\0")[:-1]
        seen = dict(line.split("=", 1) for line in printed)
        wanted = {name: value.replace("\0", seen.get("SIERRA_RUN_DIR", "")) for name, value in job.environment.items()}
        other = sorted(seen.items() ^ wanted.items())
        holds(not other, f"the variables differ from the job's: {other}")


def keeps_the_time_limit(ordeal: Ordeal) -> None:
    """Check the time limit of each run. A run that ignores signals is killed."""
    bounds = Limits(wall_s=1.0, grace_s=0.5)
    for result in ordeal.executed("sleep 60", 'trap "" TERM; while :; do sleep 0.1; done', limits=bounds):
        holds(result.stopped == "timeout", f"a run over its limit became {result}")
        holds(0.9 < result.ended - result.started < PATIENCE_S / 2, f"the run took {result.ended - result.started:.1f} s")


def looks_at_once(ordeal: Ordeal) -> None:
    """Check that a look does not wait for the runs in flight."""
    errand = ordeal.errand()
    errand.submit([errand.script(UNTIL_GO)])
    errand.until_begun(1)
    for _ in range(20):
        began = time.monotonic()
        look = errand.look()
        took = time.monotonic() - began
        holds(took < AT_ONCE_S, f"look() took {took:.1f} s")
        holds(look.alive, "the session is reported as ended while a job runs")
        time.sleep(POLL_S)
    (errand.shared / "go").touch()
    errand.end()


def ends_when_stopped(ordeal: Ordeal) -> None:
    """Check that `stop` ends the runs in flight, begins no more, and keeps earlier results. It may be called twice."""
    errand = ordeal.errand()
    errand.submit([errand.script("echo 1 > ended"), *(errand.script(UNTIL_GO) for _ in range(6))])
    errand.until(lambda: bool(errand.reported), "an ended run is not reported while others run")
    errand.until_begun(1)
    is_stopped(errand)
    good = [result for result in errand.reported if result.stopped is None and result.exit_code == 0]
    holds([result.execution for result in good] == [errand.jobs[0].execution], f"successful runs after the stop: {good}")


def is_stopped(errand: Errand) -> None:
    """Stop the runner, and check that everything ends and nothing keeps running."""
    errand.runner.stop()
    errand.runner.stop()
    errand.until_over()
    errand.look()
    holds(errand.over, "the session is alive again after its end")
    begun = errand.has("begun-*")
    errand.at_rest()
    holds(errand.has("begun-*") == begun, "runs begin after the stop")
    reported = [result.execution for result in errand.reported]
    holds(len(reported) == len(set(reported)), "a run was reported twice")


def goes_on_for_another(ordeal: Ordeal) -> None:
    """Check that another runner reports exactly the results that are not recorded, and that runs go on and execute once."""
    errand = ordeal.errand()
    errand.submit([errand.script("echo 1 > ended"), errand.script(UNTIL_GO), errand.script(UNTIL_GO)])
    errand.until(lambda: bool(errand.reported), "an ended run is not reported while others run")
    errand.until_begun(1)
    errand.leave()
    first = errand.reported[0]
    other = ordeal.resumed(errand, {first.execution: first.attempt})
    (errand.shared / "go").touch()
    other.until_over()
    reported = sorted(result.execution for result in other.reported)
    holds(
        reported == sorted(job.execution for job in errand.jobs[1:]),
        f"expected the results of 2 other runs, but got {reported}",
    )
    holds(all(result.exit_code == 0 for result in other.reported), f"runs ended when their runner was closed: {other.reported}")
    holds(errand.has("begun-*") == 2, "a run was begun more than once")


def tells_another_of_all(ordeal: Ordeal) -> None:
    """Check that another runner reports all results if nothing is recorded, even those that were reported before."""
    errand = ordeal.errand()
    errand.execute([errand.script("echo 1 > ended"), errand.script("exit 4")])
    errand.leave()
    other = ordeal.resumed(errand, {})
    other.end()
    codes = [other.results[job.execution].exit_code for job in errand.jobs]
    holds(codes == [0, 4], "the results differ from the first report")


def is_stopped_by_another(ordeal: Ordeal) -> None:
    errand = ordeal.errand()
    errand.submit([errand.script(UNTIL_GO), errand.script(UNTIL_GO)])
    errand.until_begun(1)
    errand.leave()
    is_stopped(ordeal.resumed(errand, {}))


def lives_on_without_its_process(ordeal: Ordeal) -> None:
    """Check that another process can continue after the submitting process is killed, and that nothing is executed twice."""
    errand = killed_after_submission(ordeal)
    other = ordeal.resumed(errand, {})
    (errand.shared / "go").touch()
    other.end()
    holds(all(result.exit_code == 0 for result in other.reported), f"runs ended with the process: {other.reported}")
    holds(errand.has("begun-*") == 2, "a run was begun more than once")


def ends_with_its_process(ordeal: Ordeal) -> None:
    """Check that nothing keeps running after the submitting process is killed."""
    killed_after_submission(ordeal).at_rest()


def killed_after_submission(ordeal: Ordeal) -> Errand:
    """Return two jobs in flight whose submitting process was killed."""
    errand = ordeal.errand()
    errand.jobs = [errand.script(UNTIL_GO), errand.script(UNTIL_GO)]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # about forking beside threads; the child needs only its own
        child = os.fork()
    if child == 0:
        try:
            errand.runner.submit(errand.work(), errand.session)
            while True:
                errand.runner.look()
                time.sleep(POLL_S)
        finally:
            os._exit(1)
    try:
        wait(lambda: errand.has("begun-*") >= 2, lambda: "2 runs do not begin", PATIENCE_S, POLL_S)
    finally:
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        errand.leave()
    return errand


RUNNER_CLAIMS: tuple[Callable[[Ordeal], None], ...] = (
    executes_each_job_once,
    keeps_what_runs_leave,
    tells_how_each_ended,
    gives_what_the_job_has,
    gives_exactly_the_jobs_environment,
    keeps_the_time_limit,
    looks_at_once,
    ends_when_stopped,
)
STAYING_CLAIMS: tuple[Callable[[Ordeal], None], ...] = (
    goes_on_for_another,
    tells_another_of_all,
    is_stopped_by_another,
    lives_on_without_its_process,
)
"""Claims about runners with `stays`."""
LEAVING_CLAIMS: tuple[Callable[[Ordeal], None], ...] = (ends_with_its_process,)
"""Claims about the other runners."""


def _running(seen: tuple[Task, ...]) -> set[int | None]:
    return {task.element for task in seen if task.state == State.RUNNING}


def _alive(seen: tuple[Task, ...]) -> set[int | None]:
    return {task.element for task in seen if task.state != State.ENDED}
