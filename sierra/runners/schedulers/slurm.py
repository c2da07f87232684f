"""The scheduler `slurm`: array jobs by sbatch, squeue, scancel and scontrol.

These commands are asked for text formats that are the same in 22.05, 24.11 and 26.05. Their JSON formats are not.

Jobs begin with nothing of the caller's environment, and without the user's login shell, which may take seconds, hang, or hold
secrets too. The environment of sbatch is passed on to the job, and it contains only the user's name, a plain PATH, and
SLURM_CONF. (Many sites don't know `--export=NIL` yet. Every other value except ALL makes each task start a login shell there.)
So variables such as SBATCH_PARTITION or SQUEUE_FORMAT have no effect either. If modules are to be loaded, the site's
/etc/profile is read first.

Jobs ask to be requeued when their node is lost or they are preempted, whatever the site's default is. So they come back by
themselves, even if no process follows them. This does no harm, because an attempt begins by reading what others have recorded.

Also: limits that accounting (slurmdbd) sets for a user of SLURM, by association and by quality of service (QOS).

For each kind of limit, the first one that is set is effective: that of the partition's QOS, of the job's QOS, or of the user's
association. An association inherits its account's limits, except limits on groups. (Source: "Resource Limits" in SLURM's
documentation.) Without accounting, or if accounting enforces nothing, nothing is queried. If accounting cannot be reached,
nothing is known, and sbatch will report what it refuses.
"""

from __future__ import annotations

import math
import os
import pwd
import re
import shlex
import shutil
import subprocess
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import ClassVar

from sierra.config import forbidden_directives
from sierra.config.cluster_table import ClusterTable
from sierra.errors import ConfigError, Full, Missing, SierraError
from sierra.runners.schedulers.base import Bounds, Limit, NodeVariables, Request, State, Task, least
from sierra.runners.schedulers.refusals import SLURM, about
from sierra.util import open_files
from sierra.util.lazy_definitions import dataclass, regex
from sierra.util.lazy_logger import Log
from sierra.util.text import ranges

Ask = Callable[..., str]
"""A function that returns the output of a command with these words; it raises Missing."""
Row = Mapping[str, str]

ASSOCIATION = (*("Account", "Partition", "DefaultQOS", "QOS"), *("MaxSubmitJobs", "GrpSubmitJobs", "MaxJobs", "MaxWall"))
QOS = ("Name", "MaxSubmitJobsPerUser", "MaxSubmitJobsPerAccount", "GrpSubmitJobs", "MaxJobsPerUser", "MaxWall")
USUAL = "normal"
"""The QOS of users who have none."""


@dataclass(frozen=True, slots=True)
class Allowed:
    """The limits of each kind."""

    jobs: Limit | None = None
    running: Limit | None = None
    wall_s: Limit | None = None


@dataclass(frozen=True, slots=True)
class Partitions:
    """The requested partitions, and their QOS."""

    names: tuple[str, ...]
    qos: tuple[str, ...]


def allowed(ask: Ask, config: Row, user: str, table: ClusterTable, partitions: Partitions) -> Allowed:
    """Return the limits of this user. Raises ConfigError for an account or a QOS that the user does not have."""
    enforced = set(re.findall(r"\w+", config.get("AccountingStorageEnforce", "")))
    if not config.get("AccountingStorageType", "").endswith("slurmdbd") or not enforced & {"associations", "limits", "qos"}:
        return Allowed()
    try:
        association = _association(ask, config.get("ClusterName", ""), user, table, partitions)
        names = dict.fromkeys((*partitions.qos, _qos(association, table, strict="qos" in enforced)))
        return _allowed(association, _qualities(ask, names)) if "limits" in enforced else Allowed()
    except Missing:
        return Allowed()


def seconds(text: str) -> float | None:
    """Return the seconds of a limit as SLURM writes it, for example `1-12:00:00`; None if there is no limit."""
    match = re.fullmatch(r"(?:(\d+)-)?(\d+):(\d+):(\d+)", text)
    if match is None:
        return None
    days, hours, minutes, rest = (int(part or 0) for part in match.groups())
    return float(((days * 24 + hours) * 60 + minutes) * 60 + rest)


