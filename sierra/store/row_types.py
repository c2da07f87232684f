"""The rows of the recorded tables: a class for each table, with all facts about each column beside it.

A column's annotation gives the type of its values, its meaning, its unit if it has one, and further facts: the object with
which a record is removed or copied (`Of`, `About`), the records that it names (`To`), how anonymous packages show its values
(`Redaction`), `KEY` and `LATER`.
The store's schema is made from these classes (see `sierra.store.schema`), and records are written and read as their
instances. A column whose type allows None can be NULL.

A column of texts must say how it is redacted, so its type is one of the names below. By default, times are moved and numbers
are kept.
"""

from datetime import datetime
from enum import Enum, auto
from typing import Annotated, NamedTuple


class Of(Enum):
    """An object in this column has the record: it is copied into another store with the object, and removed with it."""

    EXECUTION = auto()
    JUDGEMENT = auto()
    SESSION = auto()


class About(Enum):
    """The record is about an object in this column: it is removed with the object, and not copied with it."""

    EXECUTION = auto()
    BATCH = auto()
    REPLAY = auto()
    LOOK = auto()
    STUDY = auto()
    CLAIM = auto()
    IMPORTED_SESSION = auto()
    BUILD = auto()
    BLOB = auto()


class To(Enum):
    """The value, or each value of a list, names a record: it is removed with the last row that names it.

    The value of a member is the table of these records and its column with the name. A table comes after those that name it.
    """

    SPEC = ("specs", "spec")
    BUILD = ("builds", "build")
    SHARED_FILES = ("shared_files", "shared")
    SOURCE = ("sources", "source")
    """Specs name the tree, and so all sources that have it."""
    IMAGE = ("images", "image")
    """A spec also names the variants of its image."""
    FILES_READ = ("files_read", "files")
    LISTING = ("listings", "sha256")
    INGEST_RULES = ("ingest_rules", "ingest_rules")
    ENVIRONMENT = ("environments", "environment")
    ISOLATION = ("isolations", "isolation")
    PROGRAMS = ("programs", "programs")
    IMPORT = ("imports", "package")
    REDACTION = ("redactions", "session")
    OBJECT = ("objects", "sha256")

    def __init__(self, table: str, key: str) -> None:
        self.table = table
        self.key = key


class Key(Enum):
    """The column identifies a record of a table to which two writers may add the same one; views show it once."""

    YES = auto()


class Later(Enum):
    """The column was added within the present format of the store: older files lack it, and its values are NULL there."""

    YES = auto()


class Redaction(Enum):
    """The way in which the values of a column are shown in anonymous packages.

    TIME          all times are moved by one duration, so that the last one is midnight of the package's date: durations stay
    HOST          host-1, host-2, …: the same name for the same host everywhere
    ROBOT         robot-1, robot-2, …: the name of a robot
    PACKAGE       package-1, package-2, …: the id of an imported package, which may be published with names
    ATTEMPT       attempt-1, attempt-2, …: the original has the names of a job and of a node
    PLACE         the folder of a path, unless it is in the project or belongs to the system: /redacted/1/argos3
    HIDDEN        the text "redacted"
    NOTHING       NULL
    ENVIRONMENT, SOURCE, ISOLATION      the id of such a record, which follows from its rewritten columns
    ROW           a value that depends on others of its row: see `sierra.packages.anonymity.redact_rows`
    """

    KEEP = auto()
    TIME = auto()
    HOST = auto()
    ROBOT = auto()
    PACKAGE = auto()
    ATTEMPT = auto()
    HIDDEN = auto()
    PLACE = auto()
    NOTHING = auto()
    ENVIRONMENT = auto()
    SOURCE = auto()
    ISOLATION = auto()
    ROW = auto()


KEY = Key.YES
LATER = Later.YES

Kept = Annotated[str, Redaction.KEEP]
HostName = Annotated[str, Redaction.HOST]
RobotName = Annotated[str, Redaction.ROBOT]
PackageId = Annotated[str, Redaction.PACKAGE]
AttemptId = Annotated[str, Redaction.ATTEMPT]
Hidden = Annotated[str, Redaction.HIDDEN]
PathName = Annotated[str, Redaction.PLACE]
Dropped = Annotated[str, Redaction.NOTHING]
EnvironmentId = Annotated[str, Redaction.ENVIRONMENT, To.ENVIRONMENT]
SourceId = Annotated[str, Redaction.SOURCE, To.SOURCE]
IsolationId = Annotated[str, Redaction.ISOLATION, To.ISOLATION]
Rewritten = Annotated[str, Redaction.ROW]


class BatchRow(NamedTuple):
    """Batches: the ordered set of experiments that a query expands to."""

    batch: Annotated[Kept, "the batch's id: a Merkle hash over its experiments", About.BATCH, KEY]
    created: Annotated[datetime, "when it was first submitted"]
    query: Annotated[Kept, "the criteria as they were first submitted"]
    axes: Annotated[list[Kept], "names of the independent variables, in order"]
    controller: Annotated[Kept | None, "the controller; NULL if none was named"]
    scenario: Annotated[Kept | None, "the scenario; NULL if none was named"]
    overrides: Annotated[list[Kept], "the further values that were set for all runs, each as XPATH=VALUE"]
    platform: Annotated[Kept, "the platform, which drives the simulator"]
    experiments: Annotated[int, "number of its experiments", "1"]
    runs: Annotated[int, "number of its runs in all experiments together", "1"]
    base_seed: Annotated[int, "the number that all seeds derive from"]
    spec: Annotated[Kept, "the specification that all its runs share"]
    template: Annotated[Kept, "the template's path in the project"]
    template_sha256: Annotated[Kept, "SHA-256 of the template file"]
    lamport: Annotated[int, "its position in the logical order, as in sessions"]


class ExperimentRow(NamedTuple):
    """Points in the space of the independent variables; each variable is a further column here."""

    experiment: Annotated[Kept, "the experiment's id: a Merkle hash over its values and runs"]
    batch: Annotated[Kept, "the batch that it belongs to", About.BATCH, KEY]
    ordinal: Annotated[int, "its position in the batch, from 0", KEY]


class BatchRunRow(NamedTuple):
    """The runs of each experiment of each batch; a run may belong to several."""

    batch: Annotated[Kept, "the batch", About.BATCH]
    ordinal: Annotated[int, "the experiment's position in the batch, from 0"]
    number: Annotated[int, "the run's number in the experiment, from 0"]
    run: Annotated[Kept, "the run"]
    seed: Annotated[int, "its seed"]
    input: Annotated[Kept, "SHA-256 of its first input file; the file itself is in objects", To.OBJECT]
    other_inputs: Annotated[list[Kept], "SHA-256 of its other input files, which specs.files names", To.OBJECT]
    spec: Annotated[Kept, "the specification that it shares with the other runs of the batch", To.SPEC]


