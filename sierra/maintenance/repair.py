"""`fsck --repair`: rebuild what can be derived, and move damaged segments aside after saving their sound records.

Nothing is deleted. Files that are the same in every store are written again. A MANIFEST is rebuilt if the result has the hash
in the segment's name. Files that do not belong to a store are moved to `damaged/`. The sound files of a damaged segment are
written to a new segment, and the whole old segment is moved to `damaged/`. Saved records must be complete, by one rule:

- An execution stays if its record, and all its artifacts, files, logs and rows, are present and give its result. Otherwise it
  is dropped, and `sierra run` executes it again.
- It is also dropped if its segment has lost the list of imported sessions, unless another segment tells where it was made.
- It stays, and no longer counts, if remarks on executions of its batch are lost: see below.
- Verdicts of a replay are dropped if the replay itself is lost.
- A batch stays if its id follows from its experiments and runs, and if all their inputs and its source are present. Otherwise
  the records of the batch are dropped, its executions stay, and the next run of its query reuses them.

The same rule holds for records that were forged or written wrongly in segments whose bytes are sound.

Also: executions on which remarks are lost: they do not count until somebody judges them again.

Remarks that an execution does not count (tables `trials` and `findings`) take a success back. If the file with them is damaged,
nobody knows which executions it named. So each success of its batch gets a new remark: it is kept, and it does not count.
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from collections.abc import Set as AbstractSet
from datetime import UTC, datetime
from itertools import groupby
from operator import attrgetter
from pathlib import Path
from typing import NamedTuple

from sierra.errors import Damaged, Missing, SierraError
from sierra.execution import sessions
from sierra.maintenance import check_records, fsck
from sierra.maintenance.check_files import DERIVED, FIXED
from sierra.maintenance.check_records import Records
from sierra.maintenance.findings import Kind
from sierra.maintenance.fsck import Checked, Report, Tell
from sierra.maintenance.transaction import aside, changing, publish, undisturbed
from sierra.store import session_numbers
from sierra.store.compaction import Compaction, Drop, groups, touched
from sierra.store.lamport_clock import stamp
from sierra.store.layout import StorePaths
from sierra.store.row_types import About, Of, TrialRow
from sierra.store.schema import columns_with
from sierra.store.segments import FORMAT, FORMATS, IMPORTED, MANIFEST, NAME, SUFFIX, Segment, manifest
from sierra.store.store import Snapshot
from sierra.util.fs import write_whole
from sierra.util.hashing import sha256, short
from sierra.util.lazy_definitions import dataclass, field
from sierra.util.lazy_logger import Log
from sierra.util.regular_files import read_regular
from sierra.util.text import counted

REMARKS = ("findings", "trials")
"""The tables of remarks that take back successes of executions."""
REASON = "remarks on executions of its batch were lost in a damaged file"
SUCCESSES = """
SELECT batch, execution FROM executions
WHERE status IN ('ok', 'accepted') AND purpose = 'run' AND (
    batch[:12] IN (SELECT value FROM doubtful)
    OR run IN (SELECT run FROM batch_runs WHERE batch[:12] IN (SELECT value FROM doubtful))
) ORDER BY ALL
"""
"""SQL: the successful executions of batches, and of their runs in other batches, by the beginnings of the batches' ids."""
LAST = "SELECT * FROM trials WHERE list_contains($executions, execution)"


class Doubtful(NamedTuple):
    """A successful execution on which a remark may be lost."""

    batch: str
    execution: str


def doubtful(paths: StorePaths, sound: Sequence[Segment], broken: Mapping[str, AbstractSet[str]]) -> list[Doubtful]:
    """Return the successful executions of batches of which a file with remarks is lost, by batch.

    `sound` are all segments with their sound files, `broken` the names of lost files by segment.
    """
    batches = {part.batch for part in sound if _has_lost(paths.segments / part.name, broken.get(part.name, frozenset()))}
    if not batches:
        return []
    with Snapshot(paths.root, sound) as snapshot:
        snapshot.add_table("doubtful", value=sorted(batches))
        return snapshot.select(Doubtful, SUCCESSES)


