"""Models of everything that is recorded about one batch, experiment, run, execution or session.

`as_dict` of each returns its form in JSON: the columns of its row, then what belongs to it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields
from datetime import datetime
from typing import TYPE_CHECKING, ClassVar, NamedTuple, TypeAlias

from sierra.execution.list_batches import OnCluster
from sierra.execution.row_queries import RecordedProgram
from sierra.model import Value
from sierra.store.row_types import (
    ArtifactRow,
    BatchRow,
    BuildProductRow,
    BuildRow,
    EnvironmentRow,
    ExecutionRow,
    ImageRow,
    IsolationRow,
    RegisteredClaimRow,
    SessionRow,
    SourceRow,
    SpecRow,
)
from sierra.store.sql_result import SqlValue
from sierra.util.json_types import Json
from sierra.util.lazy_definitions import dataclass, field
from sierra.util.text import size

if TYPE_CHECKING:
    from sierra.provenance.commits_between import Known

Record: TypeAlias = dict[str, object]


@dataclass(frozen=True, slots=True)
class CountedExperiment:
    """An experiment of a batch, with the numbers of its runs."""

    ordinal: int
    experiment: str
    values: Mapping[str, Value]
    """Values of the batch's axes in the order of its query, without the axes of other batches."""
    runs: int
    succeeded: int
    failed: int
    accepted: int = 0
    """The number of runs with an end that [success] accepts."""

    def as_dict(self) -> Record:
        counts = {"runs": self.runs, "succeeded": self.succeeded, "accepted": self.accepted, "failed": self.failed}
        return {"ordinal": self.ordinal, "experiment": self.experiment, **self.values, **counts}


@dataclass(frozen=True, slots=True)
class Failed:
    """Runs of a batch that failed for one reason: their number, and the first of them."""

    reason: str
    runs: int
    run: str
    number: int
    values: Mapping[str, Value]


class Attempt(NamedTuple):
    """An attempt at an array task; see the table `attempts`."""

    session: str
    array_task: int
    job: str | None
    node: str
    started: datetime
    ended: datetime
    runs: int
    interrupted_runs: int
    state: str
    error: str | None
    executed: bool | None
    """True if it executed the shown run, False if not, None if a batch is shown."""


class Nondeterminism(NamedTuple):
    """A run whose output changed; see the table of the same name."""

    run: str
    executions: int
    results: int
    verdict: str | None
    programs: str


class ReplayOfBatch(NamedTuple):
    """A replay of a batch, or of a part of it."""

    replay: str
    started: datetime
    kind: str
    target: str
    runs: int
    verdict: str


class CaptureOfBatch(NamedTuple):
    """The last capture of a run of a batch; see the table `captures`."""

    ordinal: int
    number: int
    run: str
    execution: str
    frames: int
    verdict: str
    reason: str | None


class ImportOfBatch(NamedTuple):
    """A package that was imported and has executions of the batch."""

    package: str
    title: str
    date: str
    imported_at: datetime
    counts: bool
    """True if its executions count in the batch; otherwise they stand beside those that do."""


class RobotOfBatch(NamedTuple):
    """A robot that took a place in runs of a batch with one version of its firmware; see the table `robots`."""

    robot: str
    place: int
    robot_group: str
    firmware: str | None
    """None if it is not recorded."""
    runs: int


class FirmwareOfBatch(NamedTuple):
    """A version of the firmware, with the numbers of the robots that had it, and of the runs in which they did."""

    firmware: str
    robots: int
    runs: int


class VerdictOnRun(NamedTuple):
    """The verdict of a replay on an output of a run."""

    replay: str
    started: datetime
    path: str | None
    verdict: str
    reason: str | None


class RunOfExperiment(NamedTuple):
    """A run of an experiment, with its state."""

    number: int
    run: str
    seed: int
    executions: int
    status: str
    reason: str | None


@dataclass(frozen=True, slots=True)
class RecordedFile:
    """A recorded file of a run."""

    path: str
    kind: str
    bytes: int | None
    sha256: str | None