class SpecRow(NamedTuple):
    """Run specifications, which runs share: a spec, inputs and a seed make a run."""

    spec: Annotated[Kept, "the spec's id", KEY]
    platform: Annotated[Kept, "the platform, which drives the simulator"]
    command: Annotated[list[Kept], "program and arguments, before paths of this machine are inserted"]
    variables: Annotated[Kept, "declared environment variables, as JSON"]
    source: Annotated[Kept | None, "the tree of the code (an SWHID); NULL if the runs have no source", To.SOURCE]
    image: Annotated[Kept | None, "content identity of the container image; NULL without one", To.IMAGE]
    host_access: Annotated[
        list[Kept], "access of runs to the host, outside the image: network, gpu, each device and each mount"
    ]
    files: Annotated[list[Kept], "names of the input files that each run gets"]
    named_inputs: Annotated[
        list[Kept] | None, "those of the files that are part of the spec's id; NULL or empty: none", LATER
    ] = None
    shared_files: Annotated[
        Kept | None, "the files beside the inputs, as in shared_files; NULL: none", LATER, To.SHARED_FILES
    ] = None
    around: Annotated[
        Kept | None, "services and the commands before and after the run's command, as JSON; NULL if there are none", LATER
    ] = None
    robots: Annotated[
        Kept | None,
        "commands of groups of places on robots that differ from command, as JSON; NULL for runs without robots",
        LATER,
    ] = None


class ExecutionRow(NamedTuple):
    """Executions of runs: when, where and by which programs each run was executed, and how it ended.

    If an execution was evaluated again by changed rules, status, reason and ingest_rules are those of the last evaluation;
    the table all_judgements has all evaluations.
    """

    execution: Annotated[Kept, "the execution's id", Of.EXECUTION]
    run: Annotated[Kept, "the run"]
    session: Annotated[Kept, "the session that executed it", To.REDACTION]
    batch: Annotated[Kept, "the batch that it was executed for"]
    started: Annotated[datetime, "when its program started"]
    ended: Annotated[datetime, "when its program ended"]
    status: Annotated[
        Kept,
        "ok, accepted (an end that [success] accept names), failed, timeout, memory, cpu, output, mismatch, stopped (by the "
        "operator), interrupted, or invalid (see trials)",
    ]
    reason: Annotated[Kept | None, "why the status is not ok, in one line; of an accepted end, this end"]
    exit_code: Annotated[int | None, "the program's exit status; NULL if a signal ended it"]
    signal: Annotated[int | None, "the signal that ended it; NULL if none did"]
    wall_s: Annotated[float, "time from start to end", "s"]
    user_s: Annotated[
        float | None, "CPU time in user mode of all its processes that ended; in a container, measured from outside", "s"
    ]
    system_s: Annotated[float | None, "CPU time in kernel mode, measured in the same way", "s"]
    max_rss_bytes: Annotated[
        int | None,
        "peak resident memory of its largest process (at least the worker's); in a container, measured from outside",
        "bytes",
    ]
    host: Annotated[HostName, "host name"]
    slot: Annotated[int, "the slot of the worker that executed it"]
    result: Annotated[Kept, "Merkle hash of the names and digests of its outputs"]
    log_tail: Annotated[Kept | None, "the end of its standard error, or of its standard output if standard error is empty"]
    environment: Annotated[EnvironmentId, "the environment in which it ran"]
    programs: Annotated[Kept, "fingerprint of the programs outside source and image", To.PROGRAMS]
    ingest_rules: Annotated[
        Kept, "hash of the rules by which it was evaluated: [outputs] and [success] of the project", To.INGEST_RULES
    ]
    purpose: Annotated[Kept, "run, replay or capture; only executions for run count in statistics"]
    isolation: Annotated[IsolationId | None, "how it was isolated in a container; NULL if it was not"]
    attempt: Annotated[AttemptId | None, "on a cluster, the attempt at an array task that executed it; NULL otherwise"]
    lamport: Annotated[int, "its position in the logical order, as in sessions"]
    gpus: Annotated[
        list[Dropped] | None, "the GPUs that it was given, by index or UUID; NULL or empty: none was given to it", LATER
    ] = None
    gpu_limit: Annotated[
        float | None,
        "[limits] gpus by which it was given them; below 1 it was a share of one, and XLA_PYTHON_CLIENT_MEM_FRACTION was 0.9 "
        "times the share unless declared",
        "1",
        LATER,
    ] = None
    gpu_s: Annotated[
        float | None,
        "time in which its processes kept these GPUs busy, sampled each second; NULL if unknown (no NVML, MIG, in a shared "
        "container, or too short)",
        "s",
        LATER,
    ] = None
    gpu_memory_bytes: Annotated[
        int | None, "peak memory of its processes on GPUs, sampled in the same way; NULL if unknown", "bytes", LATER
    ] = None


class AttemptRow(NamedTuple):
    """Attempts on clusters: each time that an array task, which has a share of a batch's runs, was executed on a node."""

    attempt: Annotated[AttemptId, "the attempt's id"]
    session: Annotated[Kept, "the session that it belongs to", Of.SESSION]
    batch: Annotated[Kept, "the batch", About.BATCH]
    array_task: Annotated[int, "the index of the array task; a session with n array tasks gives each of them every n-th run"]
    scheduler: Annotated[Kept | None, "the scheduler that started it, with its version"]
    job: Annotated[Dropped | None, "the scheduler's id of the job, or of this task of the job"]
    node: Annotated[HostName, "host name of the node"]
    started: Annotated[datetime, "when it started"]
    ended: Annotated[datetime, "when it last recorded something"]
    clock_offset_s: Annotated[
        float | None,
        "how far the node's clock was ahead of the shared file system's clock; if over 2 s, all times are by the "
        "file system's clock",
        "s",
    ]
    cpus: Annotated[int | None, "cores that were allocated to it", "1"]
    memory: Annotated[int | None, "memory that was allocated to it; NULL if unknown", "bytes"]
    gpus: Annotated[Kept | None, "GPUs that were allocated to it, by the scheduler's names"]
    allocation: Annotated[Dropped | None, "other facts that the scheduler reported on the node, as JSON"]
    runs: Annotated[int, "runs that it executed to their end", "1"]
    interrupted_runs: Annotated[int, "runs that it started and did not finish", "1"]
    state: Annotated[Kept, "finished, or cut off"]
    error: Annotated[Kept | None, "why it could not continue, as reported by itself or else by the scheduler"]
    environment: Annotated[EnvironmentId | None, "the environment in which it ran"]


