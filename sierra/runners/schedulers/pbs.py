"""PBS: OpenPBS (and PBS Pro), and the `qsub` that Debian's slurm-wlm-torque provides for SLURM.

`qsub --version` tells them apart. They have little in common but the names of their commands. The module `qsub` describes the
input of each, and the module `qstat` the answers of each. These facts hold for both:

- The script is always a file, because the SLURM wrapper does not read standard input. It is named without its folder, because
  the wrapper passes its arguments through a shell.
- No history is requested, because it is off by default in OpenPBS. A job that is not listed has ended. `qstat` with ids ends
  with status 153 (unknown) or 35 (finished) then. Exit statuses are not trusted: an array's is 0 or 1, whatever its elements
  did.
- OpenPBS accepts a job that depends on a job that it does not know (any more), and deletes it at once. It is submitted again
  then.
- The ids of one `qdel` are either all of whole jobs, or all of elements and plain jobs. If an array and an element of it are
  given at once, OpenPBS deletes the element, keeps the array, and reports success.
- If nothing is known about a name, one call lists all jobs. From then on, one call asks for the ids that were alive, until one
  of them is gone, because the list of a whole site is long.
- Commands see few variables of the caller's environment (`PASSED`): a site may have made `-V` its default, and PBS_DPREFIX or
  SBATCH_* would change the meaning of scripts.
- With the SLURM wrapper, `qstat` and `qdel` know nothing of elements, which have plain numbers there. SLURM's own commands are
  installed beside this `qsub`, so SIERRA uses them instead.
"""

from __future__ import annotations

import itertools
import os
import pwd
import re
import shutil
import subprocess
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import ClassVar

from sierra.config import forbidden_directives
from sierra.config.cluster_table import ClusterTable
from sierra.errors import ConfigError, Full, Missing
from sierra.runners import schedulers
from sierra.runners.schedulers import qstat, qsub
from sierra.runners.schedulers.base import Bounds, Limit, NodeVariables, Request, Scheduler, State, Task, least
from sierra.runners.schedulers.qsub import Dialect
from sierra.runners.schedulers.refusals import PBS, about
from sierra.runners.schedulers.slurm import Slurm
from sierra.util.fs import write_whole
from sierra.util.lazy_definitions import regex
from sierra.util.lazy_logger import Log

log = Log(__name__)

TIMEOUT_S = 20.0
SUBMIT_TIMEOUT_S = 120.0
AT_ONCE = 200
"""Largest number of ids on one command line."""
ARRAY = 10_000
"""OpenPBS's default of `max_array_size`."""
PASSED = frozenset(
    (
        *("PATH", "HOME", "USER", "LOGNAME", "LD_LIBRARY_PATH", "PERL5LIB", "TMPDIR", "KRB5CCNAME", "SLURM_CONF"),
        *("PBS_CONF_FILE", "PBS_EXEC", "PBS_HOME", "PBS_SERVER", "PBS_PRIMARY", "PBS_SECONDARY", "PBS_DEFAULT"),
    )
)
FORWARDED = frozenset(("HOME", "USER", "LOGNAME", "LD_LIBRARY_PATH", "PERL5LIB", "SLURM_CONF"))
SYSTEM = {"PATH": "/usr/local/bin:/usr/bin:/bin", "SBATCH_EXPORT": "ALL"}
"""Environment of the SLURM wrapper, in addition to HANDED_ON. SLURM's sbatch passes its whole environment to the job, so the
wrapper sees almost nothing. If sbatch were told to pass on nothing, it would start a login shell on the node for each task and
wait for it, which may take minutes."""
OPENPBS = regex(r"pbs_version\s*=\s*(\S+)")
JOB = regex(r"\d+(\[\])?(\.\S+)?")
UNREACHABLE = regex(
    r"cannot connect|connection (refused|reset|timed)|connection table full|no free connections"
    r"|communication failure|protocol (error|failure)|premature end of message|shutting down|end of file|timed out"
    r"|unable to contact slurm|zero bytes|transport|could not establish a configuration",
    re.IGNORECASE,
)
FULL = regex(
    r"maximum number of jobs|would exceed|temporarily un(available|able)|MaxSubmit|accounting/QOS policy|MaxJobCount",
    re.IGNORECASE,
)
GONE = regex(r"unknown job|has finished|invalid (for|in this) state|request invalid for (state|finished)", re.IGNORECASE)
DEPENDENCY = regex(r"unknown job|dependency", re.IGNORECASE)