def _rows(ask: Ask, what: str, columns: Sequence[str], *where: str) -> list[Row]:
    output = ask("sacctmgr", "--noheader", "--parsable2", "show", what, "where", *where, f"format={','.join(columns)}")
    return [
        dict(zip(columns, line.split("|"), strict=True)) for line in output.splitlines() if line.count("|") == len(columns) - 1
    ]


def _association(ask: Ask, cluster: str, user: str, table: ClusterTable, partitions: Partitions) -> Row:
    """Return the association of the requested account, or of the user's default; empty if there is none.

    Raises ConfigError if the user does not have the requested account.
    """
    limits = _rows(ask, "associations", ASSOCIATION, f"user={user}", f"cluster={cluster}")
    accounts = dict.fromkeys(row["Account"].lower() for row in limits)
    if table.account is not None and limits and table.account.lower() not in accounts:
        raise ConfigError(f"account {table.account!r} is not yours on this cluster; you have {', '.join(accounts)}")
    usual = (row["DefaultAccount"] for row in _rows(ask, "user", ("DefaultAccount",), f"name={user}"))
    account = table.account or next(filter(None, usual), next(iter(accounts), ""))
    mine = {row["Partition"]: row for row in limits if row["Account"].lower() == account.lower()}
    return next((mine[name] for name in (*partitions.names, "") if name in mine), {})


def _qos(association: Row, table: ClusterTable, *, strict: bool) -> str:
    """Return the QOS that a job will have. Raises ConfigError if the account does not have the requested one."""
    names = [name for name in association.get("QOS", "").split(",") if name]
    if table.qos is not None and names and strict and table.qos.lower() not in names:
        raise ConfigError(f"QOS {table.qos!r} is not open to account {association['Account']!r}; it has {', '.join(names)}")
    return table.qos or association.get("DefaultQOS") or (names[0] if len(names) == 1 else USUAL)


def _qualities(ask: Ask, names: Mapping[str, object]) -> list[Row]:
    """Return the rows of these qualities of service, in this order."""
    rows = {row["Name"]: row for row in _rows(ask, "qos", QOS, f"name={','.join(names)}")}
    return [rows[name.lower()] for name in names if name.lower() in rows]


def _allowed(association: Row, qualities: Sequence[Row]) -> Allowed:
    def first(of_qos: str, of_association: str = "", read: Callable[[str], float | None] = _number) -> Limit | None:
        sources = [(f"QOS {row['Name']}", row, of_qos) for row in qualities]
        sources.append((f"your association with account {association.get('Account')}", association, of_association))
        limits = ((whose, name, read(row.get(name, ""))) for whose, row, name in sources)
        return next((Limit(most, f"{name} of {whose}") for whose, name, most in limits if most is not None), None)

    return Allowed(
        jobs=least(
            first("MaxSubmitJobsPerUser", "MaxSubmitJobs"),
            first("MaxSubmitJobsPerAccount"),
            first("GrpSubmitJobs", "GrpSubmitJobs"),
        ),
        running=first("MaxJobsPerUser", "MaxJobs"),
        wall_s=first("MaxWall", "MaxWall", seconds),
    )


def _number(text: str) -> float | None:
    return float(text) if text.isdigit() else None


log = Log(__name__)

TIMEOUT_S = 20.0
POLL_S = 0.5
PATH = "/usr/local/bin:/usr/bin:/bin"
KEPT = ("SLURM_CONF",)
"""Variables of the caller's environment that are kept, because they locate the cluster."""

TASK_FORMAT = "%F|%K|%T|%N|%r"
"""The array's job id, the index, the state, the node and the reason. The reason is free text, and so comes last."""
KINDS, SHOWN_KINDS = "%P|%a|%l|%c|%m|%G|%f", 4
"""The partition (`*`: the default), whether it is up, its time limit, and its nodes' cores, MB, resources and features."""
TASK_LINE = regex(r"^(\d+)\|([^|]*)\|([A-Z_]+)\|([^|]*)\|(.*)$", re.MULTILINE)