class RobotRow(NamedTuple):
    """Robots of executions: which robot had which place in a run, its host and its clock, and how its part ended.

    The view robot_clocks converts stamps of the robots to one time axis.
    """

    execution: Annotated[Kept, "the execution", Of.EXECUTION]
    place: Annotated[int, "its place in the run: 1, 2, …; 0 is the base station"]
    robot_group: Annotated[Kept, "the group of its place: robot, base, or a name in [robots.groups]"]
    robot: Annotated[RobotName, "the robot's name in the fleet"]
    status: Annotated[Kept, "how its part ended: ok, failed, stopped, or lost"]
    reason: Annotated[Kept | None, "what happened to it, in one line; NULL if nothing did"] = None
    host: Annotated[HostName | None, "host name that it reported"] = None
    machine: Annotated[Kept | None, "architecture of its processor, such as aarch64"] = None
    processor: Annotated[Kept | None, "model of its processor"] = None
    kernel: Annotated[Kept | None, "release and version of its kernel"] = None
    boot_id: Annotated[Dropped | None, "id of the boot of its kernel; another id shows that it was started again"] = None
    environment: Annotated[EnvironmentId | None, "its environment, as in environments; NULL if none is recorded"] = None
    firmware: Annotated[Kept | None, "the version of its firmware, as it was reported"] = None
    calibration_sha256: Annotated[Kept | None, "SHA-256 of its calibration file"] = None
    battery_start: Annotated[float | None, "charge of its battery before the run", "%"] = None
    battery_end: Annotated[float | None, "charge of its battery after the run", "%"] = None
    offset_start_ns: Annotated[int | None, "its clock minus the clock of the submitting host, before the run", "ns"] = None
    offset_end_ns: Annotated[int | None, "its clock minus the clock of the submitting host, after the run", "ns"] = None
    clock_start_ns: Annotated[
        int | None, "its clock when the first offset was measured, since 1970-01-01 UTC", "ns", Redaction.NOTHING
    ] = None
    clock_end_ns: Annotated[
        int | None, "its clock when the last offset was measured, since 1970-01-01 UTC", "ns", Redaction.NOTHING
    ] = None
    rtt_ns: Annotated[int | None, "round-trip time of these measurements; offsets are uncertain by half of it", "ns"] = None
    start_skew_ns: Annotated[
        int | None, "start of its program minus the common start, by the submitting host's clock", "ns"
    ] = None
    started: Annotated[
        datetime | None,
        "when its program started, or the engine of its container if the image has no /bin/sh, by the submitting host's clock",
    ] = None
    ended: Annotated[datetime | None, "when its program ended, by the submitting host's clock"] = None
    exit_code: Annotated[int | None, "exit status of its program; NULL if a signal ended it or it is unknown"] = None
    signal: Annotated[int | None, "the signal that ended its program; NULL if none did"] = None
    isolation: Annotated[
        IsolationId | None, "its isolation, as in isolations, with the version of its engine; NULL without a container", LATER
    ] = None
    clock_remark: Annotated[
        Kept | None, "why its stamps cannot be converted: a clock was set during the run; NULL if they can", LATER
    ] = None
    uneven_ns: Annotated[
        int | None,
        "largest error of a line through both offsets, because clocks did not move evenly; NULL without two",
        "ns",
        LATER,
    ] = None


class TrialRow(NamedTuple):
    """Supervised executions, each with the last remark on it; the table all_trials has all remarks.

    An execution whose last remark is that it is not valid has the status invalid. It counts nowhere, and its run is executed
    again.
    """

    execution: Annotated[Kept, "the execution", Of.EXECUTION]
    marked: Annotated[datetime, "when the remark was made"]
    valid: Annotated[bool | None, "whether the trial counts; NULL if nobody decided, and then it counts"]
    reason: Annotated[Kept | None, "why it is not valid, in one line"] = None
    note: Annotated[Kept | None, "a free note"] = None
    operator: Annotated[Hidden | None, "who supervised it"] = None
    block: Annotated[int | None, "the block of the randomised order of trials, from 0"] = None
    position: Annotated[int | None, "its position in the order of trials, from 0"] = None
    poses: Annotated[Kept | None, "the poses at which robots were placed, as JSON"] = None
    arena: Annotated[Kept | None, "the name or version of the arena"] = None
    order_rule: Annotated[Kept | None, "how the order of trials was made: blocked, random or as-designed"] = None
    order_seed: Annotated[int | None, "the number that the order derives from"] = None
    stopped: Annotated[bool | None, "whether the operator stopped it; NULL if that is not known"] = None
    facts: Annotated[Dropped | None, "what declared commands printed before the trial, by name, as JSON"] = None
    files: Annotated[Kept | None, "SHA-256 of declared files before the trial, by path, as JSON"] = None
    lamport: Annotated[int, "position of the remark in the logical order, as in sessions"] = 0


class DuplicateRow(NamedTuple):
    """Runs that were executed once more than requested, because two attempts at one array task ran at the same time."""

    execution: Annotated[Kept, "the run's recorded execution: the one that was seen first", Of.EXECUTION]
    run: Annotated[Kept, "the run"]
    attempt: Annotated[AttemptId, "the attempt that executed the copy"]
    result: Annotated[Kept, "Merkle hash of the copy's outputs, as in executions"]
    same: Annotated[bool, "whether these outputs equal the recorded execution's"]


class IsolationRow(NamedTuple):
    """Isolations: how executions were isolated in containers, each recorded once."""

    isolation: Annotated[Rewritten, "hash of all columns below", KEY]
    engine: Annotated[Kept, "the container engine"]
    version: Annotated[Kept | None, "versions of the engine and of the program with which it starts containers"]
    rootless: Annotated[bool | None, "whether the engine ran without root privileges"]
    mode: Annotated[Kept, "run: one container for each run; worker: one container for all runs of a slot (weaker isolation)"]
    image: Annotated[Kept, "content identity of the image"]
    user: Annotated[Rewritten | None, "the user that a container's processes have on the host"]
    network: Annotated[Kept, "none, host, not isolated (none was requested but is not possible here), or unknown"]
    devices: Annotated[list[Kept], "devices of the host that runs could use; gpu stands for NVIDIA GPUs"]
    mounts: Annotated[
        Rewritten | None, "files and folders of the host that runs could read, as JSON: path in the container, path on the host"
    ]
    limits_asked: Annotated[Kept | None, "limits that were requested of the engine, as JSON: memory in bytes, cpus, pids"]
    limits_enforced: Annotated[
        Kept | None, "limits that the engine enforces here; others are ignored, except memory, which the worker then monitors"
    ]
    argv: Annotated[list[Rewritten], "the command that starts a container, without the parts that differ for each run"]