class Pbs:
    """The scheduler `pbs`, in either of its dialects."""

    name = "pbs"
    Options: ClassVar[type[ClusterTable]] = ClusterTable
    node: ClassVar[NodeVariables] = replace(  # SLURM has commands like those of PBS
        Slurm.node,
        task=(*Slurm.node.task, "{PBS_JOBID}"),
        job=(*Slurm.node.job, "{PBS_JOBID}"),
        cores=(*Slurm.node.cores, "{NCPUS}", "{PBS_NP}", "{PBS_NUM_PPN}"),
        others=(
            *(*Slurm.node.others, "{PBS_ARRAY_ID}", "{PBS_ARRAY_INDEX}", "{PBS_ARRAYID}", "{PBS_JOBNAME}", "{PBS_QUEUE}"),
            *("{PBS_SERVER}", "{PBS_NODENUM}", "{PBS_NUM_NODES}", "{PBS_WALLTIME}"),
        ),
    )

    def __init__(self, table: ClusterTable) -> None:
        self._table = table
        self._alive: dict[str, tuple[str, ...]] = {}
        """Ids of the living jobs of a name at the last look, if none was submitted since."""
        self._submitted = 0
        """A counter that grows when a submission begins and when it ends. A look in another thread may not have seen the new
        job."""

    @staticmethod
    def refuses(line: str) -> str | None:
        return forbidden_directives.complaint("pbs", line)

    @property
    def requeue(self) -> tuple[str, ...]:
        return self._slurm.requeue if self._dialect is Dialect.SLURM else (shutil.which("qrerun") or "qrerun",)

    @property
    def forgets(self) -> bool:
        return self._dialect is not Dialect.SLURM

    def version(self) -> str:
        dialect, version = self._dialect_and_version
        return f"{dialect} {version}" if dialect is not Dialect.SLURM else f"{self._slurm.version()} (its qsub)"

    def bounds(self) -> Bounds:
        if self._dialect is Dialect.SLURM:
            return self._slurm.bounds()
        server = _first(_output_of("qstat", "-B", "-f"))
        queue = self._table.partition or server.get("default_queue", "")
        return _bounds(server, _queue(queue))

    def script(self, request: Request) -> str:
        return qsub.script(request, self._table, self._dialect)

    def submit(self, request: Request) -> str:
        script = write_whole(request.folder / f"{request.name}.pbs", self.script(request).encode())
        self._forget(request.name)
        try:
            done = self._call_qsub(script)
        finally:
            self._forget(request.name)
        try:
            return _job_id(done, waits=bool(request.after))
        except ConfigError as error:
            raise ConfigError(self.explain(str(error))) from None

    def explain(self, words: str) -> str:
        if self._dialect is Dialect.SLURM:
            return self._slurm.explain(words)
        return about(words, PBS, self._table, self._site)

    def _site(self) -> list[str]:
        """Return the requested or default queue with its limits; if it is unknown, the names of all queues."""
        try:
            name = self._table.partition or _first(_output_of("qstat", "-B", "-f")).get("default_queue", "")
            if queue := _queue(name):
                most = [f"{key.partition('.')[2]} {value}" for key, value in queue.items() if key.startswith("resources_max.")]
                return [f"queue {name} (up to {', '.join(most)})" if most else f"queue {name}"]
            names = [record["id"] for record in qstat.text_records(_output_of("qstat", "-Q", "-f"))]
            return [f"queues {', '.join(names)}"]
        except Missing:
            return []

    def look(self, name: str) -> tuple[Task, ...] | None:
        submitted = self._submitted
        try:
            if self._dialect is Dialect.SLURM:
                return self._slurm.look(name)
            tasks = tuple(qstat.tasks(self._records(name)))
        except Missing:
            return None
        if submitted == self._submitted:
            self._alive[name] = tuple(dict.fromkeys(task.job for task in tasks if task.state is not State.ENDED))
        return tasks

    def cancel(self, name: str, elements: Sequence[int] | None = None) -> None:
        if self._dialect is Dialect.SLURM:
            self._slurm.cancel(name, elements)
            return
        self._forget(name)
        alive = [record for record in self._records(name) if record.get("job_state") not in qstat.ENDED]
        if elements is None:
            ids = list(dict.fromkeys(qstat.name(record["id"]).job for record in alive))
        else:
            ids = [record["id"] for record in alive if qstat.element(record) in elements]
        for start in range(0, len(ids), AT_ONCE):
            done = _call("qdel", *ids[start : start + AT_ONCE])
            if done.returncode and any(not GONE.search(line) for line in done.stderr.splitlines()):
                raise Missing(f"qdel: {_message(done)}")

    def _call_qsub(self, script: Path) -> subprocess.CompletedProcess[str]:
        if self._dialect is not Dialect.SLURM:
            return _call("qsub", script.name, folder=script.parent, timeout=SUBMIT_TIMEOUT_S)
        environment = {name: value for name, value in os.environ.items() if name in FORWARDED} | SYSTEM
        # without these options, the wrapper chooses files for the jobs' output
        words = (shutil.which("qsub") or "qsub", "-j", "oe", "-o", "/dev/null", script.name)
        return _call(*words, folder=script.parent, timeout=SUBMIT_TIMEOUT_S, environment=environment)

    def _forget(self, name: str) -> None:
        self._submitted += 1
        self._alive.pop(name, None)

    @cached_property
    def _dialect_and_version(self) -> tuple[Dialect, str]:
        done = _call("qsub", "--version")
        said = done.stdout + done.stderr
        if match := OPENPBS.search(said):
            return Dialect.OPENPBS, match[1]
        if "Unknown option: version" in said:
            return Dialect.SLURM, ""
        words = _message(done)
        if UNREACHABLE.search(words):
            raise Missing(f"qsub cannot reach its cluster: {words}")
        raise Missing(f"qsub --version names no OpenPBS: {words}")

    @property
    def _dialect(self) -> Dialect:
        return self._dialect_and_version[0]

    @cached_property
    def _slurm(self) -> Scheduler:
        return schedulers.find("slurm")(self._table)

    def _records(self, name: str) -> list[qstat.Record]:
        """Return the caller's jobs of that name, and their elements. Raises Missing if PBS does not answer."""
        alive = self._alive.get(name, ())
        records = self._listed(alive) if alive else None
        if records is None:
            records = self._listed(())
        if records is None:
            raise Missing("qstat does not answer")
        return qstat.own(records, name, _user())

    def _listed(self, ids: Sequence[str]) -> list[qstat.Record] | None:
        """Return all jobs, or those with these ids; None if there is no answer, or if one of the jobs is gone."""
        done = _call("qstat", "-t", "-f", "-F", "json", *ids)
        try:
            return None if done.returncode else list(qstat.json_records(done.stdout))
        except ValueError:
            done = _call("qstat", "-t", "-f", *ids)
            return None if done.returncode else list(qstat.text_records(done.stdout))


