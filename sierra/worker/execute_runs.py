"""The program that executes the runs of a reproduction package again and compares the bytes of their outputs, without SIERRA.

It needs only the standard library (Python 3.8 or newer). `reproduce.py` starts it in an extracted package, after it has
verified all files, by `execution/execute_runs.py`:

    python3 -I worker.pyz execute_runs PACKAGE WORK [--id ID] [--runs N | --seconds S] [--engine NAME] [--yes]

It reaches level 2 of 3: the worker executes runs on this machine or in containers without network, in a new folder of WORK.
Then the SHA-256 of each output is compared with the recorded one. Nothing is executed before a question is answered. Values and
claims are not evaluated. If the bytes of an output may differ legitimately (a clock, a tolerance), different bytes are not
comparable at this level. The exit status is 0 if all outputs are identical, 1 if an output differs or a run fails, 2 for wrong
arguments, 3 if something that is needed is missing, if nothing was executed, or if outputs are not comparable, and 130 after
Ctrl-C. See `package_plan` for what the package says about its runs.
"""

from __future__ import annotations

import argparse
import base64
import contextlib
import hashlib
import io
import itertools
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from functools import partial
from pathlib import Path
from typing import Any, Iterator, Mapping, NamedTuple, Sequence

from sierra.worker import program
from sierra.worker.devices import NoDevices
from sierra.worker.files import last_line_of
from sierra.worker.gpus import with_gpus, without_limit
from sierra.worker.journal import GrowingJournal
from sierra.worker.machine import granted_cores, usable_cores
from sierra.worker.package_places import Place, arch, place_of, shown_command
from sierra.worker.package_plan import STDOUT, Batch, Run, choose, is_safe, missing, read_plan
from sierra.worker.processes import stdin_of
from sierra.worker.reproduce import ENGINES, HOST, Stop, clean, confirm, printable, status_of

STORE = ".sierra"
POLL_S = 0.1
SHELL = 128  # what a shell adds to the number of the signal that has ended a program
SHOWN = 20  # runs that are printed
REPORTED = 10000  # runs that the report lists
REPORT = "reproduction.md"
IDENTICAL, DIFFERENT, FAILED, NOT_COMPARABLE = "identical", "different", "failed", "not comparable"


class Outcome(NamedTuple):
    """The result of one run."""

    run: Run
    verdict: str
    reason: str


def judged(executor: Place, run: Run, end: Mapping[str, Any], folder: Path) -> Outcome:
    """Compare the outputs of a run that has ended with the recorded ones. Raises Stop if it could not be executed."""
    batch = executor.batch
    if end.get("error") and run.ended is None:
        raise missing(f"{run.called()}: {end['error']}")
    trouble, last = trouble_of(batch, run, end), clean(last_line_of(str(folder / "stderr")))
    refused = executor.error.match(f"{end.get('exit_code')} {last}")
    if refused:
        raise missing(f"{executor.name} cannot start containers here: {refused.group(1)}")
    if trouble:
        return Outcome(run, FAILED, f"{trouble}: {last}")
    outputs = renamed(digests_of(batch, end, folder), run.outputs, batch)
    lost, new = sorted(run.outputs.keys() - outputs.keys()), sorted(outputs.keys() - run.outputs.keys())
    unlike = sorted(path for path in run.outputs.keys() & outputs.keys() if run.outputs[path] != outputs[path])
    certain = [path for path in unlike if path not in batch.by_value]
    reasons = [f"{path} is missing" for path in lost] + [f"{path} is new" for path in new]
    reasons += [f"{path} differs" for path in certain]
    if reasons:
        return Outcome(run, DIFFERENT, ", ".join(reasons))
    loose = [f"{path} differs at the byte level ({batch.by_value[path]}); level 3 compares values" for path in unlike]
    return Outcome(run, NOT_COMPARABLE, ", ".join(loose)) if loose else Outcome(run, IDENTICAL, "")


def digests_of(batch: Batch, end: Mapping[str, Any], folder: Path) -> dict[str, str]:
    """Return the digests of the files that a run left, with what it printed if that is an output of any run."""
    digests = {file["path"]: file["sha256"] for file in end["outputs"]}
    printed = (folder / STDOUT).read_bytes() if (folder / STDOUT).is_file() else b""
    if printed and batch.has_stdout and STDOUT not in digests:
        digests[STDOUT] = hashlib.sha256(printed).hexdigest()
    return digests