class JudgementRow(NamedTuple):
    """Later evaluations of recorded executions: by changed rules, from the recorded files, without executing anything."""

    judgement: Annotated[Kept, "the judgement's id", Of.JUDGEMENT]
    execution: Annotated[Kept, "the execution", Of.EXECUTION]
    run: Annotated[Kept, "its run"]
    session: Annotated[Kept, "the session that evaluated it again"]
    batch: Annotated[Kept, "the batch for which it was evaluated"]
    judged_at: Annotated[datetime, "when it was evaluated"]
    status: Annotated[Kept, "as in executions"]
    reason: Annotated[Kept | None, "why the status is not ok, in one line"]
    ingest_rules: Annotated[Kept, "hash of the rules: [outputs] and [success] of the project", To.INGEST_RULES]
    lamport: Annotated[int, "its position in the logical order, as in sessions"]


class FindingRow(NamedTuple):
    """Problems that were found after an execution was recorded; from then on its status is not ok."""

    execution: Annotated[Kept, "the execution, or its judgement that is not ok", Of.JUDGEMENT, KEY]
    found_at: Annotated[datetime, "when the problem was found"]
    status: Annotated[Kept, "the new status"]
    reason: Annotated[Kept, "the reason, in one line"]
    lamport: Annotated[int, "its position in the logical order, as in sessions"]


class ArtifactRow(NamedTuple):
    """Files that executions left, and their logs, as they were last evaluated. A bag has a row for each of its tables, and an
    archive one for each file in it that became a table.
    """

    execution: Annotated[Kept, "the execution", Of.JUDGEMENT]
    run: Annotated[Kept, "the run"]
    path: Annotated[
        Kept,
        "path in the output folder; for logs, stdout or stderr; late/PLACE/… for what a lost robot gave back later",
    ]
    kind: Annotated[Kept, "table, file or log; logs are no part of a result"]
    output: Annotated[Kept | None, "the declared or detected output that it belongs to, which is the table's name"]
    size: Annotated[int, "its size", "bytes"]
    sha256: Annotated[
        Kept, "SHA-256 of its bytes; of a log over 1 MiB, SHA-256 of the part that is kept: its beginning and end", To.OBJECT
    ]
    rows: Annotated[int | None, "rows that it added to its table", "1"]
    table_layout: Annotated[
        Kept | None, "layout of its table, as JSON: its file, the type of each column, whether its last line is complete"
    ]
    counted_rows: Annotated[int | None, "rows in the file itself, counted independently of the reader", "1"]
    member: Annotated[Kept | None, "the file in an archive that became the table; NULL: the file itself", LATER] = None

    @property
    def name(self) -> str:
        """Return the path of the file that was read, such as `out.zip/data.csv`."""
        return f"{self.path}/{self.member}" if self.member else self.path


class SessionRow(NamedTuple):
    """Sessions: submissions of a query by one process, recorded when they end."""

    session: Annotated[Kept, "the session's id", Of.SESSION, To.REDACTION]
    batch: Annotated[Kept, "the batch that was requested", About.BATCH]
    query: Annotated[Kept, "the query as it was submitted"]
    started: Annotated[datetime, "when the query was submitted"]
    ended: Annotated[datetime, "when the session ended"]
    runner: Annotated[Kept, "where runs were executed"]
    engine: Annotated[Kept, "the container engine"]
    slots: Annotated[
        int | None, "runs at a time; on a cluster, those of all array tasks together, and NULL if it submitted none", "1"
    ]
    executed: Annotated[int, "runs executed", "1"]
    reexecuted: Annotated[int, "runs among them that had been executed before", "1"]
    reused: Annotated[int, "runs whose recorded successful execution was reused", "1"]
    failed: Annotated[int, "runs of the batch that were executed and have no successful execution", "1"]
    missing: Annotated[int, "runs of the batch that were not executed", "1"]
    interrupted: Annotated[bool, "whether the user interrupted it"]
    sierra: Annotated[Kept, "SIERRA's version"]
    environment: Annotated[EnvironmentId, "the environment in which it ran"]
    source: Annotated[SourceId | None, "the recorded state of the source; NULL if none is recorded"]
    programs: Annotated[Kept, "fingerprint of the programs with which its runs were, or would have been, executed", To.PROGRAMS]
    ingest_rules: Annotated[Kept, "hash of the rules, as in executions", To.INGEST_RULES]
    batch_rules: Annotated[Kept, "hash of the rules and of the allowed differences between runs of the batch (mismatch)"]
    lamport: Annotated[
        int,
        "its position in the logical order: a greater number is later, independent of clocks; old records have "
        "negative numbers, in the order of their times, and so come first",
    ]
    build: Annotated[
        Kept | None, "the build whose products its runs used, as in builds; NULL if there is no [build]", LATER, To.BUILD
    ]
    target: Annotated[Kept | None, "the target that was requested; NULL if it was none", LATER] = None


class BuildRow(NamedTuple):
    """Builds: each time that the command of [build] was executed to make the products from the source."""

    build: Annotated[Kept, "the build's id: the hash of its inputs (the columns source to programs)"]
    session: Annotated[Kept, "what executed it: a session of its own, or the replay", Of.SESSION]
    batch: Annotated[Kept, "the batch that it was executed for"]
    purpose: Annotated[Kept, "run or replay"]
    source: Annotated[Kept | None, "the tree of the code, as in specs"]
    command: Annotated[list[Kept], "program and arguments, before paths of this machine are inserted"]
    folder: Annotated[Kept, "the folder in which it was executed, relative to the project"]
    produces: Annotated[list[Kept], "the patterns of its products, relative to the project"]
    variables: Annotated[Kept, "declared environment variables, as JSON"]
    image: Annotated[Kept | None, "content identity of the container image in which it was executed; NULL without one"]
    host_access: Annotated[list[Kept], "access to the host, as in specs"]
    programs: Annotated[Kept, "fingerprint of the programs that it used, as in programs", To.PROGRAMS]
    host: Annotated[HostName, "host name"]
    engine: Annotated[Kept, "the container engine"]
    started: Annotated[datetime, "when its program started"]
    ended: Annotated[datetime, "when its program ended"]
    exit_code: Annotated[int | None, "the program's exit status; NULL if a signal or the time limit ended it"]
    reason: Annotated[Kept | None, "why it failed, in one line; NULL if it succeeded"]
    compiler: Annotated[Kept | None, "first line of the version text of its compilers, or of its program; NULL if unknown"]
    flags: Annotated[Kept | None, "declared variables that hold compilers and their flags, as JSON; NULL if there are none"]
    result: Annotated[Kept | None, "Merkle hash of the names and digests of its products; NULL if it failed"]
    log: Annotated[
        Kept,
        "SHA-256 of what it printed, which is in objects; if that is over 1 MiB, only its beginning and end are kept",
        To.OBJECT,
    ]
    lamport: Annotated[int, "its position in the logical order, as in sessions"]
    processors: Annotated[
        list[Kept] | None,
        "the processors that {arch} stands for, one after the other; NULL if the build does not use it",
        LATER,
    ] = None