ENDED = frozenset({"BOOT_FAIL", "CANCELLED", "COMPLETED", "DEADLINE", "FAILED", "LAUNCH_FAILED", "NODE_FAIL"}) | frozenset(
    {"OUT_OF_MEMORY", "PREEMPTED", "RECONFIG_FAIL", "REVOKED", "TIMEOUT"}
)
WAITING = frozenset({"PENDING", "REQUEUED", "REQUEUE_FED"})
HELD = frozenset({"SPECIAL_EXIT", "REQUEUE_HOLD", "RESV_DEL_HOLD"})

NEVER = regex(
    r"PartitionConfig|PartitionNodeLimit|PartitionTimeLimit|BadConstraints"
    r"|InvalidAccount|InvalidQOS|AccountNotAllowed|QOSNotAllowed|.*not permitted|.*can't use this partition"
    r"|(Assoc|QOS)Max\w+Per(Job|Node)(Limit)?|QOSMin\w+"
    r"|MaxMemPerLimit|DependencyNeverSatisfied|ReservationDeleted|JobHeldAdmin|JobHoldMaxRequeue|.*requeued\b.*\bheld\b"
)
"""Reasons that never resolve without another request. Reasons that may resolve are not included: limits on many jobs together
(AssocMaxJobs…, QOSGrp…), partitions and nodes that are down, licenses, begin times, and JobHeldUser (the user can release the
job)."""

BUSY = regex(r"temporarily unable to accept job|job queue full")
"""Words of sbatch when it keeps trying for two minutes."""
LIMIT = regex(r"(Max|Grp)SubmitJob")
"""Words for a violated limit on the number of jobs that are there at a time."""
UNREACHABLE = regex(
    r"unable to contact|timed out|zero bytes|communication|authentication|munge|configuration (source|file)"
    r"|in standby|unexpected message|connection (refused|reset)",
    re.IGNORECASE,
)
SUBMITTED = regex(r"^(\d+)(;\S+)?$", re.MULTILINE)
"""The answer of sbatch; in a federation, with the cluster."""


