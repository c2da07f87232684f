"""`fsck`: hash every file of a store, check its records, and report each problem and the results that it affects."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from sierra.errors import Damaged, Missing, SierraError
from sierra.execution import sessions
from sierra.maintenance import check_files, check_records
from sierra.maintenance.check_files import Contents, Objects
from sierra.maintenance.check_records import Records
from sierra.maintenance.findings import Affected, Finding, Kind, of, worst_first
from sierra.store import index_check, index_files, ownership_marks
from sierra.store.claim_records import NO_BATCH
from sierra.store.duckdb_file_io import read_parquet
from sierra.store.layout import StorePaths
from sierra.store.read_lock import Shared
from sierra.store.segments import Segment
from sierra.store.store import Snapshot, check_free
from sierra.util.lazy_definitions import dataclass
from sierra.util.shortage import shortage
from sierra.util.text import few

Tell = Callable[[str], None]
REPLACED = "replaced by another segment; sierra gc removes it"
REMEDY = "sierra fsck --repair removes it, and SIERRA builds another one"


@dataclass(frozen=True, slots=True)
class Report:
    """The result of a check: findings, the worst first, and the number of things that were checked."""

    findings: tuple[Finding, ...]
    segments: int
    files: int
    bytes: int
    objects: int
    executions: int
    seconds: float

    @property
    def sound(self) -> bool:
        return all(finding.kind.fine for finding in self.findings)

    @property
    def wrong(self) -> int:
        """The number of problems."""
        return sum(finding.kind.wrong for finding in self.findings)

    @property
    def unchecked(self) -> int:
        """The number of things that could not be checked, for lack of a permission or of anything else."""
        return sum(finding.kind is Kind.UNCHECKED for finding in self.findings)


@dataclass(frozen=True, slots=True)
class Checked:
    """A report, and the values that a repair needs."""

    report: Report
    contents: Contents
    objects: Objects


def check(paths: StorePaths, root: Path, tell: Tell = lambda text: None) -> Checked:
    """Check a store; `root` is its project. Raises Missing if there is no store, or if SIERRA did not make the folder."""
    if not paths.root.is_dir():
        raise Missing(f"no store in {paths.root}: nothing has been run here yet (sierra run creates one)")
    if not check_files.has_segments(paths):
        check_free(paths.root)
    began = time.monotonic()
    shared = Shared(paths.reading)
    try:
        contents = check_files.read(paths, lambda done: tell(f"{done / 1e6:.0f} MB hashed"))
        objects = check_files.read_objects(contents.sound, _blobs(paths, contents), lambda: tell("hashing recorded files"))
        read = Records(paths, contents, objects)
        try:
            tell("checking records")
            records = [] if contents.unchecked else check_records.check(read, root)  # they need all files
            findings = [*_contents(read), *records, *check_index(paths, contents), *_sessions(paths), *_strange(paths)]
            findings += [Finding(Kind.LEFT, f"segments/{name}", REPLACED) for name in contents.left]
            executions = _count(read)
        finally:
            read.snapshot.__exit__()
    finally:
        shared.close()
    count = len(contents.sound) + len(contents.left)
    seconds = time.monotonic() - began
    hashed = (contents.files, contents.bytes, len(objects.whole))
    return Checked(Report(tuple(worst_first(findings)), count, *hashed, executions, seconds), contents, objects)


def _blobs(paths: StorePaths, contents: Contents) -> set[str]:
    """Return the SHA-256 of objects that are files of sources outside git."""
    files = [segment.files["blobs"] for segment in contents.sound if "blobs" in segment.files]
    try:
        with Snapshot(paths.root, contents.sound) as snapshot:
            return {row[0] for row in snapshot.run(f"SELECT sha256 FROM {read_parquet(files)}")} if files else set()
    except SierraError:
        return set()


def _count(read: Records) -> int:
    try:
        return int(read.snapshot.run("SELECT count(*) FROM executions")[0][0])
    except SierraError:
        return 0


def _contents(read: Records) -> Iterator[Finding]:
    """Yield the problems of files, each with the records that it affects."""
    damaged = {segment.name: segment for segment in read.contents.sound}
    for finding in read.contents.findings:
        parts = Path(finding.path).parts
        if finding.kind.fine or len(parts) < 2 or parts[0] != "segments" or parts[1] not in damaged:
            yield finding
        else:
            yield Finding(finding.kind, finding.path, finding.what, _affected(read, parts[1], parts[-1]))
    for path, what in read.objects.faults:
        segment = Path(path).parent.name
        read.contents.broken.setdefault(segment, set()).add("objects.parquet")
        yield Finding(Kind.INCONSISTENT, read.shown(path), what, _affected(read, segment, "objects.parquet"))


def _affected(read: Records, name: str, file: str) -> Affected:
    """Return the records that a segment affects, as far as sound files show; otherwise name the batch in the segment's name."""
    [segment] = [segment for segment in read.contents.sound if segment.name == name]
    try:
        batches = [row[0] for row in read.each("SELECT batch FROM batches WHERE starts_with(batch, $p)", p=segment.batch)]
        executions: set[str] = set()
        for table, path in segment.files.items():
            if table in ("executions", "artifacts") or (table.startswith("output.") and not executions):
                executions |= {row[0] for row in read.each(f"SELECT DISTINCT execution FROM {read_parquet([path])}")}
        affected = of(read.snapshot, executions, batches=batches)
    except (Damaged, SierraError):
        return Affected(text=_named(segment))
    return affected if affected.text else Affected(text=_named(segment))