@dataclass(frozen=True, slots=True)
class ShownImage:
    """An image, with its JSON texts decoded; `row` is None if it is not recorded."""

    image: str
    row: ImageRow | None
    packages: Mapping[str, Sequence[str]]
    decoded: Mapping[str, Json]

    def as_dict(self) -> Record:
        return {**self.row._asdict(), **self.decoded, "packages": self.packages} if self.row else {"image": self.image}

    def facts(self, host_access: Sequence[str]) -> dict[str, str]:
        """Return facts for people by name; empty ones are not known."""
        from sierra.containers import images

        row, access = self.row, ", ".join(host_access) or "none"
        known = {"name": row.name or "" if row else "not recorded", "id": self.image, "host access": access}
        if row is None:
            return known
        if row.variants:
            ids = (variant.partition("=") for variant in row.variants)
            return {**known, "images": ", ".join(f"{processor} {images.short(identity)}" for processor, _, identity in ids)}
        counts = ", ".join(f"{len(lines)} of {manager}" for manager, lines in self.packages.items())
        return {
            **known,
            "kind": row.kind,
            "architecture": row.architecture or "",
            "packages": counts or "none found by a package manager",
            "created": str(row.created or ""),
            "size": size(row.size),
            "recipe": f"{len(row.recipe.splitlines())} lines" if row.recipe else "",
        }


@dataclass(frozen=True, slots=True)
class ShownIsolation:
    """An isolation, with its JSON texts decoded; `row` is None if it is not recorded."""

    isolation: str
    row: IsolationRow | None
    executions: int | None
    """Number of executions of the batch that were isolated so; None for a single execution."""
    mounts: Mapping[str, str]
    limits: Mapping[str, Mapping[str, float]]
    """Requested, enforced, monitored and ignored limits."""

    def as_dict(self) -> Record:
        if self.row is None:
            return {"isolation": self.isolation}
        count = {} if self.executions is None else {"executions": self.executions}
        return {**self.row._asdict(), **count, "mounts": self.mounts, **self.limits}


@dataclass(frozen=True, slots=True)
class ShownEnvironment:
    """An environment, with its JSON texts and lists decoded."""

    row: EnvironmentRow
    limits: Mapping[str, Sequence[float | None]]
    variables: Mapping[str, str]
    distributions: Sequence[str]

    def as_dict(self) -> Record:
        return self.row._asdict() | _members(self)


@dataclass(frozen=True, slots=True)
class ShownBuild:
    """The build whose products a batch used last."""

    row: BuildRow
    products: Sequence[BuildProductRow]

    def as_dict(self) -> Record:
        products = [_without(product._asdict(), "build", "session") for product in self.products]
        return {**self.row._asdict(), "products": products}


@dataclass(frozen=True, slots=True)
class ShownBatch:
    """A batch; its row has the controller and the scenario of the whole batch."""

    kind: ClassVar[str] = "batch"
    row: BatchRow
    spec: SpecRow
    experiments: Sequence[CountedExperiment]
    image: ShownImage | None
    isolations: Sequence[ShownIsolation]
    source: SourceRow | None
    programs: Sequence[RecordedProgram]
    environment: ShownEnvironment | None
    build: ShownBuild | None
    """None if there is no `[build]`."""
    failures: Sequence[Failed]
    nondeterminism: Sequence[Nondeterminism]
    replays: Sequence[ReplayOfBatch]
    attempts: Sequence[Attempt]
    sessions: Sequence[SessionRow]
    clusters: Sequence[OnCluster]
    targets: Sequence[str] = ()
    """Targets that it was requested for."""
    history: Known | None = None
    """The recorded commit as the repository has it now."""
    imports: Sequence[ImportOfBatch] = ()
    """Packages from which executions of its sessions came."""
    captures: Sequence[CaptureOfBatch] = ()
    robots: Sequence[RobotOfBatch] = ()
    """Robots of the executions that count."""
    firmware: Sequence[FirmwareOfBatch] = ()
    """Versions of the firmware, if it differs between runs: a place was taken with several. Otherwise empty."""
    log_file: str | None = None
    """Log file of the last session."""
    notes: Sequence[str] = ()
    """Notes on how its runs ended, one line each."""

    def as_dict(self) -> Record:
        attempts = [_without(attempt._asdict(), "executed") for attempt in self.attempts]
        return {"kind": self.kind, **self.row._asdict(), **_members(self), "attempts": attempts}


@dataclass(frozen=True, slots=True)
class ShownExperiment:
    """An experiment of a batch."""

    kind: ClassVar[str] = "experiment"
    experiment: str
    batch: str
    ordinal: int
    values: Mapping[str, Value]
    runs: Sequence[RunOfExperiment]

    def as_dict(self) -> Record:
        place = {"experiment": self.experiment, "batch": self.batch, "ordinal": self.ordinal}
        return {"kind": self.kind, **place, **self.values, "runs": self.runs}