class BuildProductRow(NamedTuple):
    """The products of builds: files of the project that its runs use; their content is not recorded."""

    build: Annotated[Kept, "the build", About.BUILD]
    session: Annotated[Kept, "what executed it, as in builds", Of.SESSION]
    name: Annotated[Kept, "the product's path in the project"]
    size: Annotated[int, "its size", "bytes"]
    sha256: Annotated[Kept, "SHA-256 of its bytes"]


class SharedFileRow(NamedTuple):
    """Files of the project that lie beside the inputs in the folder of each run (`files` in `sierra.toml`)."""

    shared: Annotated[Kept, "the set of files, as in specs", KEY]
    name: Annotated[Kept, "path of the file, in the project and in the folder of a run", KEY]
    sha256: Annotated[Kept, "SHA-256 of the file; the file itself is in objects", To.OBJECT]
    size: Annotated[int, "its size", "bytes"]
    executable: Annotated[bool, "whether the owner may execute it"]


class ReplayRow(NamedTuple):
    """Replays: recorded runs that were executed again from the record alone, and compared with it."""

    replay: Annotated[Kept, "the replay's id, which is also the session of its executions", About.REPLAY, To.REDACTION]
    kind: Annotated[Kept, "the kind of record that was replayed: batch, experiment, run or execution"]
    target: Annotated[Kept, "the id of the replayed record"]
    batch: Annotated[Kept, "the batch that was replayed, or that contains the replayed record"]
    started: Annotated[datetime, "when it was submitted"]
    ended: Annotated[datetime, "when its verdict was known"]
    runner: Annotated[Kept, "where runs were executed"]
    engine: Annotated[Kept, "the container engine"]
    runs: Annotated[int, "runs compared", "1"]
    verdict: Annotated[
        Kept, "identical, equal, within tolerance, equivalent, different or failed: the worst verdict of its experiments"
    ]
    tolerances: Annotated[Kept | None, "tolerances that were requested, as JSON: by output, by column; NULL if none were"]
    environment: Annotated[EnvironmentId, "the environment in which it ran"]
    programs: Annotated[Kept, "fingerprint of the programs with which it was executed", To.PROGRAMS]
    lamport: Annotated[int, "its position in the logical order, as in sessions"]


class VerdictRow(NamedTuple):
    """Verdicts: how far each output of a replayed run agrees with its record."""

    replay: Annotated[Kept, "the replay", About.REPLAY]
    run: Annotated[Kept, "the run"]
    recorded: Annotated[Kept, "the recorded execution", About.EXECUTION]
    execution: Annotated[Kept | None, "the execution that was compared with it; NULL if there is none", About.EXECUTION]
    path: Annotated[Kept | None, "the output's path; NULL if the verdict is about the whole run"]
    verdict: Annotated[Kept, "identical, equal, within tolerance, different or failed"]
    reason: Annotated[Kept | None, "the reason in one line; empty if they are identical"]
    row: Annotated[int | None, "the first row (or line) in which they differ, from 0"]
    column: Annotated[Kept | None, "the column of the first difference"]
    recorded_value: Annotated[Kept | None, "the recorded value at the first difference"]
    replayed_value: Annotated[Kept | None, "the replayed value at the first difference"]
    max_abs: Annotated[float | None, "the greatest absolute difference in that column, in its unit"]
    max_rel: Annotated[float | None, "the greatest difference relative to the recorded number", "1"]
    max_ulp: Annotated[float | None, "the greatest difference in units in the last place", "1"]


class CaptureRow(NamedTuple):
    """Captures: measured runs that were executed once more with rendering, for their frames alone, and compared."""

    execution: Annotated[Kept, "the execution with rendering; its frames are among its artifacts", About.EXECUTION]
    session: Annotated[Kept, "what executed it"]
    batch: Annotated[Kept, "the batch for which it was executed"]
    run: Annotated[Kept, "the run"]
    recorded: Annotated[Kept, "the measured execution with which it was compared, or a later judgement of it", About.EXECUTION]
    rendering: Annotated[Kept, "hash of its inputs, command, variables and services; the same rendering has the same hash"]
    files: Annotated[Kept, "pattern of the names of its frames, relative to its output folder"]
    frames: Annotated[int, "number of frames that it left", "1"]
    ticks_per_second: Annotated[
        float | None, "ticks, as the names of its frames have them, in a second of simulated time; NULL if unknown", "1/s"
    ]
    verdict: Annotated[
        Kept, "how far its other outputs agree with the measured ones: identical, equal, within tolerance, different or failed"
    ]
    reason: Annotated[Kept | None, "the reason in one line; empty if they are identical"]
    lamport: Annotated[int, "its position in the logical order, as in sessions"]


class RenderingRow(NamedTuple):
    """Renderings of executions for capture, recorded before they begin: a finished one counts though its capture was killed."""

    execution: Annotated[Kept, "the execution; it is not in executions if it has not finished", About.EXECUTION]
    batch: Annotated[Kept, "the batch for which it is executed", About.BATCH]
    run: Annotated[Kept, "the run"]
    rendering: Annotated[Kept, "hash of its rendering, as in captures"]


class EquivalenceRow(NamedTuple):
    """Metrics of nondeterministic experiments that a replay compared over all runs, by two one-sided tests (TOST)."""

    replay: Annotated[Kept, "the replay", About.REPLAY]
    experiment: Annotated[Kept, "the experiment"]
    metric: Annotated[Kept, "the metric's name in [equivalence]"]
    output: Annotated[Kept, "the output"]
    column: Annotated[Kept, "the column of the output"]
    measure: Annotated[Kept, "how each run was reduced to one number"]
    recorded_mean: Annotated[float | None, "the recorded mean, in the column's unit"]
    replayed_mean: Annotated[float | None, "the replayed mean"]
    n: Annotated[int | None, "number of pairs of runs; NULL if the means were not compared", "1"]
    difference: Annotated[float | None, "the mean of the differences between paired runs"]
    low: Annotated[float | None, "lower end of the confidence interval (level 1 - 2 alpha) of the difference"]
    high: Annotated[float | None, "upper end of the confidence interval"]
    margin: Annotated[float | None, "the interval must lie between -margin and +margin"]
    alpha: Annotated[
        float | None,
        "significance level: greatest probability of finding means equivalent that differ by the margin; NULL as n",
        "1",
    ]
    p: Annotated[float | None, "the greater p-value of the two tests", "1"]
    power: Annotated[float | None, "power: probability of finding equal means equivalent", "1"]
    equivalent: Annotated[bool, "whether the interval lies within the margins"]
    reason: Annotated[Kept | None, "the reason, in one line"]