def _call(
    *argv: str, folder: Path | None = None, timeout: float = TIMEOUT_S, environment: Mapping[str, str] | None = None
) -> subprocess.CompletedProcess[str]:
    """Run a command and return its outcome. Raises Missing if it does not exist, cannot start or does not end in time."""
    if environment is None:
        environment = {name: value for name, value in os.environ.items() if name in PASSED} | {"LC_ALL": "C"}
    try:
        done = subprocess.run(
            argv,
            cwd=folder,
            env=environment,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            errors="replace",
            timeout=timeout,
            check=False,
        )
        log.command(argv, done.returncode, done.stderr)
        return done
    except FileNotFoundError as error:
        raise Missing(f"{argv[0]} is not installed here; PBS's commands are on login nodes") from error
    except OSError as error:
        raise Missing(f"{argv[0]} cannot be started: {error.strerror}") from error
    except subprocess.TimeoutExpired as error:
        raise Missing(f"{argv[0]} has not answered within {timeout:g} s") from error


def _output_of(*argv: str) -> str:
    done = _call(*argv)
    if done.returncode:
        raise Missing(f"{argv[0]}: {_message(done)}")
    return done.stdout


def _message(done: subprocess.CompletedProcess[str]) -> str:
    """Return a command's error message in one line."""
    said = (done.stderr + "\n" + done.stdout).partition("and the output was:")
    lines = (
        re.sub(r"^(qsub|qstat|qdel|sbatch)(: error)?:\s*", "", line.strip(" \t'")) for line in (said[2] or said[0]).splitlines()
    )
    return "; ".join(filter(None, lines))[:500] or f"exit status {done.returncode}"