def _has_lost(folder: Path, broken: AbstractSet[str]) -> bool:
    """Check if a segment has lost remarks. Without its MANIFEST, no file in it is sound."""
    files = [f"{name}{SUFFIX}" for name in REMARKS]
    return any(file in broken or (MANIFEST in broken and (folder / file).exists()) for file in files)


def by_batch(found: Iterable[Doubtful]) -> Iterator[tuple[str, list[str]]]:
    """Yield the batches, each with its executions."""
    for batch, members in groupby(found, key=attrgetter("batch")):
        yield batch, [success.execution for success in members]


def remarks(root: Path, sound: Sequence[Segment], executions: Sequence[str], session: str) -> list[TrialRow]:
    """Return a remark on each execution: it does not count. It is later than all sound records, and repeats the last remark."""
    with Snapshot(root, sound) as snapshot:
        last = {row.execution: row for row in snapshot.select(TrialRow, LAST, executions=list(executions))}
        lamport = stamp(session_numbers.highest_of(snapshot, sound) + 1, session)
    now = datetime.now(UTC)
    return [
        last.get(execution, TrialRow(execution, now, None))._replace(marked=now, valid=False, reason=REASON, lamport=lamport)
        for execution in executions
    ]


log = Log(__name__)

JUDGEMENTS = "SELECT judgement FROM judgements WHERE list_contains($e, execution)"


@dataclass(frozen=True, slots=True)
class Repair:
    """The actions of a repair, done or planned, in lines; and the report of a check afterwards."""

    done: tuple[str, ...]
    report: Report


class _Made(NamedTuple):
    """An execution, and the session that made it."""

    execution: str
    session: str


@dataclass(slots=True)
class _Loss:
    """The records that cannot be kept, and the segments that hold them."""

    executions: set[str] = field(default_factory=set)
    batches: set[str] = field(default_factory=set)
    replays: set[str] = field(default_factory=set)
    doubtful: list[Doubtful] = field(default_factory=list)
    """The executions that stay, and no longer count."""
    touched: list[Segment] = field(default_factory=list)

    @property
    def drop(self) -> Drop:
        drop: dict[str, dict[str, AbstractSet[str]]] = {}
        for ids, facts in ((self.executions, (Of.EXECUTION, Of.JUDGEMENT, About.EXECUTION)), (self.replays, (About.REPLAY,))):
            for table, columns in columns_with(*facts).items() if ids else ():
                drop.setdefault(table, {}).update(dict.fromkeys(columns, ids))
        if self.batches:
            drop |= {table: {"batch": self.batches} for table in ("batches", "experiments", "batch_runs")}
        return drop


def repair(paths: StorePaths, root: Path, *, dry_run: bool = False, tell: Tell = lambda text: None) -> Repair:
    """Repair a store. Raises Missing if the disk is full, Busy if others are at work; nothing is lost in either case."""
    _ours(paths)
    checked = _checked(paths, root, tell)
    done = [*_fixed(paths, checked, dry_run), *_manifests(paths, checked, dry_run), *_strays(paths, checked, dry_run)]
    done += _segments_folder(paths, dry_run)
    if done and not dry_run:
        checked = _checked(paths, root, tell)
    done += _salvage(paths, root, checked, dry_run, tell)
    for line in done if not dry_run else ():
        log.warning("repaired: %s", line)
    return Repair(tuple(done), checked.report if dry_run or not done else fsck.check(paths, root, tell).report)


def _checked(paths: StorePaths, root: Path, tell: Tell) -> Checked:
    """Check a store. Raises Missing if something cannot be checked for a lack of anything: it would seem damaged."""
    checked = fsck.check(paths, root, tell)
    for finding in checked.report.findings:
        if finding.kind is Kind.UNCHECKED:
            raise Missing(f"{finding.path} {finding.what}; nothing that depends on it is repaired")
    return checked


