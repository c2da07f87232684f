"""`gc`: remove data that nothing needs, and merge small segments of a batch into one.

It removes folders of sessions that died (their finished executions are recorded first), unfinished files (also those of
figures, videos and reports, and the temporary files of runs whose worker was killed), replaced segments, and recorded files
that no record refers to. It removes the checkpoints of runs that were cut off, if no session is alive. It leaves git's
`refs/sierra/` alone: other projects and stores may share the repository, and no store knows all of them. It removes segments
that a repair put aside only on request.

On request only, it also removes the bytes of files that became tables; their rows stay. Bytes stay if they are also the bytes
of an input, of a file that did not become a table, or of a source.

Merging changes no row, and it keeps the order of rows in an execution. If several merged segments hold the same record, one
copy stays.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from collections.abc import Set as AbstractSet
from pathlib import Path

from sierra.containers.images.image_contents import unfinished
from sierra.execution import recover, sessions, unrecorded
from sierra.execution.observer import Observer
from sierra.maintenance.check_files import UNFINISHED, put_aside
from sierra.maintenance.transaction import changing, publish, undisturbed
from sierra.store import index_builder, index_files, ownership_marks, session_log_file, unfinished_files
from sierra.store.compaction import Compaction, Drop, Group, groups, out_of_use, tidy, touched
from sierra.store.duckdb_file_io import read_parquet
from sierra.store.layout import StorePaths
from sierra.store.segments import Segment
from sierra.store.store import Snapshot, Store
from sierra.util import scratch
from sierra.util.chunking import by_weight
from sierra.util.lazy_definitions import dataclass, replace
from sierra.util.text import counted
from sierra.worker import checkpoints
from sierra.worker.files import remove
from sierra.worker.processes import birth
from sierra.worker.temporary_folders import abandoned_by

MANY = 4
"""The smallest number of small segments of one batch that are merged."""
SMALL = 64 << 20
LARGE = 256 << 20
"""The largest size of merged segments, in bytes, unless one segment alone is larger."""


@dataclass(frozen=True, slots=True)
class Collection:
    """The things that are removed, or would be removed."""

    sessions: int
    """Sessions that died."""
    unfinished: int
    """Files that were never finished."""
    replaced: int
    """Segments that other segments replaced."""
    objects: int
    """Recorded files that nothing refers to, plus those in `raw`."""
    bytes: int
    """The total size of these objects in bytes."""
    merged: int
    """Segments that are merged."""
    into: int
    """Segments that result from merging."""
    damaged: int
    """Segments that a repair put aside, and sessions that cannot be recorded; they are removed only on request."""
    raw: int = 0
    """Files that became tables and whose bytes are removed; only on request."""
    recovered: int = 0
    """Executions that finished in sessions that died, and that are recorded now."""
    logs: int = 0
    """Log files of sessions that are not recorded and have ended."""
    unrecorded: tuple[str, ...] = ()
    """A message about each session that died and cannot be recorded; its files are kept."""
    checkpoints: int = 0
    """Checkpoints of runs that were cut off; none as long as a session is alive, which may need them."""
    left: int = 0
    """Segments that another process was still reading; the next gc removes them."""

    @property
    def nothing(self) -> bool:
        counts = (self.sessions, self.unfinished, self.replaced, self.objects, self.merged, self.damaged, self.logs)
        return not any((*counts, self.checkpoints))


@dataclass(frozen=True, slots=True)
class _Plan:
    groups: tuple[Group, ...]
    drop: Drop
    bytes: int
    raw: int
    seen: AbstractSet[str]

    @property
    def objects(self) -> int:
        return len(self.drop.get("objects", {}).get("sha256", ()))


def plan(store: Store, project: Path | None = None, *, damaged: bool = False, raw: bool = False) -> Collection:
    """Return the data that `collect` would remove and merge."""
    paths = store.paths
    planned = _plan(store, raw=raw)
    with sessions.exclusively(paths) as locks:
        living = {session.root for session in sessions.alive(paths)} if locks else set()
        dead = [session for session in sessions.all_of(paths) if locks and session.root not in living]
        unused = len(out_of_use(paths))
    merged = [group for group in planned.groups if len(group) > 1]
    aside = len(_aside(paths)) if damaged else 0
    return Collection(
        len(dead),
        len(list(_unfinished(paths, project))),
        unused,
        planned.objects,
        planned.bytes,
        sum(len(group) for group in merged),
        len(merged),
        aside,
        planned.raw,
        logs=len(_logs(store)),
        checkpoints=len(_checkpoints(paths)),
    )


def collect(
    store: Store,
    project: Path | None = None,
    *,
    damaged: bool = False,
    raw: bool = False,
    agree: Callable[[Collection], bool] = lambda collection: True,
    observer: Observer | None = None,
) -> Collection | None:
    """Remove data that nothing needs, if `agree` returns true for the preview; return None if it returns false.

    `observer` receives a notice about each session that cannot be recorded. `project` is the folder whose figures, videos and
    reports are looked at for unfinished files; None for none. Raises Missing if the disk is full, Busy if another session has
    just begun; nothing is lost in either case.
    """
    first = plan(store, project, damaged=damaged, raw=raw)
    if not first.nothing and not agree(first):
        return None
    paths = store.paths
    aside = _aside(paths) if damaged else []
    recovered = recover.finish_dead(store, observer or Observer())
    for path in list(_unfinished(paths, project)):
        remove(str(path)) if path.is_dir() else path.unlink(missing_ok=True)
    elsewhere = [lost.elsewhere for lost in unrecorded.found(paths) if lost.folder in aside and lost.elsewhere is not None]
    for path in (*elsewhere, *aside):  # the folders in `aside` name the others
        remove(str(path))
    for path in _logs(store):
        path.unlink(missing_ok=True)
    for path in _checkpoints(paths):
        checkpoints.discard(str(path))
    left = 0
    with changing(paths) as session:
        planned = _plan(store, raw=raw)
        if planned.groups:

            def prepare(rewriting: Compaction) -> AbstractSet[str]:
                nonlocal planned
                planned = _plan(store, raw=raw)
                for group in planned.groups:
                    rewriting.write(group, planned.drop)
                return planned.seen

            left = publish(paths, session, prepare, lambda: undisturbed(paths, session, set()))
        else:
            with sessions.exclusively(paths):
                tidy(paths, session.paths.root / "old")
                left = len(out_of_use(paths))
    index_builder.keep_up(paths)
    kept = len(recovered.left_out)
    removed = replace(first, sessions=max(first.sessions - kept, 0), left=left)
    return replace(removed, recovered=recovered.executions, unrecorded=recovered.left_out)


SESSIONS = (
    "SELECT session FROM all_sessions UNION SELECT session FROM executions UNION SELECT replay FROM replays "
    "UNION SELECT session FROM builds"
)


def _aside(paths: StorePaths) -> list[Path]:
    return [*put_aside(paths), *(lost.folder for lost in unrecorded.found(paths))]


def _logs(store: Store) -> list[Path]:
    """Return the log files of sessions that are not recorded and have ended."""
    if not (found := session_log_file.logs(store.paths)):
        return []
    known = set(store.values(str, SESSIONS)) | {session.root.name for session in sessions.all_of(store.paths)}
    return [path for path in found if path.stem not in known]


def _checkpoints(paths: StorePaths) -> list[Path]:
    """Return the checkpoints of runs, unless a session is alive: its runs may continue from them, also later on a cluster."""
    if not paths.checkpoints.is_dir():
        return []
    with sessions.exclusively(paths) as locks:
        if not locks or sessions.alive(paths):
            return []
    return [path for path in sorted(paths.checkpoints.iterdir()) if checkpoints.is_marked(str(path))]


def _unfinished(paths: StorePaths, project: Path | None) -> Iterator[Path]:
    """Yield temporary files and folders, and images that were still being read, of processes that no longer exist."""
    if project is not None:
        yield from unfinished_files.unfinished(project)
    yield from filter(scratch.is_abandoned, paths.extracted.glob("*"))
    yield from map(Path, abandoned_by(lambda owner: ownership_marks.executes_in(paths, Path(owner))))
    own = (path for path in paths.root.iterdir() if UNFINISHED.fullmatch(path.name))
    for path in (*own, *unfinished(paths), *index_files.unfinished(paths)):
        if birth(int(path.name.rpartition(".")[2])) is None:
            yield path
    yield from index_files.useless(paths)


REFERRED = """
SELECT sha256 FROM all_artifacts {which} UNION SELECT unnest([input] || other_inputs) FROM batch_runs
UNION SELECT files FROM sources UNION SELECT files FROM images UNION SELECT sha256 FROM blobs UNION SELECT log FROM builds
UNION SELECT sha256 FROM shared_files UNION SELECT sha256 FROM programs WHERE starts_with(name, '{{project}}/')
UNION SELECT sha256 FROM files_read WHERE starts_with(path, '{{project}}/')
"""


RAW = "WHERE kind <> 'table'"
TABLES = "SELECT count(DISTINCT sha256) FROM all_artifacts SEMI JOIN unneeded USING (sha256) WHERE kind = 'table'"


def _plan(store: Store, *, raw: bool) -> _Plan:
    with store.snapshot() as snapshot:
        snapshot.views.make(
            ("all_artifacts", "batch_runs", "sources", "images", "blobs", "builds", "programs", "files_read", "shared_files")
        )
        unneeded = _unneeded(snapshot, raw=raw)
        drop = {"objects": {"sha256": set(unneeded)}} if unneeded else {}
        holding = touched(snapshot, snapshot.segments, drop)
        small: dict[str, list[Segment]] = {}
        for segment in snapshot.segments:
            if segment.files and _size(segment) < SMALL:
                small.setdefault(segment.batch, []).append(segment)
        chosen = {id(segment): segment for segments in small.values() if len(segments) >= MANY for segment in segments}
        chosen |= {id(segment): segment for segment in holding}
        parts = [part for group in groups(chosen.values()) for part in map(tuple, by_weight(group, _size, LARGE))]
        kept = [group for group in parts if len(group) > 1 or group[0] in holding]
        raws = _tables(snapshot, unneeded)
        return _Plan(tuple(kept), drop, sum(unneeded.values()), raws, {segment.name for segment in snapshot.segments})


def _unneeded(snapshot: Snapshot, *, raw: bool) -> dict[str, int]:
    """Return the size in bytes of each object that no record refers to; with `raw`, artifacts of kind `table` are ignored."""
    referred = REFERRED.format(which=RAW if raw else "")
    files = [segment.files["objects"] for segment in snapshot.segments if "objects" in segment.files]
    if not files:
        return {}
    statement = f"SELECT sha256, max(size) FROM {read_parquet(files)} o ANTI JOIN ({referred}) r USING (sha256) GROUP BY sha256"
    return dict(snapshot.run(statement))


def _tables(snapshot: Snapshot, unneeded: Iterable[str]) -> int:
    """Return the number of these objects that are the bytes of tables."""
    snapshot.add_table("unneeded", sha256=sorted(unneeded))
    count: int = snapshot.run(TABLES)[0][0]
    return count


def _size(segment: Segment) -> int:
    return sum(Path(path).stat().st_size for path in segment.files.values())


RAW_LOST = (
    " that became tables: their bytes, not their rows. Changes to [outputs] or [success] may then execute their runs again, "
    "sierra show --files rebuilds them from their rows, and checks cannot read them again"
)


def text(collection: Collection) -> list[str]:
    """Return lines that list the data to remove."""
    counts = (
        (collection.sessions, "session", " that died (finished executions are recorded first)"),
        (collection.unfinished, "unfinished file", ""),
        (collection.replaced, "replaced segment", ""),
        (collection.objects - collection.raw, "recorded file", " that nothing refers to"),
        (collection.raw, "file", RAW_LOST),
        (collection.merged, "small segment", f", merged into {collection.into}"),
        (collection.logs, "log file", " of sessions that are not recorded"),
        (collection.checkpoints, "checkpoint", " of runs that were cut off, which then begin anew"),
        (collection.damaged, "folder", " of damaged segments that a repair put aside, and of sessions that cannot be recorded"),
    )
    return [f"{counted(count, noun)}{rest}" for count, noun, rest in counts if count]