class Slurm:
    """The scheduler `slurm`."""

    name = "slurm"
    Options: ClassVar[type[ClusterTable]] = ClusterTable

    node: ClassVar[NodeVariables] = NodeVariables(
        task=("{SLURM_ARRAY_JOB_ID}_{SLURM_ARRAY_TASK_ID}", "{SLURM_JOB_ID}"),
        job=("{SLURM_JOB_ID}",),
        restarts=("{SLURM_RESTART_COUNT}",),
        host=("{SLURMD_NODENAME}",),
        cores=("{SLURM_CPUS_PER_TASK}", "{SLURM_CPUS_ON_NODE}"),
        memory_mib=("{SLURM_MEM_PER_NODE}", "{SLURM_MEM_PER_CPU}*{SLURM_CPUS_ON_NODE}", "{SLURM_MEM_PER_CPU}"),
        gpus=("{SLURM_JOB_GPUS}",),
        scratch=("{SLURM_TMPDIR}",),
        end=("{SLURM_JOB_END_TIME}",),
        others=(
            *("{SLURM_JOB_NAME}", "{SLURM_CLUSTER_NAME}", "{SLURM_JOB_PARTITION}", "{SLURM_JOB_ACCOUNT}", "{SLURM_JOB_QOS}"),
            *("{SLURM_JOB_CONSTRAINTS}", "{SLURM_JOB_NODELIST}", "{SLURM_JOB_CPUS_PER_NODE}", "{SLURM_GPUS_ON_NODE}"),
            "{SLURM_JOB_START_TIME}",
        ),
    )

    forgets = False

    def __init__(self, table: ClusterTable) -> None:
        self._table = table

    @staticmethod
    def refuses(line: str) -> str | None:
        return forbidden_directives.complaint("slurm", line)

    @property
    def requeue(self) -> tuple[str, ...]:
        return shutil.which("scontrol") or "scontrol", "requeue"

    def version(self) -> str:
        return f"slurm {_output_of('sbatch', '--version').split()[-1]}"

    def bounds(self) -> Bounds:
        output = _output_of("scontrol", "show", "config")
        config = dict(re.findall(r"^(\w+) *= (.*)$", output, re.MULTILINE))
        parameters = config.get("SchedulerParameters", "")
        chosen = self._partitions(_output_of("scontrol", "--all", "--oneliner", "show", "partition"))
        user = pwd.getpwuid(os.geteuid()).pw_name
        granted = allowed(_output_of, config, user, self._table, _requested_partitions(chosen))
        walls = [_limit(seconds(line.get("MaxTime", "")), f"MaxTime of partition {name}") for name, line in chosen.items()]
        return Bounds.of(
            array=least(
                _limit(config.get("MaxArraySize", ""), "MaxArraySize"),
                *(_limit(number, "max_array_tasks") for number in re.findall(r"max_array_tasks=(\d+)", parameters)),
            ),
            jobs=least(_limit(config.get("MaxJobCount", ""), "MaxJobCount"), granted.jobs),
            wall_s=least(*walls, granted.wall_s),
            running=granted.running,
        )

    def script(self, request: Request) -> str:
        modules = [f"module load {shlex.quote(name)} || exit 3" for name in self._table.modules]
        command = [*map(shlex.quote, request.command), '"$SLURM_ARRAY_TASK_ID"']
        lines = [
            "#!/bin/bash" if modules else "#!/bin/sh",
            *(f"#SBATCH {directive}" for directive in self._directives(request)),
            *([". /etc/profile", *modules] if modules else []),
            f"cd {shlex.quote(str(request.folder))} || exit 3",
            f"exec {' '.join(command)}",
        ]
        return "\n".join((*lines, ""))

    def submit(self, request: Request) -> str:
        status, out, err = _submit(self.script(request), request.folder)
        if status == 0:
            if answers := [answer[1] for answer in SUBMITTED.finditer(out)]:  # a site's own program may print numbers before
                return answers[-1]
            raise Missing(f"sbatch did not print a job id, but {_one_line(out + err)!r}; it is unknown whether the job exists")
        if not err.strip():
            raise Missing(f"sbatch ended with status {status} and without a message")
        raise self._explained(refusal(err))

    def explain(self, words: str) -> str:
        return about(words, SLURM, self._table, self._site)

    def _explained(self, error: SierraError) -> SierraError:
        return ConfigError(self.explain(str(error))) if isinstance(error, ConfigError) else error

    def _site(self) -> list[str]:
        """Return the requested (or default) partitions by kinds of nodes; if they do not exist, the names of all partitions."""
        try:
            output = _output_of("sinfo", "--noheader", "--all", f"--format={KINDS}")
        except Missing:
            return []
        kinds = [line.split("|", 6) for line in output.splitlines() if line.count("|") >= 6]
        requested = self._table.partition.split(",") if self._table.partition else []
        chosen = [kind for kind in kinds if (kind[0].rstrip("*") in requested if requested else kind[0].endswith("*"))]
        names = dict.fromkeys(kind[0].rstrip("*") for kind in kinds)
        return [_kind(*kind) for kind in chosen[:SHOWN_KINDS]] or [f"partitions {', '.join(names)}"]

    def look(self, name: str) -> tuple[Task, ...] | None:
        own = (f"--user={os.geteuid()}", f"--name={name}")
        try:
            return tasks(
                _output_of("squeue", "--noheader", "--all", "--array", "--states=all", *own, f"--format={TASK_FORMAT}")
            )
        except Missing:
            return None

    def cancel(self, name: str, elements: Sequence[int] | None = None) -> None:
        if elements is None:
            _output_of("scancel", f"--user={os.geteuid()}", f"--name={name}")
            return
        found = self.look(name)
        if found is None:
            raise Missing("SLURM cannot be reached to cancel array tasks; run the command again later")
        if jobs := _array_tasks(task for task in found if task.element in set(elements) and task.state != State.ENDED):
            _output_of("scancel", *jobs)

    def _directives(self, request: Request) -> Iterator[str]:
        """Yield the table's settings, then the user's directives, then what must hold. The last of two equal options wins."""
        yield from ("--requeue", "--nodes=1", "--ntasks=1", *self._requested())
        yield from self._table.directives
        yield f"--job-name={request.name}"
        yield f"--comment={_quoted(' '.join(request.comment.split()))}"
        yield f"--array={ranges(request.elements)}"
        yield f"--chdir={_quoted(str(request.folder))}"
        yield f"--output={_quoted(_pattern(request.logs) + '/%A_%a.out')}"
        yield "--open-mode=append"
        if request.after:
            yield f"--dependency=afterok:{request.after}"
            yield "--kill-on-invalid-dep=yes"

    def _requested(self) -> Iterator[str]:
        table = self._table
        yield f"--cpus-per-task={table.cpus}"
        for name in ("partition", "account", "qos", "constraint"):
            if (value := getattr(table, name)) is not None:
                yield f"--{name}={_quoted(value)}"
        if table.gpus is not None:
            yield f"--gres=gpu:{table.gpus}"
        if table.memory is not None:
            yield f"--mem={math.ceil(table.memory / 2**20)}M"
        if table.wall is not None:
            yield f"--time={math.ceil(table.wall / 60)}"

    def _partitions(self, output: str) -> dict[str, dict[str, str]]:
        """Return the requested partitions, or the site's default. Raises ConfigError for an unknown partition."""
        known = {line["PartitionName"]: line for line in map(_fields, output.splitlines()) if "PartitionName" in line}
        requested = (self._table.partition or "").split(",") if self._table.partition else []
        if unknown := [name for name in requested if name not in known]:
            raise ConfigError(f"SLURM has no partition {unknown[0]!r}; it has {', '.join(known)}")
        if not requested:
            return {name: line for name, line in known.items() if line.get("Default") == "YES"}
        return {name: line for name, line in known.items() if name in requested}