def _ours(paths: StorePaths) -> None:
    """Raise Damaged if the store declares another format: its sound data would seem damaged here."""
    with contextlib.suppress(OSError):
        content = read_regular(paths.format).decode("utf-8", "replace")
        if re.fullmatch(r"sierra store \d+\n", content) and content not in FORMATS:
            problem = f"this is {content.strip()!r}, which this SIERRA does not repair"
            raise Damaged(
                f"{paths.format}: {problem}; if this SIERRA made the store, change the file's content to {FORMAT.strip()!r}"
            )


def _fixed(paths: StorePaths, checked: Checked, dry_run: bool) -> Iterator[str]:
    """Write or remove files with known or derived content; yield a line for each."""
    wrong = {finding.path for finding in checked.report.findings} & FIXED.keys()
    for name in sorted(wrong):
        if not dry_run:
            _make_room(paths, paths.root / name)
            write_whole(paths.root / name, FIXED[name].encode())
        yield f"{name}: written again"
    damaged = {finding.path for finding in checked.report.findings if finding.kind is Kind.DAMAGED}
    for name in sorted(name for name in damaged if name in DERIVED or name.startswith(f"{paths.index.name}/")):
        if not dry_run:
            _make_room(paths, paths.root / name)
            (paths.root / name).unlink(missing_ok=True)
        yield f"{name}: removed; SIERRA creates it again"


def _manifests(paths: StorePaths, checked: Checked, dry_run: bool) -> Iterator[str]:
    for name in sorted(checked.contents.broken):
        folder = paths.segments / name
        files = sorted(path for path in folder.iterdir() if path.name != MANIFEST and path.is_file() and not path.is_symlink())
        text = manifest(files)
        if MANIFEST in checked.contents.broken[name] and sha256(text)[:16] == name[-16:]:
            if not dry_run:
                _make_room(paths, folder / MANIFEST)
                write_whole(folder / MANIFEST, text)
            checked.contents.broken.pop(name)
            yield f"segments/{name}/{MANIFEST}: rebuilt from the segment's files; its hash agrees with the segment's name"


def _strays(paths: StorePaths, checked: Checked, dry_run: bool) -> Iterator[str]:
    awaited = {segment.after for segment in checked.contents.sound}
    for finding in checked.report.findings:
        path = paths.root / finding.path
        if (path == paths.segments and path.is_dir()) or path.name in awaited:  # without it, sound records would be hidden
            continue
        if finding.kind is Kind.STRAY and (path.is_symlink() or path.exists()):
            if not dry_run:
                aside(paths, path)
            yield f"{finding.path}: moved to damaged/"


def _segments_folder(paths: StorePaths, dry_run: bool) -> Iterator[str]:
    if not paths.segments.is_dir():
        if not dry_run:
            paths.segments.mkdir()
        yield "segments: created again, without the records that are lost"


def _make_room(paths: StorePaths, path: Path) -> None:
    """Move a folder to `damaged/` that is in the place of a file."""
    if path.is_dir() and not path.is_symlink():
        aside(paths, path)


def _salvage(paths: StorePaths, root: Path, checked: Checked, dry_run: bool, tell: Tell) -> Iterator[str]:
    loss = _loss(paths, checked)
    names = [segment.name for segment in loss.touched]
    if not names:
        return
    if not dry_run:
        _write(paths, root, loss, tell)
    for name in names:
        yield f"segments/{name}: its sound records written to a new segment, and the old segment moved to damaged/"
    for segment in loss.touched:
        if "artifacts" in segment.files and "objects.parquet" in checked.contents.broken.get(segment.name, ()):
            yield f"segments/{segment.name}: the bytes of files that became tables are lost, but their rows are not"
    if loss.executions:
        yield f"lost: {counted(len(loss.executions), 'execution')}; sierra run executes the effective ones again"
    if loss.replays:
        yield f"lost: {counted(len(loss.replays), 'replay')}; the executions stay, and their verdicts are removed"
    for batch, executions in by_batch(loss.doubtful):
        yield (
            f"batch {short(batch)}: remarks on its executions are lost; {counted(len(executions), 'execution')} will not count "
            "until you judge them again (sierra trial valid EXECUTION)"
        )
    for batch in sorted(loss.batches):
        yield f"batch {short(batch)} is not complete; run its query again to record it again"


