"""Capture: execute recorded runs once more with rendering, for their frames alone, and compare the rest with the record.

Rendering takes time and may disturb a simulation, so measured runs do not render. A capture is a replay with another command,
other variables or an input that asks for frames. Its executions have the purpose `capture`: they are never effective, and
nothing counts them. Their outputs other than frames are compared with the measured ones, and the verdict is recorded with the
frames: a video can say if it shows another course of events than the one that was measured.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from typing import NamedTuple

from sierra.config.project_file import LoadedProject
from sierra.errors import Missing, NotFound, UsageError
from sierra.execution import plan_from_record, recover, sessions, targets
from sierra.execution.observer import Observer
from sierra.extensions.videos.rendered_runs import RenderedRuns, check_display
from sierra.model import RunSpec, Status
from sierra.replay import replay
from sierra.replay.compare_values import Verdict, worst
from sierra.replay.options import ReplayOptions
from sierra.replay.verdicts import Compared, Replay
from sierra.store import captures
from sierra.store.recorded_files import ChosenExecution, take
from sierra.store.row_types import CaptureRow, RenderingRow
from sierra.store.store import ResolvedId, Store
from sierra.util.hashing import short
from sierra.util.lazy_definitions import dataclass

NO_FRAMES = "the execution left no file {!r}; see [capture]"
NOTHING_ELSE = "no other output could be compared"


@dataclass(frozen=True, slots=True)
class CaptureOptions:
    """Options of a capture."""

    slots: int
    runs: int = 1
    """Number of runs to capture per experiment, from the first."""
    runner: str = "local"
    engine: str | None = None
    again: bool = False
    """True to capture runs whose frames are recorded already."""


@dataclass(frozen=True, slots=True)
class Captures:
    """Result of a capture."""

    batch: str
    made: tuple[CaptureRow, ...]
    """The captures that were made now, in the order of the runs."""
    known: int
    """Number of runs whose frames were recorded before, by the same rendering."""
    notes: tuple[str, ...] = ()
    interrupted: bool = False

    @property
    def verdict(self) -> Verdict:
        """Return the verdict of the worst capture; an interrupted one has failed."""
        return Verdict.FAILED if self.interrupted else worst(Verdict(one.verdict) for one in self.made)


def capture(
    project: LoadedProject, store: Store, prefix: str, options: CaptureOptions, observer: Observer | None = None
) -> Captures:
    """Execute the runs of an id with rendering, record their frames, and compare the rest with the record.

    Raises NotFound for an unknown id, ConfigError if nothing says how runs render, UsageError for runs on robots, Missing if a
    display is not possible here, and the errors of a replay.
    """
    if not os.access(store.paths.root, os.W_OK):
        raise Missing(f"cannot write to {store.paths.root}, where frames are recorded")
    recover.finish_dead(store, observer or Observer())
    resolved = store.resolve(prefix)
    batch = resolved.batch or resolved.id
    project = targets.of_batch(project, store, batch)
    spec = plan_from_record.spec(store, batch)
    if spec.robots is not None:
        raise UsageError(f"batch {short(batch)} was executed on robots, which cannot repeat a run for frames")
    rendered = _Recorded(project, spec)
    if options.runner == "local" and (spec.image is None or options.engine == "none"):
        check_display(rendered.rendering)
    chosen = _chosen(store, resolved, options)
    for row, files in plan_from_record.inputs(store, chosen):
        rendered.identities[row.run], rendered.rates[row.run] = rendered.identity(files), rendered.ticks_per_second(files)
    known = set() if options.again else _known(store, chosen, rendered.identities)
    rest = frozenset(row.run for row in chosen) - known
    if not rest:
        return Captures(batch, (), len(known))
    rendered.finished = _finished(store, rendered.identities, rest)
    as_replay = ReplayOptions(options.slots, None, options.runner, options.engine, only=rest, variation=rendered)
    answer = replay.replay(project, store, prefix, as_replay, observer)
    captured = captures.of_executions(store, [str(run.execution) for run in answer.runs])
    return Captures(batch, tuple(captured), len(known), answer.notes, answer.interrupted)


def _chosen(store: Store, found: ResolvedId, options: CaptureOptions) -> list[ChosenExecution]:
    """Return the measured executions that are captured. Raises NotFound if there is none."""
    with store.snapshot() as snapshot:
        named = take(snapshot, found)
    good = [one for one in named if one.status in ("ok", "accepted")]
    chosen = [one for one in good if found.kind in ("run", "execution") or one.number < options.runs]
    if not chosen:
        raise NotFound(f"{found.kind} {short(found.id)} has no successful execution to capture; execute it with sierra run")
    return chosen


def _known(store: Store, chosen: Sequence[ChosenExecution], identities: Mapping[str, str]) -> set[str]:
    """Return the runs whose last capture has the same rendering, and shows what was measured."""
    with store.snapshot() as snapshot:
        before = captures.newest(snapshot, [str(one.judgement) for one in chosen])
    return {row.run for row in before.values() if row.rendering == identities[row.run] and Verdict(row.verdict).fine}


def _finished(store: Store, identities: Mapping[str, str], runs: Collection[str]) -> frozenset[str]:
    """Return executions of these runs with the same rendering that no capture has compared, because it was cut off."""
    with sessions.exclusively(store.paths) as locks:
        living = {one.root.name for one in sessions.alive(store.paths)} if locks else set()
    found = captures.cut_off(store, runs)
    return frozenset(one.execution for one in found if one.rendering == identities[one.run] and one.session not in living)


class _Recorded(RenderedRuns):
    """The runs that render, with the records of their captures."""

    def __init__(self, project: LoadedProject, recorded: RunSpec) -> None:
        super().__init__(project, recorded)
        self.identities: dict[str, str] = {}
        """The identity of the rendering of each run."""
        self.rates: dict[str, float | None] = {}
        """The ticks per simulated second of the frames of each run."""

    def records_before(self, executions: Mapping[str, str], batch: str) -> Iterator[RenderingRow]:
        for run, execution in executions.items():
            yield RenderingRow(execution, batch, run, self.identities[run])

    def records(
        self, answer: Replay, as_replay: Iterable[Iterable[NamedTuple]], store: Store, lamport: int
    ) -> Iterable[Iterable[NamedTuple]]:
        del as_replay
        return [list(self._rows(answer, store, lamport))]

    def _rows(self, answer: Replay, store: Store, lamport: int) -> Iterator[CaptureRow]:
        executions = {"e": [str(run.execution) for run in answer.runs]}
        with store.snapshot() as snapshot:
            snapshot.views.make(("artifacts", "executions"))
            frames = Counter(str(row[0]) for row in snapshot.run(WRITTEN, executions) if self.is_frame(row[1]))
            ends = {row[0]: _Ended(*row[1:]) for row in snapshot.run(ENDED, executions)}
        for index, run in enumerate(answer.runs):
            execution = str(run.execution)
            end = ends.get(execution) or _Ended(answer.id)
            verdict, reason = self._verdict(run, frames[execution], end.reason)
            yield CaptureRow(
                execution=execution,
                session=end.session,
                batch=answer.found.batch or answer.found.id,
                run=run.taken.run,
                recorded=str(run.taken.judgement),
                rendering=self.identities[run.taken.run],
                files=self.rendering.files,
                frames=frames[execution],
                ticks_per_second=self.rates[run.taken.run],
                verdict=verdict,
                reason=reason,
                lamport=lamport + index,
            )

    def _verdict(self, run: Compared, frames: int, end: str) -> tuple[Verdict, str | None]:
        """Return the verdict and the reason; `end` says more on a failed execution."""
        if run.verdict is not Verdict.FAILED and not frames:
            return Verdict.FAILED, NO_FRAMES.format(self.rendering.files)
        if not run.outputs:
            return Verdict.DIFFERENT, NOTHING_ELSE
        if run.verdict is Verdict.IDENTICAL:
            return run.verdict, None
        cause = next(((path, file.reason) for path, file in run.outputs.items() if file.verdict is run.verdict), (None, ""))
        words = [*(str(part) for part in cause if part), *([end] if end else [])]
        return run.verdict, ": ".join(words) or None


class _Ended(NamedTuple):
    """The end of an execution."""

    session: str
    status: str = "ok"
    log_tail: str | None = None

    @property
    def reason(self) -> str:
        """The last line of the log of a failed execution, or the key that sets another limit than the one that it exceeded."""
        if self.status in LIMITS:
            return f"[capture] {LIMITS[self.status]} sets another limit"
        return "".join((self.log_tail or "").strip().splitlines()[-1:]) if self.status != "ok" else ""


LIMITS: Mapping[str, str] = {Status.TIMEOUT: "wall", Status.CPU: "cpu", Status.MEMORY: "memory", Status.OUTPUT: "output"}
"""The keys of limits in `[capture]`, by the status of an execution that exceeds them."""
WRITTEN = "SELECT execution, path FROM artifacts WHERE list_contains($e, execution) AND kind <> 'log'"
ENDED = "SELECT execution, session, status, log_tail FROM executions WHERE list_contains($e, execution)"