def tasks(output: str) -> tuple[Task, ...]:
    """Return the tasks in squeue's output in TASK_FORMAT."""
    return tuple(_task(*match.groups()) for match in TASK_LINE.finditer(output))


def _task(job: str, element: str, word: str, node: str, reason: str) -> Task:
    state = _state(word, reason)
    shown = word if state == State.ENDED else "" if reason == "None" else reason
    cancelled = word == "CANCELLED" if state == State.ENDED else None
    return Task(job, int(element) if element.isdigit() else None, state, shown, node, cancelled)


def _state(word: str, reason: str) -> State:
    """Return the state for SLURM's word. A task in an unknown state may be alive."""
    if word in ENDED:
        return State.ENDED
    if word in HELD or (word in WAITING and NEVER.match(reason)):
        return State.STUCK
    return State.QUEUED if word in WAITING else State.RUNNING


def refusal(message: str) -> SierraError:
    """Return the error for sbatch's message when it does not accept a job."""
    kind = Full if LIMIT.search(message) or BUSY.search(message) else Missing if UNREACHABLE.search(message) else ConfigError
    return kind(f"SLURM: {_one_line(message)}")


def _kind(partition: str, state: str, limit: str, cores: str, megabytes: str, resources: str, features: str) -> str:
    """Return a description of one kind of nodes in a partition."""
    more = [text for text in (resources, features) if text != "(null)"]
    nodes = ", ".join((f"nodes of {cores} cores", f"{megabytes} MB", *more))
    return f"partition {partition.rstrip('*')} ({'' if state == 'up' else f'{state}, '}up to {limit}): {nodes}"


def _array_tasks(found: Iterable[Task]) -> list[str]:
    """Return the elements as scancel takes them, grouped by job: `12_[0-5,7]`."""
    jobs: dict[str, list[int]] = {}
    for task in found:
        jobs.setdefault(task.job, []).append(task.element or 0)
    return [f"{job}_[{ranges(sorted(set(elements)))}]" for job, elements in jobs.items()]