def _write(paths: StorePaths, root: Path, first: _Loss, tell: Tell) -> None:
    with sessions.exclusively(paths):
        pass  # create the folder for work if it is missing
    with changing(paths) as session:
        loss = first

        def prepare(rewriting: Compaction) -> AbstractSet[str]:
            nonlocal loss
            checked = _checked(paths, root, tell)
            loss = _loss(paths, checked)
            sound = checked.contents.sound
            for group in groups(segment for segment in loss.touched if NAME.fullmatch(segment.name)):
                rewriting.write(group, loss.drop)
            for batch, executions in by_batch(loss.doubtful):
                rewriting.new(batch).records(remarks(paths.root, sound, executions, session.id))
            return {segment.name for segment in sound}

        def may() -> None:
            if loss.executions - first.executions or loss.batches - first.batches:
                raise SierraError("more was damaged during the repair; run the command again")
            undisturbed(paths, session, loss.batches | {success.batch for success in loss.doubtful})

        publish(paths, session, prepare, may, keep={segment.name for segment in first.touched})


def _loss(paths: StorePaths, checked: Checked) -> _Loss:
    """Return the incomplete records of all segments, and the segments that are damaged or hold such records."""
    contents = checked.contents
    loss = _Loss()
    broken, contents.broken = contents.broken, {}
    read = Records(paths, contents, checked.objects)
    try:
        for check in check_records.CHECKS:
            for finding in check(read):
                if finding.kind in (Kind.LOST, Kind.INCONSISTENT):
                    loss.executions |= set() if finding.what == check_records.ORPHANS else set(finding.affected.executions)
                    if not finding.affected.executions:
                        loss.batches |= set(finding.affected.batches)
        loss.executions |= _of_unknown_origin(paths, contents.sound, broken)
        loss.executions |= set(read.column(JUDGEMENTS, e=sorted(loss.executions)))
        loss.replays = set(check_records.lost_replays(read))
        successes = doubtful(paths, contents.sound, broken)
        loss.doubtful = [success for success in successes if success.execution not in loss.executions]
        readable = [segment for segment in contents.sound if segment.name not in broken]
        going = {segment.name for segment in touched(read.snapshot, readable, loss.drop)}
        away = broken.keys() | going
        # a segment that comes after a removed one would wait forever
        loss.touched = [segment for segment in contents.sound if segment.name in away or segment.after in away]
    finally:
        read.snapshot.__exit__()
        contents.broken = broken
    return loss


def _of_unknown_origin(paths: StorePaths, sound: Sequence[Segment], broken: Mapping[str, AbstractSet[str]]) -> set[str]:
    """Return the executions of segments that have lost the list of imported sessions, and that may be imported ones."""
    lost = {name for name, files in broken.items() if f"{IMPORTED}.parquet" in files or MANIFEST in files}
    lacking = [part for part in sound if part.name in lost and "imports" in part.files and IMPORTED not in part.files]
    if not lacking:
        return set()
    with Snapshot(paths.root, lacking) as snapshot:
        rows = snapshot.select(_Made, "SELECT DISTINCT execution, session FROM executions")
    with Snapshot(paths.root, sound) as snapshot:
        known = set(snapshot.values(str, f"SELECT session FROM {IMPORTED}"))
    return {row.execution for row in rows if row.session not in known}