def renamed(digests: Mapping[str, str], recorded: Mapping[str, str], batch: Batch) -> dict[str, str]:
    """Return the digests of outputs by the names of the recorded outputs that they are compared with.

    Names that match a pattern may have the time of the run in them: such files are compared by the order of their names. If
    their number has changed, those with the same name are compared first.
    """
    names: dict[str, str] = {}
    for pattern in range(len(batch.patterns)):
        old, new = ([path for path in paths if batch.pattern_of(path) == pattern] for paths in (recorded, digests))
        same = set(old) & set(new) if len(old) != len(new) else set()
        rest = (sorted((path for path in paths if path not in same), key=natural) for paths in (old, new))
        names.update({theirs: ours for ours, theirs in zip(*rest)})
    return {names.get(path, path): digest for path, digest in digests.items()}


def natural(path: str) -> tuple[list[Any], str]:
    """Return a key that sorts names by the numbers in them."""
    parts = re.split(r"([0-9]+)", path)
    return [int(part) if number % 2 else part for number, part in enumerate(parts)], path


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


class Execution:
    """The execution of a batch in a new folder."""

    def __init__(self, executor: Place, folder: Path, slots: int) -> None:
        self.batch = executor.batch
        self.executor = executor
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
        words = program.words(str(runs), str(self.slots), str(self.folder / "journal.jsonl"))
        environment = {**self.variables(), "SIERRA_SESSION": self.session}
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
            reason = clean(self.trouble or "") or clean(last_line_of(str(self.folder / "worker.log")))
            raise missing(f"not all runs were executed: {reason}")

    def variables(self) -> Mapping[str, str]:
        """Return the variables of the worker, with the GPUs for runs. Raises Stop if there are too few."""
        gpus = self.batch.limits.get("gpus")
        try:
            return os.environ if gpus is None else with_gpus(os.environ, gpus)
        except NoDevices as error:
            raise missing(str(error)) from None

    def feed(self, process: subprocess.Popen[bytes]) -> None:
        """Send all jobs, and hold the pipe open until the worker has ended."""
        pipe = stdin_of(process)
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
        job = self.executor.job(run, self.folder / "project")
        own = {"SIERRA_SESSION": self.session, "SIERRA_EXECUTION": execution}
        job["environment"].update(own)
        if "client" in job:
            job["client"]["environment"].update(own)
        job.update(run=run.run, execution=execution, limits=self.limits_of(run))
        job["files"] = {name: base64.b64encode(content).decode() for name, content in run.files.items()}
        if not job["folders"]:
            del job["folders"]
        if self.batch.beside:
            job["beside"] = str(self.folder / "beside")
        return job

    def limits_of(self, run: Run) -> dict[str, Any]:
        """Return the limits of a run; without the one for GPUs where there is no GPU, since then the batch has none."""
        given = {**self.batch.limits, **run.limits}
        return {name: limit for name, limit in given.items() if name != "gpus" or "gpus" in self.batch.limits}

    def ended(self, process: subprocess.Popen[bytes], runs: Path) -> Iterator[Outcome]:
        """Yield the outcome of each run that has ended, until the worker has ended. Folders of identical runs are removed."""
        journal = GrowingJournal(str(self.folder / "journal.jsonl"))
        is_alive, events = True, journal.read()
        while is_alive or events:
            for event in events:
                if event["event"] == "end" and event["run"] in self.pending:
                    folder = runs / Path(event["directory"]).name
                    outcome = judged(self.executor, self.pending.pop(event["run"]), event, folder)
                    if outcome.verdict == IDENTICAL:
                        shutil.rmtree(str(folder), ignore_errors=True)
                    yield outcome
            if is_alive and not events:
                time.sleep(POLL_S)
            is_alive, events = process.poll() is None, journal.read()