def _named(segment: Segment) -> str:
    """Return the batch in a segment's name, in words."""
    return "of registered claims" if NO_BATCH.startswith(segment.batch) else f"of batch {segment.batch}…"


def _sessions(paths: StorePaths) -> Iterator[Finding]:
    """Yield a finding for each session that died.

    Yield nothing if the store is not writable: nobody can work in such a store, and sessions cannot be locked.
    """
    if not all(os.access(path, os.W_OK) for path in (paths.root, paths.work) if path.exists()):
        return
    try:
        with sessions.exclusively(paths) as locks:
            living = {alive.root for alive in sessions.alive(paths)}
            ended = sessions.all_of(paths) if locks else []
    except (SierraError, OSError) as error:
        yield Finding(Kind.DAMAGED if shortage(error) is None else Kind.UNCHECKED, "work", str(error))
        return
    for session in ended:
        if session.root not in living:
            what = "a session that died; sierra run or sierra gc finishes it"
            yield Finding(Kind.DEAD, f"work/{session.root.name}", what)


def _strange(paths: StorePaths) -> Iterator[Finding]:
    """Yield a finding for each entry of the work folder that SIERRA did not make. SIERRA never removes these entries."""
    for path in ownership_marks.strange(paths):
        name = path.relative_to(paths.root)
        yield Finding(
            Kind.FOREIGN, str(name), "has no mark of SIERRA, so SIERRA does not touch it; move it away if it is yours"
        )


def check_index(paths: StorePaths, contents: Contents) -> Iterator[Finding]:
    """Yield a finding for each index that is damaged, or that nobody reads, and for what is no index."""
    sound = {segment.name: segment for segment in contents.sound if not contents.broken.get(segment.name)}
    for path in _entries(paths.index):
        name = f"{paths.index.name}/{path.name}"
        if index_files.UNFINISHED.fullmatch(path.name):
            yield Finding(Kind.LEFT, name, "an unfinished file")
        elif not index_files.NAME.fullmatch(path.name) or path.is_symlink() or not path.is_file():
            yield Finding(Kind.STRAY, name, "is not an index")
        elif not index_files.is_current(path):
            yield Finding(Kind.LEFT, name, "an index of another version of SIERRA")
        elif (index := index_files.verified(path, anew=True)) is None:
            yield Finding(Kind.DAMAGED, name, f"has other bytes than SIERRA wrote; {REMEDY}")
        elif tables := index_check.different(index, sound):
            yield Finding(Kind.DAMAGED, name, f"its rows of {few(tables, 3)} are not those of the segments; {REMEDY}")


def _entries(folder: Path) -> list[Path]:
    try:
        return sorted(folder.iterdir())
    except OSError:
        return []