def _pattern(folder: Path) -> str:
    """Return a folder's name for use before a file name pattern of SLURM. A backslash in it would turn the pattern off.

    Raises ConfigError for such a name.
    """
    if "\\" in str(folder):
        raise ConfigError(f"SLURM cannot write the output of jobs to {str(folder)!r}; use a name without a backslash")
    return str(folder).replace("%", "%%")


def _quoted(text: str) -> str:
    """Return a value in quotes as sbatch reads it: unlike a shell, to the line's end. Raises ConfigError for a line feed."""
    if "\n" in text:
        raise ConfigError(f"SLURM does not accept {text!r}; use a name without a line feed")
    return '"' + re.sub(r'(["\\])', r"\\\1", text) + '"'


def _fields(line: str) -> dict[str, str]:
    return dict(word.split("=", 1) for word in line.split() if "=" in word)


def _requested_partitions(chosen: Mapping[str, Mapping[str, str]]) -> Partitions:
    qualities = (line.get("QoS", "N/A") for line in chosen.values())
    return Partitions(tuple(chosen), tuple(name for name in qualities if name != "N/A"))


def _limit(most: str | float | None, whose: str) -> Limit | None:
    """Return the limit; None if `most` is not a number."""
    if isinstance(most, str):
        most = float(most) if most.isdigit() else None
    return None if most is None else Limit(most, whose)


def _submit(script: str, folder: Path) -> tuple[int, str, str]:
    """Return sbatch's exit status, output and error output.

    Raises Full if sbatch waits to be accepted, and Missing if it does not answer in time.
    """
    argv = (_program("sbatch"), "--parsable")
    pipe = subprocess.PIPE
    with subprocess.Popen(argv, stdin=pipe, stdout=pipe, stderr=pipe, env=_environment(), cwd=folder) as process:
        open_files.restore(process.pid)  # before it gets the script: SLURM gives jobs the limits of sbatch
        give_up = time.monotonic() + TIMEOUT_S
        given: bytes | None = script.encode()
        while True:
            try:
                out, err = process.communicate(given, timeout=POLL_S)
                log.command(argv, process.returncode, err.decode(errors="replace"))
                return process.returncode, out.decode(errors="replace"), err.decode(errors="replace")
            except subprocess.TimeoutExpired as waiting:
                given = None
                message = (waiting.stderr or b"").decode(errors="replace")
                if BUSY.search(message):
                    process.kill()
                    raise refusal(message) from None
                if time.monotonic() > give_up:
                    process.kill()
                    raise Missing(f"SLURM does not answer sbatch within {TIMEOUT_S:.0f} s: {_one_line(message)}") from None


def _output_of(program: str, *words: str) -> str:
    """Return the output of one of SLURM's commands. Raises Missing, with the command's message, if it fails."""
    try:
        done = subprocess.run(
            (_program(program), *words),
            env=_environment(),
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            errors="replace",
            timeout=TIMEOUT_S,
            check=False,
        )
    except subprocess.TimeoutExpired:
        raise Missing(f"SLURM does not answer {program} within {TIMEOUT_S:.0f} s") from None
    log.command((program, *words), done.returncode, done.stderr)
    if done.returncode != 0:
        raise Missing(f"SLURM: {_one_line(done.stderr or done.stdout)}")
    return done.stdout


def _program(name: str) -> str:
    path = shutil.which(name)
    if path is None:
        raise Missing(f"{name} is not installed here; run the command on a host from which jobs are submitted to SLURM")
    return path


def _environment() -> dict[str, str]:
    """Return the whole environment of SLURM's commands, with which jobs begin too."""
    kept = {name: os.environ[name] for name in KEPT if name in os.environ}
    user = pwd.getpwuid(os.geteuid())
    return {**kept, "PATH": PATH, "HOME": user.pw_dir, "USER": user.pw_name, "LOGNAME": user.pw_name}


def _one_line(message: str) -> str:
    """Return a command's error message in one line."""
    lines = [re.sub(r"^\w+: (error: |fatal: )?", "", line.strip()) for line in message.splitlines()]
    return "; ".join(dict.fromkeys(line for line in lines if line and not line.startswith("Try ")))