def prepare(batch: Batch, folder: Path) -> None:
    """Make the folder with a copy of the project, the files that runs need in it, and those beside their inputs."""
    project = folder / "project"
    source = str(batch.package / batch.project)
    shutil.copytree(source, str(project), ignore=lambda folder, names: [STORE] if folder == source and STORE in names else [])
    for name in batch.programs:
        if is_safe(name) and (project / name).is_file():
            (project / name).chmod(0o755)
    for target, files in ((project, batch.files), (folder / "beside", batch.beside)):
        for name, (member, is_program) in files.items():
            (target / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(str(batch.package / member), str(target / name))
            (target / name).chmod(0o755 if is_program else 0o644)


def new_folder(work: Path) -> Path:
    """Make and return a folder for this execution. Raises Stop if nothing can be written there."""
    try:
        work.mkdir(parents=True, exist_ok=True)
        for number in itertools.count(1):
            with contextlib.suppress(FileExistsError):
                folder = work / f"level-2-{number}"
                folder.mkdir()
                return folder
    except OSError as error:
        raise missing(f"cannot write to {work} ({error.strerror}); name another folder by --work FOLDER") from None
    raise AssertionError


def proposal(places: Sequence[Place], count: int, seconds: float, slots: int) -> Iterator[str]:
    """Yield the lines that say what would be executed."""
    estimate = max(seconds / slots, max((seconds / count if count else 0), 1))
    yield f"Level 2 executes {count} runs, {slots} at a time: about {duration(estimate)} by their recorded durations."
    for executor in places:
        yield described(executor)
        yield from (f"  first command: {shown_command(run)}" for run in itertools.islice(executor.batch.runs(), 1))
        yield from (f"  note: {clean(note)}" for note in executor.batch.notes)
    if any(executor.name == HOST for executor in places):
        yield "These are programs of the package. On this machine they can do everything that you can."
    else:
        yield "The containers isolate the runs. execution/ of the package, whose programs start them, is not isolated."


def described(executor: Place) -> str:
    return f"batch {clean(executor.batch.id)[:10]}: {executor.description()}"


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
    slots = granted_cores()
    count, took = choose(batches, runs, None if seconds is None else seconds * slots)
    for batch in batches:
        note = without_limit(batch.limits.get("gpus"))
        if note:
            del batch.limits["gpus"]
            batch.notes.append(note)
    places = [place_of(batch, engine) for batch in batches if batch.only is None or batch.only]
    confirm("\n".join(proposal(places, count, took, slots)), yes=yes)
    folder = new_folder(work)
    began = time.time()
    counts = dict.fromkeys((IDENTICAL, DIFFERENT, FAILED, NOT_COMPARABLE), 0)
    faults: list[str] = []
    for executor in places:
        within = folder / executor.batch.id[:12]
        within.mkdir()
        for outcome in Execution(executor, within, slots).outcomes():
            counts[outcome.verdict] += 1
            if outcome.verdict != IDENTICAL and len(faults) < REPORTED:
                faults.append(f"{outcome.verdict}: {outcome.run.called()}: {clean(outcome.reason)}")
                if len(faults) <= SHOWN:
                    print(faults[-1])
    verdict = verdict_of(counts, sum(executor.batch.of for executor in places))
    print(verdict)
    try:
        unlike = sum(counts.values()) - counts[IDENTICAL]
        write_report(work / REPORT, identity, verdict, [*map(described, places), *obstacles], faults, unlike, began)
        print(f"The report is {work / REPORT}")
    except OSError as error:
        print(f"The report {work / REPORT} cannot be written: {error.strerror}")
    return concluded(counts, folder, obstacles)


def verdict_of(counts: Mapping[str, int], of: int) -> str:
    totals = ", ".join(f"{count} {verdict}" for verdict, count in counts.items() if count)
    return f"LEVEL 2: {sum(counts.values())} of {of} runs executed again: {totals or 'nothing'}"


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
        f"- machine: {system.sysname} {system.release}, {arch()}, {usable_cores()} cores, Python {sys.version.split()[0]}",
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
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(line_buffering=True, errors="backslashreplace")
    given = parsed(arguments)
    package, work = given.package.absolute(), given.work.absolute()
    execution = partial(execute, package, given.id, work, given.runs, given.seconds, given.engine, given.yes)
    return status_of(execution, shown=printable)