class ObservationRow(NamedTuple):
    """Observations of executions: how it was found out which files they used. Not every execution is observed."""

    execution: Annotated[Kept, "the execution", Of.EXECUTION]
    files: Annotated[
        Rewritten, "the set of files that it executed, read, looked for or listed, as in files_read", To.FILES_READ
    ]
    method: Annotated[
        Kept,
        "the program or the interface by which they were seen; none if the run could not be observed, collected if another "
        "system executed it",
    ]
    reason: Annotated[Rewritten | None, "why it may have used other files too, in one line; NULL if all were seen"]
    notes: Annotated[list[Kept], "what cannot be seen: files that a service or another machine may have read for it"]
    distributions: Annotated[
        list[Kept] | None,
        "Python distributions whose files it used, as name==version, those of which it used most bytes first",
        LATER,
    ]


class FileReadRow(NamedTuple):
    """Sets of files that executions used, outside their own folders; executions that used the same files share one."""

    files: Annotated[Rewritten, "the set: a hash of the columns path, use and sha256", KEY]
    path: Annotated[
        Rewritten,
        "its path; {project}, {home} and {prefix} (a Python virtual environment) stand for folders, {gpu} for GPUs and drivers",
        KEY,
    ]
    use: Annotated[
        Kept,
        "executed, read, found (it was only looked for), missed (looked for and absent), listed (a folder whose names were "
        "read), linked (a link to a file that was read), link (any other link that was followed)",
        KEY,
    ]
    sha256: Annotated[
        Rewritten | None,
        "SHA-256 of its content (in a virtual environment, without the environment's own path), of the names in the folder, or "
        "of the path that the link leads to; NULL if it has none",
        To.LISTING,
        To.OBJECT,
    ]
    size: Annotated[int | None, "its size", "bytes"]


class ListingRow(NamedTuple):
    """Names in the folders that executions listed, without Python's caches and what the execution had written itself."""

    sha256: Annotated[Rewritten, "the SHA-256 of these names, as in files_read", KEY]
    names: Annotated[list[Kept], "the names, sorted"]


class EndingRow(NamedTuple):
    """Remarks on how executions ended, beside their status."""

    execution: Annotated[Kept, "the execution", Of.EXECUTION]
    kind: Annotated[
        Kept,
        "left running (a process that still ran when the command had ended, and was ended), error (the error message with "
        "which standard error of a successful execution ends), error on stdout (the same, if it printed nothing on standard "
        "error), after marker (it was ended because its marker was met) or resumed (it continued from the checkpoint of an "
        "execution that was cut off)",
    ]
    text: Annotated[
        Kept,
        "the process: its program and the first words; the error message; the seconds from marker to end; {checkpoint}",
    ]


class StaleSessionRow(NamedTuple):
    """Sessions whose executions do not count in a later session's batch, because files that they used have changed."""

    session: Annotated[Kept, "the later session", Of.SESSION]
    stale: Annotated[Kept, "the session whose executions do not count"]
    path: Annotated[PathName, "one of the files that have changed, as in files_read"]


class ReusedExecutionRow(NamedTuple):
    """Executions that a session reused although something has changed, because no file that they used has.

    Each of them, or others of its experiment, were observed: files_read has the files. What differs is in unused_changes.
    """

    session: Annotated[Kept, "the session that reused it", Of.SESSION]
    run: Annotated[Kept, "the run that it counts for; it has the input, seed and command of the run that was executed"]
    execution: Annotated[Kept, "the execution, perhaps of another run: one with another source", About.EXECUTION]


class UnusedChangeRow(NamedTuple):
    """Files that differ between reused executions and the session that reused them, and that these executions did not use."""

    session: Annotated[Kept, "the session that reused the executions", Of.SESSION]
    spec: Annotated[Kept, "the run specification of the executions"]
    programs: Annotated[Kept, "the programs of the executions", To.PROGRAMS]
    name: Annotated[PathName, "the file as in files_read, or the program as in programs"]


class FileWrittenRow(NamedTuple):
    """Files that executions wrote, but not among their outputs, or removed outside their own folders."""

    execution: Annotated[Kept, "the execution", Of.EXECUTION]
    path: Annotated[
        PathName, "its path, as in files_read; outside the run's own folder {run}, it is known of observed runs only"
    ]
    use: Annotated[
        Kept,
        "written, removed, or reread (written and read again, so that other executions may have written it meanwhile); "
        "reread_new if the execution made the name itself, or a folder above it, and had not removed it before",
    ]


class ChannelRow(NamedTuple):
    """Ports that executions were given, and ports, sockets, groups, shared memory and queues that observed ones used."""

    execution: Annotated[Kept, "the execution", Of.EXECUTION]
    name: Annotated[
        PathName,
        "its name: 127.0.0.1:PORT for any address of the host, with /udp for UDP; GROUP:PORT/udp; @NAME for an abstract Unix "
        "socket; the path of another one, as in files_read; or `shared memory KEY`, `semaphore KEY`, `message queue KEY`",
    ]
    use: Annotated[
        Kept,
        "given (by {port}); listened; reused (listened with an option by which others may have the same name at the same time, "
        "or something that belongs to all); in_use (another program had it); searched (the same, but then the process chose "
        "another one); connected (to a server that is not the execution's own)",
    ]


class EnvironmentRow(NamedTuple):
    """Environments of executions (operating system, hardware, libraries, variables), each recorded once."""

    environment: Annotated[Rewritten, "hash of all columns below", KEY]
    host: Annotated[Rewritten, "host name"]
    os: Annotated[Kept | None, "operating system, by its own name"]
    kernel: Annotated[Kept, "kernel release"]
    machine: Annotated[Kept, "processor architecture"]
    cpu: Annotated[Kept | None, "processor model"]
    cpu_flags: Annotated[list[Kept], "processor features that change arithmetic or its speed, such as avx2 and fma"]
    cores: Annotated[int, "usable cores", "1"]
    memory: Annotated[int | None, "main memory", "bytes"]
    gpus: Annotated[list[Kept], "GPUs, by name or by vendor and device ids, each with its driver"]
    libc: Annotated[Kept | None, "C library and its version"]
    container: Annotated[
        Rewritten | None, "the container in which SIERRA ran, with its image if known; NULL if in no container"
    ]
    locale: Annotated[Rewritten | None, "SIERRA's locale; runs use the declared one"]
    timezone: Annotated[Rewritten | None, "SIERRA's time zone; runs use the declared one"]
    limits: Annotated[
        Kept, "process limits (ulimit) as JSON, soft and hard by name, in bytes, seconds or numbers; null for no limit"
    ]
    modules: Annotated[list[Rewritten], "environment modules that were loaded"]
    variables: Annotated[
        Rewritten, "environment variables as JSON: those known to change results, and those in [environment] record"
    ]
    python: Annotated[Kept, "version of the Python that ran SIERRA, or its agent on a robot"]
    sierra: Annotated[Kept, "SIERRA's version"]
    distributions: Annotated[
        Kept, "Python distributions installed where SIERRA, or its agent on a robot, ran, one name==version per line"
    ]
    lock: Annotated[Kept | None, "SHA-256 of the column distributions"]
    packages: Annotated[
        Kept | None, "packages of a robot's system, one name==version per line; NULL for other hosts", LATER
    ] = None
    workspaces: Annotated[
        Rewritten | None,
        "workspaces that a robot's setup line has sourced, one per line: folder, SHA-256 of its files, and commits of its "
        "repositories; NULL if there are none, and for other hosts",
        LATER,
    ] = None