@dataclass(frozen=True, slots=True)
class ShownRun:
    """A run; its row in the table `runs` has a column for each independent variable of any batch."""

    kind: ClassVar[str] = "run"
    row: Mapping[str, SqlValue]
    command: Sequence[str]
    """The spec's command with the seed and the values of variables; paths of machines are still placeholders."""
    spec: SpecRow
    executions: Sequence[ExecutionRow]
    reused_from: str | None
    """The run that was executed, if the effective execution is one of a run with another source."""
    batches: Sequence[str]
    attempts: Sequence[Attempt]
    nondeterminism: Sequence[Nondeterminism]
    verdicts: Sequence[VerdictOnRun]
    files: Sequence[RecordedFile]

    def as_dict(self) -> Record:
        executions = [_without(execution._asdict(), "run") for execution in self.executions]
        return {"kind": self.kind, **_without_nulls(self.row), **_members(self), "executions": executions}


@dataclass(frozen=True, slots=True)
class ShownObservation:
    """Summary of what an observed execution used; the tables files_read and files_written name the files."""

    used: str
    row: CountedFiles

    def as_dict(self) -> Record:
        return {"used": self.used, **self.row._asdict()}


class CountedFiles(NamedTuple):
    """The number of files that an observed execution used."""

    method: str
    reason: str | None
    """The reason why it may have used other files too; None if all were seen."""
    executed: int
    read: int
    missed: int
    """The number of files that it looked for and that were absent."""
    listed: int
    """The number of folders whose names it read."""
    written: int
    """The number of files that it wrote or removed outside its own folders."""
    notes: Sequence[str]


@dataclass(frozen=True, slots=True)
class ShownExecution:
    """An execution."""

    kind: ClassVar[str] = "execution"
    row: ExecutionRow
    attempts: Sequence[Attempt]
    artifacts: Sequence[ArtifactRow]
    image: ShownImage | None
    host_access: Sequence[str]
    isolation: ShownIsolation | None
    programs: Sequence[RecordedProgram]
    environment: ShownEnvironment | None
    observation: ShownObservation | None = None
    """The files that it used; None if it was not observed."""
    packages: Sequence[str] = ()
    """The packages in which it came, the imported one first; empty if it was made here."""
    log_file: str | None = None
    """Log file of its session."""
    records: Mapping[str, Sequence[Record]] = field(default_factory=dict)
    """Its rows in further tables, by table: robots, trials (the remark that counts last), endings, channels and others."""

    @property
    def ports(self) -> list[str]:
        """The ports that it was given in the places of `{port}`, `{port2}`, …"""
        return [str(channel["name"]) for channel in self.records.get("channels", ()) if channel["use"] == "given"]

    def as_dict(self) -> Record:
        members = _without(_members(self), "records", *([] if self.isolation else ["isolation"]))
        artifacts = [_without(artifact._asdict(), "execution", "run") for artifact in self.artifacts]
        records = {"robots": [], "trials": [], "ports": self.ports, "endings": [], **self.records}
        return {"kind": self.kind, **_without_nulls(self.row._asdict()), **members, **records, "artifacts": artifacts}


@dataclass(frozen=True, slots=True)
class ShownSession:
    """A session; `row` is None if only its log file is left."""

    kind: ClassVar[str] = "session"
    session: str
    row: SessionRow | None
    log_file: str | None

    def as_dict(self) -> Record:
        row = self.row._asdict() if self.row else {"session": self.session}
        return {"kind": self.kind, **row, "log_file": self.log_file}


@dataclass(frozen=True, slots=True)
class ShownClaim:
    """A registered claim, which may have been registered several times: under other names, or in other stores."""

    kind: ClassVar[str] = "claim"
    claim: str
    text: Mapping[str, object]
    """Its normal form."""
    registrations: Sequence[RegisteredClaimRow]
    """The registrations, the first one first."""

    def as_dict(self) -> Record:
        rows = [row._asdict() for row in self.registrations]
        known = [{name: row[name] for name in ("name", "session", "registered", "lamport")} for row in rows]
        return {**self.text, "kind": self.kind, "claim": self.claim, "registrations": known}


Shown: TypeAlias = ShownBatch | ShownExperiment | ShownRun | ShownExecution | ShownSession


def _members(shown: ShownBatch | ShownRun | ShownExecution | ShownEnvironment) -> Record:
    """Return the fields except the row, with the form in JSON of those that have one."""
    return {each.name: _form(getattr(shown, each.name)) for each in fields(shown) if each.name != "row"}


def _form(value: object) -> object:
    match value:
        case ShownBuild() | ShownImage() | ShownIsolation() | ShownEnvironment() | ShownObservation() | CountedExperiment():
            return value.as_dict()
        case list():
            return [_form(inner) for inner in value]
        case _:
            return value


def _without(row: Mapping[str, object], *names: str) -> Record:
    return {name: value for name, value in row.items() if name not in names}


def _without_nulls(row: Mapping[str, object]) -> Record:
    return {name: value for name, value in row.items() if value is not None}