def _job_id(done: subprocess.CompletedProcess[str], *, waits: bool) -> str:
    """Return the job's id from the answer of `qsub`. Raises the same errors as `submit`."""
    words = _message(done)
    if not done.returncode:
        ids = [line.strip() for line in done.stdout.splitlines() if JOB.fullmatch(line.strip())]
        if not ids:
            raise Missing(f"qsub did not print a job id: {words}")
        return ids[-1]
    if FULL.search(words):
        raise Full(f"qsub: {words}")
    if UNREACHABLE.search(words):
        raise Missing(f"qsub: {words}")
    if waits and DEPENDENCY.search(words):
        raise Missing(f"qsub: {words}: the job that it depends on is no longer known")
    raise ConfigError(f"qsub refuses: {words}")


def _user() -> str:
    try:
        return pwd.getpwuid(os.geteuid()).pw_name
    except KeyError:
        return os.environ.get("LOGNAME", str(os.geteuid()))


def _first(text: str) -> qstat.Record:
    return next(qstat.text_records(text), {})


def _queue(name: str) -> qstat.Record:
    """Return a queue's attributes; empty if the queue does not exist. `qsub` will refuse it then."""
    done = _call("qstat", "-Q", "-f", name) if name else None
    return _first(done.stdout) if done and not done.returncode else {}


def _bounds(server: qstat.Record, queue: qstat.Record) -> Bounds:
    arrays = [*_numbers(server, queue, names=("max_array_size",))] or [Limit(ARRAY, "the default of max_array_size")]
    jobs = [*_numbers(server, queue, names=("max_queuable",)), *_of_user(server, queue, name="max_queued")]
    running = [*_numbers(server, queue, names=("max_running", "max_user_run")), *_of_user(server, queue, name="max_run")]
    name = "resources_max.walltime"
    walls = [Limit(_seconds(one[name]), _source(one, name)) for one in (server, queue) if name in one]
    return Bounds.of(array=least(*arrays), jobs=least(*jobs), wall_s=least(*walls), running=least(*running))


def _source(record: qstat.Record, name: str) -> str:
    return f"{name} of {record.get('id', 'PBS')}"


def _numbers(*records: qstat.Record, names: Sequence[str]) -> Iterator[Limit]:
    for record, name in itertools.product(records, names):
        if (text := record.get(name, "").strip()).isdigit():
            yield Limit(int(text), _source(record, name))


def _of_user(*records: qstat.Record, name: str) -> Iterator[Limit]:
    """Yield the caller's limits from texts such as `[u:PBS_GENERIC=100], [u:ann=200], [o:PBS_ALL=1000]`."""
    for record in records:
        said = {who: int(limit) for who, limit in re.findall(r"([uo]:[^=\]]+)=(\d+)", record.get(name, ""))}
        for limit in (said.get("o:PBS_ALL"), said.get(f"u:{_user()}", said.get("u:PBS_GENERIC"))):
            if limit is not None:
                yield Limit(limit, _source(record, name))


def _seconds(text: str) -> float:
    """Return the seconds of a duration: a number of seconds, or fields separated by colons, up to days."""
    return sum(float(part) * unit for part, unit in zip(reversed(text.strip().split(":")), (1, 60, 3600, 86400), strict=False))