class SourceRow(NamedTuple):
    """Sources: states of the code of runs, each recorded once."""

    source: Annotated[Rewritten, "hash of all columns below except files", KEY]
    tree: Annotated[Kept, "the tree of the code that identifies runs, as an SWHID"]
    vcs: Annotated[Rewritten, "git, or none"]
    commit: Annotated[Rewritten | None, "the commit that was checked out"]
    branch: Annotated[Rewritten | None, "the branch that was checked out"]
    dirty: Annotated[bool | None, "whether files of the tree differ from the commit; NULL outside git", Redaction.ROW]
    remote: Annotated[Rewritten | None, "the remote's address, without credentials"]
    described: Annotated[
        Rewritten | None, "the commit relative to the nearest tag, as given by git describe --always --dirty --tags"
    ]
    folder: Annotated[Rewritten | None, "the project's folder relative to the root of the repository; . if it is the root"]
    submodules: Annotated[Rewritten | None, "submodules, as JSON: path and commit; NULL if there are none"]
    files: Annotated[Kept, "SHA-256 of the list of files, which is in objects: one mode, hash and path per line", To.OBJECT]


class BlobRow(NamedTuple):
    """Files of sources outside git, by the hash that git would give them; the list of a source's files has this hash."""

    blob: Annotated[
        Kept,
        "git's hash of the file; in packages also the id of a submodule's commit, that of its tree (with its list of files), "
        "and the SHA-256 of data that git-lfs manages",
        KEY,
        About.BLOB,
    ]
    sha256: Annotated[Kept, "SHA-256 of the file; the file itself is in objects", To.OBJECT]


class IngestRulesRow(NamedTuple):
    """The rules by which executions were evaluated, so that other executions can be evaluated by the same rules."""

    ingest_rules: Annotated[Kept, "hash of the rules, as in executions", KEY]
    declared: Annotated[Kept, "the tables [outputs] and [success] of sierra.toml, as JSON"]


class ProgramRow(NamedTuple):
    """Dependencies of executions outside source and image: programs, libraries, Python distributions, files."""

    programs: Annotated[Kept, "fingerprint of the set of programs that was used together", KEY]
    name: Annotated[
        PathName,
        "the name that the command uses; for a library, the name that the loader uses; for a file in the project "
        "or in a mount, {project}/… or {mount}/…",
        KEY,
    ]
    kind: Annotated[Kept, "program, library, distributions (packages installed for a Python), file or link"]
    version: Annotated[
        Kept | None,
        "for a program, the first line of its version text; for distributions, one name==version per line; else NULL",
    ]
    path: Annotated[PathName | None, "where it was found; several folders are separated by :", KEY]
    sha256: Annotated[
        Kept | None, "SHA-256 of the file; for distributions, of their names and versions, or of their content", To.OBJECT
    ]


class ImageRow(NamedTuple):
    """Container images in which runs were, or would have been, executed, each recorded once."""

    image: Annotated[
        Kept,
        "content identity: sha256: and the digest of an OCI image's configuration; squashfs: and that of a file system; "
        "variants: and the hash of the images in the column variants",
        KEY,
    ]
    kind: Annotated[Kept, "oci or squashfs; variants for images for several processors"]
    architecture: Annotated[Kept | None, "the OCI name: amd64, arm64, …; NULL if the image does not state it"]
    layers: Annotated[list[Kept], "digests of the layers' files (OCI's diff_ids), lowest layer first; empty for a squashfs"]
    name: Annotated[Kept | None, "the name that the project uses"]
    file: Annotated[
        PathName | None, "path of the image file, relative to the project's root if it is in the project; NULL for a tag"
    ]
    sha256: Annotated[Kept | None, "SHA-256 of that file"]
    squashfs: Annotated[Kept | None, "SHA-256 of the squashfs that SIERRA made from it for apptainer; NULL if it made none"]
    manifests: Annotated[
        Kept | None, "digests of its manifests as JSON, by the form in which they were seen; each form has another digest"
    ]
    created: Annotated[datetime | None, "when it was created, as the image states", Redaction.NOTHING]
    labels: Annotated[Kept | None, "its labels, as JSON"]
    variables: Annotated[Kept | None, "environment variables that it sets for its programs, as JSON"]
    packages: Annotated[Kept | None, "installed packages, as JSON: for each of dpkg, apk and python a list of name==version"]
    recipe: Annotated[Kept | None, "how it was made, if known: a definition file, or a history"]
    files: Annotated[
        Kept | None,
        "SHA-256 of the list of its files, which is in objects: one JSON object per line with path, type, size, sha256; NULL "
        "for variants",
        To.OBJECT,
    ]
    size: Annotated[int, "total size of its files; 0 for variants, whose images have rows of their own", "bytes"]
    variants: Annotated[
        list[Kept] | None,
        "the images for several processors that one name with {arch} stands for, each as PROCESSOR=IMAGE; NULL for one image",
        LATER,
    ] = None


class DeliverableRow(NamedTuple):
    """Deliverables: figures, tables, videos and reports made from the store, with a row each time that one has changed."""

    deliverable: Annotated[Kept, "hash of all columns below except made and lamport"]
    batch: Annotated[Kept, "the batch that it was made for", About.BATCH]
    batches: Annotated[list[Kept], "the batches whose data it shows"]
    kind: Annotated[Kept, "figure, table, comparison, video or report"]
    name: Annotated[Kept, "its name"]
    definition: Annotated[Kept, "what it shows and how, with labels, units and notes, as JSON"]
    sql: Annotated[Kept, "the SQL that computed its data"]
    data: Annotated[Kept, "hash of the data that it shows"]
    files: Annotated[list[Kept], "its files, relative to the project"]
    sha256s: Annotated[list[Kept], "SHA-256 of each of these files"]
    made_by: Annotated[list[Kept], "SIERRA and the libraries that made it, as name==version"]
    made: Annotated[datetime, "when it was made"]
    lamport: Annotated[int, "position in the logical order, as in sessions"]


class StudyRow(NamedTuple):
    """Sequential studies: a query, a rule about intervals, and the schedule of looks, recorded before the first look."""

    study: Annotated[Kept, "hash of the columns batch, rule, schedule, alpha and correction", About.STUDY]
    batch: Annotated[Kept, "the batch of the first look"]
    query: Annotated[Kept, "the criteria, in full"]
    rule: Annotated[Kept, "when to stop, as in ci(coverage) < 0.02: half of the interval's width, in every experiment"]
    schedule: Annotated[Kept, "the runs per experiment at each look, as a JSON list; fixed before the first look"]
    alpha: Annotated[float, "the probability that an interval misses the true value at any of the looks", "1"]
    correction: Annotated[Kept, "the correction for looking: bonferroni (level 1 - alpha / looks at each look)"]
    begun: Annotated[datetime, "when it began"]
    lamport: Annotated[int, "position in the logical order, as in sessions"]


