"""Make the folder of a paper, and check whether it still follows from the store."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Container, Iterable, Iterator, Mapping
from pathlib import Path

from sierra.config.project_file import LoadedProject, Project
from sierra.deliverables.claims.registration import registrations
from sierra.deliverables.claims.rests_on import BatchesOfClaims
from sierra.deliverables.paper import bound_files, folder, numbers
from sierra.deliverables.paper.bound_files import PaperItem
from sierra.deliverables.paper.folder import PaperClaim, PaperFile, PaperQuery, Provenance, Written
from sierra.deliverables.record import Recorder, defined
from sierra.design.query.query_request import QueryRequest
from sierra.errors import DamagedFile, NotFound, SierraError, UsageError
from sierra.execution.batches_of_queries import BatchesOfQueries, command
from sierra.store import deliverable_records
from sierra.store.layout import PROVENANCE
from sierra.store.store import Store
from sierra.util.hashing import sha256, short

SOURCE = "SELECT s.source FROM batches b JOIN specs s ON s.spec = b.spec WHERE b.batch = $b AND s.source IS NOT NULL"


def requests(project: LoadedProject) -> list[QueryRequest]:
    """Return the requests of all queries of the paper; each once.

    Raises NotFound if there are none, and UsageError if the folder of the paper has other files.
    """
    folder.check(path(project), project.root, project.config.paper.folder)
    _check_names(project.config)
    if requested := bound_files.requests(project.config):
        return requested
    raise NotFound("nothing is bound to a query: give figures, tables or comparisons of sierra.toml the key `query`")


def _check_names(config: Project) -> None:
    """Check the names of deliverables and numbers before anything is executed. Raises UsageError, NotFound."""
    compared = bound_files.comparisons(config)
    numbers.check(config, compared)
    others = {name.lower(): f"figures.{name}" for name, figure in config.figures.items() if figure.query}
    others |= {name.lower(): f"paper_tables.{name}" for name, table in config.paper_tables.items() if table.query}
    for name in compared:
        if other := others.get(name.lower()):
            raise UsageError(f"[{other}] and [comparisons.{name}] would have files of the same name; rename one")
    if (config.numbers or config.paper.package) and others.get(bound_files.NUMBERS, "").startswith("paper_tables."):
        raise UsageError(f"[{others[bound_files.NUMBERS]}] and [numbers] would have files of the same name; rename the table")


def path(project: LoadedProject) -> Path:
    """Return the folder of the paper."""
    return project.root / project.config.paper.folder


def make(project: LoadedProject, store: Store, package: str = "") -> Written:
    """Make the files of the paper from the last batches of its queries, and record them. `package`: the id of its package.

    The files of a deliverable stay as they are if they show the same data in the same way, also if the batch is another one.
    Raises the errors of `requests` and `items`.
    """
    requests(project)  # checks the folder, and that there is anything to make
    before = folder.read(path(project)) or Provenance()
    contents: dict[str, bytes] = {}
    files: dict[str, PaperFile] = {}
    items: list[PaperItem] = []
    query_batches = BatchesOfQueries(project, store)
    claims = _claims(query_batches)
    for item in bound_files.items(query_batches, package, _words(claims)):
        kept = _kept(item, before, path(project), _recorded(query_batches, item))
        new_files = {} if kept else item.files()
        contents |= new_files
        files |= kept or {name: _described(item, data) for name, data in new_files.items()}
        items.append(item)
    written = folder.write(
        path(project), before, Provenance(queries=_batches(query_batches), claims=claims, files=files), contents
    )
    _record(project, store, items, {*written.edited})
    return written


Recorded = Mapping[tuple[str, tuple[str, ...]], str]
"""The SHA-256 of files, by their paths and the libraries that made them."""


def _recorded(query_batches: BatchesOfQueries, item: PaperItem) -> Recorded:
    """Return the files that the store has recorded for what a deliverable shows now. Other libraries may make other bytes."""
    if not item.same_bytes:
        return {}
    content, prefix = item.content, path(query_batches.project).relative_to(query_batches.project.root).as_posix()
    same = content.kind, content.name, content.data, defined(content)
    return {
        (file.removeprefix(f"{prefix}/"), tuple(row.made_by)): digest
        for row in deliverable_records.latest(query_batches.store, content.batches[0])
        if (row.kind, row.name, row.data, row.definition) == same
        for file, digest in zip(row.files, row.sha256s, strict=True)
    }


def _kept(item: PaperItem, before: Provenance, directory: Path, recorded: Recorded) -> dict[str, PaperFile] | None:
    """Return the files of a deliverable if they exist and show the same data in the same way; else None.

    Files that the store has recorded with other hashes do not count: somebody edited them together with `provenance.json`.
    """
    known = {name: file for name, file in before.files.items() if (file.kind, file.name) == (item.content.kind, item.name)}
    present = item.data, _definition(item)
    same = all((file.data, file.definition) == present for file in known.values())
    own = all(_is_recorded(name, file, recorded) for name, file in known.items())
    whole = same and own and known.keys() == {*item.paths}
    return known if whole and not any(folder.faults(directory, Provenance(files=known))) else None


def _is_recorded(name: str, file: PaperFile, recorded: Recorded) -> bool:
    """Check whether a file has the bytes that the store has recorded, if it has recorded any by the same libraries."""
    return recorded.get((name, file.made_by), file.sha256) == file.sha256


def _described(item: PaperItem, data: bytes) -> PaperFile:
    """Return what `provenance.json` says about a file of a deliverable."""
    return PaperFile(
        sha256=sha256(data),
        kind=item.content.kind,
        name=item.name,
        batches=item.content.batches,
        data=item.data,
        definition=_definition(item),
        made_by=item.content.made_by,
    )


def _definition(item: PaperItem) -> str:
    """Return the hash of how a deliverable is made; the names of its queries do not count."""
    parts = {
        key: {name: value for name, value in part.items() if name != "query"} if isinstance(part, Mapping) else part
        for key, part in item.content.definition.items()
    }
    return sha256(json.dumps(parts, sort_keys=True, ensure_ascii=False).encode())


def _batches(query_batches: BatchesOfQueries) -> dict[str, PaperQuery]:
    """Return the last batch of each query of the paper, by the query as it is declared."""
    batches = {word: query_batches.last(word) for word in bound_files.queries(query_batches.project.config)}
    sources = {batch: next(iter(query_batches.store.values(str, SOURCE, b=batch)), None) for batch in batches.values()}
    return {word: PaperQuery(batch=batch, source=sources[batch]) for word, batch in batches.items()}


def _claims(query_batches: BatchesOfQueries) -> dict[str, PaperClaim]:
    """Return the claims that a figure, a table or a number of the paper shows, by name."""
    config = query_batches.project.config
    if not config.claims:
        return {}
    shown = {number.claim for number in config.numbers.values()}
    shown |= {
        name
        for name, claim in config.claims.items()
        if (claim.figure in config.figures and config.figures[claim.figure].query)
        or (claim.table in config.paper_tables and config.paper_tables[claim.table].query)
    }
    known = BatchesOfClaims(query_batches.project, query_batches.store)
    batches: dict[str, tuple[str, ...]] = {}
    for name in config.claims:
        if name in shown:
            batches[name] = ()
            with contextlib.suppress(SierraError):  # it has not been run: no execution counts
                batches[name] = tuple(known.of(name, config.claims[name]).values())
    registered = registrations(query_batches.project, query_batches.store, batches)
    return {
        name: PaperClaim(claim=registration.claim, registered=registration.word) for name, registration in registered.items()
    }


def _words(claims: Mapping[str, PaperClaim]) -> dict[str, str]:
    return {name: claim.registered for name, claim in claims.items()}


def _record(project: LoadedProject, store: Store, items: Iterable[PaperItem], edited: Container[Path]) -> None:
    """Record the files of each deliverable, so that a copy of any of them is known by its content."""
    root = path(project)
    recorders: dict[str, Recorder] = {}
    for item in items:
        batch = item.content.batches[0]
        if batch not in recorders:
            recorders[batch] = Recorder(store, project.root, batch)
        if own := tuple(root / name for name in item.paths if root / name not in edited):
            recorders[batch].add(item.content, own)
    for recorder in recorders.values():
        recorder.close()


def faults(project: LoadedProject, store: Store | None, package: str = "") -> Iterator[str]:
    """Yield one line for each file that is missing, was edited, or shows other data than the store has; and for each query
    that has no batch of the present code.

    Without a store, the files are compared with `provenance.json` alone. Raises NotFound if the paper was not made.
    """
    directory, shown = path(project), Path(project.config.paper.folder)
    provenance = folder.read(directory)
    if provenance is None:
        raise NotFound(f"{shown / PROVENANCE} does not exist; make it with: sierra paper")
    yield from (f"{shown / name} {fault}" for name, fault in folder.faults(directory, provenance))
    if provenance.unfinished:
        yield f"{shown / PROVENANCE}: the paper was not finished; make it again with: sierra paper"
    if store is not None:
        query_batches = BatchesOfQueries(project, store)
        yield from dict.fromkeys(_old_queries(query_batches))
        yield from _differences(query_batches, shown, provenance, package)


def _old_queries(query_batches: BatchesOfQueries) -> Iterator[str]:
    """Yield a line for each query that has no batch with the project as it is now."""
    for request in requests(query_batches.project):
        text = " ".join(request.criteria)
        try:
            now, last = query_batches.now(request), query_batches.same(request)[-1:]
        except DamagedFile:
            raise
        except SierraError as error:
            yield f"query {text!r}: {error}"
            continue
        if not last:
            yield f"query {text!r} has not been run; run: {command(request)}"
        elif now is None:
            yield f"query {text!r} has not been run with the code as it is now; its last batch is {short(last[0])}"
        elif now != last[0]:
            yield f"query {text!r} was requested last with other code, as batch {short(last[0])}; make the paper again"


def _differences(query_batches: BatchesOfQueries, shown: Path, provenance: Provenance, package: str) -> Iterator[str]:
    """Yield a line for each file of a deliverable that shows other data now, and for those that are no longer made."""
    known: dict[str, tuple[str, str]] = {}
    recorded: dict[tuple[str, tuple[str, ...]], str] = {}
    paths: list[str] = []
    try:
        claims = _claims(query_batches)
        for item in bound_files.items(query_batches, package, _words(claims)):
            known[f"{item.content.kind} {item.name}"] = item.data, _definition(item)
            paths += item.paths
            recorded |= _recorded(query_batches, item)
        batches = _batches(query_batches)
    except DamagedFile:
        raise
    except SierraError as error:
        yield f"{error}"
        return
    for name, file in provenance.files.items():
        data, definition = known.get(f"{file.kind} {file.name}", (None, None))
        if data is None:
            yield f"{shown / name}: sierra.toml no longer binds this {file.kind} to a query"
        elif data != file.data:
            yield f"{shown / name} shows other data than the store has now"
        elif definition != file.definition:
            yield f"{shown / name} is made otherwise now: sierra.toml or SIERRA has changed"
        elif not _is_recorded(name, file, recorded):
            yield f"{shown / name} is not the file that the store has recorded: {PROVENANCE} has the hash of another one"
    yield from (f"{shown / name} was not made yet" for name in paths if name not in provenance.files)
    for name in sorted({*claims, *provenance.claims}):
        if claims.get(name) != provenance.claims.get(name):
            now = claims[name].registered if name in claims else "not in the paper"
            yield f"{shown / PROVENANCE} has another record of claim {name!r}, which is {now}; make the paper again"
    for word in sorted({*batches, *provenance.queries}):
        if batches.get(word) != provenance.queries.get(word):
            yield f"{shown / PROVENANCE} has another batch of query {word!r} than the store; make the paper again"