class LookRow(NamedTuple):
    """Looks of studies at the data, each with the decision that was made."""

    look: Annotated[Kept, "hash of the columns study to reason and of its intervals", About.LOOK]
    study: Annotated[Kept, "the study"]
    number: Annotated[int, "the look's number in the schedule, from 1"]
    batch: Annotated[Kept, "the batch whose runs it looked at"]
    runs: Annotated[int, "runs per experiment, also those that failed", "1"]
    level: Annotated[float, "confidence of its intervals, corrected for all looks of the schedule", "1"]
    decision: Annotated[
        Kept,
        "reached, continue, not reached (at the last look), or stopped (an experiment has no successful run; the look may be "
        "repeated)",
    ]
    reason: Annotated[Kept, "the reason, in one line"]
    decided: Annotated[datetime, "when it was made"]
    lamport: Annotated[int, "position in the logical order, as in sessions"]


class LookIntervalRow(NamedTuple):
    """Intervals that looks saw: one for each condition of the rule and each experiment."""

    look: Annotated[Kept, "the look", About.LOOK]
    condition: Annotated[Kept, "the condition, as in the rule"]
    ordinal: Annotated[int, "the experiment's position in the batch, from 0"]
    n: Annotated[int, "runs with a value", "1"]
    value: Annotated[float | None, "the statistic, in the column's unit; NULL without a run"]
    low: Annotated[float | None, "lower end of the interval; NULL if there is none"]
    high: Annotated[float | None, "upper end of the interval"]
    method: Annotated[Kept | None, "the method of the interval; NULL if there is none"]
    half_width: Annotated[float | None, "half of the interval's width"]
    wanted: Annotated[float | None, "the half-width below which the condition holds; NULL if there is none"]
    holds: Annotated[bool, "whether the condition holds"]
    needed: Annotated[int | None, "estimated runs with which it would hold; NULL if it holds, or if there is no estimate", "1"]


class RegisteredClaimRow(NamedTuple):
    """Registered claims: the text of each claim of sierra.toml, recorded when it was first seen. A claim is planned if all
    executions that count for it belong to sessions with higher Lamport numbers.
    """

    claim: Annotated[Kept, "hash of the column text", KEY, About.CLAIM]
    session: Annotated[Kept, "the session that recorded it, which has no row in sessions", KEY, Of.SESSION, To.REDACTION]
    name: Annotated[Kept, "its name in sierra.toml when it was recorded", KEY]
    text: Annotated[Kept, "its sentence, its queries with their runs, and how it is decided, in normal form, as JSON"]
    registered: Annotated[datetime, "when it was recorded"]
    lamport: Annotated[int, "position in the logical order, as in sessions"]


class ImportRow(NamedTuple):
    """Imported packages, whose records were made in other stores."""

    package: Annotated[PackageId, "the package's id: a hash over the names and hashes of its files", KEY]
    title: Annotated[Hidden, "its title"]
    date: Annotated[Hidden, "its date of publication, as it states it"]
    batches: Annotated[list[Kept], "the batches that it has, those that were in the store before included"]
    imported_at: Annotated[datetime, "when it was first imported"]
    lamport: Annotated[int, "position of the import in the logical order, as in sessions"]


class ImportedSessionRow(NamedTuple):
    """Sessions that came in packages: their executions were not made here."""

    session: Annotated[Kept, "the session", KEY, About.IMPORTED_SESSION]
    batch: Annotated[Kept, "the batch that was requested; empty if the session registered claims"]
    packages: Annotated[
        list[PackageId],
        "the package that was imported, as in imports; then the package from which that one had the session, and so on",
        To.IMPORT,
    ]
    lamport: Annotated[int, "position of the import in the logical order, as in sessions"]


class RedactionRow(NamedTuple):
    """Redactions: sessions whose records were rewritten for an anonymous package.

    Hosts, folders, commits, times and parts of environments in these records are not the original ones; ids of runs, seeds,
    durations and outputs are.
    """

    session: Annotated[Kept, "the session; for a replay, the replay", KEY]
    batch: Annotated[Kept, "the batch that its records belong to; empty for registered claims", KEY]
    rules: Annotated[Kept, "the version of the rules by which the records were rewritten"]


class ObjectRow(NamedTuple):
    """Recorded files by the hash of their content, in parts of at most 8 MiB; files that became tables are included unless
    [store] raw is false.
    """

    sha256: Annotated[Kept, "SHA-256 of the whole file", KEY]
    part: Annotated[int, "position of this part, from 0", KEY]
    size: Annotated[int, "size of the whole file", "bytes"]
    content: Annotated[bytes, "the part's bytes"]


ROWS: dict[str, type[NamedTuple]] = {
    "batches": BatchRow,
    "experiments": ExperimentRow,
    "batch_runs": BatchRunRow,
    "specs": SpecRow,
    "executions": ExecutionRow,
    "attempts": AttemptRow,
    "robots": RobotRow,
    "trials": TrialRow,
    "duplicates": DuplicateRow,
    "isolations": IsolationRow,
    "judgements": JudgementRow,
    "findings": FindingRow,
    "artifacts": ArtifactRow,
    "sessions": SessionRow,
    "builds": BuildRow,
    "build_products": BuildProductRow,
    "shared_files": SharedFileRow,
    "replays": ReplayRow,
    "verdicts": VerdictRow,
    "equivalences": EquivalenceRow,
    "captures": CaptureRow,
    "renderings": RenderingRow,
    "environments": EnvironmentRow,
    "sources": SourceRow,
    "blobs": BlobRow,
    "ingest_rules": IngestRulesRow,
    "programs": ProgramRow,
    "observations": ObservationRow,
    "files_read": FileReadRow,
    "listings": ListingRow,
    "files_written": FileWrittenRow,
    "channels": ChannelRow,
    "endings": EndingRow,
    "stale_sessions": StaleSessionRow,
    "reused_executions": ReusedExecutionRow,
    "unused_changes": UnusedChangeRow,
    "images": ImageRow,
    "deliverables": DeliverableRow,
    "studies": StudyRow,
    "looks": LookRow,
    "look_intervals": LookIntervalRow,
    "registered_claims": RegisteredClaimRow,
    "imports": ImportRow,
    "imported_sessions": ImportedSessionRow,
    "redactions": RedactionRow,
    "objects": ObjectRow,
}
"""The class of each recorded table's rows."""

TABLES = {row: name for name, row in ROWS.items()}
"""The table of each class of rows."""
